"""``hvs compare``: two results, paired on the same scenarios."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from hvs_suite.cli import console
from hvs_suite.names import shown

if TYPE_CHECKING:
    from hvs_suite.statistics import Difference


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compare:
    """Compare two results on the scenarios that both played, and say whether one is better.

    Attributes:
        first: Result file of policy A.
        second: Result file of policy B.
        json: Print the figures as JSON.
    """

    first: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="A")]
    second: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="B")]
    json: bool = False

    def run(self) -> int:
        """Compare, print a table and one sentence."""
        from hvs_suite.eval.scoring import comparison

        found = comparison.compare(self.first, self.second)
        if self.json:
            console.print_json(dataclasses.asdict(found) | {"conclusion": found.conclusion()})
            return 0
        console.print_table(
            (f"{found.task}, {found.n} scenarios", "value"),
            [
                ("solved by both", str(found.n_both)),
                (f"by {found.a} alone", str(found.n_only_a)),
                (f"by {found.b} alone", str(found.n_only_b)),
                ("by neither", str(found.n_neither)),
                ("p, exact McNemar", f"{found.p:.2g}"),
                ("success, percentage points", _interval(found.success)),
                *(
                    (f"{name} at the end", _tested(difference))
                    for name, difference in found.settled.items()
                ),
                *(
                    [("steps to goal, where both succeed", _tested(found.steps_to_goal))]
                    if found.steps_to_goal
                    else []
                ),
            ],
            title=f"A = {found.a}, B = {found.b}; differences are A minus B with 95 % "
            "intervals and p of Wilcoxon's signed-rank test",
        )
        print(shown(found.conclusion()))
        return 0


def _interval(difference: "Difference") -> str:
    return f"{difference.estimate:+.3g} ({difference.low:+.3g} to {difference.high:+.3g})"


def _tested(difference: "Difference") -> str:
    return f"{_interval(difference)}, p = {difference.p:.2g}"
