"""Demonstrations as training draws from them: columns in memory, frames in a cache."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hvs_suite.datasets.features import IMAGES
from hvs_suite.errors import DatasetError
from hvs_suite.policies.imitation.frame_cache import Frames, OnFrames, cached_frames, read_rows
from hvs_suite.policies.training.dataset import EPISODE, Column, Manifest, read_columns

# Of the windows, once there are rounds of DAgger, which are a small part of all frames.
ROUNDS_SHARE = 0.5
# Held out from training to measure the loss on; whole episodes, so that no neighbour frame leaks.
HELD_OUT_SHARE = 0.05
# Philox words that keep this stream apart from the training order.
HELD_OUT_STREAM = 1


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """Frames and their labels.

    Attributes:
        columns: Key to (n, k) float32; ``episode_index`` to (n,) int64.
        images: Key to (n, H, W, C) uint8, usually memory-mapped.
    """

    columns: Mapping[str, Column]
    images: Mapping[str, Frames]


class Demonstrations:
    """Frames and labels of one dataset, and of what was added to it.

    Args:
        manifest: Of the dataset.
        cache: Folder for decoded frames.
        seed: Chooses the held-out episodes.
        episodes: Learn from this many episodes, the first ones; None for all.
        on_frames: Called with the number of frames just decoded, over all cameras.

    Attributes:
        manifest: As given.
        training: Indices of the frames to learn from.
        held_out: Indices of the frames of held-out episodes; empty for a single episode.

    Raises:
        DatasetError: The dataset lacks what training needs.
    """

    def __init__(
        self,
        manifest: Manifest,
        cache: Path,
        seed: int,
        *,
        episodes: int | None = None,
        on_frames: OnFrames | None = None,
    ) -> None:
        columns = read_columns(manifest)
        n = manifest.n_frames
        if episodes is not None:
            last = np.unique(columns[EPISODE])[episodes - 1]
            n = int(np.searchsorted(columns[EPISODE], last, "right"))
            columns = {key: column[:n] for key, column in columns.items()}
        self.manifest = manifest
        self._recordings: list[Recording] = []
        self._starts: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        self._length = 0
        images: dict[str, Frames] = {}
        for name, shape in manifest.cameras.items():
            key = IMAGES + name
            if manifest.features[key]["dtype"] != "image":
                raise DatasetError(
                    f"{manifest.root}: {key} is video; train on the lossless recording instead"
                )
            images[key] = cached_frames(
                manifest.root, key, shape, manifest.n_frames, cache, on_frames, first=n
            )
        self._append(Recording(columns, images))
        owner = columns[EPISODE]
        names = np.unique(owner)
        stream = np.random.Generator(np.random.Philox(key=[seed, HELD_OUT_STREAM]))
        n_held_out = max(1, round(HELD_OUT_SHARE * len(names))) if len(names) > 1 else 0
        shuffled = stream.permutation(names)
        self.training = np.flatnonzero(np.isin(owner, shuffled[n_held_out:]))
        self.held_out = np.flatnonzero(np.isin(owner, shuffled[:n_held_out]))

    def __len__(self) -> int:
        """Frames."""
        return self._length

    def add(self, recording: Recording) -> None:
        """Learn from more frames, all of them.

        Args:
            recording: The frames, with the same keys.
        """
        start = len(self)
        self._append(recording)
        self.training = np.concatenate([self.training, np.arange(start, len(self))])

    def _append(self, recording: Recording) -> None:
        self._recordings.append(recording)
        self._starts = np.append(self._starts, self._length)
        self._length += len(recording.columns[EPISODE])

    def columns(self) -> dict[str, Column]:
        """The numbers of all frames by key, ``episode_index`` counted over all recordings."""
        keys = [key for key in self._recordings[0].columns if key != EPISODE]
        whole: dict[str, Column] = {
            key: np.concatenate([r.columns[key] for r in self._recordings]) for key in keys
        }
        begins, lengths = self.episodes()
        whole[EPISODE] = np.repeat(np.arange(len(begins)), lengths)
        return whole

    def episodes(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """First frame and length of every episode of all recordings, (n,) each."""
        begins = []
        for recording, start in zip(self._recordings, self._starts, strict=True):
            owner = recording.columns[EPISODE]
            begins.append(start + np.flatnonzero(np.append(True, owner[1:] != owner[:-1])))
        first = np.concatenate(begins)
        return first, np.diff(np.append(first, self._length))

    def batch(self, indices: npt.NDArray[np.int64]) -> dict[str, Tensor]:
        """Frames as LeRobot's loader would give them, but for images left as bytes.

        Args:
            indices: Of the frames, (B,).

        Returns:
            Images (B, C, H, W) uint8, and the recordings' columns float32.
        """
        # Neighbours on disk together: the same rows, fewer page faults.
        indices = np.sort(indices)
        parts = self._parts(indices)
        batch = {
            key: torch.from_numpy(np.concatenate([r.columns[key][rows] for r, rows in parts]))
            for key in self._recordings[0].columns
            if key != EPISODE
        }
        return batch | {key: self.pictures(key, indices) for key in self._recordings[0].images}

    def pictures(self, key: str, indices: npt.NDArray[np.int64]) -> Tensor:
        """Images of one camera, (B, C, H, W) uint8.

        Args:
            key: Of the images.
            indices: Of the frames, ascending, (B,).
        """
        shape = self._recordings[0].images[key].shape[1:]
        images = torch.empty((len(indices), *shape), dtype=torch.uint8)
        begin = 0
        for recording, rows in self._parts(indices):
            end = begin + len(rows)
            read_rows(recording.images[key], rows, images[begin:end].numpy())
            begin = end
        # (B, H, W, C) stays the layout in memory, which is what the convolutions want.
        return images.permute(0, 3, 1, 2)

    def _parts(
        self, indices: npt.NDArray[np.int64]
    ) -> list[tuple[Recording, npt.NDArray[np.int64]]]:
        """Which rows of which recordings frames in ascending order are."""
        owner = np.searchsorted(self._starts, indices, side="right") - 1
        return [
            (self._recordings[i], indices[owner == i] - self._starts[i]) for i in np.unique(owner)
        ]

    def weights(self) -> npt.NDArray[np.float64]:
        """How often to draw from each episode, (n,), in sum 1.

        Each frame to be learned from as often as another, but for those of rounds: what happened
        to the policy itself is a small part of all frames, and half of what is drawn.
        """
        begins, lengths = self.episodes()
        weights = np.where(np.isin(begins, self.training), lengths, 0) / 1.0
        demonstrated = begins < len(self._recordings[0].columns[EPISODE])
        if not demonstrated.all():
            weights[demonstrated] *= (1.0 - ROUNDS_SHARE) / weights[demonstrated].sum()
            weights[~demonstrated] *= ROUNDS_SHARE / weights[~demonstrated].sum()
        return weights / weights.sum()
