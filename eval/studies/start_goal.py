"""Thesis, D.5: what a fixed start or a fixed goal in training changes, by imitation and by RL.

The fixed start is the thesis's, all joints zero; the fixed goal is one place in the middle of the
ring. Each policy plays all four combinations.

Budget: one seed of all took 47 minutes on one core, beside other work (docs/answers.md): three
seeds 2.4 hours, 1.2 on two.
"""

from typing import Any

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import TRIAL, Effort, Way, from_few, imitation, tuned

TASK = "align-thesis"
EFFORT = Effort(demonstrations=300, steps=800, dagger_rounds=2)
STARTS = {"fixed start": "zero", "random start": "random"}
GOALS: dict[str, Any] = {"fixed goal": (0.5, 0.2), "random goal": "random"}
TIME_LIMIT_STEPS = 40
"""The task's 20 are too short from some random starts."""
WHOLE = "random start, random goal"


def plan(*, quick: bool = False) -> Plan:
    """Four trainings in two ways, each played on all four.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    settings = {
        f"{start}, {goal}": {
            "start": STARTS[start],
            "goal": GOALS[goal],
            "time_limit_steps": TIME_LIMIT_STEPS,
        }
        for start in reversed(STARTS)
        for goal in reversed(GOALS)
    }
    scenes = [Scenes(task=TASK, options=options, name=name) for name, options in settings.items()]

    def ways(options: dict[str, Any]) -> dict[str, Way]:
        return {
            "imitation": imitation(TASK, TRIAL if quick else EFFORT, options, eyes=TASK),
            "RL from few demonstrations": tuned(
                from_few(TASK, options, quick=quick),
                TASK,
                quick=quick,
                options=options,
            ),
        }

    cells = [
        Cell(
            group=group,
            name=name,
            way=ways(options)[group],
            on=scenes,
            against=None if name == WHOLE else WHOLE,
        )
        for group in ways({})
        for name, options in settings.items()
    ]
    return Plan(
        name="start-goal",
        question="What does a fixed start or goal in training change (D.5)?",
        cells=cells,
        seeds=1 if quick else 3,
        episodes=2 if quick else 100,
    )
