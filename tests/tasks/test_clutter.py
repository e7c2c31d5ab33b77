"""Clutter: other things lie and stand around the target, and touching them ends the episode."""

import itertools
from typing import Any

import numpy as np
import pytest
from postures import goal_posture

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.solid import Solid, arm_balls, obstacle_distance
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.certificate_room import find_by_outline
from hvs_suite.tasks.shared.obstacles import LANE_M
from hvs_suite.tasks.shared.room import straight
from hvs_suite.tasks.shared.things import COLOURS

OBSTACLES = "clutter-obstacles"


@pytest.mark.parametrize("task", ["clutter-distractors", "clutter-choice"])
def test_the_target_is_the_only_whole_disc_of_its_colour_and_keeps_its_distance(task: str) -> None:
    with hvs_suite.load(task, split="test", observations="state") as env:
        numbers = set()
        for scenario in range(30):
            env.reset(scenario=scenario)
            (kind, place), *others = env.task.family.things()
            assert kind == f"{env.scenario.colour} disc"
            assert kind not in [other for other, _ in others]
            away = [np.linalg.norm(other - place) for _, other in others]
            assert min(away) >= env.spec.spacing_m
            numbers.add(len(others))
        low, high = env.spec.n_distractors
        assert numbers <= {n + len(env.spec.colours) - 1 for n in range(low, high + 1)}


def test_what_is_meant_differs_and_sentence_and_one_hot_say_it() -> None:
    with hvs_suite.load("clutter-choice", split="test") as env:
        asked = env.instruction
        told = set()
        for scenario in range(12):
            observation = env.reset(scenario=scenario).observation
            colour = COLOURS[int(observation["goal_colour"].argmax())]
            assert observation["goal_colour"].sum() == 1.0
            assert f"the {colour} disc" in env.instruction
            assert colour == env.scenario.colour
            told.add(env.instruction)
            # The disc of that colour is where the goal is.
            env.task.place(env.physics, goal_posture(env))
            picture = env.task.observables["eih"](env.physics, None)
            assert find_by_outline(env, picture, "eih") is not None
        assert len(told) >= 3
        assert asked not in told


def test_things_that_are_not_there_are_out_of_every_picture() -> None:
    options: dict[str, Any] = {"n_distractors": (0, 0), "colours": ("blue",)}
    with hvs_suite.load("clutter-distractors", split="test", **options) as env:
        env.reset(scenario=0)
        before = env.render(200, 200)
        geoms = env.task.family._props.geoms
        camera = env.task.cameras["eth"]
        shown = env.renderer.segmentation(env.physics.data.ptr, camera.id, 200, 200)
        assert set(np.unique(shown)) & set(geoms.values()) <= {geoms["disc-blue"]}
        assert env.task.family._disc_geoms["disc-red"] not in np.unique(shown)
        assert before.std() > 0


def test_touching_an_obstacle_ends_the_episode() -> None:
    with hvs_suite.load(OBSTACLES, split="test", observations="state", moves=False) as env:
        env.reset(scenario=1)
        solid = env.obstacles[0]
        x, y, _ = solid.centre
        top = solid.centre[2] + solid.half[2]
        family = kinematics().goal_configurations_at_tool_angle([x, y, top + 0.002], [0, 0, 1], 0.0)
        assert len(family)
        env.task.place(env.physics, family[0])
        time_step = env.step(env.commandable(family[0]))
        below = kinematics().goal_configurations_at_tool_angle([x, y, top - 0.03], [0, 0, 1], 0.0)
        nearest = below[np.abs(below - family[0]).max(axis=1).argmin()]
        for _ in range(5):
            if time_step.last():
                break
            time_step = env.step(env.commandable(nearest))
        assert env.info["collision"]
        assert not env.info["is_success"]


def test_one_obstacle_moves_along_its_lane_and_comes_to_rest() -> None:
    with hvs_suite.load(OBSTACLES, split="test", observations="state") as env:
        env.reset(scenario=0)
        family, start = env.task.family, env.scenario.placed
        carriage = next(each for each in start if each.prop == "carriage")
        mocap = family._props._mocaps["carriage"]
        before = env.obstacles
        ways = []
        for _ in range(env.spec.time_limit_steps):
            ways.append(env.physics.data.mocap_pos[mocap].copy() - carriage.pose[:3])
            if env.step(env.commandable(env.setpoint)).last():
                break
        lengths = np.linalg.norm(ways, axis=1)
        assert lengths[0] == 0.0
        assert lengths[-1] == pytest.approx(LANE_M)
        assert (np.diff(lengths) >= -1e-12).all()
        begins_s, speed = env.scenario.motion
        steps = np.arange(len(lengths)) * env.spec.control_period_s
        np.testing.assert_allclose(lengths, np.clip(speed * (steps - begins_s), 0.0, LANE_M))
        # While it may still move, all its lane is out of bounds; then where it rests.
        ahead = np.array([*carriage.pose[:2] + lengths[-1] * direction(carriage), 0.05])
        back = np.array([*carriage.pose[:2], 0.05])
        assert least(before, ahead) < 0.0
        assert least(before, back) < 0.0
        assert least(env.obstacles, ahead) < 0.0
        assert least(env.obstacles, back) > 0.1


def direction(placed: Any) -> Any:
    return np.array([np.cos(placed.pose[3]), np.sin(placed.pose[3])])


def least(solids: Any, point: Any) -> float:
    return float(min(solid.distance(point[None])[0] for solid in solids))


def test_a_way_stays_free_by_the_stated_rule() -> None:
    with hvs_suite.load(OBSTACLES, split="test", observations="state") as env:
        for scenario in range(15):
            env.reset(scenario=scenario)
            low, high = env.spec.n_obstacles
            assert low <= len(env.scenario.placed) - 1 <= high
            distance = obstacle_distance(env.obstacles)
            stations = [env.scenario.start, *env.scenario.way]
            for here, there in itertools.pairwise(stations):
                assert min(distance(q) for q in straight(here, there)) > 0.03
            _, flange = kinematics().flange_pose(stations[-1])
            np.testing.assert_allclose(flange, env.goal().position, atol=1e-9)


def test_balls_hold_the_arm_and_solids_measure_as_coal_does() -> None:
    random = np.random.default_rng(0)
    balls = arm_balls()
    for _ in range(40):
        q = random.uniform(-1.5, 1.5, 7)
        kind = "box" if random.random() < 0.5 else "cylinder"
        radius = random.uniform(0.03, 0.1)
        half = (radius, radius if kind == "cylinder" else 0.05, 0.2)
        solid = Solid(kind, half, tuple(random.uniform(-0.6, 0.6, 3)), random.uniform(-3, 3))
        by_balls = (solid.distance(balls.at(q[None])[0]) - balls.radius).min()
        by_coal = obstacle_distance((solid,))(q)
        # Balls stand out by less than an eighth of a link's radius.
        if by_coal > 0.0:
            assert -1e-6 <= by_coal - by_balls <= 0.012


def test_a_swept_solid_holds_it_all_along_the_way() -> None:
    random = np.random.default_rng(1)
    for _ in range(20):
        solid = Solid("box", (0.05, 0.02, 0.2), (0.3, 0.1, 0.2), random.uniform(-3, 3))
        way = random.uniform(-0.3, 0.3, 2)
        swept = solid.swept(way)
        for share in (0.0, 0.5, 1.0):
            there = np.array([*(np.array(solid.centre[:2]) + share * way), 0.2])
            c, s = np.cos(solid.yaw), np.sin(solid.yaw)
            for a, b in itertools.product((-0.05, 0.05), (-0.02, 0.02)):
                corner = there + np.array([c * a - s * b, s * a + c * b, 0.0])
                assert swept.distance(corner[None])[0] <= 1e-9


@pytest.mark.parametrize(
    ("task", "options", "reason"),
    [
        ("clutter-distractors", {"n_distractors": (6, 200)}, "do not fit on the ring"),
        ("clutter-distractors", {"n_distractors": (8, 6)}, "a least and a larger value"),
        ("clutter-choice", {"colours": ("red", "pink")}, "'pink', which is none of red, blue"),
        ("clutter-choice", {"colours": ("red", "red")}, "each once"),
        ("clutter-choice", {"marker": "ring"}, "targets are discs"),
        ("clutter-obstacles", {"n_obstacles": (2, 9)}, "a least and a larger value, from 0 to 6"),
        (
            "clutter-obstacles",
            {"obstacle_height_m": (0.1, 0.9)},
            "a least and a larger value, from 0.05 to 0.5",
        ),
        ("clutter-distractors", {"moves": True}, "an obstacle that can move"),
        ("clutter-distractors", {"observations": "eih+goal_colour"}, "unknown observation"),
    ],
)
def test_clutter_that_makes_no_sense_is_refused_in_one_line(
    task: str, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(OptionError, match=reason) as raised:
        hvs_suite.load(task, **options)
    assert len(str(raised.value).splitlines()) == 1
