"""Train a run from Python, and read what one left."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from space_dist import config as configs
from space_dist.api.arguments import Overrides, as_changes, as_path, refuse_progress, without_numpy
from space_dist.api.policies import ActingPolicy, load_policy
from space_dist.api.progress import keep, line_of_run, shown
from space_dist.config import RunConfig
from space_dist.config.quoting import short
from space_dist.errors import ConfigError, LedgerError, about, nearest
from space_dist.experiment.manifest import MANIFEST, Grid
from space_dist.experiment.places import run_folder
from space_dist.ledger import METRICS, ROW_FILES, Ledger, Row, Status
from space_dist.report import draw_learning_curve, load_run
from space_dist.report.figures import png
from space_dist.run.claiming import stored_config
from space_dist.run.launch import launch
from space_dist.run.training import Progress
from space_dist.system.interrupts import StopRequests
from space_dist.system.workplace import default_folder, lasting

Config = str | Path | Mapping[str, Any] | RunConfig

_SOURCE: Final = "config"  # what a config is called in sentences that lies in no file


class Run:
    """A run's folder, read from Python: `Run("runs/pointmass_space/s0")`, or what `train` returns.

    tracking_warning: what MLflow's mirror lacks, as `train` found it. `ledger` has the paths of its files.
    Raises LedgerError where there is no run.
    """

    def __init__(self, folder: Path | str, *, tracking_warning: str | None = None) -> None:
        self.ledger = Ledger(as_path(folder, "folder"))
        self.tracking_warning = tracking_warning
        try:
            self.ledger.status()
        except LedgerError as error:
            if instead := _meant(self.folder):
                raise LedgerError(f"{error}; {instead}") from None
            raise

    def __repr__(self) -> str:
        status = self.status
        return (
            f"Run({str(self.folder)!r}: {status.name}, seed {status.seed}, {status.state}, "
            f"{status.steps:,}/{status.budget_steps:,} steps)"
        )

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.ledger.folder

    @property
    def status(self) -> Status:
        """Where it stands now: `state`, `steps`, `budget_steps`, `message`, ..."""
        return self.ledger.status()

    @functools.cached_property
    def config(self) -> RunConfig:
        """What was asked for, every default written out. Raises LedgerError if it is not what the run wrote."""
        return stored_config(self.ledger)

    def rows(self, file: str = METRICS) -> list[Row]:
        """The rows of `metrics.jsonl` (an iteration or an evaluation each), or of another file of rows.

        file: `metrics.jsonl`, `timing.jsonl`, `curriculum.jsonl` (a decision each) or `values.jsonl` (what instances
        were worth at each). A row is a dict, by column. Raises ConfigError for any other file, and LedgerError for rows
        that are damaged.
        """
        if file not in ROW_FILES:
            hint = nearest(str(file), ROW_FILES).removesuffix(".")
            raise ConfigError(f"{short(file)} is no file of rows; there are {', '.join(ROW_FILES)}{hint}")
        return self.ledger.rows(file)

    @property
    def evaluations(self) -> list[Row]:
        """The rows of evaluations: `steps`, and of `train` and `test` the mean `return`, `success`, `length`, ..."""
        return [row for row in self.rows() if row["kind"] == "evaluation"]

    @property
    def final(self) -> dict[str, float]:
        """The mean returns of the policy that the run finished with: `train` and `test`, undiscounted.

        Raises ConfigError for a run that is not finished.
        """
        found, status = self.evaluations, self.status
        if not found or not status.is_final(found[-1]["steps"]):
            raise ConfigError(f"{self.folder} is not finished ({status.state}): `evaluations` has what there is")
        return {split: float(found[-1][split]["return"]) for split in ("train", "test")}

    def policy(self, *, seed: int = 0) -> ActingPolicy:
        """What it learned: see `load_policy`."""
        return load_policy(self, seed=seed)

    def _repr_png_(self) -> bytes | None:
        """Its learning curve, as notebooks show it; nothing before the first evaluation."""
        found = load_run(self.ledger)
        return png(draw_learning_curve(found)) if len(found.evaluation_steps) else None


def _meant(folder: Path) -> str:
    """What to do with a folder that is no run's, if it is something else of ours; else empty."""
    try:
        if (folder / MANIFEST).is_file():
            if Grid(folder).manifest().search is not None:
                return f"it is a search's: `space-dist tune report {shlex.quote(str(folder))}` reports on it"
            what = "it is a grid's: "
        elif any(folder.glob("*/status.json")):
            what = ""
        else:
            return ""
    except (OSError, LedgerError):  # not to be read, or no manifest of ours
        return ""
    return f"{what}space_dist.report_on({str(folder)!r}) reports on all of them"


def train(
    config: Config,
    *,
    seed: int | None = None,
    workers: int | None = None,
    out: Path | str | None = None,
    resume: bool = False,
    overrides: Overrides = (),
    progress: bool | Callable[[Progress], None] = True,
) -> Run:
    """Train one policy under one curriculum, to its end, as `space-dist train` does; the bits are the same.

    config: a YAML file's path, `shipped:NAME`, the same keys as a nested mapping (relative paths are then relative to
        the current folder), or a `RunConfig`.
    overrides: key -> value (`{"budget.steps": 20_000}`), or as the command's `--set` has it (`["budget.steps=20000"]`).
    seed, workers: the run's seed, and its Ray actors (0: everything in this process, without Ray).
    out: the run's folder; None: `runs/<name>/s<seed>` here.  resume: go on with the run that is there; where
        none is, one begins, which is said.
    progress: show a line that changes in its place, in a notebook or on a terminal; or what is called after each round.

    Raises ConfigError with the key of every fault, or if the folder holds another run, a grid, or runs; Interrupted if
    a file `stop` in the run's folder asked for that; SpaceDistError if it failed. After KeyboardInterrupt,
    `resume=True` goes on from the last checkpoint, and from the start before the first.
    """
    refuse_progress(progress)
    stop = StopRequests()
    run = as_config(config, overrides, seed=seed, workers=workers)
    folder = default_folder(run.name, run.seed) if out is None else run_folder(lasting(as_path(out, "out"), "out"))
    source = str(config) if isinstance(config, str | Path) else _SOURCE
    with about(source), shown(progress is True) as show:

        def observe(now: Progress) -> None:
            if callable(progress):
                progress(now)
            show(line_of_run(run.name, run.seed, now))

        def waiting(what: str) -> None:
            show(f"{run.name} s{run.seed}  {what}")

        def going_on(where: str) -> None:
            keep(f"{run.name} s{run.seed}: {where}", wanted=progress is not False)

        outcome = launch(
            run, folder, resume=resume, stop=stop, observe=observe, waiting=waiting, tell=waiting, going_on=going_on
        )
    return Run(outcome.ledger.folder, tracking_warning=outcome.tracking_warning)


def as_config(
    config: Config, overrides: Overrides = (), *, seed: int | None = None, workers: int | None = None
) -> RunConfig:
    """A checked config from whatever names or holds one. Raises ConfigError with the key of every fault."""
    if isinstance(config, str | Path) and str(config):
        data, source = configs.read(Path(config)), str(config)
    elif isinstance(config, RunConfig):
        data, source = config.model_dump(mode="json"), _SOURCE
    elif isinstance(config, Mapping):
        data, source = configs.plain(without_numpy(config), _SOURCE), _SOURCE
        configs.from_its_folder(data, Path.cwd())
    else:
        what = "''" if config == "" else f"a {type(config).__name__}"
        raise ConfigError(f"a config is a path, shipped:NAME, a mapping or a RunConfig, not {what}")
    changes = as_changes(overrides)
    for change in changes:
        configs.apply_override(data, change)
    origins = configs.origins(changes)
    for key, given in (("seed", seed), ("resources.workers", workers)):
        if given is not None:
            configs.put(data, key, without_numpy(given), source)
            origins[key] = key.rpartition(".")[2]
    return configs.parse(data, source, origins)
