"""A search, from its YAML file to its confirmation: a grid whose manifest grows, generation by generation.

    plan_search       the file checked, the first generation asked, all of it frozen
    advance           when all runs of the open trials are over: what they reached is recorded, the pruner decides who
                      gets more seeds, and where nobody does, the next generation is asked
    confirmation      the best setting of each arm as a grid's file

Each step reads the manifest and the ledgers, and nothing else, and ends with one atomic write of the manifest: killed
before it, the same step is made again, with the same result.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from space_dist import config as configs
from space_dist.config import RunConfig
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, LedgerError, SpaceDistError, about
from space_dist.experiment.endings import Cause
from space_dist.experiment.manifest import Cell, Grid, Manifest, Run
from space_dist.experiment.sampling import (
    completions,
    draw,
    explored,
    given_up,
    optuna_version,
    ranked_at_rung,
)
from space_dist.experiment.search import ArmRecord, Search, Trial
from space_dist.experiment.status import RunStatus, run_statuses
from space_dist.experiment.tuning import (
    WHOLE,
    Distribution,
    Pruner,
    Rung,
    TuneConfig,
    base_of,
    confirmation_of,
    load_tune,
)
from space_dist.grid.conductor import freeze
from space_dist.grid.heirs import take_over
from space_dist.grid.planning import InstanceFiles, frozen_cell, resolved_cell
from space_dist.instances import InstanceSet, refuse_overlap, repeats
from space_dist.report.objective import objective_of
from space_dist.run.building import Blueprint
from space_dist.run.training import next_evaluation
from space_dist.system.files import atomic_write, in_words
from space_dist.system.provenance import code_digest, git_state
from space_dist.tracking.settling import settled

AXES: Final = ("arm", "trial")
# Ends that say something of a setting. A node that went away says nothing of it, and is not held against it.
OF_THE_SETTING: Final = (Cause.CRASH, Cause.CONFIG_ERROR, Cause.OUT_OF_MEMORY, Cause.TIMEOUT)
_TRIED: Final = 24  # random settings around one value, until one of them is a config
_MAY_CHANGE: Final = ("trials", "resources", "retry", "tracking")  # of a search that has begun


class HeldUpError(SpaceDistError):
    """Runs of a search failed for reasons that say nothing of their settings: it waits for them to be tried again."""


@dataclass(frozen=True)
class SearchPlan:
    """A planned search. steps: of all its runs together, if no trial were given up; new: whether it was begun now."""

    grid: Grid
    manifest: Manifest
    steps: int
    new: bool


def plan_search(path: Path, root: Path, folder: Path | None = None) -> SearchPlan:
    """Check a search's file, and freeze it with its first generation; one that is there goes on.

    folder: of the search; None: `<root>/<name>`. Raises ConfigError for every fault of the files: keys that are none,
    values that no setting can have, instance sets that share contexts; and if the folder holds another search, or a
    grid.
    """
    config = load_tune(path)
    grid = Grid(root.absolute() / config.name if folder is None else folder)
    begun = _begun(grid)
    files = InstanceFiles()
    with about(str(path)):
        planned = _Planned(config, path, files)
        if begun is not None:
            manifest = _continued(grid, begun, planned.search)
        else:
            grid.keep(files.contents)
            manifest = _asked(planned.empty(), grid)
            freeze(grid, manifest, files.contents)
            manifest = grid.manifest()
    return SearchPlan(grid, manifest, planned.steps, begun is None)


def _begun(grid: Grid) -> Manifest | None:
    """What the folder holds. Raises ConfigError if that is a grid, LedgerError if it is damaged."""
    if not grid.manifest_file.exists():
        return None
    manifest = grid.manifest()
    if manifest.search is None:
        raise ConfigError(
            f"{grid.folder} holds a grid of this name; give the search another name, or use another --root"
        )
    return manifest


def _continued(grid: Grid, begun: Manifest, planned: Search) -> Manifest:
    """A search that is there already, with what of its file may change. Raises ConfigError for what may not."""
    search = begun.searched
    before, now = (json.loads(json.dumps(one.to_json() | {"trials": [], "optuna": ""})) for one in (search, planned))
    changes = configs.changes(before["config"], now["config"])
    forbidden = [key for key in changes if key.partition(".")[0] not in _MAY_CHANGE]
    if forbidden:
        raise ConfigError(
            f"{grid.folder} holds another search of this name, which began with another {forbidden[0]}; a search that "
            f"has begun may change {', '.join(_MAY_CHANGE)}. Give it another name, or use another --root"
        )
    if {**before, "config": 0} != {**now, "config": 0}:
        raise ConfigError(
            f"{grid.folder} holds another search of this name: the run config that it extends, or an instance file, "
            "has changed since. Give it another name, or use another --root"
        )
    if not changes:
        return begun
    trials, each = int(search.config["trials"]), int(search.config["generation"])
    if "trials" in changes and search.config["population"] is not None:
        raise ConfigError(
            f"trials: {grid.folder} was begun with a population of {trials}, which cannot change its size"
        )
    if int(planned.config["trials"]) < trials:
        raise ConfigError(f"trials: {grid.folder} was begun with {trials}; a search may get more trials, and not fewer")
    if "trials" in changes and trials % each and len(search.trials) == search.total:
        raise ConfigError(
            f"trials: the last generation of {grid.folder} was asked with {trials % each} trials of {each}; a search "
            f"may get more trials where they are a multiple of generation: {each}"
        )
    if grid.owner_alive():
        raise ConfigError(f"{grid.folder} is being worked on; `space-dist grid stop {grid.folder}` ends that")
    config = TuneConfig.model_validate(planned.config)
    manifest = dataclasses.replace(
        begun, resources=config.resources, retry=config.retry, tracking=settled(config.tracking, begun.name),
        search=dataclasses.replace(search, config=planned.config),
    )  # fmt: skip
    grid.freeze(manifest, {})
    return grid.manifest()


# ---- the plan --------------------------------------------------------------------------------------------------------


class _Planned:
    """A search's file, resolved: what each arm starts from and may be, and that all of it can work."""

    def __init__(self, config: TuneConfig, path: Path, files: InstanceFiles) -> None:
        self.config, self._files = config, files
        self._folder = configs.located(path).absolute().parent
        self._specs: dict[str, EnvironmentSpec] = {}
        self.steps = 0
        arms = {name: self._arm(name) for name in config.arms}
        self._refuse_what_is_never_drawn(arms)
        self.search = Search(config.model_dump(mode="json"), arms, self._final, optuna_version())

    def empty(self) -> Manifest:
        """The manifest before any trial."""
        config = self.config
        return Manifest(
            name=config.name, axes=AXES, cells=(), seeds=config.seed_list(), resources=config.resources,
            retry=config.retry, tracking=settled(config.tracking, config.name), baseline="",
            instances={name: hashlib.sha256(content).hexdigest()
                       for name, content in sorted(self._files.contents.items())},
            code=code_digest(), git=git_state(), search=self.search,
        )  # fmt: skip

    def _arm(self, name: str) -> ArmRecord:
        data = base_of(self.config, name, self._folder)
        with about(f"arms.{name}"):
            space = self.config.space(name, self._known(data))
            if not space:
                raise ConfigError("nothing to search: no condition of what is named under search holds")
            setting = self._refuse_what_cannot_be(data, space)
            config = resolved_cell(self.config.name, name, _with(data, setting), "")
            if self.config.objective.kind == "worst" and config.evaluation.episodes < 2:
                raise ConfigError(
                    "objective.kind: worst measures the worst instances on one half of the evaluation episodes and "
                    "chooses them on the other: it needs evaluation.episodes of 2 or more"
                )
            cell, steps = frozen_cell(self.config.resources, config, {}, name, "", self._files, self._specs)
            self._refuse_rungs(config)
            if self.config.population is not None and config.schedule:
                raise ConfigError("schedule: a population finds one; its runs cannot have one to begin with")
            self._final = self._final_sets(config)
        with about("confirm.set"):
            resolved_cell(self.config.name, name, _with(_with(data, setting), self.config.confirm.set), "confirm.set")
        self.steps += steps * len(self.config.seed_list()) * self.config.trials
        base = {**data, "instances": dict(cell.config["instances"])}
        if "init_from" in cell.config and cell.config["init_from"] is not None:
            base["init_from"] = cell.config["init_from"]
        return ArmRecord(base, {key: one.model_dump(mode="json") for key, one in space.items()})

    @staticmethod
    def _known(data: dict[str, Any]) -> dict[str, Any]:
        """The value of every key that is not searched, defaults included where these can be told."""
        try:
            whole = configs.parse(data, "").model_dump(mode="json")
        except ConfigError:  # what it lacks, trials may have
            whole = data
        return dict(configs.flattened(whole))

    def _refuse_what_cannot_be(self, data: dict[str, Any], space: Mapping[str, Distribution]) -> dict[str, Any]:
        """Raise ConfigError for a key, or a value of one, that no setting of the space makes a config of.

        Returns a setting that is one. Combinations may still be refused: these are failed trials.
        """
        fitting: dict[str, Any] = {}
        for key, one in space.items():
            for value in one.extremes():
                fault = None
                for setting in completions(space, self.config.seed, key, value, _TRIED):
                    try:
                        resolved_cell(self.config.name, "arm", _with(data, setting), f"search: {key}: {value}")
                    except ConfigError as error:
                        fault = fault or error
                    else:
                        fitting, fault = setting, None
                        break
                if fault is not None:
                    raise fault
        return fitting

    def _refuse_what_is_never_drawn(self, arms: Mapping[str, ArmRecord]) -> None:
        for key in self.config.search:
            if not any(key in arm.space for arm in arms.values()):
                raise ConfigError(f"search.{key} is never drawn: its condition (when) holds in no arm")
        for name, arm in self.config.arms.items():
            for key in arm.search:
                if key not in arms[name].space:
                    raise ConfigError(f"arms.{name}.search.{key} is never drawn: its condition (when) cannot hold")

    def _refuse_rungs(self, config: RunConfig) -> None:
        """Raise ConfigError where trials could not be compared: no evaluation is made at a rung, or none is within."""
        key = "pruner.rungs" if self.config.population is None else "population.every_steps"
        every, budget = config.evaluation.every_steps, config.budget.steps
        *rungs, _ = self.config.rungs(budget)
        for rung in rungs:
            if rung.steps >= budget or (rung.steps and next_evaluation(every, rung.steps - 1) != rung.steps):
                raise ConfigError(
                    f"{key}: trials cannot be compared at {rung.steps:,} steps: these must be fewer than budget.steps "
                    f"= {budget:,}, and steps of an evaluation (evaluation.every_steps: {every})"
                )
        if self.config.population is not None and not rungs:
            raise ConfigError(f"{key} must be less than budget.steps = {budget:,}, or nobody is ever copied")

    def _final_sets(self, config: RunConfig) -> dict[str, str]:
        """The instance files of the confirmation. Raises ConfigError where it would not be held out from the search."""
        named = {split: str(configs.beside(path, self._folder))
                 for split, path in (("train", self.config.confirm.instances.train),
                                     ("test", self.config.confirm.instances.test)) if path is not None}  # fmt: skip
        files = config.instances.model_copy(update={split: Path(path) for split, path in named.items()})
        section = config.env.model_dump_json()
        search = Blueprint(config, self._specs[section])
        confirmed = Blueprint(config.model_copy(update={"instances": files}), self._specs[section])
        train, development = self._files.sets(search)
        with about("confirm.instances"):
            final_train, final = self._files.sets(confirmed)
            _refuse_seen(development, final, "the development instances (instances.test of the search)")
            refuse_overlap(train, final, "the search's training instances", "confirm.instances.test")
        return {"train": f"instances/{self._files.name(final_train)}", "test": f"instances/{self._files.name(final)}"}


def _refuse_seen(development: InstanceSet, final: InstanceSet, what: str) -> None:
    """Raise ConfigError if a context of the final set is one that the search was judged by."""
    if development.names != final.names:
        raise ConfigError(f"test has other features than {what}: {', '.join(final.names)}")
    first, second = repeats(np.vstack((development.contexts, final.contexts)))
    shared = int(((first < len(development)) & (second >= len(development))).sum())
    if shared:
        raise ConfigError(
            f"test shares {shared} of its {len(final)} contexts with {what}: settings chosen by them cannot be "
            "confirmed by them. `space-dist instances sample` draws other ones"
        )


def _with(base: Mapping[str, Any], setting: Mapping[str, Any]) -> dict[str, Any]:
    """A run config's plain data with a setting. Raises ConfigError where a key is within what is no section."""
    data: dict[str, Any] = json.loads(json.dumps(base))
    for key, value in setting.items():
        configs.put(data, key, json.loads(json.dumps(value)), key)
    return data


# ---- asking ----------------------------------------------------------------------------------------------------------


def _asked(manifest: Manifest, grid: Grid) -> Manifest:
    """The manifest with the next generation of every arm. Settings that no config can have are failed trials."""
    search = manifest.searched
    config = TuneConfig.model_validate(search.config)
    seeds, steps = _given(manifest, _rungs(search)[0])
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


def _rungs(search: Search) -> list[Rung]:
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
    data = _with(search.arms[arm].base, setting)
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
    _refuse_held_up(grid, found)
    if search.open:
        manifest = _judged(grid, manifest, search, found)
    else:
        _refuse_other_optuna(search)
        manifest = _asked(manifest, grid)
    grid.freeze(manifest, {})
    return manifest


def _refuse_held_up(grid: Grid, found: Sequence[RunStatus]) -> None:
    for one in found:
        if one.condition == "failed" and one.cause is not None and one.cause not in OF_THE_SETTING:
            raise HeldUpError(
                f"{one.run.title}: {one.in_words}, which says nothing of its setting, so the search does not go on "
                f"without it; `space-dist grid retry {grid.folder} --cause {one.cause}` lets it be tried again"
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
    config, rungs = TuneConfig.model_validate(search.config), _rungs(search)
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
        first, schedule = _in_force(search.with_trials([*search.trials, *heirs, heir]), heir, rungs)
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


def _in_force(
    search: Search, trial: Trial, rungs: Sequence[Rung]
) -> tuple[Mapping[str, Any], list[Mapping[str, Any]]]:  # fmt: skip
    """The settings that a trial began with, and how they changed on the way: a config's `schedule`."""
    first, *later = search.lineage(trial)
    # An heir's generation is the number of the rung at which it was copied.
    schedule: list[Mapping[str, Any]] = [
        {"steps": rungs[heir.generation - 1].steps, "set": dict(heir.parameters)} for heir in later
    ]
    return first.parameters, schedule


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


# ---- the confirmation ------------------------------------------------------------------------------------------------


def confirmation(grid: Grid, manifest: Manifest) -> Path:
    """Write the grid that confirms a search: the best setting of each arm, fresh seeds, the final instances.

    A run config for each arm and the grid's file, in `confirm` in the search's folder; returns the grid's file. Raises
    ConfigError if the search is not over, an arm has no complete trial, or a setting cannot be confirmed; LedgerError
    if the folder cannot be written.
    """
    search = manifest.search
    if search is None:
        raise ConfigError(f"{grid.folder} holds a grid, and no search")
    if not search.over:
        raise ConfigError(
            f"the search of {grid.folder} is not over: the outcome of "
            f"{sum(trial.state != 'open' for trial in search.trials)} of {search.total} trials is known; "
            f"`space-dist tune run {grid.folder}` goes on"
        )
    config = TuneConfig.model_validate(search.config)
    files: dict[str, bytes] = {}
    for arm, record in search.arms.items():
        best = search.best(arm)
        if best is None:
            raise ConfigError(f"arm {arm} has nothing to confirm: none of its {config.trials} trials is complete")
        first, schedule = _in_force(search, best, _rungs(search))
        data = _with(_with(record.base, first), config.confirm.set)
        if schedule:
            data["schedule"] = schedule
        for split, path in search.final.items():
            configs.put(data, f"instances.{split}", f"../{path}", "confirm")
        if data.get("init_from") is not None:
            data["init_from"] = f"../{data['init_from']}"
        data["name"] = f"{manifest.name}_{arm}"[:100]
        files[f"{arm}.yaml"] = f"# Arm {arm} of the search {manifest.name}: trial {best.number}.\n".encode()
        files[f"{arm}.yaml"] += configs.to_yaml(data).encode()
    name = confirmation_of(manifest.name)
    whole = {
        "name": name, "extends": [f"{arm}.yaml" for arm in search.arms], "seeds": list(config.confirm_seeds()),
        "resources": manifest.resources.model_dump(mode="json"), "retry": manifest.retry.model_dump(mode="json"),
        "tracking": manifest.tracking.model_dump(mode="json"),
    }  # fmt: skip
    files[f"{name}.yaml"] = f"# The confirmation of the search {manifest.name}.\n".encode()
    files[f"{name}.yaml"] += configs.to_yaml(whole).encode()
    folder = grid.folder / "confirm"
    try:
        folder.mkdir(exist_ok=True)
        for file, content in files.items():
            atomic_write(folder / file, content)
    except OSError as error:
        raise LedgerError(f"cannot write {folder}: {in_words(error)}") from None
    for arm in search.arms:
        configs.load(folder / f"{arm}.yaml")  # for its errors: a setting and confirm.set may not go together
    return folder / f"{name}.yaml"
