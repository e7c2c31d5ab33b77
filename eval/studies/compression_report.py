"""A compression study for people: Markdown tables, and error and success against size drawn."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from hvs_suite.eval.studies.compression_figures import CameraFigures, Row, Spread, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAMERA_NAMES = {"eih": "eye in hand", "eth": "eye to hand"}
COLOURS = {"AV1": "#e9620a", "H.264": "#2b6cb0", "H.264 4:4:4": "#7a3fa0"}
LABEL_SIDES = {"AV1": (0, 8), "H.264": (0, -9), "H.264 4:4:4": (11, 0)}
INK, FAINT, RULE, REFERENCE = "#1e2024", "#6e7278", "#d8d9d6", "#16803c"
LOSSLESS = "lossless PNG"
DPI = 130


def codec_name(row: Row) -> str:
    """Codec and, where it is not the usual one, how it keeps colours."""
    usual = {None: "", "yuv420p": "", "yuv444p": " 4:4:4"}
    return row.codec + usual.get(row.pixel_format, f" {row.pixel_format}")


def markdown(study: Study) -> str:
    """The study's tables: one for all cameras together, one a camera."""
    lossless = study.rows[0]
    sizes = ", ".join(
        f"{CAMERA_NAMES[camera]} {side} px" for camera, side in study.resolutions.items()
    )
    lines = [
        f"`{study.task}`: {study.episodes:,} episodes, {study.frames:,} frames; {sizes}.",
        "",
        *_table(
            ("setting", "crf", "MB per 1,000 frames", "smaller by", *_success_heads(study)),
            [
                [
                    *_setting(row),
                    f"{row.megabytes:.2f}",
                    f"{lossless.megabytes / row.megabytes:.1f}",
                    *(_success(row) if study.steps else ()),
                ]
                for row in study.rows
            ],
        ),
    ]
    for camera in study.resolutions:
        lines += [
            "",
            f"{CAMERA_NAMES[camera].capitalize()}, {lossless.cameras[camera].n:,} pictures that "
            "show the whole target:",
            "",
            *_table(
                ("setting", "crf", "MB per 1,000", "PSNR dB", "found %", "error px: median, p95",
                 "moved px: median, p95"),
                [[*_setting(row), *_camera(row.cameras[camera])] for row in study.rows],
            ),
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


def draw(study: Study) -> "Figure":
    """Draws what is found, how far it moves and, if policies were trained, success, against size.

    Args:
        study: What to draw.

    Returns:
        The figure: a column a camera and one for the policies, two panels each.
    """
    from matplotlib.figure import Figure

    columns = len(study.resolutions) + bool(study.steps)
    size = (4.4 * columns + 0.4, 6.4)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white", layout="constrained")
    grid = figure.subplots(2, columns, squeeze=False, sharex="col")
    for column, camera in enumerate(study.resolutions):
        _draw_camera(grid[0, column], grid[1, column], study, camera)
    if study.steps:
        _draw_success(grid[0, -1], grid[1, -1], study)
    for axes in grid.flat:
        _style(axes)
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=4, fontsize=9,
        frameon=False,
    )  # fmt: skip
    figure.suptitle(
        f"{study.task}: compression by codec and crf", x=0.01, ha="left", fontsize=12, color=INK
    )
    return figure


def _draw_camera(above: Any, below: Any, study: Study, camera: str) -> None:
    """The share found, and below it the 95th percentile of how far the answers moved."""
    for name, rows in _lines(study).items():
        figures = [row.cameras[camera] for row in rows]
        sizes = [each.megabytes for each in figures]
        _line(above, name, rows, sizes, [each.pc_found for each in figures])
        moved = [math.nan if each.moved_px is None else each.moved_px.p95 for each in figures]
        _line(below, name, rows, sizes, moved)
    lossless = study.rows[0].cameras[camera]
    _rule(above, lossless.pc_found, lossless.megabytes)
    if lossless.error_px is not None:
        words = "error in lossless pictures, 95th percentile"
        _rule(below, lossless.error_px.p95, lossless.megabytes, words)
    above.set_ylim(-4, 108)
    _logarithmic(below.yaxis)
    _title(above, f"{CAMERA_NAMES[camera]}, {study.resolutions[camera]} px")
    above.set_ylabel("target found (%)", fontsize=9, color=FAINT)
    below.set_ylabel("answer moved, 95th percentile (px)", fontsize=9, color=FAINT)
    below.set_xlabel("MB per 1,000 pictures of this camera", fontsize=9, color=FAINT)


def _draw_success(above: Any, below: Any, study: Study) -> None:
    """Success with Wilson's interval, and below it the mean error at the end."""
    for name, rows in _lines(study).items():
        done = [(row, row.success) for row in rows if row.success is not None]
        sizes = [row.megabytes for row, _ in done]
        rates = [100.0 * each.n_success / each.n for _, each in done]
        for size, (_, own) in zip(sizes, done, strict=True):
            above.plot((size, size), own.pc_success_ci95, color=COLOURS.get(name, INK), linewidth=1)
        _line(above, name, [row for row, _ in done], sizes, rates)
        errors = [each.settled_error for _, each in done]
        _line(below, name, [row for row, _ in done], sizes, errors)
    lossless = study.rows[0]
    if lossless.success is not None:
        rate = 100.0 * lossless.success.n_success / lossless.success.n
        above.axhspan(*lossless.success.pc_success_ci95, color=RULE, alpha=0.5, linewidth=0)
        _rule(above, rate, lossless.megabytes)
        _rule(below, lossless.success.settled_error, lossless.megabytes)
    _logarithmic(below.yaxis)
    _title(above, f"policy, {study.steps:,} training steps")
    above.set_ylabel("solved, with 95 % interval (%)", fontsize=9, color=FAINT)
    below.set_ylabel("settled error, interquartile mean (mm)", fontsize=9, color=FAINT)
    below.set_xlabel("MB per 1,000 frames, all cameras", fontsize=9, color=FAINT)


def _line(
    axes: Any, name: str, rows: Sequence[Row], sizes: Sequence[float], heights: Sequence[float]
) -> None:
    """One codec's points, each with its crf; codecs write theirs on different sides."""
    colour = COLOURS.get(name, INK)
    axes.plot(sizes, heights, "o-", color=colour, markersize=4.5, linewidth=1.6, label=name)
    side = LABEL_SIDES.get(name, (0, 6))
    for size, height, row in zip(sizes, heights, rows, strict=True):
        if math.isfinite(height):
            axes.annotate(
                f"{row.crf}", (size, height), xytext=side, textcoords="offset points",
                ha="center", va="center", fontsize=7.5, color=colour,
            )  # fmt: skip


def _rule(axes: Any, height: float, size: float, words: str = LOSSLESS) -> None:
    """A level line where lossless pictures stand, and an upright one at their size."""
    axes.axhline(height, color=REFERENCE, linewidth=1.0, linestyle="--", label=LOSSLESS)
    axes.axvline(size, color=REFERENCE, linewidth=1.0, linestyle=":")
    if words != LOSSLESS:
        # Beside the upright line, where few settings come.
        axes.annotate(
            words, (size, height), xytext=(-4, 3), textcoords="offset points", fontsize=7.5,
            color=REFERENCE, ha="right",
        )  # fmt: skip


def _logarithmic(axis: Any) -> None:
    """Decades split at 2 and 5, in plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(NullLocator())


def _title(axes: Any, words: str) -> None:
    axes.set_title(words, fontsize=10, color=INK, loc="left")


def _style(axes: Any) -> None:
    """Faint frame and grid; sizes on a logarithmic axis."""
    _logarithmic(axes.xaxis)
    axes.tick_params(labelsize=8, colors=FAINT)
    axes.grid(color=RULE, linewidth=0.6)
    for side in axes.spines.values():
        side.set_color(RULE)


def _lines(study: Study) -> dict[str, list[Row]]:
    """Rows by codec, smallest first."""
    lines: dict[str, list[Row]] = {}
    for row in sorted(study.rows[1:], key=lambda each: each.megabytes):
        lines.setdefault(codec_name(row), []).append(row)
    return lines


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---", *["---:"] * (len(heads) - 1)]
    return [f"| {' | '.join(cells)} |" for cells in (heads, rule, *rows)]


def _setting(row: Row) -> tuple[str, str]:
    return codec_name(row), "-" if row.crf is None else str(row.crf)


def _camera(figures: CameraFigures) -> tuple[str, ...]:
    return (
        f"{figures.megabytes:.2f}",
        "-" if figures.psnr_db is None else f"{figures.psnr_db:.1f}",
        f"{figures.pc_found:.1f}",
        _spread(figures.error_px),
        _spread(figures.moved_px),
    )


def _spread(spread: Spread | None) -> str:
    return "-" if spread is None else f"{spread.median:.3f}, {spread.p95:.3f}"


def _success_heads(study: Study) -> tuple[str, ...]:
    if not study.steps:
        return ()
    return ("solved", "95 % interval", "lost, won against PNG", "p", "final mm, deg", "settled mm")


def _success(row: Row) -> tuple[str, ...]:
    own = row.success
    if own is None:
        return ("-",) * 6
    low, high = own.pc_success_ci95
    return (
        f"{own.n_success} of {own.n}",
        f"{low:.1f} to {high:.1f}",
        f"{own.n_only_lossless}, {own.n_only_this}",
        f"{own.p:.2g}",
        ", ".join(f"{value:.2f}" for value in own.errors.values()),
        f"{own.settled_error:.3f}",
    )
