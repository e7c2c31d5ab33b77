"""Certificates: every named task proves that it can be solved, over all its test scenarios.

Four questions: can the goal be *reached* within the joint ranges; is there *time*; can the target
be *seen* well enough for every tolerance; and is the task *solved* by the expert? The first three
are answered here, by checks that families choose from; the fourth takes rollouts, so ``hvs
certify`` adds it. Scenarios are never
filtered: a task that fails is changed instead.
"""

import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import away_from_stops, kinematics, travel_time
from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from hvs_suite.embodiment import BARE_ARM, Embodiment
from hvs_suite.errors import LockError
from hvs_suite.files import replacing
from hvs_suite.tasks.shared.detection import Disc, find_disc
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.metric import Metric
from hvs_suite.tasks.shared.start import steps_lower_bound

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment
    from hvs_suite.tasks.shared.placing import PlacingSpec

FloatArray = npt.NDArray[np.float64]

FOLDER = Path(__file__).resolve().parents[1] / "certificates"
MIN_JOINT_MARGIN_DEG = 2.0
MIN_FOOTPRINT_PX = 3
MAX_BUDGET = 0.8
"""Share of a tolerance that disturbances may use up."""
CONTROL_RESIDUAL_MM = 0.02
"""Standing error of the joint controller, an upper bound that the cell's tests hold."""
MAX_SPEED_SHARE = 0.6
"""Share of a joint's speed that following a moving goal may need."""
_PERCENTILE = 99
# Postures that clear the line of sight: lean the arm by A2 in one of eight directions of A1.
_LOOK_LEAN_RAD = (0.25, 0.5, 0.75)
_LOOK_TURNS = 8


@dataclasses.dataclass(frozen=True)
class Check:
    """One line of a certificate.

    Attributes:
        what: What was checked.
        found: What was found over all test scenarios.
        needed: The bound it has to keep; empty where the figure is for information.
        holds: Whether it keeps it.
    """

    what: str
    found: str
    needed: str
    holds: bool

    def __post_init__(self) -> None:
        """Store a Python bool: NumPy's does not go into JSON."""
        object.__setattr__(self, "holds", bool(self.holds))


@dataclasses.dataclass(frozen=True)
class Certificate:
    """What is known about a named task.

    Attributes:
        task: Registered name.
        digest: Digest of the task that was certified, as in ``lock.json``.
        scenarios: Number of test scenarios, from 0 up, that were checked.
        checks: Its lines.
    """

    task: str
    digest: str
    scenarios: int
    checks: tuple[Check, ...]

    @property
    def holds(self) -> bool:
        """Whether every check holds."""
        return all(check.holds for check in self.checks)

    def to_json(self) -> str:
        """The certificate as stored."""
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"


def load_certificate(task: str) -> Certificate:
    """The stored certificate of a named task.

    Args:
        task: Registered name.

    Raises:
        LockError: The task has not been certified, which the tests do not let pass.
    """
    try:
        stored = json.loads((FOLDER / f"{task}.json").read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise LockError(
            f"task {task!r} has no certificate; make one with 'hvs certify {task}'"
        ) from error
    checks = tuple(Check(**check) for check in stored.pop("checks"))
    return Certificate(checks=checks, **stored)


def store(certificate: Certificate) -> None:
    """Write a certificate where `load_certificate` finds it.

    Raises:
        OutputError: The file cannot be written.
    """
    with replacing(FOLDER / f"{certificate.task}.json") as path:
        path.write_text(certificate.to_json(), encoding="utf-8")


def check_geometry(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Is every goal reachable with margin, and in time?

    Args:
        env: The named task.
        scenarios: Indices to check.

    Returns:
        Checks of the joint margin and of the steps that the fastest motion takes.
    """
    spec = env.spec
    margins, bounds = [], []
    env.draws = False
    for index in scenarios:
        env.reset(scenario=index)
        goal = env.task.goal()
        margins.append(joint_margin_deg(goal, spec.embodiment))
        bounds.append(steps_lower_bound(spec, env.scenario.start, goal))
    env.draws = True
    limit = spec.time_limit_steps
    return [
        _margin_check(min(margins)),
        Check(
            "in time: steps of the fastest motion, hold and latency included",
            f"mean {np.mean(bounds):.1f}, max {max(bounds)}",
            f"<= {limit}",
            max(bounds) <= limit,
        ),
    ]


def check_legs(
    env: "Environment",
    scenarios: Iterable[int],
    targets: Callable[[Any], FloatArray],
    leg_steps: int,
) -> list[Check]:
    """Is every one of several targets reachable with margin, and in time from the one before?

    The time of a leg is the least travel time between any two postures at its ends: a lower bound.

    Args:
        env: The named task, a family of `Placing` with targets on the level surface.
        scenarios: Indices to check.
        targets: Centres of a scenario's targets in their order, (n, 3) m.
        leg_steps: Control steps that there are for each of them.

    Returns:
        Checks of the joint margin, of the slowest leg and of their sum.
    """
    spec, family = env.spec, env.task.family
    margins, legs, sums = [], [], []
    for index in scenarios:
        scenario = env.task.source.draw(index)
        goals = [family.goal_over(x, y) for x, y, _ in targets(scenario).tolist()]
        margins += [joint_margin_deg(goal) for goal in goals]
        steps = [steps_lower_bound(spec, scenario.start, goals[0])]
        postures = [
            kinematics().goal_configurations_at_tool_angle(goal.position, goal.normal, 0.0, 24)
            for goal in goals
        ]
        for here, there in itertools.pairwise(postures):
            seconds = min(
                float(travel_time(q, there, acceleration_limits=True).min()) for q in here
            )
            steps.append(
                math.ceil(seconds / spec.control_period_s - 1e-9)
                + spec.hold_steps
                - 1
                + spec.latency_steps
            )
        legs += steps
        sums.append(sum(steps))
    return [
        _margin_check(min(margins)),
        Check(
            "in time: steps of the slowest leg at its fastest, hold and latency included",
            f"mean {np.mean(legs):.1f}, max {max(legs)}",
            f"<= {leg_steps}",
            max(legs) <= leg_steps,
        ),
        Check(
            "in time: steps of all legs at their fastest",
            f"mean {np.mean(sums):.1f}, max {max(sums)}",
            f"<= {spec.time_limit_steps}",
            max(sums) <= spec.time_limit_steps,
        ),
    ]


def check_path(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Can the arm stay with a moving goal: within its ranges, well below its speeds, in time?

    A posture at the start of the path is carried along it, each time to the nearest one, pushed a
    little away from the joints' stops. The soonest that keeps the bounds is taken; where none does,
    of those with the least speed the one with the largest margin.

    Args:
        env: The named task.
        scenarios: Indices to check.

    Returns:
        Checks of the joint margin along the path, of the joint speeds and of the time to get there.
    """
    spec, model = env.spec, kinematics()
    margins, shares, bounds = [], [], []
    env.draws = False
    for index in scenarios:
        env.reset(scenario=index)
        task = env.task
        goals = [task.goal(k * spec.control_period_s) for k in range(spec.time_limit_steps + 1)]
        first = goals[0]
        family = model.goal_configurations_at_tool_angle(first.position, first.normal, 0.0, 24)
        times = travel_time(env.scenario.start, family, acceleration_limits=True)
        margin, share = -math.inf, math.inf
        for q in family[np.argsort(times)]:
            found = _carry(q, goals, spec.control_period_s)
            if (max(found[1], MAX_SPEED_SHARE), -found[0]) < (max(share, MAX_SPEED_SHARE), -margin):
                margin, share = found
            if margin >= MIN_JOINT_MARGIN_DEG and share <= MAX_SPEED_SHARE:
                break
        margins.append(margin)
        shares.append(share)
        bounds.append(steps_lower_bound(spec, env.scenario.start, first))
    env.draws = True
    latest = spec.time_limit_steps
    return [
        _margin_check(min(margins)),
        Check(
            "followed: largest joint speed along the path, of what the joint can do",
            f"median {100 * np.median(shares):.0f} %, max {100 * max(shares):.0f} %",
            f"<= {100 * MAX_SPEED_SHARE:.0f} %",
            max(shares) <= MAX_SPEED_SHARE,
        ),
        Check(
            "in time: steps of the fastest motion to where it starts, hold and latency included",
            f"mean {np.mean(bounds):.1f}, max {max(bounds)}",
            f"<= {latest}",
            max(bounds) <= latest,
        ),
    ]


def _carry(q: FloatArray, goals: Sequence[Goal], period_s: float) -> tuple[float, float]:
    """Least margin to a joint stop (deg) and largest share of a joint's speed along a path."""
    margin, share = math.inf, 0.0
    for goal in goals:
        near = kinematics().nearest_configuration(
            away_from_stops(q), goal.position, goal.normal, JOINT_SPEED_RAD_S
        )
        if near is None:
            return -math.inf, math.inf
        if margin < math.inf:
            share = max(share, float((np.abs(near - q) / JOINT_SPEED_RAD_S).max()) / period_s)
        margin = min(margin, float(np.rad2deg((JOINT_RANGE_RAD - np.abs(near)).min())))
        q = near
    return margin, share


def _margin_check(margin_deg: float) -> Check:
    return Check(
        "reachable: least margin to a joint stop, best posture",
        f"{margin_deg:.1f} deg",
        f">= {MIN_JOINT_MARGIN_DEG:g} deg",
        margin_deg >= MIN_JOINT_MARGIN_DEG,
    )


Find = Callable[["Environment", npt.NDArray[np.uint8], str], Disc | None]
"""Finds the target in the picture of a camera, with what a policy may know of the task."""


def _find_red(env: "Environment", image: npt.NDArray[np.uint8], camera: str) -> Disc | None:
    """The largest red patch, where nothing else is red."""
    return find_disc(image)


def check_visibility(
    env: "Environment",
    scenarios: Iterable[int],
    find: Find = _find_red,
    needed_share: float = 99.0,
) -> list[Check]:
    """Can the target be found at the start, or soon enough afterwards?

    Args:
        env: The named task.
        scenarios: Indices to check.
        find: The reference estimator.
        needed_share: Of the targets in line of sight (%), how many it has to find in ETH. Where
            outlines count it cannot find those that the arm covers in part.

    Returns:
        Checks of the rendered footprint in ETH, of a detection test under the task's own noise,
        of the share of scenes that start hidden, and of looking first and then going.
    """
    spec = env.spec
    footprints, misses, hidden, look_bounds, n = [], [], 0, [], 0
    for index in scenarios:
        n += 1
        observation = env.reset(scenario=index).observation
        eth, eih = (target_in(env, name) for name in ("eth", "eih"))
        if eth[3]:
            side = spec.eth_resolution
            camera = env.task.cameras["eth"]
            ids = env.renderer.segmentation(env.physics.data.ptr, camera.id, side, side)
            footprints.append(int((ids == env.task.family.marker_geom).sum()))
            found = find(env, observation["eth"], "eth")
            true = (eth[:2] + 1.0) / 2.0 * side - 0.5
            misses.append(math.hypot(*(found.centre - true)) if found is not None else math.inf)
        elif not eih[3]:
            hidden += 1
            look_bounds.append(_steps_look_and_go(env))
    limit = spec.time_limit_steps
    found_share = 100.0 * float(np.mean(np.array(misses) <= 1.5))
    checks = [
        Check(
            "observable: target's smallest footprint in ETH where it is in line of sight",
            f"{min(footprints)} px",
            f">= {MIN_FOOTPRINT_PX} px",
            min(footprints) >= MIN_FOOTPRINT_PX,
        ),
        Check(
            "observable: found in ETH within 1.5 px by colour, under the task's own disturbances",
            f"{found_share:.1f} %",
            f">= {needed_share:g} %",
            found_share >= needed_share,
        ),
        Check(
            "observable: hidden from both cameras at the start",
            f"{100.0 * hidden / n:.1f} %",
            "<= 15 %",
            hidden / n <= 0.15,
        ),
    ]
    if look_bounds:
        checks.append(
            Check(
                "observable: steps to look first, then go, where it is hidden",
                f"max {max(look_bounds)}",
                f"<= {limit}",
                max(look_bounds) <= limit,
            )
        )
    return checks


def check_accuracy(
    env: "Environment", scenarios: Iterable[int], find: Find = _find_red
) -> list[Check]:
    """Do the disturbances leave enough of every tolerance?

    At the goal posture of each scenario the disc is found in EIH under the task's own noise, and
    encoder errors are passed through the kinematics. *Lateral* comes from the disc's centre, and a
    tilt that the joints hide shifts the flange by standoff * tan(tilt). *Tilt* comes from the
    joints: a disc does not show it. *Height* comes from the joints or from the disc's apparent
    diameter (height = focal length * diameter / apparent diameter), whichever is better.

    Args:
        env: The named task, of a family of `Placing`.
        scenarios: Indices to check.
        find: The reference estimator.

    Returns:
        One check for each tolerance of the task.
    """
    spec: PlacingSpec = env.task.family.spec
    rows = np.array([_errors_at_goal(env, index, find) for index in scenarios])
    # A measured diameter is calibrated, so the error of the median does not count.
    rows[:, 2] = np.abs(rows[:, 2] - np.median(rows[:, 2]))
    tilt_deg, joint_height, image_height, image_lateral = np.percentile(rows, _PERCENTILE, axis=0)
    lateral = math.hypot(image_lateral, 1000.0 * spec.standoff_m * math.tan(math.radians(tilt_deg)))
    height_source = "joints" if joint_height <= image_height else "disc's diameter in EIH"
    lateral += CONTROL_RESIDUAL_MM
    height = min(joint_height, image_height) + CONTROL_RESIDUAL_MM
    budget = [
        ("lateral", "disc's centre in EIH", lateral, spec.lateral_tolerance_mm, "mm"),
        ("height", height_source, height, spec.height_tolerance_mm, "mm"),
        (
            "position",
            f"disc's centre in EIH, height from {height_source}",
            math.hypot(lateral, height),
            spec.position_tolerance_mm,
            "mm",
        ),
        ("tilt", "joints", tilt_deg, spec.tilt_tolerance_deg, "deg"),
    ]
    return [
        Check(
            f"accurate: {name} from {source}, 99th percentile",
            f"{value:.3f} {unit}",
            f"<= {MAX_BUDGET * tolerance:.2f} {unit}",
            value <= MAX_BUDGET * tolerance,
        )
        for name, source, value, tolerance, unit in budget
        if tolerance is not None
    ]


def solved_check(n_success: int, n_collision: int, n: int, mean_steps: float) -> Check:
    """The fourth question, answered by rollouts of the expert."""
    return Check(
        "solved: expert's successes, collisions, mean steps to goal",
        f"{n_success} of {n}, {n_collision}, {mean_steps:.2f}",
        "all, none",
        n_success == n and n_collision == 0,
    )


def limit_check(metric: Metric, values: Sequence[float]) -> Check:
    """How near the expert comes to a limit whose breach ends an episode.

    Args:
        metric: What is limited.
        values: The largest of each episode.
    """
    bound = math.inf if metric.bound is None else metric.bound
    return Check(
        f"safe: expert's {metric.title}, 99th percentile and largest",
        f"{np.percentile(values, 99):.1f}, {max(values):.1f} {metric.unit}",
        f"<= {bound:g} {metric.unit}",
        max(values) <= bound,
    )


def _steps_look_and_go(env: "Environment") -> int:
    """Least steps to a posture from which a camera sees the target, and on to the goal."""
    spec, scenario, goal = env.spec, env.scenario, env.task.goal()
    best = 10**6
    for lean in _LOOK_LEAN_RAD:
        for turn in np.arange(_LOOK_TURNS) * 2.0 * math.pi / _LOOK_TURNS:
            # Leaning by A1, A2 and back by A1 turns the tool nowhere: A2 about a turned axis.
            posture = scenario.start.copy()
            posture[0] = math.remainder(turn, 2.0 * math.pi)
            posture[1] = lean
            if np.any(np.abs(posture) > JOINT_RANGE_RAD) or not _sees(env, posture):
                continue
            look = float(travel_time(scenario.start, posture[None], acceleration_limits=True)[0])
            steps = math.ceil(look / spec.control_period_s - 1e-9)
            best = min(best, steps + steps_lower_bound(spec, posture, goal))
    return best


def _sees(env: "Environment", posture: FloatArray) -> bool:
    env.task.place(env.physics, posture)
    return any(target_in(env, name)[3] for name in ("eth", "eih"))


def target_in(env: "Environment", camera: str) -> FloatArray:
    """Where the family's first keypoint appears in a camera, (4,), as in ``ArmTask.privileged``."""
    keypoint = next(iter(env.task.family.keypoints().values()))
    found: FloatArray = env.task.in_image(env.physics, keypoint, camera)
    return found


def joint_margin_deg(goal: Goal, embodiment: Embodiment = BARE_ARM) -> float:
    """Least margin to a joint stop in a goal's best posture (deg); -inf if it is out of reach."""
    family = kinematics(embodiment).goal_configurations(goal.position, goal.normal)
    if not len(family):
        return -math.inf
    return float(np.rad2deg((JOINT_RANGE_RAD - np.abs(family)).min(axis=1).max()))


def _errors_at_goal(
    env: "Environment", index: int, find: Find
) -> tuple[float, float, float, float]:
    """Tilt error (deg), height error by joints, height by image, lateral error by image (mm)."""
    model = kinematics()
    env.reset(scenario=index)
    scenario, goal = env.scenario, env.task.goal()
    family = model.goal_configurations_at_tool_angle(goal.position, goal.normal, 0.0)
    times = travel_time(scenario.start, family, acceleration_limits=True)
    posture = family[int(times.argmin())]
    true_R, true_p = model.flange_pose(posture)
    believed_R, believed_p = model.flange_pose(posture + scenario.joint_offset)
    tilt = math.degrees(
        math.atan2(
            float(np.linalg.norm(np.cross(true_R[:, 2], believed_R[:, 2]))),
            float(true_R[:, 2] @ believed_R[:, 2]),
        )
    )
    joint_height = 1000.0 * abs(float((believed_p - true_p) @ goal.normal))
    env.task.place(env.physics, posture)
    found = find(env, env.task.observables["eih"](env.physics, None), "eih")
    if found is None:
        return tilt, joint_height, math.inf, math.inf
    camera = env.task.cameras["eih"]
    seen = target_in(env, "eih")
    true_px = (seen[:2] + 1.0) / 2.0 * camera.resolution - 0.5
    mm_per_px = 1000.0 * goal.standoff_m / camera.K[0, 0]
    lateral = mm_per_px * math.hypot(*(found.centre - true_px))
    height = 1000.0 * goal.standoff_m * seen[2] * camera.resolution / found.diameter
    return tilt, joint_height, height, lateral


def as_dict(certificate: Certificate) -> dict[str, Any]:
    """The certificate as plain data, for ``--json``."""
    return dataclasses.asdict(certificate)
