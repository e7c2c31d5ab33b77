"""An episode of ``align``: what its errors mean, and when and how it ends."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from postures import displaced, goal_posture, posture_at

import hvs_suite
from hvs_suite.tasks.shared.environment import Environment

Named = Callable[..., Environment]
ERRORS = ("lateral_error_mm", "height_error_mm", "position_error_mm", "tilt_error_deg")


def errors(env: Environment) -> list[float]:
    return [env.info["errors"][name] for name in ERRORS]


@pytest.mark.each_task(measures="position_error_mm")
def test_errors_have_the_meanings_of_their_names(named: Named, task: str) -> None:
    env = named(task, "state")
    # One scenario in the middle of the ring, so that every displaced pose can be reached.
    for index in range(20):
        env.reset(scenario=index)
        if 0.48 < np.linalg.norm(env.goal().target) < 0.68:
            break
    for lateral, height, tilt in [
        (0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.03, 0.0), (0.0, -0.02, 0.0), (0.0, 0.0, 7.0),
        (0.003, 0.004, 0.5), (1e-5, 1e-5, 1e-3), (0.05, 0.1, 40.0),
    ]:  # fmt: skip
        env.task.place(
            env.physics, displaced(env, lateral_m=lateral, height_m=height, tilt_deg=tilt)
        )
        position = np.hypot(lateral, height)
        expected = [1000 * lateral, 1000 * abs(height), 1000 * position, tilt]
        np.testing.assert_allclose(errors(env), expected, rtol=1e-6, atol=1e-7)


def test_yaw_is_free(named: Named) -> None:
    env = named("align-thesis", "state")
    env.reset(scenario=1)
    for yaw in (-1.0, 0.0, 0.8):
        env.task.place(env.physics, displaced(env, yaw=yaw, tilt_deg=2.0))
        np.testing.assert_allclose(errors(env), [0, 0, 0, 2.0], atol=1e-6)


def test_the_tilt_is_an_angle_and_no_constant(named: Named) -> None:
    """The thesis took the norm of a difference quaternion, which is always 1."""
    env = named("align-thesis", "state")
    env.reset(scenario=0)
    upright = env.info["errors"]["tilt_error_deg"]
    assert upright == pytest.approx(180.0)
    tilts = []
    for bend in (30, 60, 90, 120):
        env.task.place(env.physics, np.deg2rad([0, bend / 2, 0, 0, 0, bend / 2, 0]))
        tilts.append(env.info["errors"]["tilt_error_deg"])
    np.testing.assert_allclose(tilts, [150, 120, 90, 60], atol=1e-9)


def test_errors_are_taken_at_the_flange_face(named: Named) -> None:
    """The thesis took the centre of mass of the last link."""
    env = named("align-thesis", "state")
    env.reset(scenario=0)
    target = env.scenario.target
    expected = np.linalg.norm(np.array([0, 0, 0.34 + 0.4 + 0.4 + 0.126]) - target - [0, 0, 0.05])
    assert env.info["errors"]["position_error_mm"] == pytest.approx(1000 * expected)


def at_goal(task: str, **options: Any) -> tuple[Environment, np.ndarray[Any, Any]]:
    """A task whose arm starts at the goal pose, and the action that keeps it there."""
    start = posture_at(0.6, 0.1, 0.05)
    env = hvs_suite.load(
        task,
        observations="state",
        goal=(0.6, 0.1),
        start=tuple(start.tolist()),
        **options,
    )
    env.reset(scenario=0)
    return env, env.commandable(start)


@pytest.mark.each_task("align-hard", family="align")
def test_success_comes_at_the_kth_held_step_and_the_reset_does_not_count(task: str) -> None:
    env, stay = at_goal(task)
    hold = env.spec.hold_steps
    assert env.info["n_inside"] == 0
    assert not env.info["success_once"]
    for n in range(1, hold + 1):
        time_step = env.step(stay)
        info = env.info
        assert info["n_inside"] == n
        assert info["success_once"]
        assert info["is_success"] == time_step.last() == (n == hold)
        assert time_step.discount == (0.0 if n == hold else 1.0)
        assert time_step.reward == (1.0 if n == hold else 0.0)
    assert not info["truncated"]
    assert not info["collision"]


@pytest.mark.each_task("align-hard", family="align")
def test_a_goal_on_the_last_step_is_termination(task: str) -> None:
    hold = hvs_suite.TASKS[task].hold_steps
    env, stay = at_goal(task, time_limit_steps=max(hold, 2), hold_steps=max(hold, 2))
    for _ in range(max(hold, 2)):
        time_step = env.step(stay)
    assert time_step.last()
    assert time_step.discount == 0.0
    assert env.info["is_success"]
    assert not env.info["truncated"]


def test_a_hold_that_the_limit_cuts_short_is_no_success() -> None:
    env, stay = at_goal("align-limit", time_limit_steps=4)
    for _ in range(4):
        time_step = env.step(stay)
    assert time_step.last()
    assert time_step.discount == 1.0
    assert env.info["truncated"]
    assert env.info["success_once"]
    assert not env.info["is_success"]


def test_leaving_the_tolerance_starts_the_hold_anew() -> None:
    env, stay = at_goal("align-hard")
    away = env.commandable(posture_at(0.6, 0.1, 0.055))
    counts = []
    for action in (stay, stay, away, stay, stay, stay, stay):
        time_step = env.step(action)
        counts.append(env.info["n_inside"])
        if time_step.last():
            break
    assert counts[:3] == [1, 2, 0]
    assert counts[-3:] == [1, 2, 3]
    assert env.info["is_success"]


@pytest.mark.each_task("align-drill", family="align")
def test_driving_to_the_goal_ends_in_the_very_step_that_completes_the_hold(
    named: Named, task: str
) -> None:
    env = named(task, "state")
    spec = env.spec
    for index in (0, 1):
        env.reset(scenario=index)
        action = env.commandable(goal_posture(env))
        held = 0
        for n in range(1, spec.time_limit_steps + 1):
            time_step = env.step(action)
            info = env.info
            length = spec.position_tolerance_mm
            inside = info["errors"]["tilt_error_deg"] <= spec.tilt_tolerance_deg and (
                info["errors"]["position_error_mm"] <= length
                if length is not None
                else info["errors"]["lateral_error_mm"] <= spec.lateral_tolerance_mm
                and info["errors"]["height_error_mm"] <= spec.height_tolerance_mm
            )
            held = held + 1 if inside else 0
            assert info["n_inside"] == held
            assert info["is_success"] == time_step.last() == (held == spec.hold_steps), n
            if time_step.last():
                break
        assert info["is_success"]
        assert time_step.discount == 0.0
        assert not info["truncated"]


def is_inside(env: Environment) -> bool:
    """Whether a control step counts as held that ends where the arm has been placed."""
    env.step(env.commandable(env.joint_positions))
    return bool(env.info["n_inside"])


@pytest.mark.parametrize(
    ("options", "lateral_m", "height_m", "inside"),
    [
        ({"position_tolerance_mm": 5.0}, 0.0045, 0.0, True),
        ({"position_tolerance_mm": 5.0}, 0.004, 0.004, False),
        (
            {
                "position_tolerance_mm": None,
                "lateral_tolerance_mm": 5.0,
                "height_tolerance_mm": 5.0,
            },
            0.004,
            0.004,
            True,
        ),
        (
            {
                "position_tolerance_mm": None,
                "lateral_tolerance_mm": 5.0,
                "height_tolerance_mm": 1.0,
            },
            0.004,
            0.004,
            False,
        ),
        (
            {
                "position_tolerance_mm": None,
                "lateral_tolerance_mm": 1.0,
                "height_tolerance_mm": 5.0,
            },
            0.004,
            0.004,
            False,
        ),
    ],
)
def test_one_length_bounds_the_norm_and_two_bound_each_component(
    named: Named, options: dict[str, Any], lateral_m: float, height_m: float, inside: bool
) -> None:
    with hvs_suite.load("align-easy", split="test", observations="state", **options) as env:
        env.reset(scenario=1)
        env.task.place(env.physics, displaced(env, lateral_m=lateral_m, height_m=height_m))
        assert is_inside(env) == inside


def test_a_tilt_beyond_tolerance_is_no_success() -> None:
    with hvs_suite.load("align-thesis", split="test", observations="state") as env:
        env.reset(scenario=1)
        for tilt, inside in ((0.98, True), (1.02, False)):
            env.task.place(env.physics, displaced(env, tilt_deg=tilt))
            assert is_inside(env) == inside
            env.reset(scenario=1)


def test_success_and_termination_do_not_depend_on_the_rewards() -> None:
    start = posture_at(0.6, 0.1, 0.06)
    moves = [posture_at(0.6, 0.1, h) for h in (0.055, 0.0503, 0.05)]
    crash = [posture_at(0.6, 0.1, h) for h in (0.03, -0.03)]
    outcomes = []
    for rewards in ((), ("goal",), ("collision",), ("time", "position"), ("rotation",),
                    ("goal", "collision", "time", "position", "rotation", "joint_space",
                     "exponential")):  # fmt: skip
        with hvs_suite.load(
            "align-thesis",
            observations="state",
            goal=(0.6, 0.1),
            start=tuple(start.tolist()),
            rewards=rewards,
        ) as env:
            story = []
            for way in (moves, crash):
                env.reset(scenario=0)
                for q in way:
                    time_step = env.step(env.commandable(q))
                    info = env.info
                    story.append((info["is_success"], info["collision"], time_step.discount))
                    if time_step.last():
                        break
                assert time_step.last()
            outcomes.append(story)
    assert all(story == outcomes[0] for story in outcomes)
    assert (True, False, 0.0) in outcomes[0]
    assert (False, True, 0.0) in outcomes[0]


@pytest.mark.each_task
def test_info_holds_plain_bools_and_numbers(named: Named, task: str) -> None:
    env = named(task, "state")
    env.reset(scenario=0)
    env.step(env.commandable(env.scenario.start))
    kinds = {
        "task": str, "split": str, "scenario": int, "is_success": bool, "success_once": bool,
        "collision": bool, "truncated": bool, "n_inside": int, "n_clipped": int, "steps": int,
        "steps_to_goal": type(None), "overload": bool, "errors": dict,
    }  # fmt: skip
    assert {name: type(value) for name, value in env.info.items()} == kinds
    metrics = [metric.name for metric in env.spec.metrics]
    assert [*env.info["errors"]] == metrics
    assert {type(value) for value in env.info["errors"].values()} == {float}


def test_privileged_values_are_the_truth(named: Named) -> None:
    env = named("align-drill", "state")
    env.reset(scenario=2)
    env.step(env.commandable(env.scenario.start + 0.05))
    truth, scene = env.privileged(), env.scenario
    np.testing.assert_array_equal(truth["joint_positions"], env.joint_positions)
    np.testing.assert_array_equal(truth["joint_offset"], scene.joint_offset)
    np.testing.assert_array_equal(truth["target_position"], scene.target)
    np.testing.assert_allclose(truth["goal_position"], scene.target + 0.05 * scene.normal)
    np.testing.assert_array_equal(truth["goal_normal"], scene.normal)
    assert all(value.dtype == np.float64 for value in truth.values())
