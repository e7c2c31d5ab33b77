"""The result file: one policy on one task, every episode a row, and all that made the numbers.

The file is JSON with five blocks: ``schema_version``, ``summary`` (computed from the rows),
``metadata`` (what was run, on what), ``timings`` (the only block that differs between two runs of
the same thing) and ``episodes``, one row a line, so that two files can be compared line by line.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import pydantic

from hvs_suite import files, rollout, statistics
from hvs_suite.errors import ResultError

SCHEMA_VERSION: Final = 1
ERRORS = ("position_error_mm", "lateral_error_mm", "height_error_mm", "tilt_error_deg")

Count = Annotated[int, pydantic.Field(ge=0)]
Error = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]
Seconds = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]


class _Block(pydantic.BaseModel):
    """Unknown keys and values of another type are refused, not guessed."""

    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)


class EpisodeRow(_Block):
    """One scenario's outcome; meanings and units as in `hvs_suite.rollout.Episode`."""

    scenario: Count
    success: bool
    success_once: bool
    collision: bool
    truncated: bool
    steps: Annotated[int, pydantic.Field(ge=1)]
    steps_to_goal: int | None
    n_clipped: Count
    position_error_mm: Error
    lateral_error_mm: Error
    height_error_mm: Error
    tilt_error_deg: Error

    @classmethod
    def of(cls, episode: rollout.Episode) -> Self:
        """Returns the row of an episode."""
        return cls(**{name: getattr(episode, name) for name in cls.model_fields})

    @pydantic.model_validator(mode="after")
    def _agree(self) -> Self:
        """Refuses an outcome that no episode can have."""
        if self.steps_to_goal != (self.steps if self.success else None):
            raise ValueError("steps_to_goal must equal steps for a success and be null otherwise")
        if self.success + self.collision + self.truncated != 1:
            raise ValueError("exactly one of success, collision and truncated must be true")
        if self.success and not self.success_once:
            raise ValueError("a success must also count as success_once")
        if self.n_clipped > self.steps:
            raise ValueError("n_clipped cannot exceed steps")
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


class Summary(_Block):
    """The numbers a board shows.

    Attributes:
        task: Named task.
        policy: What was asked for: a built-in name or a checkpoint folder.
        split: Split whose first scenarios were played.
        n_episodes: Scenarios played.
        n_success: Successes among them.
        pc_success: Success rate (percent).
        pc_success_ci95: Wilson 95 % interval of the success rate (percent).
        n_collision: Episodes that ended in a collision.
        n_clipped: Control steps, over all episodes, whose action was out of range.
        steps_to_goal_mean: Mean over successes; None if there is none.
        position_error_mm: Error over all episodes, likewise the three below.
        lateral_error_mm: In the target plane.
        height_error_mm: Along the surface normal.
        tilt_error_deg: Between flange axis and inward surface normal.
    """

    task: str
    policy: str
    split: str
    n_episodes: Annotated[int, pydantic.Field(ge=1)]
    n_success: Count
    pc_success: float
    pc_success_ci95: Annotated[list[float], pydantic.Field(min_length=2, max_length=2)]
    n_collision: Count
    n_clipped: Count
    steps_to_goal_mean: float | None
    position_error_mm: ErrorSummary
    lateral_error_mm: ErrorSummary
    height_error_mm: ErrorSummary
    tilt_error_deg: ErrorSummary

    @classmethod
    def of(cls, task: str, policy: str, split: str, rows: Sequence[EpisodeRow]) -> Self:
        """Returns the summary of one or more rows."""
        to_goal = [row.steps_to_goal for row in rows if row.steps_to_goal is not None]
        n_success = len(to_goal)
        return cls(
            task=task,
            policy=policy,
            split=split,
            n_episodes=len(rows),
            n_success=n_success,
            pc_success=100 * n_success / len(rows),
            pc_success_ci95=list(statistics.wilson_interval(n_success, len(rows))),
            n_collision=sum(row.collision for row in rows),
            n_clipped=sum(row.n_clipped for row in rows),
            steps_to_goal_mean=sum(to_goal) / n_success if to_goal else None,
            **{name: ErrorSummary.of([getattr(row, name) for row in rows]) for name in ERRORS},
        )


class Metadata(_Block):
    """What was run and on what: enough to run it again, nothing that names a person or host.

    Attributes:
        created: UTC date and time, ISO 8601.
        suite_version: Version of hvs_suite.
        task_version: Version of the named task.
        task_digest: Digest of the task's meaning, from the lock file.
        options: Options that differ from the named task's; empty for a score.
        policy_hash: SHA-256 over the checkpoint's files; None for a policy that is code.
        packages: Version of each package that can change a number.
        gl_renderer: The OpenGL renderer that drew the images; None if none were drawn.
        cpu: Processor model.
        platform: Operating system and architecture.
    """

    created: str
    suite_version: str
    task_version: int
    task_digest: str
    options: dict[str, Any]
    policy_hash: str | None
    packages: dict[str, str]
    gl_renderer: str | None
    cpu: str
    platform: str


class Timings(_Block):
    """How long it took; differs from run to run.

    Attributes:
        workers: Processes that shared the work.
        wall_s: Wall time of the whole evaluation, start of the workers included (s).
        steps_per_s: Control steps a second over that time, all workers together.
        decision_ms: Mean wall time of one `select_action` (ms).
    """

    workers: Annotated[int, pydantic.Field(ge=1)]
    wall_s: Seconds
    steps_per_s: Seconds
    decision_ms: Seconds


class Result(_Block):
    """A result file; see the module's text for its blocks."""

    schema_version: Literal[1]
    summary: Summary
    metadata: Metadata
    timings: Timings
    episodes: Annotated[list[EpisodeRow], pydantic.Field(min_length=1)]

    @pydantic.model_validator(mode="after")
    def _agree(self) -> Self:
        """Refuses rows that are not scenarios 0..N-1, and a summary that is not theirs."""
        scenarios = [row.scenario for row in self.episodes]
        seen: set[int] = set()
        for scenario in scenarios:
            if scenario in seen:
                raise ValueError(f"scenario {scenario} appears more than once")
            seen.add(scenario)
        if scenarios != list(range(len(scenarios))):
            raise ValueError("the rows must be scenarios 0..N-1 in this order")
        ours = self.summary
        theirs = Summary.of(ours.task, ours.policy, ours.split, self.episodes)
        for name in Summary.model_fields:
            if not _close(getattr(ours, name), getattr(theirs, name)):
                raise ValueError(f"summary.{name} is not what the episodes give")
        return self


def write(result: Result, path: Path) -> None:
    """Writes a result atomically: a reader sees the old file or the new one, never half of one.

    Raises:
        OutputError: The file cannot be written.
    """
    blocks = result.model_dump(mode="json")
    rows = ",\n    ".join(json.dumps(row, allow_nan=False) for row in blocks.pop("episodes"))
    head = json.dumps(blocks, indent=2, allow_nan=False).removesuffix("\n}")
    with files.replacing(path) as temporary:
        temporary.write_text(f'{head},\n  "episodes": [\n    {rows}\n  ]\n}}\n', encoding="utf-8")


def load(path: Path) -> Result:
    """Reads and checks a result.

    Raises:
        ResultError: The file cannot be read, or is not a consistent result; says what is wrong.
    """
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise ResultError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise ResultError(f"{path}: is not JSON ({error}); evaluate again") from error
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != SCHEMA_VERSION:
        raise ResultError(
            f"{path}: schema_version is {version!r}, but this hvs_suite reads {SCHEMA_VERSION}; "
            "evaluate again with this version"
        )
    try:
        return Result.model_validate(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        what = first["msg"].removeprefix("Value error, ")
        raise ResultError(
            f"{path}: {where + ': ' if where else ''}{what}; evaluate again"
        ) from error


def _close(ours: Any, theirs: Any) -> bool:
    """Equal, but for a last digit that another NumPy may round differently."""
    if isinstance(ours, ErrorSummary):
        pairs = [(getattr(ours, name), getattr(theirs, name)) for name in ErrorSummary.model_fields]
        return all(_close(a, b) for a, b in pairs)
    if isinstance(ours, list):
        return all(_close(a, b) for a, b in zip(ours, theirs, strict=True))
    if isinstance(ours, float) and isinstance(theirs, float):
        return math.isclose(ours, theirs, rel_tol=1e-9, abs_tol=1e-9)
    return bool(ours == theirs)
