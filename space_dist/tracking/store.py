"""One record into one MLflow store: the calls that bring there what a run, a cell or a grid is.

`space_dist.rows` says how many rows of a record are there. That tag is written after the rows it counts: what dies in
between pushes some points again, and MLflow keeps a point of the same (key, time, step, value) once. Which rows they
are is written before them, into `space_dist.points`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shlex
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from space_dist.config.tracking_uri import UriError, checked_uri
from space_dist.errors import ConfigError, LedgerError, SpaceDistError
from space_dist.ledger import METRICS
from space_dist.system.extras import needed_from
from space_dist.system.files import in_words, locked
from space_dist.system.workplace import absolute_uri
from space_dist.tracking.drawing import draw
from space_dist.tracking.snapshot import Record, Snapshot, key_of

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric
    from mlflow.entities import Run as MlflowRun

RUN_TAG: Final = "space_dist.run"
ROWS_TAG: Final = "space_dist.rows"
INTENT_TAG: Final = "space_dist.points"
PARENT_TAG: Final = "mlflow.parentRunId"
PLAN_TAG: Final = "space_dist.plan"
FILES_TAG: Final = "space_dist.files"
REPORT_TAG: Final = "space_dist.report"
ARTIFACTS_TAG: Final = "space_dist.artifacts"
GRID_TAG: Final = "space_dist.grid_key"
STAMP_TAG: Final = "space_dist.stamp"
TABLE_TAG: Final = "space_dist.results"

# By which MLflow tells an experiment's kind. From 3.10 on its pages ask the browser first, whose own choice is language
# models until somebody makes another one: the addresses that we show make it.
_EXPERIMENT_KIND: Final = ("mlflow.experimentKind", "custom_model_development")
_MAX_METRICS, _MAX_PARAMS, _MAX_TAGS = 1000, 100, 100  # a call of log_batch; mlflow/utils/validation.py
_PAGE: Final = 200  # runs with all their data in one answer
_DATABASE_WAIT_SECONDS: Final = 20.0
_TURN_SECONDS: Final = 600.0  # a grid of thousands of runs takes minutes
# MLflow's own defaults print a line a run and call home.
_ENVIRONMENT: Final = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}


class TrackingError(SpaceDistError):
    """MLflow cannot be reached or does not take what it is sent. The ledgers are untouched."""


@dataclass(frozen=True)
class Child:
    """What is known of a grid's run in MLflow."""

    run_id: str
    stamp: str
    ending: str
    parent: str | None


@dataclass(frozen=True)
class Parent:
    """A grid as a run of its own.

    key: `(32 hex digits)` by which it is found. tags: its description among them. params: the plan; MLflow takes no
    change of a parameter, so another plan is another run. metrics: numbers of now. files: which belong beside it.
    table: results that are too long for the description, in Markdown. report: writes the grid's report into a folder;
    None while it may not be made. report_stamp: changes whenever that report would. Times are seconds since the epoch.
    """

    key: str
    name: str
    tags: Mapping[str, str]
    params: Mapping[str, str]
    metrics: Mapping[str, float]
    files: Sequence[Path]
    table: str | None
    report: Callable[[Path], object] | None
    report_stamp: str
    ending: str
    started_at: float
    ended_at: float

    @property
    def plan(self) -> str:
        """`(32 hex digits)` of its parameters."""
        return key_of(repr(sorted(self.params.items())))


class RefusedError(Exception):
    """MLflow was reached and does not take this one run's content."""


class Store:
    """One MLflow store. Methods raise TrackingError if it cannot be reached, RefusedError for one bad run."""

    def __init__(self, uri: str) -> None:
        self._uri = uri
        self._experiments: dict[str, str] = {}
        self._artifact_location: str | None = None  # the server's choice
        if uri.startswith("sqlite:"):
            database = _database(uri)
            # MLflow's own choice is `./mlruns`, wherever the process happens to stand.
            self._artifact_location = (database.parent / "mlartifacts").as_uri()
            self._client = _open_database(uri, database)
        else:
            self._client = _new_client(uri)

    @contextlib.contextmanager
    def exclusively(self, lock_file: Path | None = None) -> Iterator[None]:
        """Be the only one that pushes: into an SQLite store, and of all who take `lock_file`. Waits for others.

        Whoever dies lets go at once. What is found or not found meanwhile stays so.
        """
        with contextlib.ExitStack() as held:
            if lock_file is not None:
                held.enter_context(_locked(lock_file))
            if self._uri.startswith("sqlite:"):
                database = _database(self._uri)
                held.enter_context(_locked(database.parent / f".{database.name}.pusher"))
            yield

    def push(
        self, record: Record, experiment: str, run_id: str | None = None, *, known_new: bool = False,
        parent: str | None = None,
    ) -> tuple[str, bool, int]:  # fmt: skip
        """(id of the run there, whether it is new, rows pushed).

        run_id: what it was when last seen. known_new: it need not be searched for. parent: id of the run it belongs to.
        """
        with store_errors(self._uri):
            tags = {**record.tags, **({} if parent is None else {PARENT_TAG: parent})}
            run, created = self._find_or_create(record, tags, self._experiment_id(experiment), run_id, known_new)
            self._push_params(run, record.params)
            pushed = self._push_rows(run, record)
            self._push_tags(run, tags)
            # After rows and tags: a run that looks finished has all its numbers.
            self._push_ending(run, record.mlflow_status, record.ended_at)
            if isinstance(record, Snapshot) and record.started:
                self._push_artifacts(run, record)
            if record.stamp and run.data.tags.get(STAMP_TAG) != record.stamp:
                self._client.set_tag(run.info.run_id, STAMP_TAG, record.stamp)  # last: all else is there
            return str(run.info.run_id), created, pushed

    def adopt(self, run_ids: Iterable[str], parent: str) -> None:
        """Have runs belong to another one."""
        with store_errors(self._uri):
            for run_id in run_ids:
                self._client.set_tag(run_id, PARENT_TAG, parent)

    def page(self, experiment: str) -> str:
        """Where people look at an experiment's runs, in words."""
        with store_errors(self._uri):
            place = f"/#/experiments/{self._experiment_id(experiment)}/runs?workflowType=machine_learning"
        if self._uri.startswith("sqlite:"):
            serve = shlex.join(["mlflow", "ui", "--backend-store-uri", self._uri])
            return f"http://127.0.0.1:5000{place} once `{serve}` runs"
        return f"{self._uri}{place}"

    def children(self, experiment: str, grid_key: str) -> dict[str, Child]:
        """The runs of a grid that are there, by their key. Takes milliseconds for each, so it is asked once."""
        found: dict[str, Child] = {}
        with store_errors(self._uri):
            experiment_id, page = self._experiment_id(experiment), None
            while True:
                runs = self._client.search_runs(
                    [experiment_id], f"tags.`{GRID_TAG}` = '{grid_key}'", max_results=_PAGE, page_token=page
                )
                for run in runs:
                    tags = run.data.tags
                    child = Child(
                        str(run.info.run_id), tags.get(STAMP_TAG, ""), str(run.info.status), tags.get(PARENT_TAG)
                    )
                    key = tags.get(RUN_TAG, "")
                    # Two may have been made by pushers that did not see each other: all take the same one.
                    found[key] = min(child, found.get(key, child), key=lambda one: one.run_id)
                page = runs.token
                if not page:
                    return found

    def find_parent(self, parent: Parent, experiment: str) -> str | None:
        """The id of a grid's own run, if it is there; one of another plan goes into MLflow's trash."""
        with store_errors(self._uri):
            found = self._client.search_runs([self._experiment_id(experiment)], f"tags.`{RUN_TAG}` = '{parent.key}'")
            for run in found:
                if run.data.tags.get(PLAN_TAG) != parent.plan:
                    # MLflow changes no parameter: another plan needs another run.
                    self._client.delete_run(run.info.run_id)
            return min(
                (str(run.info.run_id) for run in found if run.data.tags.get(PLAN_TAG) == parent.plan), default=None
            )

    def create_parent(self, parent: Parent, experiment: str) -> str:
        """The id of a grid's own run, which is not there yet."""
        with store_errors(self._uri):
            run = self._client.create_run(
                self._experiment_id(experiment), start_time=round(parent.started_at * 1000),
                tags={RUN_TAG: parent.key, PLAN_TAG: parent.plan, **parent.tags}, run_name=parent.name,
            )  # fmt: skip
            return str(run.info.run_id)

    def push_parent(self, parent: Parent, run_id: str) -> None:
        """Bring a grid's own run up to date."""
        with store_errors(self._uri):
            run = self._client.get_run(run_id)
            self._push_params(run, parent.params)
            self._push_numbers(run, parent.metrics)
            self._push_tags(run, parent.tags)
            self._push_files(run, parent)
            self._push_ending(run, parent.ending, parent.ended_at)

    def _experiment_id(self, name: str) -> str:
        from mlflow.exceptions import MlflowException

        if name in self._experiments:
            return self._experiments[name]
        found = self._client.get_experiment_by_name(name)
        if found is None:
            try:
                identity = self._client.create_experiment(
                    name, artifact_location=self._artifact_location, tags=dict([_EXPERIMENT_KIND])
                )
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
            if _EXPERIMENT_KIND[0] not in found.tags:
                self._client.set_experiment_tag(identity, *_EXPERIMENT_KIND)
        self._experiments[name] = identity
        return identity

    def _find_or_create(
        self, record: Record, tags: Mapping[str, str], experiment_id: str, run_id: str | None, known_new: bool
    ) -> tuple[MlflowRun, bool]:
        found = [] if run_id is None else [self._client.get_run(run_id)]
        found = [run for run in found if run.info.lifecycle_stage == "active"]
        if not found and not known_new:
            found = self._client.search_runs([experiment_id], f"tags.`{RUN_TAG}` = '{record.key}'")
        if found:
            run = min(found, key=lambda run: str(run.info.run_id))
            noted = run.data.tags.get(INTENT_TAG)
            if noted is None or record.continues(noted):
                return run, False
            self._client.delete_run(run.info.run_id)  # into MLflow's trash; points cannot be taken back singly
        run = self._client.create_run(
            experiment_id, start_time=round(record.started_at * 1000), tags={RUN_TAG: record.key, **tags},
            run_name=record.title,
        )  # fmt: skip
        return run, True

    def _push_params(self, run: MlflowRun, params: Mapping[str, str]) -> None:
        """Those that are not there yet: a param never changes, and a batch that was cut off is completed."""
        from mlflow.entities import Param

        missing = [Param(key, value) for key, value in params.items() if key not in run.data.params]
        for start in range(0, len(missing), _MAX_PARAMS):
            self._client.log_batch(run.info.run_id, params=missing[start : start + _MAX_PARAMS])

    def _push_rows(self, run: MlflowRun, record: Record) -> int:
        from mlflow.entities import Metric, RunTag

        there = _whole_number(run.data.tags.get(ROWS_TAG, "0"))
        batch: list[Metric] = []

        def send(rows: int) -> None:
            # Two calls: within one, MLflow promises no order between metrics and tags.
            self._client.log_batch(run.info.run_id, metrics=batch)
            self._client.log_batch(run.info.run_id, tags=[RunTag(ROWS_TAG, str(rows))])
            batch.clear()

        complete = there
        for complete, point in record.points(there):
            if not batch and run.data.tags.get(INTENT_TAG) != record.intent:
                self._client.set_tag(run.info.run_id, INTENT_TAG, record.intent)
                run.data.tags[INTENT_TAG] = record.intent
            batch.append(Metric(point.name, point.value, point.milliseconds, point.step))
            if len(batch) == _MAX_METRICS:
                send(complete)
        if batch:
            send(complete)
        return complete - there

    def _push_numbers(self, run: MlflowRun, numbers: Mapping[str, float]) -> None:
        """Numbers of now that are not there: MLflow shows the latest."""
        from mlflow.entities import Metric

        # The time of now and not of a run: MLflow takes the point of the latest time for the latest value.
        now = round(time.time() * 1000)
        changed = [Metric(key, value, now, 0) for key, value in numbers.items() if run.data.metrics.get(key) != value]
        for start in range(0, len(changed), _MAX_METRICS):
            self._client.log_batch(run.info.run_id, metrics=changed[start : start + _MAX_METRICS])

    def _push_files(self, run: MlflowRun, parent: Parent) -> None:
        """Files, tables and the report of a grid, each when it has changed."""
        run_id, tags = run.info.run_id, run.data.tags
        if tags.get(FILES_TAG) != parent.plan:
            for file in parent.files:
                self._client.log_artifact(run_id, str(file))
            self._client.set_tag(run_id, FILES_TAG, parent.plan)
        table = key_of(parent.table or "")
        if parent.table is not None and tags.get(TABLE_TAG) != table:
            self._client.log_text(run_id, parent.table, "results.md")
            self._client.set_tag(run_id, TABLE_TAG, table)
        if parent.report is not None and tags.get(REPORT_TAG) != parent.report_stamp:
            with tempfile.TemporaryDirectory() as folder:
                parent.report(Path(folder))
                self._client.log_artifacts(run_id, folder)
            self._client.set_tag(run_id, REPORT_TAG, parent.report_stamp)

    def _push_artifacts(self, run: MlflowRun, snapshot: Snapshot) -> None:
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
                episodes = snapshot.part is None or snapshot.part.shows_episodes
                for figure in draw(ledger, Path(folder), episodes=episodes):
                    self._client.log_artifact(run.info.run_id, str(figure), "figures")
        for file in files:
            ledger.read(file)  # is it what the run wrote?
            self._client.log_artifact(run.info.run_id, str(file))
        self._client.set_tag(run.info.run_id, ARTIFACTS_TAG, wanted)

    def _push_tags(self, run: MlflowRun, tags: Mapping[str, str]) -> None:
        """After the rows: nothing may look finished before its numbers are there."""
        from mlflow.entities import RunTag

        changed = [RunTag(key, value) for key, value in tags.items() if run.data.tags.get(key) != value]
        for start in range(0, len(changed), _MAX_TAGS):
            self._client.log_batch(run.info.run_id, tags=changed[start : start + _MAX_TAGS])

    def _push_ending(self, run: MlflowRun, wanted: str, ended_at: float) -> None:
        end = round(ended_at * 1000)
        if wanted == "RUNNING":
            if run.info.status != wanted:
                self._client.update_run(run.info.run_id, status=wanted)
        elif (run.info.status, run.info.end_time) != (wanted, end):
            self._client.set_terminated(run.info.run_id, wanted, end_time=end)


def _whole_number(text: str) -> int:
    """A tag that people can edit; anything but a count means that nothing is known to be there."""
    return int(text) if re.fullmatch(r"[0-9]{1,15}", text) else 0


def usable_uri(uri: str) -> str:
    """The URI, with an absolute path if it is SQLite's. Raises ConfigError for a store that is not mirrored to."""
    try:
        return str(absolute_uri(checked_uri(uri)))
    except UriError as error:
        raise ConfigError(str(error)) from None


def ask(uri: str) -> None:
    """Raises TrackingError unless MLflow itself answers at a server's URI."""
    with store_errors(uri):
        _new_client(uri).search_experiments(max_results=1)


def _database(uri: str) -> Path:
    return Path(uri.removeprefix("sqlite:///"))


def _new_client(uri: str) -> MlflowClient:
    from mlflow import MlflowClient

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("urllib3.connectionpool").setLevel(logging.ERROR)  # a line a retry; we say it once
    return MlflowClient(tracking_uri=uri, registry_uri=uri)


def _open_database(uri: str, database: Path) -> MlflowClient:
    """A client whose tables exist. Creating them is no transaction: two pushers at once would break each other."""
    database.parent.mkdir(parents=True, exist_ok=True)
    with _locked(database.parent / f".{database.name}.lock"):
        # MLflow would try for minutes to open a file that it can never write to.
        with contextlib.closing(sqlite3.connect(database, timeout=_DATABASE_WAIT_SECONDS)) as connection:
            # Takes the write lock, which opening a file does not: a read-only one is told here.
            connection.execute("BEGIN IMMEDIATE")
            connection.rollback()
        client = _new_client(uri)
        # The first question creates the tables.
        client.get_experiment_by_name("Default")
    return client


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a file's lock, which the system takes back from whoever dies. Raises TrackingError if it cannot be had."""
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(path, _TURN_SECONDS))
        except OSError as error:
            raise TrackingError(f"cannot lock {path}, by which pushers take turns: {in_words(error)}") from None
        yield


@contextlib.contextmanager
def store_errors(uri: str) -> Iterator[None]:
    """Run MLflow, and say what went wrong in our words.

    Raises TrackingError and RefusedError; ConfigError where MLflow is not installed.
    """
    from space_dist.tracking import answers  # here: it imports requests

    for name, value in {**_ENVIRONMENT, **answers.ENVIRONMENT}.items():
        os.environ.setdefault(name, value)  # MLflow reads some of them when it is imported: next
    with needed_from("mlflow", "the mirror in MLflow", "use tracking.uri=null"):
        from mlflow.exceptions import MlflowException
    import requests
    from sqlalchemy.exc import SQLAlchemyError

    answers.bound_answers()
    try:
        yield
    except MlflowException as error:
        if error.error_code in ("INVALID_PARAMETER_VALUE", "BAD_REQUEST"):
            raise RefusedError(f"MLflow at {uri} refuses it: {_first_line(error)}") from error
        raise _unreachable(uri, error) from error
    except (SQLAlchemyError, sqlite3.Error, requests.RequestException, OSError) as error:
        raise _unreachable(uri, error) from error


def _unreachable(uri: str, error: Exception) -> TrackingError:
    return TrackingError(
        f"MLflow at {uri} cannot be written to: {_of_network(error) or _first_line(error)}. Nothing is lost: the "
        "ledgers are complete, and `space-dist sync` replays them once it works again; with --uri URI, elsewhere"
    )


def _of_network(error: BaseException | None) -> str:
    """Why no answer came, as the system puts it (`Connection refused`); empty for anything else.

    MLflow's own sentence begins with what was asked of whom, twice, and is cut before it comes to that.
    """
    from requests import RequestException

    requested, cause = False, ""
    while error is not None:
        requested = requested or isinstance(error, RequestException)
        if isinstance(error, TimeoutError) or (isinstance(error, OSError) and error.strerror):
            cause = error.strerror or str(error)  # that of a socket is "timed out", without a number
        error = error.__cause__ or error.__context__
    return cause if requested else ""


def _first_line(error: Exception) -> str:
    text = str(error).strip() or type(error).__name__
    line = text.splitlines()[0]
    return f"{line[:200]}…" if len(line) > 200 else line.rstrip(".")
