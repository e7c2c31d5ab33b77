"""Surfaces and markers: targets lie on the panel, look as they should and hit nothing."""

import cv2
import mujoco
import numpy as np
import pytest
from postures import displaced, goal_posture

import hvs_suite
from hvs_suite.cell.surface import CURVATURE_RADIUS_M, TILT_RAD, Surface, SurfaceShape
from hvs_suite.registry import make_task
from hvs_suite.tasks.shared.detection import find_disc

SHAPES: list[SurfaceShape] = ["flat", "tilted", "curved"]


@pytest.mark.parametrize("shape", SHAPES)
def test_height_and_normal_are_those_of_the_panel_that_is_built(shape: SurfaceShape) -> None:
    """A ray from above meets the compiled panel where the formula says."""
    surface = Surface(shape=shape)
    model = mujoco.MjModel.from_xml_string(
        surface.mjcf_model.to_xml_string(), surface.mjcf_model.get_assets()
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(0)
    for x, y in rng.uniform(-0.8, 0.8, (40, 2)):
        geom = np.zeros(1, np.int32)
        eye = np.array([x, y, 2.0])
        depth = mujoco.mj_ray(model, data, eye, np.array([0.0, 0.0, -1.0]), None, 1, -1, geom)
        # The curved panel is a mesh of 64 strips: between their edges it lies a little lower.
        assert 2.0 - depth == pytest.approx(surface.height(x, y), abs=1e-4)
        step = 1e-5
        slope = [
            (surface.height(x + step, y) - surface.height(x - step, y)) / (2 * step),
            (surface.height(x, y + step) - surface.height(x, y - step)) / (2 * step),
        ]
        expected = np.array([-slope[0], -slope[1], 1.0])
        np.testing.assert_allclose(
            surface.normal(x, y), expected / np.linalg.norm(expected), atol=1e-6
        )


def test_the_panels_have_the_published_shapes() -> None:
    tilted, curved = Surface(shape="tilted"), Surface(shape="curved")
    assert np.rad2deg(TILT_RAD) == pytest.approx(10.0)
    assert np.rad2deg(np.arccos(tilted.normal(0.3, 0.1)[2])) == pytest.approx(10.0)
    for x in (-0.7, 0.0, 0.5):
        centre = np.array([0.0, 0.0, -CURVATURE_RADIUS_M])
        point = np.array([x, 0.0, curved.height(x, 0.3)])
        assert np.linalg.norm(point - centre) == pytest.approx(CURVATURE_RADIUS_M)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("marker", ["disc", "ring", "fiducial"])
def test_every_marker_lies_on_every_surface_and_is_seen_from_the_goal(
    shape: SurfaceShape, marker: str
) -> None:
    with hvs_suite.load(
        "align-thesis", split="test", surface=shape, marker=marker, goal=(0.55, 0.15)
    ) as env:
        env.reset(scenario=0)
        scenario = env.scenario
        surface = env.task.root_entity.surface
        assert scenario.target[2] == pytest.approx(surface.height(0.55, 0.15))
        np.testing.assert_allclose(scenario.normal, surface.normal(0.55, 0.15))
        body = env.physics.bind(env.task.family.marker.geom)
        np.testing.assert_allclose(body.xmat.reshape(3, 3)[:, 2], scenario.normal, atol=1e-9)
        above = (body.xpos - scenario.target) @ scenario.normal
        assert 0 < above < 1e-3
        env.task.place(env.physics, goal_posture(env))
        assert env.info["errors"]["position_error_mm"] < 1e-6
        assert env.info["errors"]["tilt_error_deg"] < 1e-6
        np.testing.assert_allclose(env.goal().position, scenario.target + 0.05 * scenario.normal)
        assert env.physics.data.ncon == 0
        ids = env.renderer.segmentation(env.physics.data.ptr, env.task.cameras["eih"].id, 112, 112)
        names = {env.physics.model.id2name(int(i), "geom") for i in np.unique(ids)}
        assert "marker/marker" in names
        seen = env.privileged()["target_eih"]
        np.testing.assert_allclose(seen[:2], 0.0, atol=1e-3)
        assert seen[3] == 1.0


@pytest.mark.parametrize("shape", SHAPES)
def test_an_episode_on_any_surface_can_be_won(shape: SurfaceShape) -> None:
    with hvs_suite.load("align-easy", observations="state", surface=shape) as env:
        for index in range(3):
            env.reset(scenario=index)
            action = env.commandable(goal_posture(env))
            while not env.step(action).last():
                pass
            assert env.info["is_success"]
            assert not env.info["collision"]


def test_the_fiducial_shows_its_yaw_and_reads_as_a_marker() -> None:
    with hvs_suite.load(
        "align-thesis", marker="fiducial", target_diameter_m=0.04, goal=(0.55, 0.15)
    ) as env:
        env.reset(scenario=0)
        corners = []
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
        for yaw in (0.0, 0.5):
            env.task.place(env.physics, displaced(env, yaw=yaw))
            picture = env.render(480, 480, "eih")
            found, ids, _ = detector.detectMarkers(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
            assert ids is not None
            assert len(ids) == 1
            edge = found[0][0][1] - found[0][0][0]
            corners.append(np.arctan2(edge[1], edge[0]))
        turned = abs(np.angle(np.exp(1j * (corners[1] - corners[0]))))
        assert turned == pytest.approx(0.5, abs=0.03)


def test_a_disc_looks_the_same_from_every_yaw_and_a_ring_has_a_hole() -> None:
    for marker, filled in (("disc", True), ("ring", False)):
        with hvs_suite.load("align-thesis", marker=marker, goal=(0.55, 0.15)) as env:
            env.reset(scenario=0)
            env.task.place(env.physics, goal_posture(env))
            picture = env.task.observables["eih"](env.physics, None)
            middle = picture[54:58, 54:58].reshape(-1, 3).mean(axis=0)
            assert (middle[0] > 2 * middle[1]) == filled
            assert find_disc(picture) is not None


@pytest.mark.parametrize("diameter_m", [0.010, 0.020, 0.050])
def test_the_target_has_the_size_that_was_asked_for(diameter_m: float) -> None:
    with hvs_suite.load("align-thesis", target_diameter_m=diameter_m, goal=(0.55, 0.15)) as env:
        env.reset(scenario=0)
        env.task.place(env.physics, goal_posture(env))
        camera = env.task.cameras["eih"]
        ids = env.renderer.segmentation(env.physics.data.ptr, camera.id, 112, 112)
        area = (ids == env.task.family.marker_geom).sum()
        diameter_px = np.sqrt(4 * area / np.pi)
        assert diameter_px * 0.050 / camera.K[0, 0] == pytest.approx(diameter_m, rel=0.03)


def test_the_surface_has_the_size_that_was_asked_for() -> None:
    with hvs_suite.load("align-thesis", observations="state", surface_size_m=(1.8, 2.4)) as env:
        geom = env.physics.bind(env.task.root_entity.surface.geom)
        np.testing.assert_allclose(geom.size[:2], [0.9, 1.2])


def test_named_tasks_keep_the_edges_of_their_surface_out_of_reach() -> None:
    reach = 0.4 + 0.4 + 0.126
    for task, spec in hvs_suite.TASKS.items():
        surface = make_task(spec, "test").root_entity.surface
        assert surface.geom.size[:2].min() > reach, task


def test_targets_never_touch_and_never_move_by_themselves() -> None:
    with hvs_suite.load("align-thesis", observations="state") as env:
        env.reset(scenario=0)
        marker = env.physics.bind(env.task.family.marker.geom)
        assert (marker.contype, marker.conaffinity) == (0, 0)
        before = marker.xpos.copy()
        for _ in range(5):
            env.step(np.zeros(7))
        np.testing.assert_array_equal(marker.xpos, before)
