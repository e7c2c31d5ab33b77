"""Draws the board as one web page: no network, sortable, readable on a phone and in the dark.

Everything is in the file: style, script, plots and clips. The style and the script lie beside this
module as ``page.css`` and ``page.js``.
"""

import importlib.resources
from collections.abc import Mapping, Sequence

from markdown_it import MarkdownIt

from hvs_suite.eval.board import entry_sheet, matrix, plots
from hvs_suite.eval.board.clips import Clip
from hvs_suite.eval.board.tables import (
    DASH,
    DRAFT,
    MEANS,
    NOTE,
    SUCCESS,
    VERIFIED,
    Column,
    Entry,
    Overall,
    by_task,
    columns,
    describe,
    escaped,
    interval,
    overall,
    percent,
)


def page(
    entries: Sequence[Entry],
    clips: Mapping[tuple[str, str], Sequence[Clip]] | None = None,
    *,
    draft: bool = False,
) -> str:
    """Returns the whole page; the same entries and clips give the same text.

    Args:
        entries: One or more.
        clips: By (policy, task without version); none by default.
        draft: Say that it is one.
    """
    tables = by_task(entries)
    # By name, not by rank: a policy keeps its colour when others come.
    colours = {policy: k for k, policy in enumerate(sorted({e.policy for e in entries}))}
    sections = "\n".join(_section(task, table, colours) for task, table in tables.items())
    sheets = "\n".join(
        entry_sheet.sheet(entry, (clips or {}).get((entry.policy, entry.result.summary.task), ()))
        for table in tables.values()
        for entry in table
    )
    links = "".join(
        f'<a href="#{escaped(task)}">{escaped(table[0].result.summary.task)}</a>'
        for task, table in tables.items()
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; \
style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:">
<title>hvs_suite leaderboard</title>
<style>
{_resource("board/page.css")}</style>
</head>
<body>
<main>
<h1>hvs_suite leaderboard</h1>
{f"<p><strong>{escaped(DRAFT)}</strong></p>" if draft else ""}
<p>A KUKA LBR iiwa 7 places its tool over a target that it sees with one camera in its hand and one
looking on from above. Open a policy to see it succeed and fail, and where it lands.</p>
<div class="bar-top"><input type="search" id="search" placeholder="Search policies"
aria-label="Search policies" autocomplete="off"><nav aria-label="Tasks">{links}
<a href="#submit">submit</a></nav></div>
<p id="found" role="status"></p>
<section id="all-tasks">
<h2>All tasks</h2>
<p>{escaped(MEANS)}</p>
{_overall(overall(entries), list(tables), colours)}
<details class="note"><summary>What the figures mean</summary><p>{escaped(NOTE)}</p></details>
</section>
{sections}
<section id="submit" class="prose">
{_submitting()}
</section>
<footer>Written by <code>hvs leaderboard</code> from the result files.</footer>
</main>
{sheets}
<script>
{_resource("board/page.js")}</script>
</body>
</html>
"""


def _overall(rows: Sequence[Overall], tasks: Sequence[str], colours: Mapping[str, int]) -> str:
    """Returns the table of policies against tasks."""
    head = _head(
        [("policy", False), ("mean", True), ("families", True), *((task, True) for task in tasks)],
        sorted_by=1,
    )
    body = []
    for row in rows:
        name = escaped(row.policy)
        cells = [
            f'<td data-value="{row.mean!r}"><b>{percent(row.mean)}</b>'
            f"<small>{interval(row.low, row.high)}</small>"
            f"{plots.bar(row.low, row.mean, row.high)}</td>",
            f'<td data-value="{row.n_families}">{row.coverage}</td>',
        ]
        cells += [_overall_cell(row.entries.get(task)) for task in tasks]
        body.append(
            f'<tr data-policy="{name}"><th scope="row" data-value="{name}">'
            f"{_swatch(colours[row.policy])}{name}</th>{''.join(cells)}</tr>"
        )
    return (
        f'<div class="sheet sortable"><table class="matrix"><thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{chr(10).join(body)}\n</tbody></table></div>"
    )


def _overall_cell(entry: Entry | None) -> str:
    if entry is None:
        return f'<td data-value="">{DASH}</td>'
    return (
        f'<td data-value="{SUCCESS.value(entry)!r}"><a href="{entry_sheet.link(entry)}">'
        f"{SUCCESS.text(entry)}</a><small>{SUCCESS.interval(entry)}</small>{_bar(entry)}</td>"
    )


def _section(task: str, table: Sequence[Entry], colours: dict[str, int]) -> str:
    """Returns one task: table, curves, landings, comparison."""
    summary = table[0].result.summary
    shown = columns(summary.task)
    head = _head(
        [("policy", False), *((column.title, column.larger_first) for column in shown)],
        sorted_by=1,
    )
    options = "".join(
        f'<option value="{index}"{" selected" if index == 1 else ""}>{escaped(title)}</option>'
        for index, title in enumerate(("policy", *(column.title for column in shown)))
    )
    rows = "\n".join(_row(entry, shown, colours[entry.policy]) for entry in table)
    name = escaped(task)
    return f"""<section id="{name}">
<h2>{name}</h2>
<p>{escaped(describe(summary.task))} Split <code>{escaped(summary.split)}</code>.</p>
<label>Sort by <select>{options}</select></label>
<div class="sheet task sortable"><table><thead><tr>{head}</tr></thead>
<tbody>
{rows}
</tbody></table></div>
<div class="plots">
{_against_tolerance(table, colours)}
<figure>{plots.steps_plot(table, colours)}
<figcaption>Success against time: solved within so many control steps.</figcaption></figure>
</div>
{_legend(table, colours)}
{_landings(table)}
{_pairs(table)}
</section>"""


def _against_tolerance(table: Sequence[Entry], colours: dict[str, int]) -> str:
    """Returns the curve of success against tolerance; nothing where a tolerance is 0."""
    if table[0].result.summary.settled.success_by_scale is None:
        return ""
    return f"""<figure>{plots.tolerance_plot(table, colours)}
<figcaption>Success against tolerance, where the episodes end. 1 is the task's own tolerance;
shaded, the pointwise 95 % intervals.</figcaption></figure>"""


def _landings(table: Sequence[Entry]) -> str:
    """Returns where the policies of a task land; nothing where it goes on past its last goal."""
    tolerance = entry_sheet.sideways(table[0])
    if tolerance is None:
        return ""
    return f"""<h3>Where they land</h3>
<p>Around the target at the end, in a picture of {2 * tolerance:g} mm to each side; the circle is
the tolerance.</p>
<div class="landings">{"".join(_landing(entry, tolerance) for entry in table)}</div>"""


def _pairs(table: Sequence[Entry]) -> str:
    if len(table) < 2:
        return ""
    return f"<h3>Each with each</h3><p>{escaped(matrix.CAPTION)}</p>{matrix.matrix(table)}"


def _head(columns: Sequence[tuple[str, bool]], sorted_by: int) -> str:
    """Returns sortable headings from (title, larger first); the rows arrive sorted by one."""
    return "".join(
        f'<th scope="col"{" data-down" if down else ""}'
        f"{' aria-sort=descending' if index == sorted_by else ''}>"
        f'<button type="button">{escaped(title)}</button></th>'
        for index, (title, down) in enumerate(columns)
    )


def _row(entry: Entry, shown: Sequence[Column], colour: int) -> str:
    name = escaped(entry.policy)
    cells = "".join(_figure(column, entry) for column in shown)
    return (
        f'<tr data-policy="{name}"><th scope="row" data-value="{name}">{_swatch(colour)}'
        f'<a href="{entry_sheet.link(entry)}">{name}</a></th>{cells}</tr>'
    )


def _figure(column: Column, entry: Entry) -> str:
    value = column.value(entry)
    text = escaped(column.text(entry))
    below = escaped(column.interval(entry))
    kind = ""
    if column is SUCCESS:
        text = f"<b>{text}</b> <small>{below}</small>{_bar(entry)}"
        kind = ' class="success"'
    elif column is VERIFIED:
        whole = " whole" if entry.n_played == entry.result.summary.n_episodes else ""
        proven = (
            "Replayed: the logged actions give these numbers."
            if entry.rerun is None
            else "Re-run: the maintainers ran the policy itself on scenarios nobody had seen."
        )
        text = f'<span class="badge{whole}" title="{proven}">\N{CHECK MARK} {text}</span>'
    elif below:
        text += f" <small>{below}</small>"
    return (
        f'<td{kind} data-title="{escaped(column.title)}" '
        f'data-value="{"" if value is None else repr(float(value))}">{text}</td>'
    )


def _landing(entry: Entry, tolerance: float) -> str:
    rows = entry.result.episodes
    inside = sum(plots.is_inside(row, 2 * tolerance) for row in rows)
    plot = plots.landing_plot(
        rows, 2 * tolerance, tolerance, f"Landings of {entry.policy} around the target"
    )
    name = escaped(entry.policy)
    return (
        f'<figure data-policy="{name}">{plot}<figcaption><b>{name}</b> {inside} of {len(rows)} in '
        "the picture</figcaption></figure>"
    )


def _legend(table: Sequence[Entry], colours: Mapping[str, int]) -> str:
    buttons = "".join(
        f'<button type="button" data-policy="{escaped(entry.policy)}">'
        f"{_swatch(colours[entry.policy])}{escaped(entry.policy)}</button>"
        for entry in table
    )
    return (
        f'<div class="legend" aria-label="Point at a policy to pick out its curves">{buttons}</div>'
    )


def _swatch(colour: int) -> str:
    broken = " broken" if colour >= plots.COLOURS else ""
    return f'<i class="swatch c{colour % plots.COLOURS}{broken}"></i>'


def _bar(entry: Entry) -> str:
    low, high = entry.result.summary.pc_success_ci95
    return plots.bar(low, entry.result.summary.pc_success, high)


def _submitting() -> str:
    """Returns ``SUBMITTING.md`` as HTML, its headings one level lower."""
    parser = MarkdownIt("commonmark", {"html": False})
    tokens = parser.parse(_resource("SUBMITTING.md"))
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{int(token.tag[1]) + 1}"
    rendered: str = parser.renderer.render(tokens, parser.options, {})
    return rendered


def _resource(name: str) -> str:
    return (importlib.resources.files("hvs_suite.eval") / name).read_text(encoding="utf-8")
