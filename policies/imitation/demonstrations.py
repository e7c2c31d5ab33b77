"""Demonstrations as training draws from them: columns in memory, frames in a cache."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hvs_suite.errors import DatasetError
from hvs_suite.policies.imitation.frame_cache import Frames, OnFrames, cached_frames, read_rows
from hvs_suite.policies.imitation.remembered import remembered
from hvs_suite.policies.network.dataset import (
    EPISODE,
    GOAL_NORMAL,
    GOAL_POSITION,
    Column,
    Manifest,
    calibrate_on,
    read_columns,
)
from hvs_suite.policies.network.geometry import Calibration
from hvs_suite.policies.network.network import IMAGE_PREFIX, MEMORY, STATE

# Held out from training to measure the loss on; whole episodes, so that no neighbour frame leaks.
HELD_OUT_SHARE = 0.05
# Philox words that keep this stream apart from the training order.
HELD_OUT_STREAM = 1
MEMORY_STREAM = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """Frames and their labels.

    Attributes:
        columns: Key to (n, k) float32; ``episode_index`` to (n,) int64.
        images: Key to (n, H, W, C) uint8, usually memory-mapped.
    """

    columns: Mapping[str, Column]
    images: Mapping[str, Frames]


class FramePool:
    """Recordings to draw batches from.

    Args:
        manifest: What they were recorded on.
        seed: Of the errors in what a policy would remember.
        calibration: Of the network that learns; None if it has no joints, and remembers nothing.

    Attributes:
        manifest: As given.
    """

    def __init__(self, manifest: Manifest, seed: int, calibration: Calibration | None) -> None:
        self.manifest = manifest
        self._seed = seed
        self._calibration = calibration
        self._recordings: list[Recording] = []
        self._starts: npt.NDArray[np.int64] = np.zeros(0, np.int64)
        self._length = 0

    def __len__(self) -> int:
        """Frames."""
        return self._length

    def add(self, recording: Recording) -> None:
        """Take in more frames.

        Args:
            recording: The frames, with the same keys.
        """
        self._recordings.append(self._with_memory(recording, len(self._recordings)))
        self._starts = np.append(self._starts, self._length)
        self._length += len(recording.columns[EPISODE])

    def _with_memory(self, recording: Recording, number: int) -> Recording:
        """Add what a policy would remember at each frame, where the columns tell."""
        if self._calibration is None:
            return recording
        key = np.random.Philox(key=[self._seed, MEMORY_STREAM], counter=number)
        memory = remembered(
            recording.columns,
            list(self.manifest.cameras),
            self._calibration,
            np.random.Generator(key),
        )
        return Recording({**recording.columns, MEMORY: memory}, recording.images)

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

    def batch(self, indices: npt.NDArray[np.int64], *, pictures: bool = True) -> dict[str, Tensor]:
        """Frames as LeRobot's loader would give them, but for images left as bytes.

        Args:
            indices: Of the frames, (B,).
            pictures: Whether images are wanted; the numbers alone cost next to nothing.

        Returns:
            Images (B, C, H, W) uint8, and float32 the recordings' columns and ``memory``.
        """
        # Neighbours on disk together: the same rows, fewer page faults.
        indices = np.sort(indices)
        owner = np.searchsorted(self._starts, indices, side="right") - 1
        parts = [
            (self._recordings[i], indices[owner == i] - self._starts[i]) for i in np.unique(owner)
        ]
        first = self._recordings[0]
        batch = {
            key: torch.from_numpy(np.concatenate([r.columns[key][rows] for r, rows in parts]))
            for key in first.columns
            if key != EPISODE
        }
        for key, frames in first.images.items() if pictures else ():
            images = torch.empty((len(indices), *frames.shape[1:]), dtype=torch.uint8)
            begin = 0
            for recording, rows in parts:
                end = begin + len(rows)
                read_rows(recording.images[key], rows, images[begin:end].numpy())
                begin = end
            # (B, H, W, C) stays the layout in memory, which is what the convolutions want.
            batch[key] = images.permute(0, 3, 1, 2)
        return batch


class Demonstrations(FramePool):
    """Frames and labels of one dataset, and of what was added to it.

    Args:
        manifest: Of the dataset.
        cache: Folder for decoded frames.
        seed: Chooses the held-out episodes.
        episodes: Learn from this many episodes, the first ones; None for all.
        with_memory: Work out what an `HvsNetwork` would remember at each frame.
        on_frames: Called with the number of frames just decoded, over all cameras.

    Attributes:
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
        with_memory: bool = True,
        on_frames: OnFrames | None = None,
    ) -> None:
        columns = read_columns(manifest)
        calibration = None
        if with_memory and {STATE, GOAL_POSITION, GOAL_NORMAL} <= set(columns):
            calibration = calibrate_on(manifest, columns, episodes)
        super().__init__(manifest, seed, calibration)
        images: dict[str, Frames] = {}
        for name, shape in manifest.cameras.items():
            key = IMAGE_PREFIX + name
            if manifest.features[key]["dtype"] != "image":
                raise DatasetError(
                    f"{manifest.root}: {key} is video; train on the lossless recording instead"
                )
            images[key] = cached_frames(
                manifest.root, key, shape, manifest.n_frames, cache, on_frames
            )
        super().add(Recording(columns, images))
        owner = columns[EPISODE]
        names = np.unique(owner)[:episodes]
        stream = np.random.Generator(np.random.Philox(key=[seed, HELD_OUT_STREAM]))
        n_held_out = max(1, round(HELD_OUT_SHARE * len(names))) if len(names) > 1 else 0
        shuffled = stream.permutation(names)
        self.training = np.flatnonzero(np.isin(owner, shuffled[n_held_out:]))
        self.held_out = np.flatnonzero(np.isin(owner, shuffled[:n_held_out]))

    @property
    def episodes_to_learn_from(self) -> npt.NDArray[np.bool_]:
        """Of all episodes, those whose frames are to be learned from, (n,)."""
        begins, _ = self.episodes()
        return np.isin(begins, self.training)

    def add(self, recording: Recording) -> None:
        """Learn from more frames, all of them.

        Args:
            recording: The frames, with the same keys.
        """
        start = len(self)
        super().add(recording)
        self.training = np.concatenate([self.training, np.arange(start, len(self))])
