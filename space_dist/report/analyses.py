"""What curricula did with their instances: the analyses of the SPaCE paper (Eimer et al. 2021), as functions of arrays.

The paper's section "Can SPaCE be applied without a value function?" and its appendix "Comparison of SPaCE Curricula"
give numbers and few definitions; those here are ours wherever it leaves them open.

Of one run: `trained` are the ids that each of its T iterations was trained on, in order of time, and `ids` `(n,)` its
training instances, ascending. An id may be there several times in an iteration (draws), and counts once: the set I_t
is the distinct ones. Whatever takes `trained` raises ValueError without iterations, for an iteration without instances,
for an id that is not in `ids` (such as -1, a generated context), and if `ids` do not ascend.

Of s seeds: `orders` `(s, n)` are their orders of inclusion, a row each. Instances that were added in one iteration are
tied in it, which tau-b takes into account (Kendall 1945).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from space_dist.report.load import FloatArray, IntArray

_ROUNDING: Final = 1e-9  # 0.55 * 100 is more than 55
_DECIMALS: Final = 12  # weighted frequencies are multiples of 1 / (2 n T), far more than this


@dataclass(frozen=True, eq=False)
class Consistency:
    """How alike s seeds of one method order their instances, in Kendall's tau-b: 1 alike, 0 unrelated, -1 reversed.

    `with_others` `(s,)`: each seed with the mean order of all others, so that no seed is compared with itself.
    `pairs` `(s (s - 1) / 2,)`: all pairs, (0, 1), (0, 2), ..., (1, 2), .... NaN where an order is constant; both are
    empty for fewer than two seeds.
    """

    with_others: FloatArray
    pairs: FloatArray


@dataclass(frozen=True, eq=False)
class Shifts:
    """How far the set moved from one iteration to the next, over k transitions.

    `steps` `(k,)`: the distance of the sets' mean features, as a share of the diagonal of the context space, in [0, 1].
    `jaccard` `(k,)`: 1 - |both| / |either|, 0 for the same set and 1 for nothing in common.
    """

    steps: FloatArray
    jaccard: FloatArray


def inclusion_order(trained: Sequence[IntArray], ids: IntArray) -> IntArray:
    """`(n,)` the first iteration, counted from 1, whose set includes an instance; T + 1 if none does."""
    members = _members(trained, ids)
    return np.where(members.any(axis=0), members.argmax(axis=0) + 1, len(members) + 1).astype(np.int64)


def frequencies(trained: Sequence[IntArray], ids: IntArray) -> FloatArray:
    """`(n,)` the share of the iterations whose set includes an instance, in [0, 1]; repeated draws count once."""
    return np.asarray(_members(trained, ids).mean(axis=0))


def weighted_frequencies(frequencies: FloatArray, order: IntArray) -> FloatArray:
    """`(n,)` frequencies, weighted by (n - r + 1) / n: from 1 for the instance included first to 1 / n for the last.

    r is the rank in the `order` `(n,)` of inclusion. Instances included together get the average of their ranks: the
    first two of them 1.5 each. Source: the paper's "weighted frequency", which says nothing of ties.
    """
    n = len(order)
    ranks = stats.rankdata(order, method="average")
    return np.asarray((n - ranks + 1.0) / n * frequencies)


def rank_changes(frequencies: FloatArray, weighted: FloatArray) -> int:
    """How many instances stand at another place when ordered by weighted instead of plain frequency, both `(n,)`.

    Greatest first; equal ones, and those that are equal but for rounding, by id. The paper found 4 of SPaCE's on
    PointMass, and none of cSPaCE's.
    """
    plain, other = (np.argsort(-np.round(values, _DECIMALS), kind="stable") for values in (frequencies, weighted))
    return int((plain != other).sum())


def consistency(orders: IntArray) -> Consistency:
    """How alike the orders `(s, n)` of one method's seeds are."""
    seeds = len(orders)
    if seeds < 2:
        return Consistency(np.zeros(0), np.zeros(0))
    others = [np.delete(orders, seed, axis=0).mean(axis=0) for seed in range(seeds)]
    return Consistency(
        with_others=np.array([_tau(own, mean) for own, mean in zip(orders, others, strict=True)]),
        pairs=np.array([_tau(one, other) for one, other in itertools.combinations(orders, 2)]),
    )


def agreement(orders_a: IntArray, orders_b: IntArray) -> float:
    """Kendall's tau-b of the mean orders of two methods, `(s, n)` and `(r, n)`; NaN where one is constant.

    Raises ValueError without seeds.
    """
    if not len(orders_a) or not len(orders_b):
        raise ValueError("no seeds")
    return _tau(orders_a.mean(axis=0), orders_b.mean(axis=0))


def shifts(trained: Sequence[IntArray], ids: IntArray, features: FloatArray) -> Shifts:
    """How far the set moved while the curriculum grew it.

    `features` `(n, d)` are those of the instances, scaled to [0, 1] by the bounds of the context space. Transitions
    from iteration t to t + 1 count up to and including the one into the first set that is whole: all T - 1 if none is,
    none if the first one is. What a run does with the whole set is no curriculum, and would only dilute the mean.
    """
    members = _members(trained, ids)
    whole = members.all(axis=1)
    if whole.any():
        members = members[: int(whole.argmax()) + 1]
    moved = np.diff(_means(members, features), axis=0)
    both, either = members[:-1] & members[1:], members[:-1] | members[1:]
    return Shifts(
        steps=np.linalg.norm(moved, axis=1) / np.sqrt(features.shape[1]),
        jaccard=1.0 - both.sum(axis=1) / either.sum(axis=1),
    )


def share_below(trained: Sequence[IntArray], ids: IntArray, ends: IntArray, share: float = 0.5) -> float:
    """The share of a run's steps that were spent on sets of fewer than `share` times n instances, in [0, 1].

    `ends` `(T,)` are the real environment steps at the end of each iteration; the first one begins at 0. Raises
    ValueError if there are not T of them.
    """
    sizes = _members(trained, ids).sum(axis=1)
    if len(ends) != len(sizes):
        raise ValueError(f"{len(ends)} ends of {len(sizes)} iterations")
    small = sizes < share * len(ids) - _ROUNDING
    return float(np.diff(ends, prepend=0)[small].sum() / ends[-1])


def stretches(trained: Sequence[IntArray], ids: IntArray) -> IntArray:
    """`(k,)` over how many iterations in a row the set stayed the same, one after the other; they sum to T."""
    members = _members(trained, ids)
    changes = np.flatnonzero((members[1:] != members[:-1]).any(axis=1)) + 1
    return np.diff(np.concatenate(([0], changes, [len(members)]))).astype(np.int64)


def shares_of_first(trained: Sequence[IntArray], ids: IntArray, episodes: int) -> FloatArray:
    """`(n,)` each instance's share of a run's first episodes, if an iteration plays each of its set once.

    The iteration in which that many are reached counts in proportion; a run of fewer counts whole.
    """
    members = _members(trained, ids)
    sizes = members.sum(axis=1)
    before = np.concatenate(([0], np.cumsum(sizes)[:-1]))
    played = np.clip(episodes - before, 0, sizes)  # of each iteration
    return np.asarray((members * (played / sizes)[:, None]).sum(axis=0) / played.sum())


def feature_means(trained: Sequence[IntArray], ids: IntArray, features: FloatArray) -> FloatArray:
    """`(T, d)` the mean features of each iteration's set, in the units of the features `(n, d)`."""
    return _means(_members(trained, ids), features)


def features_by_rank(orders: IntArray, features: FloatArray) -> FloatArray:
    """`(n, d)` the features of the instance included first, second, ...: the mean over the seeds of `orders` `(s, n)`.

    In the units of the features `(n, d)`. Instances included together are ordered by id. Source: the paper's figure
    "Context feature progression during training". Raises ValueError without seeds.
    """
    if not len(orders):
        raise ValueError("no seeds")
    return np.asarray(features[np.argsort(orders, axis=1, kind="stable")].mean(axis=0))


def feature_rank_correlations(orders: IntArray, features: FloatArray) -> FloatArray:
    """`(d,)` Kendall's tau-b of the mean of the orders `(s, n)` with each of the features `(n, d)`.

    1 where instances with less of a feature come first; NaN where the order or the feature is constant. Raises
    ValueError without seeds.
    """
    if not len(orders):
        raise ValueError("no seeds")
    mean = orders.mean(axis=0)
    return np.array([_tau(mean, feature) for feature in features.T])


def released_steps(set_sizes: IntArray, horizon: int) -> IntArray:
    """`(T,)` what the released SPaCE code calls steps at the end of each iteration, from the `(T,)` sizes of the sets.

    It counts the horizon for each instance of the set, whatever was really played: neither that episodes end early, nor
    that updates need more transitions than that. Numbers of the paper are over these, ours over real steps.
    """
    return np.cumsum(horizon * set_sizes, dtype=np.int64)


def _members(trained: Sequence[IntArray], ids: IntArray) -> NDArray[np.bool_]:
    """`(T, n)` whether the set of an iteration includes an instance."""
    if not len(trained):
        raise ValueError("no iterations")
    if not len(ids) or (np.diff(ids) <= 0).any():
        raise ValueError("the ids of the instances do not ascend")
    members = np.zeros((len(trained), len(ids)), dtype=np.bool_)
    for iteration, (row, drawn) in enumerate(zip(members, trained, strict=True), start=1):
        if not len(drawn):
            raise ValueError(f"iteration {iteration} has no instances")
        places = np.minimum(np.searchsorted(ids, drawn), len(ids) - 1)
        unknown = drawn[ids[places] != drawn]
        if len(unknown):
            raise ValueError(f"iteration {iteration} has instance {unknown[0]}, which is not one of the run's")
        row[places] = True
    return members


def _means(members: NDArray[np.bool_], features: FloatArray) -> FloatArray:
    """`(T, n)` members and `(n, d)` features -> `(T, d)` mean features of each set."""
    return np.stack([features[row].mean(axis=0) for row in members])


def _tau(one: FloatArray | IntArray, other: FloatArray | IntArray) -> float:
    return float(stats.kendalltau(one, other).statistic) if len(one) > 1 else np.nan
