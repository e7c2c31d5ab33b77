"""Table and picture of a robustness study."""

import math
import textwrap
from collections.abc import Sequence
from typing import Any

from hvs_suite.eval.scoring.robustness_file import Played, Robustness
from hvs_suite.tasks.shared.robustness import STRENGTHS

COLOURS = ("#2b6cb0", "#e9620a", "#2f855a", "#7a3fa0", "#b7791f", "#4a5568")
"""Of the policies, in the order in which they are given."""
COLUMNS = ("axis", *STRENGTHS, "strengths")
_PANELS_A_ROW = 5
_TICK_CHARACTERS = 10
_SPREAD = 0.08
"""By how much the points of several policies are set apart, in strengths."""


def rows(study: Robustness) -> list[tuple[str, ...]]:
    """The table: an axis a row, success with its interval for each strength.

    A star marks what differs from the undisturbed scenes: McNemar's exact test with Holm's
    correction, at 5 % for all cells together.
    """
    significant = study.significant()
    table: list[tuple[str, ...]] = [("undisturbed", _rate(study.undisturbed), "", "", "")]
    for cells in study.axes().values():
        rates = {
            cell.strength: _rate(cell) + ("*" if (cell.axis, cell.strength) in significant else "")
            for cell in cells
        }
        levels = "; ".join(cell.level for cell in cells)
        table.append((cells[0].title, *(rates.get(strength, "") for strength in STRENGTHS), levels))
    table += [(name, *len(STRENGTHS) * ("-",), why) for name, why in study.missing.items()]
    return table


def title(study: Robustness) -> str:
    """What the table shows, in one line."""
    return (
        f"{study.policy} on {study.task}, {study.episodes} scenes of split {study.split}: success "
        "(95 % interval), * if not that of the undisturbed"
    )


def markdown(study: Robustness) -> str:
    """The table in Markdown."""
    head = [title(study).replace("*", r"\*"), ""]
    table = [COLUMNS, len(COLUMNS) * ("---",), *rows(study)]
    lines = ("| " + " | ".join(cells).replace("*", r"\*") + " |" for cells in table)
    return "\n".join([*head, *lines]) + "\n"


def draw(studies: Sequence[Robustness]) -> Any:
    """Success against strength: a panel an axis, a line a policy.

    Args:
        studies: Of one task, one or more; the first one's axes are drawn.

    Returns:
        A ``matplotlib.figure.Figure``.
    """
    from matplotlib.figure import Figure

    axes = studies[0].axes()
    n_rows = max(1, math.ceil(len(axes) / _PANELS_A_ROW))
    figure = Figure(
        figsize=(2.45 * _PANELS_A_ROW, 2.15 * n_rows + 0.5),
        dpi=130,
        facecolor="white",
        layout="constrained",
    )
    grid = figure.subplots(n_rows, _PANELS_A_ROW, sharey=True, squeeze=False)
    panels = [panel for row in grid for panel in row]
    for panel in panels[len(axes) :]:
        panel.set_axis_off()
    for panel, (name, cells) in zip(panels, axes.items(), strict=False):
        for number, study in enumerate(studies):
            found = [study.undisturbed, *study.axes().get(name, [])]
            offset = _SPREAD * (number - 0.5 * (len(studies) - 1))
            _draw_line(panel, found, offset, COLOURS[number % len(COLOURS)], study.policy)
        panel.set_title(cells[0].title, fontsize=9, loc="left")
        ticks = ["as named", *(textwrap.fill(cell.level, _TICK_CHARACTERS) for cell in cells)]
        panel.set_xticks(range(len(ticks)), ticks, fontsize=6.5)
        panel.set_xlim(-0.3, len(STRENGTHS) + 0.3)
        panel.set_ylim(-3, 103)
        panel.grid(axis="y", color="#e2e8f0", linewidth=0.7)
        panel.tick_params(axis="y", labelsize=7)
        panel.spines[["top", "right"]].set_visible(False)
    for row in grid:
        row[0].set_ylabel("success (%)", fontsize=8)
    handles, labels = panels[0].get_legend_handles_labels()
    what = f"{studies[0].task}, {studies[0].episodes} scenes a point, 95 % intervals"
    figure.suptitle(what, fontsize=10, x=0.01, ha="left")
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), fontsize=8)
    return figure


def _draw_line(
    panel: Any, played: Sequence[Played], offset: float, colour: str, label: str
) -> None:
    rates = [each.pc_success for each in played]
    below = [each.pc_success - each.pc_success_ci95[0] for each in played]
    above = [each.pc_success_ci95[1] - each.pc_success for each in played]
    panel.errorbar(
        [offset + place for place in range(len(played))],
        rates,
        yerr=(below, above),
        color=colour,
        marker="o",
        markersize=3,
        linewidth=1.2,
        elinewidth=0.8,
        capsize=1.5,
        label=label,
    )


def _rate(played: Played) -> str:
    low, high = played.pc_success_ci95
    return f"{played.pc_success:.1f} % ({low:.1f} to {high:.1f})"
