"""Pinocchio against MuJoCo, the closed-form inverse, travel times and clearance."""

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from hvs_suite.cell import robot
from hvs_suite.cell.kinematics import Kinematics, kinematics, tool_frame, travel_time

FloatArray = npt.NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(robot.robot_mjcf())


def random_configurations(n: int, seed: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 7)) * robot.JOINT_RANGE_RAD


def ring_goal(rng: np.random.Generator) -> FloatArray:
    radius, azimuth = np.sqrt(rng.uniform(0.40**2, 0.78**2)), rng.uniform(-np.pi, np.pi)
    return np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.05])


def test_pinocchio_and_mujoco_agree_on_pose_jacobian_mass_and_gravity(
    model: mujoco.MjModel,
) -> None:
    data = mujoco.MjData(model)
    for q in random_configurations(100, seed=0):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        R, p = kinematics().flange_pose(q)
        np.testing.assert_allclose(R, data.site("flange").xmat.reshape(3, 3), rtol=0, atol=1e-9)
        np.testing.assert_allclose(p, data.site("flange").xpos, rtol=0, atol=1e-9)
        J = np.zeros((6, 7))
        mujoco.mj_jacSite(model, data, J[:3], J[3:], model.site("flange").id)
        np.testing.assert_allclose(kinematics().jacobian(q), J, rtol=0, atol=1e-9)
        M = np.zeros((7, 7))
        mujoco.mj_fullM(model, data, M)
        np.testing.assert_allclose(kinematics().mass_matrix(q), M, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            kinematics().gravity_torques(q), data.qfrc_bias, rtol=0, atol=1e-9
        )


def test_inverse_kinematics_reproduces_any_reachable_pose_and_finds_the_original() -> None:
    grid = np.linspace(0.0, 2.0 * np.pi, 7)[:-1]
    for q in random_configurations(60, seed=1):
        R, p = kinematics().flange_pose(q)
        frame = tool_frame(-R[:, 2])
        yaw = np.arctan2(R[:, 0] @ frame[:, 1], R[:, 0] @ frame[:, 0])
        solutions = kinematics().inverse_kinematics(p, -R[:, 2], yaw, grid)
        for solution in solutions:
            assert (np.abs(solution) <= robot.JOINT_RANGE_RAD).all()
            R_solution, p_solution = kinematics().flange_pose(solution)
            np.testing.assert_allclose(R_solution, R, atol=1e-9)
            np.testing.assert_allclose(p_solution, p, atol=1e-9)
        fine = kinematics().inverse_kinematics(p, -R[:, 2], yaw, np.arange(0, 2 * np.pi, 0.005))
        nearest = np.abs(fine[:, :6] - q[:6]).max(axis=1).min()
        # Swivels are 5 mrad apart; near singular shapes joints move faster than the swivel.
        assert nearest < 0.05 or min(abs(np.sin(q[1])), abs(np.sin(q[5]))) < 0.3


def test_inverse_kinematics_pairs_yaws_with_swivels_and_yields_all_eight_shapes() -> None:
    q = kinematics().inverse_kinematics([0.7, 0.1, 0.5], [-1.0, 0.0, 0.0], [0.4, 1.3], [0.7, 1.4])
    frame = tool_frame([-1.0, 0.0, 0.0])
    yaws = []
    for solution in q:
        R, _ = kinematics().flange_pose(solution)
        yaws.append(np.arctan2(R[:, 0] @ frame[:, 1], R[:, 0] @ frame[:, 0]))
    assert all(min(abs(yaw - 0.4), abs(yaw - 1.3)) < 1e-9 for yaw in yaws)
    signs = {tuple(np.sign(solution[[1, 3, 5]])) for solution in q}
    assert len(signs) == 8


@pytest.mark.parametrize(
    ("position", "normal"),
    [
        ((0.0, 0.0, 1.266), (0.0, 0.0, -1.0)),  # upright: elbow, shoulder and flange straight
        ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),  # wrist above the shoulder
        ((0.926, 0.0, 0.340), (-1.0, 0.0, 0.0)),  # stretched out level
    ],
)
def test_singular_shapes_have_exact_solutions_without_nan(
    position: tuple[float, float, float], normal: tuple[float, float, float]
) -> None:
    q = kinematics().goal_configurations(position, normal, n_yaw=6, n_swivel=8)
    assert len(q) > 0
    assert np.isfinite(q).all()
    for solution in q[:: max(1, len(q) // 50)]:
        R, p = kinematics().flange_pose(solution)
        np.testing.assert_allclose(p, position, atol=1e-9)
        np.testing.assert_allclose(R[:, 2], -np.asarray(normal), atol=1e-9)


@pytest.mark.parametrize(("radius", "reachable"), [(0.40, True), (0.78, True), (0.79, False)])
def test_the_whole_ring_can_be_reached_and_no_more(radius: float, reachable: bool) -> None:
    for azimuth in np.linspace(-np.pi, np.pi, 13):
        position = [radius * np.cos(azimuth), radius * np.sin(azimuth), 0.05]
        q = kinematics().goal_configurations(position, UP)
        assert (len(q) > 0) == reachable
        assert (np.abs(q) <= robot.JOINT_RANGE_RAD).all()


def test_a_free_yaw_lets_the_tool_joint_rest_and_loses_no_time() -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        position, start = ring_goal(rng), random_configurations(1, int(rng.integers(1000)))[0]
        every = kinematics().goal_configurations(position, UP, n_yaw=36, n_swivel=72)
        still = kinematics().goal_configurations_at_tool_angle(position, UP, start[6])
        assert still[:, 6] == pytest.approx(start[6])
        for limits in (False, True):
            best = travel_time(start, every, limits).min()
            assert travel_time(start, still, limits).min() <= best + 1e-12


def test_travel_times_over_the_ring_are_those_of_the_published_limits() -> None:
    rng = np.random.default_rng(3)
    speed, full = [], []
    for _ in range(300):
        q = kinematics().goal_configurations_at_tool_angle(ring_goal(rng), UP, 0.0, n_swivel=144)
        speed.append(travel_time(np.zeros(7), q, acceleration_limits=False).min())
        full.append(travel_time(np.zeros(7), q, acceleration_limits=True).min())
    assert np.mean(speed) == pytest.approx(0.78, abs=0.02)
    assert 0.95 < max(speed) < 1.0
    assert np.mean(full) == pytest.approx(1.06, abs=0.02)
    assert 1.25 < max(full) < 1.31


def test_travel_time_of_one_joint_is_the_trapezoid_or_the_triangle() -> None:
    v, a = robot.JOINT_SPEED_RAD_S[0], robot.JOINT_ACCELERATION_RAD_S2[0]
    q = np.zeros((2, 7))
    q[:, 0] = [0.01, 2.0]
    times = travel_time(np.zeros(7), q, acceleration_limits=True)
    np.testing.assert_allclose(times, [2.0 * np.sqrt(0.01 / a), 2.0 / v + v / a])
    np.testing.assert_allclose(travel_time(np.zeros(7), q, False), [0.01 / v, 2.0 / v])


def test_the_default_grids_are_within_two_percent_of_the_fastest_way() -> None:
    rng = np.random.default_rng(4)
    for _ in range(25):
        position = ring_goal(rng)
        dense, usual = (
            travel_time(
                np.zeros(7),
                kinematics().goal_configurations_at_tool_angle(position, UP, 0.0, n_swivel=n),
                acceleration_limits=True,
            ).min()
            for n in (1440, 72)
        )
        assert usual <= 1.02 * dense


def test_clearance_is_the_least_of_all_distances_wherever_the_arm_is() -> None:
    """It measures simpler bodies first; this measures every pair as it is."""
    import pinocchio as pin

    model = Kinematics()
    scene = model._scene
    data = scene.createData()
    random = np.random.default_rng(3)
    for height, normal in ((0.0, (0.0, 0.0, 1.0)), (-0.1, (0.28, 0.0, 0.96))):
        for q in random.uniform(-robot.JOINT_RANGE_RAD, robot.JOINT_RANGE_RAD, (200, 7)):
            clearance = model.clearance(q, height, normal)
            pin.computeDistances(model.model, model._data, scene, data, q)
            least = min(result.min_distance for result in data.distanceResults)
            assert clearance == pytest.approx(least, abs=1e-5)


def test_clearance_over_a_surface_is_the_standoff_where_the_flange_is_lowest() -> None:
    q = kinematics().goal_configurations_at_tool_angle([0.55, 0.0, 0.05], UP, 0.0)
    clearances = [kinematics().clearance(solution) for solution in q]
    assert max(clearances) == pytest.approx(0.05, abs=1e-9)
    best = q[int(np.argmax(clearances))]
    assert kinematics().clearance(best, surface_height_m=0.08) == pytest.approx(-0.03, abs=1e-9)
