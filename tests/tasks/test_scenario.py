"""Scenarios are a pure function of task, version, scene options, split and index."""

import dataclasses
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_RANGE_RAD
from hvs_suite.cell.surface import Surface
from hvs_suite.errors import OptionError, ScenarioError
from hvs_suite.registry import find, make_task
from hvs_suite.tasks.align import fixed_places
from hvs_suite.tasks.shared.environment import Environment
from hvs_suite.tasks.shared.scenario import ScenarioSource, StepStream
from hvs_suite.tasks.shared.start import steps_lower_bound

Named = Callable[..., Environment]


def source(task: str, split: str = "test", **options: Any) -> ScenarioSource:
    return make_task(hvs_suite.TASKS[task].with_options(options), split).source


def digests(draws: ScenarioSource, indices: list[int]) -> list[str]:
    return [draws.draw(index).digest() for index in indices]


@pytest.mark.each_task
def test_a_scenario_depends_on_its_index_and_on_no_other_draw(task: str) -> None:
    forward, backward = source(task), source(task)
    indices = [0, 1, 2, 37, 999]
    expected = digests(forward, indices)
    assert len(set(expected)) == len(indices)
    assert digests(backward, indices[::-1]) == expected[::-1]
    assert digests(backward, [37, 37, 37]) == [expected[3]] * 3
    forward.generator("noise-eih", 37, 4).random(1000)
    assert digests(forward, [37]) == [expected[3]]


def test_a_stream_that_is_set_to_a_step_draws_as_one_made_for_it() -> None:
    draws = source("align-hard")
    stream = StepStream(draws, "noise-eth")
    for index, step in ((3, 0), (3, 7), (0, 7), (999, 39), (3, 7)):
        expected = draws.generator("noise-eth", index, step).integers(1000, size=5)
        np.testing.assert_array_equal(stream.at(index, step).integers(1000, size=5), expected)


@pytest.mark.each_task
def test_options_that_do_not_shape_the_scene_leave_it_alone(task: str) -> None:
    expected = digests(source(task), [0, 5])
    for options in (
        {"rewards": ("goal", "collision", "time", "position", "rotation")},
        {"observations": "state"},
        {"observations": "eih", "normalise_observation": True},
        {"eih_resolution": 64, "eth_resolution": 64, "eih_channels": 1, "multisampling": 4},
        {"action_mode": "joint_delta"},
        {"tilt_tolerance_deg": 3.0},
        {"discount": 0.9, "time_limit": "hard"},
        {"eth_position_m": (-1.0, 0.7, 2.5), "eih_fov_deg": 65.0},
        {"target_diameter_m": 0.9 * find(task).target_diameter_m},
        {"acceleration_limits": True},
    ):
        assert digests(source(task, **options), [0, 5]) == expected, options


@pytest.mark.parametrize(
    "options",
    [
        {"ring_m": (0.45, 0.7)},
        {"surface": "curved"},
        {"joint_offset_deg": 0.1},
        {"standoff_m": 0.1},
    ],
)
def test_options_that_shape_the_scene_give_streams_of_their_own(options: dict[str, Any]) -> None:
    one, other = source("align-easy").draw(3), source("align-easy", **options).draw(3)
    assert not np.array_equal(one.target, other.target)


def test_naming_the_tasks_own_value_changes_nothing() -> None:
    own = source("align-easy", ring_m=(0.40, 0.78), start="zero")
    assert digests(own, [0, 7]) == digests(source("align-easy"), [0, 7])


def test_tasks_versions_and_splits_have_streams_of_their_own() -> None:
    targets = {
        (task, split): tuple(source(task, split).draw(0).target)
        for task in ("align-easy", "align-thesis", "align-limit")
        for split in ("train", "test", "held-out")
    }
    spec = dataclasses.replace(hvs_suite.TASKS["align-easy"], version=2)
    targets["next version"] = tuple(make_task(spec, "test").source.draw(0).target)
    assert len(set(targets.values())) == len(targets)


@pytest.mark.parametrize("index", [-1, 1000, 2**62, 1.0, "1", None, True, np.float64(2)])
def test_test_holds_1000_scenarios_and_refuses_what_is_none(index: Any) -> None:
    with pytest.raises(ScenarioError, match=r"whole number|0 to 999"):
        source("align-easy").draw(index)


def test_the_environment_refuses_a_scenario_out_of_range_and_goes_on(named: Named) -> None:
    env = named("align-thesis", "state")
    with pytest.raises(ScenarioError, match=r"scenario 1000 .* 'test' of align-thesis .* 0 to 999"):
        env.reset(scenario=1000)
    env.reset(scenario=999)
    assert env.info["scenario"] == 999


def test_other_splits_are_unbounded() -> None:
    draws = source("align-hard", "train")
    for index in (1000, 10**9, 2**40, 2**62 - 1, np.int64(5)):
        assert draws.draw(index).index == index
    with pytest.raises(ScenarioError, match="out of range"):
        draws.draw(2**62)


@pytest.mark.parametrize("split", ["", "  ", None, 3])
def test_a_split_needs_a_name(split: Any) -> None:
    with pytest.raises(ScenarioError, match="split is a name"):
        hvs_suite.load("align-easy", split=split)


@pytest.mark.each_task
def test_info_carries_task_split_and_scenario(named: Named, task: str) -> None:
    env = named(task, "state")
    env.reset(scenario=12)
    for _ in range(2):
        assert (env.info["task"], env.info["split"], env.info["scenario"]) == (task, "test", 12)
        assert (env.split, env.scenario.index) == ("test", 12)
        env.step(env.commandable(env.scenario.start))


def test_a_seed_plays_the_scenario_of_that_number() -> None:
    with hvs_suite.load("align-thesis", split="test", observations="state") as env:
        for seed, scenario in [(0, 0), (7, 7), (1000, 0), (2**40 + 3, (2**40 + 3) % 1000)]:
            env.reset(seed=seed)
            assert env.info["scenario"] == scenario
        # Bare resets go on from the seed without repeating.
        env.reset(seed=7)
        walk = [7]
        for _ in range(50):
            env.reset()
            walk.append(env.info["scenario"])
        assert len(set(walk)) == len(walk)
    with hvs_suite.load("align-thesis", split="train", observations="state") as env:
        env.reset(seed=2**40 + 3)
        assert env.info["scenario"] == 2**40 + 3


@pytest.mark.each_task
def test_workers_seeded_in_a_row_share_no_scenes(task: str) -> None:
    train, test = source(task, "train"), source(task, "test")
    # Sixteen workers, a thousand resets each.
    streams = [{train.seeded_index(100 + w, n) for n in range(1000)} for w in range(16)]
    assert len(set.union(*streams)) == 16 * 1000
    # Test has a thousand scenes: 36 workers get 27 resets each out of it.
    streams = [{test.seeded_index(100 + w, n) for n in range(27)} for w in range(36)]
    assert len(set.union(*streams)) == 36 * 27
    assert {test.seeded_index(5, n) for n in range(1000)} == set(range(1000))


def test_no_global_generator_is_drawn_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thesis drew everything from the global generators, and training and evaluation alike."""

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("drawn from a global generator")

    n_refused = 0
    for module in (random, np.random):
        for name, function in list(vars(module).items()):
            # The global generators' methods stand in their modules as functions.
            owner = getattr(function, "__self__", None)
            if isinstance(owner, random.Random | np.random.RandomState):
                monkeypatch.setattr(module, name, refuse)
                n_refused += 1
    assert n_refused > 50
    with pytest.raises(AssertionError):
        random.random()
    with hvs_suite.load("align-drill", split="test", seed=3) as env:
        env.reset()
        env.step(env.commandable(env.scenario.start))
        env.task.source.seeded_index(3, 1)


@pytest.mark.parametrize("task", ["align-easy", "align-thesis", "align-hard"])
def test_targets_are_uniform_in_area_on_the_ring(task: str) -> None:
    played = make_task(hvs_suite.TASKS[task], "test")
    streams = map(played.source.streams, range(1000))
    targets = np.array([played.family._draw_goal(each).target for each in streams])
    radius = np.hypot(targets[:, 0], targets[:, 1])
    assert radius.min() >= 0.40
    assert radius.max() <= 0.78
    np.testing.assert_array_equal(targets[:, 2], 0.0)
    area = (radius**2 - 0.40**2) / (0.78**2 - 0.40**2)
    azimuth = np.arctan2(targets[:, 1], targets[:, 0]) / (2 * np.pi) + 0.5
    assert stats.kstest(area, "uniform").pvalue > 0.01
    assert stats.kstest(azimuth, "uniform").pvalue > 0.01
    # All of it within reach: the thesis drew x and y apart, and lost 70 % of its goals.
    far = targets[radius.argmax()] + [0, 0, 0.05]
    near = targets[radius.argmin()] + [0, 0, 0.05]
    for goal in (far, near):
        assert len(kinematics().goal_configurations_at_tool_angle(goal, [0, 0, 1.0], 0.0))


def test_the_ring_bounds_where_targets_lie() -> None:
    draws = source("align-thesis", ring_m=(0.60, 0.65))
    radius = np.hypot(*np.array([draws.draw(index).target[:2] for index in range(200)]).T)
    assert 0.60 <= radius.min() < 0.605
    assert 0.645 < radius.max() <= 0.65


def test_fixed_places_are_ten_and_taken_by_index() -> None:
    draws, places = source("align-fixed"), fixed_places(0.40, 0.78)
    assert len(set(places)) == 10
    for index in (0, 9, 10, 503):
        np.testing.assert_array_equal(draws.draw(index).target[:2], places[index % 10])
    radius = np.hypot(*np.array(places).T)
    assert radius.min() > 0.40
    assert radius.max() < 0.78


@pytest.mark.parametrize("n", [100, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "task", ["align-hard", "align-drill", "align-limit", "sequence-hard", "track-hard"]
)
def test_random_starts_are_clear_and_far_from_the_goal_with_time_to_spare(
    named: Named, task: str, n: int
) -> None:
    env, model = named(task, "state"), kinematics()
    starts = []
    for index in range(n):
        env.reset(scenario=index)
        q, goal = env.scenario.start, env.goal()
        starts.append(q)
        assert (np.abs(q) <= 0.8 * JOINT_RANGE_RAD).all()
        assert model.clearance(q) >= 0.05
        assert np.linalg.norm(model.flange_pose(q)[1] - goal.position) >= 0.10
        assert steps_lower_bound(env.spec, q, goal) + 5 <= env.spec.time_limit_steps
    spread = np.ptp(np.array(starts) / JOINT_RANGE_RAD, axis=0)
    assert (spread > 1.2).all()


def test_starts_of_the_thesis_are_upright() -> None:
    for task in ("align-fixed", "align-easy", "align-thesis"):
        np.testing.assert_array_equal(source(task).draw(3).start, np.zeros(7))


def test_joint_offsets_are_normal_and_cut_at_two_sigma() -> None:
    draws = source("align-drill")
    offsets = np.array([draws.streams(i).cut_normal("joint_offset", 7) for i in range(400)]) * 0.05
    np.testing.assert_allclose(np.deg2rad(offsets[6]), draws.draw(6).joint_offset)
    assert 0.095 < np.abs(offsets).max() <= 0.100
    # A unit normal cut at two sigma has a standard deviation of 0.880.
    assert offsets.std() == pytest.approx(0.05 * 0.880, rel=0.05)
    assert abs(offsets.mean()) < 0.003


@pytest.mark.parametrize(
    "task",
    ["align-fixed", "align-easy", "align-thesis", "align-limit", "sequence-thesis", "track-line",
     "track-curve"],
)  # fmt: skip
def test_undisturbed_tasks_are_undisturbed(task: str) -> None:
    scenario = source(task).draw(4)
    for value in (scenario.joint_offset, scenario.eth_shift, scenario.eth_turn):
        np.testing.assert_array_equal(value, 0.0)
    assert scenario.light_direction is None
    assert scenario.surface_rgb is None
    assert scenario.texture_seed is None
    np.testing.assert_array_equal(scenario.robot_tint, 1.0)
    np.testing.assert_array_equal(scenario.light_level, 1.0)


@pytest.mark.parametrize("task", ["align-hard", "align-drill", "sequence-hard", "track-hard"])
def test_disturbed_tasks_draw_every_disturbance_anew(task: str) -> None:
    draws = source(task)
    scenes = [draws.draw(index) for index in range(8)]
    drawn = ["eth_shift", "eth_turn", "light_direction", "light_level", "surface_rgb"]
    drawn += ["target_rgb", "robot_tint", "texture_seed"]
    drawn += ["joint_offset"] if task in ("align-drill", "sequence-hard") else []
    for name in drawn:
        values = {np.asarray(getattr(scene, name)).tobytes() for scene in scenes}
        assert len(values) == len(scenes), name
    for scene in scenes:
        assert scene.target_rgb is not None
        # Red stays the target's own: nothing else in the cell is drawn in it.
        assert scene.target_rgb[0] > 3 * scene.target_rgb[1:].max()


@pytest.mark.parametrize(
    ("start", "goal", "starts", "goals"),
    [("random", "random", 12, 12), ("random", "fixed", 12, 1),
     ("fixed", "random", 1, 12), ("fixed", "fixed", 1, 1)],
)  # fmt: skip
def test_start_and_goal_can_each_be_fixed_or_random(
    start: str, goal: str, starts: int, goals: int
) -> None:
    draws = source("align-thesis", "train", start=start, goal=goal, time_limit_steps=40)
    scenes = [draws.draw(index) for index in range(12)]
    assert len({scene.start.tobytes() for scene in scenes}) == starts
    assert len({scene.target.tobytes() for scene in scenes}) == goals
    other = source("align-thesis", "test", start=start, goal=goal, time_limit_steps=40).draw(0)
    assert not np.array_equal(other.target, scenes[0].target)


def test_a_given_start_and_goal_are_taken_as_they_are() -> None:
    start = (0.1, -0.2, 0.3, -0.4, 0.5, 0.6, -0.7)
    scene = source("align-thesis", start=start, goal=(-0.3, 0.5)).draw(7)
    np.testing.assert_array_equal(scene.start, start)
    np.testing.assert_array_equal(scene.target, [-0.3, 0.5, 0.0])


@pytest.mark.parametrize("surface", ["flat", "tilted", "curved"])
@pytest.mark.parametrize("start", ["near_goal", "mixed"])
def test_starts_near_the_goal_are_near_and_clear(start: str, surface: str) -> None:
    draws = source("align-thesis", "train", start=start, surface=surface)
    n = 40
    distances = []
    for index in range(n):
        scene = draws.draw(index)
        goal = scene.target + 0.05 * scene.normal
        distances.append(float(np.linalg.norm(kinematics().flange_pose(scene.start)[1] - goal)))
        assert (np.abs(scene.start) <= JOINT_RANGE_RAD).all()
    near = np.array(distances) < 0.30
    if start == "near_goal":
        assert near.mean() > 0.8
        assert min(distances) < 0.01
    else:
        upright = np.array([not draws.draw(i).start.any() for i in range(n)])
        assert 0.25 < upright.mean() < 0.75


def test_a_panel_that_leans_towards_the_arm_has_starts_near_the_goal() -> None:
    draws = source("surface-fuselage", "train", start="mixed")
    scene = draws.draw(459)  # its plane, were it endless, would cut the shoulder
    goal = scene.target + 0.05 * scene.normal
    assert np.linalg.norm(kinematics().flange_pose(scene.start)[1] - goal) < 0.30


@pytest.mark.parametrize("surface", ["tilted", "curved"])
def test_targets_on_other_surfaces_lie_on_them_and_within_reach(surface: str) -> None:
    draws = source("align-thesis", "train", surface=surface)
    panel = Surface(shape=surface)
    for index in range(40):
        scene = draws.draw(index)
        x, y, z = scene.target
        assert z == panel.height(x, y)
        goal = scene.target + 0.05 * scene.normal
        assert len(kinematics().goal_configurations_at_tool_angle(goal, scene.normal, 0.0))


def test_a_given_goal_out_of_reach_is_refused() -> None:
    with pytest.raises(OptionError, match="out of the arm's reach"):
        hvs_suite.load("align-thesis", goal=(0.9, 0.3))
