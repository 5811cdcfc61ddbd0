"""The tables of docs/wins.md, from what docs/results/wins holds: numbers and verdicts by the page's own rules.

    python jobs/wins.py            # print the tables
    python jobs/wins.py --write    # and put them into docs/wins.md

A world that was not run, or only in small, gets no verdict.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import space_dist  # noqa: F401 - before NumPy, whose settings it makes

# isort: split
import numpy as np
from kept import SAME, Artefact, Cell, asked_to_write, put_between

from space_dist.experiment.grid_file import load_grid
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
WINS: Final = ROOT / "configs/wins"
FOLDER: Final = ROOT / "docs/results/wins"
WORLDS: Final = (
    "gates", "gates_padded", "gates_padded_second", "narrow_padded", "narrow_padded_second", "goalmaze_padded",
)  # fmt: skip
DENSE: Final = "dense"
SHARES: Final = {"50": "share_50", "75": "gates_padded_second", "90": "share_90"}
WHY: Final = ("rivals", "yoked", "fork")
OURS, BASELINES = "edge", ("round_robin", "uniform")
HALF, SURE = 0.5, 0.95  # of the steps; of P(better), early: a win


@functools.cache
def budget_of(name: str) -> int:
    """Environment steps that each run of a grid may take."""
    path = next(path for path in (WINS / f"{name}.yaml", WINS / f"why/{name}.yaml") if path.exists())
    [budget] = {data["budget"]["steps"] for _, data in load_grid(path)[1]}
    return int(budget)


class World(Artefact):
    """What is kept of a grid; a run that never reaches its threshold counts as its budget."""

    def __init__(self, name: str) -> None:
        super().__init__(FOLDER / name)
        self.budget, first = budget_of(name), self.rows("cells.csv")[0]["threshold"]
        self.threshold = float(first) if first else np.nan

    def times(self, cell: Cell) -> dict[int, float]:
        """Steps to the threshold by seed; NaN for those that never reach it."""
        return {seed: steps_to_threshold(*cell.curves[seed], self.threshold) for seed in sorted(cell.curves)}

    def arrived(self, cell: Cell) -> tuple[float, int]:
        """The mean of the steps, and how many seeds never arrive."""
        times = np.array([*self.times(cell).values()])
        return float(restricted(times, self.budget).mean()), int(np.isnan(times).sum())

    def ratio(self, ours: Cell, theirs: Cell) -> Interval:
        """Of the mean steps, seed by seed."""
        mine, other = self.times(ours), self.times(theirs)
        both = [seed for seed in mine if seed in other]
        return paired_ratio(
            *(restricted(np.array([times[seed] for seed in both]), self.budget) for times in (mine, other))
        )

    def won(self, ours: Cell, theirs: Cell) -> bool:
        """By the rules of the page."""
        return self.ratio(ours, theirs).value <= HALF and early(ours, theirs).value >= SURE


def early(ours: Cell, theirs: Cell) -> Interval:
    """P(better) of the area under the curve."""
    mine, other = (np.array([*cell.values("early").values()]) for cell in (ours, theirs))
    return probability_of_improvement(mine, other)


def world_rows(name: str) -> list[str]:
    """Of one world: a row an arm, of how soon it arrives."""
    found = World(name)
    ours = found.cells[OURS]
    verdict = "a win" if all(found.won(ours, found.cells[arm]) for arm in BASELINES) else "no win"
    lines = []
    for label in (*BASELINES, OURS):
        cell = found.cells[label]
        taken, never = found.arrived(cell)
        beside = ["", f"*{verdict}*" if found.whole else "*not run whole*"]
        if label != OURS:
            beside = [interval_text(found.ratio(ours, cell), 2), interval_text(early(ours, cell), 2)]
        world = f"[`{name}`](results/wins/{name}/report.md), {found.threshold:g}" if label == BASELINES[0] else ""
        lines.append(f"| {world} | {label} | {taken:,.0f} | {never} | {' | '.join(beside)} |")
    return lines


def level_rows(name: str) -> list[str]:
    """Of one world: a row an arm, of how much it learned."""
    found = Artefact(FOLDER / name)
    lines = []
    for label in (*BASELINES, OURS):
        cell = found.cells[label]
        worst = _interval(found.row("cells.csv", label, "configuration"), "worst_iqm")
        lines.append(
            f"| {f'`{name}`' if label == BASELINES[0] else ''} | {label} | {interval_text(cell.iqm('early'), 2)} "
            f"| {interval_text(cell.iqm('final'), 2)} | {worst} |"
        )
    return lines


def dense_verdict(found: Artefact) -> str:
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
    told = "" if found.whole else " Not run whole."
    return (
        f"[`dense`](results/wins/{DENSE}/report.md): edge less round robin, final return, by seed: "
        f"{interval_text(difference, 2)}; 5 % of what round robin learned are {margin:.2f}: *{verdict}*.{told}"
    )


def share_rows() -> list[str]:
    """Of the padded gates, by the share of them that are closed."""
    lines = [
        "| closed | round robin: steps, never | uniform | edge | edge's ratio to round robin | P(edge better), early "
        "| to uniform | P, early |", "|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]  # fmt: skip
    for share, name in SHARES.items():
        if not _kept(name):
            continue
        found = World(name)
        cells = [found.cells[label] for label in (*BASELINES, OURS)]
        told = [f"{taken:,.0f}, {never} of {len(cell.curves)}"
                for cell in cells for taken, never in [found.arrived(cell)]]  # fmt: skip
        for theirs in cells[:2]:
            told += [interval_text(found.ratio(cells[2], theirs), 2), interval_text(early(cells[2], theirs), 2)]
        lines.append(f"| [{share} %](results/wins/{name}/report.md) | {' | '.join(told)} |")
    return lines


def why_rows(name: str) -> list[str]:
    """A row a cell, beside the grid's baseline; none if it was not run."""
    if not _kept(name):
        return []
    found = World(name)
    rows = found.rows("cells.csv")
    label = next(row["configuration"] for row in rows if row["cell"] == row["baseline"])
    baseline = found.cells[label]
    lines = [
        "| | mean steps to it | never | ratio of steps | P(better), early | early | final |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        cell = found.cells[row["configuration"]]
        taken, never = found.arrived(cell)
        beside = "1 | "
        if cell is not baseline:
            beside = f"{interval_text(found.ratio(cell, baseline), 2)} | {interval_text(early(cell, baseline), 2)}"
        lines.append(
            f"| {row['configuration']} | {taken:,.0f} | {never} | {beside} | {interval_text(cell.iqm('early'), 2)} "
            f"| {interval_text(cell.iqm('final'), 2)} |"
        )
    return lines


def _interval(row: dict[str, str], name: str) -> str:
    """From the columns of `cells.csv`."""
    value, low, high = (float(text) if (text := row[f"{name}{end}"]) else None for end in ("", "_low", "_high"))
    return "" if value is None else interval_text(Interval(value, low, high), 2)


def worlds() -> str:
    """Of the worlds that were run: how soon, and how much."""
    lines = [
        "| world, threshold | arm | mean steps to it | never | edge's ratio of steps | P(edge better), early |",
        "|---|---|---:|---:|---:|---:|",
    ]
    kept = [name for name in WORLDS if _kept(name)]
    for name in kept:
        lines += world_rows(name)
    dense = [DENSE] if _kept(DENSE) else []
    lines += ["", "| world | arm | early | final | worst tenth |", "|---|---|---:|---:|---:|"]
    for name in (*kept, *dense):
        lines += level_rows(name)
    return "\n".join([*lines, "", *(dense_verdict(Artefact(FOLDER / name)) for name in dense)]).strip()


def _kept(name: str) -> bool:
    return (FOLDER / name / "provenance.json").exists()


TABLES: Final[Mapping[str, Callable[[], str]]] = {
    "worlds": worlds,
    "shares": lambda: "\n".join(share_rows()),
    **{name: functools.partial(lambda one: "\n".join(why_rows(one)), name) for name in WHY},
}


def main() -> int:
    """Print, or write."""
    write = asked_to_write("the tables of docs/wins.md, made of what `make results` kept")
    for name, made in TABLES.items():
        if write:
            put_between(PAGE, f"<!-- {name}: made by jobs/wins.py -->", f"<!-- end of {name} -->", made())
        else:
            print(f"{name}\n\n{made()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
