"""Where RL should matter most: a policy that learned from a few demonstrations, made better.

For every number of demonstrations and every seed a base is trained by cloning alone. From there on
three ways have the same number of environment steps: RL fine-tuning, which asks no expert; more
imitation, where the expert labels every one of those steps (DAgger); and RL from scratch, which has
no base. All lie in one folder; what is finished there is not done again.
"""

import contextlib
import dataclasses
import json
import math
import multiprocessing
import os
import queue
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import pydantic

from hvs_suite.errors import OptionError
from hvs_suite.eval.comparison import Tally
from hvs_suite.eval.result_file import Result
from hvs_suite.eval.study_training import Report, earlier_result, judge
from hvs_suite.policies.demonstrations import read_manifest
from hvs_suite.rollout import worker_conditions

FINETUNED, IMITATED, SCRATCH = "RL fine-tuning", "more imitation", "RL from scratch"
EVAL_EPISODES = 100
"""Scenes of an evaluation amid RL, at most."""
WEAK_BASE: Mapping[str, Any] = {
    "updates": 40,
    "warm_up_steps": 1_000,
    "bound": 1.2,
    "noise": 0.1,
    "penalty": 0.01,
}
"""What fine-tuning does otherwise than by default: a base that is far too slow must be changed by
more than one that is good already (docs/experiments/few-demonstrations.md)."""
GIGABYTES = ("cache", "dagger", "replay", "eyes")
"""Folders of a training that nobody asks for again."""

Note = Callable[[Any], None]


class Point(pydantic.BaseModel):
    """Success after some environment steps, on scenes that were not learned from.

    Attributes:
        env_steps: Steps played since the base.
        n: Scenes.
        n_success: Solved.
    """

    env_steps: int
    n: int
    n_success: int


class Curve(pydantic.BaseModel):
    """One run of one way.

    Attributes:
        way: Which.
        demonstrations: What its base learned from; 0 without a base.
        seed: Of base and run.
        points: In order. The first is the base's and the last the end's, both on split ``dev``;
            between them RL was evaluated on ``validation``, and DAgger on each round's own scenes
            before it learned from them.
        minutes: Playing and learning, the base's own training not counted (min).
    """

    way: str
    demonstrations: int
    seed: int
    points: list[Point]
    minutes: float


class Versus(pydantic.BaseModel):
    """Two ways from the same bases, at their ends, all seeds together.

    Attributes:
        demonstrations: What the bases learned from.
        way: The first.
        other: The second; ``base`` for the bases themselves.
        n_only_way: Scenes that the first alone solved.
        n_only_other: Scenes that the second alone solved.
        p: Of McNemar's exact test.
    """

    demonstrations: int
    way: str
    other: str
    n_only_way: int
    n_only_other: int
    p: float


class Study(pydantic.BaseModel):
    """All curves, and what they have in common.

    Attributes:
        task: Named task.
        env_steps: That each way has.
        base_steps: Optimiser steps of each base.
        seeds: How many.
        curves: One for each way, number of demonstrations and seed.
        comparisons: Of the ways at their ends.
    """

    task: str
    env_steps: int
    base_steps: int
    seeds: int
    curves: list[Curve]
    comparisons: list[Versus]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """What every run gets.

    Attributes:
        env_steps: Environment steps of each way.
        base_steps: Optimiser steps of each base.
        imitation_steps: Optimiser steps of the run that imitates more, its base's included.
        imitation_rounds: Rounds that its environment steps are spread over.
        eye_frames: Environment steps of fine-tuning that train the eyes, in two rounds.
        eye_steps: Optimiser steps of each of them.
        seeds: Runs of everything.
        episodes: Scenes of split ``dev`` that ends are judged on.
        processes: Processes that make runs side by side, each on one core.
    """

    env_steps: int
    base_steps: int
    imitation_steps: int
    imitation_rounds: int
    eye_frames: int
    eye_steps: int
    seeds: int
    episodes: int
    processes: int

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises:
            OptionError: A number is too small.
        """
        for field in dataclasses.fields(self):
            least = 0 if field.name == "eye_frames" else 1
            if getattr(self, field.name) < least:
                raise OptionError(
                    f"{field.name} must be at least {least}, not {getattr(self, field.name)}"
                )
        if self.eye_frames >= self.env_steps or self.imitation_rounds > self.env_steps:
            raise OptionError("env_steps must be more than eye_frames and imitation_rounds")


def run_study(
    data: Path, out: Path, counts: Sequence[int], budget: Budget, report: Report
) -> Study:
    """Make every run, or go on where an earlier call was interrupted.

    Args:
        data: Recorded dataset, whose task is played.
        out: Folder of the study.
        counts: Numbers of demonstrations.
        budget: What every run gets.
        report: Called as the work goes on.

    Raises:
        OptionError: A number makes no sense.
        DatasetError: The dataset cannot be trained on.
        OutputError: ``out`` cannot be written, or holds another study.
    """
    manifest = read_manifest(data)
    for count in counts:
        if not 2 <= count <= manifest.n_episodes:
            raise OptionError(
                f"demonstrations must be 2 to the dataset's {manifest.n_episodes}, not {count}"
            )
    maker = _Maker(data, manifest.task, out, budget, report)
    _make_side_by_side(maker, counts, report)
    curves: list[Curve] = []
    ends: dict[tuple[int, str], list[Result]] = {}
    for seed in range(budget.seeds):
        for count in counts:
            base = maker.base(count, seed)
            ends.setdefault((count, "base"), []).append(base)
            for way, make in ((FINETUNED, maker.finetuned), (IMITATED, maker.imitated)):
                points, end, minutes = make(count, seed)
                ends.setdefault((count, way), []).append(end)
                whole = [_point(0, base), *points, _point(budget.env_steps, end)]
                curves.append(
                    Curve(way=way, demonstrations=count, seed=seed, points=whole, minutes=minutes)
                )
        points, end, minutes = maker.scratch(seed)
        whole = [*points, _point(budget.env_steps, end)]
        curves.append(
            Curve(way=SCRATCH, demonstrations=0, seed=seed, points=whole, minutes=minutes)
        )
    pairs = ((FINETUNED, "base"), (IMITATED, "base"), (FINETUNED, IMITATED))
    return Study(
        task=manifest.task,
        env_steps=budget.env_steps,
        base_steps=budget.base_steps,
        seeds=budget.seeds,
        curves=curves,
        comparisons=[_versus(count, way, other, ends) for count in counts for way, other in pairs],
    )


_reports: "multiprocessing.Queue[tuple[str, float, str]]"
"""Of a process that makes runs: where its reports go."""
REPORTS_EVERY_S = 0.2


def _make_side_by_side(maker: "_Maker", counts: Sequence[int], report: Report) -> None:
    """Make all runs, those from the same base one after the other, in several processes."""
    context = multiprocessing.get_context("spawn")
    reports: multiprocessing.Queue[tuple[str, float, str]] = context.Queue()
    seeds = range(maker.budget.seeds)
    families = [(count, seed) for count in counts for seed in seeds]
    families += [(0, seed) for seed in seeds]
    silent = dataclasses.replace(maker, report=_report)
    with ProcessPoolExecutor(maker.budget.processes, context, _report_to, (reports,)) as pool:
        with worker_conditions():
            runs = [pool.submit(_make_family, silent, *family) for family in families]
        try:
            while not all(run.done() for run in runs):
                with contextlib.suppress(queue.Empty):
                    report(*reports.get(timeout=REPORTS_EVERY_S))
                for run in runs:
                    if run.done():
                        run.result()
        except BaseException:
            # A run goes on where it is when the same command is given again.
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _report_to(reports: "multiprocessing.Queue[tuple[str, float, str]]") -> None:
    global _reports
    _reports = reports
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process once its parent has ended, however that was killed.

    It would train on for an hour otherwise, and keep the folder from whoever goes on.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _report(stage: str, share: float, words: str) -> None:
    _reports.put((stage, share, words))


def _make_family(maker: "_Maker", count: int, seed: int) -> None:
    """Make a base and what comes of it; without demonstrations, the run that has none."""
    if count:
        for make in (maker.base, maker.finetuned, maker.imitated):
            make(count, seed)
    else:
        maker.scratch(seed)


@dataclasses.dataclass(frozen=True)
class _Maker:
    """Makes the runs of a study, each in a folder of its own."""

    data: Path
    task: str
    out: Path
    budget: Budget
    report: Report

    def base(self, count: int, seed: int) -> Result:
        """Clone some demonstrations."""
        from hvs_suite.policies.pretrain import pretrain

        def train(policy: Path, note: Note) -> None:
            pretrain(
                self.data,
                policy,
                steps=self.budget.base_steps,
                episodes=count,
                seed=seed,
                on_progress=note,
            )

        return self._made("base", count, seed, train)[1]

    def finetuned(self, count: int, seed: int) -> tuple[list[Point], Result, float]:
        """Fine-tune the base by RL."""
        from hvs_suite.policies.finetune.settings import Settings
        from hvs_suite.policies.finetune.training import finetune

        budget = self.budget
        steps = budget.env_steps - budget.eye_frames
        settings = Settings(
            eye_rounds=2 if budget.eye_frames >= 2 else 0,
            eye_frames=max(1, budget.eye_frames // 2),
            eye_steps=budget.eye_steps,
            environments=1,
            **WEAK_BASE,
        )

        def train(policy: Path, note: Note) -> None:
            finetune(
                self._folder("base", count, seed) / "policy",
                self.task,
                policy,
                steps=steps,
                seed=seed,
                settings=settings,
                eval_every=max(1, steps // 5),
                eval_episodes=min(EVAL_EPISODES, budget.episodes),
                on_progress=note,
            )

        training, end = self._made("finetuned", count, seed, train)
        return _evaluated(training, budget.eye_frames), end, _minutes(training)

    def imitated(self, count: int, seed: int) -> tuple[list[Point], Result, float]:
        """Let the expert label every step instead."""
        from hvs_suite.policies.pretrain import pretrain

        budget = self.budget
        frames = budget.env_steps // budget.imitation_rounds

        def train(policy: Path, note: Note) -> None:
            pretrain(
                self.data,
                policy,
                steps=budget.imitation_steps,
                episodes=count,
                seed=seed,
                dagger_rounds=budget.imitation_rounds,
                dagger_frames=frames,
                workers=1,
                on_progress=note,
            )

        training, end = self._made("imitated", count, seed, train)
        rounds = json.loads((training / "outcome.json").read_text())["rounds"]
        points = [
            Point(env_steps=i * frames, n=each["episodes"], n_success=each["successes"])
            for i, each in enumerate(rounds)
        ]
        # What the first round plays has learned more than its base, and has no steps yet.
        return points[1:], end, _minutes(training)

    def scratch(self, seed: int) -> tuple[list[Point], Result, float]:
        """Learn by RL alone, as the thesis did."""
        from hvs_suite.policies.sac.training import train_sac

        def train(policy: Path, note: Note) -> None:
            train_sac(
                self.task,
                policy,
                steps=self.budget.env_steps,
                seed=seed,
                eval_every=max(1, self.budget.env_steps // 5),
                eval_episodes=min(EVAL_EPISODES, self.budget.episodes),
                on_progress=note,
            )

        training, end = self._made("scratch", 0, seed, train)
        return _evaluated(training, 0), end, _minutes(training)

    def _folder(self, way: str, count: int, seed: int) -> Path:
        # Another budget is another experiment and lies beside the first.
        folder = self.out / f"steps-{self.budget.base_steps}-{self.budget.env_steps}"
        return folder / f"seed-{seed}" / (f"{way}-{count}" if count else way)

    def _made(
        self, way: str, count: int, seed: int, train: Callable[[Path, Note], None]
    ) -> tuple[Path, Result]:
        """Train and judge a run unless that is done; the folder of its training, and its result."""
        run, budget = self._folder(way, count, seed), self.budget
        training = run / "policy" / "training"
        name = f"{way}, {count} demonstrations, seed {seed}" if count else f"{way}, seed {seed}"
        result = earlier_result(run, budget.episodes)
        if result is None:

            def note(state: Any) -> None:
                left = "" if math.isnan(state.seconds_left) else f"{state.seconds_left:.0f} s left"
                self.report(f"{name}, {state.stage}", state.share, left)

            train(run / "policy", note)
            result = judge(
                name,
                run / "policy",
                self.task,
                run,
                self.report,
                scenarios=budget.episodes,
                workers=1,
            )
            for kept in GIGABYTES:
                shutil.rmtree(training / kept, ignore_errors=True)
        return training, result


def _minutes(training: Path) -> float:
    return float(json.loads((training / "outcome.json").read_text())["train_s"]) / 60.0


def _evaluated(training: Path, played_before: int) -> list[Point]:
    """What an RL run was worth amid its training, its end left out."""
    rows = json.loads((training / "evaluations.json").read_text())[:-1]
    return [
        Point(
            env_steps=played_before + row["env_steps"],
            n=row["episodes"],
            n_success=round(row["success_rate"] * row["episodes"]),
        )
        for row in rows
    ]


def _point(env_steps: int, result: Result) -> Point:
    summary = result.summary
    return Point(env_steps=env_steps, n=summary.n_episodes, n_success=summary.n_success)


def _versus(count: int, way: str, other: str, ends: dict[tuple[int, str], list[Result]]) -> Versus:
    """Two ways on the same scenes from the same bases."""
    sides = []
    for name in (way, other):
        outcomes = [
            {row.scenario: row.success for row in result.episodes} for result in ends[count, name]
        ]
        # The scenes of each seed's policies are the same; as pairs they are others.
        sides.append(
            {
                seed * len(rows) + scenario: success
                for seed, rows in enumerate(outcomes)
                for scenario, success in rows.items()
            }
        )
    tally = Tally.of(*sides)
    return Versus(
        demonstrations=count,
        way=way,
        other=other,
        n_only_way=tally.n_only_a,
        n_only_other=tally.n_only_b,
        p=tally.p,
    )
