"""The board as Markdown: what a reader of the repository sees without a browser."""

from collections.abc import Mapping, Sequence

from hvs_suite.eval.board import means
from hvs_suite.eval.board.means import Mean
from hvs_suite.eval.board.tables import (
    DASH,
    DRAFT,
    NOTES,
    SUCCESS,
    Entry,
    by_task,
    columns,
    describe,
    figure,
    interval,
    joined,
    percent,
)
from hvs_suite.names import shown


def markdown(entries: Sequence[Entry], *, draft: bool = False) -> str:
    """Returns the board as Markdown; the same entries give the same text.

    Args:
        entries: One or more.
        draft: Say that it is one.
    """
    tables = by_task(entries)
    standings = means.standings(entries)
    lines = [
        "# Leaderboard",
        "",
        *([f"**{DRAFT}**", ""] if draft else []),
        "`leaderboard.html` beside this file shows more: curves, landings, comparisons and clips. "
        "[SUBMITTING.md](SUBMITTING.md) says how to add a policy.",
        "",
        *(f"- **{term}**: {text}" for term, text in NOTES),
        "",
        "## All families",
        "",
        means.NOTE,
        "",
    ]
    tasks = means.families(entries)
    lines += _table(
        ["policy", "mean", "tasks", "× expert's steps", *tasks],
        [
            [
                row.policy,
                _mean(row.mean),
                row.mean.coverage,
                figure(row.steps_over_expert),
                *(_part(row.families.get(family)) for family in tasks),
            ]
            for row in standings
        ],
    )
    for family, names in tasks.items():
        lines += ["", f"## {_plain(family)}", ""]
        lines += _table(
            ["policy", "mean", "tasks", *names],
            [
                [
                    row.policy,
                    _mean(row.families[family]),
                    row.families[family].coverage,
                    *_cells(row.entries, names),
                ]
                for row in means.of_family(standings, family)
            ],
        )
        for task, table in tables.items():
            if table[0].result.summary.task in names:
                lines += _task(task, table)
    lines += ["", "Written by `hvs leaderboard` from the result files; do not edit.", ""]
    return "\n".join(lines)


def _task(task: str, table: Sequence[Entry]) -> list[str]:
    summary = table[0].result.summary
    words = "".join(f"{what}: {text}. " for what, text in describe(summary.task))
    shown_columns = columns(summary.task)
    return [
        "",
        f"### {task}",
        "",
        f"{words}Split: `{_plain(summary.split)}`.",
        "",
        *_table(
            ["policy", *(column.title for column in shown_columns)],
            [[e.policy, *(joined(c.text(e), c.interval(e)) for c in shown_columns)] for e in table],
        ),
    ]


def _mean(mean: Mean) -> str:
    return joined(percent(mean.value), interval(mean.low, mean.high))


def _part(mean: Mean | None) -> str:
    """A family's mean beside the others, and of how many tasks it is where some are missing."""
    if mean is None:
        return DASH
    return _mean(mean) if mean.is_whole else f"{_mean(mean)}, {mean.coverage} tasks"


def _cells(entries: Mapping[str, Entry], names: Sequence[str]) -> list[str]:
    return [
        joined(SUCCESS.text(entries[name]), SUCCESS.interval(entries[name]))
        if name in entries
        else DASH
        for name in names
    ]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns a Markdown table: names on the left, figures on the right."""
    return [
        "| " + " | ".join(_plain(cell) for cell in head) + " |",
        "|---" + "|--:" * (len(head) - 1) + "|",
        *("| " + " | ".join(_plain(cell) for cell in row) + " |" for row in rows),
    ]


def _plain(text: str) -> str:
    """Returns text in which Markdown finds no markup."""
    text = shown(text)
    for character in "\\|`<>[]*_":
        text = text.replace(character, f"&#{ord(character)};")
    return text
