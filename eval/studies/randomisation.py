"""Thesis, D.3: what training with a disturbance costs without it, and gives with it.

Each policy is trained on ``align-hard`` with one disturbance, with none or with all, and plays the
scenes of each of them. It is not told which.

Budget: a cell took 31 minutes on one core, seven times 100 scenes included, and two cores made the
seven cells in 2.2 hours, recordings included (docs/answers.md): three seeds about 6.6. So it has
two, which take 4.4.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import TRIAL, Effort, imitation

TASK = "align-hard"
EFFORT = Effort(demonstrations=400, steps=3000, dagger_rounds=2)
NONE, ALL = "nothing", "everything"
DISTURBANCES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "looks": {"vary_light": True, "vary_colour": True, "vary_texture": True},
        "camera pose": {"eth_position_noise_m": 0.005, "eth_rotation_noise_deg": 0.5},
        "image noise": {"image_noise": 4.0},
        "joint offsets": {"joint_offset_deg": 0.05},
        "action noise": {"action_noise": 1e-4},
    }
)
"""What may be disturbed, as strongly as the named tasks do. None of them has noise on actions: here
it turns a joint by 0.3 mrad, and moves the tip by about a third of its tolerance."""


def disturbed(name: str) -> dict[str, Any]:
    """Options that leave one disturbance of the task, none or all."""
    options = {
        option: value if name in (each, ALL) else type(value)(0)
        for each, changed in DISTURBANCES.items()
        for option, value in changed.items()
    }
    return options


def plan(*, quick: bool = False) -> Plan:
    """Trained with each disturbance, played with each.

    Args:
        quick: Make everything in minutes, of next to no training.
    """
    names = (NONE, *DISTURBANCES, ALL)
    scenes = [Scenes(task=TASK, options=disturbed(name), name=name) for name in names]
    cells = [
        Cell(
            group=TASK,
            name=f"trained with {name}",
            way=imitation(TASK, TRIAL if quick else EFFORT, disturbed(name)),
            on=scenes,
            against=None if name == NONE else f"trained with {NONE}",
        )
        for name in names
    ]
    return Plan(
        name="randomisation",
        question="What does training with disturbances cost and give (D.3)?",
        cells=cells,
        seeds=1 if quick else 2,
        episodes=2 if quick else 100,
    )
