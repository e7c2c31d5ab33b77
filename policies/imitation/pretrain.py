"""Behaviour cloning, with rounds of DAgger: trains the `hvs` policy on a recorded dataset.

What is learned in a step, `hvs_suite.policies.imitation.teacher` says. A run is a function of
dataset, seed and number of steps; if it was killed, the same command continues from the last
checkpoint.
"""

import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from hvs_suite.errors import TrainingError
from hvs_suite.executor import Workers, check_workers
from hvs_suite.files import replacing
from hvs_suite.policies.imitation.dagger import (
    RoundSummary,
    TeacherName,
    play_round,
    read_round,
    round_shares,
)
from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.settings import (
    Settings,
    new_policy,
    settings_for,
    take_eyes,
    take_weights,
)
from hvs_suite.policies.imitation.state import Counters, load_state, save_state
from hvs_suite.policies.imitation.teacher import Teacher, set_prior
from hvs_suite.policies.training.budget import Budget
from hvs_suite.policies.training.curves import Curves
from hvs_suite.policies.training.dataset import Manifest, read_manifest, refuse_test_split
from hvs_suite.policies.training.plot import draw_run
from hvs_suite.policies.training.process import check_device, prepare_process
from hvs_suite.policies.training.run_folder import claimed, write_train_config

PACKAGES = ("hvs-suite", "lerobot", "numpy", "torch")
WARMUP_SHARE = 0.03
GRADIENT_NORM = 1.0
# Philox words that keep this stream apart from the held-out choice.
ORDER_STREAM = 2
LOG_EVERY_STEPS = 20


@dataclasses.dataclass(frozen=True)
class Progress:
    """How a run is doing.

    Attributes:
        stage: ``decoding``, ``training``, ``learning slopes`` or ``playing``.
        share: Part of the stage that is done, 0 to 1.
        step: Optimiser steps done.
        frames: Frames decoded, played or trained on in this sitting.
        frames_per_s: Rate of that.
        seconds_left: Of this stage, at this rate (s).
        loss: Mean training loss of the last steps; NaN while decoding.
        held_out_loss: Last measured on held-out episodes; NaN before.
    """

    stage: str
    share: float
    step: int
    frames: int
    frames_per_s: float
    seconds_left: float
    loss: float
    held_out_loss: float


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a run came to; also in ``training/outcome.json``.

    Attributes:
        step: Optimiser steps, over all sittings.
        train_s: Training time, over all sittings (s).
        decode_s: Time spent decoding frames in this sitting (s).
        play_s: Time spent on DAgger rounds in this sitting (s).
        rounds: What the DAgger rounds came to.
        frames_per_s: Frames trained on a second in this sitting.
        loss: Mean training loss of the last steps.
        held_out_loss: Loss on held-out episodes at the end; NaN if there are none.
        n_parameters: Trainable numbers of the policy.
    """

    step: int
    train_s: float
    decode_s: float
    play_s: float
    rounds: tuple[RoundSummary, ...]
    frames_per_s: float
    loss: float
    held_out_loss: float
    n_parameters: int


def pretrain(
    data: Path,
    out: Path,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    eyes: Sequence[Path] = (),
    weights: Path | None = None,
    workers: Workers = 2,
    device: str = "cpu",
    checkpoint_period_s: float = 60.0,
    on_progress: Callable[[Progress], None] | None = None,
    **settings: Any,
) -> Outcome:
    """Train the `hvs` policy on a dataset, or go on with a run that was interrupted.

    Args:
        data: Root of the dataset; its ``hvs.json`` names the task.
        out: Folder for the checkpoint, which loads with ``from_pretrained``; the training state
            lives in ``out/training``.
        minutes: Stop after this much training, decoding and DAgger rounds not counted (min).
        steps: Stop after this many optimiser steps. Give either, or both for the first reached.
        eyes: Checkpoints of policies to take the eyes of, see `take_eyes`; none for fresh ones.
        weights: Checkpoint of a policy to go on with, see `take_weights`; None for a fresh one.
        workers: Processes that play the rounds, or others elsewhere; all give the same.
        device: Where the eyes learn, as torch calls it. Belief and head, whose steps are many and
            small, learn on the processor in any case.
        checkpoint_period_s: Time between checkpoints (s).
        on_progress: Called while decoding and after every step.
        **settings: Fields of `Settings` that differ from the defaults.

    Returns:
        What the run came to.

    Raises:
        DatasetError: The dataset cannot be trained on, or was recorded on ``test``.
        OptionError: No budget, a number that makes no sense, or a device that is not there.
        OutputError: ``out`` cannot be written, its disk is full, or it holds something else than
            this run. With room again, the same command goes on from the last checkpoint.
        PolicyError: The eyes or the weights do not fit.
        TrainingError: The loss is no longer a number.
    """
    budget = Budget(steps, minutes)
    check_workers(workers)
    check_device(device)
    manifest = read_manifest(data)
    refuse_test_split(manifest)
    chosen = settings_for(manifest, eyes, weights, settings)
    cameras = [name for name in manifest.cameras if chosen.reads(name)]
    manifest = manifest.with_cameras(cameras, chosen.grey)
    prepare_process()
    identity = dataclasses.asdict(chosen)
    with claimed(out, identity):
        training = out / "training"
        policy = new_policy(manifest, chosen)
        # What tells slopes learns apart from the eyes' share, so it has to be kept as well.
        kept = chosen.kept_eyes if chosen.eye_share else cameras
        if weights is None:
            take_eyes(policy, eyes, kept)
        else:
            take_weights(policy, weights, kept)
        policy.network.eyes.to(device)
        write_train_config(
            out,
            identity,
            {"minutes": minutes, "steps": steps},
            PACKAGES,
            device=device,
            data=str(data),
            options=dict(manifest.options),
            demonstrator=manifest.demonstrator,
            policy={
                "type": policy.config.type,
                "channels": policy.config.channels,
                "hidden": policy.config.hidden,
                "weight_decay": policy.config.optimizer_weight_decay,
            },
        )
        run = _Run(out, on_progress)
        demonstrations = run.decode(manifest, training / "cache", chosen)
        set_prior(policy, demonstrations)
        run.train(
            Teacher(policy, demonstrations, chosen, training),
            chosen,
            budget=budget,
            rounds=_Rounds(
                training / "dagger",
                chosen.dagger_rounds,
                chosen.dagger_frames,
                chosen.dagger_teacher,
                workers,
            ),
            checkpoint_period_s=checkpoint_period_s,
        )
        return run.finish(policy)


@dataclasses.dataclass(frozen=True)
class _Rounds:
    """Which DAgger rounds to play, and where they live."""

    folder: Path
    count: int
    frames: int
    teacher: TeacherName
    workers: Workers

    def path(self, number: int) -> Path:
        """Folder of a round."""
        return self.folder / f"round-{number + 1}"


class _Run:
    """One sitting of a training run: clocks, reports and checkpoints around the loop."""

    def __init__(self, out: Path, on_progress: Callable[[Progress], None] | None) -> None:
        self._out = out
        self._on_progress = on_progress
        self._decode_s = 0.0
        self._play_s = 0.0
        self._rounds: list[RoundSummary] = []
        self._frames = 0
        self._sitting_s = 0.0
        self._counters = Counters()
        self._loss = math.nan
        self._held_out_loss = math.nan

    def decode(self, manifest: Manifest, cache: Path, settings: Settings) -> Demonstrations:
        """Open the dataset, decoding its frames unless the cache has them."""
        share = (settings.episodes or manifest.n_episodes) / max(1, manifest.n_episodes)
        total = share * manifest.n_frames * max(1, len(manifest.cameras))
        started = time.perf_counter()
        demonstrations = Demonstrations(
            manifest,
            cache,
            settings.seed,
            episodes=settings.episodes,
            on_frames=self._meter("decoding", total),
        )
        self._decode_s = time.perf_counter() - started
        return demonstrations

    def train(
        self,
        teacher: Teacher,
        settings: Settings,
        *,
        budget: Budget,
        rounds: _Rounds,
        checkpoint_period_s: float,
    ) -> None:
        """Train until the budget is used up; the last checkpoint is the final one."""
        state = self._out / "training" / "state.safetensors"
        rate, batch_size = settings.learning_rate, settings.batch_size
        policy, demonstrations = teacher.policy, teacher.demonstrations
        decay = policy.config.optimizer_weight_decay
        optimizer = torch.optim.AdamW(policy.parameters(), lr=rate, weight_decay=decay)
        self._counters = load_state(state, policy, optimizer)
        due = round_shares(rounds.count)
        for number in range(rounds.count):
            if not self._reopen(demonstrations, rounds.path(number)):
                break
        order = _Order(demonstrations.training, batch_size, settings.seed)
        before_s = self._counters.elapsed_s
        begun = self._share(budget)
        started = last_checkpoint = time.perf_counter()
        recent: list[float] = []
        policy.train()
        curves = Curves(self._out / "training" / "tensorboard", self._counters.step)
        try:
            while (share := self._share(budget)) < 1.0:
                if len(self._rounds) < len(due) and share >= due[len(self._rounds)]:
                    paused = time.perf_counter()
                    self._checkpoint(teacher, optimizer, state, curves)
                    self._play_round(demonstrations, rounds)
                    order = _Order(demonstrations.training, batch_size, settings.seed)
                    pause = time.perf_counter() - paused
                    started, last_checkpoint = started + pause, time.perf_counter()
                    self._play_s += pause
                step = self._counters.step
                teacher.advance(share)
                if teacher.is_due:
                    self._look_again(teacher, optimizer, state, curves)
                step_rate = rate * _schedule(share)
                for group in optimizer.param_groups:
                    group["lr"] = step_rate
                loss, parts = self._step(teacher, optimizer, order.indices(step))

                recent = [*recent[1 - LOG_EVERY_STEPS :], loss]
                self._loss = sum(recent) / len(recent)
                self._frames += batch_size
                now = time.perf_counter()
                self._sitting_s = now - started
                self._counters = Counters(step + 1, before_s + self._sitting_s)
                if self._counters.step % LOG_EVERY_STEPS == 0:
                    figures = {"loss": self._loss, **parts}
                    curves.add(
                        {"learning_rate": step_rate}
                        | {f"train/{name}": value for name, value in figures.items()},
                        self._counters.step,
                    )
                if now - last_checkpoint >= checkpoint_period_s:
                    self._checkpoint(teacher, optimizer, state, curves)
                    last_checkpoint = time.perf_counter()
                self._report_training(self._share(budget), begun)
            teacher.advance(1.0)
            if settings.eye_share == 1.0 and settings.slopes and teacher.is_due:
                self._look_again(teacher, optimizer, state, curves)
            self._checkpoint(teacher, optimizer, state, curves)
        finally:
            curves.close()

    def _share(self, budget: Budget) -> float:
        """Part of the budget that is used up, 1 at the end."""
        return budget.share(self._counters.step, self._counters.elapsed_s)

    def _step(
        self, teacher: Teacher, optimizer: torch.optim.Optimizer, rows: npt.NDArray[np.int64]
    ) -> tuple[float, dict[str, float]]:
        """Learn from some frames, and what the teacher adds to them.

        Returns:
            The loss, and what it is made of.

        Raises:
            TrainingError: It is no number any more.
        """
        step = self._counters.step
        loss, parts = teacher.lesson(rows, step)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        norms = [
            torch.nn.utils.clip_grad_norm_(together, GRADIENT_NORM).cpu()
            for together in teacher.clipped_apart()
        ]
        norm = torch.stack(norms).norm()
        # Before the step: a weight that is no number would spread through all the others.
        if not math.isfinite(loss.item()) or not math.isfinite(norm.item()):
            raise TrainingError(
                f"training came apart at step {step + 1} (loss {loss.item()}, gradient "
                f"{norm.item()}); {self._out} keeps its last checkpoint; train anew on other data, "
                "or with a lower learning rate"
            )
        optimizer.step()
        return loss.item(), parts

    def finish(self, policy: torch.nn.Module) -> Outcome:
        """What the sitting came to, written and drawn."""
        outcome = Outcome(
            step=self._counters.step,
            train_s=self._counters.elapsed_s,
            decode_s=self._decode_s,
            play_s=self._play_s,
            rounds=tuple(self._rounds),
            frames_per_s=self._frames / max(1e-9, self._sitting_s),
            loss=self._loss,
            held_out_loss=self._held_out_loss,
            n_parameters=sum(p.numel() for p in policy.parameters()),
        )
        with replacing(self._out / "training" / "outcome.json") as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(outcome), indent=2) + "\n")
        draw_run(self._out)
        return outcome

    def _reopen(self, demonstrations: Demonstrations, folder: Path) -> bool:
        """Learn from a round if it was played."""
        found = read_round(folder)
        if found is None:
            return False
        summary, recording = found
        self._rounds.append(summary)
        demonstrations.add(recording)
        return True

    def _play_round(self, demonstrations: Demonstrations, rounds: _Rounds) -> None:
        """Play the next round with the checkpoint just written, and learn from it."""
        manifest, folder = demonstrations.manifest, rounds.path(len(self._rounds))
        first = self._rounds[-1].next_scenario if self._rounds else manifest.n_episodes
        play_round(
            manifest,
            self._out,
            folder,
            frames=rounds.frames,
            first_scenario=first,
            workers=rounds.workers,
            teacher=rounds.teacher,
            on_frames=self._meter("playing", rounds.frames),
        )
        self._reopen(demonstrations, folder)

    def _look_again(
        self, teacher: Teacher, optimizer: torch.optim.Optimizer, state: Path, curves: Curves
    ) -> None:
        teacher.look_again(self._meter)
        self._checkpoint(teacher, optimizer, state, curves)
        teacher.keep()

    def _checkpoint(
        self, teacher: Teacher, optimizer: torch.optim.Optimizer, state: Path, curves: Curves
    ) -> None:
        parts = teacher.held_out()
        self._held_out_loss = parts.get("loss", math.nan)
        curves.add({f"held_out/{name}": v for name, v in parts.items()}, self._counters.step)
        save_state(state, teacher.policy, optimizer, self._counters)
        teacher.save(self._out)

    def _meter(self, stage: str, total: float) -> Callable[[int], None]:
        """Counts the frames of a stage and reports its rate and time left."""
        started = time.perf_counter()
        done = 0

        def note(count: int) -> None:
            nonlocal done
            done += count
            rate = done / max(1e-9, time.perf_counter() - started)
            self._report(stage, done / total, done, rate, (total - done) / max(1e-9, rate))

        return note

    def _report_training(self, share: float, begun: float) -> None:
        """Report, with the time left if the budget goes on shrinking at this sitting's rate."""
        rate = (share - begun) / self._sitting_s
        left = max(0.0, 1.0 - share) / rate
        self._report("training", share, self._frames, self._frames / self._sitting_s, left)

    def _report(
        self, stage: str, share: float, frames: int, rate: float, seconds_left: float
    ) -> None:
        if self._on_progress is None:
            return
        self._on_progress(
            Progress(
                stage=stage,
                share=share,
                step=self._counters.step,
                frames=frames,
                frames_per_s=rate,
                seconds_left=seconds_left,
                loss=self._loss,
                held_out_loss=self._held_out_loss,
            )
        )


class _Order:
    """Which frames each step learns from: shuffled passes, a function of seed and step alone."""

    def __init__(self, indices: npt.NDArray[np.int64], batch_size: int, seed: int) -> None:
        self._pool = indices
        self._batch_size = batch_size
        self._seed = seed
        self._pass = -1
        self._shuffled = indices

    def indices(self, step: int) -> npt.NDArray[np.int64]:
        """Frames of a step, (batch_size,); a batch may run over the end of a pass."""
        first = step * self._batch_size
        positions = np.arange(first, first + self._batch_size)
        passes = positions // len(self._pool)
        within = positions % len(self._pool)
        chosen = np.empty(self._batch_size, np.int64)
        for number in np.unique(passes):
            mask = passes == number
            chosen[mask] = self._permutation(int(number))[within[mask]]
        return chosen

    def _permutation(self, number: int) -> npt.NDArray[np.int64]:
        if number != self._pass:
            key = np.random.Philox(key=[self._seed, ORDER_STREAM], counter=number)
            self._shuffled = np.random.Generator(key).permutation(self._pool)
            self._pass = number
        return self._shuffled


def _schedule(share: float) -> float:
    """Learning rate as a share of its peak: linear warm-up, then half a cosine to zero."""
    warm = min(1.0, (share + 1e-3) / WARMUP_SHARE)
    return warm * 0.5 * (1.0 + math.cos(math.pi * min(1.0, share)))
