"""Light, colour and texture of a scenario: drawn, seen in the pictures, and undone by the next."""

from collections.abc import Callable

import numpy as np
import pytest

import hvs_suite
from hvs_suite.tasks.shared.appearance import surface_texture
from hvs_suite.tasks.shared.detection import find_disc
from hvs_suite.tasks.shared.environment import Environment

Named = Callable[..., Environment]
# The group of the collision bodies.
NEVER_DRAWN = 3


@pytest.mark.parametrize("option", ["vary_light", "vary_colour", "vary_texture"])
def test_each_disturbance_shows_in_the_pictures_by_itself(option: str) -> None:
    with hvs_suite.load("align-easy", goal=(0.5, 0.2), **{option: True}) as env:
        looks = [env.reset(scenario=i).observation["eth"] for i in range(3)]
        for i, look in enumerate(looks):
            assert (look != looks[i - 1]).mean() > 0.02
        # The scene is the same otherwise, and comes back bit for bit.
        np.testing.assert_array_equal(env.reset(scenario=0).observation["eth"], looks[0])


def test_without_disturbances_all_scenes_look_alike() -> None:
    with hvs_suite.load("align-easy", goal=(0.5, 0.2)) as env:
        looks = [env.reset(scenario=i).observation["eth"] for i in range(3)]
        np.testing.assert_array_equal(looks[0], looks[1])
        np.testing.assert_array_equal(looks[0], looks[2])


def test_a_texture_reaches_the_pictures_for_people_too() -> None:
    with hvs_suite.load("align-easy", goal=(0.5, 0.2), vary_texture=True) as env:
        env.reset(scenario=0)
        one = env.render(120, 120, "eth")
        env.reset(scenario=1)
        assert (env.render(120, 120, "eth") != one).mean() > 0.05
        env.reset(scenario=0)
        np.testing.assert_array_equal(env.render(120, 120, "eth"), one)


def test_textures_are_keyed_pictures_with_some_contrast() -> None:
    one = surface_texture(5)
    assert (one.shape, one.dtype) == ((128, 128), np.uint8)
    np.testing.assert_array_equal(surface_texture(5), one)
    assert (surface_texture(6) != one).mean() > 0.9
    assert one.std() > 5


@pytest.mark.parametrize("task", ["align-thesis", "align-hard"])
def test_nothing_else_in_the_cell_is_as_red_as_the_target(named: Named, task: str) -> None:
    """Where the target is taken away, nothing is found: not the orange of the robot either."""
    env = named(task)
    groups, target = env.physics.model.geom_group, env.task.family.marker_geom
    for index in range(10):
        env.reset(scenario=index)
        shown, groups[target] = groups[target], NEVER_DRAWN
        try:
            seen = [env.task.observables[camera](env.physics, None) for camera in ("eih", "eth")]
        finally:
            groups[target] = shown
        assert [find_disc(picture) for picture in seen] == [None, None], index
