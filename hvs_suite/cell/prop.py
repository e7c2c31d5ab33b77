"""Props: things in the cell beside the target, such as flat shapes of all colours, and obstacles.

Each is a mocap body that stands in the compiled model from the start. A scene puts some of them
somewhere and parks the others out of sight, so that nothing is compiled for a scene.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import trimesh
from dm_control import composer, mjcf

from hvs_suite.cell.marker import HALF_THICKNESS_M, RED
from hvs_suite.cell.robot import SCENE_BIT
from hvs_suite.cell.solid import Solid

FloatArray = npt.NDArray[np.float64]
Shape = Literal["disc", "square", "ring", "half disc"]

COLOURS: Mapping[str, tuple[float, float, float, float]] = MappingProxyType(
    {
        "red": RED,
        "blue": (0.06, 0.20, 0.75, 1.0),
        "green": (0.04, 0.50, 0.14, 1.0),
        "yellow": (0.88, 0.76, 0.05, 1.0),
    }
)
"""What things may be painted; none is the robot's grey or orange."""
PARKED_M = (0.0, 0.0, -100.0)
"""Where props are that a scene does without: beyond what any camera draws."""
RING_HOLE = 0.5
"""Diameter of a ring's hole, in diameters of the ring."""
_SEGMENTS = 24
_NO_CONTACT: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}


class Prop(composer.Entity):
    """A thing that scenes put somewhere; its origin lies on the surface, z outward."""

    def _start(self, name: str, rgba: Sequence[float]) -> None:
        self._root = mjcf.RootElement(model=name)
        self._material = self._root.asset.add(
            "material", name=name, rgba=rgba, specular=0.0, shininess=0.0
        )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Root of the prop's MJCF tree."""
        return self._root

    @property
    def geom(self) -> Any:
        """Its first geom."""
        return self._root.worldbody.geom[0]


class Sticker(Prop):
    """A flat, coloured shape on the surface, without contacts."""

    def _build(self, name: str, shape: Shape, colour: str, diameter_m: float) -> None:
        """Builds the sticker.

        Args:
            name: Of the prop, unique in the cell.
            shape: Its outline.
            colour: One of ``COLOURS``.
            diameter_m: Outer diameter, or side length (m).
        """
        self._start(name, COLOURS[colour])
        radius, h = 0.5 * diameter_m, HALF_THICKNESS_M
        lying: dict[str, Any] = {"pos": [0, 0, h], "material": self._material, **_NO_CONTACT}
        add = self._root.worldbody.add
        if shape == "disc":
            add("geom", type="cylinder", size=[radius, h], **lying)
        elif shape == "square":
            add("geom", type="box", size=[radius, radius, h], **lying)
        else:
            mesh = _ring(radius) if shape == "ring" else _half_disc(radius)
            self._root.asset.add(
                "mesh",
                name=name,
                vertex=mesh.vertices.ravel().tolist(),
                face=mesh.faces.ravel().tolist(),
                inertia="shell",
            )
            add("geom", type="mesh", mesh=name, material=self._material, **_NO_CONTACT)


class Obstacle(Prop):
    """Something solid that stands on the surface.

    Attributes:
        solids: What it is made of, around its origin.
    """

    def _build(self, name: str, solids: Sequence[Solid], rgba: Sequence[float]) -> None:
        """Builds the obstacle.

        Args:
            name: Of the prop, unique in the cell.
            solids: What it is made of.
            rgba: Its colour.
        """
        self.solids = tuple(solids)
        self._start(name, rgba)
        for solid in solids:
            half = [solid.half[0], solid.half[2]] if solid.kind == "cylinder" else solid.half
            self._root.worldbody.add(
                "geom",
                type=solid.kind,
                size=half,
                pos=solid.centre,
                quat=[math.cos(0.5 * solid.yaw), 0, 0, math.sin(0.5 * solid.yaw)],
                material=self._material,
                contype=SCENE_BIT,
                conaffinity=0,
                group=1,
            )


class Lane(Prop):
    """A strip painted on the surface: something moves along it, from the origin along x."""

    def _build(self, name: str, length_m: float, width_m: float) -> None:
        """Builds the strip.

        Args:
            name: Of the prop, unique in the cell.
            length_m: How far something moves (m).
            width_m: Width of the strip, by which it also goes on at either end (m).
        """
        self._start(name, (0.16, 0.16, 0.18, 1.0))
        half = [0.5 * (length_m + width_m), 0.5 * width_m, HALF_THICKNESS_M]
        self._root.worldbody.add(
            "geom",
            type="box",
            size=half,
            pos=[0.5 * length_m, 0, HALF_THICKNESS_M],
            material=self._material,
            **_NO_CONTACT,
        )


def _ring(radius: float) -> trimesh.Trimesh:
    return _extruded(
        [(radius * c, radius * s) for c, s in _circle(_SEGMENTS)],
        [(RING_HOLE * radius * c, RING_HOLE * radius * s) for c, s in _circle(_SEGMENTS)],
    )


def _half_disc(radius: float) -> trimesh.Trimesh:
    """Half a disc; its origin is the middle of its box."""
    rim = [(radius * c, radius * (s - 0.5)) for c, s in _circle(_SEGMENTS) if s > -1e-9]
    flat = np.array([(x, y, z) for x, y in rim for z in (0.0, 2.0 * HALF_THICKNESS_M)])
    return trimesh.convex.convex_hull(flat)


def _extruded(
    outer: Sequence[tuple[float, float]], inner: Sequence[tuple[float, float]]
) -> trimesh.Trimesh:
    """The flat body between two closed outlines of equally many corners."""
    n, top = len(outer), 2.0 * HALF_THICKNESS_M
    vertices = [(x, y, z) for ring in (outer, inner) for z in (0.0, top) for x, y in ring]
    faces = []
    for i in range(n):
        j = (i + 1) % n
        # Corner i of the outer and inner outline, below and above.
        ob, ot, ib, it = i, n + i, 2 * n + i, 3 * n + i
        ob_, ot_, ib_, it_ = j, n + j, 2 * n + j, 3 * n + j
        for a, b, c, d in (
            (ot, ot_, it_, it),
            (ob, ib, ib_, ob_),
            (ob, ob_, ot_, ot),
            (ib, it, it_, ib_),
        ):
            faces += [(a, b, c), (a, c, d)]
    return trimesh.Trimesh(vertices, faces, process=False)


def _circle(n: int) -> list[tuple[float, float]]:
    return [(math.cos(2 * math.pi * i / n), math.sin(2 * math.pi * i / n)) for i in range(n)]
