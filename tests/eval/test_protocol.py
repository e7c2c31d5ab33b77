"""Scoring: same rows for any number of workers, and bad input refused before any work."""

import json
from pathlib import Path

import pytest

from hvs_suite.cli import main
from hvs_suite.errors import OptionError, PolicyError, ScenarioError, UnknownTaskError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import result_file
from hvs_suite.registry import TASKS


def test_zero_ends_after_exactly_the_number_of_steps_of_the_task() -> None:
    result = protocol.evaluate("zero", "align-thesis", episodes=2)
    limit = TASKS["align-thesis"].time_limit_steps
    assert [row.steps for row in result.episodes] == [limit, limit]
    assert all(row.truncated and not row.success for row in result.episodes)
    assert result.summary.n_clipped == 0


def test_the_expert_solves_what_it_is_given() -> None:
    result = protocol.evaluate("expert", "align-easy", episodes=2)
    assert result.summary.pc_success == 100.0
    assert result.summary.errors["position_error_mm"].p95 < 5.0


@pytest.mark.parametrize("policy", ["random", "expert"])
def test_one_and_two_workers_write_the_same_rows(policy: str, tmp_path: Path) -> None:
    written = []
    for workers in (1, 2):
        path = tmp_path / f"{workers}.json"
        protocol.evaluate(policy, "align-thesis", path, episodes=3, workers=workers)
        content = path.read_text()
        log = result_file.actions_path(path).read_bytes()
        rows = content[content.index('"episodes"') :]
        written.append((rows, json.loads(content)["summary"], log))
    assert written[0] == written[1]


def test_random_differs_from_scenario_to_scenario_and_not_from_run_to_run() -> None:
    one = protocol.evaluate("random", "align-thesis", episodes=2)
    two = protocol.evaluate("random", "align-thesis", episodes=2)
    assert one.episodes == two.episodes
    assert one.episodes[0].errors != one.episodes[1].errors


def test_metadata_tells_what_was_run_but_not_who_ran_it() -> None:
    result = protocol.evaluate("zero", "align-fixed", split="train", episodes=1)
    assert result.summary.split == "train"
    assert result.metadata.task_version == TASKS["align-fixed"].version
    assert result.metadata.packages["python"].startswith("3.")
    assert result.metadata.gl_renderer
    assert result.metadata.policy_hash is None
    assert str(Path.home()) not in result.model_dump_json()


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"task": "align-eazy"}, UnknownTaskError),
        ({"policy": "nobody"}, PolicyError),
        ({"episodes": 0}, OptionError),
        ({"episodes": 1001}, ScenarioError),
        ({"workers": 0}, OptionError),
        ({"decision_limit_s": 0.0}, OptionError),
        ({"decision_limit_s": -1.0}, OptionError),
        ({"decision_limit_s": float("inf")}, OptionError),
        ({"decision_limit_s": float("nan")}, OptionError),
        ({"decision_limit_s": 1e300}, OptionError),
        ({"split": ""}, ScenarioError),
    ],
)
def test_bad_input_is_refused(change: dict[str, object], error: type[Exception]) -> None:
    good: dict[str, object] = {"policy": "zero", "task": "align-easy", "episodes": 1}
    with pytest.raises(error):
        protocol.evaluate(**(good | change))  # type: ignore[arg-type]


def test_the_command_writes_the_file_and_exits_0_whatever_the_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "made" / "zero.json"
    words = f"evaluate --policy zero --task align-easy --split test --episodes 1 --out {path}"
    assert main.run(words.split()) == 0
    assert result_file.load(path).summary.n_success == 0
    assert "0 of 1 (0.0 %)" in capsys.readouterr().out


def test_an_unwritable_output_is_found_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(protocol, "evaluate", lambda *_, **__: pytest.fail("it ran"))
    words = f"evaluate --policy zero --task align-easy --out {tmp_path}/file/zero.json"
    assert main.run(words.split()) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    "words",
    [
        "--policy zero --task align-eazy",
        "--policy nobody --task align-easy",
        "--policy zero --task align-easy --episodes 1001",
        "--policy zero --task align-easy --workers 0",
        "--policy zero --task align-easy --decision-limit inf",
        "--policy zero --task align-easy --decision-limit 1e300",
        "--policy zero --task align-easy --decision-limit nan --server ws://127.0.0.1:1",
        "--policy zero --task align-easy --task align-easy",
        "--policy zero",
    ],
)
def test_the_command_answers_bad_input_with_one_line_and_exit_2(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "out.json"
    assert main.run(["evaluate", *words.split(), "--out", str(path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not path.exists()


def test_the_board_command_builds_and_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["leaderboard", "--results", str(tmp_path / "results"), "--out", str(tmp_path)]
    assert main.run(words) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
