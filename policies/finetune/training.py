"""RL fine-tuning of a pretrained `hvs` policy: eyes on its own frames, then TD3 on a residual.

RL starts exactly at the success of what plays, the base or, if that is no worse, the base with its
new eyes, and leaves one `hvs` checkpoint that needs nothing privileged. A run is a function of
base, task, settings, seed and number of steps. Killed, it goes on from its last checkpoint when the
same command is given again.
"""

import contextlib
import dataclasses
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.noise import NormalActionNoise

from hvs_suite.executor import worker_conditions
from hvs_suite.on_ray import RayCluster
from hvs_suite.policies.catalogue import name_of
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import (
    CheckpointPolicy,
    check_fit,
    weights_digest,
)
from hvs_suite.policies.finetune.eyes import train_eyes
from hvs_suite.policies.finetune.folding import load_base, with_residual, write_folded
from hvs_suite.policies.finetune.outlook import Outlook
from hvs_suite.policies.finetune.overlapped import (
    Overlapped,
    OverlappedDummyVecEnv,
    OverlappedSubprocVecEnv,
)
from hvs_suite.policies.finetune.residual_td3 import ResidualPolicy, ResidualTD3
from hvs_suite.policies.finetune.settings import Settings
from hvs_suite.policies.finetune.stage import MakeStage
from hvs_suite.policies.network.network import N_JOINTS, HvsNetwork
from hvs_suite.policies.rl.curriculum import Kind, levels_of
from hvs_suite.policies.rl.evaluation import Evaluation, Evaluator
from hvs_suite.policies.rl.outcome import Outcome, Progress, check_run
from hvs_suite.policies.rl.run import Run
from hvs_suite.policies.training.budget import Budget
from hvs_suite.policies.training.process import prepare_process
from hvs_suite.policies.training.run_folder import claimed, write_train_config
from hvs_suite.registry import find, options_of
from hvs_suite.rollout import library_seeds
from hvs_suite.tasks.shared.spec import Spec

PACKAGES = ("hvs-suite", "mujoco", "numpy", "stable-baselines3", "torch")


def finetune(
    policy: Path,
    task: str,
    out: Path,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    settings: Settings | None = None,
    options: Mapping[str, Any] | None = None,
    cluster: RayCluster | None = None,
    curriculum: Kind | None = None,
    split: str = "train",
    eval_every: int = 10_000,
    eval_episodes: int = 100,
    checkpoint_period_s: float = 120.0,
    on_progress: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Fine-tune a pretrained policy, or go on with a run that was interrupted.

    Args:
        policy: Checkpoint of an `hvs` policy.
        task: Named task.
        out: Folder for the checkpoint, an `hvs` policy like the base; the training state lives in
            ``out/training``.
        minutes: Stop after this much playing and learning, evaluations and eyes not counted (min).
        steps: Stop after this many environment steps, rounded up to whole iterations. Give either,
            or both for the first reached.
        seed: Of weights, scenes, exploration and batches; below 2^32.
        settings: Of the method.
        options: Task options that differ from the named task's, for studies.
        cluster: Where the environments play, if not in processes of this machine.
        curriculum: Learn on easier tasks first, ``tolerance`` or ``start``, see `levels_of`;
            evaluations are of the task itself.
        split: Stream of scenes to learn from; anything but ``test``.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Scenes an evaluation, of the split ``validation``.
        checkpoint_period_s: Time between checkpoints (s).
        on_progress: Called as the run goes on.

    Returns:
        What the run came to.

    Raises:
        UnknownTaskError: There is no such task.
        PolicyError: The policy cannot be fine-tuned, or does not fit the task.
        OptionError: No budget, or a value that makes no sense.
        OutputError: ``out`` cannot be written, or holds something else than this run.
        ClusterError: The cluster cannot be joined, or lost a machine that played.
    """
    settings = settings or Settings()
    spec = find(task).with_options(options or {})
    options = options_of(spec)
    limit = Budget(steps, minutes)
    check_run(seed, split, eval_every, eval_episodes)
    levels = levels_of(task, curriculum, options) if curriculum is not None else [{}]
    check_fit(read_config(policy), policy, spec)
    load_base(policy)
    prepare_process()
    make = MakeStage(task, options, levels, split, str(policy.resolve()), settings, seed)
    identity = _identity(make, spec, curriculum)
    with contextlib.ExitStack() as stack:
        stack.enter_context(claimed(out, identity))
        budget = {"minutes": minutes, "steps": steps}
        write_train_config(out, identity, budget, PACKAGES, policy=name_of(policy))
        # Torch and SB3 draw from the global generators of NumPy and torch.
        stack.enter_context(library_seeds(seed))
        evaluator = stack.enter_context(contextlib.closing(Evaluator(spec, options, eval_episodes)))
        base = _with_new_eyes(make, out, spec, evaluator, on_progress, cluster)
        make = dataclasses.replace(make, folder=str(base.resolve()))
        learner = stack.enter_context(_learner(make, out, spec, cluster))
        run = Run(out, learner, evaluator, on_progress)
        stack.callback(run.close)
        run.train(limit, settings.collect_steps, eval_every, checkpoint_period_s)
        return run.outcome()


def _identity(make: MakeStage, spec: Spec, curriculum: Kind | None) -> dict[str, Any]:
    """What a run is a function of, but for its length."""
    return {
        "base": weights_digest(Path(make.folder)),
        "task": make.task,
        "task_version": spec.version,
        "options": make.options,
        "curriculum": curriculum,
        "split": make.split,
        "seed": make.seed,
        **dataclasses.asdict(make.settings),
    }


def _with_new_eyes(
    make: MakeStage,
    out: Path,
    spec: Spec,
    evaluator: Evaluator,
    on_progress: Callable[[Progress], None] | None,
    cluster: RayCluster | None,
) -> Path:
    """The base with the eyes that RL is to begin with: its own, or better ones."""

    def on_share(stage: str, share: float) -> None:
        if on_progress is not None:
            on_progress(Progress(stage, share, 0, 0, 0.0, math.nan, math.nan, None))

    def evaluate(checkpoint: Path, frames: int, updates: int) -> Evaluation:
        return evaluator.evaluate(
            CheckpointPolicy(checkpoint, spec),
            frames,
            updates,
            on_episode=lambda done: on_share("evaluating", done / evaluator.episodes),
        )

    return train_eyes(
        make,
        out / "training" / "eyes",
        spec,
        evaluate,
        on_share,
        cluster or make.settings.environments,
    )


@contextlib.contextmanager
def _learner(
    make: MakeStage, out: Path, spec: Spec, cluster: RayCluster | None
) -> Iterator["_Finetuned"]:
    """The model on its environments, which are closed in the end."""
    if make.settings.environments > 1:
        # They and the learner play and learn at the same time.
        torch.set_num_threads(1)
    with contextlib.closing(_environments(make, cluster)) as environments:
        model = _make_model(environments, load_base(Path(make.folder)), make.settings, make.seed)
        yield _Finetuned(model, Path(make.folder), out, spec)


def _environments(make: MakeStage, cluster: RayCluster | None) -> Overlapped:
    """All environments of a run: an actor or a process each, or this one for a single one."""
    parts = [dataclasses.replace(make, part=i) for i in range(make.settings.environments)]
    if cluster is not None:
        from hvs_suite.policies.finetune.on_ray import OverlappedRayVecEnv

        return OverlappedRayVecEnv(cluster, parts)
    if len(parts) == 1:
        return OverlappedDummyVecEnv([*parts])
    with worker_conditions():
        return OverlappedSubprocVecEnv([*parts], start_method="spawn")


class _Finetuned:
    """The run's model as `Run` takes it, and the checkpoint that comes of it."""

    guards_success = True

    def __init__(self, model: ResidualTD3, base: Path, out: Path, spec: Spec) -> None:
        self.model = model
        self._base = base
        self._out = out
        self._candidate = out / "training" / "candidate"
        self._variant = spec
        [hidden, *_] = model.actor.net_arch
        self._network = with_residual(load_base(base), hidden, model.bound)

    def policy(self) -> CheckpointPolicy:
        """Fold the residual into a checkpoint, and play that."""
        residual = self._network.residual
        assert residual is not None
        residual.load_state_dict(self.model.actor_target.mu.state_dict())
        write_folded(self._base, self._network, self._candidate, self._variant)
        return CheckpointPolicy(self._candidate, self._variant)

    def keep(self) -> None:
        """Put the candidate into the run's folder."""
        for path in self._candidate.iterdir():
            shutil.copy(path, self._out / f".{path.name}")
            (self._out / f".{path.name}").replace(self._out / path.name)


def _make_model(
    environments: Overlapped, base: HvsNetwork, settings: Settings, seed: int
) -> ResidualTD3:
    sigma = np.full(N_JOINTS, settings.noise)
    model = ResidualTD3(
        ResidualPolicy,
        environments,
        learning_rate=settings.critic_rate,
        buffer_size=settings.replay_size,
        # What would come before is drawn from the whole range of actions.
        learning_starts=0,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.gamma,
        train_freq=(settings.collect_steps // settings.environments, "step"),
        # None after the steps: they overlap with the playing.
        gradient_steps=0,
        action_noise=NormalActionNoise(np.zeros(N_JOINTS), sigma),
        # A time limit is a failure, and critics see it coming: nothing is worth anything beyond.
        replay_buffer_kwargs={"handle_timeout_termination": False},
        target_policy_noise=settings.target_noise,
        target_noise_clip=2.0 * settings.target_noise,
        policy_kwargs={
            "net_arch": [settings.hidden],
            "n_critics": settings.critics,
            "outlook": Outlook(base, settings.bound),
            "optimizer_kwargs": {"fused": True},
        },
        seed=seed,
        device="cpu",
    )
    model.actor_rate = settings.actor_rate
    model.actor_tau = settings.actor_tau
    model.updates = settings.updates
    model.warm_up_steps = settings.warm_up_steps
    model.penalty = settings.penalty
    model.bound = settings.bound
    environments.overlapped = model.learn_overlapped
    return model
