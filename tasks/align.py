"""``align``: hold the flange over a target, facing it, at a set distance, within tolerance.

The thesis's task with its defects removed. The target is one marker on the work surface, which is
level in the named tasks and tilted or curved in studies. Episodes may go on past the goal, to show
where a policy settles.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.family import register
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.placing import HARD, Placing, PlacingSpec, is_reachable
from hvs_suite.tasks.shared.scenario import Scenario, Streams
from hvs_suite.tasks.shared.spec import Description, in_words, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.surface import Surface

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlignSpec(PlacingSpec):
    """Every parameter of ``align``: place the flange over a marker, facing it, at a set distance.

    Attributes:
        goal: ``random`` on the ring, uniform in area; ``fixed``, one place drawn once per split;
            ``places``, the ten places of ``align-fixed``, by index; or ``(x, y)`` (m, base frame).
        surface: Shape of the work surface.
        surface_size_m: Side lengths of the surface (m).
    """

    family: ClassVar[str] = "align"

    goal: Literal["random", "fixed", "places"] | tuple[float, float] = scene("random")
    surface: Literal["flat", "tilted", "curved"] = scene("flat")
    surface_size_m: tuple[float, float] = (2.0, 2.0)

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        if not min(self.surface_size_m) > 0:
            raise OptionError(f"surface_size_m is {self.surface_size_m}; both sides are positive")
        if isinstance(self.goal, tuple) and not math.hypot(*self.goal) > 0.1:
            raise OptionError(
                f"goal {self.goal} lies under the robot's base; move it at least 0.1 m away"
            )

    def describe(self) -> Description:
        """The task in words."""
        words = super().describe()
        return dataclasses.replace(words, target=f"{in_words(self.goal)}, {words.target}")


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class AlignScenario(Scenario):
    """One scene.

    Attributes:
        target: Centre of the target on the surface, (3,) m, base frame.
        normal: Outward surface normal there, (3,).
    """

    target: FloatArray
    normal: FloatArray


class Align(Placing[AlignSpec, AlignScenario]):
    """One still target.

    Raises:
        OptionError: A goal that was asked for is out of reach.
    """

    hard: ClassVar[Mapping[str, str]] = {
        "align-fixed": (
            "Nothing: ten places, a known start, and wide tolerances. It shows whether a policy "
            "learns at all."
        ),
        "align-easy": (
            "The target may lie anywhere on the ring, so a policy has to find it in the "
            "pictures; the upright arm hides some targets from the eye to hand."
        ),
        "align-thesis": (
            "The tolerance is a millimetre, but a pixel of the eye to hand covers eight: the "
            "last part of the way has to be servoed with the eye in the hand."
        ),
        "align-hard": (
            "Light, colours and texture change, the eye to hand stands up to a centimetre and a "
            "degree from its nominal pose, and the arm may start anywhere: the eye to hand "
            "shows only roughly where the target is."
        ),
        "align-drill": (
            "A quarter of a millimetre over a small disc, held for five steps. Encoders have "
            "errors of up to a tenth of a degree and commands act a step late, so neither the "
            "joints nor the last picture are precise enough alone."
        ),
        "align-limit": (
            "A tenth of a millimetre and a fifth of a degree: the limit of what the controller "
            "and the pictures allow without disturbances."
        ),
    }

    def surface(self) -> "Surface":
        """The surface that the spec names."""
        from hvs_suite.cell.surface import Surface

        self._surface = Surface(shape=self.spec.surface, size_m=self.spec.surface_size_m)
        return self._surface

    def check_reach(self) -> None:
        """Check a goal that was asked for, or the ring of a level surface."""
        goal = self.spec.goal
        if isinstance(goal, tuple) and not is_reachable(self.goal_over(*goal)):
            raise OptionError(
                f"goal {goal} is out of the arm's reach, {self.spec.standoff_m} m off the "
                "surface; choose a radius from 0.40 to 0.78 m"
            )
        if goal == "random" and self.spec.surface == "flat":
            super().check_reach()

    def goal_over(self, x: float, y: float) -> Goal:
        """The goal over a point of the base plane (m)."""
        target = np.array([x, y, self._surface.height(x, y)])
        return Goal(target, self._surface.normal(x, y), self.spec.standoff_m)

    def draw(self, streams: Streams) -> AlignScenario:
        """Draw target, start and look."""
        goal = self._draw_goal(streams)
        # The plane through the origin that the whole surface lies in or below.
        floor_normal = np.asarray(self._surface.normal(0.0, 0.0))
        common = self.draw_common(streams, goal, floor_normal)
        return AlignScenario(target=goal.target, normal=goal.normal, **common)

    def _draw_goal(self, streams: Streams) -> Goal:
        asked = self.spec.goal
        if isinstance(asked, tuple):
            return self.goal_over(*asked)
        if asked == "places":
            places = fixed_places(*self.spec.ring_m)
            return self.goal_over(*places[streams.index % len(places)])
        # "fixed" is drawn once a split: from a stream of its own that ignores the index.
        stream = f"target-{asked}"
        random = streams.generator(stream) if asked == "random" else streams.once(stream)
        for _ in range(1000):
            goal = self.goal_over(*self.draw_on_ring(random))
            # The ring is what the arm reaches over a flat surface; others lie partly lower.
            if self.spec.surface == "flat" or is_reachable(goal):
                return goal
        raise OptionError(f"no target within reach found for scenario {streams.index}")

    def begin(self, physics: "mjcf.Physics", scenario: AlignScenario) -> None:
        """Lay the marker on the target."""
        super().begin(physics, scenario)
        self._goal = Goal(scenario.target, scenario.normal, self.spec.standoff_m)
        self.put_marker(physics, self._goal)

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over the target, at any time."""
        return self._goal


@functools.cache
def fixed_places(inner: float, outer: float) -> tuple[tuple[float, float], ...]:
    """The ten places of ``align-fixed``: a golden-angle spiral, even in area over the ring (m)."""
    places = []
    for i in range(10):
        radius = math.sqrt(inner**2 + (i + 0.5) / 10 * (outer**2 - inner**2))
        azimuth = 0.5 + i * math.pi * (3.0 - math.sqrt(5.0))
        places.append((radius * math.cos(azimuth), radius * math.sin(azimuth)))
    return tuple(places)


_THESIS = AlignSpec(name="align-thesis", position_tolerance_mm=1.0, tilt_tolerance_deg=1.0)

_HARD = dataclasses.replace(
    _THESIS,
    name="align-hard",
    start="random",
    target_diameter_m=0.020,
    position_tolerance_mm=0.5,
    tilt_tolerance_deg=0.5,
    hold_steps=3,
    time_limit_steps=40,
    **HARD,
)

register(
    Align,
    dataclasses.replace(
        _THESIS,
        name="align-fixed",
        goal="places",
        position_tolerance_mm=5.0,
        tilt_tolerance_deg=5.0,
    ),
    dataclasses.replace(
        _THESIS, name="align-easy", position_tolerance_mm=5.0, tilt_tolerance_deg=5.0
    ),
    _THESIS,
    _HARD,
    dataclasses.replace(
        _HARD,
        name="align-drill",
        target_diameter_m=0.010,
        position_tolerance_mm=None,
        lateral_tolerance_mm=0.25,
        height_tolerance_mm=1.0,
        tilt_tolerance_deg=0.4,
        hold_steps=5,
        eih_resolution=224,
        eth_resolution=512,
        joint_offset_deg=0.05,
        latency_steps=1,
    ),
    dataclasses.replace(
        _THESIS,
        name="align-limit",
        start="random",
        target_diameter_m=0.020,
        position_tolerance_mm=None,
        lateral_tolerance_mm=0.1,
        height_tolerance_mm=0.3,
        tilt_tolerance_deg=0.2,
        hold_steps=5,
        time_limit_steps=40,
        eih_resolution=224,
        eth_resolution=336,
        eih_fov_deg=60.0,
    ),
)
