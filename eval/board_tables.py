"""What the board shows, whatever draws it: entries, their order, columns, and Markdown."""

import dataclasses
from collections.abc import Callable, Sequence

from hvs_suite.eval.result_file import Result
from hvs_suite.tasks.variants import TASKS

NOTE = (
    "Success is the share of scenarios solved, with its Wilson 95 % interval. Errors are taken at "
    "the end of each episode's last control step, over all episodes, failures included. Steps to "
    "goal are the mean over successes."
)


@dataclasses.dataclass(frozen=True)
class Entry:
    """One policy's result on one task.

    Attributes:
        policy: Name on the board: the folder that holds the result.
        result: The checked result.
    """

    policy: str
    result: Result

    @property
    def task(self) -> str:
        """Named task with its version, such as ``align-easy-v1``."""
        return f"{self.result.summary.task}-v{self.result.metadata.task_version}"


@dataclasses.dataclass(frozen=True)
class Column:
    """One figure of an entry.

    Attributes:
        title: Heading, with the unit.
        value: Number to sort by; None where an entry has no such figure.
        text: The figure as people read it.
        larger_first: Sorting by it starts with the largest.
    """

    title: str
    value: Callable[[Result], float | None]
    text: Callable[[Result], str]
    larger_first: bool = False


COLUMNS = (
    Column(
        "success",
        lambda r: r.summary.pc_success,
        lambda r: percent(r.summary.pc_success),
        larger_first=True,
    ),
    Column(
        "95 % interval",
        lambda r: r.summary.pc_success_ci95[0],
        lambda r: interval(r),
        larger_first=True,
    ),
    Column(
        "collisions",
        lambda r: 100 * r.summary.n_collision / r.summary.n_episodes,
        lambda r: percent(100 * r.summary.n_collision / r.summary.n_episodes),
    ),
    Column(
        "steps to goal",
        lambda r: r.summary.steps_to_goal_mean,
        lambda r: figure(r.summary.steps_to_goal_mean),
    ),
    Column(
        "position error, median (mm)",
        lambda r: r.summary.position_error_mm.p50,
        lambda r: figure(r.summary.position_error_mm.p50),
    ),
    Column(
        "position error, p95 (mm)",
        lambda r: r.summary.position_error_mm.p95,
        lambda r: figure(r.summary.position_error_mm.p95),
    ),
    Column(
        "tilt error, median (deg)",
        lambda r: r.summary.tilt_error_deg.p50,
        lambda r: figure(r.summary.tilt_error_deg.p50),
    ),
    Column(
        "tilt error, p95 (deg)",
        lambda r: r.summary.tilt_error_deg.p95,
        lambda r: figure(r.summary.tilt_error_deg.p95),
    ),
    Column(
        "ms per decision",
        lambda r: r.timings.decision_ms,
        lambda r: figure(r.timings.decision_ms),
    ),
    Column(
        "scenarios",
        lambda r: r.summary.n_episodes,
        lambda r: str(r.summary.n_episodes),
        larger_first=True,
    ),
)


def by_task(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    """Returns the entries of each task, easiest task first, best entry first.

    Equal success is decided by the median position error, then by name.
    """
    tables: dict[str, list[Entry]] = {}
    names = list(TASKS)
    for entry in sorted(entries, key=lambda e: names.index(e.result.summary.task)):
        tables.setdefault(entry.task, []).append(entry)
    for table in tables.values():
        table.sort(
            key=lambda e: (
                -e.result.summary.pc_success,
                e.result.summary.position_error_mm.p50,
                e.policy,
            )
        )
    return tables


def overall(entries: Sequence[Entry]) -> dict[str, dict[str, Entry]]:
    """Returns policy -> task -> entry, policies by their mean success over all tasks.

    A task that a policy was not scored on counts as 0 %, so that leaving out the hard ones does
    not lift an entry; ties go by name.
    """
    rows: dict[str, dict[str, Entry]] = {}
    for entry in sorted(entries, key=lambda e: (e.policy, e.task)):
        rows.setdefault(entry.policy, {})[entry.task] = entry
    total = {
        policy: sum(entry.result.summary.pc_success for entry in row.values())
        for policy, row in rows.items()
    }
    return {policy: rows[policy] for policy in sorted(rows, key=lambda p: (-total[p], p))}


def markdown(entries: Sequence[Entry]) -> str:
    """Returns the board as Markdown; the same entries give the same text."""
    tables = by_task(entries)
    lines = ["# Leaderboard", "", NOTE, "", "## Success on all tasks", ""]
    lines += _table(
        ["policy", *tables],
        [
            [policy, *(_cell(row.get(task)) for task in tables)]
            for policy, row in overall(entries).items()
        ],
    )
    for task, table in tables.items():
        split = table[0].result.summary.split
        lines += ["", f"## {task}", "", f"First scenarios of the split `{_plain(split)}`.", ""]
        lines += _table(
            ["policy", *(column.title for column in COLUMNS)],
            [[e.policy, *(column.text(e.result) for column in COLUMNS)] for e in table],
        )
    lines += ["", "Written by `hvs leaderboard` from the result files; do not edit.", ""]
    return "\n".join(lines)


def percent(value: float) -> str:
    """Returns a percentage with one decimal, without one where it is whole."""
    return f"{value:.1f}".removesuffix(".0") + " %"


def interval(result: Result) -> str:
    """Returns the interval of the success rate, such as ``23.1-88.2 %``."""
    low, high = result.summary.pc_success_ci95
    return f"{low:.1f}\N{EN DASH}{high:.1f} %"


def figure(value: float | None) -> str:
    """Returns a number with two or three significant digits; a dash for None."""
    if value is None:
        return "\N{EN DASH}"
    if 0 < value < 0.005:
        return "< 0.01"
    if value >= 100:
        return f"{value:.0f}"
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def _cell(entry: Entry | None) -> str:
    if entry is None:
        return "\N{EN DASH}"
    return f"{percent(entry.result.summary.pc_success)} ({interval(entry.result)})"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns a Markdown table: names on the left, figures on the right."""
    return [
        "| " + " | ".join(_plain(cell) for cell in head) + " |",
        "|---" + "|--:" * (len(head) - 1) + "|",
        *("| " + " | ".join(_plain(cell) for cell in row) + " |" for row in rows),
    ]


def _plain(text: str) -> str:
    """Returns text that Markdown takes for nothing but text."""
    for character in "\\|`<>[]*_":
        text = text.replace(character, f"&#{ord(character)};")
    return text
