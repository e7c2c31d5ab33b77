"""Coming down over a target on a spiral, so that the eye in the hand sees it from all sides.

Pictures from one place are all wrong about a slope in the same way, so their mean is no better than
one of them. Where slope and place have to be seen better than that, the demonstrator looks from all
sides on its way down. Where it goes next depends on where it is, and on nothing else, so a learner
needs no memory of where it has looked from.
"""

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from hvs_suite.tasks.shared.goal import Goal, Tip
from hvs_suite.tasks.shared.panels import PanelSpec
from hvs_suite.tasks.shared.placing import are_near, is_reachable

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spiral:
    """How the tool comes down around a target.

    Attributes:
        range_m: How far above the goal it begins.
        leans_rad: How far it leans to the side: as far as the arm reaches, of these.
        ahead_m: How far below where the tool is the next place to go to lies (m): with too little
            it stops at each.
        upright_share: In this last part of the way down it straightens up.
        turn_rad: How far around from where the tool leans the next place lies; with None the height
            says where, once around in all.
    """

    range_m: float
    leans_rad: tuple[float, ...]
    ahead_m: float
    upright_share: float
    turn_rad: float | None = None


QUICK = Spiral(
    range_m=0.03,
    leans_rad=(math.radians(20.0), math.radians(10.0)),
    ahead_m=0.003,
    upright_share=0.3,
)
THOROUGH = Spiral(
    range_m=0.06,
    leans_rad=(math.radians(30.0), *QUICK.leans_rad),
    ahead_m=0.004,
    upright_share=0.13,
    turn_rad=math.radians(40.0),
)
"""In 60 scenes of ``surface-hard`` 12 looks lean by more than 20 degrees where the quick one has 2,
and an episode takes 42 steps where it takes 37. From the side a look says most of a slope
(docs/experiments/looks-at-a-slope.md)."""
QUICK_RAD = math.radians(0.4)
"""A slope that need not be known better than this is seen well enough on the quick way down."""


def spiral_for(spec: PanelSpec) -> Spiral:
    """How to come down to the goals of a task.

    Args:
        spec: A slope that is off by more than its tolerance over its standoff loses the goal.
    """
    needed_rad = 1e-3 * spec.tightest_tolerance_mm / spec.standoff_m
    return QUICK if needed_rad >= QUICK_RAD else THOROUGH


def on_spiral(goal: Goal, tip: Tip, spiral: Spiral, q: FloatArray) -> tuple[Goal, bool]:
    """Where to go next on the way down to a goal.

    Args:
        goal: Where the spiral ends.
        tip: Where the tool is.
        spiral: How it comes down.
        q: Joint angles, (7,) rad.

    Returns:
        A place around the target, or `goal` itself where it is near and where the arm reaches no
        place that leans; and whether the tip is on the spiral already.
    """
    left_m = float(np.linalg.norm(tip.position - goal.target)) - goal.standoff_m
    share = min((left_m - spiral.ahead_m) / spiral.range_m, 1.0)
    if share <= 0.0:
        return goal, True
    x, y = axes_across(goal.normal)
    if spiral.turn_rad is None:
        turned = 2.0 * math.pi * share
    else:
        turned = math.atan2(-tip.axis @ y, -tip.axis @ x) + spiral.turn_rad
    side = math.cos(turned) * x + math.sin(turned) * y
    follows = spiral.turn_rad is not None and share < 1.0
    for most in spiral.leans_rad:
        lean = most * min(share / spiral.upright_share, 1.0)
        around = dataclasses.replace(
            goal,
            normal=math.cos(lean) * goal.normal + math.sin(lean) * side,
            standoff_m=goal.standoff_m + share * spiral.range_m,
        )
        if are_near(q, around, goal) if follows else is_reachable(around):
            return around, share < 1.0
    return goal, share < 1.0


def axes_across(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The base frame's x and y axes, laid into the plane across a normal (3,)."""
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    return x, np.cross(normal, x)
