"""The board's plots as small SVG pictures, drawn straight from the numbers.

Matplotlib would do, but writes 30 kB and more a plot, with colours that cannot follow the reader's
light or dark mode and text that does not scale for a phone. These are 2-10 kB, take every colour
from the page's style by class, and the same numbers give the same bytes.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from hvs_suite import statistics
from hvs_suite.eval.board.tables import Entry, escaped, figure
from hvs_suite.eval.scoring.result_file import EpisodeRow

# A curve's plot in user units; shown at about 1.3 px a unit on a desktop, 1 px on a phone.
_WIDTH, _HEIGHT = 360, 232
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 346, 10, 192
_LANDING = 200
COLOURS: Final = 8
"""Distinct colours in the style; further policies take them again with broken lines."""


@dataclasses.dataclass(frozen=True)
class Line:
    """One policy's curve.

    Attributes:
        policy: Its name.
        colour: Its place among all policies of the board.
        pc_success: (n,) percent.
        n: Episodes behind each of them.
    """

    policy: str
    colour: int
    pc_success: Sequence[float]
    n: int


def tolerance_plot(entries: Sequence[Entry], colours: dict[str, int]) -> str:
    """Draws the share of scenarios that settled within each multiple of the task's tolerances.

    Args:
        entries: Of one task; the first is drawn on top.
        colours: Place of each policy among all of the board.
    """
    scales = np.geomspace(0.01, 100.0, 81)
    lines = []
    for entry in entries:
        tolerances = entry.result.metadata.tolerances
        reached = [row.scale(tolerances) for row in entry.result.episodes]
        curve = statistics.share_within(reached, scales).tolist()
        lines.append(Line(entry.policy, colours[entry.policy], curve, len(reached)))
    xs = np.linspace(_LEFT, _RIGHT, len(scales)).tolist()
    ticks = [(xs[20 * k], text) for k, text in enumerate(("0.01", "0.1", "1", "10", "100"))]
    return _plot("Success against tolerance", "tolerance, × the task's", ticks, xs, lines, xs[40])


def steps_plot(entries: Sequence[Entry], colours: dict[str, int]) -> str:
    """Draws the share of scenarios solved within each number of control steps.

    Args:
        entries: Of one task; the first is drawn on top.
        colours: Place of each policy among all of the board.
    """
    limit = entries[0].result.metadata.time_limit_steps
    lines = [
        Line(
            entry.policy,
            colours[entry.policy],
            [0.0, *entry.result.summary.success_by_step],
            entry.result.summary.n_episodes,
        )
        for entry in entries
    ]
    xs = np.linspace(_LEFT, _RIGHT, limit + 1).tolist()
    every = max(1, limit // 4)
    ticks = [(xs[step], str(step)) for step in range(0, limit + 1, every)]
    return _plot("Success against time", "control steps", ticks, xs, lines, None, stairs=True)


def landing_plot(
    rows: Sequence[EpisodeRow], radius_mm: float, tolerance_mm: float, title: str
) -> str:
    """Draws where the flange stands in the target plane at the time limit, around the target.

    Successes are round, other episodes square, and those in which the arm was lost square and of
    another colour.

    Args:
        rows: Episodes.
        radius_mm: Half the side of the picture (mm).
        tolerance_mm: The task's bound sideways, drawn as a circle where it fits (mm).
        title: What it shows, for those who cannot see it.
    """
    half = _LANDING / 2
    unit = half / radius_mm
    parts = [
        f'<svg class="landing" viewBox="0 0 {_LANDING} {_LANDING}" role="img" '
        f'aria-label="{escaped(title)}">',
        f'<path class="grid" d="M{half:g} 0v{_LANDING}M0 {half:g}h{_LANDING}"/>',
    ]
    if tolerance_mm <= radius_mm:
        radius = tolerance_mm * unit
        parts.append(f'<circle class="goal" cx="{half:g}" cy="{half:g}" r="{radius:.1f}"/>')
    # What succeeded is drawn last, over the rest.
    for kind in ("lost", "miss", "hit"):
        # Whole units, each once: a thousand episodes on one spot are one dot, and draw as one.
        spots = sorted(
            {
                (round(half + row.settled.x_mm * unit), round(half - row.settled.y_mm * unit))
                for row in rows
                if _kind(row) == kind and is_inside(row, radius_mm)
            }
        )
        if spots:
            path = "".join(f"M{x} {y}h0" for x, y in spots)
            parts.append(f'<path class="{kind}" d="{path}"/>')
    parts.append(
        f'<text x="3" y="{_LANDING - 4}">\N{MINUS SIGN}{figure_of(radius_mm)}</text>'
        f'<text class="end" x="{_LANDING - 3}" y="{_LANDING - 4}">{figure_of(radius_mm)} mm</text>'
        "</svg>"
    )
    return "".join(parts)


def landing_radius(rows: Sequence[EpisodeRow]) -> float:
    """Returns a round half side (mm) that takes in 95 % of the landings, at least a micrometre."""
    wanted = statistics.percentile([_distance(row) for row in rows], 95)
    power = 10.0 ** math.floor(math.log10(max(wanted, 1e-3)))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= wanted)


def is_inside(row: EpisodeRow, radius_mm: float) -> bool:
    """Whether a landing lies in a picture with this half side (mm)."""
    return max(abs(row.settled.x_mm), abs(row.settled.y_mm)) <= radius_mm


def figure_of(length_mm: float) -> str:
    """Returns a round length without needless digits."""
    return f"{length_mm:g}"


def bar(low: float, rate: float, high: float) -> str:
    """Draws a rate and its interval to scale from 0 to 100 % (all in percent)."""
    label = f"{figure(rate)} %, between {figure(low)} and {figure(high)} %"
    return (
        f'<svg class="bar" viewBox="0 0 100 12" preserveAspectRatio="none" role="img" '
        f'aria-label="{label}">'
        '<rect class="track" y="5" width="100" height="2"/>'
        f'<rect class="band" x="{low:.2f}" y="3" width="{high - low:.2f}" height="6"/>'
        f'<rect class="mark" x="{min(rate, 98.5):.2f}" y="1" width="1.5" height="10"/></svg>'
    )


def _plot(
    title: str,
    x_label: str,
    x_ticks: Sequence[tuple[float, str]],
    xs: Sequence[float],
    lines: Sequence[Line],
    mark: float | None,
    *,
    stairs: bool = False,
) -> str:
    """Draws curves of success with their pointwise Wilson intervals.

    Args:
        title: What it shows, for those who cannot see it.
        x_label: Axis and unit.
        x_ticks: Place and text of each.
        xs: Place of each point of the curves.
        lines: Curves; the first is drawn on top.
        mark: Place of an upright line, or None.
        stairs: Hold each value up to the next point.
    """
    middle = (_LEFT + _RIGHT) / 2
    parts = [
        f'<svg class="plot" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{title}">',
    ]
    for pc in (0, 25, 50, 75, 100):
        y = _y(pc)
        parts.append(
            f'<path class="grid" d="M{_LEFT} {y:g}H{_RIGHT}"/>'
            f'<text class="end" x="{_LEFT - 5}" y="{y + 4:g}">{pc}</text>'
        )
    for x, text in x_ticks:
        parts.append(
            f'<path class="grid" d="M{x:.1f} {_BOTTOM}v4"/>'
            f'<text class="middle" x="{x:.1f}" y="{_BOTTOM + 16}">{text}</text>'
        )
    if mark is not None:
        parts.append(f'<path class="goal" d="M{mark:.1f} {_TOP}V{_BOTTOM}"/>')
    parts.append(
        f'<text class="middle" x="{middle:g}" y="{_HEIGHT - 6}">{escaped(x_label)}</text>'
        f'<text class="middle" transform="translate(12 {(_TOP + _BOTTOM) / 2:g}) rotate(-90)">'
        "success (%)</text>"
    )
    for line in reversed(lines):
        ends = [
            statistics.wilson_interval(round(pc * line.n / 100), line.n) for pc in line.pc_success
        ]
        low, high = zip(*ends, strict=True)
        upper = _path(xs, high, stairs=stairs)
        lower = _path(xs, low, stairs=stairs, back=True)
        broken = " broken" if line.colour >= COLOURS else ""
        parts.append(
            f'<g class="c{line.colour % COLOURS}{broken}" '
            f'data-policy="{escaped(line.policy)}">'
            f'<path class="zone" d="M{upper}L{lower}Z"/>'
            f'<path class="line" d="M{_path(xs, line.pc_success, stairs=stairs)}"/></g>'
        )
    parts.append("</svg>")
    return "".join(parts)


def _path(xs: Sequence[float], values: Sequence[float], *, stairs: bool, back: bool = False) -> str:
    """Returns points as SVG path data, without those in the middle of a level stretch."""
    points: list[tuple[float, float]] = []
    for x, value in zip(xs, values, strict=True):
        y = _y(value)
        if stairs and points:
            points.append((x, points[-1][1]))
        points.append((x, y))
    kept = [
        point
        for k, point in enumerate(points)
        if k in (0, len(points) - 1)
        or not f"{points[k - 1][1]:.1f}" == f"{point[1]:.1f}" == f"{points[k + 1][1]:.1f}"
    ]
    return "L".join(f"{x:.1f} {y:.1f}" for x, y in (reversed(kept) if back else kept))


def _y(pc: float) -> float:
    return _BOTTOM - (_BOTTOM - _TOP) * pc / 100


def _kind(row: EpisodeRow) -> str:
    if row.settled.lost:
        return "lost"
    return "hit" if row.success else "miss"


def _distance(row: EpisodeRow) -> float:
    return math.hypot(row.settled.x_mm, row.settled.y_mm)
