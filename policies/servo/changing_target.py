"""``servo`` for targets that vanish and appear elsewhere: it notices, forgets and looks again."""

import numpy as np
import numpy.typing as npt

from hvs_suite.policies.servo.still_target import StillTargetServo
from hvs_suite.rollout import Observation

FloatArray = npt.NDArray[np.float64]

_ELSEWHERE_M = 0.03
"""A patch that is farther than this from where the target is believed to be is another target."""
_ELSEWHERE_SIGMA = 6.0


class ChangingTargetServo(StillTargetServo):
    """Servoes one target after the other; follows :class:`hvs_suite.rollout.Policy`.

    There is one target at a time. It is gone when the eye in the hand does not see it where it has
    to be, or when the eye to hand sees one elsewhere.

    Args:
        spec: The task's parameters.

    Raises:
        PolicyError: The task needs what this method does not do.
    """

    max_misses = 0

    def _perceive(self, observation: Observation, q: FloatArray) -> None:
        """Take in both pictures; before that, forget a target that is seen to be elsewhere."""
        if self._has_eth and self._estimate.is_known:
            seen = self._sighting(observation["eth"], self._eth_K, self._eth_T)
            if seen is not None:
                place, sigma = self._estimate.place()
                spread = float(np.sqrt(np.linalg.eigvalsh(seen.covariance)[-1]))
                bound = _ELSEWHERE_M + _ELSEWHERE_SIGMA * np.hypot(
                    sigma, np.hypot(spread, self._eth_sigma_m)
                )
                if np.hypot(*(seen.place - place)) > bound:
                    self._start_over()
        super()._perceive(observation, q)
