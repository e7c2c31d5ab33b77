"""Means over the tasks of a family and over families, and how many of the tasks each is of."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Self

from hvs_suite import registry, statistics
from hvs_suite.eval.board.tables import Entry
from hvs_suite.registry import TASKS

NOTE = (
    "Mean success over the tasks of each family, then over families. Tasks without a result (a "
    "dash) do not count as 0 %: how many tasks a mean is of stands beside it, and a mean over some "
    "of the tasks cannot be compared with one over all of them."
)


@dataclasses.dataclass(frozen=True)
class Mean:
    """Mean success of one policy over tasks.

    Attributes:
        value: Mean (percent).
        low: Lower end of its 95 % interval (percent).
        high: Upper end.
        n_tasks: Named tasks with a result, which it is taken over.
        of_tasks: Named tasks that there are.
    """

    value: float
    low: float
    high: float
    n_tasks: int
    of_tasks: int

    @classmethod
    def of(cls, entries: Sequence[Entry], of_tasks: int, weights: Sequence[float]) -> Self:
        """Returns the weighted mean of one or more entries; the weights add up to 1."""
        summaries = [entry.result.summary for entry in entries]
        low, high = statistics.mean_rate_interval(
            [(s.n_success, s.n_episodes) for s in summaries], weights=weights
        )
        value = math.fsum(w * s.pc_success for w, s in zip(weights, summaries, strict=True))
        return cls(value, low, high, len(entries), of_tasks)

    @property
    def is_whole(self) -> bool:
        """Whether no task is missing."""
        return self.n_tasks == self.of_tasks

    @property
    def coverage(self) -> str:
        """How many of the tasks it is of, such as ``2 of 3``."""
        return f"{self.n_tasks} of {self.of_tasks}"


@dataclasses.dataclass(frozen=True)
class Standing:
    """One policy over all families of the board.

    Attributes:
        policy: Name on the board.
        entries: Its entries by task, without version.
        families: Mean of each family that it has a result of.
        mean: Mean over these families, each counting alike.
        steps_over_expert: Steps to goal as a multiple of the expert's: geometric mean over the
            tasks of a family, then over families; None where there is nothing to compare.
    """

    policy: str
    entries: Mapping[str, Entry]
    families: Mapping[str, Mean]
    mean: Mean
    steps_over_expert: float | None


def families(entries: Sequence[Entry]) -> dict[str, list[str]]:
    """Returns the named tasks of each family that has a result, without version, easiest first."""
    shown = {registry.find(entry.result.summary.task).family for entry in entries}
    found: dict[str, list[str]] = {}
    for name, spec in TASKS.items():
        if spec.family in shown:
            found.setdefault(spec.family, []).append(name)
    return found


def standings(entries: Sequence[Entry]) -> list[Standing]:
    """Returns each policy over all families: more tasks first, then the better mean, then by name.

    Args:
        entries: Of the whole board.
    """
    tasks = families(entries)
    rows: dict[str, dict[str, Entry]] = {}
    for entry in entries:
        rows.setdefault(entry.policy, {})[entry.result.summary.task] = entry
    found = [
        _standing(policy, {name: row[name] for name in TASKS if name in row}, tasks)
        for policy, row in rows.items()
    ]
    return sorted(found, key=lambda row: (-row.mean.n_tasks, -row.mean.value, row.policy))


def of_family(standings: Sequence[Standing], family: str) -> list[Standing]:
    """Returns the policies with a result of a family: more of its tasks first, then its mean."""
    rows = [row for row in standings if family in row.families]
    return sorted(
        rows, key=lambda r: (-r.families[family].n_tasks, -r.families[family].value, r.policy)
    )


def parted(standings: Sequence[Standing], family: str | None = None) -> list[list[Standing]]:
    """Returns those whose means can be compared, and those that lack tasks; neither empty.

    Args:
        standings: In their order.
        family: Whose means; those over all families by default.
    """
    parts: dict[bool, list[Standing]] = {True: [], False: []}
    for row in standings:
        mean = row.mean if family is None else row.families[family]
        parts[mean.is_whole].append(row)
    return [part for part in parts.values() if part]


def _standing(
    policy: str, row: Mapping[str, Entry], tasks: Mapping[str, Sequence[str]]
) -> Standing:
    groups = {
        family: group
        for family, names in tasks.items()
        if (group := [row[name] for name in names if name in row])
    }
    means = {
        family: Mean.of(group, len(tasks[family]), [1 / len(group)] * len(group))
        for family, group in groups.items()
    }
    everything = [entry for group in groups.values() for entry in group]
    weights = [1 / (len(groups) * len(group)) for group in groups.values() for _ in group]
    mean = Mean.of(everything, sum(len(names) for names in tasks.values()), weights)
    return Standing(policy, row, means, mean, _steps_over_expert(list(groups.values())))


def _steps_over_expert(groups: Sequence[Sequence[Entry]]) -> float | None:
    logs = [
        [math.log(e.steps_over_expert) for e in group if e.steps_over_expert is not None]
        for group in groups
    ]
    means = [math.fsum(group) / len(group) for group in logs if group]
    return math.exp(math.fsum(means) / len(means)) if means else None
