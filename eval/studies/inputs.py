"""Thesis, D.1: which inputs a policy needs, of two cameras, joint positions and joint velocities.

Budget: on one core 4,000 optimiser steps on ``align-thesis`` took 9 minutes and 5,000 on
``track-line`` 18 (metadata of the shipped weights' results); rounds of DAgger, decoding and 200
scenes come to 4 minutes more. So a cell takes 11 and 18 minutes, and the 24 cells with two seeds
12 hours on one core, 6 on two.
"""

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import Imitation, Recording

CAMERAS = {"both cameras": ("eih", "eth"), "eye in hand": ("eih",), "eye to hand": ("eth",)}
JOINTS = {
    "positions, velocities": ("joint_positions", "joint_velocities"),
    "positions": ("joint_positions",),
    "velocities": ("joint_velocities",),
    "no joints": (),
}
WHOLE = "both cameras, positions, velocities"


def plan(*, quick: bool = False) -> Plan:
    """The twelve combinations on a still and on a moving target.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    cells = []
    for task, episodes, steps in (("align-thesis", 600, 3000), ("track-line", 300, 4000)):
        data = Recording(task=task, episodes=4 if quick else episodes, options={"start": "mixed"})
        for cameras, eyes in CAMERAS.items():
            for joints, felt in JOINTS.items():
                name = f"{cameras}, {joints}"
                settings = {"inputs": (*eyes, *felt), "dagger_rounds": 2, "dagger_frames": 3000}
                if quick:
                    settings |= {"dagger_rounds": 1, "dagger_frames": 8, "batch_size": 4}
                cells.append(
                    Cell(
                        group=task,
                        name=name,
                        way=Imitation(data=data, steps=2 if quick else steps, settings=settings),
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
