"""A demonstrator that goes astray over a surface of unknown slope, for its eyes' sake.

One that always arrives facing the target teaches an eye that a target which looks so near faces it,
whatever is seen (docs/experiments/belief.md). So for a time the arm goes to a goal that sways about
the true one, and is told at every step what leads to the true one.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets.leaning import axes_across
from hvs_suite.datasets.looking import Demonstrator
from hvs_suite.tasks.shared.goal import Goal

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

SWAY_STREAM = "demonstration-sway"
SWAY_RAD = math.radians(3.0)
SWAY_M = 0.003
"""Standard deviations of what is added to the goal: leaning to either side (rad), and its place
along each axis (m). An eye that errs by a degree meets leans of some degrees."""
SWAY_TIME_S = 0.4
"""Correlation time: long enough for the arm to follow."""
SWAY_SHARE = 0.8
"""It sways until at most this share of the time is up, drawn for each scene: most still arrive."""


class SwayingDemonstrator(Demonstrator):
    """Goes where the goal sways to, in one scene of a surface task.

    Args:
        env: Where it acts, with the scene begun.
        scenario: Index of the scene, which decides how the goal sways.
    """

    def __init__(self, env: Environment, scenario: int) -> None:
        super().__init__(env)
        self._random = env.task.source.generator(SWAY_STREAM, scenario)
        self._keep = math.exp(-self._period_s / SWAY_TIME_S)
        self._state = self._random.normal(size=5)
        self._steps_left = int(SWAY_SHARE * env.spec.time_limit_steps * self._random.uniform())

    @property
    def is_over(self) -> bool:
        """Whether the goal does not sway any more."""
        return self._steps_left <= 0

    def label(self) -> npt.NDArray[np.float32]:
        """The action (7,) that leads astray; the goal then sways on."""
        action = super().label()
        fresh = self._random.normal(size=5)
        self._state = self._keep * self._state + math.sqrt(1.0 - self._keep**2) * fresh
        self._steps_left -= 1
        return action

    def _goal_in(self, ahead_s: float) -> Goal:
        goal = super()._goal_in(ahead_s)
        x, y = axes_across(goal.normal)
        lean = np.tan(SWAY_RAD * self._state[:2])
        normal = goal.normal + lean[0] * x + lean[1] * y
        return dataclasses.replace(
            goal,
            target=goal.target + SWAY_M * self._state[2:],
            normal=normal / np.linalg.norm(normal),
        )
