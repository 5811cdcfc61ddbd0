"""From a grid's YAML file to its manifest: every cell resolved and checked, then frozen."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from space_dist import config as configs
from space_dist.config import RunConfig
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, about
from space_dist.experiment import scaling
from space_dist.experiment.grid_file import GridConfig, RunResources, label_of, load_grid
from space_dist.experiment.manifest import CELL_ID_DIGITS, Cell, Grid, Manifest
from space_dist.grid.conductor import freeze
from space_dist.instances import InstanceSet
from space_dist.run.building import Blueprint
from space_dist.system.provenance import code_digest, git_state, source_digest
from space_dist.tracking.settling import settled


@dataclass(frozen=True)
class Plan:
    """A frozen grid, and how it differs from what was frozen in its folder before.

    steps: of all runs together, in whole updates.  at_most: whether they may be fewer, for their curricula may probe
    between updates, or their rounds end by episodes.
    """

    grid: Grid
    manifest: Manifest
    steps: int
    at_most: bool
    new_runs: int
    dropped_runs: int


def plan(path: Path, root: Path, scale: float = scaling.WHOLE, changes: Sequence[str] = ()) -> Plan:
    """Resolve and check a grid file, and freeze it in `<root>/<name>`; beside that, a share of its seeds and steps, or
    what it is with `changes` (`KEY=VALUE`) to every cell.

    A grid that was frozen before is frozen anew: runs of cells that are still there keep their results. Raises
    ConfigError for every fault of the files, and if somebody is working on another version of the grid now.
    """
    config, points = load_grid(path, changes)
    name = scaling.name_of(config.name, scaling.checked(scale), changes)
    seeds = scaling.fewer(config.seed_list(), scale)
    grid = Grid(root.absolute() / name)
    files = InstanceFiles()
    specs: dict[str, EnvironmentSpec] = {}  # by the section of a config: an environment is looked at once
    cells: dict[str, Cell] = {}
    steps, at_most = 0, False
    for point, data in points:
        label = label_of(point, config.axes())
        where = f"{path}, cell {label!r}"
        resolved = scaling.shorter(resolved_cell(config.name, label, data, where, changes), scale, where)
        cell, run_steps = frozen_cell(config.resources, resolved, point, label, where, files, specs, changes)
        if cell.id in cells:
            raise ConfigError(f"{path}: the cells {cells[cell.id].label!r} and {label!r} are the same run config")
        cells[cell.id] = cell
        steps += run_steps * len(seeds)
        at_most |= resolved.curriculum.may_probe or resolved.n_episodes is not None
    manifest = Manifest(
        name=name, axes=tuple(config.axes()), cells=_distinct(cells.values()), seeds=seeds,
        resources=config.resources, retry=config.retry,
        tracking=settled(config.tracking, name),
        baseline=_baseline(path, config, list(cells.values())),
        instances={name: hashlib.sha256(content).hexdigest() for name, content in sorted(files.contents.items())},
        code=code_digest(), git=git_state(), scale=scale, changes=tuple(sorted(map(str, changes))),
        threshold=config.threshold,
    )  # fmt: skip
    before = freeze(grid, manifest, files.contents)
    now, then = ({run.key for run in one.runs()} if one else set[str]() for one in (manifest, before))
    return Plan(grid, grid.manifest(), steps, at_most, len(now - then), len(then - now))


class InstanceFiles:
    """Instance sets of all cells: each file read once, each set stored once, named by its content."""

    def __init__(self) -> None:
        self.contents: dict[str, bytes] = {}
        self._read: dict[tuple[object, ...], tuple[InstanceSet, InstanceSet]] = {}
        self._names: dict[int, str] = {}

    def sets(self, blueprint: Blueprint) -> tuple[InstanceSet, InstanceSet]:
        files = blueprint.config.instances
        key = (files.train, files.test, blueprint.spec.context_bounds, blueprint.config.columns_read)
        if key not in self._read:
            self._read[key] = blueprint.instances()
        return self._read[key]

    def kept(self, given: bytes) -> str:
        """The name under which what other runs give a cell (`init_from`, ...) lies beside them."""
        name = f"{hashlib.sha256(given).hexdigest()[:16]}.npz"
        self.contents[name] = given
        return name

    def name(self, instances: InstanceSet) -> str:
        if id(instances) not in self._names:  # `_read` keeps them all alive
            name = f"{instances.digest()[:16]}.csv"
            self.contents[name] = instances.to_csv().encode()
            self._names[id(instances)] = name
        return self._names[id(instances)]


def resolved_cell(
    grid: str, label: str, data: dict[str, Any], where: str, changes: Sequence[str] = ()
) -> RunConfig:  # fmt: skip
    """The run config of a cell of this grid, checked; `where` names it in errors, and so do the `changes` made to it.

    Raises ConfigError.
    """
    for key in ("tracking", "resources", "seed"):  # the grid's own
        data.pop(key, None)
    # The name of a run may become a file's.
    name = "".join(letter if letter.isalnum() and letter.isascii() else "_" for letter in f"{grid}_{label}")[:100]
    return configs.parse({**data, "name": name}, where, configs.origins(changes))


def frozen_cell(
    resources: RunResources, config: RunConfig, point: dict[str, Any], label: str, where: str, files: InstanceFiles,
    specs: dict[str, EnvironmentSpec], changes: Sequence[str] = (),
) -> tuple[Cell, int]:  # fmt: skip
    """A cell, and the environment steps of each of its runs; what it reads goes into `files`.

    point: its settings by axis. specs: of environments that were looked at before, by the section of a config.
    changes: made to it, for errors. Raises ConfigError if it cannot work.
    """
    with about(where, configs.origins(changes)):
        section = config.env.model_dump_json()
        blueprint = Blueprint.of(config, specs.get(section), can_share=resources.workers == 0)
        config, specs[section] = blueprint.config, blueprint.spec
        if config.engine == "population" and resources.workers:
            raise ConfigError(
                f"engine: population with resources.workers: {resources.workers}: runs that share a process have "
                "no rollout actors of their own; use workers: 0, or engine: single"
            )
        train, test = files.sets(blueprint)
        # For its errors: a grid of which one cell cannot work is not frozen.
        blueprint.setup(train, test)
        sources = {path: source_digest(path) for path in config.import_paths}
    identity = configs.identity(
        config, train.digest(), test.digest(), given=blueprint.given, sources=sources, with_seed=False
    )  # fmt: skip
    config = config.with_given(
        {key: Path("instances", files.kept(content)) for key, content in blueprint.given.items()}
    )
    data = config.model_dump(mode="json", exclude={"seed", "tracking", "resources"})
    data["instances"] = {split: f"instances/{files.name(chosen)}" for split, chosen in
                             (("train", train), ("test", test))}  # fmt: skip
    cell = Cell(identity[:CELL_ID_DIGITS], label, point, data, blueprint.stack, blueprint.memory)
    return cell, blueprint.total_steps


def _distinct(cells: Any) -> tuple[Cell, ...]:
    """Labels that were cut to the same words get the start of the id."""
    found = list(cells)
    labels = [cell.label for cell in found]
    return tuple(
        cell if labels.count(cell.label) == 1 else dataclasses.replace(cell, label=f"{cell.label} {cell.id[:6]}")
        for cell in found
    )


def _baseline(path: Path, config: GridConfig, cells: Sequence[Cell]) -> str:
    if config.baseline:
        found = [cell for cell in cells
                 if all(cell.settings[key] == value for key, value in config.baseline.items())]  # fmt: skip
        if len(found) != 1:
            raise ConfigError(f"{path}: baseline: {len(found)} cells have these settings; it must be exactly one")
        return found[0].id
    # The paper's baseline, where the grid names none.
    round_robin = [cell for cell in cells if cell.config["curriculum"]["kind"] == "round_robin"]
    return (round_robin or list(cells))[0].id
