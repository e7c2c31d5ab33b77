"""Certificate lines of scenes in which other things lie and stand around the target."""

import itertools
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.cameras import extrinsics, look_at
from hvs_suite.cell.kinematics import kinematics, travel_time
from hvs_suite.cell.robot import JOINT_SPEED_RAD_S
from hvs_suite.cell.solid import obstacle_distance
from hvs_suite.tasks.shared.certificate import Check, target_in
from hvs_suite.tasks.shared.detection import Disc, find_level_disc
from hvs_suite.tasks.shared.room import APPROACH_M, LEAST_CLEARANCE_M, straight

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

CLEAR_M = 0.03
"""What the way that stays free keeps from obstacles at least (m)."""
MIN_FOUND_SHARE = 99.0
_FOUND_PX = 1.5


def find_by_outline(env: "Environment", image: npt.NDArray[np.uint8], camera: str) -> Disc | None:
    """The reference estimator: the whole disc of the scenario's colour and the task's size.

    It knows the nominal pose of the eye to hand, where the hand is, and the colour that is meant.
    """
    spec = env.spec
    if camera == "eth":
        turn = look_at(spec.eth_position_m, spec.eth_look_at_m)
        T = extrinsics(np.array(spec.eth_position_m), turn)
    else:
        R, p = kinematics().flange_pose(env.joint_positions)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -R.T @ p
    colour, diameter = env.task.family.scenario.colour, env.task.family.spec.target_diameter_m
    return find_level_disc(image, colour, env.task.cameras[camera].K, T, diameter)


def check_unambiguous(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Is the target the only thing of its kind, and found as such before the arm comes down?

    Args:
        env: The named task; its family tells what lies there by ``things``, the target first.
        scenarios: Indices to check.

    Returns:
        Checks of the rule, of the room around the target, and of the reference estimator at a
        posture above the goal.
    """
    alike, nearest_m, found = 0, math.inf, []
    env.draws = False
    for index in scenarios:
        env.reset(scenario=index)
        (kind, place), *others = env.task.family.things()
        alike = max(alike, sum(other == kind for other, _ in others))
        nearest_m = min([nearest_m, *(float(np.hypot(*(p - place))) for _, p in others)])
        posture = _above_the_goal(env)
        found.append(posture is not None and _is_found(env, posture))
    env.draws = True
    share = 100.0 * float(np.mean(found))
    checks = [
        Check(
            "observable: found by colour and outline in EIH, "
            f"from {1000 * APPROACH_M:.0f} mm above the goal",
            f"{share:.1f} %",
            f">= {MIN_FOUND_SHARE:g} %",
            share >= MIN_FOUND_SHARE,
        )
    ]
    if math.isfinite(nearest_m):
        spacing_m = env.task.family.spec.spacing_m
        checks[:0] = [
            Check("unambiguous: most others of its colour and outline", f"{alike}", "0", not alike),
            Check(
                "unambiguous: least distance from the target to another thing",
                f"{1000 * nearest_m:.0f} mm",
                f">= {1000 * spacing_m:.0f} mm",
                nearest_m >= spacing_m,
            ),
        ]
    return checks


def check_clear_way(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Does a way around the obstacles exist, is there time for it, and is the target seen on it?

    Args:
        env: The named task, with scenarios that have a ``way``.
        scenarios: Indices to check.

    Returns:
        Checks of the distances along the way, by coal, of its time and of what is seen, and how
        often the fastest ways that do not heed the obstacles are blocked.
    """
    spec = env.spec
    clear_m, own_m, steps, seen, hidden, blocked = [], [], [], [], [], []
    env.draws = False
    for index in scenarios:
        env.reset(scenario=index)
        scenario = env.task.family.scenario
        stations = [scenario.start, *scenario.way]
        distance = obstacle_distance(env.obstacles)
        legs = [straight(*leg) for leg in itertools.pairwise(stations)]
        clear_m.append(min(distance(q) for leg in legs for q in leg))
        own_m.append(min(kinematics().clearance(q) for leg in legs for q in leg))
        seconds = sum(
            float(travel_time(here, there[None], acceleration_limits=True)[0])
            for here, there in itertools.pairwise(stations)
        )
        further = spec.hold_steps - 1 + spec.latency_steps
        steps.append(math.ceil(seconds / spec.control_period_s) + further)
        hidden.append(not any(target_in(env, name)[3] for name in ("eth", "eih")))
        goal = env.task.goal()
        family = kinematics().goal_configurations_at_tool_angle(
            goal.position, goal.normal, float(scenario.start[6])
        )
        times = travel_time(scenario.start, family, acceleration_limits=True)
        fastest = straight(scenario.start, family[int(times.argmin())])
        blocked.append(min(distance(q) for q in fastest) <= 0.0)
        stops = np.concatenate([leg[::4] for leg in legs] + [scenario.way[1:2]])
        seen.append(any(_is_seen(env, q) for q in stops[::-1]))
    env.draws = True
    limit = spec.time_limit_steps
    return [
        Check(
            "clear: least distance from obstacles on the way that stays free",
            f"{1000 * min(clear_m):.0f} mm",
            f">= {1000 * CLEAR_M:.0f} mm",
            min(clear_m) >= CLEAR_M,
        ),
        Check(
            "clear: least distance from the surface and between links on that way",
            f"{1000 * min(own_m):.0f} mm",
            f">= {1000 * LEAST_CLEARANCE_M:.0f} mm",
            min(own_m) >= LEAST_CLEARANCE_M,
        ),
        Check(
            "clear: steps of that way, with a stop at each posture",
            f"mean {np.mean(steps):.1f}, max {max(steps)}",
            f"<= {limit}",
            max(steps) <= limit,
        ),
        Check(
            "observable: seen by a camera from somewhere on that way",
            f"{100 * np.mean(seen):.1f} %",
            "100 %",
            all(seen),
        ),
        Check(
            "observable: hidden from both cameras at the start",
            f"{100 * np.mean(hidden):.1f} %",
            "",
            True,
        ),
        Check(
            "hard: fastest straight joint motion to the goal touches an obstacle",
            f"{100 * np.mean(blocked):.1f} %",
            "",
            True,
        ),
    ]


def _above_the_goal(env: "Environment") -> FloatArray | None:
    """A posture above the goal: of the way that stays free, or one for the margin it has."""
    way = env.task.family.scenario.way
    if len(way):
        return np.asarray(way[1])
    goal = env.task.goal()
    above = goal.position + APPROACH_M * goal.normal
    family = kinematics().goal_configurations_at_tool_angle(goal.position, goal.normal, 0.0, 12)
    for q in family:
        near = kinematics().nearest_configuration(q, above, goal.normal, JOINT_SPEED_RAD_S)
        if near is not None:
            return near
    return None


def _is_found(env: "Environment", posture: FloatArray) -> bool:
    """Whether the reference estimator finds the target at a posture in the eye in the hand."""
    env.task.place(env.physics, posture)
    found = find_by_outline(env, env.task.observables["eih"](env.physics, None), "eih")
    seen = target_in(env, "eih")
    true = (seen[:2] + 1.0) / 2.0 * env.spec.eih_resolution - 0.5
    return bool(seen[3] and found is not None and math.hypot(*(found.centre - true)) <= _FOUND_PX)


def _is_seen(env: "Environment", posture: FloatArray) -> bool:
    env.task.place(env.physics, posture)
    return any(target_in(env, name)[3] for name in ("eih", "eth"))
