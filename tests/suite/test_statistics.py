"""The estimates agree with SciPy and refuse what has no answer."""

import numpy as np
import pytest
import scipy.stats

from hvs_suite.statistics import (
    holm,
    interquartile_mean,
    interquartile_mean_interval,
    mcnemar,
    mean_rate_interval,
    paired_difference,
    percentile,
    share_solved_by,
    share_within,
    sharpest_tolerance,
    wilson_interval,
)


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


@pytest.mark.parametrize("counts", [(0, 0), (1, 0), (5, 9), (30, 12), (600, 700), (1000, 0)])
def test_mcnemar_agrees_with_scipy(counts: tuple[int, int]) -> None:
    expected = scipy.stats.binomtest(counts[0], sum(counts)).pvalue if sum(counts) else 1.0
    assert mcnemar(*counts) == pytest.approx(expected, rel=1e-9)
    assert mcnemar(*counts[::-1]) == mcnemar(*counts)


def test_mcnemar_refuses_negative_counts() -> None:
    with pytest.raises(ValueError, match="negative"):
        mcnemar(-1, 3)


def test_the_bootstrap_interval_agrees_with_scipy() -> None:
    values = np.random.default_rng(0).lognormal(size=200)
    expected = scipy.stats.bootstrap(
        (values,),
        lambda sample, axis: scipy.stats.trim_mean(sample, 0.25, axis=axis),
        n_resamples=4000,
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    interval = interquartile_mean_interval([values], resamples=4000)
    # Two sets of resamples differ by a few percent of the interval's width.
    assert interval == pytest.approx(tuple(expected), abs=0.08 * (expected.high - expected.low))


def test_the_bootstrap_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    random = np.random.default_rng(5)
    intervals = [interquartile_mean_interval([random.normal(size=60)]) for _ in range(200)]
    # 95 % of 200 give or take three standard deviations, and the bootstrap's own shortfall.
    assert 175 <= sum(low <= 0.0 <= high for low, high in intervals) <= 200


def test_the_same_values_give_the_same_interval() -> None:
    values = np.arange(30.0)
    assert interquartile_mean_interval([values]) == interquartile_mean_interval([values])


def test_strata_are_resampled_on_their_own() -> None:
    # Two tasks without spread: any resample that keeps their sizes has the same mean.
    low, high = interquartile_mean_interval([np.zeros(10), np.ones(30)])
    assert low == high == interquartile_mean(np.repeat([0.0, 1.0], [10, 30]))


def test_large_samples_are_resampled_in_blocks() -> None:
    low, high = interquartile_mean_interval([np.random.default_rng(2).normal(size=6000)])
    assert -0.1 < low < high < 0.1


def test_a_paired_difference_cancels_what_scenarios_have_in_common() -> None:
    random = np.random.default_rng(7)
    hard = random.normal(scale=100.0, size=50)
    difference = paired_difference(hard + 1.0, hard)
    assert difference.estimate == pytest.approx(1.0)
    assert (difference.low, difference.high) == pytest.approx((1.0, 1.0))
    noisy = paired_difference(hard, hard + random.normal(size=50))
    expected = scipy.stats.bootstrap(
        (hard, hard + 1.0),
        lambda a, b, axis: (a - b).mean(axis=axis),
        paired=True,
        method="percentile",
        n_resamples=100,
        rng=random,
    ).confidence_interval
    assert (expected.low, expected.high) == pytest.approx((-1.0, -1.0))
    assert noisy.low <= noisy.estimate <= noisy.high


def test_a_paired_difference_is_tested_by_the_ranks_of_what_differs() -> None:
    random = np.random.default_rng(7)
    hard = random.normal(scale=100.0, size=200)
    sooner = hard - random.exponential(size=200)
    assert paired_difference(sooner, hard).p < 1e-9
    either = random.normal(size=100)
    assert paired_difference(hard + np.concatenate([either, -either]), hard).p > 0.9
    assert paired_difference(hard, hard).p == 1.0
    # Five pairs that all differ to one side: 2 of the 2^5 ways in which their signs could fall.
    assert paired_difference([1.0, 2.0, 3.0, 4.0, 5.0], np.zeros(5)).p == pytest.approx(0.0625)


def test_pairs_need_equal_lengths() -> None:
    with pytest.raises(ValueError, match="equal lengths"):
        paired_difference([1.0], [1.0, 2.0])


def test_success_against_tolerance_agrees_with_scipy() -> None:
    errors = np.random.default_rng(1).exponential(size=37)
    tolerances = np.array([0.0, 0.1, errors[3], 1.0, 100.0])
    expected = 100.0 * scipy.stats.ecdf(errors).cdf.evaluate(tolerances)
    np.testing.assert_allclose(share_within(errors, tolerances), expected)
    assert share_within([*errors, np.inf], [1e300])[0] < 100.0


def test_the_sharpest_tolerance_is_met_by_enough_and_nothing_sharper_is() -> None:
    errors = np.arange(1.0, 21.0)
    assert sharpest_tolerance(errors) == 19.0
    assert share_within(errors, [19.0])[0] >= 95.0 > share_within(errors, [18.999])[0]
    assert sharpest_tolerance([1.0] * 18 + [np.inf] * 2) == np.inf
    with pytest.raises(ValueError, match="percent"):
        sharpest_tolerance(errors, 0.0)


def test_success_against_steps_counts_failures_as_never() -> None:
    np.testing.assert_allclose(share_solved_by([2, None, 4, 2], 5), [0, 50, 50, 75, 75])


def test_the_interval_of_one_rate_is_wilsons() -> None:
    assert mean_rate_interval([(7, 20)]) == pytest.approx(wilson_interval(7, 20))
    assert mean_rate_interval([(20, 20)])[1] == 100.0


def test_the_interval_of_a_mean_rate_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    rates = np.array([0.95, 0.5, 0.99, 0.1])
    counts = rng.binomial(100, rates, size=(2000, 4))
    intervals = [mean_rate_interval([(int(k), 100) for k in row]) for row in counts]
    covered = [low <= 100 * rates.mean() <= high for low, high in intervals]
    # A standard error of the share is half a point.
    assert np.mean(covered) == pytest.approx(0.95, abs=0.015)


def test_the_interval_of_a_mean_rate_needs_a_rate() -> None:
    with pytest.raises(ValueError, match="one or more"):
        mean_rate_interval([])


def test_holm_agrees_with_the_worked_example() -> None:
    # Times 4, 3, 2, 1 in order of size; the third may not fall below the second.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


def test_holm_refuses_what_is_no_probability() -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        holm([0.5, 1.5])
