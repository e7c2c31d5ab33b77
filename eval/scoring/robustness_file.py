"""What a robustness study found, scene by scene: a small file without logs.

The results of its cells, with their action logs, stay in the study's folder; this file holds which
scenes each cell solved, from which everything else in it follows.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pydantic

from hvs_suite import reading, statistics
from hvs_suite.errors import ResultError
from hvs_suite.eval.scoring.comparison import SIGNIFICANT, Tally
from hvs_suite.eval.scoring.result_file import Result

ALL = "all"
"""Name of the axis that disturbs all others at once."""
COMMITTED = Path(__file__).resolve().parents[1] / "robustness"
"""Where the studies lie that came with the suite: ``<policy>/<task>.json``."""
MOST_BYTES = 2**20
_MOST_SCENES = 10_000

Solved = Annotated[str, pydantic.Field(pattern="^[01]+$", max_length=_MOST_SCENES)]
Count = Annotated[int, pydantic.Field(ge=0)]


class _Block(pydantic.BaseModel):
    """Unknown keys are refused, so that a typing error is not taken for a figure."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Played(_Block):
    """The same scenes, played one way.

    Attributes:
        solved: A digit a scene from 0 up: 1 where it was solved.
        n_success: How many were.
        pc_success: The same in percent.
        pc_success_ci95: Wilson 95 % interval (%).
        n_collision: Scenes that ended in a collision.
    """

    solved: Solved
    n_success: Count
    pc_success: float
    pc_success_ci95: tuple[float, float]
    n_collision: Count

    @classmethod
    def figures(cls, solved: str, n_collision: int) -> dict[str, Any]:
        """The fields, as the scenes give them."""
        n_success = solved.count("1")
        return {
            "solved": solved,
            "n_success": n_success,
            "pc_success": round(100.0 * n_success / len(solved), 3),
            "pc_success_ci95": tuple(
                round(end, 3) for end in statistics.wilson_interval(n_success, len(solved))
            ),
            "n_collision": n_collision,
        }

    @classmethod
    def of(cls, result: Result) -> Self:
        """What a result says of its scenes."""
        return cls(**cls.figures(solved_in(result), result.summary.n_collision))


class Cell(Played):
    """One axis at one strength.

    Attributes:
        axis: Name of the axis.
        title: The axis in words.
        strength: ``mild``, ``medium`` or ``strong``.
        level: The strength in words.
        options: Options of the task that it was played with.
        n_lost: Scenes that were solved undisturbed, and now are not.
        n_won: Scenes that are solved only now.
        p: Two-sided p-value of McNemar's exact test against the undisturbed scenes.
    """

    axis: str
    title: str
    strength: str
    level: str
    options: dict[str, Any]
    n_lost: Count
    n_won: Count
    p: Annotated[float, pydantic.Field(ge=0.0, le=1.0)]

    @classmethod
    def paired(cls, solved: str, undisturbed: str) -> dict[str, Any]:
        """The fields that compare scenes with the undisturbed ones."""
        tally = Tally.of(_outcomes(undisturbed), _outcomes(solved))
        return {"n_lost": tally.n_only_a, "n_won": tally.n_only_b, "p": tally.p}


class Robustness(_Block):
    """A study.

    Attributes:
        schema_version: Of this file.
        policy: Name of the policy.
        policy_hash: As in a result.
        task: Named task.
        task_digest: Digest of the task's meaning, from the version lock.
        suite_version: Version of hvs_suite.
        gl_renderer: What drew the pictures; None if none were drawn.
        split: Split whose first scenes were played.
        episodes: How many.
        undisturbed: The task as named.
        cells: What was disturbed, axis by axis, from mild to strong.
        missing: Axes that make no sense for the task, and why.
    """

    schema_version: Literal[1]
    policy: str
    policy_hash: str | None
    task: str
    task_digest: str
    suite_version: str
    gl_renderer: str | None
    split: str
    episodes: Annotated[int, pydantic.Field(ge=1, le=_MOST_SCENES)]
    undisturbed: Played
    cells: list[Cell]
    missing: dict[str, str]

    @pydantic.model_validator(mode="after")
    def _agree(self) -> Self:
        """Refuses figures that are not those of the scenes."""
        for played in (self.undisturbed, *self.cells):
            if len(played.solved) != self.episodes:
                raise ValueError(f"solved has {len(played.solved)} scenes, not {self.episodes}")
            figures = Played.figures(played.solved, played.n_collision)
            if isinstance(played, Cell):
                figures |= Cell.paired(played.solved, self.undisturbed.solved)
            for name, value in figures.items():
                if getattr(played, name) != value:
                    raise ValueError(f"{name} is not what the scenes give")
        return self

    def axes(self) -> dict[str, list[Cell]]:
        """The cells of each axis, by its name, from mild to strong."""
        found: dict[str, list[Cell]] = {}
        for cell in self.cells:
            found.setdefault(cell.axis, []).append(cell)
        return found

    def significant(self) -> set[tuple[str, str]]:
        """Axis and strength of each cell that differs from the undisturbed scenes.

        At 5 % for all cells together, by Holm's correction.
        """
        corrected = statistics.holm([cell.p for cell in self.cells])
        return {
            (cell.axis, cell.strength)
            for cell, p in zip(self.cells, corrected, strict=True)
            if p < SIGNIFICANT
        }


def solved_in(result: Result) -> str:
    """A digit a scene: 1 where it was solved."""
    return "".join("1" if row.success else "0" for row in result.episodes)


def load(path: Path) -> Robustness:
    """Reads and checks a study.

    Raises:
        ResultError: The file cannot be read, or is no consistent study; says what is wrong.
    """
    content = reading.read_object(path, error=ResultError, most=MOST_BYTES)
    return reading.validated(Robustness, content, path, error=ResultError)


def load_all(folder: Path = COMMITTED) -> list[Robustness]:
    """Reads all studies of a folder, ordered by task and policy.

    Args:
        folder: Holds ``<policy>/<task>.json``; it need not exist.

    Raises:
        ResultError: One of them is none.
    """
    found = [load(path) for path in sorted(folder.glob("*/*.json"))]
    return sorted(found, key=lambda study: (study.task, study.policy))


def _outcomes(solved: str) -> Mapping[int, bool]:
    return {scene: digit == "1" for scene, digit in enumerate(solved)}
