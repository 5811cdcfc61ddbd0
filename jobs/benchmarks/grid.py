"""What a warm pool saves: 16 short runs on it, and as 16 Ray jobs two at a time, on the same cluster."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.results import JsonFile, keep, refuse_if
from benchmarks.servers import RayHead
from space_dist import config as configs
from space_dist.errors import SpaceDistError

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 0.5  # of the jobs' wall time
CORES = 2
console = Console()


def grid(
    runs: Annotated[int, typer.Option(min=2, help="Short runs of 20,480 PointMass steps.")] = 16,
    json_file: JsonFile = None,
) -> None:
    """Wall time of short runs: a warm pool of two workers against one Ray job a run, two at a time."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path = folder / "grid.yaml"
        path.write_text(configs.to_yaml({
            "name": "short", "extends": str(ROOT / "configs/pointmass_space.yaml"),
            "set": {"budget.steps": 20480}, "seeds": {"count": runs}, "tracking": {"uri": None},
        }))  # fmt: skip
        sockets = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sd", dir="/tmp")))  # a short path
        head = stack.enter_context(RayHead(sockets, CORES, os.environ, folder / "head.log"))
        seconds = {mode: _submit(path, folder / mode, head.address, mode, head.environment)
                   for mode in ("pool", "jobs")}  # fmt: skip
    ratio = seconds["pool"] / seconds["jobs"]
    table = Table(title=f"{runs} runs of 20,480 steps, two at a time, submission and start included")
    for column in ("", "wall time", "of the jobs'"):
        table.add_column(column, justify="right")
    for mode, name in (("jobs", "one Ray job a run"), ("pool", "warm pool")):
        table.add_row(name, f"{seconds[mode]:.1f} s", f"{seconds[mode] / seconds['jobs']:.0%}")
    console.print(table)
    console.print(f"at most {LIMIT:.0%} is wanted")
    keep({**seconds, "ratio": ratio, "limit": LIMIT}, json_file)
    refuse_if(ratio > LIMIT, console)


def _submit(path: Path, root: Path, address: str, mode: str, environment: dict[str, str]) -> float:
    command = [
        sys.executable, "-m", "space_dist.cli", "grid", "submit", str(path), "--address", address, "--root", str(root),
        "--mode", mode, "--max-in-flight", str(CORES),
    ]  # fmt: skip
    start = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SpaceDistError(f"the grid did not complete as {mode}: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return time.perf_counter() - start
