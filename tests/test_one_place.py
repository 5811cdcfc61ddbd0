"""Grids that are worked through on this machine without Ray, at one place or several, whoever is killed."""

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
from space_dist.grid import fork_server, warm
from space_dist.grid.planning import plan
from space_dist.grid.warm import LocalExecutor, memory_of_a_core, needs_ray
from space_dist.ledger import METRICS, Row
from tests import prepared
from tests.grids import TINY, write_grid, write_line_instances
from tests.patience import PATIENCE
from tests.slurm.gated_env import GATE


def without_ray() -> None:
    """Whoever imports Ray in this process from now on fails."""
    sys.modules["ray"] = None  # type: ignore[assignment]


def write(folder: Path, **sections: Any) -> Path:
    # A dozen rounds: what is done to a run in the middle is not done to one that has ended, on a busy machine either.
    settings = {
        **TINY,
        "env": {"id": "tests.slurm.gated_env:make"},
        "budget.steps": 3072,
        **write_line_instances(folder),
    }
    return write_grid(folder, grid={}, set=settings, **sections)


def start(folder: Path, at_a_time: int = 1) -> BaseProcess:
    """`grid run` of two runs, one after another or side by side."""
    arguments = ["grid", "run", write(folder), "--root", folder / "runs", "--max-parallel", at_a_time]
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


def supervisors(conductor: BaseProcess | None = None) -> list[psutil.Process]:
    """Of a conductor, by default of this process."""
    return [child for server in servers(conductor) for child in server.children()]


def servers(conductor: BaseProcess | None = None) -> list[psutil.Process]:
    """The processes whose forks the supervisors of a conductor are."""
    return [child for child in psutil.Process(conductor and conductor.pid).children()
            if "space_dist.grid.supervisor" in child.cmdline()]  # fmt: skip


def lives(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def kill(supervisor: psutil.Process) -> None:
    """Returns once it is dead, and so the run below it asked to end: a signal's sender does not wait for it."""
    supervisor.kill()
    await_(lambda: not lives(supervisor), "its death")


def is_under_way(grid: Grid, number: int) -> bool:
    ledger = grid.ledger(grid.manifest().runs()[number]) if grid.manifest_file.exists() else None
    return ledger is not None and ledger.status_file.exists() and ledger.owner_alive() and ledger.status().round > 0


@pytest.fixture
def under_way(gate: Path, tmp_path: Path) -> Iterator[tuple[BaseProcess, psutil.Process, Grid]]:
    """A conductor and its supervisor, in the middle of the first of its two runs."""
    conductor, grid = start(tmp_path), Grid(tmp_path / "runs/small")
    assert gate.exists()

    try:
        await_(lambda: is_under_way(grid, 0), "the first run to be under way")
        [supervisor] = supervisors(conductor)
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
    kill(supervisor)
    gate.unlink()
    assert rows(finished(conductor, tmp_path)) == reference
    assert ends(grid) == [["killed", None], [None]]


def test_who_forks_supervisors_is_missed_by_none_of_them(
    under_way: tuple[BaseProcess, psutil.Process, Grid], reference: list[list[Row]], gate: Path, tmp_path: Path
) -> None:  # fmt: skip
    conductor, supervisor, grid = under_way
    [server] = servers(conductor)
    kill(server)
    gate.unlink()
    assert rows(finished(conductor, tmp_path)) == reference
    assert ends(grid) == [[None], [None]]
    await_(lambda: not lives(supervisor), "its end, of which nobody is told")


def test_an_idle_supervisor_that_was_killed_costs_no_attempt(gate: Path, tmp_path: Path) -> None:
    gate.unlink()
    made = plan(write(tmp_path), tmp_path / "runs")
    first, second = made.manifest.runs()
    found: list[tuple[Any, Ended | None]] = []
    with LocalExecutor(made.grid, made.manifest, 1, lambda: None) as place:
        place.start([(first, 1)])
        await_(lambda: bool(found.extend(place.poll()) or found), "the first attempt to end")
        [supervisor] = supervisors()
        kill(supervisor)
        await_(lambda: not lives(supervisor), "the supervisor to die: while it does, it may still be given work")
        place.start([(second, 1)])
        await_(lambda: bool(found.extend(place.poll()) or len(found) == 2), "the second attempt to end")
        [another] = supervisors()
        assert another != supervisor
    assert [ended for _, ended in found] == [Ended(None)] * 2
    assert not lives(another)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 75), (signal.SIGKILL, -signal.SIGKILL)])
def test_nobody_outlives_a_conductor_that_ends_and_the_next_one_goes_on(
    under_way: tuple[BaseProcess, psutil.Process, Grid], reference: list[list[Row]], gate: Path, number: int, code: int,
    tmp_path: Path,
) -> None:  # fmt: skip
    conductor, supervisor, grid = under_way
    family = [*servers(conductor), supervisor, *supervisor.children(recursive=True)]
    assert len(family) == 3  # who has forked it, itself, and the run
    psutil.Process(conductor.pid).send_signal(number)
    conductor.join(PATIENCE)
    assert conductor.exitcode == code
    await_(lambda: not any(map(lives, family)), "the supervisor and its run to end")
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
    with LocalExecutor(made.grid, made.manifest, 1, lambda: None) as place:
        place.start([(run, 1)])
        assert place.room() == 0
        await_(lambda: Attempts(made.grid.ledger(run)).history().begun == 1, "the attempt to begin")
        [supervisor] = supervisors()
        supervisor.suspend()
        await_(lambda: bool(found.extend(place.poll()) or found), "the attempt to end")
        gate.unlink()
    [(whose, ended)] = found
    assert whose == run
    assert ended == Ended(Cause.KILLED, "its supervisor was killed")


def test_a_supervisor_that_ends_by_itself_is_a_crash_and_says_where_to_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fork_server, "PYTHON", (sys.executable, "-c", "raise SystemExit('nothing works here')"))
    made = plan(write(tmp_path), tmp_path / "runs")
    found: list[tuple[Any, Ended | None]] = []
    with LocalExecutor(made.grid, made.manifest, 1, lambda: None) as place:
        place.start([(made.manifest.runs()[0], 1)])
        await_(lambda: bool(found.extend(place.poll()) or found), "the attempt to end")
    [(_, ended)] = found
    assert ended == Ended(Cause.CRASH, "its supervisor ended with exit code 1: pool.log of the grid says why")
    assert "nothing works here" in (made.grid.folder / "pool.log").read_text()


def test_two_side_by_side_are_the_same_and_one_that_is_killed_costs_the_other_nothing(
    gate: Path, reference: list[list[Row]], tmp_path: Path
) -> None:
    conductor, grid = start(tmp_path, at_a_time=2), Grid(tmp_path / "runs/small")
    try:
        await_(lambda: is_under_way(grid, 0) and is_under_way(grid, 1), "both runs to be under way")
        first, second = supervisors(conductor)
        kill(first)
        gate.unlink()
        assert rows(finished(conductor, tmp_path)) == reference
    finally:
        conductor.kill()
        conductor.join()
    assert sorted(map(len, ends(grid))) == [1, 2]
    assert sorted(str(cause) for each in ends(grid) for cause in each) == ["None", "None", "killed"]
    assert not any(map(lives, (first, second)))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_nobody_outlives_a_conductor_of_several_places(
    gate: Path, reference: list[list[Row]], number: int, tmp_path: Path
) -> None:
    conductor, grid = start(tmp_path, at_a_time=2), Grid(tmp_path / "runs/small")
    try:
        await_(lambda: is_under_way(grid, 0) and is_under_way(grid, 1), "both runs to be under way")
        family = [one for each in servers(conductor) for one in (each, *each.children(recursive=True))]
        assert len(family) == 5  # two supervisors, each with its run, and who has forked both
        psutil.Process(conductor.pid).send_signal(number)
        conductor.join(PATIENCE)
    finally:
        conductor.kill()
        conductor.join()
    await_(lambda: not any(map(lives, family)), "their ends")
    assert [grid.ledger(run).status().state for run in grid.manifest().runs()] == ["interrupted"] * 2
    gate.unlink()
    assert rows(finished(start(tmp_path, at_a_time=2), tmp_path)) == reference


def test_a_place_is_free_again_once_its_attempt_has_ended(tmp_path: Path) -> None:
    made = plan(write(tmp_path), tmp_path / "runs")
    first, second = made.manifest.runs()
    found: list[tuple[Any, Ended | None]] = []
    with LocalExecutor(made.grid, made.manifest, 2, lambda: None) as places:
        assert (places.size, places.room()) == (2, 2)
        places.start([(first, 1)])
        assert places.room() == 1
        places.start([(second, 1)])
        assert places.room() == 0
        await_(lambda: bool(found.extend(places.poll()) or len(found) == 2), "both attempts to end")
        assert places.room() == 2
    assert {run.seed: ended for run, ended in found} == {0: Ended(None), 1: Ended(None)}


def test_who_waits_is_told_of_an_end(tmp_path: Path) -> None:
    made = plan(write(tmp_path), tmp_path / "runs")
    first, second = made.manifest.runs()
    found: list[tuple[Any, Ended | None]] = []
    with LocalExecutor(made.grid, made.manifest, 2, lambda: None) as places:
        places.start([(first, 1)])
        places.start([(second, 1)])
        until = time.monotonic() + PATIENCE
        while len(found) < 2 and time.monotonic() < until:
            places.wait(PATIENCE)
            found += places.poll()
        assert time.monotonic() < until
        places.wait(0.0)  # for nobody
    assert {run.seed: ended for run, ended in found} == {0: Ended(None), 1: Ended(None)}


def test_ray_is_for_runs_with_actors(tmp_path: Path) -> None:
    assert not needs_ray(plan(write(tmp_path), tmp_path / "runs").manifest)
    assert needs_ray(plan(write(tmp_path, name="acting", resources={"workers": 1}), tmp_path / "runs").manifest)


def test_more_places_than_cores_share_their_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = plan(write(tmp_path), tmp_path / "runs")
    monkeypatch.setattr(warm, "memory_of_a_core", lambda: 100.0)
    monkeypatch.setattr(warm, "cores", lambda: 2)
    found = [LocalExecutor(made.grid, made.manifest, size, lambda: None).memory_mb for size in (1, 2, 4)]
    assert found == [100.0, 100.0, 50.0]


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
