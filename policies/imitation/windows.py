"""Windows of recorded episodes, and what the eyes have made of every frame of them."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from hvs_suite.datasets.features import ACTION, IMAGES, STATE
from hvs_suite.files import replacing
from hvs_suite.policies.belief.eye import (
    LOG_DIAMETER,
    LOG_SIGMA_SIZE,
    LOG_SIGMA_SLOPE,
    LOG_SIGMA_UV,
    SLOPE,
    UV,
)
from hvs_suite.policies.belief.lessons import Window, facing, remembered
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork
from hvs_suite.policies.belief.recorded import Recorded, recorded
from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.slopes import Meter, learn_slopes

JITTER = 0.35
"""Eyes err more on pictures that they did not learn from: by so many of their own standard
deviations, as much in a whole window alike as from frame to frame."""
MEMORY = "memory"
"""Key of what was remembered before each frame, in the file that `WindowPool.keep` writes."""
BATCH = 256
EPISODES_AT_ONCE = 256

Rows = npt.NDArray[np.int64]


class WindowPool:
    """Draws windows from demonstrations.

    Args:
        demonstrations: The frames.
        goal_key: Column that says which target is meant; None without.
        wrench_key: Column of the wrench; None without.
    """

    def __init__(
        self, demonstrations: Demonstrations, goal_key: str | None, wrench_key: str | None
    ) -> None:
        self._demonstrations = demonstrations
        self._goal_key, self._wrench_key = goal_key, wrench_key
        self._sightings: dict[str, Tensor] = {}
        self._memory: Tensor | None = None
        self._columns: dict[str, Tensor] = {}

    @property
    def n_looked_at(self) -> int:
        """Frames that the eyes have looked at."""
        return 0 if self._memory is None else len(self._memory)

    def look(self, network: BeliefNetwork, meter: Meter | None = None) -> None:
        """Have the eyes look at every frame, and the belief go through every episode.

        Those that tell slopes learn from all frames then.

        Args:
            network: In evaluation mode.
            meter: Reports how far the learning is.
        """
        seen: dict[str, list[Tensor]] = {name: [] for name in network.shape.cameras}
        with torch.no_grad():
            for first in range(0, len(self._demonstrations), BATCH):
                rows = np.arange(first, min(first + BATCH, len(self._demonstrations)))
                batch = self._demonstrations.batch(rows)
                for name, sighting in network.look(*self.pictures(network, batch)).items():
                    seen[name].append(sighting.cpu())
        self._sightings = {name: torch.cat(parts) for name, parts in seen.items()}
        self._memory = None
        self._open(network)
        learn_slopes(
            network,
            lambda camera, rows: self._demonstrations.pictures(IMAGES + camera, rows),
            self._sightings,
            facing(network, self._columns[STATE][:, :N_JOINTS], self._truth),
            {name: target[:, 3] > 0.0 for name, target in self._truth.targets.items()},
            torch.from_numpy(self._demonstrations.training),
            meter,
        )
        self.recall(network)

    def pictures(
        self, network: BeliefNetwork, batch: Mapping[str, Tensor]
    ) -> tuple[dict[str, Tensor], Tensor | None]:
        """What the eyes are given of a batch, where they are: images, and which target is meant."""
        device = network.eyes_device
        images = {
            name: batch[f"observation.images.{name}"].to(device) for name in network.shape.cameras
        }
        return images, None if self._goal_key is None else batch[self._goal_key].to(device)

    def _open(self, network: BeliefNetwork) -> None:
        """Take the columns of all frames into memory."""
        columns = self._demonstrations.columns()
        self._truth: Recorded = recorded(
            columns, tuple(network.shape.cameras), network.cell.period_s
        )
        keys = [STATE, ACTION] + ([self._wrench_key] if self._wrench_key else [])
        self._columns = {key: torch.from_numpy(columns[key]) for key in keys}
        self._begins, self._lengths = self._demonstrations.episodes()

    def recall(self, network: BeliefNetwork) -> None:
        """Have the belief go through every episode again, from what the eyes saw last.

        Args:
            network: In evaluation mode.
        """
        order = np.argsort(self._lengths, kind="stable")
        memory = None
        with torch.no_grad():
            for first in range(0, len(order), EPISODES_AT_ONCE):
                some = order[first : first + EPISODES_AT_ONCE]
                length = int(self._lengths[some].max())
                window = self._window(some, np.zeros(len(some), np.int64), length, network)
                after = remembered(network, window)
                before = torch.cat([window.memory[:, None], after[:, :-1]], dim=1)
                if memory is None:
                    memory = before.new_zeros(len(self._columns[STATE]), before.shape[2])
                rows = self._rows(some, np.zeros(len(some), np.int64), length)
                memory[rows[window.counts]] = before[window.counts]
        self._memory = memory

    def draw(
        self,
        network: BeliefNetwork,
        weights: npt.NDArray[np.float64],
        n: int,
        length: int,
        random: np.random.Generator,
        *,
        anew: bool = False,
    ) -> Window:
        """Draw windows; those of short episodes begin with them.

        Args:
            network: What is to learn from them.
            weights: How often each episode is drawn, (number of episodes,), in sum 1.
            n: How many.
            length: Of each, in control steps.
            random: Draws them, and the jitter.
            anew: Have the eyes look at them now, without jitter, so that what is learned from them
                reaches the eyes.
        """
        if anew and (not self._columns or len(self._columns[STATE]) != len(self._demonstrations)):
            self._sightings, self._memory = {}, None
            self._open(network)
        episodes = random.choice(len(weights), n, p=weights)
        # From a quarter of a window before the beginning, so that it is met often.
        room = self._lengths[episodes] - length // 2
        begins = random.uniform(-0.25 * length, np.maximum(room, 1)).astype(np.int64)
        begins = np.maximum(begins, 0)
        window = self._window(episodes, begins, length, network)
        if anew:
            rows = self._rows(episodes, begins, length)[window.counts]
            batch = self._demonstrations.batch(rows.numpy())
            sightings = {}
            for name, sighting in network.look(*self.pictures(network, batch)).items():
                sightings[name] = torch.zeros(n, length, sighting.shape[1])
                sightings[name][window.counts] = sighting.cpu()
            return dataclasses.replace(window, sightings=sightings)
        generator = torch.Generator().manual_seed(int(random.integers(2**32)))
        for sighting in window.sightings.values():
            alike, each = (torch.randn(n, k, 5, generator=generator) * JITTER for k in (1, length))
            off = alike + each
            sighting[..., UV] += off[..., :2] * sighting[..., LOG_SIGMA_UV].clamp(max=0.0).exp()
            sighting[..., LOG_DIAMETER] += (
                off[..., 2:3] * sighting[..., LOG_SIGMA_SIZE].clamp(max=0.0).exp()
            )
            sighting[..., SLOPE] += (
                off[..., 3:] * sighting[..., LOG_SIGMA_SLOPE].clamp(max=0.0).exp()
            )
        return window

    def _rows(self, episodes: Rows, begins: Rows, length: int) -> Tensor:
        """Frames of windows, (n, length); the last one again after the end of an episode."""
        rows = (self._begins[episodes] + begins)[:, None] + np.arange(length)
        last = (self._begins + self._lengths - 1)[episodes]
        return torch.from_numpy(np.minimum(rows, last[:, None]))

    def _window(self, episodes: Rows, begins: Rows, length: int, network: BeliefNetwork) -> Window:
        rows = self._rows(episodes, begins, length)
        counts = torch.from_numpy(
            begins[:, None] + np.arange(length) < self._lengths[episodes][:, None]
        )
        memory = network.start(len(episodes))
        if self._memory is not None:
            kept = self._memory[rows[:, 0]]
            memory = torch.where(torch.from_numpy(begins == 0)[:, None], memory, kept)
        return Window(
            memory=memory,
            sightings={name: sighting[rows] for name, sighting in self._sightings.items()},
            state=self._columns[STATE][rows],
            action=self._columns[ACTION][rows],
            truth=self._truth.at(rows),
            felt=None if self._wrench_key is None else self._columns[self._wrench_key][rows],
            counts=counts,
        )

    def keep(self, path: Path, share: float) -> None:
        """Write what the eyes saw and what was made of it, for a killed run to go on with.

        Args:
            path: File to replace.
            share: Part of the training that is done.
        """
        assert self._memory is not None
        content = {**self._sightings, MEMORY: self._memory}
        with replacing(path) as temporary:
            temporary.write_bytes(save(content, {"share": repr(share)}))

    def reopen(self, path: Path, network: BeliefNetwork) -> float | None:
        """Read what `keep` wrote of these very frames.

        Args:
            path: The file.
            network: What the frames are for.

        Returns:
            When it was written, as a part of the training; None if it is not there, or of others.
        """
        if not path.exists():
            return None
        try:
            with safe_open(path, framework="pt") as file:
                seen = {name: file.get_tensor(name) for name in network.shape.cameras}
                memory = file.get_tensor(MEMORY)
                share = float(file.metadata()["share"])
        except (SafetensorError, OSError, LookupError, TypeError, ValueError):
            return None
        if any(len(sighting) != len(self._demonstrations) for sighting in seen.values()):
            return None
        self._sightings, self._memory = seen, memory
        self._open(network)
        return share
