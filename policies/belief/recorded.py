"""What a recording says of each of its frames that a policy cannot see: what it is taught by."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hvs_suite.cell.robot import JOINT_RANGE_RAD, set_point_after
from hvs_suite.datasets.features import ACTION_EXECUTED, STATE
from hvs_suite.policies.belief.geometry import flange_motion
from hvs_suite.policies.belief.network import N_JOINTS
from hvs_suite.policies.training.dataset import (
    EPISODE,
    GOAL_NORMAL,
    GOAL_POSITION,
    GOAL_UNSEEN,
    GOAL_VELOCITY,
    JOINT_OFFSET,
    TARGET_PREFIX,
)

Column = npt.NDArray[np.generic]


@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """The truth of n frames, or of windows of them, (...,) each.

    Attributes:
        set_point: Where the arm has been sent when the frame is seen, (..., 7) rad.
        goal_position: Of the tip at the goal, as the encoders show it, (..., 3) m.
        goal_normal: Unit normal there, (..., 3).
        goal_velocity: (..., 3) m/s.
        targets: Camera name to u, v, apparent diameter in image widths and 1 where it can be seen,
            (..., 4).
    """

    set_point: Tensor
    goal_position: Tensor
    goal_normal: Tensor
    goal_velocity: Tensor
    targets: Mapping[str, Tensor]

    def at(self, rows: Tensor) -> "Recorded":
        """The truth of some frames.

        Args:
            rows: Their numbers, of any shape, or which of them, of the shape that there is.
        """
        return Recorded(
            self.set_point[rows],
            self.goal_position[rows],
            self.goal_normal[rows],
            self.goal_velocity[rows],
            {name: target[rows] for name, target in self.targets.items()},
        )

    def to(self, device: torch.device) -> "Recorded":
        """The same on a device."""
        return Recorded(
            self.set_point.to(device),
            self.goal_position.to(device),
            self.goal_normal.to(device),
            self.goal_velocity.to(device),
            {name: target.to(device) for name, target in self.targets.items()},
        )


def recorded_keys(cameras: tuple[str, ...]) -> list[str]:
    """Columns that `recorded` needs, whatever the task; `FURTHER_KEYS` says what else it reads.

    Args:
        cameras: Names of the policy's cameras.
    """
    return [
        STATE,
        ACTION_EXECUTED,
        GOAL_POSITION,
        GOAL_NORMAL,
        *(TARGET_PREFIX + name for name in cameras),
    ]


def recorded(columns: Mapping[str, Column], cameras: tuple[str, ...], period_s: float) -> Recorded:
    """What the columns of a dataset say of its frames.

    Args:
        columns: Those of `recorded_keys` and ``episode_index``, (n, ...) each, the frames of an
            episode in order; those of `FURTHER_KEYS` that there are.
        cameras: Names of the policy's cameras.
        period_s: Control period (s).

    Returns:
        The truth of the n frames, float32.
    """
    goal, normal = (_tensor(part) for part in shown_goals(columns))
    return Recorded(
        set_point=_tensor(set_points(columns, period_s)),
        goal_position=goal,
        goal_normal=normal,
        goal_velocity=_tensor(columns[GOAL_VELOCITY])
        if GOAL_VELOCITY in columns
        else torch.zeros_like(goal),
        targets={name: _tensor(columns[TARGET_PREFIX + name]) for name in cameras},
    )


def shown_goals(
    columns: Mapping[str, Column],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The goals where a robot that believes its encoders sees them.

    With zero errors of the encoders, the flange is elsewhere than the measured joints say, and all
    that the eye in the hand sees is off with it. The arm is sent in the same wrong angles. So what
    a policy can see, and where it has to go, is the goal as it lies by the true flange, put by the
    flange that the encoders show: with T the pose of the flange, T(shown) T(true)^-1 goal. Where
    no picture shows how far the goal is off, it is where the pictures show it.

    Args:
        columns: State, goal and normal, (n, ...) each; if there are any,
            ``privileged.joint_offset`` (n, 7) rad, measured less true angles, and
            ``privileged.goal_unseen`` (n, 3) m.

    Returns:
        Goals (n, 3) m and unit normals (n, 3).
    """
    goal, normal = (np.asarray(columns[key], np.float64) for key in (GOAL_POSITION, GOAL_NORMAL))
    if GOAL_UNSEEN in columns:
        goal = goal - np.asarray(columns[GOAL_UNSEEN], np.float64)
    if JOINT_OFFSET not in columns:
        return goal, normal
    q = np.asarray(columns[STATE], np.float64)[:, :N_JOINTS]
    shown = flange_motion(torch.from_numpy(q))
    true = flange_motion(torch.from_numpy(q - np.asarray(columns[JOINT_OFFSET], np.float64)))
    turn = (shown.rotation @ true.rotation.transpose(1, 2)).numpy()
    offset = goal - true.position.numpy()
    position = shown.position.numpy() + np.einsum("nij,nj->ni", turn, offset)
    return position, np.einsum("nij,nj->ni", turn, normal)


def set_points(columns: Mapping[str, Column], period_s: float) -> npt.NDArray[np.float64]:
    """The set point that all actions before each frame lead to.

    Args:
        columns: State, executed actions and ``episode_index``, (n, ...) each.
        period_s: Control period (s).

    Returns:
        (n, 7) rad; the measured positions where an episode begins.
    """
    episodes = np.asarray(columns[EPISODE])
    frames = np.arange(len(episodes))
    first = np.maximum.accumulate(
        np.where(np.append(True, episodes[1:] != episodes[:-1]), frames, 0)
    )
    points = np.asarray(columns[STATE], np.float64)[:, :N_JOINTS].copy()
    asked = np.asarray(columns[ACTION_EXECUTED], np.float64) * JOINT_RANGE_RAD
    number = frames - first
    for k in range(1, int(number.max(initial=0)) + 1):
        now = np.flatnonzero(number == k)
        points[now] = set_point_after(points[now - 1], asked[now - 1], period_s)
    return points


def _tensor(column: Column) -> Tensor:
    return torch.from_numpy(np.asarray(column, np.float32))
