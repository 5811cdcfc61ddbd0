"""What a handful of seeds allows one to say (after Agarwal et al. 2021, "Deep RL at the edge of the precipice").

All intervals are 95 % percentile bootstraps of `scipy.stats.bootstrap`, from a generator of fixed seed: the same seeds
give the same interval in every report. What is resampled, with replacement, are seeds: those of each stratum among
themselves, those of two independent samples each for itself, those of a paired sample together. A percentile interval
is defined for every sample of two or more, equal values included, where BCa has no answer; with few seeds it is
narrower than it should be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from space_dist.seeding import Purpose, generator

FloatArray = NDArray[np.float64]
Statistic = Callable[..., FloatArray]
"""`(values, axis=0)`: an axis of values -> a number."""

RESAMPLES: Final = 2000
CONFIDENCE: Final = 0.95
CONSECUTIVE: Final = 3  # evaluations at or above a threshold that count as having reached it
_MAX_ELEMENTS: Final = 4_000_000  # numbers of resamples in memory at a time


@dataclass(frozen=True)
class Interval:
    """A number and the bounds of its 95 % interval.

    `value` is NaN where there is no such number; `low` and `high` are None where there is no interval: for a single
    seed, and where a resample has no such number.
    """

    value: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Estimate:
    """One number over `n` seeds, summarised in three ways.

    Without seeds, or where a seed has no such number, everything is NaN: a diverged seed is never averaged away.
    """

    n: int
    iqm: Interval
    mean: Interval
    median: Interval


@dataclass(frozen=True)
class Reach:
    """When the seeds of one setting reached a threshold, in real environment steps.

    `times` `(n,)` are NaN for a seed that did not reach it before its run ended, which is *censored* at `budget`.
    `mean` is the restricted mean: that of the times, censored ones counted as the budget, so it is a lower bound of
    the mean time where seeds are censored.
    """

    times: FloatArray
    budget: int
    mean: Interval

    @property
    def censored(self) -> int:
        """Seeds that did not reach it."""
        return int(np.isnan(self.times).sum())


def mean(values: FloatArray, axis: int = 0) -> FloatArray:
    """The plain mean over an axis."""
    return np.asarray(np.mean(values, axis=axis))


def median(values: FloatArray, axis: int = 0) -> FloatArray:
    """The median over an axis."""
    return np.asarray(np.median(values, axis=axis))


def interquartile_mean(values: FloatArray, axis: int = 0) -> FloatArray:
    """The mean of the middle half over an axis: `(n, ...)` -> `(...)`, NaN where a value is.

    A quarter is rounded down to whole values, so below four values this is the plain mean. Raises ValueError for none.
    """
    if values.shape[axis] == 0:
        raise ValueError("no values")
    middle = np.asarray(stats.trim_mean(values, 0.25, axis=axis), dtype=np.float64)
    return np.where(np.isnan(values).any(axis=axis), np.nan, middle)


def bootstrap_interval(
    values: FloatArray, statistic: Statistic = interquartile_mean, resamples: int = RESAMPLES
) -> tuple[FloatArray, FloatArray]:
    """The 95 % interval of a statistic over the first axis, by default the IQM: `(n, ...)` -> two `(...)`.

    Seeds are resampled the same way at every place of the other axes and in every call. NaN for n = 1 and where a value
    is NaN. Raises ValueError for n = 0.
    """
    n = len(values)
    if n == 0:
        raise ValueError("no values")
    columns = values.reshape(n, -1)
    bounds = np.full((2, columns.shape[1]), np.nan)
    places = np.flatnonzero(~np.isnan(columns).any(axis=0)) if n > 1 else np.zeros(0, dtype=np.int64)
    width = max(1, _MAX_ELEMENTS // (n * resamples))
    for first in range(0, len(places), width):
        part = places[first : first + width]
        bounds[:, part] = _bootstrap((columns[:, part],), statistic, n, resamples=resamples, axis=0)
    low, high = bounds.reshape(2, *values.shape[1:])
    return low, high


def intervals(samples: Sequence[FloatArray], statistic: Statistic) -> list[Interval]:
    """A statistic of each `(n,)` sample with its interval; NaN for an empty one and where a value is NaN."""
    found = [Interval(np.nan)] * len(samples)
    lengths = {len(sample) for sample in samples} - {0}
    for n in sorted(lengths):  # all samples of a length at once: a grid may have thousands
        places = [place for place, sample in enumerate(samples) if len(sample) == n]
        values = np.stack([samples[place] for place in places], axis=1)
        centre = statistic(values)
        low, high = bootstrap_interval(values, statistic)
        for place, *numbers in zip(places, centre.tolist(), low.tolist(), high.tolist(), strict=True):
            found[place] = _interval(*numbers)
    return found


def estimates(samples: Sequence[FloatArray]) -> list[Estimate]:
    """All of one number over the `(n,)` seeds of each sample."""
    three = [intervals(samples, statistic) for statistic in (interquartile_mean, mean, median)]
    return [Estimate(len(sample), *found) for sample, *found in zip(samples, *three, strict=True)]


def estimate(values: FloatArray) -> Estimate:
    """All of one number over the `(n,)` seeds."""
    return estimates([values])[0]


def stratified(strata: Sequence[FloatArray], statistic: Statistic = interquartile_mean) -> Interval:
    """A statistic over all values of several strata, with the stratified bootstrap's interval.

    The seeds of each stratum are resampled among themselves, so each resample has as many values of every stratum as
    there are. No interval where a stratum has a single value. Raises ValueError without values.
    """
    centre = float(statistic(np.concatenate(strata)))
    if np.isnan(centre) or any(len(stratum) < 2 for stratum in strata):
        return Interval(centre)

    def pooled(*resampled: FloatArray, axis: int) -> FloatArray:
        return statistic(np.concatenate(resampled, axis=axis), axis)

    return _interval(centre, *_bootstrap(strata, pooled, sum(map(len, strata))))


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Interval:
    """P(X > Y) + P(X = Y) / 2 for a value of `ours` `(n,)` and one of `theirs` `(m,)`, over all pairs.

    Both samples are resampled, each for itself. NaN if one is empty or holds a NaN. Source: Agarwal et al. 2021,
    section 4.3 (the Mann-Whitney U statistic over n m); here for one task.
    """
    n, m = len(ours), len(theirs)
    if not n or not m or np.isnan(ours).any() or np.isnan(theirs).any():
        return Interval(np.nan)
    wins = np.sign(ours[:, None] - theirs[None, :]) / 2.0 + 0.5  # 1, 0, and 1/2 for a tie

    def improvement(rows: NDArray[np.int64], columns: NDArray[np.int64], axis: int) -> FloatArray:
        return np.asarray(((_counts(rows, n) @ wins) * _counts(columns, m)).sum(axis=axis) / (n * m))

    centre = float(wins.mean())
    if min(n, m) < 2:
        return Interval(centre)
    return _interval(centre, *_bootstrap((np.arange(n), np.arange(m)), improvement, n, m))


def steps_to_threshold(steps: NDArray[np.int64], returns: FloatArray, threshold: float) -> float:
    """The step of the first of three consecutive evaluations at or above the threshold; NaN if there is none.

    `steps` and `returns` are `(k,)`, in order of time.
    """
    above = (returns >= threshold).astype(np.int64)
    if len(above) < CONSECUTIVE:
        return np.nan
    enough = np.convolve(above, np.ones(CONSECUTIVE, dtype=np.int64), mode="valid") == CONSECUTIVE
    return float(steps[np.argmax(enough)]) if enough.any() else np.nan


def restricted(times: FloatArray, budget: float) -> FloatArray:
    """Times as far as the budget: censored (NaN) and later ones count as the budget."""
    return np.fmin(times, budget)


def paired_ratio(ours: FloatArray, theirs: FloatArray) -> Interval:
    """The mean of `ours` over the mean of `theirs`, both `(n,)` and of the same seeds, which are resampled in pairs.

    Neither holds a negative number. NaN without seeds and where the mean of `theirs` is 0; no interval where a resample
    of `theirs` may be all 0.
    """
    if not len(ours) or not theirs.any():
        return Interval(np.nan)

    def ratio(above: FloatArray, below: FloatArray, axis: int) -> FloatArray:
        return np.asarray(above.mean(axis=axis) / below.mean(axis=axis))

    centre = float(ratio(ours, theirs, 0))
    if len(ours) < 2 or not theirs.all():
        return Interval(centre)
    return _interval(centre, *_bootstrap((ours, theirs), ratio, len(ours), paired=True))


def start_bound(returns: FloatArray) -> float:
    """Up to where the return of one more untrained seed may lie: a threshold below it is within noise of step 0.

    The upper 97.5 % prediction bound of a normal distribution, mean + t s sqrt(1 + 1/n), from the `(n,)` returns at the
    first evaluation. Infinite for fewer than two seeds, which show no noise, and where a return is NaN.
    """
    n = len(returns)
    if n < 2 or np.isnan(returns).any():
        return np.inf
    t = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, n - 1))
    return float(returns.mean() + t * returns.std(ddof=1) * np.sqrt(1.0 + 1.0 / n))


def _bootstrap(
    data: Sequence[NDArray[Any]], statistic: Callable[..., FloatArray], *keys: int,
    paired: bool = False, resamples: int = RESAMPLES, axis: int = -1,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """SciPy's percentile interval, its generator seeded by `keys`."""
    size = sum(sample.size for sample in data)
    found = stats.bootstrap(
        tuple(data), statistic, n_resamples=resamples, batch=max(1, _MAX_ELEMENTS // size), vectorized=True,
        paired=paired, axis=axis, confidence_level=CONFIDENCE, method="percentile",
        rng=generator(0, Purpose.BOOTSTRAP, *keys),
    )  # fmt: skip
    return found.confidence_interval.low, found.confidence_interval.high


def _interval(value: float, low: FloatArray | float, high: FloatArray | float) -> Interval:
    bounded = bool(np.isfinite(low) and np.isfinite(high))
    return Interval(value, float(low) if bounded else None, float(high) if bounded else None)


def _counts(picks: NDArray[np.int64], n: int) -> FloatArray:
    """`(..., k)` picks of 0..n-1 -> `(..., n)` how often each was picked."""
    rows = picks.reshape(-1, picks.shape[-1])
    flat = (rows + n * np.arange(len(rows))[:, None]).ravel()
    return np.bincount(flat, minlength=n * len(rows)).reshape(*picks.shape[:-1], n).astype(np.float64)
