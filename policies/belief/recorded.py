"""What a recording says of each of its frames that a policy cannot see: what it is taught by."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hvs_suite.cell.robot import JOINT_RANGE_RAD, set_point_after
from hvs_suite.datasets.features import ACTION_EXECUTED, STATE
from hvs_suite.policies.belief.network import N_JOINTS
from hvs_suite.policies.training.dataset import (
    EPISODE,
    GOAL_NORMAL,
    GOAL_POSITION,
    GOAL_VELOCITY,
    TARGET_PREFIX,
)

Column = npt.NDArray[np.generic]


@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """The truth of n frames, or of windows of them, (...,) each.

    Attributes:
        set_point: Where the arm has been sent when the frame is seen, (..., 7) rad.
        goal_position: Of the tip at the goal, (..., 3) m.
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
    """Columns that `recorded` needs, but for the goal's velocity, which stands still without.

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
            episode in order; ``privileged.goal_velocity`` where there is one.
        cameras: Names of the policy's cameras.
        period_s: Control period (s).

    Returns:
        The truth of the n frames, float32.
    """
    goal = _tensor(columns[GOAL_POSITION])
    return Recorded(
        set_point=_tensor(set_points(columns, period_s)),
        goal_position=goal,
        goal_normal=_tensor(columns[GOAL_NORMAL]),
        goal_velocity=_tensor(columns[GOAL_VELOCITY])
        if GOAL_VELOCITY in columns
        else torch.zeros_like(goal),
        targets={name: _tensor(columns[TARGET_PREFIX + name]) for name in cameras},
    )


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
