"""Up, over, and down: how the demonstrator comes among obstacles.

A policy does not see well enough what stands around to go around it. As ``servo``, it can go a way
that meets little wherever things stand: up, over to a place above the goal, and down from there.
A demonstrator that knows of no obstacle touches something in 38 of 200 scenes of
``clutter-obstacles`` if it goes straight, in 25 if it comes from above, and in 15 if it also rises
first (docs/experiments/flyover.md).
"""

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets.leaning import raised
from hvs_suite.tasks.shared.goal import Goal, Tip
from hvs_suite.tasks.shared.obstacles import ObstaclesSpec
from hvs_suite.tasks.shared.spec import Spec

FloatArray = npt.NDArray[np.float64]

OVER_M = 0.30
"""How far above the goal it comes down from (m): higher places are out of reach near the rim of the
ring on which targets lie."""
UPRIGHT_RAD: FloatArray = np.zeros(7)
"""To where it rises (rad): the upright arm, to which most ways are free."""
_BESIDE_M = 0.06
"""From how near to the line above the goal it goes down (m)."""
_RISES_BESIDE_M = 0.10
_FAR_HIGH_M, _NEAR_HIGH_M = 0.60, 0.24
"""How high above the goal it rises (m): far from the line above it, and `_RISES_BESIDE_M` from it.
Falling from the one to the other, the bound leaves room for the way over."""
_FAR_M = 0.4
"""So much farther from the line than `_RISES_BESIDE_M` it rises highest (m)."""


def leads_over(spec: Spec) -> bool:
    """Whether anything may stand around in a task, so that its demonstrations come this way.

    Args:
        spec: Parameters of the task.
    """
    return isinstance(spec, ObstaclesSpec) and spec.n_obstacles[1] > 0


def next_place(goal: Goal, tip: Tip) -> Goal:
    """Where to go on the way to a goal: above it, and once there, to the goal.

    Args:
        goal: Over a level surface.
        tip: Where the arm is.
    """
    return raised(goal, OVER_M) if _beside_m(goal, tip) > _BESIDE_M else goal


def is_low(goal: Goal, tip: Tip) -> bool:
    """Whether the arm should rise before it goes over to a goal.

    Args:
        goal: Over a level surface.
        tip: Where the arm is.
    """
    further_m = _beside_m(goal, tip) - _RISES_BESIDE_M
    high_m = np.interp(further_m, [0.0, _FAR_M], [_NEAR_HIGH_M, _FAR_HIGH_M])
    return bool(further_m > 0.0 and goal.normal @ (tip.position - goal.position) < high_m)


def _beside_m(goal: Goal, tip: Tip) -> float:
    """How far a tip is from the line above a goal (m)."""
    offset = tip.position - goal.position
    return float(np.linalg.norm(offset - (goal.normal @ offset) * goal.normal))
