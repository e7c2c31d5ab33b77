"""Certificate lines of surfaces of unknown slope and height."""

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import kinematics, travel_time
from hvs_suite.cell.robot import JOINT_SPEED_RAD_S
from hvs_suite.tasks.shared.certificate import Check
from hvs_suite.tasks.shared.detection import find_discs
from hvs_suite.tasks.shared.goal import HEIGHT, LATERAL, POSITION, TILT, Goal, Tip, goal_errors
from hvs_suite.tasks.shared.pattern_pose import Look, Ring, RingPose, axes, fit, match

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

LEAN_DEG = 35.0
FARTHER_M = 0.005
"""The reference looks from so far to the side, so much farther than the goal."""
PERCENTILE = 95
_POSTURES = 12
"""At the goal, of which one is taken from which most looks are a short way."""
_LOOKING_SHARE = 2.0 / 3.0
_TURN_RAD = 2.4
_TURN_RANGE_RAD = 2.5
_MISTAKEN = 0.02
"""How wrong the fit's first guess is: in m/10, and rad."""


def check_slope(env: "Environment", scenarios: Iterable[int], ring: Ring) -> list[Check]:
    """Do the marks show slope and place well enough for every tolerance?

    The reference estimator looks from all sides and from the goal, from wherever the arm can
    without taking another shape, in two thirds of an episode's steps. It sees pictures with the
    task's own noise, knows which patch is which mark, and fits the ring to all of them. The tip
    that goes where it says is held against the goal: a slope that is off by a small angle a shifts
    the tip by standoff * a.

    Args:
        env: The named task, with scenarios that have ``marks``.
        scenarios: Indices to check.
        ring: The marks as the drawing has them.

    Returns:
        How many looks there were, one check for each tolerance, and what a single look from the
        goal leaves, for information.
    """
    spec = env.task.family.spec
    rows, alone, numbers = [], [], []
    env.draws = False
    for index in scenarios:
        env.reset(scenario=index)
        looks, start = _looks(env, ring)
        numbers.append(len(looks))
        rows.append(_errors(env, looks, ring, start))
        alone.append(_errors(env, looks[:1], ring, start)[-1])
    env.draws = True
    names = (POSITION, LATERAL, HEIGHT, TILT)
    bounds = spec.step_bounds
    found = np.percentile(np.array(rows), PERCENTILE, axis=0)
    metrics = {metric.name: metric for metric in spec.metrics}
    count = _n_looks(env)
    needed = count // 4
    checks = [
        Check(
            f"observable: looks that show the marks, of {count} around the goal",
            f"mean {np.mean(numbers):.1f}, min {min(numbers)}",
            f">= {needed}",
            min(numbers) >= needed,
        )
    ]
    for name, value in zip(names, found, strict=True):
        metric = metrics[name]
        bound = bounds.get(name, bounds.get(POSITION))
        assert bound is not None
        checks.append(
            Check(
                f"accurate: {metric.title.removesuffix(' error')} from the marks in all looks, "
                f"{PERCENTILE}th percentile",
                f"{value:.3f} {metric.unit}",
                f"<= {bound:g} {metric.unit}",
                value <= bound,
            )
        )
    checks.append(
        Check(
            f"hard: tilt from the marks in one look from the goal, {PERCENTILE}th percentile",
            f"{np.percentile(alone, PERCENTILE):.3f} deg",
            "",
            True,
        )
    )
    return checks


def _n_looks(env: "Environment") -> int:
    """How many looks an episode has time for, coming and going left out."""
    return int(_LOOKING_SHARE * env.spec.time_limit_steps)


def _looks(env: "Environment", ring: Ring) -> tuple[list[Look], RingPose]:
    """What the eye in the hand sees of the marks, the first from the goal, and where they are."""
    goal, model = env.task.goal(), kinematics()
    scenario: Any = env.scenario
    x, y = axes(goal.normal)
    first = scenario.marks[0] - goal.target
    pose = RingPose(goal.target, goal.normal, math.atan2(float(first @ y), float(first @ x)))
    K = env.task.cameras["eih"].K
    family = model.goal_configurations_at_tool_angle(goal.position, goal.normal, 0.0)
    times = travel_time(scenario.start, family, acceleration_limits=True)
    # A posture from which one can look from most sides, of those that are soon reached.
    best: list[FloatArray] = []
    views = _views(goal, _n_looks(env))
    for q in family[np.argsort(times)[:: max(1, len(family) // _POSTURES)]]:
        around = [near for view in views if (near := _near(q, view)) is not None]
        best = max(best, around, key=len)
        if len(best) == len(views):
            break
    looks = []
    for number, q in enumerate(best):
        posture = q.copy()
        # Each time with the marks on other pixels, and so under other noise.
        posture[6] = (number * _TURN_RAD) % (2.0 * _TURN_RANGE_RAD) - _TURN_RANGE_RAD
        env.task.place(env.physics, posture)
        image = env.task.observables["eih"](env.physics, None)
        R, p = model.flange_pose(posture + scenario.joint_offset)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ p
        look = match(find_discs(image, most=2 * ring.n_marks), ring, pose, K, T)
        if look is not None:
            looks.append(look)
    return looks, pose


def _views(goal: Goal, count: int) -> list[Goal]:
    """The goal itself, and places around it from which to look at its target."""
    x, y = axes(goal.normal)
    lean, views = math.radians(LEAN_DEG), [goal]
    for around in 2.0 * math.pi * np.arange(1, count) / count:
        side = math.cos(around) * x + math.sin(around) * y
        towards = math.cos(lean) * goal.normal + math.sin(lean) * side
        views.append(Goal(goal.target, towards, goal.standoff_m + FARTHER_M))
    return views


def _near(q: FloatArray, view: Goal) -> FloatArray | None:
    return kinematics().nearest_configuration(q, view.position, view.normal, JOINT_SPEED_RAD_S)


def _errors(
    env: "Environment", looks: list[Look], ring: Ring, true: RingPose
) -> tuple[float, float, float, float]:
    """Position, lateral, height (mm) and tilt error (deg) of a tip that goes where looks say."""
    if not looks:
        return math.inf, math.inf, math.inf, math.inf
    goal = env.task.goal()
    x, _ = axes(true.normal)
    normal = true.normal + _MISTAKEN * x
    start = RingPose(
        true.target + 0.1 * _MISTAKEN * x, normal / np.linalg.norm(normal), true.turn + _MISTAKEN
    )
    pose = fit(looks, ring, start, env.task.cameras["eih"].K).pose
    tip = Tip(pose.target + goal.standoff_m * pose.normal, -pose.normal)
    errors = goal_errors(tip, goal)
    return errors[POSITION], errors[LATERAL], abs(errors[HEIGHT]), errors[TILT]
