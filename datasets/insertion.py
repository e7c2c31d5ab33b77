"""Ways of a peg into a hole: over it by the planner, then straight down its axis, guarded.

The arm is compliant and trails its set point by more than a control step, so ways are planned for
the set point, which the controller follows exactly, and the arm is waited for where it matters:
before the tip enters the mouth.
"""

import dataclasses

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import away_from_stops, kinematics
from hvs_suite.cell.robot import JOINT_ACCELERATION_RAD_S2, JOINT_RANGE_RAD
from hvs_suite.datasets.planner import Planner
from hvs_suite.embodiment import Embodiment
from hvs_suite.tasks.shared.goal import HEIGHT, LATERAL, TILT, Goal, Tip, goal_errors

FloatArray = npt.NDArray[np.float64]

ABOVE_MM = 50.0
"""How far above the mouth the planner brings the tip (mm)."""
NEAR_MM = 0.5
"""A set point so near to the axis (mm) goes down along it."""
UPRIGHT_DEG = 0.2
SETTLED_MM = 0.1
SETTLED_DEG = 0.25
"""How well the arm itself stands over the hole before it enters."""
GATE_MM = 3.0
"""Where it is waited for (mm above the mouth)."""
SLOW_MM = 1.5
FAST_MM = 10.0
"""Least and largest step down (mm)."""
_BRAKING = 0.4
_CAUGHT_MM = 30.0
_PUSHES = 6
_STOPS_RAD = (0.0, 0.05, 0.3)
_CLEAR_MM = 8.0
"""Nearer to the axis than the first and lower than the second, the only way is up."""
FUNNEL_MM = 40.0
"""From how far beside the axis a learnable way goes down along the funnel."""
FUNNEL_TILT_DEG = 10.0
FUNNEL_SLOPE = 4.0
ASIDE_MM = 15.0
"""Largest step towards the axis."""
GENTLE_MM = 1.0
"""Step down of one that presses gently."""
PRESS_N, EASE_N = 22.0, 5.0
"""Where this presses on its tip (N) it goes no deeper, and slower where so much less does (N)."""
SLIDE_MM = 3.0
"""How far beside the axis one that presses gently slides over the face, without going up."""
LED_MM = 0.3
"""From how deep in the mouth it lets the mouth alone lead it sideways."""
IN_MM = 1.0
"""From how deep on it is in the hole, where nothing is left to be pressed on but the bottom."""
IN_STEP_MM = 3.0
"""Step down there."""
SETTLED_SHARE = 1.0 / 3.0
"""Of how far off a tip may be and still be caught: so near to the axis it goes into the hole."""


class GuardedInsertion:
    """Decides where the set point goes; every answer depends on its arguments alone.

    Args:
        period_s: Control period (s).
        embodiment: The robot.
        plain: As in `Planner`.
    """

    def __init__(self, period_s: float, embodiment: Embodiment, *, plain: bool = False) -> None:
        self._kinematics = kinematics(embodiment)
        self._planner = Planner(period_s, plain=plain, embodiment=embodiment)

    def next_set_point(
        self, joints: FloatArray, velocity: FloatArray, set_point: FloatArray, goal: Goal
    ) -> FloatArray:
        """Where the set point shall be at the end of the control step.

        Args:
            joints: Now, (7,) rad.
            velocity: Of the joints, (7,) rad/s.
            set_point: Now, (7,) rad.
            goal: In the hole: its target is the middle of the mouth, its standoff negative.

        Returns:
            (7,) rad.
        """
        sent = self.errors(set_point, goal)
        if sent[LATERAL] > NEAR_MM or sent[TILT] > UPRIGHT_DEG or sent[HEIGHT] > ABOVE_MM + 5.0:
            if sent[LATERAL] < _CAUGHT_MM and sent[HEIGHT] < _CLEAR_MM:
                return self.straight(set_point, self._raised(set_point, goal), goal)
            above = dataclasses.replace(goal, standoff_m=0.001 * ABOVE_MM)
            return self._planner.next_set_point(joints, velocity, above, onward=goal)
        arm = self.errors(joints, goal)
        height = sent[HEIGHT]
        step = min(max(_BRAKING * (height - GATE_MM), SLOW_MM), FAST_MM)
        waits = arm[LATERAL] > SETTLED_MM or arm[TILT] > SETTLED_DEG
        if waits and arm[HEIGHT] > 0.0:
            step = min(step, max(height - GATE_MM, 0.0))
        depth_m = max(0.001 * (height - step), goal.standoff_m)
        return self.straight(set_point, goal.target + depth_m * goal.normal, goal)

    def learnable_set_point(
        self,
        joints: FloatArray,
        velocity: FloatArray,
        set_point: FloatArray,
        goal: Goal,
        caught_mm: float,
        *,
        pressed_n: float | None = None,
    ) -> FloatArray:
        """As `next_set_point`, but it changes little where the arm stands a little elsewhere.

        Up or down, by another posture or not: `next_set_point` decides that at half a millimetre
        beside the axis, which a policy does not see so exactly; it learns the mean of both, and
        hovers. This way goes down along a funnel: the farther from the axis, the higher it stays.

        Args:
            joints: Now, (7,) rad.
            velocity: Of the joints, (7,) rad/s.
            set_point: Now, (7,) rad.
            goal: In the hole: its target is the middle of the mouth, its standoff negative.
            caught_mm: How far beside the axis the mouth still catches the tip.
            pressed_n: What presses on the tip against its axis (N), where the hole may be
                elsewhere: then it must not press hard, slides over the face, and goes where the
                mouth leads it. None where the hole is where it seems to be.

        Returns:
            (7,) rad.
        """
        sent, arm = self.errors(set_point, goal), self.errors(joints, goal)
        height, within = sent[HEIGHT], SETTLED_SHARE * caught_mm
        if (
            sent[LATERAL] > FUNNEL_MM
            or height > ABOVE_MM + FUNNEL_MM
            or sent[TILT] > FUNNEL_TILT_DEG
        ):
            above = dataclasses.replace(goal, standoff_m=0.001 * ABOVE_MM)
            return self._planner.next_set_point(joints, velocity, above, onward=goal)
        off = max(sent[LATERAL], arm[LATERAL], within * arm[TILT] / SETTLED_DEG)
        slow, eased, led = SLOW_MM, 1.0, 0.0
        if pressed_n is not None:
            # The lower it is, the more it slides: going up at each small error takes all the time.
            off -= SLIDE_MM * _share(1.0 - arm[HEIGHT] / GATE_MM)
            # In the mouth, which may be elsewhere, it goes where the mouth leads it.
            led = _share(-arm[HEIGHT] / LED_MM)
            inside = _share((-arm[HEIGHT] - LED_MM) / (IN_MM - LED_MM))
            slow = GENTLE_MM + inside * (IN_STEP_MM - GENTLE_MM)
            eased = _share((PRESS_N - pressed_n) / EASE_N)
        least = 1000.0 * goal.standoff_m
        if arm[HEIGHT] > 0.0:
            # Through the mouth within one tolerance, above the gate from two on.
            least += (GATE_MM - least) * _share(off / within - 1.0)
            least += min(FUNNEL_SLOPE * max(off - 2.0 * within, 0.0), ABOVE_MM - GATE_MM)
        step = eased * min(max(_BRAKING * (height - GATE_MM), slow), FAST_MM)
        height = max(height - step, least) if height > least else min(height + FAST_MM, least)
        left = max(sent[LATERAL] - ASIDE_MM, 0.0) / max(sent[LATERAL], ASIDE_MM)
        aside = left * self._beside(set_point, goal)
        aside += led * (self._beside(joints, goal) - aside)
        return self.straight(set_point, goal.target + aside + 0.001 * height * goal.normal, goal)

    def errors(self, q: FloatArray, goal: Goal) -> dict[str, float]:
        """Lateral error (mm), height above the mouth (mm) and tilt (deg) of the tip at q (7,)."""
        R, p = self._kinematics.tip_pose(q)
        return goal_errors(Tip(p, R[:, 2]), dataclasses.replace(goal, standoff_m=0.0))

    def _beside(self, q: FloatArray, goal: Goal) -> FloatArray:
        """From the goal's axis to the tip at q (7,), (3,) m."""
        _, p = self._kinematics.tip_pose(q)
        beside = p - goal.target
        return np.asarray(beside - (beside @ goal.normal) * goal.normal)

    def straight(self, set_point: FloatArray, tip: FloatArray, goal: Goal) -> FloatArray:
        """The nearest set point (7,) with the tip (3,) at a place, along the goal's axis.

        Where that is beyond a joint's stop, one that is pushed away from there; else the joints
        near their stops stay where they are: yaw and elbow are free, so the others can do without.
        """
        pushed = [set_point]
        for _ in range(_PUSHES):
            pushed.append(away_from_stops(pushed[-1]))
        room = JOINT_RANGE_RAD - np.abs(set_point)
        for least in _STOPS_RAD:
            weight = JOINT_ACCELERATION_RAD_S2 * (room >= least)
            for start in pushed if least == 0.0 else [set_point]:
                near = self._kinematics.nearest_configuration(start, tip, goal.normal, weight)
                if near is not None:
                    return near
        return set_point

    def _raised(self, set_point: FloatArray, goal: Goal) -> FloatArray:
        """A step straight up from where the set point's tip is (3,) m."""
        _, p = self._kinematics.tip_pose(set_point)
        return np.asarray(p + 0.001 * FAST_MM * goal.normal)


def _share(x: float) -> float:
    return min(max(x, 0.0), 1.0)
