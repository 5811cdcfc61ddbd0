"""How often the 95 % intervals of reports cover what they are of, and how often their rivals would.

Seeds are drawn from populations whose IQM is known (from a million values), as often as asked for; an interval that is
not there counts as a miss, and has no width. Widths are medians, in standard deviations of the population. Below four
seeds the IQM is the plain mean, so there the population's mean is what an interval has to cover.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import special, stats

from benchmarks.results import JsonFile, keep
from space_dist.report.statistics import (
    CONFIDENCE,
    Interval,
    confidence_interval,
    interquartile_mean,
    paired_ratio,
    probability_of_improvement,
    stratified,
)
from space_dist.seeding import Purpose, generator

FloatArray = NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, ...]], FloatArray]
Bounds = tuple[FloatArray, FloatArray]

SIZES: Final = (3, 4, 5, 8, 10, 20)
LARGE: Final = 1_000_000  # values that stand for a population
RESAMPLES: Final = 1000
TAILS: Final = (0.5 - CONFIDENCE / 2.0, 0.5 + CONFIDENCE / 2.0)
console = Console()


def _failing(share: float) -> Draw:
    """Seeds that learn the task, and a share of them that end far below."""
    return lambda random, shape: random.standard_normal(shape) - 6.0 * (random.random(shape) < share)


POPULATIONS: Final[Mapping[str, Draw]] = {
    "normal": lambda random, shape: random.standard_normal(shape),
    "heavy tails (t, 3)": lambda random, shape: random.standard_t(3, shape),
    "skewed (exponential)": lambda random, shape: random.exponential(size=shape),
    "skewed (lognormal)": lambda random, shape: np.exp(random.standard_normal(shape)),
    "15 % fail": _failing(0.15),
    "30 % fail": _failing(0.3),
    "half fail": _failing(0.5),
    "40 % at a limit": lambda random, shape: np.minimum(random.standard_normal(shape), 0.2533),
}


def ours(values: FloatArray) -> Bounds:
    """What reports show: `(n, samples)` -> two `(samples,)`."""
    return confidence_interval(values)


def percentile(values: FloatArray) -> Bounds:
    """The percentile bootstrap."""
    low, high = np.quantile(interquartile_mean(_resampled(values), 1), TAILS, axis=0)
    return low, high


def bca(values: FloatArray) -> Bounds:
    """The bias-corrected and accelerated bootstrap (Efron 1987); at its ends where resamples agree."""
    centre, drawn = interquartile_mean(values), np.sort(interquartile_mean(_resampled(values), 1), axis=0)
    below = ((drawn < centre).mean(axis=0) + (drawn <= centre).mean(axis=0)) / 2.0
    bias = special.ndtri(np.clip(below, 1e-3, 1.0 - 1e-3))
    without = np.stack([interquartile_mean(np.delete(values, one, 0)) for one in range(len(values))])
    away = without.mean(axis=0) - without
    spread = (away**2).sum(axis=0) ** 1.5
    acceleration = np.divide((away**3).sum(axis=0), 6.0 * spread, out=np.zeros_like(spread), where=spread > 0.0)
    ends = []
    for tail in TAILS:
        z = bias + special.ndtri(tail)
        level = special.ndtr(bias + z / (1.0 - acceleration * z))
        place = np.clip((level * RESAMPLES).astype(int), 0, RESAMPLES - 1)
        ends.append(np.take_along_axis(drawn, place[None], 0)[0])
    return ends[0], ends[1]


def studentised(values: FloatArray) -> Bounds:
    """The bootstrap of Student's t, with the standard error of winsorised values; without an end where that is 0."""
    (centre, error), (drawn, errors) = _with_error(values, 0), _with_error(_resampled(values), 1)
    away = drawn - centre
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where((errors == 0.0) & (away == 0.0), 0.0, away / errors)
        low, high = np.quantile(t, TAILS, axis=0, method="nearest")
        return centre - high * error, centre - low * error


def tukey_mclaughlin(values: FloatArray) -> Bounds:
    """Student's t with the standard error of winsorised values (1963), with as many degrees as values are kept."""
    centre, error = _with_error(values, 0)
    half = stats.t.ppf(TAILS[1], len(values) - 2 * (len(values) // 4) - 1) * error
    return centre - half, centre + half


METHODS: Final[Mapping[str, Callable[[FloatArray], Bounds]]] = {
    "here": ours, "percentile": percentile, "BCa": bca, "studentised": studentised,
    "Tukey-McLaughlin": tukey_mclaughlin,
}  # fmt: skip


def coverage(
    samples: Annotated[int, typer.Option(min=100, help="Drawn from each population.")] = 2000,
    json_file: JsonFile = None,
) -> None:
    """How often 95 % intervals cover, by population and number of seeds; those of reports, and others."""
    parts = {
        "The IQM of one cell": list(of_one_cell(samples)),
        "The IQM of four cells pooled": list(of_strata(samples)),
        "P(better), as many seeds of both": list(of_improvement(samples)),
        "The ratio of restricted means, in pairs": list(of_ratio(samples)),
    }
    for title, rows in parts.items():
        table = Table(title=f"{title}: coverage in % (median width)")
        for number, column in enumerate(rows[0]):
            table.add_column(column, justify="right" if number else "left")
        for row in rows:
            table.add_row(*(f"{cell[0]:.1f} ({cell[1]:.2f})" if isinstance(cell, tuple) else str(cell)
                            for cell in row.values()))  # fmt: skip
        console.print(table)
    keep(parts, json_file)


def of_one_cell(samples: int) -> Iterable[dict[str, Any]]:
    """Rows: every method on the seeds of one cell."""
    for name, draw in POPULATIONS.items():
        population = draw(_random(name, 0), (LARGE,))
        spread, middle = float(population.std()), float(interquartile_mean(population))
        for n in SIZES:
            values = draw(_random(name, n), (n, samples))
            truth = middle if n > 3 else float(population.mean())
            found = {method: _score(*bounds(values), truth, spread) for method, bounds in METHODS.items()}
            yield {"population": name, "seeds": n, **found}


def of_strata(samples: int) -> Iterable[dict[str, Any]]:
    """Rows: four cells half a standard deviation apart, pooled; against the stratified percentile bootstrap."""
    apart = np.arange(4.0)[:, None]
    for name, draw in POPULATIONS.items():
        population = draw(_random(name, 0), (4, LARGE // 4))
        spread = float(population.std())
        truth = float(interquartile_mean((population + apart * spread / 2.0).ravel()))
        for n in SIZES[:-1]:
            cells = draw(_random(name, n, 1), (samples, 4, n)) + apart * spread / 2.0
            found = [stratified(list(one)) for one in cells]
            drawn = np.stack([_drawn_cells(cells, number) for number in range(RESAMPLES)])
            low, high = np.quantile(drawn, TAILS, axis=0)
            yield {"population": name, "seeds a cell": n, "here": _score(*_bounds(found), truth, spread),
                   "percentile": _score(low, high, truth, spread)}  # fmt: skip


def of_improvement(samples: int) -> Iterable[dict[str, Any]]:
    """Rows: two samples of a population, one of them higher by so many standard deviations."""
    for name, draw in POPULATIONS.items():
        spread = float(draw(_random(name, 0), (LARGE,)).std())
        for shift in (0.0, 1.0, 2.5):
            one, other = (draw(_random(name, 0, key), (LARGE,)) for key in (2, 3))
            truth = float((np.sign(one + shift * spread - other) / 2.0 + 0.5).mean()) if shift else 0.5
            for n in (3, 5, 10):
                above, below = (draw(_random(name, n, key), (samples, n)) for key in (4, 5))
                above = above + shift * spread
                found = [probability_of_improvement(*pair) for pair in zip(above, below, strict=True)]
                wins = np.sign(above[:, :, None] - below[:, None, :]) / 2.0 + 0.5
                random = _random(name, n, 6)
                rows, columns = (random.multinomial(n, np.full(n, 1.0 / n), RESAMPLES) / n for _ in range(2))
                drawn = np.einsum("bi,sij,bj->bs", rows, wins, columns, optimize=True)
                low, high = np.quantile(drawn, TAILS, axis=0)
                yield {"population": name, "P(better)": f"{truth:.2f}", "seeds": n,
                       "here": _score(*_bounds(found), truth, 1.0),
                       "percentile": _score(low, high, truth, 1.0)}  # fmt: skip


def of_ratio(samples: int) -> Iterable[dict[str, Any]]:
    """Rows: lognormal times of two cells that are as good, or one twice as fast, some of them censored."""
    for spread, faster, censored in ((0.3, 1.0, 0.0), (0.7, 1.0, 0.0), (0.7, 1.0, 0.4), (0.7, 1.0, 0.7),
                                     (0.5, 0.5, 0.0), (0.7, 0.5, 0.4)):  # fmt: skip
        budget = np.exp(spread * stats.norm.ppf(1.0 - censored)) if censored else np.inf

        def times(random: np.random.Generator, shape: tuple[int, ...], share: float, width: float = spread,
                  most: float = budget) -> FloatArray:  # fmt: skip
            return np.minimum(share * np.exp(width * random.standard_normal(shape)), most)

        name = f"spread {spread}, ratio {faster:g}, {censored:.0%} censored"
        truth = float(times(_random(name, 0), (LARGE,), faster).mean() / times(_random(name, 1), (LARGE,), 1.0).mean())
        for n in (3, 5, 10, 20):
            random = _random(name, n)
            quick, slow = times(random, (samples, n), faster), times(random, (samples, n), 1.0)
            found = [paired_ratio(*pair) for pair in zip(quick, slow, strict=True)]
            picks = _random(name, n, 1).integers(0, n, (RESAMPLES, n))
            drawn = quick[:, picks].mean(axis=2) / slow[:, picks].mean(axis=2)
            low, high = np.quantile(drawn, TAILS, axis=1)
            yield {"times": name, "pairs": n, "here": _score(*_bounds(found), truth, 1.0),
                   "percentile": _score(low, high, truth, 1.0)}  # fmt: skip


def _random(name: str, *keys: int) -> np.random.Generator:
    return generator(1, Purpose.BOOTSTRAP, *name.encode(), *keys)


def _resampled(values: FloatArray) -> FloatArray:
    """`(n, samples)` -> `(resamples, n, samples)`, the same places in all samples."""
    picks = generator(2, Purpose.BOOTSTRAP, len(values)).integers(0, len(values), (RESAMPLES, len(values)))
    return values[picks]


def _drawn_cells(cells: FloatArray, number: int) -> FloatArray:
    """`(samples,)` the IQM of one stratified resample of `(samples, cells, n)`."""
    picks = generator(3, Purpose.BOOTSTRAP, number).integers(0, cells.shape[2], cells.shape[1:])
    drawn = cells[:, np.arange(cells.shape[1])[:, None], picks]
    return interquartile_mean(drawn.reshape(len(cells), -1), 1)


def _with_error(values: FloatArray, axis: int) -> tuple[FloatArray, FloatArray]:
    """The IQM, and its standard error from winsorised values."""
    ordered = np.moveaxis(np.sort(values, axis=axis), axis, 0)
    n = len(ordered)
    cut = n // 4
    kept = ordered[cut : n - cut]
    error = np.clip(ordered, kept[0], kept[-1]).std(axis=0, ddof=1)
    return kept.mean(axis=0), error * np.sqrt((n - 1.0) / (len(kept) * (len(kept) - 1.0)))


def _bounds(found: Sequence[Interval]) -> Bounds:
    low, high = (np.array([np.nan if end is None else end for end in ends], dtype=np.float64)
                 for ends in ([one.low for one in found], [one.high for one in found]))  # fmt: skip
    return low, high


def _score(low: FloatArray, high: FloatArray, truth: float, unit: float) -> tuple[float, float]:
    """Per cent of the intervals that cover, and the median width in `unit`; none is a miss of no width."""
    there = ~(np.isnan(low) | np.isnan(high))
    covers = there & (low <= truth) & (truth <= high)
    widths = np.where(there, high, 0.0) - np.where(there, low, 0.0)
    return 100.0 * float(covers.mean()), float(np.median(widths)) / unit
