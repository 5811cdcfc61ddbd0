"""A search, from its YAML file to its confirmation: a grid whose manifest grows, generation by generation.

plan_search       the file checked, the first generation asked, all of it frozen
trials.advance    when all runs of the open trials are over: what they reached is recorded, the pruner decides who
goes on, and where nobody does, the next generation is asked
confirmation      the best setting of each arm as a grid's file
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from space_dist import config as configs
from space_dist.config import RunConfig
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, LedgerError, about
from space_dist.experiment.manifest import Grid, Manifest
from space_dist.experiment.sampling import (
    completions,
    optuna_version,
)
from space_dist.experiment.search import ArmRecord, Search
from space_dist.experiment.tuning import (
    Distribution,
    TuneConfig,
    base_of,
    confirmation_of,
    load_tune,
)
from space_dist.grid.conductor import freeze
from space_dist.grid.planning import InstanceFiles, frozen_cell, resolved_cell
from space_dist.grid.trials import asked, with_settings
from space_dist.instances import InstanceSet, refuse_overlap, repeats
from space_dist.run.building import Blueprint
from space_dist.run.rows import next_evaluation
from space_dist.system.files import atomic_write, in_words
from space_dist.system.provenance import code_digest, git_state
from space_dist.tracking.settling import settled

AXES: Final = ("arm", "trial")
_TRIED: Final = 24  # random settings around one value, until one of them is a config
_MAY_CHANGE: Final = ("trials", "resources", "retry", "tracking")  # of a search that has begun


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
            manifest = asked(planned.empty(), grid)
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
            f"{grid.folder} holds a grid of this name; give the search another name, or it another folder"
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
            f"{grid.folder} holds another search of this name, which was planned with another {forbidden[0]}; a search "
            f"that is planned may change {', '.join(_MAY_CHANGE)}. {_ways_out(grid, begun)}"
        )
    if {**before, "config": 0} != {**now, "config": 0}:
        raise ConfigError(
            f"{grid.folder} holds another search of this name: the run config that it extends, or an instance file, "
            f"has changed since. {_ways_out(grid, begun)}"
        )
    if not changes:
        return begun
    if "trials" in changes:
        _refuse_trials(grid, begun, int(planned.config["trials"]))
    if grid.owner_alive():
        raise ConfigError(f"{grid.folder} is being worked on; `space-dist grid stop {grid.folder}` ends that")
    config = TuneConfig.model_validate(planned.config)
    manifest = dataclasses.replace(
        begun, resources=config.resources, retry=config.retry, tracking=settled(config.tracking, begun.name),
        search=dataclasses.replace(search, config=planned.config),
    )  # fmt: skip
    grid.freeze(manifest, {})
    return grid.manifest()


def _ways_out(grid: Grid, begun: Manifest) -> str:
    """What a user may do whose search has the name of another one."""
    others = "Give it another name, or use another --root"
    if any(grid.ledger(run).folder.exists() for run in begun.runs()) or begun.searched.generation > 0:
        return others
    return f"{others}; or, since nothing of it has run yet, remove {grid.folder}"


def _refuse_trials(grid: Grid, begun: Manifest, wanted: int) -> None:
    """Raise ConfigError where a search that had been planned with so many trials would not have asked the same ones."""
    search = begun.searched
    trials, each = int(search.config["trials"]), int(search.config["generation"])
    if search.config["population"] is not None:
        raise ConfigError(
            f"trials: {grid.folder} has a population of {trials}, which cannot change its size. "
            f"{_ways_out(grid, begun)}"
        )
    asked_of_each = search.asked // len(search.arms)
    # As long as there are more to ask, every generation was asked whole.
    if wanted < asked_of_each:
        raise ConfigError(
            f"trials: {grid.folder} was planned with {trials}, and {asked_of_each} of each arm were asked; a search "
            f"may get more trials, and not fewer than were asked. {_ways_out(grid, begun)}"
        )
    if wanted > trials and trials % each and asked_of_each == trials:
        raise ConfigError(
            f"trials: the last generation of {grid.folder} was asked with {trials % each} trials of {each}; a search "
            f"may get more trials where those it has are a multiple of generation: {each}. {_ways_out(grid, begun)}"
        )


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
        setting = self._refuse_what_cannot_be(name, data, space)
        with about(f"arms.{name}"):
            config = resolved_cell(self.config.name, name, with_settings(data, setting), "")
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
            confirmed = with_settings(with_settings(data, setting), self.config.confirm.set)
            resolved_cell(self.config.name, name, confirmed, "confirm.set")
        self.steps += steps * len(self.config.seed_list()) * self.config.trials
        base = {**data, "instances": dict(cell.config["instances"])}
        _with_given(base, cell.config, "")
        return ArmRecord(base, {key: one.model_dump(mode="json") for key, one in space.items()})

    @staticmethod
    def _known(data: dict[str, Any]) -> dict[str, Any]:
        """The value of every key that is not searched, defaults included where these can be told."""
        try:
            whole = configs.parse(data, "").model_dump(mode="json")
        except ConfigError:  # what it lacks, trials may have
            whole = data
        return dict(configs.flattened(whole))

    def _refuse_what_cannot_be(
        self, arm: str, data: dict[str, Any], space: Mapping[str, Distribution]
    ) -> dict[str, Any]:
        """Raise ConfigError for a key, or a value of one, that no setting of the space makes a config of.

        Returns a setting that is one. Combinations may still be refused: these are failed trials.
        """
        fitting: dict[str, Any] = {}
        for key, one in space.items():
            for value in one.extremes():
                where, fault = f"arms.{arm}: search: {key}: {value}", None
                for setting in completions(space, self.config.seed, key, value, _TRIED):
                    try:
                        with about(f"arms.{arm}"):
                            tried = with_settings(data, setting)
                        resolved_cell(self.config.name, "arm", tried, where)
                    except ConfigError as error:
                        fault = fault or error
                    else:
                        fitting, fault = setting, None
                        break
                if fault is not None:
                    raise ConfigError(self._at_its_place(str(fault), where, arm)) from fault
        return fitting

    def _at_its_place(self, told: str, where: str, arm: str) -> str:
        """Faults of a setting, each with the section that has its key in the file, in place of the setting tried."""
        return "\n".join(
            f"{self._place_of(key, where, arm)}: {key}: {rest}" if line.startswith(where) and rest else line
            for line in told.splitlines()
            for key, _, rest in [line.removeprefix(f"{where}: ").partition(": ")]
        )

    def _place_of(self, key: str, otherwise: str, arm: str) -> str:
        """Which section of the file gave a key, or what it is a part of; `otherwise` for one that several may have."""
        ours = self.config.arms[arm]
        places = [("search", self.config.search), (f"arms.{arm}.search", ours.search),
                  (f"arms.{arm}.set", ours.set), ("set", self.config.set)]  # fmt: skip
        written = [(name, place) for place, keys in places for name in keys]
        around = [(len(name), place) for name, place in written if f"{key}.".startswith(f"{name}.")]
        if around:
            return max(around, key=lambda one: one[0])[1]
        is_whole = any(name.startswith(f"{key}.") for name, _ in written) or "." not in key
        return otherwise if is_whole else f"extends: {self.config.extends}"

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
        if self.config.population is not None and (config.budget.episodes is not None or config.curriculum.may_probe):
            raise ConfigError(
                "population: its runs must all come to every comparison, and one whose curriculum probes, or that has "
                "budget.episodes, may have ended before"
            )
        horizon = self._specs[config.env.model_dump_json()].horizon
        round_steps = config.round_steps(horizon)
        for rung in rungs:
            if -(-rung.steps // round_steps) * round_steps + round_steps > budget:
                raise ConfigError(
                    f"{key}: {rung.steps:,} steps leave no room for another round of {round_steps:,} within "
                    f"budget.steps = {budget:,}: runs have ended by then, and nothing is left to race for"
                )
            if rung.steps and next_evaluation(every, rung.steps - 1) != rung.steps:
                raise ConfigError(
                    f"{key}: trials cannot be compared at {rung.steps:,} steps: these must be steps of an "
                    f"evaluation (evaluation.every_steps: {every})"
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


def _with_given(data: dict[str, Any], frozen: Mapping[str, Any], prefix: str) -> None:
    """Name in `data` what other runs have given where it lies in a grid's folder, as `frozen` does, behind `prefix`."""
    if frozen.get("init_from") is not None:
        data["init_from"] = f"{prefix}{frozen['init_from']}"
    if "of" in data.get("curriculum", {}):
        data["curriculum"] = {**data["curriculum"], "of": f"{prefix}{frozen['curriculum']['of']}"}


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
        first, schedule = search.in_force(best)
        data = with_settings(with_settings(record.base, first), config.confirm.set)
        if schedule:
            data["schedule"] = schedule
        for split, path in search.final.items():
            configs.put(data, f"instances.{split}", f"../{path}", "confirm")
        _with_given(data, record.base, "../")
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
