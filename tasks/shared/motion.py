"""Motions on the work surface: straight lines, and smooth curves that cannot be predicted."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
DrawPlace = Callable[[np.random.Generator], tuple[float, float]]
"""Draws a point of the surface (m, base frame)."""

_N_SINES = 3
_FREQUENCY_HZ = (0.05, 0.45)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A motion: ``centre + velocity t + sum of amplitude sin(omega t + phase)``.

    Attributes:
        centre: (2,) m, base frame.
        velocity: (2,) m/s; zero on a curve.
        amplitude: (3, 2) m; zero on a line.
        omega: (3, 2) rad/s.
        phase: (3, 2) rad.
    """

    centre: FloatArray
    velocity: FloatArray
    amplitude: FloatArray
    omega: FloatArray
    phase: FloatArray

    def place(self, time_s: npt.ArrayLike) -> FloatArray:
        """Where the target is at times (...,) s: (..., 2) m."""
        time = np.asarray(time_s, np.float64)[..., None]
        return np.asarray(self.centre + self.velocity * time + self._waves(np.sin, time, 0))

    def speed(self, time_s: npt.ArrayLike) -> FloatArray:
        """How fast it moves at times (...,) s: (..., 2) m/s."""
        time = np.asarray(time_s, np.float64)[..., None]
        return np.asarray(self.velocity + self._waves(np.cos, time, 1))

    def acceleration(self, time_s: npt.ArrayLike) -> FloatArray:
        """How fast that changes at times (...,) s: (..., 2) m/s^2."""
        return -self._waves(np.sin, np.asarray(time_s, np.float64)[..., None], 2)

    def _waves(self, wave: np.ufunc, time: FloatArray, derivative: int) -> FloatArray:
        height = self._heights[derivative]
        return np.asarray((height * wave(self.omega * time[..., None] + self.phase)).sum(axis=-2))

    @functools.cached_property
    def _heights(self) -> tuple[FloatArray, ...]:
        """Of the waves and their first two derivatives, (3, 2) each."""
        return tuple(self.amplitude * self.omega**derivative for derivative in range(3))


def draw_line(random: np.random.Generator, draw_place: DrawPlace, speed_m_s: float) -> Motion:
    """Draw a straight motion of constant speed (m/s) from some place."""
    heading = random.uniform(-np.pi, np.pi)
    none = np.zeros((_N_SINES, 2))
    return Motion(
        centre=np.array(draw_place(random)),
        velocity=speed_m_s * np.array([np.cos(heading), np.sin(heading)]),
        amplitude=none,
        omega=none,
        phase=none,
    )


def draw_curve(
    random: np.random.Generator,
    draw_place: DrawPlace,
    speed_m_s: float,
    acceleration_m_s2: float,
    times: FloatArray,
) -> Motion:
    """Draw a curve about some place: for each axis, sines of random frequency, phase and height.

    Args:
        random: Generator.
        draw_place: Draws what it sways about.
        speed_m_s: Largest speed (m/s).
        acceleration_m_s2: Largest acceleration (m/s^2); the tighter of both bounds is reached.
        times: When speed and acceleration are looked at, (n,) s.

    Returns:
        The motion.
    """
    omega = 2.0 * np.pi * random.uniform(*_FREQUENCY_HZ, (_N_SINES, 2))
    wild = Motion(
        centre=np.array(draw_place(random)),
        velocity=np.zeros(2),
        # Slow sines sway farther at the same speed.
        amplitude=random.normal(size=(_N_SINES, 2)) / omega,
        omega=omega,
        phase=random.uniform(-np.pi, np.pi, (_N_SINES, 2)),
    )
    speed = np.linalg.norm(wild.speed(times), axis=1).max()
    acceleration = np.linalg.norm(wild.acceleration(times), axis=1).max()
    tame = min(speed_m_s / speed, acceleration_m_s2 / acceleration)
    return dataclasses.replace(wild, amplitude=tame * wild.amplitude)
