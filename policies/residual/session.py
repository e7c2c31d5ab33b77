"""What plays in the end: of all that a run evaluated, the best."""

import shutil
from collections.abc import Callable
from pathlib import Path

from hvs_suite.files import replacing
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy
from hvs_suite.policies.rl.evaluation import (
    Evaluation,
    Evaluator,
    standing,
    write_evaluations,
)
from hvs_suite.tasks.shared.spec import Spec


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
