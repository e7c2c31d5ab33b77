"""What ``hvs bench`` measures of simulation: steps against a bare loop over the same model."""

import contextlib
import dataclasses
import multiprocessing
import statistics
import time
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

WORKER_ROUNDS = 3
# Each episode moves every joint up to this far from where it starts (rad).
REACH_RAD = 0.3

LABELS = {
    "steps_per_s": "steps/s with both cameras, one core",
    "bare_steps_per_s": "steps/s of a bare loop, same model and actions",
    "ratio": "ratio of the two",
    "ratio_with_resets": "the same, resets counted",
    "reset_ms": "reset, first observation included (ms, median)",
    "steps_per_s_no_cameras": "steps/s without cameras",
    "one_worker_steps_per_s": "steps/s of one worker process",
    "two_worker_steps_per_s": "steps/s of two worker processes together",
    "two_worker_speedup": "speed-up of two workers over one",
}


def simulation_figures(task: str, options: Mapping[str, Any], seconds: float) -> dict[str, float]:
    """Steps a task in this process, with and without cameras, and in one and two others.

    Args:
        task: A named task.
        options: Options of it.
        seconds: How long to measure each figure (s).

    Returns:
        Figures by the names of ``LABELS``.
    """
    import hvs_suite

    with hvs_suite.load(task, **options) as env:
        figures = against_bare_loop(env, seconds)
    with hvs_suite.load(task, **{**options, "observations": "state"}) as env:
        steps, elapsed_s, _ = play(env, seconds / 2)
        figures["steps_per_s_no_cameras"] = steps / elapsed_s
    return figures | with_workers(task, options, seconds)


def against_bare_loop(env: "Environment", seconds: float) -> dict[str, float]:
    """Step the environment and a bare loop in turns.

    Args:
        env: A task with camera observations.
        seconds: How long to go on (s).

    Returns:
        ``steps_per_s``, ``bare_steps_per_s``, ``ratio``, ``ratio_with_resets`` and ``reset_ms``.
    """
    env.reset(scenario=0)
    steps = 0
    env_s = bare_s = bare_resets_s = 0.0
    resets_s = []
    with contextlib.closing(BareLoop(env)) as bare:
        end = time.perf_counter() + seconds
        scenario = 0
        # The first episode fills caches and is not counted.
        while time.perf_counter() < end or scenario < 2:
            scenario += 1
            episode = run_once(env, scenario)
            begun = time.perf_counter()
            bare.restore(episode.start)
            started = time.perf_counter()
            for control in episode.controls:
                bare.step(control)
            if scenario > 1:
                bare_s += time.perf_counter() - started
                bare_resets_s += started - begun
                env_s += episode.step_s
                steps += len(episode.controls)
                resets_s.append(episode.reset_s)
    return {
        "steps_per_s": steps / env_s,
        "bare_steps_per_s": steps / bare_s,
        "ratio": bare_s / env_s,
        "ratio_with_resets": (bare_s + bare_resets_s) / (env_s + sum(resets_s)),
        "reset_ms": 1000.0 * statistics.median(resets_s),
    }


@dataclasses.dataclass(frozen=True, eq=False)
class TimedEpisode:
    """One episode and what it took.

    Attributes:
        start: Physics state after the reset (MuJoCo's integration state).
        controls: Actuator controls of each control step, each (7,).
        reset_s: Time of the reset (s).
        step_s: Time of all steps together (s).
        observation: What the last step showed.
    """

    start: npt.NDArray[np.float64]
    controls: list[npt.NDArray[np.float64]]
    reset_s: float
    step_s: float
    observation: Mapping[str, npt.NDArray[Any]]


def run_once(env: "Environment", scenario: int) -> TimedEpisode:
    """Play a scenario with smooth motion: seven set points at a random distance, approached."""
    import mujoco

    from hvs_suite.cell.robot import JOINT_RANGE_RAD

    started = time.perf_counter()
    env.reset(scenario=scenario)
    reset_s = time.perf_counter() - started
    model, data = env.physics.model.ptr, env.physics.data.ptr
    kind = mujoco.mjtState.mjSTATE_INTEGRATION.value
    start = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, start, kind)
    draw = np.random.Generator(np.random.Philox(scenario))
    origin = np.array(env.joint_positions)
    goal = np.clip(
        origin + draw.uniform(-REACH_RAD, REACH_RAD, 7), -JOINT_RANGE_RAD, JOINT_RANGE_RAD
    )
    limit = env.spec.time_limit_steps
    controls: list[npt.NDArray[np.float64]] = []
    step_s = 0.0
    for step in range(limit):
        target = origin + (goal - origin) * (step + 1) / limit
        action = env.commandable(target).astype(np.float32)
        started = time.perf_counter()
        time_step = env.step(action)
        step_s += time.perf_counter() - started
        controls.append(data.ctrl.copy())
        if time_step.last():
            break
    return TimedEpisode(start, controls, reset_s, step_s, time_step.observation)


class BareLoop:
    """``mj_step`` and the observed pictures of the same compiled model, and nothing else.

    Pictures are drawn as MuJoCo does by itself: with every visible geom, in view or not.

    Args:
        env: Reset at least once; only its compiled model and its cameras' sizes are used.
    """

    def __init__(self, env: "Environment") -> None:
        import mujoco

        from hvs_suite.cell.gl import create_context
        from hvs_suite.cell.renderer import offscreen_context

        self._mujoco = mujoco
        self._model = env.physics.model.ptr
        self._data = mujoco.MjData(self._model)
        self._n_substeps = env.task.physics_steps_per_control_step
        side = max(env.spec.eih_resolution, env.spec.eth_resolution)
        self._gl = create_context(side, side)
        self._context = offscreen_context(self._model, side, env.spec.multisampling, shadow_size=0)
        self._scene = mujoco.MjvScene(self._model, 256)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False
        self._option = mujoco.MjvOption()
        # What the environment's cameras do not show is not drawn here either.
        self._option.geomgroup[3] = 0
        self._option.sitegroup[:] = 0
        self._perturbation = mujoco.MjvPerturb()
        self._cameras = []
        for name, resolution in (
            ("eih", env.spec.eih_resolution),
            ("eth", env.spec.eth_resolution),
        ):
            camera = mujoco.MjvCamera()
            camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
            camera.fixedcamid = _camera_id(self._model, name)
            rectangle = mujoco.MjrRect(0, 0, resolution, resolution)
            buffer = np.empty((resolution, resolution, 3), np.uint8)
            self._cameras.append((camera, rectangle, buffer))

    def restore(self, state: npt.NDArray[np.float64]) -> list[npt.NDArray[np.uint8]]:
        """Start from a physics state, as ``TimedEpisode.start`` holds it; draw as ``step`` does."""
        mujoco = self._mujoco
        mujoco.mj_setState(
            self._model, self._data, state, mujoco.mjtState.mjSTATE_INTEGRATION.value
        )
        mujoco.mj_forward(self._model, self._data)
        return self._draw()

    def step(self, control: npt.NDArray[np.float64]) -> list[npt.NDArray[np.uint8]]:
        """Run one control step and draw both pictures, uint8 (H, W, 3) each."""
        mujoco = self._mujoco
        self._data.ctrl[:] = control
        for _ in range(self._n_substeps):
            mujoco.mj_step(self._model, self._data)
        return self._draw()

    def _draw(self) -> list[npt.NDArray[np.uint8]]:
        mujoco = self._mujoco
        self._gl.make_current()
        pictures = []
        for camera, rectangle, buffer in self._cameras:
            mujoco.mjv_updateScene(
                self._model,
                self._data,
                self._option,
                self._perturbation,
                camera,
                mujoco.mjtCatBit.mjCAT_ALL.value,
                self._scene,
            )
            mujoco.mjr_render(rectangle, self._scene, self._context)
            mujoco.mjr_readPixels(buffer, None, rectangle, self._context)
            pictures.append(buffer[::-1].copy())
        return pictures

    def close(self) -> None:
        """Free the context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()


def _camera_id(model: Any, name: str) -> int:
    """Id of the camera whose last name part is ``name``; entities prefix theirs."""
    for index in range(model.ncam):
        if model.camera(index).name.rpartition("/")[2] == name:
            return index
    raise LookupError(f"the model has no camera {name!r}")


def play(env: "Environment", seconds: float) -> tuple[int, float, int]:
    """Play whole episodes for a while, resets not counted.

    Args:
        env: Any task.
        seconds: How long to go on (s).

    Returns:
        Control steps, the time they took (s), and episodes.
    """
    run_once(env, 0)
    steps = episodes = 0
    elapsed_s = 0.0
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or not episodes:
        episodes += 1
        episode = run_once(env, episodes)
        steps += len(episode.controls)
        elapsed_s += episode.step_s
    return steps, elapsed_s, episodes


def with_workers(task: str, options: Mapping[str, Any], seconds: float) -> dict[str, float]:
    """Compare two worker processes with one, in turns.

    Args:
        task: A named task.
        options: Options of it.
        seconds: How long to measure one, and two (s).

    Returns:
        ``one_worker_steps_per_s``, ``two_worker_steps_per_s`` and ``two_worker_speedup``.
    """
    one, two = [], []
    with _worker(task, options) as first, _worker(task, options) as second:
        for _ in range(WORKER_ROUNDS):
            one.append(_rate([first], seconds / WORKER_ROUNDS))
            two.append(_rate([first, second], seconds / WORKER_ROUNDS))
    return {
        "one_worker_steps_per_s": statistics.mean(one),
        "two_worker_steps_per_s": statistics.mean(two),
        "two_worker_speedup": statistics.mean(two) / statistics.mean(one),
    }


def two_worker_rate(task: str, options: Mapping[str, Any], seconds: float) -> float:
    """Steps per second of two worker processes together.

    Args:
        task: A named task.
        options: Options of it.
        seconds: How long to measure (s).
    """
    with _worker(task, options) as first, _worker(task, options) as second:
        return _rate([first, second], seconds)


@contextlib.contextmanager
def _worker(task: str, options: Mapping[str, Any]) -> Iterator[Connection]:
    """A process that plays a task whenever it is sent a duration."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(task, options, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ours
    finally:
        ours.close()
        process.join(timeout=10)
        if process.is_alive():
            process.kill()


def _work(task: str, options: Mapping[str, Any], connection: Connection) -> None:
    """Body of a worker process: answers each duration with the steps per second it reached."""
    import hvs_suite

    with hvs_suite.load(task, **options) as env, contextlib.suppress(EOFError, KeyboardInterrupt):
        while True:
            steps, elapsed_s, _ = play(env, connection.recv())
            connection.send(steps / elapsed_s)


def _rate(workers: list[Connection], seconds: float) -> float:
    """Steps per second of some workers playing at the same time, added up."""
    for worker in workers:
        worker.send(seconds)
    return float(sum(worker.recv() for worker in workers))
