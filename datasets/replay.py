"""Films of recorded episodes: what the dataset holds, beside the cell as re-simulation shows it.

The camera pictures and the error curves come from the dataset; the cell's view, which no dataset
holds, from playing the executed actions again. The state after the last action is in no frame of
the dataset either: the film ends with it, re-simulated.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets import reader
from hvs_suite.datasets.features import (
    ACTION_EXECUTED,
    CAMERAS,
    ERRORS,
    SCENARIO,
    dataset_features,
    image_key,
)
from hvs_suite.datasets.metadata import METADATA_FILE, DatasetMetadata, read_metadata
from hvs_suite.errors import DatasetError, OptionError, UnknownTaskError
from hvs_suite.pictures import FAINT, GREEN, INK, PAPER, RED, TRACK, Picture, as_rgb, font, resize
from hvs_suite.registry import find, load

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.spec import Spec

# Layout (px): a line of text, the cell with the cameras stacked beside it, the curves below.
MARGIN = 16
HEAD = 40
CELL_SIDE = 576
CAMERA_TITLE = 20
CAMERA_SIDE = CELL_SIDE // 2 - CAMERA_TITLE
WIDTH = MARGIN + CELL_SIDE + MARGIN + CAMERA_SIDE + MARGIN
CURVES_HEIGHT = 236
HEIGHT = HEAD + CELL_SIDE + MARGIN + CURVES_HEIGHT
DPI = 100
# Errors below this are drawn on the axis: a logarithm has no zero.
_FLOOR = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Replay:
    """A film of one episode.

    Attributes:
        frames: uint8 (H, W, 3) each, one a control step and one for the end.
        fps: Control steps a second.
        scenario: Index in the split.
        success: The recording says that it reached the goal.
    """

    frames: list[Picture]
    fps: float
    scenario: int
    success: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """What a dataset holds of an episode of n frames.

    Attributes:
        pictures: Camera to uint8 (H, W, 3), one a frame.
        errors: As ``ERROR_NAMES``, (n, 4).
        actions: Executed actions, float32 (n, 7).
        scenario: Index in the split.
        success: It reached the goal.
    """

    pictures: dict[str, list[Picture]]
    errors: npt.NDArray[np.float64]
    actions: npt.NDArray[np.float32]
    scenario: int
    success: bool


def replay(root: Path, episode: int) -> Replay:
    """Draws an episode of a dataset.

    Args:
        root: The dataset.
        episode: Its index.

    Returns:
        The film.

    Raises:
        DatasetError: There is no such dataset or episode, or it is damaged.
    """
    metadata = read_metadata(root)
    recorded = read_recorded(root, episode)
    pictures, actions = recorded.pictures, recorded.actions
    cells: list[Picture] = []
    with load(metadata.task, split=metadata.split, **metadata.options) as env:
        spec = env.spec
        time_step = env.reset(scenario=recorded.scenario)
        cells.append(env.render(width=CELL_SIDE, height=CELL_SIDE))
        for action in actions:
            if time_step.last():
                raise DatasetError(
                    f"{root}: episode {episode} goes on where re-simulation ends; see 'hvs check'"
                )
            time_step = env.step(action)
            cells.append(env.render(width=CELL_SIDE, height=CELL_SIDE))
        at_end = [env.info["errors"][metric.name] for metric in spec.metrics]
        for camera, shown in pictures.items():
            shown.append(as_rgb(time_step.observation[camera]))
    curves = _Curves(spec, np.vstack([recorded.errors, at_end]))
    head = f"{root.resolve().name}, episode {episode}"
    tail = f"{metadata.task}, scenario {recorded.scenario} of {metadata.split}"
    tail += _noise_in_words(metadata)
    frames = [
        _frame(
            spec,
            cells[step],
            {camera: shown[step] for camera, shown in pictures.items()},
            curves.at(step),
            (head, tail),
            (step, len(actions), recorded.success),
        )
        for step in range(len(cells))
    ]
    return Replay(frames, 1.0 / spec.control_period_s, recorded.scenario, recorded.success)


def read_recorded(root: Path, episode: int) -> Recorded:
    """Reads what a film shows of an episode.

    Args:
        root: The dataset.
        episode: Its index.

    Returns:
        Its pictures and numbers, as long as each other.

    Raises:
        DatasetError: There is no such dataset or episode, or it is damaged.
    """
    metadata = read_metadata(root)
    try:
        spec = find(metadata.task).with_options(metadata.options)
    except (UnknownTaskError, OptionError) as error:
        raise DatasetError(f"{root}: {METADATA_FILE}: {error}") from error
    info = reader.read_info(root)
    place = find_place(root, episode)
    table = reader.read_episode(root, place)
    if table.num_rows == 0:
        raise DatasetError(f"{place.file} holds no frame of episode {episode}; see 'hvs check'")
    pictures = {
        camera: reader.read_pictures(root, info, place, table, image_key(camera))
        for camera in CAMERAS
        if image_key(camera) in info["features"]
    }
    numbers = {}
    shapes = dataset_features(spec)
    for name in (ERRORS, ACTION_EXECUTED, SCENARIO, "next.success"):
        with reader.in_file(root, place.file):
            numbers[name] = reader.column(table, name)
            shape = tuple(shapes[name]["shape"])
            if numbers[name].shape[1:] != (() if shape == (1,) else shape):
                raise DatasetError(f"{name} has shape {numbers[name].shape[1:]}, not {shape}")
            if not np.isfinite(numbers[name]).all():
                raise DatasetError(f"{name} holds NaN or infinity; see 'hvs check'")
    actions = numbers[ACTION_EXECUTED].astype(np.float32)
    if any(len(each) != len(actions) for each in pictures.values()):
        raise DatasetError(f"{root}: episode {episode} lacks pictures; see 'hvs check'")
    return Recorded(
        pictures,
        numbers[ERRORS].astype(np.float64),
        actions,
        int(numbers[SCENARIO][0]),
        bool(numbers["next.success"].any()),
    )


def find_place(root: Path, episode: int) -> reader.Place:
    """Where an episode lies.

    Raises:
        DatasetError: There is none of that index.
    """
    places = {place.episode: place for place in reader.read_places(root)}
    if episode not in places:
        raise DatasetError(f"{root} holds episodes 0 to {max(places)}, not {episode}")
    return places[episode]


def _noise_in_words(metadata: DatasetMetadata) -> str:
    return f", noise {metadata.noise:g} rad" if metadata.noise else ""


def _frame(
    spec: "Spec",
    cell: Picture,
    pictures: Mapping[str, Picture],
    curves: Picture,
    words: tuple[str, str],
    state: tuple[int, int, bool],
) -> Picture:
    """Lays out one frame."""
    from PIL import Image, ImageDraw

    frame = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
    draw = ImageDraw.Draw(frame)
    step, steps, success = state
    draw.text((MARGIN, 9), words[0], INK, font(16, bold=True))
    left = MARGIN + draw.textlength(words[0], font(16, bold=True)) + 14
    draw.text((left, 12), words[1], FAINT, font(13))
    status, colour = f"step {step} of {steps}", INK
    if step == steps:
        status, colour = ("success", GREEN) if success else ("not solved", RED)
        status += f" after {steps} steps"
    draw.text((WIDTH - MARGIN, 9), status, colour, font(16, bold=True), anchor="ra")
    frame.paste(Image.fromarray(cell), (MARGIN, HEAD))
    x = MARGIN + CELL_SIDE + MARGIN
    for row, (camera, title) in enumerate((("eih", "eye in hand"), ("eth", "eye to hand"))):
        y = HEAD + row * (CAMERA_SIDE + CAMERA_TITLE)
        if camera in pictures:
            image = pictures[camera]
            # The title of the upper one lies below the head, that of the lower between them.
            draw.text((x, y), title, INK, font(13, bold=True))
            size = f"{image.shape[1]} px"
            draw.text((x + CAMERA_SIDE, y + 1), size, FAINT, font(12), anchor="ra")
            frame.paste(Image.fromarray(resize(image, CAMERA_SIDE)), (x, y + CAMERA_TITLE))
        else:
            box = (x, y + CAMERA_TITLE, x + CAMERA_SIDE, y + CAMERA_TITLE + CAMERA_SIDE)
            draw.rectangle(box, TRACK)
    frame.paste(Image.fromarray(curves), (0, HEAD + CELL_SIDE + MARGIN))
    return np.asarray(frame)


class _Curves:
    """Lengths and angles over the steps, bold up to now, with the tolerances.

    What all frames share is drawn once, and what has happened by now over it, which takes less time
    than to draw all of it for every frame.

    Args:
        spec: Whose tolerances are drawn.
        errors: (steps + 1, k), the metrics of the task.
    """

    def __init__(self, spec: "Spec", errors: npt.NDArray[Any]) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(WIDTH / DPI, CURVES_HEIGHT / DPI), dpi=DPI, facecolor=_hex(PAPER))
        figure.subplots_adjust(left=0.075, right=0.982, bottom=0.2, top=0.88, wspace=0.2)
        diagrams: dict[str, list[tuple[str, int, float | None]]] = {}
        for index, metric in enumerate(spec.metrics):
            if metric.bound is not None and metric.over == "step":
                line = (metric.title.removesuffix(" error"), index, metric.bound)
                diagrams.setdefault(metric.unit, []).append(line)
        self._lines = [
            line
            for axes, (unit, lines) in zip(
                np.ravel(figure.subplots(1, len(diagrams))), diagrams.items(), strict=True
            )
            for line in _plot(axes, f"error ({unit})", lines, errors)
        ]
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        self._canvas, self._shared = canvas, canvas.copy_from_bbox(figure.bbox)

    def at(self, step: int) -> Picture:
        """Draw what is known at a step, uint8 (CURVES_HEIGHT, WIDTH, 3)."""
        self._canvas.restore_region(self._shared)
        for line, values in self._lines:
            line.set_data(np.arange(step + 1), values[: step + 1])
            line.set_markevery([step])
            line.axes.draw_artist(line)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def _plot(
    axes: Any,
    title: str,
    lines: Sequence[tuple[str, int, float | None]],
    errors: npt.NDArray[Any],
) -> list[tuple[Any, npt.NDArray[Any]]]:
    """One diagram: errors over steps on a logarithmic axis.

    Returns:
        What is still to be drawn for each step, a line that ends in a dot, and its values.
    """
    steps = np.arange(len(errors))
    bounds = [tolerance for _, _, tolerance in lines if tolerance is not None]
    shown = np.maximum(np.abs(errors[:, [index for _, index, _ in lines]]), _FLOOR)
    moving = []
    for number, ((name, _, tolerance), colour) in enumerate(
        zip(lines, ("#e9620a", "#2b6cb0"), strict=False)
    ):
        values = shown[:, number]
        axes.plot(steps, values, color=colour, alpha=0.25, linewidth=1.5)
        [line] = axes.plot([], color=colour, linewidth=2.2, label=name, animated=True)
        line.set(marker="o", markersize=5)
        moving.append((line, values))
        if tolerance is not None:
            axes.axhline(tolerance, color=_hex(GREEN), linewidth=1.0, linestyle="--")
            axes.annotate(
                f"≤ {tolerance:g}",
                (0.0, tolerance),
                xycoords=("axes fraction", "data"),
                # The smaller of two bounds below its line: they may be close to each other.
                xytext=(4, 3 if tolerance == max(bounds) else -11),
                textcoords="offset points",
                fontsize=8,
                color=_hex(GREEN),
            )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    low = min(float(shown.min()), *bounds) if bounds else float(shown.min())
    axes.set_ylim(low / 2.5, max(float(shown.max()), *bounds) * 2.0)
    axes.set_xlim(0, len(errors) - 1)
    axes.set_title(title, fontsize=10, color=_hex(INK), loc="left", fontweight="bold")
    axes.set_xlabel("control step", fontsize=9, color=_hex(FAINT))
    axes.tick_params(labelsize=8, colors=_hex(FAINT))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(color=_hex(TRACK), linewidth=0.6)
    axes.set_facecolor("white")
    for side in axes.spines.values():
        side.set_color(_hex(TRACK))
    if len(lines) > 1:
        axes.legend(fontsize=8, frameon=False, loc="upper right")
    return moving


def _hex(colour: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
