"""DAgger: the policy plays, a teacher says at every step what it would have done instead.

Cloning shows the policy only states of the demonstrator's episodes, but small errors of the policy
soon lead to other states. Frames of the policy's own episodes, labelled by the teacher, fix that
(Ross, Gordon and Bagnell, 2011: https://arxiv.org/abs/1011.0686).

The teacher is the demonstrator, unless one asks for another: the expert, which knows even what
nobody can see, or ``servo``, which knows no more than the policy.
"""

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets.demonstration import MakeEnvironment
from hvs_suite.datasets.expert import make_expert
from hvs_suite.datasets.features import ACTION, ACTION_EXECUTED, IMAGES, Frame, observed_part
from hvs_suite.datasets.looking import make_demonstrator
from hvs_suite.datasets.png import encode
from hvs_suite.datasets.recorder import in_order
from hvs_suite.errors import DatasetError, OutputError
from hvs_suite.executor import Workers
from hvs_suite.policies.checkpoints.loading import CheckpointFactory
from hvs_suite.policies.imitation.demonstrations import Recording
from hvs_suite.policies.imitation.frame_cache import new_frames, open_frames
from hvs_suite.policies.servo import make_servo
from hvs_suite.policies.training.dataset import Manifest
from hvs_suite.reading import decode_png
from hvs_suite.rollout import Policy, PolicyFactory, overrule, play, tell

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FIRST_SHARE = 0.35
LAST_SHARE = 0.80
"""The rounds are spread over this part of the training: before, the policy errs anyhow; after, no
time would be left to learn from them."""
TeacherName = Literal["demonstrator", "expert", "servo"]
TEACHERS: Mapping[TeacherName, PolicyFactory] = {
    "demonstrator": make_demonstrator,
    "expert": make_expert,
    "servo": make_servo,
}
"""Who can label frames."""
COLUMNS = "columns.npz"
SUMMARY = "round.json"


def round_shares(rounds: int) -> list[float]:
    """At which part of the training each round is played.

    Args:
        rounds: How many.

    Returns:
        Shares of the training budget, rising, (rounds,).
    """
    return [float(share) for share in np.linspace(FIRST_SHARE, LAST_SHARE, max(rounds, 2))[:rounds]]


@dataclasses.dataclass(frozen=True)
class PlayedEpisode:
    """An episode that the policy played.

    Attributes:
        scenario: Index in the split.
        frames: One a control step, pictures left out, with the teacher's ``action``.
        pictures: PNG files of each camera's feature, one a frame: they may come from far away.
        success: The goal was reached.
        collision: A forbidden contact ended it.
    """

    scenario: int
    frames: list[Frame]
    pictures: Mapping[str, list[bytes]]
    success: bool
    collision: bool


@dataclasses.dataclass(frozen=True)
class Correct:
    """Plays scenarios with the policy and labels each frame; for :func:`hvs_suite.rollout.play`.

    Attributes:
        teacher: One of `TEACHERS`.
    """

    teacher: TeacherName = "demonstrator"

    def __call__(self, env: "Environment", policy: Policy, scenario: int) -> PlayedEpisode:
        """Plays one scenario to its end."""
        teacher = TEACHERS[self.teacher](env)
        time_step = env.reset(scenario=scenario)
        for each in (policy, teacher):
            tell(each, env)
            each.reset()
        frames: list[Frame] = []
        while not time_step.last():
            seen = time_step.observation
            frame = observed_part(env.spec, seen, env)
            frame[ACTION] = teacher.select_action(seen)
            action = np.clip(policy.select_action(seen), -1.0, 1.0).astype(np.float32)
            overrule(teacher, action)
            frames.append(frame | {ACTION_EXECUTED: action})
            time_step = env.step(action)
        cameras = [key for key in frames[0] if key.startswith(IMAGES)]
        pictures = {key: encode([frame.pop(key) for frame in frames]) for key in cameras}
        info = env.info
        return PlayedEpisode(scenario, frames, pictures, info["is_success"], info["collision"])


@dataclasses.dataclass(frozen=True)
class RoundSummary:
    """What a round came to.

    Attributes:
        frames: Frames kept.
        episodes: Episodes played.
        successes: Those that reached the goal.
        collisions: Those that ended in a forbidden contact.
        first_scenario: Index of the first, in the dataset's split.
        next_scenario: Where the next round goes on.
    """

    frames: int
    episodes: int
    successes: int
    collisions: int
    first_scenario: int
    next_scenario: int


def play_round(
    manifest: Manifest,
    checkpoint: Path,
    folder: Path,
    *,
    frames: int,
    first_scenario: int,
    workers: Workers,
    teacher: TeacherName = "demonstrator",
    on_frames: Callable[[int], None] | None = None,
) -> RoundSummary:
    """Play scenarios until enough frames are there, and keep them on disk.

    Args:
        manifest: Of the dataset: task, split, options and columns are the same.
        checkpoint: The policy that plays.
        folder: Gets the round, whole or not at all.
        frames: How many to keep.
        first_scenario: Index to begin with; give one that the dataset does not hold.
        workers: Processes that play, or others elsewhere. The result is the same with any of them.
        teacher: Who labels the frames, one of `TEACHERS`.
        on_frames: Called with the number of frames just kept.

    Returns:
        What the round came to.

    Raises:
        OutputError: The folder cannot be written.
    """
    scratch = folder.with_name(f".{folder.name}")
    keys = {key: manifest.features[key] for key in manifest.trained_keys}
    played = play(
        MakeEnvironment(manifest.task, manifest.split, dict(manifest.options)),
        CheckpointFactory(str(checkpoint.resolve())),
        # No episode is without a frame, so these are enough.
        range(first_scenario, first_scenario + frames),
        Correct(teacher),
        workers=workers,
    )
    try:
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(parents=True)
        store = _Store(scratch, keys, frames)
        episodes = successes = collisions = 0
        with contextlib.closing(played):
            for episode in in_order(played, first_scenario):
                kept = store.append(episode, first_scenario + episodes)
                episodes += 1
                successes += episode.success
                collisions += episode.collision
                if on_frames is not None:
                    on_frames(kept)
                if store.is_full:
                    break
        store.close()
        summary = RoundSummary(
            frames, episodes, successes, collisions, first_scenario, first_scenario + episodes
        )
        (scratch / SUMMARY).write_text(json.dumps(dataclasses.asdict(summary), indent=2) + "\n")
        scratch.replace(folder)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}") from error
    return summary


def read_round(folder: Path) -> tuple[RoundSummary, Recording] | None:
    """Open a round.

    Args:
        folder: That `play_round` wrote.

    Returns:
        What it came to and its frames, memory-mapped; None if it was not played.
    """
    if not (folder / SUMMARY).exists():
        return None
    summary = RoundSummary(**json.loads((folder / SUMMARY).read_text()))
    with np.load(folder / COLUMNS, allow_pickle=False) as file:
        columns = dict(file)
    images = {path.stem: open_frames(path) for path in sorted(folder.glob(f"{IMAGES}*.npy"))}
    return summary, Recording(columns, images)


class _Store:
    """Frames on disk: images memory-mapped, numbers in memory until the end."""

    def __init__(self, folder: Path, keys: Mapping[str, Mapping[str, Any]], frames: int) -> None:
        self._folder = folder
        self._frames = frames
        self._filled = 0
        self._episodes = np.zeros(frames, np.int64)
        self._images: dict[str, Any] = {}
        self._columns: dict[str, npt.NDArray[np.float32]] = {}
        for key, feature in keys.items():
            shape = (frames, *feature["shape"])
            if key.startswith(IMAGES):
                self._images[key] = new_frames(folder / f"{key}.npy", shape)
            else:
                self._columns[key] = np.zeros(shape, np.float32)

    @property
    def is_full(self) -> bool:
        return self._filled == self._frames

    def append(self, played: PlayedEpisode, episode: int) -> int:
        """Keep the frames that still fit; their number."""
        kept = min(len(played.frames), self._frames - self._filled)
        rows = slice(self._filled, self._filled + kept)
        for key, images in self._images.items():
            for row, content in enumerate(played.pictures[key][:kept], self._filled):
                images[row] = decode_png(content, images.shape[1:], error=DatasetError)
        for key, column in self._columns.items():
            column[rows] = [frame[key] for frame in played.frames[:kept]]
        self._episodes[rows] = episode
        self._filled += kept
        return kept

    def close(self) -> None:
        for image in self._images.values():
            image.flush()
        np.savez(self._folder / COLUMNS, episode_index=self._episodes, **self._columns)  # type: ignore[arg-type]
