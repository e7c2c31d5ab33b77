"""Coming down over a target so that the eye in the hand sees how its surface slopes.

Pictures from one place are all wrong about a slope in the same way, so their mean is no better than
one of them. Where slope and place have to be seen better than that, the demonstrator looks from
many places on its way down. Where it goes next depends on where it is, on the time that is left and
on what can be known there, and on nothing else, so a learner needs no memory of where it has looked
from.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from hvs_suite.tasks.shared.goal import Goal, Tip
from hvs_suite.tasks.shared.panels import PanelSpec
from hvs_suite.tasks.shared.placing import are_near, is_reachable

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spiral:
    """Comes down once around the target: the height says where.

    Attributes:
        range_m: How far above the goal it begins.
        leans_rad: How far it leans to the side: as far as the arm reaches, of these.
        ahead_m: How far below where the tool is the next place to go to lies (m): with too little
            it stops at each.
        upright_share: In this last part of the way down it straightens up.
    """

    range_m: float = 0.03
    leans_rad: tuple[float, ...] = (math.radians(20.0), math.radians(10.0))
    ahead_m: float = 0.003
    upright_share: float = 0.3

    def above(self, goal: Goal, height_m: float) -> Goal:
        """So far above a goal (m), and facing it."""
        return raised(goal, height_m)

    def next_place(self, goal: Goal, tip: Tip, q: FloatArray, steps_left: int) -> tuple[Goal, bool]:
        """Where to go next on the way down.

        Args:
            goal: Where it ends.
            tip: Where the tool is.
            q: Joint angles, (7,) rad.
            steps_left: Until it has to be at the goal.

        Returns:
            A place around the target, or `goal` itself where it is near and where the arm reaches
            no place that leans; and whether the way down has begun.
        """
        left_m = _left_m(goal, tip)
        share = min((left_m - self.ahead_m) / self.range_m, 1.0)
        if share <= 0.0:
            return goal, True
        for most in self.leans_rad:
            lean = most * min(share / self.upright_share, 1.0)
            around = _leaning(goal, lean, 2.0 * math.pi * share, share * self.range_m)
            if is_reachable(around):
                return around, share < 1.0
        return goal, share < 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Straightening:
    """Looks from the side, near by, for as long as there is time, and then straightens up.

    From the side a look says most of a slope, and the nearer the more. Two looks from one place say
    no more than one, because they err alike. So the last joint turns meanwhile, and with it the
    picture. The time alone says how far to lean and to turn: what imitates this and is late is told
    to hurry.

    Attributes:
        leans_rad: How far it leans: as far as the arm reaches, of these.
        begin_m: So near to the goal it has arrived.
        above_m: How far above the goal it leans.
        up_steps: For how many steps it straightens up.
        upright_steps: When so many steps are left it is upright.
        turn_rad: By how much the last joint turns in a step.
        most_turn_rad: By how much it turns at most, on its way to where it should be by now.
        middle_steps: When so many steps are left the last joint is in its middle.
    """

    leans_rad: tuple[float, ...] = tuple(math.radians(lean) for lean in (33.0, 30.0, 20.0, 10.0))
    begin_m: float = 0.015
    above_m: float = 0.006
    up_steps: int = 10
    upright_steps: int = 10
    turn_rad: float = 0.1
    most_turn_rad: float = 0.2
    middle_steps: int = 25

    def next_place(self, goal: Goal, tip: Tip, q: FloatArray, steps_left: int) -> tuple[Goal, bool]:
        """Where to go next on the way down; see `Spiral.next_place`.

        It leans away from the base, in the plane in which the pitch joints turn. A side that
        depended on where the arm came from would depend on how the surface slopes, which is not
        seen before. And leaning to the base the wrist is nearly straight, where a little of slope
        turns it by much.
        """
        left_m = _left_m(goal, tip)
        share = min(max((steps_left - self.upright_steps) / self.up_steps, 0.0), 1.0)
        above_m = self.above_m * min(2.0 * share, 1.0)
        has_come = left_m <= self.begin_m

        def is_on_the_way(place: Goal) -> bool:
            return are_near(q, place, goal) if has_come else is_reachable(place)

        places = self._leaning(goal, share, above_m) if share > 0.0 else ()
        return next(filter(is_on_the_way, places), goal), left_m < _BESIDE_M

    def turned(self, angle_rad: float, steps_left: int) -> float:
        """Where to send the last joint next.

        Args:
            angle_rad: Where it was sent to before.
            steps_left: As in `next_place`.

        Returns:
            rad.
        """
        by_now = self.turn_rad * (self.middle_steps - steps_left)
        most = self.most_turn_rad
        return angle_rad + min(max(by_now - angle_rad, -most), most)

    def above(self, goal: Goal, height_m: float) -> Goal:
        """So far above a goal (m), leaning as far as the arm reaches."""
        return next(
            filter(is_reachable, self._leaning(goal, 1.0, height_m)), raised(goal, height_m)
        )

    def _leaning(self, goal: Goal, share: float, above_m: float) -> Iterator[Goal]:
        """Places so far above a goal (m), leaning away from the base by a share, farthest first."""
        for lean in self.leans_rad:
            yield _leaning(goal, share * lean, _outward_rad(goal), above_m)


_BESIDE_M = 0.06
"""So near to the goal, short ways lead to all sides."""
_QUICK_RAD = math.radians(0.4)
"""A slope that need not be known better than this is seen well enough on the quick way down."""


def way_down(spec: PanelSpec) -> Spiral | Straightening:
    """How to come down to the goals of a task: leaning far where the slope has to be known well.

    Args:
        spec: A slope that is off by more than its tolerance over its standoff loses the goal.
    """
    needed_rad = 1e-3 * spec.tightest_tolerance_mm / spec.standoff_m
    return Spiral() if needed_rad >= _QUICK_RAD else Straightening()


def raised(goal: Goal, height_m: float) -> Goal:
    """So far above a goal (m), along its normal."""
    return dataclasses.replace(goal, standoff_m=goal.standoff_m + height_m)


def _outward_rad(goal: Goal) -> float:
    """To which side of a target the way from the base goes on (rad)."""
    return math.atan2(goal.target[1], goal.target[0])


def _left_m(goal: Goal, tip: Tip) -> float:
    return float(np.linalg.norm(tip.position - goal.target)) - goal.standoff_m


def _leaning(goal: Goal, lean_rad: float, side_rad: float, above_m: float) -> Goal:
    """A goal that faces the target from the side."""
    x, y = axes_across(goal.normal)
    side = math.cos(side_rad) * x + math.sin(side_rad) * y
    return dataclasses.replace(
        goal,
        normal=math.cos(lean_rad) * goal.normal + math.sin(lean_rad) * side,
        standoff_m=goal.standoff_m + above_m,
    )


def axes_across(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The base frame's x and y axes, laid into the plane across a normal (3,)."""
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    return x, np.cross(normal, x)
