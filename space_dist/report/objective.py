"""What a trial of a search reached: one number over its seeds, by the same functions that reports use.

All of it is measured on the development instances, which the search's runs have for their test instances.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from space_dist.experiment.manifest import Grid, Manifest
from space_dist.experiment.manifest import Run as GridRun
from space_dist.experiment.search import Trial
from space_dist.experiment.tuning import Objective
from space_dist.report.load import Run, load_run
from space_dist.report.measures import measure_of
from space_dist.report.statistics import interquartile_mean, restricted, steps_to_threshold

IN_WORDS: Final = {
    "final": "final return on the development instances",
    "worst": "final return on the worst tenth of the development instances (CVaR)",
    "area": "area under the curve of the return on the development instances",
    "steps": "environment steps to the threshold on the development instances",
}
_MEASURES: Final = {"final": "final", "worst": "worst", "area": "early"}


def objective_of(grid: Grid, manifest: Manifest, trial: Trial) -> float:
    """The objective of a trial over the seeds and steps it was given; NaN where a seed has no such number.

    Raises LedgerError if a run's folder cannot be read, or belongs to another run.
    """
    cell = manifest.cell(trial.cell)
    runs = [load_run(grid.ledger(GridRun(cell, seed)), cell.config) for seed in manifest.seeds[: trial.seeds]]
    if trial.steps:
        runs = [run.until(trial.steps) for run in runs]
    objective = Objective.model_validate(manifest.searched.config["objective"])
    return over_seeds(runs, objective, trial.steps or cell.budget_steps)


def over_seeds(runs: Sequence[Run], objective: Objective, budget: int) -> float:
    """One number of finished runs that differ by their seed: the IQM over seeds; of steps, their restricted mean.

    budget: environment steps, up to which areas and censored seeds count. NaN where a run was not evaluated at its
    end, or has no such number.
    """
    if not all(run.evaluated_at_end for run in runs):
        return float("nan")
    if objective.threshold is not None:  # kind: steps; the schema allows it for no other
        times = [steps_to_threshold(run.evaluation_steps, run.test["return"], objective.threshold) for run in runs]
        diverged = any(np.isnan(run.test["return"]).any() for run in runs)
        return float("nan") if diverged else float(restricted(np.array(times), budget).mean())
    values = np.array([measure_of(run, _MEASURES[objective.kind], budget) for run in runs])
    return float(interquartile_mean(values))
