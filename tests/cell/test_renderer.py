"""The kept renderer: owned copies, several at a time, processes that fork, machines without GL."""

import contextlib
import itertools
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import mujoco
import numpy as np
import pytest

import hvs_suite
from hvs_suite.cell import gl
from hvs_suite.cell.renderer import Renderer
from hvs_suite.cli.bench_simulation import BareLoop
from hvs_suite.errors import RenderError
from hvs_suite.tasks.shared.environment import Environment

Named = Callable[..., Environment]


def test_two_environments_draw_in_turn_without_disturbing_each_other() -> None:
    with hvs_suite.load("align-easy") as one, hvs_suite.load("align-limit") as other:
        alone = one.reset(scenario=1).observation["eth"]
        there = other.reset(scenario=2).observation["eth"]
        np.testing.assert_array_equal(one.reset(scenario=1).observation["eth"], alone)
        one.close()
        np.testing.assert_array_equal(other.reset(scenario=2).observation["eth"], there)


def _env_render(env: Environment, _: contextlib.ExitStack) -> Callable[[], Any]:
    return lambda: env.render(320, 240)


def _physics_render(env: Environment, _: contextlib.ExitStack) -> Callable[[], Any]:
    return lambda: env.physics.render(240, 320)


def _mujoco_renderer(env: Environment, stack: contextlib.ExitStack) -> Callable[[], Any]:
    renderer = stack.enter_context(mujoco.Renderer(env.physics.model.ptr, 240, 320))

    def draw() -> Any:
        renderer.update_scene(env.physics.data.ptr)
        return renderer.render()

    return draw


def _another_environment_of_dm_control(
    _: Environment, stack: contextlib.ExitStack
) -> Callable[[], Any]:
    # Only now: it starts Mesa, which has to hear first that it must not start threads.
    from dm_control import suite

    cartpole = stack.enter_context(suite.load("cartpole", "balance", task_kwargs={"random": 0}))
    cartpole.reset()
    return lambda: cartpole.physics.render(240, 320)


DRAWERS = (
    _env_render,
    _physics_render,
    _mujoco_renderer,
    _another_environment_of_dm_control,
)


@pytest.fixture(scope="module")
def alone() -> dict[Any, Any]:
    """What each drawer draws where nothing else does, not even the task's own cameras."""
    pictures = {}
    for drawer in DRAWERS:
        with (
            contextlib.ExitStack() as stack,
            hvs_suite.load("align-easy", split="test", observations="state") as env,
        ):
            env.reset(scenario=1)
            pictures[drawer] = drawer(env, stack)()
    assert min(picture.std() for picture in pictures.values()) > 10
    return pictures


@pytest.mark.parametrize("first", [1, -1], ids=["ours made first", "ours made last"])
def test_all_who_draw_in_a_process_get_their_own_picture_in_any_order(
    first: int, alone: dict[Any, Any], named: Named
) -> None:
    """dm_control takes the context that it made current last for current still."""
    other = named("align-limit")
    other_s = other.reset(scenario=2).observation["eth"]
    with (
        hvs_suite.load("align-easy", split="test") as env,
        contextlib.ExitStack() as stack,
    ):
        ours = env.reset(scenario=1).observation["eth"]
        made = {drawer: drawer(env, stack) for drawer in DRAWERS[::first]}
        for order in (DRAWERS[::first], *itertools.permutations(DRAWERS)):
            # MuJoCo's own renderer does not tell dm_control either, so one of ours draws between.
            np.testing.assert_array_equal(other.reset(scenario=2).observation["eth"], other_s)
            for drawer in order:
                np.testing.assert_array_equal(made[drawer](), alone[drawer], str(order))
        np.testing.assert_array_equal(env.reset(scenario=1).observation["eth"], ours)


def test_others_may_close_what_they_drew_with(alone: dict[Any, Any]) -> None:
    """MuJoCo's own renderer leaves no context current, and dm_control does not hear of it."""
    with hvs_suite.load("align-easy", split="test", observations="state") as env:
        env.reset(scenario=1)
        for _ in range(2):
            picture = env.physics.render(240, 320)
            np.testing.assert_array_equal(picture, alone[_physics_render])
            with contextlib.ExitStack() as stack:
                picture = _mujoco_renderer(env, stack)()
            np.testing.assert_array_equal(picture, alone[_mujoco_renderer])


def test_dm_control_s_pictures_show_the_textures_of_the_scenario() -> None:
    with hvs_suite.load("align-hard", split="test", observations="state") as env:
        env.reset(scenario=2)
        alone = env.physics.render(60, 80)
    with hvs_suite.load("align-hard", split="test", observations="state") as env:
        env.reset(scenario=1)
        assert (env.physics.render(60, 80) != alone).any()
        env.reset(scenario=2)
        np.testing.assert_array_equal(env.physics.render(60, 80), alone)


def test_freeing_a_context_leaves_dm_control_s_pictures_alone(alone: dict[Any, Any]) -> None:
    with contextlib.ExitStack() as stack, hvs_suite.load("align-limit") as env:
        draw = _another_environment_of_dm_control(env, stack)
        env.reset(scenario=0)
        draw()
        env.close()
        np.testing.assert_array_equal(draw(), alone[_another_environment_of_dm_control])


def test_segmentation_tells_marker_surface_and_robot_apart(named: Named) -> None:
    env = named("align-thesis")
    env.reset(scenario=0)
    ids = env.renderer.segmentation(env.physics.data.ptr, env.task.cameras["eth"].id, 112, 112)
    names = {env.physics.model.id2name(int(i), "geom").split("/")[0] for i in np.unique(ids)}
    assert {"marker", "surface", "iiwa7"} <= names
    assert ids.shape == (112, 112)


def test_collision_bodies_are_never_drawn(named: Named) -> None:
    env = named("align-thesis")
    env.reset(scenario=0)
    ids = env.renderer.segmentation(env.physics.data.ptr, env.task.cameras["eth"].id, 100, 100)
    drawn = {env.physics.model.id2name(int(i), "geom") for i in np.unique(ids) if i >= 0}
    assert not [name for name in drawn if "collision" in name]


@pytest.mark.parametrize("task", ["align-thesis", "insert-wide", "surface-tilted"])
def test_what_is_out_of_view_makes_no_difference(named: Named, task: str) -> None:
    """Pictures are those of a loop that draws all there is, wherever the eye in the hand looks."""
    env = named(task)
    env.reset(scenario=0)
    random = np.random.default_rng(0)
    with contextlib.closing(BareLoop(env)) as loop:
        for scenario in range(8):
            seen = env.reset(scenario=scenario)
            while not seen.last():
                target = env.joint_positions + random.uniform(-0.3, 0.3, 7)
                seen = env.step(env.commandable(target))
                expected = loop.restore(env.moment().state)
                for name, picture in zip(("eih", "eth"), expected, strict=True):
                    np.testing.assert_array_equal(seen.observation[name], picture)


def test_a_closed_renderer_says_so() -> None:
    env = hvs_suite.load("align-easy")
    env.reset(scenario=0)
    renderer = env.renderer
    env.close()
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(RenderError, match="closed"):
        renderer.colour(mujoco.MjData(model), 0, 8, 8)


def test_a_picture_larger_than_the_renderer_is_refused(named: Named) -> None:
    """OpenGL itself would hand out what happens to lie beside the frame."""
    env = named("align-thesis")
    env.reset(scenario=0)
    with pytest.raises(RenderError, match="larger than the 112 px"):
        env.renderer.colour(env.physics.data.ptr, 0, 113, 112)


def test_depth_and_colour_have_the_shapes_they_promise(named: Named) -> None:
    env = named("align-thesis")
    env.reset(scenario=0)
    data, camera = env.physics.data.ptr, env.task.cameras["eth"].id
    colour, depth = (
        env.renderer.colour(data, camera, 40, 60),
        env.renderer.depth(data, camera, 40, 60),
    )
    assert (colour.shape, colour.dtype) == ((40, 60, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((40, 60, 1), np.float32)
    assert colour.flags.c_contiguous
    assert depth.flags.c_contiguous


def test_multisampling_softens_edges_and_moves_nothing() -> None:
    with (
        hvs_suite.load("align-easy") as hard,
        hvs_suite.load("align-easy", multisampling=4) as soft,
    ):
        a, b = (env.reset(scenario=0).observation["eth"].astype(int) for env in (hard, soft))
        assert (a != b).any()
        assert abs(a.mean() - b.mean()) < 2.0
        assert len(np.unique(b.reshape(-1, 3), axis=0)) > len(np.unique(a.reshape(-1, 3), axis=0))


def _draw(connection: Connection) -> None:
    with hvs_suite.load("align-easy", split="test") as env:
        connection.send(env.reset(scenario=3).observation["eth"])
    connection.close()


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_process_may_fork_after_drawing(named: Named) -> None:
    """Mesa's threads do not survive a fork: the child would wait for them forever."""
    here = named("align-easy").reset(scenario=3).observation["eth"]
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_draw, args=(theirs,), daemon=True)
    child.start()
    try:
        assert ours.poll(120), "the forked child hangs"
        np.testing.assert_array_equal(ours.recv(), here)
        child.join(60)
        assert child.exitcode == 0
    finally:
        if child.is_alive():
            child.kill()


_FORK = """
import os
import warnings
import hvs_suite
with hvs_suite.load("align-easy", split="test") as env:
    env.reset(scenario=3)
    # Python warns of every fork of a process that has threads.
    warnings.simplefilter("ignore", DeprecationWarning)
    child = os.fork()
    if not child:
        hvs_suite.load("align-easy", split="test").reset(scenario=3)
        os._exit(0)
    print(os.waitpid(child, 0)[1])
"""


@pytest.mark.parametrize("asked", [{}, {"MUJOCO_GL": "egl"}], ids=["chosen", "asked for"])
def test_the_backend_is_chosen_before_mujoco_is_imported(asked: dict[str, str]) -> None:
    """Else dm_control tries, and complains of, one that needs a display, and forks hang."""
    variables = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "LP_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", _FORK],
        env=variables | asked,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.stdout, done.stderr, done.returncode) == ("0\n", "", 0)


_WITHOUT_GL = """
import hvs_suite
from hvs_suite.errors import RenderError
env = hvs_suite.load("align-thesis")
for _ in range(2):
    try:
        env.reset(scenario=0)
    except RenderError as error:
        assert len(str(error).splitlines()) == 1, error
        assert "libegl1" in str(error) and "hvs doctor" in str(error), error
    else:
        raise SystemExit("nothing was raised")
with hvs_suite.load("align-thesis", observations="state") as states:
    first = states.reset(scenario=0)
    assert sorted(first.observation) == sorted(states.observation_spec())
    assert not states.step([0.0] * 7).last()
print("done")
"""


def test_without_gl_states_work_and_a_picture_is_a_clear_error() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT_GL],
        env={**os.environ, "MUJOCO_GL": "off"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.stdout, done.stderr, done.returncode) == ("done\n", "", 0)


def test_a_backend_that_does_not_exist_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(RenderError, match="egl, osmesa, glfw"):
        gl.choose_backend()


def test_a_backend_whose_library_is_missing_names_the_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(RenderError, match="libosmesa6"):
        gl.choose_backend()


@pytest.mark.parametrize(
    ("installed", "display", "chosen"),
    [
        ({"EGL", "OSMesa"}, None, "egl"),
        ({"OSMesa", "GL"}, ":0", "osmesa"),
        ({"GL"}, ":0", "glfw"),
        ({"GL"}, None, "off"),
        (set(), ":0", "off"),
    ],
)
def test_the_first_backend_that_is_installed_is_chosen(
    monkeypatch: pytest.MonkeyPatch, installed: set[str], display: str | None, chosen: str
) -> None:
    monkeypatch.setattr(
        "ctypes.util.find_library", lambda name: f"lib{name}" if name in installed else None
    )
    # Set first, so that the old value comes back although the choice writes the variable.
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.delenv("MUJOCO_GL")
    if display is None:
        monkeypatch.delenv("DISPLAY", raising=False)
    else:
        monkeypatch.setenv("DISPLAY", display)
    assert gl.choose_backend() == chosen
    assert os.environ["MUJOCO_GL"] == chosen


def test_the_chosen_backend_of_the_user_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    for wanted, chosen in [("EGL", "egl"), ("off", "off"), ("disable", "off")]:
        monkeypatch.setenv("MUJOCO_GL", wanted)
        assert gl.choose_backend() == chosen


def test_a_context_that_cannot_be_made_names_backend_and_package(
    monkeypatch: pytest.MonkeyPatch, named: Named
) -> None:
    def fail(name: str) -> None:
        raise ImportError("cannot initialise a device display\nand more")

    env = named("align-easy", "state")
    monkeypatch.setattr("hvs_suite.cell.gl.importlib.import_module", fail)
    with pytest.raises(RenderError, match=r"'egl' does not work here.*libegl1") as raised:
        Renderer(env.physics.model.ptr, 64, 0)
    assert "\n" not in str(raised.value)
