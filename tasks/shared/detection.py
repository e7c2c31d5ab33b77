"""Coloured discs in a picture: colour segmentation, then moments with sub-pixel edges.

This is a plain classical method on purpose. The certificates use it to prove that a target can be
seen: if it finds the disc under a variant's own light, colours, texture and noise, the picture
contains what the task needs. The ``servo`` baseline uses it to solve the task.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from hvs_suite.cell.cameras import project

FloatArray = npt.NDArray[np.float64]

# Warm pixels are the target's red and the robot's orange alike. Pixel noise would cut holes into
# either if the limit ran between them, so whole patches are told apart, by their mean colour: the
# target's green and blue stay below 0.3 of its red, the robot's orange has 0.43.
_MAX_OTHER_PIXEL = 0.55
_MIN_RED_LEAD = 25
_MAX_OTHER_PATCH = 0.35
_LEADS: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {
        "red": (1.0, -0.5, -0.5),
        "blue": (-0.5, -0.5, 1.0),
        "green": (-0.5, 1.0, -0.5),
        "yellow": (0.5, 0.5, -1.0),
    }
)
"""What tells a colour from grey: weights of the channels, which add up to nothing."""
_HUES_DEG: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"blue": (195.0, 260.0), "green": (95.0, 175.0), "yellow": (40.0, 70.0)}
)
_MIN_SATURATION = 0.4
_MIN_PIXELS = 2
_MAX_DISCS = 8
# A square of the same size has 1.27 times the area of a disc, a ring 0.75 times, half a disc half.
_AREA_SHARE = (0.88, 1.13)
_MAX_SPREAD = 1.3
# The renderer draws a disc as a polygon of 20 sides within the circle; a practitioner would
# calibrate the same factor on a picture of the target at a known distance.
DRAWN_AREA = float(np.sin(2.0 * np.pi / 20) / (2.0 * np.pi / 20))
# Rows and columns around a patch that hold its edge, and the background beyond.
_EDGE_PX = 2
_BACKGROUND_PX = 2
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
_RIM = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE), np.zeros(len(_CIRCLE))], axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class Disc:
    """A coloured patch that may be the target.

    Attributes:
        centre: Centre of area, u and v (px, pixel centres whole), (2,).
        area: Area (px^2), pixels on the edge counted by how coloured they are.
        is_cut: Whether it touches the border of the picture.
        spread: 4 pi times the root of the determinant of its second moments, over its area: how
            far from the middle its parts are, whatever the slant from which one looks. 1 for a
            disc, 1.05 for a square, 1.06 for half a disc, 1.67 for a ring of half its diameter.
    """

    centre: FloatArray
    area: float
    is_cut: bool
    spread: float = 1.0

    @property
    def diameter(self) -> float:
        """Diameter of a circle of the same area (px)."""
        return 2.0 * float(np.sqrt(self.area / np.pi))


def find_discs(
    image: npt.NDArray[np.uint8], colour: str = "red", most: int = _MAX_DISCS
) -> list[Disc]:
    """Find the patches of a colour.

    Args:
        image: RGB, uint8 (H, W, 3).
        colour: ``red``, ``blue``, ``green`` or ``yellow``.
        most: How many at most.

    Returns:
        Patches, the largest first.
    """
    found = _red_patches(image) if colour == "red" else _patches_of_hue(image, _HUES_DEG[colour])
    if found is None:
        return []
    labels, stats, is_target = found
    is_target &= stats[:, cv2.CC_STAT_AREA] >= _MIN_PIXELS
    is_target[0] = False
    chosen = np.flatnonzero(is_target)
    chosen = chosen[np.argsort(-stats[chosen, cv2.CC_STAT_AREA], kind="stable")][:most]
    return [_measure(image, labels, stats[each], int(each), _LEADS[colour]) for each in chosen]


_Patches = tuple[npt.NDArray[np.int32], npt.NDArray[Any], npt.NDArray[np.bool_]]
"""Label of each pixel (H, W), OpenCV's figures of each label, and whether its colour is right."""


def _red_patches(image: npt.NDArray[np.uint8]) -> _Patches | None:
    red = image[..., 0].astype(np.int16)
    other = np.maximum(image[..., 1], image[..., 2]).astype(np.int16)
    warm = (other < _MAX_OTHER_PIXEL * red) & (red - other > _MIN_RED_LEAD)
    if not warm.any():
        return None
    count, patches, stats, _ = cv2.connectedComponentsWithStats(
        warm.astype(np.uint8), connectivity=8
    )
    labels = np.asarray(patches, np.int32)
    owner = labels[warm]
    sums = [np.bincount(owner, image[..., c][warm], count) for c in range(3)]
    return labels, stats, np.maximum(sums[1], sums[2]) < _MAX_OTHER_PATCH * sums[0]


def _patches_of_hue(image: npt.NDArray[np.uint8], hue_deg: tuple[float, float]) -> _Patches | None:
    # OpenCV counts hues in steps of 2 deg, so that they fit into a byte.
    low = np.array([hue_deg[0] / 2, 255 * _MIN_SATURATION, 25])
    high = np.array([hue_deg[1] / 2, 255, 255])
    is_painted = cv2.inRange(cv2.cvtColor(image, cv2.COLOR_RGB2HSV), low, high)
    if not is_painted.any():
        return None
    count, patches, stats, _ = cv2.connectedComponentsWithStats(is_painted, connectivity=8)
    return np.asarray(patches, np.int32), stats, np.ones(count, bool)


def find_disc(image: npt.NDArray[np.uint8], colour: str = "red") -> Disc | None:
    """Find the largest patch of a colour.

    Args:
        image: RGB, uint8 (H, W, 3).
        colour: As in `find_discs`.

    Returns:
        The disc, or None where nothing is coloured enough.
    """
    return next(iter(find_discs(image, colour)), None)


def is_whole_disc(disc: Disc, expected_px2: float) -> bool:
    """Whether a patch can be a disc of known size, seen as a whole: by its area and its spread.

    Args:
        disc: The patch.
        expected_px2: Area that the disc would have there (px^2).
    """
    low, high = _AREA_SHARE
    share = disc.area / expected_px2
    return not disc.is_cut and low <= share <= high and disc.spread <= _MAX_SPREAD


def find_level_disc(
    image: npt.NDArray[np.uint8], colour: str, K: FloatArray, T: FloatArray, diameter_m: float
) -> Disc | None:
    """Find the disc of a colour and a size that lies on the plane z = 0, among other outlines.

    A small level patch of area A that a camera sees from a height h at a depth d along its axis
    has the area A f^2 h / d^3 in the picture (f is the focal length in px).

    Args:
        image: RGB, uint8 (H, W, 3).
        colour: As in `find_discs`.
        K: Intrinsics, (3, 3) px.
        T: Extrinsics, (4, 4), base to optical frame.
        diameter_m: Diameter of the disc (m).

    Returns:
        The largest that can be it, or None.
    """
    eye = -T[:3, :3].T @ T[:3, 3]
    drawn_m2 = DRAWN_AREA * np.pi / 4.0 * diameter_m**2
    for disc in find_discs(image, colour):
        ray = T[:3, :3].T @ np.linalg.solve(K, [*disc.centre, 1.0])
        # The ray has a depth of 1.
        if ray[2] < 0.0:
            depth = -eye[2] / ray[2]
            if is_whole_disc(disc, drawn_m2 * K[0, 0] ** 2 * eye[2] / depth**3):
                return disc
    return None


def intersect(uv: FloatArray, K: FloatArray, T: FloatArray, height_m: float) -> FloatArray | None:
    """Where the ray of a pixel meets a level plane.

    Args:
        uv: Pixels, (n, 2).
        K: Intrinsics, (3, 3) px.
        T: Extrinsics, (4, 4), base to optical frame.
        height_m: Height of the plane (m).

    Returns:
        Places (n, 2) in m, or None where a ray does not come down on the plane.
    """
    rays = np.concatenate([(uv - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones((len(uv), 1))], axis=1)
    down = rays @ T[:3, :3]
    eye = -T[:3, :3].T @ T[:3, 3]
    if eye[2] <= height_m or (down[:, 2] > -0.02 * np.linalg.norm(down, axis=1)).any():
        return None
    reach = (height_m - eye[2]) / down[:, 2]
    return np.asarray(eye[:2] + reach[:, None] * down[:, :2])


def outline(
    place: FloatArray, diameter_m: float, K: FloatArray, T: FloatArray, height_m: float
) -> tuple[float, FloatArray] | None:
    """Area (px^2) and centre of area (2,) px of a disc's picture; None where it is not in front.

    The centre of the picture is not the picture of the centre: perspective shifts it by up to a
    millimetre for a near, tilted disc.
    """
    rim = np.array([*place, height_m]) + 0.5 * diameter_m * _RIM
    seen = project(rim, K, T)
    if (seen[:, 2] < 0.01).any():
        return None
    u, v = seen[:, 0] - seen[0, 0], seen[:, 1] - seen[0, 1]
    u_next, v_next = np.roll(u, -1), np.roll(v, -1)
    cross = u * v_next - u_next * v
    twice = float(cross.sum())
    if abs(twice) < 1e-9:
        return None
    centre = np.array([((u + u_next) @ cross), ((v + v_next) @ cross)]) / (3.0 * twice)
    # A polygon of 24 sides stands for the circle: put its missing area back.
    circle = (2.0 * np.pi / len(_CIRCLE)) / np.sin(2.0 * np.pi / len(_CIRCLE))
    return 0.5 * abs(twice) * circle, centre + seen[0, :2]


def _measure(
    image: npt.NDArray[np.uint8],
    labels: npt.NDArray[np.int32],
    box: npt.NDArray[np.integer],
    label: int,
    lead_of: tuple[float, float, float],
) -> Disc:
    """Moments of one patch, each pixel weighed by how far it lies from background to its colour."""
    left, top, width, height = (int(value) for value in box[:4])
    rows, columns = labels.shape
    margin = _EDGE_PX + _BACKGROUND_PX
    r0, r1 = max(0, top - margin), min(rows, top + height + margin)
    c0, c1 = max(0, left - margin), min(columns, left + width + margin)
    window = image[r0:r1, c0:c1].astype(np.float64)
    # Linear in the channels, so that pixel noise has no mean here.
    lead = window @ np.array(lead_of)
    own = (labels[r0:r1, c0:c1] == label).astype(np.uint8)
    square = np.ones((3, 3), np.uint8)
    near = cv2.dilate(own, square, iterations=_EDGE_PX).astype(bool)
    inside = cv2.erode(own, square, borderValue=0).astype(bool)
    level = float(lead[inside].mean()) if inside.any() else float(lead[own.astype(bool)].max())
    around = lead[~near]
    background = float(np.median(around)) if around.size else 0.0
    weight = (lead - background) / max(level - background, 1.0) * near
    total = float(weight.sum())
    if total <= 0.0:
        weight, total = own.astype(np.float64), float(own.sum())
    u, v = np.arange(c1 - c0), np.arange(r1 - r0)
    along, down = weight.sum(axis=0), weight.sum(axis=1)
    mu, mv = float(along @ u) / total, float(down @ v) / total
    centre = np.array([c0 + mu, r0 + mv])
    is_cut = left == 0 or top == 0 or left + width == columns or top + height == rows
    uu, vv = float(along @ (u - mu) ** 2) / total, float(down @ (v - mv) ** 2) / total
    uv = float((v - mv) @ weight @ (u - mu)) / total
    spread = 4.0 * np.pi * float(np.sqrt(max(uu * vv - uv**2, 0.0))) / total
    return Disc(centre, total, is_cut, spread)
