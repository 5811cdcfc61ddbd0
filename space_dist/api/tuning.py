"""Work through a search from Python."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from space_dist.api.arguments import as_limit, as_path, refuse_progress
from space_dist.api.grids import GridRun, worked_through
from space_dist.api.progress import line_of_grid, shown
from space_dist.errors import ConfigError
from space_dist.experiment.manifest import Grid, Manifest, in_root
from space_dist.experiment.tuning import find_tune
from space_dist.grid.conductor import Overview, working_on
from space_dist.grid.fork_server import ForkServer
from space_dist.system.extras import needed_from
from space_dist.system.interrupts import StopRequests
from space_dist.system.workplace import lasting, workplace

if TYPE_CHECKING:
    from space_dist.grid.jobs import Mode

Observing = Callable[[Manifest], AbstractContextManager[Callable[[Overview], None]]]


def run_search(
    search: Path | str,
    *,
    root: Path | str | None = None,
    max_parallel: int | None = None,
    progress: bool | Callable[[Overview], None] = True,
) -> GridRun:
    """Work through a search on this machine, as `space-dist tune run` does: what is done is skipped.

    search: its YAML file, `shipped:NAME`, its folder, or its name below `root`.  root: the folder that holds searches'
    folders; None: `runs` here.  max_parallel: runs at a time; None: as many as there are CPUs for.  progress: show a
    line that changes in its place; or what is called now and then.

    `manifest.search.trials` of what is returned has every trial: `arm`, `parameters`, `state`, and the `value` that it
    reached (None unless it is complete). Trials that fail are recorded as
    failed. Raises ConfigError for every fault of the files, LedgerError if the folder cannot be written, SpaceDistError
    if runs failed for reasons that say nothing of their settings.
    """
    refuse_progress(progress)
    max_parallel = as_limit(max_parallel)
    named = as_path(search, "search")
    base = workplace() / "runs" if root is None else lasting(as_path(root, "root"), "root")
    stop = StopRequests()
    with ForkServer() as server, shown(progress is True) as show:
        place = planned(named, base)

        @contextmanager
        def observing(manifest: Manifest) -> Iterator[Callable[[Overview], None]]:
            def observe(overview: Overview) -> None:
                if callable(progress):
                    progress(overview)
                show(line_of_grid(manifest.name, overview))

            yield observe

        with working_on(place, place.manifest(), wait=True, stop=stop, say=show):
            searched_through(place, observing=observing, stop=stop, max_parallel=max_parallel, server=server)
    return GridRun(place.folder)


def planned(path: Path, root: Path) -> Grid:
    """The search a user wants to run, planned below `root` from YAML, or as it lies in its folder, there or here."""
    path = in_root(path, root)
    if path.is_dir():
        return find_tune(path, root)
    with needed_from("tune", "a search"):
        from space_dist.grid.tuning import plan_search  # imports torch, to see whether every arm can learn
    return plan_search(path, root).grid


def searched_through(
    place: Grid, *, observing: Observing, stop: StopRequests, address: str = "local", mode: Mode = "auto",
    max_parallel: int | None = None, nodes: int = 1, server: ForkServer | None = None,
    reinstall: Callable[[], None] = lambda: None, say: Callable[[str], None] = lambda line: None,
) -> Manifest:  # fmt: skip
    """Work through generation after generation of a planned search; returns its manifest in the end.

    For whoever works on the grid. Arguments: as of `worked_through`. say: hears of every generation, too. Raises as
    `advance`, and Interrupted if asked to stop.
    """
    with needed_from("tune", "a search"):
        from space_dist.grid.trials import advance, open_runs
    manifest = place.manifest()  # now: whoever worked on it before us may have asked more
    if manifest.search is None:
        raise ConfigError(f"{place.folder} holds a grid: space-dist grid run {place.folder}")
    while manifest.search is not None and not manifest.search.over:
        if runs := open_runs(manifest):
            say(in_words(manifest))
            with observing(manifest) as observe:
                worked_through(
                    place, manifest, runs, stop=stop, observe=observe, address=address, mode=mode,
                    max_parallel=max_parallel, nodes=nodes, server=server, reinstall=reinstall, say=say,
                )  # fmt: skip
        after = advance(place, manifest)
        if after is None:  # somebody has let a failed run be tried again meanwhile
            continue
        manifest = after
    return manifest


def in_words(manifest: Manifest) -> str:
    """How far a search is: `pointmass: generation 2 of 6, 10 of 60 trials over`."""
    search = manifest.searched
    over = sum(trial.state != "open" for trial in search.trials)
    open_now = search.open
    racing = ""
    if open_now:
        upto = f" up to {open_now[0].steps:,} steps" if open_now[0].steps else ""
        seeds = "1 seed" if open_now[0].seeds == 1 else f"{open_now[0].seeds} seeds"
        racing = f", {len(open_now)} open with {seeds} each{upto}"
    if search.config["population"] is not None:
        return f"{manifest.name}: {len(search.trials)} members so far, {over} over{racing}"
    generations = -(-int(search.config["trials"]) // int(search.config["generation"]))
    return (
        f"{manifest.name}: generation {search.generation + 1} of {generations}, {over} of {search.total} trials over"
        f"{racing}"
    )
