"""Thesis, D.2: how small the picture of each camera may be, and whether it needs colour.

Budget: on one core 4,000 optimiser steps on ``align-thesis`` took 9 minutes (metadata of the
shipped weights' result), nearly all of it the eyes at 112 px. The time of an eye grows with its
pixels, so the cells take 5 to 20 minutes on ``align-thesis`` and 8 to 30 on ``surface-tilted``,
whose episodes are longer: the 18 cells with two seeds about 10 hours on one core, 5 on two.
"""

from collections.abc import Sequence
from typing import Any

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import TRIAL, Effort, imitation

EFFORTS = {
    "align-thesis": Effort(demonstrations=600, steps=3000, dagger_rounds=2),
    "surface-tilted": Effort(demonstrations=400, steps=4000, dagger_rounds=2),
}
NAMES = {"eih": "eye in hand", "eth": "eye to hand"}
WHOLE = "both 112 px, colour"


def plan(*, quick: bool = False) -> Plan:
    """Each camera smaller, larger and in grey, on a level and on a tilted surface.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    settings: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {WHOLE: ({}, {})}
    for camera, name in NAMES.items():
        for side in (28, 56, 224):
            settings[f"{name} {side} px"] = ({f"{camera}_resolution": side}, {})
    for camera, name in NAMES.items():
        settings[f"{name} grey"] = ({}, {"grey": (camera,)})
    settings["both grey"] = ({}, {"grey": tuple(NAMES)})
    cells = [
        Cell(
            group=task,
            name=name,
            way=imitation(task, TRIAL if quick else effort, options, **learning),
            on=[Scenes(task=task, options=options | _in_grey(learning.get("grey", ())))],
            against=None if name == WHOLE else WHOLE,
        )
        for task, effort in EFFORTS.items()
        for name, (options, learning) in settings.items()
    ]
    return Plan(
        name="resolution",
        question="How small may the pictures be, and do they need colour (D.2)?",
        cells=cells,
        seeds=1 if quick else 2,
        episodes=2 if quick else 200,
    )


def _in_grey(cameras: Sequence[str]) -> dict[str, int]:
    """Task options that show cameras in grey."""
    return {f"{name}_channels": 1 for name in cameras}
