"""``surface``: place the flange over a mark on a panel of unknown slope and height.

A panel stands on the table, turned, tilted to any side and raised; a target is painted on it, and
small marks in a ring around it. Errors are to the surface *there*: above its target, along its
normal. In ``surface-tilted`` the panel is a flat plate. In the others it is a piece of a
fuselage's skin, a cylinder of some radius whose axis points anywhere, and the target lies beside
its crown. Marks are separate and lie on the skin: a wide flat one would stand off it. In
``surface-hard`` there are seams and rivets, the light, colours and noise of the hard tasks.

A centred disc shows a slope only by how round it looks, which is a second-order effect. A ring of
marks shows it to first order, because what leans towards the eye looks larger. Pictures from near,
or from several sides, show the slope well enough (see the certificate).

Touching the panel ends the episode.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared import robustness
from hvs_suite.tasks.shared.family import register
from hvs_suite.tasks.shared.goal import Goal
from hvs_suite.tasks.shared.panels import OFF_CENTRE_M, SIDE_M, Panels, PanelSpec
from hvs_suite.tasks.shared.placing import HARD, Placing, is_reachable
from hvs_suite.tasks.shared.robustness import Axis
from hvs_suite.tasks.shared.scenario import Scenario, Streams, towards
from hvs_suite.tasks.shared.spec import Description, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.solid import Solid
    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfaceSpec(PanelSpec):
    """Every parameter of ``surface``."""

    family: ClassVar[str] = "surface"

    ring_m: tuple[float, float] = scene((0.47, 0.70))
    target_diameter_m: float = 0.020

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        if self.marker != "disc":
            raise OptionError(f"marker is {self.marker!r}; surface's targets are discs")
        if self.start == "fixed":
            raise OptionError("start is 'fixed', where some panel would stand; use zero or random")

    def robustness_axes(self) -> tuple[Axis, ...]:
        """The target is always a disc, which may have another paint."""
        return robustness.replaced(super().robustness_axes(), robustness.target_hue())

    def describe(self) -> Description:
        """The task in words."""
        words = super().describe()
        shape = "plate"
        if self.radius_m is not None:
            low, high = self.radius_m
            shape = f"skin of {low:g}-{high:g} m radius"
        return dataclasses.replace(
            words, target=f"{words.target} in {self.n_marks} marks, on a {shape} at any slope"
        )


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceScenario(Scenario):
    """One scene.

    Attributes:
        target: Centre of the target on the skin, (3,) m, base frame.
        normal: Outward normal there, (3,).
        marks: Centres of the marks on the skin, (n, 3) m.
        mark_normals: Outward normals there, (n, 3).
        panel: Which panel of the model stands there.
        panel_position: Of its frame, (3,) m.
        panel_turn: Its rotation vector, (3,) rad.
        panel_rgb: Its colour, (3,) in [0, 1].
    """

    target: FloatArray
    normal: FloatArray
    marks: FloatArray
    mark_normals: FloatArray
    panel: int
    panel_position: FloatArray
    panel_turn: FloatArray
    panel_rgb: FloatArray


class Surface(Placing[SurfaceSpec, SurfaceScenario]):
    """One target on a panel."""

    hard: ClassVar[Mapping[str, str]] = {
        "surface-tilted": (
            "The height of the target and the slope of the panel are unknown: a place that the "
            "eye to hand sees is wrong by centimetres if it is taken to lie in the plane z = 0."
        ),
        "surface-fuselage": (
            "The skin is curved, and the marks on it are small: half a degree needs more than "
            "one look, or one from near and straight above, where the tool has to be in the "
            "end."
        ),
        "surface-hard": (
            "At 50 mm, 0.25 mm sideways are 0.29 deg of the normal, and six marks of 1.7 mm on "
            "a ring of 17 mm have to show it. One look from the goal leaves an error of "
            "degrees. It takes many looks from well to the side, and there is time for about "
            "thirty."
        ),
    }

    def build(self, cell: "Cell") -> None:
        """Attach target, marks and panels."""
        super().build(cell)
        self._panels = Panels(cell, self.spec)

    def check_reach(self) -> None:
        """Check that the arm reaches the ring, however the panel stands.

        Raises:
            OptionError: It does not.
        """
        spec = self.spec
        lean = math.radians(spec.tilt_deg[1])
        if spec.radius_m is not None:
            lean += OFF_CENTRE_M / spec.radius_m[0]
        highest = spec.raise_m[1] + SIDE_M * math.sin(math.radians(spec.tilt_deg[1]))
        for radius, angle, height in itertools.product(spec.ring_m, (-lean, lean), (0.0, highest)):
            normal = np.array([math.sin(angle), 0.0, math.cos(angle)])
            if not is_reachable(Goal(np.array([radius, 0.0, height]), normal, spec.standoff_m)):
                raise OptionError(
                    f"ring_m is {spec.ring_m}: the arm cannot face a panel that leans by "
                    f"{math.degrees(angle):.0f} deg at a radius of {radius} m; use 0.47 to 0.70 m"
                )

    def draw(self, streams: Streams) -> SurfaceScenario:
        """Draw the panel, the target on it, start and look."""
        spec = self.spec
        place = self.draw_on_ring(streams.generator("target"))
        set_up = self._panels.draw(streams.generator("panel"), place)
        goal = Goal(set_up["target"], set_up["normal"], spec.standoff_m)
        solid = self._panels.solid(set_up["panel"], set_up["panel_position"], set_up["panel_turn"])
        return SurfaceScenario(
            panel_rgb=self._draw_paint(streams),
            **set_up,
            **self.draw_common(streams, goal, solids=(solid,)),
        )

    def _draw_paint(self, streams: Streams) -> FloatArray:
        """Colour of the panel: primer, or anything pale where colours vary."""
        random, primer = streams.generator("paint"), np.array([0.70, 0.72, 0.66])
        if not self.spec.vary_colour:
            return primer
        paint = np.clip(random.uniform(0.4, 0.9) + random.uniform(-0.08, 0.08, 3), 0, 1)
        return np.asarray(np.clip(towards(primer, paint, self.spec.colour_strength), 0, 1))

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up target, marks and panels in the compiled model."""
        super().after_compile(physics)
        self._panels.after_compile(physics)

    def begin(self, physics: "mjcf.Physics", scenario: SurfaceScenario) -> None:
        """Set up the panel, and lay target and marks on its skin."""
        super().begin(physics, scenario)
        index, position, turn = scenario.panel, scenario.panel_position, scenario.panel_turn
        self._panels.set_up(physics, index, position, turn, scenario.panel_rgb)
        self._panels.lay_marks(physics, scenario.marks, scenario.mark_normals)
        self._goal = Goal(scenario.target, scenario.normal, self.spec.standoff_m)
        self._solids = (self._panels.solid(index, position, turn),)
        self.put_marker(physics, self._goal)

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over the target, at any time."""
        return self._goal

    def obstacles(self) -> "tuple[Solid, ...]":
        """The panel and its post."""
        return self._solids

    @classmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """Reachable, in time and observable; the marks show slope and place well enough."""
        from hvs_suite.tasks.shared import certificate
        from hvs_suite.tasks.shared.certificate_slope import check_slope
        from hvs_suite.tasks.shared.pattern_pose import Ring

        spec = env.task.family.spec
        ring = Ring(spec.mark_ring_m, spec.n_marks, spec.sag_m)
        return [
            *certificate.check_geometry(env, scenarios),
            *certificate.check_visibility(env, scenarios),
            *check_slope(env, scenarios, ring),
        ]


_TILTED = SurfaceSpec(name="surface-tilted", hold_steps=3, time_limit_steps=40, eth_resolution=336)
_FUSELAGE = dataclasses.replace(
    _TILTED,
    name="surface-fuselage",
    radius_m=(1.5, 3.0),
    n_marks=8,
    target_diameter_m=0.016,
    mark_diameter_m=0.003,
    mark_ring_m=0.016,
    position_tolerance_mm=0.5,
    tilt_tolerance_deg=0.5,
)
_HARD = dataclasses.replace(
    _FUSELAGE,
    name="surface-hard",
    start="random",
    position_tolerance_mm=0.25,
    hold_steps=5,
    time_limit_steps=60,
    n_marks=6,
    target_diameter_m=0.011,
    mark_diameter_m=0.0017,
    mark_ring_m=0.0085,
    seams=True,
    # Small enough that the slope needs many looks, from the side; and to be seen from afar at all:
    **{**HARD, "eth_resolution": 512},
)

register(Surface, _TILTED, _FUSELAGE, _HARD)
