"""``servo`` for a target that moves: a Kalman filter, and an arm that aims ahead.

What a picture shows is where the target is now; where the arm will be then follows from its lag and
from the latency that it notices. So it heads for where the target will be when a command acts.
"""

import numpy as np
import numpy.typing as npt

from hvs_suite.policies.servo.motion_estimate import MotionEstimate
from hvs_suite.policies.servo.still_target import StillTargetServo, facing_down, within_reach
from hvs_suite.rollout import Observation
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.track import TrackSpec

FloatArray = npt.NDArray[np.float64]

_UNFORESEEN = 0.25
"""Share of a curve's jerk that an oscillation at the pace of its bounds does not explain."""
_MAX_HEIGHT_M = 0.30


class MovingTargetServo(StillTargetServo):
    """Servoes a moving target; follows :class:`hvs_suite.rollout.Policy`.

    Args:
        spec: The task's parameters.

    Raises:
        PolicyError: The task needs what this method does not do.
    """

    def __init__(self, spec: TrackSpec) -> None:
        self._spec = spec
        super().__init__(spec)

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self._motion = self._new_motion()

    def _new_motion(self) -> MotionEstimate:
        spec, speed = self._spec, self._spec.speed_m_s[1]
        acceleration = spec.acceleration_m_s2 if spec.motion == "curve" else 0.0
        pace = acceleration / speed
        jerk = _UNFORESEEN * pace * acceleration
        return MotionEstimate(self._eth_sigma_m, speed, acceleration, pace, jerk)

    def _perceive(self, observation: Observation, q: FloatArray) -> None:
        """Take in both pictures."""
        self._motion.pass_time(self._spec.control_period_s)
        R, p = self._kinematics.flange_pose(q)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ p
        if self._has_eth:
            seen = self._sighting(observation["eth"], self._eth_K, self._eth_T)
            if seen is not None:
                self._motion.see_eth(seen)
        if self._has_eih:
            seen = self._sighting(observation["eih"], self._eih_K, T)
            if seen is not None:
                self._misses = 0
                self._motion.see_eih(seen)
            elif self._motion.is_known and self._should_be_seen(T, self._motion.place()[0]):
                self._misses += 1
                if self._misses > self.max_misses:
                    self._motion, self._misses = self._new_motion(), 0
        if not self._motion.is_known:
            # Where nothing is now, the target may be soon: only the present pictures count.
            self._search.reset()
            self._rule_out(q, T)

    def _next_set_point(self, q: FloatArray) -> FloatArray:
        """Where the set point (7,) shall be at the end of the control step."""
        if not self._motion.is_known:
            return super()._next_set_point(q)
        angles, speeds, set_point = self._belief.when_action_acts()
        delay_s = self._belief.latency_steps * self._spec.control_period_s
        return self._planner.follow(
            angles, speeds, set_point, lambda ahead_s: self._goal_in(delay_s + ahead_s)
        )

    def _goal_in(self, ahead_s: float) -> Goal:
        """The goal some time from now; higher where it is not sure enough to be in view."""
        _, sigma = self._motion.place()
        place, _ = self._motion.place(ahead_s)
        height = min(self._height_to_see(sigma), _MAX_HEIGHT_M)
        goal = facing_down(within_reach(np.array([*place, height])))
        velocity = np.append(self._motion.velocity(ahead_s), 0.0)
        return Goal(goal.target, goal.normal, goal.standoff_m, velocity)
