"""Thesis, D.1: which inputs a policy needs, of two cameras, joint positions and joint velocities.

Actions are joint positions, so a policy that is given none still knows what it has sent. It reckons
the joints from there and from where the arm starts: in two episodes of the expert on each task to
1.4 mrad, which is a millimetre at the tip. Velocities it reckons from how far the arm trails.

Budget: on one core a cell on ``align-thesis`` took 5 to 10 minutes to train and 1 to play, and one
on ``track-line``, which learns half as many steps and begins with the eyes of the shipped weights,
4 to 8 minutes and 1 (docs/answers.md). So twelve of each with two seeds take 6 hours on one core.
"""

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import TRIAL, Effort, imitation

CAMERAS = {"both cameras": ("eih", "eth"), "eye in hand": ("eih",), "eye to hand": ("eth",)}
JOINTS = {
    "positions, velocities": ("joint_positions", "joint_velocities"),
    "positions": ("joint_positions",),
    "velocities": ("joint_velocities",),
    "no joints": (),
}
EFFORTS = {
    "align-thesis": Effort(demonstrations=600, steps=3000, dagger_rounds=2),
    "track-line": Effort(demonstrations=300, steps=1500, dagger_rounds=2),
}
EYES = {"track-line": "track-line"}
"""Whose shipped weights the eyes begin with: they need not learn again to see the same disc."""
WHOLE = "both cameras, positions, velocities"


def plan(*, quick: bool = False) -> Plan:
    """The twelve combinations on a still and on a moving target.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    cells = []
    for task, effort in EFFORTS.items():
        for cameras, eyes in CAMERAS.items():
            for joints, felt in JOINTS.items():
                name = f"{cameras}, {joints}"
                cells.append(
                    Cell(
                        group=task,
                        name=name,
                        way=imitation(
                            task,
                            TRIAL if quick else effort,
                            inputs=(*eyes, *felt),
                            eyes=EYES.get(task),
                        ),
                        on=[Scenes(task=task)],
                        against=None if name == WHOLE else WHOLE,
                    )
                )
    return Plan(
        name="inputs",
        question="Which inputs does a policy need (D.1)?",
        cells=cells,
        seeds=1 if quick else 2,
        episodes=2 if quick else 200,
    )
