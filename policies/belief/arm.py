"""Steps and postures that bring the tool's tip to a place and an axis; the arm's own geometry.

Fixed and differentiable where it says so. Base frame, metres. The tool points against the goal's
normal; turning about it is free. Nothing in here knows a task.
"""

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from hvs_suite.cell.plain_postures import EFFORT_S, ELBOWS_RAD
from hvs_suite.cell.robot import (
    BASE_TO_SHOULDER_M,
    ELBOW_TO_WRIST_M,
    JOINT_ACCELERATION_RAD_S2,
    JOINT_RANGE_RAD,
    JOINT_SPEED_RAD_S,
    MIRROR_SHIFT_RAD,
    MIRROR_SIGN,
    SHOULDER_TO_ELBOW_M,
    WRIST_TO_FLANGE_M,
)
from hvs_suite.policies.belief.geometry import FlangeMotion, flange_motion

DAMPING_M = 0.03
"""Of the least-squares inverse: small against the arm's 0.4 m links, large enough to keep steps
bounded where the arm is stretched."""
LINEAR_RANGE_M = 0.10
LINEAR_RANGE_RAD = 0.30
"""Errors are shortened to this before the inverse, which only holds near by."""
LEVER_M = 0.2
"""Angles weigh like the offsets that they cause so far away."""
BEYOND_M = 0.01
"""How far beyond its goal the tip may be sent (m): more than any demonstrator overshoots."""
BESIDE_M = 0.1
DOUBTS = 2.0
LIFTS = 3
LIFT_DAMPING_M = 0.05
UNREACHABLE_S = 100.0
"""Added to the time of a way that leads out of the joint ranges."""


def tip_of(motion: FlangeMotion, tool_length_m: float) -> FlangeMotion:
    """The motion of the tip of a tool that stands on the flange, along its axis.

    Args:
        motion: Of the flange.
        tool_length_m: From the flange to the tip (m).

    Returns:
        The same at the tip.
    """
    if tool_length_m == 0.0:
        return motion
    arm = tool_length_m * motion.rotation[:, :, 2]
    turning = motion.jacobian[:, 3:]  # (B, 3, 7)
    linear = motion.jacobian[:, :3] + torch.linalg.cross(turning, arm[:, :, None], dim=1)
    return FlangeMotion(motion.position + arm, motion.rotation, torch.cat([linear, turning], dim=1))


def joint_step(motion: FlangeMotion, offset: Tensor, normal: Tensor) -> Tensor:
    """Damped least-squares step that moves the tip by an offset and turns it to face a normal.

    Solves ``J^T (J J^T + d^2 I)^-1 e`` with the three position rows and the two tilt rows of the
    Jacobian; turning about the tool's axis is free (Nakamura and Hanafusa, 1986).

    Args:
        motion: Of the tip. No gradient flows through it.
        offset: From the tip to where it should be, (B, 3) m; gradients flow.
        normal: Unit normal that it should face, (B, 3); gradients flow.

    Returns:
        Joint step, (B, 7) rad.
    """
    with torch.no_grad():
        into_flange = motion.rotation.transpose(1, 2)[:, :2]
        turning = LEVER_M * into_flange @ motion.jacobian[:, 3:]
        rows = torch.cat([motion.jacobian[:, :3], turning], dim=1)
        gram = rows @ rows.transpose(1, 2)
        gram = gram + DAMPING_M**2 * torch.eye(5, dtype=gram.dtype, device=gram.device)
        inverse = torch.linalg.solve(gram, rows).transpose(1, 2)  # (B, 7, 5)
    tool = motion.rotation[:, :, 2].detach()
    axis = torch.linalg.cross(tool, -normal, dim=1)
    sine = axis.norm(dim=1, keepdim=True)
    angle = torch.atan2(sine, -(tool * normal).sum(dim=1, keepdim=True))
    tilt = axis * (angle.clamp(max=LINEAR_RANGE_RAD) / sine.clamp(min=1e-6))
    tilt_in_flange = LEVER_M * (into_flange @ tilt[:, :, None])[:, :, 0]
    length = offset.norm(dim=1, keepdim=True)
    near = offset * (LINEAR_RANGE_M / length.clamp(min=LINEAR_RANGE_M))
    error = torch.cat([near, tilt_in_flange], dim=1)
    return (inverse @ error[:, :, None])[:, :, 0]


def postures(flange: Tensor, normal: Tensor) -> Tensor:
    """The two plain postures that hold the flange at a place, facing a normal.

    Shoulder, elbow and wrist stand in one upright plane, the elbow above: a planar arm of two
    links, by the law of cosines; A5 and A6 then turn the tool. A1 turns that plane towards the
    wrist, or away from it with all angles of the plane the other way round. Out of reach, the arm
    is stretched that way. Weights that learned before the elbow could also be aside go by these.

    Args:
        flange: Where it should be, (B, 3) m. No gradient flows through it.
        normal: Unit normal that it should face, (B, 3). No gradient flows through it.

    Returns:
        Angles of A1 to A6, (B, 2, 6) rad, A1 and A5 in [-pi, pi]; joint ranges are not looked at.
    """
    with torch.no_grad():
        upper, fore = SHOULDER_TO_ELBOW_M, ELBOW_TO_WRIST_M
        wrist = flange + WRIST_TO_FLANGE_M * normal
        out = wrist[:, :2].norm(dim=1)
        up = wrist[:, 2] - BASE_TO_SHOULDER_M
        reach2 = (out**2 + up**2).clamp(max=(upper + fore) ** 2)
        bend = torch.arccos(((reach2 - upper**2 - fore**2) / (2.0 * upper * fore)).clamp(-1.0, 1.0))
        lean = torch.atan2(fore * torch.sin(bend), upper + fore * torch.cos(bend))
        shoulder = torch.atan2(out, up) - lean
        towards = torch.atan2(wrist[:, 1], wrist[:, 0])
        away = towards + torch.where(towards > 0, -torch.pi, torch.pi)
        zero = torch.zeros_like(out)
        both = []
        for a1, sign in ((towards, 1.0), (away, -1.0)):
            # The tool's axis as the forearm's frame has it.
            c, s = torch.cos(a1), torch.sin(a1)
            x = -(c * normal[:, 0] + s * normal[:, 1])
            y = -(c * normal[:, 1] - s * normal[:, 0])
            z = -normal[:, 2]
            lean_over = sign * (shoulder + bend)
            cl, sl = torch.cos(lean_over), torch.sin(lean_over)
            across, along = cl * x - sl * z, sl * x + cl * z
            a6 = sign * torch.atan2(torch.hypot(across, y), along)
            a5 = torch.atan2(sign * y, sign * across)
            both.append(torch.stack([a1, sign * shoulder, zero, -sign * bend, a5, a6], dim=1))
        return torch.stack(both, dim=1)


def way_to_posture(q: Tensor, flange: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The way to the nearer of the two plain postures that lie within the joint ranges.

    Nearer is where the slowest joint arrives first at full speed.

    Args:
        q: Joint angles, (B, 7) rad.
        flange: Where it should be, (B, 3) m. No gradient flows through it.
        normal: Unit normal that it should face, (B, 3). No gradient flows through it.

    Returns:
        The turns of A1 to A6 that are left, (B, 6) rad, the time of the slowest, (B, 1) s, and 1 if
        that posture lies within the ranges, else 0, (B, 1).
    """
    speed = torch.as_tensor(JOINT_SPEED_RAD_S[:-1]).to(q)
    limit = torch.as_tensor(JOINT_RANGE_RAD[:-1]).to(q)
    ends = postures(flange, normal)
    ways = ends - q[:, None, :-1]
    times = (ways.abs() / speed).amax(dim=2)
    within = (ends.abs() <= limit).all(dim=2)
    nearer = torch.where(within, times, times + UNREACHABLE_S).argmin(dim=1)
    row = torch.arange(len(q), device=q.device)
    return ways[row, nearer], times[row, nearer, None], within[row, nearer, None].to(q)


def postures_by_elbow(flange: Tensor, normal: Tensor) -> Tensor:
    """The eight mirror shapes for each place of the elbow that plain postures have.

    As `hvs_suite.cell.kinematics.Kinematics.goal_shapes`; out of reach, the arm is stretched that
    way.

    Args:
        flange: Where it should be, (..., 3) m. No gradient flows through it.
        normal: Unit normal that it should face, (..., 3). No gradient flows through it.

    Returns:
        Angles of A1 to A6, (..., 8 n, 6) rad in [-pi, pi), shape by shape; joint ranges are not
        looked at.
    """
    with torch.no_grad():
        upper, fore = SHOULDER_TO_ELBOW_M, ELBOW_TO_WRIST_M
        wrist = flange + WRIST_TO_FLANGE_M * normal
        line = wrist - wrist.new_tensor([0.0, 0.0, BASE_TO_SHOULDER_M])
        far = line.norm(dim=-1, keepdim=True)
        reach = far.clamp(max=upper + fore)
        cos_4 = ((reach**2 - upper**2 - fore**2) / (2.0 * upper * fore)).clamp(-1.0, 1.0)
        bend = torch.arccos(cos_4)
        sin_4 = torch.sin(bend)
        # The line from shoulder to wrist in the upper arm's frame, the elbow on its +x side.
        along_x = (-fore * sin_4 / reach)[..., None]
        along_z = ((upper + fore * cos_4) / reach)[..., None]
        axis = line / far
        up = F.normalize(axis.new_tensor([0.0, 0.0, 1.0]) - axis * axis[..., 2:], dim=-1)
        side = torch.linalg.cross(axis, up, dim=-1)
        axis, up, side = axis[..., None, :], up[..., None, :], side[..., None, :]
        swivel = torch.tensor(ELBOWS_RAD).to(flange)[:, None]
        to_elbow = torch.cos(swivel) * up + torch.sin(swivel) * side
        y = torch.cos(swivel) * side - torch.sin(swivel) * up
        # The upper arm's axes x, y and z in the base frame, (..., n, 3).
        x = along_z * to_elbow + along_x * axis
        z = along_z * axis - along_x * to_elbow
        a1 = torch.atan2(z[..., 1], z[..., 0])
        a2 = torch.atan2(torch.hypot(z[..., 0], z[..., 1]), z[..., 2])
        a3 = torch.atan2(y[..., 2], -x[..., 2])
        # The tool's axis in the forearm's frame.
        cos_4, sin_4, tool = cos_4[..., None], sin_4[..., None], -normal[..., None, :]
        tool_x = (tool * (cos_4 * x + sin_4 * z)).sum(dim=-1)
        tool_y = (tool * y).sum(dim=-1)
        tool_z = (tool * (cos_4 * z - sin_4 * x)).sum(dim=-1)
        a5 = torch.atan2(tool_y, tool_x)
        a6 = torch.atan2(torch.hypot(tool_x, tool_y), tool_z)
        q = torch.stack([a1, a2, a3, bend.expand_as(a1), a5, a6], dim=-1)
        sign, shift = (
            torch.as_tensor(each[:, None, :-1]).to(q) for each in (MIRROR_SIGN, MIRROR_SHIFT_RAD)
        )
        q = (sign * q[..., None, :, :] + shift).flatten(-3, -2)
        return torch.remainder(q + math.pi, 2.0 * math.pi) - math.pi


def ways_to_posture(
    q: Tensor, flange: Tensor, normal: Tensor, chosen: Tensor
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """The ways to places in the posture that `hvs_suite.cell.plain_postures` chooses for them all.

    Args:
        q: Joint angles, (B, 7) rad.
        flange: Where it should be, (B, k, 3) m. No gradient flows through it.
        normal: Unit normal that it should face, (B, 3). No gradient flows through it.
        chosen: Where it would have to come soonest, (B, 3) m.

    Returns:
        For each place what `way_to_posture` returns. A posture that is beyond the joint ranges at
        some of the places is chosen where there is no other.
    """
    speed = torch.as_tensor(JOINT_SPEED_RAD_S[:-1]).to(q)
    limit = torch.as_tensor(JOINT_RANGE_RAD[:-1]).to(q)
    places = torch.cat([chosen[:, None], flange], dim=1)
    ends = postures_by_elbow(places, normal[:, None].expand_as(places))
    within = (ends.abs() <= limit).all(dim=3)
    turns_s = (ends[:, 0] - q[:, None, :-1]) / speed
    price = turns_s.abs().amax(dim=2) + EFFORT_S * turns_s.square().sum(dim=2)
    best = (price + UNREACHABLE_S * (~within).sum(dim=1)).argmin(dim=1)
    row = torch.arange(len(q), device=q.device)
    ways = []
    for i in range(1, places.shape[1]):
        turns = ends[row, i, best] - q[:, :-1]
        time_s = (turns.abs() / speed).amax(dim=1, keepdim=True)
        ways.append((turns, time_s, within[row, i, best, None].to(q)))
    return ways


def along_way(turns: Tensor, velocity: Tensor, time_s: float, *, together: bool = True) -> Tensor:
    """How far joints have come after some time on the fastest way to rest.

    Each arrives as soon as it can, or all arrive with the slowest. Then the others go to a top
    speed p from which they arrive at that time, at the full acceleration a: with x to go in the
    direction in which they have to brake last, u their speed in it and t the time,
    p^2 - (u + a t) p + a x + u^2 / 2 = 0; where that p would be below u, they slow down to
    p = (x - u^2 / (2 a)) / (t - u / a) at once. The planner's ruckig does the same with more than
    nine joints of ten, and lets some that have too much time brake more evenly.

    Args:
        turns: That are left of the first n joints, (B, n) rad.
        velocity: Of these joints, (B, n) rad/s.
        time_s: After which (s).
        together: Whether all arrive together, or each as soon as it can.

    Returns:
        (B, n) rad.
    """
    n = turns.shape[1]
    w = torch.as_tensor(JOINT_SPEED_RAD_S[:n]).to(turns)
    a = torch.as_tensor(JOINT_ACCELERATION_RAD_S2[:n]).to(turns)
    v = torch.maximum(torch.minimum(velocity, w), -w)
    side = torch.where(turns >= v * v.abs() / (2.0 * a), 1.0, -1.0)
    x, u = side * turns, side * v
    highest = torch.sqrt((a * x + 0.5 * u**2).clamp(min=0.0))
    cruising = (2.0 * w - u) / a + (x - (2.0 * w**2 - u**2) / (2.0 * a)) / w
    t = torch.where(highest <= w, (2.0 * highest - u) / a, cruising)
    if together:
        t = t.amax(dim=1, keepdim=True)
    both = u + a * t
    faster = 0.5 * (both - torch.sqrt((both**2 - 4.0 * a * x - 2.0 * u**2).clamp(min=0.0)))
    slower = (x - u**2 / (2.0 * a)) / (t - u / a).clamp(min=1e-6)
    top = torch.minimum(torch.where(faster >= u, faster, slower).clamp(min=0.0), w)
    change, braking = (top - u).abs() / a, top / a
    steady = (t - change - braking).clamp(min=0.0)
    first = change.clamp(max=time_s)
    second = torch.minimum((time_s - change).clamp(min=0.0), steady)
    third = torch.minimum((time_s - change - steady).clamp(min=0.0), braking)
    gone = u * first + 0.5 * torch.sign(top - u) * a * first**2 + top * second
    return side * (gone + top * third - 0.5 * a * third**2)


def kept_above(
    q: Tensor,
    goal: Tensor,
    normal: Tensor,
    doubt_m: Tensor,
    lowest_m: Tensor,
    tool_length_m: float,
) -> Tensor:
    """The joint angles nearest to given ones at which the tip is not beyond its goal.

    What comes down fast, one joint against another, is easily some centimetres too low, and touches
    what the goal is above. So near the goal the tip stays on its side: its height along the normal
    is at least `DOUBTS` times how well the goal's is known, less `BEYOND_M`; farther than
    `BESIDE_M` beside it, as much less as it is farther. And nowhere is it much lower than the
    lowest of all goals. Gauss-Newton on these heights, damped as `joint_step` is; angles that are
    high enough are left alone.

    Args:
        q: Joint angles, (B, 7) rad.
        goal: Of the tip, (B, 3) m.
        normal: Unit normal there, (B, 3).
        doubt_m: Standard deviation of the goal along it, (B, 1) m.
        lowest_m: Least height of the tip over the base, () m.
        tool_length_m: From the flange to the tip (m).

    Returns:
        Joint angles, (B, 7) rad.
    """
    for _ in range(LIFTS):
        tip = tip_of(flange_motion(q), tool_length_m)
        offset = tip.position - goal
        height = (offset * normal).sum(dim=1, keepdim=True)
        lateral = (offset - height * normal).norm(dim=1, keepdim=True)
        least = DOUBTS * doubt_m - BEYOND_M - (lateral - BESIDE_M).clamp(min=0.0)
        q = q + _lift((normal[:, None] @ tip.jacobian[:, :3])[:, 0], least - height)
        tip = tip_of(flange_motion(q), tool_length_m)
        q = q + _lift(tip.jacobian[:, 2], lowest_m - tip.position[:, 2:])
    return q


def _lift(rise: Tensor, missing_m: Tensor) -> Tensor:
    """Joint step (B, 7) that makes up for a missing height (B, 1), which rises by (B, 7) m/rad."""
    gain = rise.square().sum(dim=1, keepdim=True) + LIFT_DAMPING_M**2
    return rise * (missing_m.clamp(min=0.0) / gain)
