"""From a grid's frozen manifest, which `planning` makes, to finished runs.

A `Conductor` is the one loop that works on a grid, wherever its runs are computed: an `Executor` starts them and says
how they ended. Finished runs are skipped, unfinished ones go on from their checkpoints, failed ones are tried again as
the grid's `retry` allows. One conductor at a time works on a grid; another waits, and takes over when the first is
gone. It trains nothing, so nothing here imports torch.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from space_dist.errors import ConfigError, Interrupted, LedgerError, RunLockedError
from space_dist.experiment.endings import Ended
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import (
    Attempts,
    RunStatus,
    concluded,
    is_done,
    may_retry,
    run_status_of,
    run_statuses,
    unheard,
)
from space_dist.ledger import Lock
from space_dist.system.files import in_words, locked
from space_dist.system.interrupts import StopRequests
from space_dist.system.provenance import code_digest
from space_dist.tracking.pusher import LOOK_AT, NO_LONGER, Pusher

log = logging.getLogger("space_dist")

STOP_ASKED = "the grid's file `stop`"
_TICK_SECONDS = 0.2  # between two looks at what nobody tells: files, and requests to stop
_ELSEWHERE_SECONDS = 2.0  # between two looks at the files of runs that others are at
_FIRST_DELAY, _MAX_DELAY = 0.5, 60.0  # seconds before a run that got nowhere is tried again; doubled each time
_FINAL_PUSH_SECONDS = 300.0  # of a whole grid: its last rows and its report
_FREEZE_SECONDS = 120.0  # for others who freeze it at this moment
_ABANDONED_SECONDS = 5.0  # after the grace time of a run whose supervisor is gone
_LIBRARIES_MB = 700  # of a process that trains, before it has a run
MEMBERS = {"cpu": 32, "cuda": 1024}  # of a population, at most: more gain little, and are lost together


def adopt(source: Grid, root: Path) -> Grid:
    """The same frozen grid below another root: what was exported is run where there is room."""
    manifest = source.manifest()
    grid = Grid(root.absolute() / manifest.name)
    if grid.folder.resolve() != source.folder.resolve():
        freeze(grid, manifest, source.instance_files(manifest))
    return grid


def freeze(grid: Grid, manifest: Manifest, files: dict[str, bytes]) -> Manifest | None:
    """Make this the grid's manifest, as tasks of a batch system may all do at once; returns the one before it."""
    try:
        grid.folder.mkdir(parents=True, exist_ok=True)
        with locked(grid.folder / "manifest.lock", _FREEZE_SECONDS):
            return _freeze_alone(grid, manifest, files)
    except OSError as error:
        raise LedgerError(f"cannot write the grid's folder {grid.folder}: {in_words(error)}") from None


def _freeze_alone(grid: Grid, manifest: Manifest, files: dict[str, bytes]) -> Manifest | None:
    before = None
    if grid.manifest_file.exists():
        with contextlib.suppress(LedgerError):  # a damaged one is replaced
            before = grid.manifest()
    if before is not None and (before.search is None) != (manifest.search is None):
        there, ours = ("a search", "grid") if manifest.search is None else ("a grid", "search")
        raise ConfigError(
            f"{grid.folder} holds {there} of this name; give the {ours} another name, or it another folder"
        )
    if before is not None:
        # Another version of this package does not make it another grid: its finished runs stay and are shown as such.
        same = dataclasses.replace(manifest, code=before.code, git=before.git) == before
        if same:
            with contextlib.suppress(LedgerError):
                grid.instance_files(before)
                return before
        elif grid.owner_alive():
            raise ConfigError(
                f"{grid.folder} holds another version of this grid, and somebody is working on it now; "
                f"`space-dist grid stop {grid.folder}` ends that"
            )
    grid.freeze(manifest, files)
    return before


class Executor(Protocol):
    """Where runs are computed. No call but `wait` blocks for longer than a moment."""

    def room(self) -> int:
        """How many more times `start` can be called now without anything having to wait."""

    @property
    def size(self) -> int:
        """How much room there is if nothing runs."""

    @property
    def memory_mb(self) -> float:
        """What a process may use, in MB, if as many run as may; infinite if nobody knows."""

    def start(self, attempts: Sequence[tuple[Run, int]]) -> None:
        """Begin attempts (runs, and which attempt of theirs), in one process that takes the room of one run.

        Raises SpaceDistError if what it runs on is gone.
        """

    def poll(self) -> list[tuple[Run, Ended | None]]:
        """Attempts that have ended since, and how; None where somebody else works on the run."""

    def wait(self, seconds: float) -> None:
        """Until an attempt may have ended, but no longer than that."""

    def stop(self) -> None:
        """Ask every live attempt to checkpoint and end."""

    def adopt(self, runs: Sequence[Run]) -> list[Run]:
        """Those of `runs` that an earlier conductor has started here and that still live; they are polled from now."""


@dataclass
class Overview:
    """What a display shows.

    steps_left, episodes_left: of the budgets of all runs that are neither done nor given up; the latter None where not
    all of the grid's runs end by episodes, and by_episodes says whether some do.
    total, done, failed, waiting: numbers of runs.  running: those under way, as the grid names them: `title`, `seed`,
    `cell`.  message: the last news.
    """

    total: int
    steps_left: int
    episodes_left: int | None = None
    by_episodes: bool = False
    done: int = 0
    failed: int = 0
    waiting: int = 0
    running: list[Run] = field(default_factory=list)
    message: str = ""

    def leave_out(self, run: Run) -> None:
        """It is done, or given up: nothing is left of its budget."""
        self.steps_left -= run.cell.steps_to_take
        if self.episodes_left is not None:
            self.episodes_left -= run.cell.episodes_to_take or 0


class Conductor:
    """Works through the runs of a grid. `conduct` returns where they all stand in the end."""

    def __init__(
        self, grid: Grid, manifest: Manifest, runs: Sequence[Run], executor: Executor,
        *, stop_requested: Callable[[], str | None], observe: Callable[[Overview], None] = lambda overview: None,
    ) -> None:  # fmt: skip
        self._grid, self._manifest, self._runs, self._executor = grid, manifest, runs, executor
        self._stop_requested, self._observe = stop_requested, observe
        # Runs that wait, with the time (on the monotonic clock) before which they may not start: those that have begun
        # go on before anything else begins.
        self._interrupted: list[tuple[float, Run]] = []
        self._fresh: list[tuple[float, Run]] = []
        self._live: dict[str, Run] = {}
        self._attempt: dict[str, int] = {}  # of those that were started here
        self._unrecorded: dict[str, str] = {}  # runs whose end could not be written, and why
        self._steps: dict[str, int] = {}  # that it had taken by then
        self._elsewhere: dict[str, Run] = {}
        self._abandoned: dict[str, float] = {}  # since when, on the monotonic clock
        self._shares: dict[str, tuple[int, int]] = {}  # by stack: the most that have waited, and of these in a process
        episodes = [run.cell.episodes_to_take for run in runs]
        limited = [each for each in episodes if each is not None]
        self._overview = Overview(
            len(runs), sum(run.cell.steps_to_take for run in runs),
            episodes_left=sum(limited) if limited and len(limited) == len(runs) else None, by_episodes=bool(limited),
        )  # fmt: skip

    def conduct(self) -> list[RunStatus]:
        """Until nothing is left to do. Raises Interrupted, after all live runs have ended, if asked to stop.

        Raises LedgerError in the end if runs have left no record of how they ended: nobody would know of it, and they
        would be tried for ever.
        """
        self._begin()
        looked = time.monotonic()
        while self._is_left():
            for run, ended in self._executor.poll():
                self._settle(run, ended)
            if reason := self._asked_to_stop():
                self._wind_up(reason)
            self._start_what_fits()
            if self._elsewhere and time.monotonic() - looked > _ELSEWHERE_SECONDS:
                looked = time.monotonic()
                for run in list(self._elsewhere.values()):
                    self._enqueue(run)
                    self._end_if_abandoned(run)
            self._show()
            if self._is_left():
                self._executor.wait(_TICK_SECONDS)
        self._show()
        if self._unrecorded:
            raise LedgerError(
                f"{len(self._unrecorded)} of {len(self._runs)} runs could not be worked on: "
                f"{next(iter(self._unrecorded.values()))}. What is done stays done; once that can be written, the same "
                "command goes on"
            )
        return self.run_statuses()

    def _is_left(self) -> bool:
        """Whether any run is not at its end."""
        return bool(self._interrupted or self._fresh or self._live or self._elsewhere)

    def run_statuses(self) -> list[RunStatus]:
        """Where all runs stand now, by their files."""
        return run_statuses(self._grid, self._manifest, code_digest(), self._runs)

    def _begin(self) -> None:
        adopted = {run.key for run in self._executor.adopt(self._runs)}
        for run in self._runs:
            if run.key in adopted:
                self._live[run.key] = run
            else:
                self._enqueue(run)

    def _enqueue(self, run: Run, delay: float = 0.0) -> None:
        """Put a run where its files say it belongs."""
        self._elsewhere.pop(run.key, None)
        run_status = run_status_of(run, self._grid.ledger(run), self._manifest.retry, code_digest())
        if run_status.condition == "running":
            self._elsewhere[run.key] = run
        elif run_status.condition == "waiting":
            self._steps[run.key] = run_status.steps
            waiting = self._interrupted if run_status.attempts else self._fresh
            waiting.append((time.monotonic() + delay, run))
        elif run_status.condition == "failed":
            self._overview.failed += 1
            self._overview.leave_out(run)
            log.warning("%s: %s: %s", run.title, run_status.in_words, run_status.detail)
        elif not run_status.end_recorded and run_status.supervised:
            self._elsewhere[run.key] = run
        else:
            if not run_status.end_recorded:  # its supervisor died in between
                concluded(run, run_status.ledger, run_status.attempts)
            self._note_done(run)

    def _end_if_abandoned(self, run: Run) -> None:
        """A run whose supervisor was killed hears of it and ends, unless it is stopped (SIGSTOP) or hangs."""
        history = Attempts(self._grid.ledger(run)).history()
        if run.key not in self._elsewhere or not history.abandoned:
            self._abandoned.pop(run.key, None)
            return
        late = time.monotonic() - self._abandoned.setdefault(run.key, time.monotonic())
        if late > self._manifest.resources.grace_seconds + _ABANDONED_SECONDS:
            log.warning("%s: its supervisor is gone, and it does not end: killing it", run.title)
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(history.process["pid"], signal.SIGKILL)  # a session of its own

    def _start_what_fits(self) -> None:
        for _ in range(self._executor.room()):
            if not (chosen := self._next()):
                return
            keys = {run.key for run in chosen}
            self._interrupted = [entry for entry in self._interrupted if entry[1].key not in keys]
            self._fresh = [entry for entry in self._fresh if entry[1].key not in keys]
            attempts = [(run, self._next_attempt(run)) for run in chosen]
            self._executor.start(attempts)
            self._live |= {run.key: run for run in chosen}
            self._attempt |= {run.key: attempt for run, attempt in attempts}

    def _next(self) -> list[Run]:
        """The runs to be started next, in one process: one, or an equal share of those that can share a process."""
        now = time.monotonic()
        ready = [run for not_before, run in (*self._interrupted, *self._fresh) if not_before <= now]
        if not ready or not ready[0].cell.stack:
            return ready[:1]
        alike = [run for run in ready if run.cell.stack == ready[0].cell.stack]
        device = ready[0].cell.config["device"]
        most = min(MEMBERS[device], self._fitting(max(run.cell.shared_mb for run in alike)))
        if device == "cuda":  # whose room no core's share of the runs would fill
            return alike[:most]
        waiting, share = self._shares.get(ready[0].cell.stack, (0, 0))
        if len(alike) > waiting:
            # All places together work through them in as few turns as they can, and in equal ones: else few would be
            # left for the last turn, in one place, while the others had nothing to do.
            turns = -(-len(alike) // (most * self._executor.size))
            share = -(-len(alike) // (turns * self._executor.size))
            self._shares[ready[0].cell.stack] = len(alike), share
        return alike[: min(most, share)]

    def _fitting(self, each_mb: int) -> int:
        """How many runs of so much memory a process has room for, at least one."""
        room = self._executor.memory_mb - _LIBRARIES_MB
        return max(1, int(min(room / max(1, each_mb), sys.maxsize)))

    def _next_attempt(self, run: Run) -> int:
        ledger = self._grid.ledger(run)
        attempts = Attempts(ledger)
        history = attempts.history()
        if history.begun and history.last is None and not ledger.owner_alive():
            # Nobody wrote how it ended: its supervisor is gone, too.
            attempts.end(history.begun, unheard(history.where))
        return history.begun + 1

    def _settle(self, run: Run, ended: Ended | None) -> None:
        self._live.pop(run.key, None)
        attempt, ledger = self._attempt.pop(run.key, 0), self._grid.ledger(run)
        if ended is None:
            self._elsewhere[run.key] = run
            return
        if ended.cause is None:
            self._note_done(run)
            log.info("%s: done", run.title)
            return
        history = Attempts(ledger).history()
        if not history.tells_end_of(attempt) and not is_done(run, ledger):
            log.warning("%s: %s, and no record of it: %s", run.title, ended.cause.in_words, ended.detail)
            self._overview.message = f"{run.title}: {ended.detail}"
            self._overview.failed += 1
            self._overview.leave_out(run)
            self._unrecorded[run.key] = ended.detail
            return
        again = may_retry(ended.cause, history.ends, self._manifest.retry)
        log.warning("%s: %s%s: %s", run.title, ended.cause.in_words, ", trying again" if again else "", ended.detail)
        self._overview.message = f"{run.title}: {ended.cause.in_words}"
        delay = min(_MAX_DELAY, _FIRST_DELAY * 2 ** max(0, history.ends.get(ended.cause, 0) - 1))
        self._enqueue(run, 0.0 if self._has_got_on(run) else delay)

    def _note_done(self, run: Run) -> None:
        self._overview.done += 1
        self._overview.leave_out(run)

    def _has_got_on(self, run: Run) -> bool:
        """Whether its last attempt has committed anything: then it is not the run that makes its attempts fail."""
        with contextlib.suppress(LedgerError):
            return self._grid.ledger(run).status().steps > self._steps.get(run.key, 0)
        return False

    def _asked_to_stop(self) -> str | None:
        return STOP_ASKED if self._grid.stop_file.exists() else self._stop_requested()

    def _wind_up(self, reason: str) -> None:
        log.warning("stopping: %s", reason)
        self._executor.stop()
        while self._live:
            for run, _ in self._executor.poll():
                self._live.pop(run.key, None)
            self._show()
            self._executor.wait(_TICK_SECONDS)
        raise Interrupted(
            f"stopped ({reason}); what ran has made a checkpoint, and the same command goes on from there"
        )

    def _show(self) -> None:
        overview = self._overview
        overview.running = list(self._live.values())
        overview.waiting = len(self._interrupted) + len(self._fresh) + len(self._elsewhere)
        self._observe(overview)


@contextlib.contextmanager
def working_on(
    grid: Grid, manifest: Manifest, *, wait: bool, stop: StopRequests, say: Callable[[str], None]
) -> Iterator[None]:
    """Be the only one who works on the grid, once whoever does so now is gone, and keep MLflow's mirror meanwhile.

    `say` hears why it takes time, of a mirror that could not be brought up to date, and of its page. Raises
    Interrupted if asked to stop while waiting, RunLockedError at once if not to `wait`, LedgerError if the folder
    cannot be written.
    """
    pusher = None
    try:
        with owning(grid, wait=wait, stop_requested=stop.reason, say=say) as waited:
            # Whoever works on the whole grid means it, but for who asks this process.
            if waited and grid.stop_file.exists():  # it asked whom this one waited for
                grid.stop_file.unlink(missing_ok=True)
            elif stop.sweep(grid.stop_file):
                say(f"{grid.stop_file} is from before this began: it asked somebody else, and was removed")
            if manifest.tracking.anywhere:
                pusher = Pusher(manifest.tracking, grid.folder, grid.tracking_log)
            yield
    finally:  # the lock is released, by which the pusher knows that it may end
        if pusher is not None:
            with stop.nothing_left(NO_LONGER) as left:
                if not pusher.is_soon_over():
                    say(f"mirroring to {pusher.where}, for {_FINAL_PUSH_SECONDS:.0f} s at most")
                if warning := pusher.warning(_FINAL_PUSH_SECONDS, "grid", left):
                    say(f"warning: {warning}")
            for page in pusher.pages():
                say(f"{LOOK_AT}{page}")


@contextlib.contextmanager
def owning(
    grid: Grid, *, wait: bool, stop_requested: Callable[[], str | None], say: Callable[[str], None]
) -> Iterator[bool]:
    """Be the only one who may change the grid's folder, once whoever does so now is gone. Raises as `working_on`.

    Yields whether there was anybody to wait for.
    """
    lock, waited = _acquired(grid, wait, stop_requested, say)
    try:
        yield waited
    finally:
        lock.release()


def _acquired(
    grid: Grid, wait: bool, stop_requested: Callable[[], str | None], say: Callable[[str], None]
) -> tuple[Lock, bool]:  # fmt: skip
    lock, said = Lock(grid.lock_file), False
    while True:
        try:
            lock.acquire()
        except RunLockedError as error:
            if not wait:
                raise
            if not said:
                say(f"{error}. This process takes over then.")
                said = True
            if reason := stop_requested():
                raise Interrupted(f"stopped while waiting ({reason})") from None
            time.sleep(_ELSEWHERE_SECONDS)
        except OSError as error:
            raise LedgerError(f"cannot write the grid's folder {grid.folder}: {in_words(error)}") from None
        else:
            return lock, said
