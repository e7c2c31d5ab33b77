"""The one executor: runs anything with ``reset`` and ``select_action`` over given scenarios.

Evaluation, recording and DAgger all go through `rollout`. A scenario is a pure function of its
index, so the result does not depend on how many workers there are or which one plays what.
This module imports no room: environments and policies come in as factories.
"""

import contextlib
import dataclasses
import multiprocessing
import os
import random
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any, Protocol, cast, runtime_checkable

import dm_env
import numpy as np
import numpy.typing as npt

from hvs_suite.errors import ActionError, HvsError, OptionError

# One core a worker: llvmpipe's and OpenMP's own threads would fight over the same cores. Both are
# read when the libraries load, hence set before a worker starts.
WORKER_ENVIRONMENT = {"LP_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
WORKER_EXIT_TIMEOUT_S = 10.0
_TOLD_AHEAD = 3
"""Indices that a worker holds, the one it plays included."""

Observation = Mapping[str, npt.NDArray[Any]]
Action = npt.NDArray[np.float32]


class Policy(Protocol):
    """Chooses actions; knows nothing but what it is shown since its last `reset`."""

    def reset(self) -> None:
        """Forgets the last episode; called after the environment's reset, before step one."""

    def select_action(self, observation: Observation) -> Action:
        """Returns the next action, (7,) float32 in [-1, 1], for one unbatched observation."""


@runtime_checkable
class Instructed(Protocol):
    """A policy that is told what to do in each episode, before its `reset`."""

    def instruct(self, sentence: str) -> None:
        """Takes in the task of the coming episode as a sentence."""


def tell(policy: Any, env: Any) -> None:
    """Tells a policy the task of the environment's episode, if it listens."""
    if isinstance(policy, Instructed):
        policy.instruct(env.instruction)


class Environment(Protocol):
    """What the executor needs of an environment; `hvs_suite.load` returns one."""

    @property
    def info(self) -> Mapping[str, Any]:
        """Outcome and errors (mm, deg) at the end of the last control step."""

    def action_spec(self) -> Any:
        """Returns the `dm_env.specs.BoundedArray` of actions."""

    def reset(self, *, scenario: int | None = None) -> dm_env.TimeStep:
        """Starts the scenario with this index."""

    def step(self, action: Action) -> dm_env.TimeStep:
        """Plays one control step."""

    def close(self) -> None:
        """Frees the renderer."""


EnvFactory = Callable[[], Environment]
PolicyFactory = Callable[[Any], Policy]
"""Builds the policy for an environment; module-level function or dataclass, so that it pickles."""

OnStep = Callable[[Observation, Action, Action, dm_env.TimeStep, Mapping[str, Any]], None]
"""Called after each control step with: the observation the policy saw, its action, the action
executed (clipped to the action bounds), the time step that followed, and the info after it."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """One scenario, played to its end.

    Attributes:
        scenario: Index in the environment's split.
        success: The episode ended in success.
        success_once: The goal was within tolerance at the end of at least one control step.
        collision: A forbidden contact ended the episode.
        truncated: The time limit ended the episode.
        steps: Control steps played.
        steps_to_goal: Control steps to the goal, as the task counts them; None for failures.
        n_clipped: Control steps whose action had a component outside the action bounds.
        errors: The task's metrics at the end of the last step, by name.
        actions: (steps, 7) float32, as the policy gave them, before clipping.
        decision_s: Wall time spent in `Policy.select_action`, summed over the episode (s).
    """

    scenario: int
    success: bool
    success_once: bool
    collision: bool
    truncated: bool
    steps: int
    steps_to_goal: int | None
    n_clipped: int
    errors: Mapping[str, float]
    actions: npt.NDArray[np.float32]
    decision_s: float


def run_episode(
    env: Environment, policy: Policy, scenario: int, on_step: OnStep | None = None
) -> Episode:
    """Plays one scenario from reset to its end.

    Finite actions outside the action bounds are clipped and counted, because learned policies
    overshoot.

    Args:
        env: Left at the last step of the episode, so that its state can be looked at.
        policy: Reset after the environment, so that it may read the scenario's index.
        scenario: Index in the environment's split.
        on_step: Called after each control step.

    Returns:
        The episode, errors taken at the end of its last step.

    Raises:
        ActionError: The policy returned a wrong shape, NaN or infinity.
        ScenarioError: The split has no such scenario.
    """
    spec = env.action_spec()
    time_step = env.reset(scenario=scenario)
    tell(policy, env)
    policy.reset()
    actions: list[Action] = []
    n_clipped = 0
    decision_s = 0.0
    while not time_step.last():
        observation = time_step.observation
        started = time.perf_counter()
        chosen = policy.select_action(observation)
        decision_s += time.perf_counter() - started
        action = _checked(chosen, spec.shape, scenario, len(actions))
        executed = np.clip(action, spec.minimum, spec.maximum).astype(np.float32)
        n_clipped += bool(np.any(executed != action))
        time_step = env.step(executed)
        actions.append(action)
        if on_step is not None:
            on_step(observation, action, executed, time_step, env.info)
    info = env.info
    success = bool(info["is_success"])
    return Episode(
        scenario=int(scenario),
        success=success,
        success_once=bool(info["success_once"]),
        collision=bool(info["collision"]),
        truncated=bool(info["truncated"]),
        steps=len(actions),
        steps_to_goal=info["steps_to_goal"],
        n_clipped=n_clipped,
        errors={name: float(value) for name, value in info["errors"].items()},
        actions=np.array(actions, dtype=np.float32).reshape(-1, *spec.shape),
        decision_s=decision_s,
    )


def rollout(
    make_env: EnvFactory,
    make_policy: PolicyFactory,
    scenarios: Iterable[int],
    *,
    workers: int = 1,
    on_episode: Callable[[Episode], None] | None = None,
) -> list[Episode]:
    """Plays every scenario once; the same episodes for any number of workers.

    Args:
        make_env: Builds the environment, once a worker.
        make_policy: Builds the policy for it, once a worker.
        scenarios: Indices, in any order.
        workers: Processes; 1 plays in this one.
        on_episode: Called here after each episode, in the order in which they end.

    Returns:
        The episodes, sorted by scenario.

    Raises:
        OptionError: `workers` is below 1, or a factory cannot be sent to another process.
        HvsError: Whatever typed error a factory or an episode raised, in whichever process.
        RuntimeError: Any other failure of a worker, its traceback as a note.
    """
    episodes: list[Episode] = []
    with contextlib.closing(
        play(make_env, make_policy, scenarios, run_episode, workers=workers)
    ) as played:
        for episode in played:
            episodes.append(episode)
            if on_episode is not None:
                on_episode(episode)
    return sorted(episodes, key=lambda episode: episode.scenario)


def play[T](
    make_env: EnvFactory,
    make_policy: PolicyFactory,
    scenarios: Iterable[int],
    run: Callable[[Any, Policy, int], T],
    *,
    workers: int = 1,
) -> Generator[T, None, None]:
    """Runs ``run(env, policy, scenario)`` over scenarios and yields results as they come.

    The general form of `rollout`, for callers that need more of an episode than an `Episode`
    holds. Workers take the next index whenever they are free and run a few results ahead of the
    reader at most, so memory stays flat. Closing the iterator (or an error, or Ctrl-C) ends them.

    Args:
        make_env: Builds the environment, once a worker.
        make_policy: Builds the policy for it, once a worker.
        scenarios: Indices; handed out in this order.
        run: Module-level function or dataclass; its result travels by pipe.
        workers: Processes; 1 plays in this one, in order.

    Yields:
        One result a scenario, in the order in which they end.

    Raises:
        OptionError: `workers` is below 1, or something cannot be sent to another process.
        HvsError: Whatever typed error a factory or a run raised, in whichever process.
        RuntimeError: Any other failure of a worker, its traceback as a note.
    """
    if workers < 1:
        raise OptionError(f"workers must be at least 1, not {workers}")
    indices = [int(scenario) for scenario in scenarios]
    workers = min(workers, len(indices))
    if workers > 1:
        yield from _play_in_processes((make_env, make_policy, run), indices, workers)
    elif workers == 1:
        with contextlib.closing(make_env()) as env:
            policy = make_policy(env)
            for scenario in indices:
                with one_torch_thread():
                    result = run(env, policy, scenario)
                yield result


def _checked(action: Any, shape: Sequence[int], scenario: int, step: int) -> Action:
    """Returns the action as a float32 copy, or raises ActionError saying where it went wrong."""
    where = f"step {step} of scenario {scenario}"
    try:
        checked = np.array(action, dtype=np.float32)
    except (TypeError, ValueError):
        raise ActionError(
            f"the policy returned {type(action).__name__} at {where}; an action is an array of "
            f"shape {tuple(shape)}"
        ) from None
    if checked.shape != tuple(shape):
        raise ActionError(
            f"the policy returned an action of shape {checked.shape} at {where}; return one of "
            f"shape {tuple(shape)}, without a batch dimension"
        )
    if not np.all(np.isfinite(checked)):
        raise ActionError(
            f"the policy returned NaN or infinity at {where}; actions are finite, in [-1, 1]"
        )
    return checked


@contextlib.contextmanager
def library_seeds(seed: int) -> Iterator[None]:
    """Starts the global generators of Python, NumPy and, if it is loaded, torch anew for a while.

    The suite uses none of them. Policies written elsewhere do (diffusion policies draw their noise
    from torch's), and would otherwise depend on which scenarios a worker played before. Afterwards
    the generators are as they were: the caller's own draws do not notice.

    Args:
        seed: In [0, 2^32).
    """
    torch = sys.modules.get("torch")
    before = random.getstate(), np.random.get_state(), torch and torch.get_rng_state()  # noqa: NPY002
    try:
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - this is the generator that others use
        if torch is not None:
            torch.manual_seed(seed)
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        if torch is not None:
            torch.set_rng_state(before[2])


@contextlib.contextmanager
def one_torch_thread() -> Iterator[None]:
    """Holds torch to one thread if it is loaded: sums come out the same in every process."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


type _Job = tuple[EnvFactory, PolicyFactory, Callable[[Any, Policy, int], Any]]


def _play_in_processes(job: _Job, scenarios: list[int], workers: int) -> Generator[Any, None, None]:
    """Hands indices to spawned workers one by one, and ends every worker whatever happens."""
    try:
        ForkingPickler.dumps(job)
    except Exception as error:
        raise OptionError(
            f"with several workers, factories travel to other processes, and this one cannot "
            f"({error}): define it at module level, or use workers=1"
        ) from error
    started: list[tuple[SpawnProcess, Connection]] = []
    try:
        with worker_conditions():
            for _ in range(workers):
                started.append(_start_worker(job))
        processes = {connection: process for process, connection in started}
        waiting = iter(scenarios)
        # What each worker was told and has not answered: always some, so that it plays on while
        # the caller looks at what it played before.
        told = dict.fromkeys(processes, 0)
        for connection in [*processes] * _TOLD_AHEAD:
            told[connection] += _send_next(connection, waiting)
        while busy := [connection for connection, count in told.items() if count]:
            for ready in wait(busy):
                connection = cast("Connection", ready)
                result = _receive(connection, processes)
                told[connection] += _send_next(connection, waiting) - 1
                yield result
        for process, _ in started:
            process.join(WORKER_EXIT_TIMEOUT_S)
    finally:
        for process, connection in started:
            connection.close()
            if process.is_alive():
                process.terminate()
        for process, _ in started:
            process.join(WORKER_EXIT_TIMEOUT_S)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()


@contextlib.contextmanager
def worker_conditions() -> Iterator[None]:
    """Environment variables and signals as a new worker shall inherit them.

    A worker ignores Ctrl-C from its first instruction on: the terminal sends it to the whole
    group, and only the process that asked for the work should answer.
    """
    before = {name: os.environ.get(name) for name in WORKER_ENVIRONMENT}
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if in_main_thread else None
    os.environ.update(WORKER_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if in_main_thread:
            signal.signal(signal.SIGINT, handler)


def _start_worker(job: _Job) -> tuple[SpawnProcess, Connection]:
    """Starts one worker; returns it and our end of its pipe."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, job), daemon=True)
    process.start()
    # With our copy closed, a worker that dies is seen as the end of the stream.
    theirs.close()
    return process, ours


def _send_next(connection: Connection, waiting: Iterator[int]) -> bool:
    """Sends the next index, or the end; False at the end. A dead worker is found on receiving."""
    scenario = next(waiting, None)
    with contextlib.suppress(OSError):
        connection.send(scenario)
    return scenario is not None


def _receive(connection: Connection, processes: Mapping[Connection, SpawnProcess]) -> Any:
    """Returns a worker's result, or raises what it raised."""
    try:
        kind, *content = connection.recv()
    except (EOFError, OSError):
        process = processes[connection]
        process.join(WORKER_EXIT_TIMEOUT_S)
        raise RuntimeError(
            f"A rollout worker ended with exit code {process.exitcode} before its result came; "
            "a negative code is the signal that ended it (-9: most likely out of memory)."
        ) from None
    if kind == "result":
        return content[0]
    error_type, text, trace = content
    if error_type is not None:
        raise error_type(text)
    error = RuntimeError(f"A rollout worker failed: {text}")
    error.add_note(f"In the worker:\n{trace}")
    raise error


def _work(connection: Connection, job: _Job) -> None:
    """A worker's life: build, play what it is told until the end is told, close."""
    make_env, make_policy, run = job
    try:
        with contextlib.closing(make_env()) as env:
            policy = make_policy(env)
            while (scenario := connection.recv()) is not None:
                with one_torch_thread():
                    result = run(env, policy, scenario)
                connection.send(("result", result))
    except Exception as error:
        report = (
            ("error", type(error), str(error), "")
            if isinstance(error, HvsError)
            else ("error", None, f"{type(error).__name__}: {error}", traceback.format_exc())
        )
        # Where the pipe itself has gone, so has whoever could be told.
        with contextlib.suppress(OSError):
            connection.send(report)
