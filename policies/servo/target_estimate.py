"""Where the target is: both cameras' views of it, turned into places on the surface and fused.

All places are in the base frame as the robot's encoders show it: where encoders have a zero error,
that frame is a little off near the target, and so is every set point, which cancels.
"""

import dataclasses

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.cameras import project
from hvs_suite.cell.marker import HALF_THICKNESS_M
from hvs_suite.tasks.shared.detection import DRAWN_AREA, Disc, intersect, outline

FloatArray = npt.NDArray[np.float64]

DISC_PLANE_M = 2.0 * HALF_THICKNESS_M
"""Height of the disc's face above the surface (m)."""

# Standard deviations. A centre of area is good to a fraction of a pixel, less where few pixels
# show it; encoders are zeroed to about the following.
_CENTRE_PX = 0.08
_CENTRE_SMALL_PX = 0.6
_ENCODER_RAD = 0.001
_HEIGHT_PRIOR_M = 0.001
_EDGE_PX = 0.06
# A turn of the hand by 1 rad changes what encoder errors do as much as a move of this length.
_TURN_M = 0.3
_RING_MARGIN_M = 0.09
_OUTLIER_M = 0.01
_OUTLIER_SIGMA = 6.0
_MAX_OUTLIERS = 2
_UPRIGHT_COS = float(np.cos(np.radians(4.0)))


@dataclasses.dataclass(frozen=True, eq=False)
class Sighting:
    """A patch that may be the target.

    Attributes:
        place: x and y on the surface (m, base frame), (2,).
        covariance: Of the place, from the picture alone (m^2), (2, 2).
        area_ratio: Area seen over the area expected at that place.
        is_whole: Whether neither the border nor an obstacle cuts it.
        depth_m: Distance along the optical axis (m).
        diameter_px: Diameter of a circle of the area expected there (px).
    """

    place: FloatArray
    covariance: FloatArray
    area_ratio: float
    is_whole: bool
    depth_m: float
    diameter_px: float


class Sight:
    """Judges patches by what the target would look like there.

    Args:
        diameter_m: Diameter of the target (m).
        ring_m: Inner and outer radius of the ring of targets (m).
        hole_share: Share of the disc's area that a hole in its middle takes.
    """

    def __init__(
        self, diameter_m: float, ring_m: tuple[float, float], hole_share: float = 0.0
    ) -> None:
        self._diameter_m = diameter_m
        self._ring_m = ring_m
        self._hole_share = hole_share

    def sighting(
        self, disc: Disc, K: FloatArray, T: FloatArray, surface_m: float
    ) -> Sighting | None:
        """Take a patch for the target, or None where it cannot be.

        Args:
            disc: The patch.
            K: Intrinsics of the camera, (3, 3) px.
            T: Extrinsics as believed, (4, 4).
            surface_m: Height of the surface as believed (m).
        """
        height = surface_m + DISC_PLANE_M
        place = intersect(disc.centre[None], K, T, height)
        if place is None:
            return None
        expected = outline(place[0], self._diameter_m, K, T, height)
        if expected is None:
            return None
        area, drawn_centre = expected[0] * DRAWN_AREA * (1.0 - self._hole_share), expected[1]
        middle = project(np.array([*place[0], height]), K, T)[:2]
        # Perspective shifts a disc's centre with its area, so what a hole leaves the more.
        centre = disc.centre - (1.0 + self._hole_share) * (drawn_centre - middle)
        # The point and its neighbours one pixel to the right and below: place and derivative.
        places = intersect(np.add(centre, [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), K, T, height)
        if places is None:
            return None
        radius = float(np.hypot(*places[0]))
        if not self._ring_m[0] - _RING_MARGIN_M <= radius <= self._ring_m[1] + _RING_MARGIN_M:
            return None
        slack = 4.0 + 0.5 * area
        if disc.area > area + slack or (not disc.is_cut and disc.area < 0.15 * area):
            return None
        ratio = disc.area / area
        is_whole = not disc.is_cut and disc.area > 0.85 * area
        sigma = _CENTRE_PX + _CENTRE_SMALL_PX / np.sqrt(max(disc.area, 1.0))
        if not is_whole:
            sigma += 0.5 * np.sqrt(area) * max(0.3, 1.0 - ratio)
        slope = (places[1:] - places[0]).T
        depth = float(project(np.array([*places[0], height]), K, T)[2])
        return Sighting(
            place=places[0],
            covariance=sigma**2 * slope @ slope.T,
            area_ratio=ratio,
            is_whole=is_whole,
            depth_m=depth,
            diameter_px=float(2.0 * np.sqrt(area / np.pi)),
        )


class TargetEstimate:
    """Fuses what the cameras saw of a target that stands still.

    The eye-to-hand camera's calibration error is common to all its pictures, so they are averaged
    first and the error is added once. The eye-in-hand camera's error changes as the arm moves: its
    estimate is a Kalman filter whose uncertainty grows with the way of the hand.

    Args:
        eth_sigma_m: Standard deviation that the eye-to-hand camera's calibration has on the
            surface (m).
    """

    def __init__(self, eth_sigma_m: float) -> None:
        # Never quite 0, because no pose is certain to a hundredth of a millimetre.
        self._eth_variance = eth_sigma_m**2 + 1e-10
        self._eth_information = np.zeros((2, 2))
        self._eth_weighted = np.zeros(2)
        self._eih_place: FloatArray | None = None
        self._eih_covariance: FloatArray = np.zeros((2, 2))
        self._outliers = 0
        self._lift_m = 0.0
        self._lift_variance = _HEIGHT_PRIOR_M**2

    @property
    def is_known(self) -> bool:
        """Whether any camera has seen the target."""
        return self._eih_place is not None or bool(self._eth_information.any())

    @property
    def in_hand_sigma_m(self) -> float:
        """Standard deviation (m) of the eye-in-hand estimate; infinite before the first sight."""
        if self._eih_place is None:
            return np.inf
        return float(np.sqrt(np.linalg.eigvalsh(self._eih_covariance)[-1]))

    @property
    def surface_m(self) -> float:
        """Height of the surface in the encoders' frame (m); 0 unless encoders are off."""
        return -self._lift_m

    def place(self) -> tuple[FloatArray, float]:
        """Place in x and y of the target (2,) in m and their largest standard deviation (m)."""
        information, weighted = np.zeros((2, 2)), np.zeros(2)
        if self._eth_information.any():
            picture = np.linalg.inv(self._eth_information)
            eth = np.linalg.inv(picture + self._eth_variance * np.eye(2))
            information += eth
            weighted += eth @ picture @ self._eth_weighted
        if self._eih_place is not None:
            eih = np.linalg.inv(self._eih_covariance)
            information += eih
            weighted += eih @ self._eih_place
        covariance = np.linalg.inv(information)
        return covariance @ weighted, float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))

    def move(self, way_m: float, turn_rad: float) -> None:
        """The hand moved by a way (m) and turned (rad) since the last picture."""
        growth = (_ENCODER_RAD * (way_m + _TURN_M * turn_rad)) ** 2
        self._eih_covariance = self._eih_covariance + growth * np.eye(2)
        self._lift_variance += growth

    def see_eth(self, sighting: Sighting) -> None:
        """Take in a sighting by the eye-to-hand camera."""
        information = np.linalg.inv(sighting.covariance)
        self._eth_information += information
        self._eth_weighted += information @ sighting.place

    def see_eih(self, sighting: Sighting) -> None:
        """Take in a sighting by the eye-in-hand camera."""
        noise = sighting.covariance + (_ENCODER_RAD * sighting.depth_m) ** 2 * np.eye(2)
        if self._eih_place is None:
            self._eih_place, self._eih_covariance = sighting.place.copy(), noise
            return
        innovation = sighting.place - self._eih_place
        total = self._eih_covariance + noise
        distance = float(np.sqrt(innovation @ np.linalg.solve(total, innovation)))
        if distance > _OUTLIER_SIGMA and np.linalg.norm(innovation) > _OUTLIER_M:
            self._outliers += 1
            if self._outliers >= _MAX_OUTLIERS:
                self._eih_place, self._eih_covariance = sighting.place.copy(), noise
                self._outliers = 0
            return
        self._outliers = 0
        gain = self._eih_covariance @ np.linalg.inv(total)
        self._eih_place = self._eih_place + gain @ innovation
        self._eih_covariance = (np.eye(2) - gain) @ self._eih_covariance

    def see_height(self, sighting: Sighting, axis_down: float) -> None:
        """Take the disc's apparent size for the distance.

        The area goes with the inverse square of the distance; an edge that is off by e px makes the
        distance wrong by the share 2 e / diameter.

        Args:
            sighting: By the eye-in-hand camera.
            axis_down: Cosine of the angle between the optical axis and straight down.
        """
        if not sighting.is_whole or axis_down < _UPRIGHT_COS:
            return
        longer = sighting.depth_m * (1.0 / np.sqrt(sighting.area_ratio) - 1.0)
        noise = (sighting.depth_m * _EDGE_PX / sighting.diameter_px) ** 2
        gain = self._lift_variance / (self._lift_variance + noise)
        self._lift_m += gain * longer
        self._lift_variance *= 1.0 - gain
