"""``hvs finetune``: a pretrained policy, made better by reinforcement learning."""

import dataclasses
import functools
from pathlib import Path
from typing import Any, Literal

from hvs_suite.cli.players import on_ray
from hvs_suite.cli.rl_session import show_run
from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finetune:
    """Fine-tune a pretrained policy by reinforcement learning.

    Learns by TD3 what to add to the policy's actions. No expert is asked. Trains for --minutes or
    --steps, whichever ends first, or for forty minutes if neither is given; ends early if success
    falls, and keeps what was evaluated best. Interrupted, it goes on from its last checkpoint when
    the same command is given again. Curves and a film of each evaluation are in OUT/training.

    Settings of the method that are not given are those that suit the kind of policy.

    Attributes:
        policy: Checkpoint of an hvs_belief or hvs policy, as hvs pretrain makes it, or pretrained
            for the weights shipped for the task.
        task: A named task, such as insert-feel.
        out: Folder for the checkpoint.
        minutes: Stop after this much playing and learning, evaluations not counted (min).
        steps: Stop after this many environment steps.
        seed: Of weights, scenes, exploration and batches.
        sideways_m: hvs_belief: the most that the goal is moved in a step, along the surface (m).
        along_m: hvs_belief: the same along the normal (m).
        reach_m: hvs_belief: how far from the believed goal it is moved (m).
        noise: Standard deviation of the exploration, as a share of the most that is added.
        noise_along: hvs_belief: the same along the normal.
        warm_up_steps: Steps in which the critics learn alone.
        actor_rate: Learning rate of what is added.
        penalty: Weight of the squared share of the bound that is used.
        gamma: Discount; 1 minus this is the share of success that one step less is worth.
        shaping: Weight of the potential beside the sparse reward, which shows the way to a goal
            that is rarely reached; 0 leaves the sparse reward alone.
        step_cost: hvs_belief: what a step costs.
        updates: hvs_belief: updates a step. hvs: updates while 40 steps are played.
        environments: How many play; they share the scenes between them.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Episodes an evaluation, on scenes of a split of their own.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several.
        ray: hvs: let them play on a Ray cluster (docs/many-machines.md): auto for the one that this
            machine belongs to, an address such as 10.0.0.1:6379, or local.
        curriculum: hvs: learn with wider tolerances first, or with starts nearer to the goal.
        bound: hvs: the most that is added to the policy's output, on its logarithmic scale.
        lost_share: hvs: share of the episodes that play scenes again that were lost.
        eye_rounds: hvs: how often, before, to let the policy play and train its eyes on what it
            saw.
        eye_frames: hvs: frames a round.
        eye_steps: hvs: optimiser steps a round.
    """

    policy: str
    task: str
    out: Path
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    sideways_m: float | None = None
    along_m: float | None = None
    reach_m: float | None = None
    noise: float | None = None
    noise_along: float | None = None
    warm_up_steps: int | None = None
    actor_rate: float | None = None
    penalty: float | None = None
    gamma: float | None = None
    shaping: float | None = None
    step_cost: float | None = None
    updates: int | None = None
    environments: int | None = None
    eval_every: int = 10_000
    eval_episodes: int = 100
    option: tuple[str, ...] = ()
    ray: str | None = None
    curriculum: Literal["tolerance", "start"] | None = None
    bound: float | None = None
    lost_share: float | None = None
    eye_rounds: int | None = None
    eye_frames: int | None = None
    eye_steps: int | None = None

    def run(self) -> None:
        """Train, showing how it goes, and say what came of it."""
        from hvs_suite import registry
        from hvs_suite.policies.catalogue import checkpoint_folder
        from hvs_suite.policies.checkpoints.files import read_config

        options = registry.find(self.task).options_from_text(self.option)
        base = checkpoint_folder(self.policy, self.task)
        if read_config(base)["type"] == "hvs":
            from hvs_suite.policies.finetune.settings import Settings as OldSettings
            from hvs_suite.policies.finetune.training import finetune as finetune_old

            settings = OldSettings(**self._settings(OldSettings, "hvs", "ray", "curriculum"))
            show_run(
                functools.partial(finetune_old, base, self.task, self.out),
                self.out,
                minutes=self.minutes,
                steps=self.steps,
                seed=self.seed,
                settings=settings,
                options=options,
                cluster=None if self.ray is None else on_ray(self.ray, settings.environments),
                curriculum=self.curriculum,
                eval_every=self.eval_every,
                eval_episodes=self.eval_episodes,
            )
            return
        from hvs_suite.policies.residual.settings import Settings
        from hvs_suite.policies.residual.td3 import finetune

        show_run(
            functools.partial(finetune, base, self.task, self.out),
            self.out,
            minutes=self.minutes,
            steps=self.steps,
            seed=self.seed,
            settings=Settings(**self._settings(Settings, "hvs_belief")),
            options=options,
            eval_every=self.eval_every,
            eval_episodes=self.eval_episodes,
        )

    def _settings(self, kind: type, policy: str, *further: str) -> dict[str, Any]:
        """What was given of a method's settings."""
        known = {field.name for field in dataclasses.fields(kind)}
        given = {
            field.name: value
            for field in dataclasses.fields(self)
            if field.name not in _OF_EVERY_RUN and (value := getattr(self, field.name)) is not None
        }
        if foreign := sorted(given.keys() - known - {*further}):
            option = foreign[0].replace("_", "-")
            raise OptionError(f"--{option} is not for policies of type {policy}; leave it out")
        return {name: value for name, value in given.items() if name in known}


_OF_EVERY_RUN = (
    "policy", "task", "out", "minutes", "steps", "seed", "eval_every", "eval_episodes", "option",
)  # fmt: skip
