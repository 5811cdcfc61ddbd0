"""Where every run of a grid stands, from its own files alone: any terminal, today or tomorrow, sees the same.

Beside a run's ledger lies `attempts.jsonl`: a row when an attempt begins, one when it has ended and why, one when a
user asks for another try. Whoever supervises the run writes them. One that dies leaves a beginning without an end.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from space_dist.errors import LedgerError
from space_dist.experiment.endings import Busy, Cause, Ended, Evidence, why_ended
from space_dist.experiment.grid_file import Retry
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.ledger import Ledger, Row, believed_alive, decode_row, encode_row, process_of, this_process
from space_dist.system.files import in_words, open_own, read_file

ATTEMPTS = "attempts.jsonl"
MAX_DETAIL = 4000  # characters
_MAX_BYTES = 16 << 20


@dataclass(frozen=True)
class History:
    """The attempts of a run.

    begun: how many began. last: how the last one ended; None if it has not, as far as is known.
    ends: how often each cause ended one, since a user last asked for another try. where: of the last attempt, with its
    supervisor. process: that its supervisor has started for it; empty if that is not known.
    """

    begun: int = 0
    last: Ended | None = None
    ends: Mapping[Cause, int] = field(default_factory=dict)
    where: Mapping[str, Any] = field(default_factory=dict)
    process: Mapping[str, Any] = field(default_factory=dict)

    def tells_end_of(self, attempt: int) -> bool:
        """Whether that attempt is on record, and the end of the last one."""
        return self.begun >= attempt and self.last is not None

    @property
    def abandoned(self) -> bool:
        """Whether its process lives here, and the supervisor does not that would end it."""
        return believed_alive(self.process) and not believed_alive(self.where)


class Attempts:
    """The history of one run: append-only, read whole. A row torn by a kill or a full disk is skipped."""

    def __init__(self, ledger: Ledger) -> None:
        self.path = ledger.folder / ATTEMPTS

    def begin(self, attempt: int, where: Mapping[str, Any]) -> None:
        """Attempt number `attempt` (from 1) begins in this process; `where` adds to what is known of it (a job)."""
        self._append({"event": "begin", "attempt": attempt, "where": {**this_process(), **where}})

    def started(self, pid: int) -> None:
        """The attempt that began last is made by another process of this namespace."""
        self._append({"event": "process", "process": process_of(pid)})

    def end(self, attempt: int, ended: Ended) -> None:
        """It has ended."""
        self._append({"event": "end", "attempt": attempt, "cause": ended.cause, "detail": ended.detail[-MAX_DETAIL:]})

    def sign(self) -> None:
        """A sign of life of the supervisor: the file's time."""
        with contextlib.suppress(OSError):
            os.utime(self.path)

    def forgive(self) -> None:
        """A user asks for another try: earlier ends no longer count."""
        self._append({"event": "retry"})

    def _append(self, row: Row) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(open_own(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT), "a+b") as file:
                line = encode_row({**row, "unix_time": time.time()})
                size = file.seek(0, os.SEEK_END)
                if size:
                    file.seek(size - 1)
                    if file.read(1) != b"\n":  # what was torn stays a line of its own
                        line = b"\n" + line
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise LedgerError(f"cannot write {self.path}: {in_words(error)}") from None

    def rows(self) -> list[Row]:
        """Every intact row."""
        try:
            content = read_file(self.path, _MAX_BYTES)
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise LedgerError(f"{self.path} cannot be read: {error.strerror}") from None
        return [row for line in content.splitlines(keepends=True) if (row := decode_row(line)) is not None]

    def last_sign(self) -> float:
        """When a supervisor last gave one, in seconds since the epoch."""
        with contextlib.suppress(OSError):
            return self.path.stat().st_mtime
        return 0.0

    def begun_at(self) -> list[float]:
        """When each attempt began, in seconds since the epoch."""
        return [float(row["unix_time"]) for row in self.rows() if row.get("event") == "begin"]

    def history(self) -> History:
        """What the rows say."""
        begun, last, where, process = 0, None, dict[str, Any](), dict[str, Any]()
        ends: Counter[Cause] = Counter()
        for row in self.rows():
            with contextlib.suppress(KeyError, ValueError, TypeError):  # rows of a later version
                if row["event"] == "begin":
                    begun, last, process = max(begun, int(row["attempt"])), None, {}
                    where = {**row["where"], "heartbeat": max(row["unix_time"], self.last_sign())}
                elif row["event"] == "end":
                    begun = max(begun, int(row["attempt"]))
                    last = Ended(None if row["cause"] is None else Cause(row["cause"]), str(row["detail"]))
                    if last.cause is not None:
                        ends[last.cause] += 1
                elif row["event"] == "process":
                    process = dict(row["process"])
                elif row["event"] == "retry":
                    ends.clear()
                    last = Ended(None)
        return History(begun, last, ends, where, process)


def slurm_job() -> dict[str, Any]:
    """The SLURM job this process is part of, and how often it was requeued before; nothing outside of SLURM."""
    job, restarts = os.environ.get("SLURM_JOB_ID"), os.environ.get("SLURM_RESTART_COUNT", "0")
    return {} if job is None else {"slurm_job": job, "restarts": int(restarts) if restarts.isdecimal() else 0}


def unheard(where: Mapping[str, Any]) -> Ended:
    """How an attempt ended that nobody has written the end of; `where` is its own."""
    here = slurm_job()
    same = bool(here) and where.get("slurm_job") == here["slurm_job"]
    return why_ended(Evidence(requeued=same and where.get("restarts", 0) < here["restarts"]))


Condition = Literal["done", "running", "waiting", "failed"]


@dataclass(frozen=True)
class RunStatus:
    """Where one run stands.

    run: which, as the grid names it: `title`, `seed`, `cell`.  ledger: its folder (`ledger.folder`), which `Run` reads.
    condition: `waiting` runs will be started, or go on, when somebody works on the grid; `failed` ones will not.
    cause, detail: of the last attempt's end, if it has not been done since: a text as `out_of_memory`, and a sentence.
    steps, budget_steps: environment steps, and those that it is to take for now. attempts: how many began.
    other_code: done, but by another version of this package than the one here. end_recorded, supervised: of a run that
    is done, whether the end of its last attempt is written, and whether its supervisor lives that would write it.
    """

    run: Run
    ledger: Ledger
    condition: Condition
    steps: int
    budget_steps: int
    attempts: int
    cause: Cause | None = None
    detail: str = ""
    other_code: bool = False
    fingerprint_changed: bool = False
    end_recorded: bool = True
    supervised: bool = False

    @property
    def way_out(self) -> str:
        """What lets a failed run be tried again."""
        folder = self.ledger.folder
        again = f"`space-dist grid retry {shlex.quote(str(folder.parent.parent))} --cause {self.cause}`"
        if self.cause is Cause.UNREADABLE:
            return f"restore what cannot be read, and {again} lets it go on; or remove {folder}, and it begins anew"
        return f"{again} gives another try"

    @property
    def in_words(self) -> str:
        """`failed: out of memory`, `waiting (preempted)`, ..."""
        if self.cause is None or self.condition in ("done", "running"):
            return self.condition + (" (by other code)" if self.other_code else "")
        return f"{self.condition}: {self.cause.in_words}"


def run_status_of(run: Run, ledger: Ledger, retry: Retry, code: str) -> RunStatus:
    """Where a run stands now. `code` is this package's digest. One that cannot be read is a failed run that says so."""
    history = Attempts(ledger).history()
    budget = run.cell.steps_to_take
    try:
        status = ledger.status() if ledger.status_file.exists() else None
    except LedgerError as error:
        damaged = why_ended(Evidence(damage=str(error)))
        return RunStatus(run, ledger, "failed", 0, budget, history.begun, damaged.cause, damaged.detail)
    steps = status.steps if status is not None else 0
    if status is not None and status.has_reached(run.cell.pause_at):
        return RunStatus(
            run, ledger, "done", steps, budget, history.begun,
            other_code=status.fingerprint.get("code") != code, fingerprint_changed=status.fingerprint_changed,
            end_recorded=history.last is not None or not history.begun, supervised=believed_alive(history.where),
        )  # fmt: skip
    if status is not None and ledger.owner_alive():
        return RunStatus(run, ledger, "running", steps, budget, history.begun)
    last = history.last
    if last is None and history.begun and believed_alive(history.where):  # it loads its libraries
        return RunStatus(run, ledger, "running", steps, budget, history.begun)
    if last is None and history.begun:  # its supervisor is gone, and told nobody why
        last = why_ended(Evidence(began_on=str(history.where.get("host", "an unknown host"))))
    if last is None or last.cause is None:
        return RunStatus(run, ledger, "waiting", steps, budget, history.begun)
    condition: Condition = "waiting" if may_retry(last.cause, history.ends, retry) else "failed"
    return RunStatus(run, ledger, condition, steps, budget, history.begun, last.cause, last.detail)


def is_done(run: Run, ledger: Ledger) -> bool:
    """Whether a run has ended well, or has got as far as it is to get for now."""
    with contextlib.suppress(LedgerError):
        return ledger.status_file.exists() and ledger.status().has_reached(run.cell.pause_at)
    return False


def concluded(run: Run, ledger: Ledger, attempt: int) -> Ended | None:
    """How an attempt ended whose supervisor is gone: as it wrote, or well, if its run is done; None if it was lost.

    The end of a done run whose supervisor was killed before it could write it is written here, once.
    """
    attempts = Attempts(ledger)
    history = attempts.history()
    begun = history.begun >= attempt
    if begun and history.last is not None:
        return history.last
    if not is_done(run, ledger):
        return None
    if begun:
        attempts.end(attempt, Ended(None))
    return Ended(None)


def settled(run: Run, ledger: Ledger, attempt: int, seen: Evidence) -> Ended:
    """How an attempt ended that is over: as `concluded` knows; else by what was seen of it, which is then written."""
    if (known := concluded(run, ledger, attempt)) is not None:
        return known
    ended = why_ended(seen)
    if not isinstance(ended, Busy):
        Attempts(ledger).end(attempt, ended)
    return ended


def may_retry(cause: Cause, ends: Mapping[Cause, int], retry: Retry) -> bool:
    """Whether a run that ended so may be tried again. `ends` counts the ends by cause, this one included if known."""
    if cause is Cause.STOPPED:
        return True
    allowed = {**retry.model_dump(), Cause.CONFIG_ERROR: 0, Cause.UNREADABLE: 0}
    return ends.get(cause, 0) <= int(allowed[cause])


def run_statuses(grid: Grid, manifest: Manifest, code: str, runs: Sequence[Run] | None = None) -> list[RunStatus]:
    """Where every run stands, in the manifest's order (or those of `runs`)."""
    chosen = manifest.runs() if runs is None else runs
    return [run_status_of(run, grid.ledger(run), manifest.retry, code) for run in chosen]


def exit_code(found: Sequence[RunStatus]) -> int:
    """0: all done.  1: some have failed.  3: some are not done yet."""
    conditions = {run_status.condition for run_status in found}
    if "failed" in conditions:
        return 1
    return 3 if conditions - {"done"} else 0


def last_lines(path: Path, count: int = 5, limit: int = 64 << 10) -> list[str]:
    """The last lines of a text file that may be long, missing, or no text at all."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:  # a pipe would have us wait
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - limit))
            text = file.read(limit).decode(errors="replace")
    except OSError:
        return []
    return [line for line in text.splitlines() if line.strip()][-count:]
