"""The rules for a place on the board, checked by machine; ``eval/SUBMITTING.md`` explains them."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path

from hvs_suite.errors import ResultError
from hvs_suite.eval import result_file
from hvs_suite.eval.result_file import Result
from hvs_suite.eval.verification import check_task
from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT

# Its ten places come round again after ten scenarios.
EPISODES: Mapping[str, int] = {"align-fixed": 10}
NEEDED_PACKAGES = ("python", "mujoco", "dm-control", "numpy")


@dataclasses.dataclass(frozen=True)
class Submission:
    """A result that wants to stand on the board.

    Attributes:
        path: ``<results>/<policy>/<task>.json``.
        result: What it holds.
    """

    path: Path
    result: Result


def check(paths: Iterable[Path], results: Path) -> list[Submission]:
    """Holds results against the rules, and against everything that stands in the folder.

    Args:
        paths: Results that are new or changed; all lie below `results`.
        results: Folder that holds ``<policy>/<task>.json``.

    Returns:
        The checked results; re-simulating them is `verification.verify`'s.

    Raises:
        ResultError: A rule is broken; names file and rule.
        UnknownTaskError: A result names a task that does not exist.
    """
    wanted = {path.resolve() for path in paths}
    for path in wanted:
        if not path.is_relative_to(results.resolve()):
            raise ResultError(f"{path}: a submission lies as {results}/<policy>/<task>.json")
    standing = [
        Submission(path, result_file.load(path)) for path in sorted(results.rglob("*.json"))
    ]
    submissions = [entry for entry in standing if entry.path.resolve() in wanted]
    for entry in submissions:
        check_place(entry, results)
        _check_score(entry)
        check_task(entry.path, entry.result)
        _check_metadata(entry)
        for other in standing:
            if other is not entry:
                check_pair(entry, other)
    return submissions


def check_place(entry: Submission, results: Path) -> None:
    """Checks that a result lies where its policy and task say.

    Raises:
        ResultError: It does not.
    """
    path, summary = entry.path, entry.result.summary
    if len(path.relative_to(results).parts) != 2:
        raise ResultError(f"{path}: results lie as {results}/<policy>/<task>.json")
    if path.stem != summary.task:
        raise ResultError(f"{path}: holds a result of {summary.task}; name it {summary.task}.json")


def check_pair(entry: Submission, other: Submission) -> None:
    """Checks that two results can stand on one board.

    Raises:
        ResultError: Both are of one task, and of another version or split of it, or are one result
            twice.
    """
    ours, theirs = entry.result, other.result
    if ours.summary.task != theirs.summary.task:
        return
    for name in ("task_version", "task_digest"):
        if getattr(ours.metadata, name) != getattr(theirs.metadata, name):
            raise ResultError(
                f"{entry.path}: {name} differs from {other.path}; one board holds one version"
            )
    if ours.summary.split != theirs.summary.split:
        raise ResultError(
            f"{entry.path}: split is {ours.summary.split!r}, but {theirs.summary.split!r} in "
            f"{other.path}; evaluate both on the same split"
        )
    same_policy = (ours.summary.policy, ours.metadata.policy_hash) == (
        theirs.summary.policy,
        theirs.metadata.policy_hash,
    )
    if same_policy or ours.metadata.actions_sha256 == theirs.metadata.actions_sha256:
        raise ResultError(f"{entry.path}: duplicate of {other.path}; remove one")


def _check_score(entry: Submission) -> None:
    path, summary = entry.path, entry.result.summary
    if summary.split != TEST_SPLIT:
        raise ResultError(
            f"{path}: split is {summary.split!r}; a score is played on {TEST_SPLIT!r}"
        )
    needed = EPISODES.get(summary.task, TEST_SCENARIOS)
    if summary.n_episodes != needed:
        raise ResultError(
            f"{path}: holds {summary.n_episodes} scenarios; a score of {summary.task} takes "
            f"{needed}"
        )


def _check_metadata(entry: Submission) -> None:
    path, metadata = entry.path, entry.result.metadata
    missing = [name for name in NEEDED_PACKAGES if name not in metadata.packages]
    if not metadata.gl_renderer:
        missing.append("gl_renderer")
    if metadata.policy_kind != "builtin" and not metadata.policy_hash:
        missing.append("policy_hash")
    for name in ("created", "suite_version", "cpu", "platform"):
        if not getattr(metadata, name).strip():
            missing.append(name)
    if missing:
        raise ResultError(f"{path}: metadata lacks {', '.join(missing)}; evaluate again")
