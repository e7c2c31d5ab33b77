"""``hvs pretrain``: the ``hvs`` policy, trained on a dataset by behaviour cloning and DAgger."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from hvs_suite.cli import console
from hvs_suite.cli.players import Players

if TYPE_CHECKING:
    from hvs_suite.policies.imitation.pretrain import Progress


DEFAULT_MINUTES = 10.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pretrain(Players):
    """Train the hvs policy on demonstrations by behaviour cloning.

    The task comes from the dataset. Trains for --minutes or --steps, whichever ends first, or for
    ten minutes if neither is given. If it was interrupted, the same command continues from the last
    checkpoint.

    Attributes:
        data: Root folder of the dataset, as hvs record makes it.
        out: Folder for the checkpoint; loads with from_pretrained.
        minutes: Stop after this much training, decoding not counted (min).
        steps: Stop after this many optimiser steps.
        dagger_rounds: DAgger rounds, spread over the training: the policy plays, a teacher labels
            every step, and the frames are added. Their time comes on top of --minutes.
        dagger_frames: Frames a round.
        dagger_teacher: Who labels them: the demonstrator, the expert, which also knows what nobody
            can see, or servo, which knows no more than the policy.
        inputs: What the policy is given: eih, eth, joint_positions and joint_velocities, some of
            them joined by +; all by default. Without joint_positions it knows where the arm starts
            and what it has sent.
        grey: Cameras whose pictures it is given in grey, joined by +.
        episodes: Number of demonstrations to learn from, the first ones of the dataset; all by
            default.
        error_scale: Errors of a joint's step (rad) and of a place (m) weigh linearly below this
            and logarithmically above; five times the task's tightest tolerance by default.
        eyes: Policies whose eyes to start from, where the target is too small for untrained eyes to
            find: checkpoint folders, or named tasks for the weights shipped for them. Each camera
            starts with those of the first that has it.
        kept_eyes: Cameras whose eyes stay as they were taken, joined by +.
        weights: Policy to train on, whole: a checkpoint folder, or a named task for the weights
            shipped for it. Give its --inputs, --slopes and --offsets again, and often a lower
            --learning-rate.
        windows: Windows of control steps that belief and head learn from in a step.
        window_steps: Length of each.
        eye_share: Part of the training in which the eyes learn; in the rest belief and head do,
            from what the eyes see. With 1 nothing but eyes comes out, for --eyes of another run;
            with 0 the eyes that it starts with learn nothing more.
        slopes: Cameras whose eyes tell the slope of the surface, joined by +; for surfaces that
            lean.
        offsets: Cameras whose pose is not exact, joined by +: the belief finds out how they are
            shifted and turned; for targets in sequence.
        without: Parts of the design to leave out, joined by +, to see what they are good for:
            memory of what was seen; keypoints, without which the eyes learn from goals and actions.
        corrects_within_m: How far from the goal the head corrects the mean of the ways that it is
            shown (m); beyond it does so less, and from twice as far on not at all. Everywhere by
            default. For arms that stand still on long ways.
        batch_size: Frames that the eyes learn from in a step.
        device: Where the eyes learn: cpu or cuda. The rest learns on the processor.
        learning_rate: Peak of the schedule.
        seed: Seed of the initial weights, the held-out episodes and the order.
    """

    data: Path
    out: Path
    minutes: float | None = None
    steps: int | None = None
    dagger_rounds: int = 0
    dagger_frames: int = 6000
    dagger_teacher: Literal["demonstrator", "expert", "servo"] = "demonstrator"
    inputs: str | None = None
    grey: str | None = None
    episodes: int | None = None
    error_scale: float | None = None
    eyes: tuple[str, ...] = ()
    kept_eyes: str | None = None
    weights: str | None = None
    windows: int = 48
    window_steps: int = 16
    eye_share: float = 0.5
    slopes: str | None = None
    offsets: str | None = None
    without: str | None = None
    corrects_within_m: float | None = None
    batch_size: int = 64
    device: str = "cpu"
    learning_rate: float = 2e-3
    seed: int = 0

    def run(self) -> None:
        """Train, showing how it goes, and say where the checkpoint is."""
        from hvs_suite.policies.imitation.pretrain import pretrain

        minutes = self.minutes
        if minutes is None and self.steps is None:
            minutes = DEFAULT_MINUTES
        with console.meter() as update:
            outcome = pretrain(
                self.data,
                self.out,
                minutes=minutes,
                steps=self.steps,
                dagger_rounds=self.dagger_rounds,
                dagger_frames=self.dagger_frames,
                dagger_teacher=self.dagger_teacher,
                inputs=None if self.inputs is None else tuple(self.inputs.split("+")),
                grey=() if self.grey is None else tuple(self.grey.split("+")),
                episodes=self.episodes,
                error_scale=self.error_scale,
                eyes=[_folder(name) for name in self.eyes],
                weights=None if self.weights is None else _folder(self.weights),
                kept_eyes=() if self.kept_eyes is None else tuple(self.kept_eyes.split("+")),
                windows=self.windows,
                window_steps=self.window_steps,
                eye_share=self.eye_share,
                slopes=() if self.slopes is None else tuple(self.slopes.split("+")),
                offsets=() if self.offsets is None else tuple(self.offsets.split("+")),
                without=() if self.without is None else tuple(self.without.split("+")),
                corrects_within_m=self.corrects_within_m,
                batch_size=self.batch_size,
                learning_rate=self.learning_rate,
                workers=self.players(local=2),
                device=self.device,
                seed=self.seed,
                on_progress=lambda state: update(state.stage, state.share, _words(state)),
            )
        held_out = (
            "" if math.isnan(outcome.held_out_loss) else f", held out {outcome.held_out_loss:.4f}"
        )
        for number, played in enumerate(outcome.rounds, 1):
            print(
                f"DAgger round {number}: {played.frames} frames, {played.successes} of "
                f"{played.episodes} episodes solved, {played.collisions} collisions"
            )
        print(
            f"{outcome.step} steps in {outcome.train_s:.0f} s, "
            f"{outcome.frames_per_s:.0f} frames/s, {outcome.n_parameters:,} parameters"
        )
        print(f"loss {outcome.loss:.4f}{held_out}")
        print(f"wrote {self.out}")


def _folder(name: str) -> Path:
    """The checkpoint that a folder or a named task stands for."""
    from hvs_suite.policies.catalogue import checkpoint_folder
    from hvs_suite.registry import TASKS

    return checkpoint_folder("pretrained", name) if name in TASKS else Path(name)


def _words(state: "Progress") -> str:
    """Rate, time left and losses, in words."""
    parts = [f"{state.frames_per_s:.0f} frames/s", f"{state.seconds_left:.0f} s left"]
    if state.step:
        parts.insert(0, f"step {state.step}")
    if not math.isnan(state.loss):
        parts.append(f"loss {state.loss:.4f}")
    if not math.isnan(state.held_out_loss):
        parts.append(f"held out {state.held_out_loss:.4f}")
    return ", ".join(parts)
