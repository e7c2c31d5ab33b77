"""``hvs leaderboard``: build the board from result files."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Leaderboard:
    """Build LEADERBOARD.md and leaderboard.html from result files; a bad result stops the build.

    Attributes:
        results: Folder that holds <policy>/<task>.json.
        out: Folder to write the board to.
    """

    results: Path = Path("eval/results")
    out: Path = Path("eval")

    def run(self) -> int:
        """Build the board and print where it is."""
        from hvs_suite.eval import leaderboard

        for path in leaderboard.build(self.results, self.out):
            print(f"Written to {path}")
        return 0
