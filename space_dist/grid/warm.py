"""Supervisors in processes of their own, all forks of one that has imported what runs need; here, they need no Ray."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import select
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from space_dist.errors import SpaceDistError
from space_dist.experiment.endings import Cause, Ended, Evidence
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import settled
from space_dist.grid.fork_server import ForkServer
from space_dist.grid.supervisor import KILL_SECONDS, STOPPED_SECONDS, AttemptId, Task
from space_dist.system.files import in_words
from space_dist.system.workplace import cores

log = logging.getLogger("space_dist")

_LOOK_SECONDS = 2.0  # between two looks at whether the supervisor was stopped
_PAUSE_SECONDS = 0.5  # before another is started where one died
_SHARE_OF_MEMORY = 0.7  # as Ray takes it: the rest is the system's, and other people's
_GROUP_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")  # of control groups, in both versions
_END_SECONDS = 5.0  # for a process that has closed its files
_CHUNK = 1 << 16


class SupervisorLostError(Exception):
    """It ended, or was killed, before it said how its attempts ended. code: its exit code, minus a signal's number."""

    def __init__(self, code: int | None) -> None:
        super().__init__(code)
        self.code = code


class WarmSupervisor:
    """A supervisor behind a socket: forked for its first task, and anew when it is lost."""

    def __init__(self, server: ForkServer) -> None:
        self._server = server
        self._channel: socket.socket | None = None
        self._forked_by: subprocess.Popen[bytes] | None = None
        self._pid: int | None = None  # once it has said so
        self._words = b""
        self._code: int | None = None  # of its exit
        self._stopped_since: float | None = None

    @property
    def channel(self) -> socket.socket | None:
        """What becomes readable when it says something, or is gone; None where it is known to be."""
        return self._channel

    def begin(self, task: Task) -> None:
        """Hand it attempts to make. Raises OSError if no process can be started for it."""
        if self._is_gone():
            self._channel, self._forked_by = self._server.forked(Path(task.grid))
            self._pid, self._words, self._code, self._stopped_since = None, b"", None, None
        self._send(dataclasses.asdict(task))

    def ended(self, seconds: float | None = None) -> list[dict[str, Any]] | None:
        """How its attempts ended, in order; None if that takes longer than `seconds`.

        Raises SupervisorLostError if it cannot say so any more.
        """
        while (channel := self._channel) is not None:
            if (ends := self._heard()) is not None:
                return ends
            if not select.select([channel], [], [], seconds)[0]:
                return None
            self._listen(channel)
        raise SupervisorLostError(self._code)

    def stop(self) -> None:
        """Ask the live attempts to checkpoint and end."""
        self._send({"stop": True})

    def kill_if_stopped(self) -> None:
        """Kill it if somebody has stopped it (SIGSTOP) for too long; to be called now and then."""
        if self._channel is None or self._forked_by is None:
            return
        with contextlib.suppress(psutil.Error):
            # Until it has said that it is there, it waits for whoever forks it.
            process = psutil.Process(self._pid or self._forked_by.pid)
            stopped = process.status() == psutil.STATUS_STOPPED
            self._stopped_since = (self._stopped_since or time.monotonic()) if stopped else None
            if self._stopped_since is not None and time.monotonic() - self._stopped_since > STOPPED_SECONDS:
                process.kill()

    def release(self) -> None:
        """Have it end, after a checkpoint of whatever it still works on."""
        if self._channel is not None:
            with contextlib.suppress(OSError):
                self._channel.shutdown(socket.SHUT_WR)

    def close(self, seconds: float) -> None:
        """Release it, and wait for its end; kill it if that takes longer than `seconds`."""
        self.release()
        deadline = time.monotonic() + seconds
        while (channel := self._channel) is not None:
            if select.select([channel], [], [], max(0.0, deadline - time.monotonic()))[0]:
                self._listen(channel)
                continue
            if self._pid is not None:  # nobody else's: whoever reaps it tells us so
                with contextlib.suppress(ProcessLookupError):
                    os.kill(self._pid, signal.SIGKILL)
            self._lose(channel)

    def _is_gone(self) -> bool:
        """Whether there is none: an idle one may have been killed."""
        while (channel := self._channel) is not None and select.select([channel], [], [], 0.0)[0]:
            self._listen(channel)
        return self._channel is None

    def _listen(self, channel: socket.socket) -> None:
        """Read what there is; at the end of file it is gone, and so are its runs, which hold the socket, too."""
        chunk = b""
        with contextlib.suppress(ConnectionError):
            chunk = channel.recv(_CHUNK)
        self._words += chunk
        if not chunk:
            self._heard()
            if self._code is None and self._forked_by is not None:  # which is ending, too, else it had told
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._code = self._forked_by.wait(_END_SECONDS)
            self._lose(channel)

    def _lose(self, channel: socket.socket) -> None:
        channel.close()
        self._channel = None

    def _heard(self) -> list[dict[str, Any]] | None:
        """The ends that it has told, if it has; whatever else it has said is noted."""
        while b"\n" in self._words:
            line, _, self._words = self._words.partition(b"\n")
            message: dict[str, Any] = json.loads(line)
            if "ends" in message:
                return list(message["ends"])
            self._pid, self._code = message.get("ready", self._pid), message.get("code")
        return None

    def _send(self, message: dict[str, Any]) -> None:
        if (channel := self._channel) is not None:
            with contextlib.suppress(OSError):  # it is gone: `ended` tells
                channel.sendall(json.dumps(message).encode() + b"\n")


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

    server: of supervisors; None: one of its own, that ends with it.
    """

    def __init__(
        self, grid: Grid, manifest: Manifest, size: int, stop_requested: Callable[[], str | None],
        server: ForkServer | None = None,
    ) -> None:  # fmt: skip
        self.size, self.memory_mb = size, memory_of_a_core() * min(1.0, cores() / size)
        self._grid, self._stop_requested = grid, stop_requested
        self._own = ForkServer()  # started only if it is asked
        self._places = [_Place(WarmSupervisor(server or self._own)) for _ in range(size)]
        self._seconds = manifest.resources.grace_seconds + KILL_SECONDS

    def __enter__(self) -> LocalExecutor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for place in self._places:
            place.supervisor.release()  # all at once, and then each is waited for
        deadline = time.monotonic() + 2 * self._seconds
        for place in self._places:
            place.supervisor.close(max(0.0, deadline - time.monotonic()))
        self._own.close()

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

    def wait(self, seconds: float) -> None:
        """See `grid.Executor`."""
        channels = [place.supervisor.channel for place in self._places if place.attempts]
        select.select([channel for channel in channels if channel is not None], [], [], seconds)

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
