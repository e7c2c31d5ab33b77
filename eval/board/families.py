"""What the page shows of a family: its tasks, and every policy on each of them."""

import dataclasses
import inspect
from collections.abc import Mapping, Sequence

from hvs_suite import registry
from hvs_suite.eval.board import entry_sheet, matrix, means, plots, tables
from hvs_suite.eval.board.entry_sheet import Film
from hvs_suite.eval.board.matrix import Pair
from hvs_suite.eval.board.means import Standing
from hvs_suite.eval.board.plots import Landings, Plot
from hvs_suite.eval.board.tables import VERIFIED, Column, Entry


@dataclasses.dataclass(frozen=True)
class Task:
    """What the page shows of a task.

    Attributes:
        name: Without version.
        identity: With it; its name within the page.
        hard: What is hard about it; empty if its family does not tell.
        split: Of the results.
        entries: The best first.
        columns: Of its table.
        films: The success of the best that has one, and the failure of the best that has one, each
            with its entry.
        tolerance_plot: None where a tolerance is 0.
        steps_plot: Success against time.
        landings: Each entry's; empty where they say nothing.
        tolerance_mm: The tolerance that they are shown around; None likewise.
        pairs: Each policy's row of comparisons; empty for a single policy.
    """

    name: str
    identity: str
    hard: str
    split: str
    entries: Sequence[Entry]
    columns: Sequence[Column]
    films: Sequence[tuple[Entry, Film]]
    tolerance_plot: Plot | None
    steps_plot: Plot
    landings: Sequence[tuple[Entry, Landings]]
    tolerance_mm: float | None
    pairs: Mapping[str, Sequence[Pair | None]]


@dataclasses.dataclass(frozen=True)
class Family:
    """What the page shows of a family.

    Attributes:
        name: Such as ``align``.
        about: What it is, in a line.
        names: Its named tasks, without version, be there a result of them or not.
        tasks: Those with a result.
        parts: The policies with a result: of all tasks, and of some.
        figures: What can be shown of each policy on each task.
    """

    name: str
    about: str
    names: Sequence[str]
    tasks: Mapping[str, Task]
    parts: Sequence[Sequence[Standing]]
    figures: Sequence[Column]

    def column(self, task: str, figure: Column) -> Column | None:
        """Returns the column of a task that holds a figure; None where it does not have it."""
        columns = self.tasks[task].columns if task in self.tasks else ()
        return next((column for column in columns if column.title == figure.title), None)


def families(
    by_task: Mapping[str, Sequence[Entry]],
    standings: Sequence[Standing],
    films: Mapping[tuple[str, str], Sequence[Film]],
) -> list[Family]:
    """Returns what the page shows of each family with a result.

    Args:
        by_task: Entries of each task, the best first, by the task's name with version.
        standings: Of the whole board.
        films: By (policy, task without version).
    """
    tasks = {
        table[0].result.summary.task: _task(identity, table, films)
        for identity, table in by_task.items()
    }
    named = means.families([entry for table in by_task.values() for entry in table])
    found = []
    for family, names in named.items():
        shown_tasks = {name: tasks[name] for name in names if name in tasks}
        figures = {
            column.title: column
            for task in shown_tasks.values()
            for column in task.columns
            if column is not VERIFIED
        }
        found.append(
            Family(
                family,
                (inspect.getdoc(registry.family_of(names[0])) or "").partition("\n")[0],
                names,
                shown_tasks,
                means.parted(means.of_family(standings, family), family),
                list(figures.values()),
            )
        )
    return found


def _task(
    identity: str, table: Sequence[Entry], films: Mapping[tuple[str, str], Sequence[Film]]
) -> Task:
    summary = table[0].result.summary
    tolerance = entry_sheet.sideways(table[0])
    # A bound of 0 has no multiples, so there is no curve of them.
    has_curve = summary.settled.success_by_scale is not None
    shown_films = [
        (entry, film) for entry in table for film in films.get((entry.policy, summary.task), ())
    ]
    chosen = (
        next(((entry, film) for entry, film in shown_films if film.kind == kind), None)
        for kind in ("success", "failure")
    )
    return Task(
        name=summary.task,
        identity=identity,
        hard=registry.family_of(summary.task).hard.get(summary.task, ""),
        split=summary.split,
        entries=table,
        columns=[column for column in tables.columns(summary.task) if not column.is_detail],
        films=[film for film in chosen if film is not None],
        tolerance_plot=plots.tolerance_plot(table) if has_curve else None,
        steps_plot=plots.steps_plot(table),
        landings=()
        if tolerance is None
        else [(e, plots.landings(e.result.episodes, 2 * tolerance, tolerance)) for e in table],
        tolerance_mm=tolerance,
        pairs=matrix.matrix(table) if len(table) > 1 else {},
    )
