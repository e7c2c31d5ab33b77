"""Where a target that no camera has seen yet may be, and from where to look for it.

The surface is a grid of places. A place is ruled out once a camera would have seen the target
there: inside its picture, with no part of the arm in the line of sight. The arm's outline comes
from its collision bodies and the measured joints.
"""

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from hvs_suite.cell.cameras import project
from hvs_suite.cell.kinematics import Kinematics

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

SPACING_M = 0.025
# The shells stand out of the collision bodies by up to 2 cm, and a disc shows while half is seen.
_ARM_MARGIN_M = 0.03
_BORDER_SHARE = 0.04
_MIN_FOOTPRINT_PX = 4.0


class ArmOutline:
    """The arm as balls, for lines of sight.

    Args:
        kinematics: The robot.
    """

    def __init__(self, kinematics: Kinematics) -> None:
        self._model, self._geometry = kinematics.model, kinematics.geometry
        self._data = self._model.createData()
        self._geometry_data = self._geometry.createData()
        links = [g.parentJoint for g in self._geometry.geometryObjects]
        shapes = [g.geometry for g in self._geometry.geometryObjects]
        self._radius = np.repeat([shape.radius for shape in shapes], 3) + _ARM_MARGIN_M
        self._half_length = np.array([shape.halfLength for shape in shapes])
        self._is_hand = np.repeat(np.array(links) >= 6, 3)

    def hides(self, q: FloatArray, eye: FloatArray, points: FloatArray, *, own: bool) -> BoolArray:
        """Which points the arm hides from a camera.

        Args:
            q: Joint angles, (7,) rad.
            eye: The camera, (3,) m.
            points: Points to look at, (n, 3) m.
            own: The camera sits in the hand, which then hides nothing.

        Returns:
            (n,) bool.
        """
        pin.updateGeometryPlacements(
            self._model, self._data, self._geometry, self._geometry_data, q
        )
        middle = np.array([placement.translation for placement in self._geometry_data.oMg])
        axis = np.array([placement.rotation[:, 2] for placement in self._geometry_data.oMg])
        along = (self._half_length[:, None] * axis)[:, None] * np.array([-1.0, 0.0, 1.0])[:, None]
        balls = (middle[:, None] + along).reshape(-1, 3)
        radius = self._radius
        if own:
            balls, radius = balls[~self._is_hand], radius[~self._is_hand]
        ray = points - eye
        share = (balls - eye) @ ray.T / np.einsum("ni,ni->n", ray, ray)
        nearest = eye + np.clip(share, 0.0, 1.0)[..., None] * ray
        distance = np.linalg.norm(nearest - balls[:, None], axis=2)
        return np.asarray((distance < radius[:, None]).any(axis=0))


class TargetSearch:
    """Remembers which places are still possible.

    Args:
        kinematics: The robot.
        ring_m: Inner and outer radius of the ring of targets (m).
        diameter_m: Diameter of the target (m).
    """

    def __init__(
        self, kinematics: Kinematics, ring_m: tuple[float, float], diameter_m: float
    ) -> None:
        self._outline = ArmOutline(kinematics)
        self._diameter_m = diameter_m
        reach = np.arange(-ring_m[1], ring_m[1] + SPACING_M, SPACING_M)
        x, y = (grid.ravel() for grid in np.meshgrid(reach, reach))
        radius = np.hypot(x, y)
        on_ring = (radius >= ring_m[0] - SPACING_M) & (radius <= ring_m[1] + SPACING_M)
        self._grid = np.stack([x, y, np.zeros(len(x))], axis=1)[on_ring]
        self._possible = np.ones(len(self._grid), bool)

    def reset(self) -> None:
        """Everywhere is possible again."""
        self._possible[:] = True

    @property
    def possible(self) -> FloatArray:
        """Places that are still possible, (n, 3) m; all again once none is left."""
        if not self._possible.any():
            self.reset()
        return np.asarray(self._grid[self._possible])

    def rule_out(self, q: FloatArray, K: FloatArray, T: FloatArray, side: int, own: bool) -> None:
        """A camera saw no target: it lies in no place that this camera sees.

        Args:
            q: Measured joint angles, (7,) rad.
            K: Intrinsics, (3, 3) px.
            T: Extrinsics, (4, 4).
            side: Side of the picture (px).
            own: The camera sits in the hand.
        """
        self._possible[self._sees(q, K, T, side, own)] = False

    def _sees(
        self, q: FloatArray, K: FloatArray, T: FloatArray, side: int, own: bool
    ) -> npt.NDArray[np.intp]:
        """Indices of the places, still possible, where the camera would see the target."""
        index = np.flatnonzero(self._possible)
        seen = project(self._grid[index], K, T)
        border = _BORDER_SHARE * side
        inside = (seen[:, 2] > 0.02) & (
            (seen[:, :2] > border) & (seen[:, :2] < side - 1 - border)
        ).all(axis=1)
        index, depth = index[inside], seen[inside, 2]
        eye = -T[:3, :3].T @ T[:3, 3]
        if not len(index) or eye[2] < 0.02:
            return np.empty(0, np.intp)
        points = self._grid[index]
        steepness = eye[2] / np.linalg.norm(points - eye, axis=1)
        footprint = np.pi / 4.0 * (K[0, 0] * self._diameter_m / depth) ** 2 * steepness
        index = index[footprint > _MIN_FOOTPRINT_PX]
        if not len(index):
            return np.empty(0, np.intp)
        return np.asarray(index[~self._outline.hides(q, eye, self._grid[index], own=own)])
