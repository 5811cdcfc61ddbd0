"""Artefacts: `make results NAME=pointmass_uniform` runs one grid of configs/paper and keeps what it shows.

`NAME=wins` is every grid of configs/wins and its `why` (docs/wins.md), `NAME=wins/gates` one of them, `NAME=all` all.

Into docs/results/NAME go the report, its numbers in full precision as CSV, its figures, and `provenance.json`: the
command, the commit, the arithmetic, and how much was run. Run again anywhere, the numbers are the same, byte for byte.
What is done already is skipped; killed and started again, it goes on. `--scale 0.02` makes everything in small, in
folders of its own, and says so on every figure.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from space_dist.cli.grids import run_frozen
from space_dist.cli.overview import tell
from space_dist.cli.terminal import STOP, say, warn
from space_dist.errors import ConfigError, SpaceDistError, nearest
from space_dist.experiment.manifest import Grid, Manifest
from space_dist.system.files import atomic_write
from space_dist.system.processes import collect_seldom

ROOT = Path(__file__).resolve().parent.parent
GRIDS = ROOT / "configs/paper"
WINS = ROOT / "configs/wins"
KEPT = (
    "report.md",
    "cells.csv",
    "seeds.csv",
    "curricula.csv",
    "inclusion.csv",
    "agreement.csv",
    "forgetting.csv",
)


def results(
    name: Annotated[str, typer.Argument(help="pointmass_uniform, ... of configs/paper; wins, wins/gates, ...; all.")],
    scale: Annotated[float, typer.Option(help="Share of the grid's seeds and steps.")] = 1.0,
    root: Annotated[Path, typer.Option(help="Folder that holds the grids' folders.")] = ROOT / "runs",
    out: Annotated[Path, typer.Option(help="Folder of what is kept.")] = ROOT / "docs/results",
) -> None:
    """Run grids, report on each, and keep the report with what it takes to make it again."""
    known = {path.stem: path for path in sorted(GRIDS.glob("*.yaml"))}
    of_wins = [*sorted(WINS.glob("*.yaml")), *sorted(WINS.glob("why/*.yaml"))]
    known |= {f"wins/{path.stem}": path for path in of_wins}
    chosen = {one: path for one, path in known.items() if name in (one, "all", one.rpartition("/")[0])}
    if not chosen:
        allowed = ["all", "wins", *known]
        raise ConfigError(f"{name!r} is no artefact{nearest(name, allowed)} Allowed: {', '.join(allowed)}")
    for one, path in chosen.items():
        code = _keep(one, path, scale, root, out)
        if code:
            raise typer.Exit(code)


def _keep(name: str, path: Path, scale: float, root: Path, out: Path) -> int:
    from space_dist.api.grids import frozen
    from space_dist.report import build_grid_report

    grid, manifest = frozen(path, root.absolute(), scale)
    say(f"{name}: {len(manifest.cells)} cells x {len(manifest.seeds)} seeds")
    if code := tell(manifest, grid, run_frozen(grid, manifest)):
        return code
    report = build_grid_report(grid)
    folder = out / (name if scale == 1.0 else f"{name}-scale-{scale:g}")
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    for made in sorted(report.folder.iterdir()):
        if made.name in KEPT or made.suffix == ".png":
            shutil.copyfile(made, folder / made.name)
    told = f"make results NAME={name}" + ("" if scale == 1.0 else f" SCALE={scale:g}")
    atomic_write(folder / "provenance.json", json.dumps(_provenance(told, grid, manifest), indent=1).encode() + b"\n")
    say(f"{name}: {folder}")
    return 0


def _provenance(command: str, grid: Grid, manifest: Manifest) -> dict[str, Any]:
    ledgers = [grid.ledger(run) for run in manifest.runs()]
    statuses = [ledger.status() for ledger in ledgers]
    return {
        "command": command,
        "commit": manifest.git.get("git_commit", ""),
        "arithmetic": sorted({status.fingerprint["arithmetic"] for status in statuses}),
        "scale": manifest.scale,
        "seeds": list(manifest.seeds),
        "cells": len(manifest.cells),
        "environment_steps": sum(status.steps for status in statuses),
    }


if __name__ == "__main__":
    STOP.install()
    collect_seldom()
    try:
        typer.run(results)
    except SpaceDistError as error:
        warn(f"results: {error}")
        sys.exit(error.exit_code)
