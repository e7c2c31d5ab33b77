"""``hvs replay``: an episode of a dataset as a film."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True, kw_only=True)
class Replay:
    """Film an episode of a dataset: cameras beside the cell, error curves below.

    Camera pictures and errors are those of the dataset; the cell's view is re-simulated.

    Attributes:
        data: Root folder of the dataset.
        episode: Index of the episode.
        out: Film to write (.gif or .mp4).
    """

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    episode: int
    out: Path

    def run(self) -> None:
        """Draw the film."""
        from hvs_suite import pictures
        from hvs_suite.datasets.replay import replay
        from hvs_suite.files import check_writable

        pictures.check_film_suffix(self.out)
        check_writable(self.out)
        film = replay(self.data, self.episode)
        pictures.write_film(self.out, film.frames, film.fps)
        how = "success" if film.success else "not solved"
        print(
            f"episode {self.episode}, scenario {film.scenario}: {how}; "
            f"wrote {self.out} ({len(film.frames)} frames)"
        )
