"""``servo``: classical hybrid visual servoing, as a practitioner would write it; no learning.

It sees the observations alone and knows what the cell's manual says: the task's parameters, the
robot's kinematics, both cameras' nominal calibration with its published accuracy, and that the
surface is the plane z = 0. It is not told what a scenario disturbs (pose of the eye-to-hand camera,
encoder zeros, colours), nor the latency, which it estimates by itself.

A decision is:

1. Find red patches in both pictures, keep those that can be the target, and turn their centres
   into places on the surface through the camera models and the measured joints.
2. Fuse them: the eye-to-hand camera serves the approach, the eye-in-hand camera the end. Near the
   goal the disc's apparent size also gives the height, which encoder errors hide.
3. Go to the estimated target, but stay as high as the eye-in-hand camera needs to see it for
   certain. While no camera has seen it, hover over the nearest part of the surface that no camera
   has looked at.
4. Move there the fastest way within joint limits and clear of collisions: the expert's motion,
   planned from the estimate in place of the true state. Hovering, prefer postures from which the
   way on to the goal is short: others end at a joint's stop and have to turn back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.cameras import extrinsics, extrinsics_of_hand, intrinsics, look_at
from hvs_suite.cell.kinematics import kinematics, travel_time
from hvs_suite.cell.robot import (
    BASE_TO_SHOULDER_M,
    ELBOW_TO_WRIST_M,
    JOINT_RANGE_RAD,
    SHOULDER_TO_ELBOW_M,
    WRIST_TO_FLANGE_M,
)
from hvs_suite.datasets.planner import Planner
from hvs_suite.errors import PolicyError
from hvs_suite.policies.servo.belief import Belief
from hvs_suite.policies.servo.target_estimate import Sight, Sighting, TargetEstimate
from hvs_suite.policies.servo.target_search import SPACING_M, TargetSearch
from hvs_suite.rollout import Observation
from hvs_suite.tasks.shared.detection import find_discs
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.placing import RingSpec

if TYPE_CHECKING:
    pass

FloatArray = npt.NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_MAX_HOVER_M = 0.40
_VIEW_SHARE = 0.9
"""Share of the eye-in-hand camera's half view that the target has to lie within."""
_SIGMAS = 3.0
_SETTLED_SIGMA_M = 0.003
_REACH_MARGIN_M = 0.0005
_SHORTEST_REACH_M = 0.402
"""Least distance of wrist and shoulder, A4 at its limit of 120 deg."""
_LOOK_CHOICES = 12


class StillTargetServo:
    """Servoes one still target; follows :class:`hvs_suite.rollout.Policy`.

    Attributes:
        max_misses: How often the eye in the hand may miss a target that it should see.
        look_height_m: How high the tip hovers while it looks for a target (m).
        measures_height: Whether the target's apparent size shows how far away it is.
        face_m: Height of the target's face above the surface (m).

    Args:
        spec: The task's parameters.

    Raises:
        PolicyError: The task needs what this method does not do.
    """

    max_misses = 6
    look_height_m = 0.30
    face_m = 0.0
    measures_height = True

    def __init__(self, spec: RingSpec) -> None:
        _check(spec)
        self._variant = spec
        self._embodiment = spec.embodiment
        self._kinematics = kinematics(spec.embodiment)
        self._belief = Belief(spec.control_period_s)
        self._planner = Planner(spec.control_period_s, embodiment=spec.embodiment)
        self._sight = Sight(spec.target_diameter_m, spec.ring_m)
        self._search = TargetSearch(kinematics(), spec.ring_m, spec.target_diameter_m)
        names = spec.observed
        self._has_eih, self._has_eth = "eih" in names, "eth" in names
        self._eih_K = intrinsics(spec.eih_resolution, spec.eih_fov_deg)
        self._eth_K = intrinsics(spec.eth_resolution, spec.eth_fov_deg)
        self._eth_T = extrinsics(
            np.array(spec.eth_position_m),
            look_at(spec.eth_position_m, spec.eth_look_at_m),
        )
        self._eth_sigma_m = _calibration_sigma(spec)
        self._half_view = float(np.tan(np.radians(spec.eih_fov_deg) / 2.0)) * _VIEW_SHARE
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._belief.reset()
        self._search.reset()
        self._estimate = TargetEstimate(self._eth_sigma_m)
        self._hand: tuple[FloatArray, FloatArray] | None = None
        self._look: FloatArray | None = None
        self._misses = 0

    def select_action(self, observation: Observation) -> npt.NDArray[np.float32]:
        """Choose an action.

        Args:
            observation: ``eih`` and ``eth`` uint8 (H, W, 3), or one of them;
                ``joint_positions`` (7,) rad; ``joint_velocities`` (7,) rad/s.

        Returns:
            Joint positions, (7,) float32 in [-1, 1].
        """
        q = np.asarray(observation["joint_positions"], np.float64)
        self._belief.measure(q, np.asarray(observation["joint_velocities"], np.float64))
        self._perceive(observation, q)
        target = self._next_set_point(q)
        action = np.clip(target / JOINT_RANGE_RAD, -1.0, 1.0).astype(np.float32)
        self._belief.command(action)
        return action

    def overrule(self, action: npt.NDArray[np.float32]) -> None:
        """Take in what was executed in place of the last action, (7,) in [-1, 1]."""
        self._belief.overrule(action)

    def _next_set_point(self, q: FloatArray) -> FloatArray:
        """Where the set point (7,) shall be at the end of the control step."""
        goal, onward = self._aim(q)
        angles, speeds, _ = self._belief.when_action_acts()
        return self._planner.next_set_point(angles, speeds, goal, onward=onward)

    # --- seeing ---------------------------------------------------------------------------------

    def _perceive(self, observation: Observation, q: FloatArray) -> None:
        """Take in both pictures."""
        R, p = self._kinematics.flange_pose(q)
        if self._hand is not None:
            turn = float(np.arccos(np.clip(0.5 * (np.trace(self._hand[0].T @ R) - 1), -1, 1)))
            self._estimate.move(float(np.linalg.norm(p - self._hand[1])), turn)
        self._hand = (R, p)
        T = extrinsics_of_hand(R, p, self._embodiment)
        seen = self._sighting(observation["eih"], self._eih_K, T) if self._has_eih else None
        if seen is not None:
            self._misses = 0
            self._estimate.see_eih(seen)
            if self.measures_height:
                self._estimate.see_height(seen, float(-R[2, 2]))
        elif self._has_eih:
            self._notice_a_miss(T)
        if self._has_eth and not self._estimate.in_hand_sigma_m < _SETTLED_SIGMA_M:
            seen_eth = self._sighting(observation["eth"], self._eth_K, self._eth_T)
            if seen_eth is not None:
                self._estimate.see_eth(seen_eth)
        if not self._estimate.is_known:
            self._rule_out(q, T)

    def _rule_out(self, q: FloatArray, T: FloatArray) -> None:
        """Neither camera saw a target: it lies in no place that they see."""
        if self._has_eih:
            self._search.rule_out(q, self._eih_K, T, self._variant.eih_resolution, own=True)
        if self._has_eth:
            side = self._variant.eth_resolution
            self._search.rule_out(q, self._eth_K, self._eth_T, side, own=False)

    def _sighting(self, image: npt.NDArray[Any], K: FloatArray, T: FloatArray) -> Sighting | None:
        """The first patch of a picture that can be the target."""
        for disc in find_discs(image):
            sighting = self._sight.sighting(disc, K, T, self._face_height_m)
            if sighting is not None:
                return sighting
        return None

    def _notice_a_miss(self, T: FloatArray) -> None:
        """The eye in the hand sees no target: if it should, the estimate is wrong."""
        if not self._estimate.is_known:
            return
        place, _ = self._estimate.place()
        if not self._should_be_seen(T, place):
            return
        self._misses += 1
        if self._misses > self.max_misses:
            self._start_over()

    def _should_be_seen(self, T: FloatArray, place: FloatArray) -> bool:
        """Whether a target at a place (2,) is in the eye in the hand's view, extrinsics (4, 4)."""
        x, y, depth = T[:3, :3] @ [*place, 0.0] + T[:3, 3]
        return bool(depth > 0.02 and max(abs(x), abs(y)) <= self._half_view * depth)

    def _start_over(self) -> None:
        """Forget where the target was: it is not there."""
        self._estimate = TargetEstimate(self._eth_sigma_m)
        self._search.reset()
        self._look, self._misses = None, 0

    # --- going ----------------------------------------------------------------------------------

    def _aim(self, q: FloatArray) -> tuple[Goal, Goal | None]:
        """Decide where the flange shall go, and where it goes next if it only hovers there."""
        if not self._estimate.is_known:
            return facing_down(self._look_out(q)), None
        place, sigma = self._estimate.place()
        standoff, face = self._variant.look_from_m, self._face_height_m
        # Misplaced by a few millimetres, a target at the edge would be out of reach.
        goal = self._within_reach(np.array([*place, standoff + face]))
        height = self._height_to_see(sigma)
        if height == standoff:
            return facing_down(goal), None
        hover = np.array([*place, min(height, _MAX_HOVER_M) + face])
        return facing_down(self._within_reach(hover)), facing_down(goal)

    def _height_to_see(self, sigma_m: float) -> float:
        """How far above the surface the eye in the hand is sure to see the target (m).

        Args:
            sigma_m: Standard deviation of the target's place (m).
        """
        needed = 0.0
        if self._has_eih:
            radius = 0.5 * self._variant.target_diameter_m + _SIGMAS * sigma_m
            needed = radius / self._half_view
        return max(self._variant.look_from_m, needed) * (1.0 + 0.3 * self._misses)

    def _look_out(self, q: FloatArray) -> FloatArray:
        """Where to hover to look at what no camera has seen, (3,) m.

        Of a few places, the one that shows most of the hidden surface for the time it takes; kept
        until there is nothing left to see from it.
        """
        hidden = self._search.possible
        radius = self._half_view * self.look_height_m
        if self._look is not None and _near(hidden, self._look, radius).any():
            return self._look
        best, self._look = -1.0, None
        choices = hidden[np.unique(np.linspace(0, len(hidden) - 1, _LOOK_CHOICES).astype(int))]
        for choice in choices:
            covered = hidden[_near(hidden, choice, radius)]
            goal = self._within_reach(np.array([*covered[:, :2].mean(axis=0), self.look_height_m]))
            family = self._kinematics.goal_configurations_at_tool_angle(goal, _UP, q[6])
            if not len(family):
                continue
            seconds = float(travel_time(q, family, acceleration_limits=True).min())
            worth = len(covered) / (seconds + 0.3)
            if worth > best:
                best, self._look = worth, goal
        if self._look is None:
            self._look = self._within_reach(np.array([*choices[0, :2], self.look_height_m]))
        return self._look

    @property
    def _face_height_m(self) -> float:
        """Height of the target's face in the encoders' frame (m)."""
        return self.face_m + self._estimate.surface_m

    def _within_reach(self, tip: FloatArray) -> FloatArray:
        """The nearest place at the same height over which the tool can face down, (3,) m."""
        return within_reach(tip, self._embodiment.tool_length_m)


def _near(points: FloatArray, place: FloatArray, radius: float) -> npt.NDArray[np.bool_]:
    """Which points (n, 3) lie within a radius (m) of a place, seen from above."""
    inner = max(radius - SPACING_M, SPACING_M)
    return np.asarray(np.hypot(*(points[:, :2] - place[:2]).T) < inner)


def facing_down(position: FloatArray) -> Goal:
    """The goal of the flange at a place (3,) m over the table, facing straight down."""
    return Goal(np.array([position[0], position[1], 0.0]), _UP, float(position[2]))


def within_reach(goal: FloatArray, tool_length_m: float = 0.0) -> FloatArray:
    """The nearest place at the same height over which the arm can face down, (3,) m."""
    rise = goal[2] + tool_length_m + WRIST_TO_FLANGE_M - BASE_TO_SHOULDER_M
    longest = SHOULDER_TO_ELBOW_M + ELBOW_TO_WRIST_M - _REACH_MARGIN_M
    outer = np.sqrt(max(longest**2 - rise**2, 0.0))
    inner = np.sqrt(max(_SHORTEST_REACH_M**2 - rise**2, 0.0))
    radius = max(float(np.hypot(goal[0], goal[1])), 1e-6)
    scale = np.clip(radius, inner, outer) / radius
    return np.array([goal[0] * scale, goal[1] * scale, goal[2]])


def _calibration_sigma(spec: RingSpec) -> float:
    """What the published accuracy of the eye-to-hand calibration means on the surface (m)."""
    distance = float(np.linalg.norm(np.subtract(spec.eth_position_m, spec.eth_look_at_m)))
    turn = np.radians(spec.eth_rotation_noise_deg)
    return float(np.hypot(spec.eth_position_noise_m, distance * turn))


def _check(spec: RingSpec) -> None:
    """Refuse what the method does not do, in a sentence."""
    names = spec.observed
    if not {"eih", "eth"} & set(names) or not {"joint_positions", "joint_velocities"} <= set(names):
        raise PolicyError(
            "servo needs a camera, joint_positions and joint_velocities; use the preset 'vision'"
        )
    if spec.normalise_observation or spec.action_mode != "joint_position":
        raise PolicyError("servo takes raw observations and commands joint positions")
    if any(
        name in names and channels != 3
        for name, channels in (("eih", spec.eih_channels), ("eth", spec.eth_channels))
    ):
        raise PolicyError("servo tells the target by its colour; use cameras with 3 channels")
    if getattr(spec, "surface", "flat") != "flat" or getattr(spec, "marker", "disc") != "disc":
        raise PolicyError("servo knows discs on flat surfaces alone")
