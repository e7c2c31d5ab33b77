"""Estimates and intervals that results report, each with its source. Imports no room."""

import statistics

import numpy as np
import numpy.typing as npt


def wilson_interval(n_success: int, n_total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns Wilson's score interval for a success rate, without continuity correction.

    With p = n_success / n_total and z the normal quantile of (1 + confidence) / 2:
    ``(p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n)``. It stays inside [0, 100] and
    keeps a width at 0 % and 100 %, where the usual p +- z sqrt(p(1-p)/n) claims certainty.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    Journal of the American Statistical Association 22 (1927) 209-212; recommended by Brown, Cai
    and DasGupta, "Interval estimation for a binomial proportion", Statistical Science 16 (2001).

    Args:
        n_success: Successes among `n_total`.
        n_total: Trials, at least 1.
        confidence: Coverage aimed at, in (0, 1).

    Returns:
        Lower and upper end (percent).

    Raises:
        ValueError: The counts are not those of trials, or `confidence` is outside (0, 1).
    """
    if not 0 <= n_success <= n_total or n_total < 1:
        raise ValueError(f"{n_success} successes in {n_total} trials are not possible.")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1, not {confidence}.")
    z = statistics.NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = n_success / n_total
    centre = rate + z**2 / (2 * n_total)
    half = z * (rate * (1 - rate) / n_total + z**2 / (4 * n_total**2)) ** 0.5
    scale = 1 + z**2 / n_total
    # The ends at 0 and 100 % are exact in theory; rounding must not move them.
    low = 0.0 if n_success == 0 else (centre - half) / scale
    high = 1.0 if n_success == n_total else (centre + half) / scale
    return 100 * low, 100 * high


def interquartile_mean(values: npt.ArrayLike) -> float:
    """Returns the mean of the middle half: a quarter of the values is cut off at each end.

    Less noisy than the median and deaf to outliers, unlike the mean. The number cut at each end
    is n/4 rounded down, as in SciPy's ``trim_mean(values, 0.25)``.

    Source: R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical
    precipice", NeurIPS 2021.

    Args:
        values: (n,) with n >= 1, in any unit.

    Raises:
        ValueError: `values` is empty or not one-dimensional.
    """
    ordered = np.sort(_vector(values))
    cut = len(ordered) // 4
    return float(np.mean(ordered[cut : len(ordered) - cut]))


def percentile(values: npt.ArrayLike, percent: float) -> float:
    """Returns a percentile, interpolated linearly between order statistics.

    Source: R. J. Hyndman and Y. Fan, "Sample quantiles in statistical packages", The American
    Statistician 50 (1996) 361-365, definition 7 (NumPy's default).

    Args:
        values: (n,) with n >= 1, in any unit.
        percent: Between 0 and 100; 50 is the median.

    Raises:
        ValueError: `values` is empty or not one-dimensional, or `percent` lies outside [0, 100].
    """
    return float(np.percentile(_vector(values), percent))


def _vector(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Returns values as (n,) float64, n >= 1."""
    vector = np.asarray(values, dtype=np.float64)
    if vector.ndim != 1 or not vector.size:
        raise ValueError(f"Give one or more values in one dimension, not shape {vector.shape}.")
    return vector
