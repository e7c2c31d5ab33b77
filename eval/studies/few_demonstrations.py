"""Where RL should matter most: a policy that learned from a few demonstrations, made better.

For every number of demonstrations and every seed a base is trained by cloning alone. From there on
three ways have the same number of environment steps: RL fine-tuning, which asks no expert; more
imitation, where the expert labels every one of those steps (DAgger); and RL from scratch, which has
no base. All lie in one folder; what is finished there is not done again.
"""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import pydantic

from hvs_suite.errors import OptionError, OutputError
from hvs_suite.eval.scoring.comparison import Tally
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.eval.studies.training import Note, Report, Scenes, minutes, train_and_judge
from hvs_suite.executor import Workers, check_workers, spread
from hvs_suite.files import replacing
from hvs_suite.policies.training.dataset import read_manifest
from hvs_suite.rollout import one_torch_thread

BASE = "base"
FINETUNED, IMITATED, SCRATCH = "RL fine-tuning", "more imitation", "RL from scratch"
EVAL_EPISODES = 100
"""Largest number of scenes of an evaluation during RL."""
EVERYWHERE_M = 10.0
"""How far from the goal fine-tuning moves it: a weak base may never come near."""
STUDY_FILE = "study.json"


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
    """How one way went on from a base, or from nothing.

    Attributes:
        points: In order. The first is the base's and the last the end's, both on split ``dev``;
            between them RL was evaluated on ``validation``, and DAgger on each round's own scenes
            before it learned from them.
        minutes: Playing and learning on one core, evaluations not counted; imitation learns what
            its base learned again (min).
    """

    points: list[Point]
    minutes: float


class End(pydantic.BaseModel):
    """A finished policy on split ``dev``.

    Attributes:
        solved: For each scene in order, a 1 if it was solved and a 0 if not.
        n_collision: Scenes that ended in a collision.
    """

    solved: Annotated[str, pydantic.Field(pattern="^[01]*$")]
    n_collision: int


class Family(pydantic.BaseModel):
    """What came of one base, or of none.

    Attributes:
        demonstrations: What the base learned from; 0 without a base.
        seed: Of base and runs.
        curves: By way.
        ends: By way, and of the base itself.
    """

    demonstrations: int
    seed: int
    curves: dict[str, Curve]
    ends: dict[str, End]


class Versus(pydantic.BaseModel):
    """Two ways from the same bases, at their ends, all seeds together.

    Attributes:
        demonstrations: What the bases learned from.
        way: The first.
        other: The second.
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """What every run gets.

    Attributes:
        env_steps: Environment steps of each way.
        base_steps: Optimiser steps of each base.
        imitation_steps: Optimiser steps of the run that imitates more, its base's included.
        imitation_rounds: Rounds that its environment steps are spread over.
        episodes: Scenes of split ``dev`` that ends are judged on.
    """

    env_steps: int
    base_steps: int
    imitation_steps: int
    imitation_rounds: int
    episodes: int

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises:
            OptionError: A number is too small.
        """
        for field in dataclasses.fields(self):
            if getattr(self, field.name) < 1:
                raise OptionError(
                    f"{field.name} must be at least 1, not {getattr(self, field.name)}"
                )
        if self.imitation_rounds > self.env_steps:
            raise OptionError("env_steps must be at least imitation_rounds")


class Study(pydantic.BaseModel):
    """All that is finished.

    Attributes:
        task: Named task.
        budget: What every run had.
        families: By number of demonstrations, and by seed.
    """

    task: str
    budget: Budget
    families: list[Family]

    def of(self, demonstrations: int) -> list[Family]:
        """Returns the families of a number of demonstrations, one for each seed."""
        return [each for each in self.families if each.demonstrations == demonstrations]

    def counts(self) -> list[int]:
        """Returns the numbers of demonstrations, in order."""
        return sorted({family.demonstrations for family in self.families} - {0})

    def comparisons(self) -> list[Versus]:
        """Returns the ways against each other and against the base."""
        pairs = ((FINETUNED, BASE), (IMITATED, BASE), (FINETUNED, IMITATED))
        return [self._versus(count, *pair) for count in self.counts() for pair in pairs]

    def _versus(self, count: int, way: str, other: str) -> Versus:
        # The scenes of each seed's policies are the same; as pairs they are others.
        sides = [
            {
                family.seed * self.budget.episodes + scene: solved == "1"
                for family in self.of(count)
                for scene, solved in enumerate(family.ends[name].solved)
            }
            for name in (way, other)
        ]
        tally = Tally.of(*sides)
        return Versus(
            demonstrations=count,
            way=way,
            other=other,
            n_only_way=tally.n_only_a,
            n_only_other=tally.n_only_b,
            p=tally.p,
        )


def run_study(
    data: Path,
    out: Path,
    counts: Sequence[int],
    budget: Budget,
    report: Report,
    *,
    seeds: int = 3,
    workers: Workers = 2,
    on_finished: Callable[[Study], object] | None = None,
) -> Study:
    """Make every run, or go on where an earlier call was interrupted.

    Args:
        data: Recorded dataset, whose task is played.
        out: Folder of the study. Its ``study.json`` keeps what is finished, and is all that is
            needed to go on elsewhere with other numbers of demonstrations.
        counts: Numbers of demonstrations.
        budget: What every run gets.
        report: Called as the work goes on.
        seeds: Runs of everything.
        workers: Processes that make runs side by side, each on one core; or others elsewhere that
            see the same folders.
        on_finished: Called with all that is finished, each time that is more.

    Returns:
        The study, with all else that is finished in the folder.

    Raises:
        OptionError: A number makes no sense.
        DatasetError: The dataset cannot be trained on.
        OutputError: ``out`` cannot be written, or holds another study.
    """
    check_workers(workers)
    if seeds < 1:
        raise OptionError(f"seeds must be at least 1, not {seeds}")
    manifest = read_manifest(data)
    for count in counts:
        if not 2 <= count <= manifest.n_episodes:
            raise OptionError(
                f"demonstrations must be 2 to the dataset's {manifest.n_episodes}, not {count}"
            )
    study = _begun(out / STUDY_FILE, Study(task=manifest.task, budget=budget, families=[]))
    finished = {(family.demonstrations, family.seed) for family in study.families}
    wanted = [(count, seed) for count in (*counts, 0) for seed in range(seeds)]

    def keep(family: Family) -> None:
        study.families.append(family)
        study.families.sort(key=lambda each: (each.demonstrations, each.seed))
        with replacing(out / STUDY_FILE) as temporary:
            temporary.write_text(study.model_dump_json(indent=2) + "\n", encoding="utf-8")
        if on_finished is not None:
            on_finished(study)

    missing = [each for each in wanted if each not in finished]
    make = _MakeFamilies(data.resolve(), manifest.task, out.resolve(), budget, missing)
    # A family takes hours: none waits for another while a worker is free.
    made = spread(
        make,
        range(len(missing)),
        workers=workers,
        ahead=1,
        on_note=lambda words: report(*words),
    )
    with contextlib.closing(made):
        for family in made:
            keep(family)
    return study


def _begun(path: Path, new: Study) -> Study:
    """The study that a file keeps, or a new one."""
    if not path.exists():
        return new
    try:
        study = Study.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} is not of such a study; choose another folder") from error
    if (study.task, study.budget) != (new.task, new.budget):
        raise OutputError(
            f"{path} is of another task or budget ({study.task}, {study.budget}); "
            "give the same again, or choose another folder"
        )
    return study


@dataclasses.dataclass(frozen=True)
class _MakeFamilies:
    """Makes families, the runs of each one after the other, for `hvs_suite.executor.spread`."""

    data: Path
    task: str
    out: Path
    budget: Budget
    families: Sequence[tuple[int, int]]

    @contextlib.contextmanager
    def __call__(self, note: Callable[[Any], None]) -> Iterator[Callable[[int], Family]]:
        maker = _Maker(self.data, self.task, self.out, self.budget, lambda *words: note(words))

        def make(index: int) -> Family:
            with one_torch_thread():
                return _make_family(maker, *self.families[index])

        yield make


def _make_family(maker: "_Maker", count: int, seed: int) -> Family:
    """Make a base and what comes of it; without demonstrations, the run that has none."""
    family = Family(demonstrations=count, seed=seed, curves={}, ends={})
    first = []
    if count:
        base = maker.base(count, seed)
        first = [_point(0, base)]
        family.ends[BASE] = _end(base)
        runs = {
            FINETUNED: maker.finetuned(count, seed),
            IMITATED: maker.imitated(count, seed),
        }
    else:
        runs = {SCRATCH: maker.scratch(seed)}
    for way, (points, end, taken_min) in runs.items():
        whole = [*first, *points, _point(maker.budget.env_steps, end)]
        family.curves[way] = Curve(points=whole, minutes=taken_min)
        family.ends[way] = _end(end)
    return family


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
        from hvs_suite.policies.imitation.pretrain import pretrain

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
        from hvs_suite.policies.residual.settings import Settings
        from hvs_suite.policies.residual.td3 import finetune

        steps = self.budget.env_steps

        def train(policy: Path, note: Note) -> None:
            finetune(
                self._folder("base", count, seed) / "policy",
                self.task,
                policy,
                steps=steps,
                seed=seed,
                settings=Settings(environments=1, reach_m=EVERYWHERE_M),
                eval_every=max(1, steps // 5),
                eval_episodes=min(EVAL_EPISODES, self.budget.episodes),
                on_progress=note,
            )

        run, end = self._made("finetuned", count, seed, train)
        return _evaluated(run), end, minutes(run)

    def imitated(self, count: int, seed: int) -> tuple[list[Point], Result, float]:
        """Let the expert label every step instead."""
        from hvs_suite.policies.imitation.pretrain import pretrain

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

        run, end = self._made("imitated", count, seed, train)
        rounds = json.loads((run / "policy/training/outcome.json").read_text())["rounds"]
        points = [
            Point(env_steps=i * frames, n=each["episodes"], n_success=each["successes"])
            for i, each in enumerate(rounds)
        ]
        # What the first round plays has learned more than its base, and has no steps yet.
        return points[1:], end, minutes(run)

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

        run, end = self._made("scratch", 0, seed, train)
        return _evaluated(run), end, minutes(run)

    def _folder(self, way: str, count: int, seed: int) -> Path:
        return self.out / f"seed-{seed}" / (f"{way}-{count}" if count else way)

    def _made(
        self, way: str, count: int, seed: int, train: Callable[[Path, Note], None]
    ) -> tuple[Path, Result]:
        """Train and judge a run unless that is done; its folder and its result."""
        run, budget = self._folder(way, count, seed), self.budget
        name = f"{way}, {count} demonstrations, seed {seed}" if count else f"{way}, seed {seed}"
        [result] = train_and_judge(
            name,
            run,
            train,
            self.report,
            on=[Scenes(task=self.task)],
            scenarios=budget.episodes,
            workers=1,
        )
        return run, result


def _evaluated(run: Path) -> list[Point]:
    """Success of an RL run during its training, without its end."""
    rows = json.loads((run / "policy/training/evaluations.json").read_text())[:-1]
    return [
        Point(
            env_steps=row["env_steps"],
            n=row["episodes"],
            n_success=round(row["success_rate"] * row["episodes"]),
        )
        for row in rows
    ]


def _point(env_steps: int, result: Result) -> Point:
    summary = result.summary
    return Point(env_steps=env_steps, n=summary.n_episodes, n_success=summary.n_success)


def _end(result: Result) -> End:
    return End(
        solved="".join("01"[row.success] for row in result.episodes),
        n_collision=result.summary.n_collision,
    )
