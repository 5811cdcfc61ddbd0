"""Work through a grid from Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from space_dist.api.arguments import Overrides, as_changes, as_limit, as_path, as_share, refuse_progress
from space_dist.api.progress import line_of_grid, shown
from space_dist.errors import ConfigError
from space_dist.experiment import manifest as manifests
from space_dist.experiment import scaling
from space_dist.experiment.manifest import MANIFEST, Grid, Manifest, find_grid, in_root
from space_dist.experiment.status import RunStatus, run_statuses
from space_dist.grid.conductor import Conductor, Overview, adopt, working_on
from space_dist.grid.fork_server import ForkServer
from space_dist.grid.warm import LocalExecutor, needs_ray
from space_dist.system.extras import needed_from
from space_dist.system.interrupts import StopRequests
from space_dist.system.provenance import code_digest
from space_dist.system.workplace import cores, lasting, private_ray, workplace

if TYPE_CHECKING:
    from space_dist.api.reports import ReportView
    from space_dist.api.training import Run
    from space_dist.grid.jobs import Mode


class GridRun:
    """A grid's folder, read from Python: `GridRun("runs/quickstart")`, or what `run_grid` returns.

    `manifest` is the grid as it was frozen, when this was made: `name`, `seeds`, `cells` (each with `label`, `settings`
    and `config`), and of a search `search`, whose `trials` have `arm`, `parameters`, `state`, and the `value` reached.
    Raises LedgerError where there is no grid.
    """

    def __init__(self, folder: Path | str) -> None:
        self.grid = Grid(as_path(folder, "folder"))
        self.manifest = self.grid.manifest()

    def __repr__(self) -> str:
        found = self.statuses
        done = sum(one.condition == "done" for one in found)
        return f"GridRun({str(self.folder)!r}: {self.manifest.name}, {done} of {len(found)} runs done)"

    @property
    def folder(self) -> Path:
        """The grid's folder."""
        return self.grid.folder

    @property
    def statuses(self) -> list[RunStatus]:
        """Where every run stands now: `condition` (done, running, waiting, failed), `cause`, `detail`, ..."""
        return run_statuses(self.grid, self.manifest, code_digest())

    @property
    def complete(self) -> bool:
        """Whether all runs are done."""
        return all(one.condition == "done" for one in self.statuses)

    def runs(self) -> dict[tuple[str, int], Run]:
        """Those that have begun, by (label of the cell, seed)."""
        from space_dist.api.training import Run

        ledgers = {(run.cell.label, run.seed): self.grid.ledger(run) for run in self.manifest.runs()}
        return {key: Run(ledger.folder) for key, ledger in ledgers.items() if ledger.status_file.exists()}

    def report(self, **how: Any) -> ReportView:
        """Tables with intervals, and figures: see `report_on`, whose keywords this takes."""
        from space_dist.api.reports import report_on

        return report_on(self.folder, **how)


def run_grid(
    grid: Path | str | Grid | GridRun,
    *,
    root: Path | str | None = None,
    max_parallel: int | None = None,
    scale: float = scaling.WHOLE,
    overrides: Overrides = (),
    progress: bool | Callable[[Overview], None] = True,
) -> GridRun:
    """Work through a grid on this machine, as `space-dist grid run` does: what is done is skipped.

    grid: its YAML file, `shipped:NAME`, its folder, or its manifest.json.  root: the folder that holds grids' folders;
    None: `runs` here.  max_parallel: runs at a time; None: as many as there are CPUs for.  scale: the
    share of a YAML file's seeds and steps: 1.0, all of them, or less, in a folder of its own (`<name>-scale-<scale>`).
    overrides: key -> value, or `KEY=VALUE`, as of `train`, for every cell of a YAML file, in a folder of its own
    (`<name>-set-<digest>`).
    progress: show a line that changes in its place; or what is called now and then.

    Runs that fail are noted (`GridRun.statuses`) and raise nothing. Raises ConfigError for every fault of the files,
    LedgerError if the folder cannot be written.
    """
    refuse_progress(progress)
    max_parallel, scale, changes = as_limit(max_parallel), as_share(scale, "scale"), as_changes(overrides)
    base = workplace() / "runs" if root is None else lasting(as_path(root, "root"), "root")
    named = grid.folder if isinstance(grid, Grid | GridRun) else as_path(grid, "grid")
    stop = StopRequests()
    with ForkServer() as server, shown(progress is True) as show:
        place, manifest = frozen(named, base, scale, changes)

        def observe(overview: Overview) -> None:
            if callable(progress):
                progress(overview)
            show(line_of_grid(manifest.name, overview))

        with working_on(place, manifest, wait=True, stop=stop, say=show):
            worked_through(
                place, manifest, manifest.runs(), max_parallel=max_parallel, server=server, stop=stop, observe=observe
            )  # fmt: skip
    return GridRun(place.folder)


def frozen(
    path: Path, root: Path, scale: float = scaling.WHOLE, changes: Sequence[str] = ()
) -> tuple[Grid, Manifest]:  # fmt: skip
    """The grid a user wants to run, frozen below `root`: planned from YAML, or taken as it was frozen anywhere.

    path: also the name that it has below `root`.  scale: the share of the seeds and steps in YAML.  changes:
    `KEY=VALUE` for every cell of it.
    """
    path = in_root(path, root)
    if path.is_dir() or path.name == MANIFEST:
        place = find_grid(path, root, scale, changes)
        manifest = place.manifest()
        if manifest.search is not None:
            raise ConfigError(f"{place.folder} holds a search: space-dist tune run {place.folder}")
        if not path.is_dir():
            place = adopt(place, root)
        return place, place.manifest()
    from space_dist.grid.planning import plan  # imports torch, to see whether every cell can learn

    made = plan(path, root, scale, changes)
    return made.grid, made.manifest


def worked_through(
    place: Grid, manifest: Manifest, runs: Sequence[manifests.Run], *, stop: StopRequests,
    observe: Callable[[Overview], None], address: str = "local", mode: Mode = "auto", max_parallel: int | None = None,
    nodes: int = 1, server: ForkServer | None = None, reinstall: Callable[[], None] = lambda: None,
    say: Callable[[str], None] = lambda line: None,
) -> list[RunStatus]:  # fmt: skip
    """Work through runs of a frozen grid; returns where they stand in the end. Arguments: as of `grid.jobs.conduct`.

    mode: `auto` on this machine (address local) is no Ray, unless runs have rollout actors.
    server: of processes, which was started before, for a grid on this machine.
    """
    if address == "local" and mode == "auto" and not needs_ray(manifest):
        size = max(1, min(max_parallel or cores(), len(runs)))
        with LocalExecutor(place, manifest, size, stop.reason, server) as here:
            return Conductor(place, manifest, runs, here, stop_requested=stop.reason, observe=observe).conduct()
    if address == "local":
        private_ray()
    what, instead = "a grid on a cluster, or whose runs have rollout actors,", "set resources.workers: 0"
    with needed_from("ray", what, instead):
        from space_dist.grid.jobs import conduct

    return conduct(
        place, manifest, runs, address=address, mode=mode, max_parallel=max_parallel, nodes=nodes,
        stop_requested=stop.reason, reinstall=reinstall, observe=observe, say=say,
    )  # fmt: skip
