"""The table of docs/wins.md, from what docs/results/wins holds: numbers and verdicts by the page's own rules.

    python jobs/wins.py            # print the table
    python jobs/wins.py --write    # and put it into docs/wins.md

A world that was not run, or only in small, gets no verdict.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

import space_dist  # noqa: F401 - before NumPy, whose settings it makes

# isort: split
import numpy as np
from kept import SAME, Artefact, Cell, put_between

from space_dist.report.outcomes import paired_difference
from space_dist.report.statistics import (
    Interval,
    paired_ratio,
    probability_of_improvement,
    restricted,
    steps_to_threshold,
)
from space_dist.report.tables import interval_text

ROOT: Final = Path(__file__).resolve().parent.parent
PAGE: Final = ROOT / "docs/wins.md"
BEGIN, END = "<!-- worlds: made by jobs/wins.py -->", "<!-- end of worlds -->"
WORLDS: Final = (
    "gates", "gates_padded", "gates_padded_second", "narrow_padded", "narrow_padded_second", "goalmaze_padded",
)  # fmt: skip
DENSE: Final = "dense"
OURS, BASELINES = "edge", ("round_robin", "uniform")
HALF, SURE = 0.5, 0.95  # of the steps; of P(better), early: a win


def steps(cell: Cell, seeds: list[int], threshold: float) -> np.ndarray:
    """`(n,)` environment steps of each seed until the threshold; those that never reach it count as the budget."""
    times = [steps_to_threshold(*cell.curves[seed], threshold) for seed in seeds]
    return np.asarray(restricted(np.array(times), cell.budget))


def ratio(ours: Cell, theirs: Cell, threshold: float) -> Interval:
    """Of the restricted mean steps to the threshold, seed by seed."""
    seeds = sorted({*ours.curves} & {*theirs.curves})
    return paired_ratio(steps(ours, seeds, threshold), steps(theirs, seeds, threshold))


def early(ours: Cell, theirs: Cell) -> Interval:
    """P(better) of the area under the curve."""
    mine, other = (np.array([*cell.values("early").values()]) for cell in (ours, theirs))
    return probability_of_improvement(mine, other)


def won(ours: Cell, theirs: Cell, threshold: float) -> bool:
    """By the rules of the page."""
    return ratio(ours, theirs, threshold).value <= HALF and early(ours, theirs).value >= SURE


def world_rows(name: str, found: Artefact) -> list[str]:
    """Of one world: a row an arm."""
    threshold = float(found.rows("cells.csv")[0]["threshold"])
    ours = found.cells[OURS]
    verdict = "a win" if all(won(ours, found.cells[arm], threshold) for arm in BASELINES) else "no win"
    lines = []
    for label in (*BASELINES, OURS):
        cell = found.cells[label]
        seeds = sorted(cell.curves)
        taken = steps(cell, seeds, threshold)
        never = sum(np.isnan(steps_to_threshold(*cell.curves[seed], threshold)) for seed in seeds)
        beside = ["", ""]
        if label != OURS:
            beside = [interval_text(ratio(ours, cell, threshold), 2), interval_text(early(ours, cell), 2)]
        worst = found.row("cells.csv", label, "configuration")
        world = f"[`{name}`](results/wins/{name}/report.md), {threshold:g}" if label == BASELINES[0] else ""
        lines.append(
            f"| {world} | {label} "
            f"| {taken.mean():,.0f} | {never} | {' | '.join(beside)} | {interval_text(cell.iqm('early'), 2)} "
            f"| {interval_text(cell.iqm('final'), 2)} | {_interval(worst, 'worst_iqm')} "
            f"| {(f'*{verdict}*' if found.whole else '*not run whole*') if label == OURS else ''} |"
        )
    return lines


def dense_rows(found: Artefact) -> list[str]:
    """Of the world in which nothing is to be won."""
    ours, theirs = (found.cells[label] for label in (OURS, BASELINES[0]))
    seeds = sorted({*ours.curves} & {*theirs.curves})
    finals = [np.array([cell.values("final")[seed] for seed in seeds]) for cell in (ours, theirs)]
    difference = paired_difference(*finals).mean
    margin = SAME * theirs.learned
    if difference.low is not None and difference.low >= -margin:
        verdict = "nothing lost"
    elif difference.value >= -margin:
        verdict = "nothing lost in the mean, and more than that not excluded"
    else:
        verdict = "lost"
    lines = ["| arm | early | final | worst tenth |", "|---|---:|---:|---:|"]
    for label in (*BASELINES, OURS):
        cell = found.cells[label]
        worst = _interval(found.row("cells.csv", label, "configuration"), "worst_iqm")
        lines.append(
            f"| {label} | {interval_text(cell.iqm('early'), 2)} | {interval_text(cell.iqm('final'), 2)} | {worst} |"
        )
    told = "" if found.whole else " Not run whole."
    return [
        *lines, "",
        f"Edge less round robin, final, by seed: {interval_text(difference, 2)}; 5 % of what round robin learned are "
        f"{margin:.2f}: *{verdict}*.{told}",
    ]  # fmt: skip


def _interval(row: dict[str, str], name: str) -> str:
    """From the columns of `cells.csv`."""
    value, low, high = (float(text) if (text := row[f"{name}{end}"]) else None for end in ("", "_low", "_high"))
    return "" if value is None else interval_text(Interval(value, low, high), 2)


def table() -> str:
    """Of the worlds that were run."""
    lines = [
        "| world, threshold | arm | mean steps to it | never | edge's ratio of steps | P(edge better), early | early "
        "| final | worst tenth | |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    folder = ROOT / "docs/results/wins"
    for name in WORLDS:
        if (folder / name / "provenance.json").exists():
            lines += world_rows(name, Artefact(folder / name))
    if (folder / DENSE / "provenance.json").exists():
        lines += ["", f"[`dense`](results/wins/{DENSE}/report.md), return:", "", *dense_rows(Artefact(folder / DENSE))]
    return "\n".join(lines)


def main() -> int:
    """Print, or write."""
    made = table()
    if sys.argv[1:] == ["--write"]:
        put_between(PAGE, BEGIN, END, made)
    else:
        print(made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
