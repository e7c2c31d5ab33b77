"""The demonstrator: the expert, except that it looks for the target before it goes there.

The expert knows where the target is. A policy that learns from it does not, where the arm hides the
target from both cameras, and the mean of all ways to all places that it might be at leads nowhere.
So as long as no camera has seen the target, the demonstrator moves the arm out of the eye-to-hand
camera's line of sight, to the same posture whatever it knows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets.expert import CLEARANCE_M, Expert

if TYPE_CHECKING:
    from hvs_suite.cell.environment import Environment

FloatArray = npt.NDArray[np.float64]

LOOK_OUT_RAD: FloatArray = np.array([1.75, 0.8, 0.0, -0.6, 0.0, 0.6, 0.0])
"""Where the arm goes to look (rad), chosen for the fewest steps (docs/experiments/look-out.md)."""


class Demonstrator(Expert):
    """Answers with the action that a policy should learn; one episode at a time."""

    def __init__(self, env: Environment) -> None:
        super().__init__(env)
        self._has_seen = False

    def reset(self) -> None:
        """Forget that the target was seen: a new episode begins."""
        self._has_seen = False

    def _truth(self) -> Mapping[str, FloatArray]:
        if self._has_seen:
            # Looking for the target in both pictures takes the most of ``privileged``.
            scenario = self._env.scenario
            return {
                "goal_position": self._env.task.goal,
                "goal_normal": scenario.normal,
                "target_position": scenario.target,
            }
        truth = self._env.privileged()
        self._has_seen = any(truth[name][3] > 0.5 for name in ("target_eih", "target_eth"))
        return truth

    def _next_set_point(
        self, q: FloatArray, velocity: FloatArray, position: FloatArray, normal: FloatArray
    ) -> FloatArray:
        if not self._has_seen:
            motion = self._motion(q, velocity, LOOK_OUT_RAD, together=False)
            if self._least_clearance(motion, CLEARANCE_M) >= CLEARANCE_M:
                return self._point_ahead(motion)
        return super()._next_set_point(q, velocity, position, normal)


def make_demonstrator(env: Environment) -> Demonstrator:
    """The demonstrator for an environment; a :data:`hvs_suite.rollout.PolicyFactory`."""
    return Demonstrator(env)
