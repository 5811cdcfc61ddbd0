"""Kill, stop and restart every part of a grid at work, at seeded moments, and compare with a grid left alone.

A grid of runs with rollout and curriculum actors is submitted to a Ray cluster and mirrored to an MLflow server. A
fault falls once the runs have together committed so many steps, plus some seconds, both seeded: so that faults
spread over the whole work however fast the machine is. It counts only if it hit a live process of a run in the middle
of its work. Everything that was at work then must get on; parts of one run are hit one after another, so that each
shows that it can be recovered from, while other runs and the parts that all share are hit meanwhile.
"""

from __future__ import annotations

import contextlib
import filecmp
import functools
import json
import os
import secrets
import shutil
import signal
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Optional

import psutil
import requests
import typer
from rich.console import Console
from rich.table import Table

from benchmarks.faults import KINDS, LAST, OF_ALL, Fault, Hit, Result, plan
from benchmarks.processes import MARK, in_words, is_hit, is_live, is_named, left_of_ours, marked
from benchmarks.results import JsonFile, keep
from benchmarks.servers import RayHead, TrackingServer, until
from space_dist import config as configs
from space_dist.errors import ConfigError, LedgerError, SpaceDistError, nearest
from space_dist.experiment.manifest import Grid, Run
from space_dist.experiment.status import Attempts, run_status_of
from space_dist.ledger import CURRICULUM, METRICS, TIMING, Ledger, Status

ROOT = Path(__file__).resolve().parents[2]
COMPARED = (METRICS, CURRICULUM, "model.npz")
AT_A_TIME = 2  # runs, each with a driver, a rollout actor and a curriculum actor
BASE = ROOT / "configs/pointmass_space.yaml"
SETTINGS: Mapping[str, Any] = {
    "learner.n_steps": 1024,
    "learner.n_epochs": 3,
    "rollout.slots": 2,
    "evaluation.every_steps": 10_240,
}
_FURTHER_ROUNDS = 2  # that a run must commit after a fault: the first may have been computed when it fell
_SEARCH_SECONDS = 240.0  # for a target
_RECOVERY_SECONDS = 240.0
_LEFT_SECONDS = 45.0  # for what was told to end
console = Console()


def chaos(
    faults: Annotated[int, typer.Option(min=1, help="Faults that must hit.")] = 50,
    runs: Annotated[int, typer.Option(min=1, help="Runs of the grid.")] = 8,
    steps: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=5_120, help="Environment steps of each run; default: 184,320, of a population 3,686,400."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of kinds, moments and victims.")] = 0,
    kind: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help=f"Only these kinds of faults; repeatable. Of: {', '.join(KINDS)}."),
    ] = None,
    population: Annotated[bool, typer.Option(help="Runs share their processes (engine: population).")] = False,
    json_file: JsonFile = None,
) -> None:
    """Faults over a grid on Ray and MLflow: recovered, results identical, nothing lost, doubled or left behind."""
    if unknown := sorted({*(kind or ())} - {*KINDS}):
        raise ConfigError(f"--kind {unknown[0]!r} is not known{nearest(unknown[0], KINDS)} Allowed: {', '.join(KINDS)}")
    possible = [name for name in KINDS if not (population and name.endswith("actor"))]
    settings = {**SETTINGS, "engine": "population"} if population else SETTINGS
    steps = steps or (3_686_400 if population else 184_320)  # enough for so many faults on two cores
    result = rehearse(
        runs=runs, steps=steps, seed=seed, kinds=kind or possible, count=faults, say=console.print, settings=settings
    )
    _show(result)
    keep(asdict(result), json_file)
    if result.faults:
        raise typer.Exit(1)


def rehearse(
    *, runs: int, steps: int, seed: int, kinds: Sequence[str], count: int, say: Callable[[str], None],
    base: Path = BASE, settings: Mapping[str, Any] = SETTINGS, last: float = LAST,
    after_faults: Callable[[], None] = lambda: None,
) -> Result:  # fmt: skip
    """Work on one grid twice, once left alone and once not; returns what was found.

    base, settings: the config of its runs, and what is changed of it; with `engine: population` runs share a process
    and have no actors. last: see `plan`. after_faults: called when all faults have fallen.
    """
    mark = secrets.token_hex(8)
    folder = Path(tempfile.mkdtemp(prefix="sd", dir="/tmp"))
    (folder / "tmp").mkdir()
    environment = {
        **os.environ, MARK: mark, "TMPDIR": str(folder / "tmp"), "RAY_TMPDIR": str(folder / "tmp"),
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
    }  # fmt: skip
    result = Result(runs=runs)
    try:
        with contextlib.ExitStack() as stack:
            server = TrackingServer(folder, environment, folder / "server.log")
            head = RayHead(folder / "ray", AT_A_TIME * 2, environment, folder / "head.log")
            with ThreadPoolExecutor() as pool, _ended_at_once(mark, server, head):
                list(pool.map(stack.enter_context, (server, head)))
            write = functools.partial(_grid_file, folder, runs, {**settings, "budget.steps": steps}, base)
            alone = stack.enter_context(_alone(folder, write("alone", None), environment))
            stack.enter_context(_ended_at_once(mark, server, head))  # on the way out this comes before their own ends
            rehearsal = _Rehearsal(folder, write("chaos", server.address), head, server, mark, result, say)
            start = time.monotonic()
            try:
                rehearsal.run(plan(kinds, count, runs * steps, seed, last), after_faults)
                result.seconds = time.monotonic() - start
                rehearsal.check(_finished(alone, folder))
            finally:
                rehearsal.end()
        until(lambda: not marked(mark), _LEFT_SECONDS)
        if left := marked(mark):  # the servers have ended, too
            result.faults.append(f"left behind in the end: {'; '.join(map(in_words, left))}")
        until(lambda: not _temporary(folder / "tmp"), _LEFT_SECONDS)  # a large folder is removed after its owner's end
        if names := _temporary(folder / "tmp"):
            result.faults.append(f"temporary files were left behind: {', '.join(names)}")
    finally:
        for process in marked(mark):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        if result.faults:
            say(f"kept, so that it can be looked into: {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    return result


@contextlib.contextmanager
def _ended_at_once(mark: str, *servers: RayHead | TrackingServer) -> Iterator[None]:
    """Where this process is to end (SIGTERM, Ctrl-C), kill all that it has started: what comes next may be SIGKILL."""
    try:
        yield
    except (SystemExit, KeyboardInterrupt):
        for server in servers:
            server.give_up()
        for process in marked(mark):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        raise


def _temporary(folder: Path) -> list[str]:
    """What our processes have left where temporary files lie.

    torch keeps a cache there, MLflow's killed servers leave what multiprocessing made, and Ray what is of no session.
    """
    others = ("ray", "session_latest", "prom_metrics_service_discovery.json", "torchinductor_", "pymp-")
    found = sorted(path.name for path in [*folder.iterdir(), *(folder / "ray").glob("*")])
    return [name for name in found if not name.startswith(others)]


def _grid_file(
    folder: Path, runs: int, settings: Mapping[str, Any], base: Path, name: str, uri: str | None
) -> Path:  # fmt: skip
    path = folder / f"{name}.yaml"
    cells = 2 if runs % 2 == 0 else 1
    path.write_text(configs.to_yaml({
        "name": "chaos", "extends": str(base), "set": {**settings, "checkpoint.every_rounds": 1},
        "grid": {"curriculum.kappa": [1, 16][:cells]}, "seeds": {"count": runs // cells},
        "resources": {
            "workers": 0 if uri is None or settings.get("engine") == "population" else 1,
            "grace_seconds": 5.0, "late_seconds": 6.0,
            "first_answer_seconds": 60.0,
        },
        "retry": {"killed": 1000, "node_lost": 1000, "preempted": 1000}, "tracking": {"uri": uri},
    }))  # fmt: skip
    return path


@contextlib.contextmanager
def _alone(folder: Path, grid_file: Path, environment: Mapping[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """The grid without faults, actors and MLflow, worked on at the same time."""
    command = [
        sys.executable, "-m", "space_dist.cli", "grid", "run", str(grid_file), "--root",
        str(folder / "alone"), "--max-parallel", "1",
    ]  # fmt: skip
    with (folder / "alone.log").open("wb") as output:
        process = subprocess.Popen(
            command, env=dict(environment), stdin=subprocess.DEVNULL, stdout=output, stderr=output
        )  # fmt: skip
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def _finished(alone: subprocess.Popen[bytes], folder: Path) -> Grid:
    if alone.wait():
        said = (folder / "alone.log").read_text(errors="replace")
        raise SpaceDistError(f"the grid left alone did not complete: {said[-3000:]}")
    return Grid(folder / "alone/chaos")


class _Missed(Exception):  # noqa: N818 - no error: it is counted
    """There was no live target in the middle of its work."""


@dataclass(frozen=True)
class _Live:
    """A run in the middle of its work, and the process that trains it."""

    run: Run
    round: int
    driver: psutil.Process


@dataclass(frozen=True)
class _Open:
    """A fault that fell, and is not known to be recovered from. moved: of `live`, who must go on in new processes."""

    fault: Fault
    whose: str
    start: float
    victims: Sequence[psutil.Process]
    live: Sequence[_Live]
    moved: Sequence[_Live]
    hurt: Sequence[Run]

    def over(self, has_got_on: Callable[[_Live, bool], bool]) -> bool:
        """The victims are gone, and whatever was at work has got on."""
        return not any(map(is_live, self.victims)) and all(has_got_on(one, one in self.moved) for one in self.live)


class _Rehearsal:
    """The grid at work under faults."""

    def __init__(
        self, folder: Path, grid_file: Path, head: RayHead, server: TrackingServer, mark: str, result: Result,
        say: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._folder, self._grid_file, self._head, self._server = folder, grid_file, head, server
        self._mark, self._result, self._say = mark, result, say
        self._grid = Grid(folder / "runs/chaos")
        self._runs: list[Run] = []
        self._submitter: subprocess.Popen[bytes] | None = None
        self._expected = 0  # ends of submitters that faults explain
        self._open: list[_Open] = []
        self._first_seen: dict[tuple[str, psutil.Process], int] = {}  # the round in which a run's process was
        self._began = time.monotonic()

    # ---- the course of things ----

    def run(self, faults: Sequence[Fault], after_faults: Callable[[], None]) -> None:
        """All faults, and the rest of the work."""
        self._submit()
        for fault in faults:
            self._wait(lambda fault=fault: self._steps() >= fault.after_steps)  # type: ignore[misc]
            time.sleep(fault.delay)
            if not self._strike(fault):
                self._result.faults.append(
                    f"no target for {fault.kind!r} was found in the middle of its work (--steps makes more of it)"
                )
                self._say(f"        {fault.kind}: no target")
        after_faults()
        if not self._wait(lambda: self._submitter is not None and self._submitter.poll() == 0):
            self._result.faults.append("the grid did not complete")
        self._wait(lambda: not self._open)

    def _wait(self, condition: Callable[[], bool]) -> bool:
        """Keep everything going meanwhile; False if the condition does not come true."""

        def come() -> bool:
            self._keep_submitted()
            self._look_at_open()
            return condition()

        return until(come, _RECOVERY_SECONDS + 60.0 * max(1, len(self._runs)))

    def _look_at_open(self) -> None:
        """Notice which faults are recovered from by now."""
        for one in list(self._open):
            seconds = time.monotonic() - one.start
            if recovered := one.over(self._has_got_on):
                self._result.hits.append(Hit(one.fault, one.whose, one.start - self._began, seconds))
            elif seconds > _RECOVERY_SECONDS:
                self._result.hits.append(Hit(one.fault, one.whose, one.start - self._began, None))
                self._result.faults.append(f"not recovered within {seconds:.0f} s: {one.fault.kind}, {one.whose}")
            else:
                continue
            self._open.remove(one)
            self._say(f"{len(self._result.hits):3d} {one.start - self._began:5.0f} s  {one.fault.kind:22s} "
                      f"{one.whose:18s} {f'{seconds:5.1f} s' if recovered else 'not recovered'}")  # fmt: skip

    def end(self) -> None:
        """Whoever still looks on need not."""
        if self._submitter is not None and self._submitter.poll() is None:
            self._submitter.kill()
            self._submitter.wait()

    # ---- submitting ----

    def _submit(self) -> None:
        command = [
            sys.executable, "-m", "space_dist.cli", "grid", "submit", str(self._grid_file), "--address",
            self._head.address, "--root", str(self._folder / "runs"), "--mode", "pool", "--python", sys.executable,
            "--max-in-flight", str(AT_A_TIME),
        ]  # fmt: skip
        self._result.submissions += 1
        with (self._folder / f"submitter-{self._result.submissions}.log").open("wb") as output:
            self._submitter = subprocess.Popen(
                command, env=self._head.environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )  # fmt: skip

    def _keep_submitted(self) -> None:
        """Submit again if the last submitter has ended before the grid was done, as a user would."""
        if self._head.process is not None and self._head.process.poll() is not None:
            said = (self._folder / "head.log").read_text(errors="replace")
            self._result.faults.append(f"the Ray head ended, which nobody had harmed: {said[-700:]}")
            self._expected += 1
            self._restart(self._head)
        if self._submitter is None or (code := self._submitter.poll()) is None:
            return
        said = (self._folder / f"submitter-{self._result.submissions}.log").read_text(errors="replace")
        if "Traceback" in said:
            self._result.faults.append(f"a submitter ended with a traceback: {said[-1500:]}")
        if code == 0:
            return
        if code == 1 and " failed" in said and self._failed():
            raise SpaceDistError(f"runs have failed: {said[-1500:]}")
        if self._expected:
            self._expected -= 1
        else:
            self._result.faults.append(f"a submitter ended that nobody had harmed (exit code {code}): {said[-700:]}")
        self._submit()

    def _failed(self) -> list[str]:
        retry = self._grid.manifest().retry
        found = [run_status_of(run, self._grid.ledger(run), retry, "") for run in self._all()]
        return [one.in_words for one in found if one.condition == "failed"]

    # ---- where the work stands ----

    def _all(self) -> list[Run]:
        if not self._runs and self._grid.manifest_file.exists():
            self._runs = self._grid.manifest().runs()
        return self._runs

    def _status(self, run: Run) -> Status | None:
        with contextlib.suppress(LedgerError):
            ledger = self._grid.ledger(run)
            return ledger.status() if ledger.status_file.exists() else None
        return None

    def _steps(self) -> int:
        return sum(status.steps for run in self._all() if (status := self._status(run)) is not None)

    def _driver(self, ledger: Ledger) -> psutil.Process | None:
        """The process that holds the run's lock."""
        with contextlib.suppress(OSError, ValueError, psutil.Error):
            owner = json.loads(ledger.lock_file.read_bytes())
            if ledger.owner_alive():
                return psutil.Process(int(owner["pid"]))
        return None

    def _live(self) -> list[_Live]:
        """Runs in the middle of their work: their process has committed, and not only started."""
        found = []
        for run in self._all():
            status = self._status(run)
            if status is not None and status.state == "running" and 0 < status.steps < status.budget_steps:
                driver = self._driver(self._grid.ledger(run))
                if driver is None or not is_named(driver, "space_dist.grid.supervisor"):
                    continue
                if status.round > self._first_seen.setdefault((run.key, driver), status.round):
                    found.append(_Live(run, status.round, driver))
        return found

    def _done(self, run: Run) -> bool:
        status = self._status(run)
        return status is not None and status.state == "done"

    # ---- faults ----

    def _strike(self, fault: Fault) -> bool:
        """Find a target and hit it. What a run still has to recover from must not be hidden by the next fault."""
        deadline = time.monotonic() + _SEARCH_SECONDS
        while time.monotonic() < deadline and not all(map(self._done, self._all())):
            self._keep_submitted()
            self._look_at_open()
            live, _, name = self._live(), *fault.kind.split(" ", 1)
            hurt = {run.key for one in self._open for run in one.hurt}
            free = [one for one in live if name in OF_ALL or one.run.key not in hurt]
            if free:
                try:
                    self._hit(fault, free[int(fault.choice * len(free))], live)
                except (_Missed, psutil.Error):
                    self._result.misses[fault.kind] = self._result.misses.get(fault.kind, 0) + 1
                else:
                    return True
            time.sleep(0.5)
        return False

    def _hit(self, fault: Fault, chosen: _Live, live: Sequence[_Live]) -> None:
        verb, name = fault.kind.split(" ", 1)
        victims, moved, restart = self._victims(name, chosen, live)
        if not victims or not all(map(is_live, victims)):
            raise _Missed
        start = time.monotonic()
        for victim in victims:
            with contextlib.suppress(psutil.NoSuchProcess):  # parts of a Ray head end with the one that was hit before
                victim.send_signal(signal.SIGSTOP if verb == "stop" else signal.SIGKILL)
        if name in ("conductor", "submitter", "Ray head"):
            self._expected += 1
        fell = until(lambda: all(is_hit(victim, verb) for victim in victims), 5.0, 0.02)
        counts = fell and any(
            (status := self._status(one.run)) is not None and status.state == "running"
            for one in (live if name in OF_ALL else [chosen])
        )
        if restart is not None:
            time.sleep(fault.pause)
            restart()
        if not counts:  # it ended just then, or would not fall; what was hit has been started again all the same
            raise _Missed
        whose = "all" if name in OF_ALL else chosen.run.title
        hurt = [] if name in OF_ALL else [one.run for one in _sharing(chosen, live)]
        self._open.append(_Open(fault, whose, start, victims, live, moved, hurt))

    def _has_got_on(self, before: _Live, moved: bool) -> bool:
        """Two rounds further, or done; by another process if the one before is to be gone."""
        if self._done(before.run):
            return True
        status = self._status(before.run)
        if status is None or status.round < before.round + _FURTHER_ROUNDS:
            return False
        return not moved or self._driver(self._grid.ledger(before.run)) not in (None, before.driver)

    def _victims(
        self, name: str, chosen: _Live, live: Sequence[_Live]
    ) -> tuple[list[psutil.Process], Sequence[_Live], Callable[[], None] | None]:
        """The processes to hit, the runs that go on in another process then, and what has to be restarted."""
        driver, supervisor, sharing = chosen.driver, chosen.driver.parent(), _sharing(chosen, live)
        if supervisor is None or not is_named(supervisor, "space_dist.grid.supervisor"):
            raise _Missed
        if name.endswith("actor"):
            kind = {"rollout actor": "RolloutActor", "curriculum actor": "CurriculumActor"}[name]
            return [self._actor(kind, driver)], [], None
        if name in ("driver", "supervisor"):
            return [driver if name == "driver" else supervisor], sharing, None
        if name == "pool worker":
            forker = supervisor.parent()
            worker = None if forker is None else forker.parent()
            if worker is None or not is_named(worker, "ray::PoolWorker"):
                raise _Missed
            return [worker], sharing, None
        if name == "conductor":
            return [self._conductor()], live, None
        if name == "submitter":
            if self._submitter is None or self._submitter.poll() is not None:
                raise _Missed
            return [psutil.Process(self._submitter.pid)], [], None
        server = self._head if name == "Ray head" else self._server
        return server.own(), live if name == "Ray head" else [], lambda: self._restart(server)

    def _restart(self, server: RayHead | TrackingServer) -> None:
        server.kill()  # which also collects what was killed
        server.start()

    def _actor(self, kind: str, driver: psutil.Process) -> psutil.Process:
        """The process of a run's actor, as Ray knows it."""
        try:
            jobs = [job["job_id"] for job in self._head.ask("/api/jobs/")
                    if job["job_id"] and (job["driver_info"] or {}).get("pid") == str(driver.pid)]  # fmt: skip
            actors = self._head.ask("/api/v0/actors?detail=1&limit=1000")["data"]["result"]["result"]
        except (requests.RequestException, ValueError, KeyError, TypeError):
            raise _Missed from None
        pids = [actor["pid"] for actor in actors
                if actor["job_id"] in jobs and actor["class_name"] == kind and actor["state"] == "ALIVE"]  # fmt: skip
        if len(pids) != 1 or not pids[0]:
            raise _Missed
        process = psutil.Process(int(pids[0]))
        if not is_named(process, f"ray::{kind}"):
            raise _Missed
        return process

    def _conductor(self) -> psutil.Process:
        for process in marked(self._mark):
            with contextlib.suppress(psutil.Error):
                words = process.cmdline()
                if "manifest.json" in words and str(self._grid.folder.parent) in words and "grid" in words:
                    return process
        raise _Missed

    # ---- what is true in the end ----

    def check(self, reference: Grid) -> None:
        """Compare with the grid left alone, MLflow with the ledgers, and look for what is left behind."""
        faults = self._result.faults
        command = [sys.executable, "-m", "space_dist.cli", "sync", str(self._grid.folder)]
        done = subprocess.run(command, env=self._head.environment, capture_output=True, text=True, check=False)
        if done.returncode:
            faults.append(f"the last sync failed: {done.stdout[-500:]}{done.stderr[-500:]}")
        for run in self._all():
            ours, other = self._grid.ledger(run).folder, reference.ledger(run).folder
            differ = [name for name in COMPARED if not _same(ours / name, other / name)]
            if differ:
                faults.append(f"{run.title}: not what the run left alone has: {', '.join(differ)}")
            self._result.identical += not differ
            for row in Attempts(self._grid.ledger(run)).rows():
                if row["event"] == "end":
                    cause = row["cause"] or "done"
                    self._result.ends[cause] = self._result.ends.get(cause, 0) + 1
        faults += self._mirror_faults()
        faults += [f"left behind: {path.relative_to(self._folder)}" for path in sorted(self._grid.folder.rglob("*"))
                   if path.name.startswith(".") or path.name == "stop"]  # fmt: skip
        for lock in [self._grid.lock_file, *(self._grid.ledger(run).lock_file for run in self._all())]:
            if not json.loads(lock.read_bytes()).get("released"):
                faults.append(f"a lock is still held: {lock.relative_to(self._folder)}")
        until(lambda: not left_of_ours(self._mark), _LEFT_SECONDS)
        if left := left_of_ours(self._mark):
            faults.append(f"left behind when the grid was done: {left}")

    def _mirror_faults(self) -> Iterator[str]:
        with contextlib.closing(sqlite3.connect(self._server.database)) as store:
            children = store.execute(
                "select count(*), count(distinct t.value) from tags t join runs r using (run_uuid)"
                " where t.key = 'space_dist.folder' and r.lifecycle_stage = 'active' and exists (select 1 from tags p"
                " where p.run_uuid = t.run_uuid and p.key = 'space_dist.level' and p.value = 'run')"
            ).fetchone()  # fmt: skip
            if children != (len(self._all()), len(self._all())):
                yield f"MLflow has {children[0]} children for {children[1]} folders, of {len(self._all())} runs"
            for run in self._all():
                ledger = self._grid.ledger(run)
                stored = store.execute(
                    "select m.key, m.timestamp, m.step, m.value from metrics m join tags t using (run_uuid)"
                    " where t.key = 'space_dist.folder' and t.value = ?", (str(ledger.folder),),
                ).fetchall()  # fmt: skip
                missing, more = Counter(_points(ledger)), Counter(map(tuple, stored))
                if missing != more:
                    yield (f"{run.title}: MLflow lacks {(missing - more).total()} points of {missing.total()} and has "
                           f"{(more - missing).total()} too many")  # fmt: skip


def _sharing(chosen: _Live, live: Sequence[_Live]) -> list[_Live]:
    """The runs that a run shares its process with, itself included."""
    return [one for one in live if one.driver == chosen.driver]


def _points(ledger: Ledger) -> Iterator[tuple[str, int, int, float]]:
    """(metric, milliseconds, step, value) of every number that MLflow must have once."""
    for row, timing in zip(ledger.rows(METRICS), ledger.rows(TIMING), strict=True):
        sections = {"train": "train/", "test": "test/", "rollout": "train/rollout_", "learner": "train/learner_",
                    "curriculum": "curriculum/"}  # fmt: skip
        numbers = {f"{prefix}{key}": value for section, prefix in sections.items()
                   for key, value in row.get(section, {}).items()}  # fmt: skip
        for setting in ("learning_rate", "clip_range"):  # which are the run's parameters
            numbers.pop(f"train/learner_{setting}", None)
        if row["kind"] == "iteration":
            numbers |= {f"time/{key}": row[key] for key in ("iteration", "round", "episodes", "gradient_steps")}
        numbers["time/steps_per_second"] = timing["steps_per_second"]
        for key, value in numbers.items():
            if isinstance(value, int | float):
                yield key, round(timing["unix_time"] * 1000), row["steps"], float(value)


def _same(one: Path, other: Path) -> bool:
    return one.exists() and filecmp.cmp(one, other, shallow=False)


def _show(result: Result) -> None:
    table = Table(title=f"{len(result.hits)} faults in {result.seconds:.0f} s of a grid of {result.runs} runs")
    for column in ("fault", "count", "recovered", "median time to recover", "misses"):
        table.add_column(column, justify="left" if column == "fault" else "right")
    for kind in KINDS:
        hits = [hit for hit in result.hits if hit.fault.kind == kind]
        seconds = [hit.seconds for hit in hits if hit.seconds is not None]
        median = f"{statistics.median(seconds):.1f} s" if seconds else "—"
        table.add_row(kind, str(len(hits)), str(len(seconds)), median, str(result.misses.get(kind, 0)))
    console.print(table)
    console.print(
        f"{result.identical} of {result.runs} runs are, byte for byte, those of the grid left alone. "
        f"{result.submissions} submissions; attempts ended: "
        + ", ".join(f"{number} {cause}" for cause, number in sorted(result.ends.items()))
    )
    for sentence in result.faults:
        console.print(sentence, style="red", markup=False)
    if not result.faults:
        console.print("MLflow is complete and without duplicates; no process and no file is left behind.")
