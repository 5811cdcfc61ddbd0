"""What reports compute of samples: against enumeration and hand."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from scipy import stats

from space_dist.report.statistics import (
    Interval,
    confidence_interval,
    estimates,
    interquartile_mean,
    intervals,
    paired_ratio,
    probability_of_improvement,
    restricted,
    start_bound,
    steps_to_threshold,
    stratified,
)
from space_dist.seeding import Purpose, generator


def test_strata_spread_each_for_itself() -> None:
    """0 1 and 10 14: the IQM of 0 1 10 14 is 5.5; that the strata lie apart is no spread.

    Winsorised to 1 1 and 10 10, which spread nowhere; of all values, 1.1 / 4 sqrt(2 x 0.5 + 2 x 8), of whose degrees
    of freedom Satterthwaite leaves 17^2 / (1 + 16^2).
    """
    strata = [np.array([0.0, 1.0]), np.array([10.0, 14.0])]
    half = stats.t.ppf(0.975, 17.0**2 / (1.0 + 16.0**2)) * 1.1 / 4.0 * math.sqrt(17.0)
    found = stratified(strata)
    assert (found.value, found.low, found.high) == pytest.approx((5.5, 5.5 - half, 5.5 + half))
    assert stratified([strata[0], np.array([3.0])]) == Interval(4.0 / 3.0)
    alone = np.array([1.0, 2.0, 6.0, 8.0, 9.0])
    assert stratified([alone]) == estimates([alone])[0].iqm
    assert stratified([alone[:2]]) == Interval(1.5)


def test_pooled_cells_cover_what_they_promise() -> None:
    """Four cells of three and five seeds, a standard deviation apart: the percentile bootstrap covers 84 and 90 %."""
    random = generator(0, Purpose.BOOTSTRAP, 2)
    centres = np.arange(4.0)[:, None]
    for n in (3, 5):
        cells = random.standard_normal((400, 4, n)) + centres
        found = [stratified(list(one)) for one in cells]
        covered = np.mean([one.low is not None and one.high is not None and one.low <= 1.5 <= one.high
                           for one in found])  # fmt: skip
        assert 0.94 <= covered <= 0.995, n


def test_p_better_and_the_ratio_cover_what_they_promise() -> None:
    """Equal cells, so 1/2 and 1: the percentile bootstrap excludes the ratio's 1 in 17 % of the cases at five seeds."""
    random = generator(0, Purpose.BOOTSTRAP, 3)
    for n in (3, 5, 10):
        ours, theirs = random.standard_normal((2, 400, n))
        found = [probability_of_improvement(*pair) for pair in zip(ours, theirs, strict=True)]
        assert np.mean([one.low is not None and one.high is not None and one.low <= 0.5 <= one.high
                        for one in found]) >= 0.94, n  # fmt: skip
        ratios = [paired_ratio(*np.exp(0.5 * np.stack(pair))) for pair in zip(ours, theirs, strict=True)]
        covered = np.mean([one.low is not None and one.high is not None and one.low <= 1.0 <= one.high
                           for one in ratios])  # fmt: skip
        assert 0.92 <= covered <= 0.98, n


def test_many_samples_at_once_are_like_each_alone() -> None:
    random = np.random.default_rng(3)
    samples = [random.normal(size=n) for n in (4, 1, 7, 4, 0, 4)]
    for found, sample in zip(estimates(samples), samples, strict=True):
        assert found.n == len(sample)
        if len(sample) > 2:
            low, high = confidence_interval(sample)
            assert found.iqm == Interval(float(interquartile_mean(sample)), float(low), float(high))
            assert found.mean == intervals([sample], "mean")[0]


def test_degenerate_samples_have_an_answer_and_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert intervals([np.full(5, 2.0)], "median") == [Interval(2.0)]
        assert intervals([np.array([2.0])], "median") == [Interval(2.0)]
        diverged, empty = intervals([np.array([1.0, np.nan, 3.0]), np.array([])], "iqm")
        assert math.isnan(diverged.value)
        assert math.isnan(empty.value)
        assert (diverged.low, empty.low) == (None, None)
        same = np.full(3, 2.0)
        tied = probability_of_improvement(same, same)
        assert (tied.value, tied.low) == (0.5, pytest.approx(1.0 - (tied.high or 0.0)))
        assert probability_of_improvement(same, np.array([1.0])) == Interval(1.0)
        assert math.isnan(probability_of_improvement(same, np.array([])).value)
        assert math.isnan(probability_of_improvement(same, np.array([np.nan, 1.0])).value)
        assert math.isnan(paired_ratio(same, np.zeros(3)).value)
        assert paired_ratio(np.array([1.0, 2.0]), np.array([0.0, 6.0])) == Interval(0.5)
        assert paired_ratio(np.array([1.0]), np.array([2.0])) == Interval(0.5)
        assert math.isnan(stratified([np.array([1.0, np.nan]), same]).value)


def test_probability_of_improvement_counts_all_pairs_and_half_the_ties() -> None:
    """1 beats 0; 2 beats 0 and ties twice; 3 beats all: 1 + 2 + 3 of 9. SciPy's U statistic counts the same."""
    ours, theirs = (1.0, 2.0, 3.0), (2.0, 2.0, 0.0)
    found = probability_of_improvement(np.array(ours), np.array(theirs))
    assert found.value == pytest.approx(6 / 9)
    assert found.value == pytest.approx(stats.mannwhitneyu(ours, theirs).statistic / 9)


def test_probability_of_improvement_of_unequal_samples() -> None:
    random = np.random.default_rng(0)
    ours, theirs = random.normal(0.3, 1.0, 40), random.normal(0.0, 1.0, 25)
    found = probability_of_improvement(ours, theirs)
    assert found.value == pytest.approx(stats.mannwhitneyu(ours, theirs).statistic / 1000)
    low, high = found.low or 0.0, found.high or 0.0
    for bound in (low, high):  # each explains the distance to the estimate by its own standard error
        spread = 1.0 + 31.5 * ((1.0 - bound) / (2.0 - bound) + bound / (1.0 + bound))
        error = math.sqrt(bound * (1.0 - bound) * spread / 1000.0)
        assert abs(bound - found.value) == pytest.approx(stats.t.ppf(0.975, 63) * error, rel=1e-6)
    other = probability_of_improvement(theirs, ours)
    assert (other.low, other.high) == pytest.approx((1.0 - high, 1.0 - low))


def test_three_seeds_that_beat_three_do_not_exclude_chance() -> None:
    found = probability_of_improvement(np.array([4.0, 5.0, 6.0]), np.array([1.0, 2.0, 3.0]))
    assert (found.value, found.high) == (1.0, 1.0)
    assert found.low is not None
    assert 0.3 < found.low < 0.5


@pytest.mark.parametrize(
    ("returns", "answer"),
    [
        ([0, 5, 5, 5, 0], 1000.0),  # what comes later does not count
        ([0, 5, 5, 0, 5, 5, 5], 4000.0),  # two are not enough
        ([5, 5, 5], 0.0),
        ([0, 0, 5, 5], math.nan),  # the budget ends before the third
        ([0, 5, math.nan, 5, 5], math.nan),
        ([5, 5], math.nan),
        ([], math.nan),
    ],
)
def test_a_threshold_is_reached_by_three_evaluations_in_a_row(returns: list[float], answer: float) -> None:
    steps = np.arange(len(returns)) * 1000
    np.testing.assert_equal(steps_to_threshold(steps, np.array(returns, dtype=float), 5.0), answer)


def test_censored_times_count_as_the_budget_and_seeds_go_in_pairs() -> None:
    np.testing.assert_equal(restricted(np.array([1.0, np.nan, 9.0]), 4.0), [1.0, 4.0, 4.0])
    # 2 4 6 of a mean of 4 against 4 each: the log moves by -1/2, 0 and 1/2; 4.30265 times 1/2 over the root of 3.
    found = paired_ratio(np.array([2.0, 4.0, 6.0]), np.full(3, 4.0))
    assert (found.low, found.high) == pytest.approx((math.exp(-1.242061), math.exp(1.242061)), rel=1e-5)
    # Every seed needs half of its twin's steps: nothing shows how much that varies.
    assert paired_ratio(np.array([1.0, 3.0, 7.0]), np.array([2.0, 6.0, 14.0])) == Interval(0.5)
    assert paired_ratio(np.zeros(3), np.full(3, 4.0)) == Interval(0.0)


def test_the_noise_of_step_0_is_a_prediction_bound() -> None:
    """1 and 3: mean 2, standard deviation sqrt(2), and Student's t of 12.706 for one degree of freedom."""
    assert start_bound(np.array([1.0, 3.0])) == pytest.approx(2.0 + 12.7062 * math.sqrt(2.0) * math.sqrt(1.5), rel=1e-5)
    assert start_bound(np.full(9, 4.0)) == 4.0
    assert start_bound(np.array([4.0])) == math.inf
