"""Commands about SLURM: write a grid or a search as scripts, and submit them."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional, cast

import typer

from space_dist.cli.grids import (
    Address,
    ClusterMode,
    MaxParallel,
    Nodes,
    Part,
    StopFile,
    mode_of,
    prepare,
    run_frozen,
)
from space_dist.cli.overview import tell
from space_dist.cli.terminal import STOP, one_of, say, warn
from space_dist.cli.tuning import tell_outcome, tune_confirm
from space_dist.errors import ConfigError, SpaceDistError, counted
from space_dist.system.extras import needed_from

if TYPE_CHECKING:
    from space_dist.experiment.manifest import Grid, Manifest
    from space_dist.slurm import Mode, Profile

slurm_app = typer.Typer(no_args_is_help=True, help="The same grid, or search, as SLURM scripts.")

Interface = Annotated[Optional[str], typer.Option()]  # noqa: UP045 - typer reads annotations at run time

_MODES = ("array", "cluster")
_UNFINISHED = 3  # the exit code of `slurm advance` where something is to be submitted
_SECONDS = 60.0  # for sbatch, which waits for a busy controller
_NO_CLUSTER = ("Could not establish a configuration source", "Unable to contact slurm controller")  # sbatch's words


@slurm_app.command("export")
def slurm_export(
    grid: Annotated[
        Path,
        typer.Argument(
            metavar="GRID",
            help="A grid's or a search's YAML file, its folder, or its manifest.json.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the scripts and the frozen grid.")],
    root: Annotated[
        Optional[Path],  # noqa: UP045 - typer reads annotations at run time
        typer.Option(help="Folder, seen by all nodes, below which results go. Default: the exported folder itself."),
    ] = None,
    profile: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="The site's YAML file, like configs/slurm/site.yaml."),
    ] = None,
    mode: Annotated[
        str, typer.Option(help="array: each array task does its runs alone; cluster: one Ray over all nodes of a job.")
    ] = "array",
    throttle: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Array tasks (cluster mode: runs) at a time."),
    ] = None,
    cells_per_task: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Runs (a cell with one seed each, not cells) that an array task does: pack short ones."),
    ] = None,
    overrides: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Override a key of the profile, e.g. partition=cpu. Repeatable."
        ),
    ] = None,
    templates: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder with templates of your own, which replace ours of the same name."),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Also have bash, shellcheck and sbatch look at them.")] = False,
) -> None:
    """Write a grid as scripts that train it, check and report on it, with the exact commands. The same, every time.

    Those of a search train generation after generation, and submit the next ones themselves.
    """
    from space_dist.config.reading import from_option
    from space_dist.slurm import Export, export, load_profile

    chosen = cast("Mode", one_of(_MODES, mode, "--mode"))
    if templates is not None and not templates.is_dir():
        raise ConfigError(f"--templates {templates} is no folder")
    if out.is_file():
        raise ConfigError(f"--out {out} is a file; a folder for the scripts is wanted")
    options = [("--throttle", "throttle", throttle), ("--cells-per-task", "cells_per_task", cells_per_task)]
    settings = [from_option(*option) for option in options if option[-1] is not None]
    site = load_profile(profile, [*(overrides or ()), *settings])
    _refuse_nodes(overrides or (), site, chosen)
    manifest, instances = _frozen(grid, out)
    made = Export(manifest, site, chosen, None if root is None else root.absolute())
    for path in export(made, instances, out, templates):
        say(str(path))
    tasks = counted(made.n_tasks, "array task") if mode == "array" else f"one job of {counted(site.nodes, 'node')}"
    at_most = "" if manifest.search is None else "at most "
    runs = counted(made.n_runs, "run")
    say(f"{manifest.name}: {at_most}{runs} in {tasks}; {out / 'README.md'} says what to do with it")
    settings_told = made.time_remark(), made.empty_remark(), made.nodes_remark()
    for remark in filter(None, (made.tracking_remark(out), made.import_remark(), *settings_told)):
        warn(f"warning: {remark}")
    if check:
        _check_environment(site)
        _check(out, made.scripts)


def _refuse_nodes(overrides: Sequence[str], site: Profile, mode: Mode) -> None:
    """Raise ConfigError for `--set nodes=N` of arrays. A site's file may have it, for the other mode."""
    from space_dist.config.reading import told

    for override in overrides:
        if mode == "array" and override.partition("=")[0].strip() == "nodes" and site.nodes > 1:
            raise ConfigError(
                f"{told(override)}: nodes is for --mode cluster, one Ray over the nodes of a job; in array mode, the "
                "default, each task has one node"
            )


@slurm_app.command("submit")
def slurm_submit(folder: Annotated[Path, typer.Argument(metavar="DIR", help="An exported folder.")]) -> None:
    """Submit an exported grid or search, or go on with it. Submitted twice, it still runs once."""
    from space_dist.slurm.export import SUBMIT

    script = folder / SUBMIT
    if folder.is_file():
        raise ConfigError(f"{folder} is a file: name the folder DIR of `space-dist slurm export {folder} --out DIR`")
    if not script.is_file():
        raise ConfigError(f"{folder} holds no {SUBMIT}: `space-dist slurm export GRID --out {folder}` writes one")
    raise typer.Exit(subprocess.run([_bash(), str(script.absolute())], check=False).returncode)


@slurm_app.command("address", hidden=True)
def slurm_address(
    peer: Annotated[str, typer.Option(help="A node that must reach this one.")],
    interface: Interface = None,
) -> None:
    """Print the address by which this node is to be known to the others."""
    from space_dist.slurm.node import address_facing

    print(address_facing(peer, interface))


@slurm_app.command("node", hidden=True)
def slurm_node(
    head: str,
    port: Annotated[int, typer.Option(min=1024, max=65000)],
    cpus: Annotated[int, typer.Option(min=1)],
    temp: Annotated[Path, typer.Option()],
    interface: Interface = None,
) -> None:
    """Be one node of a job's Ray, until asked to end."""
    from space_dist.slurm.node import serve

    raise typer.Exit(serve(head, port, cpus=cpus, temp=temp, interface=interface))


@slurm_app.command("task", hidden=True)
def slurm_task(
    folder: Path,
    trials: Annotated[str, typer.Option(help="The digest of the search's trials whose open runs these are.")],
    part: Part = None,
    stop_file: StopFile = None,
    max_parallel: MaxParallel = None,
    address: Address = "local",
    mode: ClusterMode = "auto",
    nodes: Nodes = 1,
) -> None:
    """Work through open runs of a search, or a part of them, as a task of a job."""
    chosen = mode_of(mode)
    prepare(address)
    from space_dist.experiment.manifest import Grid

    with needed_from("tune", "a search"):
        from space_dist.slurm.searches import runs_of_task

    place = Grid(folder)
    task = runs_of_task(place, trials)
    if task is None:
        say(f"nothing to do: the search of {folder} has gone on since this was submitted")
        return
    manifest, runs = task
    if stop_file is not None:
        STOP.watch(stop_file, manifest.resources.grace_seconds)
    found = run_frozen(
        place, manifest, runs, address=address, mode=chosen, max_parallel=max_parallel, nodes=nodes, part=part
    )  # fmt: skip
    raise typer.Exit(tell(manifest, place, found))


@slurm_app.command("advance", hidden=True)
def slurm_advance(
    search: Annotated[Path, typer.Argument(help="The search's folder, or an exported manifest.json.")],
    plan: Annotated[Path, typer.Option("--next", help="File for what is to be submitted next.")],
    after: Annotated[str, typer.Option(help="How far the runs were that were submitted last, or `first`.")],
    cells_per_task: Annotated[int, typer.Option(min=1)],
    max_array_size: Annotated[int, typer.Option(min=2)],
    throttle: Annotated[Optional[int], typer.Option(min=1)] = None,  # noqa: UP045
    root: Optional[Path] = None,  # noqa: UP045
) -> None:
    """Record what came of a search's runs. Exit codes: 0 over, and what confirms it written; 3 unfinished."""
    from space_dist.api.tuning import in_words
    from space_dist.experiment.manifest import find_grid

    with needed_from("tune", "a search"):
        from space_dist.slurm.searches import gone_on, next_arrays, settled_in

    place = settled_in(find_grid(search, search), root)
    manifest = gone_on(place, after, say)
    if manifest.searched.over:
        tell_outcome(place, manifest)
        tune_confirm(place.folder)
        return
    arrays = next_arrays(place, manifest, cells_per_task, max_array_size, throttle)
    arrays.write(plan)
    say(f"{in_words(manifest)}: {arrays.waiting} of {arrays.runs} runs to be done")
    raise typer.Exit(_UNFINISHED)


def _frozen(path: Path, out: Path) -> tuple[Manifest, Mapping[str, bytes]]:
    """A grid or search that is frozen already, or frozen now from its YAML file, with its instance files.

    A search that `out` holds already, and that may have gone on, is taken from there.
    """
    import tempfile

    from space_dist import config as configs
    from space_dist.experiment.manifest import MANIFEST, Grid, find_grid
    from space_dist.experiment.tuning import is_search
    from space_dist.grid.planning import plan

    with contextlib.ExitStack() as stack:
        if path.is_dir() or path.name == MANIFEST:
            grid = find_grid(path, path)
            if out.resolve() != grid.folder.resolve():
                _refuse_begun(grid)
        else:
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            if is_search(configs.read_yaml(configs.located(path))):
                with needed_from("tune", "a search"):
                    from space_dist.grid.tuning import plan_search
                there = out if Grid(out).manifest_file.exists() else None
                grid = plan_search(path, scratch, there).grid
            else:
                grid = plan(path, scratch).grid
        manifest = grid.manifest()
        return manifest, grid.instance_files(manifest)


def _refuse_begun(grid: Grid) -> None:
    """Raise ConfigError for a search of which runs were recorded: what it goes on from lies in its folder alone."""
    manifest = grid.manifest()
    if manifest.search is None:
        return
    with needed_from("tune", "a search"):
        from space_dist.slurm.searches import has_begun
    if has_begun(manifest):
        raise ConfigError(
            f"{grid.folder} holds a search that has begun, and goes on from its runs: export it to its own folder, "
            f"with --out {grid.folder}"
        )


def _bash() -> str:
    found = shutil.which("bash")
    if found is None:
        raise SpaceDistError("there is no bash here")
    return found


def _check_environment(site: Profile) -> None:
    """Say what of a profile's modules and environment is not here: on nodes that lack it, too, jobs end at once."""
    from space_dist.config import clean

    if site.modules and not site.prologue:  # a line of which may be what brings the command `module`
        try:
            asked = subprocess.run(
                [_bash(), "-c", 'for name; do module load "$name" || exit; done', "bash", *site.modules],
                stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_SECONDS, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise SpaceDistError(f"`module load` does not end within {_SECONDS:.0f} s") from None
        if asked.returncode:
            why = next(iter(asked.stderr.strip().splitlines()), "it says nothing")
            warn(f"modules: `module load` of {', '.join(site.modules)} fails here, as it would in a job: {clean(why)}")
    if site.venv is None:
        return
    needed = ["activate", *(["space-dist"] if site.command == ("space-dist",) and site.apptainer is None else [])]
    for name in needed:
        if not (Path(site.venv) / "bin" / name).is_file():
            warn(f"venv: {site.venv} has no bin/{name} here, which jobs need on their nodes")
            break


def _check(folder: Path, scripts: tuple[str, str, str]) -> None:
    """Raises SpaceDistError for the first objection; says which of the three could not be asked."""
    commands: list[tuple[str, list[str], tuple[str, ...]]] = [
        ("bash", ["-n"], scripts),
        ("shellcheck", [], scripts),
        ("sbatch", ["--test-only"], scripts[:2]),
    ]
    for program, options, files in commands:
        path = shutil.which(program)
        if path is None:
            warn(f"not checked by {program}, which is not here")
            continue
        for file in files:
            try:
                done = subprocess.run(
                    [path, *options, file], cwd=folder, capture_output=True, text=True, timeout=_SECONDS, check=False
                )
            except subprocess.TimeoutExpired:
                raise SpaceDistError(f"{program} does not answer within {_SECONDS:.0f} s") from None
            said = (done.stdout + done.stderr).strip()
            if done.returncode and program == "sbatch" and any(words in said for words in _NO_CLUSTER):
                warn(f"not checked by sbatch, which finds no cluster here: {said.splitlines()[-1]}")
                break
            if done.returncode:
                raise SpaceDistError(f"{program} objects to {folder / file}:\n{said}")
        else:
            say(f"{' '.join([program, *options])}: no objection")
