"""RL fine-tuning of an `hvs` policy: TD3 on a residual that moves its goal, top to bottom.

Fujimoto, van Hoof and Meger, 2018 (https://arxiv.org/abs/1802.09477), in the manner of CleanRL. It
starts exactly as the policy that it is given: the critics learn alone at first, a penalty holds the
residual to nothing, and an average of it over many updates plays in the end. A run is a function of
base, task, settings, seed and number of steps; killed, it goes on from its last checkpoint when the
same command is given again, and ends like one that was left alone.
"""

import contextlib
import copy
import dataclasses
import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from torch import Tensor

from hvs_suite.executor import worker_conditions
from hvs_suite.files import replacing
from hvs_suite.policies.belief.residual import N_LENGTHS, Residual
from hvs_suite.policies.catalogue import name_of
from hvs_suite.policies.residual.critics import Critics
from hvs_suite.policies.residual.folding import with_residual, write_folded
from hvs_suite.policies.residual.replay import Replay
from hvs_suite.policies.residual.session import begin, evaluate_and_keep, is_due
from hvs_suite.policies.residual.settings import Settings
from hvs_suite.policies.residual.stage import PRIVILEGED, READ, MakeStage, Place
from hvs_suite.policies.residual.state import load_state, save_state
from hvs_suite.policies.rl.curriculum import Kind
from hvs_suite.policies.rl.evaluation import (
    Evaluator,
    fallen,
    read_evaluations,
)
from hvs_suite.policies.rl.outcome import Outcome, Progress
from hvs_suite.policies.rl.plot import draw_rl_run
from hvs_suite.policies.training.budget import Budget
from hvs_suite.policies.training.curves import Curves
from hvs_suite.policies.training.run_folder import claimed, write_train_config
from hvs_suite.rollout import library_seeds, one_torch_thread

PACKAGES = ("gymnasium", "hvs-suite", "mujoco", "numpy", "torch")
ACTOR_EVERY = 2
"""Updates of the critics for each of the actor."""
LOG_EVERY = 200
"""Decisions between two points of a curve."""


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
    curriculum: Kind | None = None,
    split: str = "train",
    eval_every: int = 10_000,
    eval_episodes: int = 100,
    checkpoint_period_s: float = 120.0,
    on_progress: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Fine-tune an imitated policy, or go on with a run that was interrupted.

    Args:
        policy: Checkpoint of an `hvs` policy.
        task: Named task.
        out: Folder for the checkpoint, an `hvs` policy like the base; the training state
            lives in ``out/training``.
        minutes: Stop after this much playing and learning, evaluations not counted (min).
        steps: Stop after this many environment steps. Give either, or both for the first reached.
        seed: Of weights, scenes, exploration and batches; below 2^32.
        settings: Of the method.
        options: Task options that differ from the named task's, for studies.
        curriculum: Learn on easier levels first, of which each player climbs by its own success;
            evaluations are on the task itself. None for no easier ones.
        split: Stream of scenes to learn from; anything but ``test``.
        eval_every: Environment steps between evaluations; one more comes at start and end.
        eval_episodes: Scenes an evaluation, of the split ``validation``.
        checkpoint_period_s: Time between checkpoints (s).
        on_progress: Called as the run goes on.

    Returns:
        What the run came to.

    Raises:
        UnknownTaskError: There is no such task.
        PolicyError: The policy cannot be fine-tuned, does not fit the task, or comes near no goal.
        OptionError: No budget, or a value that makes no sense.
        OutputError: ``out`` cannot be written, or holds something else than this run.
    """
    settings = settings or Settings()
    budget = Budget(steps, minutes)
    begun = begin(
        policy, task, options,
        split=split, seed=seed, eval_every=eval_every, eval_episodes=eval_episodes,
    )  # fmt: skip
    spec, options, base = begun.spec, begun.options, begun.base
    identity = {**begun.identity, "curriculum": curriculum, **dataclasses.asdict(settings)}
    training = out / "training"
    with contextlib.ExitStack() as stack:
        stack.enter_context(claimed(out, identity))
        limits = {"minutes": minutes, "steps": steps}
        write_train_config(out, identity, limits, PACKAGES, policy=name_of(policy))
        stack.enter_context(one_torch_thread())
        stack.enter_context(library_seeds(seed))
        evaluator = stack.enter_context(contextlib.closing(Evaluator(spec, options, eval_episodes)))
        network = with_residual(base, settings)
        residual = network.residual
        assert residual is not None

        # What learns and what remembers.
        random = np.random.default_rng(seed)
        folder = str(policy.resolve())
        make = MakeStage(task, options, split, folder, settings, seed, curriculum=curriculum)
        widths = {READ: residual.n_inputs, PRIVILEGED: make.n_privileged}
        learner = Learner(residual, widths[PRIVILEGED], settings)
        after = {f"next_{name}": width for name, width in widths.items()}
        replay = Replay(
            settings.replay_size, {**widths, **after, "action": N_LENGTHS, "reward": 1, "over": 1}
        )
        parts = {**learner.parts(), "replay": replay}
        n = settings.environments
        counts: dict[str, Any] = load_state(training / "state.safetensors", parts) or {
            "env_steps": 0, "decisions": 0, "updates": 0, "episodes": 0, "elapsed_s": 0.0,
            "noise": np.zeros((n, N_LENGTHS)).tolist(), "recent": [],
            "places": [dataclasses.asdict(Place())] * n,
            "random": random.bit_generator.state,
        }  # fmt: skip
        random.bit_generator.state = counts["random"]
        noise = np.array(counts["noise"])
        sigma = np.array([settings.noise, settings.noise, settings.noise_along])
        recent: deque[dict[str, float]] = deque(counts["recent"], maxlen=100)
        places = [Place(**place) for place in counts["places"]]
        evaluations = read_evaluations(training / "evaluations.json", counts["env_steps"])
        curves = stack.enter_context(
            contextlib.closing(Curves(training / "tensorboard", counts["env_steps"] + 1))
        )
        with worker_conditions():
            players = _players(
                [dataclasses.replace(make, part=i, place=places[i]) for i in range(n)]
            )
        stack.callback(players.close)
        seen, info = players.reset()
        last_checkpoint = time.perf_counter()

        def report(stage: str, share: float) -> None:
            if on_progress is None:
                return
            played, elapsed_s = counts["env_steps"], counts["elapsed_s"]
            used = budget.share(played, elapsed_s)
            returns = [each["return"] for each in recent]
            on_progress(
                Progress(
                    stage=stage,
                    share=share,
                    env_steps=played,
                    updates=counts["updates"],
                    env_steps_per_s=played / max(1e-9, elapsed_s),
                    seconds_left=(1.0 - used) / used * elapsed_s if used else math.nan,
                    episode_return=sum(returns) / len(returns) if returns else math.nan,
                    evaluation=evaluations[-1] if evaluations else None,
                )
            )

        def outcome() -> Outcome:
            return Outcome(
                step=counts["updates"],
                env_steps=counts["env_steps"],
                updates_per_env_step=counts["updates"] / max(1, counts["env_steps"]),
                episodes=counts["episodes"],
                train_s=counts["elapsed_s"],
                env_steps_per_s=counts["env_steps"] / max(1e-9, counts["elapsed_s"]),
                n_parameters=sum(p.numel() for p in learner.actor.parameters()),
                evaluation=evaluations[-1] if evaluations else None,
                has_fallen=fallen(evaluations),
            )

        while True:
            share = budget.share(counts["env_steps"], counts["elapsed_s"])

            # Evaluate what would play, and keep the best of it.
            if is_due(evaluations, counts["env_steps"], eval_every, is_over=share >= 1.0):
                evaluate_and_keep(
                    lambda folder: write_folded(
                        policy, learner.average, network.shape, folder, spec
                    ),
                    evaluator, evaluations, out, spec,
                    env_steps=counts["env_steps"], updates=counts["updates"],
                    on_share=lambda part: report("evaluating", part),
                )  # fmt: skip
                figures = {f"eval/{k}": v for k, v in evaluations[-1].figures().items()}
                curves.add(figures, counts["env_steps"])
                last_checkpoint = -math.inf

            # Checkpoint.
            if time.perf_counter() - last_checkpoint >= checkpoint_period_s:
                counts |= {
                    "noise": noise.tolist(), "recent": list(recent),
                    "places": [dataclasses.asdict(place) for place in places],
                    "random": random.bit_generator.state,
                }  # fmt: skip
                save_state(training / "state.safetensors", parts, counts)
                with replacing(training / "outcome.json") as temporary:
                    temporary.write_text(json.dumps(dataclasses.asdict(outcome()), indent=2) + "\n")
                last_checkpoint = time.perf_counter()
            if share >= 1.0 or fallen(evaluations):
                break

            # Act.
            started = time.perf_counter()
            noise = (1.0 - settings.noise_decay) * noise + sigma * random.normal(size=noise.shape)
            with torch.inference_mode():
                action = learner.actor(torch.from_numpy(seen[READ])).numpy()
            action = np.clip(action + noise, -1.0, 1.0).astype(np.float32)
            players.step_async(action)

            # Update, while the players play.
            if len(replay) >= settings.batch_size:
                for _ in range(settings.updates * n):
                    learner.update(
                        replay.sample(settings.batch_size, random),
                        random,
                        with_actor=counts["decisions"] >= settings.warm_up_steps
                        and counts["updates"] % ACTOR_EVERY == 0,
                    )
                    counts["updates"] += 1

            # Store.
            following, reward, over, _, info = players.step_wait()
            replay.add(
                {**seen, **{f"next_{name}": following[name] for name in widths}}
                | {"action": action, "reward": reward[:, None], "over": over[:, None]}
            )
            seen = following
            for i in range(n):
                counted = {name: int(info[name][i]) for name in ("episode", "played", "level")}
                places[i] = Place(actions=info["actions"][i], recent=info["recent"][i], **counted)
                if over[i]:
                    ended = info["final_info"]
                    names = ("success", "collision", "return", "length")
                    recent.append({name: float(ended[name][i]) for name in names})
                    counts["episodes"] += 1
                    noise[i] = 0.0
            counts["env_steps"] = sum(place.played for place in places)
            counts["decisions"] += n
            counts["elapsed_s"] += time.perf_counter() - started

            # Show.
            if counts["decisions"] % LOG_EVERY < n and recent:
                played = {name: np.mean([each[name] for each in recent]) for name in recent[0]}
                rates = {f"rollout/{name}": float(value) for name, value in played.items()}
                curves.add({**rates, **learner.figures()}, counts["env_steps"])
            report("training", budget.share(counts["env_steps"], counts["elapsed_s"]))
        draw_rl_run(training, evaluations)
        return outcome()


class _PlayerHere(SyncVectorEnv):
    """A single player in this process: a study's worker may have no processes of its own."""

    def step_async(self, actions: Any) -> None:
        """Take an action; it is played when the result is asked for."""
        self._sent = actions

    def step_wait(self) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Play it."""
        return self.step(self._sent)


def _players(make: Sequence[MakeStage]) -> AsyncVectorEnv | _PlayerHere:
    """Players in processes of their own, but for a single one."""
    if len(make) == 1:
        return _PlayerHere(make, autoreset_mode=AutoresetMode.SAME_STEP)
    return AsyncVectorEnv(make, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)


class Learner:
    """Actor and critics, their slow copies, and the update.

    Args:
        residual: Where the actor begins.
        n_privileged: Numbers that critics see beyond those that it reads.
        settings: Of the method.
    """

    def __init__(self, residual: Residual, n_privileged: int, settings: Settings) -> None:
        self._settings = settings
        self.actor, self.average = copy.deepcopy(residual), copy.deepcopy(residual)
        self.critics = Critics(residual.n_inputs, n_privileged, settings.hidden)
        self.targets = copy.deepcopy(self.critics)
        self._actor_optimizer = torch.optim.Adam(
            self.actor.parameters(), lr=settings.actor_rate, fused=True
        )
        self._critic_optimizer = torch.optim.Adam(
            self.critics.parameters(), lr=settings.critic_rate, fused=True
        )
        self._figures: dict[str, Tensor] = {}

    def parts(self) -> dict[str, Any]:
        """All that a checkpoint has to keep, by name."""
        return {
            "actor": self.actor,
            "average": self.average,
            "critics": self.critics,
            "targets": self.targets,
            "actor_optimizer": self._actor_optimizer,
            "critic_optimizer": self._critic_optimizer,
        }

    def figures(self) -> dict[str, float]:
        """Of the last update, for curves."""
        return {f"train/{name}": value.item() for name, value in self._figures.items()}

    def update(
        self, batch: Mapping[str, Tensor], random: np.random.Generator, *, with_actor: bool
    ) -> None:
        """Learn from a batch.

        Args:
            batch: As `Replay.sample` gives it.
            random: Draws the noise on the target's actions.
            with_actor: Let the actor learn too, and its average follow.
        """
        settings = self._settings
        with torch.no_grad():
            read, privileged = batch[f"next_{READ}"], batch[f"next_{PRIVILEGED}"]
            drawn = random.normal(0.0, settings.target_noise, batch["action"].shape)
            most = 2.0 * settings.target_noise
            action = self.average(read) + torch.from_numpy(drawn).float().clamp(-most, most)
            ahead = self.targets(read, privileged, action.clamp(-1.0, 1.0)).amin(
                dim=1, keepdim=True
            )
            target = batch["reward"] + settings.gamma * (1.0 - batch["over"]) * ahead
        values = self.critics(batch[READ], batch[PRIVILEGED], batch["action"])
        loss = (values - target).square().mean()
        self._critic_optimizer.zero_grad()
        loss.backward()
        self._critic_optimizer.step()
        _follow(self.targets, self.critics, settings.tau)
        self._figures |= {"critic_loss": loss.detach(), "value": values.detach().mean()}
        if with_actor:
            action = self.actor(batch[READ])
            worth = self.critics(batch[READ], batch[PRIVILEGED], action)[:, 0]
            used = action.square().mean()
            # Normalised as in TD3+BC (Fujimoto and Gu, 2021), so that the penalty means the same
            # whatever the task pays.
            loss = -worth.mean() / worth.detach().abs().mean() + settings.penalty * used
            self._actor_optimizer.zero_grad()
            loss.backward()
            self._actor_optimizer.step()
            _follow(self.average, self.actor, settings.actor_tau)
            self._figures["residual"] = used.detach().sqrt()


@torch.no_grad()
def _follow(slow: torch.nn.Module, fast: torch.nn.Module, share: float) -> None:
    """Move a network a share of the way to another."""
    torch._foreach_lerp_(list(slow.parameters()), list(fast.parameters()), share)
