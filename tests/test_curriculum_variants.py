"""The named variants of Algorithm 1, each worked out by hand on four instances with ids 1, 2, 3, 4.

eta = 1/8 and binary fractions keep the arithmetic exact, as in test_curricula.py.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from space_dist.config import RunConfig, load
from space_dist.curricula import Curriculum, RoundRobin, SetState, Space, variants
from space_dist.curricula.making import make_curriculum
from space_dist.envs import make_batched
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds, InstanceSet, read_csv
from space_dist.run.building import Blueprint, spec_of
from space_dist.run.cluster import Central
from tests.test_curricula import as_plain, drive, feedback, make_set, shown, stored_and_restored

SPACE = Path(__file__).parent.parent / "configs" / "pointmass_space.yaml"


def config_with(curriculum: str, *overrides: str) -> RunConfig:
    return load(SPACE, [f"curriculum={curriculum}", *overrides])


def follow(curriculum: Curriculum, first: Sequence[int], values: Sequence[Sequence[float]], steps: Any = None) -> Any:
    """(ids, grew, numbers, state) of each decision from the ids `first` on values V_0, V_1, ..."""
    state = SetState(version=0, order_version=0, size=len(first), selected=np.array(first) - 1)
    decided = []
    for t, (before, after) in enumerate(itertools.pairwise(values)):
        state, selection, numbers = curriculum.step(state, feedback(state, before, after, steps[t] if steps else 1))
        decided.append((selection.ids.tolist(), numbers["grew"], numbers, state))
    return decided


def space(instances: InstanceSet | None = None, **settings: Any) -> Space:
    return Space(instances or make_set(4), **{"eta": 0.125, "kappa": 1, "seed": 0, **settings})


# ---- Line 12: what instances are ranked by -------------------------------------------------------


@pytest.mark.parametrize(
    ("pic", "expected"),
    [
        # V_0 = (  8, 4, -2, -16 )     From {1, 2}, kappa = 1.
        # V_1 = ( 10, 7, -3,  -8 )     d_1 = (  2,   3, -1,  8 )     d_1 / |V_0| = (  0.25,  0.75,   -0.5,   0.5   )
        # V_2 = (  4, 6,  5, -10 )     d_2 = ( -6,  -1,  8, -2 )     d_2 / |V_1| = ( -0.6,  -0.143,   2.667, -0.25  )
        # V_3 = ( 5.5, 8, 1,  -5 )     d_3 = ( 1.5,  2, -4,  5 )     d_3 / |V_2| = (  0.375, 0.333,  -0.8,    0.5   )
        # t = 1: {1, 2}: |8.5 - 6| = 2.5 > 0.75: not grown, S = 2, for each of them.
        (
            "improvement",
            # t = 2: {4, 2}:    |8 - 7.5|   = 0.5   <= 0.9375: grown.   7.5 = (8 + 7) / 2, 8 = (10 + 6) / 2
            # t = 3: {3, 2, 4}: |4.67 - 7|  = 2.33  >  0.875: not.      7 = (5 + 6 + 10) / 3, 4.67 = (1 + 8 + 5) / 3
            [([4, 2], False), ([3, 2, 4], True), ([4, 2, 1], False)],
        ),
        (
            "abs",
            # t = 2: {4, 2}, as above: grown. |d_2| = (6, 1, 8, 2)
            # t = 3: {3, 1, 4}: |3.83 - 6.33| = 2.5 > 0.79: not. 6.33 = (5 + 4 + 10) / 3, 3.83 = (1 + 5.5 + 5) / 3
            #        |d_3| = (1.5, 2, 4, 5)
            [([4, 2], False), ([3, 1, 4], True), ([4, 3, 2], False)],
        ),
        (
            "relative",
            # t = 2, 3: the same sets as `improvement`, so the same growth; the orders differ.
            [([2, 4], False), ([3, 2, 4], True), ([4, 1, 2], False)],
        ),
        (
            "lowest_value",
            # t = 2: {4, 3}: |7.5 - 5.5|  = 2    > 0.6875: not.    5.5 = (8 + 3) / 2, 7.5 = (10 + 5) / 2
            # t = 3: {4, 1}: |5.25 - 7|   = 1.75 > 0.875: not.     7 = (10 + 4) / 2, 5.25 = (5 + 5.5) / 2
            [([4, 3], False), ([4, 1], False), ([4, 3], False)],
        ),
    ],
)
def test_trace_of_each_ranking_by_value(pic: Any, expected: list[tuple[list[int], bool]]):
    values = [(8, 4, -2, -16), (10, 7, -3, -8), (4, 6, 5, -10), (5.5, 8, 1, -5)]
    decided = follow(space(rank=variants.BY_VALUE[pic]), [1, 2], values)
    assert [(ids, grew) for ids, grew, *_ in decided] == expected
    through_config = make_curriculum(config_with(f"{{kind: space, eta: 0.125, pic: {pic}}}"), make_set(4), _bounds())
    assert [(ids, grew) for ids, grew, *_ in follow(through_config, [1, 2], values)] == expected
    # The log tells the signed change whatever is ranked by.
    assert [(numbers["largest_pic"], numbers["smallest_pic"]) for _, _, numbers, _ in decided] == [
        (8, -1), (8, -6), (5, -4),
    ]  # fmt: skip


def test_relative_takes_shares_of_at_least_1e_8():
    # 1e-6 / 1e-8 = 100, not 1e-6 / 0;  4 / 4 = 1;  2 / |-4| = 0.5;  -8 / 8 = -1.
    everything = SetState(version=0, order_version=0, size=4, selected=np.arange(4))
    curriculum = space(rank=variants.relative)
    _, selection, _ = curriculum.step(everything, feedback(everything, (0, 4, -4, 8), (1e-6, 8, -2, 0)))
    assert selection.ids.tolist() == [1, 2, 3, 4]
    # 1e303 / 1e-8 is beyond all floats: such shares tie, above the finite ones.
    _, selection, _ = curriculum.step(everything, feedback(everything, (8, 0, 0, 4), (-8, 1e303, 1e304, 5)))
    assert set(selection.ids.tolist()[:2]) == {2, 3}
    assert selection.ids.tolist()[2:] == [4, 1]


def test_pic_random_and_random_growth_are_one():
    values = np.random.default_rng(0).normal(size=(30, 12)).cumsum(axis=0) * 0.05 + 1
    for more in ("", ", growth: multiply, kappa: 3", ", mean: as_printed", ", adaptive_eta: persistent, patience: 2"):
        one, other = (
            make_curriculum(config_with(f"{{kind: {kind}{more}}}", "seed=5"), make_set(12), _bounds())
            for kind in ("space, pic: random", "random_growth")
        )
        assert as_plain(drive(one, values)) == as_plain(drive(other, values))


# ---- Lines 6-7: the readings ---------------------------------------------------------------------


def test_trace_as_printed():
    # From {1}, kappa = 2.
    # t  V_t                    d_t                       V_t over its set, V_{t-1} over the set of t - 1
    # 0  ( 8,     16,   64,   32   )
    # 1  ( 8.5,   18,   65,   33.5 )  (0.5,  2,   1,   1.5 )   |8.5 - 0|  = 8.5  > 1e-8 / 8    not grown: {2}
    #       same_set: |8.5 - 8| = 0.5 <= 1 would have grown it
    # 2  ( 9.25,  19,   65.5, 35.5 )  (0.75, 1,   0.5, 2   )   |19 - 8.5| = 10.5 > 1.0625     not grown: {4}
    #       same_set: |19 - 18| = 1 <= 2.25
    # 3  ( 10.25, 19.5, 67.5, 20   )  (1,    0.5, 2, -15.5 )   |20 - 19|  = 1   <= 2.375      grown, S = 3: {3, 1, 2}
    #       same_set: |20 - 35.5| = 15.5 > 4.4375: by coincidence
    values = [(8, 16, 64, 32), (8.5, 18, 65, 33.5), (9.25, 19, 65.5, 35.5), (10.25, 19.5, 67.5, 20)]
    decided = follow(space(mean="as_printed", kappa=2), [1], values)
    assert [(ids, grew) for ids, grew, *_ in decided] == [([2], False), ([4], False), ([3, 1, 2], True)]
    numbers = [numbers for *_, numbers, _ in decided]
    assert [one["relative_change_as_printed"] for one in numbers] == [None, 10.5 / 8.5, 1 / 19]
    assert [one["relative_change"] for one in numbers] == [0.5 / 8, 1 / 18, 15.5 / 35.5]


def test_as_printed_grows_first_only_where_values_are_as_good_as_zero():
    # V_0 := 0, so V_1 <= 1e-8 / 8 = 1.25e-9.
    for after, grew in ((1.25e-9, True), (1.3e-9, False)):
        assert follow(space(mean="as_printed"), [1], [(8, 1, 1, 1), (after, 1, 1, 1)])[0][1] is grew


def test_trace_mean_abs_change():
    # From {1, 2}, kappa = 1.
    # t  V_t                  d_t                     mean |d_t| against mean |V_{t-1}| / 8, over the set trained on
    # 0  (  8, 24, 0,    0 )
    # 1  ( 12, 20, 1,   -1 )  ( 4, -4,  1,   -1 )     4        > 16 / 8 = 2             not grown: {1, 3}
    #       same_set: the means are 16 and 16
    # 2  ( 13, 20, 0.5, -2 )  ( 1,  0, -0.5, -1 )     1.5 / 2 <= (12 + 1) / 2 / 8       grown, S = 3: {1, 2, 3}
    # 3  ( 14, 19, 2.5,  1 )  ( 1, -1,  2,    3 )     4 / 3   <= 33.5 / 3 / 8 = 1.396   grown, S = 4: {4, 3, 1, 2}
    values = [(8, 24, 0, 0), (12, 20, 1, -1), (13, 20, 0.5, -2), (14, 19, 2.5, 1)]
    decided = follow(space(mean="mean_abs_change"), [1, 2], values)
    assert [(ids, grew) for ids, grew, *_ in decided] == [([1, 3], False), ([1, 2, 3], True), ([4, 3, 1, 2], True)]
    assert [numbers["relative_change_each"] for *_, numbers, _ in decided] == pytest.approx([0.25, 1.5 / 13, 4 / 33.5])
    assert follow(space(), [1, 2], values)[0][1] is True


def test_v0_zero_makes_the_first_changes_the_values_themselves():
    # The network says (8, 16, 64, 32) before and (8.5, 18, 60, 33) after the first update.
    # network: d_1 = (0.5, 2, -4, 1), and |8.5 - 8| <= 1.    zero: d_1 = (8.5, 18, 60, 33), and |8.5 - 0| > 1e-8 / 8.
    first, second = np.array([8.0, 16, 64, 32]), np.array([8.5, 18, 60, 33])
    start = SetState(version=0, order_version=0, size=1, selected=np.array([0]))
    for v0, grew, ids in (("network", True, [2, 4]), ("zero", False, [3])):
        central = Central(config_with(f"{{kind: space, eta: 0.125, v0: {v0}}}"), make_set(4), _bounds())
        *_, values = central.begin(first[:3], first[3:])
        assert values.tolist() == (first.tolist() if v0 == "network" else [0.0] * 4)
        new, selection, numbers, after = central.decide(start, values, 0, 1, {"after": 1}, second)
        assert (numbers["grew"], selection.ids.tolist(), after.tolist()) == (grew, ids, second.tolist())
        assert numbers["mean_value_before"] == (8.0 if v0 == "network" else 0)
        # Rescored under new scales, the values before are new ones; zeros are never sent to be rescored.
        _, selection, numbers, _ = central.decide(
            start, values, 0, 1, {"after": 1, "rescored": 1}, second, first + 0.25
        )
        assert numbers["mean_value_before"] == 8.25
        _, _, numbers, _ = central.decide(
            new, after, 1, 1, {"after": 1, "rescored": 1}, second, np.array([1.0, 2.0, 3.0, 4.0])
        )
        assert numbers["mean_value_before"] == np.mean([(1.0, 2.0, 3.0, 4.0)[i - 1] for i in ids])


# ---- Line 8: how the set grows -------------------------------------------------------------------


def test_trace_multiply():
    # From {1}, kappa = 2.
    # t  V_t                             d_t
    # 0  ( 8,    8,     8,     8     )
    # 1  ( 8,    8.25,  8.5,   8.75  )   ( 0,    0.25,  0.5,   0.75  )   0     <= 1       grown, S = 1 * 2: {4, 3}
    # 2  ( 8.75, 8.625, 9.125, 8.875 )   ( 0.75, 0.375, 0.625, 0.125 )   0.375 <= 1.078   grown, S = 2 * 2: {1, 3, 2, 4}
    #       8.625 = (8.75 + 8.5) / 2, 9 = (8.875 + 9.125) / 2. Adding one would make {1, 3, 2}
    # 3  (16,   15,    14,    13     )   ( 7.25, 6.375, 4.875, 4.125 )   not settled: S = 4: {1, 2, 3, 4}
    # 4  (16,   15.25, 14.5,  13.75  )   ( 0,    0.25,  0.5,   0.75  )   settled: min(4 * 2, 4) = 4: {4, 3, 2, 1}
    values = [(8, 8, 8, 8), (8, 8.25, 8.5, 8.75), (8.75, 8.625, 9.125, 8.875), (16, 15, 14, 13),
              (16, 15.25, 14.5, 13.75)]  # fmt: skip
    decided = follow(space(growth="multiply", kappa=2), [1], values)
    assert [(ids, grew) for ids, grew, *_ in decided] == [
        ([4, 3], True), ([1, 3, 2, 4], True), ([1, 2, 3, 4], False), ([4, 3, 2, 1], False),
    ]  # fmt: skip
    still = [[1.0] * 100] * 8
    sizes = [state.size for *_, state in follow(space(make_set(100), growth="multiply", kappa=3), [1], still)]
    assert sizes == [3, 9, 27, 81, 100, 100, 100]


# ---- Theorem 2 -----------------------------------------------------------------------------------


def test_trace_adaptive_eta():
    # All values are 4, 8, 4, 8, ...: dV = 4 always, more than 4 / 8 and 8 / 8. kappa = 1, patience = 2, epsilon = 1/2.
    # t  V_{t-1}  once                                     persistent
    # 1  4        4 > 0.5                        S = 1     the same
    # 2  8        4 > 1                          S = 1     the same
    # 3  4        eta = 4.5 / 4 = 1.125: grown   S = 2     the same
    # 4  8        4 > 1                          S = 2     4 <= 1.125 * 8: grown   S = 3
    # 5  4        4 > 0.5                        S = 2     4 <= 1.125 * 4: grown   S = 4
    # 6  8        eta = 4.5 / 8 = 0.5625: grown  S = 3     S = 4, eta stays
    values = [[4.0 if t % 2 == 0 else 8.0] * 4 for t in range(7)]
    expected = {
        "off": ([1] * 6, [0.125] * 6, [1, 2, 3, 4, 5, 6]),
        "once": ([1, 1, 2, 2, 2, 3], [0.125, 0.125, 1.125, 0.125, 0.125, 0.5625], [1, 2, 0, 1, 2, 0]),
        "persistent": ([1, 1, 2, 3, 4, 4], [0.125, 0.125, 1.125, 1.125, 1.125, 1.125], [1, 2, 0, 0, 0, 0]),
    }
    for mode, (sizes, etas, stalled) in expected.items():
        decided = follow(space(adaptive_eta=mode, patience=2, epsilon=0.5), [1], values)
        assert [state.size for *_, state in decided] == sizes
        assert [numbers["eta"] for *_, numbers, _ in decided] == etas
        assert [state.stalled for *_, state in decided] == stalled
        assert [state.eta for *_, state in decided] == (etas if mode == "persistent" else [None] * 6)


def test_a_raised_eta_grows_the_set_also_where_its_formula_would_not():
    # eta = 2, V_{t-1} = 0, dV = 1e-7 > 2e-8. The formula gives (1e-7 + 1e-3) / 1e-3 = 1.0001, which raises nothing and
    # times the floor 1e-8 is no 1e-7 either. Yet the set grows, and eta is not lowered.
    values = [(0, 0, 0, 0), (1e-7, 0, 0, 0), (0, 0, 0, 0), (1e-7, 0, 0, 0)]
    for mode in ("once", "persistent"):
        curriculum = space(eta=2.0, adaptive_eta=mode, patience=1, rank=variants.near_centroid(np.eye(4)))
        decided = follow(curriculum, [1], values, steps=[1, 0, 1])
        assert [(grew, numbers["eta"]) for _, grew, numbers, _ in decided] == [
            (False, 2.0), (False, None), (True, 2.0),
        ]  # fmt: skip
    # V_{t-1} = 0.25 is less than epsilon = 0.5: (1.75 + 0.5) / 0.5, not / 0.25.
    decided = follow(space(adaptive_eta="once", patience=1, epsilon=0.5), [1], [[0.5] * 4, [0.25] * 4, [2.0] * 4])
    assert [(grew, numbers["eta"]) for _, grew, numbers, _ in decided] == [(False, 0.125), (True, 4.5)]
    # An eta beyond all floats is the largest one: it must be storable.
    decided = follow(space(adaptive_eta="persistent", patience=1), [1], [[1e308] * 4, [0.0] * 4, [1e308] * 4])
    assert [(grew, numbers["eta"]) for _, grew, numbers, _ in decided] == [(False, 0.125), (True, sys.float_info.max)]


def test_an_iteration_without_a_gradient_step_is_no_test():
    values = [[4.0 if t % 2 == 0 else 8.0] * 4 for t in range(7)]
    decided = follow(space(adaptive_eta="once", patience=1), [1], values, steps=[1, 0, 0, 1, 0, 1])
    assert [(grew, state.stalled, numbers["eta"] is None) for _, grew, numbers, state in decided] == [
        (False, 1, False), (False, 1, True), (False, 1, True), (True, 0, False), (False, 0, True), (False, 1, False),
    ]  # fmt: skip


# Few numbers tie and settle; any float, up to the largest, breaks what floats can break.
number = st.one_of(
    st.sampled_from([0.0, -0.0, 1e-9, 1.0, -1.0, 5e-324]), st.floats(allow_nan=False, allow_infinity=False)
)


@pytest.mark.filterwarnings("ignore:(overflow|invalid value):RuntimeWarning")
@given(
    values=st.integers(1, 5).flatmap(
        lambda n: st.lists(st.lists(number, min_size=n, max_size=n), min_size=2, max_size=25)
    ),
    steps=st.lists(st.integers(0, 1), min_size=24, max_size=24),
    settings=st.fixed_dictionaries(
        {
            "eta": st.sampled_from([1e-6, 0.1, 3.0]),
            "rank": st.sampled_from(list(variants.BY_VALUE.values())),
            "mean": st.sampled_from(["same_set", "as_printed", "mean_abs_change"]),
            "adaptive_eta": st.sampled_from(["once", "persistent"]),
            "patience": st.integers(1, 4),
            "epsilon": st.sampled_from([1e-300, 1e-3, 1e3]),
        }
    ),
    multiply=st.booleans(),
)
def test_theorem_2_the_set_grows_within_patience_whatever_the_values_do(
    values: list[list[float]], steps: list[int], settings: dict[str, Any], multiply: bool
):
    n = len(values[0])
    settings |= {"growth": "multiply", "kappa": 2} if multiply else {"growth": "add", "kappa": 1}
    decided = follow(space(make_set(n), **settings), [1], values, steps)
    stalled, last = 0, settings["eta"]
    for step, (_, grew, numbers, state) in zip(steps, decided, strict=False):
        stalled = 0 if grew or state.size == n else stalled + step
        assert stalled == state.stalled <= settings["patience"]
        if step:
            assert settings["eta"] <= numbers["eta"] <= sys.float_info.max
            if settings["adaptive_eta"] == "persistent":
                assert last <= numbers["eta"] == state.eta
                last = state.eta
        else:
            assert (grew, numbers["eta"]) == (False, None)
    tests = sum(steps[: len(decided)])
    assert decided[-1][-1].size >= min(n, 1 + tests // (settings["patience"] + 1))


# ---- cSPaCE --------------------------------------------------------------------------------------

SQUARE = np.array([(-1.0, -1.0), (-0.5, -1.0), (1.0, -1.0), (1.0, 1.0)])  # scaled contexts of 1, 2, 3, 4


def test_trace_cspace_on_a_schedule():
    # From {1}, kappa = 1; a set of two is as far from its centroid as each other, so members are compared as sets.
    # t  steps  centroid         distances of 1, 2, 3, 4
    # 1  1      (-1,    -1)      0,     0.5,   2,     2.83    S = 2: {1, 2}
    # 2  0      (-0.75, -1)      0.25,  0.25,  1.75,  2.66    no gradient step: S = 2: {1, 2}
    # 3  4      the same                                      S = 3: {1, 2, 3}
    # 4  1      (-1/6,  -1)      0.83,  0.33,  1.17,  2.32    S = 4
    # 5  1                                                    S = min(5, 4)
    curriculum = space(rank=variants.near_centroid(SQUARE), growth="schedule")
    values = np.random.default_rng(0).normal(size=(6, 4)).tolist()  # whatever they do
    decided = follow(curriculum, [1], values, steps=[1, 0, 4, 1, 1])
    assert [(sorted(ids), grew) for ids, grew, *_ in decided] == [
        ([1, 2], True), ([1, 2], False), ([1, 2, 3], True), ([1, 2, 3, 4], True), ([1, 2, 3, 4], False),
    ]  # fmt: skip
    assert decided[2][0][2] == 3  # nearest first
    # Euclidean: from (0, 0), (3, 4) / 8 is 0.625 away, though by the sum of its sides 0.875.
    sides = np.array([(0.0, 0.0), (0.375, 0.5), (0.75, 0.0), (1.0, 1.0)])
    for rank in (variants.near_centroid(sides), variants.near_member(sides)):
        scores = rank(feedback(SetState(0, 0, 1, np.array([0])), [0] * 4, [0] * 4), np.arange(4) == 0)
        assert scores[1:].tolist() == [-0.625, -0.75, -np.sqrt(2)]
    assert all(numbers["eta"] is None for *_, numbers, _ in decided)
    nothing = [[float("nan")] * 4] * 6
    assert [one[:2] for one in follow(curriculum, [1], nothing, steps=[1, 0, 4, 1, 1])] == [one[:2] for one in decided]


def test_trace_cspace_by_the_value_test():
    # From {1}, kappa = 1.
    # t  V_t
    # 1  {1}: |12 - 8| = 4 > 1        not grown: {1}, whose distance to itself is 0
    # 2  {1}: |12.5 - 12| <= 1.5      grown, S = 2: {1, 2}, although the value of 2 fell
    # 3  {1, 2}: |20 - 6.25| > ...    not grown: {1, 2}
    values = [(8, 1, 1, 1), (12, 1, 9, 9), (12.5, 0, 99, 99), (20, 20, 0, 0)]
    decided = follow(space(rank=variants.near_centroid(SQUARE)), [1], values)
    assert [(sorted(ids), grew) for ids, grew, *_ in decided] == [([1], False), ([1, 2], True), ([1, 2], False)]


def test_the_centroid_can_drop_members_and_the_nearest_member_cannot():
    # On a line: x = (-1, 0.125, 0.25, 1), from {1, 4}.
    # Centroid 0: distances (1, 0.125, 0.25, 1). S = 2: {2, 3}; both are dropped. Then centroid 0.1875: {2, 3} again,
    #     and grown to S = 3: 4 at 0.8125 before 1 at 1.1875.
    # Nearest member: 2 is min(1.125, 0.875) = 0.875 away, 3 is min(1.25, 0.75) = 0.75 away. S = 2: {1, 4};
    #     S = 3: {1, 4, 3}; then 2 is 0.125 from 3: S = 4.
    line = np.array([[-1.0], [0.125], [0.25], [1.0]])
    values = [[float(t)] * 4 for t in range(4)]
    decided = follow(space(rank=variants.near_centroid(line), growth="schedule"), [1, 4], values, steps=[0, 1, 0])
    assert [sorted(ids) for ids, *_ in decided] == [[2, 3], [2, 3, 4], [2, 3, 4]]
    decided = follow(space(rank=variants.near_member(line), growth="schedule"), [1, 4], values, steps=[0, 1, 1])
    assert [sorted(ids) for ids, *_ in decided] == [[1, 4], [1, 3, 4], [1, 2, 3, 4]]
    assert (decided[1][0][2], decided[2][0][3]) == (3, 2)  # members first


@given(
    contexts=st.lists(st.tuples(*[st.integers(-2, 2).map(lambda i: i / 2)] * 2), min_size=1, max_size=9),
    steps=st.lists(st.integers(0, 1), max_size=12),
)
def test_the_nearest_member_never_drops_one_even_for_a_twin(contexts: list[tuple[float, float]], steps: list[int]):
    scaled = np.array(contexts)
    curriculum = space(make_set(len(scaled)), rank=variants.near_member(scaled), growth="schedule")
    members = {1}
    for ids, *_ in follow(curriculum, [1], [[0.0] * len(scaled)] * (len(steps) + 1), steps):
        assert members <= set(ids)
        members = set(ids)


def test_the_nearest_member_in_pieces_is_the_same(monkeypatch: pytest.MonkeyPatch):
    scaled, trained = np.random.default_rng(0).uniform(-1, 1, size=(50, 3)), np.arange(50) % 5 == 0
    told = feedback(SetState(0, 0, 10, np.flatnonzero(trained)), np.zeros(50), np.zeros(50))
    whole = variants.near_member(scaled)(told, trained)
    monkeypatch.setattr(variants, "_CHUNK_NUMBERS", 70)
    assert np.array_equal(variants.near_member(scaled)(told, trained), whole)
    by_hand = [-min(np.linalg.norm(scaled[i] - scaled[j]) for j in range(0, 50, 5)) for i in range(50) if i % 5]
    assert whole[~trained] == pytest.approx(by_hand)


@pytest.mark.parametrize("distance", ["centroid", "nearest_member"])
def test_distances_are_between_contexts_scaled_to_their_bounds(distance: str):
    # PointMass: gate_x in [-4, 4], gate_width in [0.5, 8], friction in [0, 4]. From 1, instance 2 is 1.5 of 4 away
    # (0.75 scaled), 3 is 2 of 8 away (0.5 scaled).
    contexts = np.array([(0, 4, 0), (0, 4, 1.5), (2, 4, 0), (4, 4, 4)])
    instances = InstanceSet(np.arange(1, 5), contexts, ("gate_x", "gate_width", "friction"))
    config = config_with(f"{{kind: cspace, growth: schedule, distance: {distance}}}")
    curriculum = make_curriculum(config, instances, _bounds())
    decided = follow(curriculum, [1], [[0.0] * 4] * 3)
    assert [sorted(ids) for ids, *_ in decided] == [[1, 3], [1, 2, 3]]


# ---- A fixed subset ------------------------------------------------------------------------------


def test_trace_of_a_fixed_subset():
    instances = make_set(4)
    assert RoundRobin(instances, seed=1).start()[1].ids.tolist() == [4, 3, 2, 1]
    for settings, expected in (("ids: [2, 4]", [4, 2]), ("count: 3", [4, 3, 2]), ("count: 4", [4, 3, 2, 1])):
        curriculum = make_curriculum(config_with(f"{{kind: fixed, {settings}}}", "seed=1"), instances, _bounds())
        decided = drive(curriculum, [(1, 2, 3, 4), (5, -6, 7, -8), (9, 9, 9, 9)], gradient_steps=[1, 0])
        for t, (state, selection, _) in enumerate(decided):
            assert selection.ids.tolist() == expected
            assert selection.contexts.tolist() == [instances.contexts[i - 1].tolist() for i in expected]
            assert (state.version, selection.order_version, state.size) == (t, 0, len(expected))
        numbers = decided[1][2]
        # Means are over the set: for {2, 4}, (2 + 4) / 2 and (6 + 8) / 2.
        assert numbers["mean_value_before"] == sum(expected) / len(expected)
        assert numbers["mean_value_after"] == sum(i + 4 for i in expected) / len(expected)
        assert (numbers["size"], numbers["trained_size"], numbers["grew"]) == (len(expected), len(expected), False)


def test_the_seed_chooses_the_counted_and_a_larger_count_only_adds():
    def members(count: int, seed: int) -> list[int]:
        config = config_with(f"{{kind: fixed, count: {count}}}", f"seed={seed}")
        return make_curriculum(config, make_set(30), _bounds()).start()[1].ids.tolist()

    assert len({tuple(sorted(members(5, seed))) for seed in range(10)}) == 10
    assert members(9, 4)[:5] == members(5, 4)


# ---- All of them ---------------------------------------------------------------------------------

EVERY = (
    *(f"{{kind: space, pic: {pic}}}" for pic in ("improvement", "abs", "relative", "lowest_value", "random")),
    *(f"{{kind: space, mean: {mean}, v0: zero}}" for mean in ("same_set", "as_printed", "mean_abs_change")),
    "{kind: space, growth: multiply, kappa: 2}",
    "{kind: space, adaptive_eta: once, patience: 1}",
    "{kind: space, adaptive_eta: persistent, patience: 1}",
    "{kind: random_growth, adaptive_eta: persistent, patience: 2}",
    "{kind: cspace}",
    "{kind: cspace, distance: nearest_member, growth: schedule, kappa: 2}",
    "{kind: fixed, count: 3}",
    "{kind: fixed, ids: [7, 2]}",
)


@pytest.mark.parametrize(
    "settings",
    [
        {"eta": 0.4}, {"kappa": 2}, {"growth": "multiply", "kappa": 3}, {"mean": "as_printed"},
        {"mean": "mean_abs_change"}, {"adaptive_eta": "once"}, {"adaptive_eta": "once", "patience": 2},
        {"adaptive_eta": "persistent"}, {"adaptive_eta": "persistent", "epsilon": 0.25},
    ],
    ids=str,
)  # fmt: skip
def test_each_setting_reaches_the_curriculum_and_matters(settings: dict[str, Any]):
    values = 2 + np.sin(np.arange(60)[:, None] * (1 + np.arange(9) / 8))  # never settles for long
    words = ", ".join(f"{key}: {value}" for key, value in settings.items())
    config = config_with(f"{{kind: space, {words}}}")
    found = as_plain(drive(make_curriculum(config, make_set(9), _bounds()), values))
    assert found == as_plain(drive(space(make_set(9), **{"eta": 0.1, "kappa": 1, **settings}), values))
    fewer = dict(list(settings.items())[:-1])  # the last setting alone makes the difference
    assert found != as_plain(drive(space(make_set(9), **{"eta": 0.1, "kappa": 1, **fewer}), values))


@pytest.mark.parametrize("curriculum", EVERY)
def test_every_variant_survives_storage_and_rows_in_another_order(curriculum: str):
    config = config_with(curriculum)
    instances = read_csv(config.instances.train, _bounds()).subset(range(9))
    turned = InstanceSet(instances.ids[::-1], instances.contexts[::-1], instances.names)
    values = np.round(np.random.default_rng(2).normal(size=(40, 9)).cumsum(axis=0)) / 4
    steps = np.random.default_rng(3).integers(0, 3, size=39).tolist()
    decided = drive(make_curriculum(config, instances, _bounds()), values, steps)
    assert as_plain(drive(make_curriculum(config, turned, _bounds()), values, steps)) == as_plain(decided)
    state = stored_and_restored(decided[0][0])
    for t, (_, _, expected) in enumerate(decided[1:], start=1):
        fresh = make_curriculum(config, instances, _bounds())  # nothing may be remembered outside the state
        state, selection, numbers = fresh.step(state, feedback(state, values[t - 1], values[t], steps[t - 1]))
        state = stored_and_restored(state)
        assert as_plain([(state, selection, numbers)]) == as_plain([decided[t]])
        assert json.loads(json.dumps(numbers, allow_nan=False)) == expected
        assert shown(fresh.selection(state)) == shown(selection)
    sizes = [state.size for state, *_ in decided]
    assert sizes == sorted(sizes)
    assert sizes[-1] > 1  # each of them got somewhere


def test_the_defaults_are_what_there_was_before_there_were_variants():
    # SHA-256 over (size, ids, order_version, tests, growths, stalled) of what commit 20aaf9b decided.
    expected = {
        "space": "9fb683ba194ae4fa3080accc6753ddedfe15c297930264aee12e4bb7b803e591",
        "random_growth": "fe5057547b8a369f081c43b05bc0028161b34553b484609686aa43fb57350f2f",
        "round_robin": "80ba1e9185a86be26caffc41c663358080ba69cf07fc3ba9cfbc4c08e775bce7",
    }
    n = 20
    values = [[4 + (7 * t + 13 * i + t * i * i) % 17 / (2 + t % 9) for i in range(n)] for t in range(80)]
    for kind, digest in expected.items():
        config = config_with(f"{{kind: {kind}}}", "seed=11")
        told = [
            (state.size, selection.ids.tolist(), state.order_version, state.tests, state.growths, state.stalled)
            for state, selection, _ in drive(
                make_curriculum(config, make_set(n), _bounds()), values, [t % 5 for t in range(79)]
            )
        ]
        assert hashlib.sha256(repr(told).encode()).hexdigest() == digest
    explicit = config_with(
        "{kind: space, eta: 0.1, kappa: 1, pic: improvement, mean: same_set, v0: network, growth: add, "
        "adaptive_eta: off}"
    )
    assert explicit.curriculum == config_with("{kind: space}").curriculum


# ---- The config ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("curriculum", "words"),
    [
        ("{kind: space, growth: multiply}", ["curriculum", "multiply", "kappa: 1", "kappa >= 2"]),
        ("{kind: random_growth, growth: multiply, kappa: 1}", ["curriculum", "multiply", "kappa >= 2"]),
        ("{kind: cspace, growth: multiply, kappa: 1}", ["curriculum", "multiply", "kappa >= 2"]),
        ("{kind: space, growth: schedule}", ["curriculum.growth", "Allowed: add, multiply"]),
        ("{kind: random_growth, growth: schedule}", ["curriculum.growth", "Allowed: add, multiply"]),
        ("{kind: cspace, growth: schedule, adaptive_eta: once}", ["curriculum", "schedule", "adaptive_eta: once"]),
        ("{kind: cspace, pic: abs}", ["curriculum.pic", "unknown key"]),
        ("{kind: space, distance: centroid}", ["curriculum.distance", "unknown key"]),
        ("{kind: space, pic: absolute}", ["curriculum.pic", "did you mean 'abs'?", "lowest_value"]),
        ("{kind: space, patience: 0}", ["curriculum.patience: must be a whole number of at least 1, not 0"]),
        ("{kind: space, epsilon: 0}", ["curriculum.epsilon: must be a number above 0, not 0"]),
        ("{kind: round_robin, v0: zero}", ["curriculum.v0", "unknown key"]),
        ("{kind: fixed}", ["curriculum", "either ids or count"]),
        ("{kind: fixed, ids: [1], count: 1}", ["curriculum", "either ids or count"]),
        ("{kind: fixed, ids: [1, 2, 1]}", ["curriculum", "ids", "once"]),
        ("{kind: fixed, ids: []}", ["curriculum.ids"]),
        ("{kind: fixed, ids: [-1]}", ["curriculum.ids.0"]),
        ("{kind: fixed, count: 0}", ["curriculum.count"]),
    ],
)
def test_what_does_not_go_together_is_refused(curriculum: str, words: list[str]):
    with pytest.raises(ConfigError) as caught:
        config_with(curriculum)
    for word in words:
        assert word in str(caught.value)


def test_multiply_is_refused_also_where_kappa_comes_from_elsewhere():
    with pytest.raises(ConfigError, match=r"curriculum: growth: multiply with kappa: 1 never grows"):
        load(SPACE.parent / "presets/space_ppo2_pointmass.yaml", ["curriculum.growth=multiply"])  # whose kappa is 1
    assert load(SPACE, ["curriculum.growth=multiply", "curriculum.kappa=2"]).curriculum.kind == "space"


def _bounds() -> ContextBounds:
    return make_batched("space_dist/PointMass-v0", 1, context_visible=False).context_bounds


def set_up(curriculum: str, *overrides: str) -> None:
    config = config_with(curriculum, *overrides)
    spec = spec_of(config)
    train, test = (read_csv(path, spec.context_bounds) for path in (config.instances.train, config.instances.test))
    Blueprint(config, spec).setup(train, test)


def test_unknown_ids_are_refused_when_the_run_starts():
    with pytest.raises(ConfigError) as caught:
        set_up("{kind: fixed, ids: [2, 1000000, 1000001]}")
    text = str(caught.value)
    assert "curriculum.ids: there is no instance 1000000 (nor 1 more of these)" in text
    assert "pointmass_uniform_train.csv holds 100 instances" in text
    last = read_csv(config_with("{kind: space}").instances.train, _bounds()).ids[-1]
    assert f"the nearest is {last}" in text
    with pytest.raises(ConfigError, match=r"curriculum.count: 101 is too many: .*csv holds 100 instances"):
        set_up("{kind: fixed, count: 101}")
    set_up("{kind: fixed, count: 100}")
    set_up(f"{{kind: fixed, ids: [{last}]}}")


def test_only_rankings_by_value_are_refused_where_instances_start_alike():
    blind = "env.context_visible=false"
    for pic in ("improvement", "abs", "relative", "lowest_value"):
        with pytest.raises(ConfigError, match="all instances start with the same observation"):
            set_up(f"{{kind: space, pic: {pic}}}", blind)
        set_up(f"{{kind: space, pic: {pic}, allow_context_blind: true}}", blind)
    for kind in ("space, pic: random", "random_growth", "cspace", "fixed, count: 3", "round_robin"):
        set_up(f"{{kind: {kind}}}", blind)
