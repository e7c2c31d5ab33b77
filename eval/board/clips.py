"""A clip of a success and of a failure of each entry, drawn from its action log.

There is none of ``random``, from which nobody learns anything, nor of ``zero``, which stands still.

Clips are animated AVIF: a picture to the page, so it plays from a file, on a phone, inside the
page, without a player (iOS does not play a video out of a ``data:`` address). Browsers have had it
since Chrome 85, Firefox 113 and Safari 16.4. At 360 x 220 px one takes about 12 kB (WebP of the
same look: 30 kB, GIF: 150 kB and more), so the 96 of 6 tasks x 8 policies make 1.6 MB of a page and
can stand inside it: it is one file, which can be sent and hosted anywhere.

They are kept as ``clips/<policy>/<task>.<kind>.<key>.avif`` beside the page, the key being what
they show: a build draws only what is missing, and a machine with another renderer, or none, builds
the same page. Delete one to have it drawn again.
"""

import contextlib
import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from hvs_suite import files, reading, registry
from hvs_suite.errors import OutputError, ResultError
from hvs_suite.eval.board.submission import Submission
from hvs_suite.eval.protocol import UNWATCHED
from hvs_suite.eval.scoring import action_log, result_file, trial
from hvs_suite.eval.scoring.result_file import EpisodeRow, Result
from hvs_suite.rollout import Action, Observation

if TYPE_CHECKING:
    from PIL.Image import Image

    from hvs_suite.tasks.shared.environment import Environment

FOLDER: Final = "clips"
Kind = Literal["success", "failure"]
_NOT_DRAWN: Final = UNWATCHED, "zero"

# Raised when clips are drawn otherwise than before: their names, and so all of them, change.
_STYLE: Final = 1
# Layout (px): the cell, cut out of a larger picture whose rim is empty, and both cameras beside it.
_DRAWN: Final = (290, 236)
_CUT: Final = (15, 16, 275, 216)
_CAMERA: Final = 100
_STRIP: Final = 20
SIZE: Final = (_CUT[2] - _CUT[0] + _CAMERA, 2 * _CAMERA + _STRIP)
_QUALITY: Final = 45
_LAST_FRAME_MS: Final = 1500
# Twenty times the usual; all of them become part of one page.
_MOST_BYTES: Final = 2**18
_DARK, _LIGHT = (28, 31, 36), (236, 234, 230)


@dataclasses.dataclass(frozen=True)
class Clip:
    """A clip of one scenario.

    Attributes:
        kind: Whether it shows a success or a failure.
        row: What happened.
        avif: The animation.
    """

    kind: Kind
    row: EpisodeRow
    avif: bytes


@dataclasses.dataclass(frozen=True)
class _Order:
    """A clip that is wanted.

    Attributes:
        submission: The result it belongs to.
        kind: Whether it shows a success or a failure.
        row: What happened.
        path: Where it is kept.
    """

    submission: Submission
    kind: Kind
    row: EpisodeRow
    path: Path


def choose(result: Result) -> list[tuple[Kind, EpisodeRow]]:
    """Returns the typical success and the typical failure of a result, as far as it has them.

    The typical one is the median: of successes by their steps, of failures by where they ended. The
    best or the worst would mislead. Clips are drawn from the action log, so the median is taken
    over the scenarios that it holds.
    """
    rows = result.episodes[: result.metadata.n_logged]
    headline = registry.find(result.summary.task).headline[0]
    won = sorted((r for r in rows if r.success), key=lambda r: (r.steps, r.scenario))
    lost = sorted(
        (r for r in rows if not r.success),
        key=lambda r: (r.settled.errors[headline], r.scenario),
    )
    chosen: list[tuple[Kind, EpisodeRow]] = []
    if won:
        chosen.append(("success", won[(len(won) - 1) // 2]))
    if lost:
        chosen.append(("failure", lost[(len(lost) - 1) // 2]))
    return chosen


def clips(
    submissions: Sequence[Submission],
    folder: Path,
    say: Callable[[str], None] = lambda line: None,
) -> dict[tuple[str, str], list[Clip]]:
    """Returns the clips of each result, drawing those that the folder does not hold.

    Args:
        submissions: Checked results.
        folder: Keeps the clips; those that belong to none of the results are removed.
        say: Told about each that is drawn.

    Returns:
        Clips by (policy, task), the success first.

    Raises:
        OutputError: A clip cannot be written, or there is a symbolic link in the folder.
        RenderError: Something is to be drawn and nothing here can.
        ResultError: A clip that is there is no ordinary file, or is too large for a clip.
    """
    _refuse_links(folder)
    orders = [
        _Order(entry, kind, row, _path(folder, entry, kind, row))
        for entry in submissions
        if entry.result.summary.policy not in _NOT_DRAWN
        for kind, row in choose(entry.result)
    ]
    missing = [order for order in orders if not order.path.exists()]
    for task in dict.fromkeys(order.submission.result.summary.task for order in missing):
        wanted = [order for order in missing if order.submission.result.summary.task == task]
        split = wanted[0].submission.result.summary.split
        # Clips are drawn for people, so what the policy sees need not be drawn too.
        with contextlib.closing(registry.load(task, split=split, observations="state")) as env:
            for order in wanted:
                say(f"drawing {order.path.relative_to(folder)}")
                _draw(env, order)
    _remove_all_but({order.path for order in orders}, folder)
    found: dict[tuple[str, str], list[Clip]] = {}
    for order in orders:
        name = (order.submission.path.parent.name, order.submission.path.stem)
        film = reading.read_bytes(order.path, most=_MOST_BYTES, error=ResultError, within=folder)
        found.setdefault(name, []).append(Clip(order.kind, order.row, film))
    return found


def _path(folder: Path, entry: Submission, kind: Kind, row: EpisodeRow) -> Path:
    metadata = entry.result.metadata
    shown = f"{_STYLE} {metadata.task_digest} {metadata.actions_sha256} {row.scenario}"
    key = hashlib.sha256(shown.encode()).hexdigest()[:12]
    return folder / entry.path.parent.name / f"{entry.path.stem}.{kind}.{key}.avif"


def _draw(env: "Environment", order: _Order) -> None:
    """Plays the logged actions and writes a frame at the start and after each of them."""
    log = action_log.load(
        result_file.actions_path(order.submission.path),
        order.submission.result.metadata.actions_sha256,
    )
    remaining = iter(log[order.row.scenario])
    frames: list[Image] = []

    def decide(_: Observation) -> Action:
        frames.append(_frame(env))
        action = next(remaining, None)
        if action is None:
            raise trial.EpisodeLostError(order.row.settled.failure or "the action log ends")
        return np.asarray(action)

    trial.play_trial(env, lambda: None, decide, order.row.scenario)
    frames.append(_frame(env))
    frame_ms = round(1000 * env.spec.control_period_s)
    with files.replacing(order.path) as temporary:
        frames[0].save(
            temporary,
            format="AVIF",
            save_all=True,
            append_images=frames[1:],
            duration=[frame_ms] * (len(frames) - 1) + [_LAST_FRAME_MS],
            quality=_QUALITY,
            # One thread: the same frames give the same bytes.
            max_threads=1,
        )


def _frame(env: "Environment") -> "Image":
    """The cell, what the cameras look at, and a line of figures."""
    from PIL import Image, ImageDraw

    from hvs_suite.pictures import font

    frame = Image.new("RGB", SIZE, _DARK)
    width, height = _DRAWN
    frame.paste(Image.fromarray(env.render(width=width, height=height)).crop(_CUT), (0, 0))
    for row, camera in enumerate(("eih", "eth")):
        image = env.render(width=_CAMERA, height=_CAMERA, camera=camera)
        frame.paste(Image.fromarray(image), (SIZE[0] - _CAMERA, row * _CAMERA))
    info = env.info
    shown = [metric for metric in env.spec.metrics if metric.name in env.spec.headline]
    figures = (
        f"{info['steps'] * env.spec.control_period_s:.1f} s",
        *(f"{info['errors'][metric.name]:.2f} {metric.unit}".rstrip() for metric in shown),
    )
    draw = ImageDraw.Draw(frame)
    for text, right in zip(figures, (44, 180, 300), strict=False):
        # Flush right: digits that change stay in their places.
        draw.text((right, SIZE[1] - _STRIP + 3), text, _LIGHT, font(12), anchor="ra")
    return frame


def _refuse_links(folder: Path) -> None:
    """Raises OutputError where writing or removing would go through a link to somewhere else."""
    for path in (folder, *sorted(folder.glob("*")), *sorted(folder.glob("*/*"))):
        if path.is_symlink():
            raise OutputError(f"{path} is a symbolic link; remove it, clips are kept in place")


def _remove_all_but(kept: set[Path], folder: Path) -> None:
    for path in sorted(folder.glob("*/*.avif")):
        if path not in kept:
            path.unlink()
            with contextlib.suppress(OSError):
                path.parent.rmdir()
