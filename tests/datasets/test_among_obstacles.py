"""The expert among obstacles: led around them from anywhere, by an answer that has no memory."""

import numpy as np

import hvs_suite
from hvs_suite.cell.solid import obstacle_distance
from hvs_suite.datasets.expert import make_expert
from hvs_suite.datasets.looking import LOOK_AROUND_RAD
from hvs_suite.tasks.shared.obstacles import HEIGHT_M

TASK = "clutter-obstacles"
BLOCKED = (6, 7, 12)
"""Test scenes in which an expert that heeds no obstacle runs into one, or did at some time."""


def test_who_does_not_heed_obstacles_runs_into_them_and_the_expert_does_not():
    outcomes = []
    with hvs_suite.load(TASK, split="test", observations="state") as env:
        for blind in (True, False):
            expert = make_expert(env)
            if blind:
                expert._planner.avoid = lambda solids: None
            collisions = 0
            for scenario in range(15):
                time_step = env.reset(scenario=scenario)
                while not time_step.last():
                    time_step = env.step(expert.label())
                collisions += env.info["collision"]
                assert blind or env.info["is_success"], scenario
            outcomes.append(collisions)
    blind, seeing = outcomes
    assert blind >= 2
    assert seeing == 0


def test_an_answer_depends_on_where_the_arm_is_and_on_nothing_before():
    with hvs_suite.load(TASK, split="test", observations="state") as env:
        old = make_expert(env)
        for scenario in BLOCKED:
            time_step = env.reset(scenario=scenario)
            for step in range(8):
                if time_step.last():
                    break
                action = old.label()
                if step % 4 == 0:
                    np.testing.assert_array_equal(make_expert(env).label(), action)
                time_step = env.step(action)


def test_where_a_wild_policy_has_brought_the_arm_there_is_a_way_on():
    random = np.random.default_rng(0)
    with hvs_suite.load(TASK, split="train", observations="state") as env:
        expert = make_expert(env)
        recovered = met = 0
        for scenario in range(10):
            time_step = env.reset(scenario=scenario)
            for _ in range(8):
                drift = random.normal(size=7) * 0.05
                time_step = env.step(np.clip(expert.label() + drift, -1, 1).astype(np.float32))
                if time_step.last():
                    break
            if env.info["collision"]:
                continue
            met += 1
            while not time_step.last():
                time_step = env.step(expert.label())
            recovered += env.info["is_success"]
    assert met >= 5
    assert recovered == met


def test_looking_around_passes_over_every_obstacle():
    with hvs_suite.load(TASK, split="test", observations="state") as env:
        for scenario in range(10):
            env.reset(scenario=scenario)
            distance = obstacle_distance(env.obstacles)
            assert max(s.centre[2] + s.half[2] for s in env.obstacles) <= HEIGHT_M + 1e-9
            for q in np.linspace(*LOOK_AROUND_RAD, 15):
                assert distance(q) > 0.0
