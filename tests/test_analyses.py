"""Curricula and outcomes analysed: answers worked out by hand, on a handful of instances."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from space_dist.report.analyses import (
    agreement,
    consistency,
    feature_means,
    feature_rank_correlations,
    features_by_rank,
    frequencies,
    inclusion_order,
    rank_changes,
    released_steps,
    share_below,
    shares_of_first,
    shifts,
    stretches,
    weighted_frequencies,
)
from space_dist.report.outcomes import (
    area,
    cross_worst_mean,
    forgotten,
    paired_difference,
    profile,
    span,
    worst_mean,
)

IntArray = NDArray[np.int64]


def sets(*iterations: Sequence[int]) -> tuple[IntArray, ...]:
    return tuple(np.array(ids, dtype=np.int64) for ids in iterations)


def ints(*values: int) -> IntArray:
    return np.array(values, dtype=np.int64)


def floats(*values: float) -> NDArray[np.float64]:
    return np.array(values, dtype=np.float64)


# Four instances, four iterations; 40 is never trained on, and some are drawn twice.
IDS = ints(10, 20, 30, 40)
TRAINED = sets([20, 20], [20, 30], [30, 10, 20], [10, 20, 30, 30])


def test_order_of_inclusion_counts_from_one_and_ends_behind_the_last_iteration():
    assert inclusion_order(TRAINED, IDS).tolist() == [3, 1, 2, 5]


def test_an_instance_that_leaves_the_set_keeps_its_place_in_the_order():
    assert inclusion_order(sets([1], [2], [1]), ints(1, 2)).tolist() == [1, 2]


def test_frequency_is_of_iterations_and_not_of_draws():
    assert frequencies(TRAINED, IDS).tolist() == [2 / 4, 4 / 4, 3 / 4, 0]


def test_weights_fall_from_one_to_one_over_n():
    # Ranks 3, 1, 2, 4 of 4 -> weights 2/4, 4/4, 3/4, 1/4.
    weighted = weighted_frequencies(floats(0.5, 1, 0.75, 1), ints(3, 1, 2, 5))
    assert weighted.tolist() == [0.25, 1, 0.5625, 0.25]


def test_instances_included_together_share_the_average_of_their_ranks():
    # Places 2 and 3 -> rank 2.5 -> weight (4 - 2.5 + 1) / 4 = 0.625; the least rank would give 0.75, the greatest 0.5.
    assert weighted_frequencies(np.ones(4), ints(1, 2, 2, 7)).tolist() == [1, 0.625, 0.625, 0.25]
    # All at once: rank (1 + 2 + 3) / 3 = 2 -> weight 2 / 3.
    assert weighted_frequencies(np.ones(3), ints(1, 1, 1)) == pytest.approx([2 / 3] * 3)


@pytest.mark.parametrize(
    ("plain", "weighted", "changes"),
    [
        ([1, 0.5, 0.75, 0.25], [1, 0.375, 0.4, 0.1], 0),
        ([1, 0.5, 0.75, 0.25], [1, 0.5, 0.375, 0.1], 2),  # 0 2 1 3 -> 0 1 2 3
        ([0.9, 0.6, 0.3], [0.5, 0.2, 0.8], 3),  # 0 1 2 -> 2 0 1
        ([0.5, 0.5, 0.5], [0.5, 0.4, 0.3], 0),  # equal ones by id: 0 1 2
        ([0.5, 0.5, 0.5], [0.3, 0.4, 0.5], 2),  # 0 1 2 -> 2 1 0: the middle one stays
        ([0.3, 0.2], [0.6 * 0.3, 0.9 * 0.2], 0),  # both 0.18, the second by rounding greater
    ],
)
def test_rank_changes(plain: list[float], weighted: list[float], changes: int):
    assert rank_changes(floats(*plain), floats(*weighted)) == changes


def test_many_equal_frequencies_are_ordered_by_id():
    # Once more than 16 values are sorted, only a stable sort keeps equal ones in order.
    weighted = np.where(np.arange(1000) % 2 == 0, 0.5, 0.25)
    expected = [*range(0, 1000, 2), *range(1, 1000, 2)]
    assert rank_changes(np.full(1000, 0.5), weighted) == sum(place != i for place, i in enumerate(expected))


def test_consistency_of_three_seeds():
    alike = consistency(np.array([[1, 2, 3, 4], [1, 2, 4, 3], [4, 3, 2, 1]]))
    # Of 6 pairs of instances: seeds 0 and 1 differ on one (5 - 1), 0 and 2 on all, 1 and 2 on all but one (1 - 5).
    assert alike.pairs == pytest.approx([4 / 6, -1, -4 / 6])
    # 0: 1 2 3 4 with the mean 2.5 2.5 3 2 of the others: 2 pairs agree, 3 do not, 1 is tied: -1 / sqrt(6 * 5).
    # 1: the others' mean is 2.5 throughout.
    # 2: 4 3 2 1 with 1 2 3.5 3.5: 5 pairs disagree, 1 is tied: -5 / sqrt(6 * 5).
    assert alike.with_others == pytest.approx([-1 / sqrt(30), np.nan, -5 / sqrt(30)], nan_ok=True)


@pytest.mark.parametrize("seeds", [0, 1])
def test_fewer_than_two_seeds_have_no_consistency(seeds: int):
    alike = consistency(np.ones((seeds, 4), dtype=np.int64))
    assert (alike.with_others.shape, alike.pairs.shape) == ((0,), (0,))


def test_a_constant_order_agrees_with_none():
    alike = consistency(np.array([[1, 1, 1], [1, 2, 3]]))
    assert np.isnan(alike.pairs).tolist() == [True]
    assert np.isnan(alike.with_others).tolist() == [True, True]


@pytest.mark.filterwarnings("error")
def test_a_single_instance_has_no_order():
    assert np.isnan(consistency(np.array([[1], [1]])).pairs).tolist() == [True]


def test_methods_agree_by_their_mean_orders():
    # The mean order 1 2.5 2.5 with 1 2 3: 2 pairs agree, 1 is tied: 2 / sqrt(3 * 2). The mean of the taus would be 2/3.
    ours, theirs = np.array([[1, 2, 3], [1, 3, 2]]), np.array([[1, 2, 3]])
    assert agreement(ours, theirs) == agreement(theirs, ours) == pytest.approx(2 / sqrt(6))
    assert np.isnan(agreement(ours, np.array([[1, 1, 1]])))


# The corners of a square: ids 0 to 3 anticlockwise.
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
CORNERS = ints(0, 1, 2, 3)


def test_shifts_end_with_the_step_into_the_whole_set():
    moved = shifts(sets([0], [1, 1], [1, 1, 2], [3, 2, 1, 0], [0], [2]), CORNERS, SQUARE)
    # Means (0, 0), (1, 0), (1, 1/2) as draws count once, (1/2, 1/2); lengths 1, 1/2, 1/2 of the diagonal sqrt(2).
    assert moved.steps == pytest.approx([1 / sqrt(2), 0.5 / sqrt(2), 0.5 / sqrt(2)])
    # Nothing of 2 in common; 1 of 2; 2 of 4.
    assert moved.jaccard.tolist() == [1, 0.5, 0.5]


def test_shifts_of_a_run_that_never_has_the_whole_set_are_all_its_transitions():
    moved = shifts(sets([0], [2], [2]), CORNERS, SQUARE)
    assert moved.steps == pytest.approx([1, 0])  # the whole diagonal, and not at all
    assert moved.jaccard.tolist() == [1, 0]


@pytest.mark.parametrize("trained", [[[0, 1, 2, 3], [0], [0, 1]], [[0]]])
def test_no_shifts_where_nothing_was_grown(trained: list[list[int]]):
    moved = shifts(sets(*trained), CORNERS, SQUARE)
    assert (moved.steps.shape, moved.jaccard.shape) == ((0,), (0,))


@pytest.mark.parametrize(("share", "expected"), [(0.5, 0.1), (0.51, 0.3), (0.75, 0.3), (1.0, 0.6), (0.25, 0.0)])
def test_share_of_steps_on_less_than_a_share_of_the_set(share: float, expected: float):
    # 1, 2, 3 and 4 of 4 instances, for 10, 20, 30 and 40 of 100 steps.
    trained = sets([0, 0, 0], [0, 1], [0, 1, 2], [0, 1, 2, 3])
    assert share_below(trained, CORNERS, ints(10, 30, 60, 100), share) == pytest.approx(expected)


def test_half_of_the_set_is_the_share_unless_said_otherwise():
    assert share_below(sets([0], [0, 1]), CORNERS, ints(1, 4)) == 0.25


@pytest.mark.parametrize("percent", [7, 14, 28, 55, 56, 57])
def test_exactly_a_share_of_the_set_is_not_below_it_whatever_rounding_says(percent: int):
    ids = np.arange(100)
    assert share_below((ids[:percent],), ids, ints(50), percent / 100) == 0
    assert share_below((ids[: percent - 1],), ids, ints(50), percent / 100) == 1


def test_mean_features_of_each_set():
    features = np.array([[1.0, -1.0], [2.0, 0.0], [6.0, 4.0], [100.0, 100.0]])
    # {20}, {20, 30}, {10, 20, 30} twice: (2), (2 + 6) / 2, (1 + 2 + 6) / 3; (0), (0 + 4) / 2, (-1 + 0 + 4) / 3.
    assert feature_means(TRAINED, IDS, features).tolist() == [[2, 0], [4, 2], [3, 1], [3, 1]]


def test_features_by_rank_are_means_over_seeds_with_ties_by_id():
    # Seed 0 includes b, a, c; seed 1 a and b together, so a, b, c.
    by_rank = features_by_rank(np.array([[2, 1, 3], [1, 1, 3]]), np.array([[10.0], [20.0], [40.0]]))
    assert by_rank.tolist() == [[15], [15], [40]]


def test_features_of_many_instances_included_together_are_in_order_of_id():
    features = np.arange(1000.0)[:, None]
    orders = np.where(np.arange(1000) % 2 == 0, 1, 2)[None, :]
    assert features_by_rank(orders, features)[:, 0].tolist() == [*range(0, 1000, 2), *range(1, 1000, 2)]


def test_correlation_of_features_with_the_mean_order():
    orders = np.array([[1, 2, 3, 4], [1, 3, 2, 5]])  # mean 1 2.5 2.5 4.5
    features = np.array([[0, 3, 7, 0], [1, 2, 7, 0], [2, 1, 7, 1], [3, 0, 7, 1]], dtype=np.float64)
    # Rising: 5 of 6 pairs agree, b-c is tied in the order: 5 / sqrt(5 * 6). The last: a-b and c-d are tied in the
    # feature as well, so a-c, a-d and b-d agree: 3 / sqrt(5 * 4).
    expected = [5 / sqrt(30), -5 / sqrt(30), np.nan, 3 / sqrt(20)]
    assert feature_rank_correlations(orders, features) == pytest.approx(expected, nan_ok=True)


def test_released_steps_are_the_horizon_for_each_instance():
    assert released_steps(ints(1, 1, 3), 100).tolist() == [100, 200, 500]


@pytest.mark.parametrize(
    ("trained", "ids", "message"),
    [
        ([], [1, 2], "no iterations"),
        ([[1], []], [1, 2], "iteration 2 has no instances"),
        ([[1], [2, 4]], [1, 3, 5], "iteration 2 has instance 2, which is not one of the run's"),
        ([[6]], [1, 3, 5], "iteration 1 has instance 6"),
        ([[-1]], [1, 3, 5], "iteration 1 has instance -1"),
        ([[1]], [3, 1], "do not ascend"),
        ([[1]], [1, 1], "do not ascend"),
        ([[1]], [], "do not ascend"),
    ],
)
def test_curricula_that_make_no_sense_are_refused(trained: list[list[int]], ids: list[int], message: str):
    for analyse in (inclusion_order, frequencies):
        with pytest.raises(ValueError, match=message):
            analyse(sets(*trained), ints(*ids))


def test_ends_of_another_run_and_no_seeds_are_refused():
    with pytest.raises(ValueError, match="2 ends of 4 iterations"):
        share_below(TRAINED, IDS, ints(1, 2))
    none, some = np.ones((0, 2), dtype=np.int64), np.ones((1, 2), dtype=np.int64)
    for call in (lambda: agreement(none, some), lambda: agreement(some, none),
                 lambda: features_by_rank(none, np.ones((2, 1))),
                 lambda: feature_rank_correlations(none, np.ones((2, 1)))):  # fmt: skip
        with pytest.raises(ValueError, match="no seeds"):
            call()


def course(*blocks: tuple[float, float]) -> NDArray[np.float64]:
    """Five returns for each (mean, deviation), whose sample variance is the deviation's square: -a, a, 0, -a, a.

    The sum of squares is 4 a^2, over 5 - 1. Their sum is the mean's, so that means are exact.
    """
    return np.concatenate([mean + deviation * floats(-1, 1, 0, -1, 1) for mean, deviation in blocks])


@pytest.mark.parametrize(
    ("start", "peak", "end", "expected"),
    [
        (0, 10, 4, True),
        (4, 10, 4, True),  # rose by exactly 6
        (4.5, 10, 4, False),  # rose by 5.5
        (0, 10, 4.5, False),  # fell by 5.5
        (0, 5, 10, False),  # still rising
        (10, 8, 0, False),  # fell, having never risen
        (7, 7, 7, False),
    ],
)
def test_forgotten_is_what_rose_by_delta_and_fell_by_it(start: float, peak: float, end: float, expected: bool):
    returns = course((start, 0), (peak, 0), (end, 0))[:, None]
    assert forgotten(returns, 6.0).tolist() == [expected]


@pytest.mark.parametrize(
    ("at_peak", "at_end", "expected"),
    [
        # A fall of 6 against 2 sqrt((b^2 + a^2) / 5). The peak's deviations begin upwards, the end's downwards: else
        # the windows between them would have greater means than the peak.
        (0, 6.5, True),  # 5.81
        (0, 7, False),  # 6.26
        (-6.5, 0, True),
        (-7, 0, False),
        (-4.5, 4.5, True),  # 5.69
        (-5, 5, False),  # 6.32
    ],
)
def test_a_decay_within_two_standard_errors_is_noise(at_peak: float, at_end: float, expected: bool):
    assert forgotten(course((0, 0), (10, at_peak), (4, at_end))[:, None], 6.0).tolist() == [expected]


def test_of_equal_peaks_the_first_one_counts():
    quiet_first = course((0, 0), (10, 0), (10, 5), (4, 5))  # 2 sqrt(25 / 5) = 4.47; with the noise of the second 6.32
    assert forgotten(quiet_first[:, None], 6.0).tolist() == [True]


def test_instances_are_judged_one_by_one():
    returns = np.stack([course((0, 0), (10, 0), (4, 0)), course((0, 0), (5, 0), (10, 0))], axis=1)
    assert forgotten(returns, 6.0).tolist() == [True, False]
    assert forgotten(returns[:, [0, 0, 0]], 6.0).tolist() == [True] * 3
    assert forgotten(returns[:, [1, 1]], 6.0).tolist() == [False] * 2


def test_a_spike_of_one_evaluation_is_smoothed_away():
    spike = course((0, 0), (0, 0), (0, 0))
    spike[7] = 25.0  # a running mean of 5
    assert forgotten(spike[:, None], 6.0).tolist() == [False]


def test_forgetting_needs_five_evaluations_numbers_and_a_delta():
    assert forgotten(np.arange(10.0).reshape(5, 2), 0.5).tolist() == [False, False]
    with pytest.raises(ValueError, match="4 evaluations, where a running mean needs 5"):
        forgotten(np.zeros((4, 2)), 0.5)
    with pytest.raises(ValueError, match="NaN"):
        forgotten(np.full((5, 2), np.nan), 0.5)
    for delta in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="not positive"):
            forgotten(np.zeros((5, 2)), delta)


def test_span_is_over_all_runs():
    assert span([np.array([[1.0, 5.0], [0.0, 2.0]]), floats(-2, 3)]) == 7
    assert np.isnan(span([floats(1, 2), floats(np.nan)]))
    for nothing in ([], [floats()]):
        with pytest.raises(ValueError, match="no returns"):
            span(nothing)


@pytest.mark.parametrize(
    ("share", "expected"),
    [
        (0.1, 7),  # ceil(0.3) = 1: the one with 1
        (0.34, 6),  # ceil(1.02) = 2: 1 and 2
        (1.0, 5),  # (3 + 7 + 5) / 3
    ],
)
def test_worst_mean_rounds_up(share: float, expected: float):
    assert worst_mean(floats(3, 1, 2), floats(3, 7, 5), share) == expected


def test_the_worst_tenth_is_meant_unless_said_otherwise():
    assert worst_mean(np.arange(20.0), np.arange(20.0)) == 0.5  # 0 and 1


def test_of_equally_bad_instances_the_first_count():
    assert worst_mean(floats(1, 1, 2), floats(5, 7, 9), 1 / 3) == 5
    chosen = np.where(np.arange(1000) % 2 == 0, 1.0, 2.0)
    assert worst_mean(chosen, np.arange(1000.0), 0.003) == 2  # 0, 2, 4


def test_seven_percent_of_a_hundred_are_seven():
    assert worst_mean(np.arange(100.0), np.arange(100.0), 0.07) == 3  # of 0..6; eight would have 3.5
    assert worst_mean(np.arange(4.0), np.arange(4.0), 1e-12) == 0  # and never none


def test_the_worst_of_each_half_are_measured_on_the_other():
    # The first half's worst, 0, has 9 on the second; the second's worst, 1, has 2 on the first.
    assert cross_worst_mean(np.array([[0.0, 2.0, 4.0], [9.0, 1.0, 5.0]]), 1 / 3) == 5.5


def test_worst_mean_of_what_diverged_and_of_nonsense():
    assert np.isnan(worst_mean(floats(np.nan, 1, 2), floats(1, 2, 3)))
    assert np.isnan(worst_mean(floats(1, 2, 3), floats(1, 2, np.nan)))
    with pytest.raises(ValueError, match="chosen on 2 instances, measured on 1"):
        worst_mean(floats(1, 2), floats(1))
    with pytest.raises(ValueError, match="chosen on 0"):
        worst_mean(floats(), floats())
    for share in (0.0, 1.1, np.nan):
        with pytest.raises(ValueError, match="not in"):
            worst_mean(floats(1), floats(1), share)


@pytest.mark.parametrize(
    ("steps", "values", "budget", "expected"),
    [
        ([0, 10, 20], [0, 10, 10], 20, (50 + 100) / 20),
        ([0, 10, 20], [0, 10, 10], 40, (50 + 100 + 200) / 40),  # the last value holds
        ([10, 20], [4, 8], 20, (40 + 60) / 20),  # the first value holds
        ([0, 20], [0, 20], 10, 50 / 10),  # the line is followed to 10 at step 10
        ([0, 10, 30, 50], [0, 0, 20, 99], 20, (0 + 50) / 20),  # one evaluation behind the budget is enough
        ([0, 10, 20], [0, 10, 50], 10, 50 / 10),
        ([5], [3], 100, 3),
        ([200], [3], 100, 3),
    ],
)
def test_area_under_a_curve(steps: list[int], values: list[float], budget: int, expected: float):
    assert area(ints(*steps), floats(*values), budget) == pytest.approx(expected)


def test_area_of_what_diverged_and_of_nonsense():
    assert np.isnan(area(ints(0, 10), floats(1, np.nan), 10))
    for steps, values, budget, message in (
        ([], [], 1, "0 steps of 0 evaluations"), ([0, 1], [1], 1, "2 steps of 1"), ([0, 0], [1, 1], 1, "do not ascend"),
        ([0, 2, 1], [1, 1, 1], 1, "do not ascend"), ([-1, 2], [1, 1], 1, "do not ascend from 0"),
        ([0], [1], 0, "budget is 0"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            area(ints(*steps), floats(*values), budget)


def test_paired_difference_of_three_seeds():
    found = paired_difference(floats(2, 4, 6), floats(1, 2, 3))
    # Mean 2, standard deviation 1, t(0.975, 2) = 4.302653 by the tables: half a width of 4.302653 / sqrt(3) = 2.484138.
    assert (found.n, found.mean.value, found.p) == (3, 2, 0.25)  # 2 of the 2^3 signs are as extreme
    assert (found.mean.low, found.mean.high) == pytest.approx((-0.484138, 4.484138), abs=1e-6)
    assert paired_difference(floats(1, 2, 3), floats(2, 4, 6)).mean.value == -2
    assert paired_difference(floats(1, 2, 3, 4, 10), np.zeros(5)).mean.value == 4  # of all, not of the middle


@pytest.mark.parametrize(
    ("differences", "p"),
    [
        ([1, 2, 3, 4, 5], 2 / 32),
        ([-1, 2, 3, 4], 4 / 16),  # ranks 1 2 3 4: sums of positive ones 10 and 9, and as many below
        ([-1, 1, 2, 3], 6 / 16),  # ranks 1.5 1.5 3 4: 10, and 8.5 twice
        ([-1, 1, 1], 1),  # ranks 2 2 2: 6 once and 4 thrice, half of all; as if untied, 6 of 8
        ([0, 1, 2, 3], 2 / 8),  # the 0 is left out
        ([0, 0, 1], 1),
        ([1] * 13, 2 / 2**13),
        (list(range(1, 21)), 2 / 2**20),
    ],
)
def test_p_values_are_exact(differences: list[float], p: float):
    # Adding to both is exact in these, so that ties stay ties.
    theirs = 8.0 * np.arange(len(differences))
    assert paired_difference(theirs + floats(*differences), theirs).p == pytest.approx(p)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("differences", [[1], [1, 2], [0, 0, 0, 0], [1, 2, 3, np.nan]])
def test_no_p_value_below_three_pairs_without_differences_and_where_one_is_missing(differences: list[float]):
    found = paired_difference(floats(*differences), np.zeros(len(differences)))
    assert np.isnan(found.p)
    assert (found.n, found.mean.low, found.mean.high) == (len(differences), None, None)
    assert found.mean.value == pytest.approx(np.mean(differences), nan_ok=True)


def test_what_is_no_pairs_is_refused():
    for ours, theirs in ((floats(1, 2, 3), floats(1)), (floats(), floats())):
        with pytest.raises(ValueError, match="make no pairs"):
            paired_difference(ours, theirs)


def test_profiles_count_what_is_strictly_above():
    assert profile(floats(1, 2, 2, 3), floats(0, 2, 2.5, 3)).tolist() == [1, 0.25, 0.25, 0]
    assert profile(floats(np.nan, 1), floats(-np.inf, 0, 1)).tolist() == [0.5, 0.5, 0]
    with pytest.raises(ValueError, match="no scores"):
        profile(floats(), floats(0))


orders_of_seeds = st.tuples(st.integers(2, 4), st.integers(2, 6)).flatmap(
    lambda shape: st.lists(
        st.lists(st.integers(1, 6), min_size=shape[1], max_size=shape[1]), min_size=shape[0], max_size=shape[0]
    )
)


@given(orders_of_seeds, st.randoms(use_true_random=False))
def test_what_instances_are_called_decides_no_correlation(rows: list[list[int]], random):
    orders = np.array(rows)
    places = list(range(orders.shape[1]))
    random.shuffle(places)
    named, renamed = consistency(orders), consistency(orders[:, places])
    assert renamed.pairs == pytest.approx(named.pairs, nan_ok=True)
    assert renamed.with_others == pytest.approx(named.with_others, nan_ok=True)
    assert agreement(orders[:1, places], orders[1:, places]) == pytest.approx(named.with_others[0], nan_ok=True)


@given(st.lists(st.integers(1, 9), min_size=2, max_size=8).filter(lambda order: len(set(order)) > 1))
def test_an_order_agrees_with_itself_and_not_with_its_reverse(order: list[int]):
    forwards, backwards = np.array([order]), np.array([[10 - place for place in order]])
    assert consistency(np.concatenate([forwards, forwards])).pairs == pytest.approx([1])
    assert agreement(forwards, backwards) == pytest.approx(-1)


curricula = st.lists(st.lists(st.integers(0, 3), min_size=1, max_size=6), min_size=1, max_size=6)


@given(curricula)
def test_who_is_included_late_is_trained_on_seldom(trained: list[list[int]]):
    order, share = inclusion_order(sets(*trained), CORNERS), frequencies(sets(*trained), CORNERS)
    iterations = len(trained)
    assert ((order == iterations + 1) == (share == 0)).all()
    assert (share <= (iterations + 1 - order) / iterations + 1e-12).all()
    assert (weighted_frequencies(share, order) <= share + 1e-12).all()


@given(curricula)
def test_shifts_are_shares(trained: list[list[int]]):
    moved = shifts(sets(*trained), CORNERS, SQUARE)
    for values in (moved.steps, moved.jaccard):
        assert len(values) < len(trained)
        assert ((values >= 0) & (values <= 1 + 1e-12)).all()


@given(st.lists(st.integers(-50, 50), min_size=1, max_size=12), st.floats(0.01, 1))
def test_the_worst_are_no_better_than_all(returns: list[int], share: float):
    values = floats(*returns)
    assert values.min() <= worst_mean(values, values, share) <= values.mean() + 1e-9


@given(st.dictionaries(st.integers(0, 100), st.integers(-50, 50), min_size=1), st.integers(1, 120))
def test_an_area_is_between_the_least_and_the_greatest_value(curve: dict[int, int], budget: int):
    steps = sorted(curve)
    values = floats(*(curve[step] for step in steps))
    assert values.min() - 1e-9 <= area(ints(*steps), values, budget) <= values.max() + 1e-9


def test_a_set_stays_for_so_many_iterations():
    # [20 20], [20] are the same set; then [10 20], [20] again, and [30] to the end.
    trained = sets([20, 20], [20], [10, 20], [20], [30], [30], [30])
    assert stretches(trained, IDS).tolist() == [2, 1, 1, 3]
    assert stretches(sets([10]), IDS).tolist() == [1]


def test_shares_of_the_first_episodes():
    # Episodes 20 | 20 30 | 10 20 30 | 10 20 30: the first four are 20, 20, 30, and a third of each of 10, 20 and 30.
    assert shares_of_first(TRAINED, IDS, 4) == pytest.approx([1 / 12, (2 + 1 / 3) / 4, (1 + 1 / 3) / 4, 0])
    assert shares_of_first(TRAINED, IDS, 3).tolist() == pytest.approx([0, 2 / 3, 1 / 3, 0])
    # Nine there are: 10 twice, 20 four times, 30 three times.
    assert shares_of_first(TRAINED, IDS, 1000) == pytest.approx([2 / 9, 4 / 9, 3 / 9, 0])
