"""The environment loop: dm_env's contract, repeatable scenes, latched contacts, the time limit."""

import unittest
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from absl.testing import absltest
from dm_env import StepType, test_utils
from postures import posture_at

import hvs_suite
from hvs_suite.cell.renderer import Renderer
from hvs_suite.errors import ScenarioError
from hvs_suite.registry import make_task
from hvs_suite.tasks.shared.environment import Environment

Named = Callable[..., Environment]


def state(env: Environment) -> npt.NDArray[np.float64]:
    """All that MuJoCo needs to go on from here, warm start and clock included."""
    model, data = env.physics.model.ptr, env.physics.data.ptr
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    values = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, values, kind)
    return values


def model_fields(env: Environment) -> dict[str, npt.NDArray[Any]]:
    """Every array of the compiled model, and the lights of its visual options."""
    model = env.physics.model.ptr
    fields = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    arrays = {k: np.array(v) for k, v in fields.items() if isinstance(v, np.ndarray)}
    light = model.vis.headlight
    for name in ("ambient", "diffuse", "specular"):
        arrays[f"headlight.{name}"] = np.array(getattr(light, name))
    return arrays


def wander(env: Environment, step: int) -> npt.NDArray[np.float32]:
    """A small motion about the start that touches nothing."""
    phase = 0.4 * step + np.arange(7)
    return env.commandable(env.scenario.start + 0.04 * (np.sin(phase) - np.sin(np.arange(7))))


def crash(env: Environment) -> None:
    """Play until something is hit, or the episode ends otherwise."""
    bend = env.commandable(np.deg2rad([0, 115, 0, 0, 0, 60, 0]))
    while not env.step(bend).last():
        pass


class _Contract(test_utils.EnvironmentTestMixin, absltest.TestCase):  # type: ignore[misc]
    """dm_env's own checks, which is untyped, of a task that is filled in."""

    __test__ = False
    task = ""

    def make_object_under_test(self) -> Environment:
        return hvs_suite.load(self.task)

    def make_action_sequence(self) -> Iterator[npt.NDArray[np.float32]]:
        for _ in range(self.environment.spec.time_limit_steps + 2):
            yield np.zeros(7, np.float32)


@pytest.mark.each_task
def test_a_task_keeps_the_contract_of_dm_env(task: str) -> None:
    checks = unittest.TestLoader().loadTestsFromTestCase(type(task, (_Contract,), {"task": task}))
    result = unittest.TestResult()
    checks.run(result)
    assert result.testsRun == 4
    assert [text for _, text in result.errors + result.failures] == []


@pytest.mark.each_task
def test_observations_keep_their_specification_and_at_least_two_are_pictures(
    named: Named, task: str
) -> None:
    env = named(task)
    spec = env.observation_spec()
    assert sum(len(item.shape) == 3 for item in spec.values()) >= 2
    time_step = env.reset(scenario=3)
    for n in range(5):
        assert list(time_step.observation) == list(spec)
        for name, item in spec.items():
            item.validate(time_step.observation[name])
        time_step = env.step(wander(env, n))


@pytest.mark.each_task
def test_no_observation_is_constant_while_the_arm_moves(named: Named, task: str) -> None:
    env = named(task)
    seen = [env.reset(scenario=3).observation]
    for n in range(6):
        seen.append(env.step(wander(env, n)).observation)
    for name in seen[0]:
        assert any((frame[name] != seen[0][name]).any() for frame in seen), name
    joints = np.array([frame["joint_positions"] for frame in seen])
    assert (np.ptp(joints, axis=0) > 1e-3).all()


@pytest.mark.each_task
def test_observations_share_no_memory(named: Named, task: str) -> None:
    env = named(task)
    first = env.reset(scenario=1).observation
    kept = {name: value.copy() for name, value in first.items()}
    second = env.step(wander(env, 0)).observation
    third = env.reset(scenario=2).observation
    arrays = [*first.values(), *second.values(), *third.values()]
    for i, one in enumerate(arrays):
        assert not any(np.shares_memory(one, other) for other in arrays[i + 1 :])
    for name, value in kept.items():
        np.testing.assert_array_equal(first[name], value)
    # What a caller does with an observation does not reach the simulation.
    for value in third.values():
        value[...] = 0
    np.testing.assert_array_equal(
        env.reset(scenario=1).observation["joint_positions"], kept["joint_positions"]
    )


@pytest.mark.each_task
def test_a_scenario_repeats_bit_for_bit_whatever_ran_before(task: str) -> None:
    steps = 50
    limit = max(60, hvs_suite.TASKS[task].time_limit_steps)
    with (
        hvs_suite.load(task, time_limit_steps=limit) as fresh,
        hvs_suite.load(task, time_limit_steps=limit) as used,
    ):
        for scenario in (5, 11):
            used.reset(scenario=scenario)
            crash(used)
        first = [env.reset(scenario=8).observation for env in (fresh, used)]
        for name, value in first[0].items():
            np.testing.assert_array_equal(value, first[1][name], err_msg=name)
        fields = [model_fields(env) for env in (fresh, used)]
        for name, value in fields[0].items():
            np.testing.assert_array_equal(value, fields[1][name], err_msg=name)
        # Pictures do not touch the physics: the used one goes on without them.
        for observable in used.task.observables.values():
            observable.enabled = False
        np.testing.assert_array_equal(state(fresh), state(used))
        for n in range(steps):
            action = wander(fresh, n)
            time_steps = [env.step(action) for env in (fresh, used)]
            assert time_steps[0].reward == time_steps[1].reward
            assert not time_steps[0].last()
            np.testing.assert_array_equal(state(fresh), state(used))
        assert np.abs(fresh.joint_positions - fresh.scenario.start).max() > 1e-3
        assert fresh.info == used.info


def test_raising_the_time_limit_leaves_the_scenarios_as_they_are() -> None:
    for task, spec in hvs_suite.TASKS.items():
        raised = spec.with_options({"time_limit_steps": spec.time_limit_steps + 20})
        one, other = (make_task(each, "train").source for each in (spec, raised))
        same = [one.draw(i).digest() == other.draw(i).digest() for i in range(10)]
        assert all(same), task


def test_pictures_are_the_same_whether_the_renderer_is_young_or_old() -> None:
    with hvs_suite.load("align-hard") as young, hvs_suite.load("align-hard") as old:
        for scenario in range(4):
            old.reset(scenario=scenario)
        # A texture painted while nothing was drawn has to reach the renderer that is made later.
        for observable in young.task.observables.values():
            observable.enabled = False
        young.reset(scenario=4)
        for observable in young.task.observables.values():
            observable.enabled = True
        a, b = young.reset(scenario=9).observation, old.reset(scenario=9).observation
        np.testing.assert_array_equal(a["eth"], b["eth"])
        np.testing.assert_array_equal(a["eih"], b["eih"])


def test_a_reset_rebuilds_nothing_and_each_camera_is_drawn_once_a_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thesis rebuilt its world at every reset, and converted pictures pixel by pixel."""
    drawn: list[int] = []
    colour = Renderer.colour

    def count(self: Renderer, data: Any, camera: Any, height: int, width: int) -> Any:
        drawn.append(camera)
        return colour(self, data, camera, height, width)

    monkeypatch.setattr(Renderer, "colour", count)
    with hvs_suite.load("align-hard") as env:
        env.reset(scenario=0)
        model, data, renderer = env.physics.model.ptr, env.physics.data.ptr, env.renderer
        cameras = [env.task.cameras[name].id for name in ("eih", "eth")]
        assert drawn == cameras
        for scenario in (1, 2):
            drawn.clear()
            env.reset(scenario=scenario)
            assert env.physics.model.ptr is model
            assert env.physics.data.ptr is data
            assert env.renderer is renderer
            env.step(wander(env, 0))
            assert drawn == 2 * cameras


@pytest.mark.each_task
def test_pictures_drawn_later_are_those_that_were_observed(task: str) -> None:
    with hvs_suite.load(task, image_noise=3.0) as env:
        seen = [env.reset(scenario=0), *(env.step(wander(env, i)) for i in range(3))]
        env.draws = False
        blind = [env.reset(scenario=0)]
        moments = [env.moment()]
        for i in range(3):
            blind.append(env.step(wander(env, i)))
            moments.append(env.moment())
        before = env.moment(), env.physics.get_state(), env.physics.data.xpos.copy()
        pictures = env.pictures(moments)
        assert env.control_steps == before[0].steps
        np.testing.assert_array_equal(env.physics.get_state(), before[1])
        np.testing.assert_array_equal(env.physics.data.xpos, before[2])
    for i, (one, other) in enumerate(zip(seen, blind, strict=True)):
        assert one._replace(observation=None) == other._replace(observation=None)
        assert one.observation.keys() == {*other.observation, *pictures}
        drawn = {name: each[i] for name, each in pictures.items()}
        for name, value in one.observation.items():
            np.testing.assert_array_equal(value, {**other.observation, **drawn}[name])


@pytest.mark.each_task
def test_doing_nothing_is_truncated_after_exactly_the_tasks_steps(named: Named, task: str) -> None:
    env = named(task, "state")
    limit = env.spec.time_limit_steps
    env.reset(scenario=0)
    for n in range(1, limit + 1):
        time_step = env.step(env.commandable(env.scenario.start))
        assert env.control_steps == env.info["steps"] == n
        assert time_step.discount == env.spec.discount
        assert time_step.last() == env.info["truncated"] == (n == limit)
    assert env.physics.data.time == pytest.approx(limit * env.spec.control_period_s)
    assert not env.info["is_success"]
    assert not env.info["collision"]
    assert env.step(env.commandable(np.zeros(7))).step_type is StepType.FIRST


def test_truncation_keeps_the_discount_that_was_asked_for() -> None:
    with hvs_suite.load(
        "align-thesis", observations="state", discount=0.99, time_limit_steps=3
    ) as env:
        env.reset(scenario=0)
        assert [env.step(np.zeros(7)).discount for _ in range(3)] == [0.99, 0.99, 0.99]


def first_contact(env: Environment, action: npt.NDArray[np.float32]) -> int | None:
    """Physics substep, from 1, in which a plain MuJoCo loop first meets a contact."""
    period = env.spec.control_period_s
    model, data = env.physics.model.ptr, mujoco.MjData(env.physics.model.ptr)
    mujoco.mj_copyData(data, model, env.physics.data.ptr)
    target = action * model.jnt_range[:7, 1]
    data.ctrl[:] = np.clip((target - data.act) / period, *model.actuator_ctrlrange.T)
    for substep in range(1, round(period / model.opt.timestep) + 1):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        if data.ncon:
            return substep
    return None


def test_a_contact_in_any_substep_ends_that_very_step() -> None:
    start = posture_at(0.6, 0.1, 0.030)
    down = posture_at(0.6, 0.1, -0.030)
    caught = set()
    with hvs_suite.load(
        "align-thesis", observations="state", goal=(0.6, 0.1), start=tuple(start.tolist())
    ) as env:
        for share in (0.6, 0.7, 0.8, 1.0):
            env.reset(scenario=0)
            action = env.commandable(start + share * (down - start))
            substep = first_contact(env, action)
            time_step = env.step(action)
            assert env.info["collision"] == (substep is not None)
            assert time_step.last() == env.info["collision"]
            if substep is not None:
                caught.add(substep)
                elapsed = env.physics.data.time / env.physics.model.opt.timestep
                assert round(elapsed) == substep
                assert time_step.discount == 0.0
                assert time_step.reward == -1.0
                assert env.control_steps == 1
                assert env.physics.data.ncon > 0
    # The last one is past the first substeps and long before the end of the control step.
    assert len(caught) >= 2
    assert min(caught) < 24


def test_a_contact_that_is_over_at_the_end_of_the_step_still_counts() -> None:
    """Without latching, a tip that touches and leaves within 0.1 s would go unpunished."""
    with hvs_suite.load("align-thesis", observations="state") as env:
        env.reset(scenario=0)
        asked = 0

        def once(physics: Any) -> bool:
            nonlocal asked
            asked += 1
            return asked == 1

        # Reports the first contact and no later one, as if the tip had left again.
        env.task.is_forbidden = once  # type: ignore[method-assign]
        start = posture_at(0.6, 0.1, 0.030)
        env.task.place(env.physics, start)
        time_step = env.step(env.commandable(posture_at(0.6, 0.1, -0.05)))
        assert time_step.last()
        assert env.info["collision"]
        assert asked == 1


def test_collision_overrides_success_and_breaks_the_hold() -> None:
    start = posture_at(0.6, 0.1, 0.020)
    with hvs_suite.load(
        "align-thesis",
        observations="state",
        goal=(0.6, 0.1),
        start=tuple(start.tolist()),
        position_tolerance_mm=500.0,
        tilt_tolerance_deg=90.0,
        hold_steps=2,
    ) as env:
        env.reset(scenario=0)
        env.step(env.commandable(start))
        assert env.info["n_inside"] == 1
        time_step = env.step(env.commandable(posture_at(0.6, 0.1, -0.05)))
        assert time_step.last()
        assert time_step.discount == 0.0
        assert env.info["errors"]["position_error_mm"] < 500.0
        assert env.info["collision"]
        assert not env.info["is_success"]
        assert env.info["n_inside"] == 0


def test_poses_match_joint_positions_when_the_step_returns() -> None:
    """Rewards and pictures must not belong to the substep before (3 mm at full speed)."""
    with hvs_suite.load("align-thesis", observations="state") as env:
        env.reset(scenario=0)
        for _ in range(3):
            env.step(env.commandable(np.deg2rad([0, 40, 0, -60, 0, 60, 0])))
            data = mujoco.MjData(env.physics.model.ptr)
            data.qpos[:] = env.physics.data.qpos
            mujoco.mj_kinematics(env.physics.model.ptr, data)
            np.testing.assert_array_equal(data.site_xpos, env.physics.data.ptr.site_xpos)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "3"])
def test_a_seed_that_is_no_whole_number_is_refused(named: Named, seed: Any) -> None:
    with pytest.raises(ScenarioError, match="whole number from 0 up"):
        named("align-thesis", "state").reset(seed=seed)


def test_bare_resets_walk_a_stream_that_depends_on_the_seed_alone() -> None:
    def walk(env: Environment, n: int) -> list[int]:
        found = []
        for _ in range(n):
            env.reset()
            found.append(env.info["scenario"])
        return found

    with (
        hvs_suite.load("align-thesis", observations="state", seed=4) as one,
        hvs_suite.load("align-thesis", observations="state") as other,
    ):
        stream = walk(one, 6)
        assert stream[0] == 4
        other.reset(scenario=2)
        other.reset(seed=4)
        assert other.info["scenario"] == 4
        other.reset(scenario=17)
        other.step(np.zeros(7))
        assert walk(other, 5) == stream[1:]
        assert len(set(stream)) == 6


def test_a_closed_environment_may_be_closed_again() -> None:
    env = hvs_suite.load("align-thesis")
    env.reset(scenario=0)
    env.close()
    env.close()


@pytest.mark.parametrize("azimuth", np.radians([-150.0, -90.0, -35.0, 0.0, 55.0, 90.0, 145.0]))
def test_the_cell_view_shows_the_whole_hand_of_a_stretched_arm(named: Named, azimuth) -> None:
    env = named("align-thesis")
    env.reset(scenario=0)
    model = env.physics.model
    hand = np.flatnonzero(model.geom_bodyid == model.name2id("iiwa7/link_7", "body"))
    for shoulder in (0.0, 0.6, 1.1, 1.5):
        env.task.place(env.physics, np.array([azimuth, shoulder, 0.0, 0.0, 0.0, 0.0, 0.0]))
        seen = env.render(200, 200)
        kept = model.geom_matid[hand].copy(), model.geom_rgba[hand].copy()
        model.geom_matid[hand], model.geom_rgba[hand] = -1, [0.0, 1.0, 0.0, 1.0]
        changed = (env.render(200, 200) != seen).any(axis=-1)
        model.geom_matid[hand], model.geom_rgba[hand] = kept
        assert changed.sum() > 3
        assert not changed[[0, 1, -2, -1]].any()
        assert not changed[:, [0, 1, -2, -1]].any()


def test_pictures_for_people_show_the_same_scene_as_the_cameras(named: Named) -> None:
    env = named("align-thesis")
    env.reset(scenario=0)
    before = state(env)
    for camera in ("cell", "eih", "eth"):
        picture = env.render(160, 120, camera)
        assert picture.shape == (120, 160, 3)
        assert picture.dtype == np.uint8
        assert picture.std() > 5
    np.testing.assert_array_equal(state(env), before)
    np.testing.assert_array_equal(env.render(160, 120, "cell"), env.render(160, 120, "cell"))
