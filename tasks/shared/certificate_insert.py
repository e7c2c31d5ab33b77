"""Certificate lines of holes: how well vision shows them, and what has to be found by feel."""

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.cameras import extrinsics_of_hand, project
from hvs_suite.cell.kinematics import Kinematics, kinematics, travel_time
from hvs_suite.cell.robot import JOINT_ACCELERATION_RAD_S2
from hvs_suite.tasks.shared.certificate import MAX_BUDGET, Check
from hvs_suite.tasks.shared.detection import find_disc, intersect, outline
from hvs_suite.tasks.shared.feeling import HoleSearch, search_of
from hvs_suite.tasks.shared.goal import UP, Goal

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

_FELT_EVERY = 5
"""Of the scenarios, every so many are searched by feel: that takes rollouts."""
_BEGIN_M = 0.003
"""How far above the face such a search begins (m)."""
_APPROACH_STEPS = 35
"""What the time limit leaves a search: the expert takes about so long to get there."""


def check_sight(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Does the eye in the hand show where the paint is, well enough for the mouth to catch the tip?

    From where the tip looks at the bushing, its face is found under the task's own noise, and
    encoder errors are passed through the kinematics.

    Args:
        env: The named task.
        scenarios: Indices to check.

    Returns:
        Checks of the lateral error, the depth and the tilt; where the hole is off its paint, of
        what sight alone leaves.
    """
    spec = env.task.family.spec
    model = kinematics(spec.embodiment)
    off_mm, deep_mm, left_mm, tilts = [], [], [], []
    env.draws = False
    for index in scenarios:
        env.reset(scenario=index)
        posture = _posture_above(env, model, spec.look_from_m)
        R, tip = model.tip_pose(posture)
        believed_R, believed_tip = model.tip_pose(posture + env.scenario.joint_offset)
        seen = _seen_mouth(env, posture)
        scenario = env.task.family.scenario
        wrong = np.full(2, np.inf)
        if seen is not None:
            wrong = (seen - believed_tip - (scenario.target - tip))[:2]
        off_mm.append(1000.0 * float(np.linalg.norm(wrong)))
        deep_mm.append(1000.0 * abs(float(believed_tip[2] - tip[2])))
        left_mm.append(1000.0 * float(np.linalg.norm(wrong - scenario.hole_offset)))
        tilts.append(math.degrees(math.acos(min(1.0, float(R[:, 2] @ believed_R[:, 2])))))
    env.draws = True
    catch = spec.clearance_mm + spec.chamfer_mm
    budget = (
        ("lateral from bushing's face in EIH", off_mm, catch, "mm"),
        ("depth from joints", deep_mm, spec.depth_tolerance_mm, "mm"),
        ("tilt from joints", tilts, spec.tilt_tolerance_deg, "deg"),
    )
    checks = [
        Check(
            f"accurate: {name}, 99th percentile",
            f"{np.percentile(values, 99):.3f} {unit}",
            f"<= {MAX_BUDGET * bound:.2f} {unit}",
            np.percentile(values, 99) <= MAX_BUDGET * bound,
        )
        for name, values, bound, unit in budget
    ]
    if spec.hole_noise_mm:
        left = float(np.percentile(left_mm, 95))
        checks.append(
            Check(
                "hidden: how far the hole is from where it is seen, 95th percentile",
                f"{left:.2f} mm",
                f"> {catch:.2f} mm",
                left > catch,
            )
        )
    return checks


def check_feeling(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Can a hole that is off its paint be found by feel, without hidden knowledge?

    Args:
        env: The named task.
        scenarios: Indices; every fifth is searched.

    Returns:
        A check of the search, against pushing straight down; none where the hole is where it is
        seen.
    """
    if not env.task.family.spec.hole_noise_mm:
        return []
    solved: dict[bool, list[bool]] = {True: [], False: []}
    for index in scenarios:
        if index % _FELT_EVERY == 0:
            for searches, found in solved.items():
                found.append(_search(env, index, searches=searches))
    by_search, by_pushing = (100.0 * float(np.mean(solved[each])) for each in (True, False))
    return [
        Check(
            f"felt: solved by a spiral search, of {len(solved[True])}, against pushing",
            f"{by_search:.1f} %",
            f"> {by_pushing:.1f} %",
            by_search > by_pushing,
        )
    ]


def _search(env: "Environment", index: int, *, searches: bool) -> bool:
    """Whether a search by feel solves a scenario; it begins above where the hole is seen."""
    spec = env.task.family.spec
    model = kinematics(spec.embodiment)
    env.draws = False
    env.reset(scenario=index)
    mouth = _seen_mouth(env, _posture_above(env, model, spec.look_from_m))
    assert mouth is not None
    mouth = mouth + spec.top_m * UP
    posture = _fastest(env, model, Goal(mouth, UP, _BEGIN_M))
    env.task.place(env.physics, posture)
    how = search_of(spec.clearance_mm, spec.chamfer_mm, spec.hole_noise_mm, searches)
    feeling = HoleSearch(how, mouth, mouth + _BEGIN_M * UP)
    joints, force_n = posture, 0.0
    for _ in range(spec.time_limit_steps - _APPROACH_STEPS):
        _, tip = model.tip_pose(joints)
        ahead = feeling.next_set_point(tip, force_n)
        near = model.nearest_configuration(posture, ahead, UP, JOINT_ACCELERATION_RAD_S2)
        posture = posture if near is None else near
        time_step = env.step(env.commandable(posture))
        if time_step.last():
            break
        joints = time_step.observation["joint_positions"]
        force_n = -float(time_step.observation["wrench"][2])
    env.draws = True
    return bool(env.info["is_success"])


def _posture_above(env: "Environment", model: Kinematics, height_m: float) -> FloatArray:
    """A posture (7,) with the tip above the middle of the painted face."""
    family = env.task.family
    face = family.scenario.target + family.spec.top_m * UP
    return _fastest(env, model, Goal(face, UP, height_m))


def _fastest(env: "Environment", model: Kinematics, goal: Goal) -> FloatArray:
    """The configuration (7,) of a goal that is soonest reached from the start."""
    reachable = model.goal_configurations_at_tool_angle(goal.position, goal.normal, 0.0)
    times = travel_time(env.scenario.start, reachable, acceleration_limits=True)
    return np.asarray(reachable[int(times.argmin())])


def _seen_mouth(env: "Environment", posture: FloatArray) -> FloatArray | None:
    """Where the bushing is, as seen from a posture (7,): on the surface, (3,) m; None if unseen.

    In the frame that the encoders show. Perspective shifts the centre of the face's area from the
    picture of its middle, a ring's by more than a disc's.
    """
    spec = env.task.family.spec
    model = kinematics(spec.embodiment)
    env.task.place(env.physics, posture)
    found = find_disc(env.task.observables["eih"](env.physics, None))
    if found is None:
        return None
    T = extrinsics_of_hand(*model.flange_pose(posture + env.scenario.joint_offset), spec.embodiment)
    K = env.task.cameras["eih"].K
    place = intersect(found.centre[None], K, T, spec.top_m)
    if place is None:
        return None
    drawn = outline(place[0], spec.target_diameter_m, K, T, spec.top_m)
    if drawn is None:
        return None
    shift = drawn[1] - project(np.array([*place[0], spec.top_m]), K, T)[:2]
    place = intersect((found.centre - (1.0 + spec.hole_share) * shift)[None], K, T, spec.top_m)
    return None if place is None else np.array([*place[0], 0.0])
