"""What a user writes of a search: one run config, what is searched, arms that are compared, and their confirmation.

Every arm gets the same number of trials, every trial the same seeds: a comparison of tuned arms is fair by
construction. What the search finds on the development instances is confirmed with fresh seeds on the final ones.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, field_validator, model_validator

from space_dist import config as configs
from space_dist.config import Name, Section
from space_dist.errors import ConfigError, NotPlannedError, nearest
from space_dist.experiment.grid_file import MAX_RUNS, GridTracking, Retry, RunResources, SeedRange, Seeds
from space_dist.experiment.manifest import MANIFEST, Grid, in_root

MAX_TRIALS = 10_000  # of an arm
_MAX_CHOICES = 1000
_CONFIRMED = "-confirm"  # what the confirmation's grid is called, behind the search's name
_SAME_FOR_ALL = {  # what must not differ between trials, and why
    "seed": "every trial runs with the same `seeds`",
    "name": "trials are named by the search",
    "tracking": "it decides no result; the search's own section `tracking` does",
    "resources": "it decides no result; the search's own section `resources` does",
    "instances": "returns on other instances are no better or worse, but of another task",
    "budget": "whoever trains longer is not better tuned",
    "evaluation": "returns that are measured otherwise are not comparable",
    "env.id": "returns in another environment are of another task",
    "env.kwargs": "returns in another environment are of another task",
    "init_from": "what a run starts from is no setting of it",
    "checkpoint": "it decides no result",
}
_FOR_ALL_AT_ONCE = ("instances", "budget", "evaluation", "env.id", "env.kwargs", "init_from", "checkpoint")


class Distribution(Section):
    """What a key is drawn from: one of `float`, `int` and `choice`."""

    floats: tuple[float, float] | None = Field(default=None, alias="float", strict=False)
    """Real numbers from the first to the second, drawn with six digits."""
    ints: tuple[int, int] | None = Field(default=None, alias="int", strict=False)
    """Whole numbers from the first to the second, both included."""
    choice: tuple[Any, ...] | None = Field(default=None, strict=False)
    """Any of these values; a value may be a list or a whole section."""
    log: bool = False
    """Of float and int: draw by the logarithm, so that 0.001 to 0.01 is as likely as 0.01 to 0.1."""
    when: dict[str, Any] = Field(default={})
    """Draw it only where these keys, searched or not, have these values (or one of a list of them)."""

    @model_validator(mode="after")
    def _one_that_is_not_empty(self) -> Self:
        given = [name for name, value in (("float", self.floats), ("int", self.ints), ("choice", self.choice))
                 if value is not None]  # fmt: skip
        if len(given) != 1:
            raise ValueError(
                f"needs exactly one of float, int and choice, not {' and '.join(given) or 'none'}; "
                "like {float: [0.0001, 0.01], log: true}"
            )
        if self.choice is not None:
            if self.log:
                raise ValueError("log is for float and int; a choice has no logarithm")
            if len(self.choice) > _MAX_CHOICES:
                raise ValueError(f"a choice of {len(self.choice)} values; it may have {_MAX_CHOICES}")
            if len({*self.encoded}) < max(2, len(self.choice)):
                raise ValueError("choice needs at least two values, each of them once; a single one belongs under set")
            return self
        low, high = self.floats or self.ints or (0, 0)
        if low >= high:
            raise ValueError(
                f"{given[0]}: [{low}, {high}] is empty: the first must be below the second"
                + ("; a single value belongs under set" if low == high else "")
            )
        if self.log and low <= 0:
            raise ValueError(f"log needs a range above 0, not one from {low}")
        return self

    @property
    def encoded(self) -> tuple[str, ...]:
        """The values of a choice as JSON, by which 1, 1.0 and true are told apart."""
        return tuple(json.dumps(value, sort_keys=True) for value in self.choice or ())

    def extremes(self) -> list[Any]:
        """Values with which no config of the space is as likely to be refused: the ends, or every one of a choice."""
        return list(self.choice or self.floats or self.ints or ())

    def can_be(self, value: Any) -> bool:
        """Whether it can be drawn."""
        if self.choice is not None:
            return value in self.choice
        low, high = self.floats or self.ints or (math.inf, -math.inf)
        return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high

    def holds(self, known: Mapping[str, Any]) -> bool:
        """Whether its condition holds, given the values of keys; one that has none does not."""
        return all(key in known and known[key] in allowed(value) for key, value in self.when.items())


def _within(key: str, section: str) -> bool:
    return f"{key}.".startswith(f"{section}.")


def allowed(value: Any) -> list[Any]:
    """The values that a condition names: one, or those of a list."""
    return value if isinstance(value, list) else [value]


class Arm(Section):
    """One of what is compared, most often a curriculum."""

    set: dict[str, Any] = Field(default={})
    """Config keys and values of this arm: {curriculum: {kind: space}}."""
    search: dict[str, Distribution] = Field(default={})
    """What is searched for this arm beside what all have in common."""


class Objective(Section):
    """What a trial is judged by: one number over its seeds, of returns on the development instances."""

    kind: Literal["final", "worst", "area", "steps"] = "final"
    """final: IQM over seeds of the final return. worst: of that on the worst tenth of the instances (CVaR), which needs
    evaluation.episodes of 2 or more. area: of the area under the curve over the budget. steps: environment steps to the
    threshold, seeds that do not reach it counted as the budget, their mean; less is better. As in reports."""
    threshold: float | None = None
    """Of steps: the return to reach, in the environment's units, in three evaluations in a row."""

    @model_validator(mode="after")
    def _threshold_is_for_steps(self) -> Self:
        if (self.kind == "steps") != (self.threshold is not None):
            raise ValueError(
                "kind: steps needs a threshold, the return to reach" if self.kind == "steps" else
                f"threshold says nothing with kind: {self.kind}; it is for kind: steps"
            )  # fmt: skip
        return self


class Sampler(Section):
    """Who draws: a sampler of Optuna's."""

    kind: Literal["tpe", "random"] = "tpe"
    """tpe: the tree-structured Parzen estimator, arm by arm, from what its earlier generations have found. random."""
    startup: int = Field(default=10, ge=1)
    """Of tpe: so many trials of an arm are drawn at random first. Source: Optuna's default."""
    multivariate: bool = False
    """Of tpe: draw settings jointly and not one by one. Source: Optuna's default before its version 5."""


class Rung(Section):
    """How far trials have got when they are compared."""

    seeds: int = Field(default=0, ge=0)
    """Runs of so many seeds, from the first; 0: of all."""
    steps: int = Field(default=0, ge=0)
    """So many environment steps of each, as many as an evaluation is made at; 0: the whole budget."""

    def precedes(self, other: Rung) -> bool:
        """Whether it asks for less than another one, and for more of nothing."""
        ours, theirs = ((one.seeds or math.inf, one.steps or math.inf) for one in (self, other))
        return ours != theirs and ours[0] <= theirs[0] and ours[1] <= theirs[1]

    def __str__(self) -> str:
        seeds = "all seeds" if not self.seeds else "1 seed" if self.seeds == 1 else f"{self.seeds} seeds"
        return f"{seeds}, {f'{self.steps:,}' if self.steps else 'all'} steps"


WHOLE: Final = Rung()  # all seeds, the whole budget


class Pruner(Section):
    """Racing: which trials are given up. Whoever is left goes on to the next rung, in the end to all of both."""

    kind: Literal["halving", "median"] = "halving"
    """halving: at each rung the best share of an arm's generation goes on (successive halving; Optuna's own depends on
    who ends first). median: Optuna's: whoever is below the median, at this rung, of the arm's complete trials does not
    go on."""
    rungs: tuple[Rung, ...] = Field(default=(Rung(seeds=1),), strict=False, min_length=1, max_length=100)
    """Where trials are compared, ascending: after so many seeds, fewer than `seeds`; or after so many seeds and so many
    steps of each, like {seeds: 1, steps: 40960}. Runs that are paused at a rung go on from there."""
    keep: float = Field(default=1 / 3, gt=0.0, lt=1.0)
    """Of halving: the share that goes on, rounded up. Source: a third is Hyperband's (Li et al. 2018)."""
    startup: int = Field(default=5, ge=1)
    """Of median: so many trials of an arm are complete before any is given up. Source: Optuna's default."""

    @field_validator("rungs", mode="before")
    @classmethod
    def _seeds_alone(cls, value: Any) -> Any:
        given = list(value) if isinstance(value, list | tuple) else value
        return [{"seeds": one} if type(one) is int else one for one in given] if isinstance(given, list) else given


class Population(Section):
    """Population-based training: every so often the worst members of an arm go on with the state of its best ones, and
    with other settings. Source: Jaderberg et al. 2017.

    An arm's `trials` are its members at the start. Each copy is another trial, which has its parent's settings up to
    where it was copied: so what is found is a schedule of settings, and any run of it, from its start, has the bits of
    the one that was copied.
    """

    every_steps: int = Field(ge=1)
    """Environment steps between two comparisons: a multiple of those between evaluations."""
    replace: float = Field(default=0.2, gt=0.0, le=0.5)
    """The share of the worst that goes on from the same share of the best, rounded up. Source: Jaderberg et al."""
    factors: tuple[Annotated[float, Field(gt=0.0)], ...] = Field(default=(0.8, 1.2), strict=False, min_length=1)
    """A copied number is multiplied by one of them, and kept within its range. Source: Jaderberg et al. 2017."""
    resample: float = Field(default=0.25, ge=0.0, le=1.0)
    """The chance that a setting is drawn anew instead; a choice is so, or stays. Source: Ray Tune's."""


class FinalInstances(Section):
    """What the confirmation trains and tests on."""

    train: str | None = None
    """CSV of training instances; null: the search's. A relative path is relative to this file."""
    test: str
    """CSV of the final held-out instances, none of which the search has seen."""


class Confirmation(Section):
    """What becomes of the best setting of each arm: a grid of its own, with fresh seeds on the final instances."""

    seeds: Seeds
    """Seeds, none of them the search's: a list, or start and count. Ten say something (docs/reports.md)."""
    instances: FinalInstances
    set: dict[str, Any] = Field(default={})
    """Config keys and values for all arms, like budget.steps for a longer training."""


class TuneConfig(Section):
    """A search: `trials` settings for each of `arms`, each run with `seeds`."""

    name: Name = Field(max_length=100 - len(_CONFIRMED))
    """Name of the search, in folders, tables and MLflow: letters, digits, dot, underscore, hyphen."""
    extends: str = Field(min_length=1)
    """The run config (YAML) that all trials start from, relative to this file. Its `instances.test`, or that of `set`,
    are the development instances."""
    set: dict[str, Any] = Field(default={})
    """Config keys and values for every trial."""
    search: dict[str, Distribution] = Field(default={})
    """What is searched for every arm: a distribution by config key."""
    arms: dict[str, Arm] = Field(min_length=1)
    """What is compared, by name."""
    trials: int = Field(ge=1, le=MAX_TRIALS)
    """Settings of each arm that are tried."""
    seeds: Seeds
    """Every trial runs with each: a list, or start and count. Three or more: one seed crowns luck."""
    generation: int = Field(default=5, ge=1)
    """Trials of each arm that are asked at once, after all before them are over: so many can run side by side, and so
    many know nothing of each other."""
    objective: Objective = Objective()
    sampler: Sampler = Sampler()
    pruner: Pruner | None = None
    """Racing over seeds and steps; null: every trial gets all."""
    population: Population | None = None
    """Population-based training, in place of sampler, pruner and generations; null: settings stay what they were."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """The one number from which the sampler's draws come."""
    confirm: Confirmation
    resources: RunResources = RunResources()
    retry: Retry = Retry()
    tracking: GridTracking = GridTracking()

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        self._refuse_names()
        self._refuse_keys()
        ours, theirs = self.seed_list(), self.confirm_seeds()
        for where, seeds in (("seeds", ours), ("confirm.seeds", theirs)):
            if not seeds or len({*seeds}) < len(seeds):
                raise ValueError(f"{where}: at least one, and every seed once")
        if both := sorted({*ours} & {*theirs}):
            raise ValueError(
                f"confirm.seeds: {both[0]} is one of the search's seeds; a setting that was chosen by a seed is not "
                "confirmed by it"
            )
        if len(self.arms) * self.trials * len(ours) > MAX_RUNS:
            raise ValueError(f"more than {MAX_RUNS:,} runs; a search may have that many")
        if self.pruner is not None:
            self._refuse_rungs("; ".join(map(str, self.pruner.rungs)))
        if self.population is not None:
            self._refuse_other_ways()
        return self

    def _refuse_rungs(self, shown: str) -> None:
        *rungs, last = self.rungs(0)
        many = len(self.seed_list())
        ascending = all(one.precedes(other) for one, other in pairwise([*rungs, last]))
        if not ascending or any(rung.seeds > many for rung in rungs):
            raise ValueError(
                f"pruner.rungs: {shown}: numbers of seeds, ascending, each fewer than the {many} of a trial; or seeds "
                "and steps, of which each rung has more than the one before it, and of none of them less"
            )

    def _refuse_other_ways(self) -> None:
        for name in ("pruner", "generation", "sampler"):
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(
                    f"{name} says nothing with population: all members begin at once, at random, and are compared "
                    "every population.every_steps"
                )
        if self.trials < 2:
            raise ValueError("trials: a population has at least 2 members")
        for where, searched in self._searched():
            for key, one in searched.items():
                if one.when:
                    raise ValueError(f"{where}.{key}: a population's settings have no conditions (when)")
                if key not in configs.CHANGEABLE:
                    raise ValueError(
                        f"{where}.{key} cannot change on the way, as a population's settings do"
                        f"{nearest(key, configs.CHANGEABLE)} Allowed: {', '.join(configs.CHANGEABLE)}"
                    )

    def _refuse_names(self) -> None:
        for arm in self.arms:
            # It becomes a file's name.
            if not all((letter.isalnum() and letter.isascii()) or letter in "_-" for letter in arm) or len(arm) > 50:
                raise ValueError(f"arms: {arm[:60]!r}: a name has letters, digits, underscores and hyphens, at most 50")

    def _refuse_keys(self) -> None:
        for section, keys in self._sections():
            for key in keys:
                if not all(key.split(".")):
                    raise ValueError(f"{section}: {key!r} is not a config key")
                shared = next((name for name in _SAME_FOR_ALL if _within(key, name) or _within(name, key)), None)
                if shared is None or (section in ("set", "confirm.set") and shared in _FOR_ALL_AT_ONCE):
                    continue
                raise ValueError(f"{section}.{key} is nothing that trials may differ in: {_SAME_FOR_ALL[shared]}")
        if any(_within(key, "instances") for key in self.confirm.set):
            raise ValueError("confirm.set: the final instances are named by confirm.instances")
        if "init_from" in self.confirm.set:
            raise ValueError("confirm.set.init_from: what is confirmed starts from what the search's runs started from")
        for name, arm in self.arms.items():
            searched = [*self.search, *arm.search]
            if not searched:
                raise ValueError(
                    f"arms.{name} has nothing to search: name keys under search, or under arms.{name}.search"
                )
            for place, key in enumerate(searched):
                if key in searched[:place] or key in self.set or key in arm.set:
                    raise ValueError(f"arms.{name}: {key} is given twice; a key is searched once, or has one value")
                for other in (*searched, *self.set, *arm.set):
                    if other != key and _within(other, key):
                        raise ValueError(f"arms.{name}: {other} is a part of {key}, which is searched as a whole")

    def rungs(self, budget: int) -> list[Rung]:
        """Where trials are compared, and last what a trial that is not given up comes to. budget: steps of a run."""
        many = len(self.seed_list())
        if self.population is not None:
            each = self.population.every_steps
            return [*(Rung(steps=steps) for steps in range(each, budget, each)), WHOLE]
        rungs = () if self.pruner is None else self.pruner.rungs
        return [*(rung.model_copy(update={"seeds": 0 if rung.seeds == many else rung.seeds}) for rung in rungs), WHOLE]

    @property
    def asked_at_once(self) -> int:
        """Trials of an arm that a generation has; of a population, all its members."""
        return self.trials if self.population is not None else self.generation

    def _searched(self) -> Iterator[tuple[str, dict[str, Distribution]]]:
        yield "search", self.search
        for name, arm in self.arms.items():
            yield f"arms.{name}.search", arm.search

    def _sections(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Every section that has config keys."""
        yield "set", tuple(self.set)
        yield "search", tuple(self.search)
        yield "confirm.set", tuple(self.confirm.set)
        for name, arm in self.arms.items():
            yield f"arms.{name}.set", tuple(arm.set)
            yield f"arms.{name}.search", tuple(arm.search)

    def seed_list(self) -> tuple[int, ...]:
        """Every seed of a trial."""
        return _listed(self.seeds)

    def confirm_seeds(self) -> tuple[int, ...]:
        """Every seed of the confirmation."""
        return _listed(self.confirm.seeds)

    def space(self, arm: str, known: Mapping[str, Any]) -> dict[str, Distribution]:
        """What is searched for an arm, whoever is asked about first: a condition comes after the key it is about.

        known: the values of the arm's keys that are not searched. Conditions on these are decided here: what can never
        be drawn is left out, and of `when` what depends on draws is left. Raises ConfigError for a condition on a key
        that there is not, and for conditions in a circle.
        """
        given = {**self.search, **self.arms[arm].search}
        left: dict[str, Distribution] = {}
        for key, one in given.items():
            for name in one.when:
                if name not in known and name not in given:
                    names = [*given, *known]
                    raise ConfigError(f"{key}: when: {name}: there is no such key{nearest(name, names)}")
            still = {name: value for name, value in one.when.items() if name in given}
            fixed = one.model_copy(update={"when": {k: v for k, v in one.when.items() if k not in given}})
            if fixed.holds(known):
                left[key] = one.model_copy(update={"when": still})
        return _in_order(left)


def _in_order(space: Mapping[str, Distribution]) -> dict[str, Distribution]:
    """What can be drawn of it, conditions behind the keys they are about.

    Raises ConfigError where these go round in a circle.
    """
    ordered: dict[str, Distribution] = {}
    rest = dict(space)
    while rest:
        ready = next((key for key, one in rest.items() if not any(name in rest for name in one.when)), None)
        if ready is None:
            raise ConfigError(f"the conditions of {', '.join(rest)} go round in a circle: none can be drawn first")
        one = rest.pop(ready)
        if all(name in ordered for name in one.when) and _can_hold(one, ordered):
            ordered[ready] = one
    return ordered


def _can_hold(one: Distribution, space: Mapping[str, Distribution]) -> bool:
    """Whether what is searched can take the values that its condition names."""
    return all(any(map(space[name].can_be, allowed(values))) for name, values in one.when.items())


def _listed(seeds: Any) -> tuple[int, ...]:
    if isinstance(seeds, SeedRange):
        return tuple(range(seeds.start, seeds.start + seeds.count))
    return tuple(seeds)


def confirmation_of(name: str) -> str:
    """What the grid is called that confirms a search."""
    return f"{name}{_CONFIRMED}"


def is_search(data: Mapping[str, Any]) -> bool:
    """Whether what a YAML file holds is a search, and no grid and no run."""
    return "arms" in data and "env" not in data


def load_tune(path: Path) -> TuneConfig:
    """A search's file, checked. Raises ConfigError with file and key of every fault."""
    data = configs.read_named(path)
    if not is_search(data):
        what = "the config of one run" if "env" in data else "a grid" if "grid" in data or "zip" in data else ""
        if what:
            how, called = ("train", "train") if "env" in data else ("grid run", "run_grid")
            raise ConfigError(
                f"{path} is {what}: space-dist {how} {path} (from Python: space_dist.{called}). A search has `arms`"
            )
        configs.refuse_profile(data, path)
    return configs.check(TuneConfig, data, str(path))


def base_of(config: TuneConfig, arm: str, folder: Path) -> dict[str, Any]:
    """What an arm's trials start from: a run config as plain data, its paths absolute. folder: that of the file."""
    data = configs.read(Path(configs.beside(config.extends, folder)))
    for key, value in (*config.set.items(), *config.arms[arm].set.items()):
        put(data, key, value, folder)
    for key in ("tracking", "resources", "seed"):  # the search's own
        data.pop(key, None)
    return data


def put(data: dict[str, Any], key: str, value: Any, folder: Path) -> None:
    """Set a key in a run config's plain data; the relative paths of a file are taken from its folder."""
    # A copy: trials that shared a list or a section would write into each other's.
    configs.put(data, key, json.loads(json.dumps(configs.from_folder(key, value, folder))), key)


def find_tune(path: Path, root: Path) -> Grid:
    """The search that a user names: its folder, its name below `root`, or its YAML file (planned below `root`).

    Raises ConfigError if the path names no search, NotPlannedError if a YAML file's search was never planned.
    """
    path = in_root(path, root)
    grid = Grid(path) if path.is_dir() else Grid(root / load_tune(path).name)
    if not grid.manifest_file.exists():
        raise NotPlannedError(
            f"{grid.folder} holds no search: it has no {MANIFEST}" if path.is_dir() else
            f"the search of {path} is not in {grid.folder}: `space-dist tune plan {path}` plans it there "
            "(--root names another root)"
        )  # fmt: skip
    return grid


def differences(path: Path, frozen: Mapping[str, Any]) -> list[str]:
    """The keys, sorted, in which a search's file is another than what is frozen; none if `path` is a folder or a name.

    frozen: `Search.config`.
    """
    if not path.is_file():
        return []
    now = json.loads(json.dumps(load_tune(path).model_dump(mode="json")))
    return [*configs.changes(json.loads(json.dumps(frozen)), now)]
