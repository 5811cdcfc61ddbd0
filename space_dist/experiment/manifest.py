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
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from space_dist import config as configs
from space_dist.config import NAME, ResourcesConfig, RunConfig, Section
from space_dist.errors import ConfigError, LedgerError, NotPlannedError, below, nearest, nearest_label
from space_dist.experiment import scaling
from space_dist.experiment.grid_file import GridConfig, GridTracking, Retry, RunResources, refuse_others
from space_dist.experiment.search import Search
from space_dist.ledger import Ledger, owner_alive
from space_dist.system.files import atomic_write, read_file

FORMAT = 1
MANIFEST = "manifest.json"
CELL_ID_DIGITS = 12  # 48 bits: among 10,000 cells two are alike once in five million grids, and are refused
_MAX_MANIFEST_BYTES = 512 << 20
_MAX_NAMED = 5  # cells that a sentence names
_CELL_ID = re.compile(rf"[0-9a-f]{{{CELL_ID_DIGITS}}}")


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

    @property
    def episodes_to_take(self) -> int | None:
        """Training episodes that may end each of its runs before those steps do; None: nothing but steps ends them."""
        episodes = self.config["budget"].get("episodes")
        return None if episodes is None or self.pause_at else int(episodes)


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
        hint = f"; did you mean {begun[0].label!r}?" if begun else nearest_label(text, names)
        listed = f"`space-dist grid status {self.name}` lists them"
        if len(self.cells) <= _MAX_NAMED:
            listed = f"It has {', '.join(repr(cell.label) for cell in self.cells)}"
        raise ConfigError(f"{self.name} has no cell {text!r}{hint} {listed}")

    def run(self, cell: str, seed: int | None) -> Run:
        """One run; without a seed, of a cell that has one alone. Raises ConfigError if there is no such one."""
        found = self.cell(cell)
        seeds = self.seeds_of(found)
        shown = ", ".join(map(str, seeds[:20])) + (", ..." if len(seeds) > 20 else "")
        if seed is None and len(seeds) == 1:
            seed = seeds[0]
        if seed is None:
            raise ConfigError(f"{found.label!r} of {self.name} has {len(seeds)} seeds: choose one with --seed: {shown}")
        if seed not in seeds:
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

    def is_own(self) -> bool:
        """Whether this is a grid's folder: one that has but a copy of a manifest, like MLflow's, has no instances."""
        return self.manifest_file.exists() and self.instances.is_dir()

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


def grids_below(folder: Path) -> list[Grid]:
    """The grids in the folders of a folder, however deep, by path."""
    return [grid for file in sorted(folder.rglob(MANIFEST)) if (grid := Grid(file.parent)).is_own()]


def in_root(path: Path, root: Path) -> Path:
    """The folder of the grid that is called so below `root`; of anything else that a user may name, the path itself.

    Raises ConfigError, with the nearest name, for a name that neither a file or folder here nor a grid there has.
    """
    if path.exists() or len(path.parts) != 1 or path.suffix or ":" in path.name:
        return path
    if not Grid(root / path).manifest_file.exists():
        known = [file.parent.name for file in sorted(root.glob(f"*/{MANIFEST}"))]
        meant = configs.shipped_as(path)
        hint = f"; did you mean {meant!r}?" if meant else nearest(path.name, known)
        raise ConfigError(f"{path} is neither here nor a grid in {root}{hint}".removesuffix("."))
    return root / path


def _below(folder: Path) -> str:
    """Which grids to name instead of a folder that is none: of two levels, as a home may hold a million files."""
    files = sorted([*folder.glob(f"*/{MANIFEST}"), *folder.glob(f"*/*/{MANIFEST}")])
    return below([file.parent for file in files if Grid(file.parent).is_own()])


def _refuse_misspelt_folder(path: Path) -> None:
    """Raise NotPlannedError, with the nearest folder, for what is not there, nor a file but for its ending."""
    if path.exists() or path.suffix or ":" in path.name or path.with_name(f"{path.name}.yaml").exists():
        return
    hint = nearest(path.name, sorted(other.name for other in path.parent.glob("*/")))
    if hint != ".":
        raise NotPlannedError(f"{path} does not exist{hint}")


def find_grid(path: Path, root: Path, scale: float = scaling.WHOLE, changes: Sequence[str] = ()) -> Grid:
    """The grid that a user names: its folder, its manifest.json, its name below `root`, or its YAML file (frozen below
    `root`, at a scale and with changes).

    Raises ConfigError if there is nothing of the kind, and for a scale or changes of what is frozen already;
    NotPlannedError if a YAML file's grid was never frozen.
    """
    path = in_root(path, root)
    if scale != scaling.WHOLE and (path.is_dir() or path.name == MANIFEST):
        raise ConfigError(
            f"{path} is frozen already, with its seeds and steps; --scale (from Python: scale) is for a grid's YAML "
            "file"
        )
    if changes and (path.is_dir() or path.name == MANIFEST):
        raise ConfigError(
            f"{path} is frozen already, with its settings; --set (from Python: overrides) is for a grid's YAML file"
        )
    if path.is_dir():
        if not (path / MANIFEST).exists():
            raise NotPlannedError(f"{path} holds no grid: it has no {MANIFEST}{_below(path)}")
        return Grid(path)
    if path.name == MANIFEST:
        return Grid(path.absolute().parent)
    _refuse_misspelt_folder(path)
    data = configs.read_named(path)
    refuse_others(data, path)
    config = configs.check(GridConfig, data, str(path))
    grid = Grid(root / scaling.name_of(config.name, scaling.checked(scale), changes))
    if not grid.manifest_file.exists():
        small = "" if scale == scaling.WHOLE else f" --scale {scale:g}"
        small += "".join(f" --set {shlex.quote(change)}" for change in changes)
        raise NotPlannedError(
            f"the grid of {path} is not in {grid.folder}: `space-dist grid plan {path}{small}` freezes it there, "
            "and `grid run` with the same words runs it, too (--root names another root)"
        )
    return grid
