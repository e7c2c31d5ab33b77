"""Comparisons pair scenarios, and say no more than the numbers do; imports stay unverified."""

import json
from pathlib import Path
from typing import Any

import pytest
from test_result_file import make_result, row

from hvs_suite.cli import main
from hvs_suite.errors import OptionError, ResultError, UnknownTaskError
from hvs_suite.eval.scoring import comparison, lerobot_import, result_file
from hvs_suite.eval.scoring.result_file import Result, Summary
from hvs_suite.registry import find


def save(path: Path, name: str, solved: list[bool], **changes: Any) -> Path:
    result = make_result()
    metadata = result.metadata.model_copy(update={"n_logged": len(solved)} | changes)
    rows = [
        row(
            i,
            success=won,
            error=1.0 + i % 3,
            n_clipped=0,
            steps=10,
            steps_to_goal=10 if won else None,
        )
        for i, won in enumerate(solved)
    ]
    summary = Summary.of(
        "align-easy",
        name,
        "test",
        rows,
        tolerances=metadata.tolerances,
        time_limit_steps=20,
    )
    made = Result(
        schema_version=result_file.SCHEMA_VERSION,
        summary=summary,
        metadata=metadata,
        timings=result.timings,
        episodes=rows,
    )
    result_file.write(made, path)
    return path


def test_a_clear_difference_is_called_one(tmp_path: Path) -> None:
    a = save(tmp_path / "a.json", "good", [True] * 40)
    b = save(tmp_path / "b.json", "poor", [i < 25 for i in range(40)])
    found = comparison.compare(a, b)
    assert (found.n_both, found.n_only_a, found.n_only_b, found.n_neither) == (25, 15, 0, 0)
    assert found.p == pytest.approx(2**-14)
    assert found.success.estimate == pytest.approx(37.5)
    assert found.conclusion().startswith("good succeeds more often than poor: good solves 40")
    assert comparison.compare(b, a).conclusion().startswith("good succeeds more often than poor")
    assert found.steps_to_goal is not None
    assert found.steps_to_goal.n == 25
    # By the task's headline metrics, and no others.
    assert list(found.settled) == list(find("align-easy").headline)
    assert all(difference.high < 0.0 for difference in found.settled.values())


def test_what_chance_explains_is_not_called_a_difference(tmp_path: Path) -> None:
    a = save(tmp_path / "a.json", "one", [i % 5 > 0 for i in range(40)])
    b = save(tmp_path / "b.json", "two", [i % 4 > 0 for i in range(40)])
    assert comparison.compare(a, b).conclusion().startswith("These scenarios do not tell")
    same = comparison.compare(a, a)
    assert same.conclusion().startswith("No difference in success shows")
    assert same.a == "one (A)"


def test_only_scenarios_that_both_played_count(tmp_path: Path) -> None:
    a = save(tmp_path / "a.json", "one", [True] * 10)
    b = save(tmp_path / "b.json", "two", [True] * 4)
    assert comparison.compare(a, b).n == 4


def test_results_of_different_tasks_are_not_compared(tmp_path: Path) -> None:
    a = save(tmp_path / "a.json", "one", [True])
    b = save(tmp_path / "b.json", "two", [True], task_digest="other")
    with pytest.raises(ResultError, match="task_digest"):
        comparison.compare(a, b)


def test_the_command_prints_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = save(tmp_path / "a.json", "one", [True] * 4)
    b = save(tmp_path / "b.json", "two", [False] * 4)
    assert main.run(["compare", str(a), str(b)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("These scenarios do not tell")
    assert main.run(["compare", str(a), str(b), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["n_only_a"] == 4
    assert main.run(["compare", str(a), str(tmp_path / "none.json")]) == 2


def eval_info(successes: list[bool], claimed: float | None = None) -> dict[str, Any]:
    rate = 100 * sum(successes) / len(successes) if claimed is None else claimed
    return {
        "per_task": [
            {
                "task_group": "hvs",
                "task_id": 0,
                "metrics": {
                    "sum_rewards": [float(s) for s in successes],
                    "max_rewards": [float(s) for s in successes],
                    "successes": successes,
                    "video_paths": [],
                },
            }
        ],
        "overall": {"pc_success": rate, "n_episodes": len(successes), "eval_s": 1.0},
    }


def test_an_imported_file_is_compared_but_never_verified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "eval_info.json", tmp_path / "act.json"
    source.write_text(json.dumps(eval_info([True, True, False, True])))
    words = f"import-lerobot {source} --task align-easy --policy act --out {out}"
    assert main.run(words.split()) == 0
    content = json.loads(out.read_text())
    assert content["verified"] is False
    assert content["summary"]["pc_success"] == 75.0
    # Seeds count up from 1000, which on the test split is scenario 0.
    assert [row["scenario"] for row in content["episodes"]] == [0, 1, 2, 3]
    ours = save(tmp_path / "b.json", "ours", [True] * 4)
    found = comparison.compare(out, ours)
    assert found.n_only_b == 1
    assert found.settled == {}
    assert "unverified" in found.conclusion()
    assert main.run(["verify", str(out)]) == 1


def test_the_older_layout_of_the_file_is_read_too(tmp_path: Path) -> None:
    path = tmp_path / "eval_info.json"
    rows = [{"success": s, "sum_reward": 0.0, "max_reward": 0.0, "seed": 7} for s in (True, False)]
    path.write_text(json.dumps({"per_episode": rows, "aggregated": {"pc_success": 50.0}}))
    result = lerobot_import.read(path, task="align-easy", policy="act", seed=1998)
    assert [row.scenario for row in result.episodes] == [998, 999]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("[1", "is not JSON"),
        ("[1]", "holds list, not an object"),
        ('{"per_episode": [null], "aggregated": {"pc_success": 0}}', "is no eval_info.json"),
        (json.dumps(eval_info([True])).replace("1.0", "1e999", 1), "sum_rewards.0: .* finite"),
        (json.dumps(eval_info([True])).replace("[1.0]", "[]", 1), "do not belong together"),
        ('{"per_task": 3}', "is no eval_info.json"),
        (json.dumps(eval_info([True, False]) | {"overall": None}), "is no eval_info.json"),
        ("{}", "is no eval_info.json"),
        (json.dumps(eval_info([True, False], claimed=100.0)), "pc_success is 100"),
        (json.dumps(eval_info([True] * 1001)), "a scenario twice"),
    ],
)
def test_what_cannot_be_true_is_not_imported(content: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "eval_info.json"
    path.write_text(content)
    with pytest.raises(ResultError, match=reason):
        lerobot_import.read(path, task="align-easy", policy="act")


def test_a_negative_seed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "eval_info.json"
    path.write_text(json.dumps(eval_info([True])))
    with pytest.raises(OptionError, match="a seed is"):
        lerobot_import.read(path, task="align-easy", policy="act", split="train", seed=-1)


def test_a_task_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownTaskError):
        lerobot_import.read(tmp_path / "eval_info.json", task="align-eazy", policy="act")
