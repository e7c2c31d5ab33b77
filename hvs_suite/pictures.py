"""Pictures and films of an episode: the cell, what its policy sees, and its state in figures.

A film frame is drawn from an environment as it stands, so any loop can make one a control step:
the cell, both camera images enlarged without smoothing (their pixels are what a policy gets), the
seven joint angles in their ranges, the errors against their tolerances, and the reward.
"""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OutputError
from hvs_suite.files import replacing
from hvs_suite.rollout import Instructed, run_episode

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

    from hvs_suite.rollout import Action, Episode, Observation, Policy
    from hvs_suite.tasks.shared.environment import Environment
    from hvs_suite.tasks.shared.spec import Spec

Picture = npt.NDArray[np.uint8]

FILM_SUFFIXES = (".mp4", ".gif")

# Layout of a film frame (px): the cell on the left, a panel of the same height on the right.
CELL_SIDE = 576
PANEL_WIDTH = 448
MARGIN = 16
CAMERA_SIDE = (PANEL_WIDTH - 3 * MARGIN) // 2
BAR_LEFT, BAR_WIDTH, BAR_HEIGHT = MARGIN + 32, 304, 9
ROW_HEIGHT = 25

# Layout of a strip of pictures (px).
STRIP_GAP, STRIP_TITLE = 6, 20

PAPER, INK, FAINT, TRACK = (250, 250, 248), (30, 32, 36), (110, 114, 120), (226, 227, 224)
ORANGE, GREEN, RED = (233, 98, 10), (22, 128, 60), (190, 30, 30)


def as_rgb(image: npt.NDArray[Any]) -> Picture:
    """Turn a camera observation into a picture.

    Args:
        image: (H, W, 1 or 3), uint8, or float in [0, 1] where observations are normalised.

    Returns:
        uint8 (H, W, 3).
    """
    if image.dtype != np.uint8:
        image = np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3)))


def resize(image: Picture, side: int) -> Picture:
    """Scale a square picture: enlarged pixel by pixel, shrunk by averaging.

    Args:
        image: uint8 (H, H, 3).
        side: Side of the result (px).

    Returns:
        uint8 (side, side, 3).
    """
    from PIL import Image

    method = Image.Resampling.NEAREST if side >= image.shape[0] else Image.Resampling.BOX
    return np.asarray(Image.fromarray(image).resize((side, side), method))


def film_frame(
    env: "Environment",
    images: Mapping[str, npt.NDArray[Any]],
    *,
    reward_terms: Mapping[str, float],
    reward_sum: float,
) -> Picture:
    """Draw one frame of a film from an environment as it stands.

    Args:
        env: Just reset or stepped.
        images: Camera observations, ``eih`` and ``eth``; a missing one is left blank.
        reward_terms: This step's reward by term.
        reward_sum: Reward since the reset.

    Returns:
        uint8 (CELL_SIDE, CELL_SIDE + PANEL_WIDTH, 3).
    """
    from PIL import Image, ImageDraw

    frame = Image.new("RGB", (CELL_SIDE + PANEL_WIDTH, CELL_SIDE), PAPER)
    frame.paste(Image.fromarray(env.render(width=CELL_SIDE, height=CELL_SIDE)), (0, 0))
    panel = Image.new("RGB", (PANEL_WIDTH, CELL_SIDE), PAPER)
    draw = ImageDraw.Draw(panel)
    _draw_cameras(panel, draw, images)
    top = MARGIN + 20 + CAMERA_SIDE + MARGIN
    top = _draw_joints(draw, np.asarray(env.joint_positions), top)
    _draw_standing(draw, env.spec, env.info, top, reward_terms, reward_sum)
    frame.paste(panel, (CELL_SIDE, 0))
    return np.asarray(frame)


def film_episode(
    env: "Environment", policy: "Policy", scenario: int
) -> "tuple[Episode, list[Picture]]":
    """Play a scenario and draw a frame at its start and after every control step.

    Args:
        env: Left at the last step of the episode.
        policy: Chooses the actions.
        scenario: Index in the environment's split.

    Returns:
        The episode, and its frames.
    """
    filming = _Filming(env, policy)
    episode = run_episode(env, filming, scenario, filming.after_step)
    return episode, filming.frames


class _Filming:
    """A policy that draws a frame before its first action and after each one."""

    def __init__(self, env: "Environment", policy: "Policy") -> None:
        self.frames: list[Picture] = []
        self._env = env
        self._policy = policy
        self._reward_sum = 0.0

    def instruct(self, sentence: str) -> None:
        if isinstance(self._policy, Instructed):
            self._policy.instruct(sentence)

    def reset(self) -> None:
        self.frames = []
        self._reward_sum = 0.0
        self._policy.reset()

    def select_action(self, observation: "Observation") -> "Action":
        if not self.frames:
            self.frames.append(film_frame(self._env, observation, reward_terms={}, reward_sum=0.0))
        return self._policy.select_action(observation)

    def after_step(self, *step: Any) -> None:
        _, _, _, time_step, _ = step
        self._reward_sum += time_step.reward
        self.frames.append(
            film_frame(
                self._env,
                time_step.observation,
                reward_terms=self._env.task.reward_terms,
                reward_sum=self._reward_sum,
            )
        )


def write_film(path: Path, frames: Sequence[Picture], frames_per_second: float) -> None:
    """Write frames as MP4 or GIF, whichever the suffix says.

    Args:
        path: Ends in ``.mp4`` or ``.gif``.
        frames: uint8 (H, W, 3) each, H and W even.
        frames_per_second: Speed of the film; a GIF holds its last frame for two seconds.

    Raises:
        OutputError: Another suffix, or the file cannot be written.
    """
    check_film_suffix(path)
    with replacing(path) as temporary:
        if path.suffix.lower() == ".gif":
            _write_gif(temporary, frames, frames_per_second)
        else:
            _write_mp4(temporary, frames, frames_per_second)


def strip(rows: Mapping[str, Sequence[Picture]], times_s: Sequence[float]) -> "Image":
    """Lay pictures out in rows, evenly spaced in time.

    Args:
        rows: Title of each row to its pictures, all square and of one size.
        times_s: Time of each column (s); the first is not written.

    Returns:
        The sheet.
    """
    from PIL import Image, ImageDraw

    side = next(iter(rows.values()))[0].shape[0]
    pitch = side + STRIP_GAP
    size = (STRIP_GAP + len(times_s) * pitch, STRIP_GAP + len(rows) * (pitch + STRIP_TITLE))
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, (title, pictures) in enumerate(rows.items()):
        y = STRIP_GAP + row * (pitch + STRIP_TITLE)
        draw.text((STRIP_GAP, y), title, INK, font(13, bold=True))
        for column, (picture, time_s) in enumerate(zip(pictures, times_s, strict=True)):
            x = STRIP_GAP + column * pitch
            sheet.paste(Image.fromarray(picture), (x, y + STRIP_TITLE))
            # The first column's title stands where its time would.
            if column:
                draw.text((x + side, y + 1), f"{time_s:.1f} s", FAINT, font(12), anchor="ra")
    return sheet


def check_film_suffix(path: Path) -> None:
    """Refuse a file name whose suffix is not that of a film.

    Raises:
        OutputError: It ends neither in ``.mp4`` nor in ``.gif``.
    """
    if path.suffix.lower() not in FILM_SUFFIXES:
        raise OutputError(f"{path} must end in {' or '.join(FILM_SUFFIXES)}")


@functools.cache
def font(size: int, *, bold: bool = False) -> "FreeTypeFont":
    """DejaVu Sans, which Matplotlib brings along, so that pictures look the same everywhere."""
    import matplotlib as mpl
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / name), size)


def _draw_cameras(panel: Any, draw: "ImageDraw", images: Mapping[str, npt.NDArray[Any]]) -> None:
    """Both camera images side by side under their names."""
    from PIL import Image

    for column, (key, title) in enumerate((("eih", "eye in hand"), ("eth", "eye to hand"))):
        left, top = MARGIN + column * (CAMERA_SIDE + MARGIN), MARGIN + 20
        image = images.get(key)
        size = "" if image is None else f"  {image.shape[1]} px"
        draw.text((left, MARGIN - 4), title, INK, font(14, bold=True))
        draw.text((left + CAMERA_SIDE, MARGIN - 2), size.strip(), FAINT, font(12), anchor="ra")
        if image is None:
            draw.rectangle((left, top, left + CAMERA_SIDE, top + CAMERA_SIDE), TRACK)
        else:
            panel.paste(Image.fromarray(resize(as_rgb(image), CAMERA_SIDE)), (left, top))


def _draw_joints(draw: "ImageDraw", joints: npt.NDArray[np.float64], top: int) -> int:
    """Seven rows: name, place in the joint's range, angle. Returns where to go on below."""
    from hvs_suite.cell.robot import JOINT_NAMES, JOINT_RANGE_RAD

    for row, (name, angle, limit) in enumerate(
        zip(JOINT_NAMES, joints, JOINT_RANGE_RAD, strict=True)
    ):
        y = top + row * ROW_HEIGHT
        middle = BAR_LEFT + BAR_WIDTH // 2
        at = middle + round(float(np.clip(angle / limit, -1.0, 1.0)) * BAR_WIDTH / 2)
        bar_top = y + 5
        draw.text((MARGIN, y), name, INK, font(14, bold=True))
        draw.rectangle((BAR_LEFT, bar_top, BAR_LEFT + BAR_WIDTH, bar_top + BAR_HEIGHT), TRACK)
        draw.rectangle((min(middle, at), bar_top, max(middle, at), bar_top + BAR_HEIGHT), ORANGE)
        draw.text(
            (PANEL_WIDTH - MARGIN, y), f"{np.degrees(angle):+.1f}°", INK, font(14), anchor="ra"
        )
    return top + len(JOINT_NAMES) * ROW_HEIGHT + 6


def _draw_standing(
    draw: "ImageDraw",
    spec: "Spec",
    info: Mapping[str, Any],
    top: int,
    reward_terms: Mapping[str, float],
    reward_sum: float,
) -> None:
    """Step count, errors against their tolerances, reward, and how the episode ended."""
    rows: list[tuple[str, str, bool | None]] = [
        ("step", f"{info['steps']} of {spec.time_limit_steps}", None)
    ]
    for metric in spec.metrics:
        is_bounded_step = metric.over == "step" and metric.bound is not None
        if not is_bounded_step and (metric.over == "step" or metric.name not in spec.headline):
            continue
        error = info["errors"][metric.name]
        unit = "°" if metric.unit == "deg" else f" {metric.unit}".rstrip()
        text, good = f"{error:.2f}{unit}", None
        if metric.bound is not None:
            text, good = f"{text}  (≤ {metric.bound:g}{unit})", error <= metric.bound
        rows.append((metric.title.removesuffix(" error"), text, good))
    terms = ", ".join(f"{name} {value:+.2f}" for name, value in reward_terms.items() if value)
    rows.append(
        (
            "reward",
            f"{sum(reward_terms.values()):+.2f}"
            + (f"  ({terms})" if terms else "")
            + f", sum {reward_sum:+.2f}",
            None,
        )
    )
    widest = max(draw.textlength(label, font(14)) for label, _, _ in rows)
    left = MARGIN + max(80, round(widest) + 14)
    height = min(ROW_HEIGHT, (CELL_SIDE - MARGIN - top) // len(rows))
    for row, (label, text, good) in enumerate(rows):
        y = top + row * height
        draw.text((MARGIN, y), label, FAINT, font(14))
        colour = INK if good is None else (GREEN if good else RED)
        draw.text((left, y), text, colour, font(14))
    end = _ending(info)
    if end is not None:
        word, colour = end
        draw.text((PANEL_WIDTH - MARGIN, top), word, colour, font(15, bold=True), anchor="ra")


def _ending(info: Mapping[str, Any]) -> tuple[str, tuple[int, int, int]] | None:
    """How the episode has ended, and the colour to say it in; None while it goes on."""
    if info["is_success"]:
        return "success", GREEN
    if info["collision"]:
        return "overload" if info["overload"] else "collision", RED
    if info["truncated"]:
        return "time is up", RED
    return None


def _write_gif(path: Path, frames: Sequence[Picture], frames_per_second: float) -> None:
    """Write a looping GIF; every frame has a palette of its own, undithered."""
    from PIL import Image

    pictures = [
        Image.fromarray(frame).quantize(
            255, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
        )
        for frame in frames
    ]
    durations_ms = [round(1000 / frames_per_second)] * len(pictures)
    durations_ms[-1] = 2000
    pictures[0].save(
        path,
        save_all=True,
        append_images=pictures[1:],
        duration=durations_ms,
        loop=0,
        optimize=False,
    )


def _write_mp4(path: Path, frames: Sequence[Picture], frames_per_second: float) -> None:
    """Write H.264, which every browser plays."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=round(frames_per_second))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "18"}
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
