"""The pose of a ring of marks, fitted to all that an eye in the hand saw of it.

Bundle adjustment with known cameras (Triggs et al., "Bundle adjustment: a modern synthesis", 2000,
section 2): six numbers, the ring's place, slope and turn, such that its marks project to where they
were seen, by least squares with a robust loss. All pictures count at once. One from near tells the
slope by perspective: a ring of radius r that leans by a small angle a at a distance z moves its
marks by f a r^2 / z^2 px.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from hvs_suite.cell.cameras import project
from hvs_suite.cell.kinematics import tool_frame
from hvs_suite.tasks.shared.detection import Disc

FloatArray = npt.NDArray[np.float64]

CENTRE_PX = 0.06
CENTRE_SMALL_PX = 0.5
"""Standard deviation of a mark's centre: this, and that over the root of its area (px)."""
_ROBUST_SIGMAS = 3.0
_MIN_MARKS = 3
_NEAR_SHARE = 0.35
"""A patch is a mark if it is no farther from where one has to be than this share of their gap."""
_STEPS = (1.0, 1.0, 1.0, 0.01, 0.01, 0.01)
"""Of the six numbers, how far each is changed at first: mm, and rad."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ring:
    """Marks evenly spaced around a target, as the drawing has them.

    Attributes:
        radius_m: Of the ring (m).
        n_marks: How many.
        sag_m: How far they lie below the plane that touches the surface at the target (m).
    """

    radius_m: float
    n_marks: int
    sag_m: float = 0.0

    def points(self, pose: "RingPose") -> FloatArray:
        """Centres of the marks, (n, 3) m."""
        turns = pose.turn + 2.0 * math.pi * np.arange(self.n_marks) / self.n_marks
        flat = np.stack([np.cos(turns), np.sin(turns)], axis=1) * self.radius_m
        across = axes(pose.normal)
        return np.asarray(pose.target + flat @ across - self.sag_m * pose.normal)


@dataclasses.dataclass(frozen=True, eq=False)
class RingPose:
    """Where a ring of marks is.

    Attributes:
        target: Its centre on the surface, (3,) m, base frame.
        normal: Outward unit normal there, (3,).
        turn: Of the first mark about the normal (rad).
    """

    target: FloatArray
    normal: FloatArray
    turn: float


@dataclasses.dataclass(frozen=True, eq=False)
class RingFit:
    """A pose and its uncertainty.

    Attributes:
        pose: The pose.
        sigmas: Standard deviations of the fit: of the place in the base frame (m), three, of the
            slope about two axes along the surface (rad), and of the turn (rad), (6,).
        misses: Root mean square of the distances from where marks were seen, in their standard
            deviations.
    """

    pose: RingPose
    sigmas: FloatArray
    misses: float


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """What one picture shows of the ring.

    Attributes:
        T: Extrinsics of the camera, (4, 4), base to optical frame.
        centres: Of the patches taken for marks, (m, 2) px.
        sigmas: Their standard deviations, (m,) px.
        marks: Which mark each of them is, (m,), counted from the one at the ring's turn.
    """

    T: FloatArray
    centres: FloatArray
    sigmas: FloatArray
    marks: npt.NDArray[np.intp]


def match(
    discs: Sequence[Disc], ring: Ring, pose: RingPose, K: FloatArray, T: FloatArray
) -> Look | None:
    """Tell which patches of a picture are which marks, by where they have to be.

    Args:
        discs: Patches; those that the border cuts are left out.
        ring: The marks.
        pose: Where they are believed to be.
        K: Intrinsics, (3, 3) px.
        T: Extrinsics, (4, 4).

    Returns:
        The marks that were found; None where they are too few.
    """
    expected = project(ring.points(pose), K, T)
    whole = [disc for disc in discs if not disc.is_cut]
    if (expected[:, 2] <= 0.0).any() or not whole:
        return None
    centres = np.array([disc.centre for disc in whole])
    gap = float(np.linalg.norm(np.diff(expected[:, :2], axis=0), axis=1).min())
    away = np.linalg.norm(centres[:, None] - expected[None, :, :2], axis=2)
    nearest = away.argmin(axis=1)
    # One patch for each mark, the nearest.
    best = away.argmin(axis=0)[nearest] == np.arange(len(whole))
    taken = best & (away.min(axis=1) <= _NEAR_SHARE * gap)
    if taken.sum() < _MIN_MARKS:
        return None
    areas = np.array([disc.area for disc in whole])[taken]
    sigmas = CENTRE_PX + CENTRE_SMALL_PX / np.sqrt(np.maximum(areas, 1.0))
    return Look(T, centres[taken], sigmas, nearest[taken])


def fit(looks: Sequence[Look], ring: Ring, start: RingPose, K: FloatArray) -> RingFit:
    """The pose that explains all looks best.

    Args:
        looks: At least one.
        ring: The marks.
        start: A first guess.
        K: Intrinsics of the camera, (3, 3) px.
    """
    sigmas = np.concatenate([look.sigmas for look in looks])[:, None]
    seen = np.concatenate([look.centres for look in looks])
    rotations = np.concatenate([np.repeat(k.T[None, :3, :3], len(k.marks), 0) for k in looks])
    shifts = np.concatenate([np.repeat(k.T[None, :3, 3], len(k.marks), 0) for k in looks])
    marks = np.concatenate([look.marks for look in looks])
    across = axes(start.normal)

    def moved(change: FloatArray) -> RingPose:
        normal = start.normal + change[3:5] @ across
        target = start.target + 1e-3 * change[:3]
        return RingPose(target, normal / np.linalg.norm(normal), start.turn + float(change[5]))

    def residuals(change: FloatArray) -> FloatArray:
        points = ring.points(moved(change))[marks]
        optical = np.einsum("nij,nj->ni", rotations, points) + shifts
        uv = optical[:, :2] / np.maximum(optical[:, 2:], 1e-3) * K[0, 0] + K[:2, 2]
        return np.asarray(((uv - seen) / sigmas).ravel())

    found = least_squares(
        residuals, np.zeros(6), loss="soft_l1", f_scale=_ROBUST_SIGMAS, x_scale=_STEPS
    )
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    scale = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])
    misses = float(np.sqrt(np.mean(found.fun**2)))
    return RingFit(moved(found.x), scale * np.sqrt(np.diag(covariance)), misses)


def axes(normal: FloatArray) -> FloatArray:
    """Two unit vectors along the surface, (2, 3)."""
    frame = tool_frame(normal)
    # The tool faces the surface: its y axis is turned over to look from outside.
    return np.stack([frame[:, 0], -frame[:, 1]])
