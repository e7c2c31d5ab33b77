"""The arm: published figures, contacts, shells, and the stiffness of its joint control."""

from collections.abc import Iterator

import mujoco
import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest
from dm_control import composer, mjcf

from hvs_suite.cell import robot, shells
from hvs_suite.cell.arm import Iiwa7
from hvs_suite.cell.kinematics import Kinematics, kinematics, travel_time

FloatArray = npt.NDArray[np.float64]
CONTROL_PERIOD_S = 0.1
SUBSTEPS = round(CONTROL_PERIOD_S / robot.PHYSICS_TIMESTEP_S)
DOWN = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(robot.robot_mjcf())


def ring_points(n: int, seed: int) -> Iterator[FloatArray]:
    rng = np.random.default_rng(seed)
    for _ in range(n):
        radius, azimuth = np.sqrt(rng.uniform(0.40**2, 0.78**2)), rng.uniform(-np.pi, np.pi)
        yield np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.05])


def fastest(position: FloatArray, acceleration_limits: bool) -> FloatArray:
    q = kinematics().goal_configurations_at_tool_angle(position, DOWN, 0.0)
    return q[np.argmin(travel_time(np.zeros(7), q, acceleration_limits))]


def ramp(q_from: FloatArray, q_to: FloatArray) -> FloatArray:
    """Set points (n, 7) of a synchronous trapezoid under the published accelerations."""
    least = float(travel_time(q_from, q_to[None], acceleration_limits=True)[0])
    n = int(np.ceil(least / CONTROL_PERIOD_S))
    duration, distance = n * CONTROL_PERIOD_S, np.abs(q_to - q_from)
    a = robot.JOINT_ACCELERATION_RAD_S2
    t = CONTROL_PERIOD_S * np.arange(1, n + 1)[:, None]
    root = np.sqrt(np.maximum(duration**2 - 4.0 * distance / a, 0.0))
    rise = (duration - root) / 2.0
    s = np.where(
        t < rise,
        0.5 * a * t**2,
        np.where(
            t < duration - rise,
            a * rise * (t - rise / 2.0),
            distance - 0.5 * a * (duration - t) ** 2,
        ),
    )
    return q_from + np.sign(q_to - q_from) * s


def settle(
    model: mujoco.MjModel, q_from: FloatArray, set_points: FloatArray
) -> tuple[float, float]:
    """Plays set points; the last stays.

    Returns:
        Largest tip error (mm) from two control steps after the set point's arrival on, and how far
        the tip passes the goal along its line of approach after the arrival (mm).
    """
    data = mujoco.MjData(model)
    data.qpos[:] = data.act[:] = q_from
    mujoco.mj_forward(model, data)
    goal = kinematics().flange_pose(set_points[-1])[1]
    approach, passed, errors, step = np.zeros(3), 0.0, [], 0
    while len(errors) < 8:
        target = set_points[min(step, len(set_points) - 1)]
        speed = (target - data.act) / CONTROL_PERIOD_S
        data.ctrl[:] = np.clip(speed, -robot.JOINT_SPEED_RAD_S, robot.JOINT_SPEED_RAD_S)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
            mujoco.mj_kinematics(model, data)
            passed = max(passed, 1e3 * float((data.site_xpos[0] - goal) @ approach))
        step += 1
        error = data.site_xpos[0] - goal
        arrived = step >= len(set_points) and np.allclose(data.act, set_points[-1], atol=1e-9)
        if arrived:
            if not errors:
                approach = -error / np.linalg.norm(error)
            errors.append(1e3 * float(np.linalg.norm(error)))
    return max(errors[2:]), passed


def test_the_chain_has_the_published_lengths_and_mass(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site("flange").xpos, [0, 0, 1.266], atol=1e-12)
    np.testing.assert_allclose(model.body_mass.sum(), 23.90, atol=1e-9)
    np.testing.assert_allclose(
        np.degrees(model.jnt_range[:, 1]), [170, 120, 170, 120, 170, 120, 175]
    )
    np.testing.assert_allclose(
        np.degrees(model.actuator_ctrlrange[:, 1]), [98, 98, 100, 130, 140, 180, 180]
    )
    np.testing.assert_allclose(model.jnt_actfrcrange[:, 1], [176, 176, 110, 110, 110, 40, 40])


def test_inertias_are_those_of_the_shells_scaled_to_the_published_masses(
    model: mujoco.MjModel,
) -> None:
    for name in ["base"] + [f"link_{i}" for i in range(1, 8)]:
        body = model.body(name)
        volume, centre, inertia = shells.solid_inertia(name)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, body.iquat)
        axes = rotation.reshape(3, 3)
        np.testing.assert_allclose(body.ipos, centre, atol=2e-4)
        np.testing.assert_allclose(
            axes @ np.diag(body.inertia) @ axes.T, inertia * body.mass / volume, atol=3e-5
        )


@pytest.mark.parametrize("n_goals", [20, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("motion", ["full_speed", "accelerations", "small_step"])
def test_the_tip_stands_two_control_steps_after_the_set_point_arrives(
    model: mujoco.MjModel, motion: str, n_goals: int
) -> None:
    rng = np.random.default_rng(1)
    for position in ring_points(n_goals, seed=3):
        if motion == "full_speed":
            start, goal = np.zeros(7), fastest(position, acceleration_limits=False)
            set_points = goal[None]
        elif motion == "accelerations":
            start, goal = np.zeros(7), fastest(position, acceleration_limits=True)
            set_points = ramp(start, goal)
        else:
            goal = fastest(position, acceleration_limits=True)
            step = rng.normal(size=3)
            step *= rng.uniform(1e-3, 20e-3) / np.linalg.norm(step)
            J = kinematics().jacobian(goal)
            start = goal + J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), [*step, 0, 0, 0])
            set_points = goal[None]
        error_mm, passed_mm = settle(model, start, set_points)
        assert error_mm <= 0.02
        assert passed_mm <= 0.1


def test_a_held_set_point_does_not_chatter(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    for position in ring_points(5, seed=4):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = data.act[:] = fastest(position, acceleration_limits=True)
        mujoco.mj_step(model, data, 240)
        assert np.abs(data.qvel).max() < 1e-9


def test_joint_torques_stay_within_the_published_limits(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    data.ctrl[:] = robot.JOINT_SPEED_RAD_S
    for _ in range(60):
        mujoco.mj_step(model, data)
        assert (np.abs(data.qfrc_actuator) <= robot.JOINT_TORQUE_NM + 1e-9).all()


def test_the_upright_arm_touches_nothing(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


def test_links_two_apart_cannot_meet_so_leaving_them_out_loses_nothing() -> None:
    own = Kinematics()
    geometry, objects = own.geometry, own.geometry.geometryObjects
    geometry.removeAllCollisionPairs()
    for i, first in enumerate(objects):
        for j in range(i + 1, len(objects)):
            if objects[j].parentJoint - first.parentJoint == 2:
                geometry.addCollisionPair(pin.CollisionPair(i, j))
    data, geometry_data = own.model.createData(), geometry.createData()
    # Only the two joints between such links matter.
    for joint in range(6):
        for a in np.linspace(-1.0, 1.0, 25):
            for b in np.linspace(-1.0, 1.0, 9):
                q = np.zeros(7)
                q[joint], q[joint + 1] = robot.JOINT_RANGE_RAD[joint : joint + 2] * (a, b)
                pin.updateGeometryPlacements(own.model, data, geometry, geometry_data, q)
                pin.computeDistances(geometry, geometry_data)
                assert min(r.min_distance for r in geometry_data.distanceResults) > 1e-3


def surface_physics(height_m: float) -> tuple[mjcf.Physics, Iiwa7]:
    arena, arm = composer.Arena(), Iiwa7(shells=False)
    arena.attach(arm)
    arena.mjcf_model.worldbody.add(
        "geom",
        name="surface",
        type="plane",
        size=[2, 2, 0.1],
        pos=[0, 0, height_m],
        contype=robot.SCENE_BIT,
        conaffinity=0,
    )
    return mjcf.Physics.from_mjcf_model(arena.mjcf_model), arm


@pytest.mark.parametrize(("height_m", "touches"), [(0.0, False), (0.049, False), (0.051, True)])
def test_the_flange_touches_a_surface_only_where_its_face_reaches_it(
    height_m: float, touches: bool
) -> None:
    physics, arm = surface_physics(height_m)
    q = fastest(np.array([0.6, 0.1, 0.05]), acceleration_limits=True)
    with physics.reset_context():
        physics.bind(arm.joints).qpos = q
    geoms = {physics.model.id2name(c.geom2, "geom") for c in physics.data.contact} | {
        physics.model.id2name(c.geom1, "geom") for c in physics.data.contact
    }
    # The base stands in every surface and must not count.
    assert not any("base" in name for name in geoms)
    assert any("link_7" in name for name in geoms) == touches


def test_folding_onto_the_base_is_a_contact_and_negative_clearance(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    data, found = mujoco.MjData(model), 0
    for _ in range(6_000):
        data.qpos[:] = rng.uniform(-1.0, 1.0, 7) * robot.JOINT_RANGE_RAD
        mujoco.mj_fwdPosition(model, data)
        if data.ncon:
            found += 1
            # A deep surface leaves only the arm itself.
            assert kinematics().clearance(data.qpos, surface_height_m=-9.0) < 1e-6
    assert found > 0


def test_shells_are_light_and_take_no_part_in_physics() -> None:
    physics = mjcf.Physics.from_mjcf_model(Iiwa7().mjcf_model)
    bare = mujoco.MjModel.from_xml_string(robot.robot_mjcf())
    np.testing.assert_allclose(physics.model.body_mass, bare.body_mass, atol=0)
    np.testing.assert_allclose(physics.model.body_inertia, bare.body_inertia, atol=1e-15)
    visual = physics.model.geom_group == robot.SHELL_GROUP
    assert visual.sum() == len(shells.link_shells())
    assert not physics.model.geom_contype[visual].any()
    assert not physics.model.geom_conaffinity[visual].any()
    assert sum(len(shell.mesh.faces) for shell in shells.link_shells()) < 4_000


def test_nothing_stands_in_front_of_the_flange_face() -> None:
    face = robot.FLANGE_HEIGHT_M - robot.JOINT_HEIGHTS_M[-1]
    for shell in shells.link_shells():
        if shell.body == "link_7":
            assert shell.mesh.vertices[:, 2].max() <= face + 1e-9
