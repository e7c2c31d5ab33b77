"""``servo`` for a target on a panel of unknown height and slope: it looks from all around.

A practitioner's way, in four steps:

1. Hover over where the eye to hand sees the target, above the highest panel, until the eye in the
   hand sees it too: where the rays of its looks meet is the target.
2. Come nearer until it sees the marks around the target. One look from straight above tells their
   slope badly, where they are small: the slope shows to the second order only, and by perspective.
3. So look at them from all around, leaning to every side, until the uncertainty of the fit of all
   looks is a part of the tolerance, or there is no more time.
4. Go there, and go on looking. When the arm has stood there for long enough, and the episode has
   not ended, the estimate was wrong: look around once more.
"""

import math

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import away_from_stops
from hvs_suite.cell.solid import Solid
from hvs_suite.errors import PolicyError
from hvs_suite.policies.servo.slope_estimate import SlopeEstimate
from hvs_suite.policies.servo.still_target import StillTargetServo, within_reach
from hvs_suite.rollout import Observation
from hvs_suite.tasks.shared.detection import find_discs
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.panels import OFF_CENTRE_M, SIDE_M
from hvs_suite.tasks.shared.pattern_pose import Ring, axes
from hvs_suite.tasks.shared.placing import are_near
from hvs_suite.tasks.surface import SurfaceSpec

FloatArray = npt.NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_HOVER_M = 0.22
"""How far above the target the flange hovers until the eye in the hand sees it (m)."""
_NEAR_RINGS = 8.0
"""From how near the marks can be told apart for certain, in radii of their ring."""
_LEAN_RAD = math.radians(35.0)
_FARTHER_M = 0.005
"""How much farther than the goal the eye is when it looks from the side (m)."""
_N_SIDES = 10
_SURE_SHARE = 0.4
"""The standard deviation that is good enough, in tolerances."""
_SURER = 0.7
"""By so much surer it has to be the next time, when it had been wrong."""
_THERE_M, _THERE_COS = 0.012, math.cos(math.radians(8.0))
"""Near enough to where it looks from to head for the next place."""
_STANDS_M = 0.001
_STEPS_TO_GOAL = 7
"""From the side to the goal, with one to spare."""
_PATIENCE = 3
_EYE_TO_HAND_M = 0.005
_PANEL_DEPTH_M = 0.20


class SlopedTargetServo(StillTargetServo):
    """Servoes one still target on a panel; follows :class:`hvs_suite.rollout.Policy`.

    Args:
        spec: The task's parameters.

    Raises:
        PolicyError: The task needs what this method does not do.
    """

    def __init__(self, spec: SurfaceSpec) -> None:
        if "eih" not in spec.observed:
            raise PolicyError("servo tells a slope by the eye in the hand; keep eih")
        lean = math.sin(math.radians(spec.tilt_deg[1]))
        self._highest_m = spec.raise_m[1] + SIDE_M * lean + 0.02
        self._ring = Ring(spec.mark_ring_m, spec.n_marks, spec.sag_m)
        self._standoff_m = spec.standoff_m
        tolerance_m = 1e-3 * spec.tightest_tolerance_mm
        # A slope that is off shifts the flange as well.
        slope_rad = min(math.radians(spec.tilt_tolerance_deg), tolerance_m / spec.standoff_m)
        self._needed = _SURE_SHARE * np.array([tolerance_m] * 3 + [slope_rad] * 2)
        super().__init__(spec)

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self._start_over()
        self._steps = 0

    def _start_over(self) -> None:
        """Forget where the target was."""
        super()._start_over()
        spec = self._variant
        self._slope = SlopeEstimate(self._ring, spec.target_diameter_m, (0.0, self._highest_m))
        self._side: float | None = None
        self._turning = 1.0
        self._is_going = False
        self._waited = 0
        self._sure = self._needed

    def _perceive(self, observation: Observation, q: FloatArray) -> None:
        """Take in both pictures."""
        self._steps += 1
        R, p = self._kinematics.flange_pose(q)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ p
        discs = find_discs(observation["eih"], most=2 * self._ring.n_marks)
        self._slope.see_eih(discs, self._eih_K, T)
        if discs:
            self._misses = 0
        elif self._slope.place is not None and self._should_see(T, self._slope.place):
            self._misses += 1
            if self._misses > self.max_misses:
                self._start_over()
        if self._has_eth and not self._slope.is_seen_closely:
            for disc in find_discs(observation["eth"])[:1]:
                sigma_m = self._eth_sigma_m + _EYE_TO_HAND_M
                self._slope.see_eth(disc, self._eth_K, self._eth_T, sigma_m)
        if self._slope.place is None:
            self._rule_out(q, T)

    def _should_see(self, T: FloatArray, place: FloatArray) -> bool:
        """Whether a target at a place (3,) is in the eye in the hand's view, extrinsics (4, 4)."""
        x, y, depth = T[:3, :3] @ place + T[:3, 3]
        return bool(depth > 0.02 and max(abs(x), abs(y)) <= self._half_view * depth)

    def _aim(self, q: FloatArray) -> tuple[Goal, Goal | None]:
        """Decide where the flange shall go."""
        slope = self._slope
        self._planner.avoid(())
        if slope.place is None:
            return self._over(self._look_out(q)), None
        if not slope.is_seen_closely:
            hover = np.array([*slope.place[:2], self._highest_m + _HOVER_M])
            return self._over(within_reach(hover)), None
        if slope.fit is None:
            near = max(_NEAR_RINGS * self._ring.radius_m, 1.5 * self._standoff_m)
            return Goal(slope.place, _UP, near * (1.0 + 0.3 * self._misses)), None
        normal = slope.fit.pose.normal
        self._planner.avoid((_around(slope.place, normal),))
        goal = Goal(slope.place, normal, self._standoff_m)
        self._decide(q, goal)
        if self._is_going:
            return goal, None
        return self._from_the_side(q, slope.place, normal), goal

    def _decide(self, q: FloatArray, goal: Goal) -> None:
        """Whether it is time to go, or to look around."""
        fit, spec = self._slope.fit, self._variant
        assert fit is not None
        left = spec.time_limit_steps - self._steps
        is_late = left <= spec.hold_steps + _STEPS_TO_GOAL
        if not self._is_going:
            self._is_going = is_late or bool((fit.sigmas[:5] <= self._sure).all())
            self._waited = 0
            return
        _, p = self._kinematics.flange_pose(q)
        if np.linalg.norm(p - goal.position) < _STANDS_M:
            self._waited += 1
        if self._waited > spec.hold_steps + _PATIENCE and not is_late:
            # The arm is at its estimate of the goal, but the episode goes on.
            self._is_going = False
            self._sure = _SURER * self._sure

    def _from_the_side(self, q: FloatArray, place: FloatArray, normal: FloatArray) -> Goal:
        """The next place on the circle around the target from which to look at it.

        Where the arm cannot go on around without a detour, it turns back.
        """
        R, p = self._kinematics.flange_pose(q)
        x, y = axes(normal)
        if self._side is None:
            away = p - place
            self._side = math.atan2(float(away @ y), float(away @ x))
        for _ in range(_N_SIDES):
            lean = math.cos(self._side) * x + math.sin(self._side) * y
            towards = math.cos(_LEAN_RAD) * normal + math.sin(_LEAN_RAD) * lean
            look = Goal(place, towards, self._standoff_m + _FARTHER_M)
            there = np.linalg.norm(p - look.position) < _THERE_M and -R[:, 2] @ towards > _THERE_COS
            # A short motion leads to where to look from, and another one to the goal.
            goal = Goal(place, normal, self._standoff_m)
            embodiment = self._variant.embodiment
            is_near = are_near(away_from_stops(q), look, goal, embodiment=embodiment)
            if is_near and not there:
                break
            if not is_near:
                self._turning = -self._turning
            self._side += self._turning * 2.0 * math.pi / _N_SIDES
        return look

    def _over(self, position: FloatArray) -> Goal:
        """The goal of the flange at a place (3,) m, above all panels."""
        x, y, z = position.tolist()
        return Goal(np.array([x, y, self._highest_m]), _UP, z - self._highest_m)


def _around(place: FloatArray, normal: FloatArray) -> Solid:
    """A box that holds the panel wherever on it the target lies."""
    half = 0.5 * SIDE_M * math.sqrt(2.0) + OFF_CENTRE_M
    axis = np.cross(_UP, normal)
    sine = float(np.linalg.norm(axis))
    lean = axis / max(sine, 1e-12) * math.atan2(sine, float(normal[2]))
    a, b, c = lean.tolist()
    x, y, z = (place - 0.5 * _PANEL_DEPTH_M * normal).tolist()
    return Solid(
        "box", (half, half, 0.5 * _PANEL_DEPTH_M), (x, y, z), lean=(a, b, c), is_faced=True
    )
