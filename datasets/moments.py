"""Count, extremes, mean and deviation of a feature, computed as LeRobot computes them.

LeRobot's quantiles are histogram estimates averaged over episodes; they are not checked.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

# LeRobot takes every n-th pixel of pictures from 300 px on, so that some 150 are left.
_DOWNSAMPLE_FROM_PX = 300
_DOWNSAMPLE_TO_PX = 150
_MAX_SAMPLED = 100
_MIN_POWER_SAMPLES = 10_000
_RELATIVE = 2e-5


@dataclasses.dataclass(frozen=True, eq=False)
class Moments:
    """Statistics of some values of k dimensions.

    Attributes:
        count: Frames.
        low: Least values (k,).
        high: Greatest values (k,).
        mean: Means (k,).
        variance: Variances (k,), population.
    """

    count: int
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    variance: FloatArray

    @classmethod
    def of(cls, values: npt.NDArray[Any], count: int | None = None) -> Self:
        """Moments of values (n, k), which stand for ``count`` frames (n by default).

        Sums run in the precision that LeRobot uses: over a picture's pixels its float32 sums are
        off by up to a thousandth, which would otherwise count as damage.
        """
        values = values.astype(np.result_type(values.dtype, np.float32), copy=False)
        mean = np.mean(values, axis=0)
        squares = np.mean(values**2, axis=0)
        return cls(
            len(values) if count is None else count,
            np.min(values, axis=0).astype(np.float64),
            np.max(values, axis=0).astype(np.float64),
            mean.astype(np.float64),
            np.maximum(squares - mean**2, 0.0).astype(np.float64),
        )

    def scaled(self, factor: float) -> Self:
        """Moments of the values times a factor."""
        return dataclasses.replace(
            self,
            low=self.low * factor,
            high=self.high * factor,
            mean=self.mean * factor,
            variance=self.variance * factor**2,
        )


def sample(pictures: Sequence[npt.NDArray[np.uint8]]) -> Moments:
    """Moments by channel of an episode's pictures, in [0, 1], from the pixels LeRobot samples.

    Args:
        pictures: uint8 (H, W, 3) each, all alike in shape.
    """
    chosen = sampled_pictures(pictures)
    return Moments.of(chosen.reshape(-1, chosen.shape[-1]), len(chosen)).scaled(1.0 / 255.0)


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
    chosen = np.stack([pictures[i][::step, ::step] for i in indices])
    if taken > 1:
        return chosen
    # Of a single picture LeRobot sums plane by plane, which rounds otherwise than pixel by pixel.
    return np.ascontiguousarray(chosen.transpose(0, 3, 1, 2)).transpose(0, 2, 3, 1)


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
    scale = _RELATIVE * np.maximum(size, np.maximum(np.abs(found.low), np.abs(found.high))) + 1e-7
    wanted = {"mean": (found.mean, scale + slack)}
    if not slack:
        wanted |= {"min": (found.low, scale), "max": (found.high, scale)}
    for name, (right, tolerance) in wanted.items():
        if values[name].shape != right.shape:
            return f"{name} has {values[name].size} values, not {right.size}"
        # Written so that NaN fails.
        if not np.all(np.abs(values[name] - right) <= tolerance):
            return _worst(name, values[name], right)
    if not slack:
        tolerance = _RELATIVE * (found.variance + found.mean**2) + 1e-9
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
