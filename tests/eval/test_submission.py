"""Whoever wants a place on the board keeps its rules; every committed result does."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from hvs_suite.cli import main
from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol, result_file, submission, verification

RESULTS = Path(__file__).parents[2] / "eval" / "results"
COMMITTED = sorted(RESULTS.rglob("*.json"))
SAMPLE = 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "results"
    for policy in ("expert", "zero"):
        protocol.evaluate(policy, "align-fixed", folder / policy / "align-fixed.json", episodes=10)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "results")
    return tmp_path / "results"


def alter(path: Path, **metadata: Any) -> None:
    result = result_file.load(path)
    changed = result.metadata.model_copy(update=metadata)
    result_file.write(result.model_copy(update={"metadata": changed}), path)


def test_an_honest_submission_is_accepted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["verify", "--submission", "--results", str(folder), "--sample", "2"]
    assert main.run([*words, str(folder / "expert")]) == 0
    assert "2 of 10 scenarios played again" in capsys.readouterr().out


def duplicate(folder: Path) -> str:
    shutil.copytree(folder / "expert", folder / "mine")
    return "duplicate of"


def stolen_actions(folder: Path) -> str:
    shutil.copytree(folder / "expert", folder / "mine")
    path = folder / "mine" / "align-fixed.json"
    alter(path, policy_hash="mine")
    return "duplicate of"


def another_version(folder: Path) -> str:
    alter(folder / "zero" / "align-fixed.json", task_version=2)
    return "task_version"


def no_renderer(folder: Path) -> str:
    alter(folder / "expert" / "align-fixed.json", gl_renderer=None)
    return "metadata lacks gl_renderer"


def no_hash(folder: Path) -> str:
    alter(folder / "expert" / "align-fixed.json", policy_kind="module")
    return "metadata lacks policy_hash"


def no_packages(folder: Path) -> str:
    alter(folder / "expert" / "align-fixed.json", packages={"python": "3.12"})
    return "metadata lacks mujoco, dm-control, numpy"


def another_name(folder: Path) -> str:
    path = folder / "expert" / "align-fixed.json"
    path.rename(path.with_name("align-easy.json"))
    return "name it align-fixed.json"


def too_deep(folder: Path) -> str:
    shutil.move(folder / "expert", folder / "zero" / "expert")
    return "results lie as"


def too_few(folder: Path) -> str:
    path = folder / "expert" / "align-fixed.json"
    protocol.evaluate("expert", "align-fixed", path, episodes=1)
    return "holds 1 scenarios"


def another_split(folder: Path) -> str:
    path = folder / "expert" / "align-fixed.json"
    protocol.evaluate("zero", "align-fixed", path, split="train", episodes=10)
    return "a score is played on 'test'"


@pytest.mark.parametrize(
    "break_rule",
    [
        duplicate,
        stolen_actions,
        another_version,
        no_renderer,
        no_hash,
        no_packages,
        another_name,
        too_deep,
        too_few,
        another_split,
    ],
)
def test_a_submission_that_breaks_a_rule_is_refused(
    break_rule: Any, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = break_rule(folder)
    with pytest.raises(ResultError, match=reason):
        submission.check(folder.rglob("*.json"), folder)
    assert main.run(["verify", "--submission", "--results", str(folder), str(folder)]) == 1


def test_a_submission_elsewhere_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="a submission lies as"):
        submission.check([folder / "zero" / "align-fixed.json"], tmp_path / "other")


def test_the_committed_results_keep_the_rules() -> None:
    submission.check(COMMITTED, RESULTS)


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_committed_result_comes_out_again_when_its_actions_are_played(path: Path) -> None:
    assert verification.verify(path, sample=SAMPLE).n_played == SAMPLE
