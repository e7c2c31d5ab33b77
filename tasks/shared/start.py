"""Starts: where the arm stands at reset, and how soon the goal can be reached from there."""

import math

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import Kinematics, kinematics, travel_time
from hvs_suite.cell.robot import JOINT_NAMES, JOINT_RANGE_RAD
from hvs_suite.cell.solid import Solid, obstacle_distance
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.goal import UP, Goal
from hvs_suite.tasks.shared.scenario import Streams
from hvs_suite.tasks.shared.spec import Spec, Start

FloatArray = npt.NDArray[np.float64]

RANDOM_START_RANGE = 0.8
START_CLEARANCE_M = 0.05
START_GOAL_DISTANCE_M = 0.10
SPARE_STEPS = 5
# A start near the goal: joint deviations between a tenth of a degree and 14 degrees, log-uniform,
# so that the last millimetres are met as often as the last decimetres.
_NEAR_GOAL_SCALE_RAD = (0.002, 0.25)
_NEAR_GOAL_CLEARANCE_M = 0.015
_NEAR_GOAL_SLACK_M = 0.002
MAX_REDRAWS = 1000


def draw_start(
    spec: Spec,
    own: Start,
    streams: Streams,
    goal: Goal,
    floor_normal: FloatArray = UP,
    solids: tuple[Solid, ...] = (),
) -> FloatArray:
    """Draw where the arm stands at reset.

    Args:
        spec: Parameters of the task.
        own: The start of the named task, which ``mixed`` mixes with starts near the goal.
        streams: Of the scenario.
        goal: The first one.
        floor_normal: Normal of the plane through the origin that the scene lies in or below.
        solids: What else stands there, below the plane that touches the surface at the goal.

    Returns:
        True joint angles, (7,) rad.

    Raises:
        OptionError: None can be drawn.
    """
    start = spec.start
    if start == "mixed":
        near = streams.generator("mixed").random() < 0.5
        start = "near_goal" if near else own
    if start == "zero":
        return np.zeros(len(JOINT_NAMES))
    if start == "random":
        return _random_start(spec, streams, goal, floor_normal, solids)
    if start == "fixed":
        return _fixed_start(kinematics(spec.embodiment), streams, floor_normal)
    if start == "near_goal":
        return _near_goal_start(kinematics(spec.embodiment), streams, goal)
    return np.array(start, dtype=np.float64)


def _fixed_start(model: Kinematics, streams: Streams, floor_normal: FloatArray) -> FloatArray:
    # Kept for all goals, so it cannot depend on one: clear of surface and self is all it is.
    random = streams.once("start-fixed")
    bound = RANDOM_START_RANGE * JOINT_RANGE_RAD
    for _ in range(MAX_REDRAWS):
        q = random.uniform(-bound, bound)
        if model.clearance(q, 0.0, floor_normal) >= START_CLEARANCE_M:
            return q
    raise OptionError("no fixed start found that is clear of surface and self")


def _random_start(
    spec: Spec,
    streams: Streams,
    goal: Goal,
    floor_normal: FloatArray,
    solids: tuple[Solid, ...],
) -> FloatArray:
    model = kinematics(spec.embodiment)
    random = streams.generator("start")
    bound = RANDOM_START_RANGE * JOINT_RANGE_RAD
    steps = spec.time_limit_steps - SPARE_STEPS
    for _ in range(MAX_REDRAWS):
        q = random.uniform(-bound, bound)
        if np.linalg.norm(model.tip_pose(q)[1] - goal.position) < START_GOAL_DISTANCE_M:
            continue
        if model.clearance(q, 0.0, floor_normal) < START_CLEARANCE_M:
            continue
        if solids and obstacle_distance(solids)(q) < START_CLEARANCE_M:
            continue
        if steps_lower_bound(spec, q, goal) <= steps:
            return q
    raise OptionError(
        f"no random start found for scenario {streams.index}: the goal at radius "
        f"{math.hypot(*goal.position[:2]):.2f} m cannot be reached in {steps} steps"
    )


def _near_goal_start(model: Kinematics, streams: Streams, goal: Goal) -> FloatArray:
    reachable = model.goal_configurations_at_tool_angle(goal.position, goal.normal, 0.0)
    if not len(reachable):
        raise OptionError(
            f"scenario {streams.index}: the goal {goal.position.round(3).tolist()} is out of reach"
        )
    random = streams.generator("near_goal")
    # Any posture that faces the target, quick ones from the task's own start more often.
    times = travel_time(np.zeros(len(JOINT_NAMES)), reachable, acceleration_limits=True)
    best = reachable[np.argsort(times)[: max(1, len(reachable) // 8)]]
    # No surface here bends up, so none rises above the plane that touches it at the target.
    height = float(goal.target @ goal.normal / goal.normal[2])
    found = _beside(best, model, height, goal.normal, _NEAR_GOAL_CLEARANCE_M, random)
    if found is None:
        # Where that plane leans towards the arm it cuts the shoulder, though no surface is there:
        # then about as far out of it as postures at the goal are.
        farthest = max(model.clearance(q, height, goal.normal) for q in best)
        least = farthest - _NEAR_GOAL_SLACK_M
        found = _beside(best, model, height, goal.normal, least, random)
    if found is None:
        raise OptionError(f"no start near the goal found for scenario {streams.index}")
    return found


def _beside(
    postures: FloatArray,
    model: Kinematics,
    height_m: float,
    normal: FloatArray,
    clearance_m: float,
    random: np.random.Generator,
) -> FloatArray | None:
    """Joint angles (7,) near one of some postures (n, 7), so far above a plane; None if none is."""
    for _ in range(MAX_REDRAWS):
        posture = postures[random.integers(len(postures))].copy()
        posture[6] = random.uniform(-1.0, 1.0) * 0.5
        low, high = np.log(_NEAR_GOAL_SCALE_RAD)
        scale = math.exp(random.uniform(low, high))
        q = posture + random.normal(size=7) * scale * [0.5, 0.5, 0.5, 0.5, 1, 1, 2]
        if (np.abs(q) < JOINT_RANGE_RAD).all() and (
            model.clearance(q, height_m, normal) >= clearance_m
        ):
            return q
    return None


def steps_lower_bound(spec: Spec, start: FloatArray, goal: Goal) -> int:
    """Least control steps to success from rest, under joint speed and acceleration limits.

    The travel time over all goal configurations (yaw is free, so A7 stays), rounded up to control
    steps, plus the further steps of the hold and the latency.

    Args:
        spec: Task whose period, hold and latency count.
        start: Joint angles, (7,) rad.
        goal: Where the tip has to be.

    Returns:
        Steps; a large number where the goal is out of reach.
    """
    configurations = kinematics(spec.embodiment).goal_configurations_at_tool_angle(
        goal.position, goal.normal, float(start[6])
    )
    if not len(configurations):
        return 10**6
    seconds = float(travel_time(start, configurations, acceleration_limits=True).min())
    steps = math.ceil(seconds / spec.control_period_s - 1e-9)
    return max(1, steps) + spec.hold_steps - 1 + spec.latency_steps
