"""Plays a result's logged actions again, without pictures, and recomputes every number.

This proves what the actions did. It does not prove which policy chose them, nor the versions of
packages. A policy's failures (NaN, too slow) are not checked either, because they can only cost it
an episode.
"""

import contextlib
import dataclasses
import hashlib
import math
import os
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hvs_suite import registry, rollout
from hvs_suite.datasets.lerobot_files import INFO
from hvs_suite.errors import OptionError, PolicyError, ResultError
from hvs_suite.eval.scoring import action_log, contender, result_file
from hvs_suite.eval.scoring.comparison import Tally
from hvs_suite.eval.scoring.result_file import EpisodeRow, Result
from hvs_suite.eval.scoring.trial import (
    EpisodeLostError,
    MakeTask,
    Stage,
    outcome,
    play_trial,
    same_outcome,
)
from hvs_suite.executor import Workers
from hvs_suite.names import shown
from hvs_suite.policies import builtin, catalogue
from hvs_suite.rollout import Action, Observation
from hvs_suite.tasks.shared import lock
from hvs_suite.tasks.shared.option_types import listed

NEAR: Mapping[str, float] = {"mm": 0.01, "deg": 0.01}
"""Re-simulated metrics may differ by this much, by unit: another processor rounds differently, and
where a peg slides on a face that grows to 0.007 mm (docs/results.md)."""
NEAR_OTHERWISE = 1e-3
LOG_ENDS = "the action log ends"
MOST_NEAR_PER_MILLE = 5
"""Outcomes of a thousand that rounding may decide, at least one: far more than chance brings, and
too few to lift a score."""
LEAST_P = 0.01
"""McNemar's p, below which what a policy solves when it plays again is not what a file claims."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What verifying a result found, if it found nothing wrong.

    Attributes:
        n_episodes: Scenarios of the result.
        n_played: Those that were played again.
        n_near: Those of them whose outcome rounding decided, at a bound on an error.
        n_other: Those of them in which the policy itself, playing again from pictures, went
            another way than the file says.
        nonce: What a sample was drawn with; None where all were played.
        largest: Largest difference of a metric, by unit.
    """

    n_episodes: int
    n_played: int
    n_near: int
    n_other: int
    nonce: str | None
    largest: Mapping[str, float]


class ReplayStage(Stage, Protocol):
    """What a replay needs of an environment beyond a trial."""

    slack: Mapping[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class ReplayTrial:
    """Plays a scenario's logged actions, for `rollout.play`.

    Attributes:
        actions: (steps, 7) of each scenario that is logged; in others the policy itself plays.
        claimed: What the result says of each; why its policy had no further action is believed.
    """

    actions: Mapping[int, Action]
    claimed: Mapping[int, EpisodeRow]

    def __call__(
        self, env: ReplayStage, policy: rollout.Policy, scenario: int
    ) -> tuple[EpisodeRow, bool]:
        """Returns the row that the actions give, and whether rounding decided its outcome.

        Where the outcome that logged actions give is another than the claimed one, they are played
        with bounds that are a rounding wider, and a rounding narrower: if that gives the claimed
        outcome, exactly, rounding is taken to have decided it.
        """
        claimed, log = self.claimed[scenario], self.actions.get(scenario)
        found = self._play(env, policy, scenario, log)
        if log is None or same_outcome(found, claimed):
            return found, False
        try:
            for sign in (1.0, -1.0):
                env.slack = {unit: sign * near for unit, near in NEAR.items()}
                other = self._play(env, policy, scenario, log)
                if same_outcome(other, claimed):
                    return other, True
        finally:
            env.slack = {}
        return found, False

    def _play(
        self, env: ReplayStage, policy: rollout.Policy, scenario: int, log: Action | None
    ) -> EpisodeRow:
        if log is None:
            return play_trial(env, policy.reset, policy.select_action, scenario)[0]
        remaining = iter(log)

        def decide(observation: Observation) -> Action:
            action = next(remaining, None)
            if action is None:
                raise EpisodeLostError(self.claimed[scenario].settled.failure or LOG_ENDS)
            return action

        return play_trial(env, lambda: None, decide, scenario)[0]


def verify(
    path: Path,
    *,
    sample: int | None = None,
    nonce: str | None = None,
    workers: Workers = 1,
    progress: Callable[[], None] | None = None,
) -> Verdict:
    """Checks a result file against its action log and the task.

    A policy of the suite plays again what is not logged. Where it looks, the least difference of
    rounding between two processors can pass through its pictures and estimates and lead it another
    way, so there the file need not agree row by row: what it claims to be solved is compared with
    what is solved now, by McNemar's exact test.

    Args:
        path: The result; its action log stands beside it.
        sample: Scenarios to play again; None plays all.
        nonce: What the sample is drawn with, to repeat a draw; a new one by default, because the
            author of the file must not know it.
        workers: Processes that share the work, or others elsewhere.
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
    log, rows = load_actions(path, result), result.episodes
    if sample is None or sample >= len(rows):
        chosen, nonce = list(range(len(rows))), None
    else:
        nonce = new_nonce() if nonce is None else nonce
        chosen = drawn(len(rows), sample, nonce)
    n_near, n_other, largest = 0, 0, {"mm": 0.0, "deg": 0.0}
    for scenarios, make, pictures in _in_parts(path, result, chosen, len(log)):
        replay = ReplayTrial(
            {index: log[index] for index in scenarios if index < len(log)},
            {index: rows[index] for index in scenarios},
        )
        task = MakeTask(
            result.summary.task, result.summary.split, result.metadata.options, pictures=pictures
        )
        claimed: dict[int, bool] = {}
        solved: dict[int, bool] = {}
        with contextlib.closing(
            rollout.play(task, make, scenarios, replay, workers=workers)
        ) as played:
            for row, by_rounding in played:
                said = rows[row.scenario]
                words = _difference(said, row, largest)
                if words is not None and not pictures:
                    raise ResultError(f"{path}: scenario {row.scenario}: {words}")
                claimed[row.scenario], solved[row.scenario] = said.success, row.success
                n_near += by_rounding
                n_other += words is not None
                if progress is not None:
                    progress()
        tally = Tally.of(claimed, solved)
        if tally.p < LEAST_P:
            raise ResultError(
                f"{path}: {sum(claimed.values())} of {len(claimed)} scenarios that are not logged "
                f"are claimed to be solved, but {result.summary.policy} solves "
                f"{sum(solved.values())} of them (p = {tally.p:.2g})"
            )
    most = max(1, MOST_NEAR_PER_MILLE * len(chosen) // 1000)
    if n_near > most:
        raise ResultError(
            f"{path}: rounding would have decided {n_near} of {len(chosen)} outcomes as the file "
            f"says; more than {most} cannot be chance"
        )
    return Verdict(len(rows), len(chosen), n_near, n_other, nonce, largest)


def _in_parts(
    path: Path, result: Result, chosen: Sequence[int], n_logged: int
) -> Iterator[tuple[list[int], rollout.PolicyFactory, bool]]:
    """What is logged is replayed without pictures; the policy itself plays the rest."""
    logged = [index for index in chosen if index < n_logged]
    if logged:
        yield logged, builtin.make_zero, False
    rest = [index for index in chosen if index >= n_logged]
    if rest:
        player = named_policy(path, result)
        yield rest, player.make, player.looks


def named_policy(path: Path, result: Result) -> contender.Contender:
    """Returns the suite's own policy that a result names: a built-in one, or shipped weights.

    Args:
        path: The result's file.
        result: What it holds.

    Raises:
        ResultError: There is none of this name, or it has other weights by now. Any other name is
            not looked for: a stranger's file must not choose code to run or weights to load.
    """
    policy, task = result.summary.policy, result.summary.task
    if policy not in catalogue.NAMES:
        raise ResultError(
            f"{path}: {shown(policy)!r} is no policy of the suite, but the action log does not "
            "hold all scenarios; evaluate again"
        )
    try:
        player = contender.find(policy, task)
    except PolicyError as error:
        raise ResultError(f"{path}: {error}") from error
    if player.hash != result.metadata.policy_hash:
        raise ResultError(
            f"{path}: was made with other {policy} weights than this version ships for {task}, so "
            "what the action log does not hold cannot be played again; evaluate again"
        )
    return player


def check_task(path: Path, result: Result) -> None:
    """Checks that a result was made on the task as its name, and its options, mean it here.

    Raises:
        ResultError: It was not.
        UnknownTaskError: There is no such task.
    """
    ours, metadata = result.summary.task, result.metadata
    named = registry.find(ours)
    try:
        spec = named.with_options(metadata.options)
    except OptionError as error:
        raise ResultError(f"{path}: metadata.options: {error}") from error
    if registry.options_of(spec) != metadata.options:
        raise ResultError(f"{path}: metadata.options are not what differs from {ours}")
    for name, said, known in (
        ("task_version", metadata.task_version, spec.version),
        ("task_digest", metadata.task_digest, lock.digest(ours)),
        ("tolerances", metadata.tolerances, spec.tolerances),
        ("time_limit_steps", metadata.time_limit_steps, spec.time_limit_steps),
        ("metrics", sorted(result.episodes[0].errors), sorted(m.name for m in spec.metrics)),
    ):
        if said != known:
            raise ResultError(
                f"{path}: {name} is {said}, but {known} for {ours} in this hvs_suite; evaluate "
                "again, or check with the version that made it"
            )


def check_as_named(path: Path, result: Result) -> None:
    """Checks that a result is one of the named task, and not of what options made of it.

    Raises:
        ResultError: It is not.
    """
    if result.metadata.options:
        raise ResultError(
            f"{path}: the task was changed ({shown(listed(result.metadata.options))}); only the "
            "task as named is scored"
        )


def load_actions(path: Path, result: Result) -> list[action_log.Actions]:
    """Reads the action log of a result.

    Args:
        path: The result's file.
        result: What it holds.

    Returns:
        (steps, 7) float32 of each of its first `Metadata.n_logged` rows.

    Raises:
        ResultError: The log cannot be read, is another one, or is not as long as the rows say.
    """
    log = action_log.load(result_file.actions_path(path), result.metadata.actions_sha256)
    rows = result.episodes
    n_logged = result.metadata.n_logged
    if len(log) != n_logged:
        raise ResultError(
            f"{path}: the action log holds {len(log)} scenarios, the result says {n_logged}"
        )
    for row, actions in zip(rows[:n_logged], log, strict=True):
        if len(actions) != row.settled.steps:
            raise ResultError(
                f"{path}: scenario {row.scenario}: settled.steps is {row.settled.steps}, but "
                f"{len(actions)} actions are logged"
            )
        if len(actions) > result.metadata.time_limit_steps:
            raise ResultError(
                f"{path}: scenario {row.scenario}: {len(actions)} actions are logged, more than "
                f"the time limit of {result.metadata.time_limit_steps} steps"
            )
    return log


def new_nonce() -> str:
    """Returns a random nonce to draw a sample with: 32 hex digits."""
    return secrets.token_hex(16)


def drawn(n: int, sample: int, nonce: str) -> list[int]:
    """Returns which of the scenarios 0..n-1 a nonce draws, `sample` of them in order."""
    key = int.from_bytes(hashlib.sha256(nonce.encode()).digest()[:16], "little")
    random = np.random.Generator(np.random.Philox(key=key))
    return sorted(random.choice(n, size=sample, replace=False).tolist())


def _difference(said: EpisodeRow, found: EpisodeRow, largest: dict[str, float]) -> str | None:
    """In words, what of a row the one played again contradicts; None if nothing.

    Keeps the largest differences of errors, by unit.
    """
    theirs = outcome(found)
    for name, value in outcome(said).items():
        if value != theirs[name]:
            return f"{name} is {value}, but the logged actions give {theirs[name]}"
    played = _figures(found)
    for name, figure in _figures(said).items():
        unit = name.rpartition("_")[2]
        if name not in played:
            return f"{name} is no metric of the task"
        largest[unit] = max(largest.get(unit, 0.0), abs(figure - played[name]))
        # Both are rounded to a millionth, which may part them by one more.
        bound = NEAR.get(unit, NEAR_OTHERWISE) + 2e-6
        if not math.isclose(figure, played[name], rel_tol=0.0, abs_tol=bound):
            return f"{name} is {figure}, but the logged actions give {played[name]}"
    return None


def _figures(row: EpisodeRow) -> dict[str, float]:
    """Every metric of a row, and where it landed, by name."""
    end = row.settled
    settled = {f"settled.{name}": value for name, value in end.errors.items()}
    return row.errors | settled | {"settled.x_mm": end.x_mm, "settled.y_mm": end.y_mm}


def results_in(paths: Sequence[Path]) -> list[Path]:
    """Returns the result files that are named or lie below the folders that are.

    Raises:
        OptionError: There is none, or a path does not exist or is a dataset.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise OptionError(f"{path} does not exist; name a result file or a folder of them")
        if (path / INFO).exists():
            raise OptionError(f"{path} is a dataset, no result; 'hvs check {path}' checks it")
        below = [Path(folder, name) for folder, _, names in os.walk(path) for name in names]
        found += sorted(f for f in below if f.suffix == ".json") if path.is_dir() else [path]
    if not found:
        raise OptionError("there are no results there; name a result file or a folder of them")
    return found


def as_json(path: Path, verdict: Verdict) -> dict[str, Any]:
    """Returns a verdict as plain data, for ``--json``."""
    return {"file": str(path), **dataclasses.asdict(verdict)}
