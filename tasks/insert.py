"""``insert``: bring a peg on the flange into a bushing, without pressing too hard.

A peg of 10 mm, held by a compliant arm, has to go 12 mm deep into a hole that is wider by a few
tenths of a millimetre. The tip may touch the bushing and nothing else; what it presses with, after
a low-pass of 50 Hz, must not go beyond a limit in any physics step: that ends the episode like a
collision, and is called an overload.

In ``insert-feel`` the hole is not quite where the paint says. No picture shows that, so the last
millimetre has to be felt: by the wrench at the flange, and by where the tip stops. **The expert of
that variant knows the hole**, which no learner can see, and goes straight in. The demonstrator does
what a learner can do with what it sees: it presses gently where the paint says. A policy that
imitates it has to learn the search by itself.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.family import GOAL_UNSEEN, Family, Progress, register
from hvs_suite.tasks.shared.goal import (
    HEIGHT,
    LATERAL,
    TILT,
    UP,
    Goal,
    Keypoint,
    Tip,
    goal_errors,
)
from hvs_suite.tasks.shared.metric import Metric
from hvs_suite.tasks.shared.peg_and_bushing import WRENCH, PegAndBushing, PegSpec
from hvs_suite.tasks.shared.placing import HARD, is_reachable, point_on_ring
from hvs_suite.tasks.shared.scenario import Scenario, Streams
from hvs_suite.tasks.shared.spec import Description, VectorObservation, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

DEPTH = "depth_error_mm"
PEAK_FORCE = "peak_force_n"
LIFT_M = 0.050
"""How far above the mouth the tip comes from (m): the peg does not hide the bushing yet."""
_IN_HOLE_MM = 0.1
"""A tip is in the hole where it is off by the clearance and so much for tilt and give."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InsertSpec(PegSpec):
    """Every parameter of ``insert``.

    Attributes:
        goal_depth_m: How deep the tip shall be (m).
        depth_tolerance_mm: By how much it may miss that (mm).
        tilt_tolerance_deg: Bound on the angle between peg and hole.
        force_limit_n: Largest contact force (N).
        hole_noise_mm: Standard deviation of where the hole is off its paint (mm a direction), cut
            at two sigma.
        force_noise_n: Standard deviation of the noise on measured forces (N).
        torque_noise_nm: Standard deviation of the noise on measured torques (Nm).
    """

    family: ClassVar[str] = "insert"
    headline: ClassVar[tuple[str, ...]] = (DEPTH, PEAK_FORCE)
    further_privileged: ClassVar[Mapping[str, tuple[str, ...]]] = {GOAL_UNSEEN: ("x", "y", "z")}
    plays_on: ClassVar[bool] = False

    goal_depth_m: float = 0.013
    depth_tolerance_mm: float = 1.0
    tilt_tolerance_deg: float = 1.0
    force_limit_n: float = 80.0
    hole_noise_mm: float = scene(0.0)
    force_noise_n: float = 0.3
    torque_noise_nm: float = 0.01

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        self._check_positive("depth_tolerance_mm", "tilt_tolerance_deg", "force_limit_n")
        self._check_not_negative("hole_noise_mm", "force_noise_n", "torque_noise_nm")
        if not 0.0 < self.goal_depth_m < min(self.hole_depth_m, self.peg_length_m):
            raise OptionError(
                f"goal_depth_m is {self.goal_depth_m}; it must be positive, and less than the "
                "depth of the hole and the length of the peg"
            )

    @property
    def look_from_m(self) -> float:
        """High enough that the peg does not hide the bushing."""
        return LIFT_M

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """Missing depth, lateral and tilt error at each step's end; the largest force so far."""
        lateral_mm = self.clearance_mm + _IN_HOLE_MM
        return (
            Metric(DEPTH, "mm", "missing depth", self.depth_tolerance_mm),
            Metric(LATERAL, "mm", "lateral error", lateral_mm),
            Metric(TILT, "deg", "tilt error", self.tilt_tolerance_deg),
            Metric(PEAK_FORCE, "N", "peak force", self.force_limit_n, "episode", is_limit=True),
        )

    @property
    def further_observations(self) -> dict[str, VectorObservation]:
        """Force (N) and torque (Nm) on the tool at the flange, flange axes."""
        noise = 3 * (self.force_noise_n,) + 3 * (self.torque_noise_nm,)
        names = ("fx", "fy", "fz", "tx", "ty", "tz")
        return {WRENCH: VectorObservation(names, -200.0, 200.0, noise)}

    @property
    def needed_depth_mm(self) -> float:
        """How deep the tip has to be at least (mm)."""
        return 1000.0 * self.goal_depth_m - self.depth_tolerance_mm

    def instruction(self, scenario: Scenario | None = None) -> str:
        """The task as one sentence."""
        return (
            f"Insert the peg {self.needed_depth_mm:.0f} mm deep into the bushing, without pressing "
            f"harder than {self.force_limit_n:.0f} N."
        )

    def describe(self) -> Description:
        """The task in words."""
        words = super().describe()
        others = [] if words.disturbances == "-" else [words.disturbances]
        if self.hole_noise_mm:
            others.append(f"hole off its paint by {self.hole_noise_mm:g} mm a direction")
        return dataclasses.replace(
            words,
            target=f"bushing for a {1000 * self.peg_diameter_m:.0f} mm peg, "
            f"{self.clearance_mm:g} mm wider a side, {self.chamfer_mm:g} mm chamfer",
            tolerance=f"{self.needed_depth_mm:g} mm deep, {self.tilt_tolerance_deg:g} deg, "
            f"at most {self.force_limit_n:g} N",
            disturbances=", ".join(others) or "-",
        )


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class InsertScenario(Scenario):
    """One scene.

    Attributes:
        target: Where the paint says the hole is, on the surface below it, (3,) m, base frame.
        hole_offset: Displacement of the hole from its paint, (2,) m; it cannot be seen.
    """

    target: FloatArray
    hole_offset: FloatArray


class Insert(Family[InsertSpec, InsertScenario]):
    """A peg that goes into one bushing.

    Raises:
        OptionError: The arm cannot lift the tool over the bushing.
    """

    hard: ClassVar[Mapping[str, str]] = {
        "insert-wide": (
            "The arm is compliant and trails its set point, the peg hides the hole in the last "
            "millimetres, and the tip may touch nothing but the bushing."
        ),
        "insert-jig": (
            "Clearance and chamfer catch the tip within 0.7 mm, but small encoder errors, "
            "light, colours and noise disturb what is measured, and the arm may start anywhere."
        ),
        "insert-feel": (
            "The hole is displaced from its paint by half a millimetre a direction, which no "
            "picture shows. A policy has to find it by the wrench and by where the tip stops, "
            "gently and in time. The demonstrations do not show how: they press where the paint "
            "says."
        ),
    }
    certificate_passes: ClassVar[int] = 4

    def build(self, cell: "Cell") -> None:
        """Add the bushing with its hole, and the sensors of what the peg presses with."""
        self._check_reach()
        self._peg = PegAndBushing(cell, self.spec)

    def _check_reach(self) -> None:
        embodiment = self.spec.embodiment
        for radius in self.spec.ring_m:
            mouth = np.array([radius, 0.0, self.spec.top_m])
            if not all(
                is_reachable(Goal(mouth, UP, height), embodiment)
                for height in (LIFT_M, -self.spec.goal_depth_m)
            ):
                raise OptionError(
                    f"peg_length_m is {self.spec.peg_length_m} and ring_m {self.spec.ring_m}: the "
                    f"arm cannot lift the peg over a bushing at a radius of {radius} m; use a "
                    "shorter peg, or radii nearer to 0.6 m"
                )

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up the bushing and what is felt."""
        self._peg.after_compile(physics)
        self.marker_geom = self._peg.marker_geom

    def draw(self, streams: Streams) -> InsertScenario:
        """Draw where the bushing stands, how far the hole is off, start and look."""
        spec = self.spec
        place = np.array([*point_on_ring(spec.ring_m, streams.generator("target")), 0.0])
        offset = 0.001 * spec.hole_noise_mm * streams.cut_normal("hole", 2)
        above = Goal(place + np.append(offset, spec.top_m), UP, LIFT_M)
        return InsertScenario(target=place, hole_offset=offset, **self.draw_common(streams, above))

    def begin(self, physics: "mjcf.Physics", scenario: InsertScenario) -> None:
        """Put the bushing where it stands, and its hole where that is."""
        super().begin(physics, scenario)
        hole = scenario.target + np.append(scenario.hole_offset, 0.0)
        self._peg.begin(physics, scenario.target, hole)
        self._goal = Goal(hole + self.spec.top_m * UP, UP, -self.spec.goal_depth_m)

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """In the hole itself, at any time."""
        return self._goal

    def measure(self, tip: Tip) -> dict[str, float]:
        """How much depth is missing, and how far the tip is off the hole's axis."""
        errors = goal_errors(tip, self._goal)
        return {
            DEPTH: max(errors[HEIGHT], 0.0),
            LATERAL: errors[LATERAL],
            TILT: errors[TILT],
        }

    def tally(
        self, physics: "mjcf.Physics", errors: Mapping[str, float], progress: Progress
    ) -> dict[str, float]:
        """The largest force so far."""
        return {PEAK_FORCE: self._peg.peak_n}

    def at_reset(self) -> dict[str, float]:
        """No force yet."""
        return {PEAK_FORCE: 0.0}

    def is_forbidden(self, physics: "mjcf.Physics") -> bool:
        """Whether something else than peg and bushing touches, or these too hard."""
        self._peg.feel(physics)
        return self._peg.peak_n > self.spec.force_limit_n or self._peg.touches_else(physics)

    def keypoints(self) -> dict[str, Keypoint]:
        """The middle of the painted face."""
        centre = self.scenario.target + self.spec.top_m * UP
        return {"target": Keypoint(centre, UP, self.spec.target_diameter_m)}

    def observe(self, physics: "mjcf.Physics") -> dict[str, FloatArray]:
        """What the tool feels."""
        return {WRENCH: self._peg.wrench(physics)}

    def privileged(self) -> dict[str, FloatArray]:
        """How far the hole is off its paint, (3,) m, base frame."""
        return {GOAL_UNSEEN: np.append(self.scenario.hole_offset, 0.0)}

    @classmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """Reachable, in time, observable, accurate; and what has to be found by feel."""
        from hvs_suite.tasks.shared import certificate
        from hvs_suite.tasks.shared import certificate_insert as insertion

        return [
            *certificate.check_geometry(env, scenarios),
            # The arm often hides half of so small a thing, and then its middle is estimated
            # wrongly.
            *certificate.check_visibility(env, scenarios, needed_share=95.0),
            *insertion.check_sight(env, scenarios),
            *insertion.check_feeling(env, scenarios),
        ]


# At 112 px the eye to hand would show no more than two pixels of a bushing.
_WIDE = InsertSpec(name="insert-wide", time_limit_steps=80, eth_resolution=224)

register(
    Insert,
    _WIDE,
    dataclasses.replace(
        _WIDE,
        name="insert-jig",
        start="random",
        time_limit_steps=100,
        clearance_mm=0.2,
        chamfer_mm=0.5,
        force_limit_n=60.0,
        joint_offset_deg=0.02,
        **HARD,
    ),
    dataclasses.replace(
        _WIDE,
        name="insert-feel",
        time_limit_steps=65,
        clearance_mm=0.1,
        chamfer_mm=0.2,
        force_limit_n=40.0,
        hole_noise_mm=0.5,
    ),
)
