"""Folders that commit 3c07144 wrote, before the house was rearranged: resumed, reported and submitted by what is here.

A run that was interrupted after half of its steps, a grid of which one run is done and the other interrupted, and the
same grid exported for SLURM. What they come to is what 3c07144 itself came to when it was left alone.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from space_dist.experiment.manifest import Grid
from space_dist.experiment.status import Attempts
from space_dist.ledger import METRICS, Ledger
from space_dist.run.claiming import stored_config
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.grids import ROOT
from tests.patience import PATIENCE

FOLDERS = Path(__file__).parent / "folders_before_16"
# Of metrics.jsonl, by kappa; the run alone has 2.
METRICS_OF = {
    1: "9b9d8cfbbd0ea525ebd4f7ec99743864977e31e8e48574caea427288bd333a45",
    2: "d403b5f1ca08fbd05d2ef9faf343e89d16dd40266123c199d3d7f4e740b9be19",
}
MODEL = "48a8f1342efa7a884d369fcab863c8aec99516486f167b07839e12ad641eb867"


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def space_dist(*arguments: object, **variables: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "space_dist.cli", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True,
        timeout=PATIENCE, env={**os.environ, **variables}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(FOLDERS, tmp_path / "folders"))


def assert_done(grid: Grid) -> None:
    runs = grid.manifest().runs()
    assert [digest(grid.ledger(run).folder / METRICS) for run in runs] == [METRICS_OF[1], METRICS_OF[2]]


def test_an_interrupted_run_goes_on_to_the_same_bytes(folder: Path) -> None:
    ledger = Ledger(folder / "run")
    assert ledger.status().state == "interrupted"
    launch(stored_config(ledger), ledger.folder, resume=True, stop=StopRequests())
    assert (digest(ledger.folder / METRICS), digest(ledger.folder / "model.npz")) == (METRICS_OF[2], MODEL)


def test_a_grid_goes_on_and_is_reported(folder: Path, tmp_path: Path) -> None:
    grid = Grid(folder / "before")
    space_dist("grid", "run", grid.folder, "--max-parallel", 1)
    assert_done(grid)
    assert [Attempts(grid.ledger(run)).history().begun for run in grid.manifest().runs()] == [1, 1]
    space_dist("report", grid.folder, "--out", tmp_path / "report")
    assert "kappa" in (tmp_path / "report" / "report.html").read_text()


def test_an_exported_grid_is_submitted_and_its_tasks_run(folder: Path, tmp_path: Path) -> None:
    exported, calls = folder / "slurm", tmp_path / "calls"
    sbatch = tmp_path / "bin" / "sbatch"
    sbatch.parent.mkdir()
    sbatch.write_text(f'#!/bin/sh\necho "$@" >> {calls}\necho 4711\n')
    sbatch.chmod(0o755)
    told = space_dist("slurm", "submit", exported, PATH=f"{sbatch.parent}:{os.environ['PATH']}")
    assert "submitted 2 runs" in told
    assert [line.split()[-1] for line in calls.read_text().splitlines()] == ["train.sbatch", "aggregate.sbatch"]
    script = (exported / "train.sbatch").read_text()
    found = re.search(r"--runs (\w+)", script)
    assert found is not None
    for task in (0, 1):
        space_dist(
            "grid", "run", exported / "manifest.json", "--root", tmp_path / "results", "--runs", found[1],
            "--max-parallel", 1, "--part", f"{task}-{task}",
        )  # fmt: skip
    assert_done(Grid(tmp_path / "results" / "before"))
