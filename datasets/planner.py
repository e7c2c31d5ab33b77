"""The planner: the fastest way to a goal from wherever the arm is, every control step.

It keeps no memory of its own plan, so its answer in a state does not depend on how the arm got
there, as DAgger needs. The expert plans with the true state, the classical baseline with its
estimate.

A decision is:

1. Rank the goal's whole redundant family (elbow swivel, mirror shapes, free yaw) by the least
   travel time from the present position and velocity under speed and acceleration limits.
2. Take the first whose time-optimal motion (ruckig) keeps clear of surface and self.
3. Where all are blocked by obstacles, head for a via point (see `hvs_suite.datasets.roadmap`).
4. Answer with the point of that motion at the end of the control step, and a little further: the
   arm trails its set point.

A goal that moves is met where it will be, and then followed (see `Planner.follow`).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt
import ruckig

from hvs_suite.cell import robot
from hvs_suite.cell.kinematics import Kinematics, away_from_stops, circle, kinematics
from hvs_suite.cell.plain_postures import CHOSEN_ABOVE_M, ELBOWS_RAD, soonest_first
from hvs_suite.cell.solid import Solid, obstacle_distance
from hvs_suite.datasets.roadmap import Roadmap, is_straight_clear
from hvs_suite.embodiment import BARE_ARM, Embodiment
from hvs_suite.tasks.shared.goal import Goal

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

CLEARANCE_M = 0.010
"""Distance that a motion keeps from the surface and between links (m)."""
OBSTACLE_CLEARANCE_M = 0.020
"""Distance that a motion keeps from obstacles (m)."""
ESCAPE_HEIGHT_M = 0.15
"""Where no way to the goal is clear, go above it first (m)."""
N_SWIVEL = 360
"""Elbow places in the ranked family; one degree apart costs under 10 ms of travel time."""
PROJECTION_RANGE_M = 0.15
"""Below this distance the nearest configuration of the goal is also computed exactly (m)."""
TIE_BREAK_S = 0.01
"""Price of unneeded motion: small against a control step, enough to make the choice unique."""

LEAD_S = 0.025
"""How far the set point runs ahead of the motion (s): a little less than the joints' lag, tuned for
the fewest steps. More overshoots the goal, less arrives late. A compliant arm has a longer lag."""

_CROWDED_SHARE = 0.5
_ROOM_S = 1.5
"""Where more goals follow, what a joint at its stop costs (s), against the way back from there; a
joint within `_CROWDED_SHARE` of its range costs nothing, between the price goes with the square."""

_FULL_SPEED: FloatArray = robot.JOINT_SPEED_RAD_S[:6, None]
_MAX_PATHS = 24
_MAX_PATHS_AMONG_OBSTACLES = 4
"""Straight ways that are tried before the roadmap is asked."""
_MAX_VIAS = 40
_KEPT_ROADMAPS = 4
"""Of an episode: over the goal and at it, before and after an obstacle moves."""
_MAX_ESCAPES = 4
_MAX_FLANGE_SPEED_M_S = 2.5
_PATH_STEP_S = 0.02
_DISTINCT_RAD = 0.2
# Ruckig fails on some targets that braking reaches exactly; a target beside them works.
_NUDGES_RAD = (0.0, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3)
_LEVEL = 1.0 - 1e-12
_MEETINGS = 3
"""How often the time is refined at which a moving goal is met: each round halves the error or
better, because targets move far slower than the arm."""
FORESIGHT_S = 7.0
"""For how long a posture that meets a moving goal should be able to stay with it (s)."""
_FORESIGHT_STEP_S = 0.5
_FORESIGHT_SWIVELS = 60
_FREE_RANGE_RAD = robot.JOINT_RANGE_RAD[:6] - math.radians(8.0)
"""A posture in which a joint goes beyond this is not one to follow in."""
_SPEED_SHARE = 0.7
"""Nor is one that takes more than this share of a joint's speed."""
_N_ONWARD_SWIVEL = 36
_ONWARD_SLACK_S = 0.2
"""A posture whose way on takes this much longer than the shortest way on is not chosen."""


def stopping_travel_time(
    q: FloatArray, velocity: FloatArray, goals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Least time to come to rest at each goal from a moving start, joint by joint.

    Per joint with x = distance along the direction s of the motion, u = s v the speed along it
    (negative where the joint must first turn back), a and w its acceleration and speed limits:
    peak speed p = sqrt(a x + u^2 / 2); t = (2 p - u) / a where p <= w, otherwise
    t = (w - u) / a + w / a + (x - (2 w^2 - u^2) / (2 a)) / w. s is the sign of the way that is
    left after braking as hard as possible.

    Args:
        q: Angles (n,) of the first n joints in rad.
        velocity: Their velocities (n,) in rad/s.
        goals: Goal configurations (m, n) in rad.

    Returns:
        Time of the slowest joint (m,) in s, and the sum over joints of (distance / speed)^2 (m,)
        in s^2.
    """
    return _stopping_travel_time(q, velocity, np.ascontiguousarray(goals.T))


def _stopping_travel_time(
    q: FloatArray,
    velocity: FloatArray,
    goals: FloatArray,
    acceleration: FloatArray = robot.JOINT_ACCELERATION_RAD_S2,
) -> tuple[FloatArray, FloatArray]:
    """``stopping_travel_time`` for goals (n, m), joint by joint along the first axis."""
    a = acceleration[: len(q), None]
    w = robot.JOINT_SPEED_RAD_S[: len(q), None]
    way = goals - q[:, None]
    v = np.minimum(np.maximum(velocity[:, None], -w), w)
    side = np.where(way >= v * np.abs(v) / (2.0 * a), 1.0, -1.0)
    x, u = side * way, side * v
    peak = np.sqrt(np.maximum(a * x + 0.5 * v**2, 0.0))
    bang_bang = (2.0 * peak - u) / a
    cruising = (2.0 * w - u) / a + (x - (2.0 * w**2 - v**2) / (2.0 * a)) / w
    times = np.where(peak <= w, bang_bang, cruising)
    return times.max(axis=0), ((way / w) ** 2).sum(axis=0)


class Planner:
    """Plans for one arm; every answer depends on its arguments alone.

    Args:
        period_s: Control period (s).
        plain: Go to the goal in one of few postures, by a rule that a policy can learn
            (`hvs_suite.cell.plain_postures`). From random starts this costs half a step to two a
            target (docs/experiments/elbow-aside.md).
        embodiment: The robot, whose tip is what goals are for.
        clearance_m: What a motion keeps from surface, self and obstacles (m) where it can; where it
            cannot, `CLEARANCE_M`.
    """

    def __init__(
        self,
        period_s: float,
        *,
        plain: bool = False,
        embodiment: Embodiment = BARE_ARM,
        clearance_m: float = CLEARANCE_M,
    ) -> None:
        self._kinematics: Kinematics = kinematics(embodiment)
        self._period_s = period_s
        self._lead_s = LEAD_S * embodiment.slowness
        self._plain = plain
        self._wanted_m = clearance_m
        self._swivels = np.array(ELBOWS_RAD) if plain else circle(N_SWIVEL)
        self._goal_key: bytes = b""
        self._family: FloatArray = np.empty((7, 1))
        """The goal's configurations, one a column; the last is kept free."""
        self._chosen_by: FloatArray = np.empty((0, 7))
        """For plain postures: where the arm would have to come soonest, one a row."""
        self._more_follow = False
        self._floor_m = 0.0
        self._clearance_m = 0.0
        """Of the present state."""
        self._solids: tuple[Solid, ...] = ()
        self._roadmaps: dict[tuple[tuple[Solid, ...], bytes], Roadmap] = {}
        self._soonest_s = math.inf
        """What the soonest way to the goal took a control step ago (s)."""
        self._ruckig = ruckig.Ruckig(7)
        self._input = ruckig.InputParameter(7)
        self._input.max_velocity = list(robot.JOINT_SPEED_RAD_S)
        # A set point that jerks makes a compliant arm swing.
        self._acceleration = robot.JOINT_ACCELERATION_RAD_S2 / embodiment.slowness
        self._input.max_acceleration = list(self._acceleration)
        # No jerk limit: within a control step the cell's set point moves at constant speed, so a
        # ramp that is shorter than the step cannot be executed, and a longer one costs time.

    def avoid(self, solids: tuple[Solid, ...]) -> None:
        """Keep out of solids from now on, beside the surface; none at first."""
        self._solids = solids

    def next_set_point(
        self, q: FloatArray, velocity: FloatArray, goal: Goal, *, onward: Goal | None = None
    ) -> FloatArray:
        """Where the set point shall be at the end of the control step, to come to rest at a goal.

        Args:
            q: Joint angles now, (7,) rad.
            velocity: Joint velocities now, (7,) rad/s.
            goal: Where the flange has to be.
            onward: Where it goes next, if the goal is only on the way: postures from which that
                takes long are left out, unless they are plain.

        Returns:
            (7,) rad; `q` where the goal is out of reach.
        """
        self._look_around(q, goal)
        self._remember_goal(goal)
        self._more_follow = goal.more_follow
        family = self._reachable(q, velocity, goal)
        if onward is not None and not self._plain:
            family = self._with_short_way_on(family, onward)
        if len(family) == 0:
            return q
        most = _MAX_PATHS_AMONG_OBSTACLES if self._solids else _MAX_PATHS
        clearances = {min(m, self._clearance_m - 1e-3) for m in (self._wanted_m, CLEARANCE_M)}
        for required in sorted(clearances, reverse=True):
            candidates = self._in_order(q, velocity, family)
            motion = self._first_clear(q, velocity, candidates, required, most)
            if motion is not None:
                break
        if motion is None and self._solids:
            vias = self._vias(q, velocity, goal)
            motion = self._first_clear(q, velocity, vias, required, _MAX_VIAS)
        if motion is None:
            motion = self._escape(q, velocity, goal, required)
        return self._point_ahead(motion)

    def towards_posture(
        self, q: FloatArray, velocity: FloatArray, posture: FloatArray
    ) -> FloatArray | None:
        """Where the set point shall be at the end of the control step on the way to a posture.

        Args:
            q: Joint angles now, (7,) rad.
            velocity: Joint velocities now, (7,) rad/s.
            posture: Where to rest, each joint as fast as it can, (7,) rad.

        Returns:
            (7,) rad, or None where the way there is not clear.
        """
        self._floor_m = 0.0
        self._clearance_m = self._clearance(q)
        motion = self._motion(q, velocity, posture, together=False)
        if self._least_clearance(motion, CLEARANCE_M) < CLEARANCE_M:
            return None
        return self._point_ahead(motion)

    def is_free_by(self, start: FloatArray, over: Goal, goal: Goal) -> bool:
        """Whether the arm gets straight from a posture to above a goal, and down from there.

        Args:
            start: Where the arm is at rest, (7,) rad.
            over: Where it has to be above the goal.
            goal: Where it has to be in the end, with elbow and shape as above.
        """
        self._look_around(start, goal)
        above, there = (
            self._kinematics.goal_shapes(each.position, each.normal, self._swivels)
            for each in (over, goal)
        )
        if len(above) != len(there):
            return False
        usable = _within_ranges(above) & _within_ranges(there)
        above[:, 6] = there[:, 6] = start[6]
        return any(
            is_straight_clear(self._clearance, start, on_way, self._wanted_m)
            and is_straight_clear(self._clearance, on_way, end, self._wanted_m)
            for on_way, end in zip(above[usable], there[usable], strict=True)
        )

    def follow(
        self,
        q: FloatArray,
        velocity: FloatArray,
        set_point: FloatArray,
        goal_in: Callable[[float], Goal],
        foresight_s: float = FORESIGHT_S,
    ) -> FloatArray:
        """Where the set point shall be at the end of the control step, to stay with a moving goal.

        Near the goal, a posture is taken at which the flange is where the goal will be at the end
        of the control step, and the set point that brings the arm there exactly
        (`robot.set_point_to_reach`): the posture nearest to the present one, pushed a little away
        from the joints' stops, which yaw and elbow are free for. Where that is too far for one
        step, the arm heads for the place where it can meet the goal soonest, in a posture in which
        it can stay with it.

        Args:
            q: Joint angles now, (7,) rad.
            velocity: Joint velocities now, (7,) rad/s.
            set_point: Now, (7,) rad.
            goal_in: The goal some time from now (s).
            foresight_s: How far ahead that is worth planning for (s).

        Returns:
            (7,) rad.
        """
        # What was left out for the last answer may be right for this one.
        self._goal_key = b""
        soon = goal_in(self._period_s)
        for start in (away_from_stops(q), q):
            posture = self._nearest_posture(start, soon)
            if posture is None:
                continue
            led = robot.set_point_to_reach(posture, q, set_point, self._period_s)
            within = np.abs(led - set_point) <= robot.JOINT_SPEED_RAD_S * self._period_s
            if within.all() and (np.abs(led) <= robot.JOINT_RANGE_RAD).all():
                return led
        ahead_s, lasting = 0.0, None
        for _ in range(_MEETINGS):
            meeting = goal_in(ahead_s)
            self._remember_goal(meeting, lasting)
            family = self._reachable(q, velocity, meeting)
            if len(family) == 0:
                break
            times, _ = stopping_travel_time(q[:6], velocity[:6], family[:, :6])
            ahead_s = float(times.min())
            if lasting is None:
                moments = np.arange(ahead_s, ahead_s + foresight_s, _FORESIGHT_STEP_S).tolist()
                lasting = self._lasting([goal_in(moment) for moment in moments])
        meeting = goal_in(ahead_s)
        self._remember_goal(meeting, lasting)
        return self.next_set_point(q, velocity, meeting)

    def _lasting(self, path: Sequence[Goal]) -> BoolArray:
        """Which rows of `Kinematics.goal_shapes` can be kept along a path: (m,).

        Carried along with elbow and shape as they are, they keep away from the joints' stops and
        well below their speeds. A7 is left out, because yaw is free. Where the path leaves the
        reach it ends.
        """
        swivels = self._swivels if self._plain else circle(_FORESIGHT_SWIVELS)
        lasts: BoolArray = np.ones(8 * len(swivels), bool)
        fastest = _SPEED_SHARE * _FORESIGHT_STEP_S * robot.JOINT_SPEED_RAD_S[:6]
        before: FloatArray | None = None
        for goal in path:
            shapes = self._kinematics.goal_shapes(goal.position, goal.normal, swivels)[:, :6]
            if len(shapes) == 0:
                break
            lasts &= (np.abs(shapes) <= _FREE_RANGE_RAD).all(axis=1)
            if before is not None:
                lasts &= (np.abs(shapes - before) <= fastest).all(axis=1)
            before = shapes
        # What holds for an elbow place holds for those within a few degrees of it.
        return lasts.repeat(len(self._swivels) // len(swivels))

    def _look_around(self, q: FloatArray, goal: Goal) -> None:
        """Take in how far the arm is from what it must not touch."""
        # Distances are to a level plane. Where the surface is not level at the target, that is the
        # target's height, which is right near the goal and a guess far from it; unless all that
        # stands on the table is known.
        height = 0.0 if self._solids else float(goal.target[2])
        is_level = goal.normal[2] > _LEVEL or bool(self._solids)
        self._floor_m = height if is_level else height - CLEARANCE_M
        self._clearance_m = self._clearance(q)

    def _clearance(self, q: FloatArray) -> float:
        """Distance (m) of the arm from the surface, itself and obstacles, these a little nearer."""
        clearance = self._kinematics.clearance(q, self._floor_m)
        if not self._solids:
            return clearance
        # So that one bound holds for all.
        nearer = OBSTACLE_CLEARANCE_M - CLEARANCE_M
        return min(clearance, obstacle_distance(self._solids)(q) - nearer)

    def _vias(self, q: FloatArray, velocity: FloatArray, goal: Goal) -> Iterator[FloatArray]:
        """Postures (7,) to head for where the goal's own cannot be reached straight."""
        key = self._solids, goal.position.tobytes() + goal.normal.tobytes()
        if key not in self._roadmaps:
            while len(self._roadmaps) >= _KEPT_ROADMAPS:
                del self._roadmaps[next(iter(self._roadmaps))]
            self._roadmaps[key] = Roadmap(self._clearance, goal)
        roadmap = self._roadmaps[key]
        nodes = roadmap.nodes[:, :6].T
        times, effort = _stopping_travel_time(q[:6], velocity[:6], nodes, self._acceleration)
        rest = self._where_braking_ends(q, velocity)[6]
        last = min(max(rest, -robot.JOINT_RANGE_RAD[6]), robot.JOINT_RANGE_RAD[6])
        for node in roadmap.candidates(times + TIE_BREAK_S * effort):
            yield np.append(node[:6], last)

    def _remember_goal(self, goal: Goal, among: BoolArray | None = None) -> None:
        """Computes the goal's family of configurations once a goal.

        Args:
            goal: Where the flange has to be.
            among: Rows of `Kinematics.goal_shapes` (m,) to choose among where one is in range.
        """
        key = goal.position.tobytes() + goal.normal.tobytes()
        if key == self._goal_key and among is None:
            return
        self._goal_key = key
        self._soonest_s = math.inf
        shapes = self._kinematics.goal_shapes(goal.position, goal.normal, self._swivels)
        usable, chosen_by = _within_ranges(shapes), shapes
        if self._plain:
            over = goal.target + CHOSEN_ABOVE_M * goal.normal
            above = self._kinematics.goal_shapes(over, goal.normal, self._swivels)
            if len(above) == len(shapes) and (usable & _within_ranges(above)).any():
                usable, chosen_by = usable & _within_ranges(above), above
        if among is not None and len(shapes) and (usable & among).any():
            usable = usable & among
        self._chosen_by = chosen_by[usable]
        family = shapes[usable]
        self._family = np.empty((7, len(family) + 1))
        self._family[:, :-1] = family.T

    def _with_short_way_on(self, family: FloatArray, onward: Goal) -> FloatArray:
        """The configurations (m, 7) of a family from which the next goal is soon reached."""
        if len(family) == 0:
            return family
        there = self._kinematics.goal_configurations_at_tool_angle(
            onward.position, onward.normal, family[0, 6], n_swivel=_N_ONWARD_SWIVEL
        )
        if len(there) == 0:
            return family
        seconds = np.zeros((len(family), len(there)), np.float32)
        for here, after, speed in zip(family.T, there.T, robot.JOINT_SPEED_RAD_S, strict=True):
            way = np.subtract.outer(here.astype(np.float32), after.astype(np.float32))
            np.maximum(seconds, np.abs(way) / np.float32(speed), out=seconds)
        soonest = seconds.min(axis=1)
        return np.asarray(family[soonest <= soonest.min() + _ONWARD_SLACK_S])

    def _in_order(
        self, q: FloatArray, velocity: FloatArray, family: FloatArray
    ) -> Iterator[FloatArray]:
        """Goal configurations (7,) of a family (m, 7), the one reached soonest first.

        The first is nearly always clear, so it is found without timing all: none is reached sooner
        than at full speed, and as a rule the soonest is no farther away than it was a control step
        ago. Where that fails all are timed, so the answer does not depend on the last one.
        """
        if self._plain:
            yield from family[soonest_first(q, self._chosen_by)]
            return
        # Joint by joint along the first axis: NumPy is slow over rows of seven.
        joints = family[:, :6].T

        def price(goals: FloatArray) -> FloatArray:
            times, effort = _stopping_travel_time(q[:6], velocity[:6], goals, self._acceleration)
            return times + TIE_BREAK_S * effort + (_crowding(goals) if self._more_follow else 0.0)

        bound = (np.abs(joints - q[:6, None]) / _FULL_SPEED).max(axis=0)
        [listed] = np.nonzero(bound <= self._soonest_s)
        prices = price(joints.take(listed, axis=1))
        if len(listed) == 0 or prices.min() > self._soonest_s:
            listed, prices = np.arange(len(family)), price(joints)
        least = int(prices.argmin())
        # A little slack, because bounds and prices are rounded.
        self._soonest_s, first = float(prices[least]) + 1e-9, int(listed[least])
        yield family[first]
        for column in np.argsort(price(joints), kind="stable").tolist():
            if column != first:
                yield family[column]

    def _point_ahead(self, motion: ruckig.Trajectory) -> FloatArray:
        """Where a motion is at the end of the control step (7,); the arm trails its set point."""
        ahead = min(self._period_s + self._lead_s, motion.duration)
        return np.asarray(motion.at_time(ahead)[0])

    def _first_clear(
        self,
        q: FloatArray,
        velocity: FloatArray,
        candidates: Iterable[FloatArray],
        required: float,
        most: int,
    ) -> ruckig.Trajectory | None:
        """The motion to the first candidate that keeps clear; skips what is near a blocked one."""
        blocked: list[FloatArray] = []
        for goal in candidates:
            if any(np.abs(goal - other).max() < _DISTINCT_RAD for other in blocked):
                continue
            motion = self._motion(q, velocity, goal)
            enough = required
            if required > CLEARANCE_M:
                # At the goal itself there may be less room.
                enough = max(min(required, self._clearance(goal) - 1e-3), CLEARANCE_M)
            if self._least_clearance(motion, enough) >= enough:
                return motion
            blocked.append(goal)
            if len(blocked) >= most:
                break
        return None

    def _escape(
        self,
        q: FloatArray,
        velocity: FloatArray,
        goal: Goal,
        required: float,
    ) -> ruckig.Trajectory:
        """A motion away from obstacles where all ways to the goal are blocked or too fast.

        To a place above the goal, towards the upright posture, or braking, whichever keeps clear
        first or else clearest; each joint as fast as it can.
        """
        above = self._kinematics.goal_configurations_at_tool_angle(
            goal.position + ESCAPE_HEIGHT_M * goal.normal,
            goal.normal,
            tool_angle=q[6],
            n_swivel=24,
        )
        rest = self._where_braking_ends(q, velocity)
        rest = np.clip(rest, -robot.JOINT_RANGE_RAD, robot.JOINT_RANGE_RAD)
        upright = np.append(np.zeros(6), rest[6])
        nearest = above[np.argsort(np.abs(above - rest).max(axis=1))[:_MAX_ESCAPES]]
        best, clearest = -np.inf, self._motion(q, velocity, rest, together=False)
        for target in (*nearest, upright, 0.5 * (rest + upright), rest):
            motion = self._motion(q, velocity, target, together=False)
            least = self._least_clearance(motion, -np.inf)
            if least >= required:
                return motion
            if least > best:
                best, clearest = least, motion
        return clearest

    def _reachable(self, q: FloatArray, velocity: FloatArray, goal: Goal) -> FloatArray:
        """Goal configurations (m, 7), in no order; good until it is asked again.

        A7 alone turns the free yaw, so it is left where it comes to rest.
        """
        rest = self._where_braking_ends(q, velocity)
        # Beside plain postures, the nearest would be another goal for every place from which the
        # arm comes.
        nearest = None if self._plain else self._nearest_posture(rest, goal)
        family = self._family
        if nearest is None:
            family = family[:, :-1]
        else:
            family[:, -1] = nearest
        family[6] = min(max(rest[6], -robot.JOINT_RANGE_RAD[6]), robot.JOINT_RANGE_RAD[6])
        return family.T

    def _nearest_posture(self, q: FloatArray, goal: Goal) -> FloatArray | None:
        """The configuration (7,) of a goal that is nearest to joint angles (7,), by travel time.

        Distances are weighed by the accelerations, as travel times over short ways are. None far
        from the goal, where the family's one-degree grid is as good.
        """
        _, tip = self._kinematics.tip_pose(q)
        if math.hypot(*(goal.position - tip).tolist()) > PROJECTION_RANGE_M:
            return None
        return self._kinematics.nearest_configuration(
            q, goal.position, goal.normal, robot.JOINT_ACCELERATION_RAD_S2
        )

    def _where_braking_ends(self, q: FloatArray, velocity: FloatArray) -> FloatArray:
        """Where each joint comes to rest (7,) if it brakes as hard as it can."""
        return q + velocity * np.abs(velocity) / (2.0 * self._acceleration)

    def _motion(
        self, q: FloatArray, velocity: FloatArray, goal: FloatArray, *, together: bool = True
    ) -> ruckig.Trajectory:
        """The time-optimal motion to rest at a goal, the joints arriving together or each alone."""
        # Ruckig's root finding stumbles over distances at the limit of double precision.
        ends = goal.tolist()
        self._input.current_position = [
            end if abs(angle - end) < 1e-9 else angle
            for angle, end in zip(q.tolist(), ends, strict=True)
        ]
        self._input.current_velocity = [
            0.0 if abs(speed) < 1e-9 else min(max(speed, -limit), limit)
            for speed, limit in zip(velocity.tolist(), self._input.max_velocity, strict=True)
        ]
        self._input.synchronization = (
            ruckig.Synchronization.Time if together else ruckig.Synchronization.No
        )
        trajectory = ruckig.Trajectory(7)
        for nudge in _NUDGES_RAD:
            self._input.target_position = [end + nudge for end in ends]
            try:
                self._ruckig.calculate(self._input, trajectory)
            except ruckig.RuckigError:
                continue
            return trajectory
        raise RuntimeError(f"ruckig finds no motion from {q} at {velocity} to {goal}")

    def _least_clearance(self, motion: ruckig.Trajectory, required: float) -> float:
        """Least clearance (m) along a motion from the present state.

        Stops looking once it falls below ``required``.
        Steps as far as the arm can get within the distance found (conservative advancement).
        """
        least = clearance = self._clearance_m
        t = 0.0
        while least >= required and t < motion.duration:
            t += max(_PATH_STEP_S, (clearance - CLEARANCE_M) / _MAX_FLANGE_SPEED_M_S)
            q = motion.at_time(min(t, motion.duration))[0]
            clearance = self._clearance(q)
            least = min(least, clearance)
        return least


def _within_ranges(postures: FloatArray) -> BoolArray:
    """Which postures (m, 7) are within the joint ranges, A7 left out: (m,)."""
    return np.asarray((np.abs(postures[:, :6]) <= robot.JOINT_RANGE_RAD[:6]).all(axis=1))


def _crowding(postures: FloatArray) -> FloatArray:
    """What postures (6, m) without A7 cost for joints near their stops, (m,) s."""
    share = np.abs(postures) / robot.JOINT_RANGE_RAD[:6, None]
    crowded = np.clip((share - _CROWDED_SHARE) / (1.0 - _CROWDED_SHARE), 0.0, 1.0)
    return np.asarray(_ROOM_S * (crowded**2).sum(axis=0))
