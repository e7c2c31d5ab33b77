"""The scripted expert: it knows the true state, and plans every control step from it alone.

It predicts the joints to the moment from which the action acts (tasks with latency) and commands
what the planner answers. It keeps no memory, so its action in a state does not depend on how the
arm got there, as DAgger needs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.cell import robot
from hvs_suite.datasets.insertion import GuardedInsertion
from hvs_suite.datasets.planner import CLEARANCE_M, Planner
from hvs_suite.errors import OptionError
from hvs_suite.rollout import Observation
from hvs_suite.tasks.shared.goal import Goal

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]


class Expert:
    """Answers with the best action for the environment's present state.

    Follows :class:`hvs_suite.rollout.Policy`; the observation is not looked at.

    Args:
        env: Where it acts.
        plain: As in `Planner`.
        clearance_m: As in `Planner`.

    Raises:
        OptionError: The environment's action mode is not ``joint_position``.
    """

    def __init__(
        self, env: Environment, *, plain: bool = False, clearance_m: float = CLEARANCE_M
    ) -> None:
        spec = env.spec
        if spec.action_mode != "joint_position":
            raise OptionError(
                f"The expert commands joint positions, not {spec.action_mode}: load the "
                "task with action_mode='joint_position'."
            )
        self._env = env
        self._planner = Planner(
            spec.control_period_s,
            plain=plain,
            embodiment=spec.embodiment,
            clearance_m=clearance_m,
        )
        self._insertion = GuardedInsertion(spec.control_period_s, spec.embodiment, plain=plain)
        self._period_s = spec.control_period_s
        self._delay_s = spec.latency_steps * spec.control_period_s

    def reset(self) -> None:
        """Nothing to forget: every decision depends on the present state alone."""

    def select_action(self, observation: Observation) -> npt.NDArray[np.float32]:
        """The expert's action (7,) in [-1, 1] for the environment's present state."""
        return self.label()

    def label(self) -> npt.NDArray[np.float32]:
        """The expert's action (7,) in [-1, 1] for the environment's present state."""
        env = self._env
        # The set points still queued move the arm before the action takes effect.
        q, velocity, set_point = robot.after_commands(
            env.joint_positions,
            env.joint_velocities,
            env.setpoint,
            env.pending_setpoints,
            self._period_s,
        )
        self._planner.avoid(env.obstacles)
        target = self._next_set_point(q, velocity, set_point)
        return np.asarray(env.commandable(target), dtype=np.float32)

    def _next_set_point(
        self, q: FloatArray, velocity: FloatArray, set_point: FloatArray
    ) -> FloatArray:
        """Where the set point (7,) shall be at the end of the control step that acts next."""
        goal = self._goal_in(0.0)
        if goal.standoff_m < 0.0:  # below the surface: there is a hole
            return self._insertion.next_set_point(q, velocity, set_point, goal)
        if not goal.velocity.any():
            return self._planner.next_set_point(q, velocity, goal)
        return self._planner.follow(q, velocity, set_point, self._goal_in)

    def _goal_in(self, ahead_s: float) -> Goal:
        """The goal some time (s) after the moment from which the action acts."""
        return self._env.goal(self._delay_s + ahead_s)


def make_expert(env: Environment) -> Expert:
    """The expert for an environment; a :data:`hvs_suite.rollout.PolicyFactory`."""
    return Expert(env)
