"""How single instances, and pairs of seeds, came out: forgetting, worst cases, areas, paired differences, profiles.

Functions of arrays. `returns` `(k, n)` are those of one run at its k evaluations, in order of time, on each of its n
instances, in the environment's units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from space_dist.report.load import FloatArray, IntArray
from space_dist.report.statistics import FEWEST, Interval, intervals

SMOOTHED: Final = 5  # evaluations of a running mean
ERRORS: Final = 2.0  # standard errors that a decay is to exceed
_ROUNDING: Final = 1e-9  # 0.07 * 100 is more than 7


@dataclass(frozen=True)
class PairedDifference:
    """Ours minus theirs over `n` pairs: the mean with its 95 % interval (Student's t), and Wilcoxon's p-value.

    `p` is two-sided; NaN below three pairs, where all differences are 0, and where one is NaN.
    """

    mean: Interval
    p: float
    n: int


def forgotten(returns: FloatArray, delta: float) -> NDArray[np.bool_]:
    """`(n,)` whether an instance was learnt and then forgotten: its return rose by `delta`, and fell by it again.

    Of the running mean of each instance's returns over five evaluations (full windows only), start is the first, peak
    the greatest (the first of equal ones) and end the last. Forgotten is an instance with peak - start >= delta and
    peak - end >= delta, where peak - end is also at least two standard errors of that difference, from the sample
    variances of the two windows. `delta` is in the environment's units: a share of `span`.

    Source: the paper's appendix "The Influence of Catastrophic Forgetting" counts instances "for which the performance
    decays after an initial improvement"; this definition is ours. Raises ValueError for fewer than five evaluations, a
    return that is NaN, and a delta that is not positive, by which instances that never change would be forgotten.
    """
    if len(returns) < SMOOTHED:
        raise ValueError(f"{len(returns)} evaluations, where a running mean needs {SMOOTHED}")
    if np.isnan(returns).any():
        raise ValueError("a return is NaN")
    if not delta > 0.0:
        raise ValueError(f"delta is {delta}, and not positive")
    windows = np.lib.stride_tricks.sliding_window_view(returns, SMOOTHED, axis=0)  # (k - 4, n, 5)
    smooth = windows.mean(axis=-1)
    best = smooth.argmax(axis=0)
    peak, start, end = smooth.max(axis=0), smooth[0], smooth[-1]
    around_peak = windows[best, np.arange(returns.shape[1])]
    error = np.sqrt(around_peak.var(axis=-1, ddof=1) / SMOOTHED + windows[-1].var(axis=-1, ddof=1) / SMOOTHED)
    return np.asarray((peak - start >= delta) & (peak - end >= delta) & (peak - end >= ERRORS * error))


def span(returns: Sequence[FloatArray]) -> float:
    """The greatest minus the least return of many runs, arrays of any shape; NaN where one is.

    Raises ValueError without returns.
    """
    values = np.concatenate([np.ravel(of_run) for of_run in returns]) if returns else np.zeros(0)
    if not len(values):
        raise ValueError("no returns")
    return float(values.max() - values.min())


def worst_mean(chosen_on: FloatArray, measured_on: FloatArray, share: float = 0.1) -> float:
    """The mean of `measured_on` `(n,)` over the ceil(share n) instances that are worst on `chosen_on` `(n,)`.

    Equal ones are chosen by index. NaN where a return is, for a diverged instance is neither worst nor best. With both
    the same, this is the conditional value at risk (Rockafellar and Uryasev 2000), which noise makes too low: see
    `cross_worst_mean`. Raises ValueError without instances, if there are not as many of both, and for a share that is
    not in (0, 1].
    """
    if not len(chosen_on) or len(chosen_on) != len(measured_on):
        raise ValueError(f"chosen on {len(chosen_on)} instances, measured on {len(measured_on)}")
    if not 0.0 < share <= 1.0:
        raise ValueError(f"the share is {share}, and not in (0, 1]")
    if np.isnan(chosen_on).any() or np.isnan(measured_on).any():
        return np.nan
    count = max(1, math.ceil(share * len(chosen_on) - _ROUNDING))
    return float(measured_on[np.argsort(chosen_on, kind="stable")[:count]].mean())


def cross_worst_mean(halves: FloatArray, share: float = 0.1) -> float:
    """`worst_mean` by which no instance is chosen by the noise that it is measured with.

    `halves` `(2, n)` are returns of two separate halves of the episodes on each instance: the worst of each half are
    measured on the other, and the two means averaged.
    """
    one, other = halves
    return (worst_mean(one, other, share) + worst_mean(other, one, share)) / 2.0


def area(steps: IntArray, values: FloatArray, budget: int) -> float:
    """The area under a curve from step 0 to the budget, over the budget: the mean return over training.

    `steps` `(k,)` are real environment steps, `values` `(k,)` the returns measured at them; straight lines between.
    The first value holds before its step, the last one behind its own; where evaluations lie behind the budget, the
    line to the first of them is followed as far as the budget. Raises ValueError without evaluations, if there are not
    as many of both, for steps that do not ascend from 0, and for a budget that is not positive.
    """
    if not len(steps) or len(steps) != len(values):
        raise ValueError(f"{len(steps)} steps of {len(values)} evaluations")
    if (np.diff(steps, prepend=-1) <= 0).any():
        raise ValueError("the steps of the evaluations do not ascend from 0")
    if budget <= 0:
        raise ValueError(f"the budget is {budget}, and not positive")
    corners = np.concatenate(([0], steps[steps < budget], [budget]))
    return float(np.trapezoid(np.interp(corners, steps, values), corners) / budget)


def paired_difference(ours: FloatArray, theirs: FloatArray) -> PairedDifference:
    """Ours minus theirs, both `(n,)` and of the same seeds in the same order.

    p is that of Wilcoxon's signed-rank test (1945): differences of 0 are left out, equal sizes get their average rank.
    It is exact up to 50 differences, or 13 where sizes are equal (of all their signs); the normal approximation beyond.
    Its least value is 2 / 2^n: 0.25 for three pairs, 0.0625 for five. Raises ValueError without pairs, and if there are
    not as many of both.
    """
    n = len(ours)
    if not n or n != len(theirs):
        raise ValueError(f"{n} of ours and {len(theirs)} of theirs make no pairs")
    differences = ours - theirs
    (centre,) = intervals([differences], "mean")
    moved = differences[differences != 0.0]
    if n < FEWEST or not len(moved):
        return PairedDifference(centre, np.nan, n)
    return PairedDifference(centre, float(stats.wilcoxon(moved, method="auto").pvalue), n)


def profile(scores: FloatArray, thresholds: FloatArray) -> FloatArray:
    """`(j,)` the share of `scores` `(m,)` (runs x instances) strictly above each of the `thresholds` `(j,)`.

    A score that is NaN is above none. Source: the performance profiles of Agarwal et al. 2021, section 4.2. Raises
    ValueError without scores.
    """
    if not len(scores):
        raise ValueError("no scores")
    return np.asarray((scores[:, None] > thresholds[None, :]).mean(axis=0))
