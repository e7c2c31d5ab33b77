"""Reward terms: the thesis's five and four shapings, each switched alone, and their formulas."""

import dataclasses
import math

import numpy as np
import pytest
from postures import posture_at

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_RANGE_RAD
from hvs_suite.tasks.shared.rewards import StepOutcome, joint_distance, reward_terms
from hvs_suite.tasks.shared.spec import THESIS_REWARDS, RewardTerm, Spec

ON_THE_WAY = StepOutcome(
    success=False,
    collision=False,
    truncated=False,
    distance_m=0.3,
    lateral_m=0.18,
    height_m=0.24,
    tilt_deg=40.0,
    joint_distance=0.2,
)
ALL: tuple[RewardTerm, ...] = (
    *THESIS_REWARDS,
    "lateral",
    "height",
    "joint_space",
    "exponential",
)


def spec(*rewards: RewardTerm, time_limit: str = "soft") -> Spec:
    return dataclasses.replace(
        hvs_suite.TASKS["align-thesis"],
        rewards=rewards,
        time_limit=time_limit,  # type: ignore[arg-type]
    )


def outcome(**changes: object) -> StepOutcome:
    return dataclasses.replace(ON_THE_WAY, **changes)  # type: ignore[arg-type]


def test_each_term_switches_alone() -> None:
    values = {
        "time": -0.05,
        "position": 0.4 * (1.559 - 0.3) / 1.559,
        "lateral": 0.4 * (1.559 - 0.18) / 1.559,
        "height": 0.4 * (1.559 - 0.24) / 1.559,
        "rotation": 0.4 * (179.0 - 40.0) / 179.0,
        "joint_space": 0.4 * 0.8,
        "exponential": 0.4 * math.exp(-6.0),
    }
    for name in ALL:
        terms = reward_terms(spec(name), ON_THE_WAY)
        assert terms == ({name: pytest.approx(values[name])} if name in values else {})
        assert reward_terms(spec(name), outcome(success=True)) == (
            {"goal": 1.0} if name == "goal" else {}
        )
        assert reward_terms(spec(name), outcome(collision=True)) == (
            {"collision": -1.0} if name == "collision" else {}
        )
    everything = reward_terms(spec(*ALL), ON_THE_WAY)
    assert everything == {name: pytest.approx(value) for name, value in values.items()}


@pytest.mark.parametrize(
    ("further", "on_the_way"),
    [
        ((), 0.0),
        (("rotation",), 0.4 * 139.0 / 179.0),
        (("position",), 0.4 * 1.259 / 1.559),
        (("position", "rotation"), 0.4 * (1.259 / 1.559 + 139.0 / 179.0)),
        (("time",), -0.05),
        (("time", "position", "rotation"), 0.4 * (1.259 / 1.559 + 139.0 / 179.0) - 0.05),
    ],
)
def test_the_thesis_s_six_sets_are_there(
    further: tuple[RewardTerm, ...], on_the_way: float
) -> None:
    """D.4: goal and collision alone, and with each of five additions."""
    chosen = spec("goal", "collision", *further)
    assert sum(reward_terms(chosen, ON_THE_WAY).values()) == pytest.approx(on_the_way)
    assert sum(reward_terms(chosen, outcome(success=True)).values()) == 1.0
    assert sum(reward_terms(chosen, outcome(collision=True)).values()) == -1.0


def test_collision_replaces_everything_and_the_goal_every_shaping() -> None:
    assert reward_terms(spec(*ALL), outcome(collision=True, success=True)) == {"collision": -1.0}
    assert reward_terms(spec(*ALL), outcome(success=True)) == {"goal": 1.0}


@pytest.mark.parametrize(
    ("distance_m", "share"),
    [(0.0, 1.0), (0.001, 1.0), (0.0011, (1.559 - 0.0011) / 1.559), (1.559, 0.0)],
)
def test_position_pays_in_full_within_tolerance_and_falls_linearly(
    distance_m: float, share: float
) -> None:
    terms = reward_terms(spec("position"), outcome(distance_m=distance_m))
    assert terms["position"] == pytest.approx(0.4 * share)


@pytest.mark.parametrize(
    ("tilt_deg", "share"), [(0.0, 1.0), (1.0, 1.0), (90.0, 89.0 / 179.0), (179.0, 0.0)]
)
def test_rotation_pays_in_full_within_tolerance_and_falls_linearly(
    tilt_deg: float, share: float
) -> None:
    """With A, the angle: the thesis's algorithm prints the length L here."""
    terms = reward_terms(spec("rotation"), outcome(tilt_deg=tilt_deg))
    assert terms["rotation"] == pytest.approx(0.4 * share)


@pytest.mark.parametrize(
    ("task", "lateral_m", "height_m"),
    [("align-thesis", 0.001, 0.001), ("align-drill", 0.00025, 0.001)],
)
def test_lateral_and_height_each_pay_in_full_within_their_own_tolerance(
    task: str, lateral_m: float, height_m: float
) -> None:
    chosen = dataclasses.replace(hvs_suite.TASKS[task], rewards=("lateral", "height"))
    for lateral, height in ((lateral_m, 0.3), (0.3, height_m)):
        terms = reward_terms(chosen, outcome(lateral_m=lateral, height_m=height))
        assert (terms["lateral"] == 0.4, terms["height"] == 0.4) == (lateral < 0.3, height < 0.3)
        beyond = reward_terms(chosen, outcome(lateral_m=1.1 * lateral, height_m=1.1 * height))
        assert beyond["lateral"] < terms["lateral"]
        assert beyond["height"] < terms["height"]


def test_exponential_falls_to_one_eth_at_50_mm() -> None:
    at = [
        reward_terms(spec("exponential"), outcome(distance_m=d))["exponential"]
        for d in (0.0, 0.05, 0.10)
    ]
    np.testing.assert_allclose(at, 0.4 * np.exp([0, -1, -2]))


def test_joint_space_measures_the_way_to_the_nearest_goal_posture() -> None:
    family = kinematics().goal_configurations([0.6, 0.1, 0.05], [0, 0, 1.0])
    assert joint_distance(family[17], family) == 0.0
    beside = family[17] + np.array([0, 0, 0, 0.01, 0, 0, 0])
    assert joint_distance(beside, family[17:18]) == pytest.approx(0.01 / (2 * JOINT_RANGE_RAD[3]))
    assert 0.0 < joint_distance(np.zeros(7), family) < 1.0


def test_a_hard_time_limit_costs_the_goal_s_reward_and_a_soft_one_nothing() -> None:
    late = outcome(truncated=True)
    assert reward_terms(spec(time_limit="soft"), late) == {}
    assert reward_terms(spec(time_limit="hard"), late) == {"time_limit": -1.0}
    assert reward_terms(spec(time_limit="hard"), ON_THE_WAY) == {}
    assert reward_terms(spec("goal", time_limit="hard"), outcome(success=True)) == {"goal": 1.0}


def test_scoring_is_sparse_by_default() -> None:
    assert all(v.rewards == ("goal", "collision") for v in hvs_suite.TASKS.values())


def linear(error_mm: float, tolerance_mm: float) -> float:
    length = 2 * 780 - tolerance_mm
    return 0.4 if error_mm <= tolerance_mm else 0.4 * (length - error_mm) / length


@pytest.mark.parametrize("task", ["align-thesis", "align-drill"])
def test_the_environment_pays_what_the_formulas_say(task: str) -> None:
    """On the way to the goal, step by step, with every term on."""
    with hvs_suite.load(
        task, observations="state", goal=(0.6, 0.1), start=(0.0,) * 7, rewards=ALL
    ) as env:
        env.reset(scenario=0)
        goal = env.commandable(posture_at(0.6, 0.1, 0.05))
        family = kinematics().goal_configurations([0.6, 0.1, 0.05], [0, 0, 1.0])
        tolerance = env.spec.position_tolerance_mm or env.spec.lateral_tolerance_mm
        height_tolerance = env.spec.height_tolerance_mm or tolerance
        angle = 180.0 - env.spec.tilt_tolerance_deg
        time_step = env.step(goal)
        paid = []
        while not time_step.last():
            errors = env.info["errors"]
            d, a = errors["position_error_mm"] / 1000, errors["tilt_error_deg"]
            expected = {
                "time": -0.05,
                "position": linear(1000 * d, tolerance),
                "lateral": linear(errors["lateral_error_mm"], tolerance),
                "height": linear(errors["height_error_mm"], height_tolerance),
                "rotation": 0.4 if a <= 180 - angle else 0.4 * (angle - a) / angle,
                "joint_space": 0.4 * (1 - joint_distance(env.joint_positions, family)),
                "exponential": 0.4 * math.exp(-d / 0.05),
            }
            assert env.task.reward_terms == {k: pytest.approx(v) for k, v in expected.items()}
            assert time_step.reward == pytest.approx(sum(expected.values()))
            paid.append(time_step.reward)
            time_step = env.step(goal)
        assert env.info["is_success"]
        assert time_step.reward == 1.0
        assert paid[-1] > paid[0] + 0.4


def test_a_hard_limit_is_still_a_truncation() -> None:
    with hvs_suite.load(
        "align-thesis", observations="state", time_limit="hard", time_limit_steps=2
    ) as env:
        env.reset(scenario=0)
        assert env.step(np.zeros(7)).reward == 0.0
        last = env.step(np.zeros(7))
        assert (last.reward, last.discount, env.info["truncated"]) == (-1.0, 1.0, True)
