"""The demonstrator: the expert, except that it looks for the target before it goes there.

The expert knows where the target is. A policy that learns from it does not, where the arm hides the
target from both cameras, and the mean of all ways to all places that it might be at leads nowhere.
So as long as no camera has seen the target, the demonstrator moves the arm out of the eye-to-hand
camera's line of sight, to the same posture whatever it knows.

Where the eye-to-hand camera stands a little elsewhere than it should, it says only within some
centimetres where the target is. Who goes there at once ends up beside it, too low for the eye in
the hand to see it. So until the eye in the hand has seen the target, the demonstrator heads for a
place above it, from which it will.

And where the arm may start anywhere, it goes there in one of two postures, the elbow straight above
the line from shoulder to wrist, A1 towards the target or away from it: the one whose slowest joint
arrives first at full speed. The expert chooses the soonest of some two thousand, and which that is
jumps with every little change of where the arm stands: nobody could learn it
(docs/experiments/simple-ways.md). Two postures cost three steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.robot import JOINT_SPEED_RAD_S
from hvs_suite.datasets.expert import CLEARANCE_M, Expert
from hvs_suite.registry import TASKS

if TYPE_CHECKING:
    from hvs_suite.cell.environment import Environment

FloatArray = npt.NDArray[np.float64]

LOOK_OUT_RAD: FloatArray = np.array([1.75, 0.8, 0.0, -0.6, 0.0, 0.6, 0.0])
"""Where the arm goes to look (rad), chosen for the fewest steps (docs/experiments/look-out.md)."""


PLAIN_SWIVELS = 1
"""The elbow straight above: two postures within reach, as a rule."""
LOOK_DOWN_M = 0.15
"""How far above the goal the eye in the hand looks for the target (m): high enough to have it in
view wherever the eye-to-hand camera may take it to be, and hardly a detour."""


class Demonstrator(Expert):
    """Answers with the action that a policy should learn; one episode at a time."""

    def __init__(self, env: Environment) -> None:
        super().__init__(env)
        variant = env.variant
        named = TASKS.get(variant.name)
        starts = {variant.start, named.start if named is not None else variant.start}
        self._is_plain = "random" in starts
        if self._is_plain:
            self.n_swivel = PLAIN_SWIVELS
        self._looks_down = variant.eth_position_noise_m > 0 or variant.eth_rotation_noise_deg > 0
        self.reset()

    def reset(self) -> None:
        """Forget that the target was seen: a new episode begins."""
        self._has_seen = False
        self._has_seen_closely = not self._looks_down

    def _truth(self) -> Mapping[str, FloatArray]:
        if self._has_seen and self._has_seen_closely:
            # Looking for the target in both pictures takes the most of ``privileged``.
            scenario = self._env.scenario
            return {
                "goal_position": self._env.task.goal,
                "goal_normal": scenario.normal,
                "target_position": scenario.target,
            }
        truth = self._env.privileged()
        in_hand, afar = (truth[name][3] > 0.5 for name in ("target_eih", "target_eth"))
        self._has_seen = self._has_seen or bool(in_hand or afar)
        self._has_seen_closely = self._has_seen_closely or bool(in_hand)
        if not self._has_seen_closely:
            raised = truth["goal_position"] + LOOK_DOWN_M * truth["goal_normal"]
            return {**truth, "goal_position": raised}
        return truth

    def _in_order(
        self, q: FloatArray, velocity: FloatArray, family: FloatArray
    ) -> Iterator[FloatArray]:
        if not self._is_plain:
            return super()._in_order(q, velocity, family)
        times = (np.abs(family - q) / JOINT_SPEED_RAD_S)[:, :6].max(axis=1)
        return iter(family[np.argsort(times, kind="stable")])

    def _nearest_goal(
        self, rest: FloatArray, position: FloatArray, normal: FloatArray
    ) -> FloatArray | None:
        # Beside the two, it would be another goal for every place that the arm comes from.
        return None if self._is_plain else super()._nearest_goal(rest, position, normal)

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
