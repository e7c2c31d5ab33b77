"""A policy that breaks down loses its episode and nothing else; past the goal it plays on."""

import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hvs_suite
from hvs_suite.cli import main
from hvs_suite.errors import OutputError, PolicyError
from hvs_suite.eval import action_log, protocol, result_file
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.registry import TASKS
from hvs_suite.rollout import run_episode

TASK = "align-thesis"


@pytest.fixture(autouse=True)
def _own_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parent)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nan", "not finite"),
        ("shape", "wrong shape"),
        ("text", "wrong shape"),
        ("raises", "raised IndexError"),
        ("hangs", "too slow"),
    ],
)
def test_a_policy_that_breaks_down_loses_the_episode_and_the_run_goes_on(
    name: str, reason: str
) -> None:
    result = protocol.evaluate(f"broken_policies:{name}", TASK, episodes=2, decision_limit_s=0.3)
    assert result.summary.failures == {reason: 2}
    assert result.summary.n_failure == 2
    for row in result.episodes:
        assert (row.failure, row.steps, row.truncated) == (reason, 1, False)
        assert row.position_error_mm > 0.0


def test_the_deadline_leaves_no_timer_behind() -> None:
    before = signal.getsignal(signal.SIGALRM)
    protocol.evaluate("zero", TASK, episodes=1, decision_limit_s=0.5)
    assert signal.getsignal(signal.SIGALRM) is before


def test_a_policy_that_draws_from_global_generators_scores_the_same_in_any_order() -> None:
    one, two = (
        protocol.evaluate("broken_policies:draws", TASK, episodes=3, workers=workers)
        for workers in (1, 2)
    )
    assert one.episodes == two.episodes
    assert one.metadata.policy_kind == "module"
    assert one.metadata.policy_hash is not None


def test_evaluating_leaves_the_caller_s_global_generators_alone() -> None:
    states = []
    for _ in range(2):
        states.append((random.getstate(), str(np.random.get_state())))  # noqa: NPY002
        protocol.evaluate("broken_policies:draws", TASK, episodes=1)
    assert states[0] == states[1]


def test_a_policy_sees_what_the_preset_shows_and_nothing_else() -> None:
    result = protocol.evaluate("broken_policies:curious", TASK, episodes=1)
    assert result.summary.failures == {}


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        ("no_such_module:make", "cannot import no_such_module"),
        ("broken_policies:nobody", "no callable nobody"),
        ("broken_policies:nothing", "has no reset"),
    ],
)
def test_code_that_is_no_policy_is_refused(spec: str, reason: str) -> None:
    with pytest.raises(PolicyError, match=reason):
        protocol.evaluate(spec, TASK, episodes=1)


def test_the_score_is_the_episode_that_ends_at_the_goal() -> None:
    result = protocol.evaluate("expert", TASK, episodes=2)
    with hvs_suite.load(TASK, split="test") as env:
        expert = policy_factory("expert", TASK)(env)
        for row in result.episodes:
            episode = run_episode(env, expert, row.scenario)
            assert (row.success, row.steps, row.steps_to_goal) == (
                episode.success,
                episode.steps,
                episode.steps_to_goal,
            )
            for name in result_file.ERRORS:
                assert getattr(row, name) == pytest.approx(getattr(episode, name), abs=1e-6)


def test_past_the_goal_the_policy_plays_on_to_the_time_limit_and_settles() -> None:
    result = protocol.evaluate("expert", TASK, episodes=2)
    for row in result.episodes:
        assert row.steps < row.settled_steps == TASKS[TASK].time_limit_steps
        assert row.settled_position_error_mm < 0.02
        assert np.hypot(row.settled_x_mm, row.settled_y_mm) == pytest.approx(
            row.settled_lateral_error_mm, abs=1e-5
        )
    assert result.summary.settled_sharpest_95.position_error_mm is not None


def test_playing_on_changes_no_scenario() -> None:
    with hvs_suite.load("align-hard", split="test") as env:
        first = env.reset(scenario=5).observation
        env.goal_ends_episode = False
        again = env.reset(scenario=5).observation
    for name, value in first.items():
        np.testing.assert_array_equal(value, again[name])


def test_the_action_log_holds_every_action(tmp_path: Path) -> None:
    path = tmp_path / "zero.json"
    result = protocol.evaluate("random", TASK, path, episodes=2)
    log = action_log.load(result_file.actions_path(path), result.metadata.actions_sha256)
    assert [len(actions) for actions in log] == [row.settled_steps for row in result.episodes]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["zero.actions.npz", "zero.json"]


def rows(path: Path) -> tuple[str, Any, bytes]:
    text = path.read_text()
    content = json.loads(text)
    del content["metadata"]["created"]
    log = result_file.actions_path(path).read_bytes()
    return text[text.index('"episodes"') :], content["metadata"], log


def test_a_killed_evaluation_goes_on_to_the_same_result(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole.json", tmp_path / "killed.json"
    protocol.evaluate("random", TASK, whole, episodes=40)
    words = f"evaluate --policy random --task {TASK} --episodes 40 --out {killed}".split()
    process = subprocess.Popen(
        [sys.executable, "-c", "from hvs_suite.cli.main import main; main()", *words]
    )
    partial = tmp_path / "killed.json.partial"
    deadline = time.monotonic() + 60.0
    while not (partial.exists() and partial.read_bytes().count(b"\n") > 4):
        assert process.poll() is None
        assert time.monotonic() < deadline
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not killed.exists()
    with partial.open("ab") as file:
        file.write(b'{"row": {"scen')
    played: list[int] = []
    protocol.evaluate(
        "random", TASK, killed, episodes=40, progress=lambda t: played.append(t.row.scenario)
    )
    assert sorted(played) == list(range(40))
    assert rows(killed) == rows(whole)
    assert not partial.exists()


def test_the_beginning_of_another_evaluation_is_not_mixed_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.json"

    def stop(trial: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        protocol.evaluate("random", TASK, path, episodes=2, progress=stop)
    with pytest.raises(OutputError, match=r"another evaluation \(policy differs\)"):
        protocol.evaluate("zero", TASK, path, episodes=2)
    partial = tmp_path / "out.json.partial"
    partial.write_text("nonsense\n")
    with pytest.raises(OutputError, match="damaged"):
        protocol.evaluate("zero", TASK, path, episodes=2)


def test_several_tasks_write_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "evaluate --policy broken_policies:nan --task align-easy --task align-fixed"
    assert main.run([*words.split(), "--episodes", "1", "--out", str(tmp_path / "mine")]) == 0
    names = {file.name for file in (tmp_path / "mine").iterdir()}
    assert {"align-easy.json", "align-fixed.json"} < names
    assert "scenario 0 lost: NaN" in capsys.readouterr().err
    assert not multiprocessing.active_children()
