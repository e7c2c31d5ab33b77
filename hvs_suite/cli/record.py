"""``hvs record``: demonstrations of the expert as a LeRobot dataset."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """Record demonstrations of the expert as a LeRobot dataset.

    Plays scenarios 0 to N-1 of the split; failures are kept and marked.

    Attributes:
        task: A named task, such as align-easy.
        episodes: Number of episodes to record.
        out: Root folder of the dataset; must not exist or be empty, unless --resume is given.
        split: Name of the split the scenarios come from.
        resume: Go on with a recording that was interrupted.
        workers: Processes that play episodes.
    """

    task: str
    episodes: int
    out: Path
    split: str = "train"
    resume: bool = False
    workers: int = 1

    def run(self) -> None:
        """Record, and say what was recorded."""
