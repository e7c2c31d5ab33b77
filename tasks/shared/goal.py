"""Goals: where the tool has to be, as planners, critics and servos speak of it."""

import dataclasses
import functools
import math

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

POSITION = "position_error_mm"
LATERAL = "lateral_error_mm"
HEIGHT = "height_error_mm"
TILT = "tilt_error_deg"
"""Names of what `goal_errors` measures."""
UP: FloatArray = np.array([0.0, 0.0, 1.0])
"""Outward normal of a level surface, base frame."""


@dataclasses.dataclass(frozen=True, eq=False)
class Goal:
    """A place for the tool tip at one moment; base frame, yaw about the normal is free.

    Attributes:
        target: What the tip faces, (3,) m.
        normal: Outward unit normal there, (3,); the tool's axis is its opposite.
        standoff_m: Distance that the tip keeps from the target along the normal (m).
        velocity: How fast the goal moves, (3,) m/s.
        more_follow: Whether the arm goes on to another goal, at a place that is not known yet.
    """

    target: FloatArray
    normal: FloatArray
    standoff_m: float = 0.0
    velocity: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(3))
    more_follow: bool = False

    @functools.cached_property
    def position(self) -> FloatArray:
        """Where the tip has to be, (3,) m."""
        return self.target + self.normal * self.standoff_m


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoint:
    """A point whose projections supervise the eyes of a policy.

    Attributes:
        position: Centre, (3,) m, base frame.
        normal: The way it faces, (3,): seen from behind it is hidden.
        diameter_m: Size of the mark around it (m).
    """

    position: FloatArray
    normal: FloatArray
    diameter_m: float


@dataclasses.dataclass(frozen=True, eq=False)
class Tip:
    """Where the tool tip is at one moment; the flange's centre where there is no tool.

    Attributes:
        position: (3,) m, base frame.
        axis: Direction that the tool points to, (3,) unit, base frame.
    """

    position: FloatArray
    axis: FloatArray


def goal_errors(tip: Tip, goal: Goal) -> dict[str, float]:
    """How far a tip is from a goal.

    With d = tip - target and n the normal: height = d . n - standoff,
    lateral = norm(d - (d . n) n), position = hypot(lateral, height),
    tilt = atan2(norm(a x n), -a . n) for the tool's axis a.

    Args:
        tip: Where the tip is.
        goal: Where it has to be.

    Returns:
        ``position_error_mm``, ``lateral_error_mm``, ``height_error_mm`` (signed: above is
        positive) and ``tilt_error_deg``.
    """
    # Plain floats: on vectors of three, NumPy would cost a tenth of the control step.
    ax, ay, az = tip.axis.tolist()
    dx, dy, dz = (tip.position - goal.target).tolist()
    nx, ny, nz = goal.normal.tolist()
    along = dx * nx + dy * ny + dz * nz
    height = along - goal.standoff_m
    lateral = math.hypot(dx - along * nx, dy - along * ny, dz - along * nz)
    # atan2 keeps its precision for small angles, where arccos loses half the digits.
    sine = math.hypot(ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx)
    tilt = math.atan2(sine, -(ax * nx + ay * ny + az * nz))
    return {
        POSITION: 1000.0 * math.hypot(lateral, height),
        LATERAL: 1000.0 * lateral,
        HEIGHT: 1000.0 * height,
        TILT: math.degrees(tilt),
    }
