"""Replay memory: transitions as rows of arrays, which a checkpoint keeps."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Rows = Mapping[str, npt.NDArray[np.float32]]


class Replay:
    """The last transitions, of whatever numbers.

    Args:
        capacity: How many.
        widths: Name to numbers a row.
    """

    def __init__(self, capacity: int, widths: Mapping[str, int]) -> None:
        self._arrays = {n: np.zeros((capacity, width), np.float32) for n, width in widths.items()}
        self._capacity = capacity
        self._stored = 0

    def __len__(self) -> int:
        return min(self._stored, self._capacity)

    def add(self, rows: Rows) -> None:
        """Keep some transitions, each array (n, width), and forget the oldest.

        Args:
            rows: As many of each name.
        """
        n = len(next(iter(rows.values())))
        at = (self._stored + np.arange(n)) % self._capacity
        for name, array in self._arrays.items():
            array[at] = rows[name]
        self._stored += n

    def sample(self, n: int, random: np.random.Generator) -> dict[str, Tensor]:
        """Draw transitions, each as likely, with replacement.

        Args:
            n: How many.
            random: Draws them.

        Returns:
            Name to (n, width).
        """
        at = random.integers(0, len(self), n)
        return {name: torch.from_numpy(array[at]) for name, array in self._arrays.items()}

    def state(self) -> dict[str, Tensor]:
        """All that it holds, for a checkpoint."""
        kept = {name: torch.from_numpy(array[: len(self)]) for name, array in self._arrays.items()}
        return {**kept, "stored": torch.tensor(self._stored)}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Hold what `state` returned."""
        self._stored = int(state["stored"])
        for name, array in self._arrays.items():
            array[: len(self)] = state[name].numpy()
