"""The page of a named task, made from what the task says of itself.

Nothing is written twice: the sentence, the bounds and the disturbances come from the spec, drawing
scenarios shows what is random, the docstrings explain it, and the certificate is the stored one.
Only the text on what makes a task hard is written for the page, in the family's file.
"""

import dataclasses
import inspect
import itertools
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import docstring_parser
import numpy as np

from hvs_suite.tasks.shared.certificate import Certificate
from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

_DRAWN = 10
"""Scenarios that are drawn to find out what differs between them."""
_NAMES = ("split", "index")
"""Fields of a scenario that name it."""


def page(env: "Environment", certificate: Certificate, picture: str) -> str:
    """Write the page of a named task.

    Args:
        env: The named task on its test split.
        certificate: Its certificate.
        picture: Where the picture lies, as a link from the page.

    Returns:
        Markdown.
    """
    spec, family = env.spec, env.task.family
    words = spec.describe()
    held = f", held for {words.held}" if words.held else ""
    seconds = spec.time_limit_steps * spec.control_period_s
    return "\n".join(
        [
            f"# `{spec.name}`",
            "",
            f"> {spec.instruction()}",
            "",
            f"![Start and goal of a scenario of {spec.name}, and its certificate]({picture})",
            "",
            *_table(
                ("", ""),
                (
                    ("start", words.start),
                    ("target", words.target),
                    ("success", f"{words.tolerance}{held}"),
                    (
                        "time",
                        f"{spec.time_limit_steps} control steps of {spec.control_period_s:g} s "
                        f"({seconds:g} s)",
                    ),
                    (
                        "disturbances",
                        "none" if words.disturbances == "-" else words.disturbances,
                    ),
                ),
            ),
            "",
            "## What is hard about it",
            "",
            family.hard[spec.name],
            "",
            "## What is drawn for each scene",
            "",
            *_table(("quantity", "meaning"), _drawn(env)),
            "",
            "## What is measured",
            "",
            *_table(("metric", "bound", "measured"), _measured(spec)),
            "",
            "## Observations and actions",
            "",
            *_table(("name", "shape", "type"), _shapes(env)),
            "",
            "## Parameters",
            "",
            f"Parameters that differ from the defaults of family `{spec.family}`:",
            "",
            *_table(("parameter", "value", "meaning"), _parameters(spec)),
            "",
            "## Certificate",
            "",
            f"Over all {certificate.scenarios:,} test scenarios:",
            "",
            *_table(
                ("checked", "found", "needed"),
                ((check.what, check.found, check.needed) for check in certificate.checks),
            ),
            "",
        ]
    )


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """A Markdown table; a bar inside a cell would end it."""
    for cells in (head, ("---",) * len(head), *rows):
        yield "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _drawn(env: "Environment") -> Iterator[tuple[str, str]]:
    """Fields of the scenario that differ between scenarios, with what they are."""
    scenarios = [env.task.source.draw(index) for index in range(_DRAWN)]
    said = _attributes(type(scenarios[0]))
    for field in dataclasses.fields(scenarios[0]):
        values = [getattr(scenario, field.name) for scenario in scenarios]
        if field.name not in _NAMES and any(not _same(*two) for two in itertools.pairwise(values)):
            yield f"`{field.name}`", said[field.name]


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    return bool(one == other)


def _measured(spec: Spec) -> Iterator[tuple[str, str, str]]:
    for metric in spec.metrics:
        bound = "" if metric.bound is None else f"{metric.bound:g} {metric.unit}".strip()
        when = "at the end of each control step" if metric.over == "step" else "over the episode"
        yield f"`{metric.name}`", bound, when


def _shapes(env: "Environment") -> Iterator[tuple[str, str, str]]:
    for name, each in (*env.observation_spec().items(), ("action", env.action_spec())):
        yield f"`{name}`", str(each.shape), np.dtype(each.dtype).name


def _parameters(spec: Spec) -> Iterator[tuple[str, str, str]]:
    said = _attributes(type(spec))
    for field in dataclasses.fields(spec):
        value = getattr(spec, field.name)
        if field.name != "name" and value != field.default:
            yield f"`{field.name}`", f"`{value}`", said[field.name]


def _attributes(kind: type) -> dict[str, str]:
    """What the docstrings of a class and of those above it say of each attribute."""
    said: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        for parameter in docstring_parser.parse(inspect.cleandoc(each.__doc__ or "")).params:
            said[parameter.arg_name] = " ".join((parameter.description or "").split())
    return said
