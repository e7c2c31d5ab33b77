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
                *_row("success, percentage points", found.success),
                *(
                    row
                    for name, difference in found.settled.items()
                    for row in _row(f"{name} at the end", difference)
                ),
                *_row("steps to goal, where both succeed", found.steps_to_goal),
            ],
            title=f"A = {found.a}, B = {found.b}; differences are A minus B with 95 % intervals",
        )
        print(shown(found.conclusion()))
        return 0


def _row(name: str, difference: "Difference | None") -> list[tuple[str, str]]:
    if difference is None:
        return []
    d = difference
    return [(name, f"{d.estimate:+.3g} ({d.low:+.3g} to {d.high:+.3g})")]
