"""Two policies on the same scenarios: which is better, and how certain that is."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from hvs_suite import reading, registry, statistics
from hvs_suite.errors import ResultError
from hvs_suite.eval.scoring import lerobot_import, result_file
from hvs_suite.eval.scoring.result_file import EpisodeRow
from hvs_suite.names import shown
from hvs_suite.statistics import Difference
from hvs_suite.tasks.shared.option_types import listed

SIGNIFICANT = 0.05


@dataclasses.dataclass(frozen=True)
class Side:
    """What a comparison needs of a result.

    Attributes:
        name: Policy.
        task: Named task.
        split: Split.
        digest: Digest of the task; None where the file does not tell (imported).
        options: Options that changed the task, in words; None where the file does not tell.
        success: Outcome by scenario.
        rows: Rows by scenario; empty for an imported result.
    """

    name: str
    task: str
    split: str
    digest: str | None
    options: str | None
    success: Mapping[int, bool]
    rows: Mapping[int, EpisodeRow]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Two policies, A and B, over the scenarios that both played.

    Attributes:
        task: Named task, and the options that changed it.
        a: Name of the first policy.
        b: Name of the second.
        n: Scenarios that both played.
        n_both: Solved by both.
        n_only_a: Solved by A alone.
        n_only_b: Solved by B alone.
        n_neither: Solved by neither.
        p: Two-sided p-value of McNemar's exact test.
        success: Success rate, A minus B (percentage points).
        settled: The task's headline metrics where the episodes ended, A minus B, by name; empty for
            imported results.
        steps_to_goal: Steps to goal, A minus B, over scenarios that both solved (control steps).
        unverified: Names of policies whose result is an import.
    """

    task: str
    a: str
    b: str
    n: int
    n_both: int
    n_only_a: int
    n_only_b: int
    n_neither: int
    p: float
    success: Difference
    settled: dict[str, Difference]
    steps_to_goal: Difference | None
    unverified: tuple[str, ...]

    def conclusion(self) -> str:
        """Returns the conclusion that the figures allow, in one sentence."""
        rates = (
            f"{self.a} solves {self.n_both + self.n_only_a} and {self.b} "
            f"{self.n_both + self.n_only_b} of the same {self.n} scenarios of {self.task}"
        )
        tests = (
            f"p = {self.p:.2g}, difference {self.success.estimate:+.1f} percentage points, 95 % "
            f"interval {self.success.low:+.1f} to {self.success.high:+.1f}"
        )
        caveat = (
            f", if the unverified result of {' and '.join(self.unverified)} is true"
            if self.unverified
            else ""
        )
        if self.p < SIGNIFICANT:
            better, worse = (self.a, self.b) if self.success.estimate > 0 else (self.b, self.a)
            return f"{better} succeeds more often than {worse}{caveat}: {rates} ({tests})."
        if not self.n_only_a + self.n_only_b:
            return (
                f"No difference in success shows{caveat}: {rates}, and they are the same scenarios."
            )
        return (
            f"These scenarios do not tell which of {self.a} and {self.b} succeeds more "
            f"often{caveat}: {rates} ({tests})."
        )


@dataclasses.dataclass(frozen=True)
class Tally:
    """On how many scenarios two policies, A and B, succeeded.

    Attributes:
        n_both: Solved by both.
        n_only_a: Solved by A alone.
        n_only_b: Solved by B alone.
        n_neither: Solved by neither.
    """

    n_both: int
    n_only_a: int
    n_only_b: int
    n_neither: int

    @classmethod
    def of(cls, a: Mapping[int, bool], b: Mapping[int, bool]) -> "Tally":
        """Counts the scenarios that both played.

        Args:
            a: Outcome of A by scenario.
            b: Outcome of B by scenario.
        """
        pairs = [(a[index], b[index]) for index in a.keys() & b.keys()]
        return cls(
            n_both=pairs.count((True, True)),
            n_only_a=pairs.count((True, False)),
            n_only_b=pairs.count((False, True)),
            n_neither=pairs.count((False, False)),
        )

    @property
    def n(self) -> int:
        """Scenarios that both played."""
        return self.n_both + self.n_only_a + self.n_only_b + self.n_neither

    @property
    def p(self) -> float:
        """Two-sided p-value of McNemar's exact test."""
        return statistics.mcnemar(self.n_only_a, self.n_only_b)


def compare(first: Path, second: Path) -> Comparison:
    """Compares two results of the same task on the scenarios that both played.

    Args:
        first: Result file, ours or imported.
        second: Another.

    Raises:
        ResultError: A file is refused, or the two cannot be compared.
    """
    a, b = load_side(first), load_side(second)
    for what, ours, theirs in (
        ("task", a.task, b.task),
        ("split", a.split, b.split),
        ("task_digest", a.digest, b.digest),
        ("the task's options", a.options, b.options),
    ):
        if ours != theirs and None not in (ours, theirs):
            raise ResultError(
                f"{first} and {second} cannot be compared: {what} is {ours!r} and {theirs!r}"
            )
    common = sorted(a.success.keys() & b.success.keys())
    if not common:
        raise ResultError(f"{first} and {second} have no scenario in common")
    tally = Tally.of(a.success, b.success)
    rows = [(a.rows[i], b.rows[i]) for i in common if i in a.rows and i in b.rows]
    steps = [
        (ours.steps_to_goal, theirs.steps_to_goal)
        for ours, theirs in rows
        if ours.steps_to_goal is not None and theirs.steps_to_goal is not None
    ]
    names = (a.name, b.name) if a.name != b.name else (f"{a.name} (A)", f"{b.name} (B)")
    return Comparison(
        task=f"{a.task} with {shown(a.options)}" if a.options else a.task,
        a=names[0],
        b=names[1],
        n=len(common),
        **dataclasses.asdict(tally),
        p=tally.p,
        success=statistics.paired_difference(
            [100.0 * a.success[index] for index in common],
            [100.0 * b.success[index] for index in common],
        ),
        settled={
            name: statistics.paired_difference(
                [ours.settled.errors[name] for ours, _ in rows],
                [theirs.settled.errors[name] for _, theirs in rows],
            )
            for name in registry.find(a.task).headline
            if rows and all(name in row.errors for row in rows[0])
        },
        steps_to_goal=(
            statistics.paired_difference(
                [ours for ours, _ in steps], [theirs for _, theirs in steps]
            )
            if steps
            else None
        ),
        unverified=tuple(
            name for name, side in zip(names, (a, b), strict=True) if side.digest is None
        ),
    )


def load_side(path: Path) -> Side:
    """Reads a result of ours, or an imported one.

    Raises:
        ResultError: It is neither.
    """
    content = reading.read_json(path, error=ResultError, most=result_file.MOST_BYTES)
    if lerobot_import.is_imported(content):
        claim = lerobot_import.load(path)
        return Side(
            name=claim.summary.policy,
            task=claim.summary.task,
            split=claim.summary.split,
            digest=None,
            options=None,
            success={row.scenario: row.success for row in claim.episodes},
            rows={},
        )
    result = result_file.load(path)
    return Side(
        name=result.summary.policy,
        task=result.summary.task,
        split=result.summary.split,
        digest=result.metadata.task_digest,
        options=listed(result.metadata.options),
        success={row.scenario: row.success for row in result.episodes},
        rows={row.scenario: row for row in result.episodes},
    )
