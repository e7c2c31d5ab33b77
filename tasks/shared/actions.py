"""The four action modes: what seven (or six) numbers in [-1, 1] command.

Every mode ends in joint set points in *encoder* coordinates, the ones that an observation shows: a
zero delta means no motion whatever the encoder's zero error is.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from dm_env import specs

from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_NAMES, JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from hvs_suite.errors import ActionError
from hvs_suite.tasks.shared.spec import ActionMode

FloatArray = npt.NDArray[np.float64]

JOINT_DELTA_RAD = 0.1
"""Full scale of ``joint_delta`` a control step (rad)."""
TWIST_LINEAR_M_S = 0.5
"""Full scale of the first three numbers of ``flange_twist`` (m/s)."""
TWIST_ANGULAR_RAD_S = 1.5
"""Full scale of the last three numbers of ``flange_twist`` (rad/s)."""
# Keeps joint speeds finite near singular postures at the cost of some tracking error there.
_DAMPING = 0.02


def action_size(mode: ActionMode) -> int:
    """Numbers in an action: six for a twist, else one a joint."""
    return 6 if mode == "flange_twist" else len(JOINT_NAMES)


def action_spec(mode: ActionMode) -> specs.BoundedArray:
    """Numbers in [-1, 1], float32."""
    return specs.BoundedArray((action_size(mode),), np.float32, -1.0, 1.0, name=mode)


def check_action(action: Any, mode: ActionMode, *, clip: bool) -> tuple[FloatArray, bool]:
    """Validate an action.

    Args:
        action: What the user gave.
        mode: Action mode, which sets the shape.
        clip: Clip values outside [-1, 1] instead of refusing them.

    Returns:
        The action as float64 (7,) or (6,), and whether it was clipped.

    Raises:
        ActionError: Not numbers, a wrong shape, NaN or infinity, or out of range without ``clip``.
    """
    size = action_size(mode)
    try:
        values = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError(f"an action is {size} numbers in [-1, 1], not {action!r}") from error
    if values.shape != (size,):
        raise ActionError(f"an action of mode {mode} has shape ({size},), not {values.shape}")
    # Plain floats cost a third of NumPy's here, in every control step. NaN fails this, too.
    if all(-1.0 <= value <= 1.0 for value in values.tolist()):
        return values, False
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ActionError(f"action[{bad}] is {values[bad]}; actions are finite numbers in [-1, 1]")
    if not clip:
        largest = float(np.abs(values).max())
        raise ActionError(
            f"an action value of {largest:.6g} lies outside [-1, 1]; clip it, or use the "
            "Gymnasium environment, which clips and counts"
        )
    return np.clip(values, -1.0, 1.0), True


def set_point(
    action: FloatArray, mode: ActionMode, commanded: FloatArray, period_s: float
) -> FloatArray:
    """Turn an action into joint set points.

    Args:
        action: Valid action, (7,) or (6,).
        mode: ``joint_position``: angles as a fraction of the joint range (170, 120, 170, 120, 170,
            120, 175 deg). ``joint_delta``: change of the set point, full scale 0.1 rad.
            ``joint_velocity``: speed as a fraction of each joint's limit. ``flange_twist``: linear
            (full scale 0.5 m/s) and angular (1.5 rad/s) velocity of the flange in the base frame,
            by damped least squares dq = J^T (J J^T + lambda^2 I)^-1 v (Nakamura and Hanafusa,
            1986), slowed down as a whole where a joint would exceed its speed.
        commanded: Set point before this action, (7,) rad, encoder coordinates.
        period_s: Control period (s).

    Returns:
        Set point, (7,) rad, encoder coordinates, within the joint ranges.
    """
    if mode == "joint_position":
        target = action * JOINT_RANGE_RAD
    elif mode == "joint_delta":
        target = commanded + action * JOINT_DELTA_RAD
    elif mode == "joint_velocity":
        target = commanded + action * JOINT_SPEED_RAD_S * period_s
    else:
        J = kinematics().jacobian(commanded)
        twist = action * np.repeat([TWIST_LINEAR_M_S, TWIST_ANGULAR_RAD_S], 3)
        speed = J.T @ np.linalg.solve(J @ J.T + _DAMPING**2 * np.eye(6), twist)
        speed /= max(1.0, float((np.abs(speed) / JOINT_SPEED_RAD_S).max()))
        target = commanded + speed * period_s
    return np.minimum(np.maximum(target, -JOINT_RANGE_RAD), JOINT_RANGE_RAD)
