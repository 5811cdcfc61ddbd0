"""The claims of docs/results.md against what docs/results holds: numbers, words and verdicts by the page's own rules.

    python jobs/claims.py            # print the table
    python jobs/claims.py --write    # and put it into docs/results.md

A claim whose grid was not run, or only in small, gets no verdict.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final, Literal

import space_dist  # noqa: F401 - before NumPy, whose settings it makes

# isort: split
import numpy as np
from kept import SAME, Artefact, Cell, Measure, asked_to_write, put_between

from space_dist.report.outcomes import paired_difference
from space_dist.report.statistics import (
    Interval,
    paired_ratio,
    probability_of_improvement,
    restricted,
    start_bound,
    steps_to_threshold,
)
from space_dist.report.tables import NONE, interval_text, number_text

ROOT: Final = Path(__file__).resolve().parent.parent
PAGE: Final = ROOT / "docs/results.md"
BEGIN, END = "<!-- claims: made by jobs/claims.py -->", "<!-- end of claims -->"

Verdict = Literal["holds", "holds in part", "does not hold here", "not tested at full scale"]


@dataclass(frozen=True)
class Part:
    """A part of a claim: what was measured, in words; whether it is seen, and whether its contrary is."""

    text: str
    seen: bool
    contradicted: bool = False


# ---- words ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Compared:
    """A cell beside another by one measure, both intervals of P(better) and of the difference by seed."""

    improvement: Interval
    difference: Interval
    p: float
    text: str

    @property
    def better(self) -> bool:
        return _above(self.improvement, 0.5) and _above(self.difference, 0.0)

    @property
    def worse(self) -> bool:
        return _below(self.improvement, 0.5) and _below(self.difference, 0.0)


def compared(ours: Cell, theirs: Cell, measure: Measure = "final", at: int | None = None) -> Compared:
    """The words `better` and `worse` of the page."""
    mine, other = ours.values(measure, at), theirs.values(measure, at)
    both = sorted({*mine} & {*other})
    pairs = [np.array([values[seed] for seed in both]) for values in (mine, other)]
    improvement = probability_of_improvement(np.array([*mine.values()]), np.array([*other.values()]))
    found = paired_difference(*pairs)
    when = measure if at is None else f"at {at:,} steps"
    p = NONE if math.isnan(found.p) else f"{found.p:.2g}"
    text = (
        f"{when} {interval_text(ours.iqm(measure, at))} against {interval_text(theirs.iqm(measure, at))}, P(better) "
        f"{interval_text(improvement, 2)}, difference {interval_text(found.mean)}, p = {p} ({found.n} seeds)"
    )
    return Compared(improvement, found.mean, found.p, text)


def same(ours: Cell, theirs: Cell, measure: Measure = "final") -> tuple[bool, Compared]:
    """Whether the interval of the difference lies within the margin."""
    found, margin = compared(ours, theirs, measure), SAME * theirs.learned
    return _above(found.difference, -margin) and _below(found.difference, margin), found


def ratio(ours: Cell, theirs: Cell) -> Interval | None:
    """Of the steps until the other's final level; None where that is within noise of step 0, or nobody reaches it."""
    level = theirs.iqm().value
    if any(
        level <= start_bound(np.array([returns[0] for _, returns in cell.curves.values()])) for cell in (ours, theirs)
    ):
        return None
    both = sorted({*ours.curves} & {*theirs.curves})
    budget = min(ours.budget, theirs.budget)
    times = [
        restricted(np.array([steps_to_threshold(*cell.curves[seed], level) for seed in both]), budget)
        for cell in (ours, theirs)
    ]
    return paired_ratio(*times) if any((one < budget).any() for one in times) else None


def _known(found: Interval) -> bool:
    """Whether there are seeds enough for an interval: without one nothing is seen."""
    return found.low is not None


def _above(found: Interval, bound: float) -> bool:
    return found.low is not None and found.low > bound


def _below(found: Interval, bound: float) -> bool:
    return found.high is not None and found.high < bound


def _ratio_text(found: Interval | None) -> str:
    return "steps to its final level: not comparable" if found is None else f"steps ratio {interval_text(found, 2)}"


def better(ours: Cell, theirs: Cell, measure: Measure = "final", at: int | None = None, who: str = "") -> Part:
    """A claim that one is better than the other."""
    found = compared(ours, theirs, measure, at)
    return Part(f"{who}{found.text}", found.better, found.worse)


def worse(ours: Cell, theirs: Cell, measure: Measure = "final", at: int | None = None, who: str = "") -> Part:
    """A claim that one is worse than the other."""
    found = compared(ours, theirs, measure, at)
    return Part(f"{who}{found.text}", found.worse, found.better)


def alike(ours: Cell, theirs: Cell, measure: Measure = "final", who: str = "") -> Part:
    """A claim that both are the same."""
    seen, found = same(ours, theirs, measure)
    return Part(f"{who}{found.text}", seen, found.better or found.worse)


def faster(ours: Cell, theirs: Cell, times: float = 1.0, who: str = "") -> Part:
    """A claim that one needs so many times fewer steps until the other's final level."""
    found = ratio(ours, theirs)
    if found is None:
        return Part(f"{who}{_ratio_text(found)}", seen=False)
    seen = _below(found, 1.0) and found.value <= 1.0 / times
    return Part(f"{who}{_ratio_text(found)}", seen, _above(found, 1.0))


Claim = Callable[[Artefact], list[Part]]

# ---- claims ---------------------------------------------------------------------------------------------------------

ROBIN, SPACE, CSPACE = "round_robin", "space eta=0.1 kappa=1", "cspace eta=0.1 kappa=1"


def _cartpole_learning(found: Artefact) -> list[Part]:
    ours, theirs = found.cells["space eta=0.025 kappa=1"], found.cells[ROBIN]
    return [better(ours, theirs, measure) for measure in ("final", "early")]


def _cartpole_poles(found: Artefact) -> list[Part]:
    label = "space eta=0.025 kappa=1"
    stretch = float(found.row("curricula.csv", label)["stretch_median"])
    shares = [float(row["share_of_first_40_episodes"]) for row in found.rows("inclusion.csv") if row["label"] == label]
    return [
        Part(f"a set stays for {number_text(stretch, 1)} iterations in the median", stretch >= 3.0),
        Part(f"the long pole has {100 * shares[2]:.0f} % of the first 40 episodes (short {100 * shares[0]:.0f} %, "
             f"medium {100 * shares[1]:.0f} %)", shares[2] < 1 / 6),
    ]  # fmt: skip


def _same_and_ten_times_faster(found: Artefact) -> list[Part]:
    ours, theirs = found.cells[SPACE], found.cells[ROBIN]
    return [alike(ours, theirs), faster(ours, theirs, 10.0)]


def _uniform(found: Artefact) -> list[Part]:
    ours, theirs = found.cells[SPACE], found.cells[ROBIN]
    return [faster(ours, theirs), better(ours, theirs)]


def _spdrl(found: Artefact) -> list[Part]:
    (ours,) = (cell for label, cell in found.cells.items() if label.startswith("spdrl"))
    return [worse(ours, found.cells[ROBIN], measure) for measure in ("early", "final")]


def _cspace(found: Artefact) -> list[Part]:
    ours, other, theirs = (found.cells[label] for label in (SPACE, CSPACE, ROBIN))
    return [
        *(alike(ours, other, measure, "SPaCE against cSPaCE, ") for measure in ("final", "early")),
        better(ours, theirs, who="SPaCE against round robin, "),
        better(other, theirs, who="cSPaCE against round robin, "),
    ]


def _mazes(found: Artefact) -> list[Part]:
    (ours,), (theirs,) = (
        [cell for label, cell in found.cells.items() if label.endswith(f" {kind}") and "1000" not in label]
        for kind in (SPACE, ROBIN)
    )
    return [better(ours, theirs, "early"), faster(ours, theirs)]


def _multiply(found: Artefact) -> list[Part]:
    one = found.cells[SPACE]
    return [worse(cell, one, "early", who=f"{label}: ") for label, cell in found.cells.items() if "multiply" in label]


def _similar_curricula(found: Artefact) -> list[Part]:
    parts = []
    for label, name in ((SPACE, "SPaCE"), (CSPACE, "cSPaCE")):
        least = float(found.row("curricula.csv", label)["tau_with_others_least"])
        parts.append(Part(f"{name}: least tau with the other seeds {least:.2f}", least >= 0.9))
    (tau,) = (
        float(row["tau"])
        for row in found.rows("agreement.csv")
        if {row["label"], row["other_label"]} == {SPACE, CSPACE}
    )
    return [*parts, Part(f"tau between the two {tau:.2f}", abs(tau) <= 0.2)]


def _shift(found: Artefact) -> list[Part]:
    ours, other = (found.row("curricula.csv", label) for label in (SPACE, CSPACE))
    mean, theirs = (100.0 * float(row["shift_mean"]) for row in (ours, other))
    most, their_most = (100.0 * float(row["shift_most"]) for row in (ours, other))
    text = (
        f"{mean:.1f} % an iteration (SPaCE; at most {most:.1f} %), {theirs:.1f} % (cSPaCE; at most {their_most:.1f} %)"
    )
    return [Part(text, mean < 10.0 and mean < theirs)]


def _places(found: Artefact) -> list[Part]:
    parts = []
    for label, name in ((SPACE, "SPaCE"), (CSPACE, "cSPaCE")):
        changes = float(found.row("curricula.csv", label)["rank_changes_mean"])
        parts.append(Part(f"{name}: {changes:.0f} instances change places", changes <= 4.0))
    return parts


def _forgetting(found: Artefact) -> list[Part]:
    parts, intervals = [], []
    for label, name in ((SPACE, "SPaCE"), (ROBIN, "round robin")):
        row = found.row("forgetting.csv", label)
        value, low, high = (row[f"forgotten_10_percent{end}"] for end in ("", "_low", "_high"))
        one = Interval(float(value), *(float(end) if end else None for end in (low, high)))
        intervals.append(one)
        parts.append(Part(f"{name}: {interval_text(one, 1)} of 100", one.value < 15.0))
    apart = _above(intervals[0], intervals[1].high or np.inf) or _above(intervals[1], intervals[0].high or np.inf)
    return [*parts, Part("intervals apart" if apart else "not told apart", not apart)]


def _pooled(cells: Mapping[str, Cell], setting: str) -> Cell:
    """All cells with a setting as one, whose seeds are (the other setting, seed), numbered."""
    chosen = [cell for label, cell in cells.items() if setting in label.split()]
    curves = {100 * seed + i: curve for i, cell in enumerate(chosen) for seed, curve in cell.curves.items()}
    return Cell(setting, curves, chosen[0].budget)


def _little_difference(found: Artefact) -> list[Part]:
    parts = []
    for name, values in (("kappa", ("1", "4", "16", "32")), ("eta", ("0.05", "0.1", "0.2", "0.4"))):
        pooled = [_pooled(found.cells, f"{name}={value}") for value in values]
        pairs = [(*same(ours, theirs), ours, theirs) for theirs, ours in combinations(pooled, 2)]
        _, most, ours, theirs = max(pairs, key=lambda pair: abs(pair[1].difference.value))
        levels = ", ".join(f"{cell.label} {interval_text(cell.iqm())}" for cell in pooled)
        parts.append(
            Part(
                f"{levels}; furthest apart {ours.label} and {theirs.label}: difference "
                f"{interval_text(most.difference)}, where the same is within {number_text(SAME * theirs.learned)}",
                all(alike for alike, *_ in pairs),
                any(not alike and (pair.better or pair.worse) for alike, pair, *_ in pairs),
            )
        )
    return parts


def _sizes(found: Artefact) -> list[Part]:
    cells = {
        size: found.cells[f"train=../instances/pointmass_sizes_train_{size}.csv {SPACE}"]
        for size in (25, 50, 100, 200, 400, 800, 1600)
    }
    hundred = cells[100]
    fewer = [worse(cells[size], hundred, who=f"{size} against 100, ") for size in (25, 50)]
    return fewer + [alike(cells[size], hundred, who=f"{size} against 100, ") for size in (200, 400, 800, 1600)]


def _vds(found: Artefact) -> list[Part]:
    ours, theirs = found.cells['vds members_see=["goal_x","goal_y"]'], found.cells[ROBIN]
    ends, starts = ([returns[at] for _, returns in ours.curves.values()] for at in (-1, 0))
    gained = paired_difference(np.array(ends), np.array(starts)).mean
    above = _above(gained, 0.0)
    return [
        worse(ours, theirs),
        Part(f"VDS's final less its first {interval_text(gained)}", _known(gained) and not above, above),
    ]


def _ant_curricula(found: Artefact) -> list[Part]:
    taus = {
        label: [float(found.row("curricula.csv", label)[f"tau_with_others_{end}"]) for end in ("least", "most")]
        for label in (SPACE, CSPACE)
    }
    (low, high), (least, _) = taus[SPACE], taus[CSPACE]
    return [
        Part(f"SPaCE: tau with the other seeds {low:.2f} to {high:.2f}", low >= 0.1 and high <= 0.6),
        Part(f"cSPaCE: least tau with the other seeds {least:.2f}", least >= 0.9),
    ]


def _target(rate: str) -> Claim:
    def claim(found: Artefact) -> list[Part]:
        cells = {label: cell for label, cell in found.cells.items() if f"learning_rate={rate} " in label}
        (ours,), (space,), (robin,) = (
            [cell for label, cell in cells.items() if kind in label] for kind in ("spdrl", SPACE, ROBIN)
        )
        others = {"SPDRL against SPaCE, ": space, "SPDRL against round robin, ": robin}
        early = [worse(ours, other, at=200_000, who=who) for who, other in others.items()]
        return early + [better(ours, other, who=who) for who, other in others.items()]

    return claim


CLAIMS: Final[Mapping[str, tuple[str, Claim]]] = {
    "C1": ("cartpole", _cartpole_learning),
    "C2": ("cartpole", _cartpole_poles),
    "C3": ("ant", _same_and_ten_times_faster),
    "C4": ("ball_catching", _same_and_ten_times_faster),
    "C5 (PPO)": ("pointmass_uniform", _uniform),
    "C5 (TRPO)": ("pointmass_uniform_trpo", _uniform),
    "C6 (PPO)": ("pointmass_uniform", _spdrl),
    "C6 (TRPO)": ("pointmass_uniform_trpo", _spdrl),
    "C7 (PPO)": ("pointmass_uniform", _cspace),
    "C7 (TRPO)": ("pointmass_uniform_trpo", _cspace),
    "C8": ("maze", _mazes),
    "C9 (PPO)": ("pointmass_table1", _little_difference),
    "C9 (TRPO)": ("pointmass_table1_trpo", _little_difference),
    "C10": ("pointmass_multiply", _multiply),
    "C11": ("ant_vds", _vds),
    "C12 (learning rate 3e-4)": ("pointmass_target", _target("0.0003")),
    "C12 (learning rate 3e-5)": ("pointmass_target", _target("3e-05")),
    "C13": ("pointmass_sizes", _sizes),
    "C14 (PPO)": ("pointmass_uniform", _similar_curricula),
    "C14 (TRPO)": ("pointmass_uniform_trpo", _similar_curricula),
    "C15": ("ant", _ant_curricula),
    "C16 (PPO)": ("pointmass_uniform", _shift),
    "C16 (TRPO)": ("pointmass_uniform_trpo", _shift),
    "C17 (PPO)": ("pointmass_uniform", _places),
    "C17 (TRPO)": ("pointmass_uniform_trpo", _places),
    "C18 (PPO)": ("pointmass_uniform", _forgetting),
    "C18 (TRPO)": ("pointmass_uniform_trpo", _forgetting),
    "C18 (only the goal varies)": ("pointmass_goal", _forgetting),
}


def verdict(parts: list[Part], *, whole: bool) -> Verdict:
    """By the page's rules."""
    if not whole:
        return "not tested at full scale"
    if all(part.seen for part in parts):
        return "holds"
    if any(part.contradicted for part in parts) or not any(part.seen for part in parts):
        return "does not hold here"
    return "holds in part"


def most_of(grid: str) -> Artefact | None:
    """What is kept of a grid: all of it, or else the most that was run of it in small; None where nothing is."""
    folders = [ROOT / "docs/results" / grid, *(ROOT / "docs/results").glob(f"{grid}-scale-*")]
    found = [Artefact(folder) for folder in folders if (folder / "provenance.json").exists()]
    return max(found, key=lambda artefact: artefact.scale, default=None)


def table() -> str:
    """Of the claims whose grid was run: what came out, and the verdict."""
    lines = ["| | What came out | Verdict |", "|---|---|---|"]
    for name, (grid, claim) in CLAIMS.items():
        if (found := most_of(grid)) is None:
            continue
        parts = claim(found)
        told = "; ".join(part.text + (" ✓" if part.seen else " ✗" if part.contradicted else "") for part in parts)
        small = "" if found.whole else f", scale {found.scale:g}"
        lines.append(
            f"| [{name}{small}](results/{found.folder.name}/report.md) | {told} "
            f"| *{verdict(parts, whole=found.whole)}* |"
        )
    return "\n".join(lines)


def main() -> int:
    """Print, or write."""
    if asked_to_write("the table of docs/results.md, made of what `make results` kept"):
        put_between(PAGE, BEGIN, END, table())
    else:
        print(table())
    return 0


if __name__ == "__main__":
    sys.exit(main())
