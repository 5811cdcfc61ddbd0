"""What a run's files say of it now, as cheaply as can be: a grid's mirror looks at thousands of them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from space_dist.errors import LedgerError
from space_dist.experiment.endings import Cause, Evidence, why_ended
from space_dist.experiment.manifest import Manifest, Run
from space_dist.experiment.status import Attempts, History, RunStatus, run_status_of
from space_dist.ledger import METRICS, Ledger, Row, Status, decode_row
from space_dist.system.provenance import code_digest

# The others were ended from outside.
_OWN_FAULTS: Final = (Cause.CONFIG_ERROR, Cause.OUT_OF_MEMORY, Cause.CRASH, Cause.UNREADABLE)
_TAIL_BYTES: Final = 64 << 10

Signature = tuple[Any, ...]


@dataclass(frozen=True)
class Look:
    """What a run's files say at one time.

    files: as long as it stays, nothing but a process's death can have changed. signed_at: when its last attempt began
    or ended. final: mean undiscounted return on the test instances at the end of a done run; None
    where it has none.
    """

    files: tuple[Signature, ...]
    run_status: RunStatus
    status: Status | None
    history: History
    signed_at: float
    final: float | None
    fault: str | None = None

    @property
    def begun(self) -> bool:
        return self.status is not None or self.history.begun > 0 or self.fault is not None

    @property
    def news(self) -> tuple[Any, ...]:
        """Changes when there is something to push."""
        one = self.run_status
        return (
            one.condition, one.steps, one.attempts, one.cause, one.detail, one.other_code, self.status, self.history,
            self.signed_at, self.final, self.fault,
        )  # fmt: skip

    @property
    def running(self) -> bool:
        return self.run_status.condition == "running"

    @property
    def started_at(self) -> float:
        return self.status.started_at if self.status is not None else self.signed_at

    @property
    def ended_at(self) -> float:
        return self.status.updated_at if self.status is not None else self.signed_at

    @property
    def ending(self) -> str:
        """How the run stands, in MLflow's words."""
        run_status = self.run_status
        if run_status.condition in ("done", "running"):
            return "FINISHED" if run_status.condition == "done" else "RUNNING"
        if run_status.condition == "failed" or run_status.cause in _OWN_FAULTS:
            return "FAILED"
        return "FAILED" if self.status is not None and self.status.state == "failed" else "KILLED"


def signature(path: str) -> Signature:
    """Changes with every atomic replacement (inode, time) and every append (size); empty where there is no file."""
    try:
        found = os.stat(path)  # noqa: PTH116 - this is done 20,000 times
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


def look_at(run: Run, ledger: Ledger, manifest: Manifest, files: tuple[Signature, ...]) -> Look:
    if not any(files):
        waiting = RunStatus(run, ledger, "waiting", 0, run.cell.steps_to_take, 0)
        return Look(files, waiting, None, History(), 0.0, None)
    try:
        attempts = Attempts(ledger)
        rows, history = attempts.rows(), attempts.history()
        signed_at = max((float(row["unix_time"]) for row in rows), default=0.0)
        run_status = run_status_of(run, ledger, manifest.retry, code_digest())
        status = ledger.status() if files[0] else None
        final = final_return(ledger, status) if status is not None and run_status.condition == "done" else None
    except LedgerError as error:
        ended = why_ended(Evidence(damage=str(error)))
        run_status = RunStatus(run, ledger, "failed", 0, run.cell.steps_to_take, 0, ended.cause, ended.detail)
        return Look(files, run_status, None, History(), 0.0, None, fault=str(error))
    # A heartbeat is no news.
    history = dataclasses.replace(history, where={k: v for k, v in history.where.items() if k != "heartbeat"})
    return Look(files, run_status, status, history, signed_at, final)


def final_return(ledger: Ledger, status: Status) -> float | None:
    """A run's final mean undiscounted return on the test instances; None if there is no such number.

    Raises LedgerError if the file cannot be read, or not understood.
    """
    row = last_evaluation(ledger, status)
    try:
        if row is None or not status.is_final(row["steps"]):
            return None
        value = row["test"]["return"]
        return None if value is None else float(value)
    except (KeyError, TypeError, ValueError) as error:
        raise LedgerError(f"{ledger.folder / METRICS} has rows that this version cannot read: {error!r}") from None


def last_evaluation(ledger: Ledger, status: Status) -> Row | None:
    """The row of a run's last committed evaluation, if there is one.

    Reads no more of the file's end than it takes. Raises LedgerError if the file cannot be read, or not understood.
    """
    path = ledger.folder / METRICS
    try:
        for row in _backwards(path, status.committed.get(METRICS, 0)):
            if row["kind"] == "evaluation":
                return row
    except OSError as error:
        raise LedgerError(f"{path} cannot be read: {error.strerror}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise LedgerError(f"{path} has rows that this version cannot read: {error!r}") from None
    return None


def _backwards(path: Path, size: int) -> Iterator[Row]:
    """The intact rows of a file's first `size` bytes, the last one first."""
    if not size:
        return
    rest, position = b"", size
    with path.open("rb") as file:
        while position:
            length = min(_TAIL_BYTES, position)
            position -= length
            file.seek(position)
            lines = (file.read(length) + rest).splitlines(keepends=True)
            rest = b"" if position == 0 else lines.pop(0)  # its beginning may lie further ahead
            for line in reversed(lines):
                if (row := decode_row(line)) is not None:
                    yield row
