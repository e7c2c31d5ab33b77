"""What the page shows of robustness studies: for each task, every axis against every policy."""

import dataclasses
from collections.abc import Sequence
from typing import Self

from hvs_suite.eval.board.tables import interval, percent
from hvs_suite.eval.scoring.comparison import SIGNIFICANT
from hvs_suite.eval.scoring.robustness_file import ALL, Cell, Played, Robustness

NOTE = (
    "One thing at a time differs from the task as named, at three strengths, and then all of them "
    "at once; the policy is not told. Each figure is the success in percent on the same scenes as "
    "undisturbed. A star marks a significant difference: McNemar's exact test with Holm's "
    f"correction, p below {SIGNIFICANT:g} for all cells of a policy and task together."
)


@dataclasses.dataclass(frozen=True)
class Tile:
    """Success at one strength.

    Attributes:
        pc_success: In percent.
        text: The same as people read it, without its unit.
        is_significant: Whether it differs from the undisturbed scenes.
        told: Strength, interval and what changed, in words.
    """

    pc_success: float
    text: str
    is_significant: bool
    told: str

    @classmethod
    def of(cls, played: Played, told: str, *, is_significant: bool = False) -> Self:
        """Returns the tile of a cell, or of the undisturbed scenes."""
        rate = f"{percent(played.pc_success)} ({interval(*played.pc_success_ci95)})"
        text = percent(played.pc_success).removesuffix(" %")
        return cls(played.pc_success, text, is_significant, f"{told}: {rate}")


@dataclasses.dataclass(frozen=True)
class Axis:
    """One thing that differs.

    Attributes:
        title: What it is.
        levels: Its strengths, or why the task has none; undisturbed, how many scenes were played.
        tiles: Those of each policy, from mild to strong; empty where it was not played.
    """

    title: str
    levels: str
    tiles: Sequence[Sequence[Tile]]


@dataclasses.dataclass(frozen=True)
class Study:
    """All studies of one task.

    Attributes:
        task: Its name, without version.
        policies: In the order of the tiles.
        worst: Of each policy, success undisturbed and with everything at its strongest; empty
            where that was not played.
        axes: From one disturbance to all of them.
    """

    task: str
    policies: Sequence[str]
    worst: Sequence[tuple[str, Tile, Tile]]
    axes: Sequence[Axis]


def studies(found: Sequence[Robustness]) -> list[Study]:
    """Returns what the page shows of each task that was studied.

    Args:
        found: As `robustness_file.load_all` gives them.
    """
    by_task: dict[str, list[Robustness]] = {}
    for study in found:
        by_task.setdefault(study.task, []).append(study)
    return [_study(task, group) for task, group in by_task.items()]


def _study(task: str, group: Sequence[Robustness]) -> Study:
    undisturbed = [Tile.of(study.undisturbed, "undisturbed") for study in group]
    played = [
        {axis: _tiles(study, cells) for axis, cells in study.axes().items()} for study in group
    ]
    titles = {cell.axis: cell.title for study in group for cell in study.cells}
    n_scenes = ", ".join(dict.fromkeys(f"{study.episodes} scenes" for study in group))
    axes = [Axis("undisturbed", n_scenes, [[tile] for tile in undisturbed])]
    for name in sorted(titles, key=lambda name: name == ALL):
        cells = next(study.axes()[name] for study in group if name in study.axes())
        levels = " · ".join(cell.level for cell in cells)
        axes.append(Axis(titles[name], levels, [tiles.get(name, []) for tiles in played]))
    missing = {name: why for study in group for name, why in study.missing.items()}
    axes += [Axis(name, why, [[] for _ in group]) for name, why in missing.items()]
    worst = [
        (study.policy, undisturbed[k], played[k][ALL][-1])
        for k, study in enumerate(group)
        if ALL in played[k]
    ]
    return Study(task, [study.policy for study in group], worst, axes)


def _tiles(study: Robustness, cells: Sequence[Cell]) -> list[Tile]:
    significant = study.significant()
    return [
        Tile.of(
            cell,
            f"{cell.strength}, {cell.level}; {cell.n_lost} scenes lost, {cell.n_won} won",
            is_significant=(cell.axis, cell.strength) in significant,
        )
        for cell in cells
    ]
