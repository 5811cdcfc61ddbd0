"""Commands about grids: plan, run, submit, and what comes afterwards."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import shlex
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional, cast

import typer

from space_dist.cli.overview import (
    Watching,
    display,
    episodes_of,
    planned_steps,
    print_cells,
    print_stand,
    status_json,
    tell,
)
from space_dist.cli.terminal import STOP, Changes, Json, console, delivered, one_of, output_left, say, warn
from space_dist.errors import ConfigError, Interrupted, LedgerError, SpaceDistError, counted
from space_dist.system.extras import needed_from
from space_dist.system.files import LogFile
from space_dist.system.ray_address import of_a_job_server, of_a_ray

if TYPE_CHECKING:
    from ray.job_submission import JobDetails

    from space_dist.experiment.manifest import Grid, Manifest, Run
    from space_dist.experiment.status import RunStatus
    from space_dist.grid.fork_server import ForkServer
    from space_dist.grid.jobs import Mode, Remote

grid_app = typer.Typer(no_args_is_help=True, help="Many runs: cells (settings) x seeds.")

GridPath = Annotated[
    Path,
    typer.Argument(
        metavar="GRID",
        help="A grid's YAML file, its folder, its name below --root, or its manifest.json.",
        show_default=False,
    ),
]
Root = Annotated[
    Optional[Path],  # noqa: UP045 - typer reads annotations at run time
    typer.Option(help="Folder that holds the grids' folders. Default: runs; within a Ray job ~/space_dist/runs."),
]
Scale = Annotated[
    float,
    typer.Option(help="Of a YAML file: this share of its seeds and steps, in a folder of its own, NAME-scale-SCALE."),
]
MaxParallel = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(min=1, max=10_000, help="Runs at a time. Default: as many as there are CPUs for."),
]
Address = Annotated[
    str,
    typer.Option(
        help="local: this machine; auto: the Ray cluster this process is in; HOST:PORT: that one.", callback=of_a_ray
    ),
]
ClusterMode = Annotated[
    str,
    typer.Option(
        help="In a cluster: pool (workers that stay warm), jobs (a Ray job a run), auto: by length. On this "
        "machine Ray is used with `pool`, and by `auto` where runs have rollout actors."
    ),
]
Nodes = Annotated[int, typer.Option(min=1, max=10_000, help="In a cluster: wait until it has so many nodes.")]
Part = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(help="Only runs FIRST-LAST of the manifest, counted from 0: the part of a batch system's task."),
]
StopFile = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option(help="Stop, as on a signal, once this file exists: how a batch system's script passes one on."),
]
JobServer = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(help="The cluster's job server, where its storage is not seen from here.", callback=of_a_job_server),
]
Seed = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(help="The run's seed. Default: that of the cell, if it has only one.", show_default=False),
]

_MODES = ("auto", "pool", "jobs")
_WATCH_SECONDS = 1.0
_MAX_DIGITS = 9  # of a number that is asked for
_UNFINISHED = 3  # the exit code of `grid status` where runs are still to be done


@grid_app.command("plan")
def grid_plan(
    grid: GridPath, root: Root = None, scale: Scale = 1.0, changes: Changes = None, as_json: Json = False
) -> None:  # fmt: skip
    """Check a grid, print its cells and what is done already, and freeze its manifest."""
    from space_dist.experiment.status import run_statuses
    from space_dist.grid.planning import plan
    from space_dist.system.provenance import code_digest

    made = plan(grid, root_of(root), scale, changes or ())
    manifest = made.manifest
    found = run_statuses(made.grid, manifest, code_digest())
    done = [run_status for run_status in found if run_status.condition == "done"]
    left = sum(one.budget_steps - one.steps for one in found if one.condition != "done")
    if as_json:
        print_json({
            "grid": manifest.name, "folder": str(made.grid.folder), "seeds": list(manifest.seeds), "runs": len(found),
            "cpus_per_run": manifest.cpus_per_run, "steps": made.steps, "steps_left": left, "done": len(done),
            "new_runs": made.new_runs, "dropped_runs": made.dropped_runs,
            "cells": [{"id": cell.id, "label": cell.label, "settings": cell.settings, "budget_steps": cell.budget_steps}
                      for cell in manifest.cells],
        })  # fmt: skip
        return
    print_cells(manifest, found)
    say(
        f"{counted(len(manifest.cells), 'cell')} x {counted(len(manifest.seeds), 'seed')} = "
        f"{counted(len(found), 'run')}, {planned_steps(made)}; "
        f"{counted(manifest.cpus_per_run, 'CPU')} a run"
        + (" or population: runs of one shape share a process" if any(cell.stack for cell in manifest.cells) else "")
    )
    other = sum(run_status.other_code for run_status in done)
    say(
        f"done already: {counted(len(done), 'run')}"
        + (f", {other} of them by another version of this package" if other else "")
    )
    if made.dropped_runs:
        say(f"{made.dropped_runs} runs of the grid as it was frozen before are no longer in it; their folders are kept")
    say(f"frozen in {made.grid.folder}")


@grid_app.command("run")
def grid_run(
    grids: Annotated[
        list[Path],
        typer.Argument(
            metavar="GRID...", help="YAML files of grids, their folders, names below --root, or manifest.json."
        ),
    ],
    root: Root = None,
    scale: Scale = 1.0,
    changes: Changes = None,
    max_parallel: MaxParallel = None,
    address: Address = "local",
    mode: ClusterMode = "auto",
    part: Part = None,
    nodes: Nodes = 1,
    stop_file: StopFile = None,
    digest: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option("--runs", help="Refuse a manifest whose runs have another digest than this one."),
    ] = None,
) -> None:
    """Work through a grid, or one after the other: skip what is done, go on with what is not, retry by cause."""
    chosen = mode_of(mode)
    if len(grids) > 1 and (part is not None or digest is not None):
        raise ConfigError(f"--part and --runs are of one grid, and here are {len(grids)}")
    prepare(address)
    codes = []
    with started_ahead(address, chosen) as server:
        from space_dist.api.grids import frozen

        all_frozen = [frozen(grid, root_of(root), scale, changes or ()) for grid in grids]
        [place, manifest], *others = all_frozen
        if others and len({one.folder for one, _ in all_frozen}) < len(all_frozen):
            raise ConfigError(f"of {', '.join(map(str, grids))} two are one grid; name each once")
        if digest is not None and digest != manifest.runs_digest:
            raise ConfigError(
                f"{grids[0]} holds other runs (digest {manifest.runs_digest}) than those this was written for "
                f"({digest}): export the grid again, and submit that"
            )
        if stop_file is not None:
            STOP.watch(stop_file, manifest.resources.grace_seconds)
        found = run_frozen(
            place, manifest, address=address, mode=chosen, max_parallel=max_parallel, nodes=nodes, part=part,
            server=server,
        )  # fmt: skip
    codes.append(tell(manifest, place, found))
    for number, (place, manifest) in enumerate(others):
        if STOP.reason() is not None:
            waiting = ", ".join(later.name for _, later in others[number:])
            warn(f"stopped before {waiting}: run the same command again to go on")
            codes.append(Interrupted.exit_code)
            break
        found = run_frozen(place, manifest, address=address, mode=chosen, max_parallel=max_parallel, nodes=nodes)
        codes.append(tell(manifest, place, found))
    raise typer.Exit(next((code for code in codes if code), 0))


@grid_app.command("submit")
def grid_submit(
    grid: GridPath,
    address: Annotated[str, typer.Option(help="Its job server, like http://127.0.0.1:8265.", callback=of_a_job_server)],
    root: Root = None,
    scale: Scale = 1.0,
    changes: Changes = None,
    max_in_flight: Annotated[
        str, typer.Option(help="Runs at a time: auto (as many as there are CPUs for), or a number.")
    ] = "auto",
    mode: Annotated[
        str, typer.Option(help="pool (workers that stay warm), jobs (a Ray job a run), auto: by expected length.")
    ] = "auto",
    detach: Annotated[bool, typer.Option("--detach", help="Return once it is submitted.")] = False,
    py_modules: Annotated[
        Optional[list[Path]],  # noqa: UP045
        typer.Option("--py-module", help="A package of your own (environment, policy) that the cluster lacks."),
    ] = None,
    python: Annotated[str, typer.Option(help="The cluster's Python that has space_dist.")] = "python",
) -> None:
    """Submit a grid to a Ray cluster. Submitted twice, it still runs once."""
    STOP.install("no longer looking on; what was submitted goes on in the cluster")
    with needed_from("ray", "`grid submit`"):
        from space_dist.grid.jobs import Remote
    from space_dist.api.grids import frozen

    chosen = mode_of(mode)
    limit = None if max_in_flight == "auto" else _number(max_in_flight, "--max-in-flight")
    base = root_of(root)
    place, manifest = frozen(grid, base, scale, changes or ())
    remote = Remote(address, manifest, base)
    if reason := STOP.reason():
        raise Interrupted(f"stopped by {reason} before it was submitted")
    job = remote.submit(place, mode=chosen, max_in_flight=limit, py_modules=py_modules or (), python=python)
    named = " (no --root was given)" if root is None else ""
    say(f"{manifest.name}: conducted by job {job} at {address}; its runs go into {base / manifest.name} there{named}")
    if detach:
        say(f"`space-dist grid status {place.folder}` tells how far it is, `grid submit` again looks on")
        return
    code = remote.follow(job, say, STOP.reason)
    found = run_statuses_of(place, manifest)
    if not any(run_status.attempts or run_status.steps for run_status in found):
        warn(
            f"{place.folder} shows no run of it: it is not on the cluster's storage. What is seen from here is "
            "limited to what the conductor said above"
        )
        raise typer.Exit(code)
    raise typer.Exit(tell(manifest, place, found))


@grid_app.command("status")
def grid_status(
    grid: GridPath,
    root: Root = None,
    scale: Scale = 1.0,
    changes: Changes = None,
    watch: Annotated[bool, typer.Option("--watch", help="Go on showing until nothing is left to do.")] = False,
    as_json: Json = False,
    by_cause: Annotated[bool, typer.Option("--by-cause", help="Group what is not done by why.")] = False,
    address: JobServer = None,
) -> None:
    """Where every run stands. Exit codes: 0 complete, 1 failures, 3 unfinished, 2 there is no such grid."""
    from space_dist.experiment.status import exit_code
    from space_dist.slurm.queue import WatchedQueue

    place, manifest = _found(grid, root, scale, changes or ())
    if address is not None:
        raise typer.Exit(_remote_status(place, manifest, address))
    watched, watching, shown = WatchedQueue(place.folder), Watching(), dict[str, Any]()
    while True:
        queue = watched.now()
        found = run_statuses_of(place, manifest)
        now = status_json(manifest, place, found) | ({} if queue is None else {"slurm": queue.to_json()})
        if now == shown and not console.is_terminal:  # a file or a pipe keeps what it was told
            pass
        elif as_json:
            print_json(now)
        else:
            if watch and console.is_terminal:
                console.clear()
            print_stand(place, manifest, found, by_cause, queue)
        shown = now
        settled = all(run_status.condition in ("done", "failed") for run_status in found)
        if not watch or output_left() or settled or watching.is_over(place, queue, found):
            raise typer.Exit(exit_code(found))
        time.sleep(_WATCH_SECONDS)


@grid_app.command("logs")
def grid_logs(
    grid: GridPath,
    cell: Annotated[str, typer.Argument(help="A cell's label, or the start of its id.")],
    seed: Seed = None,
    root: Root = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="Go on until the run has ended, or nobody works on the grid.")
    ] = False,
) -> None:
    """What one run has said."""
    from space_dist.cli.logs import RunLog
    from space_dist.slurm.queue import WatchedQueue

    place, manifest = _found(grid, root)
    run = manifest.run(cell, seed)
    ledger = place.ledger(run)
    [run_status] = run_statuses_of(place, manifest, [run])
    watched, watching, log = WatchedQueue(place.folder), Watching(begun=run_status.attempts > 0), RunLog(ledger)
    while True:
        [run_status] = run_statuses_of(place, manifest, [run])
        log.show()
        if not follow or output_left() or run_status.condition in ("done", "failed"):
            break
        if watching.is_over(place, watched.now(), [run_status]):
            warn("nobody works on the grid any more")
            break
        time.sleep(_WATCH_SECONDS)
    log.tell_left_out()
    taken = f"{run_status.steps:,} of {run_status.budget_steps:,} steps"
    if (limit := run.cell.episodes_to_take) is not None:
        taken += f", {episodes_of(ledger):,} of {limit:,} episodes"
    warn(f"{run.title}: {run_status.in_words}, {taken}. {ledger.folder}")
    if run_status.detail and run_status.condition != "done":
        warn(run_status.detail)
    if run_status.condition == "waiting" and run_status.attempts and not place.owner_alive():
        warn(f"going on with it: {_how_again(grid, place, manifest)}")  # the log is of `train`, and says --resume


@grid_app.command("stop")
def grid_stop(
    grid: GridPath,
    root: Root = None,
    address: JobServer = None,
) -> None:
    """Have all runs make a checkpoint and end. Running or submitting the grid again goes on from there."""
    from space_dist.slurm.queue import queue_of

    place, manifest = _found(grid, root)
    if address is not None:
        remote, conductor = _conductor(place, manifest, address)
        remote.stop(str(conductor.submission_id))
        say(f"{manifest.name}: job {conductor.submission_id} was asked to stop its runs, and itself")
        return
    live = [run_status for run_status in run_statuses_of(place, manifest) if run_status.condition == "running"]
    queue = queue_of(place.folder)
    if not live and not place.owner_alive() and not (queue and queue.live):
        say(f"{manifest.name}: nothing is running")
        return
    place.stop_file.touch()
    for run_status in live:  # those nobody conducts any more, too
        run_status.ledger.stop_file.touch()
    were = "was" if len(live) == 1 else "were"
    asked = f"{counted(len(live), 'run')} {were} asked to make a checkpoint and end"
    say(f"{manifest.name}: {asked if live else 'asked to stop; no run is at work now'}")
    if queue and queue.live:
        say("SLURM jobs that still wait will end as soon as they start; scancel removes them")


@grid_app.command("retry")
def grid_retry(
    grid: GridPath,
    cause: Annotated[list[str], typer.Option("--cause", help="Causes of failures to try again; repeatable.")],
    root: Root = None,
) -> None:
    """Let failed runs be tried again, whatever the grid's `retry` says; they go on from their checkpoints."""
    from space_dist.experiment.endings import Cause
    from space_dist.experiment.status import Attempts

    known = [one.value for one in Cause]
    causes = {name.strip().replace("-", "_") for text in cause for name in text.split(",")}
    for name in sorted(causes):
        one_of(known, name, "--cause")
    place, manifest = _found(grid, root)
    forgiven = 0
    for run_status in run_statuses_of(place, manifest):
        failed = run_status.condition == "failed" and run_status.cause in causes
        looked_into = Cause.UNREADABLE in causes and (failed or run_status.condition == "done")
        if what := _unreadable(run_status) if looked_into else "":
            told = dataclasses.replace(run_status, cause=Cause.UNREADABLE)
            say(f"{run_status.run.title}: {what}; {told.way_out}")
        elif failed:
            Attempts(run_status.ledger).forgive()
            say(f"{run_status.run.title}: {run_status.in_words}; it will be tried again")
            forgiven += 1
    say(f"{counted(forgiven, 'run')} may be tried again{f'; {_how_again(grid, place, manifest)}' if forgiven else ''}")


def _how_again(named: Path, place: Grid, manifest: Manifest) -> str:
    """Which commands go on with what may be tried again. named: the grid, as its user did."""
    from space_dist.slurm.export import JOBS, SUBMIT

    if manifest.search is not None:
        ways = [f"`space-dist tune run {shlex.quote(str(place.folder))}`"]
    else:
        ways = [f"`space-dist grid run {named if named.is_file() else place.folder}`", "`grid submit`"]
    script = place.folder / SUBMIT
    if script.is_file():
        ways = [f"`{shlex.quote(str(script))}`, on SLURM,", *ways]
    elif (place.folder / JOBS).exists():  # it was exported with --root
        ways = [f"`./{SUBMIT}` of the exported folder, on SLURM,", *ways]
    how = f"{' or '.join(ways)} does it"
    if named.is_file() or manifest.search is not None:
        return how
    return f"{how}, as the grid was frozen; what has changed in its YAML file comes in when that file is run"


def _unreadable(run_status: RunStatus) -> str:
    """The first of what a run has written and nobody can read any more; empty if that is nothing."""
    try:
        return next(iter(run_status.ledger.damage()), "")
    except LedgerError as error:  # its status
        return str(error)


@grid_app.command("work", hidden=True)
def grid_work(
    folder: Path,
    attempts: Annotated[list[str], typer.Argument(help="CELL:SEED:ATTEMPT of each run.")],
    nonce: Annotated[str, typer.Option()],
    job: Annotated[str, typer.Option()],
) -> None:
    """One attempt of one run, or of several in one process, as a job of its own."""
    STOP.install()
    from space_dist.experiment.endings import AskedBy, Cause

    with needed_from("ray", "a Ray job"):
        from space_dist.grid.pool import refuse_other_folder
    from space_dist.grid.supervisor import AttemptId, Supervisor, Task, preload
    from space_dist.system.workplace import lasting

    refuse_other_folder(lasting(folder, "the grid's folder"), nonce)
    preload()
    stop_file = folder / "stop"

    def stop_requested() -> AskedBy | None:
        if STOP.reason() is None:
            return None
        return "user" if stop_file.exists() else "others"

    task = Task(str(folder), tuple(map(AttemptId.parse, attempts)), "auto", {"job": job})
    failed = [ended for ended in Supervisor().attempt(task, stop_requested) if ended.cause is not None]
    for ended in failed:
        warn(f"space-dist: {ended.cause.in_words if ended.cause else ''}: {ended.detail}")
    resumable = (Cause.STOPPED, Cause.PREEMPTED, Cause.TIMEOUT)
    # The worst one counts: 75, which asks for another start, must not hide a failure.
    codes = {75 if one.cause in resumable else 2 if one.cause is Cause.CONFIG_ERROR else 1 for one in failed}
    if codes:
        raise typer.Exit(min(codes, key=[1, 2, 75].index))


def run_frozen(
    place: Grid, manifest: Manifest, runs: Sequence[Run] | None = None, *, address: str = "local", mode: Mode = "auto",
    max_parallel: int | None = None, nodes: int = 1, part: str | None = None, server: ForkServer | None = None,
) -> list[RunStatus]:  # fmt: skip
    """Work through a frozen grid, or these runs of it, with a display; returns where they stand in the end.

    part: `FIRST-LAST` of them, counted from 0. server: from `started_ahead`.
    """
    prepare(address)
    from space_dist.api.grids import worked_through
    from space_dist.grid.conductor import working_on

    chosen = _part(manifest.runs() if runs is None else runs, part)
    log_to(place)
    with contextlib.ExitStack() as stack:
        if part is None:
            stack.enter_context(working_on(place, manifest, wait=True, stop=STOP, say=warn))
        observe = stack.enter_context(display(manifest, place))
        return worked_through(
            place, manifest, chosen, address=address, mode=mode, max_parallel=max_parallel, nodes=nodes,
            server=server, stop=STOP, reinstall=STOP.install, observe=observe, say=say,
        )  # fmt: skip


# ---- parts ----------------------------------------------------------------------------------------------------------


def prepare(address: str) -> None:
    """What must come before Ray, and anything else that is heavy, is imported."""
    STOP.install()
    if address == "local":
        from space_dist.system.workplace import private_ray

        private_ray()


@contextlib.contextmanager
def started_ahead(address: str, mode: Mode) -> Iterator[ForkServer | None]:
    """Who imports what runs need while it is planned what they will do, where runs work without Ray."""
    if address != "local" or mode != "auto":
        yield None
        return
    from space_dist.grid.fork_server import ForkServer

    with ForkServer() as server:
        yield server


def root_of(root: Path | None) -> Path:
    """The folder that holds the grids' folders."""
    from space_dist.system.workplace import lasting, workplace

    return workplace() / "runs" if root is None else lasting(root, "--root")


def _found(
    path: Path, root: Path | None, scale: float = 1.0, changes: Sequence[str] = ()
) -> tuple[Grid, Manifest]:  # fmt: skip
    """A grid that was frozen before, however the user names it."""
    from space_dist.experiment.manifest import find_grid

    place = find_grid(path, root_of(root), scale, changes)
    tell_results_elsewhere(place)
    return place, place.manifest()


def tell_results_elsewhere(place: Grid) -> None:
    """Say where the results are of a folder that was exported for SLURM with another root, and holds none."""
    from space_dist.slurm.export import results_elsewhere

    if (results := results_elsewhere(place.folder)) is not None:
        named = shlex.quote(str(results))
        where = f"name {named} instead, where they are" if results.exists() else f"its jobs will put them into {named}"
        warn(f"{place.folder} was exported with --root, and holds no results: {where}")


def mode_of(text: str) -> Mode:
    """What `--mode` was given. Raises ConfigError if there is no such mode."""
    return cast("Mode", one_of(_MODES, text, "--mode"))


def _number(text: str, option: str) -> int:
    if not text.isdecimal() or len(text) > _MAX_DIGITS or not 1 <= int(text) <= 10_000:
        raise ConfigError(f"{option} {text[:40]!r}: write auto, or a whole number from 1 to 10000")
    return int(text)


def _part(runs: Sequence[Run], part: str | None) -> Sequence[Run]:
    if part is None:
        return runs
    first, dash, last = part.partition("-")
    numbers = dash and first.isdecimal() and last.isdecimal() and max(len(first), len(last)) <= _MAX_DIGITS
    if not numbers or int(first) > int(last):
        raise ConfigError(f"--part {part[:40]!r}: write FIRST-LAST, like 0-3")
    if int(first) >= len(runs):
        raise ConfigError(f"--part {part}: the grid has {len(runs)} runs, counted from 0")
    return runs[int(first) : int(last) + 1]


def run_statuses_of(place: Grid, manifest: Manifest, runs: Sequence[Run] | None = None) -> list[RunStatus]:
    """Where the runs of a grid stand now."""
    from space_dist.experiment.status import run_statuses
    from space_dist.system.provenance import code_digest

    return run_statuses(place, manifest, code_digest(), runs)


def log_to(place: Grid) -> None:
    """Have what happens to the runs stand in the grid's log, too."""
    log = logging.getLogger("space_dist")
    log.setLevel(logging.INFO)
    with contextlib.suppress(OSError):
        handler = LogFile(place.log)
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        log.addHandler(handler)


def _conductor(place: Grid, manifest: Manifest, address: str) -> tuple[Remote, JobDetails]:
    """The job that conducts a grid on the cluster at `address`. Raises SpaceDistError if there was none."""
    with needed_from("ray", f"--address {address}"):
        from space_dist.grid.jobs import Remote

    remote = Remote(address, manifest, place.folder.parent)
    conductor = remote.conductor()
    if conductor is None:
        raise SpaceDistError(f"{address} knows no conductor of {manifest.name}")
    return remote, conductor


def _remote_status(place: Grid, manifest: Manifest, address: str) -> int:
    """What the job server knows, where the ledgers are not seen from here."""
    remote, conductor = _conductor(place, manifest, address)
    lines = [line for line in remote.logs(str(conductor.submission_id)).splitlines() if line.strip()]
    say(f"job {conductor.submission_id}: {conductor.status.value.lower()}")
    for line in lines[-5:]:
        say(line)
    warn("this is all that the job server tells; the runs' own files are on the cluster's storage")
    if conductor.status.value in ("PENDING", "RUNNING"):
        return _UNFINISHED
    return conductor.driver_exit_code or 0


def print_json(data: dict[str, Any]) -> None:
    """What a command was asked for as JSON. Raises SpaceDistError if it is lost."""
    print(json.dumps(data, indent=1))
    delivered()
