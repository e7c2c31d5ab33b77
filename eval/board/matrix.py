"""The board's pairwise comparison: which policy beats which on the same scenarios."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal

from hvs_suite import statistics
from hvs_suite.eval.board.tables import Entry
from hvs_suite.eval.scoring.comparison import SIGNIFICANT, Tally

CAPTION = (
    "Success of the row's policy minus the column's, in percentage points, on the scenarios that "
    "both played; p from McNemar's exact test, corrected by Holm's method for all pairs of the "
    f"task. Coloured where p is below {SIGNIFICANT:g}."
)


@dataclasses.dataclass(frozen=True)
class Pair:
    """One policy against another.

    Attributes:
        other: The policy that it is compared with.
        decided: Whether the first is ``better`` or ``worse``, or the scenarios cannot tell.
        points: Difference in success (percentage points), as people read it.
        p: The corrected p, as people read it.
        counts: How many each of them solves, in words.
    """

    other: str
    decided: Literal["better", "worse", "even"]
    points: str
    p: str
    counts: str


def matrix(entries: Sequence[Entry]) -> dict[str, list[Pair | None]]:
    """Returns the comparison of a task's entries, each with each; None with itself.

    Args:
        entries: Two or more.

    Returns:
        Each policy's row, its columns in the order of the rows.
    """
    outcomes = {e.policy: {r.scenario: r.success for r in e.result.episodes} for e in entries}
    pairs = {
        (a, b): Tally.of(outcomes[a], outcomes[b]) for a, b in itertools.combinations(outcomes, 2)
    }
    corrected = statistics.holm([tally.p for tally in pairs.values()])
    cells: dict[tuple[str, str], Pair] = {}
    for ((a, b), tally), p in zip(pairs.items(), corrected, strict=True):
        cells[a, b] = _pair(a, b, tally, p)
        turned = dataclasses.replace(tally, n_only_a=tally.n_only_b, n_only_b=tally.n_only_a)
        cells[b, a] = _pair(b, a, turned, p)
    return {a: [cells.get((a, b)) for b in outcomes] for a in outcomes}


def _pair(a: str, b: str, tally: Tally, p: float) -> Pair:
    points = 100 * (tally.n_only_a - tally.n_only_b) / tally.n
    return Pair(
        other=b,
        decided="even" if p >= SIGNIFICANT else "better" if points > 0 else "worse",
        points=f"{points:+.1f}".replace("-", "\N{MINUS SIGN}") if points else "0",
        p="p < 0.001" if p < 0.001 else f"p = {p:.3f}" if p < 0.1 else f"p = {p:.2f}",
        counts=(
            f"{a} alone solves {tally.n_only_a}, {b} alone {tally.n_only_b}, both {tally.n_both}, "
            f"neither {tally.n_neither} of {tally.n}"
        ),
    )
