"""MLflow as a mirror: committed rows of ledgers are replayed into experiments. The only importer of MLflow.

A run is found by its tag `space_dist.run` before it is created, and `space_dist.synced_rows` says how many rows of
metrics.jsonl are there. That tag is written after the rows it counts: what dies in between pushes some points again,
and MLflow keeps a point of the same (key, time, step, value) once. So pushing twice changes nothing, and whatever
MLflow loses or misses is pushed again from the ledger.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import re
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from space_dist.errors import ConfigError, LedgerError, SpaceDistError
from space_dist.ledger import METRICS, TIMING, Ledger, Row, Status, find_ledgers

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric
    from mlflow.entities import Run as MlflowRun

log = logging.getLogger(__name__)

RUN_TAG: Final = "space_dist.run"
ROWS_TAG: Final = "space_dist.synced_rows"
ARTIFACTS_TAG: Final = "space_dist.artifacts"

_MAX_METRICS, _MAX_PARAMS, _MAX_TAGS = 1000, 100, 100  # a call of log_batch; mlflow/utils/validation.py
_MAX_PARAM, _MAX_TAG, _MAX_KEY = 6000, 5000, 250  # characters
_DATABASE_WAIT_SECONDS: Final = 20.0
_ALLOWED: Final = "allowed are sqlite:////absolute/path/mlflow.db and http(s)://HOST:PORT of an MLflow server"
# MLflow's own defaults wait for a dead server for minutes, print a line a run and call home.
_ENVIRONMENT: Final = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",  # seconds
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
}


class TrackingError(SpaceDistError):
    """MLflow cannot be reached or does not take what it is sent. The ledgers are untouched."""


@dataclass(frozen=True)
class SyncResult:
    """What a `sync` did.

    `runs` were brought up to date, `created` of them newly; `rows` of metrics.jsonl were pushed; `skipped` runs have
    no tracking URI. `failed` names, by folder, the runs that could not be mirrored because their ledger is damaged or
    MLflow refused their content: whoever calls must show them.
    """

    runs: int = 0
    created: int = 0
    rows: int = 0
    skipped: int = 0
    failed: Mapping[Path, str] = dataclass_field(default_factory=dict)


def sync(ledgers: Sequence[Ledger], uri: str | None = None, experiment: str | None = None) -> SyncResult:
    """Bring MLflow up to date with the committed rows of the runs. Doing it again changes nothing.

    `uri` and `experiment` default to each run's own (`tracking.uri`, `tracking.experiment` of its config). A run that
    was deleted in MLflow is replayed afresh.

    Raises ConfigError for a URI or experiment that cannot be used, TrackingError if a store cannot be reached.
    """
    return _Mirror(uri, experiment).push(ledgers)


def follow(
    root: Path | Sequence[Path],
    uri: str | None = None,
    experiment: str | None = None,
    poll_seconds: float = 5.0,
    *,
    stop: Callable[[], bool],
) -> SyncResult:
    """Keep MLflow up to date with all runs in and below `root` until `stop()` is true, then push a last time.

    Runs may appear later. While a store cannot be reached nothing is lost: it is logged once, and once more when it is
    back. Returns the sum of what was done, `failed` as of the last push.

    Raises ConfigError as `sync` does, and TrackingError if the last push fails.
    """
    mirror = _Mirror(uri, experiment)
    roots = [root] if isinstance(root, Path) else list(root)
    total, failed, unreachable = SyncResult(), dict[Path, str](), False
    while True:
        last = stop()
        try:
            done = mirror.push(_find(roots))
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
            total = SyncResult(
                done.runs, total.created + done.created, total.rows + done.rows, done.skipped, done.failed
            )
        if last:
            return total
        until = time.monotonic() + poll_seconds
        while (left := until - time.monotonic()) > 0 and not stop():
            time.sleep(min(left, 0.2))


def _find(roots: Sequence[Path]) -> list[Ledger]:
    found: dict[Path, Ledger] = {}
    for root in roots:
        with contextlib.suppress(LedgerError):  # no run there yet
            found |= {ledger.folder.resolve(): ledger for ledger in find_ledgers([root])}
    return list(found.values())


# ---- a run's side ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Snapshot:
    """What of a run is to be mirrored, read before MLflow is asked anything."""

    ledger: Ledger
    status: Status
    alive: bool
    config: Mapping[str, Any]
    rows: Sequence[Row]
    timing: Sequence[Row]
    note: str  # Markdown: what the run is, where it stands, and how it did

    @property
    def key(self) -> str:
        """`(32 hex digits)`: this run and no other, also when another one starts in its folder."""
        identity = f"{self.ledger.folder.resolve()}\n{self.status.started_at!r}"
        return hashlib.sha256(identity.encode()).hexdigest()[:32]

    @property
    def mlflow_status(self) -> str:
        if self.status.state == "running":
            return "RUNNING" if self.alive else "KILLED"
        return {"done": "FINISHED", "failed": "FAILED", "interrupted": "KILLED"}[self.status.state]


def _read(ledger: Ledger, status: Status, alive: bool, config: Mapping[str, Any]) -> _Snapshot:
    try:
        rows = ledger.rows(METRICS, committed_only=True)
        timing = ledger.rows(TIMING, committed_only=True)  # after the rows: it has one for each of them by now
    except OSError as error:
        raise LedgerError(f"{error.filename} cannot be read: {error.strerror}") from None
    if len(timing) < len(rows):
        raise LedgerError(f"{ledger.folder / TIMING} has {len(timing)} rows where {METRICS} has {len(rows)}")
    try:
        note = _note(ledger, status, config, rows)
    except (KeyError, TypeError, ValueError) as error:
        raise LedgerError(f"{ledger.folder / METRICS} has rows that this version cannot read: {error!r}") from None
    return _Snapshot(ledger, status, alive, config, rows, timing, note)


def _numbers(row: Row) -> Iterator[tuple[str, float]]:
    """(metric name, value) of each number of a row; per-instance lists, nulls and words are none."""
    sections = ("train", "test") if row["kind"] == "evaluation" else ("rollout", "learner", "curriculum")
    for section in sections:
        for name, value in row[section].items():
            if isinstance(value, int | float):
                yield f"{section}/{name}", float(value)
    if row["kind"] == "iteration":
        for name, value in row.items():
            if isinstance(value, int | float) and name not in ("steps", "complete"):
                yield name, float(value)


def _metrics(snapshot: _Snapshot, start: int) -> Iterator[tuple[int, Metric]]:
    """(rows complete once this is pushed, metric) from row `start` on, each row's own time and real step."""
    from mlflow.entities import Metric

    for index in range(start, len(snapshot.rows)):
        row, timing = snapshot.rows[index], snapshot.timing[index]
        try:
            milliseconds, steps, numbers = round(timing["unix_time"] * 1000), int(row["steps"]), list(_numbers(row))
            rate = timing["steps_per_second"]
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise LedgerError(f"{snapshot.ledger.folder / METRICS}, row {index + 1}: {error!r}") from None
        if rate is not None:
            numbers.append(("timing/steps_per_second", float(rate)))
        for position, (name, value) in enumerate(numbers):
            yield index + (position + 1 == len(numbers)), Metric(name, value, milliseconds, steps)


def _flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """`section.key` -> text; lists as JSON."""
    flat: dict[str, str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, default=str)
            flat[f"{prefix}{key}"[:_MAX_KEY]] = text[:_MAX_PARAM]
    return flat


def _tags(snapshot: _Snapshot) -> dict[str, str]:
    status = snapshot.status
    tags = {
        "space_dist.seed": str(status.seed),
        "space_dist.name": status.name,
        "space_dist.state": status.state,
        "space_dist.folder": str(snapshot.ledger.folder),
        "space_dist.fingerprint_changed": str(status.fingerprint_changed).lower(),
        **{f"space_dist.fingerprint.{key}": str(value) for key, value in status.fingerprint.items()},
        "mlflow.note.content": snapshot.note,
    }
    return {key: value[:_MAX_TAG] for key, value in tags.items()}


def _note(ledger: Ledger, status: Status, config: Mapping[str, Any], rows: Sequence[Row]) -> str:
    flat = _flatten(config)
    what = " · ".join(flat[key] for key in ("curriculum.kind", "learner.kind", "env.id") if key in flat)
    lines = [
        f"**{status.name}**, seed {status.seed}: {what}",
        "",
        f"- {status.state}, {status.steps:,} of {status.budget_steps:,} environment steps",
    ]
    if status.message:
        lines.append(f"- {status.message.splitlines()[0][:500]}")
    evaluations = [row for row in rows if row["kind"] == "evaluation"]
    if evaluations:
        last = evaluations[-1]
        when = "at the end" if status.state == "done" else f"at {last['steps']:,} steps"
        lines += [f"- {split} return {when}: {_shown(last[split]['return'])}, success {_shown(last[split]['success'])}"
                  for split in ("test", "train")]  # fmt: skip
    lines.append(f"- folder `{ledger.folder}`")
    return "\n".join(lines)


def _shown(value: float | None) -> str:
    return "—" if value is None else f"{value:.4g}"


# ---- MLflow's side --------------------------------------------------------------------------------------------------


class _Mirror:
    """Pushes runs, and remembers which it left up to date, so that following many costs nothing while they rest."""

    def __init__(self, uri: str | None, experiment: str | None) -> None:
        self._uri = None if uri is None else _checked_uri(uri)
        self._experiment = experiment
        self._stores: dict[str, _Store] = {}
        self._settled: dict[Path, tuple[Status, bool]] = {}

    def push(self, ledgers: Sequence[Ledger]) -> SyncResult:
        runs = created = rows = skipped = 0
        failed: dict[Path, str] = {}
        for ledger in ledgers:
            try:
                status, alive = ledger.status(), ledger.owner_alive()
                if self._settled.get(ledger.folder) == (status, alive):
                    runs += 1
                    continue
                config = _config(ledger)
                target = self._target(config, ledger)
                if target is None:
                    skipped += 1
                    continue
                store, experiment = self._store(target[0]), target[1]
                new, pushed = store.push(_read(ledger, status, alive, config), experiment)
            except (LedgerError, _RefusedError) as error:
                failed[ledger.folder] = str(error)
                continue
            runs, created, rows = runs + 1, created + new, rows + pushed
            self._settled[ledger.folder] = (status, alive)
        return SyncResult(runs, created, rows, skipped, failed)

    def _target(self, config: Mapping[str, Any], ledger: Ledger) -> tuple[str, str] | None:
        """(URI, experiment) for a run, None if it has no URI."""
        tracking = config.get("tracking")
        own: Mapping[str, Any] = tracking if isinstance(tracking, Mapping) else {}
        uri = self._uri if self._uri is not None else own.get("uri")
        experiment = self._experiment if self._experiment is not None else own.get("experiment")
        if uri is None:
            return None
        if not isinstance(experiment, str):
            raise LedgerError(f"{ledger.config} names no tracking.experiment; give one")
        return (uri if self._uri is not None else _checked_uri(str(uri))), experiment

    def _store(self, uri: str) -> _Store:
        if uri not in self._stores:
            with _store_errors(uri):
                self._stores[uri] = _Store(uri)
        return self._stores[uri]


class _RefusedError(Exception):
    """MLflow was reached and does not take this one run's content."""


class _Store:
    """One MLflow store. Methods raise TrackingError if it cannot be reached, _RefusedError for one bad run."""

    def __init__(self, uri: str) -> None:
        self._uri = uri
        self._experiments: dict[str, str] = {}
        self._artifact_location: str | None = None  # the server's choice
        if uri.startswith("sqlite:"):
            database = _database(uri)
            self._artifact_location = (database.parent / "mlartifacts").as_uri()
            self._client = _open_database(uri, database)
        else:
            self._client = _new_client(uri)

    def push(self, snapshot: _Snapshot, experiment: str) -> tuple[bool, int]:
        """(whether the run is new there, rows pushed)."""
        with _store_errors(self._uri):
            run, created = self._find_or_create(snapshot, self._experiment_id(experiment))
            self._push_params(run, snapshot)
            pushed = self._push_rows(run, snapshot)
            self._push_standing(run, snapshot)
            self._push_artifacts(run, snapshot)
            return created, pushed

    def _experiment_id(self, name: str) -> str:
        from mlflow.exceptions import MlflowException

        if name in self._experiments:
            return self._experiments[name]
        found = self._client.get_experiment_by_name(name)
        if found is None:
            try:
                identity = self._client.create_experiment(name, artifact_location=self._artifact_location)
            except MlflowException as error:
                if error.error_code != "RESOURCE_ALREADY_EXISTS":
                    raise
                found = self._client.get_experiment_by_name(name)  # another pusher was faster
                if found is None:
                    raise
        if found is not None:
            if found.lifecycle_stage != "active":
                raise ConfigError(
                    f"the MLflow experiment {name!r} at {self._uri} was deleted; restore it there, or choose another "
                    "name (tracking.experiment)"
                )
            identity = str(found.experiment_id)
        self._experiments[name] = identity
        return identity

    def _find_or_create(self, snapshot: _Snapshot, experiment_id: str) -> tuple[MlflowRun, bool]:
        found = self._client.search_runs([experiment_id], f"tags.`{RUN_TAG}` = '{snapshot.key}'")
        if found:
            return min(found, key=lambda run: str(run.info.run_id)), False
        status = snapshot.status
        run = self._client.create_run(
            experiment_id,
            start_time=round(status.started_at * 1000),
            tags={RUN_TAG: snapshot.key, **_tags(snapshot)},
            run_name=f"{status.name}-s{status.seed}",
        )
        return run, True

    def _push_params(self, run: MlflowRun, snapshot: _Snapshot) -> None:
        """Those that are not there yet: a param never changes, and a batch that was cut off is completed."""
        from mlflow.entities import Param

        missing = [Param(key, value) for key, value in _flatten(snapshot.config).items() if key not in run.data.params]
        for start in range(0, len(missing), _MAX_PARAMS):
            self._client.log_batch(run.info.run_id, params=missing[start : start + _MAX_PARAMS])

    def _push_rows(self, run: MlflowRun, snapshot: _Snapshot) -> int:
        from mlflow.entities import RunTag

        there = _whole_number(run.data.tags.get(ROWS_TAG, "0"))
        batch: list[Metric] = []

        def send(rows: int) -> None:
            # Two calls: within one, MLflow promises no order between metrics and tags.
            self._client.log_batch(run.info.run_id, metrics=batch)
            self._client.log_batch(run.info.run_id, tags=[RunTag(ROWS_TAG, str(rows))])
            batch.clear()

        complete = there
        for complete, metric in _metrics(snapshot, there):
            batch.append(metric)
            if len(batch) == _MAX_METRICS:
                send(complete)
        if batch:
            send(complete)
        return complete - there

    def _push_artifacts(self, run: MlflowRun, snapshot: _Snapshot) -> None:
        """The config at once; all that makes a run reusable and readable when it is done."""
        ledger, before = snapshot.ledger, run.data.tags.get(ARTIFACTS_TAG)
        wanted = "done" if snapshot.status.state == "done" else "config"
        if before in (wanted, "done"):
            return
        files = [ledger.config]
        if wanted == "done":
            files += [ledger.instances("train"), ledger.instances("test"), ledger.model_arrays,
                      ledger.model_description, ledger.folder / METRICS]  # fmt: skip
            files += [ledger.log] if ledger.log.exists() else []
            if missing := [file.name for file in files if not file.exists()]:
                raise LedgerError(f"{ledger.folder} is done but has no {', '.join(missing)}")
            with tempfile.TemporaryDirectory() as folder:
                for figure in _draw(ledger, Path(folder)):
                    self._client.log_artifact(run.info.run_id, str(figure), "figures")
        for file in files:
            self._client.log_artifact(run.info.run_id, str(file))
        self._client.set_tag(run.info.run_id, ARTIFACTS_TAG, wanted)

    def _push_standing(self, run: MlflowRun, snapshot: _Snapshot) -> None:
        """Tags and status, after the rows: nothing may look finished before its numbers are there."""
        from mlflow.entities import RunTag

        changed = [RunTag(key, value) for key, value in _tags(snapshot).items() if run.data.tags.get(key) != value]
        for start in range(0, len(changed), _MAX_TAGS):
            self._client.log_batch(run.info.run_id, tags=changed[start : start + _MAX_TAGS])
        wanted, end = snapshot.mlflow_status, round(snapshot.status.updated_at * 1000)
        if wanted == "RUNNING":
            if run.info.status != wanted:
                self._client.update_run(run.info.run_id, status=wanted)
        elif (run.info.status, run.info.end_time) != (wanted, end):
            self._client.set_terminated(run.info.run_id, wanted, end_time=end)


def _config(ledger: Ledger) -> dict[str, Any]:
    from space_dist.report import read_config  # here: it imports Matplotlib, which takes long

    return read_config(ledger)


def _draw(ledger: Ledger, folder: Path) -> list[Path]:
    """PNGs of a finished run in `folder`."""
    from space_dist.report import draw_curriculum, draw_learning_curve, load_run, save

    run = load_run(ledger)
    figures = {}
    if len(run.evaluation_steps):
        figures["learning_curve.png"] = draw_learning_curve(run)
    if run.trained:
        figures["curriculum.png"] = draw_curriculum(run)
    for name, figure in figures.items():
        save(figure, folder / name)
    return [folder / name for name in figures]


def _whole_number(text: str) -> int:
    """A tag that people can edit; anything but a count means that nothing is known to be there."""
    return int(text) if re.fullmatch(r"[0-9]{1,15}", text) else 0


def _checked_uri(uri: str) -> str:
    """The URI, with an absolute path if it is SQLite's. Raises ConfigError for a store that is not mirrored to."""
    try:
        parts = urlsplit(uri)
        host, has_credentials = parts.hostname, "@" in parts.netloc
    except ValueError:
        raise ConfigError(f"the tracking URI {uri!r} is not a URI; {_ALLOWED}") from None
    if parts.scheme in ("http", "https") and host:
        if has_credentials:
            raise ConfigError(
                f"the tracking URI for {host} contains credentials, which would be stored with every run; give them in "
                "the environment: MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD"
            )
        return uri.rstrip("/")
    if parts.scheme == "sqlite":
        return f"sqlite:///{_database(uri)}"
    if parts.scheme in ("", "file"):
        raise ConfigError(f"the tracking URI {uri!r} is a folder of files, which MLflow no longer supports; {_ALLOWED}")
    raise ConfigError(f"a tracking URI of the kind {parts.scheme}: cannot be mirrored to; {_ALLOWED}")


def _database(uri: str) -> Path:
    name = uri.removeprefix("sqlite:///")
    if name == uri or not name or name == ":memory:" or "?" in name:
        raise ConfigError(f"the tracking URI {uri!r} names no database file; {_ALLOWED}")
    return Path(name).absolute()


def _new_client(uri: str) -> MlflowClient:
    from mlflow import MlflowClient

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("urllib3.connectionpool").setLevel(logging.ERROR)  # a line a retry; we say it once
    return MlflowClient(tracking_uri=uri, registry_uri=uri)


def _open_database(uri: str, database: Path) -> MlflowClient:
    """A client whose tables exist. Creating them is no transaction: two pushers at once would break each other."""
    database.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(database.parent / f".{database.name}.lock", os.O_RDWR | os.O_CREAT, 0o644)
    with os.fdopen(descriptor) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        # MLflow would try for minutes to open a file that it can never write to.
        with contextlib.closing(sqlite3.connect(database, timeout=_DATABASE_WAIT_SECONDS)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.rollback()
        client = _new_client(uri)
        client.get_experiment_by_name("Default")
    return client


@contextlib.contextmanager
def _store_errors(uri: str) -> Iterator[None]:
    """Run MLflow, and say what went wrong in our words. Raises TrackingError and _RefusedError."""
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)  # MLflow reads some of them when it is imported: next
    import requests
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except MlflowException as error:
        if error.error_code in ("INVALID_PARAMETER_VALUE", "BAD_REQUEST"):
            raise _RefusedError(f"MLflow at {uri} refuses it: {_first_line(error)}") from error
        raise _unreachable(uri, error) from error
    except (SQLAlchemyError, sqlite3.Error, requests.RequestException, OSError) as error:
        raise _unreachable(uri, error) from error


def _unreachable(uri: str, error: Exception) -> TrackingError:
    return TrackingError(
        f"MLflow at {uri} cannot be written to: {_first_line(error)}. Nothing is lost: the ledgers are complete, and "
        "`space-dist sync` replays them once it works again"
    )


def _first_line(error: Exception) -> str:
    text = str(error).strip() or type(error).__name__
    line = text.splitlines()[0]
    return f"{line[:200]}…" if len(line) > 200 else line.rstrip(".")
