"""The eye-in-hand and eye-to-hand cameras: where they are, what they see, where points project.

Frames: the *optical* frame of a camera has x to the right of the image, y down and z forward
(OpenCV's convention). Pixel centres have whole coordinates, so the middle of an image of width W
lies at (W - 1) / 2. MuJoCo's camera frame has y up and z backward instead.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from hvs_suite.embodiment import Embodiment

FloatArray = npt.NDArray[np.float64]

# Rotation from MuJoCo's camera frame to the optical frame, and back.
_OPTICAL = np.diag([1.0, -1.0, -1.0])


def intrinsics(resolution: int, fov_deg: float) -> FloatArray:
    """Pinhole matrix of a square image.

    Args:
        resolution: Side of the image (px).
        fov_deg: Full field of view (deg), the same both ways.

    Returns:
        K, (3, 3): focal length ``resolution / (2 tan(fov / 2))`` and principal point (px).
    """
    focal = resolution / (2.0 * np.tan(np.deg2rad(fov_deg) / 2.0))
    centre = (resolution - 1) / 2.0
    return np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])


def look_at(position: Sequence[float], point: Sequence[float]) -> FloatArray:
    """Orientation of a camera that looks at a point with the image's top towards +z.

    Args:
        position: Camera position (m, base frame).
        point: Point on the optical axis (m, base frame), not straight above or below.

    Returns:
        Rotation of MuJoCo's camera frame in the base frame, (3, 3).
    """
    backward = np.asarray(position, float) - np.asarray(point, float)
    backward /= np.linalg.norm(backward)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(backward, right), backward])


def extrinsics(position: FloatArray, rotation: FloatArray) -> FloatArray:
    """Transform from the base frame to the optical frame.

    Args:
        position: Camera position, (3,) m, base frame.
        rotation: MuJoCo's camera frame in the base frame, (3, 3).

    Returns:
        T, (4, 4): ``p_optical = T @ [p_base, 1]``.
    """
    transform = np.eye(4)
    transform[:3, :3] = (rotation @ _OPTICAL).T
    transform[:3, 3] = -transform[:3, :3] @ position
    return transform


def extrinsics_of_hand(
    rotation: FloatArray, position: FloatArray, embodiment: Embodiment
) -> FloatArray:
    """Transform from the base frame to the optical frame of the eye in the hand.

    Args:
        rotation: Of the flange frame in the base frame, (3, 3).
        position: Of the flange face's centre, (3,) m, base frame.
        embodiment: Says where on the flange the eye is.

    Returns:
        T, (4, 4), as in `extrinsics`.
    """
    axes, place = embodiment.hand_eye
    T = np.eye(4)
    T[:3, :3] = (rotation @ axes).T
    T[:3, 3] = -T[:3, :3] @ (position + rotation @ place)
    return T


def project(points: npt.ArrayLike, K: FloatArray, T: FloatArray) -> FloatArray:
    """Project points into an image.

    Args:
        points: Points in the base frame, (..., 3) m.
        K: Intrinsics, (3, 3).
        T: Extrinsics, (4, 4).

    Returns:
        (..., 3): u and v (px, pixel centres whole) and depth (m, negative behind the camera).
    """
    optical = np.asarray(points) @ T[:3, :3].T + T[:3, 3]
    depth = optical[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    uv = optical[..., :2] / safe[..., None] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    return np.concatenate([uv, depth[..., None]], axis=-1)


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera of the compiled model.

    Attributes:
        name: ``eih`` or ``eth``.
        id: Index in the compiled model.
        resolution: Side of the image (px).
        channels: 3 for RGB, 1 for grey.
        fov_deg: Field of view (deg).
    """

    name: str
    id: int
    resolution: int
    channels: int
    fov_deg: float

    @functools.cached_property
    def K(self) -> FloatArray:  # noqa: N802
        """Intrinsics, (3, 3) px; read-only, because asked for every control step."""
        matrix = intrinsics(self.resolution, self.fov_deg)
        matrix.setflags(write=False)
        return matrix

    def T(self, data: mujoco.MjData) -> FloatArray:  # noqa: N802
        """True extrinsics in the present state, (4, 4); privileged where the pose is disturbed."""
        return extrinsics(data.cam_xpos[self.id].copy(), data.cam_xmat[self.id].reshape(3, 3))


class CameraImage(observable.Observable):
    """Observable for a picture of the environment's kept renderer.

    Args:
        take: Draws the picture: ``take(physics) -> array``.
        spec: Shape, type and bounds of the picture.
    """

    def __init__(self, take: Any, spec: specs.BoundedArray) -> None:
        super().__init__(update_interval=1, buffer_size=1, delay=0, aggregator=None, corruptor=None)
        self._take = take
        self._spec = spec

    @property
    def array_spec(self) -> specs.BoundedArray:
        """Shape, type and bounds, known without drawing anything."""
        return self._spec

    def _callable(self, physics: mjcf.Physics) -> Any:
        return lambda: self._take(physics)


def to_grey(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Turn an RGB picture (H, W, 3) into grey (H, W, 1) with the weights of ITU-R BT.601."""
    weights = np.array([299, 587, 114], np.uint32)
    return ((image.astype(np.uint32) @ weights + 500) // 1000).astype(np.uint8)[..., None]


def add_eye_in_hand(
    flange_body: Any, flange_site: Any, fov_deg: float, embodiment: Embodiment
) -> Any:
    """Mount the eye-in-hand camera where the embodiment has it.

    Args:
        flange_body: MJCF body that carries the flange.
        flange_site: MJCF site at the flange face, z outward.
        fov_deg: Field of view (deg).
        embodiment: Says where; see `Embodiment.hand_eye`.

    Returns:
        The MJCF camera, named ``eih``.
    """
    axes, place = embodiment.hand_eye
    # MuJoCo cameras look along -z, hence y and z are turned over about the optical x axis.
    return flange_body.add(
        "camera",
        name="eih",
        pos=flange_site.pos + place,
        xyaxes=[*axes[:, 0], *(0.0 - axes[:, 1])],
        fovy=fov_deg,
    )


def add_eye_to_hand(
    root: mjcf.RootElement, position: Sequence[float], point: Sequence[float], fov_deg: float
) -> Any:
    """Mount the eye-to-hand camera at its nominal pose.

    Args:
        root: The cell.
        position: Nominal position (m, base frame).
        point: Point it looks at (m, base frame).
        fov_deg: Field of view (deg).

    Returns:
        The MJCF camera, named ``eth``.
    """
    rotation = look_at(position, point)
    return root.worldbody.add(
        "camera",
        name="eth",
        pos=list(position),
        xyaxes=[*rotation[:, 0], *rotation[:, 1]],
        fovy=fov_deg,
    )
