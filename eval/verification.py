"""Plays a result's logged actions again, without pictures, and recomputes every number.

What the actions did is thereby proven; that a certain policy chose them is not, and versions of
packages are believed. A policy's failures (NaN, too slow) are believed too: they only ever cost it
an episode.
"""

import contextlib
import dataclasses
import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hvs_suite import registry, rollout
from hvs_suite.errors import OptionError, ResultError
from hvs_suite.eval import action_log, result_file
from hvs_suite.eval.protocol import MakeTask
from hvs_suite.eval.result_file import EpisodeRow, Result
from hvs_suite.eval.trial import (
    NEAR_DEG,
    NEAR_MM,
    EpisodeLostError,
    Stage,
    play_trial,
)
from hvs_suite.policies import builtin
from hvs_suite.rollout import Action, Observation
from hvs_suite.tasks.shared import lock

LOG_ENDS = "the action log ends"
_OUTCOME = (
    "success",
    "success_once",
    "collision",
    "truncated",
    "steps",
    "steps_to_goal",
    "n_clipped",
    "failure",
    "settled_steps",
    "settled_collision",
    "settled_failure",
)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What verifying a result found, if it found nothing wrong.

    Attributes:
        n_episodes: Scenarios of the result.
        n_played: Those that were played again.
        n_near: Those of them whose outcome differs, a rounding away from a tolerance.
        largest_mm: Largest difference of a position error (mm).
        largest_deg: Largest difference of a tilt error (deg).
    """

    n_episodes: int
    n_played: int
    n_near: int
    largest_mm: float
    largest_deg: float


@dataclasses.dataclass(frozen=True, eq=False)
class ReplayTrial:
    """Plays a scenario's logged actions, for `rollout.play`.

    Attributes:
        actions: (steps, 7) of each scenario.
        failures: Why the policy had no further action, by scenario; None where it had.
    """

    actions: Mapping[int, Action]
    failures: Mapping[int, str | None]

    def __call__(
        self, env: Stage, policy: rollout.Policy, scenario: int
    ) -> tuple[EpisodeRow, float]:
        """Returns the row that the actions give, and its nearness as in `Trial`."""
        remaining = iter(self.actions[scenario])

        def decide(observation: Observation) -> Action:
            action = next(remaining, None)
            if action is None:
                raise EpisodeLostError(self.failures[scenario] or LOG_ENDS)
            return action

        row, _, nearness = play_trial(env, lambda: None, decide, scenario)
        return row, nearness


def verify(
    path: Path,
    *,
    sample: int | None = None,
    workers: int = 1,
    progress: Callable[[], None] | None = None,
) -> Verdict:
    """Checks a result file against its action log and the task.

    Args:
        path: The result; its action log stands beside it.
        sample: Scenarios to play again, drawn by the file's own hash; None plays all.
        workers: Processes that share the work.
        progress: Called after each scenario.

    Returns:
        What was checked.

    Raises:
        ResultError: Something is not as the file says; names it.
        UnknownTaskError: The result's task does not exist.
        OptionError: `sample` or `workers` is below 1.
    """
    if sample is not None and sample < 1:
        raise OptionError(f"a sample holds at least 1 scenario, not {sample}")
    result = result_file.load(path)
    check_task(path, result)
    log = action_log.load(result_file.actions_path(path), result.metadata.actions_sha256)
    rows = result.episodes
    if len(log) != len(rows):
        raise ResultError(
            f"{path}: the action log holds {len(log)} scenarios, the result {len(rows)}"
        )
    for row, actions in zip(rows, log, strict=True):
        if len(actions) != row.settled_steps:
            raise ResultError(
                f"{path}: scenario {row.scenario}: settled_steps is {row.settled_steps}, but "
                f"{len(actions)} actions are logged"
            )
    chosen = drawn(path, len(rows), sample)
    replay = ReplayTrial(
        {index: log[index] for index in chosen},
        {index: rows[index].settled_failure for index in chosen},
    )
    task = MakeTask(result.summary.task, result.summary.split, pictures=False)
    n_near, largest = 0, {"mm": 0.0, "deg": 0.0}
    with contextlib.closing(
        rollout.play(task, builtin.make_zero, chosen, replay, workers=workers)
    ) as played:
        for row, nearness in played:
            n_near += _compare(path, rows[row.scenario], row, nearness, largest)
            if progress is not None:
                progress()
    return Verdict(len(rows), len(chosen), n_near, largest["mm"], largest["deg"])


def check_task(path: Path, result: Result) -> None:
    """Checks that a result was made on the task as its name means it here.

    Raises:
        ResultError: It was not.
        UnknownTaskError: There is no such task.
    """
    variant = registry.find(result.summary.task)
    ours, metadata = result.summary.task, result.metadata
    if metadata.options:
        options = ", ".join(sorted(metadata.options))
        raise ResultError(
            f"{path}: the task was changed ({options}); only the task as named is scored"
        )
    for name, said, known in (
        ("task_version", metadata.task_version, variant.version),
        ("task_digest", metadata.task_digest, lock.digest(ours)),
        ("tolerances", metadata.tolerances, variant.tolerances),
        ("time_limit_steps", metadata.time_limit_steps, variant.time_limit_steps),
    ):
        if said != known:
            raise ResultError(
                f"{path}: {name} is {said}, but {known} for {ours} in this hvs_suite; evaluate "
                "again, or check with the version that made it"
            )


def drawn(path: Path, n: int, sample: int | None) -> list[int]:
    """Returns the scenarios to play again: all of 0..n-1, or a sample drawn by the file's hash."""
    if sample is None or sample >= n:
        return list(range(n))
    key = int.from_bytes(hashlib.sha256(path.read_bytes()).digest()[:16], "little")
    random = np.random.Generator(np.random.Philox(key=key))
    return sorted(random.choice(n, size=sample, replace=False).tolist())


def _compare(
    path: Path, said: EpisodeRow, found: EpisodeRow, nearness: float, largest: dict[str, float]
) -> bool:
    """Compares a row with the one played again; returns whether rounding decided its outcome.

    Raises:
        ResultError: They differ by more than that.
    """
    where = f"{path}: scenario {said.scenario}"
    differs = [name for name in _OUTCOME if getattr(said, name) != getattr(found, name)]
    if differs and nearness > 1.0:
        name = differs[0]
        raise ResultError(
            f"{where}: {name} is {getattr(said, name)}, but the logged actions give "
            f"{getattr(found, name)}"
        )
    errors: Iterable[str] = [*(f"settled_{name}" for name in result_file.ERRORS)]
    errors = [*errors, "settled_x_mm", "settled_y_mm"]
    if not differs:
        # Another end of the episode has other errors, and rightly so.
        errors = [*result_file.ERRORS, *errors]
    for name in errors:
        unit, bound = ("deg", NEAR_DEG) if name.endswith("deg") else ("mm", NEAR_MM)
        ours, theirs = getattr(said, name), getattr(found, name)
        largest[unit] = max(largest[unit], abs(ours - theirs))
        # Both are rounded to a millionth, which may part them by one more.
        if not math.isclose(ours, theirs, rel_tol=0.0, abs_tol=bound + 2e-6):
            raise ResultError(
                f"{where}: {name} is {ours}, but the logged actions give {theirs} {unit}"
            )
    return bool(differs)


def results_in(paths: Sequence[Path]) -> list[Path]:
    """Returns the result files that are named or lie below the folders that are.

    Raises:
        OptionError: There is none, or a path does not exist.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise OptionError(f"{path} does not exist; name a result file or a folder of them")
        found += sorted(path.rglob("*.json")) if path.is_dir() else [path]
    if not found:
        raise OptionError("there are no results there; name a result file or a folder of them")
    return found


def as_json(path: Path, verdict: Verdict) -> dict[str, Any]:
    """Returns a verdict as plain data, for ``--json``."""
    return {"file": str(path), **dataclasses.asdict(verdict)}
