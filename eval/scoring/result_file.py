"""The result file: one policy on one task, every episode a row, and all that made the numbers.

The file is JSON with five blocks: ``schema_version`` and ``sha256``, ``summary`` (computed from the
rows), ``metadata`` (what was run, on what), ``timings`` (the only block that differs between two
runs of the same thing) and ``episodes``, one column a line, so that two files can be compared line
by line. ``docs/results.md`` explains every key.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import pydantic

from hvs_suite import files, reading, statistics
from hvs_suite.errors import ResultError
from hvs_suite.policies import catalogue

SCHEMA_VERSION: Final = 3
SCALES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 20.0, 50.0, 100.0)
"""Where the curve of success against tolerance is given, in multiples of the task's tolerances."""
SHARPEST_PERCENT = 95.0
MOST_BYTES = 16 * 2**20
"""Largest file that is read: a hundred times one of 1,000 scenarios."""
MOST_VALUES = 500_000
"""Episodes times columns that are read: 10,000 episodes of twice the columns of any task. A column
of a few bytes becomes a value of every row, and of every resample of its interval."""

Count = Annotated[int, pydantic.Field(ge=0)]
Error = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]
Signed = Annotated[float, pydantic.Field(allow_inf_nan=False)]
Percent = Annotated[float, pydantic.Field(ge=0.0, le=100.0)]
Seconds = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]
Errors = dict[str, Error]
Interval = Annotated[list[float], pydantic.Field(min_length=2, max_length=2)]


class _Block(pydantic.BaseModel):
    """Unknown keys and values of another type are refused, not guessed."""

    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)


class Settled(_Block):
    """Where a scenario ended that was played on past its goal to the time limit.

    Attributes:
        steps: Control steps played altogether.
        collision: A forbidden contact ended them.
        failure: As in `EpisodeRow`, after the goal too.
        errors: The task's metrics at the end of the last of them.
        x_mm: Where the flange stands then in the target plane, along the base's x axis.
        y_mm: The same across it.
    """

    steps: Count
    collision: bool
    failure: str | None
    errors: Errors
    x_mm: Signed
    y_mm: Signed

    @property
    def lost(self) -> bool:
        """Whether the arm did not stand anywhere at the end: it collided or was lost."""
        return self.collision or self.failure is not None


class EpisodeRow(_Block):
    """One scenario's outcome.

    What happened up to the goal is the score. Where the task goes on past its goal, the policy
    plays to the time limit, and ``settled`` says where it then stands; elsewhere, and without
    success, the two are the same.

    Attributes:
        scenario: Index in the split.
        success: The task was done, as its family judges it.
        success_once: Within tolerance at the end of at least one control step up to ``steps``.
        collision: A forbidden contact came before the goal.
        truncated: The time limit came before the goal.
        steps: Control steps up to success, collision, time limit or failure.
        steps_to_goal: Control steps to the goal, at most ``steps``; None without success.
        n_clipped: Those of these steps whose action was out of range.
        failure: Why the policy lost the episode before the goal: ``not finite``, ``wrong shape``,
            ``too slow``, or ``raised <error>``; None if it did not.
        errors: The task's metrics after ``steps``, by name.
        settled: Where it ended.
    """

    scenario: Count
    success: bool
    success_once: bool
    collision: bool
    truncated: bool
    steps: Count
    steps_to_goal: int | None
    n_clipped: Count
    failure: str | None
    errors: Errors
    settled: Settled

    def scale(self, tolerances: Mapping[str, float]) -> float:
        """Factor on all of a task's tolerances that this row's settled errors just meet.

        Args:
            tolerances: Bound of each metric that decides success, none of them 0.

        Returns:
            The largest quotient of error and bound; infinity where the arm was lost.
        """
        if self.settled.lost:
            return math.inf
        return max(self.settled.errors[name] / bound for name, bound in tolerances.items())

    @pydantic.model_validator(mode="after")
    def _agree(self) -> Self:
        """Refuses an outcome that no episode can have."""
        if (self.steps_to_goal is not None) != self.success:
            raise ValueError("steps_to_goal is a number for a success and null otherwise")
        if self.steps_to_goal is not None and not 0 < self.steps_to_goal <= self.steps:
            raise ValueError("steps_to_goal must lie between 1 and steps")
        if self.success + self.collision + self.truncated + (self.failure is not None) != 1:
            raise ValueError(
                "an episode has one end: success, collision, truncated or a failure's reason"
            )
        if self.success and not self.success_once:
            raise ValueError("a success must also count as success_once")
        if self.n_clipped > self.steps:
            raise ValueError("n_clipped cannot exceed steps")
        end = self.settled
        if end.steps < self.steps:
            raise ValueError("settled.steps cannot be fewer than steps")
        if end.errors.keys() != self.errors.keys():
            raise ValueError("settled.errors must have the metrics of errors")
        if not self.success:
            ours = (self.steps, self.collision, self.failure, self.errors)
            if ours != (end.steps, end.collision, end.failure, end.errors):
                raise ValueError("without success, the settled figures must be the episode's own")
        return self


class ErrorSummary(_Block):
    """An error over all episodes, at the end of each one's last step (mm or deg).

    Attributes:
        p50: Median.
        p95: 95th percentile.
        iqm: Interquartile mean.
    """

    p50: Error
    p95: Error
    iqm: Error

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Returns the summary of (n,) values."""
        return cls(
            p50=statistics.percentile(values, 50),
            p95=statistics.percentile(values, 95),
            iqm=statistics.interquartile_mean(values),
        )


class SettledErrorSummary(_Block):
    """An error over all episodes where each one settled (mm or deg).

    Attributes:
        p50: Median.
        p95: 95th percentile.
        p99: 99th percentile.
        iqm: Interquartile mean.
        iqm_ci95: Its 95 % bootstrap interval.
    """

    p50: Error
    p95: Error
    p99: Error
    iqm: Error
    iqm_ci95: Interval

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Returns the summary of (n,) values."""
        return cls(
            p50=statistics.percentile(values, 50),
            p95=statistics.percentile(values, 95),
            p99=statistics.percentile(values, 99),
            iqm=statistics.interquartile_mean(values),
            iqm_ci95=list(statistics.interquartile_mean_interval([values])),
        )


class ToleranceCurve(_Block):
    """Share of episodes that settled within a multiple of the task's tolerances.

    Attributes:
        scale: Multiples, `SCALES`.
        pc_success: Share within each (percent).
    """

    scale: list[float]
    pc_success: list[Percent]


class Sharpest(_Block):
    """The sharpest tolerance that 95 % of the episodes met where they settled; None if none is.

    Attributes:
        scale: Multiple of all the task's tolerances at once; None also where one of them is 0.
        errors: Bound on each metric alone.
    """

    scale: Error | None
    errors: dict[str, Error | None]


class SettledSummary(_Block):
    """Where the episodes ended, those that were lost counting where they stopped.

    Attributes:
        n_lost: Episodes that ended in a collision or a failure, before or after the goal.
        errors: Each metric.
        success_by_scale: Success against tolerance, lost episodes never a success; None where a
            tolerance is 0.
        sharpest_95: The sharpest tolerance met in 95 % of the scenarios.
    """

    n_lost: Count
    errors: dict[str, SettledErrorSummary]
    success_by_scale: ToleranceCurve | None
    sharpest_95: Sharpest

    @classmethod
    def of(cls, rows: Sequence[EpisodeRow], tolerances: Mapping[str, float]) -> Self:
        """Returns the summary of one or more rows."""
        ends = [row.settled for row in rows]
        curve, scale = None, None
        if all(bound > 0 for bound in tolerances.values()):
            scales = [row.scale(tolerances) for row in rows]
            share = statistics.share_within(scales, SCALES)
            curve = ToleranceCurve(scale=list(SCALES), pc_success=share.tolist())
            scale = _sharpest(scales)
        return cls(
            n_lost=sum(end.lost for end in ends),
            errors={
                name: SettledErrorSummary.of([end.errors[name] for end in ends])
                for name in rows[0].errors
            },
            success_by_scale=curve,
            sharpest_95=Sharpest(
                scale=scale,
                errors={
                    name: _sharpest([math.inf if end.lost else end.errors[name] for end in ends])
                    for name in rows[0].errors
                },
            ),
        )


class Summary(_Block):
    """The numbers a board shows.

    Attributes:
        task: Named task.
        policy: What was asked for: a built-in name, a checkpoint, a module, or a server's name.
        split: Split whose first scenarios were played.
        n_episodes: Scenarios played.
        n_success: Successes among them.
        pc_success: Success rate (percent).
        pc_success_ci95: Wilson 95 % interval of the success rate (percent).
        n_collision: Episodes that ended in a collision.
        n_failure: Episodes that the policy lost by a failure of its own.
        failures: How many for each reason.
        n_clipped: Control steps, over all episodes, whose action was out of range.
        steps_to_goal_mean: Mean over successes; None if there is none.
        success_by_step: Share solved within 1, 2, ... control steps (percent).
        errors: Each metric over all episodes, where each was scored.
        settled: Where they ended.
    """

    task: str
    policy: str
    split: str
    n_episodes: Annotated[int, pydantic.Field(ge=1)]
    n_success: Count
    pc_success: float
    pc_success_ci95: Interval
    n_collision: Count
    n_failure: Count
    failures: dict[str, int]
    n_clipped: Count
    steps_to_goal_mean: float | None
    success_by_step: list[Percent]
    errors: dict[str, ErrorSummary]
    settled: SettledSummary

    @classmethod
    def of(
        cls,
        task: str,
        policy: str,
        split: str,
        rows: Sequence[EpisodeRow],
        *,
        tolerances: Mapping[str, float],
        time_limit_steps: int,
    ) -> Self:
        """Returns the summary of one or more rows.

        Args:
            task: Named task.
            policy: Name of the policy.
            split: Split of the scenarios.
            rows: One or more.
            tolerances: Bound of each error that the task bounds (mm, deg).
            time_limit_steps: The task's time limit (control steps).
        """
        to_goal = [row.steps_to_goal for row in rows if row.steps_to_goal is not None]
        n_success = len(to_goal)
        failures = Counter(row.failure for row in rows if row.failure is not None)
        solved = statistics.share_solved_by([row.steps_to_goal for row in rows], time_limit_steps)
        return cls(
            task=task,
            policy=policy,
            split=split,
            n_episodes=len(rows),
            n_success=n_success,
            pc_success=100 * n_success / len(rows),
            pc_success_ci95=list(statistics.wilson_interval(n_success, len(rows))),
            n_collision=sum(row.collision for row in rows),
            n_failure=failures.total(),
            failures=dict(sorted(failures.items())),
            n_clipped=sum(row.n_clipped for row in rows),
            steps_to_goal_mean=sum(to_goal) / n_success if to_goal else None,
            success_by_step=solved.tolist(),
            errors={
                name: ErrorSummary.of([row.errors[name] for row in rows]) for name in rows[0].errors
            },
            settled=SettledSummary.of(rows, tolerances),
        )


class Metadata(_Block):
    """What was run and on what: enough to run it again, nothing that names a person or host.

    Attributes:
        created: UTC date and time, ISO 8601.
        suite_version: Version of hvs_suite.
        task_version: Version of the named task.
        task_digest: Digest of the task's meaning, from the lock file.
        tolerances: Bound of each metric that decides success, in the metric's unit.
        time_limit_steps: The task's time limit (control steps).
        options: Options that differ from the named task's; empty for a score.
        policy_kind: ``builtin``, ``checkpoint``, ``module`` (code of one's own) or ``server``.
        policy_hash: SHA-256 over the checkpoint's files, or of the module's; a server's own word;
            None for a policy that comes with the suite.
        policy_parameters: Numbers in the checkpoint's weights; None if it has none.
        training_steps: Optimiser steps, as far as the checkpoint tells.
        training_hours: Hours of training, as far as the checkpoint tells.
        decision_limit_s: Time after which a decision lost its episode (s).
        actions_sha256: SHA-256 of the action log, ``<file stem>.actions.npz`` beside the file.
        n_logged: How many scenarios, from 0 up, the log holds. What a built-in policy did in the
            others is found out by letting it play again.
        packages: Version of each package that can change a number.
        gl_renderer: The OpenGL renderer that drew the images; None if none were drawn.
        cpu: Processor model.
        platform: Operating system and architecture.
    """

    created: str
    suite_version: str
    task_version: int
    task_digest: str
    tolerances: Annotated[dict[str, float], pydantic.Field(min_length=1)]
    time_limit_steps: Annotated[int, pydantic.Field(ge=1)]
    options: dict[str, Any]
    policy_kind: Literal["builtin", "checkpoint", "module", "server"]
    policy_hash: str | None
    policy_parameters: Count | None
    training_steps: Count | None
    training_hours: Seconds | None
    decision_limit_s: Seconds
    actions_sha256: Annotated[str, pydantic.Field(pattern="^[0-9a-f]{64}$")]
    n_logged: Annotated[int, pydantic.Field(ge=1)]
    packages: dict[str, str]
    gl_renderer: str | None
    cpu: str
    platform: str

    @pydantic.model_validator(mode="after")
    def _agree(self) -> Self:
        """Refuses bounds that nothing can meet."""
        for name, bound in self.tolerances.items():
            if not 0.0 <= bound < math.inf:
                raise ValueError(f"tolerances.{name} is no bound on a metric")
        return self


class Timings(_Block):
    """How long it took; differs from run to run.

    Attributes:
        workers: Processes that shared the work, in the last sitting.
        wall_s: Wall time of the evaluation over all sittings, start of the workers included (s).
        steps_per_s: Control steps a second of all workers together while they play, resets
            included; what `hvs bench` measures as well.
        decision_ms: Mean wall time of one `select_action` (ms).
        decision_ms_max: The longest (ms).
    """

    workers: Annotated[int, pydantic.Field(ge=1)]
    wall_s: Seconds
    steps_per_s: Seconds
    decision_ms: Seconds
    decision_ms_max: Seconds


class Result(_Block):
    """A result file; see the module's text for its blocks."""

    schema_version: Literal[3]
    summary: Summary
    metadata: Metadata
    timings: Timings
    episodes: Annotated[list[EpisodeRow], pydantic.Field(min_length=1)]

    @pydantic.model_validator(mode="after")
    def _agree(self) -> Self:
        """Refuses rows that are not alike, and a summary that is not theirs."""
        if [row.scenario for row in self.episodes] != list(range(len(self.episodes))):
            raise ValueError("episodes are scenarios 0..N-1, in this order")
        metrics = self.episodes[0].errors.keys()
        if any(row.errors.keys() != metrics for row in self.episodes):
            raise ValueError("all rows must have the same metrics")
        if not self.metadata.tolerances.keys() <= metrics:
            raise ValueError("metadata.tolerances bounds what is no metric")
        n_logged = self.metadata.n_logged
        plays_again = is_ours(self.summary.policy, self.metadata.policy_kind)
        if n_logged > len(self.episodes) or (n_logged < len(self.episodes) and not plays_again):
            raise ValueError("metadata.n_logged must be the number of rows")
        if n_logged < len(self.episodes) and self.metadata.options:
            raise ValueError("metadata.n_logged must be the number of rows where there are options")
        ours = self.summary
        theirs = Summary.of(
            ours.task,
            ours.policy,
            ours.split,
            self.episodes,
            tolerances=self.metadata.tolerances,
            time_limit_steps=self.metadata.time_limit_steps,
        )
        for name, value in theirs.model_dump().items():
            if not _close(getattr(ours, name), value):
                raise ValueError(f"summary.{name} is not what the episodes give")
        return self


def is_ours(policy: str, kind: str) -> bool:
    """Returns whether a policy is one of the suite's own, which can play again."""
    return policy in catalogue.NAMES and kind in ("builtin", "checkpoint")


def actions_path(path: Path) -> Path:
    """Returns where the action log of a result file lies: ``<file stem>.actions.npz``."""
    return path.with_name(f"{path.stem}.actions.npz")


def write(result: Result, path: Path) -> None:
    """Writes a result atomically: a reader sees the old file or the new one, never half of one.

    Raises:
        OutputError: The file cannot be written.
    """
    blocks = result.model_dump(mode="json")
    blocks["episodes"] = _columns(blocks["episodes"])
    blocks = {"schema_version": blocks.pop("schema_version"), "sha256": seal(blocks), **blocks}
    columns = _text(blocks.pop("episodes"), "  ")
    head = json.dumps(blocks, indent=2, allow_nan=False).removesuffix("\n}")
    with files.replacing(path) as temporary:
        temporary.write_text(f'{head},\n  "episodes": {columns}\n}}\n', encoding="utf-8")


def _columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rows as columns; one that holds the same value throughout is that value.

    The scenarios are 0..N-1 and left out, as are settled figures that are the episodes' own.
    """
    columns: dict[str, Any] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if name == "scenario":
            continue
        if isinstance(values[0], dict):
            columns[name] = _columns(values)
        else:
            same = all(value == values[0] for value in values)
            columns[name] = values[0] if same else values
    if "settled" in columns:
        columns["settled"] = {
            name: column
            for name, column in columns["settled"].items()
            if column != columns.get(name, ...)
        }
    return columns


def _rows(columns: Mapping[str, Any], n: int) -> list[dict[str, Any]]:
    """What `_columns` was made of.

    Raises:
        ValueError: A column is not as long as there are rows.
    """
    if isinstance(columns.get("settled"), dict):
        own = {name: columns[name] for name in Settled.model_fields if name in columns}
        columns = {**columns, "settled": own | columns["settled"]}
    spread: dict[str, list[Any]] = {}
    for name, column in columns.items():
        if isinstance(column, dict):
            spread[name] = _rows(column, n)
        elif isinstance(column, list):
            if len(column) != n:
                raise ValueError(f"{name} holds {len(column)} values for {n} episodes")
            spread[name] = column
        else:
            spread[name] = [column] * n
    return [{name: values[i] for name, values in spread.items()} for i in range(n)]


def _n_columns(columns: Mapping[str, Any]) -> int:
    return sum(_n_columns(c) if isinstance(c, dict) else 1 for c in columns.values()) + 1


def _text(columns: Mapping[str, Any], indent: str) -> str:
    """Columns as JSON, one a line: readable, and a difference shows in which column it is."""
    lines = [
        f"{indent}  {json.dumps(name)}: "
        + (
            _text(column, indent + "  ")
            if isinstance(column, dict)
            else json.dumps(column, separators=(",", ":"), allow_nan=False)
        )
        for name, column in columns.items()
    ]
    return "{\n" + ",\n".join(lines) + f"\n{indent}}}"


def seal(content: Mapping[str, Any]) -> str:
    """Returns the SHA-256 over the blocks of a file: keys sorted, no spaces, version and seal out.

    It detects accidental changes, such as by an editor or half a merge. A cheat can compute it
    again; re-simulation finds that.
    """
    blocks = {k: v for k, v in content.items() if k not in ("schema_version", "sha256")}
    text = json.dumps(blocks, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def load(path: Path) -> Result:
    """Reads and checks a result.

    Raises:
        ResultError: The file cannot be read, or is not a consistent result; says what is wrong.
    """
    content = reading.read_object(path, error=ResultError, most=MOST_BYTES)
    version = content.get("schema_version")
    if version is None:
        raise ResultError(f"{path}: is no result of 'hvs evaluate' (it has no schema_version)")
    if version != SCHEMA_VERSION:
        raise ResultError(
            f"{path}: schema_version is {version!r:.50}, but this hvs_suite reads "
            f"{SCHEMA_VERSION}; evaluate again with this version"
        )
    sealed = content.pop("sha256", None)
    unsealed = {**content, "episodes": _episodes(path, content)}
    result = reading.validated(Result, unsealed, path, error=ResultError)
    try:
        fits = sealed == seal(content)
    except ValueError as error:
        raise ResultError(f"{path}: holds a number without bounds; evaluate again") from error
    if not fits:
        raise ResultError(f"{path}: was changed after it was written (sha256); evaluate again")
    return result


def _episodes(path: Path, content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of a file's columns.

    Raises:
        ResultError: They are no columns of as many values as the summary says.
    """
    columns, summary = content.get("episodes"), content.get("summary")
    n = summary.get("n_episodes") if isinstance(summary, dict) else None
    if not isinstance(columns, dict) or not isinstance(n, int) or n < 1:
        raise ResultError(f"{path}: holds no columns of episodes; evaluate again")
    if n * _n_columns(columns) > MOST_VALUES:
        raise ResultError(f"{path}: holds more than {MOST_VALUES:,} values of episodes")
    try:
        rows = _rows(columns, n)
    except ValueError as error:
        raise ResultError(f"{path}: episodes: {error}; evaluate again") from error
    return [{"scenario": index, **row} for index, row in enumerate(rows)]


def _sharpest(errors: Sequence[float]) -> float | None:
    sharpest = statistics.sharpest_tolerance(errors, SHARPEST_PERCENT)
    return sharpest if math.isfinite(sharpest) else None


def _close(ours: Any, theirs: Any) -> bool:
    """Equal, but for a last digit that another NumPy may round differently."""
    if isinstance(ours, pydantic.BaseModel):
        ours = ours.model_dump()
    if isinstance(ours, dict):
        return ours.keys() == theirs.keys() and all(_close(ours[k], theirs[k]) for k in ours)
    if isinstance(ours, list):
        return len(ours) == len(theirs) and all(map(_close, ours, theirs))
    if isinstance(ours, float) and isinstance(theirs, float):
        return math.isclose(ours, theirs, rel_tol=1e-9, abs_tol=1e-9)
    return bool(ours == theirs)
