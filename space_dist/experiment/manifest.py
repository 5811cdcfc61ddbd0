"""A grid: cells (settings) x seeds, written in one YAML file and frozen into a manifest.

The manifest is the list of runs that laptop, Ray cluster and SLURM share. It lies in the grid's folder and is complete
there: resolved configs, and copies of the instance files, so nothing outside can change what its runs are.

    <root>/<grid>/manifest.json          the frozen grid
    <root>/<grid>/instances/*.csv        the instance sets, named by their content
    <root>/<grid>/<cell>/s<seed>/        the ledger of one run, with attempts.jsonl beside it
    <root>/<grid>/submitter.json         who is working on the grid now
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Discriminator, Field, Tag, field_validator, model_validator

from space_dist import config as configs
from space_dist.config import NAME, Mirrors, Patience, ResourcesConfig, RunConfig, Section
from space_dist.errors import ConfigError, LedgerError, NotPlannedError, nearest
from space_dist.experiment import scaling
from space_dist.experiment.search import Search
from space_dist.ledger import Ledger, owner_alive
from space_dist.system.files import atomic_write, read_file

FORMAT = 1
MANIFEST = "manifest.json"
CELL_ID_DIGITS = 12  # 48 bits: among 10,000 cells two are alike once in five million grids, and are refused
MAX_SEED = 2**31 - 1
MAX_RUNS = 100_000  # a folder each; a typing error in a range makes millions
_MAX_MANIFEST_BYTES = 512 << 20
_MAX_LABEL = 120  # characters; what is cut is told apart by the id
_MAX_NAMED = 5  # cells that a sentence names
_CELL_ID = re.compile(rf"[0-9a-f]{{{CELL_ID_DIGITS}}}")
_NOT_OF_A_GRID = {
    "seed": "seeds",
    "name": "name",
    "tracking": "tracking",
    "resources": "resources",
}


# ---- what a user writes ---------------------------------------------------------------------------------------------


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

    name: str = Field(pattern=NAME)
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
    data = configs.read_yaml(place)
    _refuse_others(data, path)
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


def _refuse_others(data: Mapping[str, Any], path: Path) -> None:
    """Raise ConfigError for what is a config, and of no grid."""
    if "env" in data and "extends" not in data:
        raise ConfigError(
            f"{path} is the config of one run: space-dist train {path}, and space-dist report with the run's folder. "
            "A grid names it with `extends`"
        )
    if "arms" in data:
        raise ConfigError(f"{path} is a search: space-dist tune run {path}. A grid has no `arms`")


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


# ---- what is frozen -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cell:
    """One setting; its runs differ by seed.

    id: 12 hex digits of the identity of its config. label: unique in the grid. settings: value by axis of the grid.
    config: a resolved run config as plain data, its instance paths relative to the grid's folder.
    stack: equal for cells whose runs can share a process (`engine: population`); empty for runs that work alone.
    shared_mb: about what each of its runs takes of that process's memory, in MB. n_seeds: how many of the grid's seeds,
    from the first, it runs with; 0: all. pause_at: environment steps at which its runs are paused for now; 0: at their
    end. A search gives more of both to what promises more.
    """

    id: str
    label: str
    settings: Mapping[str, Any]
    config: Mapping[str, Any]
    stack: str = ""
    shared_mb: int = 0
    n_seeds: int = 0
    pause_at: int = 0

    @property
    def budget_steps(self) -> int:
        """Environment steps that each of its runs may take in all."""
        return int(self.config["budget"]["steps"])

    @property
    def steps_to_take(self) -> int:
        """Environment steps that each of its runs is to take for now."""
        return self.pause_at or self.budget_steps


@dataclass(frozen=True)
class Run:
    """One run of a grid."""

    cell: Cell
    seed: int

    @property
    def key(self) -> str:
        """`<cell>/s<seed>`: its folder in the grid's."""
        return f"{self.cell.id}/s{self.seed}"

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.cell.label}, seed {self.seed}"


@dataclass(frozen=True)
class Manifest:
    """A frozen grid.

    axes: config keys in which cells differ. baseline: id of the cell that reports compare with. code, git: the version
    of this package that froze it. instances: file name in the grid's `instances` folder -> SHA-256 of its content.
    scale: the share of the grid's seeds and steps that this is. changes: `KEY=VALUE`, what every cell has otherwise
    than the grid's file. threshold: the test return to which reports count steps; None: the baseline's final one.
    search: of a grid that grows, trial by trial.
    """

    name: str
    axes: tuple[str, ...]
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    resources: RunResources
    retry: Retry
    tracking: GridTracking
    baseline: str
    instances: Mapping[str, str]
    code: str
    git: Mapping[str, str]
    scale: float = scaling.WHOLE
    changes: tuple[str, ...] = ()
    threshold: float | None = None
    search: Search | None = None

    def runs(self) -> list[Run]:
        """Every run, seed by seed, so that all cells can be compared early on."""
        return [Run(cell, seed) for place, seed in enumerate(self.seeds) for cell in self.cells
                if not cell.n_seeds or place < cell.n_seeds]  # fmt: skip

    def seeds_of(self, cell: Cell) -> tuple[int, ...]:
        """The seeds that a cell runs with."""
        return self.seeds[: cell.n_seeds] if cell.n_seeds else self.seeds

    @property
    def runs_digest(self) -> str:
        """`(16 hex digits)` which runs, in which order: what a batch system's task number refers to."""
        return _sha256({"runs": [run.key for run in self.runs()]})[:16]

    @property
    def searched(self) -> Search:
        """The search whose trials the cells are. Raises LedgerError if there is none, for the manifest is a grid's."""
        if self.search is None:
            raise LedgerError(f"{self.name} is a grid, and no search")
        return self.search

    @property
    def experiment(self) -> str:
        """The MLflow experiment."""
        return self.tracking.experiment or self.name

    @property
    def cpus_per_run(self) -> int:
        """The run's own CPU and one for each rollout actor; the curriculum actor needs none of its own."""
        return 1 + self.resources.workers

    def cell(self, text: str) -> Cell:
        """The cell with this label, or the one whose id starts so. Raises ConfigError if there is none, or several."""
        found = [cell for cell in self.cells if text == cell.label] or [
            cell for cell in self.cells if len(text) >= 2 and cell.id.startswith(text)
        ]
        if len(found) == 1:
            return found[0]
        begun = [cell for cell in self.cells if text and (cell.label.startswith(text) or cell.id.startswith(text))]
        if len(begun) > 1:
            named = ", ".join(f"{cell.label!r} ({cell.id})" for cell in begun[:_MAX_NAMED])
            more = f" and {len(begun) - _MAX_NAMED} more" if len(begun) > _MAX_NAMED else ""
            raise ConfigError(
                f"{text!r} is ambiguous: {len(begun)} cells of {self.name} begin so: {named}{more}. Give a whole "
                "label, or more of the id"
            )
        names = [name for cell in self.cells for name in (cell.label, cell.id)]
        hint = f"; did you mean {begun[0].label!r}?" if begun else nearest(text, names)
        raise ConfigError(f"{self.name} has no cell {text!r}{hint} `space-dist grid status` lists them")

    def run(self, cell: str, seed: int) -> Run:
        """One run. Raises ConfigError if there is no such one."""
        found = self.cell(cell)
        seeds = self.seeds_of(found)
        if seed not in seeds:
            shown = ", ".join(map(str, seeds[:20])) + (", ..." if len(seeds) > 20 else "")
            raise ConfigError(f"{self.name} has no seed {seed}; it has {shown}")
        return Run(found, seed)

    def to_json(self) -> bytes:
        """The content of manifest.json, with its own SHA-256; the same manifest gives the same bytes."""
        data: dict[str, Any] = {
            "format": FORMAT, "name": self.name, "axes": list(self.axes),
            "cells": [{"id": cell.id, "label": cell.label, "settings": cell.settings, "config": cell.config,
                       **({"stack": cell.stack, "shared_mb": cell.shared_mb} if cell.stack else {}),
                       **({"n_seeds": cell.n_seeds} if cell.n_seeds else {}),
                       **({"pause_at": cell.pause_at} if cell.pause_at else {})}
                      for cell in self.cells],
            "seeds": list(self.seeds),
            "resources": self.resources.model_dump(), "retry": self.retry.model_dump(),
            "tracking": self.tracking.model_dump(),
            "baseline": self.baseline, "instances": dict(self.instances), "code": self.code, "git": dict(self.git),
            **({} if self.scale == scaling.WHOLE else {"scale": self.scale}),
            **({"changes": list(self.changes)} if self.changes else {}),
            **({} if self.threshold is None else {"threshold": self.threshold}),
            **({} if self.search is None else {"search": self.search.to_json()}),
        }  # fmt: skip
        data["sha256"] = _sha256(data)
        return json.dumps(data, indent=1, sort_keys=True).encode() + b"\n"

    @classmethod
    def from_json(cls, content: bytes, source: str) -> Manifest:
        """The inverse of `to_json`. Raises LedgerError for anything that is not exactly what was written."""
        try:
            data = json.loads(content)
            if data["format"] != FORMAT:
                raise LedgerError(f"{source} has format {data['format']!r}; this version reads format {FORMAT}")
            if data.pop("sha256") != _sha256(data):
                raise ValueError("checksum")
            del data["format"]
            cells = tuple(Cell(**cell) for cell in data.pop("cells"))
            search = None if "search" not in data else Search.from_json(data.pop("search"))
            known: dict[str, type[Section]] = {"resources": RunResources, "retry": Retry, "tracking": GridTracking}
            sections: dict[str, Any] = {key: model.model_validate(data.pop(key)) for key, model in known.items()}
            manifest = cls(
                cells=cells, axes=tuple(data.pop("axes")), seeds=tuple(data.pop("seeds")), search=search,
                changes=tuple(data.pop("changes", ())), **sections, **data,
            )  # fmt: skip
            names = (manifest.name, *manifest.instances)
            if not all(re.fullmatch(NAME, name) for name in names) or not all(_CELL_ID.fullmatch(c.id) for c in cells):
                raise ValueError("a name that is none")
            if search is not None and {trial.cell for trial in search.trials} - {"", *(cell.id for cell in cells)}:
                raise ValueError("a trial of a cell that is none")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            raise LedgerError(f"{source} is damaged, or no manifest of a grid") from None
        return manifest


def _sha256(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


class Grid:
    """A grid's folder: the one class that knows its paths."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder).absolute()
        self.manifest_file = self.folder / MANIFEST
        self.instances = self.folder / "instances"
        self.lock_file = self.folder / "submitter.json"
        self.stop_file = self.folder / "stop"
        self.log = self.folder / "grid.log"
        self.tracking_log = self.folder / "tracking.log"
        self.tracking_lock = self.folder / "tracking.lock"

    def __repr__(self) -> str:
        return f"Grid({str(self.folder)!r})"

    def manifest(self) -> Manifest:
        """The frozen grid. Raises LedgerError if there is none, or it is damaged."""
        try:
            content = read_file(self.manifest_file, _MAX_MANIFEST_BYTES + 1)
        except FileNotFoundError:
            raise NotPlannedError(f"{self.folder} holds no grid: it has no {MANIFEST}") from None
        except OSError as error:
            raise LedgerError(f"{self.manifest_file} cannot be read: {error.strerror}") from None
        if len(content) > _MAX_MANIFEST_BYTES:
            raise LedgerError(
                f"{self.manifest_file} is larger than {_MAX_MANIFEST_BYTES >> 20} MiB: that is no manifest"
            )
        return Manifest.from_json(content, str(self.manifest_file))

    def freeze(self, manifest: Manifest, files: Mapping[str, bytes]) -> None:
        """Store a manifest and the instance files it names (name -> content); the manifest comes last.

        Raises LedgerError if the folder cannot be written.
        """
        self.keep(files)
        try:
            atomic_write(self.manifest_file, manifest.to_json())
        except OSError as error:
            raise LedgerError(f"cannot write the grid's folder {self.folder}: {error.strerror}") from None

    def keep(self, files: Mapping[str, bytes]) -> None:
        """Store instance files (name -> content). Raises LedgerError if the folder cannot be written."""
        try:
            self.instances.mkdir(parents=True, exist_ok=True)
            for name, content in files.items():
                # Named by content: what is there is the same.
                if not (self.instances / name).exists():
                    atomic_write(self.instances / name, content)
        except OSError as error:
            raise LedgerError(f"cannot write the grid's folder {self.folder}: {error.strerror}") from None

    def instance_files(self, manifest: Manifest) -> dict[str, bytes]:
        """The content of the instance files, name by name. Raises LedgerError if one is missing or has changed."""
        files = {}
        for name, sha256 in manifest.instances.items():
            path = self.instances / name
            try:
                files[name] = read_file(path)
            except OSError as error:
                raise LedgerError(f"{path} cannot be read: {error.strerror}") from None
            if hashlib.sha256(files[name]).hexdigest() != sha256:
                raise LedgerError(f"{path} has changed since the grid was frozen")
        return files

    def owner_alive(self) -> bool:
        """Whether somebody is working on the grid now, as far as can be told from this machine."""
        return owner_alive(self.lock_file)

    def ledger(self, run: Run) -> Ledger:
        """Where a run's results are, or will be."""
        return Ledger(self.folder / run.cell.id / f"s{run.seed}")

    def run_config(self, manifest: Manifest, run: Run, *, address: str = "local") -> RunConfig:
        """What a run is to do, with the grid's own instance files, here."""
        shared = ResourcesConfig.model_fields.keys() & RunResources.model_fields.keys()
        resources = {**manifest.resources.model_dump(mode="json", include=shared), "address": address}
        data = {
            **run.cell.config,
            "seed": run.seed,
            "resources": resources,
            "tracking": {**manifest.tracking.model_dump(mode="json"), "experiment": manifest.experiment, "live": False},
        }
        configs.from_its_folder(data, self.folder)
        return configs.parse(data, f"{self.manifest_file}, cell {run.cell.id}")


def in_root(path: Path, root: Path) -> Path:
    """The folder of the grid that is called so below `root`; of anything else that a user may name, the path itself.

    Raises ConfigError, with the nearest name, for a name that neither a file or folder here nor a grid there has.
    """
    if path.exists() or len(path.parts) != 1 or path.suffix or ":" in path.name:
        return path
    if not Grid(root / path).manifest_file.exists():
        known = [file.parent.name for file in sorted(root.glob(f"*/{MANIFEST}"))]
        raise ConfigError(f"{path} is neither here nor a grid in {root}{nearest(path.name, known)}".removesuffix("."))
    return root / path


def find_grid(path: Path, root: Path, scale: float = scaling.WHOLE, changes: Sequence[str] = ()) -> Grid:
    """The grid that a user names: its folder, its manifest.json, its name below `root`, or its YAML file (frozen below
    `root`, at a scale and with changes).

    Raises ConfigError if there is nothing of the kind, and for a scale or changes of what is frozen already;
    NotPlannedError if a YAML file's grid was never frozen.
    """
    path = in_root(path, root)
    if scale != scaling.WHOLE and (path.is_dir() or path.name == MANIFEST):
        raise ConfigError(f"{path} is frozen already, with its seeds and steps; --scale is for a grid's YAML file")
    if changes and (path.is_dir() or path.name == MANIFEST):
        raise ConfigError(f"{path} is frozen already, with its settings; --set is for a grid's YAML file")
    if path.is_dir():
        if not (path / MANIFEST).exists():
            raise NotPlannedError(f"{path} holds no grid: it has no {MANIFEST}")
        return Grid(path)
    if path.name == MANIFEST:
        return Grid(path.absolute().parent)
    data = configs.read_yaml(configs.located(path))
    _refuse_others(data, path)
    config = configs.check(GridConfig, data, str(path))
    grid = Grid(root / scaling.name_of(config.name, scaling.checked(scale), changes))
    if not grid.manifest_file.exists():
        small = "" if scale == scaling.WHOLE else f" --scale {scale:g}"
        small += "".join(f" --set {shlex.quote(change)}" for change in changes)
        raise NotPlannedError(
            f"the grid of {path} is not in {grid.folder}: `space-dist grid plan {path}{small}` freezes it there "
            "(--root names another root)"
        )
    return grid
