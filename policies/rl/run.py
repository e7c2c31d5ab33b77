"""One sitting of an RL run: SB3's iterations, with evaluations, checkpoints and curves in between.

Killed, a run goes on from its last checkpoint when the same command is given again, and ends like
one that was left alone.
"""

import dataclasses
import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

from hvs_suite.files import replacing
from hvs_suite.policies.rl.curves import LoggedCurves
from hvs_suite.policies.rl.evaluation import Evaluator, read_evaluations, write_evaluations
from hvs_suite.policies.rl.guide import GUIDED
from hvs_suite.policies.rl.journal import OUTCOMES
from hvs_suite.policies.rl.outcome import Outcome, Progress
from hvs_suite.policies.rl.plot import draw_rl_run
from hvs_suite.policies.rl.state import Counters, load_run, save_run
from hvs_suite.policies.training.budget import Budget
from hvs_suite.policies.training.curves import Curves
from hvs_suite.rollout import Policy

LOG_EVERY = 10
"""Iterations between two points of a curve."""
RECENT = 100
"""Iterations that a rate is of; before anything is learned a run is many times faster."""


class Learner(Protocol):
    """What learns, and the policy that comes of it."""

    @property
    def model(self) -> SAC:
        """SB3's, its environment a journal."""

    def policy(self) -> Policy:
        """What the model has learnt so far, without exploration."""

    def keep(self) -> None:
        """Write what `policy` made into the run's folder, to be played from there."""


class Run:
    """One sitting.

    Args:
        out: Folder of the run; its state lives in ``out/training``.
        learner: What learns.
        evaluator: Evaluates it.
        on_progress: Called after every iteration and every episode of an evaluation.
    """

    def __init__(
        self,
        out: Path,
        learner: Learner,
        evaluator: Evaluator,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        self._training = out / "training"
        self._learner = learner
        self._model = model = learner.model
        self._evaluator = evaluator
        self._on_progress = on_progress
        self._counters: Counters = load_run(self._training, model)
        # Share of the budget, environment steps and seconds after each of the last iterations.
        self._recent: deque[tuple[float, int, float]] = deque(maxlen=RECENT + 1)
        self._evaluations = read_evaluations(
            self._training / "evaluations.json", model.num_timesteps
        )
        # Points of a sitting that was killed lie beyond the step of its last checkpoint.
        self._curves = Curves(self._training / "tensorboard", model.num_timesteps + 1)
        model.set_logger(Logger(None, [LoggedCurves(self._curves)]))

    def close(self) -> None:
        """Close the curves."""
        self._curves.close()

    def train(
        self, budget: Budget, collect_steps: int, eval_every: int, checkpoint_period_s: float
    ) -> None:
        """Train until the budget is used up.

        Args:
            budget: How long.
            collect_steps: Environment steps an iteration.
            eval_every: Environment steps between evaluations; one more comes at start and end.
            checkpoint_period_s: Time between checkpoints (s).
        """
        model, counters = self._model, self._counters
        share = budget.share(model.num_timesteps, counters.elapsed_s)
        self._recent.append((share, model.num_timesteps, counters.elapsed_s))
        if not self._evaluations:
            self._evaluate()
            self._checkpoint()
        last_checkpoint = time.perf_counter()
        iterations = 0
        while share < 1.0:
            started = time.perf_counter()
            # One iteration: SB3 collects `collect_steps` steps, then updates.
            model.learn(collect_steps, log_interval=sys.maxsize, reset_num_timesteps=False)
            counters.elapsed_s += time.perf_counter() - started
            iterations += 1
            share = budget.share(model.num_timesteps, counters.elapsed_s)
            self._recent.append((share, model.num_timesteps, counters.elapsed_s))
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
            self._report("training", share)
        draw_rl_run(self._training, self._evaluations)

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
            has_fallen=False,
        )

    def _evaluate(self) -> None:
        """Play greedily, film scene 0, keep the figures and the policy."""
        env_steps = self._model.num_timesteps
        evaluation = self._evaluator.evaluate(
            self._learner.policy(),
            env_steps,
            self._model._n_updates,
            self._training / "clips" / f"{env_steps:010d}.mp4",
            lambda done: self._report("evaluating", done / self._evaluator.episodes),
        )
        self._evaluations.append(evaluation)
        write_evaluations(self._training / "evaluations.json", self._evaluations)
        self._curves.add({f"eval/{k}": v for k, v in evaluation.figures().items()}, env_steps)
        self._learner.keep()

    def _checkpoint(self) -> None:
        save_run(self._training, self._model, self._counters)
        with replacing(self._training / "outcome.json") as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(self.outcome()), indent=2) + "\n")

    def _log(self) -> None:
        """Points of all curves: SB3's own, and what it does not know of our episodes."""
        model = self._model
        recent = list(model.ep_info_buffer or ())
        ends = [{**episode, **episode["errors"]} for episode in recent]
        guided = [GUIDED] if recent and GUIDED in recent[0] else []
        for name in (*OUTCOMES[:-1], *guided, *recent[0]["errors"]) if recent else ():
            value = sum(float(end[name]) for end in ends) / len(ends)
            model.logger.record(f"rollout/{name}", value)
        model.logger.record(
            "train/updates_per_env_step", model._n_updates / max(1, model.num_timesteps)
        )
        model.dump_logs()

    def _report(self, stage: str, share: float) -> None:
        if self._on_progress is None:
            return
        recent = [float(episode["r"]) for episode in self._model.ep_info_buffer or ()]
        share_then, steps_then, then = self._recent[0]
        share_now, steps_now, now = self._recent[-1]
        used = share_now - share_then
        self._on_progress(
            Progress(
                stage=stage,
                share=share,
                env_steps=self._model.num_timesteps,
                updates=self._model._n_updates,
                env_steps_per_s=(steps_now - steps_then) / max(1e-9, now - then),
                seconds_left=max(0.0, 1.0 - share_now) * (now - then) / used if used else math.nan,
                episode_return=sum(recent) / len(recent) if recent else math.nan,
                evaluation=self._evaluations[-1] if self._evaluations else None,
            )
        )
