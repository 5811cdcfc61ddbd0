from __future__ import annotations

import dataclasses
import io
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from space_dist.curricula import Curriculum, Feedback, RoundRobin, Selection, SetState, Space, variants
from space_dist.curricula.space import _highest
from space_dist.instances import ContextBounds, InstanceSet, read_csv
from space_dist.rollout.walk import Walk
from space_dist.seeding import Purpose, instance_keys

KINDS = ("space", "random_growth", "round_robin")


def make_set(n: int, order: Sequence[int] | None = None) -> InstanceSet:
    """n instances with ids 1 .. n, given in any order of rows."""
    ids = np.arange(1, n + 1)
    contexts = np.stack([ids / 8, np.sqrt(ids)], axis=1)
    rows = np.arange(n) if order is None else np.array(order)
    return InstanceSet(ids[rows], contexts[rows], ("a", "b"))


def make(kind: str, instances: InstanceSet, *, eta: float = 0.125, kappa: int = 1, seed: int = 0) -> Curriculum:
    if kind == "round_robin":
        return RoundRobin(instances, seed=seed)
    rank = {"space": variants.improvement, "random_growth": variants.at_random(instances, seed=seed)}[kind]
    return Space(instances, eta=eta, kappa=kappa, seed=seed, rank=rank)


def feedback(state: SetState, before: Any, after: Any, gradient_steps: int = 1) -> Feedback:
    return Feedback(
        state.version, np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64), gradient_steps
    )


def drive(
    curriculum: Curriculum, values: Any, gradient_steps: Sequence[int] | None = None
) -> list[tuple[SetState, Selection, dict[str, Any]]]:
    """What a curriculum decides on a history of values (T + 1, n), its first selection included."""
    values = np.asarray(values, dtype=np.float64)
    decided: list[tuple[SetState, Selection, dict[str, Any]]] = [(*curriculum.start(), {})]
    for t in range(1, len(values)):
        state = decided[-1][0]
        steps = 1 if gradient_steps is None else gradient_steps[t - 1]
        decided.append(curriculum.step(state, feedback(state, values[t - 1], values[t], steps)))
    return decided


def plain(state: SetState) -> dict[str, Any]:
    return {**dataclasses.asdict(state), "selected": state.selected.tolist()}


def shown(selection: Selection) -> tuple[int, list[int], list[list[float]], int]:
    return selection.version, selection.ids.tolist(), selection.contexts.tolist(), selection.order_version


def as_plain(decided: Sequence[tuple[SetState, Selection, dict[str, Any]]]) -> list[Any]:
    return [(plain(state), shown(selection), numbers) for state, selection, numbers in decided]


# ---- Traces worked out by hand: four instances with ids 1, 2, 3, 4 (indices 0, 1, 2, 3) ----------
# eta = 1/8 throughout: binary fractions keep the arithmetic exact. V is mean |V(s0, c_i)| over the set *trained on*.


class Row(NamedTuple):
    values: tuple[float, float, float, float]  # V_t(s0, c_i) of ids 1, 2, 3, 4
    trained: list[int]  # ids of the set that iteration t trained on
    before: float  # V_{t-1}
    after: float  # V_t
    grew: bool
    size: int  # S behind iteration t
    selected: list[int]  # ids, in walking order, for iteration t + 1
    order_version: int
    stalled: int


def check_trace(curriculum: Space, first: list[int], initial: tuple[float, ...], rows: list[Row]) -> None:
    """Start from the ids `first`, so that no trace hangs on what the seed draws."""
    state = SetState(version=0, order_version=0, size=len(first), selected=np.array(first) - 1)
    before = initial
    for t, row in enumerate(rows, start=1):
        assert curriculum.selection(state).ids.tolist() == row.trained, f"trained in t={t}"
        state, selection, numbers = curriculum.step(state, feedback(state, before, row.values))
        found = Row(
            row.values,
            row.trained,
            float(str(numbers["mean_value_before"])),
            float(str(numbers["mean_value_after"])),
            bool(numbers["grew"]),
            state.size,
            selection.ids.tolist(),
            selection.order_version,
            state.stalled,
        )
        assert found._replace(before=row.before, after=row.after) == row, f"t={t}"
        assert (found.before, found.after) == pytest.approx((row.before, row.after), rel=1e-15), f"t={t}"
        assert (state.version, selection.version, state.order_version) == (t, t, row.order_version)
        assert (numbers["size"], numbers["trained_size"]) == (row.size, len(row.trained))
        assert numbers["relative_change"] == pytest.approx(abs(row.after - row.before) / row.before, rel=1e-14)
        assert numbers["kept"] == len(set(row.selected) & set(row.trained))
        pic = np.subtract(row.values, before)
        assert (numbers["largest_pic"], numbers["smallest_pic"]) == (pic.max(), pic.min())
        before = row.values


def test_trace_a_steady_values_grow_the_set_to_all_four_and_no_further():
    # V_0 = (8, 16, 24, 32), kappa = 1.
    # t  d_t                          |V_t - V_{t-1}| against V_{t-1} / 8
    # 1  ( 2,    1,    3,    4   )    |10 - 8|          = 2     >  1       not grown, S = 1: {4}
    # 2  ( 1,    2,    1,    3   )    |39 - 36|         = 3     <= 4.5     grown, S = 2: {4, 2}
    # 3  ( 0.5,  1,    2,    1.5 )    |30.25 - 29|      = 1.25  <= 3.625   grown, S = 3: {3, 4, 2}
    #       29 = (39 + 19) / 2, 30.25 = (40.5 + 20) / 2
    # 4  ( 0.5,  0.25, 0.75, 1   )    |92.5 - 90.5| / 3 = 0.667 <= 3.77    grown, S = 4: {4, 3, 1, 2}
    #       90.5 = 30 + 40.5 + 20, 92.5 = 30.75 + 41.5 + 20.25
    # 5  ( 0.25, 0.5,  0.75, 1   )    |26.75 - 26.125|  = 0.625 <= 3.27    settled, but S = min(5, 4) = 4 did not grow
    #       26.125 = 104.5 / 4, 26.75 = 107 / 4
    # 6  ( 7.75, 9.25, 8.5,  9.5 )    |35.5 - 26.75|    = 8.75  >  3.34    not grown, S stays 4
    #       35.5 = 142 / 4
    check_trace(
        Space(make_set(4), eta=0.125, kappa=1, seed=0),
        [1],
        (8, 16, 24, 32),
        [
            Row((10, 17, 27, 36), [1], 8, 10, False, 1, [4], 1, 1),
            Row((11, 19, 28, 39), [4], 36, 39, True, 2, [4, 2], 2, 0),
            Row((11.5, 20, 30, 40.5), [4, 2], 29, 30.25, True, 3, [3, 4, 2], 3, 0),
            Row((12, 20.25, 30.75, 41.5), [3, 4, 2], 90.5 / 3, 92.5 / 3, True, 4, [4, 3, 1, 2], 4, 0),
            Row((12.25, 20.75, 31.5, 42.5), [4, 3, 1, 2], 26.125, 26.75, False, 4, [4, 3, 2, 1], 5, 0),
            Row((20, 30, 40, 52), [4, 3, 2, 1], 26.75, 35.5, False, 4, [4, 2, 3, 1], 6, 0),
        ],
    )


def test_trace_b_moving_means_do_not_grow_but_reselect_by_signed_pic():
    # V_0 = (8, 4, -2, -16), kappa = 1, from the set {1, 2}.
    # t  d_t                         |V_t - V_{t-1}| against V_{t-1} / 8
    # 1  ( 4,    2,    1,    0   )   |9 - 6|       = 3    > 0.75    not grown: {1, 2}, the same order
    # 2  ( 1,    3,    0.5, -0.5 )   |11 - 9|      = 2    > 1.125   not grown: {2, 1}, the same set in a new order
    # 3  (-5,   -4,   -1.5, -0.5 )   |6.5 - 11|    = 4.5  > 1.375   not grown: all fell; the highest: {4, 3}
    #       By |d_t| it would be {1, 2}.
    # 4  ( 2,    1,    3,    4   )   |7 - 9.5|     = 2.5  > 1.1875  not grown: {4, 3}, the same order
    #       9.5 = (|-17| + |-2|) / 2, 7 = (|-13| + |1|) / 2
    # 5  ( 0.75, 1.5, -3,    0.5 )   |7.25 - 7|    = 0.25 <= 0.875  grown, S = 3: {2, 1, 4}
    #       7.25 = (|-12.5| + |-2|) / 2. |mean V| instead of mean |V| would move from 6 to 7.25, 1.25 > 0.75: not grown
    check_trace(
        Space(make_set(4), eta=0.125, kappa=1, seed=0),
        [1, 2],
        (8, 4, -2, -16),
        [
            Row((12, 6, -1, -16), [1, 2], 6, 9, False, 2, [1, 2], 0, 1),
            Row((13, 9, -0.5, -16.5), [1, 2], 9, 11, False, 2, [2, 1], 2, 2),
            Row((8, 5, -2, -17), [2, 1], 11, 6.5, False, 2, [4, 3], 3, 3),
            Row((10, 6, 1, -13), [4, 3], 9.5, 7, False, 2, [4, 3], 3, 4),
            Row((10.75, 7.5, -2, -12.5), [4, 3], 7, 7.25, True, 3, [2, 1, 4], 5, 0),
        ],
    )


def test_trace_c_kappa_two_grows_where_the_rule_as_printed_would_not():
    # V_0 = (8, 16, 64, 32), kappa = 2.
    # t  d_t                          |V_t - V_{t-1}| against V_{t-1} / 8
    # 1  (0.5,  2, 1,   1.5)          |8.5 - 8|        = 0.5   <= 1      grown, S = 1 + 2 = 3: {2, 4, 3}
    # 2  (0.75, 1, 0.5, 2  )          |120 - 116.5| /3 = 1.167 <= 4.854  grown, S = min(3 + 2, 4) = 4: {4, 2, 1, 3}
    #       116.5 = 18 + 33.5 + 65, 120 = 19 + 35.5 + 65.5
    #       As printed, V_1 = 8.5 was the mean over {1} and V_2 = 40 is the mean over {2, 4, 3}: |40 - 8.5| = 31.5 >
    #       8.5 / 8, so the set would not grow although no value of it moved by more than 6 %.
    rows = [
        Row((8.5, 18, 65, 33.5), [1], 8, 8.5, True, 3, [2, 4, 3], 1, 0),
        Row((9.25, 19, 65.5, 35.5), [2, 4, 3], 116.5 / 3, 40, True, 4, [4, 2, 1, 3], 2, 0),
    ]
    check_trace(Space(make_set(4), eta=0.125, kappa=2, seed=0), [1], (8, 16, 64, 32), rows)
    as_printed = abs(rows[1].after - rows[0].after) <= 0.125 * rows[0].after
    assert not as_printed


def test_trace_c_does_not_grow_where_the_rule_as_printed_would():
    # V_0 = (8, 16, 64, 32), kappa = 2.
    # t  d_t                    |V_t - V_{t-1}| against V_{t-1} / 8
    # 1  (8,  9,   -4, -1)      |16 - 8|    = 8   > 1       not grown: {2}
    # 2  (1, -8.5,  0,  2)      |16.5 - 25| = 8.5 > 3.125   not grown: {4}
    #       As printed: V_1 = 16 over {1}, V_2 = 16.5 over {2}: 0.5 <= 2, so the set would grow, by coincidence, just
    #       after instance 2 lost a third of its value.
    rows = [
        Row((16, 25, 60, 31), [1], 8, 16, False, 1, [2], 1, 1),
        Row((17, 16.5, 60, 33), [2], 25, 16.5, False, 1, [4], 2, 2),
    ]
    check_trace(Space(make_set(4), eta=0.125, kappa=2, seed=0), [1], (8, 16, 64, 32), rows)
    as_printed = abs(rows[1].after - rows[0].after) <= 0.125 * rows[0].after
    assert as_printed


def test_the_other_readings_of_lines_6_and_7_are_logged():
    # The two traces (c), t = 2. As printed: |40 - 8.5| / 8.5 and |16.5 - 16| / 16.
    # Each for itself: (|19 - 18| + |35.5 - 33.5| + |65.5 - 65|) / 3 / (116.5 / 3), and |16.5 - 25| / 25.
    space = Space(make_set(4), eta=0.125, kappa=2, seed=0)
    for values, printed, each in [
        ([(8, 16, 64, 32), (8.5, 18, 65, 33.5), (9.25, 19, 65.5, 35.5)], 31.5 / 8.5, 3.5 / 116.5),
        ([(8, 16, 64, 32), (16, 25, 60, 31), (17, 16.5, 60, 33)], 0.5 / 16, 8.5 / 25),
    ]:
        state = SetState(version=0, order_version=0, size=1, selected=np.array([0]))
        state, _, first = space.step(state, feedback(state, values[0], values[1]))
        _, _, second = space.step(state, feedback(state, values[1], values[2]))
        assert first["relative_change_as_printed"] is None  # the printed V_0 = 0 has no share
        assert second["relative_change_each"] == pytest.approx(each)
        assert second["relative_change_as_printed"] == pytest.approx(printed)


def test_changes_of_opposite_sign_cancel_in_the_mean_but_not_in_the_change_of_each():
    # {1, 2}: 8 -> 12 and 24 -> 20. Means 16 -> 16: grown. Each for itself: (4 + 4) / 2 / 16 = 1/4.
    state = SetState(version=0, order_version=0, size=2, selected=np.array([0, 1]))
    space = Space(make_set(4), eta=0.125, kappa=1, seed=0)
    _, _, numbers = space.step(state, feedback(state, (8, 24, 0, 0), (12, 20, 1, -1)))
    assert (numbers["grew"], numbers["relative_change"], numbers["relative_change_each"]) == (True, 0.0, 0.25)


# ---- (d) Ties ------------------------------------------------------------------------------------


def test_ties_stand_in_the_order_of_the_seeded_key():
    instances = make_set(4)
    state = SetState(version=0, order_version=0, size=4, selected=np.arange(4))
    orders = set()
    for seed in range(20):
        keys = instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts)
        by_key = sorted([1, 2, 3, 4], key=lambda i: int(keys[i - 1]))
        space = Space(instances, eta=0.125, kappa=1, seed=seed)
        first, selection = space.start()
        assert (first.size, selection.ids.tolist()) == (1, by_key[:1])
        _, tied, _ = space.step(state, feedback(state, (1, 2, 3, 4), (2, 3, 4, 5)))
        assert tied.ids.tolist() == by_key
        # d_t = (1, 2, 1, 2): first 2 and 4, then 1 and 3, each pair in the order of its keys.
        _, pairs, _ = space.step(state, feedback(state, (1, 2, 3, 4), (2, 4, 4, 6)))
        assert pairs.ids.tolist() == [i for i in by_key if i in (2, 4)] + [i for i in by_key if i in (1, 3)]
        orders.add(tuple(by_key))
    assert len(orders) > 5
    assert {order[0] for order in orders} == {1, 2, 3, 4}  # any instance can come first


def test_the_order_of_two_tied_instances_does_not_depend_on_the_others():
    whole = make_set(12)
    for seed in range(5):
        order = RoundRobin(whole, seed=seed).start()[1].ids.tolist()
        part = RoundRobin(whole.subset([1, 4, 5, 9, 11]), seed=seed).start()[1].ids.tolist()
        assert part == [i for i in order if i in (2, 5, 6, 10, 12)]


@pytest.mark.parametrize("kind", KINDS)
def test_neither_rows_nor_columns_of_the_file_decide_anything(tmp_path: Path, kind: str):
    bounds = ContextBounds(("a", "b"), np.array([0.0, 0.0]), np.array([1.0, 1.0]))
    rows = [(7, 0.25, 0.5), (3, 0.5, 0.25), (900, 0.75, 0.75), (12, 0.0, 1.0)]
    values = np.random.default_rng(0).integers(-2, 3, size=(12, 4))  # ties in most iterations
    expected = None
    for number, permuted in enumerate(itertools.permutations(rows)):
        path = tmp_path / f"{number}.csv"
        swap = number % 2
        path.write_text(
            ("b,id,a\n" if swap else "id,a,b\n")
            + "".join(f"{b},{i},{a}\n" if swap else f"{i},{a},{b}\n" for i, a, b in permuted)
        )
        decided = as_plain(drive(make(kind, read_csv(path, bounds), seed=5), values))
        expected = expected or decided
        assert decided == expected


# ---- (e) Boundaries of line 7 --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("eta", "before", "after", "grew"),
    [
        (0.25, 4.0, 5.0, True),  # |5 - 4| = 1 = 0.25 * 4
        (0.25, 4.0, 3.0, True),
        (0.25, -4.0, 5.0, True),  # the mean is of |V|: a value that changes sign may count as settled
        (0.25, 4.0, math.nextafter(5.0, math.inf), False),
        (0.25, 4.0, math.nextafter(3.0, -math.inf), False),
        (0.25, 0.0, 0.0, True),
        (0.25, 0.0, 0.25 * 1e-8, True),  # V_{t-1} = 0: a share of the floor 1e-8
        (0.25, 0.0, -0.25 * 1e-8, True),
        (0.25, 0.0, math.nextafter(0.25 * 1e-8, 1.0), False),
        (0.25, 0.0, 1e-3, False),
        (0.25, 2e-9, 4e-9, True),  # 2e-9 <= 0.25 * 1e-8, though it is 100 % of V_{t-1}
        (0.25, 4e-8, 5.1e-8, False),  # above the floor V_{t-1} counts again: 1.1e-8 > 1e-8
    ],
)
def test_line_7_at_its_boundaries(eta: float, before: float, after: float, grew: bool):
    state = SetState(version=0, order_version=0, size=1, selected=np.array([2]))
    space = Space(make_set(4), eta=eta, kappa=1, seed=0)
    others = (100.0, -50.0)  # of instances that were not trained on: the means must not see them
    new, _, numbers = space.step(
        state, feedback(state, (others[0], 7, before, 1), (others[1], 9, after, -1), gradient_steps=3)
    )
    assert numbers["grew"] is grew
    assert (new.size, new.tests, new.growths, new.stalled) == ((2, 1, 1, 0) if grew else (1, 1, 0, 1))


def test_values_that_keep_moving_never_grow_the_set_and_the_stall_is_counted():
    values = [[4.0 * 2 ** (t % 2)] * 4 for t in range(31)]  # Theorem 1 needs convergence: these double and halve
    state = drive(Space(make_set(4), eta=0.125, kappa=1, seed=0), values)[-1][0]
    assert (state.size, state.tests, state.growths, state.stalled) == (1, 30, 0, 30)


# ---- Round robin, random growth ------------------------------------------------------------------


def test_round_robin_walks_one_fixed_permutation():
    values = np.random.default_rng(0).normal(size=(6, 9))
    orders = set()
    for seed in range(10):
        decided = drive(RoundRobin(make_set(9), seed=seed), values)
        order = decided[0][1].ids.tolist()
        assert sorted(order) == list(range(1, 10))
        for t, (state, selection, numbers) in enumerate(decided):
            assert selection.ids.tolist() == order
            assert (state.version, selection.version, selection.order_version, state.size) == (t, t, 0, 9)
            if t:
                assert (numbers["grew"], numbers["size"], numbers["trained_size"]) == (False, 9, 9)
                assert numbers["mean_value_before"] == np.abs(values[t - 1]).mean()
                assert numbers["mean_value_after"] == np.abs(values[t]).mean() == state.mean_value
        orders.add(tuple(order))
    assert len(orders) == 10


def test_selections_carry_the_contexts_of_their_ids():
    instances = make_set(9)
    contexts = dict(zip(instances.ids.tolist(), instances.contexts.tolist(), strict=True))
    values = np.random.default_rng(0).normal(size=(6, 9)).cumsum(axis=0) * 1e-3 + 1
    for kind in KINDS:
        for _, selection, _ in drive(make(kind, instances, kappa=3), values):
            assert selection.contexts.tolist() == [contexts[i] for i in selection.ids.tolist()]


def test_random_growth_has_random_but_reproducible_members():
    values = np.random.default_rng(1).normal(size=(25, 50)) * 1e-6 + 1  # settled: grows by 1 each time
    decided = drive(make("random_growth", make_set(50), seed=3), values)
    assert as_plain(drive(make("random_growth", make_set(50), seed=3), values)) == as_plain(decided)
    assert as_plain(drive(make("random_growth", make_set(50), seed=4), values)) != as_plain(decided)
    members = [set(selection.ids.tolist()) for _, selection, _ in decided]
    assert [len(one) for one in members] == list(range(1, 26))
    assert all(not one < other for one, other in itertools.pairwise(members[1:]))  # drawn afresh, not added to
    assert len(set().union(*members)) == 50
    # What the values of instances are says nothing about who is a member: here they are shuffled among them.
    shuffled = drive(make("random_growth", make_set(50), seed=3), values[:, ::-1])
    assert [set(selection.ids.tolist()) for _, selection, _ in shuffled] == members
    # Not favouritism either: over 200 draws of one of four, each comes up often.
    still = [[1.0 + 1.0 * (t % 2)] * 4 for t in range(201)]
    firsts = [int(selection.ids[0]) for _, selection, _ in drive(make("random_growth", make_set(4)), still)]
    assert min(firsts.count(i) for i in (1, 2, 3, 4)) > 25


# ---- Properties ----------------------------------------------------------------------------------


class Case(NamedTuple):
    n: int
    seed: int
    eta: float
    kappa: int
    values: list[list[float]]  # (T + 1, n)
    gradient_steps: list[int]  # (T,)

    def make(self, kind: str, order: Sequence[int] | None = None) -> Curriculum:
        return make(kind, make_set(self.n, order), eta=self.eta, kappa=self.kappa, seed=self.seed)

    def drive(self, kind: str, order: Sequence[int] | None = None) -> list[tuple[SetState, Selection, dict[str, Any]]]:
        return drive(self.make(kind, order), self.values, self.gradient_steps)


@st.composite
def cases(draw: st.DrawFn) -> Case:
    n, length = draw(st.integers(1, 8)), draw(st.integers(1, 10))
    coarse = st.integers(-4, 4).map(float)  # few numbers: many ties, many settled means
    fine = st.floats(-1e6, 1e6, allow_nan=False)
    values = draw(st.sampled_from([coarse, fine]))
    return Case(
        n,
        draw(st.integers(0, 2**31 - 1)),
        draw(st.sampled_from([0.01, 0.1, 0.5, 2.0])),
        draw(st.integers(1, 10)),
        draw(st.lists(st.lists(values, min_size=n, max_size=n), min_size=length + 1, max_size=length + 1)),
        draw(st.lists(st.integers(0, 2), min_size=length, max_size=length)),
    )


kinds = st.sampled_from(KINDS)
growing = st.sampled_from(("space", "random_growth"))


@given(
    kind=growing,
    limits=st.lists(st.floats(-100, 100), min_size=1, max_size=8),
    spread=st.floats(-100, 100),
    rate=st.floats(0.0, 0.8),
    alternates=st.booleans(),
    eta=st.floats(0.01, 0.5),
    kappa=st.integers(1, 3),
)
def test_theorem_1_converging_values_include_every_instance_in_the_end(
    kind: str, limits: list[float], spread: float, rate: float, alternates: bool, eta: float, kappa: int
):
    # V_t(i) = V(i) + r_i q^t. Behind t = 130, q^t < 1e-12, so every change is below 0.01 * 1e-8 and each test grows.
    n = len(limits)
    transient = spread * np.linspace(-1, 1, n + 1)[1:]
    factor = -rate if alternates else rate
    values = [np.array(limits) + transient * factor**t for t in range(131 + n)]
    state, selection, _ = drive(make(kind, make_set(n), eta=eta, kappa=kappa), values)[-1]
    assert state.size == n
    assert sorted(selection.ids.tolist()) == list(range(1, n + 1))


@given(cases(), kinds)
def test_sizes_never_shrink_and_members_are_distinct(case: Case, kind: str):
    decided = case.drive(kind)
    sizes = [state.size for state, _, _ in decided]
    assert sizes == sorted(sizes)
    assert sizes[0] == (case.n if kind == "round_robin" else 1)
    for (old, *_), (state, selection, numbers) in itertools.pairwise(decided):
        ids = selection.ids.tolist()
        assert 1 <= len(ids) == len(set(ids)) == state.size <= case.n
        assert set(ids) <= set(range(1, case.n + 1))
        assert state.size == min(old.size + case.kappa * numbers["grew"], case.n)
        same = np.array_equal(old.selected, state.selected)
        assert state.order_version == (old.order_version if same else state.version)
        assert shown(case.make(kind).selection(state)) == shown(selection)


@given(cases(), growing)
def test_nothing_grows_without_a_gradient_step(case: Case, kind: str):
    for (old, *_), (state, _, numbers), steps in zip(
        decided := case.drive(kind), decided[1:], case.gradient_steps, strict=False
    ):
        if steps == 0:
            assert (state.size, numbers["grew"]) == (old.size, False)
            assert (state.tests, state.growths) == (old.tests, old.growths)
        else:
            assert state.tests == old.tests + 1


@given(cases(), kinds, st.randoms(use_true_random=False))
def test_the_order_of_rows_is_irrelevant(case: Case, kind: str, random: Any):
    order = list(range(case.n))
    random.shuffle(order)
    assert as_plain(case.drive(kind, order)) == as_plain(case.drive(kind))


def stored_and_restored(state: SetState) -> SetState:
    """Through JSON and npz, as a checkpoint does it."""
    numbers = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    file = io.BytesIO()
    np.savez(file, selected=numbers.pop("selected"))
    text = json.dumps(numbers, allow_nan=False)
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        return SetState(selected=arrays["selected"], **json.loads(text))


@given(cases(), kinds)
def test_a_state_survives_json_and_npz(case: Case, kind: str):
    decided = case.drive(kind)
    state = stored_and_restored(decided[0][0])
    for t in range(1, len(decided)):
        # A fresh curriculum each time: nothing may be remembered outside the state.
        state, selection, numbers = case.make(kind).step(
            state, feedback(state, case.values[t - 1], case.values[t], case.gradient_steps[t - 1])
        )
        state = stored_and_restored(state)
        assert as_plain([(state, selection, numbers)]) == as_plain([decided[t]])
        json.dumps(numbers, allow_nan=False)


@given(cases(), kinds)
def test_step_is_pure(case: Case, kind: str):
    curriculum = case.make(kind)
    state, selection = curriculum.start()
    assert as_plain([(*curriculum.start(), {})]) == as_plain([(state, selection, {})])
    for t, steps in enumerate(case.gradient_steps):
        told = feedback(state, case.values[t], case.values[t + 1], steps)
        for array in (told.values_before, told.values_after, state.selected):
            array.setflags(write=False)
        earlier = plain(state)
        once, again = curriculum.step(state, told), curriculum.step(state, told)
        assert as_plain([once]) == as_plain([again])
        assert plain(state) == earlier
        assert (told.values_before.tolist(), told.values_after.tolist()) == (case.values[t], case.values[t + 1])
        state = once[0]


@given(cases())
def test_random_growth_grows_on_exactly_the_feedback_that_space_grows_on(case: Case):
    space, control = case.make("space"), case.make("random_growth")
    for (state, *_), before, after, steps in zip(
        case.drive("space"), case.values, case.values[1:], case.gradient_steps, strict=False
    ):
        told = feedback(state, before, after, steps)
        (one, _, said), (other, _, heard) = space.step(state, told), control.step(state, told)
        for name in ("size", "tests", "growths", "stalled"):
            assert getattr(one, name) == getattr(other, name)
        for name in ("grew", "mean_value_before", "mean_value_after", "relative_change", "relative_change_each"):
            assert said[name] == heard[name]


@given(st.lists(st.sampled_from([-1.0, -0.0, 0.0, 0.5, 0.5, 2.0, 1e300]), min_size=1, max_size=40), st.data())
def test_the_partial_selection_equals_a_full_stable_sort(scores: list[float], data: st.DataObject):
    n = len(scores)
    size = data.draw(st.integers(1, n))
    keys = data.draw(st.lists(st.integers(0, 2**64 - 1), min_size=n, max_size=n, unique=True))
    by_key = sorted(range(n), key=lambda i: keys[i])
    in_full = sorted(by_key, key=lambda i: -scores[i])  # Python's sort is stable
    assert _highest(np.array(scores), size, np.array(keys, dtype=np.uint64)).tolist() == in_full[:size]


@pytest.mark.parametrize("levels", [1, 50, 10**9])
def test_the_partial_selection_of_many(levels: int):
    n, random = 20_000, np.random.default_rng(0)
    scores = random.integers(0, levels, size=n).astype(float)
    keys = random.permutation(n).astype(np.uint64)
    by_key = np.argsort(keys)
    in_full = by_key[np.argsort(-scores[by_key], kind="stable")]
    for size in (1, 399, 400, 401, n - 1, n):
        assert np.array_equal(_highest(scores, size, keys), in_full[:size])


# ---- The walk through a selection ----------------------------------------------------------------


def selection_of(n: int, *, version: int = 0, order_version: int = 0) -> Selection:
    return Selection(version, np.arange(n), np.zeros((n, 1)), order_version)


def test_shards_start_spread_over_a_new_order():
    nowhere = Walk(-1, ())
    assert [nowhere.position(selection_of(10), shard, 4) for shard in range(4)] == [0, 2, 5, 7]
    assert [nowhere.position(selection_of(1), shard, 4) for shard in range(4)] == [0, 0, 0, 0]
    assert [nowhere.position(selection_of(2), shard, 4) for shard in range(4)] == [0, 0, 1, 1]
    elsewhere = Walk(3, (9, 9, 9, 9))
    assert [elsewhere.position(selection_of(10, order_version=4), shard, 4) for shard in range(4)] == [0, 2, 5, 7]


def test_shards_go_on_where_they_stopped_on_the_same_order():
    walk = Walk(3, (9, 0, 4, 10))
    same = selection_of(10, version=8, order_version=3)  # another decision with the same outcome
    assert [walk.position(same, shard, 4) for shard in range(4)] == [9, 0, 4, 0]


def walked(walk: Walk, selection: Selection, episodes: Sequence[int]) -> tuple[Walk, list[list[int]]]:
    """The walk behind one round in which shard k begins episodes[k] episodes, and the places each shard takes.

    `rollout.collect` and `Training._account` in two lines.
    """
    n, starts = len(selection.ids), [walk.position(selection, k, len(episodes)) for k in range(len(episodes))]
    places = [[(start + i) % n for i in range(count)] for start, count in zip(starts, episodes, strict=True)]
    after = tuple((start + count) % n for start, count in zip(starts, episodes, strict=True))
    return Walk(selection.order_version, after), places


@given(n=st.integers(1, 12), shards=st.integers(1, 5), data=st.data())
def test_counts_differ_by_at_most_one_within_a_shard_and_by_the_shards_over_all(n: int, shards: int, data: Any):
    rounds = data.draw(st.lists(st.lists(st.integers(0, 25), min_size=shards, max_size=shards), max_size=8))
    begins = data.draw(st.integers(0, len(rounds)))  # an iteration may begin anywhere in the life of an order
    walk, selection, counts = Walk(-1, ()), selection_of(n), np.zeros((shards, n), dtype=int)
    for number, episodes in enumerate(rounds):
        walk, places = walked(walk, selection, episodes)
        if number >= begins:
            for shard, taken in enumerate(places):
                np.add.at(counts[shard], taken, 1)
            assert np.ptp(counts, axis=1).max() <= 1
            assert np.ptp(counts.sum(axis=0)) <= shards


def test_the_bound_over_all_shards_is_reached_and_an_instance_can_be_left_out_of_an_iteration():
    # Four instances, two shards, from places 0 and 2. Shard 0 walks once around, shard 1 halfway: both stand at 0.
    selection = selection_of(4)
    walk, _ = walked(Walk(-1, ()), selection, (4, 2))
    assert walk.positions == (0, 0)
    # Each walks two more, as many as four instances need between them, and both take the same two.
    _, places = walked(walk, selection, (2, 2))
    assert np.bincount(np.concatenate(places), minlength=4).tolist() == [2, 2, 0, 0]


@given(n=st.integers(1, 30), shards=st.integers(1, 8), data=st.data())
def test_a_new_order_is_passed_over_whole_in_its_first_iteration(n: int, shards: int, data: Any):
    # An iteration of `passes: 1` has at least n * horizon steps, so each shard begins at least n / shards episodes.
    share = -(-n // shards)
    episodes = data.draw(st.lists(st.integers(share, share + 5), min_size=shards, max_size=shards))
    _, places = walked(Walk(-1, ()), selection_of(n), episodes)
    assert set(itertools.chain(*places)) == set(range(n))
