"""The common part of families that place the tool over a marker, facing it, at a distance.

The marker is one small thing on the work surface, drawn within the ring that the arm reaches. What
is measured is where the tool's tip stands over it and how far its axis is from the normal there.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from hvs_suite.embodiment import BARE_ARM, Embodiment
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared import robustness
from hvs_suite.tasks.shared.family import Family
from hvs_suite.tasks.shared.goal import (
    HEIGHT,
    LATERAL,
    POSITION,
    TILT,
    UP,
    Goal,
    Keypoint,
    Tip,
    goal_errors,
)
from hvs_suite.tasks.shared.metric import Metric
from hvs_suite.tasks.shared.robustness import Axis
from hvs_suite.tasks.shared.scenario import Scenario
from hvs_suite.tasks.shared.spec import Description, Spec, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

DETOUR_RAD = 1.2
"""A joint turns farther than this only where the arm has to take another shape."""

HARD: Mapping[str, Any] = MappingProxyType(
    {
        # A small disc leaves margin in a narrower view, which shows it larger.
        "eih_fov_deg": 60.0,
        "eth_resolution": 336,
        # Wide enough for the ring when the camera is turned by the largest disturbance.
        "eth_fov_deg": 33.0,
        "vary_light": True,
        "vary_colour": True,
        "vary_texture": True,
        # Cut at two sigma: up to 1 cm and 1 deg a direction.
        "eth_position_noise_m": 0.005,
        "eth_rotation_noise_deg": 0.5,
        "image_noise": 4.0,
    }
)
"""What the hard variants of all families disturb, and the cameras that they are seen with."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RingSpec(Spec):
    """Parameters of tasks whose target is one round thing on the ring that the arm reaches.

    Attributes:
        ring_m: Inner and outer radius of the ring of targets (m).
        target_diameter_m: Diameter of the target (m).
    """

    ring_m: tuple[float, float] = scene((0.40, 0.78))
    target_diameter_m: float = 0.050

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        self._check_positive("target_diameter_m")
        if not 0.0 < self.ring_m[0] < self.ring_m[1]:
            raise OptionError(f"ring_m is {self.ring_m}; use an inner and a larger outer radius")

    @property
    def reach_m(self) -> float:
        """Outer radius of the ring (m)."""
        return self.ring_m[1]

    @property
    def target_size_m(self) -> float:
        """Diameter of the target (m)."""
        return self.target_diameter_m

    def robustness_axes(self) -> tuple[Axis, ...]:
        """The common ones, and the target's size."""
        return (*super().robustness_axes(), robustness.target_size(self.target_diameter_m))

    @property
    def look_from_m(self) -> float:
        """How far above the target the tip is where the eye in the hand sees it best (m)."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlacingSpec(RingSpec):
    """Parameters of placing the flange over a marker.

    Attributes:
        marker: Picture on the target.
        standoff_m: Distance from surface to flange face at the goal (m).
        position_tolerance_mm: Bound on the norm of the position error, or None where each
            component has its own bound.
        lateral_tolerance_mm: Bound on the error in the target plane, or None.
        height_tolerance_mm: Bound on the error along the normal, or None.
        tilt_tolerance_deg: Bound on the angle between flange axis and inward surface normal.
    """

    headline: ClassVar[tuple[str, ...]] = (POSITION, TILT)

    marker: Literal["disc", "ring", "fiducial"] = "disc"
    standoff_m: float = scene(0.050)
    position_tolerance_mm: float | None = 1.0
    lateral_tolerance_mm: float | None = None
    height_tolerance_mm: float | None = None
    tilt_tolerance_deg: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        self._check_positive("standoff_m", "tilt_tolerance_deg")
        for name in ("position_tolerance_mm", "lateral_tolerance_mm", "height_tolerance_mm"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise OptionError(f"{name} is {value}; it must be positive, or None for no bound")
        if self.position_tolerance_mm is None and None in (
            self.lateral_tolerance_mm,
            self.height_tolerance_mm,
        ):
            raise OptionError(
                "give position_tolerance_mm, or both lateral_tolerance_mm and height_tolerance_mm"
            )

    def robustness_axes(self) -> tuple[Axis, ...]:
        """The ring's, with another kind of marker."""
        return robustness.replaced(super().robustness_axes(), robustness.unseen_marker())

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """Position, lateral, height and tilt error at the end of each control step."""
        return (
            Metric(POSITION, "mm", "position error", self.position_tolerance_mm),
            Metric(LATERAL, "mm", "lateral error", self.lateral_tolerance_mm),
            Metric(HEIGHT, "mm", "height error", self.height_tolerance_mm),
            Metric(TILT, "deg", "tilt error", self.tilt_tolerance_deg),
        )

    @property
    def look_from_m(self) -> float:
        """At the goal."""
        return self.standoff_m

    @property
    def landing_metric(self) -> Metric | None:
        """The lateral error where it has a bound of its own, else the position error."""
        position, lateral, *_ = self.metrics
        return position if lateral.bound is None else lateral

    def describe(self) -> Description:
        """The task in words."""
        parts = []
        if self.position_tolerance_mm is not None:
            parts.append(f"{self.position_tolerance_mm:g} mm")
        if self.lateral_tolerance_mm is not None:
            parts.append(f"{self.lateral_tolerance_mm:g} mm sideways")
        if self.height_tolerance_mm is not None:
            parts.append(f"{self.height_tolerance_mm:g} mm in height")
        return dataclasses.replace(
            super().describe(),
            target=f"{self.target_diameter_m * 1000:.0f} mm {self.marker}",
            tolerance=", ".join([*parts, f"{self.tilt_tolerance_deg:g} deg"]),
        )

    def instruction(self, scenario: Scenario | None = None) -> str:
        """The task as one sentence, identical in environment and dataset."""
        return (
            f"Place the flange centred over the target, facing it, "
            f"{self.standoff_m * 1000:.0f} mm above the surface."
        )


class Placing[S: PlacingSpec, C: Scenario](Family[S, C]):
    """One marker, whose place is the goal; families say where it is and how it moves."""

    def build(self, cell: "Cell") -> None:
        """Attach the marker, a mocap body, to the cell; check what was asked for against it.

        Raises:
            OptionError: A goal that was asked for is out of reach.
        """
        from hvs_suite.cell.marker import Marker

        self.check_reach()
        self.marker = Marker(kind=self.spec.marker, diameter_m=self.spec.target_diameter_m)
        cell.add_marker(self.marker)

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up the marker in the compiled model."""
        self.marker_geom = int(physics.bind(self.marker.geom).element_id)
        self._mocap = int(physics.model.body_mocapid[physics.model.geom_bodyid[self.marker_geom]])

    def put_marker(self, physics: "mjcf.Physics", goal: Goal) -> None:
        """Lay the marker where a goal's target is."""
        import mujoco

        from hvs_suite.cell.marker import orientation

        model, data = physics.model.ptr, physics.data.ptr
        data.mocap_pos[self._mocap] = goal.target
        data.mocap_quat[self._mocap] = orientation(goal.normal)
        # The next picture shows the bodies where they were last computed.
        mujoco.mj_kinematics(model, data)

    def measure(self, tip: Tip) -> dict[str, float]:
        """Errors of the tip to the present goal; see `goal_errors`."""
        return goal_errors(tip, self.goal())

    def keypoints(self) -> dict[str, Keypoint]:
        """The centre of the marker's face."""
        from hvs_suite.cell.marker import HALF_THICKNESS_M

        goal = self.goal()
        centre = goal.target + goal.normal * 2.0 * HALF_THICKNESS_M
        return {"target": Keypoint(centre, goal.normal, self.spec.target_diameter_m)}

    def draw_on_ring(self, random: np.random.Generator) -> tuple[float, float]:
        """Draw a point of the ring, uniform in area (m, base frame)."""
        return point_on_ring(self.spec.ring_m, random)

    def goal_over(self, x: float, y: float) -> Goal:
        """The goal over a point of the level surface (m, base frame)."""
        return Goal(np.array([x, y, 0.0]), UP, self.spec.standoff_m)

    def check_reach(self) -> None:
        """Check that all goals are within reach: the whole ring, over the level surface.

        Raises:
            OptionError: It is not.
        """
        for radius in self.spec.ring_m:
            if not is_reachable(self.goal_over(radius, 0.0)):
                raise OptionError(
                    f"ring_m is {self.spec.ring_m}: the arm cannot face the surface at a radius of "
                    f"{radius} m, {self.spec.standoff_m} m off it; use radii from 0.40 to 0.78 m"
                )

    @classmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """Reachable, in time, observable and accurate."""
        from hvs_suite.tasks.shared import certificate

        return [
            *certificate.check_geometry(env, scenarios),
            *certificate.check_visibility(env, scenarios),
            *certificate.check_accuracy(env, scenarios),
        ]


def point_on_ring(ring_m: tuple[float, float], random: np.random.Generator) -> tuple[float, float]:
    """Draw a point of a ring, given by its radii, uniform in area (m, base frame)."""
    inner, outer = ring_m
    radius = math.sqrt(random.uniform(inner**2, outer**2))
    azimuth = random.uniform(-math.pi, math.pi)
    return radius * math.cos(azimuth), radius * math.sin(azimuth)


def is_reachable(goal: Goal, embodiment: Embodiment = BARE_ARM) -> bool:
    """Whether the tip can be at a goal within the joint ranges."""
    from hvs_suite.cell.kinematics import kinematics

    found = kinematics(embodiment).goal_configurations_at_tool_angle(
        goal.position, goal.normal, 0.0
    )
    return bool(len(found))


def are_near(q: FloatArray, *goals: Goal, embodiment: Embodiment = BARE_ARM) -> bool:
    """Whether short motions lead from joint angles to one goal after the other.

    Args:
        q: Joint angles, (7,) rad.
        goals: Where to go.
        embodiment: What the arm carries.
    """
    from hvs_suite.cell.kinematics import kinematics
    from hvs_suite.cell.robot import JOINT_ACCELERATION_RAD_S2

    for goal in goals:
        there = kinematics(embodiment).nearest_configuration(
            q, goal.position, goal.normal, JOINT_ACCELERATION_RAD_S2
        )
        if there is None or np.abs(there - q).max() > DETOUR_RAD:
            return False
        q = there
    return True
