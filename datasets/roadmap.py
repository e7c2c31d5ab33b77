"""A roadmap: via points among obstacles, for an arm whose straight way to the goal is blocked.

Some hundred postures, the same for every scene, and those at a goal are joined by straight joint
motions. What a scene's obstacles leave of them gives each posture a time to go to the goal. So the
next via point depends only on the scene, the goal and where the arm is, not on what happened
before. Asked again in every control step, the roadmap leads along one way, and it also leads a
learner back that has left it. (A probabilistic roadmap, Kavraki et al. 1996, with edges tried only
when a way uses them, Bohlin and Kavraki 2000; its samples are a Halton sequence, so they are no
more random than a grid.)

The last joint turns the flange about its own axis, which meets nothing: it is left out.
"""

import functools
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.stats import qmc

from hvs_suite.cell import robot
from hvs_suite.cell.kinematics import kinematics, travel_time
from hvs_suite.tasks.shared.goal import Goal

FloatArray = npt.NDArray[np.float64]
Clearance = Callable[[FloatArray], float]
"""Least distance (m) of the arm from everything at joint angles (7,) rad."""

CLEARANCE_M = 0.015
"""What postures and the ways between them keep (m): more than a motion has to, so that an arm that
left a way by a little is still clear."""
_N_VIA = 160
_VIA_CLEARANCE_M = 0.10
_VIA_RANGE = 0.75
"""Share of each joint's range that via points are taken from."""
_NEIGHBOURS = 12
_STEP_RAD = 0.06
_N_SWIVEL = 48
_N_GOALS = 32
_DISTINCT_RAD = 0.25
_RAISES_M = (0.12, 0.28)
"""Ways to a goal come from above it, so there are postures there, too."""


class Roadmap:
    """Ways to one goal among the obstacles of one scene.

    Args:
        clearance: Of the scene.
        goal: Where they lead.
    """

    def __init__(self, clearance: Clearance, goal: Goal) -> None:
        self._clearance = clearance
        vias = _via_points()
        goals = self._goal_postures(goal)
        above = [
            _with_zero(near)
            for rise in _RAISES_M
            for q in goals
            if (near := _raised(q, goal, rise)) is not None
        ]
        self.nodes = np.array([*vias, *above, *goals])
        """Postures (n, 7) rad, the last joint at zero."""
        self._n_goals = len(goals)
        self._seconds = _times_between(self.nodes)
        self._is_free: dict[int, bool] = {}
        self._update()

    def candidates(self, seconds: FloatArray) -> Iterator[FloatArray]:
        """Postures to head for, the one on the quickest way to the goal first.

        Args:
            seconds: Least time from where the arm is to each of ``nodes``, (n,) s.

        Yields:
            (7,) rad, the last joint at zero. Whether the way there is clear is for the caller to
            find out; from there on a clear way leads to the goal.
        """
        refused = np.zeros(len(self.nodes), bool)
        while True:
            total = np.where(refused, np.inf, seconds + self._to_go)
            first = int(total.argmin())
            if not np.isfinite(total[first]):
                return
            if not self._leads_to_goal(first):
                continue
            yield self.nodes[first]
            refused[first] = True

    def _goal_postures(self, goal: Goal) -> list[FloatArray]:
        """Postures at the goal that are clear, far from each other, the nearest to upright first.

        Not the first so many that are clear: each is to stand for a whole way of reaching.
        """
        family = kinematics().goal_configurations_at_tool_angle(
            goal.position, goal.normal, 0.0, _N_SWIVEL
        )
        if not len(family):
            return []
        times = travel_time(np.zeros(7), family, acceleration_limits=True)
        found: list[FloatArray] = []
        for q in family[np.argsort(times, kind="stable")]:
            if len(found) == _N_GOALS:
                break
            is_new = all(np.abs(q - other).max() >= _DISTINCT_RAD for other in found)
            if is_new and self._clearance(q) >= CLEARANCE_M:
                found.append(q)
        return found

    def _leads_to_goal(self, node: int) -> bool:
        """Whether the way on from a node is clear; where it is not, times to go are found anew."""
        while self._next[node] >= 0:
            after = int(self._next[node])
            if not self._is_clear(node, after):
                self._seconds[node, after] = self._seconds[after, node] = np.inf
                self._update()
                return False
            node = after
        return True

    def _is_clear(self, one: int, other: int) -> bool:
        """Whether the straight motion between two nodes is clear, and both are; tried once."""
        key = min(one, other) * len(self.nodes) + max(one, other)
        if key not in self._is_free:
            self._is_free[key] = is_straight_clear(
                self._clearance, self.nodes[one], self.nodes[other], CLEARANCE_M
            )
        return self._is_free[key]

    def _update(self) -> None:
        """Times to go to the goal from every node, and the next node on the way."""
        n = len(self.nodes)
        rows, columns = np.nonzero(np.isfinite(self._seconds))
        # All goals are one: a further node that each of them is at no cost.
        ends = np.arange(n - self._n_goals, n)
        rows = np.concatenate([rows, np.full(len(ends), n)])
        columns = np.concatenate([columns, ends])
        # Dijkstra leaves out what costs nothing at all.
        cost = np.concatenate([self._seconds[np.isfinite(self._seconds)], np.full(len(ends), 1e-9)])
        graph = csr_array((cost, (rows, columns)), shape=(n + 1, n + 1))
        to_go, before = dijkstra(graph, indices=n, return_predecessors=True)
        self._to_go: FloatArray = to_go[:n]
        self._next = np.where(before[:n] == n, -1, before[:n])
        self._next[~np.isfinite(self._to_go)] = -1


def is_straight_clear(
    clearance: Clearance, here: FloatArray, there: FloatArray, least_m: float
) -> bool:
    """Whether the straight joint motion from one posture to another keeps clear, both included.

    Args:
        clearance: Of the scene.
        here: Joint angles (7,) rad.
        there: Joint angles (7,) rad.
        least_m: What it has to keep (m).
    """
    count = 1 + int(np.abs(there - here).max() / _STEP_RAD)
    # Ends and middle first: what is blocked shows soon.
    shares = np.linspace(0.0, 1.0, count + 1)
    order = np.argsort([_bits(number) for number in range(count + 1)], kind="stable")
    return all(clearance(here + share * (there - here)) >= least_m for share in shares[order])


def _bits(number: int) -> int:
    """How often a number can be halved, negative: ends and middle come first in that order."""
    return -((number & -number).bit_length()) if number else -64


@functools.cache
def _via_points() -> FloatArray:
    """The upright arm and postures well above the surface, (n, 7) rad, the last joint at zero."""
    model = kinematics()
    found: list[FloatArray] = [np.zeros(7)]
    bound = _VIA_RANGE * robot.JOINT_RANGE_RAD[:6]
    sequence = qmc.Halton(6, scramble=False)
    sequence.fast_forward(1)
    while len(found) < _N_VIA:
        for sample in sequence.random(64):
            q = np.append((2.0 * sample - 1.0) * bound, 0.0)
            if model.clearance(q) >= _VIA_CLEARANCE_M and len(found) < _N_VIA:
                found.append(q)
    return np.array(found)


def _times_between(nodes: FloatArray) -> FloatArray:
    """Travel times (n, n) s from each node to its nearest and to the upright arm, else infinite."""
    times = np.stack([travel_time(q, nodes, acceleration_limits=True) for q in nodes])
    np.fill_diagonal(times, np.inf)
    near = times <= np.sort(times, axis=1)[:, [min(_NEIGHBOURS, len(nodes) - 1)]]
    near[0] = near[:, 0] = True
    near |= near.T
    return np.where(near, times, np.inf)


def _raised(q: FloatArray, goal: Goal, rise_m: float) -> FloatArray | None:
    """The posture above a goal that is nearest to one at the goal."""
    above = goal.position + rise_m * goal.normal
    return kinematics().nearest_configuration(q, above, goal.normal, robot.JOINT_SPEED_RAD_S)


def _with_zero(q: FloatArray) -> FloatArray:
    return np.append(q[:6], 0.0)
