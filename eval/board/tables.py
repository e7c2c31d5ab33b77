"""What the board shows, whatever draws it: entries, their order, and their columns."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from hvs_suite import registry
from hvs_suite.eval.board.submission import Submission
from hvs_suite.eval.scoring.result_file import Result, SettledErrorSummary
from hvs_suite.registry import TASKS

NOTES = (
    ("success", "The share of scenarios solved, with its Wilson 95 % interval."),
    (
        "steps to goal",
        "Their mean over the successes, and beside it the ratio to the expert's steps, on the "
        "scenarios that both solve.",
    ),
    (
        "errors, forces, shares of time",
        "What the family measures, over all episodes, failures included: the interquartile mean "
        "with its bootstrap 95 % interval. Settled errors are taken at the time limit, because "
        "there the goal does not end the episode.",
    ),
    (
        "sharpest tolerance",
        "The multiple of the task's own tolerances that 95 % of the scenarios end within.",
    ),
    (
        "replayed",
        "The logged actions of so many scenarios, drawn after the result was handed in, were "
        "played again and gave the same numbers. Only the submitter vouches that the named policy "
        "chose them, and how fast.",
    ),
    (
        "re-run",
        "The maintainers ran the policy itself (its weights or its server) on new scenarios, and "
        "its success agreed with the result.",
    ),
)
"""What the figures mean: term and explanation."""
DRAFT = (
    "This is a draft: its results may have fewer scenarios than a score needs, and they were not "
    "checked against the rules of the board."
)
DASH = "\N{EN DASH}"


@dataclasses.dataclass(frozen=True)
class Entry:
    """One policy's result on one task.

    Attributes:
        policy: Name on the board: the folder that holds the result.
        result: The checked result.
        n_played: Scenarios whose actions were played again, and gave the same numbers.
        steps_over_expert: Steps to goal over the expert's, on the scenarios that both solved; None
            where there are none, or no expert on the board.
        rerun: What the maintainers found when they ran the policy themselves; None if they did not.
    """

    policy: str
    result: Result
    n_played: int
    steps_over_expert: float | None = None
    rerun: Result | None = None

    @property
    def task(self) -> str:
        """Named task with its version, such as ``align-easy-v1``."""
        return f"{self.result.summary.task}-v{self.result.metadata.task_version}"

    @property
    def proof(self) -> str:
        """What is proven of it, such as ``replayed 20 of 1000``; `NOTE` says what that means."""
        n = self.result.summary.n_episodes
        replayed = f"replayed {'all' if self.n_played == n else f'{self.n_played} of'} {n}"
        if self.rerun is None:
            return replayed
        summary = self.rerun.summary
        return f"{replayed}, re-run: {summary.n_success} of {summary.n_episodes} solved"


@dataclasses.dataclass(frozen=True)
class Column:
    """One figure of an entry.

    Attributes:
        title: Heading, with the unit.
        value: Number to sort by; None where an entry has no such figure.
        text: The figure as people read it.
        larger_first: Sorting by it starts with the largest.
        interval: Its 95 % interval as people read it; empty where it has none.
        is_detail: The page shows it in the entry's sheet alone.
    """

    title: str
    value: Callable[[Entry], float | None]
    text: Callable[[Entry], str]
    larger_first: bool = False
    interval: Callable[[Entry], str] = lambda entry: ""
    is_detail: bool = False


SUCCESS = Column(
    "success",
    lambda e: e.result.summary.pc_success,
    lambda e: percent(e.result.summary.pc_success),
    larger_first=True,
    interval=lambda e: interval(*e.result.summary.pc_success_ci95),
)
VERIFIED = Column("verified", lambda e: e.n_played, lambda e: e.proof, larger_first=True)


def columns(task: str) -> tuple[Column, ...]:
    """Returns the columns of a task's table: what all tasks have, and its own headline metrics.

    Args:
        task: Its name, without version.
    """
    spec = registry.find(task)
    titles = {metric.name: (metric.title, metric.unit) for metric in spec.metrics}
    where = "settled " if spec.plays_on else ""
    own: list[Column] = []
    for name in spec.headline:
        title, unit = titles[name]
        own += [_middle(name, f"{where}{title}", unit), _tail(name, unit)]
    return (
        SUCCESS,
        Column(
            "collisions",
            lambda e: share(e, e.result.summary.n_collision),
            lambda e: percent(share(e, e.result.summary.n_collision)),
        ),
        Column(
            "steps to goal",
            lambda e: e.result.summary.steps_to_goal_mean,
            lambda e: figure(e.result.summary.steps_to_goal_mean),
        ),
        Column(
            "× expert's steps",
            lambda e: e.steps_over_expert,
            lambda e: figure(e.steps_over_expert),
        ),
        *own,
        Column(
            "sharpest tolerance (×)",
            lambda e: e.result.summary.settled.sharpest_95.scale,
            lambda e: figure(e.result.summary.settled.sharpest_95.scale),
        ),
        Column(
            "ms per decision",
            lambda e: e.result.timings.decision_ms,
            lambda e: figure(e.result.timings.decision_ms),
        ),
        VERIFIED,
    )


def _middle(name: str, title: str, unit: str) -> Column:
    """A metric's interquartile mean where the episodes ended."""
    return Column(
        f"{title} ({unit})" if unit else title,
        lambda e: e.result.summary.settled.errors[name].iqm,
        lambda e: figure(e.result.summary.settled.errors[name].iqm),
        interval=lambda e: iqm_interval(e.result.summary.settled.errors[name]),
    )


def _tail(name: str, unit: str) -> Column:
    """A metric's 95th percentile there."""
    return Column(
        f"p95 ({unit})" if unit else "p95",
        lambda e: e.result.summary.settled.errors[name].p95,
        lambda e: figure(e.result.summary.settled.errors[name].p95),
        is_detail=True,
    )


def make_entries(
    submissions: Sequence[Submission],
    replays: Mapping[str, int] | None = None,
    reruns: Mapping[str, Result] | None = None,
) -> list[Entry]:
    """Returns what the board shows of checked results.

    Args:
        submissions: One a policy and task.
        replays: How many scenarios were played again, by ``<policy>/<task>``; none by default.
        reruns: What the maintainers ran themselves, likewise.
    """
    experts = {
        entry.result.summary.task: entry.result
        for entry in submissions
        if entry.result.metadata.policy_kind == "builtin" and entry.path.parent.name == "expert"
    }
    entries = []
    for entry in submissions:
        name = f"{entry.path.parent.name}/{entry.path.stem}"
        expert = experts.get(entry.result.summary.task)
        entries.append(
            Entry(
                entry.path.parent.name,
                entry.result,
                (replays or {}).get(name, 0),
                None if expert is None else _steps_over(entry.result, expert),
                (reruns or {}).get(name),
            )
        )
    return entries


def by_task(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    """Returns the entries of each task, easiest task first, best entry first.

    Equal success is decided by the task's first headline metric, then by name.
    """
    tables: dict[str, list[Entry]] = {}
    names = list(TASKS)
    for entry in sorted(entries, key=lambda e: names.index(e.result.summary.task)):
        tables.setdefault(entry.task, []).append(entry)
    for table in tables.values():
        table.sort(
            key=lambda e: (
                -e.result.summary.pc_success,
                e.result.summary.settled.errors[_first_metric(e)].iqm,
                e.policy,
            )
        )
    return tables


def _first_metric(entry: Entry) -> str:
    return registry.find(entry.result.summary.task).headline[0]


def describe(task: str) -> list[tuple[str, str]]:
    """Returns what a task (its name, without version) asks for, as (what, in words)."""
    words = registry.find(task).describe()
    held = f", held for {words.held}" if words.held else ""
    return [
        ("Start", words.start),
        ("Target", words.target),
        ("Success", f"{words.tolerance}{held}"),
        ("Time", words.time),
        ("Disturbed", "nothing" if words.disturbances == "-" else words.disturbances),
    ]


def share(entry: Entry, count: int) -> float:
    """Returns a count of episodes as percent of all."""
    return 100 * count / entry.result.summary.n_episodes


def percent(value: float) -> str:
    """Returns a percentage with one decimal, without one where it is whole."""
    return f"{value:.1f}".removesuffix(".0") + " %"


def interval(low: float, high: float) -> str:
    """Returns an interval of percentages, such as ``23.1-88.2 %``."""
    return f"{low:.1f}{DASH}{high:.1f} %"


def iqm_interval(summary: SettledErrorSummary) -> str:
    """Returns the interval of an interquartile mean; empty where its ends read the same."""
    low, high = (figure(end) for end in summary.iqm_ci95)
    return "" if low == high else f"{low}{DASH}{high}"


def joined(text: str, interval: str) -> str:
    """Returns a figure with its interval in brackets, as far as it has one."""
    return f"{text} ({interval})" if interval else text


def figure(value: float | None) -> str:
    """Returns a number with two or three significant digits; a dash for None."""
    if value is None:
        return DASH
    if 0 < value < 0.0005:
        return "< 0.001"
    if value >= 100:
        return f"{value:.0f}"
    if value >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if value >= 0.1 or value == 0 else f"{value:.3f}"


def _steps_over(result: Result, expert: Result) -> float | None:
    pairs = [
        (own.steps_to_goal, theirs.steps_to_goal)
        for own, theirs in zip(result.episodes, expert.episodes, strict=False)
        if own.steps_to_goal is not None and theirs.steps_to_goal is not None
    ]
    return sum(own for own, _ in pairs) / sum(steps for _, steps in pairs) if pairs else None
