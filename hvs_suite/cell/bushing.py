"""The bushing: what is painted, and the hole itself, which may be elsewhere.

Two bodies, because in some tasks the hole is not quite where the paint says. The hole is made of
convex pieces (24 sectors of a ring with a chamfer, and a bottom), because MuJoCo would fill in one
concave mesh.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from dm_control import composer, mjcf

from hvs_suite.cell.marker import RED, Marker
from hvs_suite.cell.robot import COLLISION_GROUP, SCENE_BIT
from hvs_suite.cell.tool import BODY, CONTACT

FloatArray = npt.NDArray[np.float64]

BOTTOM_M = 0.003
"""Thickness of the material below the hole (m)."""
_SECTORS = 24
_SECTIONS = 48
_PAINT_M = 0.00005
"""Thickness of the painted ring (m): its side must not show."""


class Bushing(Marker):
    """What cameras see: a steel ring whose face is painted; its origin lies on the surface."""

    def _build(  # type: ignore[override]
        self, diameter_m: float, hole_diameter_m: float, hole_depth_m: float, chamfer_m: float
    ) -> None:
        """Builds the bushing.

        Args:
            diameter_m: Its outer diameter (m).
            hole_diameter_m: Diameter of the hole (m).
            hole_depth_m: Depth of the hole (m).
            chamfer_m: Width and depth of the chamfer around its mouth (m).
        """
        self.diameter_m = diameter_m
        self._root = mjcf.RootElement(model="bushing")
        self._material = self._root.asset.add(
            "material", name="paint", rgba=RED, specular=0.0, shininess=0.0
        )
        self._root.asset.add(
            "material", name="steel", rgba=(0.30, 0.31, 0.33, 1), specular=0.4, shininess=0.4
        )
        outer, inner, top = 0.5 * diameter_m, 0.5 * hole_diameter_m, BOTTOM_M + hole_depth_m
        mouth = inner + chamfer_m
        under = top - _PAINT_M
        self._geom = self._add("face", [(mouth, under), (outer, under), (outer, top), (mouth, top)])
        self._add(
            "body",
            [
                (0.0, 0.0),
                (outer, 0.0),
                (outer, top),
                (mouth, top),
                (inner, top - chamfer_m),
                (inner, BOTTOM_M),
                (0.0, BOTTOM_M),
            ],
        )

    def _add(self, name: str, profile: list[tuple[float, float]]) -> Any:
        """Adds a solid of revolution by its outline (radius, height), counterclockwise."""
        if profile[0][0] > 0.0:
            profile = [*profile, profile[0]]
        mesh = trimesh.creation.revolve(np.array(profile), sections=_SECTIONS)
        mesh.fix_normals()
        if name == "body":
            # The paint is its upper face: two so near to each other would flicker.
            top = max(height for _, height in profile)
            mesh.update_faces((mesh.triangles[:, :, 2] < top - 1e-9).any(axis=1))
        self._root.asset.add(
            "mesh",
            name=name,
            vertex=np.round(mesh.vertices, 7).ravel(),
            face=mesh.faces.ravel(),
            inertia="shell",
            smoothnormal=False,
        )
        return self._root.worldbody.add(
            "geom",
            name=name,
            type="mesh",
            mesh=name,
            material="paint" if name == "face" else "steel",
            contype=0,
            conaffinity=0,
            mass=0,
            group=1,
        )


class Hole(composer.Entity):
    """What a peg meets: the same shape, hidden; its origin lies on the surface below the hole."""

    def _build(
        self, diameter_m: float, hole_diameter_m: float, hole_depth_m: float, chamfer_m: float
    ) -> None:
        """Builds the hole; arguments as those of `Bushing`."""
        self._root = mjcf.RootElement(model="hole")
        common: dict[str, Any] = {
            "contype": SCENE_BIT,
            "conaffinity": 0,
            "group": COLLISION_GROUP,
            **CONTACT,
        }
        outer, inner, top = 0.5 * diameter_m, 0.5 * hole_diameter_m, BOTTOM_M + hole_depth_m
        profile = np.array(
            [
                (inner, 0.0),
                (outer, 0.0),
                (outer, top),
                (inner + chamfer_m, top),
                (inner, top - chamfer_m),
            ]
        )
        half = math.pi / _SECTORS
        # The flat inner sides touch the circle of the hole, so the hole is nowhere narrower.
        profile[:, 0] /= math.cos(half)
        self._root.asset.add("mesh", name="sector", vertex=_sector(profile, half).ravel())
        for number in range(_SECTORS):
            turn = number * half
            self._root.worldbody.add(
                "geom",
                name=f"sector_{number}",
                type="mesh",
                mesh="sector",
                quat=[math.cos(turn), 0, 0, math.sin(turn)],
                **common,
            )
        self._root.worldbody.add(
            "geom",
            name="bottom",
            type="cylinder",
            size=[inner + chamfer_m, 0.5 * BOTTOM_M],
            pos=[0, 0, 0.5 * BOTTOM_M],
            **common,
        )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Root of the hole's MJCF tree."""
        return self._root

    def add_force_sensor(self, cell: composer.Arena, robot: mjcf.RootElement) -> Any:
        """Adds a sensor of the force (3,) N between the tool and the hole, to which it belongs.

        Args:
            cell: What both are attached to.
            robot: The robot's tree.

        Returns:
            The MJCF sensor.
        """
        return cell.mjcf_model.sensor.add(
            "contact",
            name="insertion_force",
            subtree1=robot.find("body", BODY),
            subtree2=mjcf.get_attachment_frame(self._root),
            data="force",
            reduce="netforce",
            num=1,
        )

    @property
    def geoms(self) -> tuple[Any, ...]:
        """All its geoms."""
        return tuple(self._root.worldbody.geom)


def _sector(profile: FloatArray, half: float) -> FloatArray:
    """Corners (n, 3) m of an outline (radius, height) at either end of an arc of twice ``half``."""
    corners = [
        (r * math.cos(side * half), r * math.sin(side * half), z)
        for side in (-1.0, 1.0)
        for r, z in profile
    ]
    return np.round(corners, 8)
