"""Grids in MLflow: one parent, one child for each run begun, whatever happened in between. Also on a real server."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import sqlite3
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mlflow import MlflowClient
from mlflow.entities import Run as MlflowRun
from typer.testing import CliRunner

from space_dist.cli import app
from space_dist.errors import LedgerError
from space_dist.experiment.endings import Cause, Ended
from space_dist.experiment.grid_file import GridTracking, Retry, RunResources
from space_dist.experiment.manifest import Cell, Grid, Manifest
from space_dist.experiment.status import Attempts
from space_dist.ledger import METRICS, TIMING, Ledger, Lock, RunWriter
from space_dist.tracking import NOTE_TAG, TrackingError, find, follow, sync
from space_dist.tracking.looking import final_return, last_evaluation
from tests.grids import ROOT
from tests.test_report import GROWTH, STARTED, continue_run, start_run
from tests.test_tracking import contents, histories, stop_in

sys.path.append(str(ROOT / "jobs"))

from benchmarks.servers import TrackingServer

from tests.patience import PATIENCE

TEST = [-10.0, -8.0, -6.0, -4.0, 1.0]


def make_grid(
    folder: Path, uri: str | None, etas: tuple[float, ...] = (0.1, 0.2), seeds: tuple[int, ...] = (0, 1), **changes: Any
) -> tuple[Grid, Manifest]:
    config = {
        "name": "demo",
        "curriculum": {"kind": "space", "eta": 0.1, "kappa": 1},
        "learner": {"kind": "ppo"},
        "budget": {"steps": 4000},
        "instances": {"train": "instances/a.csv", "test": "instances/b.csv"},
    }
    cells = tuple(
        Cell(f"{number:012x}", f"eta={eta}", {"curriculum.eta": eta},
             config | {"curriculum": {"kind": "space", "eta": eta, "kappa": 1}})
        for number, eta in enumerate(etas)
    )  # fmt: skip
    manifest = Manifest(
        "demo", ("curriculum.eta",), cells, seeds, RunResources(memory_mb=500), Retry(), GridTracking(uri=uri),
        cells[0].id, {}, "c0de", {"git_commit": "abc", "git_dirty": "true"},
    )  # fmt: skip
    manifest = dataclasses.replace(manifest, **changes)
    grid = Grid(folder)
    grid.freeze(manifest, {})
    return grid, manifest


def ledger_of(grid: Grid, cell: int, seed: int) -> Ledger:
    return Ledger(grid.folder / f"{cell:012x}" / f"s{seed}")


def begin(grid: Grid, cell: int, seed: int, attempt: int = 1, **where: Any) -> Attempts:
    attempts = Attempts(ledger_of(grid, cell, seed))
    attempts.begin(attempt, where)
    return attempts


def run_to(
    grid: Grid, cell: int, seed: int, until: int | None = None, state: str = "done", attempt: int = 1, last: float = 1.0
) -> Ledger:
    """A run of a grid as its supervisor and its process leave it."""
    attempts, ledger = begin(grid, cell, seed, attempt, job=f"job-{attempt}"), ledger_of(grid, cell, seed)
    if not ledger.exists():
        start_run(ledger.folder, seed=seed, name="demo", eta=0.1 * (cell + 1))
    continue_run(ledger, [*TEST[:-1], last], GROWTH, until=until, state=state, success=0.5)
    attempts.end(attempt, Ended(None if state == "done" else Cause.PREEMPTED, "" if state == "done" else "SIGTERM"))
    return ledger


def interrupted(folder: Path, uri: str, *seeds: int) -> Grid:
    """A grid of one cell and two seeds; the runs of `seeds` were interrupted after their second evaluation."""
    grid, _ = make_grid(folder, uri, etas=(0.1,))
    for seed in seeds:
        run_to(grid, 0, seed, until=1, state="interrupted")
    return grid


@pytest.fixture(autouse=True)
def reports(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The grids that were reported on, with a page instead of a report: drawing takes seconds."""
    made: list[Path] = []

    def write(grid: Grid, out: Path, *, in_depth: bool) -> None:
        assert not in_depth  # it is made again and again
        made.append(grid.folder)
        (out / "report.html").write_text("a report")

    monkeypatch.setattr("space_dist.report.build_grid_report", write)
    return made


def levels(uri: str, experiment: str = "demo") -> tuple[MlflowRun, dict[str, MlflowRun], dict[str, MlflowRun]]:
    """(the grid, its cells by label, their runs by title); nothing else may be there, and each in its place."""
    client = MlflowClient(uri)
    found = client.get_experiment_by_name(experiment)
    assert found is not None
    runs = list(client.search_runs([found.experiment_id], max_results=1000))
    (parent,) = [run for run in runs if run.data.tags["space_dist.level"] == "grid"]
    cells = {run.info.run_name: run for run in runs if run.data.tags["space_dist.level"] == "cell"}
    children = {run.info.run_name: run for run in runs if run.data.tags["space_dist.level"] == "run"}
    assert len(cells) + len(children) == len(runs) - 1
    assert "mlflow.parentRunId" not in parent.data.tags
    assert {run.data.tags["mlflow.parentRunId"] for run in cells.values()} <= {parent.info.run_id}
    for title, run in children.items():
        assert run.data.tags["mlflow.parentRunId"] == cells[title.partition(",")[0]].info.run_id
    return parent, cells, children


def everything(uri: str, experiment: str = "demo") -> tuple[MlflowRun, dict[str, MlflowRun]]:
    """(the grid, its runs by title)."""
    parent, _, children = levels(uri, experiment)
    return parent, children


def test_a_parent_explains_the_grid_and_has_a_child_for_each_run_begun(uri: str, tmp_path: Path) -> None:
    grid, _ = make_grid(tmp_path / "demo", uri)
    assert sync([], grids=[grid]).runs == 0
    parent, children = everything(uri)
    assert (parent.info.status, children) == ("RUNNING", {})

    run_to(grid, 0, 0)
    begin(grid, 0, 1).end(1, Ended(Cause.CONFIG_ERROR, "curriculum.eta: is no number | at all"))
    run_to(grid, 1, 0, until=2, state="interrupted")
    before = contents(grid.folder)
    result = sync([], grids=[grid])
    assert (result.runs, result.created, result.rows, result.failed) == (3, 3, 14, {})
    assert contents(grid.folder) == before

    again, children = everything(uri)
    assert (again.info.run_id, again.info.status, again.info.run_name) == (parent.info.run_id, "RUNNING", "demo")
    note = again.data.tags[NOTE_TAG]
    for text in (
        "**demo**: 2 cells × 2 seeds = 4 runs of 4,000 environment steps, 16,000 in all",
        "| curriculum.eta | `0.1`, `0.2` |",
        "each run may use 1 CPU (0 rollout actors), 500 MB",
        "code `c0de`, git commit `abc`, edited since",
        "**4 runs**: 1 done, 2 waiting, 1 failed (1 config error)",
        "- eta=0.1, seed 1: config error. curriculum.eta: is no number \\| at all",
        "| eta=0.1 (baseline) | `000000000000` | 1 | 1 | 1 | 1 | 1/2 | 1 config error |",
        "| eta=0.2 | `000000000001` | — | — | — | — | 0/2 |  |",
    ):
        assert text in note
    assert {name: child.info.status for name, child in children.items()} == {
        "eta=0.1, seed 0": "FINISHED", "eta=0.1, seed 1": "FAILED", "eta=0.2, seed 0": "KILLED",
    }  # fmt: skip
    tags = children["eta=0.2, seed 0"].data.tags
    assert {key: tags[key] for key in tags if key.partition(".")[0] == "setting"} == {"setting.curriculum.eta": "0.2"}
    for key, value in {
        "cell": "000000000001", "cell_label": "eta=0.2", "seed": "0", "curriculum": "space", "attempts": "1",
        "cause": "preempted", "condition": "waiting", "state": "interrupted", "job": "job-1", "grid": "demo",
    }.items():  # fmt: skip
        assert tags[f"space_dist.{key}"] == value
    config_error = children["eta=0.1, seed 1"]
    assert config_error.data.tags["space_dist.git_commit"] == "abc"
    assert "is no number" in config_error.data.tags[NOTE_TAG]
    assert config_error.data.params["curriculum.eta"] == "0.1"
    assert len(histories(uri, children["eta=0.1, seed 0"])["test/return"]) == 5

    assert (sync([], grids=[grid]).created, sync([], grids=[grid]).rows) == (0, 0)
    assert everything(uri)[0].to_dictionary() == again.to_dictionary()
    assert {name: run.to_dictionary() for name, run in everything(uri)[1].items()} == {
        name: run.to_dictionary() for name, run in children.items()
    }


def test_retries_and_resumed_runs_stay_the_children_they_were(uri: str, tmp_path: Path) -> None:
    grid, manifest = make_grid(tmp_path / "demo", uri, etas=(0.1,), seeds=(0, 1))
    run_to(grid, 0, 0, until=2, state="interrupted")
    begin(grid, 0, 1).end(1, Ended(Cause.CRASH, "boom"))
    sync([], grids=[grid])
    before = {name: run.info.run_id for name, run in everything(uri)[1].items()}
    parent, children = everything(uri)
    assert (parent.info.status, children["eta=0.1, seed 1"].info.status) == ("RUNNING", "FAILED")

    run_to(grid, 0, 0, attempt=2, last=3.0)
    run_to(grid, 0, 1, attempt=2, last=5.0)
    assert sync([], grids=[grid]).created == 0
    parent, children = everything(uri)
    assert {name: run.info.run_id for name, run in children.items()} == before
    assert {run.info.status for run in children.values()} == {"FINISHED"}
    assert {run.data.tags["space_dist.cause"] for run in children.values()} == {"none"}
    assert {run.data.tags["space_dist.attempts"] for run in children.values()} == {"2"}
    assert [v for _, _, v in histories(uri, children["eta=0.1, seed 0"])["test/return"]] == [*TEST[:-1], 3.0]
    assert parent.info.status == "FINISHED"
    assert "| 4 | 4 | 3 | 5 | 2/2 |" in parent.data.tags[NOTE_TAG]

    wider, _ = make_grid(grid.folder, uri, etas=(0.1, 0.2), seeds=(0, 1, 2))
    assert sync([], grids=[wider]).created == 0
    widened, children = everything(uri)
    assert widened.info.run_id != parent.info.run_id  # parameters of the plan are never changed
    assert {name: run.info.run_id for name, run in children.items()} == before
    assert (parent.data.params["seeds"], widened.data.params["seeds"]) == ("2", "3")
    assert everything(uri)[0].info.status == "RUNNING"
    assert "2 cells × 3 seeds" in everything(uri)[0].data.tags[NOTE_TAG]

    shutil.rmtree(ledger_of(grid, 0, 0).folder)  # started afresh: MLflow cannot take back single points
    ledger = start_run(ledger_of(grid, 0, 0).folder, name="demo")
    with RunWriter(ledger) as writer:
        writer.set_status(dataclasses.replace(ledger.status(), started_at=STARTED + 99))
    continue_run(ledger, TEST, GROWTH, until=1, state="interrupted")
    assert sync([], grids=[wider]).created == 1
    _, children = everything(uri)
    assert len(histories(uri, children["eta=0.1, seed 0"])["test/return"]) == 2
    assert manifest.experiment == "demo"


def test_a_grid_whose_last_runs_failed_has_failed(uri: str, tmp_path: Path) -> None:
    grid = interrupted(tmp_path / "demo", uri, 0)
    begin(grid, 0, 0, 2).end(2, Ended(Cause.OUT_OF_MEMORY, "600 MB"))
    begin(grid, 0, 1).end(1, Ended(Cause.OUT_OF_MEMORY, "700 MB"))
    sync([], grids=[grid])
    parent, children = everything(uri)
    assert parent.info.status == "FAILED"
    assert {run.info.status for run in children.values()} == {"FAILED"}
    assert "2 out of memory" in parent.data.tags[NOTE_TAG]


def test_what_was_deleted_in_mlflow_is_replayed_under_one_parent(uri: str, tmp_path: Path) -> None:
    grid = interrupted(tmp_path / "demo", uri, 0, 1)
    sync([], grids=[grid])
    parent, children = everything(uri)
    client = MlflowClient(uri)
    client.delete_run(parent.info.run_id)
    client.delete_run(children["eta=0.1, seed 0"].info.run_id)
    assert sync([], grids=[grid]).created == 1
    parent, children = everything(uri)
    assert [len(histories(uri, run)["test/return"]) for run in children.values()] == [2, 2]


def test_a_death_after_any_creation_doubles_nothing(
    uri: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid = interrupted(tmp_path / "demo", uri, 0, 1)
    create, calls = MlflowClient.create_run, 0

    def mortal(*args: Any, **keywords: Any) -> Any:
        nonlocal calls
        calls += 1
        run = create(*args, **keywords)
        raise ConnectionError(f"cut after {run.info.run_id}")

    monkeypatch.setattr(MlflowClient, "create_run", mortal)
    for _ in range(4):
        with pytest.raises(TrackingError, match="cut after"):
            sync([], grids=[grid])
    assert sync([], grids=[grid]).created == 0
    assert calls == 4  # the grid, its cell, two runs
    _, children = everything(uri)
    assert [len(histories(uri, run)["test/return"]) for run in children.values()] == [2, 2]


def test_two_pushers_take_turns(uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = interrupted(tmp_path / "demo", uri, 0, 1)
    create = MlflowClient.create_run

    def slow(*args: Any, **keywords: Any) -> Any:
        time.sleep(0.5)  # in which the other one, were it allowed to, would find nothing and create it too
        return create(*args, **keywords)

    monkeypatch.setattr(MlflowClient, "create_run", slow)
    results = []
    pushers = [threading.Thread(target=lambda: results.append(sync([], grids=[grid]))) for _ in range(2)]
    for pusher in pushers:
        pusher.start()
    for pusher in pushers:
        pusher.join()
    assert sorted(result.created for result in results) == [0, 2]
    assert sorted(result.rows for result in results) == [0, 6]
    assert len(everything(uri)[1]) == 2


def test_a_run_may_start_while_its_attempt_is_pushed(uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, _ = make_grid(tmp_path / "demo", uri, etas=(0.1,))
    begin(grid, 0, 0)
    create = MlflowClient.create_run

    def meanwhile(*args: Any, **keywords: Any) -> Any:
        ledger_of(grid, 0, 0).config.write_text("half of what a run begins with")
        return create(*args, **keywords)

    monkeypatch.setattr(MlflowClient, "create_run", meanwhile)
    result = sync([], grids=[grid])
    assert (result.runs, result.created, result.rows, result.failed) == (1, 1, 0, {})


def following(grid: Grid) -> tuple[threading.Thread, list[Any]]:
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(follow(grid.folder, poll_seconds=0.05)))
    thread.start()
    return thread, results


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_following_lasts_as_long_as_somebody_works_on_the_grid(uri: str, tmp_path: Path) -> None:
    grid, _ = make_grid(tmp_path / "demo", uri, etas=(0.1,), seeds=(0, 1))
    assert follow(grid.folder).runs == 0  # nobody does

    lock = Lock(grid.lock_file)
    lock.acquire()
    thread, results = following(grid)
    run_to(grid, 0, 0, until=1, state="interrupted")
    until(lambda: len(everything(uri)[1]) == 1)
    ledger = run_to(grid, 0, 0, attempt=2)
    with RunWriter(ledger) as writer:  # the submitter is gone, but a run still lives
        writer.status = done = ledger.status()
        writer.set_status(dataclasses.replace(done, state="running"))
        until(lambda: everything(uri)[1]["eta=0.1, seed 0"].info.status == "RUNNING")
        lock.release()
        thread.join(0.6)
        assert thread.is_alive()
        writer.set_status(done)
    thread.join(60)
    assert not thread.is_alive()
    assert (results[0].created, results[0].rows) == (1, 9)
    assert everything(uri)[1]["eta=0.1, seed 0"].info.status == "FINISHED"


def test_following_a_grid_at_rest_asks_mlflow_nothing(
    uri: str,
    tmp_path: Path,
) -> None:
    monkeypatch = pytest.MonkeyPatch()
    grid = interrupted(tmp_path / "demo", uri, 0)

    def fall_silent() -> None:
        Attempts(ledger_of(grid, 0, 0)).sign()  # a heartbeat is no news
        for name in ("search_runs", "get_run", "create_run", "log_batch", "set_tag"):
            monkeypatch.setattr(MlflowClient, name, None)
        monkeypatch.setattr(Ledger, "status", None)

    def go_on() -> None:
        monkeypatch.undo()
        run_to(grid, 0, 0, attempt=2)

    result = follow(grid.folder, poll_seconds=0.0, stop=stop_in(5, {2: fall_silent, 4: go_on}))
    assert (result.runs, result.created, result.rows, result.failed) == (1, 1, 9, {})


def test_a_follower_takes_nothing_for_granted_after_an_outage(
    uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store that has lost its runs meanwhile: everything is pushed again."""
    grid = interrupted(tmp_path / "demo", uri, 0)

    def mortal(*_: Any, **__: Any) -> Any:
        raise ConnectionError("away")

    def lose() -> None:
        begin(grid, 0, 1).end(1, Ended(Cause.CONFIG_ERROR, "no"))
        parent, children = everything(uri)
        for run in (parent, *children.values()):
            MlflowClient(uri).delete_run(run.info.run_id)
        monkeypatch.setattr(MlflowClient, "search_runs", mortal)

    result = follow(grid.folder, poll_seconds=0.0, stop=stop_in(4, {2: lose, 3: monkeypatch.undo}))
    assert (result.runs, result.created, result.rows) == (2, 3, 6)
    _, children = everything(uri)
    assert len(histories(uri, children["eta=0.1, seed 0"])["test/return"]) == 2


def test_long_results_are_cut_in_the_description_and_whole_beside_it(uri: str, tmp_path: Path) -> None:
    etas = tuple(0.001 * number for number in range(1, 201))
    make_grid(tmp_path / "demo", uri, etas=etas)
    sync([], grids=[Grid(tmp_path / "demo")])
    parent, _ = everything(uri)
    note = parent.data.tags[NOTE_TAG]
    assert 7000 < len(note) <= 8000
    shown = note.count("| `0000000000")
    assert f"{200 - shown} more cells are in results.md" in note
    found = {artifact.path for artifact in MlflowClient(uri).list_artifacts(parent.info.run_id)}
    assert found == {"manifest.json", "results.md"}
    table = (tmp_path / "a store #1/mlartifacts" / parent.info.run_id / "artifacts/results.md").read_text()
    assert table.count("| `0000000000") == 200


def test_the_last_evaluation_is_read_from_the_end(tmp_path: Path) -> None:
    ledger = start_run(tmp_path / "run")
    assert last_evaluation(ledger, ledger.status()) is None
    assert final_return(ledger, ledger.status()) is None
    continue_run(ledger, [float(n) for n in range(400)], [[0]] * 399)  # several blocks
    status = ledger.status()
    assert status.committed[METRICS] > 3 * (64 << 10)
    assert final_return(ledger, status) == 399.0
    assert final_return(ledger, dataclasses.replace(status, state="interrupted")) is None
    assert final_return(ledger, dataclasses.replace(status, steps=status.steps + 1)) is None  # not evaluated at the end
    half = dataclasses.replace(ledger.status(), committed={METRICS: 100 << 10})
    rows = (ledger.folder / METRICS).read_bytes()[: 100 << 10].splitlines()
    row = last_evaluation(ledger, half)
    assert row is not None
    assert row["test"]["return"] == float(sum(b'"evaluation"' in line for line in rows[:-1]) - 1)


def test_damaged_runs_are_named_and_the_others_mirrored(uri: str, tmp_path: Path) -> None:
    grid = interrupted(tmp_path / "demo", uri, 0)
    bad = run_to(grid, 0, 1, until=1, state="interrupted")
    bad.status_file.write_text("{")
    result = sync([], grids=[grid])
    assert (result.runs, result.created) == (1, 1)
    assert "damaged" in result.failed[bad.folder]
    grid.manifest_file.write_text("{}")
    assert "damaged" in sync([], grids=[grid]).failed[grid.folder]


def test_grids_and_runs_are_found_and_told_apart(tmp_path: Path) -> None:
    grid, _ = make_grid(tmp_path / "runs/demo", None)
    start_run(ledger_of(grid, 0, 0).folder)
    single = start_run(tmp_path / "runs/single/s0")
    found = find([tmp_path / "runs", single.folder])
    assert [one.folder for one in found.ledgers] == [single.folder]
    assert [one.folder for one in found.grids] == [grid.folder]
    for inside in (grid.folder, ledger_of(grid, 0, 0).folder.parent, ledger_of(grid, 0, 0).folder):
        assert [one.folder for one in find([inside]).grids] == [grid.folder]
        assert find([inside]).ledgers == ()
    (tmp_path / "nothing").mkdir()
    with pytest.raises(LedgerError, match="no run or grid found in"):
        find([tmp_path / "nothing"])


def test_what_mlflow_keeps_of_a_grid_is_not_taken_for_one(tmp_path: Path) -> None:
    grid, _ = make_grid(tmp_path / "runs/demo", None)
    start_run(ledger_of(grid, 0, 0).folder)
    sync([], f"sqlite:///{tmp_path / 'mlflow/mlflow.db'}", grids=[grid])
    assert list((tmp_path / "mlflow").rglob("manifest.json"))
    with pytest.raises(LedgerError, match=r"no run or grid found in .*: no folder there has a status\.json, or a"):
        find([tmp_path / "mlflow"])
    assert [one.folder for one in find([tmp_path]).grids] == [grid.folder]


def test_the_command_takes_a_grid_by_each_of_its_names(uri: str, tmp_path: Path) -> None:
    grid, _ = make_grid(tmp_path / "runs/demo", None, etas=(0.1,))
    run_to(grid, 0, 0, until=1, state="interrupted")
    yaml = tmp_path / "demo.yaml"
    yaml.write_text("name: demo\nextends: base.yaml\nseeds: [0]\n")
    answers = []
    for arguments in ([str(grid.folder)], [str(grid.manifest_file)], [str(yaml), "--root", str(tmp_path / "runs")]):
        done = CliRunner().invoke(app, ["sync", "--uri", uri, *arguments])
        assert done.exit_code == 0, done.output
        answers.append(done.output)
    assert "1 new, 3 rows pushed" in answers[0]
    assert answers[0].splitlines()[:3] == [
        f"mirroring {grid.folder} to MLflow at {uri}", f"{grid.folder}: to MLflow at {uri}",
        f"demo: {grid.manifest().runs()[0].title}",
    ]  # fmt: skip
    by_name = CliRunner().invoke(app, ["sync", "--uri", uri, "demo", "--root", str(tmp_path / "runs")])
    answers.append(by_name.output)
    assert all("1 run is up to date in MLflow (0 new, 0 rows pushed" in answer for answer in answers[1:])
    absent = CliRunner().invoke(app, ["sync", "--uri", uri, str(tmp_path / "runs/dmo")])
    assert (absent.exit_code, "mirroring" in absent.output) == (1, False)
    assert "dmo does not exist; did you mean 'demo'?" in str(absent.exception)
    assert "1 have no tracking.uri" in CliRunner().invoke(app, ["sync", "--follow", str(grid.folder)]).output


# ---- a real server --------------------------------------------------------------------------------------------------


def points_of(ledger: Ledger) -> list[tuple[str, int, int, float]]:
    """(metric, milliseconds, step, value) of all a ledger's numbers, sorted; written for the test alone."""
    points = []
    for row, timing in zip(ledger.rows(METRICS), ledger.rows(TIMING), strict=True):
        sections = {"train": "train/", "test": "test/", "rollout": "train/rollout_", "learner": "train/learner_",
                    "curriculum": "curriculum/"}  # fmt: skip
        numbers = {f"{prefix}{key}": value for section, prefix in sections.items()
                   for key, value in row.get(section, {}).items()}  # fmt: skip
        if row["kind"] == "iteration":
            numbers |= {f"time/{key}": row[key] for key in ("iteration", "round", "episodes")}
        numbers["time/steps_per_second"] = timing["steps_per_second"]
        points += [(key, round(timing["unix_time"] * 1000), row["steps"], float(value))
                   for key, value in numbers.items() if isinstance(value, int | float)]  # fmt: skip
    return sorted(points)


@pytest.mark.server
def test_a_server_that_was_killed_in_the_middle_has_everything_once_after_a_sync(
    empty_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    server = TrackingServer(tmp_path, os.environ, tmp_path / "server.log")
    grid, _ = make_grid(tmp_path / "demo", server.address)
    ledgers = [run_to(grid, cell, seed, last=cell + seed) for cell in (0, 1) for seed in (0, 1)]
    write, batches = MlflowClient.log_batch, 0

    with server, monkeypatch.context() as patch:

        def fatal(*args: Any, **keywords: Any) -> Any:
            nonlocal batches
            batches += "metrics" in keywords
            if batches == 4:  # two are the cells'
                server.kill()
            return write(*args, **keywords)

        patch.setattr(MlflowClient, "log_batch", fatal)
        patch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
        with pytest.raises(TrackingError, match="Nothing is lost"):
            sync([], grids=[grid])
    with server:
        result = sync([], grids=[grid])
        assert (result.runs, result.failed) == (4, {})
        assert 0 < result.created < 4
        parent, children = everything(server.address)
        assert sync([], grids=[grid]).rows == 0
    assert (parent.info.status, len(children)) == ("FINISHED", 4)
    assert "| eta=0.2 | `000000000001` | 1.5 | 1.5 | 1 | 2 | 2/2 |" in parent.data.tags[NOTE_TAG]
    assert {child.info.status for child in children.values()} == {"FINISHED"}
    with contextlib.closing(sqlite3.connect(server.database)) as connection:
        for ledger in ledgers:
            folder = str(ledger.folder)
            stored = connection.execute(
                "select m.key, m.timestamp, m.step, m.value from metrics m join tags t using (run_uuid)"
                " where t.key = 'space_dist.folder' and t.value = ?", (folder,),
            ).fetchall()  # fmt: skip
            assert sorted(stored) == points_of(ledger)
