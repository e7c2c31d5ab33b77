"""Thesis, D.6: what a curriculum buys RL that begins with few demonstrations.

Budget: on one core 8,000 environment steps with their evaluations took 5 to 6 minutes
(docs/answers.md). Three cells, from 10 and from 25 demonstrations, with three seeds: 1.7 hours on
one core.
"""

import typing

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import from_few, tuned
from hvs_suite.policies.rl.curriculum import Kind

TASK = "align-thesis"
DEMONSTRATIONS = (10, 25)
NONE = "no curriculum"


def plan(*, quick: bool = False) -> Plan:
    """Without a curriculum, and with each.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    kinds: dict[str, Kind | None] = {
        NONE: None,
        **{f"{kind} curriculum": kind for kind in typing.get_args(Kind)},
    }
    cells = []
    for n in DEMONSTRATIONS[:1] if quick else DEMONSTRATIONS:
        base = from_few(TASK, quick=quick, demonstrations=n)
        cells += [
            Cell(
                group=f"{TASK}, from {n} demonstrations",
                name=name,
                way=tuned(base, TASK, quick=quick, curriculum=kind),
                on=[Scenes(task=TASK)],
                against=None if kind is None else NONE,
            )
            for name, kind in kinds.items()
        ]
    return Plan(
        name="curriculum",
        question="What does a curriculum buy (D.6)?",
        cells=cells,
        seeds=1 if quick else 3,
        episodes=2 if quick else 100,
    )
