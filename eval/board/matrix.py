"""The board's pairwise comparison: which policy beats which on the same scenarios."""

import itertools
from collections.abc import Mapping, Sequence

from hvs_suite import statistics
from hvs_suite.eval.board.tables import DASH, Entry, escaped
from hvs_suite.eval.scoring.comparison import SIGNIFICANT, Tally

CAPTION = (
    "Success of the row's policy minus the column's, in percentage points, on the scenarios that "
    "both played; p from McNemar's exact test, corrected by Holm's method for all pairs of the "
    f"task. Coloured where p is below {SIGNIFICANT:g}."
)


def matrix(entries: Sequence[Entry]) -> str:
    """Returns the comparison of a task's entries, each with each, as an HTML table."""
    outcomes = {e.policy: {r.scenario: r.success for r in e.result.episodes} for e in entries}
    tallies = {
        (a, b): Tally.of(outcomes[a], outcomes[b]) for a, b in itertools.combinations(outcomes, 2)
    }
    corrected = statistics.holm([tally.p for tally in tallies.values()])
    p_values = dict(zip(tallies, corrected, strict=True))
    head = "".join(
        f'<th scope="col" data-policy="{escaped(name)}">{escaped(name)}</th>' for name in outcomes
    )
    rows = []
    for a in outcomes:
        cells = "".join(_cell(a, b, tallies, p_values) for b in outcomes)
        name = escaped(a)
        rows.append(f'<tr data-policy="{name}"><th scope="row">{name}</th>{cells}</tr>')
    return (
        '<div class="sheet"><table class="matrix pairs"><thead><tr><td></td>'
        f"{head}</tr></thead>\n<tbody>{chr(10).join(rows)}</tbody></table></div>"
    )


def _cell(
    a: str,
    b: str,
    tallies: Mapping[tuple[str, str], Tally],
    p_values: Mapping[tuple[str, str], float],
) -> str:
    column = f'data-policy="{escaped(b)}"'
    if a == b:
        return f'<td class="self" {column}>{DASH}</td>'
    if (a, b) in tallies:
        tally, p = tallies[a, b], p_values[a, b]
        only_a, only_b = tally.n_only_a, tally.n_only_b
    else:
        tally, p = tallies[b, a], p_values[b, a]
        only_a, only_b = tally.n_only_b, tally.n_only_a
    points = 100 * (only_a - only_b) / tally.n
    decided = "even" if p >= SIGNIFICANT else "better" if points > 0 else "worse"
    told = escaped(
        f"{a} alone solves {only_a}, {b} alone {only_b}, both {tally.n_both}, neither "
        f"{tally.n_neither} of {tally.n}"
    )
    return (
        f'<td class="{decided}" {column} title="{told}">{_signed(points)}'
        f"<small>{_p_text(p)}</small></td>"
    )


def _signed(points: float) -> str:
    return f"{points:+.1f}".replace("-", "\N{MINUS SIGN}") if points else "0"


def _p_text(p: float) -> str:
    if p < 0.001:
        return "p &lt; 0.001"
    return f"p = {p:.3f}" if p < 0.1 else f"p = {p:.2f}"
