"""MLflow as a mirror, on real SQLite stores: everything once, whatever happened in between."""

from __future__ import annotations

import contextlib
import dataclasses
import gzip
import hashlib
import itertools
import logging
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import mlflow
import psutil
import pytest
from mlflow import MlflowClient
from mlflow.entities import Run
from typer.testing import CliRunner

from space_dist.cli import app
from space_dist.config import TrackingConfig
from space_dist.errors import ConfigError
from space_dist.ledger import METRICS, TIMING, Ledger, RunWriter
from space_dist.report import figures
from space_dist.tracking import ROWS_TAG, RUN_TAG, TrackingError, answers, follow, pusher, store, sync
from space_dist.tracking.pusher import ended_within
from tests.patience import PATIENCE
from tests.test_report import GROWTH, STARTED, STEPS, continue_run, finished_run, start_run

TEST = [-10.0, -8.0, -6.0, -4.0, 1.0]


def only_run(uri: str, experiment: str = "tests") -> Run:
    client = MlflowClient(uri)
    found = client.get_experiment_by_name(experiment)
    assert found is not None
    (run,) = client.search_runs([found.experiment_id])
    return run


def histories(uri: str, run: Run) -> dict[str, list[tuple[int, int, float]]]:
    """Every point of every metric: name -> (step, milliseconds, value), sorted."""
    client = MlflowClient(uri)
    return {
        name: sorted((p.step, p.timestamp, p.value) for p in client.get_metric_history(run.info.run_id, name))
        for name in run.data.metrics
    }


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stop_in(last: int, events: Mapping[int, Callable[[], object]]) -> Callable[[], bool]:
    """For `follow`: what happens in some of its rounds, counted from 1, and that it stops in the last one."""
    rounds = itertools.count(1)

    def stop() -> bool:
        now = next(rounds)
        if now in events:
            events[now]()
        return now >= last

    return stop


def test_what_somebody_must_mend_is_passed_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As that MLflow is not installed: the next `space-dist sync` would say no more."""
    script = tmp_path / "pusher.py"
    script.write_text("import sys\nprint('space-dist: first a cable is needed', file=sys.stderr)\nsys.exit(2)\n")
    monkeypatch.setattr(pusher, "PYTHON", (sys.executable, str(script)))
    mirrored = pusher.Pusher(TrackingConfig(uri="http://127.0.0.1:9"), tmp_path, tmp_path / "log.txt")
    said = mirrored.warning(PATIENCE, "run") or ""
    assert "http://127.0.0.1:9 could not be brought up to date: first a cable is needed; nothing is lost: `spa" in said


def test_a_finished_run_is_mirrored_whole_and_once(uri: str, tmp_path: Path) -> None:
    ledger = finished_run(tmp_path / "run", 1.0, seed=3, uri=uri)
    before = contents(ledger.folder)
    result = sync([ledger])
    assert (result.runs, result.created, result.rows, result.skipped, result.failed) == (1, 1, 9, 0, {})

    run = only_run(uri)
    assert run.info.run_name == "space-s3"
    assert (run.info.status, run.info.start_time) == ("FINISHED", round((STARTED + 3) * 1000))
    assert run.info.end_time == round(ledger.status().updated_at * 1000)
    assert run.data.params["curriculum.eta"] == "0.1"
    assert run.data.params["learner.net_arch"] == "[64, 64]"
    tags = run.data.tags
    assert (tags["space_dist.seed"], tags["space_dist.state"]) == ("3", "done")
    assert (tags["space_dist.fingerprint.torch"], tags[ROWS_TAG]) == ("2.0", "9")
    assert "4,000 of 4,000 environment steps" in tags["mlflow.note.content"]
    assert "test return at the end: 1, success 0.5" in tags["mlflow.note.content"]

    points = histories(uri, run)
    start = STARTED + 3
    times = [round((start + 1.25 * row["row"]) * 1000) for row in ledger.rows(TIMING)]
    expected = [(number * STEPS, times[2 * number], value) for number, value in enumerate(TEST)]
    assert points["test/return"] == points["train/return"] == expected
    assert points["train/learner_loss"] == [(n * STEPS, times[2 * n - 1], 1.0 / n) for n in range(1, 5)]
    assert [value for _, _, value in points["curriculum/trained_size"]] == [1, 2, 4, 4]
    assert {value for _, _, value in points["curriculum/grew"]} == {1.0}
    assert {name.partition("/")[0] for name in points} == {"curriculum", "test", "time", "train"}
    assert {"time/episodes", "time/iteration", "time/round", "time/steps_per_second"} <= {*points}
    assert not {"train/rollout_success", "curriculum/mean_value_after", "test/returns"} & set(points)

    again = sync([ledger])
    assert (again.runs, again.created, again.rows) == (1, 0, 0)
    repeated = only_run(uri)
    assert histories(uri, repeated) == points
    assert repeated.to_dictionary() == run.to_dictionary()
    assert contents(ledger.folder) == before
    assert list(Path.cwd().iterdir()) == []


def test_the_artifacts_of_a_finished_run(uri: str, tmp_path: Path) -> None:
    ledger = finished_run(tmp_path / "run", 1.0, uri=uri)
    sync([ledger])
    folder = tmp_path / "a store #1" / "mlartifacts" / only_run(uri).info.run_id / "artifacts"
    assert {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} == {
        "config.yaml", "instances_train.csv", "instances_test.csv", "model.npz", "model.json", "metrics.jsonl",
        "log.txt", "figures/learning_curve.png", "figures/curriculum.png",
    }  # fmt: skip
    assert (folder / "model.npz").read_bytes() == ledger.model_arrays.read_bytes()
    assert (folder / "figures/curriculum.png").read_bytes().startswith(b"\x89PNG")


def test_rows_that_come_later_are_added_once_each(uri: str, tmp_path: Path) -> None:
    whole = finished_run(tmp_path / "whole", 1.0, seed=1)
    ledger = start_run(tmp_path / "run", seed=1, uri=uri)
    assert sync([ledger]).rows == 0
    assert only_run(uri).info.status == "KILLED"  # it says running, but nobody works on it
    continue_run(ledger, TEST, GROWTH, until=2, state="interrupted", success=0.5)
    assert sync([ledger]).rows == 5
    assert only_run(uri).info.status == "KILLED"
    assert [step for step, _, _ in histories(uri, only_run(uri))["test/return"]] == [0, 1000, 2000]

    with RunWriter(ledger) as writer:  # rows behind the last checkpoint are not mirrored, and a live run runs
        writer.status = ledger.status()
        writer.set_status(dataclasses.replace(writer.status, state="running"))
        writer.append(METRICS, {"kind": "evaluation", "steps": 999})
        assert sync([ledger]).rows == 0
        assert only_run(uri).info.status == "RUNNING"

    continue_run(ledger, TEST, GROWTH, success=0.5)
    assert sync([ledger]).rows == 4
    assert only_run(uri).info.status == "FINISHED"
    sync([whole], uri, "at once")
    assert histories(uri, only_run(uri)) == histories(uri, only_run(uri, "at once"))


def test_a_death_between_rows_and_their_tag_doubles_nothing(uri: str, tmp_path: Path) -> None:
    ledger = finished_run(tmp_path / "run", 1.0, uri=uri)
    sync([ledger])
    points, run = histories(uri, only_run(uri)), only_run(uri)
    for found in ("4", "nonsense"):
        MlflowClient(uri).set_tag(run.info.run_id, ROWS_TAG, found)
        sync([ledger])
        assert histories(uri, only_run(uri)) == points
        assert only_run(uri).data.tags[ROWS_TAG] == "9"


def test_more_rows_than_one_call_takes(uri: str, tmp_path: Path) -> None:
    ledger = start_run(tmp_path / "run", uri=uri)
    many = 130  # iterations of 11 points and evaluations of 6 and 7: more than 2,000 points
    continue_run(ledger, [float(n) for n in range(many + 1)], [[0]] * many, state="interrupted")
    assert sync([ledger]).rows == 2 * many + 1
    points = histories(uri, only_run(uri))
    assert sum(len(history) for history in points.values()) > 2000
    assert [value for _, _, value in points["test/return"]] == [float(n) for n in range(many + 1)]
    assert len(points["train/learner_loss"]) == many


def test_a_death_after_any_call_is_made_good(uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Die right after the 1st, 2nd, ... call that writes, until one push survives; then everything must be there."""
    ledger = start_run(tmp_path / "run")
    monkeypatch.setattr(store, "_MAX_METRICS", 100)
    monkeypatch.setattr(figures, "png", lambda figure: b"a picture")  # drawing takes most of the time
    continue_run(ledger, [float(n) for n in range(7)], [[0]] * 6)  # two calls' worth of metrics
    sync([ledger], uri, "reference")
    reference = only_run(uri, "reference")
    points, calls, deaths = histories(uri, reference), 0, 0

    def mortal(name: str) -> Callable[..., Any]:
        write = getattr(MlflowClient, name)

        def call(*args: Any, **keywords: Any) -> Any:
            nonlocal calls
            answer = write(*args, **keywords)
            calls += 1
            if calls == deaths + 1:
                raise ConnectionError("cut")
            return answer

        return call

    while True:
        calls, experiment = 0, f"died {deaths}"
        with monkeypatch.context() as patch:
            for name in ("create_experiment", "create_run", "log_batch", "log_artifact", "set_tag", "set_terminated"):
                patch.setattr(MlflowClient, name, mortal(name))
            try:
                sync([ledger], uri, experiment)
                break
            except TrackingError:
                deaths += 1
        sync([ledger], uri, experiment)
        run = only_run(uri, experiment)
        assert histories(uri, run) == points
        assert (run.data.params, run.info.status) == (reference.data.params, "FINISHED")
        assert run.data.tags == reference.data.tags
        assert len(MlflowClient(uri).list_artifacts(run.info.run_id)) == 8
    assert deaths > 15


@pytest.mark.parametrize(("state", "status"), [("failed", "FAILED"), ("interrupted", "KILLED")])
def test_an_end_is_told_truthfully(uri: str, tmp_path: Path, state: str, status: str) -> None:
    ledger = start_run(tmp_path / "run", uri=uri)
    continue_run(ledger, [0.0, 1.0], [[0]], state=state, message="out of memory")
    sync([ledger])
    run = only_run(uri)
    assert run.info.status == status
    assert run.info.end_time == round(ledger.status().updated_at * 1000)
    assert "out of memory" in run.data.tags["mlflow.note.content"]


def test_a_run_is_found_by_its_folder_and_start(uri: str, tmp_path: Path) -> None:
    ledger = finished_run(tmp_path / "run", 1.0)
    sync([Ledger(tmp_path / "cwd/../run")], uri, "tests")
    text = f"{ledger.folder.resolve()}\n{STARTED!r}"
    assert only_run(uri).data.tags[RUN_TAG] == hashlib.sha256(text.encode()).hexdigest()[:32]
    shutil.rmtree(ledger.folder)
    with RunWriter(start_run(ledger.folder)) as writer:  # another run in the same folder
        writer.set_status(dataclasses.replace(ledger.status(), started_at=STARTED + 99))
    assert sync([ledger], uri, "tests").created == 1


def test_runs_without_a_uri_are_skipped_and_damaged_ones_named(uri: str, tmp_path: Path) -> None:
    good, none, bad = (start_run(tmp_path / name, uri=own) for name, own in (("a", uri), ("b", None), ("c", uri)))
    bad.config.write_text("[")
    result = sync([bad, none, good])
    assert (result.runs, result.skipped, list(result.failed)) == (1, 1, [bad.folder])
    assert "damaged" in result.failed[bad.folder]


def test_what_mlflow_refuses_of_one_run_does_not_stop_the_others(uri: str, tmp_path: Path) -> None:
    bad, good = start_run(tmp_path / "a", uri=uri), start_run(tmp_path / "b", seed=1, uri=uri)
    with RunWriter(bad) as writer:
        writer.status = bad.status()
        train, test = (bad.instances(split).read_text() for split in ("train", "test"))
        writer.write_config(bad.config.read_text() + "\n'what?': 1\n", train, test)
        writer.set_status(bad.status())
    result = sync([bad, good])
    assert result.runs == 1
    assert "refuses it" in result.failed[bad.folder]


def test_a_dead_server_costs_nothing(tmp_path: Path) -> None:
    ledger = finished_run(tmp_path / "run", 1.0)
    before = contents(tmp_path)
    with pytest.raises(
        TrackingError, match=r"http://127\.0\.0\.1:9 cannot be written to: Connection refused\. Nothing is lost"
    ):
        sync([ledger], "http://127.0.0.1:9", "tests")
    assert contents(tmp_path) == before


def test_a_dead_server_keeps_no_other_store_waiting(uri: str, tmp_path: Path) -> None:
    for name, of in (("a", "http://127.0.0.1:9"), ("b", "http://127.0.0.1:9"), ("c", uri)):
        start_run(tmp_path / name, uri=of)
    done = CliRunner().invoke(app, ["sync", str(tmp_path)])
    assert done.exit_code == 1
    assert "1 run is up to date in MLflow (1 new" in done.output
    [line] = [line for line in done.output.splitlines() if "not mirrored" in line]
    assert f"{tmp_path / 'a'}, {tmp_path / 'b'} are not mirrored: MLflow at http://127.0.0.1:9 cannot be" in line
    assert line.endswith("once it works again; with --uri URI, elsewhere")
    assert only_run(uri).info.run_name


def answered(write: Callable[[socket.socket], None]) -> Iterator[str]:
    """A server that answers every connection so, until the other side has gone."""

    def serve() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            threading.Thread(target=answer, args=(connection,), daemon=True).start()

    def answer(connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.recv(1 << 16)
            write(connection)

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, daemon=True).start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)


def drip(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n{")
    while True:
        connection.sendall(b" ")
        time.sleep(0.05)


def drip_headers(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\nX: ")
    while True:
        connection.sendall(b"x")
        time.sleep(0.05)


def too_many(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 429 Too Many\r\nRetry-After: 1000\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")


def send_on(connection: socket.socket) -> None:
    time.sleep(0.4)
    connection.sendall(b"HTTP/1.1 302 Found\r\nLocation: /on\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")


def bomb(connection: socket.socket) -> None:
    content = gzip.compress(b" " * (answers.MAX_BYTES + (1 << 20)), 9)
    head = f"HTTP/1.1 200 OK\r\nContent-Encoding: gzip\r\nContent-Length: {len(content)}\r\n\r\n"
    connection.sendall(head.encode() + content)
    connection.recv(1)


@pytest.mark.parametrize(
    ("server", "words"),
    [(drip, "too long|no whole answer"), (drip_headers, "no whole answer"), (too_many, "Max retries exceeded"),
     (send_on, "no whole answer"), (bomb, "larger than 64 MiB")],
)  # fmt: skip
def test_a_server_that_answers_badly_is_given_up(
    server: Callable[[socket.socket], None], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them would hold a request for ever, or for as long as there is memory."""
    monkeypatch.setattr(answers, "SECONDS", 60.0 if server in (bomb, too_many) else 3.0)  # each address is within it
    ledger = start_run(tmp_path / "run")
    serving = answered(server)
    with pytest.raises(TrackingError, match=words):
        sync([ledger], next(serving), "tests")
    assert next(serving, None) is None


def test_a_pusher_that_takes_too_long_is_ended_with_all_that_it_started() -> None:
    script = "sleep 1000 & echo $!; wait"
    with subprocess.Popen(["bash", "-c", script], stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        child = psutil.Process(int(process.stdout.readline()))
        assert not ended_within(process, 0.0)
        assert process.poll() is not None
        psutil.wait_procs([child], timeout=PATIENCE)
        assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE


@pytest.mark.parametrize(
    "store", ["file:///srv/mlruns", "mlruns", "/srv/mlruns", "", "sqlite://", "sqlite:///:memory:", "sqlite:mlflow.db",
              "postgresql://user:word@host/db", "http://user:word@host:5000", "http://[", "databricks",
              "http:///", "https://:5000", "http://host:99999", "http://host:0", "http://user:word@[", "http://a b/",
              "http://host/?token=word@", "sqlite:///folder/", "sqlite://user:word@host/db"]
)  # fmt: skip
def test_other_stores_are_refused(tmp_path: Path, store: str) -> None:
    with pytest.raises(ConfigError, match=r"sqlite:////absolute|MLFLOW_TRACKING_PASSWORD") as refusal:
        sync([start_run(tmp_path / "run")], store, "tests")
    assert "word@" not in str(refusal.value)


@pytest.mark.parametrize(
    ("uri", "said"),
    [("rel.db", "'rel.db' has no beginning that says what it is; did you mean sqlite:///rel.db? allowed"),
     ("/srv/x.sqlite", "did you mean sqlite:////srv/x.sqlite? allowed"),
     ("databricks", "'databricks' has no beginning that says what it is; allowed"),
     ("mlruns", "'mlruns' is a folder of files"), ("/srv/runs", "'/srv/runs' is a folder of files")]
)  # fmt: skip
def test_a_tracking_uri_without_a_scheme_is_told_what_it_lacks(uri: str, said: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        store.usable_uri(uri)
    assert said in str(refusal.value)


@pytest.mark.parametrize("content", [b"this is no database" * 100, None])
def test_a_file_that_is_no_database_is_said_so(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "mlflow.db"
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(TrackingError, match="cannot be written to"):
        sync([start_run(tmp_path / "run")], f"sqlite:///{path}", "tests")


def test_a_deleted_experiment_is_refused(uri: str, tmp_path: Path) -> None:
    ledger = start_run(tmp_path / "run", uri=uri)
    sync([ledger])
    MlflowClient(uri).delete_experiment(only_run(uri).info.experiment_id)
    with pytest.raises(ConfigError, match="was deleted"):
        sync([ledger])


def test_following_picks_up_runs_and_rows_as_they_come(uri: str, tmp_path: Path) -> None:
    root, ledger = tmp_path / "runs", Ledger(tmp_path / "runs/s0")
    events = {  # at first there is no run: not even the folder
        2: lambda: start_run(ledger.folder, uri=uri),
        3: lambda: continue_run(ledger, TEST, GROWTH, until=2, state="interrupted"),
        4: lambda: continue_run(ledger, TEST, GROWTH),
    }
    result = follow(root, poll_seconds=0.0, stop=stop_in(5, events))
    assert (result.runs, result.created, result.rows) == (1, 1, 9)
    assert only_run(uri).info.status == "FINISHED"
    assert len(histories(uri, only_run(uri))["test/return"]) == 5


def test_following_says_once_that_the_store_is_away_and_once_that_it_is_back(
    uri: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    start_run(tmp_path / "runs/s0")
    database, away = Path(uri.removeprefix("sqlite:///")), tmp_path / "away.db"
    database.rename(away)
    database.mkdir()

    def come_back() -> None:
        database.rmdir()
        away.rename(database)

    with caplog.at_level(logging.WARNING, logger="space_dist.tracking"):
        follow(tmp_path / "runs", uri, "tests", poll_seconds=0.0, stop=stop_in(6, {4: come_back}))
    first, second = (record.getMessage() for record in caplog.records if record.name == "space_dist.tracking")
    assert "Nothing is lost" in first
    assert "reached again" in second
    assert only_run(uri).info.run_name == "space-s0"


def test_mlflow_keeps_its_own_settings(uri: str, tmp_path: Path) -> None:
    before = mlflow.get_tracking_uri()
    sync([start_run(tmp_path / "run")], uri, "tests")
    assert mlflow.get_tracking_uri() == before
    assert mlflow.active_run() is None
