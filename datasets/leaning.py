"""Coming down over a target on a spiral, so that the eye in the hand sees it from all sides.

Pictures from one place are all wrong about a slope in the same way, so their mean is no better than
one of them. Where slope and place have to be seen better than that, the demonstrator looks from all
sides on its way down. How it leans depends on how far it has come, and on nothing else, so a
learner needs no memory of where it has looked from.
"""

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from hvs_suite.tasks.shared.goal import Goal, Tip
from hvs_suite.tasks.shared.placing import is_reachable

FloatArray = npt.NDArray[np.float64]

LEANS_RAD = math.radians(20.0), math.radians(10.0)
"""How far it leans to the side: as far as the arm reaches."""
RANGE_M = 0.030
"""How far above the goal the spiral begins (m)."""
TURNS = 1.0
"""How often it goes around the target."""
AHEAD_M = 0.003
"""How far ahead on it the next place to go to lies (m): with less it stops at each."""
UPRIGHT_SHARE = 0.3
"""In the last part of the spiral it straightens up."""


def on_spiral(goal: Goal, tip: Tip) -> tuple[Goal, bool]:
    """Where to go next on the way down to a goal.

    Args:
        goal: Where the spiral ends.
        tip: Where the tool is.

    Returns:
        A place around the target, or `goal` itself where it is near and where the arm reaches no
        place that leans; and whether the tip is on the spiral already.
    """
    left_m = float(np.linalg.norm(tip.position - goal.target)) - goal.standoff_m
    share = min((left_m - AHEAD_M) / RANGE_M, 1.0)
    if share <= 0.0:
        return goal, True
    x, y = axes_across(goal.normal)
    turned = 2.0 * math.pi * TURNS * share
    side = math.cos(turned) * x + math.sin(turned) * y
    for most in LEANS_RAD:
        lean = most * min(share / UPRIGHT_SHARE, 1.0)
        around = dataclasses.replace(
            goal,
            normal=math.cos(lean) * goal.normal + math.sin(lean) * side,
            standoff_m=goal.standoff_m + share * RANGE_M,
        )
        if is_reachable(around):
            return around, share < 1.0
    return goal, share < 1.0


def axes_across(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The base frame's x and y axes, laid into the plane across a normal (3,)."""
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    return x, np.cross(normal, x)
