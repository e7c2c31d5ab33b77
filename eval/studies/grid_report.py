"""Table, words and picture of a study that a grid of cells makes."""

import itertools
from collections.abc import Sequence
from typing import Any

from hvs_suite.eval.scoring.comparison import SIGNIFICANT
from hvs_suite.eval.studies.grid import Row, Study
from hvs_suite.eval.studies.training import SPLIT
from hvs_suite.statistics import mean_rate_interval

REFERENCE, OTHER = "#16803c", "#2b6cb0"


def markdown(study: Study) -> str:
    """Tables and words of what is finished."""
    lines = [study.question]
    for group in study.groups():
        rows = study.rows(group)
        n = len(rows[0].judged[0].solved)
        lines += [
            "",
            f"## {group}",
            "",
            f"{n} scenes of split `{SPLIT}` a seed. Intervals are of 95 %, made of Wilson's; p is "
            "of McNemar's exact test on the same scenes and seeds, after Holm's correction.",
            "",
            *table(rows),
            "",
            *_words(rows),
        ]
    lines += [
        "",
        "The commands that make each policy again are in study.json, and in cells/. Give them with "
        "`OMP_NUM_THREADS=1`: cells are made on one thread, and some processors round otherwise "
        "with two.",
    ]
    return "\n".join(lines) + "\n"


def table(rows: Sequence[Row]) -> list[str]:
    """A table of a group in Markdown, line by line.

    A column that would say the same in every row is left out.

    Args:
        rows: As `Study.rows` gives them.
    """
    columns = {
        "setting": [row.name for row in rows],
        "played": [row.scenes for row in rows],
        "solved": [f"{row.rate:.1f} %" for row in rows],
        "95 % interval": [f"{row.interval[0]:.1f} to {row.interval[1]:.1f} %" for row in rows],
        "each seed": [", ".join(f"{rate:.4g}" for rate in row.rates) for row in rows],
        "collisions": [str(sum(each.n_collision for each in row.judged)) for row in rows],
        "steps": [_mean([each.steps_to_goal for each in row.judged], 1) for row in rows],
        f"settled {rows[0].judged[0].metric}": [
            _mean([each.settled for each in row.judged], 2) for row in rows
        ],
        "compared with": [str(row.cell[0].against) if row.p is not None else "-" for row in rows],
        "only it, only this": [
            f"{row.only_other}, {row.only_this}" if row.p is not None else "-" for row in rows
        ],
        "p": [f"{row.p:.2g}" if row.p is not None else "-" for row in rows],
        "minutes": [_mean([each.minutes for each in row.cell], 1) for row in rows],
    }
    needless = {
        "played": len({row.scenes for row in rows}) == 1,
        "each seed": max(len(row.rates) for row in rows) == 1,
        "collisions": not any(each.n_collision for row in rows for each in row.judged),
        # The words below the table name it.
        "compared with": len({row.cell[0].against for row in rows if row.p is not None}) <= 1,
    }
    shown = {name: cells for name, cells in columns.items() if not needless.get(name)}
    lines = [f"| {' | '.join(shown)} |", f"|{'---|' * len(shown)}"]
    return lines + [f"| {' | '.join(cells)} |" for cells in zip(*shown.values(), strict=True)]


def _mean(values: Sequence[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.{digits}f}" if known else "-"


def _words(rows: Sequence[Row]) -> list[str]:
    """What the table says, one sentence for each thing that is compared."""
    most = max(row.rate for row in rows)
    best = _names([row for row in rows if row.rate == most], rows)
    lines = [f"- Most scenes are solved by {best}: {most:.1f} %." if most else "- None is solved."]
    tested = [row for row in rows if row.p is not None]
    for against in dict.fromkeys(row.cell[0].against for row in tested):
        own = [row for row in tested if row.cell[0].against == against]
        sure = [row for row in own if row.p is not None and row.p < SIGNIFICANT]
        for words, some in (
            ("more scenes", [row for row in sure if row.only_this > row.only_other]),
            ("fewer scenes", [row for row in sure if row.only_this < row.only_other]),
            (
                "neither more nor fewer, as far as these scenes tell",
                [r for r in own if r not in sure],
            ),
        ):
            if some:
                lines.append(f"- Compared with {against}, {words}: {_names(some, rows)}.")
    return lines


def _names(some: Sequence[Row], rows: Sequence[Row]) -> str:
    """Names of some rows of a table, each cell once."""
    if len({row.scenes for row in rows}) == 1:
        return "; ".join(row.name for row in some)
    played: dict[str, list[str]] = {}
    for row in some:
        played.setdefault(row.name, []).append(row.scenes)
    return "; ".join(f"{name} (played {' and '.join(each)})" for name, each in played.items())


def draw(study: Study) -> Any:
    """A panel for each group: success with its interval, or a map where cells play several scenes.

    Where success was followed over environment steps, its curves stand beside the panel.

    Args:
        study: What is finished; at least one cell.

    Returns:
        A ``matplotlib.figure.Figure``.
    """
    from matplotlib.figure import Figure

    groups = {group: study.rows(group) for group in study.groups()}
    followed = {name for name, rows in groups.items() if any(_points(row) > 2 for row in rows)}
    heights = [
        max(0.9 + 0.34 * len({row.name for row in rows}), 2.6 if group in followed else 0.0)
        for group, rows in groups.items()
    ]
    # Many panels stand two abreast, so that a page shows them all.
    abreast = 2 if len(groups) > 2 and not followed else 1
    axes_each = 2 if followed else 1
    row_heights = [max(some) for some in itertools.batched(heights, abreast)]
    n_columns = abreast * axes_each
    figure = Figure(figsize=(5.2 * n_columns + 2.4, sum(row_heights) + 0.3), layout="constrained")
    figure.set_dpi(130)
    panels = figure.subplots(
        len(row_heights), n_columns, squeeze=False, height_ratios=row_heights
    ).reshape(-1, axes_each)
    for (axes, *beside), (group, rows) in zip(panels, groups.items(), strict=False):
        if len({row.scenes for row in rows}) > 1:
            _draw_map(axes, rows)
        else:
            _draw_bars(axes, rows[::-1])
        axes.set_title(group, fontsize=10, loc="left")
        for each in beside:
            if group in followed:
                _draw_curves(each, [row for row in rows if _points(row) > 1])
            else:
                each.set_axis_off()
    for [unused] in panels[len(groups) :]:
        unused.set_axis_off()
    return figure


def _points(row: Row) -> int:
    """How many points the curve of each seed has at least."""
    return min(len(each.curve) for each in row.cell)


def _draw_curves(axes: Any, rows: Sequence[Row]) -> None:
    """Mean success of the seeds over environment steps, with its 95 % interval."""
    for row in rows:
        curves = [{point.env_steps: point for point in each.curve} for each in row.cell]
        # A run that was ended early has fewer points than its sisters.
        steps = sorted(set.intersection(*map(set, curves)))
        counts = [[(c[at].n_success, c[at].n) for c in curves] for at in steps]
        means = [100.0 * sum(k / n for k, n in each) / len(each) for each in counts]
        low, high = zip(*map(mean_rate_interval, counts), strict=True)
        thousands = [at / 1000.0 for at in steps]
        [line] = axes.plot(thousands, means, marker="o", markersize=3, label=row.name)
        axes.fill_between(thousands, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
    axes.set_xlabel("environment steps (thousands)", fontsize=8)
    axes.set_ylabel("solved (%)", fontsize=8)
    axes.set_ylim(-2.0, 102.0)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e4e4e2", linewidth=0.6)
    axes.legend(fontsize=7, frameon=False)


def _draw_bars(axes: Any, rows: Sequence[Row]) -> None:
    rates = [row.rate for row in rows]
    ends = (
        [max(0.0, row.rate - row.interval[0]) for row in rows],
        [max(0.0, row.interval[1] - row.rate) for row in rows],
    )
    colours = [REFERENCE if row.cell[0].against is None else OTHER for row in rows]
    axes.barh([row.name for row in rows], rates, xerr=ends, color=colours, capsize=3)
    for place, row in enumerate(rows):
        # Behind the interval, where there is room whatever the rate.
        axes.text(row.interval[1] + 1.5, place, f"{row.rate:.1f} %", va="center", fontsize=8)
    axes.set(xlim=(0.0, 112.0), xticks=range(0, 101, 20))
    axes.tick_params(labelsize=8)
    axes.set_xlabel("solved (%), with its 95 % interval", fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_map(axes: Any, rows: Sequence[Row]) -> None:
    """Cells by scenes; what is darker was solved more often."""
    names = list(dict.fromkeys(row.name for row in rows))
    scenes = list(dict.fromkeys(row.scenes for row in rows))
    rates = {(row.name, row.scenes): row.rate for row in rows}
    table = [[rates.get((name, each), float("nan")) for each in scenes] for name in names]
    axes.imshow(table, vmin=0.0, vmax=100.0, cmap="Blues", aspect="auto")
    for y, line in enumerate(table):
        for x, rate in enumerate(line):
            colour = "white" if rate > 60.0 else "black"
            axes.text(x, y, f"{rate:.0f}", ha="center", va="center", fontsize=8, color=colour)
    # On one line, long names of neighbours touch.
    axes.set_xticks(range(len(scenes)), [name.replace(", ", ",\n") for name in scenes], fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlabel("played with; solved (%)", fontsize=8)
