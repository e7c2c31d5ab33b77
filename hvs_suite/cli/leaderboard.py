"""``hvs leaderboard``: build the board from result files."""

import dataclasses
import sys
from pathlib import Path

from hvs_suite.names import shown


@dataclasses.dataclass(frozen=True, kw_only=True)
class Leaderboard:
    """Build LEADERBOARD.md and leaderboard.html from result files; a bad result stops the build.

    Attributes:
        results: Folder that holds <policy>/<task>.json and the action logs.
        out: Folder to write the board to; keeps the clips too.
        replay: Scenarios of each new result to play again before it is shown; 1000 plays all.
        reruns: Folder of the maintainers' own results on an unseen split, laid out likewise.
        ledger: File that remembers what was played; in the user's cache by default.
        draft: Also show results that are not scores yet, such as those with fewer scenarios; the
            board marks them.
    """

    results: Path = Path("eval/results")
    out: Path = Path("eval")
    replay: int = 20
    reruns: Path | None = None
    ledger: Path | None = None
    draft: bool = False

    def run(self) -> int:
        """Build the board and print where it is."""
        from hvs_suite.eval import leaderboard

        for path in leaderboard.build(
            self.results,
            self.out,
            replay=self.replay,
            reruns=self.reruns,
            ledger=self.ledger,
            draft=self.draft,
            say=_say,
        ):
            print(f"Written to {path}")
        return 0


def _say(line: str) -> None:
    print(shown(line), file=sys.stderr)
