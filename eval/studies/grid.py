"""One runner for all studies that train in several ways and compare: a grid of cells and seeds.

A cell is a setting. Its policy is made in some way, with one seed after the other, and judged on
scenes. Recordings come first, played by all workers; then the policies that RL begins with; then
the cells, each on one core. All lie in one folder, a JSON file for each cell and seed among it;
what is finished there is not made again, and what was interrupted goes on.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import pydantic

from hvs_suite.errors import OptionError, OutputError
from hvs_suite.eval.scoring.comparison import Tally
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.eval.studies.training import (
    POLICY,
    SPLIT,
    Point,
    Report,
    Scenes,
    minutes,
    result_path,
    train_and_judge,
    train_once,
)
from hvs_suite.eval.studies.ways import (
    Finetuning,
    Imitation,
    Recording,
    Way,
    command,
    digest,
    slug,
)
from hvs_suite.executor import Workers, check_workers, spread
from hvs_suite.files import replacing
from hvs_suite.reading import read_json, validated
from hvs_suite.registry import find
from hvs_suite.rollout import one_torch_thread
from hvs_suite.statistics import holm, mean_rate_interval


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """A setting.

    Attributes:
        name: In its group.
        way: How its policies are made.
        on: What they are judged on.
        group: Cells that stand in one table, such as those of a task.
        against: The cell of its group that it is compared with; None for one that others are
            compared with.
        seeds: Its own; None for the plan's.
    """

    name: str
    way: Way
    on: Sequence[Scenes]
    group: str
    against: str | None = None
    seeds: Sequence[int] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """A study.

    Attributes:
        name: Of the command.
        question: What it asks.
        cells: Its cells; each stands after the one that it is compared with.
        seeds: With how many each is made, from 0 up.
        episodes: Scenes that each policy is judged on.
    """

    name: str
    question: str
    cells: Sequence[Cell]
    seeds: int
    episodes: int

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense.

        Raises:
            OptionError: There is one.
        """
        for name in ("seeds", "episodes"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")

    def jobs(self) -> list[tuple[Cell, int]]:
        """Every cell with each of its seeds."""
        return [
            (cell, seed)
            for cell in self.cells
            for seed in (range(self.seeds) if cell.seeds is None else cell.seeds)
        ]

    def chosen(self, names: Sequence[str]) -> list[Cell]:
        """Those cells, and what they are compared with.

        Args:
            names: Of cells; all if there is none.

        Raises:
            OptionError: There is no such cell.
        """
        known = list(dict.fromkeys(cell.name for cell in self.cells))
        if unknown := sorted({*names} - {*known}):
            raise OptionError(f"unknown cell {unknown[0]!r}; choose from {', '.join(known)}")
        wanted = {cell.name for cell in self.cells} if not names else {*names}
        # The last first: what a cell is compared with stands before it.
        for cell in reversed(self.cells):
            if cell.name in wanted and cell.against is not None:
                wanted.add(cell.against)
        return [cell for cell in self.cells if cell.name in wanted]


class Judged(pydantic.BaseModel):
    """How a policy did on some scenes.

    Attributes:
        scenes: Their name.
        solved: For each scene in order, a 1 if it was solved and a 0 if not.
        n_collision: Scenes that ended in a collision.
        steps_to_goal: Mean control steps to the goal; None if none was solved.
        settled: Interquartile mean of the task's first headline metric where episodes ended.
        metric: Title and unit of that.
    """

    scenes: str
    solved: Annotated[str, pydantic.Field(pattern="^[01]+$")]
    n_collision: int
    steps_to_goal: float | None
    settled: float
    metric: str

    @classmethod
    def of(cls, scenes: Scenes, result: Result) -> "Judged":
        """What a result says."""
        summary, spec = result.summary, find(scenes.task)
        name = spec.headline[0]
        [metric] = [each for each in spec.metrics if each.name == name]
        return cls(
            scenes=scenes.name,
            solved="".join("01"[row.success] for row in result.episodes),
            n_collision=summary.n_collision,
            steps_to_goal=summary.steps_to_goal_mean,
            settled=summary.settled.errors[name].iqm,
            metric=metric.label,
        )


class Finished(pydantic.BaseModel):
    """A policy of a cell, made and judged.

    Attributes:
        group: Of the cell.
        name: Of the cell.
        against: The cell that it is compared with.
        seed: Of all that was drawn.
        commands: What makes and judges the same policy, line by line.
        minutes: Time of its training on one core, its base's and evaluations not counted (min).
        curve: Success over the environment steps that it learned from, with its end, the first of
            ``judged``; empty for a way that plays none.
        judged: One for each of the cell's scenes.
    """

    group: str
    name: str
    against: str | None
    seed: int
    commands: list[str]
    minutes: float
    curve: list[Point] = []
    judged: list[Judged]


@dataclasses.dataclass(frozen=True)
class Row:
    """A cell on some scenes, all seeds together.

    Attributes:
        cell: Its policies; one for each seed.
        scenes: Name of the scenes.
        judged: How each did.
        rates: Solved by each (%).
        interval: 95 % interval of their mean (%), made of their Wilson intervals.
        only_other: Scenes that the cell that it is compared with alone solved.
        only_this: Scenes that this one alone solved.
        p: Of McNemar's exact test between them; None without one.
    """

    cell: Sequence[Finished]
    scenes: str
    judged: Sequence[Judged]
    rates: Sequence[float]
    interval: tuple[float, float]
    only_other: int = 0
    only_this: int = 0
    p: float | None = None

    @property
    def name(self) -> str:
        """Name of the cell."""
        return self.cell[0].name

    @property
    def rate(self) -> float:
        """Mean of the rates (%)."""
        return sum(self.rates) / len(self.rates)


class Study(pydantic.BaseModel):
    """All that is finished.

    Attributes:
        name: Of the command.
        question: What it asks.
        finished: By cell in the order of the plan, and by seed.
    """

    name: str
    question: str
    finished: list[Finished]

    def groups(self) -> list[str]:
        """Names of the groups, in order."""
        return list(dict.fromkeys(each.group for each in self.finished))

    def rows(self, group: str) -> list[Row]:
        """A row for each cell of a group and each of its scenes.

        The p-values are corrected by Holm over the rows of the group.
        """
        cells: dict[str, list[Finished]] = {}
        for each in self.finished:
            if each.group == group:
                cells.setdefault(each.name, []).append(each)
        rows = []
        for own in cells.values():
            for place, scenes in enumerate(judged.scenes for judged in own[0].judged):
                row = _row(own, place, scenes)
                others = cells.get(own[0].against or "", [])
                rows.append(_compared(row, others, place) if others else row)
        tested = [row for row in rows if row.p is not None]
        corrected = dict(
            zip(map(id, tested), holm([row.p for row in tested if row.p is not None]), strict=True)
        )
        return [dataclasses.replace(row, p=corrected.get(id(row))) for row in rows]


def _row(cell: Sequence[Finished], place: int, scenes: str) -> Row:
    judged = [each.judged[place] for each in cell]
    counts = [(each.solved.count("1"), len(each.solved)) for each in judged]
    rates = [100.0 * k / n for k, n in counts]
    return Row(cell, scenes, judged, rates, mean_rate_interval(counts))


def _compared(row: Row, others: Sequence[Finished], place: int) -> Row:
    """A row with its comparison: the same scenes and seeds, where both are there."""

    def outcomes(cell: Sequence[Finished]) -> dict[Any, bool]:
        return {
            (each.seed, scene): solved == "1"
            for each in cell
            for scene, solved in enumerate(each.judged[place].solved)
        }

    tally = Tally.of(outcomes(others), outcomes(row.cell))
    if not tally.n:
        return row
    return dataclasses.replace(row, only_other=tally.n_only_a, only_this=tally.n_only_b, p=tally.p)


def run_grid(
    plan: Plan,
    out: Path,
    report: Report,
    *,
    names: Sequence[str] = (),
    workers: Workers = 2,
    on_finished: Callable[[Study], object] | None = None,
) -> Study:
    """Make every cell with every seed, or go on where an earlier call was interrupted.

    Args:
        plan: The study.
        out: Its folder.
        report: Called as the work goes on.
        names: Cells to make, and what they are compared with; all if there is none.
        workers: Processes that make cells side by side, each on one core; or others elsewhere that
            see the same folder.
        on_finished: Called with all that is finished, each time that is more.

    Returns:
        The study, with all cells of the plan that are finished in the folder.

    Raises:
        OptionError: There is no such cell, or a number makes no sense.
        DatasetError: A dataset cannot be trained on.
        OutputError: ``out`` cannot be written, or a file there is damaged.
    """
    check_workers(workers)
    chosen = plan.chosen(names)
    make = Maker(out, out.resolve(), plan.episodes)
    order = plan.jobs()
    found = {_key(*each): make.read(*each) for each in order}

    def study() -> Study:
        finished = [each for each in found.values() if each is not None]
        return Study(name=plan.name, question=plan.question, finished=finished)

    missing = [each for each in order if each[0] in chosen and found[_key(*each)] is None]
    for each in make_all(make, missing, workers, report):
        found[each.group, each.name, each.seed] = each
        if on_finished is not None:
            on_finished(study())
    return study()


def _key(cell: Cell, seed: int) -> tuple[str, str, int]:
    return cell.group, cell.name, seed


def make_all(
    make: "Maker", jobs: Sequence[tuple[Cell, int]], workers: Workers, report: Report
) -> Iterator[Finished]:
    """Make cells, and before them what they share.

    Args:
        make: Makes them.
        jobs: Cells, each with a seed.
        workers: As in `run_grid`.
        report: Called as the work goes on.

    Yields:
        Each of them, in the order in which they end.
    """
    needed = [_learned_from(cell.way) for cell, _ in jobs]
    for data in {digest(each): each for each in needed if each is not None}.values():
        data.make(
            make.out,
            workers,
            lambda state, task=data.task: report(  # type: ignore[misc]
                f"recording {task}", state.episodes / state.total, f"{state.episodes} episodes"
            ),
        )
    bases = [(cell.way.base, seed) for cell, seed in jobs if isinstance(cell.way, Finetuning)]
    distinct = {base.folder(make.out, seed): (base, seed) for base, seed in bases}
    for wave in (list(distinct.values()), list(jobs)):
        # A training takes long: none waits for another while a worker is free.
        made = spread(
            dataclasses.replace(make, jobs=wave),
            range(len(wave)),
            workers=workers,
            ahead=1,
            on_note=lambda words: report(*words),
        )
        with contextlib.closing(made):
            for each in made:
                if each is not None:
                    yield each


def _learned_from(way: Way) -> Recording | None:
    """The recording that a way needs."""
    imitation = way.base if isinstance(way, Finetuning) else way
    return imitation.data if isinstance(imitation, Imitation) else None


@dataclasses.dataclass(frozen=True)
class Maker:
    """Makes cells, and the policies that RL begins with, for `hvs_suite.executor.spread`.

    Attributes:
        shown: Folder of the study, as the user named it.
        out: The same as any process finds it.
        episodes: Scenes that each policy is judged on.
        jobs: What to make, each with a seed.
    """

    shown: Path
    out: Path
    episodes: int
    jobs: Sequence[tuple[Cell | Imitation, int]] = ()

    @contextlib.contextmanager
    def __call__(self, note: Callable[[Any], None]) -> Iterator[Callable[[int], Finished | None]]:
        """A function that makes a job by its number."""

        def make(index: int) -> Finished | None:
            job, seed = self.jobs[index]
            with one_torch_thread():
                if isinstance(job, Cell):
                    return self._cell(job, seed, lambda *words: note(words))
                self._train(f"base, seed {seed}", job, seed, lambda *words: note(words))
                return None

        yield make

    def path(self, cell: Cell, seed: int) -> Path:
        """The file of a cell; another budget has another one."""
        name = f"{slug(cell.group)}-{slug(cell.name)}-{digest(cell)}-{self.episodes}-seed-{seed}"
        return self.out / "cells" / f"{name}.json"

    def read(self, cell: Cell, seed: int) -> Finished | None:
        """A cell that is finished.

        Raises:
            OutputError: Its file is damaged.
        """
        path = self.path(cell, seed)
        if not path.exists():
            return None
        return validated(Finished, read_json(path, error=OutputError), path, error=OutputError)

    def _train(self, name: str, way: Way, seed: int, report: Report) -> None:
        run = way.folder(self.out, seed)
        train_once(name, run, lambda policy, note: way.train(self.out, seed, policy, note), report)

    def _cell(self, cell: Cell, seed: int, report: Report) -> Finished | None:
        run = cell.way.folder(self.out, seed)
        results = train_and_judge(
            f"{cell.group}, {cell.name}, seed {seed}",
            run,
            lambda policy, note: cell.way.train(self.out, seed, policy, note),
            report,
            on=cell.on,
            scenarios=self.episodes,
            workers=1,
        )
        judged = [Judged.of(*each) for each in zip(cell.on, results, strict=True)]
        finished = Finished(
            group=cell.group,
            name=cell.name,
            against=cell.against,
            seed=seed,
            commands=self.commands(cell, seed),
            minutes=minutes(run),
            curve=_ended(cell.way.curve(self.out, seed), judged[0]),
            judged=judged,
        )
        path = self.path(cell, seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(finished.model_dump_json(indent=2) + "\n", encoding="utf-8")
        return finished

    def commands(self, cell: Cell, seed: int) -> list[str]:
        """What makes and judges a cell's policy."""
        run = cell.way.folder(self.shown, seed)
        judge = [
            command(
                "evaluate",
                {
                    "policy": run / POLICY,
                    "task": scenes.task,
                    "split": SPLIT,
                    "episodes": self.episodes,
                    "option": scenes.options,
                    "out": result_path(run, scenes, self.episodes),
                },
            )
            for scenes in cell.on
        ]
        return [*cell.way.commands(self.shown, seed), *judge]


def _ended(curve: Sequence[Point], end: Judged) -> list[Point]:
    """A curve that ends with what was judged."""
    if not curve:
        return []
    solved = end.solved.count("1")
    last = Point(env_steps=curve[-1].env_steps, n=len(end.solved), n_success=solved)
    return [*curve[:-1], last]
