"""Statistics of an episode, as LeRobot 0.6 computes them, and much cheaper.

LeRobot keeps least, greatest, mean, deviation and five quantiles of every dimension. It estimates
the quantiles with histograms of 5000 bins; here the bin of each value is looked up instead of
counting into all of them. Columns of numbers come out number for number the same. Pixels are
counted by shade, so that means and deviations are exact, where LeRobot's float32 sums lose up to
a hundredth, and the deviation of an even picture up to a tenth.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets.moments import Moments, sampled_pictures, shade_counts

FloatArray = npt.NDArray[np.float64]

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
STAT_NAMES = ("min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99")
_MIN, _MAX, _MEAN, _STD = range(4)
STAT_ORDER = (*STAT_NAMES[: _STD + 1], "count", *STAT_NAMES[_STD + 1 :])
"""The order of LeRobot's columns."""
_BINS = 5000
_MARGIN = 1e-10


@dataclasses.dataclass(frozen=True, eq=False)
class FeatureStats:
    """Statistics of one feature of k dimensions; a picture has one dimension a channel.

    Attributes:
        count: Frames they were taken from.
        values: (9, k), one row each of ``STAT_NAMES``.
    """

    count: int
    values: FloatArray

    def named(self, *, picture: bool) -> dict[str, Any]:
        """As LeRobot nests them: lists (k,), of pictures (k, 1, 1), and ``count`` (1,)."""
        rows = self.values[:, :, None, None] if picture else self.values
        named: dict[str, Any] = dict(zip(STAT_NAMES, rows.tolist(), strict=True))
        named["count"] = [self.count]
        return {name: named[name] for name in STAT_ORDER}

    @classmethod
    def from_named(cls, named: Mapping[str, Any]) -> "FeatureStats":
        """Reads what ``named`` gave."""
        values = np.array([np.ravel(named[name]) for name in STAT_NAMES], np.float64)
        return cls(int(np.ravel(named["count"])[0]), values)


def merge_stats(parts: Sequence[FeatureStats]) -> FeatureStats:
    """Statistics of all parts together, weighed by their frames; quantiles are averaged."""
    values = np.stack([part.values for part in parts])
    counts = np.array([part.count for part in parts], np.float64)[:, None]
    merged = (values * counts[:, None]).sum(axis=0) / counts.sum()
    spread = values[:, _STD] ** 2 + (values[:, _MEAN] - merged[_MEAN]) ** 2
    merged[_MIN] = values[:, _MIN].min(axis=0)
    merged[_MAX] = values[:, _MAX].max(axis=0)
    merged[_STD] = np.sqrt((spread * counts).sum(axis=0) / counts.sum())
    return FeatureStats(int(counts.sum()), merged)


def column_stats[Name](columns: Mapping[Name, npt.NDArray[Any]]) -> dict[Name, FeatureStats]:
    """Statistics of columns of numbers.

    Args:
        columns: Feature to values (n,) or (n, k), n the same for all.

    Returns:
        Feature to statistics, in the order given.
    """
    stats: dict[Name, FeatureStats] = {}
    grouped: dict[np.dtype[Any], dict[Name, npt.NDArray[Any]]] = {}
    for name, column in columns.items():
        values = column.reshape(len(column), -1)
        # Columns of a type go through NumPy together: a call costs more than their few numbers.
        wide = np.result_type(values.dtype, np.float32)
        grouped.setdefault(wide, {})[name] = values.astype(wide, copy=False)
    for group in grouped.values():
        together = _of_numbers(np.concatenate(list(group.values()), axis=1))
        ends = np.cumsum([column.shape[1] for column in group.values()])
        for name, part in zip(group, np.split(together, ends[:-1], axis=1), strict=True):
            stats[name] = FeatureStats(len(group[name]), part)
    return {name: stats[name] for name in columns}


@dataclasses.dataclass(frozen=True, eq=False)
class Shades:
    """The pixels of an episode's pictures that LeRobot samples, counted.

    Attributes:
        frames: Pictures that were counted.
        counts: Pixels of each shade, (256, C).
    """

    frames: int
    counts: npt.NDArray[np.int64]


def picture_shades(
    features: Mapping[str, Sequence[npt.NDArray[np.uint8]]],
) -> dict[str, Shades]:
    """Counts pixels; what needs the pictures themselves of ``shade_stats``.

    Args:
        features: Feature to pictures, uint8 (H, W, C) each, all of a feature alike in shape.
    """
    chosen = {name: sampled_pictures(pictures) for name, pictures in features.items()}
    return {name: Shades(len(each), shade_counts(each)) for name, each in chosen.items()}


def shade_stats[Name](features: Mapping[Name, Shades]) -> dict[Name, FeatureStats]:
    """Statistics by channel, in [0, 1].

    Args:
        features: Feature to its counted pixels.

    Returns:
        Feature to statistics, in the order given.
    """
    if not features:
        return {}
    # Channels of all features go through NumPy together, as columns do.
    counts = np.concatenate([each.counts for each in features.values()], axis=1)
    moments = Moments.of_shades(counts, 0)
    upto = np.cumsum(counts, axis=0)
    wanted = np.array(QUANTILES)[:, None] * upto[-1]
    # A shade has a bin to itself, so the quantile's shade alone decides.
    shades = (upto < wanted[:, None]).sum(axis=1)
    low, high = ((255.0 * bound).astype(np.float32) for bound in (moments.low, moments.high))
    edges = _Edges(low, high)
    inside = np.take_along_axis(counts, shades, axis=0)
    before = np.take_along_axis(upto, shades, axis=0) - inside
    quantiles = edges.within(edges.bins(shades.astype(np.float32)), (wanted - before) / inside)
    first = np.stack([moments.low, moments.high, moments.mean, np.sqrt(moments.variance)])
    values = np.concatenate([first, quantiles / 255.0])
    ends = np.cumsum([each.counts.shape[1] for each in features.values()])
    split = np.split(values, ends[:-1], axis=1)
    return {
        name: FeatureStats(each.frames, part)
        for (name, each), part in zip(features.items(), split, strict=True)
    }


def _of_numbers(values: npt.NDArray[Any]) -> FloatArray:
    """Statistics (9, k) of values (n, k), float32 or float64."""
    n = len(values)
    low, high, mean = values.min(axis=0), values.max(axis=0), values.mean(axis=0)
    if n < 2:
        quantiles = np.tile(mean, (len(QUANTILES), 1))
        return np.stack([low, high, mean, np.zeros_like(mean), *quantiles]).astype(np.float64)
    variance = (values**2).mean(axis=0) - mean**2
    quantiles = _quantiles(np.sort(values, axis=0), _Edges(low, high))
    first = np.stack([low, high, mean, np.sqrt(np.maximum(variance, 0.0))])
    return np.concatenate([first, quantiles])


def _quantiles(values: npt.NDArray[Any], edges: "_Edges") -> FloatArray:
    """LeRobot's estimates (5, k) for values (n, k) that rise along their first axis."""
    bins = edges.bins(values)
    wanted = np.array(QUANTILES) * len(values)
    # The bin that holds the quantile, and how far into it by count.
    index = bins[np.ceil(wanted).astype(int) - 1]
    before = (bins < index[:, None]).sum(axis=1)
    inside = (bins == index[:, None]).sum(axis=1)
    return edges.within(index, (wanted[:, None] - before) / inside)


class _Edges:
    """The edges of LeRobot's histograms: np.linspace(low - margin, high + margin, 5001).

    Args:
        low: Least value of each dimension (k,), float32 or float64; so are the edges.
        high: Greatest (k,).
    """

    def __init__(self, low: npt.NDArray[Any], high: npt.NDArray[Any]) -> None:
        self._start, self._stop = low - _MARGIN, high + _MARGIN
        self._step = (self._stop - self._start) / _BINS

    def bins(self, values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """Bin of each value (..., k): the last edge that is not above it, and that is no end.

        Halving finds it exactly; in float32 many edges may be equal.
        """
        found = np.zeros(values.shape, np.int64)
        for bit in reversed(range(_BINS.bit_length())):
            further = np.minimum(found + (1 << bit), _BINS - 1)
            edge = further.astype(values.dtype) * self._step + self._start
            found = np.where(edge <= values, further, found)
        return found

    def within(self, bins: npt.NDArray[np.int64], share: FloatArray) -> FloatArray:
        """Points (..., k) a share of the way through bins; through the first one at its start."""
        left = bins.astype(self._start.dtype) * self._step + self._start
        right = (bins + 1).astype(self._start.dtype) * self._step + self._start
        right = np.where(bins == _BINS - 1, self._stop, right)
        between = left + share * (right - left)
        return np.where(bins == 0, self._start, between).astype(np.float64)
