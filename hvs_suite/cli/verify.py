"""``hvs verify``: play a result's logged actions again and recompute its numbers."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import tyro

from hvs_suite.cli import console
from hvs_suite.cli.players import Players
from hvs_suite.errors import ResultError, UnknownTaskError
from hvs_suite.names import shown

BROKEN = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verify(Players):
    """Play the logged actions of results again, without pictures, and recompute every number.

    Exits with 1 and the reason if a file differs from what is played.

    Attributes:
        files: Result files, or folders of them.
        sample: Scenarios of each file to play again, drawn with a new nonce; all by default.
        nonce: Nonce that an earlier run printed, to draw the same sample again.
        submission: Also check the files against the rules of the board (eval/SUBMITTING.md).
        results: With --submission, the folder that holds <policy>/<task>.json.
        json: Print what was found as JSON.
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")]
    sample: int | None = None
    nonce: str | None = None
    submission: bool = False
    results: Path = Path("eval/results")
    json: bool = False

    def run(self) -> int:
        """Verify the files one after the other; stop at the first that fails."""
        from hvs_suite.eval.board import submission
        from hvs_suite.eval.scoring import result_file, verification

        paths = verification.results_in(self.files)
        found = []
        try:
            if self.submission:
                submission.check(self.results, paths)
            for path in paths:
                n = result_file.load(path).summary.n_episodes
                n = n if self.sample is None else min(n, self.sample)
                with console.progress(f"verify {path}", n) as advance:
                    verdict = verification.verify(
                        path,
                        sample=self.sample,
                        nonce=self.nonce,
                        workers=self.players(),
                        progress=advance,
                    )
                found.append(verification.as_json(path, verdict))
                if not self.json:
                    drawn = "" if verdict.nonce is None else f" (nonce {verdict.nonce})"
                    print(
                        f"{shown(str(path))}: as it says; {verdict.n_played} of "
                        f"{verdict.n_episodes} scenarios played again{drawn}, {verdict.n_near} "
                        f"decided by rounding{_otherwise(verdict.n_other)}, largest difference "
                        f"{_largest(verdict.largest)}"
                    )
        except (ResultError, UnknownTaskError) as error:
            from hvs_suite.cli.main import complain

            complain(str(error))
            return BROKEN
        if self.json:
            console.print_json(found)
        return 0


def _otherwise(n_other: int) -> str:
    """In how many scenarios a policy that played again went another way, if in any."""
    if not n_other:
        return ""
    return f", {n_other} played otherwise by the policy on this processor"


def _largest(largest: Mapping[str, float]) -> str:
    """Largest differences by unit, such as ``0.0e+00 mm, 0.0e+00 deg``."""
    return ", ".join(f"{value:.1e} {unit}" for unit, value in largest.items())
