"""Count, extremes, mean and deviation of a feature, of the values that LeRobot looks at.

LeRobot's quantiles are histogram estimates averaged over episodes; they are not checked.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

# LeRobot takes every n-th pixel of pictures from 300 px on, so that some 150 are left.
_DOWNSAMPLE_FROM_PX = 300
_DOWNSAMPLE_TO_PX = 150
_MAX_SAMPLED = 100
_MIN_POWER_SAMPLES = 10_000
_ROUNDING = 2e-5
# LeRobot adds up the pixels of all pictures in float32, which loses up to a hundredth.
_PICTURE_ROUNDING = 1e-2
_SHADES = np.arange(256.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Moments:
    """Statistics of some values of k dimensions.

    Attributes:
        count: Frames.
        low: Least values (k,).
        high: Greatest values (k,).
        mean: Means (k,).
        variance: Variances (k,), population.
        rounding: Relative error that the sums of the listed statistics may have.
    """

    count: int
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    variance: FloatArray
    rounding: float = _ROUNDING

    @classmethod
    def of(cls, values: npt.NDArray[Any]) -> Self:
        """Moments of values (n, k), their sums in the precision that LeRobot uses."""
        values = values.astype(np.result_type(values.dtype, np.float32), copy=False)
        mean = np.mean(values, axis=0)
        squares = np.mean(values**2, axis=0)
        return cls(
            len(values),
            np.min(values, axis=0).astype(np.float64),
            np.max(values, axis=0).astype(np.float64),
            mean.astype(np.float64),
            np.maximum(squares - mean**2, 0.0).astype(np.float64),
        )

    @classmethod
    def of_shades(cls, counts: npt.NDArray[np.int64], frames: int) -> Self:
        """Moments by channel, in [0, 1], of pixels counted by shade.

        Args:
            counts: As ``shade_counts`` gives them, (256, c).
            frames: Pictures that were counted.
        """
        pixels = counts.sum(axis=0)
        mean = _SHADES @ counts / pixels
        variance = np.maximum(_SHADES**2 @ counts / pixels - mean**2, 0.0)
        low = (counts > 0).argmax(axis=0)
        high = 255 - (counts[::-1] > 0).argmax(axis=0)
        return cls(
            frames, low / 255.0, high / 255.0, mean / 255.0, variance / 255.0**2, _PICTURE_ROUNDING
        )


def sample(pictures: Sequence[npt.NDArray[np.uint8]]) -> Moments:
    """Moments by channel of an episode's pictures, in [0, 1], from the pixels LeRobot samples.

    Args:
        pictures: uint8 (H, W, 3) each, all alike in shape.
    """
    chosen = sampled_pictures(pictures)
    return Moments.of_shades(shade_counts(chosen), len(chosen))


def shade_counts(pictures: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """How many pixels of pictures (n, h, w, c) have each shade, (256, c)."""
    n, height, _, channels = pictures.shape
    flat = pictures.reshape(n * height, -1, channels)
    counts = [cv2.calcHist([flat], [c], None, [256], [0, 256]) for c in range(channels)]
    return np.concatenate(counts, axis=1).astype(np.int64)


def sampled_pictures(pictures: Sequence[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """The pixels of an episode that LeRobot looks at: not all pictures, not all of a large one.

    Args:
        pictures: uint8 (H, W, C) each, all alike in shape.

    Returns:
        uint8 (n, h, w, C).
    """
    n = len(pictures)
    taken = max(min(n, _MAX_SAMPLED), min(int(n**0.75), _MIN_POWER_SAMPLES))
    indices = np.round(np.linspace(0, n - 1, taken)).astype(int)
    side = max(pictures[0].shape[:2])
    step = 1 if side < _DOWNSAMPLE_FROM_PX else int(side / _DOWNSAMPLE_TO_PX)
    return np.stack([pictures[i][::step, ::step] for i in indices])


def merge(parts: Sequence[Moments]) -> Moments:
    """Moments of all parts together, weighed by their frames."""
    counts = np.array([part.count for part in parts], np.float64)[:, None]
    means = np.stack([part.mean for part in parts])
    mean = (means * counts).sum(axis=0) / counts.sum()
    variances = np.stack([part.variance for part in parts])
    variance = ((variances + (means - mean) ** 2) * counts).sum(axis=0) / counts.sum()
    return Moments(
        int(counts.sum()),
        np.min([part.low for part in parts], axis=0),
        np.max([part.high for part in parts], axis=0),
        mean,
        variance,
        max(part.rounding for part in parts),
    )


def compare(found: Moments, listed: Mapping[str, Any], slack: float = 0.0) -> str:
    """What a listed set of statistics says otherwise, in words; empty where nothing.

    Args:
        found: Moments of the frames.
        listed: ``count``, ``min``, ``max``, ``mean`` and ``std``, as LeRobot nests them.
        slack: Further difference allowed of means, where pictures were compressed after LeRobot
            had looked at them; extremes and deviations are then not compared.
    """
    try:
        count = int(np.ravel(listed["count"])[0])
        values = {
            name: np.ravel(np.asarray(listed[name], np.float64))
            for name in ("min", "max", "mean", "std")
        }
    except (KeyError, TypeError, ValueError, IndexError) as error:
        return f"lacks {error}"
    if count != found.count:
        return f"count is {count}, not {found.count}"
    size = np.abs(found.mean) + np.sqrt(found.variance)
    size = np.maximum(size, np.maximum(np.abs(found.low), np.abs(found.high)))
    wanted = {"mean": (found.mean, found.rounding * size + 1e-7 + slack)}
    if not slack:
        exact = _ROUNDING * size + 1e-7
        wanted |= {"min": (found.low, exact), "max": (found.high, exact)}
    for name, (right, tolerance) in wanted.items():
        if values[name].shape != right.shape:
            return f"{name} has {values[name].size} values, not {right.size}"
        # Written so that NaN fails.
        if not np.all(np.abs(values[name] - right) <= tolerance):
            return _worst(name, values[name], right)
    if not slack:
        tolerance = found.rounding * (found.variance + found.mean**2) + 1e-9
        if not np.all(np.abs(values["std"] ** 2 - found.variance) <= tolerance):
            return _worst("std", values["std"], np.sqrt(found.variance))
    return ""


def compare_all(
    found: Mapping[str, Moments],
    listed: Mapping[str, Mapping[str, Any]],
    slack: Mapping[str, float],
) -> dict[str, str]:
    """Features whose listed statistics differ, with what differs."""
    compared = {
        name: compare(each, listed[name], slack.get(name, 0.0)) for name, each in found.items()
    }
    return {name: what for name, what in compared.items() if what}


def _worst(name: str, listed: FloatArray, right: FloatArray) -> str:
    away = np.nan_to_num(np.abs(listed - right), nan=np.inf)
    worst = int(np.argmax(away))
    return f"{name}[{worst}] is {listed[worst]:.6g}, the frames give {right[worst]:.6g}"
