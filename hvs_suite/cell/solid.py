"""Solids that the arm must not touch: boxes and cylinders, and the arm's distance to them.

One description serves all: a prop's geoms are made of it, a family places and sweeps it, planners
and draws measure distances to it.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Literal, Self

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from hvs_suite.cell.kinematics import kinematics

FloatArray = npt.NDArray[np.float64]
Place = tuple[float, float, float]

_FIRST_FREE_LINK = 2
"""Base and link 1 stay where they stand; nothing is put there."""
_HAND = 7
_BALL_SPACING = 1.0
"""Distance of the balls along a link's axis, in radii: they stand out by an eighth of it."""


@dataclasses.dataclass(frozen=True)
class Solid:
    """A box or a cylinder; upright as a rule, and what is moved and swept always.

    Attributes:
        kind: Which of them.
        half: Half its sides (m); of a cylinder the radius, twice, and half the height.
        centre: Its centre (m).
        yaw: Turn about the vertical (rad).
        lean: Rotation vector of a further turn (rad), for what does not stand upright.
        is_faced: Whether the tool comes near it, face on: a dome over the flange, which is quicker
            to measure, would be in the way there.
    """

    kind: Literal["box", "cylinder"]
    half: Place
    centre: Place = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    lean: Place = (0.0, 0.0, 0.0)
    is_faced: bool = False

    @property
    def rotation(self) -> FloatArray:
        """From its own axes to the base's, (3, 3)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        upright = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(pin.exp3(np.array(self.lean)) @ upright)

    def moved(self, to: Sequence[float], yaw: float) -> Self:
        """The solid of a body that was put somewhere.

        Args:
            to: Where the body's origin is (m).
            yaw: How far the body is turned (rad).
        """
        (x, y, z), (c, s) = self.centre, (math.cos(yaw), math.sin(yaw))
        centre = (to[0] + c * x - s * y, to[1] + s * x + c * y, to[2] + z)
        return dataclasses.replace(self, centre=centre, yaw=self.yaw + yaw)

    def swept(self, way: Sequence[float]) -> "Solid":
        """A box that holds the solid wherever it is on a straight, level way (2,) m."""
        length, heading = math.hypot(*way), math.atan2(way[1], way[0])
        turn = self.yaw - heading
        c, s = abs(math.cos(turn)), abs(math.sin(turn))
        a, b, h = self.half
        along, across = (a, b) if self.kind == "cylinder" else (c * a + s * b, s * a + c * b)
        x, y, z = self.centre
        middle = (x + 0.5 * way[0], y + 0.5 * way[1], z)
        return Solid("box", (along + 0.5 * length, across, h), middle, heading)

    def distance(self, points: FloatArray) -> FloatArray:
        """How far points (n, 3) are from its surface, (n,) m; negative inside."""
        x, y, z = ((points - self.centre) @ self.rotation).T
        if self.kind == "cylinder":
            beyond = np.stack([np.hypot(x, y) - self.half[0], np.abs(z) - self.half[2]])
        else:
            beyond = np.abs([x, y, z]) - np.array(self.half)[:, None]
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=0)
        return np.asarray(outside + np.minimum(beyond.max(axis=0), 0.0))


class ObstacleDistance:
    """Measures how far the arm is from solids, by coal, on the arm's collision bodies.

    Args:
        solids: What the arm must keep out of.
    """

    def __init__(self, solids: Sequence[Solid]) -> None:
        self._model = kinematics().model
        self._geometry = pin.GeometryModel()
        bodies = [
            body
            for body in kinematics().geometry.geometryObjects
            if body.parentJoint >= _FIRST_FREE_LINK
        ]
        domed = [self._geometry.addGeometryObject(_domed(body)) for body in bodies]
        true_hand = [
            self._geometry.addGeometryObject(body) if body.parentJoint == _HAND else dome
            for body, dome in zip(bodies, domed, strict=True)
        ]
        for number, solid in enumerate(solids):
            added = self._geometry.addGeometryObject(_geometry(f"solid-{number}", solid))
            for link in true_hand if solid.is_faced else domed:
                self._geometry.addCollisionPair(pin.CollisionPair(link, added))
        self._data = self._model.createData()
        self._geometry_data = self._geometry.createData()

    def __call__(self, q: npt.ArrayLike) -> float:
        """Least distance (m) at joint angles (7,) rad; negative where the arm is inside."""
        if not len(self._geometry.collisionPairs):
            return math.inf
        nearest = pin.computeDistances(
            self._model,
            self._data,
            self._geometry,
            self._geometry_data,
            np.asarray(q, dtype=np.float64),
        )
        return float(self._geometry_data.distanceResults[nearest].min_distance)


@functools.lru_cache(maxsize=64)
def obstacle_distance(solids: tuple[Solid, ...]) -> ObstacleDistance:
    """The measure for some solids, made once for each scene."""
    return ObstacleDistance(solids)


class ArmBalls:
    """Balls that hold the arm: quick to hold against many solids at once.

    Attributes:
        radius: Of each ball, (b,) m.
    """

    def __init__(self) -> None:
        self._model = kinematics().model
        self._data = self._model.createData()
        links, places, radii = [], [], []
        for body in kinematics().geometry.geometryObjects:
            if body.parentJoint < _FIRST_FREE_LINK:
                continue
            radius, half = body.geometry.radius, body.geometry.halfLength
            count = 1 + math.ceil(2.0 * half / (_BALL_SPACING * radius))
            along = np.linspace(-half, half, count)
            spacing = 2.0 * half / max(count - 1, 1)
            axis, middle = body.placement.rotation[:, 2], body.placement.translation
            places += [middle + each * axis for each in along]
            links += [body.parentJoint] * count
            # Halfway between two balls, the link is this far from either centre.
            radii += [math.hypot(radius, 0.5 * spacing)] * count
        self._links, self._places = np.array(links), np.array(places)
        self.radius = np.array(radii)

    def at(self, postures: FloatArray) -> FloatArray:
        """Centres of the balls at postures (n, 7) rad, (n, b, 3) m."""
        centres = np.empty((len(postures), len(self.radius), 3))
        for row, q in enumerate(postures):
            pin.forwardKinematics(self._model, self._data, q)
            turns = np.array([each.rotation for each in self._data.oMi])
            shifts = np.array([each.translation for each in self._data.oMi])
            turned = np.einsum("nij,nj->ni", turns[self._links], self._places)
            centres[row] = turned + shifts[self._links]
        return centres


@functools.cache
def arm_balls() -> ArmBalls:
    """The process's one :class:`ArmBalls`."""
    return ArmBalls()


def _domed(body: pin.GeometryObject) -> pin.GeometryObject:
    """A link's body; a cylinder as the capsule that holds it, which coal measures far faster."""
    shape = body.geometry
    if isinstance(shape, coal.Cylinder):
        shape = coal.Capsule(shape.radius, 2.0 * shape.halfLength)
    return pin.GeometryObject(body.name, body.parentJoint, body.placement, shape)


def _geometry(name: str, solid: Solid) -> pin.GeometryObject:
    a, b, h = solid.half
    shape = coal.Cylinder(a, 2.0 * h) if solid.kind == "cylinder" else coal.Box(2 * a, 2 * b, 2 * h)
    return pin.GeometryObject(name, 0, pin.SE3(solid.rotation, np.array(solid.centre)), shape)
