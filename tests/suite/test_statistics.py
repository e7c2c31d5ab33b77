"""The estimates agree with SciPy and refuse what has no answer."""

import numpy as np
import pytest
import scipy.stats

from hvs_suite.statistics import interquartile_mean, percentile, wilson_interval


@pytest.mark.parametrize("n_total", [1, 2, 7, 60, 1000])
@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
def test_wilson_interval_agrees_with_scipy(n_total: int, confidence: float) -> None:
    for n_success in sorted({0, 1, n_total // 3, n_total - 1, n_total}):
        expected = scipy.stats.binomtest(n_success, n_total).proportion_ci(
            confidence, method="wilson"
        )
        interval = wilson_interval(n_success, n_total, confidence)
        assert interval == pytest.approx((100 * expected.low, 100 * expected.high), abs=1e-9)


def test_wilson_interval_ends_exactly_at_none_and_all() -> None:
    assert wilson_interval(0, 20)[0] == 0.0
    assert wilson_interval(20, 20)[1] == 100.0


@pytest.mark.parametrize("counts", [(-1, 5), (6, 5), (0, 0)])
def test_wilson_interval_refuses_impossible_counts(counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="not possible"):
        wilson_interval(*counts)


@pytest.mark.parametrize("confidence", [0.0, 1.0, 95.0])
def test_wilson_interval_refuses_an_impossible_confidence(confidence: float) -> None:
    with pytest.raises(ValueError, match="confidence"):
        wilson_interval(1, 2, confidence)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 11, 1000])
def test_interquartile_mean_agrees_with_scipy(n: int) -> None:
    values = np.random.default_rng(n).lognormal(size=n)
    assert interquartile_mean(values) == pytest.approx(scipy.stats.trim_mean(values, 0.25))


def test_interquartile_mean_is_deaf_to_an_outlier() -> None:
    assert interquartile_mean([1.0, 2.0, 2.0, 3.0]) == interquartile_mean([1.0, 2.0, 2.0, 1e9])


@pytest.mark.parametrize("percent", [0, 50, 95, 100])
def test_percentile_agrees_with_scipy(percent: float) -> None:
    values = np.random.default_rng(3).normal(size=41)
    expected = scipy.stats.scoreatpercentile(values, percent)
    assert percentile(values, percent) == pytest.approx(expected)


def test_no_values_have_no_estimate() -> None:
    with pytest.raises(ValueError, match="one or more"):
        interquartile_mean([])
    with pytest.raises(ValueError, match="one or more"):
        percentile([[1.0]], 50)
