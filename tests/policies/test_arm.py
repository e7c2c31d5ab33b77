"""Geometry of the arm: kinematics, postures, steps and how far down the tip may go."""

import math

import numpy as np
import pytest
import ruckig
import torch
from torch import Tensor

from hvs_suite.cell import robot
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.plain_postures import ELBOWS_RAD
from hvs_suite.policies.belief import arm
from hvs_suite.policies.belief.geometry import flange_motion

UP = torch.tensor([[0.0, 0.0, 1.0]])
NOWHERE = torch.tensor(-1.0)


def goals(n: int, *, tilt: float) -> tuple[Tensor, Tensor]:
    """Places all around the base, and unit normals about as tilted as given (rad)."""
    generator = torch.Generator().manual_seed(0)
    around = 2.0 * math.pi * torch.rand(n, generator=generator)
    out = 0.42 + 0.25 * torch.rand(n, generator=generator)
    place = torch.stack([out * around.cos(), out * around.sin(), torch.full((n,), 0.1)], dim=1)
    slope = tilt * torch.randn(n, 2, generator=generator)
    normal = torch.cat([slope, torch.ones(n, 1)], dim=1)
    return place, normal / normal.norm(dim=1, keepdim=True)


def test_kinematics_agree_with_pinocchio() -> None:
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 7))
    motion = flange_motion(torch.from_numpy(q))
    for i, configuration in enumerate(q):
        rotation, position = kinematics().flange_pose(configuration)
        np.testing.assert_allclose(motion.rotation[i], rotation, atol=1e-9)
        np.testing.assert_allclose(motion.position[i], position, atol=1e-9)
        np.testing.assert_allclose(
            motion.jacobian[i], kinematics().jacobian(configuration), atol=1e-9
        )


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_both_postures_hold_the_flange_at_the_place_and_face_the_normal(tilt: float) -> None:
    place, normal = goals(100, tilt=tilt)
    for q in arm.postures(place, normal).unbind(dim=1):
        motion = flange_motion(torch.nn.functional.pad(q, (0, 1)))
        np.testing.assert_allclose(motion.position, place, atol=1e-5)
        np.testing.assert_allclose(motion.rotation[:, :, 2], -normal, atol=1e-5)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_postures_for_each_place_of_the_elbow_are_those_of_the_kinematics(tilt: float) -> None:
    place, normal = goals(50, tilt=tilt)
    shapes = arm.postures_by_elbow(place[:, None].double(), normal[:, None].double())[:, 0]
    for position, facing, q in zip(place, normal, shapes, strict=True):
        expected = kinematics().goal_shapes(position, facing, np.array(ELBOWS_RAD))[:, :6]
        apart = q.numpy() - expected
        np.testing.assert_allclose(np.sin(0.5 * apart), 0.0, atol=1e-6)


@pytest.mark.parametrize("tool_m", [0.0, 0.07])
def test_joint_steps_bring_the_tip_to_a_place_near_by(tool_m: float) -> None:
    place, normal = goals(50, tilt=0.2)
    q = torch.nn.functional.pad(arm.postures(place + tool_m * normal, normal)[:, 0], (0, 1))
    wanted = place + torch.tensor([0.02, -0.03, 0.01])
    for _ in range(8):
        tip = arm.tip_of(flange_motion(q), tool_m)
        q = q + arm.joint_step(tip, wanted - tip.position, normal)
    tip = arm.tip_of(flange_motion(q), tool_m)
    np.testing.assert_allclose(tip.position, wanted, atol=2e-4)
    np.testing.assert_allclose(tip.rotation[:, :, 2], -normal, atol=2e-3)


@pytest.mark.parametrize("doubt_m", [0.0, 0.02])
def test_the_tip_stays_above_where_the_goal_may_be(doubt_m: float) -> None:
    place, normal = goals(50, tilt=0.2)
    least = arm.DOUBTS * doubt_m - arm.BEYOND_M
    too_low = place + (least - 0.04) * normal
    q = torch.nn.functional.pad(arm.postures(too_low, normal)[:, 0], (0, 1))
    doubt = torch.full((50, 1), doubt_m)
    kept = arm.kept_above(q, place, normal, doubt, NOWHERE, 0.0)
    height = ((flange_motion(kept).position - place) * normal).sum(dim=1)
    np.testing.assert_allclose(height, least, atol=4e-3)


def test_the_tip_is_nowhere_below_the_lowest_of_all_goals() -> None:
    place, _ = goals(50, tilt=0.0)
    q = torch.nn.functional.pad(arm.postures(place, UP.expand(50, 3))[:, 0], (0, 1))
    elsewhere = place + torch.tensor([0.5, 0.5, -0.3])
    lowest = place[:, 2].max() + 0.03
    kept = arm.kept_above(q, elsewhere, UP.expand(50, 3), torch.zeros(50, 1), lowest, 0.0)
    height = flange_motion(kept).position[:, 2]
    assert (height > lowest - 0.01).all()


def test_a_tip_that_is_high_enough_or_far_beside_is_left_alone() -> None:
    place, normal = goals(50, tilt=0.2)
    q = torch.nn.functional.pad(arm.postures(place + 0.01 * normal, normal)[:, 0], (0, 1))
    doubt = torch.zeros(50, 1)
    assert (arm.kept_above(q, place, normal, doubt, NOWHERE, 0.0) == q).all()
    side = torch.linalg.cross(normal, UP.expand(50, 3) + 0.1, dim=1)
    far = place + 0.3 * side / side.norm(dim=1, keepdim=True) + 0.1 * normal
    assert (arm.kept_above(q, far, normal, doubt, NOWHERE, 0.0) == q).all()


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("time_s", [0.02, 0.125, 0.5])
def test_joints_on_their_way_are_where_the_planner_has_them(time_s: float, together: bool) -> None:
    random = np.random.default_rng(2)
    fastest, braking = robot.JOINT_SPEED_RAD_S[:6], robot.JOINT_ACCELERATION_RAD_S2[:6]
    turns = 0.5 * random.normal(size=(300, 6)) ** 3
    velocity = random.uniform(-1.0, 1.0, (300, 6)) * fastest
    velocity[:100] *= 0.05
    plan = ruckig.InputParameter(6)
    plan.max_velocity, plan.max_acceleration = fastest.tolist(), braking.tolist()
    plan.current_position = [0.0] * 6
    how = ruckig.Synchronization
    plan.synchronization = getattr(how, "Time" if together else "No")
    expected = []
    for way, speed in zip(turns, velocity, strict=True):
        plan.target_position, plan.current_velocity = way.tolist(), speed.tolist()
        motion = ruckig.Trajectory(6)
        ruckig.Ruckig(6).calculate(plan, motion)
        expected.append(motion.at_time(min(time_s, motion.duration))[0])
    found = arm.along_way(
        torch.from_numpy(turns), torch.from_numpy(velocity), time_s, together=together
    )
    # A joint that has too much time may use it in more than one way.
    off = np.abs(found.numpy() - np.array(expected))
    assert np.quantile(off, 0.9) < 1e-6
    assert (off <= np.abs(turns) + 0.02 * np.abs(velocity)).all()


def test_joints_rest_at_the_end_of_their_way() -> None:
    turns, velocity = torch.tensor([[0.3, -0.2, 0.0, 0.1, -0.4, 0.2]]), torch.zeros(1, 6)
    torch.testing.assert_close(arm.along_way(turns, velocity, 5.0), turns)
    nothing = torch.zeros(1, 6)
    torch.testing.assert_close(arm.along_way(nothing, nothing, 0.1), nothing)
