"""``hvs leaderboard``: build the board from result files."""

import dataclasses
import sys
from pathlib import Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Leaderboard:
    """Build LEADERBOARD.md and leaderboard.html from result files; a bad result stops the build.

    Attributes:
        results: Folder that holds <policy>/<task>.json and the action logs.
        out: Folder to write the board to; keeps the clips and verified.json too.
        replay: Scenarios of each new result to play again before it is shown; 1000 plays all.
    """

    results: Path = Path("eval/results")
    out: Path = Path("eval")
    replay: int = 20

    def run(self) -> int:
        """Build the board and print where it is."""
        from hvs_suite.eval import leaderboard

        for path in leaderboard.build(self.results, self.out, replay=self.replay, say=_say):
            print(f"Written to {path}")
        return 0


def _say(line: str) -> None:
    print(line, file=sys.stderr)
