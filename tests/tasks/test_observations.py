"""Observations: presets, the thesis's twelve combinations, sizes, channels and normalisation."""

import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

import hvs_suite
from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S, JOINT_TORQUE_NM, robot_mjcf
from hvs_suite.tasks.shared.environment import Environment
from hvs_suite.tasks.shared.observations import NoiseBank

Named = Callable[..., Environment]
PRIVILEGED = {"flange_position", "goal_position", "goal_normal", "target_position", "joint_offset"}
# D.1 of the thesis: EIH, ETH or both, with and without positions and velocities.
TWELVE = [
    "+".join((*cameras, *joints))
    for cameras, joints in itertools.product(
        [("eih",), ("eth",), ("eih", "eth")],
        [(), ("joint_positions",), ("joint_velocities",), ("joint_positions", "joint_velocities")],
    )
]


@pytest.mark.parametrize("observations", TWELVE)
def test_every_input_combination_of_the_thesis_is_there(observations: str) -> None:
    with hvs_suite.load(
        "align-thesis", observations=observations, eih_resolution=32, eth_resolution=32
    ) as env:
        names = observations.split("+")
        assert list(env.observation_spec()) == names
        time_step = env.reset(scenario=0)
        assert list(time_step.observation) == names
        for name, spec in env.observation_spec().items():
            spec.validate(time_step.observation[name])


@pytest.mark.each_task
def test_vision_holds_nothing_privileged_and_state_no_pictures(named: Named, task: str) -> None:
    assert list(named(task).observation_spec()) == [
        "eih", "eth", "joint_positions", "joint_velocities", *named(task).spec.further_observations,
    ]  # fmt: skip
    state = named(task, "state")
    assert set(state.observation_spec()) >= {"goal_position", "joint_positions"}
    assert all(len(spec.shape) == 1 for spec in state.observation_spec().values())
    assert not set(named(task).observation_spec()) & PRIVILEGED


@pytest.mark.each_task
def test_pictures_have_the_size_of_the_variant(named: Named, task: str) -> None:
    env = named(task)
    seen = env.reset(scenario=0).observation
    for name in ("eih", "eth"):
        side = getattr(env.spec, f"{name}_resolution")
        assert seen[name].shape == (side, side, 3)
        assert seen[name].dtype == np.uint8
    assert seen["joint_positions"].shape == seen["joint_velocities"].shape == (7,)


def test_the_thesis_s_pictures_are_112_px_in_colour(named: Named) -> None:
    spec = named("align-thesis").observation_spec()
    assert spec["eih"].shape == spec["eth"].shape == (112, 112, 3)


@pytest.mark.parametrize(("eih", "eth"), [(64, 112), (112, 33), (8, 200)])
@pytest.mark.parametrize(("eih_channels", "eth_channels"), [(1, 3), (3, 1)])
def test_each_camera_has_a_resolution_and_channels_of_its_own(
    eih: int, eth: int, eih_channels: int, eth_channels: int
) -> None:
    with hvs_suite.load(
        "align-thesis",
        eih_resolution=eih,
        eth_resolution=eth,
        eih_channels=eih_channels,
        eth_channels=eth_channels,
    ) as env:
        seen = env.reset(scenario=0).observation
        assert seen["eih"].shape == (eih, eih, eih_channels)
        assert seen["eth"].shape == (eth, eth, eth_channels)


def test_grey_is_the_luma_of_the_colour_picture() -> None:
    with (
        hvs_suite.load("align-thesis", eth_channels=1) as grey,
        hvs_suite.load("align-thesis") as colour,
    ):
        one = grey.reset(scenario=0).observation["eth"][..., 0]
        three = colour.reset(scenario=0).observation["eth"]
        np.testing.assert_allclose(one, three @ [0.299, 0.587, 0.114], atol=0.51)


def test_normalised_observations_have_the_thesis_s_ranges() -> None:
    """Pictures to [0, 1], joints to [-1, 1]; the same scene otherwise."""
    with (
        hvs_suite.load("align-thesis", normalise_observation=True) as env,
        hvs_suite.load("align-thesis") as raw,
    ):
        for name, spec in env.observation_spec().items():
            assert spec.dtype == np.float32
            assert spec.minimum.min() == (0.0 if name in ("eih", "eth") else -1.0)
            assert spec.maximum.max() == 1.0
        raw.reset(scenario=0)
        move = raw.commandable(np.deg2rad([20, 30, -20, -40, 20, 30, 50]))
        for e in (env, raw):
            e.reset(scenario=0)
        for _ in range(3):
            seen, plain = env.step(move).observation, raw.step(move).observation
        for name, spec in env.observation_spec().items():
            spec.validate(seen[name])
        np.testing.assert_allclose(seen["eth"], plain["eth"] / 255.0, atol=1e-6)
        np.testing.assert_allclose(
            seen["joint_positions"], plain["joint_positions"] / JOINT_RANGE_RAD, atol=1e-6
        )
        # An arm that passes its set point's speed by a hair reads as full speed.
        speed = np.clip(plain["joint_velocities"] / JOINT_SPEED_RAD_S, -1.0, 1.0)
        np.testing.assert_allclose(seen["joint_velocities"], speed, atol=1e-6)
        assert np.abs(seen["joint_velocities"]).max() > 0.3


@pytest.mark.parametrize("task", ["align-thesis", "align-drill"])
def test_joints_are_measured_with_the_encoder_s_offset(named: Named, task: str) -> None:
    env = named(task)
    seen = env.reset(scenario=1).observation
    np.testing.assert_allclose(
        seen["joint_positions"], env.scenario.start + env.scenario.joint_offset, atol=1e-12
    )
    assert env.scenario.joint_offset.any() == (task == "align-drill")
    np.testing.assert_array_equal(seen["joint_velocities"], 0.0)


def test_joint_velocities_are_those_of_the_motion(named: Named) -> None:
    env = named("align-thesis")
    env.reset(scenario=0)
    goal = env.commandable(np.deg2rad([60, 20, 0, -40, 0, 30, 0]))
    seen: list[Any] = [env.step(goal).observation for _ in range(4)]
    # Joint A1 cruises at its limit of 98 deg/s by then.
    rate = (seen[3]["joint_positions"][0] - seen[2]["joint_positions"][0]) / 0.1
    assert rate == pytest.approx(np.deg2rad(98), rel=0.01)
    assert seen[3]["joint_velocities"][0] == pytest.approx(np.deg2rad(98), rel=0.01)


def played(observations: str, **options: Any) -> list[dict[str, Any]]:
    """What is seen on the way to a bent posture, and at rest there."""
    with hvs_suite.load(
        "align-thesis", observations=observations, eih_resolution=8, time_limit_steps=40, **options
    ) as env:
        goal = np.deg2rad([60, 60, 0, -70, 0, 50, 0])
        steps = [env.reset(scenario=0)]
        steps += [env.step(env.commandable(goal)) for _ in range(20)]
        for name, spec in env.observation_spec().items():
            for time_step in steps:
                spec.validate(time_step.observation[name])
        return [dict(time_step.observation) for time_step in steps]


def test_joint_torques_carry_the_arm_and_move_it() -> None:
    seen = [step["joint_torques"] for step in played("eih+joint_torques")]
    # The upright arm weighs on no joint.
    np.testing.assert_allclose(seen[0], 0.0, atol=1e-9)
    model = mujoco.MjModel.from_xml_string(robot_mjcf())
    data = mujoco.MjData(model)
    data.qpos[:7] = np.deg2rad([60, 60, 0, -70, 0, 50, 0])
    mujoco.mj_forward(model, data)
    weight = data.qfrc_bias[:7]
    assert abs(weight[1]) > 40.0
    np.testing.assert_allclose(seen[-1], weight, atol=0.05)
    # To start turning takes torque about the first axis, on which no weight ever lies.
    assert seen[1][0] > 5.0


def test_joint_torques_have_the_robot_s_limits_as_their_full_scale() -> None:
    raw = np.array([step["joint_torques"] for step in played("eih+joint_torques")])
    scaled = played("eih+joint_torques", normalise_observation=True)
    np.testing.assert_allclose(
        [step["joint_torques"] for step in scaled], raw / JOINT_TORQUE_NM, atol=1e-6
    )


def test_measuring_torques_changes_nothing_else() -> None:
    told, plain = played("eih+joint_positions+joint_torques"), played("eih+joint_positions")
    for one, other in zip(told, plain, strict=True):
        np.testing.assert_array_equal(one["joint_positions"], other["joint_positions"])


def test_measurements_stay_within_their_bounds_at_full_speed() -> None:
    with hvs_suite.load("align-drill", observations="state", time_limit_steps=200) as env:
        spec = env.observation_spec()
        rng = np.random.default_rng(3)
        for scenario in range(8):
            env.reset(scenario=scenario)
            for _ in range(20):
                time_step = env.step(rng.uniform(-1, 1, 7))
                for name, item in spec.items():
                    item.validate(time_step.observation[name])
                if time_step.last():
                    break


def test_image_noise_has_the_asked_strength_and_is_its_scene_s_own() -> None:
    with hvs_suite.load("align-hard", split="test") as env:
        first = env.reset(scenario=0).observation
        again = env.task.observables["eth"](env.physics, None)
        np.testing.assert_array_equal(first["eth"], again)
        second = env.step(env.commandable(env.scenario.start)).observation
        # The scene stands still: what differs is noise of 4 grey levels, drawn anew each step.
        noise = first["eth"].astype(float) - second["eth"].astype(float)
        assert noise.std() == pytest.approx(4.0 * np.sqrt(2.0), rel=0.1)
        assert abs(noise.mean()) < 0.1
        other = env.reset(scenario=1).observation
        assert (other["eih"] != first["eih"]).any()
        np.testing.assert_array_equal(env.reset(scenario=0).observation["eih"], first["eih"])


@pytest.mark.parametrize("sigma", [4.0, 100.0])
def test_noise_of_any_strength_is_added_and_cut_to_the_range_of_a_pixel(sigma: float) -> None:
    bank = NoiseBank(sigma)
    black, grey, white = (np.full((64, 64, 3), level, np.uint8) for level in (0, 100, 255))
    for image in (black, grey, white):
        bank.disturb(image, np.random.default_rng(0))
    # Black shows what noise adds, white what it takes away.
    noise = black.astype(int) + (white.astype(int) - 255)
    np.testing.assert_array_equal(grey, np.clip(100 + noise, 0, 255))
    assert (noise > 0).any()
    assert (noise < 0).any()


def test_depth_comes_beside_the_other_observations_on_request() -> None:
    with hvs_suite.load(
        "align-thesis",
        observations="eih+eih_depth+eth_depth+joint_positions",
        eih_resolution=24,
        eth_resolution=40,
    ) as env:
        seen = env.reset(scenario=0).observation
        assert seen["eih_depth"].shape == (24, 24, 1)
        assert seen["eth_depth"].shape == (40, 40, 1)
        for name, spec in env.observation_spec().items():
            spec.validate(seen[name])
        # Eye to hand stands 2.9 m off, and the arm is nearer than the table.
        assert 1.3 < seen["eth_depth"].min() < 2.5


def test_the_state_preset_tells_where_flange_and_goal_are(named: Named) -> None:
    env = named("align-limit", "state")
    seen = env.reset(scenario=0).observation
    np.testing.assert_allclose(seen["goal_position"], env.privileged()["goal_position"])
    np.testing.assert_allclose(
        np.linalg.norm(seen["goal_position"] - seen["flange_position"]) * 1000,
        env.info["errors"]["position_error_mm"],
    )
