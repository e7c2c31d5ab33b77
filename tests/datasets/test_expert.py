"""The expert: always there, never a collision, from any state, and nearly as fast as possible."""

import numpy as np
import pytest
import ruckig

import hvs_suite
from hvs_suite.cell import robot
from hvs_suite.datasets.expert import make_expert
from hvs_suite.datasets.planner import stopping_travel_time
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.start import steps_lower_bound

TASKS = sorted(hvs_suite.TASKS)
COUNTS = [20, pytest.param(1000, marks=pytest.mark.slow)]


def play(env, expert, scenario):
    """Plays one scenario and returns the final info."""
    time_step = env.reset(scenario=scenario)
    expert.reset()
    while not time_step.last():
        time_step = env.step(expert.select_action(time_step.observation))
    return env.info


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("task", TASKS)
def test_reaches_every_goal_without_collision(task, count):
    with hvs_suite.load(task, split="test", observations="state") as env:
        expert = make_expert(env)
        failed = [i for i in range(count) if not play(env, expert, i)["is_success"]]
    assert failed == []


@pytest.mark.timeout(600)
@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_takes_little_longer_than_the_limits_of_speed_and_acceleration_allow(count):
    steps, bounds = [], []
    with hvs_suite.load("align-thesis", split="test", observations="state") as env:
        expert = make_expert(env)
        for scenario in range(count):
            steps.append(play(env, expert, scenario)["steps"])
            bounds.append(steps_lower_bound(env.spec, env.scenario.start, env.goal()))
    assert np.mean(steps) <= 1.15 * np.mean(bounds) + 1.0


def test_recovers_from_wherever_a_wild_policy_has_brought_the_arm():
    random = np.random.default_rng(0)
    with hvs_suite.load("align-thesis", observations="state", time_limit_steps=60) as env:
        expert = make_expert(env)
        recovered = 0
        for scenario in range(10):
            time_step = env.reset(scenario=scenario)
            for _ in range(8):
                drift = random.normal(size=7) * 0.06
                time_step = env.step(np.clip(expert.label() + drift, -1, 1).astype(np.float32))
                if time_step.last():
                    break
            if env.info["collision"] or env.info["is_success"]:
                continue
            while not time_step.last():
                time_step = env.step(expert.label())
            recovered += 1
            assert env.info["is_success"], scenario
    assert recovered >= 5


def test_answers_alike_for_the_same_state_whatever_it_played_before():
    with hvs_suite.load("align-hard", observations="state") as env:
        experienced, fresh = make_expert(env), make_expert(env)
        for scenario in range(3):
            play(env, experienced, scenario)
        env.reset(scenario=7)
        for _ in range(5):
            label = fresh.label()
            np.testing.assert_array_equal(experienced.label(), label)
            env.step(label)


def test_stays_where_it_has_arrived():
    with hvs_suite.load(
        "align-thesis", observations="state", hold_steps=15, time_limit_steps=40
    ) as env:
        info = play(env, make_expert(env), 0)
    assert info["is_success"]
    assert info["errors"]["position_error_mm"] < 0.01


@pytest.mark.parametrize(
    "options",
    [
        {"surface": "tilted"},
        {"surface": "curved"},
        {"start": "mixed"},
        {"start": "random", "time_limit_steps": 40},
        {"latency_steps": 2},
        {"acceleration_limits": True},
    ],
    ids=str,
)
def test_solves_the_task_with_other_options(options):
    with hvs_suite.load("align-thesis", observations="state", **options) as env:
        expert = make_expert(env)
        infos = [play(env, expert, scenario) for scenario in range(5)]
    assert [info["scenario"] for info in infos if not info["is_success"]] == []


def test_aims_with_true_joints_where_the_encoders_are_off():
    with hvs_suite.load("align-thesis", observations="state", joint_offset_deg=1.0) as env:
        assert all(play(env, make_expert(env), scenario)["is_success"] for scenario in range(3))


def test_refuses_to_command_anything_but_joint_positions():
    with (
        hvs_suite.load("align-easy", action_mode="joint_delta") as env,
        pytest.raises(OptionError, match="joint_position"),
    ):
        make_expert(env)


def test_travel_time_from_a_moving_start_is_what_ruckig_finds():
    random = np.random.default_rng(1)
    planner = ruckig.Ruckig(7)
    problem = ruckig.InputParameter(7)
    problem.max_velocity = list(robot.JOINT_SPEED_RAD_S)
    problem.max_acceleration = list(robot.JOINT_ACCELERATION_RAD_S2)
    for _ in range(200):
        q, goal = random.uniform(-2, 2, (2, 7))
        velocity = random.uniform(-1, 1, 7) * robot.JOINT_SPEED_RAD_S
        problem.current_position, problem.current_velocity = list(q), list(velocity)
        problem.target_position = list(goal)
        trajectory = ruckig.Trajectory(7)
        planner.calculate(problem, trajectory)
        times, _ = stopping_travel_time(q, velocity, goal[None])
        # Joints that must arrive together may need longer than the slowest alone; never less.
        least = max(trajectory.independent_min_durations)
        assert times[0] == pytest.approx(least, abs=1e-9)
