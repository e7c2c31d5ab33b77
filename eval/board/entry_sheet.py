"""The sheet that opens for one entry of the board: figures, clips, landings, what it was run on."""

import base64
import urllib.parse
from collections.abc import Sequence

from hvs_suite import registry
from hvs_suite.eval.board import plots
from hvs_suite.eval.board.clips import SIZE, Clip
from hvs_suite.eval.board.tables import (
    DASH,
    SUCCESS,
    Entry,
    escaped,
    figure,
    iqm_interval,
    joined,
)
from hvs_suite.eval.scoring.result_file import Metadata
from hvs_suite.names import shown
from hvs_suite.tasks.shared.metric import Metric


def identity(entry: Entry) -> str:
    """Returns the name of an entry's sheet, ``<task>/<policy>``."""
    return f"{entry.task}/{shown(entry.policy)}"


def link(entry: Entry) -> str:
    """Returns the address of an entry's sheet within the page."""
    return "#" + urllib.parse.quote(identity(entry))


def sheet(entry: Entry, clips: Sequence[Clip]) -> str:
    """Returns an entry's sheet, a closed dialog.

    Args:
        entry: The entry.
        clips: Its clips; the page may have none.
    """
    name = escaped(identity(entry))
    return f"""<dialog id="{name}" aria-labelledby="{name}-title">
<header><h2 id="{name}-title">{escaped(entry.policy)}
<small>{escaped(entry.task)}</small></h2>
<form method="dialog"><button aria-label="Close">\N{MULTIPLICATION SIGN}</button></form></header>
{_outcomes(entry)}
{_films(entry, clips)}
{_landings(entry)}
{_errors(entry)}
{_origin(entry)}
</dialog>"""


def _outcomes(entry: Entry) -> str:
    summary = entry.result.summary
    rows = [
        ("success", joined(SUCCESS.text(entry), SUCCESS.interval(entry))),
        ("solved", f"{summary.n_success} of {summary.n_episodes}"),
        ("collisions", str(summary.n_collision)),
        (
            "lost by its own fault",
            ", ".join(f"{count} {reason}" for reason, count in summary.failures.items()) or "0",
        ),
        ("steps to goal, mean", figure(summary.steps_to_goal_mean)),
        ("× expert's steps", figure(entry.steps_over_expert)),
        ("steps out of range", str(summary.n_clipped)),
        ("verified", entry.proof),
    ]
    return _list(rows, "figures")


def _films(entry: Entry, clips: Sequence[Clip]) -> str:
    """Both clips; lazily, so that a closed sheet decodes nothing."""
    if not clips:
        return ""
    width, height = SIZE
    films = []
    for clip in clips:
        row = clip.row
        if row.success:
            how = f"solved in {row.steps} steps"
        elif row.settled.failure is not None:
            how = f"lost after {row.steps} steps: {row.settled.failure}"
        elif row.collision:
            how = f"collides in step {row.steps}"
        else:
            how = "not solved in time"
        where = ", ".join(
            f"{metric.title} {figure(row.settled.errors[metric.name])} {metric.unit}".rstrip()
            for metric in metrics_of(entry)
            if metric.name in row.settled.errors
        )
        caption = escaped(f"Scenario {row.scenario}: {how}; at the end {where}.")
        data = base64.b64encode(clip.avif).decode("ascii")
        films.append(
            f'<figure><img loading="lazy" width="{width}" height="{height}" alt="{caption}" '
            f'src="data:image/avif;base64,{data}">'
            f"<figcaption><b>A typical {clip.kind}.</b> {caption}</figcaption></figure>"
        )
    return f'<div class="films">{"".join(films)}</div>'


def _landings(entry: Entry) -> str:
    rows = entry.result.episodes
    tolerance = sideways(entry)
    if tolerance is None:
        return ""
    radius = plots.landing_radius(rows)
    outside = sum(not plots.is_inside(row, radius) for row in rows)
    caption = "Where the flange stands around the target at the time limit, seen along the normal. "
    caption += (
        f"The circle is the tolerance, {tolerance:g} mm."
        if tolerance <= radius
        else f"The tolerance, {tolerance:g} mm, lies outside the picture."
    )
    if outside:
        caption += f" {outside} of {len(rows)} landings lie outside the picture."
    plot = plots.landing_plot(rows, radius, tolerance, "Landings around the target")
    return (
        f'<figure class="wide">{plot}<figcaption>{caption}<span class="key">'
        '<i class="hit"></i>solved<i class="miss"></i>not solved<i class="lost"></i>arm lost'
        "</span></figcaption></figure>"
    )


def sideways(entry: Entry) -> float | None:
    """Returns the task's tolerance in the target plane (mm); None where landings say nothing.

    They do where episodes are played to their end whatever comes: past the goal to the time limit.
    """
    spec = registry.find(entry.result.summary.task)
    metric = spec.landing_metric
    return metric.bound if metric is not None and spec.plays_on else None


def metrics_of(entry: Entry) -> list[Metric]:
    """Returns the headline metrics of an entry's task."""
    spec = registry.find(entry.result.summary.task)
    metrics = {metric.name: metric for metric in spec.metrics}
    return [metrics[name] for name in spec.headline]


def _title(metric: Metric) -> str:
    return f"{metric.title} ({metric.unit})" if metric.unit else metric.title


def _errors(entry: Entry) -> str:
    """Settled errors, one row each."""
    summary = entry.result.summary
    rows = []
    for metric in registry.find(summary.task).metrics:
        error = summary.settled.errors[metric.name]
        sharpest = summary.settled.sharpest_95.errors[metric.name]
        cells = (
            joined(figure(error.iqm), iqm_interval(error)),
            *(figure(value) for value in (error.p50, error.p95, error.p99, sharpest)),
        )
        rows.append(
            f'<tr><th scope="row">{escaped(_title(metric))}</th>'
            + "".join(f"<td>{escaped(cell)}</td>" for cell in cells)
            + "</tr>"
        )
    head = "".join(
        f'<th scope="col">{title}</th>'
        for title in (
            "settled error",
            "interquartile mean",
            "median",
            "p95",
            "p99",
            "95 % settle within",
        )
    )
    return (
        f'<div class="sheet"><table class="matrix"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _origin(entry: Entry) -> str:
    metadata, summary, timings = entry.result.metadata, entry.result.summary, entry.result.timings
    rows = [
        ("policy", f"{summary.policy} ({metadata.policy_kind})"),
        ("policy hash", _short(metadata.policy_hash)),
        ("parameters", _count(metadata.policy_parameters)),
        ("training", _training(metadata)),
        (
            "decision",
            f"{figure(timings.decision_ms)} ms, at most {figure(timings.decision_ms_max)}",
        ),
        ("task digest", _short(metadata.task_digest)),
        ("action log", _short(metadata.actions_sha256)),
        ("created", metadata.created),
        ("hvs_suite", metadata.suite_version),
        ("renderer", metadata.gl_renderer or DASH),
        ("machine", f"{metadata.cpu}, {metadata.platform}"),
        (
            "packages",
            ", ".join(f"{name} {version}" for name, version in metadata.packages.items()),
        ),
    ]
    command = escaped(f"hvs verify eval/results/{entry.policy}/{summary.task}.json")
    return (
        f"<details><summary>How it was made</summary>{_list(rows, 'origin')}"
        f"<p>Check it yourself: <code>{command}</code></p></details>"
    )


def _list(rows: Sequence[tuple[str, str]], kind: str) -> str:
    items = "".join(
        f"<div><dt>{escaped(title)}</dt><dd>{escaped(text)}</dd></div>" for title, text in rows
    )
    return f'<dl class="{kind}">{items}</dl>'


def _short(digest: str | None) -> str:
    return DASH if digest is None else digest[:16]


def _count(number: int | None) -> str:
    return DASH if number is None else f"{number:,}"


def _training(metadata: Metadata) -> str:
    told = []
    if metadata.training_steps is not None:
        told.append(f"{metadata.training_steps:,} steps")
    if metadata.training_hours is not None:
        told.append(f"{figure(metadata.training_hours)} hours")
    return ", ".join(told) or DASH
