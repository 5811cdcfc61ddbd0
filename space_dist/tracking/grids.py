"""A grid on three levels: the grid itself, a curve for each of its cells, and the cell's runs that have begun.

What is here is read from the grid's files. Looking at a grid again costs two `stat` calls a run, and reads what has
changed; MLflow is asked nothing while nothing changes.
"""

from __future__ import annotations

import logging
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from space_dist.errors import LedgerError, SpaceDistError
from space_dist.experiment.manifest import Cell, Grid, Manifest, Run
from space_dist.experiment.status import Attempts
from space_dist.ledger import METRICS, Status
from space_dist.tracking.cells import CellCurve, Evaluations, curve, read_evaluations
from space_dist.tracking.describing import CONDITIONS, describe, describe_cell, remark
from space_dist.tracking.looking import Look, Signature, look_at, signature
from space_dist.tracking.sinks import Sink
from space_dist.tracking.snapshot import (
    LEVEL_TAG,
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
_REPORT_SECONDS: Final = 600.0  # between reports of a grid at work: one of thousands of runs takes a while
_MAX_NUMBERS: Final = 100  # cells whose final numbers the parent shows as metrics; all are in its cells.csv
_MAX_LISTED: Final = 5000  # characters


class GridMirror:
    """One grid on its way into one MLflow store, and into sinks.

    begun: runs that have begun. failed: by folder, what could not be mirrored, and why. saw_life: whether a run was
    alive at the last look.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.failed: dict[Path, str] = {}
        self._manifest: Manifest | None = None
        self._manifest_signature: Signature = ()
        self._runs: list[tuple[Run, str, str]] = []  # with the files that tell whether something happened
        self._looks: dict[str, Look] = {}
        self._evaluations: dict[
            str, tuple[tuple[float, int], Evaluations]
        ] = {}  # with what tells whether they are more
        self._pending: dict[str, Run] = {}
        self._pending_cells: dict[str, Cell] = {}
        self._unfed: dict[str, Run] = {}  # to the sinks
        self._parent_id: str | None = None
        self._children: dict[str, Child] = {}  # of the cells, and theirs
        self._behind = True  # the parent
        self._reported = -_REPORT_SECONDS  # when, on the monotonic clock

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
            look_at(look.run_status.run, look.run_status.ledger, manifest, look.files).running for look in running
        )

    def look(self) -> Manifest:
        """Read what has changed. Raises LedgerError if the grid itself cannot be read."""
        found = signature(str(self.grid.manifest_file))
        if self._manifest is None or found != self._manifest_signature:
            self._manifest, self._manifest_signature = self.grid.manifest(), found
            ledgers = [(run, self.grid.ledger(run)) for run in self._manifest.runs()]
            self._runs = [(run, str(one.status_file), str(Attempts(one).path)) for run, one in ledgers]
            # Another plan may have other cells, and gets another parent.
            self._looks, self._pending, self._pending_cells, self._unfed, self._parent_id = {}, {}, {}, {}, None
        for run, status, attempts in self._runs:
            known = self._looks.get(run.key)
            files = (signature(status), signature(attempts)[:2])  # whose time is a heartbeat
            if known is not None and known.files == files and not known.running:
                continue
            look = look_at(run, self.grid.ledger(run), self._manifest, files)
            self._looks[run.key] = look
            if known is None or known.news != look.news:
                self._behind = True
                if look.begun:
                    self._pending[run.key] = self._unfed[run.key] = run
                    self._pending_cells[run.cell.id] = run.cell
        return self._manifest

    def feed(self, manifest: Manifest, sinks: Sequence[Sink]) -> None:
        """Bring all sinks up to the last look."""
        unfed, self._unfed = self._unfed, {}
        key = self._key(manifest)
        for run in unfed.values():
            folder = self.grid.ledger(run).folder
            try:
                snapshot = self._snapshot(run, self._part(manifest, run, key))
                for sink in sinks:
                    sink.push(snapshot)
            except (LedgerError, OSError) as error:
                self.failed[folder] = str(error)
        for cell in {run.cell.id: run.cell for run in unfed.values()}.values():
            try:
                record = self._curve(manifest, cell, key)
                for sink in sinks:
                    sink.push(record)
            except OSError as error:
                self.failed[self.grid.folder / cell.id] = str(error)

    def push(
        self, manifest: Manifest, store: Store, experiment: str, tell: Callable[[str], None] = lambda what: None
    ) -> tuple[int, int]:  # fmt: skip
        """(runs of the grid that are new there, rows of theirs pushed) to bring the store up to the last look.

        `tell` hears of each run before it is pushed.

        Raises TrackingError if it cannot be reached, RefusedError if it does not take the grid itself.
        """
        try:
            with store.exclusively(self.grid.tracking_lock):
                return self._push(manifest, store, experiment, tell)
        except TrackingError:
            self._take_nothing_for_granted()  # who knows what was lost
            raise

    def _take_nothing_for_granted(self) -> None:
        self._parent_id, self._behind = None, True
        self._pending = {run.key: run for run, *_ in self._runs if self._looks[run.key].begun}
        self._pending_cells = {run.cell.id: run.cell for run in self._pending.values()}

    def _push(
        self, manifest: Manifest, store: Store, experiment: str, tell: Callable[[str], None]
    ) -> tuple[int, int]:  # fmt: skip
        created = rows = 0
        parent = self._parent(manifest)
        parent_id = store.find_parent(parent, experiment)
        if parent_id is None:
            parent_id = store.create_parent(parent, experiment)
        listed = parent_id != self._parent_id
        if listed:
            self._take_nothing_for_granted()
            self._children, self._parent_id = store.children(experiment, parent.key), parent_id
            self.failed = {}
        for cell in list(self._pending_cells.values()):
            self._push_cell(manifest, cell, store, experiment, listed=listed)
            del self._pending_cells[cell.id]
        for run in list(self._pending.values()):
            ledger = self.grid.ledger(run)
            part = self._part(manifest, run, parent.key)
            child, above = self._children.get(part.key), self._children.get(self._cell_key(parent.key, run.cell))
            owner = parent_id if above is None else above.run_id
            # The stamp is the last thing that a push writes: who has it has everything, and MLflow is asked nothing.
            if child is None or (child.stamp, child.ending, child.parent) != (part.stamp, part.ending, owner):
                tell(f"{manifest.name}: {run.title}")
                try:
                    run_id, new, pushed = store.push(
                        self._snapshot(run, part), experiment, child.run_id if child else None,
                        known_new=listed, parent=owner,
                    )  # fmt: skip
                except (LedgerError, RefusedError) as error:
                    self.failed[ledger.folder] = str(error)
                    del self._pending[run.key]
                    continue
                self._children[part.key] = Child(run_id, part.stamp, part.ending, owner)
                created, rows = created + new, rows + pushed
            self.failed.pop(ledger.folder, None)
            del self._pending[run.key]
        if self._behind:  # after the children: the grid is not finished before they are
            store.push_parent(self._parent(manifest), parent_id)
            self._behind = False
        return created, rows

    def _push_cell(self, manifest: Manifest, cell: Cell, store: Store, experiment: str, *, listed: bool) -> None:
        """The run of a cell; where it had to begin anew, the cell's runs become its."""
        key = self._key(manifest)
        record, folder = self._curve(manifest, cell, key), self.grid.folder / cell.id
        child = self._children.get(record.key)
        now = (record.stamp, record.mlflow_status, self._parent_id)
        if child is None or (child.stamp, child.ending, child.parent) != now:
            try:
                run_id, *_ = store.push(
                    record, experiment, child.run_id if child else None, known_new=listed, parent=self._parent_id
                )
            except RefusedError as error:
                self.failed[folder] = str(error)
                return
            child = self._children[record.key] = Child(run_id, record.stamp, record.mlflow_status, self._parent_id)
        self.failed.pop(folder, None)
        keys = [self._run_key(key, Run(cell, seed)) for seed in manifest.seeds_of(cell)]
        # Their old parent is in MLflow's trash.
        strays = {one: found for one in keys if (found := self._children.get(one)) and found.parent != child.run_id}
        store.adopt([stray.run_id for stray in strays.values()], child.run_id)
        for one, stray in strays.items():
            self._children[one] = Child(stray.run_id, stray.stamp, stray.ending, child.run_id)

    def _key(self, manifest: Manifest) -> str:
        return key_of("grid", str(self.grid.folder.resolve()), manifest.name)

    @staticmethod
    def _cell_key(grid_key: str, cell: Cell) -> str:
        return key_of(grid_key, cell.id)

    @staticmethod
    def _run_key(grid_key: str, run: Run) -> str:
        return key_of(grid_key, run.cell.id, str(run.seed))

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

    def _part(self, manifest: Manifest, run: Run, grid_key: str) -> Part:
        look, cell = self._looks[run.key], run.cell
        run_status, code = look.run_status, (look.status.fingerprint.get("code") if look.status is not None else None)
        # The commit is that of the code that froze the grid: it says nothing of a run by other code.
        git = manifest.git if code in (None, manifest.code) else {}
        tags = {
            **_of_cell(manifest, cell, grid_key),
            "space_dist.attempts": str(run_status.attempts),
            "space_dist.condition": run_status.condition,
            "space_dist.cause": run_status.cause or NONE,
            "space_dist.detail": run_status.detail or NONE,
            "space_dist.job": str(look.history.where.get("job") or NONE),
            "space_dist.code": code or NONE,
            "space_dist.git_commit": git.get("git_commit", NONE),
            "space_dist.git_dirty": git.get("git_dirty", NONE),
        }
        if look.status is None:
            tags[STARTED_TAG] = NONE
        tags = {key: value[:MAX_TAG] for key, value in tags.items()}
        stamp = key_of(repr(sorted(tags.items())), repr(look.status), look.ending)
        return Part(
            self._run_key(grid_key, run), run.title, remark(look), self.grid.folder, f"{_place(cell)}/s{run.seed}",
            cell.label, tags, look.ending, look.ended_at, stamp,
            # A search has many settings that nobody keeps: drawing them all takes longer than training them.
            shows_episodes=run.seed == manifest.seeds[0] and manifest.search is None,
        )  # fmt: skip

    def _curve(self, manifest: Manifest, cell: Cell, grid_key: str) -> CellCurve:
        """A cell of which a run has begun."""
        looks = [self._looks[Run(cell, seed).key] for seed in manifest.seeds_of(cell)]
        begun = [look for look in looks if look.begun]
        ending, counts = _ending(looks)
        tags = {
            **_of_cell(manifest, cell, grid_key),
            LEVEL_TAG: "cell",
            "space_dist.folder": str(self.grid.folder / cell.id),
            **{f"space_dist.{condition}": str(counts[condition]) for condition in CONDITIONS},
            NOTE_TAG: describe_cell(cell, looks),
        }
        tags = {key: value[:MAX_TAG] for key, value in tags.items()}
        groups = [[self._evaluated(look) for look in looks if look.run_status.condition in which]
                  for which in (("done",), ("running", "waiting"))]  # fmt: skip
        rows = curve(*groups)
        config = {key: value for key, value in cell.config.items() if key != "instances"}
        made = CellCurve(
            self._cell_key(grid_key, cell), cell.label, self.grid.folder, f"{_place(cell)}/iqm", cell.label,
            as_params(config), tags, ending, min(look.started_at for look in begun),
            max(look.ended_at for look in begun), "", rows,
        )  # fmt: skip
        return made.stamped(key_of(repr(sorted(tags.items())), made.intent, ending))

    def _evaluated(self, look: Look) -> Evaluations:
        """A run's evaluations, read when there may be more of them; none where they cannot be read."""
        if look.status is None or look.fault is not None:
            return Evaluations.none()
        run, size = look.run_status.run, (look.status.started_at, look.status.committed.get(METRICS, 0))
        known = self._evaluations.get(run.key)
        if known is None or known[0] != size:
            try:
                found = read_evaluations(self.grid.ledger(run))
            except LedgerError:  # which is told of the run itself
                return Evaluations.none()
            known = self._evaluations[run.key] = (size, found)
        return known[1]

    def _parent(self, manifest: Manifest) -> Parent:
        looks = [self._looks[run.key] for run, *_ in self._runs]
        ending, counts = _ending(looks)
        begun = [look for look in looks if look.begun]
        frozen = self._manifest_signature[2] / 1e9
        note, table = describe(self.grid, manifest, looks)
        tags = {
            LEVEL_TAG: "grid",
            "space_dist.name": manifest.name,
            "space_dist.folder": str(self.grid.folder),
            "space_dist.runs": str(len(looks)),
            **{f"space_dist.{condition}": str(counts[condition]) for condition in CONDITIONS},
            "space_dist.code": manifest.code,
            "space_dist.git_commit": manifest.git.get("git_commit", NONE),
            "space_dist.git_dirty": manifest.git.get("git_dirty", NONE),
            NOTE_TAG: note,
        }
        return Parent(
            self._key(manifest), manifest.name, {key: value[:MAX_TAG] for key, value in tags.items()},
            _plan_params(manifest), _final_numbers(manifest, looks), (self.grid.manifest_file,), table,
            self._report(manifest) if counts["done"] else None,
            key_of(repr([(look.run_status.condition, look.final) for look in looks])), ending,
            min((look.started_at for look in begun), default=frozen),
            max((look.ended_at for look in begun), default=frozen),
        )  # fmt: skip

    def _report(self, manifest: Manifest) -> Callable[[Path], None] | None:
        """What writes the grid's report into a folder; None while the grid is at work and has a recent one."""
        if self.saw_life and time.monotonic() - self._reported < _REPORT_SECONDS:
            return None

        def write(folder: Path) -> None:
            from space_dist import report  # here: it imports Matplotlib, which takes long

            # Before it is made: one that cannot be made is not tried at every look.
            self._reported = time.monotonic()
            try:
                if manifest.search is None:
                    report.build_grid_report(self.grid, folder, in_depth=False)  # it is made again and again
                else:
                    from space_dist.report.search_report import build_search_report  # here: it imports Optuna

                    build_search_report(self.grid, folder)
            except SpaceDistError as error:
                log.warning("%s: its report was not made: %s", self.grid.folder, error)

        return write


def _ending(looks: Sequence[Look]) -> tuple[str, Counter[str]]:
    """How runs stand together, in MLflow's words, and how many of them in which condition."""
    counts = Counter[str](look.run_status.condition for look in looks)
    if counts["running"] or counts["waiting"]:
        return "RUNNING", counts
    return ("FAILED" if counts["failed"] else "FINISHED"), counts


def _of_cell(manifest: Manifest, cell: Cell, grid_key: str) -> dict[str, str]:
    """Tags of a cell and of its runs."""
    return {
        GRID_TAG: grid_key,
        "space_dist.grid": manifest.name,
        "space_dist.cell": cell.id,
        "space_dist.cell_label": cell.label,
        "space_dist.curriculum": str(cell.config["curriculum"]["kind"]),
        **_settings(cell),
    }


def _place(cell: Cell) -> str:
    """A cell's folder among those of a sink: its label, as far as that is plain."""
    # A label is people's own words: in a path, `..` or a slash would lead elsewhere.
    plain = re.sub(r"[^A-Za-z0-9=_,. -]", "_", cell.label).strip(". ")
    return plain if plain and plain == cell.label else f"{plain} {cell.id}".strip()


def _plan_params(manifest: Manifest) -> dict[str, str]:
    """The plan: how many cells and seeds, what is varied, and what all cells have in common.

    Of a search, which has more cells with every generation: what does not change, for another plan is another run.
    """
    if manifest.search is not None:
        config = manifest.search.config
        searched = {f"search.{arm}.{key}": str({name: value for name, value in one.items() if value})
                    for arm, record in manifest.search.arms.items() for key, one in record.space.items()}  # fmt: skip
        return {
            "arms": ", ".join(manifest.search.arms), "trials": str(config["trials"]), "seeds": str(len(manifest.seeds)),
            "seed_list": ", ".join(map(str, manifest.seeds))[:_MAX_LISTED], "objective": config["objective"]["kind"],
            "sampler": config["sampler"]["kind"], **searched,
        }  # fmt: skip
    each = [as_params({key: value for key, value in cell.config.items() if key not in ("instances", "name")})
            for cell in manifest.cells]  # fmt: skip
    common = {key: value for key, value in each[0].items() if all(one.get(key) == value for one in each[1:])}
    varied: dict[str, dict[str, None]] = {}
    for cell in manifest.cells:
        for key, value in _settings(cell).items():
            varied.setdefault(key.replace("setting.", "varied.", 1), {})[value] = None
    return {
        "cells": str(len(manifest.cells)), "seeds": str(len(manifest.seeds)),
        "seed_list": ", ".join(map(str, manifest.seeds))[:_MAX_LISTED],
        **common, **{key: ", ".join(values)[:_MAX_LISTED] for key, values in varied.items()},
    }  # fmt: skip


def _final_numbers(manifest: Manifest, looks: Sequence[Look]) -> dict[str, float]:
    """`test/return_iqm LABEL`, `_low` and `_high`: final returns on the test instances over a cell's finished seeds."""
    from space_dist.report.statistics import intervals

    finals: dict[str, list[float]] = {cell.id: [] for cell in manifest.cells[:_MAX_NUMBERS]}
    for look in looks:
        if look.final is not None and look.run_status.run.cell.id in finals:
            finals[look.run_status.run.cell.id].append(look.final)
    numbers: dict[str, float] = {}
    found = intervals([np.array(values, dtype=np.float64) for values in finals.values()], "iqm")
    for cell, interval in zip(manifest.cells, found, strict=False):
        name = re.sub(r"[^A-Za-z0-9_. -]", "_", cell.label.replace("=", " "))
        for end, value in (("iqm", interval.value), ("low", interval.low), ("high", interval.high)):
            if value is not None and np.isfinite(value):
                numbers[f"test/return_{end} {name}"] = float(value)
    return numbers


def _settings(cell: Cell) -> dict[str, str]:
    """`setting.<config key>` of everything in which cells differ."""
    return as_params(cell.settings, "setting.")
