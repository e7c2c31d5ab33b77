"""Whoever wants a place on the board keeps its rules; every committed result does."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forgeries import rewrite, with_log

from hvs_suite.cli import main
from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol
from hvs_suite.eval.board import ours, submission
from hvs_suite.eval.scoring import action_log, result_file, verification

RESULTS = Path(__file__).parents[2] / "eval" / "results"
COMMITTED = sorted(RESULTS.rglob("*.json"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two of the suite's own results, as they are committed."""
    for policy in ("expert", "zero"):
        copy = tmp_path / "results" / policy
        copy.mkdir(parents=True)
        for name in ("align-fixed.json", "align-fixed.actions.npz"):
            shutil.copy(RESULTS / policy / name, copy / name)
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
    made_to_wander(folder)
    shutil.copytree(folder / "mine", folder / "mine-too")
    return "duplicate of"


def stolen_actions(folder: Path) -> str:
    return copied(folder, lambda actions: actions)


def copied(folder: Path, change: Callable[[Any], Any], policy: str = "expert") -> str:
    """Another policy's actions, a little otherwise, under a name of one's own."""
    path = folder / "mine" / "align-fixed.json"
    shutil.copytree(folder / policy, folder / "mine")
    log = action_log.load(
        result_file.actions_path(path), result_file.load(path).metadata.actions_sha256
    )
    with_log(path, [change(actions) for actions in log], lambda row: row)
    return "duplicate of"


def shifted_by_a_rounding(folder: Path) -> str:
    return copied(folder, lambda actions: np.nextafter(actions, np.float32(1)))


def shifted_out_of_range(folder: Path) -> str:
    return copied(folder, lambda actions: np.where(np.abs(actions) >= 1, 2 * actions, actions))


def a_step_of_its_own(folder: Path) -> str:
    return copied(folder, lambda actions: np.concatenate([actions[:-1], -actions[-1:]]))


def its_own_once_the_goal_is_held(folder: Path) -> str:
    # The expert takes up to 14 of the 20 steps; what it did later gave no score.
    return copied(folder, lambda actions: np.concatenate([actions[:14], actions[14:] + 0.01]))


def stored_uncompressed(folder: Path) -> str:
    copied(folder, lambda actions: actions)
    path = folder / "mine" / "align-fixed.json"
    log = result_file.actions_path(path)
    with np.load(log) as content:
        np.savez(log, **content)
    rewrite(path, lambda row: row, actions_sha256=action_log.digest(log))
    return "duplicate of"


def made_to_wander(folder: Path) -> None:
    """A result of one's own: zero's, its actions far from anybody's."""
    copied(folder, lambda actions: actions + np.float32(0.3), "zero")


def calls_itself_builtin(folder: Path) -> str:
    made_to_wander(folder)
    alter(folder / "mine" / "align-fixed.json", policy_kind="builtin")
    return "'mine' is no built-in policy"


def calls_itself(name: str) -> Callable[[Path], str]:
    def call(folder: Path) -> str:
        made_to_wander(folder)
        path = folder / "mine" / "align-fixed.json"
        result = result_file.load(path)
        summary = result.summary.model_copy(update={"policy": name})
        result_file.write(result.model_copy(update={"summary": summary}), path)
        return "is a policy of the suite" if name.isascii() else "passes for 'expert'"

    return call


def bears(name: str) -> Callable[[Path], str]:
    def bear(folder: Path) -> str:
        made_to_wander(folder)
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / "mine").rename(folder / name)
        return "is a policy of the suite" if name == "expert" else f"'{name}' passes for 'expert'"

    return bear


def bears_another_s_name(folder: Path) -> str:
    made_to_wander(folder)
    (folder / "mine").rename(folder / "robo")
    shutil.copytree(folder / "robo", folder / "r\u043ebo")
    return "passes for"


def the_experts_own_elsewhere(folder: Path) -> str:
    (folder / "expert").rename(folder / "mine")
    return "lies in the folder expert"


def a_link(folder: Path) -> str:
    (folder / "zero").rename(folder.with_name("elsewhere"))
    os.symlink(folder.with_name("elsewhere"), folder / "zero")
    return "zero: is a symbolic link"


def a_linked_log(folder: Path) -> str:
    log = folder / "zero" / "align-fixed.actions.npz"
    log.rename(folder.with_name("elsewhere.npz"))
    os.symlink(folder.with_name("elsewhere.npz"), log)
    return "is a symbolic link"


def a_hidden_name(folder: Path) -> str:
    made_to_wander(folder)
    (folder / "mine").rename(folder / "mi\u200bne")
    return r"holds U\+200B"


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
        shifted_by_a_rounding,
        shifted_out_of_range,
        a_step_of_its_own,
        its_own_once_the_goal_is_held,
        stored_uncompressed,
        calls_itself_builtin,
        calls_itself("expert"),
        calls_itself("finetuned"),
        calls_itself("\u0435xpert"),
        bears("expert"),
        bears("Expert"),
        bears("e\u0445pert"),
        bears("e\u00d7pert"),
        bears_another_s_name,
        the_experts_own_elsewhere,
        a_link,
        a_linked_log,
        a_hidden_name,
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
        submission.check(folder)
    assert main.run(["verify", "--submission", "--results", str(folder), str(folder)]) == 1


def test_a_policy_of_one_s_own_is_accepted(folder: Path) -> None:
    made_to_wander(folder)
    paths = [folder / "mine" / "align-fixed.json"]
    assert [entry.path for entry in submission.check(folder, paths)] == paths


def test_a_submission_elsewhere_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="a submission lies as"):
        submission.check(folder, [tmp_path / "other" / "align-fixed.json"])


def test_the_committed_results_keep_the_rules() -> None:
    submission.check(RESULTS)
    assert ours.shipped() == ours.found(RESULTS)


@pytest.mark.parametrize("sample", [1, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_committed_result_comes_out_again_when_its_actions_are_played(
    path: Path, sample: int
) -> None:
    assert verification.verify(path, sample=sample).n_played == sample
