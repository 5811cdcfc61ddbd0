"""What becomes of each held-out instance: performance profiles, curves, and what is forgotten again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from space_dist.errors import LedgerError
from space_dist.report.analysis_figures import draw_instances, draw_profiles
from space_dist.report.document import Picture, Section
from space_dist.report.figures import png
from space_dist.report.grid import CellRuns
from space_dist.report.load import FloatArray, IntArray, Run
from space_dist.report.outcomes import forgotten, span
from space_dist.report.statistics import Interval, estimate
from space_dist.report.tables import Value, interval_numbers, interval_text

SHARES: Final = (0.05, 0.1, 0.2)  # of the range of returns: by so much a return must rise, and fall again
FEWEST: Final = 5  # evaluations that forgetting can be told from
MAX_PANELS: Final = 12  # cells with a diagram of their own
MAX_PROFILES: Final = 12

Curves = Mapping[str, Sequence[tuple[IntArray, FloatArray]]]
"""By cell: of each finished run `(k,)` steps and `(k, n)` returns of the n held-out instances."""


def instance_sections(cells: Sequence[CellRuns], note: str) -> list[Section]:
    """Profiles, curves and forgetting, of the cells that have a finished run; `note` is written on figures."""
    curves = curves_of(cells)
    cells = [cell for cell in cells if curves[cell.cell.id]]
    if not cells:
        return []
    return [*_of_each_task(cells, curves, note), *_forgetting(cells, curves)]


def curves_of(cells: Sequence[CellRuns]) -> dict[str, list[tuple[IntArray, FloatArray]]]:
    """What became of each held-out instance, read anew."""
    return {cell.cell.id: [_curve(run) for run in cell.configuration.finished if run.evaluated_at_end]
            for cell in cells}  # fmt: skip


def _curve(run: Run) -> tuple[IntArray, FloatArray]:
    returns = run.instance_returns("test")
    if len(returns) != len(run.evaluation_steps):
        raise LedgerError(f"{run.ledger.folder} has evaluations that this version cannot read")
    return run.evaluation_steps, returns


def _of_each_task(cells: Sequence[CellRuns], curves: Curves, note: str) -> list[Section]:
    """Profiles and curves: returns of different tasks have no common scale."""
    sections = []
    tasks = list(dict.fromkeys(cell.task for cell in cells))
    for number, task in enumerate(tasks, start=1):
        own = [cell for cell in cells if cell.task == task]
        which = f": environment and test set of {own[0].label}" if len(tasks) > 1 else ""
        end = f"_{number}.png" if len(tasks) > 1 else ".png"
        sections += [_profiles(own, curves, which, end, note), _every_instance(own, curves, which, end, note)]
    return sections


def _profiles(cells: Sequence[CellRuns], curves: Curves, which: str, end: str, note: str) -> Section:
    drawn = cells[:MAX_PROFILES]
    scores = [np.concatenate([returns[-1] for _, returns in curves[cell.cell.id]]) for cell in drawn]
    figure = draw_profiles([cell.caption for cell in drawn], scores)
    caption = "Share of runs × held-out instances whose final return is above tau (Agarwal et al. 2021)"
    picture = Picture(f"profiles{end}", caption, png(figure, note))
    return Section(f"Performance profiles{which}", _first(drawn, cells), pictures=[picture])


def _every_instance(cells: Sequence[CellRuns], curves: Curves, which: str, end: str, note: str) -> Section:
    drawn = cells[:MAX_PANELS]
    figure = draw_instances([cell.caption for cell in drawn], [_mean_curve(curves[cell.cell.id]) for cell in drawn])
    caption = (
        "Return of each held-out instance over environment steps, mean over seeds; black: tenths and median of them"
    )
    picture = Picture(f"instances{end}", caption, png(figure, note))
    return Section(f"Every held-out instance{which}", _first(drawn, cells), pictures=[picture])


def _first(drawn: Sequence[CellRuns], cells: Sequence[CellRuns]) -> list[str]:
    return [] if len(drawn) == len(cells) else [f"The first {len(drawn)} of {len(cells):,} cells."]


def _mean_curve(curves: Sequence[tuple[IntArray, FloatArray]]) -> tuple[IntArray, FloatArray]:
    """Mean over runs, at every step at which one was evaluated; between its evaluations a run's last one counts."""
    steps = np.unique(np.concatenate([own for own, _ in curves]))
    steps = steps[steps >= max(own[0] for own, _ in curves)]
    each = [returns[np.searchsorted(own, steps, side="right") - 1] for own, returns in curves]
    return steps, np.asarray(np.mean(each, axis=0))


def forgetting(cells: Sequence[CellRuns], curves: Curves) -> dict[str, dict[float, Interval]]:
    """By cell and share of the range of all returns of the task: how many instances fall again by that, mean over runs.

    Without cells whose runs have too few evaluations, or a return that is no number, and without tasks in which every
    return is the same.
    """
    found = {}
    for cell in cells:
        own = [returns for _, returns in curves[cell.cell.id]]
        if min(len(returns) for returns in own) < FEWEST or any(np.isnan(returns).any() for returns in own):
            continue
        whole = span([returns for other in cells if other.task == cell.task for _, returns in curves[other.cell.id]])
        if not whole:
            continue
        counts = {share: [float(forgotten(returns, share * whole).sum()) for returns in own] for share in SHARES}
        most = float(own[0].shape[1])
        found[cell.cell.id] = {share: estimate(np.array(each)).mean.within(0.0, most) for share, each in counts.items()}
    return found


def _forgetting(cells: Sequence[CellRuns], curves: Curves) -> list[Section]:
    found = forgetting(cells, curves)
    rows = []
    for cell in cells:
        own = curves[cell.cell.id]
        seeds = f"of {own[0][1].shape[1]:,} ({len(own)}/{cell.summary.n_runs})"
        numbers = found.get(cell.cell.id, {})
        texts = {f"fall by {100 * share:g} % of the range, mean [95 %]": f"{interval_text(one, 1)} {seeds}"
                 for share, one in numbers.items()}  # fmt: skip
        rows += [{"cell": cell.label, **texts}] if texts else []
    if not rows:
        return []
    text = (
        "Instances whose return, smoothed over five evaluations, rises by at least that share of the range of all "
        "returns here, and ends at least as much, and at least two standard errors, below its peak; per run."
    )
    return [Section("Forgetting", [text], rows)]


def forgetting_rows(cells: Sequence[CellRuns]) -> list[dict[str, Value]]:
    """For CSV: a row a cell."""
    curves = curves_of(cells)
    found = forgetting([cell for cell in cells if curves[cell.cell.id]], curves)
    return [
        {"cell": cell.cell.id, "label": cell.label, "seeds": len(curves[cell.cell.id]),
         **{key: value for share, one in found[cell.cell.id].items()
            for key, value in interval_numbers(f"forgotten_{100 * share:g}_percent", one).items()}}
        for cell in cells if cell.cell.id in found
    ]  # fmt: skip
