"""Tables and picture of the study of few demonstrations."""

from collections.abc import Sequence
from typing import Any

from hvs_suite.eval.studies.few_demonstrations import (
    BASE,
    FINETUNED,
    IMITATED,
    SCRATCH,
    Curve,
    Point,
    Study,
)
from hvs_suite.eval.studies.training import SPLIT
from hvs_suite.statistics import mean_rate_interval

COLOURS = {FINETUNED: "#e9620a", IMITATED: "#2b6cb0", SCRATCH: "#7a3fa0"}


def _pooled(points: Sequence[Point]) -> tuple[float, float, float]:
    """Mean success of several seeds and its 95 % interval (%)."""
    counts = [(point.n_success, point.n) for point in points]
    low, high = mean_rate_interval(counts)
    return 100.0 * sum(k / n for k, n in counts) / len(counts), low, high


def _cell(points: Sequence[Point]) -> str:
    """Mean success and its interval; nothing for a way that is not finished for any seed."""
    if not points:
        return ""
    mean, low, high = _pooled(points)
    return f"{mean:.1f} % ({low:.1f} to {high:.1f})"


def _curves(study: Study, way: str, count: int) -> list[Curve]:
    return [family.curves[way] for family in study.of(0 if way == SCRATCH else count)]


def markdown(study: Study) -> str:
    """The study's tables, of what is finished."""
    budget = study.budget
    lines = [
        f"`{study.task}`, {budget.episodes} scenes of split `{SPLIT}`, mean of the seeds with its "
        f"95 % interval: bases of {budget.base_steps:,} optimiser steps, then "
        f"{budget.env_steps:,} environment steps.",
        "",
        f"| demonstrations | seeds | base | {FINETUNED} | of the gap closed | minutes | {IMITATED} "
        f"| minutes | {SCRATCH} |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for count in study.counts():
        tuned, imitated, scratch = (_curves(study, way, count) for way in COLOURS)
        bases = [curve.points[0] for curve in tuned]
        ends = [[curve.points[-1] for curve in way] for way in (tuned, imitated, scratch)]
        before, after = _pooled(bases)[0], _pooled(ends[0])[0]
        closed = (after - before) / max(1e-9, 100.0 - before)
        minutes = [sum(c.minutes for c in way) / len(way) for way in (tuned, imitated)]
        cells = [_cell(points) for points in (bases, *ends)]
        lines.append(
            f"| {count} | {len(tuned)} | {cells[0]} | {cells[1]} | {100 * closed:.0f} % "
            f"| {minutes[0]:.0f} | {cells[2]} | {minutes[1]:.0f} | {cells[3]} |"
        )
    lines += [
        "",
        "| demonstrations | against each other | only the first, only the second | p |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| {row.demonstrations} | {row.way}, {row.other} | {row.n_only_way}, {row.n_only_other} "
        f"| {row.p:.2g} |"
        for row in study.comparisons()
    ]
    lines += [
        "",
        f"| demonstrations | collisions: {BASE} | {FINETUNED} | {IMITATED} |",
        "|---|---|---|---|",
    ]
    for count in study.counts():
        cells = [
            str(sum(family.ends[way].n_collision for family in study.of(count)))
            for way in (BASE, FINETUNED, IMITATED)
        ]
        lines.append(f"| {count} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(study: Study) -> Any:
    """Success against environment steps, a panel for each number of demonstrations.

    Args:
        study: What is finished; at least one base.

    Returns:
        A ``matplotlib.figure.Figure``.
    """
    from matplotlib.figure import Figure

    counts = study.counts()
    size = (3.4 * len(counts) + 0.6, 3.6)
    figure = Figure(figsize=size, dpi=130, facecolor="white", layout="constrained")
    for axes, count in zip(
        figure.subplots(1, len(counts), sharey=True, squeeze=False)[0], counts, strict=True
    ):
        # What the study is about lies on top.
        for way, colour in reversed(COLOURS.items()):
            curves = _curves(study, way, count)
            if not curves:
                continue
            # A run that was ended early has fewer points than its sisters.
            steps = sorted(set.intersection(*({p.env_steps for p in c.points} for c in curves)))
            pooled = [
                _pooled([next(p for p in c.points if p.env_steps == at) for c in curves])
                for at in steps
            ]
            means, lows, highs = zip(*pooled, strict=True)
            thousands = [at / 1000.0 for at in steps]
            axes.plot(thousands, means, color=colour, marker="o", markersize=3, label=way)
            axes.fill_between(thousands, lows, highs, color=colour, alpha=0.15, linewidth=0)
        axes.set_title(f"{count} demonstrations", fontsize=9, loc="left")
        axes.set(xlabel="environment steps (thousands)", ylim=(-2.0, 102.0))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e4e4e2", linewidth=0.6)
    figure.axes[0].set_ylabel("solved (%)")
    figure.axes[0].legend(fontsize=7, frameon=False, loc="center right")
    figure.suptitle(f"{study.task}: from a few demonstrations", fontsize=10, x=0.01, ha="left")
    return figure
