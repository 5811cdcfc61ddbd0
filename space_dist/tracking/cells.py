"""A grid's cells as curves: over environment steps, the IQM over a cell's seeds and both ends of its 95 % interval.

What a curve is made of is what the report's is made of: the seeds that are done; while there is none, those that are
under way, as far as the slowest of them has been evaluated. So it is a function of the ledgers alone.

MLflow takes no point back. While the same seeds count, a curve only gets longer, and its new points are added. When a
seed is done, and with it others count than before, all points change: then the curve is another one
(`CellCurve.continues`), and begins anew in a run of its own, which takes the old one's place.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from space_dist.errors import LedgerError
from space_dist.ledger import METRICS, TIMING, Ledger
from space_dist.tracking.snapshot import Point

SPLITS: Final = ("test", "train")


@dataclass(frozen=True, eq=False)
class Evaluations:
    """The k committed evaluations of a run, in order of time.

    steps: `(k,)` real environment steps. milliseconds: `(k,)` since the epoch. returns: split -> `(k,)` mean
    undiscounted returns over its instances, NaN where there is no such number.
    """

    steps: NDArray[np.int64]
    milliseconds: NDArray[np.int64]
    returns: Mapping[str, NDArray[np.float64]]

    @classmethod
    def none(cls) -> Evaluations:
        """Of a run that has not got so far."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), {split: np.zeros(0) for split in SPLITS})


def read_evaluations(ledger: Ledger) -> Evaluations:
    """Of a run, from its files. Raises LedgerError if they cannot be read, or not understood."""
    try:
        rows = ledger.rows(METRICS, committed_only=True)
        timing = ledger.rows(TIMING, committed_only=True)  # after the rows: it has one for each of them by now
        pairs = [(row, time) for row, time in zip(rows, timing, strict=False) if row["kind"] == "evaluation"]
        returns = {split: [row[split]["return"] for row, _ in pairs] for split in SPLITS}
        return Evaluations(
            np.array([int(row["steps"]) for row, _ in pairs], dtype=np.int64),
            np.array([round(time["unix_time"] * 1000) for _, time in pairs], dtype=np.int64),
            {split: np.array([np.nan if x is None else x for x in values], dtype=np.float64)
             for split, values in returns.items()},
        )  # fmt: skip
    except OSError as error:
        raise LedgerError(f"{error.filename} cannot be read: {error.strerror}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise LedgerError(f"{ledger.folder / METRICS} has rows that this version cannot read: {error!r}") from None


def curve(done: Sequence[Evaluations], under_way: Sequence[Evaluations]) -> tuple[tuple[Point, ...], ...]:
    """The points of a cell, a tuple for each step, in order.

    done, under_way: its seeds; those that failed are neither. A step's points are the IQM of each split's returns over
    the seeds that count, the ends of its interval where there is one, and how many seeds these are. Between its
    evaluations, and behind its end, a seed counts with the last one. A number that a seed does not have is one that the
    cell does not have. The time of a point is that of its latest evaluation.
    """
    from space_dist.report import confidence_interval, interquartile_mean  # here: Matplotlib, which takes long

    counted = [one for one in done or under_way if len(one.steps)]
    if not counted:
        return ()
    steps = functools.reduce(np.union1d, (one.steps for one in counted))
    # Before a seed's first evaluation the cell has no number of it.
    steps = steps[steps >= max(one.steps[0] for one in counted)]
    if not done:
        steps = steps[steps <= min(one.steps[-1] for one in counted)]
    places = [np.searchsorted(one.steps, steps, side="right") - 1 for one in counted]
    numbers: dict[str, NDArray[np.float64]] = {}
    for split in SPLITS:
        values = np.stack([one.returns[split][place] for one, place in zip(counted, places, strict=True)])
        low, high = confidence_interval(values)
        numbers |= {f"{split}/return_iqm": interquartile_mean(values), f"{split}/return_low": low,
                    f"{split}/return_high": high}  # fmt: skip
    numbers["test/n_seeds"] = np.full(len(steps), float(len(counted)))
    times = np.max([one.milliseconds[place] for one, place in zip(counted, places, strict=True)], axis=0)
    return tuple(
        tuple(Point(name, float(values[k]), int(times[k]), int(steps[k]))
              for name, values in numbers.items() if np.isfinite(values[k]))
        for k in range(len(steps))
    )  # fmt: skip


@dataclass(frozen=True)
class CellCurve:
    """A cell of a grid, as sinks show it: a `Record` whose rows are the steps of its curve."""

    key: str
    title: str
    root: Path
    name: str
    group: str
    params: Mapping[str, str]
    tags: Mapping[str, str]
    mlflow_status: str
    started_at: float
    ended_at: float
    stamp: str
    rows: tuple[tuple[Point, ...], ...]

    @property
    def intent(self) -> str:
        """How many rows there are, and a digest of them."""
        return f"{len(self.rows)} {_digest(self.rows)}"

    def stamped(self, stamp: str) -> CellCurve:
        """The same with its stamp, which may be made of what it holds."""
        return dataclasses.replace(self, stamp=stamp)

    def continues(self, intent: str) -> bool:
        """Whether these rows begin with those that were noted."""
        count, _, digest = intent.partition(" ")
        # People can edit tags; no count has so many digits.
        return count.isdecimal() and len(count) < 16 and digest == _digest(self.rows[: int(count)])

    def points(self, start: int) -> Iterator[tuple[int, Point]]:
        """(rows complete once this is pushed, point) from row `start` on."""
        for index in range(start, len(self.rows)):
            for position, point in enumerate(self.rows[index]):
                yield index + (position + 1 == len(self.rows[index])), point


def _digest(rows: Sequence[Sequence[Point]]) -> str:
    return hashlib.sha256(repr([[tuple(point) for point in row] for row in rows]).encode()).hexdigest()[:32]
