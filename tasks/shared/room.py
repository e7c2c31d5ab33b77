"""Room for obstacles: they are put where a known way of the arm stays free.

The stated rule by which scenes with obstacles can be solved: three straight joint motions, from the
start to the upright arm, from there to a posture above the goal and down to it, keep a margin from
everything. The posture is drawn among all that reach the goal, so the free way is seldom the
shortest, and it is part of the scenario.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_SPEED_RAD_S
from hvs_suite.cell.solid import Solid, arm_balls
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.goal import Goal

FloatArray = npt.NDArray[np.float64]

MARGIN_M = 0.04
"""What the free way keeps from obstacles (m)."""
LEAST_CLEARANCE_M = 0.02
"""What it keeps from the surface and between links (m)."""
APPROACH_M = 0.15
"""How far above the goal the way comes in (m)."""
SIGHT_RADIUS_M = 0.05
SIGHT_HEIGHT_M = 0.25
"""The air above the target that stays free, so that the eye in the hand looks down on it (m)."""
_BASE_RADIUS_M = 0.25
_BASE_HEIGHT_M = 0.60
_GAP_M = 0.02
_STEP_RAD = 0.06
_NOTHING_RAD = 1e-12
_N_SWIVEL = 36
_SAMPLES = 8


def straight(here: FloatArray, there: FloatArray) -> FloatArray:
    """Postures (n, 7) of a straight joint motion, both ends included, at most 0.06 rad apart."""
    count = 2 + int(np.abs(there - here).max() / _STEP_RAD)
    return np.asarray(np.linspace(here, there, count), np.float64)


def draw_way(random: np.random.Generator, start: FloatArray, goal: Goal) -> FloatArray:
    """Draw the way that stays free: upright, then above the goal, then at the goal.

    Args:
        random: Draws the posture.
        start: Where the arm stands at reset, (7,) rad.
        goal: Where the tip has to be.

    Returns:
        (3, 7) rad.

    Raises:
        OptionError: No posture can be reached in a straight motion.
    """
    upright = np.append(np.zeros(6), start[6])
    family = kinematics().goal_configurations_at_tool_angle(
        goal.position, goal.normal, float(start[6]), _N_SWIVEL
    )
    above = goal.position + APPROACH_M * goal.normal
    for row in random.permutation(len(family)):
        raised = kinematics().nearest_configuration(
            family[row], above, goal.normal, JOINT_SPEED_RAD_S
        )
        if raised is None:
            continue
        # The last joint turns the flange about its own axis, which need not be.
        raised[6] = start[6]
        way = [*np.linspace(upright, raised, _SAMPLES)[1:], family[row]]
        if all(kinematics().clearance(q, goal.target[2]) >= LEAST_CLEARANCE_M for q in way):
            found = np.stack([upright, raised, family[row]])
            # What rounding leaves of a zero has the sign that the processor gives it.
            found[np.abs(found) < _NOTHING_RAD] = 0.0
            return found
    raise OptionError(
        f"no free way found to the goal at {goal.position.round(3).tolist()}; use other radii "
        "in ring_m"
    )


class Room:
    """Says where an obstacle may stand, and remembers those that do.

    Args:
        start: Where the arm stands at reset, (7,) rad.
        way: As `draw_way` gives it.
        target: What has to be seen, (3,) m.
    """

    def __init__(self, start: FloatArray, way: FloatArray, target: FloatArray) -> None:
        balls = arm_balls()
        stations = [start, *way]
        postures = np.concatenate([straight(*leg) for leg in itertools.pairwise(stations)])
        arm = balls.at(postures).reshape(-1, 3)
        sight = target + np.outer(np.linspace(0.0, SIGHT_HEIGHT_M, 10), [0.0, 0.0, 1.0])
        base = np.outer(np.linspace(0.0, _BASE_HEIGHT_M, 10), [0.0, 0.0, 1.0])
        self._points = np.concatenate([arm, sight, base])
        self._reach = np.concatenate(
            [
                np.tile(balls.radius + MARGIN_M, len(postures)),
                np.full(len(sight), SIGHT_RADIUS_M),
                np.full(len(base), _BASE_RADIUS_M),
            ]
        )
        self._footprints: list[FloatArray] = []

    def fits(self, solids: Sequence[Solid]) -> bool:
        """Whether an obstacle made of some solids may stand where they are."""
        own = np.concatenate([_footprint(solid) for solid in solids])
        for other in self._footprints:
            apart = np.linalg.norm(own[:, None, :2] - other[None, :, :2], axis=2)
            if (apart < own[:, None, 2] + other[None, :, 2] + _GAP_M).any():
                return False
        return all((solid.distance(self._points) > self._reach).all() for solid in solids)

    def add(self, solids: Sequence[Solid]) -> None:
        """Let it stand there."""
        self._footprints.append(np.concatenate([_footprint(solid) for solid in solids]))


def _footprint(solid: Solid) -> FloatArray:
    """Circles (n, 3) that hold a solid seen from above: x, y, radius (m)."""
    (a, b, _), (x, y, _) = solid.half, solid.centre
    if solid.kind == "cylinder":
        return np.array([[x, y, a]])
    narrow, wide = min(a, b), max(a, b)
    count = math.ceil(wide / narrow)
    along = np.linspace(-1.0, 1.0, 2 * count + 1)[1::2] * wide
    turn = solid.yaw + (0.0 if a >= b else 0.5 * math.pi)
    radius = math.hypot(narrow, wide / count)
    return np.stack(
        [x + along * math.cos(turn), y + along * math.sin(turn), np.full(count, radius)], axis=1
    )
