"""``hvs finetune``: a pretrained policy, made better by reinforcement learning."""

import dataclasses
from pathlib import Path
from typing import Literal

from hvs_suite.cli.rl_session import show_finetuning
from hvs_suite.policies.residual.settings import Settings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finetune:
    """Fine-tune a pretrained policy by reinforcement learning.

    Learns by TD3 where to move the goal that the policy believes in. No expert is asked. Trains for
    --minutes or --steps, whichever ends first, or for forty minutes if neither is given; ends early
    if success falls, and keeps what was evaluated best. Interrupted, it goes on from its last
    checkpoint when the same command is given again. Curves and a film of each evaluation are in
    OUT/training.

    Attributes:
        policy: Checkpoint of an hvs policy, as hvs pretrain makes it, or pretrained for the weights
            shipped for the task.
        task: A named task, such as insert-feel.
        out: Folder for the checkpoint.
        minutes: Stop after this much playing and learning, evaluations not counted (min).
        steps: Stop after this many environment steps.
        seed: Of weights, scenes, exploration and batches.
        sideways_m: The most that the goal is moved in a step, along the surface (m).
        along_m: The same along the normal (m).
        reach_m: How far from the believed goal it is moved (m).
        noise: Standard deviation of the exploration, as a share of the most that is moved.
        noise_along: The same along the normal.
        warm_up_steps: Steps in which the critics learn alone.
        actor_rate: Learning rate of what moves the goal.
        penalty: Weight of the squared share of the largest step that is used.
        gamma: Discount; 1 minus this is the share of success that one step less is worth.
        shaping: Weight of the potential beside the sparse reward, which shows the way to a goal
            that is rarely reached; 0 leaves the sparse reward alone.
        step_cost: What a step outside the tolerances costs.
        updates: Updates a step.
        environments: How many play; they share the scenes between them.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Episodes an evaluation, on scenes of a split of their own.
        curriculum: Learn on easier levels first: tolerance shrinks the tolerances from eightfold,
            start begins near the goal. The next level comes when four fifths of the last fifty
            episodes succeed.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
    """

    policy: str
    task: str
    out: Path
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    sideways_m: float = Settings.sideways_m
    along_m: float = Settings.along_m
    reach_m: float = Settings.reach_m
    noise: float = Settings.noise
    noise_along: float = Settings.noise_along
    warm_up_steps: int = Settings.warm_up_steps
    actor_rate: float = Settings.actor_rate
    penalty: float = Settings.penalty
    gamma: float = Settings.gamma
    shaping: float = Settings.shaping
    step_cost: float = Settings.step_cost
    updates: int = Settings.updates
    environments: int = Settings.environments
    eval_every: int = 10_000
    eval_episodes: int = 100
    curriculum: Literal["tolerance", "start"] | None = None
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Train, showing how it goes, and say what came of it."""
        # Only now, because it imports torch.
        from hvs_suite.policies.residual.td3 import finetune

        show_finetuning(self, Settings, finetune, curriculum=self.curriculum)
