"""Supervisors in processes of their own, which keep their imports from attempt to attempt; here, they need no Ray."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import select
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from space_dist.errors import SpaceDistError
from space_dist.experiment.endings import Cause, Ended, Evidence
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import settled
from space_dist.grid.supervisor import KILL_SECONDS, SAID, STOPPED_SECONDS, AttemptId, Task
from space_dist.system.files import appending, in_words
from space_dist.system.importing import PYTHON
from space_dist.system.workplace import cores

log = logging.getLogger("space_dist")

_LOOK_SECONDS = 2.0  # between two looks at whether the supervisor was stopped
_PAUSE_SECONDS = 0.5  # before another is started where one died
_SHARE_OF_MEMORY = 0.7  # as Ray takes it: the rest is the system's, and other people's
_GROUP_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")  # of control groups, in both versions
_CHUNK = 1 << 16
_AHEAD = 8  # supervisors that are started before it is known how many are wanted


class SupervisorLostError(Exception):
    """It ended, or was killed, before it said how its attempts ended. code: its exit code, minus a signal's number."""

    def __init__(self, code: int | None) -> None:
        super().__init__(code)
        self.code = code


class WarmSupervisor:
    """`python -m space_dist.grid.supervisor` behind two pipes: started by its first task, and anew when it is lost."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._words = b""
        self._stopped_since: float | None = None

    def start(self, folder: Path | None = None) -> None:
        """Have it import what runs need, where it does not run already.

        folder: of the grid where what it says goes from the start, and not with its first task only.
        """
        if self._process is None or self._process.poll() is not None:
            self._process, self._words = _started(folder), b""

    def begin(self, task: Task) -> None:
        """Hand it attempts to make."""
        self.start(Path(task.grid))
        self._send(dataclasses.asdict(task))

    def ended(self, seconds: float | None = None) -> list[dict[str, Any]] | None:
        """How its attempts ended, in order; None if that takes longer than `seconds`.

        Raises SupervisorLostError if it cannot say so any more.
        """
        process, code = self._process, None
        while process is not None and process.stdout is not None:
            line, newline, rest = self._words.partition(b"\n")
            if newline:
                self._words = rest
                message: dict[str, Any] = json.loads(line)
                if "ends" in message:
                    return list(message["ends"])
                continue
            if not select.select([process.stdout], [], [], seconds)[0]:
                return None
            chunk = os.read(process.stdout.fileno(), _CHUNK)
            # End of file: it is gone, and waiting reaps it.
            if not chunk:
                code = process.wait()
                self._process = None
                break
            self._words += chunk
        raise SupervisorLostError(code)

    def stop(self) -> None:
        """Ask the live attempts to checkpoint and end."""
        self._send({"stop": True})

    def kill_if_stopped(self) -> None:
        """Kill it if somebody has stopped it (SIGSTOP) for too long; to be called now and then."""
        if self._process is None:
            return
        with contextlib.suppress(psutil.Error):
            stopped = psutil.Process(self._process.pid).status() == psutil.STATUS_STOPPED
            self._stopped_since = (self._stopped_since or time.monotonic()) if stopped else None
            if self._stopped_since is not None and time.monotonic() - self._stopped_since > STOPPED_SECONDS:
                self._process.kill()

    def release(self) -> None:
        """Have it end, after a checkpoint of whatever it still works on."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()

    def kill(self) -> None:
        """End it at once: it has nothing to do."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def close(self, seconds: float) -> None:
        """Release it, and wait for its end; kill it if that takes longer than `seconds`."""
        self.release()
        if self._process is None:
            return
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _send(self, message: dict[str, Any]) -> None:
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(json.dumps(message).encode() + b"\n")
                self._process.stdin.flush()


def _started(folder: Path | None) -> subprocess.Popen[bytes]:
    command = [*PYTHON, "-m", "space_dist.grid.supervisor"]
    # Nothing of a Ray actor's own identity: runs that join Ray join it as drivers.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("RAY_JOB_")}
    with Path(os.devnull).open("ab") if folder is None else appending(folder / SAID) as errors:
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, env=environment
        )  # fmt: skip


class WarmPlaces:
    """Supervisors of this machine that outlive what they are lent for: the next grid, or generation, starts at once.

    As a context: they end with it. limit: how many are wanted at a time at most.
    """

    def __init__(self, limit: int | None = None) -> None:
        self._idle = [WarmSupervisor() for _ in range(min(limit or cores(), cores(), _AHEAD))]

    def __enter__(self) -> WarmPlaces:
        with contextlib.suppress(OSError):  # told by whoever cannot do without
            for supervisor in self._idle:
                supervisor.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for supervisor in self._idle:
            supervisor.kill()

    def lent(self, count: int) -> list[WarmSupervisor]:
        """As many as that, of which the first are warm."""
        lent, self._idle = self._idle[:count], self._idle[count:]
        return lent + [WarmSupervisor() for _ in range(count - len(lent))]

    def take_back(self, supervisors: Iterable[WarmSupervisor]) -> None:
        """Those that have nothing to do."""
        self._idle.extend(supervisors)


def understood(attempts: Sequence[tuple[Run, int]], ends: Sequence[dict[str, Any]]) -> list[tuple[Run, Ended | None]]:
    """What a supervisor said of its attempts, run by run; None where another process works on the run."""
    return [
        (run, None if end["busy"] else Ended(None if end["cause"] is None else Cause(end["cause"]), end["detail"]))
        for (run, _), end in zip(attempts, ends, strict=True)
    ]


def all_lost(grid: Grid, attempts: Sequence[tuple[Run, int]], seen: Evidence) -> list[tuple[Run, Ended | None]]:
    """Those that are done are done; nobody but whoever manages them can say how the others ended."""
    return [(run, settled(run, grid.ledger(run), attempt, seen)) for run, attempt in attempts]


def supervisor_lost(reason: str | None, code: int | None) -> Evidence:
    """A supervisor that is gone. reason: why we were asked to end, if we were. code: as of `SupervisorLostError`.

    A batch system that ends a job signals all its processes, and so us, too.
    """
    return Evidence(gone="supervisor", gone_code=code, all_asked=reason or "")


@dataclass
class _Place:
    """A supervisor on this machine, and what it is doing."""

    supervisor: WarmSupervisor
    attempts: Sequence[tuple[Run, int]] = ()
    not_before: float = 0.0  # of the monotonic clock, for the next attempt
    looked: float = 0.0


class LocalExecutor:
    """An `Executor` of `size` places here, for runs without rollout actors: there is nothing for Ray to do.

    warm: who lends it supervisors, and takes those back that have nothing left to do.
    """

    def __init__(
        self, grid: Grid, manifest: Manifest, size: int, stop_requested: Callable[[], str | None],
        warm: WarmPlaces | None = None,
    ) -> None:  # fmt: skip
        self.size, self.memory_mb = size, memory_of_a_core() * min(1.0, cores() / size)
        self._grid, self._stop_requested, self._warm = grid, stop_requested, warm
        lent = [WarmSupervisor() for _ in range(size)] if warm is None else warm.lent(size)
        self._places = [_Place(supervisor) for supervisor in lent]
        self._seconds = manifest.resources.grace_seconds + KILL_SECONDS

    def __enter__(self) -> LocalExecutor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        busy = [place for place in self._places if place.attempts or self._warm is None]
        if self._warm is not None:
            self._warm.take_back(place.supervisor for place in self._places if not place.attempts)
        for place in busy:
            place.supervisor.release()  # all at once, and then each is waited for
        deadline = time.monotonic() + 2 * self._seconds
        for place in busy:
            place.supervisor.close(max(0.0, deadline - time.monotonic()))

    def room(self) -> int:
        """See `grid.Executor`."""
        return sum(map(self._is_free, self._places))

    def start(self, attempts: Sequence[tuple[Run, int]]) -> None:
        """See `grid.Executor`."""
        place = next(filter(self._is_free, self._places))
        each = tuple(AttemptId(run.cell.id, run.seed, attempt) for run, attempt in attempts)
        try:
            place.supervisor.begin(Task(str(self._grid.folder), each))
        except OSError as error:
            raise SpaceDistError(
                f"cannot start a process for the runs of {self._grid.folder}: {in_words(error)}"
            ) from None
        place.attempts = attempts

    def adopt(self, runs: Sequence[Run]) -> list[Run]:  # noqa: ARG002 - a supervisor does not outlive its conductor
        """See `grid.Executor`."""
        return []

    def stop(self) -> None:
        """See `grid.Executor`."""
        for place in self._places:
            if place.attempts:
                place.supervisor.stop()

    def poll(self) -> list[tuple[Run, Ended | None]]:
        """See `grid.Executor`."""
        return [end for place in self._places if place.attempts for end in self._ended(place)]

    def _ended(self, place: _Place) -> list[tuple[Run, Ended | None]]:
        try:
            if (ends := place.supervisor.ended(0.0)) is None:
                self._look(place)
                return []
            found = understood(place.attempts, ends)
        except SupervisorLostError as lost:
            log.warning("lost a supervisor")
            found = all_lost(self._grid, place.attempts, supervisor_lost(self._stop_requested(), lost.code))
            place.not_before = time.monotonic() + _PAUSE_SECONDS
        place.attempts = ()
        return found

    @staticmethod
    def _is_free(place: _Place) -> bool:
        return not place.attempts and time.monotonic() >= place.not_before

    @staticmethod
    def _look(place: _Place) -> None:
        if time.monotonic() - place.looked > _LOOK_SECONDS:
            place.looked = time.monotonic()
            place.supervisor.kill_if_stopped()


def needs_ray(manifest: Manifest) -> bool:
    """Whether runs on this machine have anything for Ray to do: rollout actors."""
    return manifest.resources.workers > 0


def slurms_memory_of_a_core() -> list[float]:
    """MB, each way in which SLURM says it, if it does: it may give us less than it lets us see."""
    shares = []
    if (given := os.environ.get("SLURM_MEM_PER_CPU", "")).isdecimal():
        shares.append(float(given))
    if (given := os.environ.get("SLURM_MEM_PER_NODE", "")).isdecimal():
        # SLURM sets one of the two, by how memory was asked for (--mem-per-cpu or --mem).
        shares.append(float(given) / cores())
    return shares


def memory_of_a_core() -> float:
    """What a process on one of our CPUs may use, in MB: its share of what is free and of what our group is allowed."""
    free = float(psutil.virtual_memory().available)
    for name in _GROUP_LIMITS:
        with contextlib.suppress(OSError, ValueError):  # "max": no limit
            free = min(free, float((Path("/sys/fs/cgroup") / name).read_text()))
    return min(_SHARE_OF_MEMORY * free / cores() / 2**20, *slurms_memory_of_a_core(), float("inf"))
