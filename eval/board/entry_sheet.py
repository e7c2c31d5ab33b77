"""The sheet that opens for one entry of the board: figures, clips, landings, what it was run on."""

import dataclasses
import urllib.parse
from collections.abc import Sequence

from hvs_suite import registry
from hvs_suite.eval.board import plots
from hvs_suite.eval.board.clips import Clip
from hvs_suite.eval.board.plots import Landings
from hvs_suite.eval.board.tables import DASH, SUCCESS, Entry, figure, iqm_interval, joined
from hvs_suite.eval.scoring.result_file import Metadata
from hvs_suite.names import shown
from hvs_suite.tasks.shared.metric import Metric

Rows = Sequence[tuple[str, str]]

ERRORS = ("at the end", "interquartile mean", "median", "p95", "p99", "95 % end within")
"""Headings of `Sheet.errors`."""


@dataclasses.dataclass(frozen=True)
class Film:
    """A clip with what it shows.

    Attributes:
        number: Its place among the clips of the page.
        kind: Whether it shows a success or a failure.
        caption: What happens, in a sentence.
    """

    number: int
    kind: str
    caption: str

    @classmethod
    def of(cls, number: int, entry: Entry, clip: Clip) -> "Film":
        """Returns the film of an entry's clip.

        Args:
            number: Its place among the clips of the page.
            entry: Whose clip it is.
            clip: The clip.
        """
        row = clip.row
        if row.success:
            how = f"is solved in {row.steps} steps"
        elif row.settled.failure is not None:
            how = f"is lost after {row.steps} steps ({row.settled.failure})"
        elif row.collision:
            how = f"ends with a collision in step {row.steps}"
        else:
            how = "is not solved in time"
        where = ", ".join(
            f"{metric.title} {figure(row.settled.errors[metric.name])} {metric.unit}".rstrip()
            for metric in _headline(entry)
            if metric.name in row.settled.errors
        )
        return cls(number, clip.kind, f"Scenario {row.scenario} {how}. At its end: {where}.")


@dataclasses.dataclass(frozen=True)
class Sheet:
    """What the sheet shows.

    Attributes:
        entry: The entry.
        identity: Its name within the page.
        outcomes: Figures with their titles.
        films: Its clips; the page may have none.
        landings: Where it lands, and what the picture shows; None where landings have no meaning.
        errors: Title of each metric and its figures, as `ERRORS` heads them.
        origin: Machine and versions that it was run on, with titles.
        command: How anyone can check it.
    """

    entry: Entry
    identity: str
    outcomes: Rows
    films: Sequence[Film]
    landings: tuple[Landings, str] | None
    errors: Sequence[tuple[str, Sequence[str]]]
    origin: Rows
    command: str


def identity(entry: Entry) -> str:
    """Returns the name of an entry's sheet, ``<task>/<policy>``."""
    return f"{entry.task}/{shown(entry.policy)}"


def link(entry: Entry) -> str:
    """Returns the address of an entry's sheet within the page."""
    return "#" + urllib.parse.quote(identity(entry))


def sheet(entry: Entry, films: Sequence[Film]) -> Sheet:
    """Returns an entry's sheet.

    Args:
        entry: The entry.
        films: Its clips.
    """
    return Sheet(
        entry,
        identity(entry),
        _outcomes(entry),
        films,
        _landings(entry),
        _errors(entry),
        _origin(entry),
        f"hvs verify eval/results/{entry.policy}/{entry.result.summary.task}.json",
    )


def sideways(entry: Entry) -> float | None:
    """Returns the task's tolerance in the target plane (mm); None where landings have no meaning.

    They have one where episodes are always played past the goal to the time limit.
    """
    spec = registry.find(entry.result.summary.task)
    metric = spec.landing_metric
    return metric.bound if metric is not None and spec.plays_on else None


def _outcomes(entry: Entry) -> Rows:
    summary = entry.result.summary
    return [
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


def _landings(entry: Entry) -> tuple[Landings, str] | None:
    tolerance = sideways(entry)
    if tolerance is None:
        return None
    rows = entry.result.episodes
    picture = plots.landings(rows, plots.landing_radius(rows), tolerance)
    caption = (
        "The picture shows where the flange stands around the target at the time limit, seen along "
        "the normal. "
    )
    caption += (
        f"The tolerance, {tolerance:g} mm, lies outside the picture."
        if picture.goal is None
        else f"The circle is the tolerance, {tolerance:g} mm."
    )
    if outside := picture.n - picture.n_inside:
        caption += f" {outside} of {picture.n} landings lie outside the picture."
    return picture, caption


def _headline(entry: Entry) -> list[Metric]:
    """The headline metrics of an entry's task."""
    spec = registry.find(entry.result.summary.task)
    metrics = {metric.name: metric for metric in spec.metrics}
    return [metrics[name] for name in spec.headline]


def _title(metric: Metric) -> str:
    return f"{metric.title} ({metric.unit})" if metric.unit else metric.title


def _errors(entry: Entry) -> list[tuple[str, list[str]]]:
    """Settled errors, one row each."""
    summary = entry.result.summary
    rows = []
    for metric in registry.find(summary.task).metrics:
        error = summary.settled.errors[metric.name]
        sharpest = summary.settled.sharpest_95.errors[metric.name]
        cells = [
            joined(figure(error.iqm), iqm_interval(error)),
            *(figure(value) for value in (error.p50, error.p95, error.p99, sharpest)),
        ]
        rows.append((_title(metric), cells))
    return rows


def _origin(entry: Entry) -> Rows:
    metadata, summary, timings = entry.result.metadata, entry.result.summary, entry.result.timings
    return [
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
