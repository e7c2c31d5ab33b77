"""The four action modes: what they command, latency, limits, and actions that are none."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from postures import posture_at

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import (
    JOINT_ACCELERATION_RAD_S2,
    JOINT_RANGE_RAD,
    JOINT_SPEED_RAD_S,
)
from hvs_suite.errors import ActionError
from hvs_suite.tasks.shared.actions import JOINT_DELTA_RAD, TWIST_ANGULAR_RAD_S, TWIST_LINEAR_M_S
from hvs_suite.tasks.shared.environment import Environment

Named = Callable[..., Environment]
MODES = {"joint_position": 7, "joint_delta": 7, "joint_velocity": 7, "flange_twist": 6}
RELATIVE = ["joint_delta", "joint_velocity", "flange_twist"]
BENT = (0.3, 0.5, -0.2, -1.2, 0.3, 0.9, 0.4)


def bent(mode: str, task: str = "align-thesis", **options: Any) -> Environment:
    """A task without pictures whose arm starts bent, far from any singular posture."""
    env = hvs_suite.load(
        task, observations="state", action_mode=mode, start=BENT, time_limit_steps=100, **options
    )
    env.reset(scenario=0)
    return env


@pytest.mark.parametrize(("mode", "size"), MODES.items())
def test_actions_are_numbers_within_one(mode: str, size: int) -> None:
    spec = bent(mode).action_spec()
    assert (spec.shape, spec.dtype) == ((size,), np.float32)
    assert (spec.minimum, spec.maximum) == (-1.0, 1.0)


def test_joint_position_commands_fractions_of_the_joint_range() -> None:
    env = bent("joint_position")
    goal = np.array(BENT) + np.array([0.1, -0.1, 0.1, 0.1, -0.1, 0.1, 0.1])
    degrees = np.array([170, 120, 170, 120, 170, 120, 175])
    action = np.rad2deg(goal) / degrees
    for _ in range(6):
        env.step(action)
    np.testing.assert_allclose(env.joint_positions, goal, atol=1e-5)
    np.testing.assert_allclose(env.setpoint, goal, atol=1e-12)


def test_commandable_undoes_the_encoder_s_offset() -> None:
    env = bent("joint_position", "align-drill")
    goal = np.array(BENT) + 0.05
    assert np.abs(env.scenario.joint_offset).max() > 1e-4
    for _ in range(8):
        env.step(env.commandable(goal))
    np.testing.assert_allclose(env.joint_positions, goal, atol=1e-5)


def test_joint_delta_moves_the_set_point_by_a_tenth_of_a_radian() -> None:
    env = bent("joint_delta")
    env.step(np.full(7, 0.5))
    env.step(np.full(7, -0.25))
    np.testing.assert_allclose(env.setpoint, np.array(BENT) + 0.25 * JOINT_DELTA_RAD, atol=1e-12)


def test_joint_velocity_is_a_fraction_of_each_joint_s_limit() -> None:
    env = bent("joint_velocity")
    share = np.array([0.2, -0.2, 0.1, 0.3, -0.3, 0.2, 0.1])
    for _ in range(3):
        env.step(share)
    np.testing.assert_allclose(
        env.setpoint, np.array(BENT) + 0.3 * share * JOINT_SPEED_RAD_S, atol=1e-12
    )


@pytest.mark.parametrize("axis", range(6))
def test_flange_twist_moves_the_flange_along_the_commanded_direction(axis: int) -> None:
    env = bent("flange_twist")
    R0, p0 = kinematics().flange_pose(env.joint_positions)
    action = np.zeros(6)
    action[axis] = 0.1
    env.step(action)
    for _ in range(4):
        env.step(np.zeros(6))
    R1, p1 = kinematics().flange_pose(env.joint_positions)
    turned = R1 @ R0.T
    vector = np.array(
        [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    )
    moved = np.concatenate([p1 - p0, vector / 2])
    scale = 0.01 * np.repeat([TWIST_LINEAR_M_S, TWIST_ANGULAR_RAD_S], 3)
    expected = np.zeros(6)
    expected[axis] = scale[axis]
    # Within 4 % and a little drift: one step on a straight line in joint space, damped.
    np.testing.assert_allclose(moved, expected, atol=0.04 * max(expected) + 2e-5)


def test_a_twist_that_is_too_fast_is_slowed_down_as_a_whole() -> None:
    env = bent("flange_twist")
    fast = np.array([0.0, 0.0, 1.0, 0.0, 1.0, -1.0])
    before = env.setpoint
    env.step(fast)
    speed = (env.setpoint - before) / env.spec.control_period_s
    assert (np.abs(speed) <= JOINT_SPEED_RAD_S * (1 + 1e-9)).all()
    J = kinematics().jacobian(before)
    twist = fast * np.repeat([TWIST_LINEAR_M_S, TWIST_ANGULAR_RAD_S], 3)
    reached = J @ speed
    assert reached @ twist / np.linalg.norm(reached) / np.linalg.norm(twist) > 0.99


def test_a_twist_stays_finite_at_the_stretched_singular_posture() -> None:
    with hvs_suite.load("align-thesis", observations="state", action_mode="flange_twist") as env:
        env.reset(scenario=0)
        for _ in range(5):
            env.step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
            assert np.isfinite(env.joint_positions).all()
            assert (np.abs(env.joint_velocities) < 2 * JOINT_SPEED_RAD_S).all()


@pytest.mark.parametrize("mode", RELATIVE)
def test_a_zero_delta_means_no_motion_whatever_the_encoder_says(mode: str) -> None:
    env = bent(mode, "align-drill")
    assert np.abs(env.scenario.joint_offset).max() > 1e-4
    for _ in range(5):
        env.step(np.zeros(MODES[mode]))
    np.testing.assert_allclose(env.joint_positions, BENT, atol=1e-9)
    np.testing.assert_allclose(env.setpoint, BENT, atol=1e-12)


def test_measured_joints_hold_still_when_they_are_commanded_as_measured() -> None:
    """Set points live in the encoder's coordinates, the ones that a policy sees."""
    with hvs_suite.load(
        "align-drill", start=BENT, observations="eih+joint_positions", eih_resolution=16
    ) as env:
        seen = env.reset(scenario=0).observation["joint_positions"]
        np.testing.assert_allclose(seen, np.array(BENT) + env.scenario.joint_offset)
        for _ in range(4):
            env.step(seen / JOINT_RANGE_RAD)
        np.testing.assert_allclose(env.joint_positions, BENT, atol=1e-9)


@pytest.mark.parametrize("latency", [1, 2])
def test_latency_delays_an_action_by_whole_steps(latency: int) -> None:
    prompt = bent("joint_delta", latency_steps=0)
    late = bent("joint_delta", latency_steps=latency)
    actions = np.random.default_rng(0).uniform(-0.4, 0.4, (8, 7))
    told = [prompt.joint_positions]
    for action in actions:
        prompt.step(action)
        told.append(prompt.joint_positions)
    for k, action in enumerate(actions):
        late.step(action)
        expected = told[max(0, k + 1 - latency)]
        np.testing.assert_allclose(late.joint_positions, expected, atol=1e-12)
        assert len(late.pending_setpoints) == latency


@pytest.mark.parametrize(
    ("mode", "full_scale"),
    [
        ("joint_position", JOINT_RANGE_RAD),
        ("joint_delta", np.full(7, JOINT_DELTA_RAD)),
        ("joint_velocity", 0.1 * JOINT_SPEED_RAD_S),
    ],
)
def test_noise_on_actions_has_the_asked_strength_and_is_its_scene_s_own(
    mode: str, full_scale: npt.NDArray[np.float64]
) -> None:
    env = bent(mode, action_noise=0.01)
    stay = np.array(BENT) / JOINT_RANGE_RAD if mode == "joint_position" else np.zeros(7)

    def noise(scenario: int) -> npt.NDArray[np.float64]:
        env.reset(scenario=scenario)
        shown = [np.array(BENT)]
        for _ in range(60):
            env.step(stay)
            shown.append(env.setpoint)
        steps = np.array(shown)
        off = steps[1:] - BENT if mode == "joint_position" else np.diff(steps, axis=0)
        return off / full_scale

    first = noise(0)
    assert first.std() == pytest.approx(0.01, rel=0.1)
    assert abs(first.mean()) < 0.002
    # The same actions in the same scene do the same, so that an episode can be played again.
    np.testing.assert_array_equal(noise(0), first)
    assert np.abs(noise(1) - first).max() > 0.005


def test_noise_on_actions_leaves_the_scene_and_the_range_of_actions() -> None:
    with bent("joint_position") as quiet, bent("joint_position", action_noise=0.5) as noisy:
        assert noisy.scenario.digest() == quiet.scenario.digest()
        assert noisy.spec.describe().disturbances == "action noise"
        for _ in range(30):
            noisy.step(np.ones(7) * 0.99)
            assert (np.abs(noisy.setpoint) <= JOINT_RANGE_RAD).all()
            if noisy.info["collision"]:
                break


@pytest.mark.each_task("align-drill", "sequence-hard", "track-hard")
def test_tasks_answer_as_late_as_they_say(named: Named, task: str) -> None:
    env = named(task, "state")
    env.reset(scenario=0)
    env.step(env.commandable(env.scenario.start + 0.05))
    moved = np.abs(env.joint_positions - env.scenario.start).max() > 1e-3
    is_late = task in ("align-drill", "sequence-hard", "track-hard")
    assert moved == (not is_late)
    assert env.spec.latency_steps == int(is_late)


@pytest.mark.parametrize("mode", MODES)
def test_no_command_makes_a_joint_faster_than_the_robot(mode: str) -> None:
    env = bent(mode)
    rng = np.random.default_rng(1)
    before = env.setpoint
    for _ in range(20):
        if env.step(rng.uniform(-1, 1, MODES[mode])).last():
            break
        step = np.abs(env.setpoint - before)
        assert (step <= JOINT_SPEED_RAD_S * env.spec.control_period_s * (1 + 1e-9)).all()
        assert (np.abs(env.setpoint) <= JOINT_RANGE_RAD + 1e-9).all()
        before = env.setpoint


def bad_actions(size: int) -> list[Any]:
    nan, infinite, large = np.zeros(size), np.zeros(size), np.zeros(size)
    nan[2], infinite[0], large[1] = np.nan, -np.inf, 1.0001
    return [nan, infinite, large, np.zeros(size + 1), np.zeros((1, size)), 0.0, None, "up",
            [0.0] * (size - 1), [[0.0], [0.0, 1.0]]]  # fmt: skip


@pytest.mark.parametrize(("mode", "size"), MODES.items())
def test_an_action_that_is_none_is_refused_and_changes_nothing(mode: str, size: int) -> None:
    env = bent(mode)
    other = bent(mode)
    for action in bad_actions(size):
        with pytest.raises(ActionError) as raised:
            env.step(action)
        assert len(str(raised.value).splitlines()) == 1
    assert env.control_steps == 0
    for e in (env, other):
        e.step(np.full(size, 0.05))
    np.testing.assert_array_equal(env.joint_positions, other.joint_positions)


@pytest.mark.parametrize(
    ("value", "reason"), [(np.nan, r"action\[3\] is nan"), (np.inf, "inf"), (1.5, "clip it")]
)
def test_the_error_says_what_is_wrong(named: Named, value: float, reason: str) -> None:
    env = named("align-thesis", "state")
    env.reset(scenario=0)
    action = np.zeros(7)
    action[3] = value
    with pytest.raises(ActionError, match=reason):
        env.step(action)


def test_clipping_is_counted_and_does_what_the_bound_would() -> None:
    clipped, bounded = bent("joint_position"), bent("joint_position")
    clipped.clip_actions = True
    start = np.asarray(clipped.commandable(BENT), np.float64)
    for n, value in enumerate((1.7, 1.0, -3.0, 0.2)):
        action = start.copy()
        action[6] = value
        clipped.step(action)
        bounded.step(np.clip(action, -1, 1))
        assert clipped.info["n_clipped"] == [1, 1, 2, 2][n]
        np.testing.assert_array_equal(clipped.joint_positions, bounded.joint_positions)
    assert bounded.info["n_clipped"] == 0
    with pytest.raises(ActionError):
        clipped.step(np.full(7, np.nan))
    clipped.reset(scenario=0)
    assert clipped.info["n_clipped"] == 0


def set_point_speeds(env: Environment, action: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Speeds of the set point in every control step to the end of the episode, (n, 7) rad/s."""
    speeds, before = [np.zeros(7)], env.setpoint
    while True:
        last = env.step(action).last()
        speeds.append((env.setpoint - before) / env.spec.control_period_s)
        before = env.setpoint
        if last:
            return np.array(speeds)


def test_acceleration_limits_hold_and_the_arm_still_arrives() -> None:
    goal = posture_at(0.6, 0.1, 0.05)
    with hvs_suite.load(
        "align-thesis",
        observations="state",
        goal=(0.6, 0.1),
        acceleration_limits=True,
        time_limit_steps=30,
    ) as env:
        env.reset(scenario=0)
        speeds = set_point_speeds(env, env.commandable(goal))
        change = np.abs(np.diff(speeds, axis=0)) / env.spec.control_period_s
        assert (change <= JOINT_ACCELERATION_RAD_S2 * (1 + 1e-6)).all()
        assert (np.abs(speeds) <= JOINT_SPEED_RAD_S * (1 + 1e-9)).all()
        assert env.info["is_success"]
        # It neither overshoots nor creeps: within two control steps of the trapezoid.
        assert env.control_steps <= 17


def test_without_the_option_the_set_point_jumps_to_full_speed() -> None:
    with hvs_suite.load("align-thesis", observations="state", goal=(0.6, 0.1)) as env:
        env.reset(scenario=0)
        speeds = set_point_speeds(env, env.commandable(posture_at(0.6, 0.1, 0.05)))
        assert np.isclose(np.abs(speeds[1]), JOINT_SPEED_RAD_S).any()


def test_acceleration_limits_hold_through_changes_of_mind() -> None:
    env = bent("joint_position", acceleration_limits=True)
    rng = np.random.default_rng(2)
    before, speed = env.setpoint, np.zeros(7)
    for n in range(40):
        if n % 3 == 0:
            action = env.commandable(np.array(BENT) + rng.uniform(-0.3, 0.3, 7))
        env.step(action)
        new = (env.setpoint - before) / env.spec.control_period_s
        limit = JOINT_ACCELERATION_RAD_S2 * env.spec.control_period_s
        assert (np.abs(new - speed) <= limit * (1 + 1e-6)).all()
        before, speed = env.setpoint, new
