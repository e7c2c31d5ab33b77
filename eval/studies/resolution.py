"""Thesis, D.2: how small the picture of each camera may be, and whether it needs colour.

Budget: a cell of ``align-thesis`` took 12 to 21 minutes on one core (docs/answers.md), one of
``surface-tilted`` 37 to 47, so one seed of all 6 hours on one core, 3 on two.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import TRIAL, Effort, imitation

NAMES = {"eih": "eye in hand", "eth": "eye to hand"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pictures:
    """What is tried on a task.

    Attributes:
        whole: Name of the cell with the task's own pictures.
        effort: What each cell costs.
        sides: Other sides of the picture of each camera (px).
        grey: Cameras that see no colour; each entry is a cell.
        slopes: Cameras whose eyes tell the slope.
        eyes: Named task of whose shipped weights the eyes begin with; None for fresh ones.
    """

    whole: str
    effort: Effort
    sides: Mapping[str, Sequence[int]]
    grey: Sequence[tuple[str, ...]]
    slopes: tuple[str, ...] = ()
    eyes: str | None = None

    def settings(self) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
        """Task options and settings of the learner, by cell."""
        learning = {"slopes": self.slopes} if self.slopes else {}
        cells: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {self.whole: ({}, learning)}
        for camera, sides in self.sides.items():
            for side in sides:
                cells[f"{NAMES[camera]} {side} px"] = ({f"{camera}_resolution": side}, learning)
        for cameras in self.grey:
            name = NAMES[cameras[0]] if len(cameras) == 1 else "both"
            cells[f"{name} grey"] = ({}, {"grey": cameras, **learning})
        return cells


TASKS: Mapping[str, Pictures] = MappingProxyType(
    {
        "align-thesis": Pictures(
            whole="both 112 px, colour",
            effort=Effort(demonstrations=600, steps=3000, dagger_rounds=2),
            sides={"eih": (28, 56, 224), "eth": (28, 56, 224)},
            grey=(("eih",), ("eth",), ("eih", "eth")),
        ),
        # What learns slopes from nothing does well or badly by chance
        # (docs/experiments/fresh-slopes.md), so the eye in the hand begins with that of
        # surface-hard, whose pictures have the same side. (That of surface-tilted tells slopes in
        # a way that no training takes over any more.) The eye to hand of 336 px begins with the
        # other's too; the smaller ones and the grey one have other layers and begin afresh.
        "surface-tilted": Pictures(
            whole="eye to hand 336 px, colour",
            effort=Effort(demonstrations=300, steps=2000, dagger_rounds=2),
            sides={"eth": (112, 168)},
            grey=(("eth",),),
            slopes=("eih",),
            eyes="surface-hard",
        ),
    }
)


def plan(*, quick: bool = False) -> Plan:
    """Each camera smaller, larger and in grey on a level surface, and one on a tilted surface.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    cells = [
        Cell(
            group=task,
            name=name,
            way=imitation(
                task,
                TRIAL if quick else pictures.effort,
                options,
                eyes=pictures.eyes,
                **learning,
            ),
            on=[Scenes(task=task, options=options | _in_grey(learning.get("grey", ())))],
            against=None if name == pictures.whole else pictures.whole,
        )
        for task, pictures in TASKS.items()
        for name, (options, learning) in pictures.settings().items()
    ]
    return Plan(
        name="resolution",
        question="How small may the pictures be, and do they need colour (D.2)?",
        cells=cells,
        seeds=1,
        episodes=2 if quick else 200,
    )


def _in_grey(cameras: Sequence[str]) -> dict[str, int]:
    """Task options that show cameras in grey."""
    return {f"{name}_channels": 1 for name in cameras}
