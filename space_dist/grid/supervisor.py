"""One attempt of one run, in a process of its own that is watched: memory, time, stops, and why it ended.

Every place that runs grids (this machine, Ray pool, Ray job, SLURM task) does it through `Supervisor.attempt`. Runs
with `engine: population` may share a process; each still has an attempt, and an end, of its own. The process is a fork
of the supervisor, which has imported everything already: it starts in milliseconds, and whatever it does to itself
(leaks, crashes, global state) ends with it.

`python -m space_dist.grid.supervisor` is a server of supervisors: it imports what runs need, once, and forks one for
each socket that comes through its standard input, which is a socket, too. A supervisor reads a task a line, and answers
with a line how its attempts ended. When its socket ends, so does it, after its run has made a checkpoint.
"""

from __future__ import annotations

import gc
import os

# ruff: noqa: E402 - one thread for all arithmetic, before any library reads these
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import contextlib
import ctypes
import dataclasses
import json
import select
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from space_dist.config import RunConfig
from space_dist.errors import ConfigError, Interrupted, LedgerError, SpaceDistError
from space_dist.experiment.endings import AskedBy, Busy, Ended, Evidence, Said, why_ended
from space_dist.experiment.grid_file import RunResources
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import Attempts, is_done, last_lines, slurm_job
from space_dist.grid.fork_server import SAID
from space_dist.system.files import appending, open_own
from space_dist.system.interrupts import StopRequests
from space_dist.system.processes import collect_seldom

OUTPUT = "output.txt"
STOPPED_SECONDS = 10.0  # a run in state T this long is taken for lost
_LOOK_SECONDS = 0.1
_SIGN_SECONDS = 5.0
KILL_SECONDS = 10.0  # after a run's grace time
_LISTEN_SECONDS = 2.0
_PDEATHSIG = 1  # prctl's
_MOST_WORDS = 4000  # of an error


@dataclass(frozen=True)
class AttemptId:
    """One run's attempt."""

    cell: str
    seed: int
    attempt: int

    def __str__(self) -> str:
        return f"{self.cell}:{self.seed}:{self.attempt}"

    @classmethod
    def parse(cls, text: str) -> AttemptId:
        """The inverse of `str`. Raises ConfigError for anything else."""
        cell, *numbers = text.split(":")
        if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
            raise ConfigError(f"{text!r}: write CELL:SEED:ATTEMPT")
        return cls(cell, *map(int, numbers))


@dataclass(frozen=True)
class Task:
    """What to attempt, in one process where it is more than one. grid: its folder. address: of the Ray to join.

    where: more about this place (a job's id).
    """

    grid: str
    attempts: tuple[AttemptId, ...]
    address: str = "local"
    where: Mapping[str, Any] = field(default_factory=dict)


class Supervisor:
    """Forks a process for each attempt and watches it. Must be used from a process without other threads."""

    def __init__(self) -> None:
        self._manifests: dict[str, tuple[int, Manifest]] = {}

    def attempt(self, task: Task, stop_requested: Callable[[], AskedBy | None]) -> list[Ended]:
        """Make the attempts of `task` and record them; returns how each ended, in order. Asks `stop_requested` often.

        Raises LedgerError if the grid's folder cannot be read or written.
        """
        grid = Grid(task.grid)
        manifest = self._manifest(grid)
        runs = [manifest.run(attempt_id.cell, attempt_id.seed) for attempt_id in task.attempts]
        begun = {run.key: attempt_id for run, attempt_id in zip(runs, task.attempts, strict=True)
                 if not grid.ledger(run).owner_alive()}  # fmt: skip
        mine = [run for run in runs if run.key in begun]
        for run in mine:
            Attempts(grid.ledger(run)).begin(begun[run.key].attempt, {**slurm_job(), **task.where})
        found = self._attempted(grid, manifest, mine, task.address, stop_requested) if mine else {}
        for run in mine:
            Attempts(grid.ledger(run)).end(begun[run.key].attempt, found[run.key].on_record)
        return [found.get(run.key, why_ended(Evidence(held=True))) for run in runs]

    def _attempted(
        self, grid: Grid, manifest: Manifest, runs: Sequence[Run], address: str,
        stop_requested: Callable[[], AskedBy | None],
    ) -> dict[str, Ended]:  # fmt: skip
        """How each of the runs ended, by its key, that one process worked on."""
        out_of_memory_before = _system_kills()
        output = grid.ledger(runs[0]).folder / OUTPUT
        child = _Child.fork(lambda tell: _work(grid, manifest, runs, address, tell), output)
        histories = [Attempts(grid.ledger(run)) for run in runs]
        for history in histories:
            history.started(child.pid)
        watch = _Watch(child, manifest.resources, histories)
        while (code := child.code()) is None:
            watch.look(stop_requested)
            time.sleep(_LOOK_SECONDS)
        child.clean()
        has_actors = manifest.resources.workers > 0
        seen = dataclasses.replace(
            watch.seen, runs=len(runs), code=code, oom_killed=_system_kills() > out_of_memory_before,
            # Ray's library aborts (SIGABRT) a process whose cluster is gone.
            has_actors=has_actors, ray_answers=not (has_actors and code == -signal.SIGABRT) or ray_answers(address),
            stop_file=grid.stop_file.exists(), output=tuple(last_lines(output)),
        )  # fmt: skip
        found: dict[str, Ended] = {}
        for run in runs:
            said = child.said.get(run.key)
            done = said is not None and said.code == 0 and is_done(run, grid.ledger(run))  # an exit code proves nothing
            found[run.key] = why_ended(dataclasses.replace(seen, said=said, done=done))
        return found

    def _manifest(self, grid: Grid) -> Manifest:
        """Read once, as long as it does not change: manifests may be large, and runs short."""
        try:
            changed = grid.manifest_file.stat().st_mtime_ns
        except OSError:
            changed = -1
        known = self._manifests.get(task_folder := str(grid.folder))
        if known is None or known[0] != changed:
            known = self._manifests[task_folder] = (changed, grid.manifest())
        return known[1]


class _Child:
    """A forked process, what it says through a pipe, and everything below it.

    said: how each of its runs ended, by its key, as far as it has said so.
    """

    def __init__(self, pid: int, pipe: int) -> None:
        self.pid, self._pipe = pid, pipe
        # A child that hangs must not hang its supervisor.
        os.set_blocking(pipe, False)
        self.said: dict[str, Said] = {}
        self._process = psutil.Process(pid)
        self._code: int | None = None
        self._words = b""

    @classmethod
    def fork(cls, work: Callable[[Tell], None], output: Path) -> _Child:
        # Else what is buffered would be written twice, by both processes.
        sys.stdout.flush()
        sys.stderr.flush()
        parent = os.getpid()
        reading, writing = os.pipe()
        pid = os.fork()
        if pid:
            os.close(writing)
            return cls(pid, reading)
        code = 1
        try:
            os.close(reading)
            # A session of its own: what the run leaves behind is killed as one group.
            os.setsid()
            ctypes.CDLL(None).prctl(_PDEATHSIG, signal.SIGTERM)
            # The parent died before PDEATHSIG was set, which is sent for later deaths only (prctl(2)).
            if os.getppid() != parent:
                os._exit(Interrupted.exit_code)
            code = _child_main(work, output, writing)
        except BaseException:  # nothing may return into the parent's code
            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
            # Past the parent's `finally` blocks and exit handlers, which are not ours to run.
            os._exit(code)

    def code(self) -> int | None:
        """The exit code, minus the number of the signal that ended it; None while it lives."""
        self._listen()
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code

    def tree(self) -> list[psutil.Process]:
        with contextlib.suppress(psutil.Error):
            return [self._process, *self._process.children(recursive=True)]
        return []

    def signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            if self._code is None:
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End it and everything below, at once."""
        for process in self.tree():
            with contextlib.suppress(psutil.Error):
                process.kill()

    def clean(self) -> None:
        """Kill what the run has left in its session, and hear its last words."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self._listen()
        os.close(self._pipe)

    def _listen(self) -> None:
        with contextlib.suppress(OSError):  # nothing more for now
            while chunk := os.read(self._pipe, 1 << 16):
                self._words += chunk
        *lines, self._words = self._words.split(b"\n")
        for line in lines:
            # A killed process may leave half a line.
            with contextlib.suppress(ValueError, KeyError, TypeError):
                found = json.loads(line)
                self.said[found["run"]] = Said(int(found["code"]), str(found["error"]), str(found["message"]))


@dataclass
class _Watch:
    """Looks after a child, and remembers what it saw for which it ended it, or asked it to end."""

    child: _Child
    resources: RunResources
    attempts: Sequence[Attempts]  # that share its process, and so the sum of what each may use
    seen: Evidence = field(default_factory=Evidence)
    began: float = field(default_factory=time.monotonic)
    kill_at: float | None = None
    killed: bool = False
    stopped_since: float | None = None
    last_sign: float = 0.0

    def look(self, stop_requested: Callable[[], AskedBy | None]) -> None:
        now = time.monotonic()
        if now - self.last_sign > _SIGN_SECONDS:
            self.last_sign = now
            for attempts in self.attempts:
                attempts.sign()
        used, state = self._used()
        limit, count = self.resources.memory_mb, len(self.attempts)
        if limit is not None and used > count * limit << 20:
            self._end(dataclasses.replace(self.seen, over_memory=(used >> 20, limit)))
        self.stopped_since = (self.stopped_since or now) if state == psutil.STATUS_STOPPED else None
        if self.stopped_since is not None and now - self.stopped_since > STOPPED_SECONDS:
            self._end(dataclasses.replace(self.seen, halted_seconds=STOPPED_SECONDS))
        if self.kill_at is None:
            minutes, asked_by = self.resources.minutes, stop_requested()
            if asked_by is not None:
                self._ask(dataclasses.replace(self.seen, asked_by=asked_by))
            elif minutes is not None and now - self.began > 60.0 * minutes * count:
                self._ask(dataclasses.replace(self.seen, over_minutes=minutes))
        elif now > self.kill_at:
            self.child.kill()

    def _used(self) -> tuple[int, str]:
        """RSS of the child's processes in bytes, and the child's state."""
        used, state = 0, ""
        for process in self.child.tree():
            with contextlib.suppress(psutil.Error):
                used += process.memory_info().rss
                # The first of the tree is the run's own process.
                state = state or process.status()
        return used, state

    def _ask(self, seen: Evidence) -> None:
        self.seen = seen
        # The run itself ends after `grace_seconds` on its last checkpoint: who is killed later than that hangs.
        self.kill_at = time.monotonic() + self.resources.grace_seconds + KILL_SECONDS
        self.child.signal(signal.SIGTERM)

    def _end(self, seen: Evidence) -> None:
        if not self.killed:  # what is seen of a process that dies is no reason of its death
            self.seen, self.killed = seen, True
        self.child.kill()


def ray_answers(address: str) -> bool:
    """Whether somebody listens at a Ray's address, HOST:PORT; Ray itself aborts a process that asks in vain."""
    host, _, port = address.rpartition(":")
    if not port.isdecimal():
        return True
    try:
        socket.create_connection((host, int(port)), timeout=_LISTEN_SECONDS).close()
    except OSError:
        return False
    return True


def _system_kills() -> int:
    """How often the kernel has killed a process of our control group for want of memory."""
    total = 0
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            folder = Path("/sys/fs/cgroup") / line.split(":", 2)[2].lstrip("/")
            for events in {folder / "memory.events", Path("/sys/fs/cgroup/memory.events")}:
                with contextlib.suppress(OSError):
                    counts = dict(entry.split() for entry in events.read_text().splitlines())
                    total += int(counts.get("oom_kill", 0))
    return total


# ---- in the child ---------------------------------------------------------------------------------------------------


Tell = Callable[[Run, "SpaceDistError | None"], None]
"""What a process says of a run that has ended: its error, None where it is done."""


def _child_main(work: Callable[[Tell], None], output: Path, pipe: int) -> int:
    """The exit code: of its run's error; 0 if it has more, each of which has an end of its own."""
    descriptor = open_own(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    codes: list[int] = []
    own = os.getpid()

    def tell(run: Run, error: SpaceDistError | None) -> None:
        if os.getpid() != own:  # a copy that the run's environment has forked
            return
        said = Said.of(error)
        codes.append(said.code)
        row = {"run": run.key, **dataclasses.asdict(said), "message": said.message[:_MOST_WORDS]}
        os.write(pipe, json.dumps(row).encode() + b"\n")
        if error is not None:
            with contextlib.suppress(OSError):  # the disk of its output may be full
                print(f"space-dist: {error}", file=sys.stderr)

    work(tell)
    return codes[0] if len(codes) == 1 else 0


def _work(grid: Grid, manifest: Manifest, runs: Sequence[Run], address: str, tell: Tell) -> None:
    from space_dist.run.launch import Outcome, launch

    stop = StopRequests()
    stop.install()
    from space_dist.run.population import advance, member

    by_folder = {grid.ledger(run).folder: run for run in runs}

    def ended(folder: Path, outcome: Outcome | SpaceDistError) -> None:
        tell(by_folder[folder], outcome if isinstance(outcome, SpaceDistError) else None)

    configured: dict[Path, RunConfig] = {}
    for folder, run in by_folder.items():
        try:
            configured[folder] = grid.run_config(manifest, run, address=address)
        except SpaceDistError as error:
            ended(folder, error)
    if len(runs) > 1:
        members = {folder: member(config, folder, stop=stop, pause_at=by_folder[folder].cell.pause_at)
                   for folder, config in configured.items()}  # fmt: skip
        advance(members, ended)
        return
    for folder, config in configured.items():
        try:
            ended(folder, launch(config, folder, resume=True, stop=stop, pause_at=by_folder[folder].cell.pause_at))
        except SpaceDistError as error:
            ended(folder, error)


# ---- as a process of its own ----------------------------------------------------------------------------------------


class _Manager:
    """Whoever sends tasks through `channel`."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._buffer = b""
        self._asked_by: AskedBy | None = None
        self.gone = False

    def tasks(self) -> Iterator[Task]:
        while not self.gone:
            message = self._next(None)
            if message is not None and "stop" not in message:
                self._asked_by = None
                attempts = tuple(AttemptId(**attempt_id) for attempt_id in message.pop("attempts"))
                yield Task(attempts=attempts, **message)

    def stop_requested(self) -> AskedBy | None:
        message = self._next(0.0)
        if message is not None and "stop" in message:
            self._asked_by = "user"
        return self._asked_by or ("others" if self.gone else None)

    def tell(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # it is gone, and hears nothing
            self._channel.sendall(json.dumps(message).encode() + b"\n")

    def _next(self, seconds: float | None) -> dict[str, Any] | None:
        if b"\n" not in self._buffer:
            if self.gone or not select.select([self._channel], [], [], seconds)[0]:
                return None
            chunk = b""
            with contextlib.suppress(ConnectionError):
                chunk = self._channel.recv(1 << 16)
            self.gone = not chunk
            self._buffer += chunk
        line, newline, rest = self._buffer.partition(b"\n")
        if not newline:
            return None
        self._buffer = rest
        message: dict[str, Any] = json.loads(line)
        return message


def main() -> None:
    """Fork a supervisor for each socket that comes, and say through it, once that has ended, with which exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever manages us
    collect_seldom()
    preload()
    gc.freeze()  # forks look through none of it, and share its memory
    requests, wake = _socket_of(os.dup(0)), os.pipe()
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    for end in wake:
        os.set_blocking(end, False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.set_wakeup_fd(wake[1], warn_on_full_buffer=False)
    forks: dict[int, socket.socket] = {}
    wanted = True
    while wanted or forks:
        ready, _, _ = select.select([wake[0], requests.fileno()] if wanted else wake[:1], [], [])
        if wake[0] in ready:
            os.read(wake[0], 1 << 16)
            _tell_ends(forks)
        if requests.fileno() in ready:
            wanted_one, descriptors, _, _ = socket.recv_fds(requests, 1, 1)
            wanted = bool(wanted_one)  # else whoever wants them is gone
            for channel in map(_socket_of, descriptors):
                if pid := os.fork():
                    forks[pid] = channel
                    continue
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                # Whoever holds one of these would keep others from seeing that it has ended.
                for other in (requests, *forks.values()):
                    other.close()
                for end in wake:
                    os.close(end)
                _supervise(_Manager(channel))
                return


def _socket_of(descriptor: int) -> socket.socket:
    os.set_inheritable(descriptor, False)
    return socket.socket(fileno=descriptor)


def _tell_ends(forks: dict[int, socket.socket]) -> None:
    """Say through their sockets which of the forks have ended, and forget them."""
    while forks:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if not pid:
            return
        with forks.pop(pid) as channel:
            _Manager(channel).tell({"code": os.waitstatus_to_exitcode(status)})


def _supervise(manager: _Manager) -> None:
    """Attempt every task that comes, one after another."""
    supervisor = Supervisor()
    manager.tell({"ready": os.getpid()})
    for task in manager.tasks():
        _say_into(Path(task.grid))
        try:
            ended = supervisor.attempt(task, manager.stop_requested)
        except (LedgerError, ConfigError) as error:
            ended = [why_ended(Evidence(said=Said.of(error)))] * len(task.attempts)
        manager.tell({"ends": [{"busy": isinstance(one, Busy), **dataclasses.asdict(one)} for one in ended]})


def preload() -> None:
    """Import what every run needs, so that forks need not. Starts no thread."""
    import space_dist.curricula.configured
    import space_dist.learner
    import space_dist.run.population  # noqa: F401


def _say_into(grid: Path) -> None:
    """Write what is not an answer into the folder of the grid that is worked on."""
    with contextlib.suppress(OSError), appending(grid / SAID) as file:  # its attempts tell that nothing can be written
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)


if __name__ == "__main__":
    main()
