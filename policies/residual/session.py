"""What every fine-tuning run begins with, and what plays in the end: of all evaluated, the best."""

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hvs_suite.files import replacing
from hvs_suite.policies.belief.network import BeliefNetwork
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy, check_fit, weights_digest
from hvs_suite.policies.residual.folding import load_base
from hvs_suite.policies.rl.evaluation import (
    Evaluation,
    Evaluator,
    standing,
    write_evaluations,
)
from hvs_suite.policies.rl.outcome import check_run
from hvs_suite.policies.training.process import prepare_process
from hvs_suite.registry import find, options_of
from hvs_suite.tasks.shared.spec import Spec


@dataclasses.dataclass(frozen=True)
class Begun:
    """What a run is about.

    Attributes:
        spec: Its task, with its options.
        options: Those that differ from the named task's.
        base: Network that it begins with.
        identity: What the run is a function of, but for its method's settings.
    """

    spec: Spec
    options: Mapping[str, Any]
    base: BeliefNetwork
    identity: Mapping[str, Any]


def begin(
    policy: Path,
    task: str,
    options: Mapping[str, Any] | None,
    *,
    split: str,
    seed: int,
    eval_every: int,
    eval_episodes: int,
) -> Begun:
    """Check what a run is to be made with, and load its base.

    Args:
        policy: Checkpoint of the base.
        task: Named task.
        options: Task options that differ from it; None for none.
        split: Stream of scenes to learn from.
        seed: Of the run.
        eval_every: Environment steps between evaluations.
        eval_episodes: Scenes an evaluation.

    Raises:
        UnknownTaskError: There is no such task.
        PolicyError: The policy cannot be fine-tuned, or does not fit the task.
        OptionError: A value makes no sense.
    """
    spec = find(task).with_options(options or {})
    options = options_of(spec)
    check_run(seed, split, eval_every, eval_episodes)
    check_fit(read_config(policy), policy, spec)
    base = load_base(policy)
    prepare_process()
    identity = {
        "base": weights_digest(policy), "task": task, "task_version": spec.version,
        "options": options, "split": split, "seed": seed,
    }  # fmt: skip
    return Begun(spec, options, base, identity)


def evaluate_and_keep(
    write: Callable[[Path], None],
    evaluator: Evaluator,
    evaluations: list[Evaluation],
    out: Path,
    spec: Spec,
    *,
    env_steps: int,
    updates: int,
    on_share: Callable[[float], None],
) -> None:
    """Evaluate a candidate, and let it play if none before it was better.

    Args:
        write: Writes it as a checkpoint into a folder.
        evaluator: Plays it.
        evaluations: Those of the run so far; gets this one.
        out: Folder of the run.
        spec: Its task.
        env_steps: Played so far.
        updates: Done so far.
        on_share: Called with the part that has been played.
    """
    training = out / "training"
    candidate = training / "candidate"
    write(candidate)
    evaluations.append(
        evaluator.evaluate(
            CheckpointPolicy(candidate, spec),
            env_steps,
            updates,
            training / "clips" / f"{env_steps:010d}.mp4",
            lambda k: on_share(k / evaluator.episodes),
        )
    )
    write_evaluations(training / "evaluations.json", evaluations)
    if standing(evaluations[-1]) == max(standing(each) for each in evaluations):
        for path in candidate.iterdir():
            with replacing(out / path.name) as temporary:
                shutil.copy(path, temporary)


def is_due(evaluations: list[Evaluation], env_steps: int, every: int, *, is_over: bool) -> bool:
    """Whether there is to be another evaluation.

    Args:
        evaluations: Those before.
        env_steps: Played so far.
        every: Environment steps between them; there is one before the first step.
        is_over: Whether the run is; its end is evaluated too.
    """
    evaluated = evaluations[-1].env_steps if evaluations else -every
    return env_steps // every > evaluated // every or (is_over and evaluated < env_steps)
