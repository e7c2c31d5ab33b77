"""Reward terms: the thesis's five and four further shapings, each switchable.

Switching a term changes the reward and nothing else: success and termination never depend on it.
"""

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.robot import JOINT_RANGE_RAD
from hvs_suite.tasks.shared.goal import HEIGHT, LATERAL, POSITION, TILT
from hvs_suite.tasks.shared.spec import RewardTerm, Spec

FloatArray = npt.NDArray[np.float64]

GOAL_REWARD = 1.0
"""r*, the scale of all terms."""
TIME_COST = 0.05
SHAPING_WEIGHT = 0.4
EXPONENTIAL_LENGTH_M = 0.05
"""Distance at which the exponential shaping has fallen to 1/e (m)."""
OF_ERRORS = frozenset({"position", "lateral", "height", "rotation", "exponential"})
"""Terms that pay by how far the tip is from its goal."""


@dataclasses.dataclass(frozen=True)
class StepOutcome:
    """What the rewards of a control step depend on.

    Attributes:
        success: The goal was reached and held in this step.
        collision: A forbidden contact happened in this step.
        truncated: The time limit ended the episode.
        distance_m: Norm of the position error to the goal (m), or None where no term needs it.
        lateral_m: Its part in the target plane (m), likewise.
        height_m: Its part along the normal, without sign (m), likewise.
        tilt_deg: Tilt error (deg), likewise.
        joint_distance: Distance to the nearest goal configuration: the largest joint difference as
            a fraction of that joint's full range, or None where the term is off.
    """

    success: bool
    collision: bool
    truncated: bool
    distance_m: float | None
    lateral_m: float | None
    height_m: float | None
    tilt_deg: float | None
    joint_distance: float | None


def reward_terms(spec: Spec, outcome: StepOutcome) -> dict[str, float]:
    """Reward terms of one control step, switched-on ones only; their sum is the reward.

    A collision (-r*) replaces everything else. While the goal is not reached, ``time`` costs 0.05 a
    step and the shapings pay at most 0.4 r* each: ``position`` 0.4 r* (L - d) / L with
    L = 2 reach - tolerance, ``lateral`` and ``height`` the same of one part of the error, with the
    tolerance of that part, ``rotation`` 0.4 r* (A - a) / A with A = 180 deg - tolerance (all four
    in full within tolerance), ``joint_space`` 0.4 r* (1 - joint distance), ``exponential``
    0.4 r* exp(-d / 50 mm). A hard time limit costs r* when it strikes.

    Args:
        spec: Which terms are on, and the tolerances.
        outcome: The control step.

    Returns:
        Term by name.
    """
    on = spec.rewards
    if outcome.collision:
        return {"collision": -GOAL_REWARD} if "collision" in on else {}
    if outcome.success:
        return {"goal": GOAL_REWARD} if "goal" in on else {}
    terms: dict[str, float] = {}
    if "time" in on:
        terms["time"] = -TIME_COST
    bounds = spec.step_bounds
    lengths: tuple[tuple[RewardTerm, float | None, str, str], ...] = (
        ("position", outcome.distance_m, POSITION, LATERAL),
        ("lateral", outcome.lateral_m, LATERAL, POSITION),
        ("height", outcome.height_m, HEIGHT, POSITION),
    )
    for term, error_m, bound, other in lengths:
        if term in on and error_m is not None:
            tolerance = 1e-3 * bounds.get(bound, bounds.get(other, 0.0))
            length = 2.0 * spec.reach_m - tolerance
            terms[term] = SHAPING_WEIGHT * _linear(error_m, tolerance, length)
    if "rotation" in on and outcome.tilt_deg is not None:
        tolerance = bounds.get(TILT, 0.0)
        terms["rotation"] = SHAPING_WEIGHT * _linear(outcome.tilt_deg, tolerance, 180.0 - tolerance)
    if "joint_space" in on and outcome.joint_distance is not None:
        terms["joint_space"] = SHAPING_WEIGHT * (1.0 - outcome.joint_distance)
    if "exponential" in on and outcome.distance_m is not None:
        terms["exponential"] = SHAPING_WEIGHT * math.exp(-outcome.distance_m / EXPONENTIAL_LENGTH_M)
    if outcome.truncated and spec.time_limit == "hard":
        terms["time_limit"] = -GOAL_REWARD
    return terms


def joint_distance(q: FloatArray, goal_configurations: FloatArray) -> float:
    """Distance in joint space to the nearest of many goal configurations.

    Args:
        q: Joint angles, (7,) rad.
        goal_configurations: (m, 7) rad.

    Returns:
        Largest joint difference as a fraction of that joint's full range, for the nearest, in
        [0, 1].
    """
    difference = np.abs(goal_configurations - q) / (2.0 * JOINT_RANGE_RAD)
    return float(difference.max(axis=1).min())


def _linear(error: float, tolerance: float, span: float) -> float:
    return 1.0 if error <= tolerance else (span - error) / span
