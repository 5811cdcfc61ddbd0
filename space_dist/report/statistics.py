"""What a handful of seeds allows one to say (after Agarwal et al. 2021, "Deep RL at the edge of the precipice").

All intervals are to cover 95 %, and are computed, not drawn: no number of a report hangs on a random generator.
Percentile bootstraps, which the field uses, do not cover what they promise with few seeds: 74 % at three, 89 % at five.
`python jobs/benchmark.py coverage` measures both on populations of every kind; docs/reports.md has the table.

IQM, mean       centre +- t se, t of Student's distribution; se is the larger one of two standard errors: that of the
                winsorised values (Tukey and McLaughlin 1963), which a few values alone make far too small at times, and
                that of all values, times 1.1 where values are trimmed
median          order statistics (exact for any distribution) from six values on; below as above, times 1.25
P(better)       Newcombe 2006, method 5, with Student's t: with the normal's 1.96 it excludes 1/2 wherever three seeds
                beat three, which chance does in one case of ten
ratio           Student's t on the log of the ratio, its standard error by the delta method, in pairs

Below three seeds there is no interval: with two, Student's t is 12.7, and nothing shorter covers. Nor is there one
where seeds show no spread at all, for then nothing says how wide it would have to be.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

FloatArray = NDArray[np.float64]
Statistic = Literal["iqm", "mean", "median"]

CONFIDENCE: Final = 0.95
CONSECUTIVE: Final = 3  # evaluations at or above a threshold that count as having reached it
FEWEST: Final = 3  # seeds of an interval
ENOUGH: Final = 10  # seeds from which on intervals cover whatever the population: docs/reports.md
_UPPER: Final = 0.5 + CONFIDENCE / 2.0
_TRIMMED: Final = 1.1  # standard error of the IQM of normal values over that of their mean, rounded up
_MEDIAN: Final = 1.25  # of the median over that of the mean, likewise
_ORDERED: Final = 6  # values from which on least and greatest enclose the median with 95 %: 1 - 2 / 2^6


@dataclass(frozen=True)
class Interval:
    """A number and the bounds of its 95 % interval.

    `value` is NaN where there is no such number; `low` and `high` are None where there is no interval: below three
    seeds, where they show no spread, and where a number is missing.
    """

    value: float
    low: float | None = None
    high: float | None = None

    def within(self, least: float, most: float) -> Interval:
        """The same, where the number is known to lie between two bounds."""
        if self.low is None or self.high is None:
            return self
        return Interval(self.value, max(self.low, least), min(self.high, most))


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


_CENTRES: Final[Mapping[Statistic, Callable[[FloatArray], FloatArray]]] = {
    "iqm": interquartile_mean, "mean": mean, "median": median,
}  # fmt: skip


def confidence_interval(values: FloatArray, statistic: Statistic = "iqm") -> tuple[FloatArray, FloatArray]:
    """The 95 % interval of a statistic over the first axis: `(n, ...)` -> two `(...)`.

    NaN for n < 3, where a value is NaN, and where the interval would have no width. Raises ValueError for n = 0.
    """
    n = len(values)
    if n == 0:
        raise ValueError("no values")
    columns = values.reshape(n, -1)
    bounds = np.full((2, columns.shape[1]), np.nan)
    places = np.flatnonzero(np.isfinite(columns).all(axis=0)) if n >= FEWEST else np.zeros(0, dtype=np.int64)
    if len(places):
        part = columns[:, places]
        bounds[:, places] = _of_median(part) if statistic == "median" else _of_trimmed([part], statistic)
    bounds[:, ~(bounds[1] > bounds[0])] = np.nan
    low, high = bounds.reshape(2, *values.shape[1:])
    return low, high


def intervals(samples: Sequence[FloatArray], statistic: Statistic) -> list[Interval]:
    """A statistic of each `(n,)` sample with its interval; NaN for an empty one and where a value is NaN."""
    found = [Interval(np.nan)] * len(samples)
    lengths = {len(sample) for sample in samples} - {0}
    for n in sorted(lengths):  # all samples of a length at once: a grid may have thousands
        places = [place for place, sample in enumerate(samples) if len(sample) == n]
        values = np.stack([samples[place] for place in places], axis=1)
        centre = _CENTRES[statistic](values)
        low, high = confidence_interval(values, statistic)
        for place, *numbers in zip(places, centre.tolist(), low.tolist(), high.tolist(), strict=True):
            found[place] = _interval(*numbers)
    return found


def estimates(samples: Sequence[FloatArray]) -> list[Estimate]:
    """All of one number over the `(n,)` seeds of each sample."""
    three = [intervals(samples, statistic) for statistic in _CENTRES]
    return [Estimate(len(sample), *found) for sample, *found in zip(samples, *three, strict=True)]


def estimate(values: FloatArray) -> Estimate:
    """All of one number over the `(n,)` seeds."""
    return estimates([values])[0]


def stratified(strata: Sequence[FloatArray]) -> Interval:
    """The IQM over all values of several strata, with an interval for seeds drawn from each stratum by itself.

    No interval where a stratum has a single value. Raises ValueError without values.
    """
    centre = float(interquartile_mean(np.concatenate(strata)))
    fewest = FEWEST if len(strata) == 1 else 2
    if np.isnan(centre) or min(map(len, strata)) < fewest:
        return Interval(centre)
    low, high = _of_trimmed([stratum[:, None] for stratum in strata], "iqm")
    return _interval(centre, float(low[0]), float(high[0]))


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Interval:
    """P(X > Y) + P(X = Y) / 2 for a value of `ours` `(n,)` and one of `theirs` `(m,)`, over all pairs.

    NaN if one is empty or holds a NaN; no interval where one has fewer than three values. Sources: Agarwal et al. 2021,
    section 4.3 (the Mann-Whitney U statistic over n m), here for one task; Newcombe 2006, Statistics in Medicine 25,
    559-573, method 5: every p whose own standard error explains the distance to the estimate, under which no seed of
    one beating any of the other still leaves room.
    """
    n, m = len(ours), len(theirs)
    if not n or not m or np.isnan(ours).any() or np.isnan(theirs).any():
        return Interval(np.nan)
    wins = np.sign(ours[:, None] - theirs[None, :]) / 2.0 + 0.5  # 1, 0, and 1/2 for a tie
    centre = float(wins.mean())
    if min(n, m) < FEWEST:
        return Interval(centre)
    low = _least_probability(centre, n, m)
    return _interval(centre, low, 1.0 - _least_probability(1.0 - centre, n, m))


def _least_probability(found: float, n: int, m: int) -> float:
    """The lower bound of a probability that was `found` over `(n, m)` pairs."""
    if found == 0.0:
        return 0.0
    t, size = float(stats.t.ppf(_UPPER, n + m - 2)), (n + m) / 2.0 - 1.0

    def excess(p: float) -> float:
        variance = p * (1.0 - p) * (1.0 + size * ((1.0 - p) / (2.0 - p) + p / (1.0 + p))) / (n * m)
        return found - p - t * float(np.sqrt(variance))

    # At exactly 1 the variance is 0, and so is the excess: the root found would be that end.
    return float(optimize.brentq(excess, 0.0, min(found, 1.0 - 1e-12)))


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
    """The mean of `ours` over the mean of `theirs`, both `(n,)` and of the same seeds, in pairs.

    Neither holds a negative number. NaN without seeds and where the mean of `theirs` is 0; no interval below three
    seeds, where a mean is 0, and where every seed has the same ratio.
    """
    n = len(ours)
    if not n or not theirs.any():
        return Interval(np.nan)
    centre = float(ours.mean() / theirs.mean())
    if n < FEWEST or centre == 0.0:
        return Interval(centre)
    shares = ours / ours.mean() - theirs / theirs.mean()  # by how much a seed moves the log of the ratio, times n
    half = float(stats.t.ppf(_UPPER, n - 1) * shares.std(ddof=1) / np.sqrt(n))
    if half < 1e-9:  # rounding
        return Interval(centre)
    return _interval(centre, centre * float(np.exp(-half)), centre * float(np.exp(half)))


def start_bound(returns: FloatArray) -> float:
    """Up to where the return of one more untrained seed may lie: a threshold below it is within noise of step 0.

    The upper 97.5 % prediction bound of a normal distribution, mean + t s sqrt(1 + 1/n), from the `(n,)` returns at the
    first evaluation. Infinite for fewer than two seeds, which show no noise, and where a return is NaN.
    """
    n = len(returns)
    if n < 2 or np.isnan(returns).any():
        return np.inf
    t = float(stats.t.ppf(_UPPER, n - 1))
    return float(returns.mean() + t * returns.std(ddof=1) * np.sqrt(1.0 + 1.0 / n))


def _of_trimmed(strata: Sequence[FloatArray], statistic: Statistic) -> tuple[FloatArray, FloatArray]:
    """Bounds of the mean, or the IQM, of all values of strata `(n_k, p)` -> two `(p,)`; each n_k at least 2.

    The degrees of freedom of several strata are Satterthwaite's.
    """
    pooled = np.sort(np.concatenate(strata), axis=0)
    n = len(pooled)
    cut = n // 4 if statistic == "iqm" else 0
    kept = pooled[cut : n - cut]
    winsorised = [np.clip(stratum, kept[0], kept[-1]) for stratum in strata]
    plain = _TRIMMED**2 if cut else 1.0
    variance, freedom = _variance(strata, np.sqrt(plain) / n)
    other, its_freedom = _variance(winsorised, 1.0 / len(kept))
    freedom = np.where(other > variance, its_freedom, freedom)
    half = stats.t.ppf(_UPPER, freedom) * np.sqrt(np.maximum(variance, other))
    centre = kept.mean(axis=0)
    return centre - half, centre + half


def _variance(strata: Sequence[FloatArray], scale: float) -> tuple[FloatArray, FloatArray]:
    """Of `scale` times the sum of all values of strata `(n_k, p)`: the variance, and its degrees of freedom; `(p,)`."""
    parts = np.stack([len(stratum) * scale**2 * stratum.var(axis=0, ddof=1) for stratum in strata])
    each = np.array([len(stratum) - 1.0 for stratum in strata])[:, None]
    total, squares = parts.sum(axis=0), (parts**2 / each).sum(axis=0)
    freedom = np.divide(total**2, squares, out=np.ones_like(total), where=squares > 0.0)
    return total, freedom


def _of_median(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bounds of the median over the first axis: `(n, p)` -> two `(p,)`; n at least 3."""
    n = len(values)
    if n < _ORDERED:
        half = stats.t.ppf(_UPPER, n - 1) * _MEDIAN * values.std(axis=0, ddof=1) / np.sqrt(n)
        return median(values) - half, median(values) + half
    ordered = np.sort(values, axis=0)
    outside = int(stats.binom.ppf(1.0 - _UPPER, n, 0.5)) - 1  # as many as are below the median in 2.5 % at most
    return ordered[max(outside, 0)], ordered[n - 1 - max(outside, 0)]


def _interval(value: float, low: float, high: float) -> Interval:
    bounded = bool(np.isfinite(low) and np.isfinite(high) and low < high)
    return Interval(value, low, high) if bounded else Interval(value)
