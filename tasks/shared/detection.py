"""Red discs in a picture: colour segmentation, then moments with sub-pixel edges.

A plain classical method on purpose. The certificates use it to prove that a target can be seen: if
it finds the disc under a variant's own light, colours, texture and noise, the picture holds what
the task needs. The ``servo`` baseline uses it to solve the task.
"""

import dataclasses

import cv2
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

# Warm pixels are the target's red and the robot's orange alike. Pixel noise would cut holes into
# either if the limit ran between them, so whole patches are told apart, by their mean colour: the
# target's green and blue stay below 0.3 of its red, the robot's orange has 0.43.
_MAX_OTHER_PIXEL = 0.55
_MIN_RED_LEAD = 25
_MAX_OTHER_PATCH = 0.35
_MIN_PIXELS = 2
_MAX_DISCS = 6
# Rows and columns around a patch that hold its edge, and the background beyond.
_EDGE_PX = 2
_BACKGROUND_PX = 2


@dataclasses.dataclass(frozen=True, eq=False)
class Disc:
    """A red patch that may be the target.

    Attributes:
        centre: Centre of area, u and v (px, pixel centres whole), (2,).
        area: Area (px^2), pixels on the edge counted by how red they are.
        is_cut: Whether it touches the border of the picture.
    """

    centre: FloatArray
    area: float
    is_cut: bool

    @property
    def diameter(self) -> float:
        """Diameter of a circle of the same area (px)."""
        return 2.0 * float(np.sqrt(self.area / np.pi))


def find_discs(image: npt.NDArray[np.uint8]) -> list[Disc]:
    """Find the red patches.

    Args:
        image: RGB, uint8 (H, W, 3).

    Returns:
        Up to six patches, the largest first.
    """
    red = image[..., 0].astype(np.int16)
    other = np.maximum(image[..., 1], image[..., 2]).astype(np.int16)
    warm = (other < _MAX_OTHER_PIXEL * red) & (red - other > _MIN_RED_LEAD)
    if not warm.any():
        return []
    count, patches, stats, _ = cv2.connectedComponentsWithStats(
        warm.astype(np.uint8), connectivity=8
    )
    labels = np.asarray(patches, np.int32)
    owner = labels[warm]
    sums = [np.bincount(owner, image[..., c][warm], count) for c in range(3)]
    is_red = np.maximum(sums[1], sums[2]) < _MAX_OTHER_PATCH * sums[0]
    is_red &= stats[:, cv2.CC_STAT_AREA] >= _MIN_PIXELS
    is_red[0] = False
    found = np.flatnonzero(is_red)
    found = found[np.argsort(-stats[found, cv2.CC_STAT_AREA], kind="stable")][:_MAX_DISCS]
    return [_measure(image, labels, stats[label], int(label)) for label in found]


def find_disc(image: npt.NDArray[np.uint8]) -> Disc | None:
    """Find the largest red patch.

    Args:
        image: RGB, uint8 (H, W, 3).

    Returns:
        The disc, or None where nothing is red enough.
    """
    return next(iter(find_discs(image)), None)


def _measure(
    image: npt.NDArray[np.uint8],
    labels: npt.NDArray[np.int32],
    box: npt.NDArray[np.integer],
    label: int,
) -> Disc:
    """Moments of one patch, each pixel weighed by how far it lies from background to disc red."""
    left, top, width, height = (int(value) for value in box[:4])
    rows, columns = labels.shape
    margin = _EDGE_PX + _BACKGROUND_PX
    r0, r1 = max(0, top - margin), min(rows, top + height + margin)
    c0, c1 = max(0, left - margin), min(columns, left + width + margin)
    window = image[r0:r1, c0:c1].astype(np.float64)
    # Linear in the channels, so that pixel noise has no mean here.
    lead = window[..., 0] - 0.5 * (window[..., 1] + window[..., 2])
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
    centre = np.array(
        [
            c0 + float(weight.sum(axis=0) @ np.arange(c1 - c0)) / total,
            r0 + float(weight.sum(axis=1) @ np.arange(r1 - r0)) / total,
        ]
    )
    is_cut = left == 0 or top == 0 or left + width == columns or top + height == rows
    return Disc(centre, total, is_cut)
