"""``servo`` with a peg: see the bushing, go over it, then feel for the hole.

The eyes say where the paint is; with that the tip goes down onto the bushing. Where the hole is not
there, it goes along a spiral at a light force until it drops into the mouth, and lets the mouth
lead it (`hvs_suite.tasks.shared.feeling`). ``push`` does without the spiral: it goes straight down
at its estimate of the hole, which shows what vision alone achieves.
"""

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets.insertion import GATE_MM, GuardedInsertion
from hvs_suite.policies.servo.still_target import StillTargetServo
from hvs_suite.policies.servo.target_estimate import DISC_PLANE_M, Sight
from hvs_suite.rollout import Observation
from hvs_suite.tasks.insert import InsertSpec
from hvs_suite.tasks.shared.feeling import HoleSearch, search_of
from hvs_suite.tasks.shared.goal import HEIGHT, LATERAL, UP, Goal
from hvs_suite.tasks.shared.peg_and_bushing import WRENCH

FloatArray = npt.NDArray[np.float64]

_LOOKS = 4
"""Pictures of the bushing from near by before the tip goes down."""
_NEAR_MM = 4.0
_ENTER_MM = 0.5


class InsertionServo(StillTargetServo):
    """Inserts a peg; follows :class:`hvs_suite.rollout.Policy`.

    Attributes:
        searches: Whether it searches for a hole that is not where it was seen.

    Args:
        spec: The task's parameters.

    Raises:
        PolicyError: The task needs what this method does not do.
    """

    # The hole and the tool's shadow make the face look smaller than it is.
    measures_height = False
    searches = True

    def __init__(self, spec: InsertSpec) -> None:
        self.face_m = spec.top_m - DISC_PLANE_M
        self._depth_m = spec.goal_depth_m
        self._how = search_of(spec.clearance_mm, spec.chamfer_mm, spec.hole_noise_mm, self.searches)
        self._guarded = GuardedInsertion(spec.control_period_s, spec.embodiment)
        super().__init__(spec)
        self._sight = Sight(spec.target_diameter_m, spec.ring_m, spec.hole_share)

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self._n_looks = 0
        self._mouth: FloatArray | None = None
        self._feeling: HoleSearch | None = None

    def select_action(self, observation: Observation) -> npt.NDArray[np.float32]:
        """Choose an action; see `StillTargetServo.select_action`."""
        self._force_n = -float(observation[WRENCH][2])
        return super().select_action(observation)

    def _perceive(self, observation: Observation, q: FloatArray) -> None:
        """Take in both pictures, until the peg begins to hide what they show."""
        if self._mouth is None:
            super()._perceive(observation, q)

    def _next_set_point(self, q: FloatArray) -> FloatArray:
        """Where the set point (7,) shall be at the end of the control step."""
        if self._mouth is None:
            self._look_closely(q)
        if self._mouth is None:
            return super()._next_set_point(q)
        joints, velocity, set_point = self._belief.when_action_acts()
        goal = Goal(self._mouth, UP, -self._depth_m)
        if self._feeling is None:
            sent, arm = (self._guarded.errors(each, goal) for each in (set_point, joints))
            if sent[HEIGHT] > GATE_MM + 0.1 or max(sent[LATERAL], arm[LATERAL]) > _ENTER_MM:
                return self._guarded.next_set_point(joints, velocity, set_point, goal)
            _, tip = self._kinematics.tip_pose(set_point)
            self._feeling = HoleSearch(self._how, self._mouth, tip)
        _, tip = self._kinematics.tip_pose(joints)
        ahead = self._feeling.next_set_point(tip, self._force_n)
        return self._guarded.straight(set_point, ahead, goal)

    def _look_closely(self, q: FloatArray) -> None:
        """Count looks from near by, and fix the estimate once there are enough."""
        if not self._estimate.is_known or not np.isfinite(self._estimate.in_hand_sigma_m):
            return
        place, _ = self._estimate.place()
        mouth = np.array([*place, self._face_height_m + DISC_PLANE_M])
        above = self._guarded.errors(q, Goal(mouth, UP))
        near = above[HEIGHT] < 1e3 * self._variant.look_from_m + _NEAR_MM
        self._n_looks += near and above[LATERAL] < _NEAR_MM
        if self._n_looks >= _LOOKS:
            self._mouth = mouth


class PushServo(InsertionServo):
    """Goes straight down where it sees the hole."""

    searches = False
