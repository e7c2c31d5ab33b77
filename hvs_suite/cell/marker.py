"""Visual targets: a plain disc, a ring and a fiducial that also shows its yaw.

A marker is a mocap body, so moving it changes the state and not the compiled model. It has no
contacts and lies a quarter of a millimetre proud of the surface.
"""

import functools
from typing import Any, Literal

import cv2
import imageio.v3 as iio
import mujoco
import numpy as np
import numpy.typing as npt
from dm_control import composer, mjcf

from hvs_suite.cell.kinematics import tool_frame

FloatArray = npt.NDArray[np.float64]

MarkerKind = Literal["disc", "ring", "fiducial"]

RED = (0.80, 0.06, 0.06, 1.0)
# Thick enough for the depth buffer at 3 m, thin enough not to show a side.
HALF_THICKNESS_M = 0.000125
_RING_HOLE = 0.5
_FIDUCIAL_ID = 7
_FIDUCIAL_PX = 256


class Marker(composer.Entity):
    """The target that the tool has to be placed over; its origin lies on the surface, z outward."""

    def _build(
        self,
        kind: MarkerKind = "disc",
        diameter_m: float = 0.05,
        name: str = "marker",
        half_thickness_m: float = HALF_THICKNESS_M,
    ) -> None:
        """Builds the marker.

        Args:
            kind: ``disc``, ``ring`` (outer diameter as given, hole half of it) or ``fiducial`` (an
                ArUco 4x4 marker whose sides are the diameter).
            diameter_m: Diameter or side length (m).
            name: Of the marker, unique in the cell.
            half_thickness_m: Half of what it is proud of the surface (m).
        """
        self.diameter_m = diameter_m
        self._root = mjcf.RootElement(model=name)
        common: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}
        radius = diameter_m / 2
        top = 2 * half_thickness_m
        if kind == "fiducial":
            texture = self._root.asset.add(
                "texture",
                name="fiducial",
                type="cube",
                fileright=mjcf.Asset(_fiducial(), ".png"),
                fileleft=mjcf.Asset(_fiducial(), ".png"),
                fileup=mjcf.Asset(_fiducial(), ".png"),
                filedown=mjcf.Asset(_fiducial(), ".png"),
                filefront=mjcf.Asset(_fiducial(), ".png"),
                fileback=mjcf.Asset(_fiducial(), ".png"),
            )
            self._material = self._root.asset.add("material", name="marker", texture=texture)
            self._geom = self._root.worldbody.add(
                "geom",
                name="marker",
                type="box",
                material=self._material,
                size=[radius, radius, half_thickness_m],
                pos=[0, 0, half_thickness_m],
                **common,
            )
            return
        self._material = self._root.asset.add(
            "material", name="marker", rgba=RED, specular=0.0, shininess=0.0
        )
        self._geom = self._root.worldbody.add(
            "geom",
            name="marker",
            type="cylinder",
            material=self._material,
            size=[radius, half_thickness_m],
            pos=[0, 0, half_thickness_m],
            **common,
        )
        if kind == "ring":
            self._root.worldbody.add(
                "geom",
                name="hole",
                type="cylinder",
                rgba=[0.95, 0.95, 0.95, 1],
                size=[radius * _RING_HOLE, half_thickness_m],
                pos=[0, 0, top],
                **common,
            )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Root of the marker's MJCF tree."""
        return self._root

    @property
    def geom(self) -> Any:
        """The geom that cameras see."""
        return self._geom

    @property
    def material(self) -> Any:
        """The marker's material."""
        return self._material


def orientation(normal: FloatArray) -> FloatArray:
    """Quaternion (4,) w x y z that turns a marker's z axis to a surface's outward normal (3,)."""
    return _orientation(*normal.tolist())


# A target that moves over a plane keeps its normal, and is asked for in every control step.
@functools.lru_cache(maxsize=16)
def _orientation(x: float, y: float, z: float) -> FloatArray:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, tool_frame(np.array([-x, -y, -z])).ravel())
    quat.setflags(write=False)
    return quat


def _fiducial() -> bytes:
    """PNG of the ArUco marker with a white margin."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    inner = cv2.aruco.generateImageMarker(dictionary, _FIDUCIAL_ID, _FIDUCIAL_PX * 3 // 4)
    picture = np.full((_FIDUCIAL_PX, _FIDUCIAL_PX), 255, np.uint8)
    margin = _FIDUCIAL_PX // 8
    picture[margin : margin + len(inner), margin : margin + len(inner)] = inner
    return iio.imwrite("<bytes>", np.repeat(picture[..., None], 3, axis=2), extension=".png")
