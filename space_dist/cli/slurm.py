"""Commands about SLURM: write a grid as scripts, and submit them."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional, cast

import typer

from space_dist.cli.grids import GridPath
from space_dist.cli.terminal import one_of, say, warn
from space_dist.errors import ConfigError, SpaceDistError

if TYPE_CHECKING:
    from space_dist.experiment.manifest import Manifest
    from space_dist.slurm import Mode

slurm_app = typer.Typer(no_args_is_help=True, help="The same grid as SLURM scripts.")

Interface = Annotated[Optional[str], typer.Option()]  # noqa: UP045 - typer reads annotations at run time

_MODES = ("array", "cluster")
_SECONDS = 60.0  # for sbatch, which waits for a busy controller


@slurm_app.command("export")
def slurm_export(
    grid: GridPath,
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
        typer.Option(help="Runs that an array task does: pack short ones."),
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
    """Write a grid as scripts that train it, check and report on it, with the exact commands. The same, every time."""
    from space_dist.slurm import Export, export, load_profile

    chosen = cast("Mode", one_of(_MODES, mode, "--mode"))
    if templates is not None and not templates.is_dir():
        raise ConfigError(f"--templates {templates} is no folder")
    settings = list(overrides or [])
    settings += [] if throttle is None else [f"throttle={throttle}"]
    settings += [] if cells_per_task is None else [f"cells_per_task={cells_per_task}"]
    site = load_profile(profile, settings)
    manifest, instances = _frozen(grid)
    made = Export(manifest, site, chosen, None if root is None else root.absolute())
    for path in export(made, instances, out, templates):
        say(str(path))
    tasks = f"{made.n_tasks} array tasks" if mode == "array" else f"one job of {site.nodes} nodes"
    say(f"{manifest.name}: {made.n_runs} runs in {tasks}; {out / 'README.md'} says what to do with it")
    if remark := made.tracking_remark(out):
        warn(f"warning: {remark}")
    if check:
        _check(out)


@slurm_app.command("submit")
def slurm_submit(folder: Annotated[Path, typer.Argument(metavar="DIR", help="An exported folder.")]) -> None:
    """Submit an exported grid, or go on with it. Submitted twice, it still runs once."""
    from space_dist.slurm.export import SUBMIT

    script = folder / SUBMIT
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


def _frozen(path: Path) -> tuple[Manifest, Mapping[str, bytes]]:
    """A grid that is frozen already, or frozen now from its YAML file, with its instance files."""
    import tempfile

    from space_dist.experiment.manifest import MANIFEST, find_grid
    from space_dist.grid.planning import plan

    with contextlib.ExitStack() as stack:
        if path.is_dir() or path.name == MANIFEST:
            grid = find_grid(path, path)
        else:
            grid = plan(path, Path(stack.enter_context(tempfile.TemporaryDirectory()))).grid
        manifest = grid.manifest()
        return manifest, grid.instance_files(manifest)


def _bash() -> str:
    found = shutil.which("bash")
    if found is None:
        raise SpaceDistError("there is no bash here")
    return found


def _check(folder: Path) -> None:
    """Raises SpaceDistError for the first objection; says which of the three could not be asked."""
    from space_dist.slurm.export import AGGREGATE, SUBMIT, TRAIN

    commands: list[tuple[str, list[str], tuple[str, ...]]] = [
        ("bash", ["-n"], (TRAIN, AGGREGATE, SUBMIT)),
        ("shellcheck", [], (TRAIN, AGGREGATE, SUBMIT)),
        ("sbatch", ["--test-only"], (TRAIN, AGGREGATE)),
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
            if done.returncode:
                raise SpaceDistError(f"{program} objects to {folder / file}:\n{(done.stdout + done.stderr).strip()}")
        say(f"{' '.join([program, *options])}: no objection")
