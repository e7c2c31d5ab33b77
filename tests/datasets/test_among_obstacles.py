"""The expert among obstacles: led around them from anywhere, by an answer that has no memory."""

import numpy as np

import hvs_suite
from hvs_suite.cell.solid import Solid, obstacle_distance
from hvs_suite.datasets import flyover
from hvs_suite.datasets.expert import Expert, make_expert
from hvs_suite.datasets.leaning import raised
from hvs_suite.datasets.looking import LOOK_AROUND_RAD, Demonstrator
from hvs_suite.datasets.planner import Planner
from hvs_suite.tasks.shared.goal import Goal, Tip
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


GOAL = Goal(np.array([0.5, 0.1, 0.0]), np.array([0.0, 0.0, 1.0]), standoff_m=0.05)
DOWN = np.array([0.0, 0.0, -1.0])


def test_the_way_leads_up_and_over_and_down() -> None:
    def tip(beside_m: float, height_m: float) -> Tip:
        return Tip(GOAL.position + np.array([beside_m, 0.0, height_m]), DOWN)

    for beside_m, high_m in ((0.6, 0.6), (0.3, 0.42), (0.11, 0.25)):
        assert flyover.is_low(GOAL, tip(beside_m, high_m - 0.02))
        assert not flyover.is_low(GOAL, tip(beside_m, high_m + 0.02))
        assert flyover.next_place(GOAL, tip(beside_m, 0.3)).position[2] > GOAL.position[2] + 0.29
    for height_m in (0.0, 0.1, 0.3):
        assert not flyover.is_low(GOAL, tip(0.05, height_m))
        assert flyover.next_place(GOAL, tip(0.05, height_m)) is GOAL


def test_a_way_down_is_free_unless_something_hangs_over_the_goal() -> None:
    planner = Planner(0.1, plain=True)
    above = raised(GOAL, flyover.OVER_M)
    assert planner.is_free_by(flyover.UPRIGHT_RAD, above, GOAL)
    planner.avoid((Solid("box", (0.1, 0.1, 0.02), (0.5, 0.1, 0.3)),))
    assert not planner.is_free_by(flyover.UPRIGHT_RAD, above, GOAL)
    planner.avoid(())
    out_of_reach = Goal(np.array([1.5, 0.1, 0.0]), GOAL.normal, standoff_m=0.05)
    assert not planner.is_free_by(
        flyover.UPRIGHT_RAD, raised(out_of_reach, flyover.OVER_M), out_of_reach
    )


def test_demonstrations_come_down_from_above_and_meet_less_even_blind() -> None:
    met = {Demonstrator: 0, Expert: 0}
    heights_m = []
    with hvs_suite.load(TASK, split="train", observations="state") as env:
        for kind in met:
            demonstrator = kind(env)
            demonstrator._planner.avoid = lambda solids: None
            for scenario in range(25):
                time_step = env.reset(scenario=scenario)
                demonstrator.reset()
                was_beside = False
                while not time_step.last():
                    offset = env.tip().position - env.goal().position
                    is_beside = bool(np.hypot(*offset[:2]) > 0.08)
                    if kind is Demonstrator and was_beside and not is_beside:
                        heights_m.append(offset[2])
                    was_beside = is_beside
                    time_step = env.step(demonstrator.label())
                met[kind] += env.info["collision"]
    assert met[Demonstrator] < met[Expert]
    assert len(heights_m) > 15
    assert np.mean(np.array(heights_m) > 0.2) > 0.9


def test_where_the_way_over_is_blocked_demonstrations_go_around() -> None:
    blocked = 0
    with hvs_suite.load(TASK, split="train", observations="state") as env:
        demonstrator = Demonstrator(env)
        for scenario in range(25):
            time_step = env.reset(scenario=scenario)
            demonstrator.reset()
            blocked += not demonstrator._flies_over()
            while not time_step.last():
                time_step = env.step(demonstrator.label())
            assert not env.info["collision"], scenario
    assert blocked >= 1
