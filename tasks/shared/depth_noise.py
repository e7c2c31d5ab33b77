"""What a depth camera makes of true depth: noise, steps and holes, as in structured light.

Such a camera measures disparities. For a focal length f (px) and a baseline b (m), a depth z has
the disparity d = f b / z, which is found with a standard deviation s and stored in eighths of a
pixel. So depth has the standard deviation z^2 s / (f b), and steps of z^2 / (8 f b): both grow with
the square of the distance (Khoshelham and Oude Elberink, "Accuracy and resolution of Kinect depth
data for indoor mapping applications", Sensors 12(2), 2012, equations 7 to 10). Beside an edge the
camera sees what the projector does not light: there is no measurement (ibid., section 3.1).
"""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

SENSOR_PX = 640
"""Width of the sensor whose pixels disparities are counted in."""
BASELINES_M: Mapping[str, float] = MappingProxyType({"eih": 0.018, "eth": 0.075})
"""Between projector and camera: as small as in a hand's, as wide as in a room's depth camera."""
_STEPS_A_PX = 8.0
_EDGE_PX = 1.0
"""Difference of disparities between neighbours from which on one is in the other's shadow."""


def as_measured(
    depth: npt.NDArray[np.float32],
    fov_deg: float,
    baseline_m: float,
    sigma_px: float,
    random: np.random.Generator,
) -> npt.NDArray[np.float32]:
    """A depth picture as a structured-light camera gives it.

    Args:
        depth: True depth along the optical axis, (H, W, 1) m.
        fov_deg: Field of view (deg).
        baseline_m: Distance of projector and camera (m).
        sigma_px: Standard deviation of a disparity (px of a sensor 640 px wide).
        random: Draws.

    Returns:
        Measured depth, float32 (H, W, 1) m; 0 where there is no measurement.
    """
    scale = baseline_m * 0.5 * SENSOR_PX / math.tan(math.radians(fov_deg) / 2.0)
    disparity = scale / np.maximum(depth[..., 0].astype(np.float64), 1e-3)
    lit = maximum_filter(disparity, 3) - minimum_filter(disparity, 3) <= _EDGE_PX * (
        # A slope that fills a coarse picture's pixel changes more than it would in a fine one's.
        SENSOR_PX / depth.shape[1]
    )
    noisy = disparity + sigma_px * random.normal(size=disparity.shape)
    stored = np.rint(noisy * _STEPS_A_PX) / _STEPS_A_PX
    seen = lit & (stored > 0.0)
    measured = np.where(seen, scale / np.where(seen, stored, 1.0), 0.0)
    return np.asarray(measured[..., None], np.float32)
