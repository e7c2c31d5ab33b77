"""Panels: flat plates and pieces of a fuselage's skin, each on a post, that a scene sets up.

A piece of skin is the top of a cylinder; its axis is parallel to the panel's own y. The frame's
origin lies in the middle of the skin, x and y along it and z outward.
"""

import dataclasses
import functools
import math

import cv2
import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import trimesh
from dm_control import mjcf

from hvs_suite.cell.prop import Prop
from hvs_suite.cell.robot import SCENE_BIT
from hvs_suite.cell.solid import Solid

FloatArray = npt.NDArray[np.float64]

THICKNESS_M = 0.012
POST_LENGTH_M = 0.30
"""Longer than any panel is high: the post goes into the table."""
_POST_SHARE = 0.35
"""Side of the post, in sides of the panel."""
_SEGMENTS = 24
_TEXTURE_PX = 512
_RIVET_PITCH_M, _RIVET_RADIUS_M = 0.022, 0.003
_N_STAINS = 8


class Panel(Prop):
    """A square panel on a post.

    Attributes:
        side_m: Its sides (m).
        curvature: Of its skin, across its y axis (1/m); 0 for a flat one.
    """

    def _build(
        self, name: str, side_m: float, curvature: float = 0.0, seams: int | None = None
    ) -> None:
        """Builds the panel.

        Args:
            name: Of the prop, unique in the cell.
            side_m: Its sides (m).
            curvature: 1 / radius of the skin (1/m); 0 for a flat plate.
            seams: Key of the seams, rivets and stains on it; None for plain paint.
        """
        self.side_m, self.curvature = side_m, curvature
        self._start(name, (0.70, 0.72, 0.66, 1.0))
        if seams is not None:
            self._material.texture = self._root.asset.add(
                "texture", name=name, type="2d", file=mjcf.Asset(_skin(seams, side_m), ".png")
            )
        mesh = self._mesh()
        self._root.asset.add(
            "mesh",
            name=name,
            vertex=mesh.vertices.ravel().tolist(),
            face=mesh.faces.ravel().tolist(),
            texcoord=(mesh.vertices[:, :2] / side_m + 0.5).ravel().tolist(),
        )
        solid = {"contype": SCENE_BIT, "conaffinity": 0, "group": 1}
        self._root.worldbody.add("geom", type="mesh", mesh=name, material=self._material, **solid)
        half = 0.5 * _POST_SHARE * side_m
        self._root.worldbody.add(
            "geom",
            type="box",
            size=[half, half, 0.5 * POST_LENGTH_M],
            pos=[0.0, 0.0, self.bottom_m - 0.5 * POST_LENGTH_M],
            rgba=[0.25, 0.27, 0.30, 1.0],
            **solid,
        )

    @property
    def bottom_m(self) -> float:
        """Where the panel's flat underside is, along its z axis (m)."""
        return float(self.skin(0.5 * self.side_m, 0.0)[0][2]) - THICKNESS_M

    def skin(self, x: float, y: float) -> tuple[FloatArray, FloatArray]:
        """A point of the skin (3,) m, and the outward unit normal there (3,), in its own frame."""
        lean = self.curvature * x
        # Written so that it holds for a flat one, too: R cos(a) - R = -x^2 / (R (1 + cos(a))).
        upright = math.sqrt(1.0 - lean**2)
        return np.array([x, y, -lean * x / (1.0 + upright)]), np.array([lean, 0.0, upright])

    def corners(self) -> FloatArray:
        """The lowest points of the panel itself, in its own frame, (4, 3) m."""
        half = 0.5 * self.side_m
        return np.array([(x, y, self.bottom_m) for x in (-half, half) for y in (-half, half)])

    def solid(self, position: FloatArray, rotation_vector: FloatArray) -> Solid:
        """A box that holds panel and post, below the plane that touches the skin in the middle.

        Args:
            position: Of the panel's frame, (3,) m.
            rotation_vector: Its turn, (3,) rad.
        """
        depth = POST_LENGTH_M - self.bottom_m
        half = (0.5 * self.side_m, 0.5 * self.side_m, 0.5 * depth)
        a, b, c = rotation_vector.tolist()
        middle = Solid("box", half, lean=(a, b, c), is_faced=True)
        x, y, z = (position - 0.5 * depth * middle.rotation[:, 2]).tolist()
        return dataclasses.replace(middle, centre=(x, y, z))

    def _mesh(self) -> trimesh.Trimesh:
        half = 0.5 * self.side_m
        n = _SEGMENTS if self.curvature else 1
        top = [self.skin(x, y)[0] for x in np.linspace(-half, half, n + 1) for y in (-half, half)]
        return trimesh.convex.convex_hull(np.concatenate([top, self.corners()]))


@functools.cache
def _skin(key: int, side_m: float) -> bytes:
    """What a used panel looks like: lap seams with rivets on either side, stains and scratches.

    Args:
        key: Of its random draws.
        side_m: Side of the panel (m).

    Returns:
        PNG of grey values as RGB, 512 x 512 px.
    """
    random = np.random.Generator(np.random.Philox(key=key))
    scale = _TEXTURE_PX / side_m
    grey = np.full((_TEXTURE_PX, _TEXTURE_PX), 235.0)
    for _ in range(_N_STAINS):
        place, radius = random.uniform(0, _TEXTURE_PX, 2), random.uniform(0.1, 0.3) * _TEXTURE_PX
        rows, columns = np.ogrid[:_TEXTURE_PX, :_TEXTURE_PX]
        away = np.hypot(rows - place[0], columns - place[1]) / radius
        grey += random.uniform(-30.0, 10.0) * np.exp(-(away**2))
    grey = cv2.GaussianBlur(grey + random.normal(0.0, 6.0, grey.shape), (0, 0), 1.2)
    picture = np.clip(grey, 0.0, 255.0).astype(np.uint8)
    for is_riveted in (False, True):
        # Across, and once more across what has been turned over; rows of rivets do not cross.
        picture = np.ascontiguousarray(picture.T)
        for place in random.uniform(0.15, 0.85, 2) * _TEXTURE_PX:
            _draw_seam(picture, place)
            if is_riveted:
                _draw_rivets(picture, place, scale, random)
    return iio.imwrite("<bytes>", np.repeat(picture[..., None], 3, axis=2), extension=".png")


def _draw_seam(canvas: npt.NDArray[np.uint8], place_px: float) -> None:
    """Draw a seam across the whole picture (H, W)."""
    end, row = canvas.shape[0], round(place_px)
    cv2.line(canvas, (0, row), (end, row), 95.0, 2, cv2.LINE_AA)
    cv2.line(canvas, (0, row + 2), (end, row + 2), 250.0, 1, cv2.LINE_AA)


def _draw_rivets(
    canvas: npt.NDArray[np.uint8], place_px: float, scale: float, random: np.random.Generator
) -> None:
    """Draw a row of rivets beside a seam."""
    row = round(place_px + random.choice([-1.0, 1.0]) * 0.010 * scale)
    radius = round(_RIVET_RADIUS_M * scale)
    first = random.uniform(0.0, _RIVET_PITCH_M) * scale
    for along in np.arange(first, canvas.shape[0], _RIVET_PITCH_M * scale):
        centre = (round(along), row)
        cv2.circle(canvas, centre, radius, 130.0, 2, cv2.LINE_AA)
        cv2.circle(canvas, centre, radius - 2, 215.0, -1, cv2.LINE_AA)
