"""The board's plots: where every line and dot of them stands; ``templates/plots.jinja`` draws them.

Matplotlib would do, but writes 30 kB and more a plot, with colours that cannot follow the reader's
light or dark mode and text that does not scale for a phone. These are 2-10 kB, take every colour
from the page's style by class, and the same numbers give the same bytes.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from hvs_suite import statistics
from hvs_suite.eval.board.tables import Entry
from hvs_suite.eval.scoring.result_file import EpisodeRow

# A curve's plot in user units; shown at about 1.3 px a unit on a desktop, 1 px on a phone.
WIDTH: Final = 360
HEIGHT: Final = 232
LEFT: Final = 44
RIGHT: Final = 346
TOP: Final = 10
BOTTOM: Final = 192
LANDING: Final = 200
"""Side of a picture of landings in user units."""


@dataclasses.dataclass(frozen=True)
class Curve:
    """One policy's curve of success, as SVG path data.

    Attributes:
        policy: Its name.
        line: The curve.
        zone: Its pointwise 95 % intervals.
    """

    policy: str
    line: str
    zone: str


@dataclasses.dataclass(frozen=True)
class Plot:
    """Curves of success.

    Attributes:
        title: What it shows, for readers who cannot see it.
        x_label: Axis and unit.
        x_ticks: Place and text of each.
        y_ticks: The same of success in percent.
        curves: The last is drawn on top.
        mark: Place of an upright line, or None.
    """

    title: str
    x_label: str
    x_ticks: Sequence[tuple[float, str]]
    y_ticks: Sequence[tuple[float, str]]
    curves: Sequence[Curve]
    mark: float | None


@dataclasses.dataclass(frozen=True)
class Landings:
    """Where the flange of one policy stands at the end, around the target.

    Attributes:
        radius_mm: Half the side of the picture (mm).
        goal: Radius of the circle that shows the tolerance (user units); None where it does not
            fit.
        spots: SVG path data of the dots of each kind; the last are drawn on top.
        n_inside: Landings in the picture.
        n: Landings altogether.
    """

    radius_mm: float
    goal: float | None
    spots: Sequence[tuple[Literal["lost", "miss", "hit"], str]]
    n_inside: int
    n: int


def tolerance_plot(entries: Sequence[Entry]) -> Plot:
    """Returns the share of scenarios that settled within each multiple of the task's tolerances.

    Args:
        entries: Of one task; the first is drawn on top.
    """
    scales = np.geomspace(0.01, 100.0, 81)
    xs = np.linspace(LEFT, RIGHT, len(scales)).tolist()
    curves = []
    for entry in entries:
        tolerances = entry.result.metadata.tolerances
        reached = [row.scale(tolerances) for row in entry.result.episodes]
        share = statistics.share_within(reached, scales).tolist()
        curves.append(_curve(entry, xs, share))
    ticks = [(xs[20 * k], text) for k, text in enumerate(("0.01", "0.1", "1", "10", "100"))]
    return _plot("Success against tolerance", "tolerance, × the task's", ticks, curves, xs[40])


def steps_plot(entries: Sequence[Entry]) -> Plot:
    """Returns the share of scenarios solved within each number of control steps.

    Args:
        entries: Of one task; the first is drawn on top.
    """
    limit = entries[0].result.metadata.time_limit_steps
    xs = np.linspace(LEFT, RIGHT, limit + 1).tolist()
    curves = [
        _curve(entry, xs, [0.0, *entry.result.summary.success_by_step], stairs=True)
        for entry in entries
    ]
    every = max(1, limit // 4)
    ticks = [(xs[step], str(step)) for step in range(0, limit + 1, every)]
    return _plot("Success against time", "control steps", ticks, curves, None)


def landings(rows: Sequence[EpisodeRow], radius_mm: float, tolerance_mm: float) -> Landings:
    """Returns where the flange stands in the target plane at the time limit, around the target.

    Args:
        rows: Episodes.
        radius_mm: Half the side of the picture (mm).
        tolerance_mm: The task's bound sideways (mm).
    """
    half = LANDING / 2
    unit = half / radius_mm
    inside = [row for row in rows if _is_inside(row, radius_mm)]
    spots: list[tuple[Literal["lost", "miss", "hit"], str]] = []
    # What succeeded is drawn last, over the rest.
    for kind in ("lost", "miss", "hit"):
        # Whole units, each once: a thousand episodes on one spot are one dot, and draw as one.
        places = sorted(
            {
                (round(half + row.settled.x_mm * unit), round(half - row.settled.y_mm * unit))
                for row in inside
                if _kind(row) == kind
            }
        )
        if places:
            spots.append((kind, "".join(f"M{x} {y}h0" for x, y in places)))
    goal = tolerance_mm * unit if tolerance_mm <= radius_mm else None
    return Landings(radius_mm, goal, spots, len(inside), len(rows))


def landing_radius(rows: Sequence[EpisodeRow]) -> float:
    """Returns a round half side (mm) that takes in 95 % of the landings, at least a micrometre."""
    distances = [math.hypot(row.settled.x_mm, row.settled.y_mm) for row in rows]
    wanted = statistics.percentile(distances, 95)
    power = 10.0 ** math.floor(math.log10(max(wanted, 1e-3)))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= wanted)


def _plot(
    title: str,
    x_label: str,
    x_ticks: Sequence[tuple[float, str]],
    curves: Sequence[Curve],
    mark: float | None,
) -> Plot:
    y_ticks = [(_y(pc), str(pc)) for pc in (0, 25, 50, 75, 100)]
    return Plot(title, x_label, x_ticks, y_ticks, curves[::-1], mark)


def _curve(
    entry: Entry, xs: Sequence[float], pc_success: Sequence[float], *, stairs: bool = False
) -> Curve:
    """Returns a curve of success with its pointwise Wilson intervals.

    Args:
        entry: Whose it is.
        xs: (n,) place of each point.
        pc_success: (n,) percent.
        stairs: Hold each value up to the next point.
    """
    n = entry.result.summary.n_episodes
    ends = [statistics.wilson_interval(round(pc * n / 100), n) for pc in pc_success]
    low, high = zip(*ends, strict=True)
    upper = _path(xs, high, stairs=stairs)
    lower = _path(xs, low, stairs=stairs, back=True)
    line = _path(xs, pc_success, stairs=stairs)
    return Curve(entry.policy, f"M{line}", f"M{upper}L{lower}Z")


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
    return BOTTOM - (BOTTOM - TOP) * pc / 100


def _is_inside(row: EpisodeRow, radius_mm: float) -> bool:
    return max(abs(row.settled.x_mm), abs(row.settled.y_mm)) <= radius_mm


def _kind(row: EpisodeRow) -> Literal["lost", "miss", "hit"]:
    if row.settled.lost:
        return "lost"
    return "hit" if row.success else "miss"
