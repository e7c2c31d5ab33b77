"""``hvs pretrain``: the ``hvs`` policy, trained on a dataset by behaviour cloning."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Train the hvs policy on demonstrations by behaviour cloning.

    The task comes from the dataset. Trains for --minutes or --steps, whichever is given.

    Attributes:
        data: Root folder of the dataset, as hvs record makes it.
        out: Folder for the checkpoint; loads with from_pretrained.
        minutes: Stop after this long (min).
        steps: Stop after this many optimiser steps.
    """

    data: Path
    out: Path
    minutes: float | None = None
    steps: int | None = None

    def run(self) -> None:
        """Train, and say where the checkpoint is."""
