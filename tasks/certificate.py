"""Certificates: every named task proves that it can be solved, over all its test scenarios.

Four questions: can the goal be *reached* within the joint ranges; is there *time*; can the target
be *seen* well enough for every tolerance; and is the task *solved* by the expert? The first three
are answered here; the fourth takes rollouts, so ``hvs certify`` adds it. Scenarios are never
filtered: a task that fails is changed instead.
"""

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import kinematics, travel_time
from hvs_suite.cell.robot import JOINT_RANGE_RAD
from hvs_suite.errors import LockError
from hvs_suite.files import replacing
from hvs_suite.tasks.detection import find_disc
from hvs_suite.tasks.scenario import Scenario, steps_lower_bound

if TYPE_CHECKING:
    from hvs_suite.cell.environment import Environment

FloatArray = npt.NDArray[np.float64]

FOLDER = Path(__file__).resolve().parent / "certificates"
MIN_JOINT_MARGIN_DEG = 2.0
MIN_FOOTPRINT_PX = 3
MAX_BUDGET = 0.8
"""Share of a tolerance that disturbances may use up."""
CONTROL_RESIDUAL_MM = 0.02
"""Standing error of the joint controller, an upper bound that the cell's tests hold."""
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
    variant, model = env.variant, kinematics()
    margins, bounds = [], []
    for index in scenarios:
        scenario: Scenario = env.task.source.draw(index)
        goal = scenario.target + scenario.normal * variant.standoff_m
        family = model.goal_configurations(goal, scenario.normal)
        margin = (JOINT_RANGE_RAD - np.abs(family)).min(axis=1)
        margins.append(np.rad2deg(margin.max()) if len(family) else -math.inf)
        bounds.append(steps_lower_bound(variant, scenario.start, goal, scenario.normal))
    limit = variant.time_limit_steps
    return [
        Check(
            "reachable: least margin to a joint stop, best posture",
            f"{min(margins):.1f} deg",
            f">= {MIN_JOINT_MARGIN_DEG:g} deg",
            min(margins) >= MIN_JOINT_MARGIN_DEG,
        ),
        Check(
            "in time: steps of the fastest motion, hold and latency included",
            f"mean {np.mean(bounds):.1f}, max {max(bounds)}",
            f"<= {limit}",
            max(bounds) <= limit,
        ),
    ]


def check_visibility(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Can the target be found at the start, or soon enough after?

    Args:
        env: The named task.
        scenarios: Indices to check.

    Returns:
        Checks of the rendered footprint in ETH, of a detection test under the variant's own noise,
        of the share of scenes that start hidden, and of looking first and then going.
    """
    variant = env.variant
    footprints, misses, hidden, look_bounds, n = [], [], 0, [], 0
    for index in scenarios:
        n += 1
        observation = env.reset(scenario=index).observation
        eth, eih = (env.task.target_in_image(env.physics, name) for name in ("eth", "eih"))
        if eth[3]:
            side = variant.eth_resolution
            camera = env.task.cameras["eth"]
            ids = env.renderer.segmentation(env.physics.data.ptr, camera.id, side, side)
            footprints.append(int((ids == env.task.marker_geom).sum()))
            found = find_disc(observation["eth"])
            true = (eth[:2] + 1.0) / 2.0 * side - 0.5
            misses.append(math.hypot(*(found.centre - true)) if found is not None else math.inf)
        elif not eih[3]:
            hidden += 1
            look_bounds.append(_steps_look_and_go(env))
    limit = variant.time_limit_steps
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
            ">= 99 %",
            found_share >= 99.0,
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


def check_accuracy(env: "Environment", scenarios: Iterable[int]) -> list[Check]:
    """Do the disturbances leave enough of every tolerance?

    At the goal posture of each scenario the disc is found in EIH under the variant's own noise, and
    encoder errors are passed through the kinematics. *Lateral* comes from the disc's centre, and a
    tilt that the joints hide shifts the flange by standoff * tan(tilt). *Tilt* comes from the
    joints: a disc does not show it. *Height* comes from the joints or from the disc's apparent
    diameter (height = focal length * diameter / apparent diameter), whichever is better.

    Args:
        env: The named task.
        scenarios: Indices to check.

    Returns:
        One check for each tolerance of the variant.
    """
    variant = env.variant
    rows = np.array([_errors_at_goal(env, index) for index in scenarios])
    # Who measures a diameter calibrates it: what the median is off by is no error.
    rows[:, 2] = np.abs(rows[:, 2] - np.median(rows[:, 2]))
    tilt_deg, joint_height, image_height, image_lateral = np.percentile(rows, _PERCENTILE, axis=0)
    lateral = math.hypot(
        image_lateral, 1000.0 * variant.standoff_m * math.tan(math.radians(tilt_deg))
    )
    height_source = "joints" if joint_height <= image_height else "disc's diameter in EIH"
    lateral += CONTROL_RESIDUAL_MM
    height = min(joint_height, image_height) + CONTROL_RESIDUAL_MM
    budget = [
        ("lateral", "disc's centre in EIH", lateral, variant.lateral_tolerance_mm, "mm"),
        ("height", height_source, height, variant.height_tolerance_mm, "mm"),
        (
            "position",
            f"disc's centre in EIH, height from {height_source}",
            math.hypot(lateral, height),
            variant.position_tolerance_mm,
            "mm",
        ),
        ("tilt", "joints", tilt_deg, variant.tilt_tolerance_deg, "deg"),
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


def _steps_look_and_go(env: "Environment") -> int:
    """Least steps to a posture from which a camera sees the target, and on to the goal."""
    variant, scenario = env.variant, env.scenario
    goal = scenario.target + scenario.normal * variant.standoff_m
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
            steps = math.ceil(look / variant.control_period_s - 1e-9)
            best = min(best, steps + steps_lower_bound(variant, posture, goal, scenario.normal))
    return best


def _sees(env: "Environment", posture: FloatArray) -> bool:
    env.task.place(env.physics, posture)
    return any(env.task.target_in_image(env.physics, name)[3] for name in ("eth", "eih"))


def _errors_at_goal(env: "Environment", index: int) -> tuple[float, float, float, float]:
    """Tilt error (deg), height error by joints, height by image, lateral error by image (mm)."""
    variant, model = env.variant, kinematics()
    env.reset(scenario=index)
    scenario: Scenario = env.scenario
    goal = scenario.target + scenario.normal * variant.standoff_m
    family = model.goal_configurations_at_tool_angle(goal, scenario.normal, 0.0)
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
    joint_height = 1000.0 * abs(float((believed_p - true_p) @ scenario.normal))
    env.task.place(env.physics, posture)
    found = find_disc(env.task.observables["eih"](env.physics, None))
    if found is None:
        return tilt, joint_height, math.inf, math.inf
    camera = env.task.cameras["eih"]
    seen = env.task.target_in_image(env.physics, "eih")
    true_px = (seen[:2] + 1.0) / 2.0 * camera.resolution - 0.5
    mm_per_px = 1000.0 * variant.standoff_m / camera.K[0, 0]
    lateral = mm_per_px * math.hypot(*(found.centre - true_px))
    height = 1000.0 * variant.standoff_m * seen[2] * camera.resolution / found.diameter
    return tilt, joint_height, height, lateral


def certify(
    env: "Environment", scenarios: Iterable[int], on_scenario: Callable[[], None] = lambda: None
) -> list[Check]:
    """All checks that need no rollouts.

    Args:
        env: The named task on its test split.
        scenarios: Indices to check.
        on_scenario: Called after each scenario, in each of three passes over them.
    """
    indices = list(scenarios)

    def one_pass() -> Iterator[int]:
        for index in indices:
            yield index
            on_scenario()

    return [
        *check_geometry(env, one_pass()),
        *check_visibility(env, one_pass()),
        *check_accuracy(env, one_pass()),
    ]


def as_dict(certificate: Certificate) -> dict[str, Any]:
    """The certificate as plain data, for ``--json``."""
    return dataclasses.asdict(certificate)
