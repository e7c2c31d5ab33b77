"""What a named task may be loaded with, and the one clear line for what makes no sense."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from postures import posture_at

import hvs_suite
from hvs_suite.errors import HvsError, OptionError, UnknownTaskError
from hvs_suite.tasks.shared.option_types import to_text
from hvs_suite.tasks.shared.spec import JOINT_LIMITS_DEG


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("align-thesi", "did you mean align-thesis"),
        ("algn-hard", "align-hard"),
        ("align_easy", "align-easy"),
        ("polish", "choose from align-fixed, align-easy"),
        ("", "choose from"),
    ],
)
def test_an_unknown_task_is_refused_with_the_nearest_names(name: str, hint: str) -> None:
    with pytest.raises(UnknownTaskError, match=hint) as raised:
        hvs_suite.load(name)
    assert isinstance(raised.value, LookupError)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (
            {"resolution": 64},
            "no option 'resolution'; did you mean eth_resolution or eih_resolution",
        ),
        ({"time_limits": 64}, "did you mean time_limit"),
        ({"colour": "blue"}, "no option 'colour'"),
        ({"version": 2}, "no option 'version'"),
        ({"eih_resolution": 0}, "eih_resolution is 0 px; use 8 to 2048"),
        ({"eth_resolution": -5}, "eth_resolution is -5 px"),
        ({"eth_resolution": 4096}, "eth_resolution is 4096 px"),
        ({"eih_resolution": 64.0}, "eih_resolution is 64.0, which is not int"),
        ({"eih_resolution": True}, "eih_resolution is True"),
        ({"eih_channels": 2}, r"use 3 \(RGB\) or 1 \(grey\)"),
        ({"observations": "joint_positions+joint_velocities"}, "both cameras off"),
        ({"observations": "joint_positions"}, "keep eih or eth"),
        ({"observations": "eih+eih"}, "twice"),
        ({"observations": "eih+goal_position"}, "unknown observation 'goal_position'"),
        ({"observations": ""}, "unknown observation ''"),
        ({"observations": 3}, "observations is 3"),
        ({"action_mode": "joint_torque"}, "action_mode is 'joint_torque'"),
        ({"rewards": ("goal", "style")}, "rewards is"),
        ({"rewards": "goal"}, "rewards is"),
        ({"start": (0.0,) * 6}, "start has 6 angles"),
        ({"start": (0.0, 2.2, 0.0, 0.0, 0.0, 0.0, 0.0)}, r"beyond joint A2's 120 deg"),
        ({"start": "upside-down"}, "start is"),
        ({"goal": (0.0, 0.05)}, "under the robot's base"),
        ({"goal": (1.0, 1.0)}, "out of the arm's reach"),
        ({"goal": (math.nan, 0.5)}, "goal is"),
        ({"goal": "there"}, "goal is"),
        ({"ring_m": (0.7, 0.4)}, "inner and a larger outer radius"),
        ({"surface": "wavy"}, "surface is 'wavy'"),
        ({"surface_size_m": (0.0, 1.0)}, "both sides are positive"),
        ({"marker": "cross"}, "marker is 'cross'"),
        ({"target_diameter_m": 0.0}, "must be positive"),
        ({"standoff_m": -0.05}, "must be positive"),
        ({"position_tolerance_mm": 0.0}, "must be positive"),
        ({"position_tolerance_mm": None}, "both lateral_tolerance_mm and height_tolerance_mm"),
        ({"tilt_tolerance_deg": -1.0}, "must be positive"),
        ({"hold_steps": 0}, "whole number from 1 up"),
        ({"time_limit_steps": 0}, "whole number from 1 up"),
        ({"time_limit_steps": 2.5}, "which is not int"),
        ({"time_limit": "firm"}, "time_limit is 'firm'"),
        ({"control_period_s": 0.0}, "must be positive"),
        ({"discount": 1.5}, "use 0 to 1"),
        ({"multisampling": 3}, "use 0, 2, 4 or 8"),
        ({"eih_fov_deg": 180.0}, "use 1 to 150"),
        ({"eth_position_m": (0.1, 0.1, 3.0), "eth_look_at_m": (0.1, 0.1, 0.0)}, "straight above"),
        ({"eth_position_m": (0.1, 0.1)}, "eth_position_m is"),
        ({"image_noise": -1.0}, "cannot be negative"),
        ({"action_noise": -0.1}, "action_noise is -0.1; it cannot be negative"),
        ({"joint_offset_deg": math.inf}, "joint_offset_deg is inf"),
        ({"latency_steps": -1}, "latency_steps is -1"),
        ({"vary_light": 1}, "vary_light is 1"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 1.5}, "seed is 1.5"),
    ],
)
def test_an_option_that_makes_no_sense_is_refused_in_one_line(
    options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(OptionError, match=reason) as raised:
        hvs_suite.load("align-thesis", **options)
    assert len(str(raised.value).splitlines()) == 1
    assert isinstance(raised.value, HvsError)


def test_a_control_period_has_to_be_a_whole_number_of_physics_steps() -> None:
    for period in (0.05, 0.2):
        with hvs_suite.load("align-thesis", observations="state", control_period_s=period) as env:
            env.reset(scenario=0)
            env.step(np.zeros(7))
            assert env.physics.data.time == pytest.approx(period)
            assert env.control_timestep() == period
    with pytest.raises(OptionError, match="control_period_s"):
        hvs_suite.load("align-thesis", control_period_s=0.0033)


def test_lists_do_for_tuples_as_they_come_from_json() -> None:
    with hvs_suite.load(
        "align-thesis", observations="state", goal=[0.5, 0.2], rewards=["goal", "time"]
    ) as env:
        assert env.spec.goal == (0.5, 0.2)
        assert env.spec.rewards == ("goal", "time")


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (["target_diameter_m=0.03"], {"target_diameter_m": 0.03}),
        (["ring_m=0.45,0.7"], {"ring_m": (0.45, 0.7)}),
        (["ring_m = (0.45, 0.7)"], {"ring_m": (0.45, 0.7)}),
        (["vary_light=true", "vary_colour=True"], {"vary_light": True, "vary_colour": True}),
        (["marker=ring", "latency_steps=1"], {"marker": "ring", "latency_steps": 1}),
        (["start=near_goal", "goal=0.5,-0.3"], {"start": "near_goal", "goal": (0.5, -0.3)}),
        (["start=0,0.5,0,-1,0,1,0"], {"start": (0, 0.5, 0, -1, 0, 1, 0)}),
        (["rewards=goal", "standoff_m=1e-1"], {"rewards": ("goal",), "standoff_m": 0.1}),
        (["observations=eih+joint_positions"], {"observations": "eih+joint_positions"}),
        (
            ["position_tolerance_mm=none", "lateral_tolerance_mm=0.2", "height_tolerance_mm=1"],
            {
                "position_tolerance_mm": None,
                "lateral_tolerance_mm": 0.2,
                "height_tolerance_mm": 1,
            },
        ),
        # What the task has already changes nothing.
        (["hold_steps=1", "marker=disc", "vary_light=false", "standoff_m=0.05"], {}),
    ],
)
def test_options_are_read_from_text_by_their_own_types(
    words: list[str], options: dict[str, Any]
) -> None:
    assert hvs_suite.TASKS["align-thesis"].options_from_text(words) == options


@pytest.mark.each_task
def test_every_parameter_of_a_task_can_be_given_as_text(task: str) -> None:
    spec = hvs_suite.TASKS[task]
    parameters = dataclasses.asdict(spec)
    del parameters["name"], parameters["version"]
    words = [f"{name}={to_text(value)}" for name, value in parameters.items()]
    assert spec.options_from_text(words) == {}
    # A spec of other values takes the same words for changes.
    other = dataclasses.replace(spec, time_limit_steps=spec.time_limit_steps + 1)
    assert other.options_from_text(words) == {"time_limit_steps": spec.time_limit_steps}


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["colour=red"], "no option 'colour'; did you mean vary_colour"),
        (["xyzzy=1"], "no option 'xyzzy'; use .*target_diameter_m.*"),
        (["marker"], "given as name=value"),
        (["=1"], "no option ''"),
        (["name=align-hard"], "no option 'name'"),
        (["marker=cross"], "marker is 'cross', which is not disc, ring or fiducial"),
        (["time_limit_steps=2.5"], "time_limit_steps is 2.5, which is not int"),
        (["target_diameter_m=wide"], "target_diameter_m is 'wide', which is not float"),
        (["target_diameter_m=nan"], "target_diameter_m is nan"),
        (["vary_light=1"], "vary_light is 1, which is not bool"),
        (["ring_m=0.5"], r"ring_m is 0.5, which is not \(float, float\)"),
        (["ring_m=0.5,0.6,0.7"], "ring_m is"),
        (["ring_m=0.7,0.4"], "inner and a larger outer radius"),
        (["marker=ring", "marker=disc"], "marker is given twice"),
    ],
)
def test_text_that_is_no_option_is_refused_in_one_line(words: list[str], reason: str) -> None:
    with pytest.raises(OptionError, match=reason) as raised:
        hvs_suite.TASKS["align-thesis"].options_from_text(words)
    assert len(str(raised.value).splitlines()) == 1


def test_joint_limits_of_the_options_are_those_of_the_robot() -> None:
    from hvs_suite.cell.robot import JOINT_RANGE_RAD

    np.testing.assert_allclose(np.deg2rad(JOINT_LIMITS_DEG), JOINT_RANGE_RAD)


@pytest.mark.parametrize("start", [(0.0,) * 7, (0.1, 0.4, -0.1, -0.9, 0.2, 0.7, 1.0)])
def test_the_arm_starts_where_it_is_told_to(start: tuple[float, ...]) -> None:
    with hvs_suite.load("align-easy", observations="state", start=start) as env:
        env.reset(scenario=0)
        np.testing.assert_array_equal(env.joint_positions, start)
        np.testing.assert_array_equal(env.setpoint, start)
        np.testing.assert_array_equal(env.joint_velocities, 0.0)


@pytest.mark.parametrize("start", ["zero", "random", "fixed", "near_goal", "mixed"])
@pytest.mark.parametrize("goal", ["random", "fixed", "places", (0.5, -0.3)])
def test_every_start_goes_with_every_goal(start: str, goal: Any) -> None:
    with hvs_suite.load(
        "align-easy", observations="state", start=start, goal=goal, time_limit_steps=30
    ) as env:
        starts, goals = set(), set()
        for index in range(6):
            env.reset(scenario=index)
            starts.add(env.joint_positions.tobytes())
            goals.add(env.privileged()["goal_position"].tobytes())
            if isinstance(goal, tuple):
                np.testing.assert_allclose(
                    env.privileged()["goal_position"], [*goal, env.spec.standoff_m]
                )
        assert len(goals) == (6 if goal in ("random", "places") else 1)
        if start in ("zero", "fixed"):
            assert len(starts) == 1
        else:
            assert len(starts) > 1


def test_the_goal_s_requirements_can_be_changed() -> None:
    """Height over the surface, tolerances, and how long they have to be held."""
    with hvs_suite.load(
        "align-thesis",
        observations="state",
        goal=(0.6, 0.1),
        standoff_m=0.12,
        position_tolerance_mm=4.0,
        tilt_tolerance_deg=2.0,
        hold_steps=2,
    ) as env:
        env.reset(scenario=0)
        np.testing.assert_allclose(env.privileged()["goal_position"], [0.6, 0.1, 0.12])
        # 3 mm beside the goal: inside what was asked for, outside the task's own tolerance.
        env.task.place(env.physics, posture_at(0.603, 0.1, 0.12))
        stay = env.commandable(env.joint_positions)
        assert not env.step(stay).last()
        assert env.step(stay).last()
        assert env.info["is_success"]
        assert env.spec.instruction().endswith("120 mm above the surface.")


def test_eye_to_hand_stands_where_it_is_told_to() -> None:
    position = (0.2, -1.6, 2.2)
    with hvs_suite.load("align-thesis", eth_position_m=position, eth_fov_deg=40.0) as env:
        moved = env.reset(scenario=0).observation["eth"]
        T = env.task.cameras["eth"].T(env.physics.data.ptr)
        np.testing.assert_allclose(-T[:3, :3].T @ T[:3, 3], position, atol=1e-9)
    with hvs_suite.load("align-thesis") as env:
        assert (env.reset(scenario=0).observation["eth"] != moved).any()


def test_named_tasks_have_what_the_thesis_had_in_common() -> None:
    own_ring_m = {"track": (0.42, 0.74), "surface": (0.47, 0.70)}
    for v in hvs_suite.TASKS.values():
        assert getattr(v, "standoff_m", 0.05) == 0.05
        assert v.control_period_s == 0.1
        assert v.ring_m == own_ring_m.get(v.family, (0.40, 0.78))
        assert v.action_mode == "joint_position"
        assert getattr(v, "surface_size_m", (2.0, 2.0)) == (2.0, 2.0)
        assert 60 <= v.eih_fov_deg <= 75


def test_physics_runs_at_240_hz_and_24_substeps_make_a_control_step() -> None:
    with hvs_suite.load("align-thesis", observations="state") as env:
        assert env.physics.model.opt.timestep == pytest.approx(1 / 240)
        assert env.control_timestep() == pytest.approx(0.1)
        env.reset(scenario=0)
        env.step(np.zeros(7))
        assert env.physics.data.time == pytest.approx(24 / 240)


@pytest.mark.each_task
def test_training_takes_a_discount_of_its_own(task: str) -> None:
    with hvs_suite.load(task, observations="state", discount=0.99) as env:
        env.reset(scenario=0)
        assert env.step(env.commandable(env.scenario.start)).discount == 0.99
    assert hvs_suite.TASKS[task].discount == 1.0
