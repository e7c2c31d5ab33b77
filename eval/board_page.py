"""Draws the board as one web page: no network, sortable, readable on a phone and in the dark."""

import html
from collections.abc import Sequence

from hvs_suite.eval.board_tables import (
    COLUMNS,
    NOTE,
    Column,
    Entry,
    by_task,
    interval,
    overall,
    percent,
)
from hvs_suite.eval.result_file import Result

STYLE = """
:root { color-scheme: light dark; --paper: #faf9f7; --card: #fff; --ink: #1c1e21; --soft: #63676d;
  --line: #e3e0db; --track: #ece9e4; --mark: #d9560b; --band: #f4b48a; }
@media (prefers-color-scheme: dark) { :root { --paper: #14161a; --card: #1c1f24; --ink: #eceae6;
  --soft: #9ba0a8; --line: #2d3138; --track: #2a2e35; --mark: #ff8a3d; --band: #7a4420; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; }
main { max-width: 78rem; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { margin: 0; font-size: 1.9rem; letter-spacing: -.02em; }
h2 { margin: 2.75rem 0 .25rem; font-size: 1.25rem; }
p { margin: .4rem 0 1rem; max-width: 46rem; color: var(--soft); }
.sheet { overflow-x: auto; background: var(--card); border: 1px solid var(--line);
  border-radius: 10px; }
table { width: 100%; border-collapse: separate; border-spacing: 0;
  font-variant-numeric: tabular-nums; }
th, td { padding: .6rem .8rem; text-align: right; border-bottom: 1px solid var(--line);
  white-space: nowrap; }
tbody tr:last-child > * { border-bottom: 0; }
thead th { font-size: .8rem; font-weight: 500; color: var(--soft); vertical-align: bottom;
  white-space: normal; line-height: 1.25; }
th:first-child { text-align: left; }
tbody th { font-weight: 600; min-width: 6rem; }
thead button { all: unset; cursor: pointer; }
thead button:hover, thead [aria-sort] button { color: var(--ink); }
thead button:focus-visible { outline: 2px solid var(--mark); outline-offset: 3px; }
thead [aria-sort=ascending] button::after { content: " \\2191"; }
thead [aria-sort=descending] button::after { content: " \\2193"; }
svg { display: block; width: 100%; min-width: 7rem; height: 12px; }
.track { fill: var(--track); } .band { fill: var(--band); } .mark { fill: var(--mark); }
td.success { min-width: 9rem; } td.success b { font-weight: 600; }
.matrix small { display: block; color: var(--soft); font-size: .78rem; }
.matrix th:first-child { position: sticky; left: 0; background: var(--card); }
footer { margin-top: 3rem; color: var(--soft); font-size: .85rem; }
label { display: none; }
@media (max-width: 44rem) {
  main { padding-top: 1.5rem; }
  label { display: block; margin-bottom: .5rem; color: var(--soft); font-size: .9rem; }
  .task { border: 0; background: none; overflow: visible; }
  .task table, .task tbody, .task tr, .task th, .task td { display: block; }
  .task thead { display: none; }
  .task tr { display: grid; grid-template-columns: 1fr 1fr; gap: .6rem 1rem; padding: 1rem;
    margin-bottom: .75rem; background: var(--card); border: 1px solid var(--line);
    border-radius: 10px; }
  .task th, .task td { padding: 0; border: 0; text-align: left; white-space: normal;
    overflow-wrap: anywhere; }
  .task th, .task td.success { grid-column: 1 / -1; }
  .task td::before { content: attr(data-title); display: block; color: var(--soft);
    font-size: .75rem; line-height: 1.2; }
}
"""

SCRIPT = """
for (const sheet of document.querySelectorAll(".task")) {
  const body = sheet.querySelector("tbody");
  const heads = [...sheet.querySelectorAll("thead th")];
  const choice = sheet.parentElement.querySelector("select");
  const sort = (column, down) => {
    const sign = down ? -1 : 1;
    const key = row => row.children[column].dataset.value;
    const compare = (a, b) => {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");
      return sign * (column ? x - y : x.localeCompare(y));
    };
    body.append(...[...body.rows].sort(compare));
    heads.forEach(head => head.removeAttribute("aria-sort"));
    heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
    choice.value = column;
  };
  heads.forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
    const now = head.getAttribute("aria-sort");
    sort(column, now ? now === "ascending" : "down" in head.dataset);
  }));
  choice.addEventListener("change", () => {
    const column = Number(choice.value);
    sort(column, "down" in heads[column].dataset);
  });
}
"""


def page(entries: Sequence[Entry]) -> str:
    """Returns the whole page; the same entries give the same text."""
    tables = by_task(entries)
    sections = "\n".join(_section(task, table) for task, table in tables.items())
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>hvs_suite leaderboard</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<h1>hvs_suite leaderboard</h1>
<p>A KUKA LBR iiwa 7 places its tool over a target it sees with one camera in the hand and one
beside the cell. {html.escape(NOTE)}</p>
<section>
<h2>Success on all tasks</h2>
<p>Ordered by mean success; a task without a result counts as 0 %.</p>
{_matrix(entries, list(tables))}
</section>
{sections}
<footer>Written by <code>hvs leaderboard</code> from the result files.</footer>
</main>
<script>{SCRIPT}</script>
</body>
</html>
"""


def _matrix(entries: Sequence[Entry], tasks: Sequence[str]) -> str:
    """Returns the table of policies against tasks."""
    head = "".join(f'<th scope="col">{html.escape(task)}</th>' for task in tasks)
    rows = []
    for policy, row in overall(entries).items():
        cells = "".join(_matrix_cell(row.get(task)) for task in tasks)
        rows.append(f'<tr><th scope="row">{html.escape(policy)}</th>{cells}</tr>')
    return (
        f'<div class="sheet"><table class="matrix"><thead><tr><th scope="col">policy</th>{head}'
        f"</tr></thead>\n<tbody>\n{chr(10).join(rows)}\n</tbody></table></div>"
    )


def _matrix_cell(entry: Entry | None) -> str:
    if entry is None:
        return "<td>\N{EN DASH}</td>"
    rate = percent(entry.result.summary.pc_success)
    return f"<td>{rate}<small>{interval(entry.result)}</small>{_bar(entry.result)}</td>"


def _section(task: str, table: Sequence[Entry]) -> str:
    """Returns one task's heading and sortable table."""
    columns = (
        Column("policy", lambda r: None, lambda r: ""),
        *COLUMNS,
    )
    head = "".join(
        f'<th scope="col"{" data-down" if column.larger_first else ""}'
        # The rows arrive in this order.
        f"{' aria-sort=descending' if column.title == 'success' else ''}>"
        f'<button type="button">{html.escape(column.title)}</button></th>'
        for column in columns
    )
    options = "".join(
        f'<option value="{index}"{" selected" if column.title == "success" else ""}>'
        f"{html.escape(column.title)}</option>"
        for index, column in enumerate(columns)
    )
    rows = "\n".join(_row(entry) for entry in table)
    split = html.escape(table[0].result.summary.split)
    return f"""<section>
<h2>{html.escape(task)}</h2>
<p>First scenarios of the split <code>{split}</code>.</p>
<label>Sort by <select>{options}</select></label>
<div class="sheet task"><table><thead><tr>{head}</tr></thead>
<tbody>
{rows}
</tbody></table></div>
</section>"""


def _row(entry: Entry) -> str:
    name = html.escape(entry.policy)
    cells = "".join(_figure(column, entry.result) for column in COLUMNS)
    return f'<tr><th scope="row" data-value="{name}">{name}</th>{cells}</tr>'


def _figure(column: Column, result: Result) -> str:
    value = column.value(result)
    key = "" if value is None else repr(float(value))
    text = html.escape(column.text(result))
    title = html.escape(column.title)
    if column.title == "success":
        text = f"<b>{text}</b>{_bar(result)}"
        return f'<td class="success" data-title="{title}" data-value="{key}">{text}</td>'
    return f'<td data-title="{title}" data-value="{key}">{text}</td>'


def _bar(result: Result) -> str:
    """Returns the success rate and its interval, drawn to scale from 0 to 100 %."""
    rate = result.summary.pc_success
    low, high = result.summary.pc_success_ci95
    return (
        f'<svg viewBox="0 0 100 12" preserveAspectRatio="none" role="img" '
        f'aria-label="{percent(rate)}, between {interval(result)}">'
        '<rect class="track" y="5" width="100" height="2"/>'
        f'<rect class="band" x="{low:.2f}" y="3" width="{high - low:.2f}" height="6"/>'
        f'<rect class="mark" x="{min(rate, 98.5):.2f}" y="1" width="1.5" height="10"/></svg>'
    )
