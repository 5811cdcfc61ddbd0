"""A grid into MLflow: one parent run that explains the grid and shows its results, one child for each run begun.

What is here is read from the grid's files. Looking at a grid again costs two `stat` calls a run, and reads what has
changed; MLflow is asked nothing while nothing changes.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from space_dist.errors import LedgerError
from space_dist.experiment.endings import Cause, Evidence, why_ended
from space_dist.experiment.manifest import Cell, Grid, Manifest, Run
from space_dist.experiment.status import Attempts, History, RunStatus, run_status_of
from space_dist.ledger import METRICS, Ledger, Row, Status, decode_row
from space_dist.system.provenance import code_digest
from space_dist.tracking.snapshot import (
    MAX_TAG,
    NOTE_TAG,
    STARTED_TAG,
    Part,
    Snapshot,
    as_params,
    key_of,
    read_snapshot,
)
from space_dist.tracking.store import GRID_TAG, Child, Parent, RefusedError, Store, TrackingError

log = logging.getLogger("space_dist.tracking")

NONE: Final = "none"  # a tag's value where there is no such thing: tags of an earlier attempt must not stay
_OWN_FAULTS: Final = (Cause.CONFIG_ERROR, Cause.OUT_OF_MEMORY, Cause.CRASH)  # the others were ended from outside
_SHOWN_FAILURES, _SHOWN_VALUES = 5, 12
_TAIL_BYTES: Final = 64 << 10

_Signature = tuple[Any, ...]


@dataclass(frozen=True)
class Look:
    """What a run's files say at one time.

    files: as long as it stays, nothing but a process's death can have changed. signed_at: when its last attempt began
    or ended. final: mean undiscounted return on the test instances at the end of a done run; None
    where it has none.
    """

    files: tuple[_Signature, ...]
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


class GridMirror:
    """One grid on its way into one store.

    begun: runs that have begun. failed: by folder, runs that could not be mirrored, and why. saw_life: whether a run
    was alive at the last look.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.failed: dict[Path, str] = {}
        self._manifest: Manifest | None = None
        self._manifest_signature: _Signature = ()
        self._runs: list[tuple[Run, str, str]] = []  # with the files that tell whether something happened
        self._looks: dict[str, Look] = {}
        self._pending: dict[str, Run] = {}
        self._parent_id: str | None = None
        self._children: dict[str, Child] = {}
        self._behind = True  # the parent

    @property
    def begun(self) -> int:
        return sum(look.begun for look in self._looks.values())

    @property
    def changed(self) -> bool:
        """Whether there may be anything to push."""
        return self._behind or bool(self._pending)

    @property
    def saw_life(self) -> bool:
        return any(look.running for look in self._looks.values())

    def any_alive(self) -> bool:
        """Whether a run that was alive at the last look still is."""
        manifest, running = self._manifest, [look for look in self._looks.values() if look.running]
        return manifest is not None and any(
            _look(look.run_status.run, look.run_status.ledger, manifest, look.files).running for look in running
        )

    def look(self) -> Manifest:
        """Read what has changed. Raises LedgerError if the grid itself cannot be read."""
        signature = _signature(str(self.grid.manifest_file))
        if self._manifest is None or signature != self._manifest_signature:
            self._manifest, self._manifest_signature = self.grid.manifest(), signature
            ledgers = [(run, self.grid.ledger(run)) for run in self._manifest.runs()]
            self._runs = [(run, str(one.status_file), str(Attempts(one).path)) for run, one in ledgers]
            self._looks, self._pending, self._parent_id = {}, {}, None
        for run, status, attempts in self._runs:
            known = self._looks.get(run.key)
            files = (_signature(status), _signature(attempts)[:2])  # whose time is a heartbeat
            if known is not None and known.files == files and not known.running:
                continue
            look = _look(run, self.grid.ledger(run), self._manifest, files)
            if known is None or known.news != look.news:
                self._behind = True
                if look.begun:
                    self._pending[run.key] = run
            self._looks[run.key] = look
        return self._manifest

    def push(self, manifest: Manifest, store: Store, experiment: str) -> tuple[int, int]:
        """(children created, rows pushed) to bring the store up to the last look.

        Raises TrackingError if it cannot be reached, RefusedError if it does not take the grid itself.
        """
        try:
            with store.exclusively(self.grid.tracking_lock):
                return self._push(manifest, store, experiment)
        except TrackingError:
            self._take_nothing_for_granted()  # who knows what was lost
            raise

    def _take_nothing_for_granted(self) -> None:
        self._parent_id, self._behind = None, True
        self._pending = {run.key: run for run, *_ in self._runs if self._looks[run.key].begun}

    def _push(self, manifest: Manifest, store: Store, experiment: str) -> tuple[int, int]:
        key = key_of("grid", str(self.grid.folder.resolve()), manifest.name)
        created = rows = 0
        parent_id = store.find_parent(key, experiment)
        if parent_id is None:
            parent_id = store.create_parent(self._parent(manifest, key), experiment)
        listed = parent_id != self._parent_id
        if listed:
            self._take_nothing_for_granted()
            self._children, self._parent_id = store.children(experiment, key), parent_id
            self.failed = {}
        for run in list(self._pending.values()):
            ledger = self.grid.ledger(run)
            part = self._part(manifest, run, key, parent_id)
            child = self._children.get(part.key)
            if child is None or (child.stamp, child.ending) != (part.stamp, part.ending):
                try:
                    run_id, new, pushed = store.push(
                        self._snapshot(run, part), experiment, child.run_id if child else None, known_new=listed
                    )
                except (LedgerError, RefusedError) as error:
                    self.failed[ledger.folder] = str(error)
                    del self._pending[run.key]
                    continue
                self._children[part.key] = Child(run_id, part.stamp, part.ending)
                created, rows = created + new, rows + pushed
            self.failed.pop(ledger.folder, None)
            del self._pending[run.key]
        if self._behind:  # after the children: the grid is not finished before they are
            store.push_parent(self._parent(manifest, key), parent_id)
            self._behind = False
        return created, rows

    def _snapshot(self, run: Run, part: Part) -> Snapshot:
        look, ledger = self._looks[run.key], self.grid.ledger(run)
        if look.fault is not None:
            raise LedgerError(look.fault)
        if look.status is not None:
            from space_dist.report import read_config  # here: it imports Matplotlib, which takes long

            return read_snapshot(ledger, look.status, look.running, read_config(ledger), part)
        # It ended, or has not got, before the first row: what is known comes from the grid.
        status = Status(
            "running" if look.running else "failed", str(run.cell.config["name"]), run.seed, 0, run.cell.budget_steps,
            0, look.started_at, look.ended_at, message=look.run_status.detail or None,
        )  # fmt: skip
        config = {key: value for key, value in run.cell.config.items() if key != "instances"}
        note = f"**{run.cell.label}**, seed {run.seed}: nothing trained yet\n\n{part.remark}"
        return Snapshot(ledger, status, look.running, {**config, "seed": run.seed}, (), (), note, part, started=False)

    def _part(self, manifest: Manifest, run: Run, grid_key: str, parent_id: str) -> Part:
        look, cell = self._looks[run.key], run.cell
        run_status, code = look.run_status, (look.status.fingerprint.get("code") if look.status is not None else None)
        # The commit is that of the code that froze the grid: it says nothing of a run by other code.
        git = manifest.git if code in (None, manifest.code) else {}
        tags = {
            "mlflow.parentRunId": parent_id,
            GRID_TAG: grid_key,
            "space_dist.grid": manifest.name,
            "space_dist.cell": cell.id,
            "space_dist.cell_label": cell.label,
            "space_dist.curriculum": str(cell.config["curriculum"]["kind"]),
            "space_dist.attempts": str(run_status.attempts),
            "space_dist.condition": run_status.condition,
            "space_dist.cause": run_status.cause or NONE,
            "space_dist.detail": run_status.detail or NONE,
            "space_dist.job": str(look.history.where.get("job") or NONE),
            "space_dist.code": code or NONE,
            "space_dist.git_commit": git.get("git_commit", NONE),
            "space_dist.git_dirty": git.get("git_dirty", NONE),
            **_settings(cell),
        }
        if look.status is None:
            tags[STARTED_TAG] = NONE
        tags = {key: value[:MAX_TAG] for key, value in tags.items()}
        stamp = key_of(repr(sorted(tags.items())), repr(look.status), look.ending)
        return Part(
            key_of(grid_key, cell.id, str(run.seed)), run.title, _remark(look), tags, look.ending, look.ended_at, stamp,
            shows_episodes=run.seed == manifest.seeds[0],
        )  # fmt: skip

    def _parent(self, manifest: Manifest, key: str) -> Parent:
        looks = [self._looks[run.key] for run, *_ in self._runs]
        counts = Counter(look.run_status.condition for look in looks)
        ending = "FAILED" if counts["failed"] else "FINISHED"
        if counts["running"] or counts["waiting"]:
            ending = "RUNNING"
        begun = [look for look in looks if look.begun]
        frozen = self._manifest_signature[2] / 1e9
        note, table = describe(self.grid, manifest, looks)
        tags = {
            "space_dist.name": manifest.name,
            "space_dist.folder": str(self.grid.folder),
            "space_dist.runs": str(len(looks)),
            **{f"space_dist.{condition}": str(counts[condition]) for condition in _CONDITIONS},
            "space_dist.code": manifest.code,
            "space_dist.git_commit": manifest.git.get("git_commit", NONE),
            "space_dist.git_dirty": manifest.git.get("git_dirty", NONE),
            NOTE_TAG: note,
        }
        return Parent(
            key, manifest.name, {key: value[:MAX_TAG] for key, value in tags.items()}, table, ending,
            min((look.started_at for look in begun), default=frozen),
            max((look.ended_at for look in begun), default=frozen),
        )  # fmt: skip


_CONDITIONS: Final = ("done", "running", "waiting", "failed")


# ---- a run's files --------------------------------------------------------------------------------------------------


def _signature(path: str) -> _Signature:
    """Changes with every atomic replacement (inode, time) and every append (size); empty where there is no file."""
    try:
        found = os.stat(path)  # noqa: PTH116 - this is done 20,000 times
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


def _look(run: Run, ledger: Ledger, manifest: Manifest, files: tuple[_Signature, ...]) -> Look:
    if not any(files):
        waiting = RunStatus(run, ledger, "waiting", 0, run.cell.budget_steps, 0)
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
        run_status = RunStatus(run, ledger, "failed", 0, run.cell.budget_steps, 0, ended.cause, ended.detail)
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


# ---- what people read -----------------------------------------------------------------------------------------------


def _settings(cell: Cell) -> dict[str, str]:
    """`setting.<config key>` of everything in which cells differ."""
    return as_params(cell.settings, "setting.")


def describe(grid: Grid, manifest: Manifest, looks: Sequence[Look]) -> tuple[str, str | None]:
    """(Markdown that fits into a description: the plan, where it stands, the results; the results if cut, else None).

    looks: in the order of `manifest.runs()`.
    """
    plan = _plan(grid, manifest)
    status_lines = _status_lines(looks)
    head, *rows = _results(manifest, looks)
    whole = "\n".join([*plan, "", *status_lines, "", head, *rows])
    if len(whole) <= MAX_TAG:
        return whole, None
    shown, kept = [*plan, "", *status_lines, "", head], 0
    room = MAX_TAG - 100 - len("\n".join(shown))
    for row in rows:
        room -= len(row) + 1
        if room < 0:
            break
        shown.append(row)
        kept += 1
    shown += ["", f"{len(rows) - kept} more cells are in results.md, among this run's artifacts."]
    return "\n".join(shown), "\n".join([f"# {manifest.name}", "", head, *rows, ""])


def _plan(grid: Grid, manifest: Manifest) -> list[str]:
    cells, seeds, resources = manifest.cells, manifest.seeds, manifest.resources
    budgets = [cell.budget_steps for cell in cells]
    each = f"{budgets[0]:,}" if len({*budgets}) == 1 else f"{min(budgets):,} to {max(budgets):,}"
    lines = [
        f"**{_cell_text(manifest.name)}**: {_count(len(cells), 'cell')} × {_count(len(seeds), 'seed')} = "
        f"{_count(len(cells) * len(seeds), 'run')} of {each} environment steps, {sum(budgets) * len(seeds):,} in all",
        "",
    ]
    if manifest.axes:
        lines += ["| varied | values |", "|---|---|"]
        for axis in manifest.axes:
            values = list(dict.fromkeys(_word(cell.settings[axis]) for cell in cells))
            more = f", … ({len(values)} in all)" if len(values) > _SHOWN_VALUES else ""
            shown = ", ".join(f"`{_cell_text(value[:80])}`" for value in values[:_SHOWN_VALUES])
            lines.append(f"| {_cell_text(axis)} | {shown}{more} |")
        lines.append("")
    consecutive = len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))
    named = f"{seeds[0]} to {seeds[-1]}" if consecutive else ", ".join(map(str, seeds[:50]))
    limits = [f"{_count(manifest.cpus_per_run, 'CPU')} ({_count(resources.workers, 'rollout actor')})"]
    limits += [f"{resources.memory_mb:,} MB"] if resources.memory_mb is not None else []
    limits += [f"{resources.minutes:g} minutes an attempt"] if resources.minutes is not None else []
    commit = manifest.git.get("git_commit")
    edited = ", edited since" if manifest.git.get("git_dirty") == "true" else ""
    return [
        *lines,
        f"- seeds {named}{', …' if not consecutive and len(seeds) > 50 else ''}",
        f"- each run may use {', '.join(limits)}",
        f"- code `{manifest.code}`" + (f", git commit `{commit}`{edited}" if commit else ""),
        f"- folder `{grid.folder}`",
    ]


def _status_lines(looks: Sequence[Look]) -> list[str]:
    counts = Counter(look.run_status.condition for look in looks)
    failed = [look.run_status for look in looks if look.run_status.condition == "failed"]
    words = [f"{counts[name]} {name}" for name in _CONDITIONS if counts[name] and name != "failed"]
    words += [f"{len(failed)} failed ({_by_cause(failed)})"] if failed else []
    lines = [f"**{len(looks)} runs**: {', '.join(words)}"]
    if any(look.run_status.other_code for look in looks):
        count = sum(look.run_status.other_code for look in looks)
        lines += ["", f"{count} of the done were computed by another version of this package than this table."]
    if failed:
        lines.append("")
        for one in failed[:_SHOWN_FAILURES]:
            first = one.detail.splitlines()[0][:160] if one.detail else ""
            lines.append(f"- {one.run.title}: {one.cause.in_words if one.cause else 'failed'}. {_cell_text(first)}")
        if len(failed) > _SHOWN_FAILURES:
            lines.append(f"- and {len(failed) - _SHOWN_FAILURES} more")
    return lines


def _results(manifest: Manifest, looks: Sequence[Look]) -> list[str]:
    """The table's head, and a row for each cell."""
    from space_dist.report import interquartile_mean

    by_cell: dict[str, list[Look]] = {cell.id: [] for cell in manifest.cells}
    for look in looks:
        by_cell[look.run_status.run.cell.id].append(look)
    rows = [
        "Final return on the test instances, over the seeds that are done:\n\n"
        "| cell | id | IQM | mean | least | greatest | seeds done | failed |\n|---|---|---:|---:|---:|---:|---:|---|"
    ]
    for cell in manifest.cells:
        group = by_cell[cell.id]
        done = [look for look in group if look.run_status.condition == "done"]
        finals = np.array([math.nan if look.final is None else look.final for look in done], dtype=np.float64)
        numbers = ["—"] * 4
        if len(finals):
            numbers = [f"{x:.4g}" for x in (interquartile_mean(finals), finals.mean(), finals.min(), finals.max())]
        name = _cell_text(cell.label) + (" (baseline)" if cell.id == manifest.baseline else "")
        failed = [look.run_status for look in group if look.run_status.condition == "failed"]
        rows.append(
            f"| {name} | `{cell.id}` | {' | '.join(numbers)} | {len(done)}/{len(group)} | {_by_cause(failed)} |"
        )
    return rows


def _by_cause(failed: Sequence[RunStatus]) -> str:
    causes = Counter(one.cause.in_words if one.cause else "unknown" for one in failed)
    return ", ".join(f"{count} {cause}" for cause, count in causes.most_common())


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _word(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{key.rpartition('.')[2]}={text}" for key, text in as_params(value).items())
    return as_params({"value": value})["value"]


def _cell_text(text: str) -> str:
    """Text that stays in its place of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def _remark(look: Look) -> str:
    """Where a run stands in its grid, and what is known of the end of its last attempt."""
    one = look.run_status
    lines = [f"In its grid: {one.in_words}, after {_count(one.attempts, 'attempt')}"]
    if one.detail:
        lines += ["", *(f"    {line}" for line in one.detail[:2000].splitlines())]
    return "\n".join(lines)
