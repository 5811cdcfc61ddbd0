"""The command line: parse, build, call. Exit codes: 0 done, 75 stopped and resumable, 2 bad input, else failed."""

from __future__ import annotations

from space_dist.cli.terminal import CTRL_C, keep_outputs, say, spread, warn  # isort: skip - before anything heavy

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from space_dist import __version__
from space_dist.arithmetic import overruled
from space_dist.cli import evidence, runs, starting
from space_dist.cli.curricula import curriculum_app
from space_dist.cli.grids import grid_app
from space_dist.cli.health import doctor
from space_dist.cli.inputs import config_app, instances_app
from space_dist.cli.slurm import slurm_app
from space_dist.cli.tuning import tune_app
from space_dist.cli.worlds import env_app, render
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.system.processes import collect_seldom

_INTERRUPTED = 128 + 2  # SIGINT's exit code

app = typer.Typer(
    name="space-dist", no_args_is_help=True, pretty_exceptions_enable=False,
    help="Self-paced curricula for contextual reinforcement learning.",
)  # fmt: skip
for _command in (
    starting.init, starting.configs, runs.train, runs.evaluate, runs.explain, runs.report, runs.sync, runs.export_sb3,
    evidence.fork, evidence.headroom, render, doctor,
):  # fmt: skip
    app.command()(_command)
app.add_typer(grid_app, name="grid")
app.add_typer(tune_app, name="tune")
app.add_typer(slurm_app, name="slurm")
app.add_typer(instances_app, name="instances")
app.add_typer(config_app, name="config")
app.add_typer(env_app, name="env")
app.add_typer(curriculum_app, name="curriculum")


def _tell_version(asked: bool) -> None:
    if asked:
        say(f"space-dist {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Tell the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run a command; every error that a user can cause ends it with one sentence and its exit code."""
    collect_seldom()
    keep_outputs()
    for sentence in overruled():
        warn(f"space-dist: {sentence}")
    try:
        Path.cwd()
    except FileNotFoundError:
        warn("space-dist: the current folder was removed: cd into one that is there")
        sys.exit(ConfigError.exit_code)
    try:
        app(args=spread(sys.argv[1:]))
    except SystemExit as error:
        if error.code == _INTERRUPTED:  # Typer's, which says nothing
            warn(f"space-dist: {CTRL_C}")
        raise
    except SpaceDistError as error:
        for line in str(error).splitlines():
            warn(f"space-dist: {line}")
        sys.exit(error.exit_code)
    except Exception as error:
        # Nobody wants a traceback on their terminal; who does says so.
        if os.environ.get("SPACE_DIST_TRACEBACK"):
            raise
        what = f"{type(error).__name__}: {str(error)[:300]}"
        hint = "SPACE_DIST_TRACEBACK=1 shows where"
        warn(f"space-dist: unexpected: {what} ({hint})")
        sys.exit(1)
