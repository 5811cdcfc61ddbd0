"""A grid as its user writes it, in one YAML file: cells (settings) x seeds, and what its runs may use."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Discriminator, Field, Tag, field_validator, model_validator

from space_dist import config as configs
from space_dist.config import Mirrors, Name, Patience, Section
from space_dist.errors import ConfigError, nearest

MAX_SEED = 2**31 - 1
MAX_RUNS = 100_000  # a folder each; a typing error in a range makes millions
_MAX_LABEL = 120  # characters; what is cut is told apart by the id
_NOT_OF_A_GRID = {
    "seed": "seeds",
    "name": "name",
    "tracking": "tracking",
    "resources": "resources",
}


class SeedRange(Section):
    """Consecutive seeds."""

    start: int = Field(default=0, ge=0, le=MAX_SEED)
    """The first seed."""
    count: int = Field(ge=1, le=MAX_RUNS)
    """How many seeds."""

    @model_validator(mode="after")
    def _check(self) -> SeedRange:
        if self.start + self.count - 1 > MAX_SEED:
            raise ValueError(
                f"the last seed would be {self.start + self.count - 1}; the largest there is is {MAX_SEED}"
            )
        return self


def _listed_or_range(given: Any) -> Any:
    if not isinstance(given, list | tuple | Mapping | SeedRange):
        raise ValueError("write a list, like [0, 1, 2], or a range, like {start: 0, count: 10}")
    return given


def _seeds_are(given: Any) -> str:
    return "range" if isinstance(given, Mapping | SeedRange) else "list"


_SeedList = Annotated[tuple[Annotated[int, Field(ge=0, le=MAX_SEED)], ...], Field(strict=False)]
Seeds = Annotated[
    Annotated[_SeedList, Tag("list")] | Annotated[SeedRange, Tag("range")],
    Discriminator(_seeds_are),
    BeforeValidator(_listed_or_range),
]


class RunResources(Patience):
    """What each run may use. Decides no result."""

    workers: int = Field(default=0, ge=0, le=1024)
    """Ray rollout actors of each run, of one CPU each, beside the CPU of the run itself; 0: the run needs one CPU."""
    memory_mb: int | None = Field(default=None, ge=64)
    """Megabytes of memory (RSS of all the run's processes on its node) at which the run is ended; null: no limit."""
    minutes: float | None = Field(default=None, gt=0.0)
    """Wall time of one attempt, at which the run is asked to checkpoint and ends with cause timeout; null: no limit."""
    grace_seconds: float = Field(default=25.0, gt=0.0)
    """Time to reach a checkpoint when asked to stop, before the run is killed."""


class Retry(Section):
    """How often a run is tried again, by the cause of its end. Config errors never are."""

    preempted: int = Field(default=100, ge=0)
    """Asked to stop by somebody else's signal."""
    node_lost: int = Field(default=10, ge=0)
    """The machine it ran on went away."""
    out_of_memory: int = Field(default=0, ge=0)
    """It exceeded resources.memory_mb, or the system had no memory left."""
    timeout: int = Field(default=0, ge=0)
    """It exceeded resources.minutes. A retry goes on from the last checkpoint, so it may well get further."""
    crash: int = Field(default=0, ge=0)
    """It raised an error, or ended by a fault of its own."""
    killed: int = Field(default=3, ge=0)
    """Killed by an unknown hand (SIGKILL), or gone without a word."""


class GridTracking(Mirrors):
    """Where the grid is shown: MLflow, TensorBoard, Weights & Biases. Decides no result."""

    experiment: str | None = Field(default=None, min_length=1, max_length=200)
    """MLflow experiment; null: MLFLOW_EXPERIMENT_NAME of the environment, else the grid's name."""


Axes = dict[str, list[Any]]


class GridConfig(Section):
    """One grid: every combination of the axes of `grid`, times the rows of `zip`, less `exclude`, times `seeds`."""

    name: Name
    """Name of the grid, in folders, tables and MLflow: letters, digits, dot, underscore, hyphen."""
    extends: tuple[Annotated[str, Field(min_length=1)], ...] = Field(min_length=1, strict=False)
    """The run config (YAML) that cells start from, relative to this file; several: an axis of their own."""
    set: dict[str, Any] = Field(default={})
    """Config keys and values for every cell."""
    grid: Axes = Field(default={})
    """Axes by config key: all combinations. A value may be a whole section: curriculum: [{kind: space}, ...]."""
    zip: Axes = Field(default={})
    """Axes of equal length that go together: first values with first values, and so on."""
    exclude: tuple[dict[str, Any], ...] = Field(default=(), strict=False)
    """Cells to leave out: all those that have every key and value of an entry."""
    seeds: Seeds
    """Every cell runs with each: a list, or start and count."""
    resources: RunResources = RunResources()
    retry: Retry = Retry()
    tracking: GridTracking = GridTracking()
    baseline: dict[str, Any] = Field(default={})
    """What reports compare with: the cell that has all these keys and values; none: the first round robin cell, else
    the first cell."""
    threshold: float | None = Field(default=None, allow_inf_nan=False)
    """Steps to this test return are reported; none: to the baseline's final IQM."""

    @field_validator("extends", mode="before")
    @classmethod
    def _one_or_many(cls, value: Any) -> Any:
        return [value] if isinstance(value, str) else value

    @field_validator("grid", "zip", mode="before")
    @classmethod
    def _lists(cls, value: Any) -> Any:
        for key, values in value.items() if isinstance(value, dict) else ():
            if not isinstance(values, list) or not values:
                raise ValueError(f"{key} needs a list of at least one value")
        return value

    @model_validator(mode="after")
    def _axes(self) -> Self:
        for section in ("set", "grid", "zip"):
            for key in getattr(self, section):
                head = key.partition(".")[0]
                if head in _NOT_OF_A_GRID:
                    raise ValueError(
                        f"{section}.{key} decides no result of a cell; the grid's own key {_NOT_OF_A_GRID[head]!r} does"
                    )
                if not all(key.split(".")):
                    raise ValueError(f"{section}: {key!r} is not a config key")
        twice = sorted({*self.grid} & {*self.zip} | {*self.set} & ({*self.grid} | {*self.zip}))
        if twice:
            raise ValueError(f"{twice[0]} is given twice; a key may be in one of set, grid and zip")
        lengths = {key: len(values) for key, values in self.zip.items()}
        if len({*lengths.values()}) > 1:
            raise ValueError(
                "zip: all lists must be equally long: " + ", ".join(f"{k} {n}" for k, n in lengths.items())
            )
        if isinstance(self.seeds, tuple) and (not self.seeds or len({*self.seeds}) < len(self.seeds)):
            raise ValueError("seeds: at least one, and every seed once")
        known = {*self.axes()}
        for entry in (*self.exclude, self.baseline):
            unknown = [key for key in entry if key not in known]
            if unknown:
                raise ValueError(
                    f"exclude and baseline name cells by axes of this grid; {unknown[0]} is none"
                    f"{nearest(unknown[0], known)} Either may be misspelt. Axes: {', '.join(known) or 'none'}"
                )
        return self

    def axes(self) -> list[str]:
        """The keys in which cells differ, in the order of the file."""
        return [*(["extends"] if len(self.extends) > 1 else []), *self.zip, *self.grid]

    def seed_list(self) -> tuple[int, ...]:
        """Every seed."""
        if isinstance(self.seeds, SeedRange):
            return tuple(range(self.seeds.start, self.seeds.start + self.seeds.count))
        return self.seeds

    def points(self) -> Iterator[dict[str, Any]]:
        """The settings of every cell, by axis. Raises ConfigError if an entry of `exclude` leaves out nothing."""
        rows = [dict(zip(self.zip, row, strict=True)) for row in zip(*self.zip.values(), strict=True)] or [{}]
        bases = [{"extends": base} for base in self.extends] if len(self.extends) > 1 else [{}]
        unused = list(range(len(self.exclude)))
        for base, row, values in itertools.product(bases, rows, itertools.product(*self.grid.values())):
            point = {**base, **row, **dict(zip(self.grid, values, strict=True))}
            hits = [number for number, entry in enumerate(self.exclude) if _matches(point, entry)]
            unused = [number for number in unused if number not in hits]
            if not hits:
                yield point
        if unused:
            raise ConfigError(f"exclude: {json.dumps(self.exclude[unused[0]])} matches no cell")


def _matches(point: Mapping[str, Any], entry: Mapping[str, Any]) -> bool:
    return all(point[key] == value for key, value in entry.items())


def load_grid(
    path: Path, changes: Sequence[str] = ()
) -> tuple[GridConfig, list[tuple[dict[str, Any], dict[str, Any]]]]:
    """A grid file, checked: the grid, and for each cell its settings by axis and its run config as plain data.

    Relative paths in the grid file are relative to it. changes: `KEY=VALUE` for every cell, after all that the file
    says; relative paths in them are relative to the current folder. Raises ConfigError with file and key of every
    fault, and for a change of what the grid compares.
    """
    place = configs.located(path)
    data = configs.read_named(path)
    refuse_others(data, path)
    grid = configs.check(GridConfig, data, str(path))
    _refuse_changes(grid, changes)
    folder = place.absolute().parent
    bases = {base: configs.read(Path(configs.beside(base, folder))) for base in grid.extends}
    n_runs = len(grid.seed_list())
    cells: list[tuple[dict[str, Any], dict[str, Any]]] = []
    try:
        for point in grid.points():
            if (len(cells) + 1) * n_runs > MAX_RUNS:
                raise ConfigError(f"more than {MAX_RUNS:,} runs; a grid may have that many")
            # Copies, here and below: cells that shared a dict would overwrite each other's values.
            data = json.loads(json.dumps(bases[point.get("extends", grid.extends[0])]))
            for key, value in (*grid.set.items(), *point.items()):
                if key == "extends":
                    continue
                here = configs.from_folder(key, value, folder)
                configs.put(data, key, json.loads(json.dumps(here)), key)
            for change in changes:
                configs.apply_override(data, change)
            cells.append((point, data))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if not cells:
        raise ConfigError(f"{path}: exclude leaves no cell")
    return grid, cells


def _refuse_changes(grid: GridConfig, changes: Sequence[str]) -> None:
    """Raise ConfigError for changes of what cells differ in, of what is the grid's own, and of one thing twice."""
    keys: list[str] = []
    for change in changes:
        key = change.partition("=")[0].strip()
        if twice := [other for other in keys if f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")]:
            raise ConfigError(f"{configs.told(change)}: {twice[0]} is changed already; change everything once")
        keys.append(key)
        head = key.partition(".")[0]
        if head in _NOT_OF_A_GRID:
            own = _NOT_OF_A_GRID[head]
            raise ConfigError(f"{configs.told(change)}: {own!r} is the grid's own; change it in a copy of the file")
        for axis in grid.axes():
            if f"{key}.".startswith(f"{axis}.") or f"{axis}.".startswith(f"{key}."):
                raise ConfigError(
                    f"{configs.told(change)}: cells of this grid differ in {axis}; change it in a copy of the file"
                )


def refuse_others(data: Mapping[str, Any], path: Path) -> None:
    """Raise ConfigError for what is a config, and of no grid."""
    if "env" in data and "extends" not in data:
        raise ConfigError(
            f"{path} is the config of one run: space-dist train {path} (from Python: space_dist.train), and space-dist "
            "report with the run's folder. A grid names it with `extends`"
        )
    if "arms" in data:
        raise ConfigError(
            f"{path} is a search: space-dist tune run {path} (from Python: space_dist.run_search). A grid has no `arms`"
        )
    configs.refuse_profile(data, path)


def label_of(point: Mapping[str, Any], axes: Sequence[str]) -> str:
    """What a cell is called in tables: `kappa=4 eta=0.05`."""
    ends = [key.rpartition(".")[2] for key in axes]
    parts = []
    for key, end in zip(axes, ends, strict=True):
        value = point[key]
        if key == "extends":
            parts.append(Path(value).stem)
        elif key == "schedule":
            parts.append(_changes(value))
        elif key == "instances" and isinstance(value, dict):
            parts.append(_sets(value))
        elif isinstance(value, dict):
            rest = [f"{name}={_word(item)}" for name, item in value.items() if name != "kind"]
            parts.append(" ".join([_word(value["kind"]) if "kind" in value else end, *rest]))
        else:
            parts.append(f"{end if ends.count(end) == 1 else key}={_word(value)}")
    return " ".join(parts)[:_MAX_LABEL] or "all"


def _sets(instances: Mapping[str, Any]) -> str:
    """`maze_dfs` for maze_dfs_train.csv and maze_dfs_test.csv; else each file's name without its folder and ending."""
    stems = {name: Path(str(file)).stem for name, file in instances.items()}
    whole = str(stems.get("train")).removesuffix("_train")
    if stems == {"train": f"{whole}_train", "test": f"{whole}_test"}:
        return whole
    return " ".join(f"{name}={stem}" for name, stem in stems.items())


def _changes(schedule: Any) -> str:
    """A schedule in words: `from 50000 round_robin`."""
    if not schedule or not all(isinstance(one, dict) and isinstance(one.get("set"), dict) for one in schedule):
        return "unchanged" if not schedule else f"schedule={_word(schedule)}"
    return ", ".join(f"from {one.get('steps')} {label_of(one['set'], list(one['set']))}" for one in schedule)


def _word(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
