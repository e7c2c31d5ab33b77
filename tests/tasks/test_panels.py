"""Surface: a panel stands there at any slope and height, and its marks show how."""

import math
from typing import Any

import numpy as np
import pytest
from postures import goal_posture

import hvs_suite
from hvs_suite.cell.cameras import extrinsics, intrinsics, look_at, project
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.solid import Solid, obstacle_distance
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.depth_noise import as_measured
from hvs_suite.tasks.shared.pattern_pose import Look, Ring, RingPose, fit

CURVED = "surface-fuselage"
STEEP = 3
"""A test scene whose panel leans a good deal."""
TASKS = ("surface-tilted", CURVED, "surface-hard")


@pytest.mark.parametrize("task", TASKS)
def test_target_and_marks_lie_on_a_panel_that_stands_on_the_table(task: str) -> None:
    with hvs_suite.load(task, split="test", observations="state") as env:
        spec, family = env.spec, env.task.family
        tilts, panels = [], set()
        for index in range(20):
            scene = env.task.source.draw(index)
            panel = family._panels.panels[scene.panel]
            radius = 1.0 / panel.curvature if panel.curvature else math.inf
            away = scene.marks - scene.target
            # On the skin, on the ring around the target, and no farther below the plane that
            # touches it there than a cylinder bends.
            below = -away @ scene.normal
            assert below.min() >= -1e-12
            assert below.max() <= 1.01 * spec.mark_ring_m**2 / (2.0 * radius) + 1e-12
            across = np.linalg.norm(away + np.outer(below, scene.normal), axis=1)
            np.testing.assert_allclose(across, spec.mark_ring_m, rtol=2e-3)
            assert spec.ring_m[0] <= np.hypot(*scene.target[:2]) <= spec.ring_m[1]
            [solid] = (panel.solid(scene.panel_position, scene.panel_turn),)
            up = solid.rotation[:, 2]
            lowest = min((solid.rotation @ p + scene.panel_position)[2] for p in panel.corners())
            assert spec.raise_m[0] - 1e-9 <= lowest <= spec.raise_m[1] + 1e-9
            tilts.append(math.degrees(math.acos(up[2])))
            panels.add(scene.panel)
            # The box that planners keep out of holds the target, and nothing of the base.
            assert solid.distance(scene.target[None])[0] <= 1e-9
            assert solid.distance(np.array([[0.0, 0.0, 0.1]]))[0] > 0.15
        assert max(tilts) <= spec.tilt_deg[1]
        assert np.ptp(tilts) > 10.0
        assert len(panels) == 1 if spec.radius_m is None else len(panels) > 5


def test_one_panel_is_seen_and_it_looks_as_the_scene_says() -> None:
    with hvs_suite.load(CURVED, split="test", observations="state", vary_colour=True) as env:
        geoms = env.task.family._panels.geoms
        for index in (0, 3):
            env.reset(scenario=index)
            camera = env.task.cameras["eth"]
            shown = np.unique(env.renderer.segmentation(env.physics.data.ptr, camera.id, 300, 300))
            assert set(shown) & set(geoms) == {geoms[env.scenario.panel]}
            colour = env.physics.model.ptr.geom_rgba[geoms[env.scenario.panel], :3]
            np.testing.assert_allclose(colour, env.scenario.panel_rgb, rtol=1e-6)


def test_errors_are_to_the_slope_at_the_target() -> None:
    with hvs_suite.load(CURVED, split="test", observations="state") as env:
        env.reset(scenario=STEEP)
        assert env.scenario.normal[2] < math.cos(math.radians(3.0))
        env.task.place(env.physics, goal_posture(env))
        assert env.task.errors["position_error_mm"] < 1e-3
        assert env.task.errors["tilt_error_deg"] < 1e-3
        goal = env.goal()
        level = kinematics().goal_configurations_at_tool_angle(goal.position, [0, 0, 1], 0.0)
        env.task.place(env.physics, level[0])
        off = math.degrees(math.acos(env.scenario.normal[2]))
        assert env.task.errors["tilt_error_deg"] == pytest.approx(off, abs=1e-3)


@pytest.mark.parametrize("task", TASKS[:2])
def test_touching_the_panel_ends_the_episode(task: str) -> None:
    with hvs_suite.load(task, split="test", observations="state") as env:
        env.reset(scenario=1)
        goal = env.goal()
        # From a hand's breadth above it straight down to below the skin.
        for rise in np.linspace(0.05, -0.03, 9):
            position = goal.target + rise * goal.normal
            family = kinematics().goal_configurations_at_tool_angle(position, goal.normal, 0.0)
            if rise == 0.05:
                q = goal_posture(env)
                env.task.place(env.physics, q)
            q = family[np.abs(family - q).max(axis=1).argmin()]
            if env.step(env.commandable(q)).last():
                break
        assert env.info["collision"]
        assert not env.info["is_success"]


def test_what_leans_is_measured_as_it_stands() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        turn = random.normal(size=3) * 0.4
        half = tuple(random.uniform(0.02, 0.2, 3))
        solid = Solid("box", half, (0.5, 0.1, 0.2), random.uniform(-3, 3), tuple(turn))
        points = random.uniform(-0.3, 0.3, (50, 3))
        at_origin = Solid("box", half).distance(points)
        moved = points @ solid.rotation.T + solid.centre
        np.testing.assert_allclose(solid.distance(moved), at_origin, atol=1e-12)


def test_the_tool_comes_near_what_it_faces_without_a_dome() -> None:
    [q, *_] = kinematics().goal_configurations_at_tool_angle([0.5, 0.0, 0.15], [0, 0, 1], 0.0)
    upright = Solid("box", (0.1, 0.1, 0.05), (0.5, 0.0, 0.05))
    faced = Solid("box", (0.1, 0.1, 0.05), (0.5, 0.0, 0.05), is_faced=True)
    assert obstacle_distance((faced,))(q) == pytest.approx(0.05, abs=1e-4)
    assert obstacle_distance((upright,))(q) < 0.03


def test_a_ring_of_marks_is_found_from_where_it_was_seen() -> None:
    ring, K = Ring(0.02, 8, 0.0001), intrinsics(112, 60.0)
    normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    true = RingPose(np.array([0.5, 0.2, 0.1]), normal, 0.3)
    looks = []
    for place in ([0.52, 0.2, 0.2], [0.45, 0.25, 0.19], [0.5, 0.15, 0.18]):
        T = extrinsics(np.array(place), look_at(place, true.target))
        seen = project(ring.points(true), K, T)[:, :2]
        looks.append(Look(T, seen, np.full(8, 0.1), np.arange(8)))
    start = RingPose(true.target + 0.003, np.array([0.0, 0.0, 1.0]), 0.4)
    found = fit(looks, ring, start, K)
    np.testing.assert_allclose(found.pose.target, true.target, atol=1e-6)
    np.testing.assert_allclose(found.pose.normal, true.normal, atol=1e-6)
    assert found.misses < 1e-3
    # Half the marks from one place: it is less sure, and says so.
    alone = fit([Look(looks[0].T, *(each[::2] for each in _columns(looks[0])))], ring, start, K)
    assert (alone.sigmas > 1.5 * found.sigmas).all()


def _columns(look: Look) -> Any:
    return look.centres, look.sigmas, look.marks


def test_depth_is_noisier_from_farther_away_in_steps_and_with_holes_at_edges() -> None:
    random = np.random.default_rng(0)
    spread = []
    for metres in (1.0, 2.0):
        flat = np.full((120, 120, 1), metres, np.float32)
        measured = as_measured(flat, 60.0, 0.075, 0.5, random)
        assert (measured > 0.0).all()
        spread.append(float(measured.std()))
        scale = 0.075 * 320.0 / math.tan(math.radians(30.0))
        steps = scale / measured * 8.0
        np.testing.assert_allclose(steps, np.rint(steps), atol=0.01)
        assert measured.std() == pytest.approx(metres**2 * 0.5 / scale, rel=0.1)
    assert spread[1] == pytest.approx(4.0 * spread[0], rel=0.1)
    edge = np.full((40, 40, 1), 1.0, np.float32)
    edge[:, 20:] = 0.5
    holes = as_measured(edge, 60.0, 0.075, 0.1, random)[..., 0] == 0.0
    assert holes[:, 19:21].all()
    assert not holes[:, :18].any()
    assert not holes[:, 22:].any()


def test_noisy_depth_is_the_same_whenever_a_scene_is_played_and_true_depth_is_left_alone() -> None:
    options: dict[str, Any] = {"observations": "eih_depth+eth_depth"}
    with hvs_suite.load(CURVED, split="test", **options) as env:
        true = env.reset(scenario=0).observation
    with hvs_suite.load(CURVED, split="test", depth_noise_px=0.1, **options) as env:
        first = env.reset(scenario=0).observation
        env.reset(scenario=1)
        again = env.reset(scenario=0).observation
    for name in ("eih_depth", "eth_depth"):
        np.testing.assert_array_equal(first[name], again[name])
        assert first[name].dtype == np.float32
    seen = first["eth_depth"] > 0.0
    off = np.abs(first["eth_depth"] - true["eth_depth"])[seen & (true["eth_depth"] < 4.0)]
    assert 0.001 < np.median(off) < 0.05


@pytest.mark.parametrize(
    ("task", "options", "reason"),
    [
        ("surface-tilted", {"marker": "fiducial"}, "targets are discs"),
        ("surface-tilted", {"tilt_deg": (0.0, 40.0)}, "a least and a larger value, from 0 to 20"),
        ("surface-tilted", {"raise_m": (0.1, 0.05)}, "from 0 to 0.15"),
        ("surface-tilted", {"ring_m": (0.4, 0.78)}, "the arm cannot face a panel that leans by"),
        ("surface-tilted", {"n_marks": 2}, "fewer show no slope"),
        ("surface-tilted", {"start": "fixed"}, "where some panel would stand"),
        (CURVED, {"radius_m": (0.1, 2.0)}, "from 0.5 up"),
        (CURVED, {"mark_ring_m": 0.008}, "the marks overlap the target"),
        (CURVED, {"mark_ring_m": 0.09}, "the marks leave the panel"),
        (CURVED, {"n_marks": 24, "mark_diameter_m": 0.006}, "so many overlap"),
        ("surface-hard", {"depth_noise_px": -1.0}, "depth_noise_px is -1.0; it cannot be negative"),
    ],
)
def test_surfaces_that_make_no_sense_are_refused_in_one_line(
    task: str, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(OptionError, match=reason) as raised:
        hvs_suite.load(task, **options)
    assert len(str(raised.value).splitlines()) == 1
