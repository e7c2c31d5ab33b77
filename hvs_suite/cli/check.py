"""``hvs check``: is a dataset whole, and does re-simulation reproduce it?"""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from hvs_suite.cli import console
from hvs_suite.cli.players import Players

DAMAGED = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check(Players):
    """Check a dataset: decode every frame, compare the numbers, and play every episode again.

    Prints one line for each damaged place: file, episode, frame and what is wrong. Exits with 1 if
    there is any.

    Attributes:
        data: Root folder of the dataset.
        skip_pictures: Do not draw frames again to compare them; they are still decoded.
        json: Print what was found as JSON.
    """

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    skip_pictures: bool = False
    json: bool = False

    def run(self) -> int:
        """Check, and print what was found."""
        from hvs_suite.datasets.check import check_dataset

        with console.meter() as update:
            report = check_dataset(
                self.data,
                workers=self.players(),
                pictures=not self.skip_pictures,
                progress=lambda done, total: update(
                    "checking", done / total, f"{done}/{total} episodes"
                ),
            )
        if self.json:
            console.print_json(
                {
                    "dataset": str(self.data),
                    "episodes": report.episodes,
                    "frames": report.frames,
                    "damage": [dataclasses.asdict(each) for each in report.damage],
                }
            )
        else:
            for each in report.damage:
                print(each)
            count = len(report.damage)
            places = "1 damaged place" if count == 1 else f"{count} damaged places"
            found = places if count else "no damage"
            print(f"{self.data}: {report.episodes} episodes, {report.frames} frames, {found}")
        return DAMAGED if report.damage else 0
