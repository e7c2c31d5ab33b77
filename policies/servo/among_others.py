"""``servo`` among other things: finds the target by colour and outline, and stays high.

A patch of the right colour is the target if it covers as much of the picture as a whole disc of the
target's size would there, and if its parts are no farther from its middle than a disc's: a square
covers a quarter more, a ring a quarter less, half a disc half. In a task with a choice, an
observation says which colour is meant.

It does not see obstacles: it has no model of their shapes, and the one picture from above that
shows them does not tell how high they are. So it moves as one does in an unknown cell: first up,
then to a place well above the target, and then straight down.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from hvs_suite.policies.servo.still_target import StillTargetServo
from hvs_suite.policies.servo.target_estimate import Sighting
from hvs_suite.rollout import Action, Observation
from hvs_suite.tasks.clutter import GOAL_COLOUR, ClutterSpec
from hvs_suite.tasks.shared.detection import find_discs, is_whole_disc

FloatArray = npt.NDArray[np.float64]

_SAFE_HEIGHT_M = 0.55
"""Where the flange is above the highest obstacle (m)."""
_UP_RAD = 0.15
"""The arm is as good as upright when no joint is farther from zero than this."""


class AmongOthersServo(StillTargetServo):
    """Servoes the right one of several things; follows :class:`hvs_suite.rollout.Policy`.

    Args:
        spec: The task's parameters.

    Raises:
        PolicyError: The task needs what this method does not do.
    """

    def __init__(self, spec: ClutterSpec) -> None:
        self._has_obstacles = spec.n_obstacles[1] > 0
        if self._has_obstacles:
            self.look_height_m = _SAFE_HEIGHT_M
        self._colours = spec.colours
        self._colour = spec.colours[0]
        super().__init__(spec)

    def select_action(self, observation: Observation) -> Action:
        """Choose an action; see `StillTargetServo.select_action`."""
        if GOAL_COLOUR in observation:
            self._colour = self._colours[int(np.argmax(observation[GOAL_COLOUR]))]
        return super().select_action(observation)

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self._is_up = not self._has_obstacles

    def _next_set_point(self, q: FloatArray) -> FloatArray:
        """Where the set point (7,) shall be at the end of the control step: first of all, up."""
        if not self._is_up:
            angles, speeds, _ = self._belief.when_action_acts()
            self._is_up = bool(np.abs(angles[:6]).max() < _UP_RAD)
            upright = np.append(np.zeros(6), angles[6])
            ahead = self._planner.towards_posture(angles, speeds, upright)
            if not self._is_up and ahead is not None:
                return ahead
        return super()._next_set_point(q)

    def _sighting(self, image: npt.NDArray[Any], K: FloatArray, T: FloatArray) -> Sighting | None:
        """The first patch of a picture that has the target's colour, size and outline."""
        for disc in find_discs(image, self._colour):
            sighting = self._sight.sighting(disc, K, T, self._estimate.surface_m)
            if sighting is None:
                continue
            if is_whole_disc(disc, disc.area / sighting.area_ratio) or self._is_known(sighting):
                return sighting
        return None

    def _is_known(self, sighting: Sighting) -> bool:
        """Whether a patch lies where the eye in the hand has seen the target, cut or not."""
        if not self._estimate.in_hand_sigma_m < np.inf:
            return False
        place, sigma = self._estimate.place()
        return bool(np.hypot(*(sighting.place - place)) < 0.02 + 3.0 * sigma)
