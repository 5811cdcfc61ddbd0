"""Grids that are worked through one run after another: on this machine, without Ray, whoever is killed."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psutil
import pytest

from space_dist.experiment.endings import Cause, Ended
from space_dist.experiment.manifest import Grid
from space_dist.experiment.status import Attempts
from space_dist.grid import warm
from space_dist.grid.planning import plan
from space_dist.grid.warm import LocalExecutor, local_is_enough, memory_of_a_core
from space_dist.ledger import METRICS, Row
from tests import prepared
from tests.grids import TINY, write_grid, write_line_instances
from tests.patience import PATIENCE
from tests.slurm.gated_env import GATE


def without_ray() -> None:
    """Whoever imports Ray in this process from now on fails."""
    sys.modules["ray"] = None  # type: ignore[assignment]


def write(folder: Path, **sections: Any) -> Path:
    settings = {**TINY, "env": {"id": "tests.slurm.gated_env:make"}, **write_line_instances(folder)}
    return write_grid(folder, grid={}, set=settings, **sections)


def start(folder: Path) -> BaseProcess:
    """`grid run` of two runs, one after another."""
    arguments = ["grid", "run", write(folder), "--root", folder / "runs", "--max-parallel", 1]
    return prepared.command(arguments, folder / "said.txt", before=without_ray)


def await_(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.02)


def finished(process: BaseProcess, folder: Path) -> Grid:
    process.join(PATIENCE)
    assert process.exitcode == 0, (folder / "said.txt").read_text()
    assert "small: 2 of 2 runs done" in (folder / "said.txt").read_text()
    return Grid(folder / "runs/small")


def rows(grid: Grid) -> list[list[Row]]:
    return [grid.ledger(run).rows(METRICS) for run in grid.manifest().runs()]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> list[list[Row]]:
    folder = tmp_path_factory.mktemp("alone")
    return rows(finished(start(folder), folder))


@pytest.fixture
def gate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """While this file is there, runs are slow."""
    path = tmp_path / "gate"
    path.touch()
    monkeypatch.setenv(GATE, str(path))
    return path


@pytest.fixture
def under_way(gate: Path, tmp_path: Path) -> Iterator[tuple[BaseProcess, psutil.Process, Grid]]:
    """A conductor and its supervisor, in the middle of the first of its two runs."""
    conductor, grid = start(tmp_path), Grid(tmp_path / "runs/small")
    assert gate.exists()

    def begun() -> bool:
        runs = grid.manifest().runs() if grid.manifest_file.exists() else []
        return any(grid.ledger(run).owner_alive() and grid.ledger(run).status().round > 0
                   for run in runs if grid.ledger(run).status_file.exists())  # fmt: skip

    try:
        await_(begun, "the first run to be under way")
        [supervisor] = [child for child in psutil.Process(conductor.pid).children()
                        if "space_dist.grid.supervisor" in child.cmdline()]  # fmt: skip
        yield conductor, supervisor, grid
    finally:
        conductor.kill()
        conductor.join()


def ends(grid: Grid) -> list[list[str | None]]:
    return [[row["cause"] for row in Attempts(grid.ledger(run)).rows() if row["event"] == "end"]
            for run in grid.manifest().runs()]  # fmt: skip


def test_another_supervisor_takes_over_from_one_that_was_killed(
    under_way: tuple[BaseProcess, psutil.Process, Grid], reference: list[list[Row]], gate: Path, tmp_path: Path
) -> None:  # fmt: skip
    conductor, supervisor, grid = under_way
    supervisor.kill()
    gate.unlink()
    assert rows(finished(conductor, tmp_path)) == reference
    assert ends(grid) == [["killed", None], [None]]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 75), (signal.SIGKILL, -signal.SIGKILL)])
def test_nobody_outlives_a_conductor_that_ends_and_the_next_one_goes_on(
    under_way: tuple[BaseProcess, psutil.Process, Grid], reference: list[list[Row]], gate: Path, number: int, code: int,
    tmp_path: Path,
) -> None:  # fmt: skip
    conductor, supervisor, grid = under_way
    family = [supervisor, *supervisor.children(recursive=True)]
    assert len(family) == 2  # itself, and the run
    psutil.Process(conductor.pid).send_signal(number)
    conductor.join(PATIENCE)
    assert conductor.exitcode == code
    await_(lambda: not any(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in family),
           "the supervisor and its run to end")  # fmt: skip
    first, second = (grid.ledger(run) for run in grid.manifest().runs())
    assert (first.status().state, second.status_file.exists()) == ("interrupted", False)
    gate.unlink()
    assert rows(finished(start(tmp_path), tmp_path)) == reference
    assert ends(grid) == [["stopped" if number == signal.SIGTERM else "preempted", None], [None]]


def test_a_supervisor_that_is_stopped_for_good_is_killed(
    gate: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm, "STOPPED_SECONDS", 0.1)
    monkeypatch.setattr(warm, "_LOOK_SECONDS", 0.05)
    made = plan(write(tmp_path), tmp_path / "runs")
    run = made.manifest.runs()[0]
    found: list[tuple[Any, Ended | None]] = []
    with LocalExecutor(made.grid, made.manifest, lambda: None) as place:
        place.start([(run, 1)])
        assert place.room() == 0
        await_(lambda: Attempts(made.grid.ledger(run)).history().begun == 1, "the attempt to begin")
        [supervisor] = [
            child for child in psutil.Process().children() if "space_dist.grid.supervisor" in child.cmdline()
        ]
        supervisor.suspend()
        await_(lambda: bool(found.extend(place.poll()) or found), "the attempt to end")
        gate.unlink()
    [(whose, ended)] = found
    assert whose == run
    assert ended == Ended(Cause.KILLED, "its supervisor was killed")


def test_ray_is_for_runs_with_actors_and_for_several_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = plan(write(tmp_path), tmp_path / "runs").manifest
    runs = manifest.runs()
    assert local_is_enough(manifest, runs, 1)
    assert local_is_enough(manifest, runs[:1], None)
    assert not local_is_enough(manifest, runs, 2)
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "1")
    assert local_is_enough(manifest, runs, None)
    with_actors = plan(write(tmp_path, name="acting", resources={"workers": 1}), tmp_path / "runs").manifest
    assert not local_is_enough(with_actors, with_actors.runs(), 1)


def test_a_place_has_a_cores_share_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SLURM_MEM_PER_CPU", "SLURM_MEM_PER_NODE", "SLURM_CPUS_PER_TASK"):
        monkeypatch.delenv(name, raising=False)
    found = memory_of_a_core()
    assert 0 < found < psutil.virtual_memory().total / 2**20 / warm.cores()
    monkeypatch.setenv("SLURM_MEM_PER_CPU", "10")
    assert memory_of_a_core() == 10.0
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "1")
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "9")
    assert memory_of_a_core() == 9.0
