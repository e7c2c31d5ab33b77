"""What comes before RL where perception fails: eyes trained on what the policy itself gets to see.

No expert is asked. The simulator knows where the target stands in each picture, and that is all
that the eyes are trained on; head and residual stay as they are. A residual on features cannot know
what the features have lost.
"""

import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hvs_suite.datasets.features import dataset_features
from hvs_suite.executor import Workers
from hvs_suite.policies.finetune.folding import load_base, write_folded
from hvs_suite.policies.finetune.settings import Settings
from hvs_suite.policies.finetune.stage import MakeStage
from hvs_suite.policies.imitation.dagger import RoundSummary, play_round, read_round
from hvs_suite.policies.imitation.demonstrations import FramePool, Recording
from hvs_suite.policies.network.dataset import GOAL_NORMAL, GOAL_POSITION, TARGET_PREFIX, Manifest
from hvs_suite.policies.network.network import (
    IMAGE_PREFIX,
    MEMORY,
    STATE,
    Eye,
    HvsNetwork,
    sighting_loss,
    target_loss,
)
from hvs_suite.policies.rl.evaluation import Evaluation, read_evaluations, write_evaluations
from hvs_suite.policies.rl.journal import SCENES_A_SEED
from hvs_suite.tasks.shared.spec import Spec

BATCH_SIZE = 64
# Scenes of a seed that its RL does not get to: it would play for months.
FIRST_SCENE = SCENES_A_SEED // 2
# Philox words that keep this stream apart from others of the same seed.
ORDER_STREAM = 4


def train_eyes(
    run: MakeStage,
    folder: Path,
    spec: Spec,
    evaluate: Callable[[Path, int, int], Evaluation],
    on_share: Callable[[str, float], None],
    workers: Workers,
) -> Path:
    """Let the policy play and train its eyes on what it saw, round by round.

    A round that was finished is not done again; one that was interrupted is. Eyes with which fewer
    scenes are solved than before are not kept.

    Args:
        run: Whose base to begin with, and whose task, stream of scenes, seed and settings to take.
        folder: Gets a folder a round: its frames, the checkpoint that came of it, and
            ``outcome.json`` with the seconds of the sitting that finished it; and
            ``evaluations.json``, of the base and of each round.
        spec: The task.
        evaluate: Evaluates a checkpoint, given the frames played and the optimiser steps so far.
        workers: Who plays.
        on_share: Called with ``looking`` or ``training eyes``, and the share of it that is done.

    Returns:
        The checkpoint that solved most; of equals the last, and the base if there are no rounds.
    """
    base, seed, settings = Path(run.folder), run.seed, run.settings
    results = folder / "evaluations.json"
    evaluations = read_evaluations(results, sys.maxsize)

    def success_of(checkpoint: Path, number: int) -> float:
        if len(evaluations) == number:
            played, learned = number * settings.eye_frames, number * settings.eye_steps
            evaluations.append(evaluate(checkpoint, played, learned))
            write_evaluations(results, evaluations)
        return evaluations[number].success_rate

    if not settings.eye_rounds:
        return base
    folder.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(folder, spec.name, run.split, run.options, dataset_features(spec), 0, 0)
    pool = FramePool(manifest, seed, load_base(base).calibration)
    scene = seed * SCENES_A_SEED + FIRST_SCENE
    best, success = base, success_of(base, 0)
    for number in range(settings.eye_rounds):
        began = time.perf_counter()
        place = folder / f"round-{number + 1}"
        summary, recording = _look(
            manifest, best, place / "frames", scene, settings, on_share, workers
        )
        scene = summary.next_scenario
        pool.add(recording)
        improved = place / "checkpoint"
        if not (improved / "config.json").exists():
            network = load_base(best)
            _train(network, pool, settings, [seed, number], on_share)
            seconds = {"train_s": time.perf_counter() - began}
            (place / "outcome.json").write_text(json.dumps(seconds), encoding="utf-8")
            write_folded(best, network, improved, spec)
        solved = success_of(improved, number + 1)
        if solved >= success:
            best, success = improved, solved
    return best


def _look(
    manifest: Manifest,
    checkpoint: Path,
    frames: Path,
    first_scenario: int,
    settings: Settings,
    on_share: Callable[[str, float], None],
    workers: Workers,
) -> tuple[RoundSummary, Recording]:
    """Let a checkpoint play a round, unless it was played; what came of it, and its frames."""
    if (found := read_round(frames)) is not None:
        return found
    frames.parent.mkdir(parents=True, exist_ok=True)
    seen = 0

    def note(count: int) -> None:
        nonlocal seen
        seen += count
        on_share("looking", seen / settings.eye_frames)

    play_round(
        manifest,
        checkpoint,
        frames,
        frames=settings.eye_frames,
        first_scenario=first_scenario,
        workers=workers,
        labelled=False,
        on_frames=note,
    )
    found = read_round(frames)
    assert found is not None
    return found


def _train(
    network: HvsNetwork,
    pool: FramePool,
    settings: Settings,
    key: list[int],
    on_share: Callable[[str, float], None],
) -> None:
    """Train the eyes alone, and nothing of them on actions."""
    random = np.random.Generator(np.random.Philox(key=key, counter=ORDER_STREAM))
    for eye in network.eyes.values():
        assert isinstance(eye, Eye)
        eye.train_in_bfloat16 = torch.cpu._is_avx512_bf16_supported()
        eye.train()
    optimizer = torch.optim.AdamW(network.eyes.parameters(), lr=settings.eye_rate)
    for step in range(settings.eye_steps):
        share = step / settings.eye_steps
        for group in optimizer.param_groups:
            group["lr"] = settings.eye_rate * 0.5 * (1.0 + math.cos(math.pi * share))
        loss = eye_loss(network, pool.batch(random.integers(0, len(pool), BATCH_SIZE)))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.eyes.parameters(), 1.0)
        optimizer.step()
        on_share("training eyes", (step + 1) / settings.eye_steps)
    network.eval()


def eye_loss(network: HvsNetwork, batch: Mapping[str, Tensor]) -> Tensor:
    """Loss of what the eyes see, and of where the target is taken to be.

    Args:
        network: Whose eyes.
        batch: Inputs and ``privileged.*`` as `FramePool.batch` gives them.
    """
    images = {name: batch[IMAGE_PREFIX + name] for name in network.shape.cameras}
    decision = network(images, batch[STATE], batch.get(MEMORY))
    loss = torch.stack(
        [sighting_loss(s, batch[TARGET_PREFIX + name]) for name, s in decision.sightings.items()]
    ).sum()
    truth = batch[GOAL_POSITION] - network.standoff * batch[GOAL_NORMAL]
    assert decision.target is not None
    return loss + 0.1 * target_loss(decision.target, truth, network.shape.error_scale)
