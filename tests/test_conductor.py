"""A grid at work: attempts under a supervisor, and the conductor that begins them."""

# ruff: noqa: F811 - fixtures that are imported
from __future__ import annotations

import dataclasses
import faulthandler
import json
import math
import os
import signal
import socket
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from space_dist.errors import ConfigError, Interrupted, LedgerError
from space_dist.experiment.endings import Busy, Cause, Ended, Evidence
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import (
    Attempts,
    concluded,
    run_status_of,
    settled,
)
from space_dist.grid import conductor, supervisor
from space_dist.grid.conductor import Conductor, Overview
from space_dist.grid.fork_server import ForkServer
from space_dist.grid.planning import plan
from space_dist.ledger import METRICS, Lock, Row
from tests.grids import ROOT, SMALL, TINY, write_grid, write_line_instances
from tests.patience import PATIENCE
from tests.test_grid import CODE, one  # noqa: F401
from tests.test_report import continue_run, start_run

# ---- attempts under a supervisor ------------------------------------------------------------------------------------


class Supervised:
    """A supervisor, spoken to as a pool does."""

    def __init__(self, server: ForkServer) -> None:
        self.channel, _ = server.forked(Path(os.devnull))
        self.words = self.channel.makefile("rb")
        self.pid = int(self.read()["ready"])

    def read(self) -> dict[str, Any]:
        answer: dict[str, Any] = json.loads(self.words.readline())
        return answer

    def send(self, message: dict[str, Any]) -> None:
        self.channel.sendall(json.dumps(message).encode() + b"\n")

    def attempt(self, grid: Grid, run: Run, attempt: int = 1) -> dict[str, Any]:
        (end,) = self.attempts(grid, [run], attempt)
        return end

    def attempts(self, grid: Grid, runs: list[Run], attempt: int = 1) -> list[dict[str, Any]]:
        self.send(task(grid, runs, attempt))
        ends: list[dict[str, Any]] = self.read()["ends"]
        return ends


def task(grid: Grid, runs: list[Run], attempt: int = 1) -> dict[str, Any]:
    attempts = [{"cell": run.cell.id, "seed": run.seed, "attempt": attempt} for run in runs]
    return {"grid": str(grid.folder), "attempts": attempts}


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    with pytest.MonkeyPatch.context() as patch, ForkServer() as made:
        patch.setenv("PYTHONPATH", str(ROOT))
        yield made


@pytest.fixture(scope="module")
def supervised(server: ForkServer) -> Iterator[Supervised]:
    made = Supervised(server)
    yield made
    made.channel.shutdown(socket.SHUT_WR)
    assert made.read() == {"code": 0}
    assert made.words.read() == b""


def faulty(folder: Path, fault: str, marker: str = "", **sections: Any) -> tuple[Grid, Manifest, Run]:
    kwargs = {"fault": fault, "marker": marker}
    settings = {**TINY, "env": {"id": "tests.fault_env:make", "kwargs": kwargs}, **write_line_instances(folder)}
    made = plan(write_grid(folder, grid={}, set=settings, seeds=[0], **sections), folder / "runs")
    return made.grid, made.manifest, made.manifest.runs()[0]


@pytest.fixture(scope="module")
def unharmed(supervised: Supervised, tmp_path_factory: pytest.TempPathFactory) -> list[Row]:
    grid, _, run = faulty(tmp_path_factory.mktemp("calm"), "none")
    assert supervised.attempt(grid, run)["cause"] is None
    return grid.ledger(run).rows(METRICS)


@pytest.mark.parametrize(
    ("fault", "cause", "words", "sections"),
    [
        ("raise", Cause.CRASH, "the ground gave way", {}),
        ("segfault", Cause.CRASH, "SIGSEGV", {}),
        ("kill", Cause.KILLED, "SIGKILL", {}),
        ("terminate", Cause.PREEMPTED, "SIGTERM", {}),
        ("config", Cause.CONFIG_ERROR, "the ground is not known", {}),
        ("memory", Cause.OUT_OF_MEMORY, "memory_mb is 900", {"resources": {"memory_mb": 900}}),
        ("no_memory", Cause.OUT_OF_MEMORY, "MemoryError", {}),
        ("slow", Cause.TIMEOUT, "0.1 minutes", {"resources": {"minutes": 0.1, "grace_seconds": 1.0}}),
        ("stop", Cause.KILLED, "SIGSTOP", {}),
        ("exit", Cause.CRASH, "tried to end the process (SystemExit: 0)", {}),
        ("_exit", Cause.CRASH, "os._exit(0)", {}),
        ("exit from C", Cause.CRASH, "exit code 0 and without a word", {}),
    ],
)  # fmt: skip
def test_causes_are_told_apart_and_retries_finish_the_run(
    supervised: Supervised, unharmed: list[Row], fault: str, cause: Cause, words: str, sections: dict[str, Any],
    tmp_path: Path,
) -> None:  # fmt: skip
    grid, manifest, run = faulty(tmp_path, fault, str(tmp_path / "marker"), **sections)
    first = supervised.attempt(grid, run)
    assert (first["cause"], first["busy"]) == (cause, False)
    assert words in first["detail"]
    found = run_status_of(run, grid.ledger(run), manifest.retry, CODE)
    retried = cause in (Cause.KILLED, Cause.PREEMPTED)
    assert (found.condition, found.cause) == ("waiting" if retried else "failed", cause)
    again = supervised.attempt(grid, run, 2)
    assert again["cause"] is None, again
    assert run_status_of(run, grid.ledger(run), manifest.retry, CODE).condition == "done"
    assert grid.ledger(run).rows(METRICS) == unharmed


def test_a_run_whose_environment_forks_is_done_once(
    supervised: Supervised, unharmed: list[Row], tmp_path: Path
) -> None:
    grid, manifest, run = faulty(tmp_path, "fork", str(tmp_path / "marker"))
    assert supervised.attempt(grid, run)["cause"] is None
    assert (tmp_path / "marker").exists()
    assert run_status_of(run, grid.ledger(run), manifest.retry, CODE).condition == "done"
    assert grid.ledger(run).rows(METRICS) == unharmed


def test_nobody_is_believed_to_be_done_whose_ledger_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, manifest, run = faulty(tmp_path, "none")

    def lies(*arguments: Any) -> None:
        arguments[-1](run, None)

    monkeypatch.setattr(supervisor, "_work", lies)
    folder, attempt = str(grid.folder), supervisor.AttemptId(run.cell.id, run.seed, 1)
    [ended] = supervisor.Supervisor().attempt(supervisor.Task(folder, (attempt,)), lambda: None)
    assert (ended.cause, "and is not" in ended.detail) == (Cause.CRASH, True)
    assert run_status_of(run, grid.ledger(run), manifest.retry, CODE).condition == "failed"


def test_a_run_that_others_work_on_is_left_alone(supervised: Supervised, tmp_path: Path) -> None:
    grid, _, run = faulty(tmp_path, "none")
    grid.ledger(run).folder.mkdir(parents=True)
    lock = Lock(grid.ledger(run).lock_file)
    lock.acquire()
    try:
        assert supervised.attempt(grid, run)["busy"]
    finally:
        lock.release()
    assert Attempts(grid.ledger(run)).history().begun == 0


def test_a_stop_makes_a_checkpoint_and_the_run_goes_on(supervised: Supervised, tmp_path: Path) -> None:
    grid, manifest, run = faulty(tmp_path, "none")
    supervised.send(task(grid, [run]))
    supervised.send({"stop": "stopped"})
    (ended,) = supervised.read()["ends"]
    assert ended["cause"] in ("stopped", None)  # None: it was done before it heard
    assert run_status_of(run, grid.ledger(run), manifest.retry, CODE).condition in ("waiting", "done")
    assert supervised.attempt(grid, run, 2)["cause"] is None


def test_a_run_stops_when_its_supervisor_is_killed(server: ForkServer, tmp_path: Path) -> None:
    grid, manifest, run = faulty(tmp_path, "slow")
    lonely = Supervised(server)
    lonely.send(task(grid, [run]))
    deadline = time.monotonic() + PATIENCE
    while not grid.ledger(run).owner_alive() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert grid.ledger(run).owner_alive()
    os.kill(lonely.pid, signal.SIGKILL)
    assert lonely.read() == {"code": -signal.SIGKILL}
    while grid.ledger(run).owner_alive() and time.monotonic() < deadline:
        time.sleep(0.1)
    found = run_status_of(run, grid.ledger(run), manifest.retry, CODE)
    assert (found.condition, found.cause) == ("waiting", Cause.KILLED)


# ---- the conductor --------------------------------------------------------------------------------------------------


class Script:
    """An executor that ends runs as it is told to: a list of causes for each run."""

    def __init__(
        self, grid: Grid, causes: dict[str, list[Cause | None]], size: int = 2, memory_mb: float = math.inf
    ) -> None:
        self.grid, self.causes, self.size, self.memory_mb = grid, causes, size, memory_mb
        self.live: list[Sequence[tuple[Run, int]]] = []
        self.started: list[str] = []
        self.groups: list[list[str]] = []
        self.most = 0

    def room(self) -> int:
        return self.size - len(self.live)

    def start(self, attempts: Sequence[tuple[Run, int]]) -> None:
        self.groups.append([run.key for run, _ in attempts])
        self.live.append(attempts)
        self.most = max(self.most, len(self.live))
        for run, attempt in attempts:
            self.started.append(run.key)
            Attempts(self.grid.ledger(run)).begin(attempt, {})

    def poll(self) -> list[tuple[Run, Ended | None]]:
        ended: list[tuple[Run, Ended | None]] = []
        for run, attempt in (attempt_id for attempts in self.live for attempt_id in attempts):
            causes = self.causes.get(run.key, [])
            how = Ended(causes.pop(0) if causes else None, "as told")
            Attempts(self.grid.ledger(run)).end(attempt, how)
            ended.append((run, how))
        self.live = []
        return ended

    def wait(self, seconds: float) -> None:
        if not self.live:  # those end at the next look
            time.sleep(seconds)

    def stop(self) -> None:
        pass

    def adopt(self, runs: Any) -> list[Run]:  # noqa: ARG002
        return []


def test_a_stopped_run_whose_supervisor_was_killed_holds_nobody_up(
    server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody is left to end it but whoever waits for it; and what is merely slow to end is left in peace."""
    grid, manifest, run = faulty(tmp_path, "stop", resources={"grace_seconds": 0.5})
    lonely, deadline = Supervised(server), time.monotonic() + PATIENCE
    lonely.send(task(grid, [run]))
    stopped, attempts = None, Attempts(grid.ledger(run))
    while stopped is None or stopped.status() != psutil.STATUS_STOPPED:
        assert time.monotonic() < deadline
        time.sleep(0.02)
        stopped = psutil.Process(attempts.history().process["pid"]) if attempts.history().process else None
    assert not attempts.history().abandoned
    os.kill(lonely.pid, signal.SIGKILL)
    assert lonely.read() == {"code": -signal.SIGKILL}
    assert attempts.history().abandoned
    assert run_status_of(run, grid.ledger(run), manifest.retry, CODE).condition == "running"
    monkeypatch.setattr("space_dist.grid.conductor._ABANDONED_SECONDS", 0.5)
    monkeypatch.setattr("space_dist.grid.conductor._ELSEWHERE_SECONDS", 0.1)
    script, began = Script(grid, {}), time.monotonic()
    Conductor(grid, manifest, [run], script, stop_requested=lambda: None).conduct()
    assert script.started == [run.key]
    assert time.monotonic() - began > 1.0
    assert not stopped.is_running() or stopped.status() == psutil.STATUS_ZOMBIE
    assert not attempts.history().abandoned


def test_a_done_run_whose_supervisor_died_before_it_said_so_has_its_end_written_once(
    supervised: Supervised, tmp_path: Path
) -> None:  # fmt: skip
    grid, manifest, run = faulty(tmp_path, "none")
    assert supervised.attempt(grid, run)["cause"] is None
    attempts = Attempts(grid.ledger(run))
    begin, process, _ = attempts.path.read_bytes().splitlines(keepends=True)
    attempts.path.write_bytes(begin + process)
    assert not run_status_of(run, grid.ledger(run), manifest.retry, CODE).end_recorded

    def conduct() -> Script:
        script = Script(grid, {})
        Conductor(grid, manifest, [run], script, stop_requested=stop).conduct()
        return script

    def stop() -> str | None:  # asked each time round
        return "still supervised" if time.monotonic() > until else None

    until = time.monotonic() + 0.5
    with pytest.raises(Interrupted):
        conduct()
    assert attempts.history().last is None
    dead = {**attempts.rows()[0]["where"], "started": 1}
    attempts.path.write_bytes(b"")
    attempts._append({"event": "begin", "attempt": 1, "where": dead})
    until = math.inf
    for _ in range(2):
        assert conduct().started == []
        assert [row["event"] for row in attempts.rows()] == ["begin", "end"]
    assert attempts.history().last == Ended(None)


def test_what_became_of_an_attempt_is_as_written_or_done_or_unknown(supervised: Supervised, tmp_path: Path) -> None:
    grid, _, run = faulty(tmp_path, "none")
    ledger, attempts = grid.ledger(run), Attempts(grid.ledger(run))
    attempts.begin(1, {})
    assert concluded(run, ledger, 1) is None
    attempts.end(1, Ended(Cause.KILLED, "by a hand"))
    assert concluded(run, ledger, 1) == Ended(Cause.KILLED, "by a hand")
    assert concluded(run, ledger, 2) is None  # it never began
    assert supervised.attempt(grid, run, 2)["cause"] is None
    rows = attempts.rows()
    assert concluded(run, ledger, 2) == concluded(run, ledger, 3) == Ended(None)  # somebody else's is not written twice
    assert attempts.rows() == rows
    attempts.begin(3, {})
    assert [concluded(run, ledger, 3), concluded(run, ledger, 3)] == [Ended(None)] * 2
    assert [row["event"] for row in attempts.rows()[len(rows) :]] == ["begin", "end"]


def test_what_was_seen_of_a_lost_attempt_is_written_once_and_only_if_it_was_one(tmp_path: Path) -> None:
    grid, _, run = faulty(tmp_path, "none")
    ledger, attempts = grid.ledger(run), Attempts(grid.ledger(run))
    attempts.begin(1, {})
    assert isinstance(
        settled(run, ledger, 1, Evidence(job="", job_succeeded=True)), Busy
    )  # somebody else is working on it
    assert attempts.history().last is None
    lost = Ended(Cause.KILLED, "its worker was killed")
    assert settled(run, ledger, 1, Evidence(gone="worker")) == attempts.history().last == lost
    assert settled(run, ledger, 1, Evidence(gone="worker", node_alive=False)) == lost  # as it is on record
    assert [row["event"] for row in attempts.rows()] == ["begin", "end"]


def test_the_conductor_retries_by_cause_and_never_starts_more_than_fits(tmp_path: Path) -> None:
    made = plan(write_grid(tmp_path, retry={"killed": 1, "crash": 0}), tmp_path / "runs")
    grid, manifest, runs = made.grid, made.manifest, made.manifest.runs()
    causes: dict[str, list[Cause | None]] = {
        runs[0].key: [Cause.KILLED], runs[1].key: [Cause.CRASH], runs[2].key: [Cause.KILLED] * 2,
        runs[3].key: [Cause.CONFIG_ERROR],
    }  # fmt: skip
    script = Script(grid, causes)
    Conductor(grid, manifest, runs, script, stop_requested=lambda: None).conduct()
    assert [script.started.count(run.key) for run in runs] == [2, 1, 2, 1]
    assert script.most == 2
    found = [run_status_of(run, grid.ledger(run), manifest.retry, CODE).cause for run in runs[1:]]
    assert found == [Cause.CRASH, Cause.KILLED, Cause.CONFIG_ERROR]
    again = Script(grid, {})
    Conductor(grid, manifest, runs[1:], again, stop_requested=lambda: None).conduct()
    assert again.started == []


def test_settings_of_a_run_in_a_grid_cannot_be_its_own_pusher(one: tuple[Grid, Manifest, Run]) -> None:
    grid, manifest, run = one
    shared = dataclasses.replace(
        manifest, tracking=manifest.tracking.model_copy(update={"uri": "http://127.0.0.1:1"})
    )  # fmt: skip
    config = grid.run_config(shared, run)
    assert (config.tracking.uri, config.tracking.live, config.tracking.experiment) == (
        "http://127.0.0.1:1", False, "small",
    )  # fmt: skip


def test_deadlines_of_a_grid_are_those_of_its_runs(tmp_path: Path) -> None:
    resources = {"workers": 2, "memory_mb": 500, "grace_seconds": 3.0, "room_seconds": 7.0, "late_seconds": 2.0,
                 "late_factor": 5.0, "first_answer_seconds": 50.0}  # fmt: skip
    made = plan(write_grid(tmp_path, resources=resources), tmp_path / "runs")
    config = made.grid.run_config(made.manifest, made.manifest.runs()[0], address="auto").resources
    assert config.model_dump() == {key: resources[key] for key in resources if key != "memory_mb"} | {"address": "auto"}


@pytest.mark.parametrize(
    ("workers", "end", "listening", "cause"),
    [
        (1, "_exit", True, Cause.NODE_LOST), (0, "_exit", True, Cause.CRASH),
        (1, "abort", False, Cause.NODE_LOST), (1, "abort", True, Cause.CRASH),
    ],
)  # fmt: skip
def test_a_run_that_ray_took_with_it_is_lost_and_not_crashed(
    workers: int, end: str, listening: bool, cause: Cause, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray's library ends the process of a driver by itself: with 1 and no word, or by SIGABRT."""
    made = plan(write_grid(tmp_path, resources={"workers": workers}), tmp_path / "runs")
    run = made.manifest.runs()[0]
    with socket.socket() as port:
        port.bind(("127.0.0.1", 0))
        if listening:
            port.listen()
        address = f"127.0.0.1:{port.getsockname()[1]}"

        def work(*_: object) -> None:
            faulthandler.disable()  # pytest's
            if end == "abort":
                os.abort()
            os._exit(1)

        monkeypatch.setattr(supervisor, "_work", work)
        asked = supervisor.Task(str(made.grid.folder), (supervisor.AttemptId(run.cell.id, run.seed, 1),), address)
        assert [ended.cause for ended in supervisor.Supervisor().attempt(asked, lambda: None)] == [cause]


def test_what_has_begun_goes_on_before_anything_new(tmp_path: Path) -> None:
    """And without delay if its last attempt got on; else after others had their chance."""
    made = plan(write_grid(tmp_path), tmp_path / "runs")
    runs = made.manifest.runs()
    Attempts(made.grid.ledger(runs[2])).begin(1, {"pid": -1})
    Attempts(made.grid.ledger(runs[2])).end(1, Ended(Cause.PREEMPTED))
    started: list[Run] = []

    class OneAtATime:
        size, memory_mb = 1, math.inf

        def __init__(self) -> None:
            self.now: Run | None = None

        def room(self) -> int:
            return self.now is None

        def start(self, attempts: Sequence[tuple[Run, int]]) -> None:
            ((run, attempt),) = attempts
            self.now = run
            started.append(run)
            Attempts(made.grid.ledger(run)).begin(attempt, {})

        def poll(self) -> list[tuple[Run, Ended | None]]:
            run, self.now = self.now, None
            if run is None:
                return []
            first = run is runs[0] and started.count(run) == 1
            ended = Ended(Cause.KILLED if first else None)
            Attempts(made.grid.ledger(run)).end(1, ended)
            if first:  # it got on
                start_run(made.grid.ledger(run).folder)
                continue_run(made.grid.ledger(run), [0.0, 1.0], [[0]], state="running")
            return [(run, ended)]

        def wait(self, seconds: float) -> None:
            if self.now is None:
                time.sleep(seconds)

        def stop(self) -> None: ...

        def adopt(self, runs: Any) -> list[Run]:  # noqa: ARG002
            return []

    Conductor(made.grid, made.manifest, runs, OneAtATime(), stop_requested=lambda: None).conduct()
    assert started == [runs[2], runs[0], runs[0], runs[1], runs[3]]


def test_runs_that_can_share_a_process_are_dealt_evenly_to_all_places(tmp_path: Path) -> None:
    settings = {**SMALL, "engine": "population"}
    made = plan(write_grid(tmp_path, set=settings, seeds=[0, 1, 2]), tmp_path / "runs")
    script = Script(made.grid, {made.manifest.runs()[0].key: [Cause.KILLED]})
    Conductor(made.grid, made.manifest, made.manifest.runs(), script, stop_requested=lambda: None).conduct()
    assert [len(group) for group in script.groups] == [3, 3, 1]
    assert script.groups[2] == [made.manifest.runs()[0].key]


@pytest.mark.parametrize("begins", [False, True])
def test_a_run_whose_end_cannot_be_written_is_not_tried_for_ever(tmp_path: Path, *, begins: bool) -> None:
    """As on a full disk: its history stays what it was, or says that it has begun, by somebody who lives."""
    made = plan(write_grid(tmp_path, seeds=[0, 1]), tmp_path / "runs")
    runs = made.manifest.runs()
    Attempts(made.grid.ledger(runs[0])).begin(1, {})
    Attempts(made.grid.ledger(runs[0])).end(1, Ended(Cause.PREEMPTED, "before"))
    tried: list[Run] = []

    class Unwritable(Script):
        unwritable: Sequence[Run] = ()

        def start(self, attempts: Sequence[tuple[Run, int]]) -> None:
            [(run, attempt)] = attempts
            tried.append(run)
            if run is not runs[0]:
                super().start(attempts)
                return
            if begins:
                Attempts(made.grid.ledger(run)).begin(attempt, {})
            self.unwritable = (run,)

        def poll(self) -> list[tuple[Run, Ended | None]]:
            told, self.unwritable = self.unwritable, ()
            return [*super().poll(), *((run, Ended(Cause.CRASH, "cannot write attempts.jsonl")) for run in told)]

    seen: list[Overview] = []
    executor = Unwritable(made.grid, {}, size=1)
    works = Conductor(made.grid, made.manifest, runs, executor, stop_requested=lambda: None,
                      observe=lambda now: seen.append(dataclasses.replace(now)))  # fmt: skip
    words = rf"1 of {len(runs)} runs could not be worked on: cannot write attempts.jsonl\. What is done stays done"
    with pytest.raises(LedgerError, match=words):
        works.conduct()
    assert tried == runs
    assert (seen[-1].done, seen[-1].failed) == (len(runs) - 1, 1)


@pytest.mark.parametrize(("n_seeds", "groups"), [(5, [3, 3, 3, 1]), (4, [4, 4]), (8, [4, 4, 4, 4]), (9, [3] * 6)])
def test_turns_are_equal_and_as_few_as_can_be(
    n_seeds: int, groups: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(conductor.MEMBERS, "cpu", 4)
    settings = {**SMALL, "engine": "population"}
    made = plan(write_grid(tmp_path, set=settings, seeds=[*range(n_seeds)]), tmp_path / "runs")
    script = Script(made.grid, {})  # two places, and two cells
    Conductor(made.grid, made.manifest, made.manifest.runs(), script, stop_requested=lambda: None).conduct()
    assert [len(group) for group in script.groups] == groups


@pytest.mark.parametrize(("members", "groups"), [(2.5, [2, 2, 2]), (0.0, [1] * 6), (100.0, [6])])
def test_no_more_share_a_process_than_its_memory_holds(members: float, groups: list[int], tmp_path: Path) -> None:
    path = write_grid(tmp_path, set={**SMALL, "engine": "population"}, seeds=[0, 1, 2])
    made = plan(path, tmp_path / "runs")
    manifest = made.grid.manifest()
    (each,) = {cell.shared_mb for cell in manifest.cells}
    assert each > 0
    script = Script(made.grid, {}, size=1, memory_mb=700 + members * each)
    Conductor(made.grid, manifest, manifest.runs(), script, stop_requested=lambda: None).conduct()
    assert [len(group) for group in script.groups] == groups


def test_only_what_is_alike_shares_a_process(tmp_path: Path) -> None:
    shapes = {"learner.net_arch": [[8], [8, 8]], "curriculum.kappa": [1, 4]}
    made = plan(write_grid(tmp_path, grid=shapes, set={**SMALL, "engine": "auto"}), tmp_path / "runs")
    script = Script(made.grid, {}, size=1)
    Conductor(made.grid, made.manifest, made.manifest.runs(), script, stop_requested=lambda: None).conduct()
    assert [len(group) for group in script.groups] == [4, 4]
    shape_of = {run.key: run.cell.settings["learner.net_arch"] for run in made.manifest.runs()}
    assert all(len({str(shape_of[key]) for key in group}) == 1 for group in script.groups)


@pytest.mark.parametrize(
    ("changes", "workers", "engine"),
    [({}, 0, "population"), ({}, 1, "single"), ({"learner": {"kind": "sac", "n_steps": 1024}}, 0, "single"),
     ({"learner": {"kind": "a2c", "n_steps": 1024}}, 0, "single")],
)  # fmt: skip
def test_auto_is_decided_when_a_grid_is_frozen(
    changes: dict[str, Any], workers: int, engine: str, tmp_path: Path
) -> None:  # fmt: skip
    settings = {**{key: value for key, value in SMALL.items() if not changes or "learner" not in key}, **changes}
    path = write_grid(tmp_path, set={**settings, "engine": "auto"}, resources={"workers": workers})
    cells = plan(path, tmp_path / "runs").manifest.cells
    assert [cell.config["engine"] for cell in cells] == [engine] * 2
    assert all(bool(cell.stack) == (engine == "population") for cell in cells)


def test_members_of_a_population_have_no_actors(tmp_path: Path) -> None:
    path = write_grid(tmp_path, set={**SMALL, "engine": "population"}, resources={"workers": 1})
    with pytest.raises(ConfigError, match="workers: 0, or engine: single"):
        plan(path, tmp_path / "runs")


def test_members_of_a_population_end_each_for_itself(supervised: Supervised, tmp_path: Path) -> None:
    """In one process: one diverges, one is worked on by somebody else, one is not its config; two are done."""
    made = plan(
        write_grid(
            tmp_path, seeds=[0], set={**SMALL, "engine": "population"},
            grid={"learner.learning_rate": [1e-3, 1e30, 2e-3, 3e-3]},
        ),
        tmp_path / "runs",
    )  # fmt: skip
    grid, runs = made.grid, made.manifest.runs()
    grid.ledger(runs[2]).folder.mkdir(parents=True)
    lock = Lock(grid.ledger(runs[2]).lock_file)
    lock.acquire()
    try:
        ends = supervised.attempts(grid, runs)
    finally:
        lock.release()
    assert [(end["cause"], end["busy"]) for end in ends] == [
        (None, False), ("crash", False), (None, True), (None, False)
    ]  # fmt: skip
    assert "diverged" in ends[1]["detail"]
    found = [run_status_of(run, grid.ledger(run), made.manifest.retry, CODE).condition for run in runs]
    assert found == ["done", "failed", "waiting", "done"]
    assert "diverged" in grid.ledger(runs[1]).log.read_text()
    assert "diverged" not in grid.ledger(runs[0]).log.read_text()
    (alone,) = supervised.attempts(grid, [runs[2]])
    assert alone["cause"] is None


def test_a_population_that_is_killed_goes_on_with_every_member(supervised: Supervised, tmp_path: Path) -> None:
    """And whoever was done stays done: its process takes only those with it that were not."""
    kwargs = {"fault": "kill", "marker": str(tmp_path / "marker")}
    settings = {**TINY, "env": {"id": "tests.fault_env:make", "kwargs": kwargs}, "engine": "population",
                **write_line_instances(tmp_path)}  # fmt: skip
    axes = {"learner.gamma": [0.9, 0.8, 0.7]}
    made = plan(write_grid(tmp_path, grid=axes, set=settings, seeds=[0]), tmp_path / "runs")
    grid, runs = made.grid, made.manifest.runs()
    assert [end["cause"] for end in supervised.attempts(grid, runs)] == [Cause.KILLED] * 3
    assert [end["cause"] for end in supervised.attempts(grid, runs[1:], 2)] == [None] * 2
    assert [end["cause"] for end in supervised.attempts(grid, runs, 3)] == [None] * 3
    (tmp_path / "alone").mkdir()
    unharmed = plan(write_grid(tmp_path / "alone", grid=axes, set=settings, seeds=[0]), tmp_path / "alone/runs")
    for run in runs:
        assert supervised.attempt(unharmed.grid, run)["cause"] is None
        for name in (METRICS, "curriculum.jsonl", "model.npz"):
            ours, other = (one.ledger(run).folder / name for one in (grid, unharmed.grid))
            assert ours.read_bytes() == other.read_bytes(), name


@pytest.mark.parametrize("broken", [1, 2])
def test_a_config_that_this_version_refuses_is_a_config_error_of_its_run(
    broken: int, supervised: Supervised, tmp_path: Path
) -> None:  # fmt: skip
    """Alone, and beside a run that is none: a manifest may come from another version."""
    settings = {**SMALL, "engine": "population"}
    made = plan(write_grid(tmp_path, set=settings, seeds=[0], grid={"curriculum.kappa": [1, 4]}), tmp_path / "runs")
    first, other = made.manifest.cells
    wrong = dataclasses.replace(first, config={**first.config, "budget": {"steps": 1}})
    made.grid.freeze(dataclasses.replace(made.manifest, cells=(wrong, other)), {})
    runs = made.grid.manifest().runs()[:broken]
    ends = supervised.attempts(made.grid, runs)
    assert [end["cause"] for end in ends] == [Cause.CONFIG_ERROR, None][:broken]
    assert "budget.steps" in ends[0]["detail"]
