"""The arm's kinematics, which the network need not learn: that of the nominal robot.

Fixed and differentiable, on *measured* joints. Everything is in the base frame (metres, z up from
the mounting plane).
"""

import dataclasses

import torch
from torch import Tensor

from hvs_suite.cell.robot import FLANGE_HEIGHT_M, JOINT_AXES, JOINT_HEIGHTS_M


def cross(a: Tensor) -> Tensor:
    """Matrices (B, 3, 3) that do to a vector what a x does, for a (B, 3)."""
    x, y, z = a.unbind(dim=1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).view(-1, 3, 3)


def _joint_tables() -> tuple[Tensor, ...]:
    """What makes the turn of joint i: fixed + sine sin(q) + cosine cos(q), and the ways between.

    Rodrigues' formula for a unit axis a: a a^T + sin(q) [a]_x + cos(q) (I - a a^T).

    Returns:
        Three of (7, 3, 3), the ways along z to each joint and on to the flange (8, 1) m, and the
        joints' axes (7, 3).
    """
    axes = torch.tensor(JOINT_AXES, dtype=torch.float64)
    along = axes[:, :, None] * axes[:, None]
    skew = cross(axes)
    heights = torch.tensor([0.0, *JOINT_HEIGHTS_M, FLANGE_HEIGHT_M], dtype=torch.float64)
    return along, skew, torch.eye(3, dtype=torch.float64) - along, heights.diff()[:, None], axes


_JOINTS = _joint_tables()


@dataclasses.dataclass(frozen=True)
class FlangeMotion:
    """Pose of the flange and how the joints move it.

    Attributes:
        position: Flange face centre, (B, 3) m.
        rotation: Flange axes in the base frame as columns, (B, 3, 3).
        jacobian: Linear over angular velocity in base axes per joint speed, (B, 6, 7).
    """

    position: Tensor
    rotation: Tensor
    jacobian: Tensor


def flange_motion(q: Tensor) -> FlangeMotion:
    """Forward kinematics as a product of seven joint rotations, all axes meeting the z line.

    Args:
        q: Joint angles, (B, 7) rad.

    Returns:
        Pose and geometric Jacobian of the flange.
    """
    fixed, sine, cosine, ways, joint_axes = (table.to(q) for table in _JOINTS)
    angle = q[:, :, None, None]
    turns = fixed + sine * torch.sin(angle) + cosine * torch.cos(angle)  # (B, 7, 3, 3)
    # The frame before each joint's turn, and the flange's.
    frames = [torch.eye(3, dtype=q.dtype, device=q.device).expand(len(q), 3, 3)]
    for turn in turns.unbind(dim=1):
        frames.append(frames[-1] @ turn)
    rotations = torch.stack(frames, dim=1)  # (B, 8, 3, 3)
    places = torch.cumsum(rotations[..., 2] * ways, dim=1)  # (B, 8, 3)
    position = places[:, -1]
    axes = (rotations[:, :-1] @ joint_axes[..., None])[..., 0]  # (B, 7, 3)
    linear = torch.linalg.cross(axes, position[:, None] - places[:, :-1], dim=2)
    jacobian = torch.cat([linear, axes], dim=2).transpose(1, 2)
    return FlangeMotion(position, rotations[:, -1], jacobian)
