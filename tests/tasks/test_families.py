"""What is special about the families whose targets change or move, and how families register."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from postures import goal_posture

import hvs_suite
from hvs_suite.errors import OptionError
from hvs_suite.registry import find
from hvs_suite.tasks.sequence import MISSED, Sequence
from hvs_suite.tasks.shared.environment import Environment
from hvs_suite.tasks.shared.family import register
from hvs_suite.tasks.track import RMS_POSITION, TIME_INSIDE, WORST_POSITION, Track

Named = Callable[..., Environment]
FloatArray = npt.NDArray[np.float64]


def stay(env: Environment) -> npt.NDArray[np.float32]:
    """The action that keeps the arm where it is."""
    return env.commandable(env.setpoint)


# Options by which even an arm that stands still is inside.
ANYWHERE = {"position_tolerance_mm": 5000.0, "tilt_tolerance_deg": 180.0}


@pytest.mark.parametrize(
    ("task", "options"),
    [("track-line", {}), ("track-hard", {}), ("sequence-thesis", {"target_steps": 2})],
)
def test_a_picture_drawn_afterwards_is_the_one_observed_then(
    task: str, options: dict[str, Any]
) -> None:
    """Where what moves by itself is no joint, so that joint angles alone do not bring it back."""
    with hvs_suite.load(task, split="test", **options) as env:
        seen = [env.reset(scenario=1).observation]
        moments, places = [env.moment()], [env.goal().target]
        for _ in range(6):
            seen.append(env.step(stay(env)).observation)
            moments.append(env.moment())
            places.append(env.goal().target)
        assert len(np.unique(places, axis=0)) >= 3
        drawn = env.pictures(moments[::-1])
        for name in ("eih", "eth"):
            for later, then in zip(drawn[name][::-1], seen, strict=True):
                np.testing.assert_array_equal(later, then[name])
        np.testing.assert_array_equal(env.moment().state, moments[-1].state)


def test_a_target_that_was_reached_vanishes_and_reaching_all_is_success(named: Named) -> None:
    env = named("sequence-thesis", "state")
    env.reset(scenario=0)
    reached = 0
    while not env.info["truncated"] and not env.info["is_success"]:
        place = env.goal().target
        np.testing.assert_array_equal(place, env.scenario.targets[reached])
        env.task.place(env.physics, goal_posture(env))
        time_step = env.step(stay(env))
        reached += 1
        assert env.info["errors"][MISSED] == 5 - reached
        if reached < 5:
            assert np.linalg.norm(env.goal().target - place) >= env.spec.target_distance_m
            assert not time_step.last()
    assert reached == 5
    assert time_step.last()
    assert (time_step.discount, time_step.reward) == (0.0, 1.0)
    assert env.info["is_success"]
    assert env.info["steps_to_goal"] == env.info["steps"] == 5


def test_a_metric_is_said_with_its_unit_and_a_count_without() -> None:
    labels = {metric.name: metric.label for metric in find("sequence-thesis").metrics}
    assert labels[MISSED] == "targets missed"
    assert labels["position_error_mm"] == "position error, mm"


def test_a_miss_does_not_end_a_sequence_and_the_end_of_the_last_target_does() -> None:
    with hvs_suite.load(
        "sequence-thesis", split="test", observations="state", target_steps=3
    ) as env:
        env.reset(scenario=0)
        for step in range(1, 16):
            shown = env.goal().target
            if step == 4:
                env.task.place(env.physics, goal_posture(env))
            time_step = env.step(stay(env))
            # The first is missed after three steps, the second reached in the fourth.
            vanished = step == 4 or (step >= 3 and (step - 4) % 3 == 0) or step == 3
            assert (env.goal().target != shown).any() == (vanished and not time_step.last())
            assert time_step.last() == (step == 13)
            if time_step.last():
                break
    assert env.info["truncated"]
    assert not env.info["is_success"]
    assert env.info["steps_to_goal"] is None
    assert env.info["errors"][MISSED] == 4
    assert time_step.discount == 1.0


def test_tracking_is_always_played_to_the_limit_and_success_needs_the_last_steps() -> None:
    with hvs_suite.load("track-line", split="test", observations="state", **ANYWHERE) as env:
        env.reset(scenario=0)
        for step in range(1, 61):
            time_step = env.step(stay(env))
            assert time_step.last() == (step == 60)
            assert env.info["is_success"] == (step == 60)
        assert env.info["n_inside"] == 60
        # First step of the unbroken hold.
        assert env.info["steps_to_goal"] == 1
        assert not env.info["truncated"]
        assert env.info["errors"][TIME_INSIDE] == 100.0


@pytest.mark.parametrize(("joined_at", "is_success"), [(30, True), (41, True), (42, False)])
def test_what_counts_is_the_last_twenty_steps(joined_at: int, is_success: bool) -> None:
    """The arm is carried over the target from a step on."""
    with hvs_suite.load("track-line", split="test", observations="state") as env:
        env.reset(scenario=0)
        posture: FloatArray | None = None
        for step in range(1, 61):
            if step >= joined_at:
                ahead = env.goal(env.spec.control_period_s)
                posture = near(ahead.position, posture)
                env.task.place(env.physics, posture)
            env.step(stay(env))
        assert env.info["is_success"] == is_success
        assert env.info["truncated"] == (not is_success)
        assert env.info["steps_to_goal"] == (joined_at if is_success else None)
        assert (env.info["errors"][WORST_POSITION] <= 1.0) == is_success
        assert env.info["errors"][RMS_POSITION] <= env.info["errors"][WORST_POSITION]


def near(position: FloatArray, posture: FloatArray | None) -> FloatArray:
    """A posture with the flange at a place, facing down."""
    from hvs_suite.cell.kinematics import kinematics

    found = kinematics().goal_configurations_at_tool_angle(position, [0, 0, 1.0], 0.0)
    return np.asarray(found[np.abs(found - (0.0 if posture is None else posture)).sum(1).argmin()])


@pytest.mark.parametrize("task", ["track-line", "track-curve", "track-hard"])
def test_a_moving_goal_is_where_it_was_said_to_be(task: str) -> None:
    """``goal(ahead_s)`` foretells it, its speed is its derivative, and playing again repeats it."""
    with hvs_suite.load(task, split="test", observations="state") as env:
        runs = []
        for _ in range(2):
            env.reset(scenario=5)
            first, period = env.goal, env.spec.control_period_s
            foretold = [first(step * period) for step in range(11)]
            met = [env.goal(), *(env.step(stay(env)) and env.goal() for _ in range(10))]
            for said, found in zip(foretold, met, strict=True):
                np.testing.assert_allclose(said.target, found.target, atol=1e-12)
                np.testing.assert_allclose(said.velocity, found.velocity, atol=1e-12)
            runs.append(np.array([each.target for each in met]))
            tiny = 1e-5
            slope = (env.goal(tiny).target - env.goal(-tiny).target) / (2 * tiny)
            np.testing.assert_allclose(env.privileged()["goal_velocity"], slope, atol=1e-6)
            speed = np.linalg.norm(slope)
            assert 0.0 < speed <= env.spec.speed_m_s[1] + 1e-6
        np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("task", ["sequence-thesis", "track-line"])
def test_what_is_observed_depends_on_scenario_and_step_alone(task: str) -> None:
    with hvs_suite.load(task, split="test") as used, hvs_suite.load(task, split="test") as fresh:
        used.reset(scenario=3)
        for _ in range(7):
            used.step(stay(used))
        for env in (used, fresh):
            env.reset(scenario=9)
        for _ in range(4):
            one, other = (env.step(stay(env)).observation for env in (used, fresh))
            for name, value in one.items():
                np.testing.assert_array_equal(value, other[name])


@pytest.mark.parametrize(
    ("task", "options", "reason"),
    [
        ("align-thesis", {"ring_m": (0.3, 0.9)}, "use radii from 0.40 to 0.78 m"),
        ("sequence-thesis", {"ring_m": (0.3, 0.9)}, "use radii from 0.40 to 0.78 m"),
        ("track-line", {"ring_m": (0.3, 0.9)}, "use radii from 0.40 to 0.78 m"),
        ("sequence-thesis", {"n_targets": 0}, "n_targets is 0"),
        (
            "sequence-thesis",
            {"n_targets": 6, "target_steps": 30},
            "do not fit into time_limit_steps",
        ),
        ("sequence-thesis", {"target_steps": 0}, "target_steps is 0"),
        ("sequence-thesis", {"target_distance_m": 2.0}, "target_distance_m is 2.0"),
        ("sequence-thesis", {"motion": "line"}, "no option 'motion'"),
        ("track-line", {"motion": "circle"}, "motion is 'circle'"),
        ("track-line", {"speed_m_s": (0.2, 0.1)}, "a least and a larger speed"),
        ("track-line", {"acceleration_m_s2": 0.0}, "must be positive"),
        ("track-line", {"hold_steps": 61}, "more than time_limit_steps 60"),
        ("track-line", {"position_tolerance_mm": None}, "position_tolerance_mm"),
        ("track-line", {"goal": "random"}, "no option 'goal'"),
    ],
)
def test_an_option_of_a_family_that_makes_no_sense_is_refused_in_one_line(
    task: str, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(OptionError, match=reason) as raised:
        hvs_suite.load(task, **options)
    assert len(str(raised.value).splitlines()) == 1


def test_a_name_is_registered_once_and_begins_with_its_family() -> None:
    thesis = hvs_suite.TASKS["sequence-thesis"]
    register(Sequence, thesis)  # as importing a module again does
    with pytest.raises(OptionError, match="another task called 'sequence-thesis'"):
        register(Sequence, dataclasses.replace(thesis, hold_steps=2))
    with pytest.raises(OptionError, match="another task called 'sequence-thesis'"):
        register(Track, thesis)
    with pytest.raises(OptionError, match=r"called sequence-\.\.\., not 'chain-thesis'"):
        register(Sequence, dataclasses.replace(thesis, name="chain-thesis"))
    assert hvs_suite.TASKS["sequence-thesis"] == thesis
