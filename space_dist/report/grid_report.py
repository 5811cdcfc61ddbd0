"""The report of a grid: its tables, figures and caveats in Markdown, in CSV, and as one HTML page."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from space_dist.config import clean
from space_dist.errors import ConfigError
from space_dist.experiment import scaling
from space_dist.experiment.manifest import Grid, Manifest
from space_dist.report.curricula import (
    CellCurricula,
    agreement_rows,
    curricula_of,
    curriculum_rows,
    curriculum_sections,
    inclusion_rows,
)
from space_dist.report.document import Document, Picture, Section, to_html, to_markdown, writing_to
from space_dist.report.figures import COLOURS, HeatMap, Panel, draw_comparison, draw_heat_map, draw_panels, png
from space_dist.report.grid import (
    CellRuns,
    Comparison,
    cause_in_words,
    compare,
    coupled_remarks,
    failures,
    fingerprint_remarks,
    grouped,
    heat_maps,
    missing,
    not_comparable,
    pool,
    read_cells,
    run_folder,
    varying,
)
from space_dist.report.instances import forgetting_rows, instance_sections
from space_dist.report.load import Configuration
from space_dist.report.measures import (
    Measured,
    against_in_words,
    measure_numbers,
    measure_sections,
    measured,
    paired_cell,
)
from space_dist.report.released import released_section
from space_dist.report.statistics import FEWEST, Interval, estimate
from space_dist.report.tables import (
    NONE,
    Value,
    caveats,
    few_seeds,
    interval_numbers,
    interval_text,
    number_text,
    numbers,
    reached_text,
    share_text,
    size_text,
    steps_text,
    to_csv,
)
from space_dist.system.files import atomic_write, read_file

MAX_DRAWN: Final = 48  # cells with a learning curve
MAX_LISTED: Final = 100  # failures, remarks
MAX_ANALYSED: Final = 48  # cells whose instances and curricula are looked at one by one
_CURVES_PER_PANEL: Final = 6
_MAX_REPORT_BYTES: Final = 16 << 20
_TITLE: Final = "Grid"
_METHOD: Final = tuple(
    " ".join(paragraph.split())
    for paragraph in f"""
Round brackets say how many of a cell's seeds a number rests on: (9/10) are nine finished seeds of ten, and (9/10 seeds
against 10/10) are compared with all ten of the baseline. Runs that are not finished count in no number.

Final returns are undiscounted means over the held-out (test) instances at each finished run's last step. IQM:
interquartile mean over seeds (below four seeds the plain mean). Intervals in square brackets are to cover 95 %: from
Student's t and winsorised values, over the seeds of a cell; where cells are pooled, from the spread within each cell
(stratified). Below {FEWEST} seeds, where seeds do not differ, and where a final return is no number, there is none.

P(better) is the probability that a seed of the cell ends above a seed of the baseline, over all pairs of seeds, a tie
counting one half; its interval is that of Newcombe (2006), method 5, with Student's t.

A threshold is reached at the first of three consecutive evaluations of the test return at or above it. Seeds that do
not reach it within their budget are censored: they count as the budget in the restricted mean, which is a lower bound
of the mean where seeds are censored. The ratio is the cell's restricted mean over the baseline's (0.5: in half of the
steps), both up to the smaller budget; its interval is of pairs of seeds, and the threshold is held fixed. Untestable:
the threshold lies within noise of step 0, that is not above the 97.5 % prediction bound (mean + t s sqrt(1 + 1/n)) of
one more untrained seed; or runs end by episodes, and have no last step in common.

Early is the area under the curve of the return on the held-out instances over environment steps (trapezoid), up to
where the longest run of the same task ended, divided by that: the mean return over training. The worst tenth (CVaR) are
the held-out instances of least final return, chosen on one half of the evaluation episodes and measured on the other,
both ways, and needs evaluation.episodes of two or more. Differences are taken seed by seed, with Student's t; p is of
the two-sided Wilcoxon signed-rank test.

Curves are IQMs over the finished seeds (while a cell has none, over unfinished ones, which its label says) with the
same intervals as bands. Steps are real environment steps of training.""".split("\n\n")
)


@dataclass(frozen=True)
class GridReport:
    """What `build_grid_report` wrote into `folder`: report.md, report.html, cells.csv, runs.csv and PNG figures.

    `summary` are sentences: how complete the grid is, and what cells are compared with. `table` has a dict (column ->
    text) a cell, with the same columns in all; `remarks` are sentences that belong below it.
    """

    folder: Path
    summary: list[str]
    table: list[dict[str, str]]
    remarks: list[str]
    markdown: str


def build_grid_report(
    grid: Grid, out: Path | None = None, *, baseline: str | None = None, threshold: float | None = None,
    in_depth: bool = True,
) -> GridReport:  # fmt: skip
    """Report on a grid as it stands, finished or not; `out` is by default `report` in the grid's folder.

    baseline: label of a cell, or the start of its id; None: the manifest's. threshold: a test return; None: the
    manifest's, else the baseline's final IQM. in_depth: look at curricula and at each instance as well, which takes
    seconds. Raises ConfigError for an unknown baseline, a threshold that is no finite number, or if `out` cannot be
    written to; LedgerError if the manifest is missing or damaged.
    """
    if threshold is not None and not math.isfinite(threshold):
        raise ConfigError(f"--threshold must be a finite number, not {threshold}")
    manifest = grid.manifest()
    if manifest.search is not None:  # whose best cell is the luckiest, on the instances that chose it: no result
        raise ConfigError(f"{grid.folder} holds a search: space-dist tune report {grid.folder}")
    chosen = manifest.baseline if baseline is None else manifest.cell(baseline).id
    folder = grid.folder / "report" if out is None else out
    with writing_to(folder):
        folder.mkdir(parents=True, exist_ok=True)  # before the work, which takes a while for a large grid
    asked = manifest.threshold if threshold is None else threshold
    cells = read_cells(grid, manifest)
    reference = next((cell for cell in cells if cell.cell.id == chosen), None)
    if reference is None:
        raise ConfigError(f"{grid.manifest_file} names a baseline {chosen!r} that is none of its cells")
    compared = compare(cells, reference, asked)
    found = _found(cells, compared, in_depth=in_depth)
    summary, remarks = _summary(manifest, cells, reference, compared, asked), _remarks(manifest, cells, compared)
    sections = _sections(found, summary, scaling.in_words(manifest.scale, len(manifest.seeds)))
    sections += [Section("Remarks", items=remarks)] if remarks else []
    document = Document(f"{_TITLE} {manifest.name}", [*sections, Section("How to read this", _METHOD)])
    markdown = to_markdown(document)
    tables = _tables(found)
    files = {
        **{picture.file: picture.png for section in document.sections for picture in section.pictures},
        **{name: to_csv(rows).encode() for name, rows in tables.items() if rows},
        "runs.csv": to_csv(_run_numbers(grid, cells)).encode(),
        "report.md": markdown.encode(),
        "report.html": to_html(document).encode(),
    }
    with writing_to(folder):
        for name in {*_pictures_of(folder / "report.md"), *tables} - {*files}:  # of the report before, on other runs
            (folder / name).unlink(missing_ok=True)
        for name, content in files.items():
            atomic_write(folder / name, content)
    table = [_short_row(*three) for three in zip(cells, compared, found.finals, strict=True)]
    return GridReport(folder, summary, table, remarks + _untestable(cells, compared), markdown)


@dataclass(frozen=True)
class _Found:
    """What a report tells, cell by cell. finals: the table's rows. analysed: the cells that are looked at in depth."""

    cells: list[CellRuns]
    compared: list[Comparison]
    measures: list[dict[str, Measured]]
    finals: list[dict[str, str]]
    analysed: list[CellRuns]
    curricula: list[CellCurricula]


def _found(cells: list[CellRuns], compared: list[Comparison], *, in_depth: bool) -> _Found:
    measures, analysed = measured(cells, compared), cells[:MAX_ANALYSED] if in_depth else []
    finals = _finals(cells, compared, measures)
    return _Found(cells, compared, measures, finals, analysed, curricula_of(analysed))


def _sections(found: _Found, summary: list[str], note: str) -> list[Section]:
    """All but remarks and explanations. note: for figures, at which scale of the grid."""
    cells, compared, analysed = found.cells, found.compared, found.analysed
    sections = [
        Section("", summary),
        Section("Final return on the held-out instances", rows=found.finals),
        *_failed(cells),
        *_curves(cells, compared, note),
    ]
    if any(cell.summary.n_finished for cell in cells):
        names = [_name(*pair) for pair in zip(cells, compared, strict=True)]
        few = [f"Of {len(cells):,} cells, instances and curricula of the first {MAX_ANALYSED} are looked at."]
        sections += [
            Section("Steps to the threshold", rows=[_steps_row(*pair) for pair in zip(cells, compared, strict=True)]),
            *measure_sections(cells, names, found.measures),
            *_maps(cells, note),
            *_pooled(cells),
            Section("Training", rows=[_training_row(cell) for cell in cells]),
            *([Section("Instances and curricula", few)] if 0 < len(analysed) < len(cells) else []),
            *curriculum_sections(found.curricula, note),
            *instance_sections(analysed, note),
            *released_section(analysed, note),
        ]
    return sections


def _tables(found: _Found) -> dict[str, list[dict[str, Value]]]:
    """The CSV files about cells, and what is in them, by name; some are empty where nothing is known."""
    three = zip(found.cells, found.compared, found.measures, strict=True)
    return {
        "cells.csv": [_numbers(*each) for each in three],
        "curves.csv": _curve_rows(found.cells),
        "seeds.csv": _seed_rows(found.cells),
        "inclusion.csv": inclusion_rows(found.curricula),
        "curricula.csv": curriculum_rows(found.curricula),
        "agreement.csv": agreement_rows(found.curricula),
        "forgetting.csv": forgetting_rows(found.analysed),
    }


def _pictures_of(report: Path) -> list[str]:
    """The files that an earlier report of a grid shows; none of a file that is somebody else's."""
    try:
        content = read_file(report, _MAX_REPORT_BYTES)
    except OSError:
        return []
    if not content.startswith(f"# {_TITLE} ".encode()):
        return []
    return [name.decode() for name in re.findall(rb"\]\((\w+\.png)\)", content)]


# ---- sentences ------------------------------------------------------------------------------------------------------


def _summary(
    manifest: Manifest, cells: Sequence[CellRuns], baseline: CellRuns, compared: Sequence[Comparison],
    threshold: float | None,
) -> list[str]:  # fmt: skip
    counts = Counter(run_status.condition for cell in cells for run_status in cell.run_statuses)
    n_runs, done = counts.total(), counts.pop("done", 0)
    size = (
        f"{len(cells):,} cell{'s' if len(cells) > 1 else ''} × {len(manifest.seeds):,} "
        f"seed{'s' if len(manifest.seeds) > 1 else ''}"
    )
    rest = ", ".join(f"{count:,} {condition}" for condition, count in sorted(counts.items()))
    if not done:
        return [
            f"No run of this grid has finished yet, so there is no number to report: of its {n_runs:,} runs ({size}), "
            f"{rest}."
        ]
    every = f"All {n_runs:,}" if done == n_runs else f"{done:,} of {n_runs:,}"
    finished = "Its one run is finished" if n_runs == 1 else f"{every} runs are finished"
    sentences = [f"{finished} ({size}){f'; {rest}' if rest else ''}."]
    if manifest.scale != scaling.WHOLE:
        sentences.append(
            f"A grid in small, {scaling.in_words(manifest.scale, len(manifest.seeds))}: no evidence for the whole one."
        )
    if manifest.changes:
        told = " ".join(f"--set {shlex.quote(change)}" for change in manifest.changes)
        sentences.append(f"Not as the grid's file has it: {told}.")
    level = compared[cells.index(baseline)].threshold
    others = len({cell.task for cell in cells}) > 1
    counterparts = "; in other environments or test sets, its counterpart there" if others else ""
    source = "the baseline's final IQM" if threshold is None else "as asked for"
    sentences.append(
        f"Baseline: {baseline.label}{counterparts}. Threshold of the test return: "
        + (f"{number_text(level)} ({source})." if not math.isnan(level) else "none, for the baseline has no final IQM.")
    )
    return sentences + few_seeds({cell.label: cell.summary.test.n for cell in cells})


def _remarks(manifest: Manifest, cells: Sequence[CellRuns], compared: Sequence[Comparison]) -> list[str]:
    strange = [(cell, one) for cell, one in failures(cells) if not_comparable(one)]
    lines = [
        f"In no number: {cell.label}, seed {one.run.seed}: {clean(one.detail)}." for cell, one in strange[:MAX_LISTED]
    ]
    lines += fingerprint_remarks(cells, manifest) + coupled_remarks(cells)
    if alone := [cell.label for cell, comparison in zip(cells, compared, strict=True) if comparison.reference is None]:
        shown = ", ".join(alone[:MAX_LISTED]) + (", ..." if len(alone) > MAX_LISTED else "")
        lines.append(f"Not compared, for their environment or test set has no counterpart of the baseline: {shown}.")
    peculiar = [line for cell in cells for line in caveats(cell.configuration)]
    more = [f"{len(peculiar) - MAX_LISTED:,} more remarks of this kind."] if len(peculiar) > MAX_LISTED else []
    return lines + peculiar[:MAX_LISTED] + more


def _untestable(cells: Sequence[CellRuns], compared: Sequence[Comparison]) -> list[str]:
    """Why steps to the threshold are untestable: the table for a terminal has no room for it."""
    of_reason: dict[str, list[str]] = {}
    for cell, comparison in zip(cells, compared, strict=True):
        word, _, reason = comparison.untestable.partition(": ")
        if reason:
            what, _, bound = reason.partition(" (")
            names = of_reason.setdefault(f"{word.capitalize()} steps to the threshold, {what}", [])
            names.append(f"{cell.label} ({bound}" if bound else cell.label)
    return [
        f"{reason}: {', '.join(names[:MAX_LISTED])}{', ...' if len(names) > MAX_LISTED else ''}."
        for reason, names in of_reason.items()
    ]


# ---- tables ---------------------------------------------------------------------------------------------------------


def _with_seeds(text: str, n: int, of: int, what: str = "") -> str:
    return f"{text} ({share_text(n, of, what) if what else f'{n}/{of}'})"


def _name(cell: CellRuns, comparison: Comparison) -> str:
    return f"{cell.label} (baseline)" if comparison.reference is cell else cell.label


def _finals(
    cells: Sequence[CellRuns], compared: Sequence[Comparison], measures: Sequence[Mapping[str, Measured]]
) -> list[dict[str, str]]:
    rows = []
    for cell, comparison, found in zip(cells, compared, measures, strict=True):
        test, of = cell.summary.test, cell.summary.n_runs
        rows.append(
            {
                "cell": _name(cell, comparison),
                "seeds finished": f"{cell.summary.n_finished}/{of}",
                "not finished": missing(cell) or NONE,
                "IQM [95 %]": _with_seeds(interval_text(test.iqm), test.n, of),
                "mean [95 %]": _with_seeds(interval_text(test.mean), test.n, of),
                "median [95 %]": _with_seeds(interval_text(test.median), test.n, of),
                "P(better) [95 %]": _improvement(cell, comparison),
                **paired_cell(found["final"], of),
            }
        )
    return rows


def _improvement(cell: CellRuns, comparison: Comparison) -> str:
    if comparison.improvement is None or comparison.reference is None:
        return NONE
    ours, theirs = cell.summary, comparison.reference.summary
    rests_on = against_in_words(ours.test.n, ours.n_runs, theirs.test.n, theirs.n_runs)
    return f"{interval_text(comparison.improvement, 2)} ({rests_on})"


def _steps_row(cell: CellRuns, comparison: Comparison) -> dict[str, str]:
    reach, of = comparison.reach, cell.summary.n_runs
    row = {"cell": _name(cell, comparison), "threshold": number_text(comparison.threshold)}
    if reach is None:
        return row | {"reached by": NONE, "censored": NONE, "steps, restricted mean [95 %]": comparison.untestable,
                      "ratio to the baseline [95 %]": NONE}  # fmt: skip
    n = len(reach.times)
    row["reached by"] = f"{n - reach.censored}/{n}"
    row["censored"] = f"{reach.censored}/{n} at {reach.budget:,} steps" if reach.censored else f"0/{n}"
    row["steps, restricted mean [95 %]"] = _with_seeds(interval_text(reach.mean, 0), n, of)
    row["ratio to the baseline [95 %]"] = _ratio(comparison, of)
    return row


def _ratio(comparison: Comparison, n_seeds: int) -> str:
    if comparison.ratio is None:
        return NONE
    return _with_seeds(interval_text(comparison.ratio, 2), comparison.pairs, n_seeds, "pair")


def _training_row(cell: CellRuns) -> dict[str, str]:
    found, of = cell.summary, cell.summary.n_runs
    done = found.n_finished
    return {
        "cell": cell.label,
        "environment steps": _with_seeds(steps_text(found), done, of),
        "train return, IQM [95 %]": _with_seeds(interval_text(found.train.iqm), found.train.n, of),
        "test success": _with_seeds(number_text(found.test_success), found.test.n, of),
        "set size at the end": _with_seeds(size_text(found), done, of),
        "all instances reached": _with_seeds(reached_text(found), done, of),
    }


def _short_row(cell: CellRuns, comparison: Comparison, final: dict[str, str]) -> dict[str, str]:
    """For a terminal."""
    steps = comparison.untestable.partition(":")[0]
    if comparison.reach is not None:
        reach = comparison.reach
        steps = f"{interval_text(reach.mean, 0)}, {reach.censored}/{len(reach.times)} censored"
    return {
        "cell": final["cell"],
        "seeds": final["seeds finished"],
        "not finished": final["not finished"],
        "test return, IQM [95 %]": final["IQM [95 %]"],
        "P(better)": final["P(better) [95 %]"],
        "steps to the threshold": steps,
        "ratio": _ratio(comparison, cell.summary.n_runs),
    }


def _failed(cells: Sequence[CellRuns]) -> list[Section]:
    found = failures(cells)
    if not found:
        return []
    causes = Counter(cause_in_words(run_status) for _, run_status in found)
    text = [f"{len(found):,} run{'s' if len(found) > 1 else ''} failed and "
            f"{'are' if len(found) > 1 else 'is'} in no number: "
            + ", ".join(f"{count:,} {cause}" for cause, count in causes.most_common()) + "."]  # fmt: skip
    if len(found) > MAX_LISTED:
        text.append(f"The first {MAX_LISTED} follow; runs.csv lists every one.")
    rows, details = [], []
    for cell, run_status in found[:MAX_LISTED]:
        title = f"{cell.label}, seed {run_status.run.seed}"
        lines = [clean(line) for line in run_status.detail.splitlines() if line.strip()] or [""]
        rows.append(
            {
                "run": title,
                "cause": cause_in_words(run_status),
                "what it said": lines[0] or NONE,
                "steps": f"{run_status.steps:,} of {run_status.budget_steps:,}",
                "attempts": str(run_status.attempts),
            }
        )
        details += [(f"{title}: all it said", "\n".join(lines))] if len(lines) > 1 else []
    return [Section("Failed runs", text, rows, details=details, words=True)]


def _pooled(cells: Sequence[CellRuns]) -> list[Section]:
    rows = [
        {"setting": found.setting, "cells": f"{found.n_cells}",
         "test return, IQM [95 %]": _with_seeds(interval_text(found.iqm), found.n_finished, found.n_runs, "run")}
        for found in pool(cells)
    ]  # fmt: skip
    text = ("The final test return of all cells with a setting, whatever their others; the intervals are stratified by "
            "cell. Settings whose cells differ in other ways too, or in how many runs are finished, are no fair "
            "comparison.")  # fmt: skip
    return [Section("One setting at a time", [text], rows)] if rows else []


# ---- figures --------------------------------------------------------------------------------------------------------


def _curves(cells: Sequence[CellRuns], compared: Sequence[Comparison], note: str) -> list[Section]:
    """One figure a task: returns of different tasks have no common scale."""
    references = {cell.task: comparison.reference for cell, comparison in zip(cells, compared, strict=True)}
    several, text, pictures = len(references) > 1, [], []
    for number, (task, reference) in enumerate(references.items(), start=1):
        own = [cell for cell in cells if cell.task == task and cell.configuration.drawn]
        if not own:
            continue
        which = f": environment and test set of {own[0].label}" if several else ""
        if len(own) > MAX_DRAWN:
            text.append(f"Of {len(own):,} cells, the {MAX_DRAWN} of the highest final IQM are drawn, best first, "
                        f"and the baseline{which}.")  # fmt: skip
            own = sorted(own, key=_descending)[:MAX_DRAWN]
        if len(own) <= len(COLOURS):
            figure = draw_comparison([cell.configuration for cell in own])
            caption = "Test return, train return and size of the training set over environment steps"
        else:
            figure = draw_panels(_panels(own, reference))
            grey = "" if reference is None else "; grey: the baseline"
            caption = f"Test return over environment steps (IQM over seeds, 95 % interval){grey}"
        file = f"curves_{number}.png" if several else "curves.png"
        pictures.append(Picture(file, f"{caption}{which}", png(figure, note)))
    return [Section("Learning curves", text, pictures=pictures)] if pictures else []


def _descending(cell: CellRuns) -> float:
    value = cell.summary.test.iqm.value
    return math.inf if math.isnan(value) else -value


def _panels(cells: Sequence[CellRuns], baseline: CellRuns | None) -> list[Panel]:
    """One task's cells that differ only by the last setting in one panel where that is few enough; else six in each."""
    keys = varying(cells)
    groups = grouped(cells, keys[:-1])
    if max(map(len, groups.values())) > _CURVES_PER_PANEL or len(groups) * 2.5 > len(cells):
        parts = {at: list(cells[at : at + _CURVES_PER_PANEL]) for at in range(0, len(cells), _CURVES_PER_PANEL)}
        groups = {(f"cells {at + 1} to {at + len(part)}",): part for at, part in parts.items()}

    def curves(group: Sequence[CellRuns]) -> list[Configuration]:
        return [cell.configuration for cell in group if cell is not baseline]

    reference = None if baseline is None or not baseline.configuration.drawn else baseline.configuration
    return [Panel(", ".join(place), curves(group), reference) for place, group in groups.items() if curves(group)]


def _maps(cells: Sequence[CellRuns], note: str) -> list[Section]:
    maps = [found for found in heat_maps(cells) if not all(math.isnan(value) for value in found.means.flat)]
    shown = [value for found in maps for value in found.means.flat if not math.isnan(value)]
    text = "Final test return: mean ± standard deviation over the finished seeds, as in the paper's Table 1."
    sections = []
    for number, found in enumerate(maps, start=1):
        title = "Two parameters" + (f": {found.title}" if found.title else "")
        picture = Picture(f"heat_map_{number}.png", f"{found.column_name} and {found.row_name}: mean final test return",
                          png(draw_heat_map(found, min(shown), max(shown)), note))  # fmt: skip
        sections.append(Section(title, [text], _map_rows(found), pictures=[picture]))
    return sections


def _map_rows(found: HeatMap) -> list[dict[str, str]]:
    head = f"{found.row_name} \\ {found.column_name}"
    return [
        {head: name, **{f"{found.column_name}={value}": found.text(row, column)
                        for column, value in enumerate(found.columns)}}
        for row, name in enumerate(found.rows)
    ]  # fmt: skip


# ---- numbers in full precision --------------------------------------------------------------------------------------


def _numbers(cell: CellRuns, comparison: Comparison, measures: Mapping[str, Measured]) -> dict[str, Value]:
    reach, none = comparison.reach, Interval(math.nan)
    reference = comparison.reference
    return {
        "cell": cell.cell.id,
        **numbers(cell.summary),
        "not_finished": missing(cell),
        "baseline": None if reference is None else reference.cell.id,
        **interval_numbers("probability_of_improvement", comparison.improvement or none),
        "baseline_return_seeds": None if reference is None else reference.summary.test.n,
        "threshold": comparison.threshold,
        "steps_seeds": None if reach is None else len(reach.times),
        "steps_censored": None if reach is None else reach.censored,
        **interval_numbers("steps_restricted_mean", none if reach is None else reach.mean),
        **interval_numbers("steps_ratio", comparison.ratio or none),
        "steps_ratio_pairs": comparison.pairs,
        "steps_untestable": comparison.untestable,
        **measure_numbers(measures),
    }


def _curve_rows(cells: Sequence[CellRuns]) -> list[dict[str, Value]]:
    """The learning curves that are drawn: a row a cell and step."""
    rows: list[dict[str, Value]] = []
    for cell in cells:
        steps, returns = cell.configuration.returns("test")
        for step, values in zip(steps.tolist(), returns.T, strict=True):
            found = estimate(values).iqm
            rows.append({"cell": cell.cell.id, "label": cell.label, "steps": step, "seeds": len(values),
                         **interval_numbers("test_return_iqm", found)})  # fmt: skip
    return rows


def _seed_rows(cells: Sequence[CellRuns]) -> list[dict[str, Value]]:
    """Every evaluation of every finished run: a row each, with six digits, which is more than seeds agree in."""
    return [
        {"cell": cell.cell.id, "label": cell.label, "seed": run.status.seed, "steps": step,
         "test_return": float(f"{value:.6g}")}
        for cell in cells for run in cell.configuration.finished
        for step, value in zip(run.evaluation_steps.tolist(), run.test["return"].tolist(), strict=True)
    ]  # fmt: skip


def _run_numbers(grid: Grid, cells: Sequence[CellRuns]) -> list[dict[str, Value]]:
    """A row a run, those that left nothing included."""
    fields = sorted({field for cell in cells for run in cell.configuration.runs for field in run.status.fingerprint})
    rows = []
    for cell in cells:
        read = {run.status.seed: run for run in cell.configuration.runs}
        for run_status in cell.run_statuses:
            run = read.get(run_status.run.seed)
            last = run if run is not None and len(run.evaluation_steps) else None
            row: dict[str, Value] = {
                "cell": cell.cell.id, "label": cell.label, "seed": run_status.run.seed,
                "condition": run_status.condition, "cause": run_status.cause,
                "detail": " / ".join(clean(line) for line in run_status.detail.splitlines()),
                "attempts": run_status.attempts, "steps": run_status.steps, "budget_steps": run_status.budget_steps,
                "last_test_return": None if last is None else last.last("test", "return"),
                "last_train_return": None if last is None else last.last("train", "return"),
                "fingerprint_changed": None if run is None else str(run.status.fingerprint_changed).lower(),
                "folder": run_folder(grid, run_status),
            }  # fmt: skip
            rows.append(row | {field: None if run is None else clean(str(run.status.fingerprint.get(field, "")))
                               for field in fields})  # fmt: skip
    return rows
