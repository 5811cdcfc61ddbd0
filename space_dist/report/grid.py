"""A grid's runs compared: what each cell reached, how much surer and sooner than a baseline, and which are missing.

A cell is compared with its *reference*: the baseline, or, in a grid of several environments or test sets, the
baseline's counterpart there. Returns of different tasks are never pooled or compared.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from space_dist.config import clean, flattened
from space_dist.errors import LedgerError
from space_dist.experiment.endings import Evidence, why_ended
from space_dist.experiment.manifest import Cell, Grid, Manifest
from space_dist.experiment.status import RunStatus, run_statuses
from space_dist.report.figures import HeatMap
from space_dist.report.load import SPLITS, Configuration, FloatArray, Run, load_run, short_names, word
from space_dist.report.statistics import (
    Interval,
    Reach,
    intervals,
    paired_ratio,
    probability_of_improvement,
    restricted,
    start_bound,
    steps_to_threshold,
    stratified,
)
from space_dist.report.tables import Summary, finals, summarise

MAX_MAPS: Final = 24
MAX_POOLED: Final = 200  # settings of which cells are pooled
NOT_COMPARABLE: Final = "not comparable"
MAX_NAMED: Final = 12  # runs that a sentence names


@dataclass(frozen=True, eq=False)
class CellRuns:
    """A cell with all that its runs have left: `run_statuses` are one a seed, `configuration` holds the runs read."""

    cell: Cell
    label: str
    run_statuses: tuple[RunStatus, ...]
    configuration: Configuration
    summary: Summary

    @property
    def finals(self) -> FloatArray:
        """`(n,)` final test returns of the finished seeds."""
        return finals(self.configuration.finished, "test", "return")

    @property
    def task(self) -> str:
        """What its returns are measured on: environment, its arguments, and test instances."""
        env = self.cell.config["env"]
        return json.dumps([env["id"], env.get("kwargs", {}), self.cell.config["instances"]["test"]], sort_keys=True)

    @property
    def caption(self) -> str:
        """Its label, and how many seeds are finished: for figures of these."""
        n = len(self.configuration.finished)
        return f"{self.label} ({n} seed{'s' if n != 1 else ''})"

    @functools.cached_property
    def settings(self) -> dict[str, Any]:
        """Its place on the grid's axes, sections taken apart: `curriculum.kind`, `curriculum.eta`, ..."""
        return dict(flattened(self.cell.settings))

    def times(self, threshold: float) -> dict[int, float]:
        """Per finished seed, the step at which it reached the threshold; NaN if it did not within the budget."""
        found = {
            run.status.seed: steps_to_threshold(run.evaluation_steps, run.test["return"], threshold)
            for run in self.configuration.finished
        }
        return {seed: time if time <= self.cell.budget_steps else math.nan for seed, time in found.items()}


@dataclass(frozen=True)
class Comparison:
    """A cell against its reference.

    reference: None where the cell has none. improvement: probability that a seed of the cell ends above one of the
    reference; None for the reference itself. threshold: a test return; NaN where there is none. reach: when the cell's
    seeds reached it; None if `untestable` says why that cannot be told. ratio: its restricted mean over the
    reference's, both up to the smaller budget, over `pairs` seeds.
    """

    reference: CellRuns | None
    improvement: Interval | None = None
    threshold: float = math.nan
    reach: Reach | None = None
    untestable: str = ""
    ratio: Interval | None = None
    pairs: int = 0


def read_cells(grid: Grid, manifest: Manifest) -> list[CellRuns]:
    """Every cell with its runs, in the manifest's order.

    A run that cannot be read, or is on other instances than its cell's, is a failed one that says why.
    """
    read = [_read(run_status) for run_status in run_statuses(grid, manifest, manifest.code)]
    strangers = _not_comparable([(known.run.cell, run) for run, known in read if run is not None], manifest)
    by_cell: dict[str, list[RunStatus]] = {cell.id: [] for cell in manifest.cells}
    runs: dict[str, list[Run]] = {cell.id: [] for cell in manifest.cells}
    for run, told in read:
        known = told
        reason = None if run is None else strangers.get(run.ledger.folder)
        if reason is not None:  # nothing of it has ended badly, so there is no cause
            known = dataclasses.replace(known, condition="failed", cause=None, detail=f"{NOT_COMPARABLE}: {reason}")
        by_cell[known.run.cell.id].append(known)
        runs[known.run.cell.id] += [] if run is None or reason is not None else [run]
    labels = _labels(manifest.cells)
    configurations = [
        Configuration(labels[cell.id], tuple(runs[cell.id]), len(manifest.seeds_of(cell)) - len(runs[cell.id]))
        for cell in manifest.cells
    ]
    return [
        CellRuns(cell, configuration.label, tuple(by_cell[cell.id]), configuration, summary)
        for cell, configuration, summary in zip(
            manifest.cells, configurations, summarise(configurations), strict=True
        )
    ]  # fmt: skip


def _read(run_status: RunStatus) -> tuple[Run | None, RunStatus]:
    if not run_status.ledger.status_file.exists():
        return None, run_status
    try:
        run = load_run(run_status.ledger, run_status.run.cell.config)
        if run.status.seed != run_status.run.seed:
            raise LedgerError(f"{run_status.ledger.folder} holds a run of seed {run.status.seed}")
    except LedgerError as error:
        if run_status.condition not in ("done", "failed"):  # it is being written, or will be written anew
            return None, dataclasses.replace(run_status, detail=run_status.detail or str(error))
        ended = why_ended(Evidence(damage=str(error)))
        return None, dataclasses.replace(
            run_status,
            condition="failed",
            cause=run_status.cause or ended.cause,
            detail=run_status.detail or ended.detail,
        )
    if run.finished and run_status.condition != "done":  # since we looked
        run_status = dataclasses.replace(run_status, condition="done", cause=None, detail="", steps=run.status.steps)
    return run, run_status


def _not_comparable(runs: Sequence[tuple[Cell, Run]], manifest: Manifest) -> dict[Path, str]:
    """The folders of runs whose numbers are none of their cells', each with why: they are on other instances."""
    reasons: dict[Path, str] = {}
    for split in SPLITS:
        digests: dict[str, dict[Path, str]] = {}  # by the grid's file: of each run's own copy
        for cell, run in runs:
            of_file = digests.setdefault(cell.config["instances"][split], {})
            with contextlib.suppress(LedgerError):  # a copy that is lost says nothing
                of_file[run.ledger.folder] = hashlib.sha256(run.ledger.read(run.ledger.instances(split))).hexdigest()
        for file, found in digests.items():
            if not found:
                continue
            frozen = manifest.instances.get(Path(file).name)
            right = Counter(found.values()).most_common(1)[0][0] if frozen is None else frozen
            reasons |= {
                folder: f"the instances that it was {'trained' if split == 'train' else 'tested'} on are not those of "
                f"the grid ({file})"
                for folder, digest in found.items()
                if digest != right
            }
    for _, run in runs:
        if run.foreign is not None:
            iteration, ids = run.foreign
            some = ", ".join(map(str, ids[:3].tolist())) + (f" and {len(ids) - 3} more" if len(ids) > 3 else "")
            which = "the instance" if len(ids) == 1 else "the instances"
            own = run.ledger.instances("train")
            reasons[run.ledger.folder] = f"iteration {iteration} was trained on {which} {some}, not in {own}"
    return reasons


def _labels(cells: Sequence[Cell]) -> dict[str, str]:
    """Labels that command no terminal; by id where two are alike."""
    labels = {cell.id: clean(cell.label).strip() for cell in cells}
    counts = Counter(labels.values())
    return {
        identity: label if label and counts[label] == 1 else f"{label} {identity}".strip()
        for identity, label in labels.items()
    }


def compare(cells: Sequence[CellRuns], baseline: CellRuns, threshold: float | None = None) -> list[Comparison]:
    """Each cell against its reference. `threshold`: of the test return; None: each reference's final IQM."""
    references = {task: _reference(cells, baseline, task) for task in {cell.task for cell in cells}}
    found = [_compare(cell, references[cell.task], threshold) for cell in cells]
    tested = {number: reach for number, comparison in enumerate(found) if (reach := comparison.reach) is not None}
    means = intervals([restricted(reach.times, reach.budget) for reach in tested.values()], "mean")  # all cells at once
    for (number, reach), interval in zip(tested.items(), means, strict=True):
        found[number] = dataclasses.replace(
            found[number], reach=dataclasses.replace(reach, mean=interval.within(0.0, reach.budget))
        )
    return found


def _reference(cells: Sequence[CellRuns], baseline: CellRuns, task: str) -> CellRuns | None:
    """The baseline, or the one cell of another task that has all of the baseline's other settings."""
    if task == baseline.task:
        return baseline
    method = _method(baseline)
    found = [cell for cell in cells if cell.task == task and _method(cell) == method]
    return found[0] if len(found) == 1 else None


def _method(cell: CellRuns) -> dict[str, Any]:
    """What it does in its task: its settings on the axes, of a base config's the curriculum."""
    settings = {key: value for key, value in cell.settings.items() if not _is_of_task(key)}
    if "extends" in settings:  # each task may have a base config of its own
        settings["extends"] = cell.cell.config.get("curriculum")
    return settings


def _compare(cell: CellRuns, reference: CellRuns | None, threshold: float | None) -> Comparison:
    if reference is None:
        return Comparison(None, untestable="no baseline for this task")
    improvement = None if cell is reference else probability_of_improvement(cell.finals, reference.finals)
    level = reference.summary.test.iqm.value if threshold is None else threshold
    known = Comparison(reference, improvement, level)
    if reason := _untestable(cell, level):
        return dataclasses.replace(known, untestable=reason)
    ours = cell.times(level)
    budget = cell.cell.budget_steps
    known = dataclasses.replace(known, reach=Reach(np.array([*ours.values()]), budget, Interval(math.nan)))
    if cell is reference or _untestable(reference, level):
        return known
    theirs = reference.times(level)
    both = sorted({*ours} & {*theirs})
    common = min(budget, reference.cell.budget_steps)
    pair = [restricted(np.array([times[seed] for seed in both]), common) for times in (ours, theirs)]
    # Where no seed reached it, both means are the budget, and their ratio of 1 would say something that is not known.
    reached = any(bool((times < common).any()) for times in pair)
    return dataclasses.replace(known, ratio=paired_ratio(*pair) if reached else None, pairs=len(both))


def _untestable(cell: CellRuns, threshold: float) -> str:
    """Why steps to a threshold cannot be told for a cell; empty if they can."""
    starts = np.array([run.test["return"][0] for run in cell.configuration.finished if len(run.evaluation_steps)])
    if math.isnan(threshold):
        return "no threshold"
    if not len(starts):
        return "no finished seed"
    if cell.cell.config["budget"].get("episodes") is not None:  # for one that never comes there, no end is everybody's
        ends = [run.status.steps for run in cell.configuration.finished]
        span = f"{min(ends):,}" if min(ends) == max(ends) else f"{min(ends):,} to {max(ends):,}"
        return f"untestable: runs end by episodes (at {span} steps)"
    if len(starts) < 2:
        return "untestable: one seed shows no noise at step 0, more seeds do"
    bound = start_bound(starts)
    if threshold <= bound:
        return f"untestable: within noise of step 0 (up to {bound:.4g})"
    return ""


# ---- settings -------------------------------------------------------------------------------------------------------


def _is_of_task(key: str) -> bool:
    return key.partition(".")[0] in ("env", "instances") and key != "env.context_visible"


def varying(cells: Sequence[CellRuns]) -> list[str]:
    """The settings in which cells differ, in the grid's order."""
    keys = dict.fromkeys(key for cell in cells for key in cell.settings)
    return [
        key for key in keys
        if len({json.dumps(cell.settings[key]) if key in cell.settings else "" for cell in cells}) > 1
    ]  # fmt: skip


def grouped(
    cells: Iterable[CellRuns], keys: Sequence[str], of: Callable[[str], bool] = lambda key: True
) -> dict[tuple[str, ...], list[CellRuns]]:
    """Cells by the values of those of `keys` that `of` chooses, a value as `key=value`; in order of the first cell."""
    names = short_names(keys)
    groups: dict[tuple[str, ...], list[CellRuns]] = {}
    for cell in cells:
        place = tuple(f"{names[key]}={word(cell.settings[key])}" for key in keys if of(key) and key in cell.settings)
        groups.setdefault(place, []).append(cell)
    return groups


@dataclass(frozen=True)
class Pooled:
    """All cells with one setting, pooled; `n_finished` of `n_runs` runs count."""

    setting: str
    n_cells: int
    n_finished: int
    n_runs: int
    iqm: Interval


def pool(cells: Sequence[CellRuns]) -> list[Pooled]:
    """Per setting in which the cells of a grid differ, the IQM over all runs that have it; strata are the cells.

    Empty where every setting has one cell, and where cells differ in task.
    """
    keys = varying(cells)
    if len({cell.task for cell in cells}) > 1:
        return []
    found: list[Pooled] = []
    for key in keys:
        groups = grouped([cell for cell in cells if key in cell.settings], [key])
        if len(groups) < 2 or max(map(len, groups.values())) < 2:
            continue
        name = short_names(keys)[key]
        for group in groups.values():
            if len(found) == MAX_POOLED:
                return found
            strata = [cell.finals for cell in group if len(cell.finals)]
            found.append(
                Pooled(
                    f"{name}={word(group[0].settings[key])}",
                    len(group),
                    sum(map(len, strata)),
                    sum(cell.summary.n_runs for cell in group),
                    stratified(strata) if strata else Interval(math.nan),
                )
            )
    return found


def heat_maps(cells: Sequence[CellRuns]) -> list[HeatMap]:
    """A map of final test returns for each part of a grid that differs in exactly two parameters.

    Parts are the cells of one task, base config, curriculum kind and list: what cannot be laid out along an axis. Two
    parameters that change together span no map.
    """
    keys = varying(cells)
    lists = {key for key in keys for cell in cells if isinstance(cell.settings.get(key), list)}

    def apart(key: str) -> bool:
        return key in ("extends", "curriculum") or key.endswith(".kind") or _is_of_task(key) or key in lists

    maps = []
    for place, group in grouped(cells, keys, apart).items():
        inner = [key for key in varying(group) if not apart(key)]
        if len(inner) == 2 and all(key in cell.settings for key in inner for cell in group):
            across, down = ([*dict.fromkeys(word(cell.settings[key]) for cell in group)] for key in inner)
            if len(group) > max(len(across), len(down)):
                maps.append(_heat_map(place, inner, across, down, group))
    return maps[:MAX_MAPS]


def _heat_map(
    place: tuple[str, ...], keys: Sequence[str], across: list[str], down: list[str], group: Sequence[CellRuns]
) -> HeatMap:
    shape = (len(down), len(across))
    means, spreads = np.full(shape, np.nan), np.full(shape, np.nan)
    seeds = [[""] * len(across) for _ in down]
    for cell in group:
        row, column = down.index(word(cell.settings[keys[1]])), across.index(word(cell.settings[keys[0]]))
        values = cell.finals
        means[row, column] = values.mean() if len(values) else np.nan
        spreads[row, column] = values.std(ddof=1) if len(values) > 1 else np.nan
        seeds[row][column] = f"{len(values)}/{cell.summary.n_runs}"
    names = short_names(keys)
    return HeatMap(", ".join(place), names[keys[0]], names[keys[1]], across, down, means, spreads, seeds)


# ---- what the numbers alone would hide ------------------------------------------------------------------------------


def failures(cells: Sequence[CellRuns]) -> list[tuple[CellRuns, RunStatus]]:
    """Every run that has failed, in the order of cells and seeds."""
    return [
        (cell, run_status) for cell in cells for run_status in cell.run_statuses if run_status.condition == "failed"
    ]


def cause_in_words(run_status: RunStatus) -> str:
    """Why a run that has failed is in no number."""
    if run_status.cause is not None:
        return run_status.cause.in_words
    return NOT_COMPARABLE if not_comparable(run_status) else "unknown"


def not_comparable(run_status: RunStatus) -> bool:
    """Whether it is on other instances than its cell's, see `read_cells`."""
    return run_status.condition == "failed" and run_status.detail.startswith(NOT_COMPARABLE)


def missing(cell: CellRuns) -> str:
    """Which runs of a cell are not counted, and why: `1 failed: out of memory, 2 waiting`."""
    counts = Counter(
        f"{run_status.condition}: {NOT_COMPARABLE}" if not_comparable(run_status) else run_status.in_words
        for run_status in cell.run_statuses
        if run_status.condition != "done"
    )
    return ", ".join(f"{count} {words}" for words, count in counts.items())


def fingerprint_remarks(cells: Sequence[CellRuns], manifest: Manifest) -> list[str]:
    """Which finished runs were made by other code than the manifest's, or on another platform than most."""
    runs = [(cell, run) for cell in cells for run in cell.configuration.finished]
    lines = []
    for field in sorted({field for _, run in runs for field in run.status.fingerprint}):
        values: dict[str, list[tuple[CellRuns, Run]]] = {}
        for cell, run in runs:
            if field in run.status.fingerprint:  # a library that a cell does not use is not in its runs'
                values.setdefault(str(run.status.fingerprint[field]), []).append((cell, run))
        usual = manifest.code if field == "code" else max(values, key=lambda value: len(values[value]))
        whose = "the grid was frozen by" if field == "code" else "most runs have"
        lines += [
            f"Finished by another {field}, and counted all the same: {named(found)} ({field} {clean(value)}; {whose} "
            f"{clean(usual)})."
            for value, found in values.items() if value != usual
        ]  # fmt: skip
    if moved := [(cell, run) for cell, run in runs if run.status.fingerprint_changed]:
        lines.append(f"Resumed with another arithmetic or other library versions, and counted: {named(moved)}.")
    return lines


def coupled_remarks(cells: Sequence[CellRuns]) -> list[str]:
    """Of cells whose runs train several policies under one curriculum: what a sample is."""
    return [
        f"{cell.label}: each run trains {curriculum['policies']} policies that share one curriculum, so they depend on "
        "each other and count as one sample; returns are means over them, steps are those of all."
        for cell in cells
        if (curriculum := cell.cell.config.get("curriculum", {})).get("aggregate") == "population"
    ]


def named(runs: Sequence[tuple[CellRuns, Run]]) -> str:
    """`12 runs: kappa=4 seeds 0, 1; ...`; with very many, the first of them."""
    seeds: dict[str, list[int]] = {}
    for cell, run in runs[:MAX_NAMED]:
        seeds.setdefault(cell.label, []).append(run.status.seed)
    parts = [f"{label} seed{'s' if len(found) > 1 else ''} {', '.join(map(str, found))}"
             for label, found in seeds.items()]  # fmt: skip
    more = f"; and {len(runs) - MAX_NAMED:,} more, all in runs.csv" if len(runs) > MAX_NAMED else ""
    return f"{len(runs):,} run{'s' if len(runs) > 1 else ''}, {'; '.join(parts)}{more}"


def run_folder(grid: Grid, run_status: RunStatus) -> str:
    """A run's folder, relative to the grid's."""
    return Path(run_status.ledger.folder).relative_to(grid.folder).as_posix()
