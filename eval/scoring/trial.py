"""One scenario played for a score: to the goal, and on past it to where the policy settles.

One episode gives both sets of figures. The score is taken at the control step at which the goal has
been held; the policy, which is not told, plays on to the time limit. Two separate episodes would be
the same up to the goal, because a scenario fixes everything random.
"""

import abc
import contextlib
import dataclasses
import functools
import hashlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import FrameType
from typing import Any, Protocol

import dm_env
import numpy as np
import numpy.typing as npt

from hvs_suite import registry, rollout
from hvs_suite.errors import OptionError, describe
from hvs_suite.eval.scoring.result_file import EpisodeRow, Settled
from hvs_suite.rollout import Action, Instructed, Observation, Policy, library_seeds

NOT_FINITE = "not finite"
WRONG_SHAPE = "wrong shape"
TOO_SLOW = "too slow"

DECISION_LIMIT_S = 10.0
"""A hundred control periods: far above any policy that could be used, below a hung one."""
LONGEST_DECISION_LIMIT_S = 3600.0
# A policy in another process keeps the time itself; this much later the alarm goes off anyway (s).
_GRACE_S = 5.0
# A micrometre: a tenth of what is allowed where an episode is played again, and short to read.
_DIGITS = 3

Decide = Callable[[Observation], Action]


class Stage(Protocol):
    """What a trial needs of an environment; `hvs_suite.load` returns one."""

    goal_ends_episode: bool

    @property
    def info(self) -> Mapping[str, Any]:
        """Outcome and errors (mm, deg) at the end of the last control step."""

    @property
    def instruction(self) -> str:
        """The task of the present episode as a sentence."""

    @property
    def landing_mm(self) -> npt.NDArray[np.float64]:
        """Where the flange stands over the target, (2,) mm."""

    def action_spec(self) -> Any:
        """Returns the `dm_env.specs.BoundedArray` of actions."""

    def reset(self, *, scenario: int | None = None) -> dm_env.TimeStep:
        """Starts the scenario with this index."""

    def step(self, action: Action) -> dm_env.TimeStep:
        """Plays one control step."""


class EpisodeLostError(Exception):
    """A policy lost its episode.

    Args:
        reason: What is counted.
        detail: What it said, which helps to find the fault.
    """

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(reason)
        self.reason = reason
        self.detail = detail


class Connected(abc.ABC):
    """A policy in another process, to which a connection is made before the clock starts.

    `Policy.select_action` and `Policy.reset` of such a policy keep the time limit of a decision by
    themselves; only they may raise `EpisodeLostError`.
    """

    @abc.abstractmethod
    def connect(self, seed: int) -> None:
        """Makes the connection if there is none.

        Args:
            seed: What the policy is told at the next reset; it may draw from it.

        Raises:
            ServerError: Nothing answers at the other end. The run stops, and can be resumed.
            PolicyError: The policy cannot be built there.
        """


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """A played scenario.

    Attributes:
        row: Its outcome.
        actions: (settled.steps, 7) float32, as the policy gave them, before clipping.
        decision_s: Wall time spent in the policy, summed (s).
        slowest_s: Its longest decision (s).
        play_s: Wall time of the whole trial in the process that played it, reset included (s).
        detail: What the policy said when it failed; empty if it did not.
    """

    row: EpisodeRow
    actions: npt.NDArray[np.float32]
    decision_s: float
    slowest_s: float
    play_s: float
    detail: str


def same_outcome(one: EpisodeRow, other: EpisodeRow) -> bool:
    """Whether two rows differ in nothing but their errors."""
    return outcome(one) == outcome(other)


def outcome(row: EpisodeRow) -> dict[str, Any]:
    """Returns what a row says of an episode apart from its errors, by name."""
    figures = row.model_dump(exclude={"errors": True, "settled": True})
    end = row.settled
    return figures | {
        "settled.steps": end.steps,
        "settled.collision": end.collision,
        "settled.failure": end.failure,
    }


@dataclasses.dataclass(frozen=True)
class MakeTask:
    """Builds a task in whichever process asks for it.

    Attributes:
        task: Named task.
        split: Split its scenarios come from.
        options: Options that differ from it.
        pictures: Draw the observations; a re-simulation or a policy that does not look needs none.
    """

    task: str
    split: str
    options: Mapping[str, Any]
    pictures: bool = True

    def __call__(self) -> rollout.Environment:
        """Returns a new environment."""
        unseen = {} if self.pictures else {"observations": "state"}
        options = {**self.options, **unseen}
        env: rollout.Environment = registry.load(self.task, split=self.split, **options)
        return env


@dataclasses.dataclass(frozen=True)
class PlayTrial:
    """Plays a policy's trial in whichever process asks for it, for `rollout.play`.

    Attributes:
        decision_limit_s: Time after which a decision loses the episode (s).
        salt: Of this run, for `episode_seed`.
    """

    decision_limit_s: float
    salt: str

    def __call__(self, env: Stage, policy: Policy, scenario: int) -> Trial:
        """Plays one scenario; a policy that breaks down loses it, and nothing else."""
        seed = episode_seed(self.salt, scenario)
        if isinstance(policy, Connected):
            policy.connect(seed)
        return _play_policy(env, policy, scenario, seed, self.decision_limit_s)


def play_trial(
    env: Stage, start: Callable[[], None], decide: Decide, scenario: int
) -> tuple[EpisodeRow, npt.NDArray[np.float32]]:
    """Plays one scenario with a function of the observation.

    Args:
        env: Left at the last step; its goals no longer end episodes afterwards.
        start: Called once after the reset.
        decide: Returns a finite action of the right shape, or raises `EpisodeLostError`; so may
            `start`.
        scenario: Index in the environment's split.

    Returns:
        Row, and actions (n, 7) float32 before clipping.
    """
    env.goal_ends_episode = False
    spec = env.action_spec()
    low, high = np.float32(spec.minimum), np.float32(spec.maximum)
    time_step = env.reset(scenario=scenario)
    actions: list[Action] = []
    n_clipped = 0
    scored: dict[str, Any] | None = None
    failure: str | None = None
    info = env.info
    try:
        start()
        while not time_step.last():
            action = decide(time_step.observation)
            # Both are float32, and np.clip takes three times as long.
            executed = np.minimum(np.maximum(action, low), high)
            n_clipped += bool((executed != action).any())
            time_step = env.step(executed)
            actions.append(action)
            info = env.info
            if scored is None and info["is_success"]:
                scored = _scored(info, len(actions), n_clipped, None)
    except EpisodeLostError as error:
        failure = error.reason
    if scored is None:
        scored = _scored(info, len(actions), n_clipped, failure)
    x, y = env.landing_mm
    settled = Settled(
        steps=len(actions),
        collision=bool(info["collision"]),
        failure=failure,
        errors=_errors(info),
        x_mm=round(float(x), _DIGITS),
        y_mm=round(float(y), _DIGITS),
    )
    row = EpisodeRow(scenario=int(scenario), **scored, settled=settled)
    return row, np.array(actions, np.float32).reshape(-1, *spec.shape)


def _play_policy(env: Stage, policy: Policy, scenario: int, seed: int, limit_s: float) -> Trial:
    """A live policy's trial: times, checks and guards each of its decisions."""
    shape = env.action_spec().shape
    is_connected = isinstance(policy, Connected)
    alarm_s = limit_s + _GRACE_S if is_connected else limit_s
    times = [0.0]
    detail = ""

    def guarded(call: Callable[[], Any]) -> Any:
        nonlocal detail
        started = time.perf_counter()
        try:
            set_alarm(alarm_s)
            try:
                answer = call()
            finally:
                set_alarm(0.0)
        except _DeadlineError:
            detail = f"no answer within {limit_s:g} s"
            raise EpisodeLostError(TOO_SLOW, detail) from None
        except Exception as error:
            if is_connected and isinstance(error, EpisodeLostError):
                detail = error.detail
                raise
            detail = describe(error)
            raise EpisodeLostError(f"raised {type(error).__name__}", detail) from error
        times.append(time.perf_counter() - started)
        if times[-1] > limit_s:
            detail = f"{times[-1]:.3g} s for a decision, more than {limit_s:g} s"
            raise EpisodeLostError(TOO_SLOW, detail)
        return answer

    def decide(observation: Observation) -> Action:
        nonlocal detail
        answer = guarded(lambda: policy.select_action(observation))
        try:
            return _checked(answer, shape)
        except EpisodeLostError as failure:
            detail = failure.detail
            raise

    begun = time.perf_counter()

    def start() -> None:
        seeds.enter_context(library_seeds(seed))
        if isinstance(policy, Instructed):
            guarded(lambda: policy.instruct(env.instruction))
        guarded(policy.reset)

    with contextlib.ExitStack() as seeds, _alarm_clock() as set_alarm:
        row, actions = play_trial(env, start, decide, scenario)
    return Trial(
        row=row,
        actions=actions,
        decision_s=sum(times),
        slowest_s=max(times),
        play_s=time.perf_counter() - begun,
        detail=detail,
    )


def _checked(answer: Any, shape: Sequence[int]) -> Action:
    """Returns a policy's answer as a float32 copy.

    Raises:
        EpisodeLostError: It is no action.
    """
    try:
        action = np.array(answer, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise EpisodeLostError(WRONG_SHAPE, f"{type(answer).__name__} is no array") from error
    if action.shape != tuple(shape):
        raise EpisodeLostError(WRONG_SHAPE, f"shape {action.shape} instead of {tuple(shape)}")
    if not np.isfinite(action).all():
        raise EpisodeLostError(NOT_FINITE, "NaN or infinity in the action")
    return action


def episode_seed(salt: str, scenario: int) -> int:
    """Returns the seed that a policy may draw from in a scenario, in [0, 2^32).

    Args:
        salt: A secret of the run. Without it, a table made beforehand would tell a policy from its
            seed which scenario it plays.
        scenario: Index in the split.
    """
    digest = hashlib.sha256(f"episode {salt} {scenario}".encode()).digest()
    return int.from_bytes(digest[:4], "little")


def check_decision_limit(limit_s: float) -> None:
    """Checks the time limit of a decision.

    Args:
        limit_s: As the user gave it (s).

    Raises:
        OptionError: It is not above 0 and at most `LONGEST_DECISION_LIMIT_S`.
    """
    if not 0.0 < limit_s <= LONGEST_DECISION_LIMIT_S:
        raise OptionError(
            f"the time limit of a decision is {limit_s:g} s; use more than 0 and at most "
            f"{LONGEST_DECISION_LIMIT_S:g} s"
        )


class _DeadlineError(BaseException):
    """No `Exception`: a policy that catches those must not catch this."""


@contextlib.contextmanager
def _alarm_clock() -> Iterator[Callable[[float], object]]:
    """Yields a function that sets an alarm after some seconds, 0 for none, in the block.

    It raises `_DeadlineError`; in other threads than the main, never.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGALRM"):
        yield lambda seconds: None
        return

    def strike(signal_number: int, frame: FrameType | None) -> None:
        raise _DeadlineError

    before, _ = signal.setitimer(signal.ITIMER_REAL, 0.0)
    handler = signal.signal(signal.SIGALRM, strike)
    started = time.monotonic()
    try:
        yield functools.partial(signal.setitimer, signal.ITIMER_REAL)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)
        if before:
            # A timer that was running before (of a test runner) continues.
            left = max(before - (time.monotonic() - started), 1e-3)
            signal.setitimer(signal.ITIMER_REAL, left)


def _scored(
    info: Mapping[str, Any], steps: int, n_clipped: int, failure: str | None
) -> dict[str, Any]:
    """The scored part of a row."""
    success = bool(info["is_success"]) and failure is None
    return {
        "success": success,
        "success_once": bool(info["success_once"]),
        "collision": bool(info["collision"]),
        "truncated": bool(info["truncated"]) and not success,
        "steps": steps,
        "steps_to_goal": info["steps_to_goal"] if success else None,
        "n_clipped": n_clipped,
        "failure": failure,
        "errors": _errors(info),
    }


def _errors(info: Mapping[str, Any]) -> dict[str, float]:
    return {name: round(float(value), _DIGITS) for name, value in info["errors"].items()}
