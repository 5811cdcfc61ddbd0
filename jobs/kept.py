"""What `make results` keeps of a grid in docs/results, read again: the seeds' curves, and what is told of them."""

from __future__ import annotations

import csv
import json
import signal
import sys
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Final, Literal

import space_dist  # noqa: F401 - before NumPy, whose settings it makes

# isort: split
import numpy as np
from numpy.typing import NDArray

from space_dist.report.outcomes import area
from space_dist.report.statistics import Interval, estimate
from space_dist.system.files import atomic_write

FloatArray = NDArray[np.float64]
Measure = Literal["early", "final"]

SAME: Final = 0.05  # of what the baseline learned


def asked_to_write(what: str) -> bool:
    """Whether the command line says `--write`, not nothing. Ends the process for anything else, and for `--help`."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # whoever reads may leave: `| head`
    words = sys.argv[1:]
    if words in ([], ["--write"]):
        return bool(words)
    usage = f"usage: python jobs/{Path(sys.argv[0]).name} [--write]: print {what}, or write it there"
    if words in (["--help"], ["-h"]):
        print(usage)
        sys.exit(0)
    print(f"{words[0] if words[0] != '--write' else words[1]!r} is not known. {usage}", file=sys.stderr)
    sys.exit(2)


class Cell:
    """One cell's finished runs, as `seeds.csv` has them."""

    def __init__(self, label: str, curves: Mapping[int, tuple[NDArray[np.int64], FloatArray]], budget: int) -> None:
        self.label, self.curves, self.budget = label, curves, budget

    def values(self, measure: Measure, at: int | None = None) -> dict[int, float]:
        """By seed: the mean over training, or the return at a step (the last evaluation up to it); None: at the end."""
        found = {}
        for seed, (steps, returns) in self.curves.items():
            if measure == "early":
                found[seed] = area(steps, returns, self.budget)
            else:
                found[seed] = float(returns[-1 if at is None else np.searchsorted(steps, at, side="right") - 1])
        return found

    def iqm(self, measure: Measure = "final", at: int | None = None) -> Interval:
        """Over seeds."""
        return estimate(np.array([*self.values(measure, at).values()])).iqm

    @cached_property
    def learned(self) -> float:
        """Final less first IQM."""
        first = estimate(np.array([returns[0] for _, returns in self.curves.values()])).iqm
        return self.iqm().value - first.value


class Artefact:
    """The folder of a grid in docs/results."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.provenance = json.loads((self.folder / "provenance.json").read_text())
        curves: dict[str, dict[int, list[tuple[int, float]]]] = {}
        for row in self.rows("seeds.csv"):
            seeds = curves.setdefault(row["label"], {})
            seeds.setdefault(int(row["seed"]), []).append((int(row["steps"]), float(row["test_return"])))
        last = max(points[-1][0] for seeds in curves.values() for points in seeds.values())  # of the longest run
        self.cells = {
            label: Cell(
                label,
                {seed: (np.array([step for step, _ in points]), np.array([value for _, value in points]))
                 for seed, points in seeds.items()},
                last,
            )
            for label, seeds in curves.items()
        }  # fmt: skip

    @property
    def scale(self) -> float:
        """The share of the grid's seeds and steps that was run."""
        return float(self.provenance["scale"])

    @property
    def whole(self) -> bool:
        """Whether all seeds and steps of the grid were run."""
        return self.scale == 1.0

    def rows(self, name: str) -> list[dict[str, str]]:
        """A CSV file's."""
        with (self.folder / name).open(newline="") as file:
            return list(csv.DictReader(file))

    def row(self, name: str, label: str, column: str = "label") -> dict[str, str]:
        """Of a cell; `column` is the one that holds labels."""
        return next(row for row in self.rows(name) if row[column] == label)


def put_between(page: Path, begin: str, end: str, made: str) -> None:
    """Put what was made into a page, between two marks. Raises ValueError if the page does not have them, in order."""
    before, found, rest = page.read_text().partition(begin)
    if not found or end not in rest:
        raise ValueError(f"{page} lacks {begin!r} and, behind it, {end!r}")
    atomic_write(page, f"{before}{begin}\n\n{made}\n\n{end}{rest.partition(end)[2]}".encode())
