"""Finding the red target in a picture by its colour: the certificates' proof that it can be seen.

A plain classical method on purpose: if this finds the disc under a variant's own light, colours,
texture and noise, the picture holds the information that the task needs.
"""

import dataclasses

import cv2
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

# The target's green and blue stay below 0.3 of its red; the robot's orange has 0.43. Red less 2.6
# times the others is thus positive on the target alone, and the least value below is more than two
# sigma of it under the hardest variant's pixel noise.
_OTHERS_WEIGHT = 2.6
_MIN_PURITY = 22.0


@dataclasses.dataclass(frozen=True, eq=False)
class Disc:
    """A disc in a picture.

    Attributes:
        centre: u and v (px, pixel centres whole), (2,).
        diameter: Diameter of a circle of the same area (px).
    """

    centre: FloatArray
    diameter: float


def find_disc(image: npt.NDArray[np.uint8]) -> Disc | None:
    """Find the reddest blob.

    Pixels on the edge count by how red they are, between the disc's own red and the background's,
    so that centre and diameter are good to a fraction of a pixel.

    Args:
        image: RGB, uint8 (H, W, 3).

    Returns:
        The disc, or None where nothing is red enough.
    """
    smooth = image.astype(np.float32)
    red = smooth[..., 0]
    other = np.maximum(smooth[..., 1], smooth[..., 2])
    lead = red - other
    mask = (red - _OTHERS_WEIGHT * other > _MIN_PURITY).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return None
    strength = [float(lead[labels == i].sum()) for i in range(1, count)]
    best = 1 + int(np.argmax(strength))
    left, top, width, height = stats[best, :4]
    # One pixel of margin takes in the edge; the disc's own level comes from its inside.
    rows = slice(max(0, top - 2), top + height + 2)
    columns = slice(max(0, left - 2), left + width + 2)
    near = cv2.dilate((labels == best).astype(np.uint8), np.ones((3, 3), np.uint8))[rows, columns]
    window = lead[rows, columns]
    level = float(np.median(lead[labels == best]))
    around = window[near == 0]
    background = float(np.median(around)) if around.size else 0.0
    weight = np.clip((window - background) / (level - background), 0.0, 1.0) * near
    total = float(weight.sum())
    v, u = np.mgrid[
        rows.start : rows.start + weight.shape[0], columns.start : columns.start + weight.shape[1]
    ]
    centre = np.array([(weight * u).sum() / total, (weight * v).sum() / total])
    return Disc(centre, 2.0 * float(np.sqrt(total / np.pi)))
