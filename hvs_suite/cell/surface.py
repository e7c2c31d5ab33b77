"""Work surfaces: a flat table, a tilted panel and a curved (fuselage) panel.

Each surface knows its height and outward normal over every point of the base plane, so that a
target can be laid on it and a goal computed without touching the simulation.
"""

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import trimesh
from dm_control import composer, mjcf

from hvs_suite.cell.robot import SCENE_BIT

FloatArray = npt.NDArray[np.float64]
SurfaceShape = Literal["flat", "tilted", "curved"]

THICKNESS_M = 0.05
TILT_RAD = np.deg2rad(10.0)
# About the radius of a single-aisle fuselage.
CURVATURE_RADIUS_M = 2.0
_CURVE_SEGMENTS = 64
TEXTURE_SIDE_PX = 128


class Surface(composer.Entity):
    """The panel that targets lie on; its origin is the base frame's origin.

    ``flat``: the plane z = 0. ``tilted``: rotated by 10 deg about the y axis through the origin, so
    that the robot's base stands in its middle. ``curved``: the top of a cylinder of radius 2 m
    whose axis is parallel to y, touching z = 0 along the y axis.
    """

    def _build(
        self, shape: SurfaceShape = "flat", size_m: tuple[float, float] = (2.0, 2.0)
    ) -> None:
        """Builds the panel.

        Args:
            shape: Shape of the panel.
            size_m: Side lengths along x and y (m).
        """
        self.shape = shape
        self._root = mjcf.RootElement(model="surface")
        # A kept, writable texture: randomisation repaints it, white leaves the colour alone.
        self._texture = self._root.asset.add(
            "texture",
            name="surface",
            type="2d",
            builtin="flat",
            rgb1=[1, 1, 1],
            rgb2=[1, 1, 1],
            width=TEXTURE_SIDE_PX,
            height=TEXTURE_SIDE_PX,
        )
        self._material = self._root.asset.add(
            "material",
            name="surface",
            texture=self._texture,
            texuniform=False,
            rgba=[0.62, 0.64, 0.66, 1],
            specular=0.1,
            shininess=0.1,
            reflectance=0.0,
        )
        common: dict[str, Any] = {
            "name": "surface",
            "material": self._material,
            "contype": SCENE_BIT,
            "conaffinity": 0,
        }
        half = [size_m[0] / 2, size_m[1] / 2, THICKNESS_M / 2]
        if shape == "curved":
            mesh = _curved_panel(size_m)
            self._root.asset.add(
                "mesh",
                name="surface",
                vertex=mesh.vertices.ravel().tolist(),
                face=mesh.faces.ravel().tolist(),
            )
            self._geom = self._root.worldbody.add("geom", type="mesh", mesh="surface", **common)
        else:
            normal = self.normal(0.0, 0.0)
            angle = TILT_RAD if shape == "tilted" else 0.0
            self._geom = self._root.worldbody.add(
                "geom",
                type="box",
                size=half,
                pos=(-normal * THICKNESS_M / 2).tolist(),
                quat=[np.cos(angle / 2), 0, np.sin(angle / 2), 0],
                **common,
            )

    def height(self, x: float, y: float) -> float:
        """Height of the surface over a point of the base plane (m)."""
        if self.shape == "tilted":
            return float(-np.tan(TILT_RAD) * x)
        if self.shape == "curved":
            return float(np.sqrt(CURVATURE_RADIUS_M**2 - x**2) - CURVATURE_RADIUS_M)
        return 0.0

    def normal(self, x: float, y: float) -> FloatArray:
        """Outward unit normal over a point of the base plane, (3,), base frame."""
        if self.shape == "tilted":
            return np.array([np.sin(TILT_RAD), 0.0, np.cos(TILT_RAD)])
        if self.shape == "curved":
            return np.array([x, 0.0, np.sqrt(CURVATURE_RADIUS_M**2 - x**2)]) / CURVATURE_RADIUS_M
        return np.array([0.0, 0.0, 1.0])

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Root of the surface's MJCF tree."""
        return self._root

    @property
    def geom(self) -> Any:
        """The panel's geom."""
        return self._geom

    @property
    def material(self) -> Any:
        """The panel's material."""
        return self._material

    @property
    def texture(self) -> Any:
        """The panel's texture, white unless repainted."""
        return self._texture


def _curved_panel(size_m: tuple[float, float]) -> trimesh.Trimesh:
    """The top of a cylinder along y, closed below by a plane, as a convex mesh."""
    half = size_m[0] / 2
    x = np.linspace(-half, half, _CURVE_SEGMENTS + 1)
    z = np.sqrt(CURVATURE_RADIUS_M**2 - x**2) - CURVATURE_RADIUS_M
    outline = np.concatenate(
        [np.column_stack([x, z]), [[half, z[-1] - THICKNESS_M], [-half, z[0] - THICKNESS_M]]]
    )
    sides = [
        np.column_stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]])
        for y in (-size_m[1] / 2, size_m[1] / 2)
    ]
    return trimesh.convex.convex_hull(np.concatenate(sides))
