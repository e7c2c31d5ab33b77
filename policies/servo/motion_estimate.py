"""Where a moving target is and will be: a Kalman filter over what both cameras saw of it.

The state is place, velocity and acceleration on the surface, and the error that the eye-to-hand
camera's calibration makes there, which is common to all its pictures. A smooth motion that stays in
a bounded place turns back: its jerk is, on the average, against its velocity, as in an oscillation
of one frequency. So the state moves on in this way, and white jerk stands for the rest. For targets
known to move straight, the frequency, acceleration and jerk are zero.
"""

import numpy as np
import numpy.typing as npt

from hvs_suite.policies.servo.target_estimate import Sighting

FloatArray = npt.NDArray[np.float64]

_PLACE, _VELOCITY, _ACCELERATION, _BIAS = (slice(2 * k, 2 * k + 2) for k in range(4))
_ENCODER_RAD = 0.001
_EIH_SIGMA_M = 0.00005
"""What is left of the eye in the hand's error at the goal, beside that of a patch's centre (m)."""
_OUTLIER_SIGMA = 8.0
_MAX_OUTLIERS = 2


class MotionEstimate:
    """Fuses what the cameras saw of a target that moves.

    Args:
        eth_sigma_m: Standard deviation that the eye-to-hand camera's calibration has on the
            surface (m).
        speed_m_s: Largest speed of the target (m/s).
        acceleration_m_s2: Its largest acceleration (m/s^2); 0 for straight motion.
        pace_rad_s: Angular frequency w of the oscillation: jerk = -w^2 velocity (rad/s).
        jerk_m_s3: Standard deviation of the jerk beside that (m/s^3).
    """

    def __init__(
        self,
        eth_sigma_m: float,
        speed_m_s: float,
        acceleration_m_s2: float,
        pace_rad_s: float,
        jerk_m_s3: float,
    ) -> None:
        self._prior = (
            np.repeat([0.0, speed_m_s / 2.0, acceleration_m_s2 / 2.0, eth_sigma_m], 2) + 1e-9
        )
        self._pace, self._jerk = pace_rad_s, jerk_m_s3
        self._x: FloatArray | None = None
        self._P: FloatArray = np.zeros((8, 8))
        self._outliers = 0

    @property
    def is_known(self) -> bool:
        """Whether any camera has seen the target."""
        return self._x is not None

    def place(self, ahead_s: float = 0.0) -> tuple[FloatArray, float]:
        """Where the target will be, (2,) m, and the largest standard deviation of that (m)."""
        x, P = self._predicted(ahead_s)
        return x[_PLACE], float(np.sqrt(np.linalg.eigvalsh(P[_PLACE, _PLACE])[-1]))

    def velocity(self, ahead_s: float = 0.0) -> FloatArray:
        """How fast it will move, (2,) m/s."""
        return self._predicted(ahead_s)[0][_VELOCITY]

    def pass_time(self, period_s: float) -> None:
        """A control step has passed."""
        if self._x is not None:
            self._x, self._P = self._predicted(period_s)

    def see_eth(self, sighting: Sighting) -> None:
        """Take in a sighting by the eye-to-hand camera."""
        self._see(sighting.place, sighting.covariance, has_bias=True)

    def see_eih(self, sighting: Sighting) -> None:
        """Take in a sighting by the eye-in-hand camera."""
        own = (_EIH_SIGMA_M + 0.2 * _ENCODER_RAD * max(sighting.depth_m - 0.05, 0.0)) ** 2
        self._see(sighting.place, sighting.covariance + own * np.eye(2), has_bias=False)

    def _predicted(self, ahead_s: float) -> tuple[FloatArray, FloatArray]:
        assert self._x is not None
        # Place, velocity and acceleration under jerk = -w^2 velocity, which for w = 0 is constant
        # acceleration. NumPy's sinc(x) is sin(pi x) / (pi x).
        turn = self._pace * ahead_s
        cos, sin_over_pace = np.cos(turn), ahead_s * np.sinc(turn / np.pi)
        lean = 0.5 * (ahead_s * np.sinc(0.5 * turn / np.pi)) ** 2
        F = np.eye(8)
        F[:6, :6] = np.kron(
            [
                [1.0, sin_over_pace, lean],
                [0.0, cos, sin_over_pace],
                [0.0, -(self._pace**2) * sin_over_pace, cos],
            ],
            np.eye(2),
        )
        # White jerk: the discrete process noise of a Wiener-process acceleration model (Bar-Shalom,
        # Li and Kirubarajan, "Estimation with applications to tracking and navigation", 6.2.3).
        t = ahead_s
        q = np.array(
            [
                [t**5 / 20, t**4 / 8, t**3 / 6],
                [t**4 / 8, t**3 / 3, t**2 / 2],
                [t**3 / 6, t**2 / 2, t],
            ]
        )
        Q = np.zeros((8, 8))
        # The spectral density of jerk that stays the same for a tenth of a second or so.
        Q[:6, :6] = np.kron(q, np.eye(2)) * self._jerk**2 * 0.1
        return F @ self._x, F @ self._P @ F.T + Q

    def _see(self, place: FloatArray, noise: FloatArray, *, has_bias: bool) -> None:
        if self._x is None:
            self._start(place, noise, has_bias=has_bias)
            return
        H = np.zeros((2, 8))
        H[:, _PLACE] = np.eye(2)
        if has_bias:
            H[:, _BIAS] = np.eye(2)
        innovation = place - H @ self._x
        S = H @ self._P @ H.T + noise
        if innovation @ np.linalg.solve(S, innovation) > _OUTLIER_SIGMA**2:
            self._outliers += 1
            if self._outliers > _MAX_OUTLIERS:
                self._start(place, noise, has_bias=has_bias)
            return
        self._outliers = 0
        gain = self._P @ H.T @ np.linalg.inv(S)
        self._x = self._x + gain @ innovation
        keep = np.eye(8) - gain @ H
        # Joseph's form stays symmetric and positive.
        self._P = keep @ self._P @ keep.T + gain @ noise @ gain.T

    def _start(self, place: FloatArray, noise: FloatArray, *, has_bias: bool) -> None:
        """Begin with a first sighting."""
        self._x, self._P, self._outliers = np.zeros(8), np.diag(self._prior**2), 0
        self._x[_PLACE] = place
        self._P[_PLACE, _PLACE] = noise
        if has_bias:
            bias = self._P[_BIAS, _BIAS].copy()
            self._P[_PLACE, _PLACE] += bias
            self._P[_PLACE, _BIAS] = self._P[_BIAS, _PLACE] = -bias
