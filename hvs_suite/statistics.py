"""Estimates, intervals and tests for results, each with its source. Imports no other part."""

import dataclasses
import functools
import math
import statistics
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

CONFIDENCE = 0.95
"""Coverage that all intervals aim at."""
N_RESAMPLES = 1000
"""Bootstrap resamples: the ends of a 95 % interval come from 25 of them each."""
# Resampled values drawn at once.
_CHUNK = 1 << 20


def wilson_interval(
    n_success: int, n_total: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
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


def mean_rate_interval(
    counts: Sequence[tuple[int, int]], weights: Sequence[float] | None = None
) -> tuple[float, float]:
    """Returns an interval for a weighted mean of independent success rates.

    With rates p_i, weights w_i and the rates' Wilson intervals [l_i, u_i], their mean
    m = sum w_i p_i has the interval ``m - sqrt(sum w_i^2 (p_i - l_i)^2)`` to
    ``m + sqrt(sum w_i^2 (u_i - p_i)^2)``. One rate has its Wilson interval.

    Source: G. Y. Zou, W. Huang and X. Zhang, "A note on confidence interval estimation for a linear
    function of binomial proportions", Computational Statistics & Data Analysis 53 (2009) 1080-1085.

    Args:
        counts: Successes and trials of each rate, one or more.
        weights: One for each rate; 1 / k by default. Less than 1 in all where rates that are
            missing count as 0 %.

    Returns:
        Lower and upper end (percent).

    Raises:
        ValueError: There is no rate, or counts are not those of trials.
    """
    if not counts:
        raise ValueError("Give one or more rates.")
    rates = [100 * n_success / n_total for n_success, n_total in counts]
    intervals = [wilson_interval(*count) for count in counts]
    shares = [1.0 / len(rates)] * len(rates) if weights is None else list(weights)
    weighed = list(zip(shares, rates, intervals, strict=True))
    mean = math.fsum(w * p for w, p, _ in weighed)
    below = math.hypot(*(w * (p - low) for w, p, (low, _) in weighed))
    above = math.hypot(*(w * (high - p) for w, p, (_, high) in weighed))
    return max(0.0, mean - below), min(100.0, mean + above)


def interquartile_mean(values: npt.ArrayLike) -> float:
    """Returns the mean of the middle half: a quarter of the values is cut off at each end.

    It is less noisy than the median, and outliers do not affect it as they affect the mean. The
    number cut at each end is n/4 rounded down, as in SciPy's ``trim_mean(values, 0.25)``.

    Source: R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical
    precipice", NeurIPS 2021.

    Args:
        values: (n,) with n >= 1, in any unit.

    Raises:
        ValueError: `values` is empty or not one-dimensional.
    """
    vector = _vector(values)
    return float(np.sort(vector)[_middle_half(len(vector))].mean())


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


def interquartile_mean_interval(
    strata: Sequence[npt.ArrayLike], resamples: int = N_RESAMPLES
) -> tuple[float, float]:
    """Returns the stratified bootstrap interval of the interquartile mean.

    Each stratum (the episodes of one task) is resampled with replacement on its own, so that every
    resample holds as many episodes of each task as the data; the interquartile mean is then taken
    over all of them together. The interval holds the middle 95 % of these means. The same
    values give the same interval, always.

    Source: B. Efron, "Bootstrap methods: another look at the jackknife", Annals of Statistics 7
    (1979) 1-26 (percentile interval); stratified as in R. Agarwal et al., NeurIPS 2021.

    Args:
        strata: One or more (n_k,), in any unit; a single task is a single stratum.
        resamples: Number of resamples.

    Returns:
        Lower and upper end, in the unit of the values.

    Raises:
        ValueError: A stratum is empty, or there is none.
    """
    if not strata:
        raise ValueError("Give one or more strata.")
    columns = [_vector(values) for values in strata]
    values = np.concatenate(columns)
    # Places in the order of all values stand for the values: small integers are sorted faster.
    order = np.argsort(values, kind="stable")
    places = np.empty(len(values), np.min_scalar_type(len(values)))
    places[order] = np.arange(len(values))
    ascending, middle = values[order], _middle_half(len(values))
    means = [
        ascending[np.sort(places[index], axis=1, kind="stable")[:, middle]].mean(axis=1)
        for index in _resampled(tuple(len(column) for column in columns), resamples)
    ]
    return _middle(np.concatenate(means))


@dataclasses.dataclass(frozen=True)
class Difference:
    """A difference between two policies over the same scenarios, first minus second.

    Attributes:
        estimate: In the unit of the values.
        low: Lower end of its interval.
        high: Upper end.
        n: Pairs.
        p: Two-sided p-value of Wilcoxon's signed-rank test; 1 where no pair differs.
    """

    estimate: float
    low: float
    high: float
    n: int
    p: float


def paired_difference(first: npt.ArrayLike, second: npt.ArrayLike) -> Difference:
    """Returns the mean paired difference with its bootstrap interval, and tests it.

    Scenarios are resampled, not values: both policies' values of a scenario stay together, so what
    makes a scenario hard for both cancels. The test ranks the differences, so that a few lost
    scenarios do not decide it; pairs that do not differ say nothing.

    Sources: B. Efron and R. Tibshirani, "An introduction to the bootstrap" (1993), chapters 8 and
    13 (percentile interval); F. Wilcoxon, "Individual comparisons by ranking methods", Biometrics
    Bulletin 1 (1945) 80-83.

    Args:
        first: (n,) of the first policy, by scenario.
        second: (n,) of the second, the same scenarios in the same order.

    Raises:
        ValueError: The lengths differ or are 0.
    """
    # Only now, because it takes a second to import.
    from scipy.stats import wilcoxon

    ours, theirs = _vector(first), _vector(second)
    if ours.shape != theirs.shape:
        raise ValueError(f"Pairs need equal lengths, not {len(ours)} and {len(theirs)}.")
    differences = ours - theirs
    means = np.concatenate(
        [differences[index].mean(axis=1) for index in _resampled((len(ours),), N_RESAMPLES)]
    )
    low, high = _middle(means)
    p = float(wilcoxon(differences).pvalue) if differences.any() else 1.0
    return Difference(float(differences.mean()), low, high, len(ours), p)


def mcnemar(n_only_first: int, n_only_second: int) -> float:
    """Returns the p-value of McNemar's exact test, two-sided.

    Under the hypothesis that both policies are equally good, each scenario that only one of them
    solves is a fair coin: ``p = min(1, 2 P(X <= min(b, c)))`` with X ~ Binomial(b + c, 1/2).
    Scenarios that both or neither solve say nothing.

    Source: Q. McNemar, "Note on the sampling error of the difference between correlated proportions
    or percentages", Psychometrika 12 (1947) 153-157; the exact form is the sign test.

    Args:
        n_only_first: Scenarios that only the first policy solved (b).
        n_only_second: Scenarios that only the second solved (c).

    Raises:
        ValueError: A count is negative.
    """
    if min(n_only_first, n_only_second) < 0:
        raise ValueError("Counts cannot be negative.")
    n = n_only_first + n_only_second
    tail = sum(math.comb(n, k) for k in range(min(n_only_first, n_only_second) + 1))
    # Whole numbers until the end: 2**n overflows a float from n = 1,024 on.
    return min(1.0, 2 * tail / 2**n)


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p-values corrected for having tested them all together.

    The i-th smallest of m is multiplied by m - i + 1, and none may fall below a smaller one's.
    Calling those below 0.05 significant is then wrong about any of them with probability 0.05 at
    most, however they depend on each other.

    Source: S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal
    of Statistics 6 (1979) 65-70.

    Args:
        p_values: (m,) in [0, 1].

    Returns:
        (m,) in the same order, each at least as large as it was.

    Raises:
        ValueError: A value is no probability.
    """
    if not all(0.0 <= p <= 1.0 for p in p_values):
        raise ValueError("p-values lie between 0 and 1.")
    corrected = [0.0] * len(p_values)
    floor = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        floor = max(floor, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = floor
    return corrected


def share_within(errors: npt.ArrayLike, tolerances: npt.ArrayLike) -> FloatArray:
    """Returns the curve of success against tolerance: the empirical distribution of the errors.

    Source: the empirical distribution function, F(x) = (number of errors <= x) / n; as "performance
    profile" in R. Agarwal et al., NeurIPS 2021.

    Args:
        errors: (n,) with n >= 1; infinity for an episode that no tolerance makes a success.
        tolerances: (m,), in the unit of the errors.

    Returns:
        (m,) percent.
    """
    ordered = np.sort(_vector(errors))
    within = np.searchsorted(ordered, np.asarray(tolerances, np.float64), side="right")
    return np.asarray(100.0 * within / len(ordered), np.float64)


def sharpest_tolerance(errors: npt.ArrayLike, percent: float = 95.0) -> float:
    """Returns the smallest tolerance that at least `percent` of the errors meet.

    It is the ceil(percent/100 * n)-th smallest error: definition 1 of Hyndman and Fan (1996), the
    inverse of the empirical distribution, which unlike the interpolated percentile is always met.

    Args:
        errors: (n,) with n >= 1; infinity for an episode that no tolerance makes a success.
        percent: Share that must meet it, in (0, 100].

    Returns:
        In the unit of the errors; infinity if fewer than `percent` are finite.
    """
    if not 0.0 < percent <= 100.0:
        raise ValueError(f"percent must lie in (0, 100], not {percent}.")
    ordered = np.sort(_vector(errors))
    # The quotient first: 95 / 100 * 20 is a little more than 19 in floating point.
    rank = math.ceil(percent * len(ordered) / 100.0 - 1e-9)
    return float(ordered[max(rank, 1) - 1])


def share_solved_by(steps_to_goal: Sequence[int | None], limit: int) -> FloatArray:
    """Returns the curve of success against steps.

    Every episode that has not reached its goal by a step, for whatever reason, counts as not
    solved: nothing is censored, since all episodes have the same limit.

    Args:
        steps_to_goal: Control steps to success of each episode, None for failures.
        limit: Time limit (control steps).

    Returns:
        (limit,) percent solved within 1, 2, ... limit control steps.
    """
    steps = [math.inf if count is None else count for count in steps_to_goal]
    return share_within(steps, np.arange(1, limit + 1))


def _middle_half(n: int) -> slice:
    """What is left of n sorted values without a quarter at either end."""
    return slice(n // 4, n - n // 4)


# Most results hold as many episodes as the protocol asks for: the same resamples serve them all.
@functools.lru_cache(maxsize=4)
def _resampled(lengths: tuple[int, ...], resamples: int) -> list[npt.NDArray[np.uint32]]:
    """Indices of bootstrap resamples into the strata laid end to end, (m, n) blocks.

    They come from the bit generator itself: NumPy promises that its stream never changes, which it
    does not for the distributions above it. The bias of the remainder is below n / 2^64.
    """
    stream = np.random.Philox(key=0)
    n_each = np.repeat(lengths, lengths).astype(np.uint64)
    begins = np.repeat(np.cumsum(lengths) - lengths, lengths).astype(np.uint64)
    total = len(n_each)
    # In blocks, because what they are drawn as, and what they pick, takes more memory than they do.
    block = max(1, _CHUNK // total)
    return [
        (stream.random_raw(rows * total).reshape(rows, total) % n_each + begins).astype(np.uint32)
        for rows in (min(block, resamples - begin) for begin in range(0, resamples, block))
    ]


def _middle(values: FloatArray) -> tuple[float, float]:
    low, high = np.percentile(values, [50 - 50 * CONFIDENCE, 50 + 50 * CONFIDENCE])
    return float(low), float(high)


def _vector(values: npt.ArrayLike) -> FloatArray:
    """Returns values as (n,) float64, n >= 1."""
    vector = np.asarray(values, dtype=np.float64)
    if vector.ndim != 1 or not vector.size:
        raise ValueError(f"Give one or more values in one dimension, not shape {vector.shape}.")
    return vector
