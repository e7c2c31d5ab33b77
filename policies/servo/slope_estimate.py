"""Where a target is that may lie at any height and slope: first its place, then its ring of marks.

From afar an eye sees the target alone: a place, where the rays of all looks meet. From near it sees
the marks around it, and their ring is fitted to all looks at once (see
`hvs_suite.tasks.shared.pattern_pose`).
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from hvs_suite.tasks.shared.detection import Disc
from hvs_suite.tasks.shared.pattern_pose import Look, Ring, RingFit, RingPose, axes, fit, match

FloatArray = npt.NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_RAY_RAD = 0.004
"""Standard deviation of a ray, calibration included (rad)."""
_SIZE_SHARE = 0.06
"""Standard deviation of a distance that was told from the target's size, in distances."""
_OUTLIER_M = 0.05
_MAX_OUTLIERS = 3
_MAX_LOOKS = 40
_MAX_LOST = 4
"""In how many pictures on end the marks may not be where they have to be."""
_MAX_MISSES = 4.0
"""Root mean square of a fit's misses, in their standard deviations, that is believed."""


class SlopeEstimate:
    """Fuses what the cameras saw of one target on a panel.

    Args:
        ring: The marks around it.
        diameter_m: Of the target (m).
        height_m: Least and largest height that a target may have (m).
    """

    def __init__(self, ring: Ring, diameter_m: float, height_m: tuple[float, float]) -> None:
        self._ring = ring
        self._diameter_m = diameter_m
        self._height_m = height_m
        self._rays: list[tuple[FloatArray, FloatArray]] = []
        self._looks: list[Look] = []
        self._eth: tuple[FloatArray, FloatArray] | None = None
        self._outliers = self._n_lost = 0
        self.place: FloatArray | None = None
        """Of the target, (3,) m; None before any camera has seen it."""
        self.fit: RingFit | None = None
        """Of the marks; None before they have been told apart."""

    @property
    def is_seen_closely(self) -> bool:
        """Whether the eye in the hand has seen the target."""
        return bool(self._rays)

    @property
    def n_looks(self) -> int:
        """How many pictures show the marks."""
        return len(self._looks)

    def see_eth(self, disc: Disc, K: FloatArray, T: FloatArray, sigma_m: float) -> None:
        """Take in a patch in the eye to hand's picture; its calibration has that deviation."""
        direction = _ray(disc.centre, K, T)
        weight = (np.eye(3) - np.outer(direction, direction)) / sigma_m**2
        self._eth = weight, weight @ _eye(T)
        self._locate()

    def see_eih(self, discs: Sequence[Disc], K: FloatArray, T: FloatArray) -> None:
        """Take in the patches in the picture of the eye in the hand, the largest first."""
        if self.fit is None:
            self._see_target(discs, K, T)
        if self.place is None:
            return
        guess = self._first_guess(discs, K, T) if self.fit is None else self.fit.pose
        look = match(discs, self._ring, guess, K, T) if guess is not None else None
        # All marks have to be told apart at first; later any look will do.
        if guess is None or look is None:
            # The target itself is in view, and where its marks have to be there are none.
            self._n_lost += self.fit is not None and bool(discs) and not discs[0].is_cut
            if self._n_lost > _MAX_LOST:
                self._forget_marks()
            return
        if self.fit is None and len(look.marks) < self._ring.n_marks:
            return
        looks = [*self._looks, look][-_MAX_LOOKS:]
        found = fit(looks, self._ring, guess, K)
        if found.misses > _MAX_MISSES:
            # Something else was taken for a mark, now or before.
            self._forget_marks()
            return
        self._looks, self.fit, self._n_lost = looks, found, 0
        self.place = found.pose.target

    def _forget_marks(self) -> None:
        """Begin again with the place of the target alone."""
        self._looks, self.fit, self._n_lost = [], None, 0
        self._rays = self._rays[-1:]

    def _see_target(self, discs: Sequence[Disc], K: FloatArray, T: FloatArray) -> None:
        """Take the largest patch that is not cut for the target, where its size can be right."""
        for disc in discs[:3]:
            direction, eye = _ray(disc.centre, K, T), _eye(T)
            if disc.is_cut or direction[2] > -0.1:
                continue
            depth = K[0, 0] * self._diameter_m / disc.diameter
            place = eye + depth / float(T[2, :3] @ direction) * direction
            low, high = self._height_m
            slack = 0.1 + 3.0 * _SIZE_SHARE * depth
            if not low - slack <= place[2] <= high + slack:
                continue
            if self.place is not None and self._rays:
                # Where one look is not like the others, it is not of the target; or they are not.
                ray = self.place - eye
                off = float(np.linalg.norm(ray - ray @ direction * direction))
                if off > _OUTLIER_M:
                    self._outliers += 1
                    if self._outliers < _MAX_OUTLIERS:
                        return
                    self._rays = []
            self._outliers = 0
            along, across = (_SIZE_SHARE * depth) ** -2, (_RAY_RAD * depth) ** -2
            outer = np.outer(direction, direction)
            weight = across * (np.eye(3) - outer) + along * outer
            self._rays.append((weight, weight @ place))
            self._locate()
            return

    def _locate(self) -> None:
        """The place where all rays meet, with what is known of its height."""
        low, high = self._height_m
        information = np.diag([1e-6, 1e-6, (0.5 * (high - low)) ** -2])
        weighted = information @ [0.0, 0.0, 0.5 * (low + high)]
        seen = [self._eth] if self._eth is not None and not self._rays else self._rays
        for matrix, vector in seen:
            information, weighted = information + matrix, weighted + vector
        self.place = np.linalg.solve(information, weighted)

    def _first_guess(self, discs: Sequence[Disc], K: FloatArray, T: FloatArray) -> RingPose | None:
        """A level ring, turned like the patches around the target."""
        assert self.place is not None
        n = self._ring.n_marks
        if len(discs) <= n:
            return None
        optical = T[:3, :3] @ self.place + T[:3, 3]
        if optical[2] <= 0.02:
            return None
        rays = np.array([_ray(disc.centre, K, T) for disc in discs[1 : n + 1]])
        eye = _eye(T)
        reach = (self.place[2] - eye[2]) / np.minimum(rays[:, 2], -1e-3)
        flat = (eye + reach[:, None] * rays - self.place) @ axes(_UP).T
        turn = float(np.angle(np.exp(1j * n * np.arctan2(flat[:, 1], flat[:, 0])).mean())) / n
        return RingPose(self.place, _UP, turn)


def _ray(uv: FloatArray, K: FloatArray, T: FloatArray) -> FloatArray:
    """Direction (3,) in the base frame of a pixel's ray."""
    ray = T[:3, :3].T @ np.linalg.solve(K, [*uv, 1.0])
    return np.asarray(ray / math.sqrt(ray @ ray))


def _eye(T: FloatArray) -> FloatArray:
    """Where a camera is, (3,) m."""
    return np.asarray(-T[:3, :3].T @ T[:3, 3])
