"""Soft actor-critic from scratch, as the thesis had it, on Stable-Baselines3.

A run is a function of task, settings, seed and number of steps. If it was killed, the same command
continues from the last checkpoint and ends like an uninterrupted run.
"""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from gymnasium import spaces
from stable_baselines3 import SAC

from hvs_suite.errors import OptionError, PolicyError
from hvs_suite.policies.belief.eye import Eye
from hvs_suite.policies.checkpoints.loading import load_network, weights_digest
from hvs_suite.policies.rl.evaluation import Evaluator
from hvs_suite.policies.rl.guide import Guide, PlayedActions
from hvs_suite.policies.rl.journal import Journal, make_journal
from hvs_suite.policies.rl.outcome import Outcome, Progress, check_run
from hvs_suite.policies.rl.run import Run
from hvs_suite.policies.sac.network import policy_kwargs
from hvs_suite.policies.sac.playing import GreedyActor, save_actor, write_config
from hvs_suite.policies.sac.settings import Settings
from hvs_suite.policies.training.budget import Budget
from hvs_suite.policies.training.process import check_device, prepare_process
from hvs_suite.policies.training.run_folder import claimed, write_train_config
from hvs_suite.registry import find, options_of
from hvs_suite.rollout import library_seeds
from hvs_suite.tasks.shared.spec import (
    PRESETS,
    THESIS_REWARDS,
    Spec,
)

PACKAGES = ("hvs-suite", "mujoco", "numpy", "stable-baselines3", "torch")
INPUTS = (*PRESETS["vision"], "joint_torques")


def train_sac(
    task: str,
    out: Path,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    settings: Settings | None = None,
    eyes_of: Path | None = None,
    guide: Guide | None = None,
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
        eyes_of: Checkpoint of an `hvs` policy whose eyes are to be used, where the settings have
            them pretrained.
        guide: Policy that plays some of the episodes, so that the replay memory holds what
            exploration would not find; None for exploration alone.
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
        PolicyError: The eyes are for other pictures, or the guide cannot play the task.
        OutputError: ``out`` cannot be written, or holds something else than this run.
    """
    settings = settings or Settings()
    spec = find(task).with_options({**(options or {}), "rewards": tuple(rewards)})
    options = options_of(spec)
    limit = Budget(steps, minutes)
    check_run(seed, split, eval_every, eval_episodes)
    _check(spec, settings, device)
    if (settings.eyes == "pretrained") != (eyes_of is not None):
        raise OptionError(
            "name the checkpoint whose eyes to use with pretrained eyes, and only then"
        )
    trained = {} if eyes_of is None else _trained_eyes(eyes_of, spec)
    prepare_process()
    identity = {
        "task": task,
        "task_version": spec.version,
        "options": options,
        "split": split,
        "seed": seed,
        "eyes_of": None if eyes_of is None else weights_digest(eyes_of),
        "guide": None if guide is None else [guide.name, guide.share],
        **json.loads(json.dumps(dataclasses.asdict(settings))),
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(claimed(out, identity))
        budget = {"minutes": minutes, "steps": steps}
        write_train_config(out, identity, budget, PACKAGES, device=device)
        # SB3 draws from the global generators of NumPy and torch.
        stack.enter_context(library_seeds(seed))
        journal = stack.enter_context(
            contextlib.closing(make_journal(spec, options, split, seed, guide))
        )
        model = _make_model(journal, settings, trained, seed, device)
        assert isinstance(model.observation_space, spaces.Dict)
        channels = next((eye.channels for eye in trained.values()), None)
        write_config(out, spec, model.observation_space, settings, channels)
        evaluator = stack.enter_context(contextlib.closing(Evaluator(spec, options, eval_episodes)))
        run = Run(out, _Sac(out, model), evaluator, on_progress)
        stack.callback(run.close)
        run.train(limit, settings.collect_steps, eval_every, checkpoint_period_s)
        return run.outcome()


class _Sac:
    """SAC as `Run` takes it."""

    def __init__(self, out: Path, model: SAC) -> None:
        self.model = model
        self._out = out

    def policy(self) -> GreedyActor:
        """The actor's most likely actions."""
        return GreedyActor(self.model.actor)

    def keep(self) -> None:
        """Write the actor."""
        save_actor(self._out, self.model.actor)


def _trained_eyes(folder: Path, spec: Spec) -> dict[str, Eye]:
    """The eye of each picture that a task shows, by name, from an `hvs` checkpoint."""
    network = load_network(folder)
    if network.shape.n_goals:
        raise PolicyError(f"the eyes of {folder} have to be told which target is meant")
    found: dict[str, Eye] = {}
    for name in (name for name in spec.observed if name in ("eih", "eth")):
        shown = getattr(spec, f"{name}_channels"), getattr(spec, f"{name}_resolution")
        if network.shape.cameras.get(name) != shown:
            raise PolicyError(
                f"the eyes of {folder} do not take {name} with {shown[0]} channels and "
                f"{shown[1]} px, as {spec.name} shows it"
            )
        found[name] = cast(Eye, network.eyes[name])
    return found


def _make_model(
    journal: Journal, settings: Settings, trained: Mapping[str, Eye], seed: int, device: str
) -> SAC:
    return SAC(
        "MultiInputPolicy",
        journal,
        replay_buffer_class=PlayedActions,
        learning_rate=settings.learning_rate,
        buffer_size=settings.replay_size,
        learning_starts=settings.random_steps,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.gamma,
        train_freq=(settings.collect_steps, "step"),
        gradient_steps=settings.updates,
        target_update_interval=1,
        policy_kwargs=policy_kwargs(settings, trained),
        seed=seed,
        device=device,
    )


def _check(spec: Spec, settings: Settings, device: str) -> None:
    if settings.eyes == "shared" and (
        not {"eih", "eth"} <= set(spec.observed) or spec.eih_channels != spec.eth_channels
    ):
        raise OptionError("shared eyes need both pictures, with the same number of channels")
    others = [name for name in spec.observed if name not in INPUTS]
    if others or spec.normalise_observation:
        raise OptionError(
            f"the network reads {', '.join(INPUTS)}, and normalises them itself; leave out "
            f"{', '.join(others) or 'normalise_observation'}"
        )
    check_device(device)
