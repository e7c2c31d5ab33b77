"""The prior: what demonstrations say of where goals are and of how cameras show them."""

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.spatial.transform import Rotation

from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from hvs_suite.policies.belief.belief import ACCELERATION, PLACE, VELOCITY, View
from hvs_suite.policies.belief.prior import WIDER, fit_prior
from hvs_suite.policies.belief.recorded import set_points

PERIOD_S = 0.1
TAN = 0.7
SIZE_M = 0.04
FloatArray = npt.NDArray[np.float64]


def looks(
    n: int, standoff_m: float, *, straight: bool = False
) -> tuple[dict[str, FloatArray], dict[str, View]]:
    """Goals over sloped targets, and a camera that sees the targets from above, or never."""
    random = np.random.default_rng(0)
    slope = 0.0 if straight else 0.2
    normal = np.concatenate([random.normal(0.0, slope, (n, 2)), np.ones((n, 1))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    target = random.uniform(-0.5, 0.5, (n, 3))
    offset = random.uniform(-0.2, 0.2, (n, 3)) * (0.0 if straight else 1.0)
    origin = target + np.array([0.0, 0.0, 0.6]) + offset
    optical = (target - origin) * np.array([1.0, -1.0, -1.0])  # it looks straight down
    uv = optical[:, :2] / optical[:, 2:] / TAN
    diameter = SIZE_M / (2.0 * TAN * optical[:, 2:])
    columns = {
        "privileged.goal_position": target + standoff_m * normal,
        "privileged.goal_normal": normal,
        "privileged.target_eih": np.concatenate([uv, diameter, np.ones((n, 1))], axis=1),
        "episode_index": np.arange(n) // 10,
    }
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    view = View(torch.from_numpy(origin), down.expand(n, 3, 3), TAN)
    return columns, {"eih": view}


@pytest.mark.parametrize("standoff_m", [0.05, 0.0, -0.012])
def test_rays_say_how_far_the_goal_is_from_the_target(standoff_m: float) -> None:
    columns, views = looks(200, standoff_m)
    prior = fit_prior(columns, views, PERIOD_S)
    assert prior.standoff_m == pytest.approx(standoff_m, abs=1e-9)
    assert prior.sizes["eih"] == pytest.approx(SIZE_M / (2.0 * TAN), rel=1e-9)
    target = columns["privileged.goal_position"] - standoff_m * columns["privileged.goal_normal"]
    np.testing.assert_allclose(prior.place, target.mean(axis=0), atol=1e-9)
    spread = prior.covariance[PLACE, PLACE]
    np.testing.assert_allclose(spread, WIDER * np.cov(target.T, bias=True), atol=1e-8)
    assert prior.slope_variance == pytest.approx(WIDER * 0.2**2, rel=0.3)
    assert torch.linalg.eigvalsh(prior.covariance).min() > 0.0


def test_how_a_camera_is_shifted_and_turned_has_its_variances_from_the_demonstrations() -> None:
    columns, views = looks(1000, 0.05)
    exact = fit_prior(columns, views, PERIOD_S)
    assert max(*exact.offsets["eih"], exact.drifts["eih"]) < 1e-8
    # In each episode it is elsewhere than it is taken to be: the others turn about its centre.
    random, episode = np.random.default_rng(1), columns["episode_index"]
    shift, turn = (random.normal(0.0, sd, (100, 3))[episode] for sd in (0.01, 0.02))
    view = views["eih"]
    R = Rotation.from_rotvec(turn).as_matrix() @ view.rotation.numpy()
    nominal = View(view.origin + torch.from_numpy(shift), torch.from_numpy(R), view.tan)
    prior = fit_prior(columns, {"eih": nominal}, PERIOD_S)
    np.testing.assert_allclose(np.sqrt(prior.offsets["eih"]), [0.01, 0.02], rtol=0.25)
    assert np.sqrt(prior.drifts["eih"]) < 1e-3


def test_a_target_that_nobody_sees_has_its_goals_for_a_prior() -> None:
    columns, views = looks(50, 0.05)
    columns["privileged.target_eih"][:, 3] = 0.0
    prior = fit_prior(columns, views, PERIOD_S)
    assert prior.standoff_m == 0.0
    np.testing.assert_allclose(prior.place, columns["privileged.goal_position"].mean(axis=0))


def test_goals_that_move_have_velocity_and_acceleration_within_an_episode_alone() -> None:
    columns, views = looks(40, 0.05)
    still = fit_prior(columns, views, PERIOD_S).covariance
    assert still[VELOCITY, VELOCITY].max() < 1e-9
    # Steady in each episode, but faster from one to the next.
    velocity = np.zeros((40, 3))
    velocity[:, 0] = 0.1 * columns["episode_index"]
    steady = fit_prior({**columns, "privileged.goal_velocity": velocity}, views, PERIOD_S)
    moving = steady.covariance[VELOCITY, VELOCITY]
    assert moving[0, 0] == pytest.approx(WIDER * np.mean(velocity[:, 0] ** 2), rel=1e-6)
    assert steady.covariance[ACCELERATION, ACCELERATION].max() < 1e-9
    velocity[:, 1] = 0.03 * (np.arange(40) % 2)
    shaken = fit_prior({**columns, "privileged.goal_velocity": velocity}, views, PERIOD_S)
    acceleration = shaken.covariance[ACCELERATION, ACCELERATION]
    assert acceleration[1, 1] == pytest.approx(WIDER * 0.3**2, rel=1e-6)


def test_set_points_follow_what_was_done_and_begin_where_the_arm_is() -> None:
    random = np.random.default_rng(0)
    state = random.uniform(-0.5, 0.5, (6, 14))
    executed = random.uniform(-1.0, 1.0, (6, 7))
    executed[0] = state[0, :7] / JOINT_RANGE_RAD  # it stays
    columns = {
        "observation.state": state,
        "privileged.action_executed": executed,
        "episode_index": np.array([3, 3, 3, 7, 7, 7]),
    }
    points = set_points(columns, PERIOD_S)
    np.testing.assert_allclose(points[[0, 1, 3]], state[[0, 0, 3], :7])
    way = executed[1] * JOINT_RANGE_RAD - points[1]
    furthest = PERIOD_S * JOINT_SPEED_RAD_S
    np.testing.assert_allclose(points[2], points[1] + np.clip(way, -furthest, furthest))
