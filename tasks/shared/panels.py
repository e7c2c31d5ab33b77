"""Panels: plates or pieces of skin; a scene sets one up, with a target and marks on it.

All panels stand in the compiled model from the start, and so do the marks; a scene sets one panel
up and parks the others.
"""

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.goal import UP
from hvs_suite.tasks.shared.placing import PlacingSpec
from hvs_suite.tasks.shared.spec import scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.cell.arena import Cell
    from hvs_suite.cell.solid import Solid

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
class PanelSpec(PlacingSpec):
    """Parameters of placing over a target on a panel.

    Attributes:
        tilt_deg: Least and largest tilt of a panel (deg).
        raise_m: Least and largest distance of its lowest point from the table (m).
        radius_m: Least and largest radius of its skin (m); None for flat plates.
        seams: Whether seams, rivets and stains are on it.
        n_marks: Marks around the target.
        mark_diameter_m: Their diameter (m).
        mark_ring_m: Radius of the ring that they lie on (m).
    """

    tilt_deg: tuple[float, float] = scene((0.0, 15.0))
    raise_m: tuple[float, float] = scene((0.0, 0.08))
    radius_m: tuple[float, float] | None = scene(None)
    seams: bool = False
    n_marks: int = 8
    mark_diameter_m: float = 0.005
    mark_ring_m: float = scene(0.025)

    def __post_init__(self) -> None:
        """Refuse panels and marks that cannot be, with a sentence.

        Raises:
            OptionError: One of them cannot.
        """
        super().__post_init__()
        self._check_range("tilt_deg", most=MAX_TILT_DEG)
        self._check_range("raise_m", most=MAX_RAISE_M)
        if self.radius_m is not None:
            self._check_range("radius_m", least=0.5)
        if not 3 <= self.n_marks <= 24:
            raise OptionError(f"n_marks is {self.n_marks}; use 3 to 24, fewer show no slope")
        self._check_positive("mark_diameter_m")
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


class Panels:
    """All panels of a family, and the marks that lie on the one that is set up.

    Args:
        cell: What they are attached to.
        spec: What they are like.

    Attributes:
        panels: All of them, in order.
        geoms: Index of each one's skin in the compiled model.
    """

    def __init__(self, cell: "Cell", spec: PanelSpec) -> None:
        from hvs_suite.cell.marker import Marker
        from hvs_suite.cell.panel import Panel

        self._spec = spec
        self._marks = [
            Marker(
                diameter_m=spec.mark_diameter_m,
                name=f"mark-{number}",
                half_thickness_m=MARK_HALF_THICKNESS_M,
            )
            for number in range(spec.n_marks)
        ]
        curvatures = [0.0]
        if spec.radius_m is not None:
            low, high = spec.radius_m
            curvatures = np.linspace(1.0 / high, 1.0 / low, N_PANELS).tolist()
        self.panels = [
            Panel(f"panel-{number}", SIDE_M, curvature, number if spec.seams else None)
            for number, curvature in enumerate(curvatures)
        ]
        for mark in self._marks:
            cell.add_marker(mark)
        for panel in self.panels:
            cell.add_prop(panel)

    def after_compile(self, physics: "mjcf.Physics") -> None:
        """Look up marks and panels in the compiled model."""
        model = physics.model
        things = [each.geom for each in self._marks] + [each.geom for each in self.panels]
        geoms = [int(physics.bind(geom).element_id) for geom in things]
        rows = [int(model.body_mocapid[model.geom_bodyid[geom]]) for geom in geoms]
        n = len(self._marks)
        self._mark_rows, self._panel_rows, self.geoms = rows[:n], rows[n:], geoms[n:]

    def draw(self, random: np.random.Generator, place: tuple[float, float]) -> dict[str, Any]:
        """Draw a panel, how it stands, and where on it the target lies.

        Args:
            random: Draws.
            place: Of the target, seen from above (m, base frame).

        Returns:
            ``target`` (3,) m and ``normal`` (3,) there, ``marks`` (n, 3) m and ``mark_normals``
            (n, 3), all in the base frame; ``panel``, its index; ``panel_position`` (3,) m and
            ``panel_turn`` (3,) rad, a rotation vector, of its frame.
        """
        from scipy.spatial.transform import Rotation

        spec = self._spec
        index = int(random.integers(len(self.panels)))
        panel = self.panels[index]
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
        return {
            "target": points[0] + position,
            "normal": normals[0],
            "marks": points[1:] + position,
            "mark_normals": normals[1:],
            "panel": index,
            "panel_position": position,
            "panel_turn": turn.as_rotvec(),
        }

    def solid(self, panel: int, position: FloatArray, rotation_vector: FloatArray) -> "Solid":
        """What panel and post fill; arguments as `set_up`'s."""
        return self.panels[panel].solid(position, rotation_vector)

    def set_up(
        self,
        physics: "mjcf.Physics",
        panel: int,
        position: FloatArray,
        rotation_vector: FloatArray,
        rgb: FloatArray,
    ) -> None:
        """Set up one panel, and park the others.

        Args:
            physics: The compiled cell.
            panel: Its index.
            position: Of its frame, (3,) m.
            rotation_vector: Its turn, (3,) rad.
            rgb: Its colour, (3,) in [0, 1].
        """
        from scipy.spatial.transform import Rotation

        from hvs_suite.cell.prop import PARKED_M

        data, row = physics.data.ptr, self._panel_rows[panel]
        data.mocap_pos[self._panel_rows] = PARKED_M
        data.mocap_pos[row] = position
        data.mocap_quat[row] = Rotation.from_rotvec(rotation_vector).as_quat(scalar_first=True)
        # A geom's own colour hides its material's, which is put back for every scene.
        physics.model.ptr.geom_rgba[self.geoms[panel], :3] = rgb

    def lay_marks(self, physics: "mjcf.Physics", places: FloatArray, normals: FloatArray) -> None:
        """Lay the marks on a skin, by their centres (n, 3) m and its outward normals there."""
        from hvs_suite.cell.marker import orientation

        data = physics.data.ptr
        data.mocap_pos[self._mark_rows] = places
        data.mocap_quat[self._mark_rows] = [orientation(normal) for normal in normals]
