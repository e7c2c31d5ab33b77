"""How a policy is scored: scenarios 0..N-1 of a split, the task as named, every episode a row.

Studies may change the task by options; the result then records them and is not a score.
"""

import contextlib
import dataclasses
import datetime
import hashlib
import random
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from hvs_suite import executor, files, registry, rollout
from hvs_suite.errors import OptionError, ScenarioError
from hvs_suite.eval.scoring import action_log, contender, progress_file, provenance, result_file
from hvs_suite.eval.scoring.contender import Contender
from hvs_suite.eval.scoring.trial import (
    DECISION_LIMIT_S,
    MakeTask,
    PlayTrial,
    Trial,
    check_decision_limit,
)
from hvs_suite.eval.serving import policy_process
from hvs_suite.policies import catalogue
from hvs_suite.tasks.shared import lock
from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT
from hvs_suite.tasks.shared.spec import Spec

LOGGED_OF_BUILTIN = 50
"""Scenarios that the log of a built-in policy holds: it can play the others again."""
LOGGED_OF_SHIPPED = 250
"""The same of shipped weights. They play exactly again only where a processor rounds alike, so more
of what they did is kept."""
UNWATCHED = "random"
"""Nobody learns anything from watching this policy: one scenario is logged, and no clip drawn."""

Progress = Callable[[Trial], None]


def evaluate(
    policy: str | Contender,
    task: str,
    out: Path | None = None,
    *,
    split: str = TEST_SPLIT,
    episodes: int = TEST_SCENARIOS,
    options: Mapping[str, Any] = catalogue.AS_NAMED,
    workers: executor.Workers = 1,
    decision_limit_s: float = DECISION_LIMIT_S,
    progress: Progress | None = None,
) -> result_file.Result:
    """Scores a policy on the first scenarios of a split and writes the result.

    After an interruption the same call continues, and ends in the same result. Code of one's own
    (``module:factory``) plays in a process of its own, which holds no simulator. The order of the
    scenarios is drawn for each run, so that a policy cannot count which one it plays.

    Args:
        policy: What `hvs_suite.policies.catalogue.policy_factory` takes, or a contender that was
            found for the task and the options.
        task: Named task.
        out: Result file to write (JSON); the action log and, meanwhile, what is already played
            stand beside it. None writes nothing.
        split: Split to play; ``test`` for a score, any other name for trying.
        episodes: Scenarios to play: 0 to `episodes` - 1.
        options: Options of the task that differ from the named one, for studies; only the task as
            named is a score.
        workers: Processes, or workers elsewhere; the episodes are the same with any of them.
        decision_limit_s: Time after which a decision loses its episode (s).
        progress: Called after each episode, in the order in which they end; at once for those that
            an interrupted call left.

    Returns:
        The result.

    Raises:
        UnknownTaskError: There is no such task.
        PolicyError: There is no such policy, or it does not fit the task.
        ScenarioError: The split does not hold that many scenarios.
        OptionError: `episodes` or `workers` is below 1, the time limit is no time limit, or an
            option of the task makes no sense.
        OutputError: The result cannot be written, another process is writing it, or the beginning
            of another one is in its place.
        RenderError: Nothing here can draw the images.
        ServerError: The policy's server is gone; what is already played is kept.
    """
    _check_counts(split, episodes, workers)
    check_decision_limit(decision_limit_s)
    spec = registry.find(task).with_options(options)
    options = registry.options_of(spec)
    if spec.action_mode == "flange_twist":
        raise OptionError("action_mode=flange_twist has six numbers; an action log holds seven")
    player = contender.find(policy, task, options) if isinstance(policy, str) else policy
    make = player.make
    if player.kind == "module":
        make = policy_process.ProcessFactory(player.name, str(Path.cwd()), task, decision_limit_s)
    evaluation = _Evaluation.of(player, spec, split, decision_limit_s)
    partial = None if out is None else out.with_name(out.name + progress_file.SUFFIX)
    if out is not None:
        files.check_writable(out)
    with progress_file.ProgressFile(partial, evaluation.identity()) as kept:
        order = random.Random(kept.salt).sample(range(episodes), episodes)
        wall_s = _play_rest(
            kept,
            rollout.play(
                MakeTask(task, split, options, pictures=player.looks),
                make,
                [index for index in order if index not in kept.trials],
                PlayTrial(decision_limit_s, kept.salt),
                workers=workers,
            ),
            progress,
        )
        trials = [kept.trials[index] for index in range(episodes)]
        result, log = evaluation.result(trials, _timings(trials, wall_s, executor.size(workers)))
        if out is not None:
            _write(result, log, out)
        kept.remove()
    return result


def _write(result: result_file.Result, log: bytes, out: Path) -> None:
    # The log first: a result is never there without its log.
    with files.replacing(result_file.actions_path(out)) as temporary:
        temporary.write_bytes(log)
    result_file.write(result, out)


@dataclasses.dataclass(frozen=True)
class _Evaluation:
    """The policy, the task, and everything else that decides the trials.

    Attributes:
        player: The policy.
        spec: The task.
        split: Split its scenarios come from.
        created: When this session began.
        origin: The part of a result's metadata on which its trials depend.
    """

    player: Contender
    spec: Spec
    split: str
    created: str
    origin: Mapping[str, Any]

    @classmethod
    def of(cls, player: Contender, spec: Spec, split: str, decision_limit_s: float) -> Self:
        """Note what an evaluation here and now depends on."""
        created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        origin = {
            "task_digest": lock.digest(spec.name),
            "options": registry.options_of(spec),
            "policy_kind": player.kind,
            "policy_hash": player.hash,
            "decision_limit_s": decision_limit_s,
            "suite_version": provenance.suite_version(),
            "packages": provenance.package_versions(),
            "gl_renderer": provenance.gl_renderer(),
            "cpu": provenance.cpu(),
        }
        return cls(player, spec, split, created, origin)

    def identity(self) -> dict[str, Any]:
        """What an interrupted evaluation must have in common with the one that continues it."""
        return {
            "schema_version": result_file.SCHEMA_VERSION,
            "task": self.spec.name,
            "split": self.split,
            "policy": self.player.name,
            **self.origin,
        }

    def result(
        self, trials: Sequence[Trial], timings: result_file.Timings
    ) -> tuple[result_file.Result, bytes]:
        """The result of all trials, and their action log."""
        player, spec = self.player, self.spec
        rows = [trial.row for trial in trials]
        is_ours = result_file.is_ours(player.name, player.kind)
        plays_again = is_ours and not self.origin["options"]
        most = LOGGED_OF_SHIPPED if player.name in catalogue.SHIPPED else LOGGED_OF_BUILTIN
        if player.name == UNWATCHED:
            most = 1
        n_logged = min(most, len(rows)) if plays_again else len(rows)
        log = action_log.encode([trial.actions for trial in trials[:n_logged]])
        judged_by: dict[str, Any] = {
            "tolerances": spec.tolerances,
            "time_limit_steps": spec.time_limit_steps,
        }
        result = result_file.Result(
            schema_version=result_file.SCHEMA_VERSION,
            summary=result_file.Summary.of(spec.name, player.name, self.split, rows, **judged_by),
            metadata=result_file.Metadata(
                created=self.created,
                task_version=spec.version,
                policy_parameters=player.parameters,
                training_steps=player.training_steps,
                training_hours=player.training_hours,
                actions_sha256=hashlib.sha256(log).hexdigest(),
                n_logged=n_logged,
                platform=provenance.operating_system(),
                **judged_by,
                **self.origin,
            ),
            timings=timings,
            episodes=rows,
        )
        return result, log


def _check_counts(split: str, episodes: int, workers: executor.Workers) -> None:
    executor.check_workers(workers)
    if episodes < 1:
        raise OptionError(f"episodes must be at least 1, not {episodes}")
    if split == TEST_SPLIT and episodes > TEST_SCENARIOS:
        raise ScenarioError(
            f"split {TEST_SPLIT!r} holds {TEST_SCENARIOS} scenarios, not {episodes}; ask for "
            f"{TEST_SCENARIOS} episodes or fewer"
        )


def _timings(trials: Sequence[Trial], wall_s: float, workers: int) -> result_file.Timings:
    steps = sum(len(trial.actions) for trial in trials)
    play_s = sum(trial.play_s for trial in trials)
    return result_file.Timings(
        workers=workers,
        wall_s=wall_s,
        steps_per_s=steps * min(workers, len(trials)) / play_s,
        decision_ms=1000 * sum(trial.decision_s for trial in trials) / max(steps, 1),
        decision_ms_max=1000 * max(trial.slowest_s for trial in trials),
    )


def _play_rest(
    kept: progress_file.ProgressFile,
    played: Generator[Trial, None, None],
    progress: Progress | None,
) -> float:
    """Keeps trials as they come; returns the wall time over all sittings (s)."""
    before, started = kept.elapsed_s, time.perf_counter()
    for trial in kept.trials.values():
        if progress is not None:
            progress(trial)
    with contextlib.closing(played):
        for trial in played:
            kept.add(trial, before + time.perf_counter() - started)
            if progress is not None:
                progress(trial)
    return before + time.perf_counter() - started
