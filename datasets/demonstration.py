"""One demonstration: a policy plays a scenario, and every frame of it is kept.

The worker that plays it prepares it for the disk: pictures as PNG files, their pixels counted,
numbers by column. One process writes for all workers, so its share of the work limits all of them.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from hvs_suite.cell.robot import JOINT_RANGE_RAD
from hvs_suite.datasets.episode_stats import Shades, picture_shades
from hvs_suite.datasets.features import (
    Frame,
    acted_part,
    dataset_features,
    image_key,
    observed_part,
)
from hvs_suite.datasets.png import encode
from hvs_suite.datasets.swaying import SwayingDemonstrator
from hvs_suite.registry import load
from hvs_suite.rollout import Policy, overrule, tell
from hvs_suite.tasks.shared.panels import PanelSpec

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment, Moment

NOISE_STREAM = "demonstration-noise"
NOISE_TIME_S = 0.3
"""Correlation time of the perturbation: long enough to lead the arm astray, not only shake it."""
NOISE_FULL_DISTANCE_M = 0.2
"""Distance to the goal from which on the perturbation has its full size (m)."""
NOISE_FLOOR = 0.02
"""Share of it that is left at the goal, so that the last millimetres are demonstrated as well; less
in proportion where the tolerance is below a millimetre, because an arm that is shaken by more than
that never arrives."""


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """One played scenario of n frames.

    Attributes:
        scenario: Index in the split.
        length: Control steps, one frame each.
        columns: The columns of :mod:`hvs_suite.datasets.features`: (n, k), or n PNG files.
        shades: Pixels of each column of pictures, counted.
        task: What was to be done, as a sentence.
        success: The goal was reached.
        collision: A forbidden contact ended it.
    """

    scenario: int
    length: int
    columns: dict[str, npt.NDArray[Any] | list[bytes]]
    shades: dict[str, Shades]
    task: str
    success: bool
    collision: bool

    @property
    def numbers(self) -> dict[str, npt.NDArray[Any]]:
        """The columns that hold no pictures."""
        return {k: v for k, v in self.columns.items() if isinstance(v, np.ndarray)}

    @property
    def picture_bytes(self) -> int:
        """Size of all PNG files."""
        columns = self.columns.values()
        return sum(sum(map(len, files)) for files in columns if isinstance(files, list))


@dataclasses.dataclass(frozen=True)
class MakeEnvironment:
    """Loads the task to record; travels to worker processes.

    Attributes:
        task: Registered name.
        split: Stream of scenarios.
        options: Options of the task.
    """

    task: str
    split: str
    options: Mapping[str, Any]

    def __call__(self) -> "Environment":
        """Loads it."""
        return load(self.task, split=self.split, **self.options)


@dataclasses.dataclass(frozen=True)
class Demonstrate:
    """Plays scenarios with a demonstrator; for :func:`hvs_suite.rollout.play`.

    Attributes:
        noise: Standard deviation of the perturbation of the executed joint targets, far from the
            goal (rad); 0 executes what the demonstrator says. With any, it also goes astray over
            surfaces of unknown slope, see `hvs_suite.datasets.swaying`.
        looks: Whether the demonstrator needs the pictures to decide.
    """

    noise: float
    looks: bool = False

    def __call__(self, env: "Environment", policy: Policy, scenario: int) -> Demonstration:
        """Plays one scenario to its end."""
        # The expert does not look, and drawing all pictures of an episode at once is faster.
        env.draws = self.looks
        time_step = env.reset(scenario=scenario)
        tell(policy, env)
        policy.reset()
        perturbation = _Perturbation(env, scenario, self.noise) if self.noise > 0.0 else None
        astray = None
        if perturbation is not None and isinstance(env.spec, PanelSpec) and not self.looks:
            astray = SwayingDemonstrator(env, scenario)
        frames: list[Frame] = []
        moments: list[Moment] = []
        while not time_step.last():
            frame = observed_part(env.spec, time_step.observation, env)
            moments.append(env.moment())
            action = policy.select_action(time_step.observation)
            if self.looks:
                # The expert keeps within the bounds by itself.
                action = np.clip(action, -1.0, 1.0).astype(np.float32)
            executed = action
            if perturbation is not None:
                if astray is not None and not astray.is_over:
                    executed = astray.label()
                executed = perturbation.apply(executed)
                overrule(policy, executed)
            time_step = env.step(executed)
            frame |= acted_part(
                action,
                executed,
                float(time_step.reward or 0.0),
                time_step.last(),
                env.info["is_success"],
            )
            frames.append(frame)
        if not self.looks:
            for camera, drawn in env.pictures(moments).items():
                for frame, picture in zip(frames, drawn, strict=True):
                    frame[image_key(camera)] = picture
        features = dataset_features(env.spec)
        return packed(scenario, frames, features, env.info, env.instruction)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Keeps OpenCV from sharing work that takes microseconds: handing it over takes longer."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def packed(
    scenario: int,
    frames: Sequence[Frame],
    features: Mapping[str, dict[str, Any]],
    info: Mapping[str, Any],
    task: str,
) -> Demonstration:
    """The frames of an episode by column, pictures encoded.

    Args:
        scenario: Index in the split.
        frames: One a control step.
        features: LeRobot's, in the order of the columns.
        info: Of the environment, at the end of the episode.
        task: What was to be done, as a sentence.
    """
    columns: dict[str, npt.NDArray[Any] | list[bytes]] = {}
    pictures: dict[str, list[npt.NDArray[np.uint8]]] = {}
    for name, feature in features.items():
        if feature["dtype"] == "image":
            pictures[name] = [frame[name] for frame in frames]
            columns[name] = encode(pictures[name])
        else:
            columns[name] = np.array([frame[name] for frame in frames])
    with _one_thread():
        shades = picture_shades(pictures)
    return Demonstration(
        scenario=scenario,
        length=len(frames),
        columns=columns,
        shades=shades,
        task=task,
        success=bool(info["is_success"]),
        collision=bool(info["collision"]),
    )


class _Perturbation:
    """An Ornstein-Uhlenbeck process on the joint targets that dwindles towards the goal.

    x[k+1] = rho x[k] + sqrt(1 - rho^2) n, rho = exp(-period / correlation time); what is added is
    noise * share * x, with share = distance / 0.2 m cut to [floor, 1] and floor = 0.02 times the
    task's tightest tolerance in mm, at most 0.02. The draws come from the scenario's own generator,
    so a demonstration depends on nothing but its index.
    """

    def __init__(self, env: "Environment", scenario: int, noise: float) -> None:
        self._env = env
        self._noise = noise
        self._random = env.task.source.generator(NOISE_STREAM, scenario)
        self._keep = math.exp(-env.spec.control_period_s / NOISE_TIME_S)
        self._floor = NOISE_FLOOR * min(1.0, env.spec.tightest_tolerance_mm)
        self._state = self._random.normal(size=len(JOINT_RANGE_RAD))

    def apply(self, action: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The action (7,) to execute instead; in [-1, 1]."""
        distance = self._env.distance_m
        share = min(1.0, max(self._floor, distance / NOISE_FULL_DISTANCE_M))
        added = self._noise * share * self._state / JOINT_RANGE_RAD
        fresh = self._random.normal(size=len(JOINT_RANGE_RAD))
        self._state = self._keep * self._state + math.sqrt(1.0 - self._keep**2) * fresh
        return np.clip(action + added, -1.0, 1.0).astype(np.float32)
