"""What a handful of seeds allows one to say (after Agarwal et al. 2021, "Deep RL at the edge of the precipice")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from space_dist.seeding import Purpose, generator

FloatArray = NDArray[np.float64]

RESAMPLES: Final = 2000
CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Estimate:
    """One number over `n` seeds. `low` and `high` bound the IQM's 95 % interval and are None for a single seed.

    Without seeds, or where a seed has no such number, everything is NaN: a diverged seed is never averaged away.
    """

    n: int
    iqm: float
    mean: float
    median: float
    low: float | None
    high: float | None


def interquartile_mean(values: FloatArray) -> FloatArray:
    """The mean of the middle half over the first axis: `(n, ...)` -> `(...)`, NaN where a value is.

    A quarter is rounded down to whole values, so below four values this is the plain mean. Raises ValueError for none.
    """
    if len(values) == 0:
        raise ValueError("no values")
    middle = np.asarray(stats.trim_mean(values, 0.25, axis=0), dtype=np.float64)
    return np.where(np.isnan(values).any(axis=0), np.nan, middle)


def bootstrap_interval(values: FloatArray, resamples: int = RESAMPLES) -> tuple[FloatArray, FloatArray]:
    """The 95 % percentile bootstrap interval of the IQM over the first axis: `(n, ...)` -> two `(...)`.

    Seeds are resampled with replacement, the same way at every place of the other axes and in every call. NaN for
    n = 1 and where a value is NaN. Raises ValueError for n = 0.
    """
    n = len(values)
    centre = interquartile_mean(values)
    if n == 1:
        return np.full_like(centre, np.nan), np.full_like(centre, np.nan)
    picks = generator(0, Purpose.BOOTSTRAP, n).integers(n, size=(resamples, n))
    tail = 50.0 * (1.0 - CONFIDENCE)
    columns = values.reshape(n, -1)
    bounds = np.empty((2, columns.shape[1]))
    for place in range(columns.shape[1]):  # one by one: all resamples of all places need not fit into memory
        spread = interquartile_mean(columns[:, place][picks].T)
        bounds[:, place] = np.percentile(spread, (tail, 100.0 - tail))
    low, high = bounds.reshape(2, *values.shape[1:])
    return low, high


def estimate(values: FloatArray) -> Estimate:
    """All of one number over the `(n,)` seeds."""
    n = len(values)
    if n == 0 or np.isnan(values).any():
        return Estimate(n, np.nan, np.nan, np.nan, None, None)
    low, high = bootstrap_interval(values) if n > 1 else (None, None)
    return Estimate(
        n,
        float(interquartile_mean(values)),
        float(values.mean()),
        float(np.median(values)),
        None if low is None else float(low),
        None if high is None else float(high),
    )
