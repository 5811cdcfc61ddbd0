"""Runs of a grid on a warm pool: Ray actors of one CPU, each with a supervisor that keeps its imports from run to run.

The pool lives and dies with its conductor, so it suits runs that are short beside the seconds a process needs to start.
A worker that dies, or gives no sign of life, is replaced; what it was doing ends with a cause and may be tried again.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from space_dist.system.workplace import RAY_DEFAULTS

os.environ.update(RAY_DEFAULTS | dict(os.environ))  # before Ray reads it

import ray
from ray.exceptions import RayActorError, RayError

from space_dist.errors import LedgerError, SpaceDistError
from space_dist.experiment.endings import Ended, Evidence
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.grid.fork_server import ForkServer
from space_dist.grid.supervisor import AttemptId, Task, ray_answers
from space_dist.grid.warm import SupervisorLostError, WarmSupervisor, all_lost, supervisor_lost, understood
from space_dist.ledger import believed_alive, this_process

log = logging.getLogger("space_dist")

_SIGN_SECONDS = 2.0  # between two questions to a worker whether it is there
_LATE_SECONDS = 30.0  # without an answer a worker is taken for lost
_START_SECONDS = 120.0  # for the first worker: a cluster that others fill says so instead of waiting for ever
_NONCE = ".nonce-"
_FORGOTTEN_SECONDS = 86_400.0  # after which a nonce is nobody's, though its process cannot be seen from here


class PoolWorker:
    """One CPU's worth of a pool: manages a warm supervisor, a process of its own, on the actor's node."""

    def __init__(self, folder: str, nonce: str) -> None:
        refuse_other_folder(Path(folder), nonce)
        self._supervisor = WarmSupervisor(ForkServer())

    def attempt(self, task: Task) -> list[dict[str, Any]] | int | None:
        """How the attempts of a task ended; if the supervisor was lost with them, `SupervisorLostError.code`."""
        self._supervisor.begin(task)
        try:
            return self._supervisor.ended()
        except SupervisorLostError as lost:
            return lost.code

    def stop(self) -> None:
        """Ask the live attempt to checkpoint and end."""
        self._supervisor.stop()

    def sign(self) -> str:
        """A sign of life: the id of the node. Kills a supervisor that somebody has stopped (SIGSTOP) for too long."""
        self._supervisor.kill_if_stopped()
        node: str = ray.get_runtime_context().get_node_id()
        return node


@dataclass
class _Slot:
    """A worker, what it is doing, and when it was last heard of. node: None until it has started."""

    actor: Any
    hired: float
    sign: Any
    node: str | None = None
    attempts: Sequence[tuple[Run, int]] = ()
    answer: Any = None
    heard: float = 0.0


class Pool:
    """An `Executor` on the Ray this process has joined; a context manager that leaves nothing behind.

    `size` workers, of one CPU each, beside the CPUs of the runs' own rollout actors.
    """

    def __init__(
        self, grid: Grid, manifest: Manifest, size: int, memory_mb: float, stop_requested: Callable[[], str | None]
    ) -> None:
        self._grid, self._manifest, self._size, self.memory_mb = grid, manifest, size, memory_mb
        self._stop_requested = stop_requested
        self._nonce = Nonce(grid)
        self._address = ray.get_runtime_context().gcs_address
        self._slots: list[_Slot] = []

    def __enter__(self) -> Pool:
        self._nonce.place()
        try:
            self._slots = [self._hire() for _ in range(self._size)]
        except BaseException:
            self._nonce.remove()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Where Ray is gone, `ray.kill` would abort this process before it has said why.
        for slot in self._slots if ray_answers(self._address) else ():
            with contextlib.suppress(RayError):
                ray.kill(slot.actor)
        self._nonce.remove()

    def room(self) -> int:
        """See `grid.Executor`. A worker that Ray has no CPU for yet is no room."""
        return sum(not slot.attempts and slot.node is not None for slot in self._slots)

    @property
    def size(self) -> int:
        """See `grid.Executor`."""
        return self._size

    def start(self, attempts: Sequence[tuple[Run, int]]) -> None:
        """See `grid.Executor`."""
        slot = next(slot for slot in self._slots if not slot.attempts and slot.node is not None)
        each = tuple(AttemptId(run.cell.id, run.seed, attempt) for run, attempt in attempts)
        task = Task(str(self._grid.folder), each, self._address)
        slot.attempts, slot.heard = attempts, time.monotonic()
        slot.answer = slot.actor.attempt.remote(task)

    def adopt(self, runs: Sequence[Run]) -> list[Run]:  # noqa: ARG002 - a pool does not outlive its conductor
        """See `grid.Executor`."""
        return []

    def stop(self) -> None:
        """See `grid.Executor`."""
        for slot in self._slots:
            if slot.attempts:
                slot.actor.stop.remote()

    def poll(self) -> list[tuple[Run, Ended | None]]:
        """See `grid.Executor`."""
        ended: list[tuple[Run, Ended | None]] = []
        for index, slot in enumerate(self._slots):
            attempts = slot.attempts
            try:
                if attempts and ray.wait([slot.answer], timeout=0)[0]:
                    ends = ray.get(slot.answer)
                    slot.attempts, slot.answer = (), None
                    if ends is None or isinstance(ends, int):
                        ended += all_lost(self._grid, attempts, supervisor_lost(self._stop_requested(), ends))
                    else:
                        ended += understood(attempts, ends)
                else:
                    self._listen(slot)
            except RayActorError as error:
                _refuse_start(error)
                if not ray_answers(self._address):
                    raise SpaceDistError(
                        f"the Ray cluster at {self._address} is gone. What is done stays done; once there is one "
                        "again, the same command goes on from the last checkpoints"
                    ) from error
                log.warning("lost a worker of the pool: %s", str(error).splitlines()[0][:200])
                lost = self._lost(slot)
                self._slots[index] = self._hire()
                ended += all_lost(self._grid, attempts, lost)
        if all(slot.node is None and time.monotonic() - slot.hired > _START_SECONDS for slot in self._slots):
            raise SpaceDistError(
                f"Ray did not start a worker of one CPU within {_START_SECONDS:.0f} s; {_cpus()} CPUs are free"
            )
        return ended

    def wait(self, seconds: float) -> None:
        """See `grid.Executor`."""
        awaited = [reference for slot in self._slots for reference in (slot.answer, slot.sign) if reference is not None]
        if awaited:
            ray.wait(awaited, timeout=seconds)
        else:
            time.sleep(seconds)

    def _listen(self, slot: _Slot) -> None:
        """Ask for a sign of life now and then; whoever gives none for too long is killed, and found dead next time."""
        now = time.monotonic()
        if slot.sign is not None and ray.wait([slot.sign], timeout=0)[0]:
            slot.node = ray.get(slot.sign)
            slot.sign, slot.heard = None, now
        elif slot.sign is None and now - slot.heard > _SIGN_SECONDS:
            slot.sign = slot.actor.sign.remote()
        if slot.node is not None and now - slot.heard > _SIGN_SECONDS + _LATE_SECONDS:
            # Else it would be killed again at every look until Ray tells its death.
            slot.heard = now
            ray.kill(slot.actor)

    def _lost(self, slot: _Slot) -> Evidence:
        alive = {node["NodeID"] for node in ray.nodes() if node["Alive"]}  # type: ignore[no-untyped-call]
        node_alive = slot.node is None or slot.node in alive
        return Evidence(gone="worker", node_alive=node_alive, all_asked=self._stop_requested() or "")

    def _hire(self) -> _Slot:
        # Never restarted by Ray: who hires knows what it was doing.
        # Concurrent calls, because `stop` and `sign` must be heard while `attempt` waits for a run.
        workers = ray.remote(num_cpus=1, max_restarts=0)(PoolWorker).options(max_concurrency=4)
        actor = workers.remote(str(self._grid.folder), self._nonce.text)
        return _Slot(actor, hired=time.monotonic(), sign=actor.sign.remote())  # type: ignore[attr-defined]


class Nonce:
    """A file that proves that another process sees the same grid folder."""

    def __init__(self, grid: Grid) -> None:
        self.text = secrets.token_hex(16)
        self._path = grid.folder / f"{_NONCE}{self.text}"

    def place(self) -> None:
        """Raises LedgerError if the folder cannot be written."""
        try:
            # The owner, by which others tell a nonce that a kill has left behind.
            self._path.write_text(json.dumps(this_process()))
        except OSError as error:
            raise LedgerError(f"cannot write the grid's folder {self._path.parent}: {error.strerror}") from None

    def remove(self) -> None:
        """Whatever happens; and with it those of conductors that were killed."""
        with contextlib.suppress(OSError):
            self._path.unlink()
            for other in self._path.parent.glob(f"{_NONCE}*"):
                if _abandoned(other):
                    other.unlink()


def _abandoned(nonce: Path) -> bool:
    """Whether its conductor is dead; one that cannot be seen from here is believed to live for a day."""
    owner: dict[str, Any] = {}
    with contextlib.suppress(ValueError):  # torn by a kill
        owner = json.loads(nonce.read_text())
    here = this_process()
    if all(here[key] and owner.get(key) == here[key] for key in ("boot_id", "pid_namespace")):
        return not believed_alive(owner)
    return time.time() - nonce.stat().st_mtime > _FORGOTTEN_SECONDS


def refuse_other_folder(folder: Path, nonce: str) -> None:
    """Raise LedgerError if the folder here is not the one in which the conductor has placed its nonce."""
    if not (folder / f"{_NONCE}{nonce}").exists():
        host = os.uname().nodename
        raise LedgerError(
            f"{host} does not see the grid's folder {folder}: its root must be on storage all nodes share"
        )


def _refuse_start(error: RayActorError) -> None:
    """An actor that could not even start will not do better next time: raise what it said."""
    text = str(error)
    if "does not see the grid's folder" in text:
        raise LedgerError(next(line for line in text.splitlines() if "does not see" in line).partition("Error: ")[2])


def _cpus() -> str:
    free: dict[str, float] = ray.available_resources()  # type: ignore[no-untyped-call]
    return f"{free.get('CPU', 0.0):g}"
