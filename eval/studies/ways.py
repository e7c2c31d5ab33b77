"""Ways to make a policy for a study: each trains it, and says the commands that do the same.

A way is plain data, so its digest names the folder of what was made by it: cells that share a
recording or a base share the folder, and another budget lies beside the first.
"""

import dataclasses
import hashlib
import json
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hvs_suite.eval.studies.training import POLICY, Note, Point, evaluated, played_rounds
from hvs_suite.executor import Workers
from hvs_suite.policies.rl.curriculum import Kind
from hvs_suite.tasks.shared.option_types import to_text

NOISE_RAD = 0.02
"""As `hvs demo` records: without disturbance and starts near the goal little is learnt."""
EVERYWHERE_M = 10.0
"""How far from the goal fine-tuning moves it: a weak base may never come near."""
RL_STEPS = 8_000
"""Environment steps of RL in most studies; in the first 3,000 decisions only the critics learn."""
RL_EPISODES = 50
"""Scenes on which RL judges itself, at its start and at its end."""

type Options = Mapping[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recording:
    """Demonstrations of the expert.

    Attributes:
        task: Named task.
        episodes: How many.
        options: Task options that differ from it.
        noise: See `hvs_suite.datasets.recorder.record` (rad).
    """

    task: str
    episodes: int
    options: Options = dataclasses.field(default_factory=dict)
    noise: float = NOISE_RAD

    def folder(self, out: Path) -> Path:
        """Where a study keeps it."""
        return out / "data" / f"{self.task}-{self.episodes}-{digest(self)}"

    def make(self, out: Path, workers: Workers, on_progress: Note) -> None:
        """Record it into a study, or go on where that was interrupted."""
        from hvs_suite.datasets.recorder import record

        record(
            self.task,
            self.episodes,
            "train",
            self.folder(out),
            self.options,
            workers=workers,
            noise=self.noise,
            resume=True,
            progress=on_progress,
            command=self.command(out),
        )

    def command(self, out: Path) -> str:
        """The command that records it."""
        words = {"task": self.task, "episodes": self.episodes, "noise": self.noise}
        return command("record", {**words, "out": self.folder(out), "option": self.options})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Imitation:
    """Behaviour cloning, with DAgger where its settings say so.

    Attributes:
        data: What to learn from.
        steps: Optimiser steps.
        settings: Of `hvs_suite.policies.imitation.pretrain.pretrain`, where not the defaults.
        eyes: Named task of whose shipped weights the eyes begin with; None for fresh ones.
    """

    data: Recording
    steps: int
    settings: Options = dataclasses.field(default_factory=dict)
    eyes: str | None = None

    def folder(self, out: Path, seed: int) -> Path:
        """Where a study keeps the run."""
        return out / "runs" / f"imitation-{digest(self)}-seed-{seed}"

    def train(self, out: Path, seed: int, policy: Path, note: Note) -> None:
        """Train into a folder, on one core."""
        from hvs_suite.policies.catalogue import checkpoint_folder
        from hvs_suite.policies.imitation.pretrain import pretrain

        pretrain(
            self.data.folder(out),
            policy,
            steps=self.steps,
            eyes=[] if self.eyes is None else [checkpoint_folder("pretrained", self.eyes)],
            workers=1,
            seed=seed,
            on_progress=note,
            **self.settings,
        )

    def commands(self, out: Path, seed: int) -> Iterator[str]:
        """The commands that make the same policy."""
        yield self.data.command(out)
        words = {"data": self.data.folder(out), "out": self.folder(out, seed) / POLICY}
        yield command(
            "pretrain",
            {**words, "steps": self.steps, **self.settings, "eyes": self.eyes, "seed": seed},
        )

    def curve(self, out: Path, seed: int) -> list[Point]:
        """Success over environment steps; see `played_rounds`."""
        return played_rounds(self.folder(out, seed))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finetuning:
    """RL on top of an imitated policy of the same seed.

    Of start and end it keeps what was evaluated better, so harm shows as no help.

    Attributes:
        base: That policy.
        task: Named task.
        steps: Environment steps.
        settings: Of `hvs_suite.policies.residual.settings.Settings`, where not the study's.
        options: Task options that differ from the named task's.
        curriculum: See `hvs_suite.policies.residual.td3.finetune`.
        evaluations: How many there are after the one at the start; it keeps the best.
        eval_episodes: Scenes of each.
    """

    base: Imitation
    task: str
    steps: int
    settings: Options = dataclasses.field(default_factory=dict)
    options: Options = dataclasses.field(default_factory=dict)
    curriculum: Kind | None = None
    evaluations: int = 1
    eval_episodes: int = RL_EPISODES

    def folder(self, out: Path, seed: int) -> Path:
        """Where a study keeps the run."""
        return out / "runs" / f"finetuned-{digest(self)}-seed-{seed}"

    def train(self, out: Path, seed: int, policy: Path, note: Note) -> None:
        """Train into a folder, on one core."""
        from hvs_suite.policies.residual.settings import Settings
        from hvs_suite.policies.residual.td3 import finetune

        finetune(
            self.base.folder(out, seed) / POLICY,
            self.task,
            policy,
            steps=self.steps,
            seed=seed,
            settings=Settings(**self._settings()),
            options=self.options,
            curriculum=self.curriculum,
            eval_every=_period(self.steps, self.evaluations),
            eval_episodes=self.eval_episodes,
            on_progress=note,
        )

    def _settings(self) -> dict[str, Any]:
        return {"environments": 1, "reach_m": EVERYWHERE_M, **self.settings}

    def commands(self, out: Path, seed: int) -> Iterator[str]:
        """The commands that make the same policy."""
        yield from self.base.commands(out, seed)
        words = {
            "policy": self.base.folder(out, seed) / POLICY,
            "task": self.task,
            "out": self.folder(out, seed) / POLICY,
            "steps": self.steps,
            **self._settings(),
            "curriculum": self.curriculum,
            "eval_every": _period(self.steps, self.evaluations),
            "eval_episodes": self.eval_episodes,
            "seed": seed,
            "option": self.options,
        }
        yield command("finetune", words)

    def curve(self, out: Path, seed: int) -> list[Point]:
        """Success over environment steps."""
        return evaluated(self.folder(out, seed))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scratch:
    """SAC from nothing, as the thesis had it.

    Attributes:
        task: Named task.
        steps: Environment steps.
        settings: Of `hvs_suite.policies.sac.settings.Settings`, where not the thesis's.
        evaluations: How many there are after the one at the start.
        eval_episodes: Scenes of each.
    """

    task: str
    steps: int
    settings: Options = dataclasses.field(default_factory=dict)
    evaluations: int = 1
    eval_episodes: int = 20

    def folder(self, out: Path, seed: int) -> Path:
        """Where a study keeps the run."""
        return out / "runs" / f"scratch-{digest(self)}-seed-{seed}"

    def train(self, out: Path, seed: int, policy: Path, note: Note) -> None:
        """Train into a folder, on one core."""
        from hvs_suite.policies.sac.settings import Settings
        from hvs_suite.policies.sac.training import train_sac

        train_sac(
            self.task,
            policy,
            steps=self.steps,
            seed=seed,
            settings=Settings(**self.settings),
            eval_every=_period(self.steps, self.evaluations),
            eval_episodes=self.eval_episodes,
            on_progress=note,
        )

    def commands(self, out: Path, seed: int) -> Iterator[str]:
        """The command that makes the same policy."""
        words = {"task": self.task, "out": self.folder(out, seed) / POLICY, "steps": self.steps}
        every = _period(self.steps, self.evaluations)
        judged = {"eval_every": every, "eval_episodes": self.eval_episodes}
        yield command("train-sac", {**words, **self.settings, **judged, "seed": seed})

    def curve(self, out: Path, seed: int) -> list[Point]:
        """Success over environment steps."""
        return evaluated(self.folder(out, seed))


def _period(steps: int, evaluations: int) -> int:
    return max(1, steps // evaluations)


type Way = Imitation | Finetuning | Scratch


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effort:
    """What an imitated policy costs.

    Attributes:
        demonstrations: Episodes to record.
        steps: Optimiser steps.
        dagger_rounds: Rounds of DAgger.
        dagger_frames: Frames of each.
        batch_size: Frames that the eyes learn from in a step.
    """

    demonstrations: int
    steps: int
    dagger_rounds: int = 0
    dagger_frames: int = 3000
    batch_size: int = 64


TRIAL = Effort(demonstrations=4, steps=2, dagger_rounds=1, dagger_frames=8, batch_size=4)
"""Next to no training, to try a study out."""
FEW = Effort(demonstrations=25, steps=150)
"""What RL begins with in most studies: a policy that sees well and goes to the wrong place."""


def imitation(
    task: str,
    effort: Effort,
    options: Options = MappingProxyType({}),
    *,
    eyes: str | None = None,
    **settings: Any,
) -> Imitation:
    """A policy that learns from a recording of its own.

    Args:
        task: Named task.
        effort: What it costs.
        options: Task options to record with; half of the arms start near the goal if they name no
            other start.
        eyes: As in `Imitation`.
        **settings: Of `Imitation`, beside the effort's.
    """
    spent = dataclasses.asdict(effort)
    n, steps = spent.pop("demonstrations"), spent.pop("steps")
    data = Recording(task=task, episodes=n, options={"start": "mixed", **options})
    return Imitation(data=data, steps=steps, settings={**spent, **settings}, eyes=eyes)


def from_few(
    task: str,
    options: Options = MappingProxyType({}),
    *,
    quick: bool,
    demonstrations: int = FEW.demonstrations,
) -> Imitation:
    """What RL begins with: few demonstrations, and the eyes of the shipped weights.

    Eyes of its own would not do. RL moves the goal that they see, by some millimetres, and cannot
    mend what they miss.

    Args:
        task: Named task, which has shipped weights.
        options: Task options to record with, as in `imitation`.
        quick: Make next to no training of it.
        demonstrations: How many, if it is not a trial.
    """
    effort = TRIAL if quick else dataclasses.replace(FEW, demonstrations=demonstrations)
    return imitation(task, effort, options, eyes=task)


def tuned(base: Imitation, task: str, *, quick: bool, **options: Any) -> Finetuning:
    """A policy that goes on by RL.

    Args:
        base: What it begins with.
        task: Named task.
        quick: Make next to no training of it.
        **options: Of `Finetuning`.
    """
    way = Finetuning(base=base, task=task, steps=RL_STEPS, **options)
    return dataclasses.replace(way, steps=40, eval_episodes=2) if quick else way


def digest(plan: Any) -> str:
    """Names a plan, a dataclass, by what it holds."""
    content = json.dumps(dataclasses.asdict(plan), sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()[:8]


def slug(words: str) -> str:
    """Words as a part of a path."""
    return re.sub(r"[^a-z0-9.]+", "-", words.lower()).strip("-")


def command(name: str, words: Mapping[str, Any]) -> str:
    """A command line of ``hvs``.

    Args:
        name: Of the command.
        words: Values of its options; None leaves one out. Task options are a mapping, names that
            ``+`` joins are tuples.
    """
    line = ["hvs", name]
    for key, value in words.items():
        if isinstance(value, Mapping):
            for option, chosen in sorted(value.items()):
                line += ["--option", f"{option}={to_text(chosen)}"]
        elif value is not None:
            text = "+".join(value) if isinstance(value, tuple) else str(value)
            line += [f"--{key.replace('_', '-')}", text]
    return shlex.join(line)
