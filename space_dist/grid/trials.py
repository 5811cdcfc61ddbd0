"""The trials of a search: asked, judged when their runs are over, given up or sent on, and taken over by heirs.

Each step reads the manifest and the ledgers, and nothing else, and ends with one atomic write of the manifest: killed
before it, the same step is made again, with the same result.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from space_dist import config as configs
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.experiment.endings import Cause
from space_dist.experiment.manifest import Cell, Grid, Manifest, Run
from space_dist.experiment.sampling import draw, explored, given_up, optuna_version, ranked_at_rung
from space_dist.experiment.search import Search, Trial
from space_dist.experiment.status import RunStatus, run_statuses
from space_dist.experiment.tuning import WHOLE, Pruner, Rung, TuneConfig
from space_dist.grid.heirs import take_over
from space_dist.grid.planning import InstanceFiles, frozen_cell, resolved_cell
from space_dist.report.objective import objective_of

# Ends that say something of a setting. A node that went away says nothing of it, and is not held against it.
OF_THE_SETTING: Final = (Cause.CRASH, Cause.CONFIG_ERROR, Cause.OUT_OF_MEMORY, Cause.TIMEOUT)


class HeldUpError(SpaceDistError):
    """Runs of a search failed for reasons that say nothing of their settings: it waits for them to be tried again."""


def with_settings(base: Mapping[str, Any], setting: Mapping[str, Any]) -> dict[str, Any]:
    """A run config's plain data with a setting. Raises ConfigError where a key is within what is no section."""
    data: dict[str, Any] = json.loads(json.dumps(base))
    for key, value in setting.items():
        configs.put(data, key, json.loads(json.dumps(value)), key)
    return data


# ---- asking ----------------------------------------------------------------------------------------------------------


def asked(manifest: Manifest, grid: Grid) -> Manifest:
    """The manifest with the next generation of every arm. Settings that no config can have are failed trials."""
    search = manifest.searched
    config = TuneConfig.model_validate(search.config)
    seeds, steps = _given(manifest, rungs_of(search)[0])
    cells = {cell.id: cell for cell in manifest.cells}
    files, specs = InstanceFiles(), dict[str, EnvironmentSpec]()
    trials: list[Trial] = []
    generation = search.generation + 1
    for arm in search.arms:
        known = search.of_arm(arm)
        for setting in draw(search, arm, min(config.asked_at_once, config.trials - len(known))):
            number = len(known) + sum(trial.arm == arm for trial in trials)
            where = f"{manifest.name}, trial {number} of {arm}"
            try:
                cell = _cell(manifest, search, arm, number, setting, (), where, grid, files, specs)
            except ConfigError as error:
                remark = str(error).removeprefix(f"{where}: ").splitlines()[0]
                trials.append(Trial(number, arm, generation, setting, "", seeds, steps, state="failed", remark=remark))
                continue
            cells.setdefault(cell.id, cell)  # the same setting once more has the same runs
            trials.append(Trial(number, arm, generation, setting, cell.id, seeds, steps))
    return _with_search(manifest, tuple(cells.values()), search.with_trials([*search.trials, *trials]))


def rungs_of(search: Search) -> list[Rung]:
    """Where its trials are compared, and last what a complete one comes to."""
    budget = next(iter(search.arms.values())).base["budget"]["steps"]  # the same for all arms
    return TuneConfig.model_validate(search.config).rungs(int(budget))


def _given(manifest: Manifest, rung: Rung) -> tuple[int, int]:
    """How many seeds a trial gets for a rung, and steps of each."""
    return rung.seeds or len(manifest.seeds), rung.steps


def _cell(
    manifest: Manifest, search: Search, arm: str, number: int, setting: Mapping[str, Any],
    schedule: Sequence[Mapping[str, Any]], where: str, grid: Grid, files: InstanceFiles,
    specs: dict[str, EnvironmentSpec],
) -> Cell:  # fmt: skip
    data = with_settings(search.arms[arm].base, setting)
    if schedule:
        data["schedule"] = [*schedule]
    configs.from_its_folder(data, grid.folder)
    label = f"{arm} {number}"
    resolved = resolved_cell(manifest.name, label, data, where)
    point = {"arm": arm, "trial": number, **setting, **(schedule[-1]["set"] if schedule else {})}
    cell, _ = frozen_cell(manifest.resources, resolved, point, label, where, files, specs)
    return cell


def _with_search(manifest: Manifest, cells: Iterable[Cell], search: Search) -> Manifest:
    """The manifest with these trials: each cell with as many seeds and steps as the trials that have it were given."""
    seeds, steps = {cell.id: 0 for cell in cells}, {cell.id: 0.0 for cell in cells}
    for trial in search.trials:
        if trial.cell:
            seeds[trial.cell] = max(seeds[trial.cell], trial.seeds)
            steps[trial.cell] = max(steps[trial.cell], trial.steps or math.inf)
    whole = len(manifest.seeds)
    kept = tuple(
        dataclasses.replace(
            cell, n_seeds=0 if seeds[cell.id] == whole else seeds[cell.id],
            pause_at=0 if math.isinf(steps[cell.id]) else int(steps[cell.id]),
        )
        for cell in cells
    )  # fmt: skip
    return dataclasses.replace(manifest, cells=kept, search=search, baseline=kept[0].id if kept else "")


# ---- what became of it -----------------------------------------------------------------------------------------------


def open_runs(manifest: Manifest) -> list[Run]:
    """The runs of the trials whose outcome is not known, seed by seed, each as far as its cell's `pause_at`."""
    waiting = {trial.cell for trial in manifest.search.open} if manifest.search is not None else set[str]()
    return [run for run in manifest.runs() if run.cell.id in waiting]


def advance(grid: Grid, manifest: Manifest) -> Manifest | None:
    """The manifest with the outcome of the open trials, and what is to be run next, written; None: runs are not over.

    For whoever works on the grid. Raises HeldUpError if a run failed for a reason that says nothing of its setting,
    ConfigError for another Optuna than the one that the search began with, LedgerError if the folder cannot be read or
    written.
    """
    search = manifest.searched
    if search.over:
        return manifest
    found = run_statuses(grid, manifest, manifest.code, open_runs(manifest))
    if any(one.condition in ("running", "waiting") for one in found):
        return None
    _refuse_held_up(found)
    if search.open:
        manifest = _judged(grid, manifest, search, found)
    else:
        _refuse_other_optuna(search)
        manifest = asked(manifest, grid)
    grid.freeze(manifest, {})
    return manifest


def _refuse_held_up(found: Sequence[RunStatus]) -> None:
    for one in found:
        if one.condition == "failed" and one.cause is not None and one.cause not in OF_THE_SETTING:
            raise HeldUpError(
                f"{one.run.title}: {one.in_words}, which says nothing of its setting, so the search does not go on "
                f"without it; {one.way_out}"
            )


def _refuse_other_optuna(search: Search) -> None:
    here = optuna_version()
    if here != search.optuna:
        raise ConfigError(
            f"this search was begun with Optuna {search.optuna}, and Optuna {here} would draw other trials: "
            f"pip install optuna=={search.optuna}"
        )


def _judged(grid: Grid, manifest: Manifest, search: Search, found: Sequence[RunStatus]) -> Manifest:
    """The manifest with what its open trials have reached at their rung; some are given up, the others go on.

    Of a population, those that are given up have heirs of the best in their place.
    """
    failed: dict[str, tuple[int, str]] = {}
    for one in found:
        if one.condition == "failed" and one.cause is not None:
            failed.setdefault(one.run.cell.id, (one.run.seed, one.cause.in_words))
    judged = [trial if trial.state != "open" else _measured(grid, manifest, trial, failed.get(trial.cell))
              for trial in search.trials]  # fmt: skip
    config, rungs = TuneConfig.model_validate(search.config), rungs_of(search)
    gone: set[tuple[str, int]] = set()
    chosen: list[tuple[Trial, dict[str, Any]]] = []
    for arm in search.arms:
        racing = [trial for trial in judged if trial.arm == arm and trial.state == "open"]
        if not racing:
            continue
        if config.population is None:
            gone |= {(arm, number) for number in given_up(search, arm, racing, _pruner(config))}
            continue
        rung = racing[0].rung
        count = math.ceil(config.population.replace * config.trials - 1e-9)
        lost = config.trials - len(racing)  # failed: heirs take their places first
        worst = ranked_at_rung(search, racing)[max(1, len(racing) - max(0, count - lost)) :]
        gone |= {(arm, trial.number) for trial in worst}
        best = ranked_at_rung(search, racing)[: max(1, min(count, len(racing) - len(worst)))]
        chosen += explored(search, arm, rung, best, len(worst) + lost, config.population)
    after = [trial if trial.state != "open" else
             dataclasses.replace(trial, state="pruned") if (trial.arm, trial.number) in gone else
             _sent_on(manifest, trial, rungs)
             for trial in judged]  # fmt: skip
    cells, heirs = _heirs(grid, manifest, search.with_trials(after), chosen, rungs)
    return _with_search(manifest, cells, search.with_trials([*after, *heirs]))


def _pruner(config: TuneConfig) -> Pruner:
    if config.pruner is None:
        raise RuntimeError("an open trial has come to its end, and is not complete")
    return config.pruner


def _sent_on(manifest: Manifest, trial: Trial, rungs: Sequence[Rung]) -> Trial:
    """On its way to the next rung."""
    seeds, steps = _given(manifest, rungs[trial.rung])
    return dataclasses.replace(trial, rung=trial.rung + 1, seeds=seeds, steps=steps)


def _heirs(
    grid: Grid, manifest: Manifest, search: Search, chosen: Sequence[tuple[Trial, dict[str, Any]]],
    rungs: Sequence[Rung],
) -> tuple[list[Cell], list[Trial]]:  # fmt: skip
    """The trials that go on from others' state, each with its parent and its settings, and all cells with theirs.

    Their runs are there when this returns.
    """
    files, specs = InstanceFiles(), dict[str, EnvironmentSpec]()
    cells = {cell.id: cell for cell in manifest.cells}
    heirs: list[Trial] = []
    for parent, setting in chosen:
        number = len(search.of_arm(parent.arm)) + sum(heir.arm == parent.arm for heir in heirs)
        where = f"{manifest.name}, trial {number} of {parent.arm}"
        seeds, steps = _given(manifest, rungs[parent.rung])
        heir = Trial(
            number, parent.arm, parent.rung, setting, "", seeds, steps, rung=parent.rung + 1, parent=parent.number
        )
        first, schedule = search.with_trials([*search.trials, *heirs, heir]).in_force(heir)
        try:
            cell = _cell(manifest, search, parent.arm, number, first, schedule, where, grid, files, specs)
        except ConfigError as error:
            remark = str(error).removeprefix(f"{where}: ").splitlines()[0]
            heirs.append(dataclasses.replace(heir, state="failed", remark=remark))
            continue
        inherited = take_over(grid, cells[parent.cell], cell, manifest.seeds[: parent.seeds])
        cells.setdefault(cell.id, cell)
        heirs.append(dataclasses.replace(heir, cell=cell.id, inherited=inherited))
    return [*cells.values()], heirs


def _measured(grid: Grid, manifest: Manifest, trial: Trial, failed: tuple[int, str] | None) -> Trial:
    """An open trial whose runs are over: failed, complete, or open still, with what it reached at its rung."""
    if failed is not None:
        seed, cause = failed
        return dataclasses.replace(trial, state="failed", remark=f"seed {seed}: {cause}")
    value = objective_of(grid, manifest, trial)
    if not np.isfinite(value):
        return dataclasses.replace(trial, state="failed", remark="its objective is no number")
    complete = (trial.seeds, trial.steps) == _given(manifest, WHOLE)
    values = {**trial.values, trial.rung: value}
    return dataclasses.replace(trial, state="complete" if complete else "open", values=values)
