"""Soft actor-critic from scratch, as the thesis had it, on Stable-Baselines3.

A run is a function of task, settings, seed and number of steps. Killed, it goes on from its last
checkpoint when the same command is given again, and ends like one that was left alone.
"""

import contextlib
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

from hvs_suite.errors import OptionError
from hvs_suite.files import replacing
from hvs_suite.policies.run_folder import claim, write_train_config
from hvs_suite.policies.sac.curves import Curves
from hvs_suite.policies.sac.evaluation import (
    Evaluation,
    Examiner,
    read_evaluations,
    write_evaluations,
)
from hvs_suite.policies.sac.journal import OUTCOMES, Journal, make_journal
from hvs_suite.policies.sac.network import policy_kwargs
from hvs_suite.policies.sac.playing import GreedyActor, save_actor, write_config
from hvs_suite.policies.sac.settings import Settings
from hvs_suite.policies.sac.state import Counters, load_run, save_run
from hvs_suite.registry import find
from hvs_suite.rollout import library_seeds
from hvs_suite.tasks.scenario import TEST_SPLIT
from hvs_suite.tasks.variants import (
    PRESETS,
    THESIS_REWARDS,
    AlignVariant,
    observation_names,
    with_options,
)

PACKAGES = ("hvs-suite", "mujoco", "numpy", "stable-baselines3", "torch")
LOG_EVERY = 10
"""Iterations between two points of a curve."""
INPUTS = PRESETS["vision"]


@dataclasses.dataclass(frozen=True)
class Progress:
    """How a run is doing.

    Attributes:
        stage: ``training`` or ``evaluating``.
        share: Part of the stage that is done, 0 to 1.
        env_steps: Environment steps over all sittings.
        updates: Updates over all sittings.
        env_steps_per_s: Rate in this sitting, evaluations not counted.
        seconds_left: Of the budget, at the rate of this sitting (s).
        episode_return: Mean of the last hundred episodes; NaN before the first has ended.
        evaluation: The last one; None before.
    """

    stage: str
    share: float
    env_steps: int
    updates: int
    env_steps_per_s: float
    seconds_left: float
    episode_return: float
    evaluation: Evaluation | None


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a run came to; also in ``training/outcome.json``.

    Attributes:
        step: Updates, over all sittings.
        env_steps: Environment steps, over all sittings.
        updates_per_env_step: Their ratio.
        episodes: Episodes ended.
        train_s: Time spent playing and learning over all sittings, evaluations not counted (s).
        env_steps_per_s: Rate over all sittings.
        n_parameters: Trainable numbers of the actor.
        evaluation: The last one.
    """

    step: int
    env_steps: int
    updates_per_env_step: float
    episodes: int
    train_s: float
    env_steps_per_s: float
    n_parameters: int
    evaluation: Evaluation | None


def train_sac(
    task: str,
    out: Path,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    settings: Settings | None = None,
    rewards: Sequence[str] = THESIS_REWARDS,
    options: Mapping[str, Any] | None = None,
    split: str = "train",
    eval_every: int = 10_000,
    eval_episodes: int = 20,
    device: str = "cpu",
    checkpoint_period_s: float = 300.0,
    on_progress: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Train SAC on a named task, or go on with a run that was interrupted.

    Args:
        task: Named task.
        out: Folder for the actor, which `policy_factory` takes; the training state lives in
            ``out/training``.
        minutes: Stop after this much playing and learning, evaluations not counted (min).
        steps: Stop after this many environment steps, rounded up to whole iterations. Give either,
            or both for the first reached.
        seed: Of weights, scenes, exploration and batches; below 2^32.
        settings: Of SAC; the thesis's by default.
        rewards: Reward terms to learn from, as the task's option of that name.
        options: Further task options, for studies.
        split: Stream of scenes to learn from; anything but ``test``.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Scenes an evaluation.
        device: Of the networks, as torch calls it.
        checkpoint_period_s: Time between checkpoints (s).
        on_progress: Called after every iteration and every episode of an evaluation.

    Returns:
        What the run came to.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: No budget, or a value that makes no sense.
        OutputError: ``out`` cannot be written, or holds something else than this run.
    """
    settings = settings or Settings()
    options = {**(options or {}), "rewards": tuple(rewards)}
    variant = with_options(find(task), options)
    _check(variant, minutes, steps, seed, split, eval_every, eval_episodes, device)
    torch.set_num_threads(min(2, torch.get_num_threads()))
    identity = {
        "task": task,
        "task_version": variant.version,
        "options": json.loads(json.dumps(options)),
        "split": split,
        "seed": seed,
        **json.loads(json.dumps(dataclasses.asdict(settings))),
    }
    claim(out, identity)
    budget = {"minutes": minutes, "steps": steps}
    write_train_config(out, identity, budget, PACKAGES, device=device)
    # SB3 draws from the global generators of NumPy and torch.
    with contextlib.ExitStack() as stack:
        stack.enter_context(library_seeds(seed))
        journal = stack.enter_context(
            contextlib.closing(make_journal(variant, options, split, seed))
        )
        model = _make_model(journal, settings, seed, device)
        assert isinstance(model.observation_space, spaces.Dict)
        write_config(out, variant, model.observation_space, settings.hidden)
        examiner = stack.enter_context(
            contextlib.closing(Examiner(variant, options, eval_episodes))
        )
        run = _Run(out, model, journal, examiner, on_progress)
        stack.callback(run.close)
        run.train(_Budget(steps, minutes), settings, eval_every, checkpoint_period_s)
        return run.outcome()


@dataclasses.dataclass(frozen=True)
class _Budget:
    """How long to train: environment steps, minutes, or whichever is reached first."""

    steps: int | None
    minutes: float | None

    def share(self, env_steps: int, elapsed_s: float) -> float:
        """Part that is used up, 1 at the end."""
        shares = [0.0]
        if self.steps is not None:
            shares.append(env_steps / self.steps)
        if self.minutes is not None:
            shares.append(elapsed_s / (60.0 * self.minutes))
        return max(shares)


class _Run:
    """One sitting: SB3's iterations, with evaluations, checkpoints and curves in between."""

    def __init__(
        self,
        out: Path,
        model: SAC,
        journal: Journal,
        examiner: Examiner,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        self._out = out
        self._training = out / "training"
        self._model = model
        self._journal = journal
        self._examiner = examiner
        self._on_progress = on_progress
        self._counters: Counters = load_run(self._training, model, journal)
        self._begun = (model.num_timesteps, self._counters.elapsed_s)
        self._evaluations = read_evaluations(
            self._training / "evaluations.json", model.num_timesteps
        )
        self._curves = Curves(self._training / "tensorboard", model.num_timesteps)
        model.set_logger(Logger(None, [self._curves]))

    def close(self) -> None:
        """Close the curves."""
        self._curves.close()

    def train(
        self, budget: _Budget, settings: Settings, eval_every: int, checkpoint_period_s: float
    ) -> None:
        """Train until the budget is used up; the last checkpoint is the final one."""
        model, counters = self._model, self._counters
        begun = share = budget.share(model.num_timesteps, counters.elapsed_s)
        if not self._evaluations:
            self._evaluate()
            self._checkpoint()
        last_checkpoint = time.perf_counter()
        iterations = 0
        while share < 1.0:
            started = time.perf_counter()
            # One iteration: SB3 collects `collect_steps` steps, then updates.
            model.learn(settings.collect_steps, log_interval=sys.maxsize, reset_num_timesteps=False)
            counters.elapsed_s += time.perf_counter() - started
            iterations += 1
            share = budget.share(model.num_timesteps, counters.elapsed_s)
            if iterations % LOG_EVERY == 0 or share >= 1.0:
                self._log()
            evaluated = self._evaluations[-1].env_steps
            due = model.num_timesteps // eval_every > evaluated // eval_every
            if due or (share >= 1.0 and evaluated < model.num_timesteps):
                self._evaluate()
                last_checkpoint = -math.inf
            if time.perf_counter() - last_checkpoint >= checkpoint_period_s:
                self._checkpoint()
                last_checkpoint = time.perf_counter()
            used = (share - begun) / max(1e-9, counters.elapsed_s - self._begun[1])
            self._report("training", share, max(0.0, 1.0 - share) / max(1e-12, used))

    def outcome(self) -> Outcome:
        """What the run has come to."""
        env_steps, updates = self._model.num_timesteps, self._model._n_updates
        return Outcome(
            step=updates,
            env_steps=env_steps,
            updates_per_env_step=updates / max(1, env_steps),
            episodes=self._model._episode_num,
            train_s=self._counters.elapsed_s,
            env_steps_per_s=env_steps / max(1e-9, self._counters.elapsed_s),
            n_parameters=sum(p.numel() for p in self._model.actor.parameters()),
            evaluation=self._evaluations[-1] if self._evaluations else None,
        )

    def _evaluate(self) -> None:
        """Play greedily, film scene 0, and keep the figures."""
        env_steps = self._model.num_timesteps
        evaluation = self._examiner.evaluate(
            GreedyActor(self._model.actor),
            env_steps,
            self._model._n_updates,
            self._training / "clips" / f"{env_steps:010d}.mp4",
            lambda done: self._report("evaluating", done / self._examiner.episodes, 0.0),
        )
        self._evaluations.append(evaluation)
        write_evaluations(self._training / "evaluations.json", self._evaluations)
        self._curves.add({f"eval/{k}": v for k, v in evaluation.figures().items()}, env_steps)

    def _checkpoint(self) -> None:
        save_run(self._training, self._model, self._journal, self._counters)
        save_actor(self._out, self._model.actor)
        with replacing(self._training / "outcome.json") as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(self.outcome()), indent=2) + "\n")

    def _log(self) -> None:
        """Points of all curves: SB3's own, and what it does not know of our episodes."""
        model = self._model
        recent = list(model.ep_info_buffer or ())
        for name in OUTCOMES if recent else ():
            value = sum(float(episode[name]) for episode in recent) / len(recent)
            model.logger.record(f"rollout/{name}", value)
        model.logger.record(
            "train/updates_per_env_step", model._n_updates / max(1, model.num_timesteps)
        )
        model.dump_logs()

    def _report(self, stage: str, share: float, seconds_left: float) -> None:
        if self._on_progress is None:
            return
        recent = [float(episode["r"]) for episode in self._model.ep_info_buffer or ()]
        steps = self._model.num_timesteps - self._begun[0]
        self._on_progress(
            Progress(
                stage=stage,
                share=share,
                env_steps=self._model.num_timesteps,
                updates=self._model._n_updates,
                env_steps_per_s=steps / max(1e-9, self._counters.elapsed_s - self._begun[1]),
                seconds_left=seconds_left,
                episode_return=sum(recent) / len(recent) if recent else math.nan,
                evaluation=self._evaluations[-1] if self._evaluations else None,
            )
        )


def _make_model(journal: Journal, settings: Settings, seed: int, device: str) -> SAC:
    return SAC(
        "MultiInputPolicy",
        journal,
        learning_rate=settings.learning_rate,
        buffer_size=settings.replay_size,
        learning_starts=settings.random_steps,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.gamma,
        train_freq=(settings.collect_steps, "step"),
        gradient_steps=settings.updates,
        target_update_interval=1,
        policy_kwargs=policy_kwargs(list(settings.hidden)),
        seed=seed,
        device=device,
    )


def _check(
    variant: AlignVariant,
    minutes: float | None,
    steps: int | None,
    seed: int,
    split: str,
    eval_every: int,
    eval_episodes: int,
    device: str,
) -> None:
    if minutes is None and steps is None:
        raise OptionError("say how long to train: give minutes or steps")
    for name, value in (("minutes", minutes), ("steps", steps)):
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise OptionError(f"{name} must be above 0, not {value}")
    if not 0 <= seed < 2**32:
        raise OptionError(f"seed must be from 0 to 2^32 - 1, not {seed}")
    if split == TEST_SPLIT:
        raise OptionError(f"split {TEST_SPLIT!r} is for scoring; train on another, such as train")
    for name, count in (("eval_every", eval_every), ("eval_episodes", eval_episodes)):
        if count < 1:
            raise OptionError(f"{name} must be at least 1, not {count}")
    others = [name for name in observation_names(variant.observations) if name not in INPUTS]
    if others or variant.normalise_observation:
        raise OptionError(
            f"the network reads {', '.join(INPUTS)}, and normalises them itself; leave out "
            f"{', '.join(others) or 'normalise_observation'}"
        )
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise OptionError(f"device {device!r} cannot be used: {reason}; use cpu") from error
