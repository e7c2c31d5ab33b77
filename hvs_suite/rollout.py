"""Plays anything with ``reset`` and ``select_action`` over given scenarios.

Evaluation, recording and DAgger all go through `play`. A scenario is a pure function of its index,
so the result does not depend on how many workers there are, where they are, or which one plays
what. This module imports no other part of the suite: environments and policies come as factories.
"""

import contextlib
import dataclasses
import random
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

import dm_env
import numpy as np
import numpy.typing as npt

from hvs_suite.errors import ActionError
from hvs_suite.executor import Note, Workers, spread

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


@runtime_checkable
class Overruled(Protocol):
    """A policy that remembers its actions, and has to know when another one was executed."""

    def overrule(self, action: Action) -> None:
        """Takes in what was executed in place of its last action, (7,) in [-1, 1]."""


def overrule(policy: Any, action: Action) -> None:
    """Tells a policy that another action than its last was executed, if it listens."""
    if isinstance(policy, Overruled):
        policy.overrule(action)


class Environment(Protocol):
    """What the executor needs from an environment; `hvs_suite.load` returns one."""

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
    workers: Workers = 1,
    on_episode: Callable[[Episode], None] | None = None,
) -> list[Episode]:
    """Plays every scenario once; the same episodes for any number of workers.

    Args:
        make_env: Builds the environment, once a worker.
        make_policy: Builds the policy for it, once a worker.
        scenarios: Indices, in any order.
        workers: Processes; 1 plays in this one. Or others elsewhere.
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
    workers: Workers = 1,
) -> Generator[T, None, None]:
    """Runs ``run(env, policy, scenario)`` over scenarios and yields results as they come.

    The general form of `rollout`, for callers that need more of an episode than an `Episode`
    holds. Workers take the next index whenever they are free and run a few results ahead of the
    reader at most, so memory stays flat. Closing the iterator (or an error, or Ctrl-C) ends them.

    Args:
        make_env: Builds the environment, once a worker.
        make_policy: Builds the policy for it, once a worker.
        scenarios: Indices; handed out in this order.
        run: Module-level function or dataclass; its result travels.
        workers: Processes; 1 plays in this one, in order. Or others elsewhere.

    Yields:
        One result a scenario, in the order in which they end.

    Raises:
        OptionError: `workers` is below 1, or something cannot be sent to another process.
        ClusterError: Workers elsewhere cannot be had.
        HvsError: Whatever typed error a factory or a run raised, in whichever process.
        RuntimeError: Any other failure of a worker, its traceback as a note.
    """
    if not isinstance(workers, int):
        make_policy = carried(make_policy)
    yield from spread(_Play(make_env, make_policy, run), scenarios, workers=workers)


@dataclasses.dataclass(frozen=True)
class _Play[T]:
    """Makes a worker that plays scenarios, for :func:`hvs_suite.executor.spread`."""

    make_env: EnvFactory
    make_policy: PolicyFactory
    run: Callable[[Any, Policy, int], T]

    @contextlib.contextmanager
    def __call__(self, note: Note) -> Iterator[Callable[[int], T]]:
        with contextlib.closing(self.make_env()) as env:
            policy = self.make_policy(env)

            def play_one(scenario: int) -> T:
                with one_torch_thread():
                    return self.run(env, policy, scenario)

            yield play_one


@runtime_checkable
class ReadsFolder(Protocol):
    """A factory, a dataclass, that reads the files of a folder when it is called."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    folder: str

    def __call__(self, *arguments: Any) -> Any:
        """Builds what it builds."""


@dataclasses.dataclass(frozen=True)
class _Carried:
    """A factory that `ReadsFolder`, with the folder's files, for machines without that folder."""

    factory: ReadsFolder
    files: Mapping[str, bytes]

    def __call__(self, *arguments: Any) -> Any:
        with tempfile.TemporaryDirectory(prefix="hvs-policy-") as folder:
            for name, content in self.files.items():
                (Path(folder) / name).write_bytes(content)
            return dataclasses.replace(self.factory, folder=folder)(*arguments)


def carried[T](make: T) -> T:
    """A factory that needs no file of this machine.

    Args:
        make: If it `ReadsFolder`, or is a dataclass around one that does, it takes the folder's
            files with it, except for sub-folders, which policies do not read.
    """
    if not dataclasses.is_dataclass(make) or isinstance(make, type):
        return make
    if not isinstance(make, ReadsFolder):
        inside = {field.name: getattr(make, field.name) for field in dataclasses.fields(make)}
        return dataclasses.replace(make, **{name: carried(each) for name, each in inside.items()})
    paths = sorted(path for path in Path(make.folder).iterdir() if path.is_file())
    return cast("T", _Carried(make, {path.name: path.read_bytes() for path in paths}))


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

    The suite uses none of them, but other policies do (diffusion policies draw their noise from
    torch's generator), and would otherwise depend on which scenarios a worker played before.
    Afterwards the generators are as they were, so the caller's own draws are unchanged.

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
