"""What each choice of the `hvs` policy contributes: trained without it, on one task a family.

Every policy of a task has the same data, seed and number of optimiser steps as the whole one, but
for the one thing that its cell names, and plays the same scenes. All begin with fresh eyes, so that
those which learn without keypoints know of none.

Budget: the cells took 6 minutes (no eye to hand) to 51 (``surface-tilted``) on one core, as their
``minutes`` in docs/experiments/ablation.json say: 42 cells 12.6 hours on one core, 6.3 on two.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from hvs_suite.errors import OptionError
from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import TRIAL, Effort, imitation
from hvs_suite.policies.imitation.settings import INPUTS, Settings

WHOLE = "everything"
EFFORTS: Mapping[str, Effort] = MappingProxyType(
    {
        "align-thesis": Effort(demonstrations=600, steps=3000, dagger_rounds=2),
        "sequence-thesis": Effort(demonstrations=200, steps=4000, dagger_rounds=2),
        "track-line": Effort(demonstrations=300, steps=3000, dagger_rounds=2),
        "surface-tilted": Effort(demonstrations=400, steps=4000, dagger_rounds=2),
        "clutter-choice": Effort(demonstrations=600, steps=4000, dagger_rounds=2),
        "insert-wide": Effort(demonstrations=300, steps=4000, dagger_rounds=2),
    }
)
SLOPES: Mapping[str, tuple[str, ...]] = MappingProxyType({"surface-tilted": ("eih",)})
"""Cameras whose eyes tell the slope, where surfaces lean."""
LEFT_OUT: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        WHOLE: {},
        "no memory": {"without": ("memory",)},
        "no keypoints": {"without": ("keypoints",)},
        "no DAgger": {"dagger_rounds": 0},
        "no eye in hand": {"inputs": tuple(name for name in INPUTS if name != "eih")},
        "no eye to hand": {"inputs": tuple(name for name in INPUTS if name != "eth")},
        "windows of one frame": {
            "window_steps": 1,
            "windows": Settings.windows * Settings.window_steps,
        },
    }
)


def plan(tasks: Sequence[str] = (), *, quick: bool = False) -> Plan:
    """The policy as it is, and without one thing at a time.

    Args:
        tasks: Some of `EFFORTS`; all by default.
        quick: Make everything in minutes, of next to no training.

    Raises:
        OptionError: A task has no effort.
    """
    if unknown := sorted({*tasks} - {*EFFORTS}):
        raise OptionError(f"no ablation of {unknown[0]!r}; choose from {', '.join(EFFORTS)}")
    cells = []
    for task in tasks or EFFORTS:
        for name, left_out in LEFT_OUT.items():
            settings = dict(left_out)
            slopes = SLOPES.get(task, ())
            if slopes := tuple(eye for eye in slopes if eye in settings.get("inputs", INPUTS)):
                settings["slopes"] = slopes
            cells.append(
                Cell(
                    group=task,
                    name=name,
                    way=imitation(task, TRIAL if quick else EFFORTS[task], **settings),
                    on=[Scenes(task=task)],
                    against=None if name == WHOLE else WHOLE,
                )
            )
    return Plan(
        name="ablation",
        question="What does each choice contribute? Policies that lack one thing each.",
        cells=cells,
        seeds=1,
        episodes=2 if quick else 200,
    )
