"""What the board shows, whatever draws it: entries, their order, columns, and Markdown."""

import dataclasses
import html
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from hvs_suite import registry, statistics
from hvs_suite.eval.board.submission import Submission
from hvs_suite.eval.scoring.result_file import Result, SettledErrorSummary
from hvs_suite.names import shown
from hvs_suite.registry import TASKS

NOTE = (
    "Success is the share of scenarios solved, with its Wilson 95 % interval. Steps to goal are "
    "the mean over successes, beside it as a multiple of the expert's on the scenarios that both "
    "solve. Settled errors are taken at the time limit, the goal not ending the episode, over all "
    "episodes, failures included: interquartile mean with its bootstrap interval, and 95th "
    "percentile. The sharpest tolerance is the multiple of the task's own that 95 % of the "
    "scenarios settle within. Verified says what is proven. Replayed: the logged actions of so "
    "many scenarios, drawn after the result was handed in, were played again and gave the same "
    "numbers; that the named policy chose them, and how fast, is its submitter's word. Re-run: the "
    "maintainers ran the policy themselves, its weights or its server, on scenarios that nobody "
    "had seen, and reached a success that agrees."
)
DRAFT = (
    "This is a draft: results on it may hold fewer scenarios than a score takes, and nobody has "
    "held them against the rules of the board."
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
    """

    title: str
    value: Callable[[Entry], float | None]
    text: Callable[[Entry], str]
    larger_first: bool = False
    interval: Callable[[Entry], str] = lambda entry: ""


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


@dataclasses.dataclass(frozen=True)
class Overall:
    """One policy over all tasks of the board.

    Attributes:
        policy: Name on the board.
        entries: Its entries by task.
        mean: Mean success (percent), over the families that it was scored on, of each family's
            mean. A task of such a family that it was not scored on counts as 0 %, so that leaving
            out the hard ones does not lift it.
        low: Lower end of the mean's 95 % interval (percent).
        high: Upper end.
        n_families: Families that it was scored on.
        of_families: Families on the board.
    """

    policy: str
    entries: Mapping[str, Entry]
    mean: float
    low: float
    high: float
    n_families: int
    of_families: int

    @property
    def coverage(self) -> str:
        """How much of the board it was scored on."""
        return f"{self.n_families} of {self.of_families}"


def overall(entries: Sequence[Entry]) -> list[Overall]:
    """Returns each policy over all tasks: more families first, then the better mean, then by name.

    Args:
        entries: Of the whole board.
    """
    rows: dict[str, dict[str, Entry]] = {}
    for entry in sorted(entries, key=lambda e: (e.policy, e.task)):
        rows.setdefault(entry.policy, {})[entry.task] = entry
    family = {entry.task: registry.find(entry.result.summary.task).family for entry in entries}
    size = Counter(family.values())
    table = []
    for policy, row in rows.items():
        scored = {family[task] for task in row}
        weights = [1.0 / (size[family[task]] * len(scored)) for task in row]
        summaries = [entry.result.summary for entry in row.values()]
        low, high = statistics.mean_rate_interval(
            [(s.n_success, s.n_episodes) for s in summaries], weights=weights
        )
        mean = sum(w * s.pc_success for w, s in zip(weights, summaries, strict=True))
        table.append(Overall(policy, row, mean, low, high, len(scored), len(size)))
    return sorted(table, key=lambda row: (-row.n_families, -row.mean, row.policy))


MEANS = (
    "Mean success: first over the tasks of a family, where one without a result counts as 0 %, "
    "then over the families that a policy was scored on. Policies that were scored on more "
    "families come first."
)


def describe(task: str) -> str:
    """Returns what a task (its name, without version) asks for, in one line."""
    words = registry.find(task).describe()
    held = f", held for {words.held}" if words.held else ""
    return (
        f"start {words.start}; target: {words.target}; within {words.tolerance}{held}; "
        f"{words.time}; disturbed: {'nothing' if words.disturbances == '-' else words.disturbances}"
    )


def markdown(entries: Sequence[Entry], *, draft: bool = False) -> str:
    """Returns the board as Markdown; the same entries give the same text.

    Args:
        entries: One or more.
        draft: Say that it is one.
    """
    tables = by_task(entries)
    lines = [
        "# Leaderboard",
        "",
        *([f"**{DRAFT}**", ""] if draft else []),
        "`leaderboard.html` beside this file shows more: curves, landings, comparisons and clips. "
        "[SUBMITTING.md](SUBMITTING.md) says how to add a policy.",
        "",
        NOTE,
        "",
        "## All tasks",
        "",
        MEANS,
        "",
    ]
    lines += _table(
        ["policy", "mean", "families", *tables],
        [
            [
                row.policy,
                joined(percent(row.mean), interval(row.low, row.high)),
                row.coverage,
                *(_cell(row.entries.get(task)) for task in tables),
            ]
            for row in overall(entries)
        ],
    )
    for task, table in tables.items():
        summary = table[0].result.summary
        lines += ["", f"## {task}", "", describe(summary.task)]
        lines += [f"Split `{_plain(summary.split)}`.", ""]
        lines += _table(
            ["policy", *(column.title for column in columns(summary.task))],
            [
                [e.policy, *(joined(c.text(e), c.interval(e)) for c in columns(summary.task))]
                for e in table
            ],
        )
    lines += ["", "Written by `hvs leaderboard` from the result files; do not edit.", ""]
    return "\n".join(lines)


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


def escaped(text: str) -> str:
    """Returns text that HTML, and whoever reads it, takes for nothing but what it is."""
    return html.escape(shown(text))


def _cell(entry: Entry | None) -> str:
    if entry is None:
        return DASH
    return joined(SUCCESS.text(entry), SUCCESS.interval(entry))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns a Markdown table: names on the left, figures on the right."""
    return [
        "| " + " | ".join(_plain(cell) for cell in head) + " |",
        "|---" + "|--:" * (len(head) - 1) + "|",
        *("| " + " | ".join(_plain(cell) for cell in row) + " |" for row in rows),
    ]


def _plain(text: str) -> str:
    """Returns text that Markdown takes for nothing but text."""
    text = shown(text)
    for character in "\\|`<>[]*_":
        text = text.replace(character, f"&#{ord(character)};")
    return text
