"""``surface``: place the flange over a mark on a panel whose slope and height have to be seen.

A panel stands on the table, turned, tilted to any side and raised; a target is painted on it, and
small marks in a ring around it. Errors are to the surface *there*: above its target, along its
normal. In ``surface-tilted`` the panel is a flat plate. In the others it is a piece of a
fuselage's skin, a cylinder of some radius whose axis points anywhere, and the target lies beside
its crown. Marks are separate and lie on the skin: a wide flat one would stand off it. In
``surface-hard`` there are seams and rivets, the light, colours and noise of the hard tasks.

A centred disc tells a slope only by how round it looks: to the second order. A ring of marks tells
it to the first: what leans towards the eye looks larger. Whoever comes near, or looks from several
sides, sees it well enough (see the certificate).

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
from hvs_suite.tasks.shared.placing import HARD, UP, Placing, PlacingSpec, is_reachable
from hvs_suite.tasks.shared.robustness import Axis
from hvs_suite.tasks.shared.scenario import Scenario, Streams, draw_look, towards
from hvs_suite.tasks.shared.spec import Description, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.panel import Panel
    from hvs_suite.cell.solid import Solid
    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

SIDE_M = 0.24
"""Of a panel: none comes near the base, wherever on the ring its target lies."""
OFF_CENTRE_M = 0.05
"""How far from the middle of its panel a target may lie, along either side (m)."""
N_PANELS = 16
"""Curved panels in the model, evenly spaced in curvature; a scene sets up one of them."""
MARK_HALF_THICKNESS_M = 0.00004
"""Of the marks (m): on thicker ones the eye would see the sides as well."""
MAX_TILT_DEG = 20.0
MAX_RAISE_M = 0.15


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfaceSpec(PlacingSpec):
    """Every parameter of ``surface``.

    Attributes:
        tilt_deg: Least and largest tilt of a panel (deg).
        raise_m: Least and largest distance of its lowest point from the table (m).
        radius_m: Least and largest radius of its skin (m); None for flat plates.
        seams: Whether seams, rivets and stains are on it.
        n_marks: Marks around the target.
        mark_diameter_m: Their diameter (m).
        mark_ring_m: Radius of the ring that they lie on (m).
    """

    family: ClassVar[str] = "surface"

    ring_m: tuple[float, float] = scene((0.47, 0.70))
    target_diameter_m: float = 0.020
    tilt_deg: tuple[float, float] = scene((0.0, 15.0))
    raise_m: tuple[float, float] = scene((0.0, 0.08))
    radius_m: tuple[float, float] | None = scene(None)
    seams: bool = False
    n_marks: int = 8
    mark_diameter_m: float = 0.005
    mark_ring_m: float = scene(0.025)

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
        for name, most in (("tilt_deg", MAX_TILT_DEG), ("raise_m", MAX_RAISE_M)):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= most:
                raise OptionError(f"{name} is {(low, high)}; use a least and a larger up to {most}")
        if self.radius_m is not None and not 0.5 <= self.radius_m[0] <= self.radius_m[1]:
            raise OptionError(f"radius_m is {self.radius_m}; use a least from 0.5 m and a larger")
        if not 3 <= self.n_marks <= 24:
            raise OptionError(f"n_marks is {self.n_marks}; use 3 to 24, fewer show no slope")
        self._check("must be positive", lambda value: value > 0, "mark_diameter_m")
        outer = self.mark_ring_m + 0.5 * self.mark_diameter_m
        if not self.mark_ring_m > 0.5 * (self.target_diameter_m + self.mark_diameter_m):
            raise OptionError(f"mark_ring_m is {self.mark_ring_m}: the marks overlap the target")
        if outer + OFF_CENTRE_M > 0.5 * SIDE_M:
            raise OptionError(f"mark_ring_m is {self.mark_ring_m}: the marks leave the panel")
        if 2.0 * self.mark_ring_m * math.sin(math.pi / self.n_marks) <= self.mark_diameter_m:
            raise OptionError(f"n_marks is {self.n_marks}: so many overlap; use fewer, or smaller")

    @property
    def sag_m(self) -> float:
        """How far the marks lie below the plane that touches the skin at the target (m).

        On the average over the ring and over the radii: they do so across the cylinder's axis, by
        r^2 / 2R, and not at all along it.
        """
        if self.radius_m is None:
            return 0.0
        return 0.25 * self.mark_ring_m**2 * 0.5 * sum(1.0 / radius for radius in self.radius_m)

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
            "Nobody tells how high the target lies, nor which way the panel leans: a place that "
            "the eye to hand sees is off by centimetres, and the plane z = 0 means nothing."
        ),
        "surface-fuselage": (
            "The skin is curved, and the marks on it are small: half a degree takes more than one "
            "look, or one from near and straight above, where the tool has to be in the end."
        ),
        "surface-hard": (
            "At 50 mm, 0.25 mm sideways are 0.29 deg of the normal, told by six marks of 1.7 mm "
            "on a ring of 17 mm: one look from the goal leaves degrees. It takes many, from well "
            "to the side, and there is time for about thirty."
        ),
    }

    def build(self, cell: "Cell") -> None:
        """Attach target, marks and panels."""
        from hvs_suite.cell.marker import Marker

        super().build(cell)
        spec = self.spec
        self._marks = [
            Marker(
                diameter_m=spec.mark_diameter_m,
                name=f"mark-{number}",
                half_thickness_m=MARK_HALF_THICKNESS_M,
            )
            for number in range(spec.n_marks)
        ]
        for mark in self._marks:
            cell.add_marker(mark)
        self._panels = self._make_panels()
        for panel in self._panels:
            cell.add_prop(panel)

    def _make_panels(self) -> "list[Panel]":
        from hvs_suite.cell.panel import Panel

        spec = self.spec
        curvatures = [0.0]
        if spec.radius_m is not None:
            low, high = spec.radius_m
            curvatures = np.linspace(1.0 / high, 1.0 / low, N_PANELS).tolist()
        return [
            Panel(f"panel-{number}", SIDE_M, curvature, number if spec.seams else None)
            for number, curvature in enumerate(curvatures)
        ]

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
        from scipy.spatial.transform import Rotation

        from hvs_suite.tasks.shared.start import draw_start

        spec = self.spec
        place = self.draw_on_ring(streams.generator("target"))
        random = streams.generator("panel")
        index = int(random.integers(len(self._panels)))
        panel = self._panels[index]
        yaw, towards, around = random.uniform(-math.pi, math.pi, 3)
        tilt = math.radians(random.uniform(*spec.tilt_deg))
        lean = Rotation.from_rotvec([tilt * math.cos(towards), tilt * math.sin(towards), 0.0])
        turn = lean * Rotation.from_rotvec(yaw * UP)
        x, y = random.uniform(-OFF_CENTRE_M, OFF_CENTRE_M, 2)
        angles = around + 2.0 * math.pi * np.arange(spec.n_marks) / spec.n_marks
        ring = spec.mark_ring_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        local = [panel.skin(x, y), *(panel.skin(x + dx, y + dy) for dx, dy in ring)]
        points, normals = (turn.apply([each[i] for each in local]) for i in (0, 1))
        lowest = turn.apply(panel.corners())[:, 2].min()
        height = random.uniform(*spec.raise_m) - lowest
        position = np.array([place[0] - points[0, 0], place[1] - points[0, 1], height])
        look = draw_look(spec, streams)
        goal = Goal(points[0] + position, normals[0], spec.standoff_m)
        own = self.named.start if self.named is not None else "zero"
        rotation_vector = turn.as_rotvec()
        solids = (panel.solid(position, rotation_vector),)
        return SurfaceScenario(
            target=goal.target,
            normal=goal.normal,
            marks=points[1:] + position,
            mark_normals=normals[1:],
            panel=index,
            panel_position=position,
            panel_turn=rotation_vector,
            panel_rgb=self._draw_paint(streams),
            start=draw_start(spec, own, streams, goal, UP, solids),
            **look,
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
        model = physics.model
        things = [each.geom for each in self._marks] + [each.geom for each in self._panels]
        geoms = [int(physics.bind(geom).element_id) for geom in things]
        rows = [int(model.body_mocapid[model.geom_bodyid[geom]]) for geom in geoms]
        n = len(self._marks)
        self._mark_rows, self._panel_rows, self._panel_geoms = rows[:n], rows[n:], geoms[n:]

    def begin(self, physics: "mjcf.Physics", scenario: SurfaceScenario) -> None:
        """Set up the panel, park the others, and lay target and marks on the skin."""
        from scipy.spatial.transform import Rotation

        from hvs_suite.cell.marker import orientation
        from hvs_suite.cell.prop import PARKED_M

        super().begin(physics, scenario)
        data, row = physics.data.ptr, self._panel_rows[scenario.panel]
        turn = Rotation.from_rotvec(scenario.panel_turn)
        data.mocap_pos[self._panel_rows] = PARKED_M
        data.mocap_pos[row] = scenario.panel_position
        data.mocap_quat[row] = turn.as_quat(scalar_first=True)
        # A geom's own colour hides its material's, which is put back for every scene.
        physics.model.ptr.geom_rgba[self._panel_geoms[scenario.panel], :3] = scenario.panel_rgb
        data.mocap_pos[self._mark_rows] = scenario.marks
        data.mocap_quat[self._mark_rows] = [orientation(n) for n in scenario.mark_normals]
        self._goal = Goal(scenario.target, scenario.normal, self.spec.standoff_m)
        panel = self._panels[scenario.panel]
        self._solids = (panel.solid(scenario.panel_position, scenario.panel_turn),)
        self.put_marker(physics, self._goal)

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over the target, at any time."""
        return self._goal

    def obstacles(self) -> "tuple[Solid, ...]":
        """The panel and its post."""
        return self._solids

    @classmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """Reachable, in time and observable; slope and place told well enough by the marks."""
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
