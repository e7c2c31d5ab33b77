"""The demonstrator: it looks where the expert would already know, and is the expert otherwise."""

import numpy as np
import pytest
import torch

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.plain_postures import CHOSEN_ABOVE_M
from hvs_suite.cell.robot import JOINT_SPEED_RAD_S
from hvs_suite.datasets.expert import Expert
from hvs_suite.datasets.leaning import Spiral, Straightening
from hvs_suite.datasets.looking import CLEARANCE_M, Demonstrator
from hvs_suite.tasks.shared.goal import Goal, Tip
from hvs_suite.tasks.shared.placing import is_reachable

SCENES = 100


def is_hidden(env) -> bool:
    truth = env.privileged()
    return all(truth[name][3] < 0.5 for name in ("target_eih", "target_eth"))


@pytest.mark.parametrize("task", ["align-thesis", "align-hard"])
def test_hidden_targets_are_looked_for_and_reached_in_time(task):
    n_hidden = 0
    with hvs_suite.load(task, split="train", observations="state") as env:
        demonstrator = Demonstrator(env)
        for scenario in range(SCENES):
            time_step = env.reset(scenario=scenario)
            if not is_hidden(env):
                continue
            n_hidden += 1
            demonstrator.reset()
            while not time_step.last():
                time_step = env.step(demonstrator.select_action({}))
            assert env.info["is_success"], scenario
    assert n_hidden >= 2


def test_what_to_do_does_not_depend_on_a_target_that_no_camera_saw():
    answers, experts = [], []
    with hvs_suite.load("align-thesis", split="train", observations="state") as env:
        for scenario in range(SCENES):
            env.reset(scenario=scenario)
            if is_hidden(env):
                answers.append(Demonstrator(env).label())
                experts.append(Expert(env).label())
    assert len(answers) >= 2
    for answer in answers[1:]:
        np.testing.assert_array_equal(answer, answers[0])
    assert np.abs(np.diff(experts, axis=0)).max() > 1e-3  # while the expert knows


def test_once_seen_the_target_is_gone_for_as_the_expert_goes_in_plain_postures():
    with hvs_suite.load("align-thesis", split="train", observations="state") as env:
        scenarios = iter(range(SCENES))
        env.reset(scenario=next(scenarios))
        while is_hidden(env):
            env.reset(scenario=next(scenarios))
        demonstrator = Demonstrator(env)
        expert = Expert(env, plain=True, clearance_m=CLEARANCE_M)
        np.testing.assert_array_equal(demonstrator.label(), expert.label())


@pytest.mark.parametrize("task", ["align-hard", "align-drill"])
def test_where_the_far_camera_may_be_off_the_hand_looks_before_it_comes_down(task):
    heights_m = []
    with hvs_suite.load(task, split="train", observations="state") as env:
        demonstrator = Demonstrator(env)
        for scenario in range(30):
            time_step = env.reset(scenario=scenario)
            demonstrator.reset()
            while not time_step.last():
                truth = env.privileged()
                _, flange = kinematics().flange_pose(truth["joint_positions"])
                height_m = (flange - truth["goal_position"]) @ truth["goal_normal"]
                if truth["target_eih"][3] > 0.5:
                    heights_m.append(height_m)
                    break
                time_step = env.step(demonstrator.select_action({}))
            while not time_step.last():
                time_step = env.step(demonstrator.select_action({}))
            assert env.info["is_success"], scenario
    # Now and then the arm starts lower than that.
    assert np.mean(np.array(heights_m) > 0.1) > 0.85
    assert len(heights_m) == 30


def test_two_targets_show_how_far_off_the_far_camera_is_and_the_next_need_no_look():
    as_expert = {number: [] for number in range(5)}
    with hvs_suite.load("sequence-hard", split="train", observations="state") as env:
        demonstrator = Demonstrator(env)
        expert = Expert(env, plain=True, clearance_m=CLEARANCE_M)
        for scenario in range(4):
            time_step = env.reset(scenario=scenario)
            demonstrator.reset()
            target, number, is_new = env.goal().target, 0, True
            while not time_step.last():
                if (env.goal().target != target).any():
                    target, number, is_new = env.goal().target, number + 1, True
                if is_new and not is_hidden(env):
                    same = np.array_equal(demonstrator.label(), expert.label())
                    as_expert[number].append(same)
                is_new = False
                time_step = env.step(demonstrator.select_action({}))
    later = [same for number in (2, 3, 4) for same in as_expert[number]]
    assert len(later) > 8
    assert all(later)
    assert len(as_expert[0] + as_expert[1]) > 4
    assert not any(as_expert[0] + as_expert[1])


@pytest.mark.parametrize("task", ["align-hard", "align-limit"])
def test_from_a_random_start_the_way_is_the_one_that_the_policy_takes_to_be_the_soonest(task):
    from hvs_suite.policies.belief.arm import ways_to_posture

    elbows_aside, n_choices = 0, 0
    with hvs_suite.load(task, split="train", observations="state") as env:
        demonstrator = Demonstrator(env)
        for scenario in range(40):
            env.reset(scenario=scenario)
            q, goal = env.joint_positions, env.goal()
            over = goal.target + CHOSEN_ABOVE_M * goal.normal
            place, chosen, normal, joints = (
                torch.tensor(each[None]) for each in (goal.position, over, goal.normal, q)
            )
            [(turns, time_s, within)] = ways_to_posture(joints, place[:, None], normal, chosen)
            planner = demonstrator._planner
            planner._remember_goal(goal)
            family = planner._reachable(q, np.zeros(7), goal)
            first = next(iter(planner._in_order(q, np.zeros(7), family)))
            np.testing.assert_allclose(first[:6], q[:6] + turns[0].numpy(), atol=1e-6)
            slowest = np.abs(turns[0].numpy() / JOINT_SPEED_RAD_S[:6]).max()
            assert (time_s.item(), within.item()) == (pytest.approx(slowest), 1.0)
            elbows_aside += abs(first[2]) > 0.1
            n_choices += len(family) > 2
    assert elbows_aside > 10
    assert n_choices > 30


@pytest.mark.parametrize("task", ["surface-tilted", "surface-fuselage", "surface-hard"])
def test_an_unknown_slope_is_looked_at_from_aside_on_the_way_down(task):
    quarters, sidelong = [], []
    with hvs_suite.load(task, split="train", observations="state") as env:
        demonstrator = Demonstrator(env)
        for scenario in range(20):
            time_step = env.reset(scenario=scenario)
            demonstrator.reset()
            seen_from = set()
            n_sidelong = 0
            while not time_step.last():
                goal, tip = env.goal(), env.tip()
                away = tip.position - goal.target
                leans = -tip.axis @ goal.normal < np.cos(np.radians(8.0))
                is_near = np.linalg.norm(away) < 0.11
                n_sidelong += is_near and -tip.axis @ goal.normal < np.cos(np.radians(20.0))
                if leans and env.privileged()["target_eih"][3] > 0.5:
                    seen_from.add(int(np.degrees(np.arctan2(away[1], away[0])) // 90))
                time_step = env.step(demonstrator.select_action({}))
            assert env.info["is_success"], scenario
            quarters.append(len(seen_from))
            sidelong.append(n_sidelong)
    if task == "surface-hard":
        # A slope has to be known to 0.3 degrees: it is looked at far from the side, and for long.
        assert np.mean(sidelong) > 20.0
    else:
        # From all around; straight down: 0.3 at most.
        assert np.mean(quarters) > 2.2


def test_the_spiral_leads_around_the_target_and_ends_at_the_goal():
    goal = Goal(np.array([0.5, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]), standoff_m=0.05)
    down = np.array([0.0, 0.0, -1.0])
    for height_m in np.linspace(0.2, 0.0, 50):
        tip = Tip(goal.position + height_m * goal.normal, down)
        next_one, _ = Spiral().next_place(goal, tip, np.zeros(7), 20)
        assert (next_one.target == goal.target).all()
        assert np.degrees(np.arccos(min(next_one.normal[2], 1.0))) < 20.1
        if height_m < Spiral().ahead_m:
            assert next_one is goal


WAY = Straightening()
LOOKS_ON = WAY.upright_steps + WAY.up_steps
"""The last moment at which the tool leans as far as it can."""


@pytest.mark.parametrize("side_deg", [-60.0, 0.0, 60.0])
@pytest.mark.parametrize("lean_deg", [30.0, 10.0])
def test_the_tool_leans_away_from_the_base_while_there_is_time(side_deg, lean_deg):
    goal = Goal(np.array([0.5, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]), standoff_m=0.05)
    q = np.array([0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0])
    side, lean = np.radians(side_deg), np.radians(lean_deg)
    away = np.array([np.sin(lean) * np.cos(side), np.sin(lean) * np.sin(side), np.cos(lean)])
    at = kinematics().nearest_configuration(q, goal.target + 0.056 * away, away, np.ones(7))
    tip = Tip(goal.target + 0.056 * away, -away)
    leans = []
    for steps_left in range(LOOKS_ON + 2, -1, -1):
        next_one, is_near = WAY.next_place(goal, tip, at, steps_left)
        assert is_near
        x, y, z = next_one.normal
        assert (x, y) == pytest.approx((np.sqrt(1.0 - z**2), 0.0))
        leans.append(np.degrees(np.arccos(z)))
    assert leans[:3] == pytest.approx([33.0] * 3)
    # Then it straightens up, whatever it did before.
    assert (np.diff(leans[2 : 3 + WAY.up_steps]) < -2.0).all()
    assert leans[2 + WAY.up_steps :] == [0.0] * (1 + WAY.upright_steps)


def test_the_last_joint_turns_on_by_the_time_and_where_it_is_late_it_hurries():
    by_now = WAY.turn_rad * (WAY.middle_steps - 20)
    assert WAY.turned(by_now - WAY.turn_rad, 20) == pytest.approx(by_now)
    assert WAY.turned(by_now - 2.0, 20) == pytest.approx(by_now - 2.0 + WAY.most_turn_rad)
    assert WAY.turned(by_now + 2.0, 20) == pytest.approx(by_now + 2.0 - WAY.most_turn_rad)
    # From the first step to the last it stays off its stops.
    assert abs(WAY.turn_rad * (WAY.middle_steps - 55)) < 3.05 - 0.04
    assert abs(WAY.turn_rad * WAY.middle_steps) < 3.05


def test_it_arrives_leaning_to_the_same_side_wherever_it_comes_from():
    goal = Goal(np.array([0.4, 0.4, 0.1]), np.array([0.0, 0.0, 1.0]), standoff_m=0.05)
    arrivals = []
    for lean_deg in (-30.0, 0.0, 30.0):
        away = np.array([np.sin(np.radians(lean_deg)), 0.0, np.cos(np.radians(lean_deg))])
        tip = Tip(goal.target + 0.3 * away, -away)
        arrival, has_begun = WAY.next_place(goal, tip, np.zeros(7), LOOKS_ON)
        assert not has_begun
        assert np.degrees(np.arccos(arrival.normal[2])) == pytest.approx(33.0)
        arrivals.append(arrival.normal)
    np.testing.assert_allclose(arrivals, [arrivals[0]] * 3)
    assert arrivals[0][0] == pytest.approx(arrivals[0][1])
    assert arrivals[0][0] > 0.0
    # Where it waits for the eye in the hand to see the target, it leans already.
    np.testing.assert_allclose(WAY.above(goal, 0.15).normal, arrivals[0])


@pytest.mark.parametrize("way", [Spiral(), WAY])
def test_where_the_arm_cannot_lean_it_goes_straight_down(way):
    goal = Goal(np.array([0.79, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]), standoff_m=0.05)
    assert is_reachable(goal)
    above = Tip(goal.position + 0.1 * goal.normal, -goal.normal)
    next_one, _ = way.next_place(goal, above, np.zeros(7), LOOKS_ON)
    assert (next_one.target == goal.target).all()
    assert (next_one.normal == goal.normal).all()
