"""What curricula are compared by: return early, at the end, and on the worst instances, paired by seed.

A cell's runs share its reference's seeds, and with them the initial weights and the order in which instances come, so
differences are taken seed by seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from space_dist.report.document import Section
from space_dist.report.grid import CellRuns, Comparison
from space_dist.report.load import Run
from space_dist.report.outcomes import PairedDifference, area, cross_worst_mean, paired_difference
from space_dist.report.statistics import Estimate, Interval, estimates, probability_of_improvement
from space_dist.report.tables import NONE, Value, interval_numbers, interval_text, share_text

WORST: Final = 0.1  # of the held-out instances
MEASURES: Final[Mapping[str, str]] = {
    "early": "Early: area under the curve of the return on the held-out instances",
    "final": "Late: final return on the held-out instances",
    "worst": "Worst tenth of the held-out instances at the end",
}


@dataclass(frozen=True)
class Measured:
    """One measure of a cell: the IQM over its finished seeds, and how it compares with the reference, by seed.

    n, against: seeds, and those of the reference, which has `against_of` in all. improvement, difference: None for the
    reference itself, and where there is none.
    """

    n: int
    iqm: Interval
    against: int = 0
    against_of: int = 0
    improvement: Interval | None = None
    difference: PairedDifference | None = None


def measured(cells: Sequence[CellRuns], compared: Sequence[Comparison]) -> list[dict[str, Measured]]:
    """Every measure of every cell."""
    ends = {task: _last_step([cell for cell in cells if cell.task == task]) for task in {cell.task for cell in cells}}
    values = {cell.cell.id: {name: _values(cell, name, ends[cell.task]) for name in MEASURES} for cell in cells}
    iqms = {name: estimates([np.array([*values[cell.cell.id][name].values()]) for cell in cells]) for name in MEASURES}
    found = []
    for place, (cell, comparison) in enumerate(zip(cells, compared, strict=True)):
        reference = comparison.reference
        theirs = {} if reference is None or reference is cell else values[reference.cell.id]
        of = 0 if reference is None else reference.summary.n_runs
        found.append(
            {name: _measured(iqms[name][place], values[cell.cell.id][name], theirs.get(name), of) for name in MEASURES}
        )
    return found


def _measured(known: Estimate, ours: Mapping[int, float], theirs: Mapping[int, float] | None, of: int) -> Measured:
    """One measure, by seed, beside the reference's, which has `of` seeds in all; None: there is no reference."""
    if theirs is None:
        return Measured(known.n, known.iqm)
    both = sorted({*ours} & {*theirs})
    pairs = [np.array([values[seed] for seed in both]) for values in (ours, theirs)]
    return Measured(
        known.n,
        known.iqm,
        len(theirs),
        of,
        probability_of_improvement(np.array([*ours.values()]), np.array([*theirs.values()])),
        paired_difference(*pairs) if both else None,
    )


def _last_step(cells: Sequence[CellRuns]) -> int:
    """Where the longest of a task's finished runs ended: those that end by episodes never use up their steps."""
    last = [run.evaluation_steps[-1] for cell in cells for run in cell.configuration.finished if run.evaluated_at_end]
    return int(max(last, default=1))


def _values(cell: CellRuns, name: str, last: int) -> dict[int, float]:
    """One measure, by finished seed; without those that have no such number."""
    runs = [run for run in cell.configuration.finished if run.evaluated_at_end]
    values = {run.status.seed: measure_of(run, name, last) for run in runs}
    return values if name != "worst" else {seed: value for seed, value in values.items() if not math.isnan(value)}


def measure_of(run: Run, name: str, last: int) -> float:
    """One of MEASURES of a finished run; NaN where it has no such number. last: the step up to which areas reach."""
    if name == "early":
        return area(run.evaluation_steps, run.test["return"], last)
    if name == "final":
        return run.last("test", "return")
    halves = run.final_halves("test")
    return math.nan if halves is None else cross_worst_mean(halves, WORST)


# ---- tables ---------------------------------------------------------------------------------------------------------


def measure_sections(
    cells: Sequence[CellRuns], names: Sequence[str], found: Sequence[Mapping[str, Measured]]
) -> list[Section]:
    """A table a measure, but of the final return, which has one already; `names` are the cells' in tables.

    The worst tenth only where any cell has it.
    """
    sections = []
    for name, title in MEASURES.items():
        if name == "final" or not any(row[name].n for row in found):
            continue
        rows = [
            {
                "cell": label,
                "IQM [95 %]": f"{interval_text(row[name].iqm)} ({row[name].n}/{cell.summary.n_runs})",
                "P(better) [95 %]": _improvement(row[name], cell.summary.n_runs),
                **paired_cell(row[name], cell.summary.n_runs),
            }
            for cell, label, row in zip(cells, names, found, strict=True)
        ]
        sections.append(Section(title, rows=rows))
    return sections


def paired_cell(found: Measured, n_seeds: int) -> dict[str, str]:
    """A column of a table: the difference by seed, and its test, and on how many of the cell's seeds they rest."""
    pairs = found.difference
    if pairs is None:
        return {"difference by seed [95 %], Wilcoxon p": NONE}
    p = NONE if math.isnan(pairs.p) else f"{pairs.p:.3g}"
    text = f"{interval_text(pairs.mean)}, {p} ({share_text(pairs.n, n_seeds, 'pair')})"
    return {"difference by seed [95 %], Wilcoxon p": text}


def _improvement(found: Measured, n_seeds: int) -> str:
    if found.improvement is None:
        return NONE
    rests_on = against_in_words(found.n, n_seeds, found.against, found.against_of)
    return f"{interval_text(found.improvement, 2)} ({rests_on})"


def against_in_words(ours: int, of_ours: int, theirs: int, of_theirs: int) -> str:
    """`9/10 seeds against 10/10`: on how many of a cell's and its reference's seeds a comparison rests."""
    return f"{share_text(ours, of_ours, 'seed')} against {theirs}/{of_theirs}"


def measure_numbers(found: Mapping[str, Measured]) -> dict[str, Value]:
    """For CSV."""
    row: dict[str, Value] = {}
    for name in MEASURES:
        one = found[name]
        none = Interval(math.nan)
        row |= {f"{name}_seeds": one.n, **interval_numbers(f"{name}_iqm", one.iqm)}
        row |= interval_numbers(f"{name}_probability_of_improvement", one.improvement or none)
        row |= interval_numbers(f"{name}_difference", none if one.difference is None else one.difference.mean)
        row |= {f"{name}_pairs": 0 if one.difference is None else one.difference.n}
        row |= {f"{name}_wilcoxon_p": None if one.difference is None else one.difference.p}
    return row
