"""Dashboards as mirrors: committed rows of ledgers are replayed. The only importer of MLflow.

    experiment -> one run for each run outside grids
               -> one parent run for each grid -> one for each cell -> one for each of its runs that has begun

Every one is found by its tag `space_dist.run` before it is created, and pushing twice changes nothing: whatever MLflow
loses or misses is pushed again from the ledgers. Other sinks (`sinks`) are fed by the same replay.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any, Final

from space_dist.config.sections import SINKS
from space_dist.config.tracking_uri import settled_uri
from space_dist.errors import LedgerError, NotPlannedError
from space_dist.experiment.manifest import CELL_ID_DIGITS, MANIFEST, Grid
from space_dist.ledger import Ledger, Status, there
from space_dist.tracking.grids import GridMirror
from space_dist.tracking.sinks import Sink, sink_of
from space_dist.tracking.snapshot import NOTE_TAG, read_snapshot
from space_dist.tracking.store import (
    GRID_TAG,
    ROWS_TAG,
    RUN_TAG,
    RefusedError,
    Store,
    TrackingError,
    store_errors,
    usable_uri,
)

__all__ = [
    "GRID_TAG", "NOTE_TAG", "ROWS_TAG", "RUN_TAG", "Found", "SyncResult", "TrackingError", "find", "follow", "sync",
]  # fmt: skip

log = logging.getLogger(__name__)

_LOOK_SECONDS: Final = 0.25  # a follower that looks at its files for longer than this does so less often
_STATUS: Final = "status.json"
_CELL: Final = re.compile(rf"[0-9a-f]{{{CELL_ID_DIGITS}}}")


@dataclass(frozen=True)
class SyncResult:
    """What a `sync` did.

    `runs` were brought up to date, `created` of them newly; `rows` of metrics.jsonl were pushed; `skipped` runs are to
    be shown nowhere. A grid's runs that have not begun do not count. `failed` names, by folder, the runs that could not
    be mirrored because their ledger is damaged, MLflow refused their content, or their store could not be reached (and
    others could): whoever calls must show them. `pages` say where to look at what is in MLflow, and in
    other sinks.
    """

    runs: int = 0
    created: int = 0
    rows: int = 0
    skipped: int = 0
    failed: Mapping[Path, str] = dataclass_field(default_factory=dict)
    pages: tuple[str, ...] = ()

    def plus(self, other: SyncResult) -> SyncResult:
        """Both together."""
        return SyncResult(
            self.runs + other.runs, self.created + other.created, self.rows + other.rows, self.skipped + other.skipped,
            {**self.failed, **other.failed}, tuple(dict.fromkeys((*self.pages, *other.pages))),
        )  # fmt: skip


@dataclass(frozen=True)
class Found:
    """Grids, and runs that belong to none."""

    ledgers: tuple[Ledger, ...] = ()
    grids: tuple[Grid, ...] = ()


def find(paths: Iterable[Path]) -> Found:
    """Every run and grid in, below and around `paths`, in order, each once; a grid stands for all its runs.

    Raises NotPlannedError for a path without any.
    """
    ledgers: dict[Path, Ledger] = {}
    grids: dict[Path, Grid] = {}
    for path in map(there, paths):
        before = len(ledgers) + len(grids)
        if around := _grid_around(path.resolve()):
            grids[around] = Grid(around)
            continue
        hit = False
        for folder, below, files in os.walk(path):
            is_grid = MANIFEST in files and Grid(folder).is_own()  # MLflow has copies of manifests, in its own folders
            if is_grid or _STATUS in files:
                below.clear()  # neither holds another one
                hit = True
                where = Path(folder).resolve()
                if is_grid:
                    grids[where] = Grid(folder)
                else:
                    ledgers[where] = Ledger(folder)
        if not hit and len(ledgers) + len(grids) == before:
            raise NotPlannedError(
                f"no run or grid found in {path}: no folder there has a {_STATUS}, or a {MANIFEST} beside instances"
            )
    return Found(tuple(ledgers[key] for key in sorted(ledgers)), tuple(grids[key] for key in sorted(grids)))


def _grid_around(path: Path) -> Path | None:
    """The folder of the grid that a cell's or a run's folder belongs to."""
    for folder in (path, path.parent):
        if _CELL.fullmatch(folder.name) and (folder.parent / MANIFEST).is_file():
            return folder.parent
    return None


def sync(
    ledgers: Sequence[Ledger], uri: str | None = None, experiment: str | None = None, *, grids: Sequence[Grid] = (),
    tell: Callable[[str], None] = lambda what: None,
) -> SyncResult:  # fmt: skip
    """Bring MLflow up to date with the committed rows of the runs and grids. Doing it again changes nothing.

    `uri` and `experiment` default to each run's own (`tracking.uri`, `tracking.experiment` of its config), or to its
    grid's. A run that was deleted in MLflow is replayed afresh. `tell` hears of each run and grid that is begun with.

    Raises ConfigError for a URI or experiment that cannot be used, TrackingError if no store can be reached.
    """
    return _Mirror(uri, experiment, tell).push(Found(tuple(ledgers), tuple(grids)))


def follow(
    root: Path | Sequence[Path],
    uri: str | None = None,
    experiment: str | None = None,
    poll_seconds: float = 5.0,
    *,
    stop: Callable[[], bool] | None = None,
) -> SyncResult:
    """Keep MLflow up to date with all runs and grids in and below `root` until `stop()` is true, then push a last time.

    Without `stop`, that is when nobody works on the grids any more and no run is alive: whoever starts a follower holds
    the grid's or the run's lock by then.

    Runs may appear later. While a store cannot be reached nothing is lost: it is logged once, and once more when it is
    back. Returns the sum of what was done, `failed` as of the last push.

    Raises ConfigError as `sync` does, and TrackingError if the last push fails.
    """
    mirror = _Mirror(uri, experiment)
    roots = [root] if isinstance(root, Path) else list(root)
    total, failed, unreachable = SyncResult(), dict[Path, str](), False
    found = _find_so_far(roots)
    while True:
        last = not mirror.anyone_works(found) if stop is None else stop()
        looked = time.monotonic()
        found = _find_so_far(roots)
        looking = time.monotonic() - looked
        try:
            done = mirror.push(found)
        except TrackingError as error:
            if last:
                raise
            if not unreachable:
                log.warning("%s", error)
            unreachable = True
        else:
            if unreachable:
                log.warning("MLflow can be reached again")
            unreachable = False
            for folder, reason in done.failed.items():
                if failed.get(folder) != reason:
                    log.warning("%s is not mirrored: %s", folder, reason)
            failed = dict(done.failed)
            total = dataclasses.replace(done, created=total.created + done.created, rows=total.rows + done.rows)
            if stop is None and mirror.saw_life:  # it began meanwhile
                last = False
        if last:
            return total
        # So that looking takes a twentieth of its time at most, however many runs there are.
        until = time.monotonic() + poll_seconds * max(1.0, (looking + mirror.looking_seconds) / _LOOK_SECONDS)
        while (left := until - time.monotonic()) > 0:
            if not mirror.anyone_works(found) if stop is None else stop():
                break
            time.sleep(min(left, 0.2))


def _find_so_far(roots: Sequence[Path]) -> Found:
    ledgers: dict[Path, Ledger] = {}
    grids: dict[Path, Grid] = {}
    for root in roots:
        with contextlib.suppress(LedgerError):  # no run there yet
            here = find([root])
            ledgers |= {ledger.folder.resolve(): ledger for ledger in here.ledgers}
            grids |= {grid.folder.resolve(): grid for grid in here.grids}
    return Found(tuple(ledgers.values()), tuple(grids.values()))


class _Mirror:
    """Pushes runs and grids, and remembers what it left up to date: following many costs nothing while they rest.

    saw_life: whether a run was alive when last looked at. looking_seconds: what that took for the grids.
    """

    def __init__(
        self, uri: str | None, experiment: str | None, tell: Callable[[str], None] = lambda what: None
    ) -> None:  # fmt: skip
        self._uri = None if uri is None else usable_uri(uri)
        self._experiment, self._tell = experiment, tell
        self._stores: dict[str, Store] = {}
        self._open_sinks: dict[str, Sink] = {}
        self._settled: dict[Path, tuple[Status, bool]] = {}
        self._grids: dict[Path, GridMirror] = {}
        self._dead: dict[str, str] = {}  # stores that could not be reached in this push, and why
        self._reached = False  # whether another one could
        self.saw_life = False
        self.looking_seconds = 0.0

    def anyone_works(self, found: Found) -> bool:
        """Whether a grid is being worked on, or a run seen alive still is. Costs little, since one is enough."""
        return any(grid.owner_alive() or self._grid(grid).any_alive() for grid in found.grids) or any(
            ledger.owner_alive() for ledger in found.ledgers
        )

    def push(self, found: Found) -> SyncResult:
        """Bring all of it up to date. Raises TrackingError if no store can be reached."""
        self.saw_life, self.looking_seconds = False, 0.0
        self._dead, self._reached = {}, False
        total = self._push_runs(found.ledgers)
        for grid in found.grids:
            try:
                total = total.plus(self._push_grid(grid))
            except TrackingError as error:
                total = total.plus(SyncResult(failed={grid.folder: str(error)}))
        if self._dead and not self._reached:
            raise TrackingError("\n".join(self._dead.values()))
        return total

    @contextlib.contextmanager
    def _reaching(self, uri: str) -> Iterator[None]:
        """Ask a store. One that cannot be reached costs seconds, and is not asked again in this push."""
        if uri in self._dead:
            raise TrackingError(self._dead[uri])
        try:
            yield
        except TrackingError as error:
            self._dead[uri] = str(error)
            raise
        self._reached = True

    def _push_runs(self, ledgers: Sequence[Ledger]) -> SyncResult:
        total = SyncResult()
        for ledger in ledgers:
            try:
                total = total.plus(self._push_run(ledger))
            except (LedgerError, RefusedError, TrackingError, OSError) as error:
                total = total.plus(SyncResult(failed={ledger.folder: str(error)}))
        return total

    def _push_run(self, ledger: Ledger) -> SyncResult:
        status, alive = ledger.status(), ledger.owner_alive()
        self.saw_life |= alive
        if self._settled.get(ledger.folder) == (status, alive):
            return SyncResult(1)
        config = _config(ledger)
        target, sinks = self._target(config, ledger), self._sinks(_tracking(config).get("sinks"))
        if target is None and not sinks:
            return SyncResult(skipped=1)
        snapshot = read_snapshot(ledger, status, alive, config)
        for sink in sinks:
            sink.push(snapshot)
        result = SyncResult(1, pages=_pages_of(sinks, ledger.folder))
        if target is not None:
            self._tell(f"{ledger.folder}: to MLflow at {target[0]}")
            uri, experiment = target
            with self._reaching(uri):
                store = self._store(uri)
                # One writer at a time: SQLite gives up on a second one after its busy timeout.
                with store.exclusively():
                    _, new, pushed = store.push(snapshot, experiment)
                result = SyncResult(1, int(new), pushed, pages=(store.page(experiment), *result.pages))
        # Noted last: what fails on the way is pushed again at the next look.
        self._settled[ledger.folder] = (status, alive)
        return result

    def _push_grid(self, grid: Grid) -> SyncResult:
        mirror, before = self._grid(grid), time.monotonic()
        try:
            manifest = mirror.look()
        except LedgerError as error:
            return SyncResult(failed={grid.folder: str(error)})
        self.looking_seconds += time.monotonic() - before
        self.saw_life |= mirror.saw_life
        sinks = self._sinks(manifest.tracking.sinks)
        if sinks:
            mirror.feed(manifest, sinks)
        places = _pages_of(sinks, grid.folder)
        uri = self._uri if self._uri is not None else settled_uri(manifest.tracking.uri)
        if uri is None:
            n_mirrored = mirror.begun - len(mirror.failed)
            return (
                SyncResult(n_mirrored, failed=mirror.failed, pages=places)
                if sinks
                else SyncResult(skipped=mirror.begun)
            )
        experiment, created, rows = self._experiment or manifest.experiment, 0, 0
        with self._reaching(usable_uri(uri)):
            store = self._store(usable_uri(uri))
            if mirror.changed:
                self._tell(f"{grid.folder}: to MLflow at {usable_uri(uri)}")
                try:
                    created, rows = mirror.push(manifest, store, experiment, self._tell)
                except RefusedError as error:
                    return SyncResult(failed={grid.folder: str(error)})
            pages = (store.page(experiment), *places)
        return SyncResult(mirror.begun - len(mirror.failed), created, rows, 0, mirror.failed, pages)

    def _grid(self, grid: Grid) -> GridMirror:
        return self._grids.setdefault(grid.folder, GridMirror(grid))

    def _target(self, config: Mapping[str, Any], ledger: Ledger) -> tuple[str, str] | None:
        """(URI, experiment) for a run, None if it has no URI."""
        own = _tracking(config)
        uri = self._uri if self._uri is not None else own.get("uri")
        experiment = self._experiment if self._experiment is not None else own.get("experiment")
        if uri is None:
            return None
        if not isinstance(experiment, str):
            raise LedgerError(f"{ledger.config} names no tracking.experiment; give one")
        return usable_uri(str(uri)), experiment

    def _sinks(self, names: Any) -> list[Sink]:
        """Sinks by the names in a run's config, or a grid's manifest."""
        chosen = [name for name in SINKS if isinstance(names, Sequence) and name in names]
        return [self._open_sinks.setdefault(name, sink_of(name)) for name in chosen]

    def _store(self, uri: str) -> Store:
        if uri not in self._stores:
            with store_errors(uri):
                self._stores[uri] = Store(uri)
        return self._stores[uri]


def _pages_of(sinks: Sequence[Sink], root: Path) -> tuple[str, ...]:
    """Where to look at what sinks other than MLflow have of a folder."""
    return tuple(page for sink in sinks if (page := sink.page(root)) is not None)


def _tracking(config: Mapping[str, Any]) -> Mapping[str, Any]:
    found = config.get("tracking")
    return found if isinstance(found, Mapping) else {}


def _config(ledger: Ledger) -> dict[str, Any]:
    from space_dist.report import read_config  # here: it imports Matplotlib, which takes long

    return read_config(ledger)
