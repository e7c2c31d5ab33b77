"""Axes of robustness: they leave the scene where it was, show what they say, and are no news."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import hvs_suite
from hvs_suite.errors import OptionError
from hvs_suite.policies.context import PolicyContext
from hvs_suite.registry import make_task
from hvs_suite.tasks.shared.robustness import STRENGTHS
from hvs_suite.tasks.shared.scenario import Look, Scenario
from hvs_suite.tasks.shared.strewn import APART_M

# What a disturbance may change of a scenario.
LOOK = {field.name for field in dataclasses.fields(Look)} | {"panel_rgb"}


def drawn(task: str, **options: Any) -> Scenario:
    spec = hvs_suite.TASKS[task].with_options(options)
    return make_task(spec, "test").source.draw(3)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, tuple):
        return all(map(same, one, other))
    if dataclasses.is_dataclass(one):
        fields = dataclasses.fields(one)
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields)
    return bool(np.array_equal(one, other))


@pytest.mark.each_task
def test_every_axis_leaves_the_scene_where_it_was(task: str) -> None:
    named = drawn(task)
    for axis in hvs_suite.TASKS[task].robustness_axes():
        assert len(axis.options) == len(axis.levels) in (0, len(STRENGTHS)), axis.name
        # The strongest stands for all: each cell takes a while to build.
        for options in axis.options[-1:]:
            scenario = drawn(task, **options)
            for field in dataclasses.fields(scenario):
                if field.name not in LOOK:
                    ours, theirs = (getattr(each, field.name) for each in (scenario, named))
                    assert same(ours, theirs), (axis.name, field.name)


def test_a_task_s_own_disturbance_is_added_to() -> None:
    axes = {axis.name: axis for axis in hvs_suite.TASKS["align-hard"].robustness_axes()}
    noises = [options["image_noise"] for options in axes["image-noise"].options]
    assert noises == sorted(noises)
    assert noises[0] == pytest.approx(np.hypot(4.0, 2.0))
    assert axes["light"].options[0]["light_strength"] > 1.0


def test_an_axis_that_makes_no_sense_says_why() -> None:
    axes = {axis.name: axis for axis in hvs_suite.TASKS["clutter-choice"].robustness_axes()}
    assert not axes["marker"].options
    assert "colour" in axes["marker"].anchor


def test_unannounced_options_are_kept_from_policies() -> None:
    changed = {"target_diameter_m": 0.03, "latency_steps": 2}
    with hvs_suite.load("align-easy", **changed) as env:
        assert PolicyContext.of(env).spec.target_diameter_m == 0.03
    with hvs_suite.load("align-easy", **changed, unannounced=True) as env:
        assert PolicyContext.of(env).spec == hvs_suite.TASKS["align-easy"]
        assert env.spec.latency_steps == 2


def picture(camera: str = "eth", task: str = "align-easy", **options: Any) -> Any:
    with hvs_suite.load(task, split="test", unannounced=True, **options) as env:
        return env.reset(scenario=3).observation[camera].astype(int)


@pytest.mark.parametrize("look", ["light", "colour", "texture"])
def test_a_look_begins_at_the_cell_s_own_and_reaches_the_drawn_one(look: str) -> None:
    own = picture()
    shots = [
        picture(**{f"vary_{look}": True, f"{look}_strength": strength})
        for strength in (0.0, 0.5, 1.0, 1.5)
    ]
    # A texture of strength 0 is white throughout, as without one.
    np.testing.assert_array_equal(shots[0], own)
    assert min(np.abs(shot - own).mean() for shot in shots[1:]) > 0.3
    assert (shots[3] != shots[2]).any()
    np.testing.assert_array_equal(shots[2], picture(**{f"vary_{look}": True}))


def test_a_hand_eye_error_moves_what_the_hand_sees_and_nothing_else() -> None:
    error = {"eih_position_noise_m": 0.002, "eih_rotation_noise_deg": 2.0}
    start = {"start": "near_goal"}
    np.testing.assert_array_equal(picture(**start, **error), picture(**start))
    assert (picture("eih", **start, **error) != picture("eih", **start)).any()


def test_without_a_hand_eye_error_a_scene_keeps_the_digest_it_had() -> None:
    scenario = drawn("align-thesis")
    assert scenario.eih_shift is None
    moved = dataclasses.replace(scenario, eih_shift=np.zeros(3), eih_turn=np.zeros(3))
    assert moved.digest() != scenario.digest()


def test_blur_takes_contrast_and_keeps_brightness() -> None:
    sharp, soft = picture(), picture(image_blur_px=1.0)
    assert soft.std() < sharp.std()
    assert soft.mean() == pytest.approx(sharp.mean(), abs=1.0)


def test_the_target_takes_another_hue_and_nothing_else_does() -> None:
    red, violet = picture(), picture(target_hue_deg=-60.0)
    changed = (red != violet).any(axis=2)
    assert 0 < changed.sum() < 0.01 * changed.size
    assert (violet - red)[changed, 2].max() > 50


@pytest.mark.each_task
def test_things_are_strewn_beside_whatever_lies_there(task: str) -> None:
    options: dict[str, Any] = {"n_strewn": 8, "unannounced": True, "observations": "state"}
    with hvs_suite.load(task, split="test", **options) as env:
        for index in (0, 1):
            env.reset(scenario=index)
            model, data = env.physics.model, env.physics.data
            bodies = [model.name2id(f"strewn-{i}/", "body") for i in range(8)]
            places = data.mocap_pos[model.body_mocapid[bodies], :2]
            others = np.concatenate([env.task.family.occupied(), places])
            for number, place in enumerate(places):
                rest = np.delete(others, len(others) - 8 + number, axis=0)
                assert np.linalg.norm(rest - place, axis=1).min() >= APART_M


def test_too_many_things_are_refused() -> None:
    with (
        hvs_suite.load("align-easy", n_strewn=200, observations="state") as env,
        pytest.raises(OptionError, match="lower n_strewn"),
    ):
        env.reset(scenario=0)
