"""``hvs attach``: restores the origin of a dataset that LeRobot's tools edited."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from hvs_suite.cli import console


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attach:
    """Restore hvs.json in a dataset that lerobot-edit-dataset split, merged or trimmed.

    Plays every episode again, without pictures, and writes hvs.json only if all of them agree with
    the origins. Then hvs check, pretrain, replay and share accept the dataset.

    Attributes:
        data: Root folder of the edited dataset.
        origin: Root folder of the dataset that it was made of; give it several times for several.
        workers: Processes that share the episodes.
    """

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    origin: tuple[Path, ...]
    workers: int = 1

    def run(self) -> None:
        """Prove it and write it down."""
        from hvs_suite.datasets.attachment import attach
        from hvs_suite.errors import OptionError

        if not self.origin:
            raise OptionError("name what the dataset was made of: --origin DIR")
        with console.meter() as update:
            metadata = attach(
                self.data,
                self.origin,
                workers=self.workers,
                progress=lambda done, total: update(
                    "checking", done / total, f"{done}/{total} episodes"
                ),
            )
        print(f"{self.data}: {metadata.task}, split {metadata.split}")
