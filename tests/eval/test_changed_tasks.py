"""Tasks that options change: played again with them, and never taken for the task as named."""

import json
import shutil
from pathlib import Path

import pytest

from hvs_suite.cli.main import run
from hvs_suite.datasets.check import check_dataset
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import result_file, verification
from hvs_suite.eval.serving import policy_session
from hvs_suite.eval.serving.remote_policy import hello
from hvs_suite.registry import load

TASK = "align-easy"
OPTIONS = {"marker": "ring", "ring_m": [0.45, 0.7], "time_limit_steps": 6}
WORDS = ["--option", "marker=ring", "--option=ring_m=0.45,0.7", "--option", "time_limit_steps=6"]


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of ``random`` on the changed task, among the results of a board."""
    out = tmp_path_factory.mktemp("changed") / "results" / "random" / f"{TASK}.json"
    words = ["evaluate", "--policy", "random", "--task", TASK, "--episodes", "3", *WORDS]
    assert run([*words, "--out", str(out)]) == 0
    return out


def test_a_result_says_how_its_task_was_changed(changed: Path) -> None:
    result = result_file.load(changed)
    assert result.metadata.options == OPTIONS
    assert result.metadata.time_limit_steps == 6
    assert max(row.steps for row in result.episodes) <= 6
    # Every action is logged, also those of a built-in policy.
    assert result.metadata.n_logged == 3


def test_it_is_played_again_with_the_options_and_does_not_come_out_without(
    changed: Path, tmp_path: Path
) -> None:
    assert verification.verify(changed).n_played == 3
    other = tmp_path / f"{TASK}.json"
    shutil.copy(result_file.actions_path(changed), result_file.actions_path(other))
    result = result_file.load(changed)
    for options in ({**OPTIONS, "ring_m": [0.5, 0.6]}, {"time_limit_steps": 6}):
        metadata = result.metadata.model_copy(update={"options": options})
        result_file.write(result.model_copy(update={"metadata": metadata}), other)
        with pytest.raises(result_file.ResultError, match="but the logged actions give"):
            verification.verify(other)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({**OPTIONS, "marker": "cross"}, "marker is 'cross'"),
        ({**OPTIONS, "colour": "red"}, "no option 'colour'"),
        ({**OPTIONS, "hold_steps": 1}, "are not what differs from align-easy"),
        ({**OPTIONS, "position_tolerance_mm": 9.0}, "tolerances is"),
        ({**OPTIONS, "control_period_s": 1e9}, "it must be at most 1"),
    ],
)
def test_options_that_a_file_only_claims_are_refused(
    changed: Path, tmp_path: Path, options: dict[str, object], reason: str
) -> None:
    other = tmp_path / f"{TASK}.json"
    shutil.copy(result_file.actions_path(changed), result_file.actions_path(other))
    result = result_file.load(changed)
    metadata = result.metadata.model_copy(update={"options": options})
    result_file.write(result.model_copy(update={"metadata": metadata}), other)
    with pytest.raises(result_file.ResultError, match=reason):
        verification.verify(other)


def test_the_board_refuses_it_and_nothing_is_compared_with_the_named_task(
    changed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = changed.parents[1]
    reason = "the task was changed (marker=ring, ring_m=0.45,0.7, time_limit_steps=6)"
    for words in (
        ["leaderboard", "--draft", "--results", str(results), "--out", str(tmp_path / "board")],
        ["verify", str(changed), "--submission", "--results", str(results)],
    ):
        assert run(words) != 0
        assert reason in capsys.readouterr().err
    assert not (tmp_path / "board").exists()
    named = tmp_path / "named.json"
    protocol.evaluate("zero", TASK, named, episodes=3)
    assert run(["compare", str(changed), str(named)]) == 2
    assert "options" in capsys.readouterr().err
    other = tmp_path / "other.json"
    protocol.evaluate("zero", TASK, other, episodes=3, options=OPTIONS)
    assert run(["compare", str(changed), str(other)]) == 0
    assert f"{TASK} with marker=ring" in capsys.readouterr().out


def test_an_option_with_the_task_s_own_value_changes_nothing(tmp_path: Path) -> None:
    result = protocol.evaluate("zero", TASK, episodes=1, options={"marker": "disc"})
    assert result.metadata.options == {}
    assert result.episodes == protocol.evaluate("zero", TASK, episodes=1).episodes


def test_a_dataset_says_it_too_and_is_simulated_again_with_it(tmp_path: Path) -> None:
    words = ["record", "--task", TASK, "--episodes", "2", "--start", "near_goal", *WORDS]
    assert run([*words, "--out", str(tmp_path / "data")]) == 0
    origin = tmp_path / "data" / "hvs.json"
    content = json.loads(origin.read_text())
    assert content["options"] == {**OPTIONS, "start": "near_goal"}
    assert not check_dataset(tmp_path / "data").damage
    origin.write_text(json.dumps({**content, "options": {**OPTIONS, "start": "zero"}}))
    assert check_dataset(tmp_path / "data").damage


def test_whoever_serves_a_policy_learns_how_the_task_was_changed() -> None:
    with load(TASK, **OPTIONS) as env:
        message = hello(TASK, env)
    assert message["options"] == OPTIONS
    _, context = policy_session.served("servo", TASK, message)
    assert (context.spec.marker, context.spec.ring_m) == ("ring", (0.45, 0.7))
