"""The executor gives the same episodes however many workers play them, and fails clearly."""

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
import pytest
from dm_env import specs

from hvs_suite.errors import ActionError, OptionError, PolicyError
from hvs_suite.rollout import Episode, play, rollout, run_episode

LIMIT = 5


class Counter:
    """A cell in miniature: scenario i is solved at step i + 1, within LIMIT steps."""

    def __init__(self) -> None:
        self.closed = False
        self.scenario = -1
        self.steps = 0
        self.executed: list[np.ndarray] = []

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((7,), np.float32, -1.0, 1.0)

    def reset(self, *, scenario: int | None = None) -> dm_env.TimeStep:
        assert scenario is not None
        self.scenario, self.steps, self.executed = scenario, 0, []
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        self.steps += 1
        self.executed.append(action)
        if self.info["is_success"]:
            return dm_env.termination(1.0, self._observation())
        if self.info["truncated"]:
            return dm_env.truncation(0.0, self._observation(), discount=1.0)
        return dm_env.transition(0.0, self._observation())

    def close(self) -> None:
        self.closed = True

    @property
    def info(self) -> dict[str, Any]:
        success = self.steps == self.scenario + 1
        return {
            "is_success": success,
            "success_once": success,
            "collision": False,
            "truncated": self.steps == LIMIT and not success,
            "steps_to_goal": self.steps if success else None,
            "errors": {"position_error_mm": float(self.scenario), "tilt_error_deg": 3.0},
            "process": os.getpid(),
            "threads": os.environ.get("LP_NUM_THREADS"),
        }

    def _observation(self) -> dict[str, np.ndarray]:
        return {"step": np.array([self.scenario, self.steps], dtype=np.float32)}


@dataclasses.dataclass
class Echo:
    """Answers with the scenario and step it sees, as seven numbers in [-1, 1]."""

    env: Counter
    scale: float = 0.1

    def reset(self) -> None:
        self.seen = 0

    def select_action(self, observation: Any) -> np.ndarray:
        self.seen += 1
        return np.resize(observation["step"] * self.scale, 7).astype(np.float32)


@dataclasses.dataclass
class Refuses:
    """A policy whose every action is the given one."""

    action: Any

    def __call__(self, env: Counter) -> "Refuses":
        return self

    def reset(self) -> None: ...

    def select_action(self, observation: Any) -> Any:
        return self.action


def no_weights(env: Counter) -> Echo:
    raise PolicyError("No weights are shipped for this task.")


def breaks(env: Counter) -> Echo:
    raise ZeroDivisionError("by accident")


def dies(env: Counter) -> Echo:
    os._exit(7)


def where(env: Counter, policy: Any, scenario: int) -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("LP_NUM_THREADS")


def overshoots(env: Counter) -> Echo:
    return Echo(env, scale=0.4)


def as_plain(episode: Episode) -> dict[str, Any]:
    plain = dataclasses.asdict(episode)
    del plain["decision_s"]
    plain["actions"] = episode.actions.tobytes(), episode.actions.shape
    return plain


def test_success_ends_an_episode_and_gives_the_steps_to_the_goal() -> None:
    episode = run_episode(Counter(), Echo(Counter()), 2)
    assert (episode.success, episode.truncated, episode.steps) == (True, False, 3)
    assert episode.steps_to_goal == 3
    assert episode.actions.shape == (3, 7)
    assert episode.actions.dtype == np.float32


def test_failure_has_no_steps_to_goal() -> None:
    episode = run_episode(Counter(), Echo(Counter()), 9)
    assert (episode.success, episode.truncated, episode.steps) == (False, True, LIMIT)
    assert episode.steps_to_goal is None
    assert episode.errors["position_error_mm"] == 9.0


def test_actions_out_of_range_are_clipped_and_their_steps_counted() -> None:
    env = Counter()
    episode = run_episode(env, overshoots(env), 4)
    # The policy answers with 0.4 times scenario and step: 1.6 for the scenario in every step.
    assert episode.n_clipped == episode.steps == 5
    assert episode.actions.max() == pytest.approx(1.6)
    assert max(action.max() for action in env.executed) == 1.0


def test_the_hook_sees_what_the_policy_saw_and_what_was_executed() -> None:
    env, calls = Counter(), []
    run_episode(env, overshoots(env), 3, lambda *call: calls.append(call))
    assert len(calls) == 4
    for k, (observation, action, executed, time_step, info) in enumerate(calls):
        assert observation["step"][1] == k
        assert time_step.observation["step"][1] == k + 1
        assert action[0] == pytest.approx(1.2)
        assert executed[0] == 1.0
        assert info["process"] == os.getpid()
    assert [time_step.last() for *_, time_step, _ in calls] == [False, False, False, True]


@pytest.mark.parametrize(
    ("action", "reason"),
    [
        (np.zeros(6), "shape"),
        (np.zeros((1, 7)), "batch"),
        (np.full(7, np.nan), "NaN"),
        (np.full(7, np.inf), "infinity"),
        (None, "shape"),
        ("up", "str"),
    ],
)
def test_an_action_that_is_none_names_scenario_and_step(action: Any, reason: str) -> None:
    with pytest.raises(ActionError, match=reason) as caught:
        run_episode(Counter(), Refuses(action), 3)
    assert "step 0 of scenario 3" in str(caught.value)


def test_one_and_two_workers_give_the_same_episodes_in_order_of_scenario() -> None:
    scenarios = [5, 0, 3, 1, 4, 2]
    alone = rollout(Counter, Echo, scenarios)
    assert [episode.scenario for episode in alone] == sorted(scenarios)
    together = rollout(Counter, Echo, scenarios, workers=2)
    assert [as_plain(e) for e in together] == [as_plain(e) for e in alone]


def test_workers_are_other_processes_held_to_one_thread() -> None:
    before = os.environ.get("LP_NUM_THREADS")
    places = list(play(Counter, Echo, range(4), where, workers=2))
    assert os.getpid() not in {process for process, _ in places}
    assert {threads for _, threads in places} == {"1"}
    assert os.environ.get("LP_NUM_THREADS") == before


@pytest.mark.parametrize("workers", [1, 2])
def test_every_episode_is_reported_once(workers: int) -> None:
    seen: list[int] = []
    rollout(Counter, Echo, range(5), workers=workers, on_episode=lambda e: seen.append(e.scenario))
    assert sorted(seen) == [0, 1, 2, 3, 4]


def test_no_scenarios_need_no_environment() -> None:
    assert rollout(breaks, breaks, [], workers=2) == []  # type: ignore[arg-type]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_typed_error_keeps_its_type(workers: int) -> None:
    with pytest.raises(PolicyError, match=r"^No weights are shipped for this task\.$"):
        rollout(Counter, no_weights, range(3), workers=workers)
    assert not multiprocessing.active_children()


def test_another_error_of_a_worker_comes_with_its_traceback() -> None:
    with pytest.raises(RuntimeError, match="ZeroDivisionError: by accident") as caught:
        rollout(Counter, breaks, range(3), workers=2)
    assert "in breaks" in caught.value.__notes__[0]
    assert not multiprocessing.active_children()


def test_a_worker_that_dies_is_noticed() -> None:
    with pytest.raises(RuntimeError, match="exit code 7"):
        rollout(Counter, dies, range(3), workers=2)
    assert not multiprocessing.active_children()


def test_the_environment_is_closed_after_success_and_after_an_error() -> None:
    env = Counter()
    rollout(lambda: env, Echo, [0])
    assert env.closed
    env = Counter()
    with pytest.raises(PolicyError):
        rollout(lambda: env, no_weights, [0])
    assert env.closed


def test_a_factory_that_cannot_travel_is_refused_with_the_mend() -> None:
    with pytest.raises(OptionError, match="module level"):
        rollout(lambda: Counter(), Echo, range(2), workers=2)


@pytest.mark.parametrize("workers", [0, -1])
def test_less_than_one_worker_is_refused(workers: int) -> None:
    with pytest.raises(OptionError, match="at least 1"):
        rollout(Counter, Echo, range(2), workers=workers)


def test_leaving_the_iterator_ends_the_workers() -> None:
    played = play(Counter, Echo, range(1000), run_episode, workers=2)
    next(played)
    assert len(multiprocessing.active_children()) == 2
    played.close()
    assert not multiprocessing.active_children()


def test_ctrl_c_ends_workers_without_a_word_from_them() -> None:
    script = textwrap.dedent(
        f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        import multiprocessing, signal
        # Shells start background jobs, this test's perhaps, with the signal masked.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        from test_rollout import Counter, Echo
        from hvs_suite.rollout import rollout
        def told(episode):
            print("playing", flush=True)
        try:
            rollout(Counter, Echo, range(10**6), workers=2, on_episode=told)
        except KeyboardInterrupt:
            print("left", len(multiprocessing.active_children()))
        """
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "playing\n"
    # To the whole group, as a terminal does it.
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert out.splitlines()[-1] == "left 0"
    assert err == ""
