"""What the network need not learn: the arm's kinematics, and where an image point lies in space.

Fixed and differentiable. Everything is expressed in the base frame (metres, z up from the mounting
plane) unless a name says otherwise; image coordinates (u, v) are in [-1, 1], u to the right, v
down, 0 in the centre. The kinematics is that of the nominal robot on *measured* joints.
"""

import dataclasses

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hvs_suite.cell.robot import (
    BASE_TO_SHOULDER_M,
    ELBOW_TO_WRIST_M,
    FLANGE_HEIGHT_M,
    JOINT_AXES,
    JOINT_HEIGHTS_M,
    JOINT_RANGE_RAD,
    JOINT_SPEED_RAD_S,
    SHOULDER_TO_ELBOW_M,
    WRIST_TO_FLANGE_M,
)

FloatArray = npt.NDArray[np.float64]

# Damping of the least-squares inverse: small against the arm's 0.4 m links, large enough to keep
# steps bounded where the arm is stretched.
DAMPING_M = 0.03
# Offsets are shortened to this before the inverse, which only holds near the goal.
LINEARISATION_RANGE_M = 0.10
LINEARISATION_RANGE_RAD = 0.30
# Added to the time of a way that leads out of the joint ranges.
UNREACHABLE_S = 100.0
# How far below the lowest goal the flange may be sent (m): more than an arm overshoots that comes
# to rest soon, and less than the height of goals over the surface.
LEAST_HEIGHT_MARGIN_M = 0.01
# Rounds of Gauss-Newton that lift the flange, and their damping.
LIFTS = 4
LIFT_DAMPING_M = 0.05
# The most that a target may lie above or below the surface as the joints have it (m).
HEIGHT_BOUND_M = 0.01
# What is seen from closer than the distance at the goal over this counts no more than that.
NEAREST_LOOK = 1.5
# Least number of frames that show the target before a camera is calibrated from data.
MIN_CALIBRATION_FRAMES = 60


def _joint_tables() -> tuple[Tensor, ...]:
    """What makes the turn of joint i: fixed + sine sin(q) + cosine cos(q), and the ways between.

    Rodrigues' formula for a unit axis a: a a^T + sin(q) [a]_x + cos(q) (I - a a^T).

    Returns:
        Three of (7, 3, 3), the ways along z to each joint and on to the flange (8, 1) m, and the
        joints' axes (7, 3).
    """
    axes = torch.tensor(JOINT_AXES, dtype=torch.float64)
    along = axes[:, :, None] * axes[:, None]
    x, y, z = axes.unbind(dim=1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).view(-1, 3, 3)
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


def joint_step(motion: FlangeMotion, offset: Tensor) -> Tensor:
    """Damped least-squares step that puts the flange at an offset, facing straight down.

    Solves ``J^T (J J^T + d^2 I)^-1 e`` with the three position rows and the two tilt rows of the
    Jacobian; turning about the tool axis is free (Nakamura and Hanafusa, 1986).

    Args:
        motion: Where the flange is. No gradient flows through it.
        offset: From the flange to where it should be, (B, 3) m, base frame.

    Returns:
        Joint step, (B, 7) rad.
    """
    with torch.no_grad():
        tool = motion.rotation[:, :, 2]
        down = torch.zeros_like(tool)
        down[:, 2] = -1.0
        axis = torch.linalg.cross(tool, down, dim=1)
        sine = axis.norm(dim=1, keepdim=True)
        angle = torch.atan2(sine, -tool[:, 2:])
        tilt = axis * (angle.clamp(max=LINEARISATION_RANGE_RAD) / sine.clamp(min=1e-6))
        into_flange = motion.rotation.transpose(1, 2)[:, :2]  # its x and y axes: yaw is free
        # Angles weigh like the offsets they cause half a link away.
        lever = 0.2
        rows = torch.cat([motion.jacobian[:, :3], lever * into_flange @ motion.jacobian[:, 3:]], 1)
        gram = rows @ rows.transpose(1, 2)
        gram = gram + DAMPING_M**2 * torch.eye(5, dtype=gram.dtype, device=gram.device)
        inverse = torch.linalg.solve(gram, rows).transpose(1, 2)  # (B, 7, 5)
        tilt_in_flange = lever * (into_flange @ tilt[:, :, None])[:, :, 0]
    length = offset.norm(dim=1, keepdim=True)
    near = offset * (LINEARISATION_RANGE_M / length.clamp(min=LINEARISATION_RANGE_M))
    error = torch.cat([near, tilt_in_flange], dim=1)
    return (inverse @ error[:, :, None])[:, :, 0]


def postures(goal: Tensor) -> Tensor:
    """The two plain postures that hold the flange at a goal, facing straight down.

    Shoulder, elbow and wrist stand in one upright plane, the elbow above: a planar arm of two
    links, by the law of cosines. A1 turns that plane towards the goal, or away from it with all
    angles of the plane the other way round. Out of reach, the arm is stretched that way.

    Args:
        goal: Of the flange, (B, 3) m. No gradient flows through it.

    Returns:
        Angles of A1 to A6, (B, 2, 6) rad, A1 in [-pi, pi]; joint ranges are not looked at.
    """
    with torch.no_grad():
        upper, fore = SHOULDER_TO_ELBOW_M, ELBOW_TO_WRIST_M
        out = goal[:, :2].norm(dim=1)
        up = goal[:, 2] + WRIST_TO_FLANGE_M - BASE_TO_SHOULDER_M
        reach2 = (out**2 + up**2).clamp(max=(upper + fore) ** 2)
        bend = torch.arccos(((reach2 - upper**2 - fore**2) / (2.0 * upper * fore)).clamp(-1.0, 1.0))
        lean = torch.atan2(fore * torch.sin(bend), upper + fore * torch.cos(bend))
        shoulder = torch.atan2(out, up) - lean
        towards = torch.atan2(goal[:, 1], goal[:, 0])
        zero = torch.zeros_like(out)
        plane = torch.stack([shoulder, zero, -bend, zero, torch.pi - shoulder - bend], dim=1)
        away = towards + torch.where(towards > 0, -torch.pi, torch.pi)
        one = torch.cat([towards[:, None], plane], dim=1)
        other = torch.cat([away[:, None], -plane], dim=1)
        return torch.stack([one, other], dim=1)


def way_to_posture(q: Tensor, goal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The way to the nearer of the two plain postures that lie within the joint ranges.

    The nearer one is where the slowest joint arrives first at full speed, as for the demonstrator.

    Args:
        q: Joint angles, (B, 7) rad.
        goal: Of the flange, (B, 3) m. No gradient flows through it.

    Returns:
        The turns of A1 to A6 that are left, (B, 6) rad, the time of the slowest, (B, 1) s, and 1 if
        that posture lies within the ranges, else 0, (B, 1).
    """
    speed = torch.as_tensor(JOINT_SPEED_RAD_S[:-1]).to(q)
    limit = torch.as_tensor(JOINT_RANGE_RAD[:-1]).to(q)
    ends = postures(goal)
    ways = ends - q[:, None, :-1]
    times = (ways.abs() / speed).amax(dim=2)
    within = (ends.abs() <= limit).all(dim=2)
    nearer = torch.where(within, times, times + UNREACHABLE_S).argmin(dim=1)
    row = torch.arange(len(q), device=q.device)
    return ways[row, nearer], times[row, nearer, None], within[row, nearer, None].to(q)


def lifted(q: Tensor, least_height_m: Tensor) -> Tensor:
    """The joint angles nearest to given ones at which the flange is not too low.

    Gauss-Newton on the height of the flange, damped as `joint_step` is; angles that are high enough
    are left alone.

    Args:
        q: Joint angles, (B, 7) rad.
        least_height_m: Least height of the flange, scalar (m).

    Returns:
        Joint angles, (B, 7) rad.
    """
    motion = flange_motion(q)
    too_low = motion.position[:, 2:] < least_height_m
    for _ in range(LIFTS):
        rise = motion.jacobian[:, 2]
        gain = (rise**2).sum(dim=1, keepdim=True) + LIFT_DAMPING_M**2
        q = q + too_low * rise * ((least_height_m - motion.position[:, 2:]) / gain)
        motion = flange_motion(q)
    return q


def seen_from_hand(
    motion: FlangeMotion, uv: Tensor, rays: Tensor, plane_height_m: Tensor
) -> Tensor:
    """Where the ray through an eye-in-hand image point meets the work surface.

    Args:
        motion: Pose of the flange, where the camera sits.
        uv: Image coordinates, (B, 2).
        rays: (3, 3); ``rays @ (u, v, 1)`` is the viewing direction in the flange frame.
        plane_height_m: Height of the surface, scalar (m).

    Returns:
        (B, 4): the point (m), and 1 where the ray goes down to the surface within 1.5 m, else 0
        (the point is then the one below the flange).
    """
    direction = (motion.rotation @ (_homogeneous(uv) @ rays.T)[:, :, None])[:, :, 0]
    direction = direction / direction.norm(dim=1, keepdim=True).clamp(min=1e-6)
    drop = plane_height_m - motion.position[:, 2]
    reach = drop / direction[:, 2].clamp(max=-1e-3)
    valid = ((direction[:, 2] < -0.05) & (reach < 1.5) & (reach > 0)).to(uv.dtype)[:, None]
    below = torch.stack(
        [motion.position[:, 0], motion.position[:, 1], plane_height_m.expand_as(drop)], dim=1
    )
    point = motion.position + reach.clamp(0.0, 1.5)[:, None] * direction
    return torch.cat([torch.where(valid > 0, point, below), valid], dim=1)


def look_height(
    motion: FlangeMotion,
    uv: Tensor,
    diameter: Tensor,
    rays: Tensor,
    size_at_1m: Tensor,
    plane_height_m: Tensor,
    standoff_m: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """How high a disc lies, by how large it appears to the eye in the hand.

    A constant error in pixels is an error in distance that grows with the square of the distance.
    So a look has the inverse fourth power of its distance as weight, 1 at the goal.

    Args:
        motion: Pose of the flange, where the camera sits.
        uv: Image coordinates of the centre, (B, 2).
        diameter: Apparent diameter (image widths), (B, 1).
        rays: See `seen_from_hand`.
        size_at_1m: See `Calibration`, scalar.
        plane_height_m: Height of the surface, scalar (m).
        standoff_m: Distance between flange and target at the goal, scalar (m).

    Returns:
        (B, 1) each: distance along the optical axis, at most 2 m; height over the surface, within
        10 mm; and weight, 0 where the size means nothing.
    """
    depth = (size_at_1m / diameter).clamp(max=2.0)
    direction = _homogeneous(uv) @ rays.T
    direction = direction / direction[:, 2:].clamp(min=0.1)
    along = (motion.rotation @ direction[:, :, None])[:, 2]
    height = motion.position[:, 2:] + depth * along - plane_height_m
    closeness = (standoff_m / depth.clamp(min=1e-6)).clamp(max=NEAREST_LOOK)
    weight = torch.where(size_at_1m > 0, closeness**4, torch.zeros_like(closeness))
    return depth, height.clamp(-HEIGHT_BOUND_M, HEIGHT_BOUND_M), weight


def seen_from_afar(uv: Tensor, homography: Tensor, plane_height_m: Tensor) -> Tensor:
    """Where an eye-to-hand image point lies on the work surface.

    Args:
        uv: Image coordinates, (B, 2).
        homography: (3, 3) from (u, v, 1) to (x, y, 1) up to scale.
        plane_height_m: Height of the surface, scalar (m).

    Returns:
        The point, (B, 3) m.
    """
    mapped = _homogeneous(uv) @ homography.T
    scale = mapped[:, 2:]
    scale = torch.where(scale.abs() < 1e-3, torch.full_like(scale, 1e-3), scale)
    xy = (mapped[:, :2] / scale).clamp(-2.0, 2.0)
    return torch.cat([xy, plane_height_m.expand_as(xy[:, :1])], dim=1)


def _homogeneous(uv: Tensor) -> Tensor:
    return torch.cat([uv, torch.ones_like(uv[:, :1])], dim=1)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Cameras and surface as the demonstrations show them.

    Attributes:
        rays: Eye-in-hand: (u, v, 1) to viewing direction in the flange frame, (3, 3).
        homography: Eye-to-hand: (u, v, 1) to (x, y, 1) on the surface, (3, 3).
        plane_height_m: Mean height of the targets (m).
        standoff_m: Distance between flange face and target at the goal (m).
        size_at_1m: Apparent diameter of the target in the eye in hand (image widths) times its
            depth (m); 0 if it was never seen.
        lowest_goal_m: Height of the lowest goal of the flange (m).
    """

    rays: FloatArray
    homography: FloatArray
    plane_height_m: float
    standoff_m: float
    size_at_1m: float
    lowest_goal_m: float


def calibrate(
    q: FloatArray,
    goal_position: FloatArray,
    goal_normal: FloatArray,
    standoff_m: float,
    target_eih: FloatArray | None,
    target_eth: FloatArray | None,
) -> Calibration:
    """Fit the camera maps to demonstrations by direct linear transformation.

    A camera that never shows the target keeps a plain default, which the network can live with.

    Args:
        q: Measured joint angles, (n, 7) rad.
        goal_position: Goal of the flange, (n, 3) m.
        goal_normal: Outward surface normal at the target, (n, 3).
        standoff_m: Distance between flange face and target at the goal (m).
        target_eih: u, v, apparent diameter, visible for the eye-in-hand camera, (n, 4), or None.
        target_eth: The same for the eye-to-hand camera, or None.

    Returns:
        The calibration.
    """
    target = goal_position - standoff_m * goal_normal
    rays, homography, size_at_1m = np.diag([0.7, 0.7, 1.0]), np.eye(3), 0.0
    if target_eih is not None and (seen := _seen(target_eih)).sum() >= MIN_CALIBRATION_FRAMES:
        motion = flange_motion(torch.from_numpy(np.asarray(q[seen], np.float64)))
        offset = target[seen] - motion.position.numpy()
        direction = np.einsum("nji,nj->ni", motion.rotation.numpy(), offset)
        rays = _direct_linear(target_eih[seen, :2], direction)
        size_at_1m = float(np.median(target_eih[seen, 2] * direction[:, 2]))
    if target_eth is not None and (seen := _seen(target_eth)).sum() >= MIN_CALIBRATION_FRAMES:
        ones = np.ones((int(seen.sum()), 1))
        homography = _direct_linear(
            target_eth[seen, :2], np.concatenate([target[seen, :2], ones], axis=1)
        )
    height, lowest = float(target[:, 2].mean()), float(goal_position[:, 2].min())
    return Calibration(rays, homography, height, standoff_m, size_at_1m, lowest)


def _seen(target: FloatArray) -> npt.NDArray[np.bool_]:
    return (target[:, 3] > 0.5) & (np.abs(target[:, :2]).max(axis=1) <= 1.0)


def _direct_linear(uv: FloatArray, direction: FloatArray) -> FloatArray:
    """Least-squares M with ``M @ (u, v, 1)`` parallel to ``direction`` (Hartley and Zisserman 4.1).

    Args:
        uv: (n, 2).
        direction: (n, 3), its third component positive.

    Returns:
        (3, 3), scaled so that the last component is positive at (0, 0).
    """
    x = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    d = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    zero = np.zeros_like(x)
    rows = np.concatenate(
        [
            np.concatenate([zero, -d[:, 2:] * x, d[:, 1:2] * x], axis=1),
            np.concatenate([d[:, 2:] * x, zero, -d[:, :1] * x], axis=1),
        ]
    )
    matrix = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    return np.asarray(matrix / matrix[2, 2])
