"""``hvs finetune``: a pretrained policy, made better by reinforcement learning."""

import dataclasses
import functools
from pathlib import Path
from typing import Literal

from hvs_suite.cli.players import on_ray
from hvs_suite.cli.rl_session import show_run


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finetune:
    """Fine-tune a pretrained policy by reinforcement learning.

    Lets the policy play and trains its eyes on what it saw, then learns by TD3 what to add to its
    actions. It needs no expert. Trains for --minutes or --steps, whichever ends first, or for forty
    minutes if neither is given; ends early if success falls, and keeps what was evaluated best. If
    it was interrupted, the same command continues from the last checkpoint. Curves and a film of
    each evaluation are in OUT/training.

    Attributes:
        policy: Checkpoint of an hvs policy, as hvs pretrain makes it, or pretrained for the weights
            shipped for the task.
        task: A named task, such as align-thesis.
        out: Folder for the checkpoint.
        minutes: Stop after this much playing and learning, evaluations and eyes not counted (min).
        steps: Stop after this many environment steps.
        seed: Seed of weights, scenes, exploration and batches.
        curriculum: Learn with wider tolerances first, or with starts nearer to the goal.
        eye_rounds: How often to let the policy play before RL, and to train its eyes on what it
            saw.
        eye_frames: Frames a round.
        eye_steps: Optimiser steps a round.
        warm_up_steps: Environment steps in which the critics learn alone.
        bound: The most that is added to the policy's output, on its logarithmic scale.
        noise: Standard deviation of the exploration, as a share of the bound.
        actor_rate: Learning rate of what is added.
        penalty: Weight of the squared share of the bound that is used.
        gamma: Discount; 1 minus this is the share of success that one step less is worth.
        shaping: Weight of the potential beside the sparse reward, which shows the way to a goal
            that is rarely reached; 0 leaves the sparse reward alone.
        lost_share: Share of the episodes that play lost scenes again, once there are any: a policy
            that is already good learns from little else.
        environments: Number of environments, which share the scenes.
        ray: Let them play on a Ray cluster (docs/many-machines.md): auto for the one that this
            machine belongs to, an address such as 10.0.0.1:6379, or local.
        updates: Updates while 40 environment steps are played; four times as many while the
            critics learn alone.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Episodes an evaluation, on scenes of a split of their own.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
    """

    policy: str
    task: str
    out: Path
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    curriculum: Literal["tolerance", "start"] | None = None
    eye_rounds: int = 2
    eye_frames: int = 6_000
    eye_steps: int = 1_000
    warm_up_steps: int = 2_000
    bound: float = 0.6
    noise: float = 0.2
    actor_rate: float = 1e-4
    penalty: float = 0.1
    gamma: float = 0.97
    shaping: float = 0.01
    lost_share: float = 0.0
    environments: int = 2
    ray: str | None = None
    updates: int = 20
    eval_every: int = 10_000
    eval_episodes: int = 100
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Train, showing how it goes, and say what came of it."""
        from hvs_suite import registry
        from hvs_suite.policies.catalogue import checkpoint_folder
        from hvs_suite.policies.finetune.settings import Settings

        settings = Settings(
            eye_rounds=self.eye_rounds,
            eye_frames=self.eye_frames,
            eye_steps=self.eye_steps,
            warm_up_steps=self.warm_up_steps,
            bound=self.bound,
            noise=self.noise,
            actor_rate=self.actor_rate,
            penalty=self.penalty,
            gamma=self.gamma,
            shaping=self.shaping,
            lost_share=self.lost_share,
            updates=self.updates,
            environments=self.environments,
        )
        options = registry.find(self.task).options_from_text(self.option)
        base = checkpoint_folder(self.policy, self.task)
        from hvs_suite.policies.finetune.training import finetune

        show_run(
            functools.partial(finetune, base, self.task, self.out),
            self.out,
            minutes=self.minutes,
            steps=self.steps,
            seed=self.seed,
            settings=settings,
            options=options,
            cluster=None if self.ray is None else on_ray(self.ray, self.environments),
            curriculum=self.curriculum,
            eval_every=self.eval_every,
            eval_episodes=self.eval_episodes,
        )
