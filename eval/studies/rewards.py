"""Thesis, D.4: which rewards help RL, from a policy that learned from few demonstrations.

What RL adds of its own, a potential and the cost of a step, is switched off: policies learn from
the reward that the cell names, and from nothing else. Fine-tuning keeps the base where it did not
become better, so a reward that harms shows as one that does not help.

Budget: on one core 8,000 environment steps took 2.3 to 5.3 minutes and a base 0.4
(docs/answers.md), evaluations and 100 scenes 2 more. Nine cells that learn, with three seeds, and
their bases: 3 hours on one core, 1.5 on two.
"""

from typing import Any

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import Way, from_few, tuned
from hvs_suite.tasks.shared.spec import THESIS_REWARDS

TASK = "align-thesis"
SPARSE = ("goal", "collision")
SPARSE_NAME = "goal and collision alone"
REWARDS: dict[str, dict[str, Any]] = {
    SPARSE_NAME: {"rewards": SPARSE},
    "with rotation": {"rewards": (*SPARSE, "rotation")},
    "with position": {"rewards": (*SPARSE, "position")},
    "with position and rotation": {"rewards": (*SPARSE, "position", "rotation")},
    "with time": {"rewards": (*SPARSE, "time")},
    "with XY and Z apart": {"rewards": (*SPARSE, "lateral", "height")},
    "all five": {"rewards": THESIS_REWARDS},
    "all five, hard time limit": {"rewards": THESIS_REWARDS, "time_limit": "hard"},
    "with exponential distance": {"rewards": (*SPARSE, "exponential")},
    "with joint-space distance": {"rewards": (*SPARSE, "joint_space")},
}
"""The thesis's six sets, and what it wished for besides; options of the task by name."""


def plan(*, quick: bool = False) -> Plan:
    """The base as it is, and tuned by each reward.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    base = from_few(TASK, quick=quick)
    ways: dict[str, Way] = {
        name: tuned(
            base,
            TASK,
            quick=quick,
            settings={"shaping": 0.0, "step_cost": 0.0},
            options=options,
        )
        for name, options in REWARDS.items()
    }
    ways["no RL"] = base
    cells = [
        Cell(
            group=TASK,
            name=name,
            way=way,
            on=[Scenes(task=TASK)],
            against=None if name == SPARSE_NAME else SPARSE_NAME,
        )
        for name, way in ways.items()
    ]
    return Plan(
        name="rewards",
        question="Which rewards help (D.4)?",
        cells=cells,
        seeds=1 if quick else 3,
        episodes=2 if quick else 100,
    )
