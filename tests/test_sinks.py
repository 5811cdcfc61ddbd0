"""TensorBoard and Weights & Biases, read back with their own readers: all that ledgers hold, once."""

from __future__ import annotations

import importlib.util
import json
import math
import threading
from pathlib import Path

import pytest

from space_dist import config as configs
from space_dist.config import TrackingConfig, to_yaml
from space_dist.config.tracking_uri import settled_experiment, settled_uri
from space_dist.errors import ConfigError
from space_dist.experiment.grid_file import GridTracking
from space_dist.ledger import Ledger, RunWriter
from space_dist.report import read_config
from space_dist.tracking import sync, wandb
from space_dist.tracking.settling import settled
from space_dist.tracking.sinks import read_synced, refuse_missing
from space_dist.tracking.wandb import records
from tests.patience import PATIENCE
from tests.test_grid_tracking import make_grid, run_to
from tests.test_report import GROWTH, continue_run, start_run
from tests.test_tracking import contents

TEST = [-10.0, -8.0, -6.0, -4.0, 1.0]


def showing(ledger: Ledger, *sinks: str) -> Ledger:
    """The run, with these sinks in its config."""
    with RunWriter(ledger) as writer:
        writer.status = ledger.status()
        train, test = (ledger.instances(split).read_text() for split in ("train", "test"))
        config = read_config(ledger)
        config["tracking"]["sinks"] = list(sinks)
        writer.write_config(to_yaml(config), train, test)
        writer.set_status(ledger.status())
    return ledger


def events(folder: Path) -> dict[str, list[tuple[int, int, float]]]:
    """Every point that TensorBoard reads below a folder: name -> (step, milliseconds, value)."""
    loader = pytest.importorskip("tensorboard.backend.event_processing.event_file_loader")
    found: dict[str, list[tuple[int, int, float]]] = {}
    for path in sorted(folder.rglob("*tfevents*")):
        for event in loader.LegacyEventFileLoader(str(path)).Load():
            for value in event.summary.value:
                point = (event.step, round(event.wall_time * 1000), value.simple_value)
                found.setdefault(value.tag, []).append(point)
    return found


def test_tensorboard_has_what_the_ledger_has_once(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    ledger = showing(start_run(tmp_path / "run"), "tensorboard")
    result, folder = sync([ledger]), ledger.folder / "tensorboard"
    assert (result.runs, result.pages) == (1, (f"{folder}: `tensorboard --logdir {folder}`",))
    continue_run(ledger, TEST, GROWTH, until=2, state="interrupted")
    sync([ledger])
    assert [(step, value) for step, _, value in events(ledger.folder)["test/return"]] == [
        (0, -10.0), (1000, -8.0), (2000, -6.0),
    ]  # fmt: skip
    continue_run(ledger, TEST, GROWTH)
    sync([ledger])
    found = events(ledger.folder)
    assert [value for _, _, value in found["test/return"]] == TEST
    assert {name.partition("/")[0] for name in found} == {"curriculum", "test", "time", "train"}
    before = contents(ledger.folder)
    assert sync([ledger]).runs == 1
    assert contents(ledger.folder) == before
    assert not list(tmp_path.glob("**/mlflow.db"))

    whole = showing(start_run(tmp_path / "at once"), "tensorboard")  # the file is a function of the ledger
    continue_run(whole, TEST, GROWTH)
    sync([whole])
    files = [next(one.folder.rglob("*tfevents*")).read_bytes() for one in (ledger, whole)]
    assert files[0] == files[1]


@pytest.mark.parametrize("harm", ["half a record more", "cut", "gone", "state gone", "state nonsense"])
def test_what_a_death_left_of_tensorboards_file_is_made_good(tmp_path: Path, harm: str) -> None:
    pytest.importorskip("tensorboard")
    ledger = showing(start_run(tmp_path / "run"), "tensorboard")
    continue_run(ledger, TEST, GROWTH, until=2, state="interrupted")
    sync([ledger])
    file = next(ledger.folder.rglob("*tfevents*"))
    state = file.with_name("synced.json")
    if harm == "half a record more":
        file.write_bytes(file.read_bytes() + b"\x18\0\0\0")
    elif harm == "cut":
        file.write_bytes(file.read_bytes()[:-20])
    elif harm == "gone":
        file.unlink()
    elif harm == "state gone":
        state.unlink()
    else:
        state.write_text('{"rows": -4, "intent": [], "bytes": 1}')
    continue_run(ledger, TEST, GROWTH)
    sync([ledger])
    assert [value for _, _, value in events(ledger.folder)["test/return"]] == TEST


def test_a_grid_in_tensorboard_has_a_curve_for_each_cell(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    grid, _ = make_grid(tmp_path / "demo", None, etas=(0.1,), tracking=GridTracking(uri=None, sinks=("tensorboard",)))
    run_to(grid, 0, 0, last=1.0)
    assert (sync([], grids=[grid]).runs, sync([], grids=[grid]).skipped) == (1, 0)
    folder = grid.folder / "tensorboard"
    assert sync([], grids=[grid]).pages == (f"{folder}: `tensorboard --logdir {folder}`",)
    run_to(grid, 0, 1, last=3.0)
    sync([], grids=[grid])
    place = grid.folder / "tensorboard/eta=0.1"
    assert [value for _, _, value in events(place / "iqm")["test/return_iqm"]] == [*TEST[:-1], 2.0]  # and not 1 before
    assert {value for _, _, value in events(place / "iqm")["test/n_seeds"]} == {2.0}
    assert [value for _, _, value in events(place / "s1")["test/return"]] == [*TEST[:-1], 3.0]


def test_weights_and_biases_has_a_run_once_it_rests(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    ledger = showing(start_run(tmp_path / "run"), "wandb")
    continue_run(ledger, TEST, GROWTH, until=2, state="interrupted")
    sync([ledger])
    continue_run(ledger, TEST, GROWTH)
    sync([ledger])
    (folder,) = (ledger.folder / "wandb").glob("offline-run-*")
    assert [path.suffix for path in folder.rglob("*") if path.is_file()] == [".wandb"]  # no log that is still written
    before = contents(ledger.folder)
    place = ledger.folder / "wandb"
    assert sync([ledger]).pages == (f"{place}: `wandb sync` uploads its folders offline-run-...",)
    assert contents(ledger.folder) == before
    rows = [row for row in history(next(folder.glob("*.wandb"))) if "test/return" in row]
    assert [(row["steps"], row["test/return"]) for row in rows] == [(1000 * n, TEST[n]) for n in range(5)]
    assert read_synced(ledger.folder / "wandb").ending == "FINISHED"


def history(path: Path) -> list[dict[str, float]]:
    """The rows of an offline run."""
    return [
        {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in content.item}
        for kind, content in records(path)
        if kind == "history"
    ]


def test_a_run_that_weights_and_biases_has_not_written_yet_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb")
    ledger = showing(start_run(tmp_path / "run"), "wandb")
    continue_run(ledger, TEST, GROWTH)
    sync([ledger])
    (written,) = (ledger.folder / "wandb").glob("offline-run-*/*.wandb")
    whole = written.read_bytes()
    late = tmp_path / "late/wandb/offline-run-1/run-1.wandb"
    late.parent.mkdir(parents=True)
    for size in (7, 100, len(whole) // 2):  # its header, and parts
        late.write_bytes(whole[:size])
        monkeypatch.setattr(wandb, "_PATIENCE", 0.05)
        with pytest.raises(OSError, match="has not written its run within"):
            wandb.await_exit(tmp_path / "late")
    writer = threading.Timer(0.05, late.write_bytes, [whole])
    monkeypatch.setattr(wandb, "_PATIENCE", PATIENCE)
    writer.start()
    wandb.await_exit(tmp_path / "late")
    writer.join()
    assert late.read_bytes() == whole


def test_a_missing_package_is_a_sentence_that_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    refuse_missing(())
    with pytest.raises(ConfigError, match=r"tracking.sinks: wandb needs .* pip install 'space-dist\[wandb\]'"):
        settled(TrackingConfig(uri=None, sinks=("wandb",)), "x")


@pytest.mark.parametrize(("sinks", "words"), [(["tensorbord"], "tensorboard"), (["wandb", "wandb"], "every sink once")])
def test_unknown_sinks_are_refused(sinks: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=rf"grid.yaml: sinks.*{words}"):
        configs.check(GridTracking, {"sinks": sinks}, "grid.yaml")


# ---- MLflow's own variables ------------------------------------------------------------------------------------------


def test_a_config_comes_before_the_environment_and_that_before_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (settled_uri("auto"), settled_uri(None)) == ("sqlite:///mlflow.db", None)
    assert settled_experiment(None, "demo") == "demo"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://host:5000/")
    monkeypatch.setenv("MLFLOW_EXPERIMENT_NAME", "ours")
    assert settled_uri("auto") == "http://host:5000"
    assert settled_uri("sqlite:////a.db") == "sqlite:////a.db"
    assert settled_uri(None) is None
    assert (settled_experiment(None, "demo"), settled_experiment("mine", "demo")) == ("ours", "mine")
    found = settled(TrackingConfig(), "space_dist")
    assert (found.uri, found.experiment) == ("http://host:5000", "ours")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "")
    assert settled_uri("auto") == "sqlite:///mlflow.db"


@pytest.mark.parametrize("uri", ["http://user:word@host:5000", "file:///mlruns", "databricks", "http://["])
def test_what_the_environment_may_not_say_is_refused_without_a_password(
    uri: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    with pytest.raises(ConfigError, match=r"^MLFLOW_TRACKING_URI of the environment.*tracking\.uri: null") as refusal:
        settled(TrackingConfig(), "x")
    assert "word" not in str(refusal.value).replace("PASSWORD", "").replace("password", "")
    assert settled(TrackingConfig(uri=None), "x").uri is None
    monkeypatch.setenv("MLFLOW_EXPERIMENT_NAME", "x" * 201)
    with pytest.raises(ConfigError, match="MLFLOW_EXPERIMENT_NAME"):
        settled(TrackingConfig(uri=None), "x")


def test_numbers_are_kept_as_tensorboard_can(tmp_path: Path) -> None:
    """Its numbers are of 32 bits."""
    pytest.importorskip("tensorboard")
    ledger = showing(start_run(tmp_path / "run"), "tensorboard")
    continue_run(ledger, [math.pi, 1e-3], [[0]], state="interrupted")
    sync([ledger])
    assert [value for _, _, value in events(ledger.folder)["test/return"]] == pytest.approx([math.pi, 1e-3], rel=1e-6)
