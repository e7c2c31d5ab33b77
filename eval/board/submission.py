"""The rules for a place on the board, checked by machine; ``eval/SUBMITTING.md`` explains them.

``hvs verify --submission`` and ``hvs leaderboard`` both go by `check`.
"""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from hvs_suite.errors import ResultError
from hvs_suite.eval.board import ours
from hvs_suite.eval.scoring import action_log, result_file
from hvs_suite.eval.scoring.action_log import Actions
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.eval.scoring.verification import check_as_named, check_task, load_actions
from hvs_suite.names import check_name, look_alike
from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT

# Its ten places come round again after ten scenarios.
EPISODES: Mapping[str, int] = {"align-fixed": 10}
NEEDED_PACKAGES = ("python", "mujoco", "dm-control", "numpy")
MOST_ALIKE = 0.25
"""Share of scenarios in which two policies may do the same; two of ours do in one of twenty."""


@dataclasses.dataclass(frozen=True, eq=False)
class Submission:
    """A result that is submitted to the board.

    Attributes:
        path: ``<results>/<policy>/<task>.json``.
        result: What it holds.
        executed: Its actions up to where each scenario was scored, as `action_log.executed` gives
            them.
    """

    path: Path
    result: Result
    executed: Actions


def check(
    results: Path, paths: Iterable[Path] | None = None, *, draft: bool = False
) -> list[Submission]:
    """Checks results against the rules, and against all other results in the folder.

    Args:
        results: Folder that holds ``<policy>/<task>.json``.
        paths: Those of them that are new or changed; all by default.
        draft: Accept what is not a score yet: fewer scenarios, another split, incomplete metadata,
            and results of the suite's own policies that other people made.

    Returns:
        The checked results by path; re-simulating them is `verification.verify`'s.

    Raises:
        ResultError: A rule is broken, or there are no results; names file and rule.
        UnknownTaskError: A result names a task that does not exist.
    """
    files = _files_in(results)
    wanted = {path.resolve() for path in files} if paths is None else {p.resolve() for p in paths}
    for path in wanted - {path.resolve() for path in files}:
        raise ResultError(f"{path}: a submission lies as {results}/<policy>/<task>.json")
    tasks = {path.stem for path in wanted}
    folders = {path.parent.name for path in files}
    submissions: list[Submission] = []
    standing: list[Submission] = []
    # Only results of one task are ever held against each other.
    for path in (path for path in files if path.stem in tasks):
        result = result_file.load(path)
        if path.resolve() in wanted:
            _check_alone(path, result, results, draft=draft)
            _check_passes_for_nobody(path, folders)
        log = load_actions(path, result)
        scored = [actions[: row.steps] for actions, row in zip(log, result.episodes, strict=False)]
        entry = Submission(
            path, result, action_log.executed(scored, result.metadata.time_limit_steps)
        )
        for other in standing:
            if path.resolve() in wanted:
                _check_pair(entry, other)
            elif other in submissions:
                _check_pair(other, entry)
        standing.append(entry)
        if path.resolve() in wanted:
            submissions.append(entry)
    return submissions


def _files_in(results: Path) -> list[Path]:
    """Returns the results below a folder.

    Raises:
        ResultError: There is none, or there is a link: what it leads to may change, or be no part
            of the submission.
    """
    found = []
    for folder, folders, names in os.walk(results):
        for name in (*folders, *names):
            path = Path(folder, name)
            if path.is_symlink():
                raise ResultError(f"{path}: is a symbolic link; put the file itself there")
        found += [Path(folder, name) for name in names if name.endswith(".json")]
    if not found:
        raise ResultError(
            f"there are no results below {results}; make one with 'hvs evaluate ... --out "
            f"{results}/<policy>/<task>.json'"
        )
    return sorted(found)


def _check_alone(path: Path, result: Result, results: Path, *, draft: bool) -> None:
    """Checks what a result says of itself.

    Raises:
        ResultError: A rule is broken.
    """
    check_name(path.parent.name, f"{path}: the folder's name", error=ResultError)
    check_name(result.summary.policy, f"{path}: summary.policy", error=ResultError)
    _check_place(path, result, results)
    check_as_named(path, result)
    check_task(path, result)
    if not draft:
        _check_score(path, result)
        _check_metadata(path, result)
        ours.check(path, result)


def _check_passes_for_nobody(path: Path, folders: set[str]) -> None:
    """Checks that a name does not look like another one in letters of another alphabet.

    Raises:
        ResultError: It is.
    """
    name = path.parent.name
    twin = None if name.isascii() else look_alike(name, sorted(folders - {name}))
    if twin is not None:
        raise ResultError(f"{path}: {name!r} passes for {twin!r}; choose another name")


def _check_place(path: Path, result: Result, results: Path) -> None:
    """Checks that a result lies where its policy and task say.

    Raises:
        ResultError: It does not.
    """
    summary = result.summary
    if len(path.relative_to(results).parts) != 2:
        raise ResultError(f"{path}: results lie as {results}/<policy>/<task>.json")
    if path.stem != summary.task:
        raise ResultError(f"{path}: holds a result of {summary.task}; name it {summary.task}.json")


def _check_pair(entry: Submission, other: Submission) -> None:
    """Checks that two results can stand on one board.

    Raises:
        ResultError: Both are of one task, and of another version or split of it, or are one result
            twice, be it with other roundings or under another name. Outcomes follow from actions,
            which is what `verification.verify` proves; so it is the actions that are compared.
    """
    mine, theirs = entry.result, other.result
    if mine.summary.task != theirs.summary.task:
        return
    for name in ("task_version", "task_digest"):
        if getattr(mine.metadata, name) != getattr(theirs.metadata, name):
            raise ResultError(
                f"{entry.path}: {name} differs from {other.path}; one board holds one version"
            )
    if mine.summary.split != theirs.summary.split:
        raise ResultError(
            f"{entry.path}: split is {mine.summary.split!r}, but {theirs.summary.split!r} in "
            f"{other.path}; evaluate both on the same split"
        )
    same_policy = (mine.summary.policy, mine.metadata.policy_hash) == (
        theirs.summary.policy,
        theirs.metadata.policy_hash,
    )
    if same_policy or mine.metadata.actions_sha256 == theirs.metadata.actions_sha256:
        raise ResultError(f"{entry.path}: duplicate of {other.path}; remove one")
    # `push` and `servo` go the same way until the peg lands.
    if all(ours.is_shipped(each.path, each.result) for each in (entry, other)):
        return
    alike = action_log.share_alike(entry.executed, other.executed)
    if alike > MOST_ALIKE:
        raise ResultError(
            f"{entry.path}: duplicate of {other.path}: the same actions but for rounding in "
            f"{100 * alike:.0f} % of the scenarios; remove one"
        )


def _check_score(path: Path, result: Result) -> None:
    summary = result.summary
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


def _check_metadata(path: Path, result: Result) -> None:
    metadata = result.metadata
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
