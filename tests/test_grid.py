"""Grids: the file, the manifest, cell ids, and where runs stand."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from space_dist import config as configs
from space_dist.api.grids import frozen
from space_dist.cli.grids import grid_retry
from space_dist.cli.overview import _live_table, print_failures
from space_dist.errors import ConfigError, LedgerError, NotPlannedError
from space_dist.experiment.endings import Cause, Ended
from space_dist.experiment.grid_file import GridConfig, label_of
from space_dist.experiment.manifest import Grid, Manifest, Run, find_grid
from space_dist.experiment.status import (
    Attempts,
    exit_code,
    last_lines,
    run_status_of,
    run_statuses,
)
from space_dist.grid.conductor import Overview
from space_dist.grid.planning import plan
from space_dist.ledger import METRICS, Lock, RunWriter
from space_dist.slurm.export import JOBS
from space_dist.slurm.queue import queue_of
from space_dist.system.interrupts import StopRequests
from space_dist.system.provenance import source_digest
from tests.commanding import command
from tests.grids import ROOT, SMALL, SPACE, TINY, write_grid, write_line_instances
from tests.test_report import start_run

CODE = "0" * 16


def refusal(folder: Path, **sections: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        plan(write_grid(folder, **sections), folder / "runs")
    return str(caught.value)


def ids(folder: Path, **sections: Any) -> list[str]:
    folder.mkdir(exist_ok=True, parents=True)
    return [cell.id for cell in plan(write_grid(folder, **sections), folder / "runs").manifest.cells]


# ---- the file -------------------------------------------------------------------------------------------------------


def test_cells_are_products_and_zips_without_what_is_excluded(tmp_path: Path) -> None:
    made = plan(
        write_grid(
            tmp_path,
            grid={"curriculum.kappa": [1, 4], "curriculum.eta": [0.05, 0.1]},
            zip={"learner.gamma": [0.9, 0.95], "learner.gae_lambda": [0.8, 0.99]},
            exclude=[{"curriculum.kappa": 4, "curriculum.eta": 0.05}, {"learner.gamma": 0.9, "curriculum.kappa": 1}],
            seeds={"start": 5, "count": 3},
        ),
        tmp_path / "runs",
    )  # fmt: skip
    settings = [tuple(cell.settings[axis] for axis in made.manifest.axes) for cell in made.manifest.cells]
    assert made.manifest.axes == ("learner.gamma", "learner.gae_lambda", "curriculum.kappa", "curriculum.eta")
    assert settings == [(0.9, 0.8, 4, 0.1), (0.95, 0.99, 1, 0.05), (0.95, 0.99, 1, 0.1), (0.95, 0.99, 4, 0.1)]
    assert [run.seed for run in made.manifest.runs()] == [5] * 4 + [6] * 4 + [7] * 4
    assert made.manifest.cells[0].label == "gamma=0.9 gae_lambda=0.8 kappa=4 eta=0.1"
    assert made.steps == 12 * 2048
    config = made.grid.run_config(made.manifest, made.manifest.runs()[0])
    assert (config.learner.gamma, config.seed, config.tracking.live) == (0.9, 5, False)


def test_several_bases_and_whole_sections_are_axes(tmp_path: Path) -> None:
    bases = [str(SPACE), str(ROOT / "configs/pointmass_round_robin.yaml")]
    made = plan(write_grid(tmp_path, extends=bases, grid={"learner.gamma": [0.9]}), tmp_path / "runs").manifest
    assert [cell.label for cell in made.cells] == ["pointmass_space gamma=0.9", "pointmass_round_robin gamma=0.9"]
    assert made.baseline == made.cells[1].id
    sections = [{"kind": "space", "eta": 0.05}, {"kind": "random_growth"}, {"kind": "fixed", "ids": [1, 2]}]
    made = plan(write_grid(tmp_path, grid={"curriculum": sections}), tmp_path / "runs").manifest
    assert [cell.label for cell in made.cells] == ["space eta=0.05", "random_growth", "fixed ids=[1,2]"]


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"grid": {"curriculum.kapa": [1]}}, ("curriculum.kapa", "did you mean 'kappa'", "cell")),
        ({"grid": {"curriculum.kappa": []}}, ("curriculum.kappa", "at least one value")),
        ({"grid": {"curriculum.kappa": 3}}, ("curriculum.kappa", "list")),
        ({"grid": {"seed": [1, 2]}}, ("grid.seed", "'seeds'")),
        ({"set": {"tracking.uri": None, "name": "x"}}, ("set.tracking.uri", "'tracking'")),
        ({"zip": {"learner.gamma": [0.9], "learner.gae_lambda": [0.8, 0.9]}}, ("equally long", "gamma 1")),
        ({"zip": {"curriculum.kappa": [0.9]}}, ("curriculum.kappa", "twice")),
        ({"exclude": [{"curriculum.kappa": 3}]}, ("exclude", "matches no cell")),
        ({"exclude": [{"curriculum.kapa": 1}]}, ("curriculum.kapa", "did you mean 'curriculum.kappa'")),
        ({"exclude": [{"curriculum.kappa": 1}, {"curriculum.kappa": 4}]}, ("leaves no cell",)),
        ({"grid": {"curriculum.kappa": [1, 1]}}, ("same run config",)),
        ({"seeds": [1, 1]}, ("seeds", "once")),
        ({"seeds": {"count": 0}}, ("seeds", "must be a whole number from 1 to 100,000, not 0")),
        ({"seeds": {"count": 60000}}, ("more than 100,000 runs",)),
        ({"seeds": 3}, ("seeds: write a list, like [0, 1, 2], or a range", "not 3")),
        ({"seeds": [0, -1]}, ("seeds.1: must be", "not -1")),
        ({"seeds": {"start": 2**31 - 1, "count": 2}}, ("seeds: the last seed would be 2147483648",)),
        ({"seeds": {"start": 0, "cout": 2}}, ("seeds.cout", "did you mean 'count'")),
        ({"name": "../x"}, ("name",)),
        ({"nme": "x"}, ("nme", "did you mean 'name'")),
        ({"extends": "nowhere.yaml"}, ("nowhere.yaml", "does not exist")),
        ({"baseline": {"curriculum.kappa": 9}}, ("baseline", "0 cells")),
        ({"retry": {"config_error": 1}}, ("retry.config_error", "unknown key")),
        ({"resources": {"memory_mb": 1}}, ("resources.memory_mb",)),
        ({"tracking": {"uri": "file:///x"}}, ("tracking.uri", "sqlite")),
        ({"grid": {"rollout.shards": [3]}}, ("n_steps", "multiple")),
        ({"set": {"budget.steps": 100}}, ("budget.steps",)),
        ({"set": {**SMALL, "instances.train": "gone.csv"}}, ("gone.csv", "instances.train")),
    ],
)  # fmt: skip
def test_faults_are_named(sections: dict[str, Any], words: tuple[str, ...], tmp_path: Path) -> None:
    text = refusal(tmp_path, **sections)
    assert all(word in text for word in words), text
    assert "grid.yaml" in text or "nowhere.yaml" in text
    assert len(text) < 3000
    assert not list(tmp_path.glob("runs/*/manifest.json"))


def test_every_field_of_a_grid_is_explained() -> None:
    for model in [GridConfig, *(field.annotation for field in GridConfig.model_fields.values())]:
        for name, field in getattr(model, "model_fields", {}).items():
            inner = hasattr(field.annotation, "model_fields")
            assert inner or len(field.description or "") > 10, name


# ---- cell ids -------------------------------------------------------------------------------------------------------


def test_cell_ids_survive_what_decides_no_result(tmp_path: Path) -> None:
    before = ids(tmp_path / "a")
    full = configs.load(SPACE).model_dump(mode="json")
    full["tracking"]["uri"], full["resources"]["workers"], full["checkpoint"]["every_rounds"] = None, 3, 7
    rng = random.Random(3)
    keys = sorted(full, key=lambda _: rng.random())
    everything = tmp_path / "everything.yaml"  # other order, every default written out, elsewhere
    everything.write_text(configs.to_yaml({key: full[key] for key in keys} | {"name": "other"}))
    moved = tmp_path / "moved.csv"
    lines = Path(full["instances"]["train"]).read_text().splitlines()
    moved.write_text("\n".join([lines[0], *sorted(lines[1:], key=lambda _: rng.random())]) + "\n")
    settings = {**SMALL, "checkpoint.every_rounds": 9, "instances.train": str(moved), "learner.gamma": 0.95}
    after = ids(
        tmp_path / "b", name="elsewhere", extends=str(everything), set=settings, seeds=[7],
        resources={"workers": 2, "memory_mb": 500}, retry={"crash": 3}, tracking={"uri": "http://localhost:1"},
    )  # fmt: skip
    assert after == before


@pytest.mark.parametrize(
    "change",
    [
        {"learner.gamma": 0.9}, {"curriculum.eta": 0.2}, {"env.context_visible": False}, {"rollout.slots": 1},
        {"evaluation.every_steps": 1000}, {"env.kwargs": {}}, {"budget.steps": 4096},
    ],
)  # fmt: skip
def test_cell_ids_change_with_what_decides_results(change: dict[str, Any], tmp_path: Path) -> None:
    settings = {**SMALL, "curriculum.allow_context_blind": True}
    before, after = ids(tmp_path / "a", set=settings), ids(tmp_path / "b", set={**settings, **change})
    assert (before == after) == (change == {"env.kwargs": {}})  # which is the default


def test_a_column_that_one_cell_reads_is_no_other_cells(tmp_path: Path) -> None:
    """The same file, of which only the first has a column beside the features."""
    instances = write_line_instances(tmp_path)
    train = Path(instances["instances.train"])
    head, *lines = train.read_text().splitlines()
    train.write_text("\n".join([f"{head},effort", *(f"{line},1" for line in lines)]) + "\n")
    curricula = [{"kind": "manual", "column": "effort"}, {"kind": "space"}]
    path = write_grid(tmp_path, set={**TINY, **instances}, grid={"curriculum": curricula})
    with pytest.raises(ConfigError, match="effort"):
        plan(path, tmp_path / "runs")


def test_cell_ids_change_with_an_edited_instance_file(tmp_path: Path) -> None:
    copy = tmp_path / "train.csv"
    text = (ROOT / "configs/instances/pointmass_uniform_train.csv").read_text()
    copy.write_text(text)
    settings = {**SMALL, "instances.train": str(copy)}
    before = ids(tmp_path / "a", set=settings)
    assert before == ids(tmp_path / "b")
    lines = text.splitlines()
    cells = lines[1].split(",")
    cells[1] = str(float(cells[1]) + 1e-9)
    copy.write_text("\n".join([lines[0], ",".join(cells), *lines[2:]]) + "\n")
    assert ids(tmp_path / "c", set=settings) != before


def test_cell_ids_change_with_an_edited_user_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "my_line"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "env.py").write_text("from tests.tiny_env import make\n")
    (package / "physics.py").write_text("GRAVITY = 9.81\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    settings = {**TINY, "env": {"id": "my_line.env:make"}, **write_line_instances(tmp_path)}
    before = ids(tmp_path / "a", set=settings)
    assert ids(tmp_path / "b", set=settings) == before
    (package / "physics.py").write_text("GRAVITY = 9.80\n")
    assert ids(tmp_path / "c", set=settings) != before


def test_a_single_module_and_a_missing_one_have_their_digests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lone_env.py").write_text("a = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    before = source_digest("lone_env:make")
    (tmp_path / "lone_env.py").write_text("a = 2\n")
    assert source_digest("lone_env:make") != before
    with pytest.raises(ConfigError, match="no module 'nowhere_env'"):
        source_digest("nowhere_env:make")


# ---- the manifest ---------------------------------------------------------------------------------------------------


def test_a_manifest_is_complete_and_always_the_same_bytes(tmp_path: Path) -> None:
    path = write_grid(tmp_path)
    made = plan(path, tmp_path / "runs")
    content = made.grid.manifest_file.read_bytes()
    assert plan(path, tmp_path / "runs").new_runs == 0
    assert made.grid.manifest_file.read_bytes() == content
    assert plan(path, tmp_path / "other").grid.manifest_file.read_bytes() == content
    assert Manifest.from_json(content, "it") == made.manifest
    moved = tmp_path / "moved"
    made.grid.folder.rename(moved)
    config = Grid(moved).run_config(made.manifest, made.manifest.runs()[3])
    assert config.instances.train.parent == moved / "instances"
    assert (config.seed, config.curriculum.kind) == (1, "space")


def test_a_grid_can_grow_and_keeps_what_it_has(tmp_path: Path) -> None:
    first = plan(write_grid(tmp_path), tmp_path / "runs")
    second = plan(write_grid(tmp_path, seeds=[0, 1, 2], grid={"curriculum.kappa": [4, 16]}), tmp_path / "runs")
    assert (second.new_runs, second.dropped_runs) == (4, 2)
    assert first.manifest.cells[1] == second.manifest.cells[0]
    lock = Lock(second.grid.lock_file)
    lock.acquire()
    try:
        with pytest.raises(ConfigError, match="somebody is working on it now"):
            plan(write_grid(tmp_path, seeds=[9]), tmp_path / "runs")
        assert plan(write_grid(tmp_path, seeds=[0, 1, 2], grid={"curriculum.kappa": [4, 16]}), tmp_path / "runs")
    finally:
        lock.release()


def test_a_changed_manifest_is_refused(tmp_path: Path) -> None:
    grid = plan(write_grid(tmp_path), tmp_path / "runs").grid
    content = grid.manifest_file.read_bytes()
    rng = random.Random(0)
    for position in rng.sample(range(len(content)), 60):
        for changed in (content[:position], content[:position] + b"#" + content[position + 1 :]):
            if changed.strip() == content.strip():
                continue
            grid.manifest_file.write_bytes(changed)
            with pytest.raises(LedgerError, match=r"damaged|format"):
                grid.manifest()
    data = json.loads(content)
    for forged in ([], 3, {}, {**data, "format": 99}, {**data, "cells": [{"id": "../x"}]}):
        grid.manifest_file.write_text(json.dumps(forged))
        with pytest.raises(LedgerError, match=r"damaged|format"):
            grid.manifest()
    grid.manifest_file.write_bytes(content)
    changed_file = next(grid.instances.glob("*.csv"))
    changed_file.write_text(changed_file.read_text() + "\n")
    with pytest.raises(LedgerError, match="changed since the grid was frozen"):
        grid.instance_files(grid.manifest())


def test_cells_and_grids_are_found_by_what_users_type(tmp_path: Path) -> None:
    path = write_grid(tmp_path)
    with pytest.raises(LedgerError, match="grid plan"):
        find_grid(path, tmp_path / "runs")
    grid, manifest = (made := plan(path, tmp_path / "runs")).grid, made.manifest
    for name in (path, grid.folder, grid.manifest_file):
        assert find_grid(name, tmp_path / "runs").folder == grid.folder
    assert find_grid(Path(grid.folder.name), tmp_path / "runs").folder == grid.folder  # by its name
    assert frozen(Path(grid.folder.name), tmp_path / "runs")[0].folder == grid.folder
    with pytest.raises(ConfigError, match=r"smal is neither here nor a grid in .*did you mean 'small'"):
        frozen(Path("smal"), tmp_path / "runs")
    with pytest.raises(ConfigError, match="is frozen already"):
        find_grid(Path(grid.folder.name), tmp_path / "runs", 0.5)
    cell = manifest.cells[1]
    assert manifest.cell("kappa=4") == manifest.cell(cell.id) == manifest.cell(cell.id[:6]) == cell
    with pytest.raises(ConfigError, match="did you mean 'kappa=4'"):
        manifest.cell("kapa=4")
    with pytest.raises(ConfigError, match=r"no cell 'zz'\. It has 'kappa=1', 'kappa=4'$"):
        manifest.cell("zz")
    labels = ("round_robin", "space eta=0.1 kappa=1", "vds")
    words = dataclasses.replace(manifest, cells=tuple(dataclasses.replace(cell, label=label) for label in labels))
    meant_by = {"spcae": labels[1], "robni": labels[0], "vsd": "vds", "VDS": "vds", "eat": labels[1]}
    for typed, meant in meant_by.items():
        with pytest.raises(ConfigError, match=f"small has no cell '{typed}'; did you mean '{meant}'[?] It has 'round_"):
            words.cell(typed)
    with pytest.raises(NotPlannedError, match=r"/smal does not exist; did you mean 'small'[?]$"):
        find_grid(tmp_path / "runs/smal", tmp_path / "runs")
    with pytest.raises(ConfigError, match="no seed 7; it has 0, 1"):
        manifest.run("kappa=4", 7)
    with pytest.raises(ConfigError, match="'kappa=4' of small has 2 seeds: choose one with --seed: 0, 1"):
        manifest.run("kappa=4", None)
    single = dataclasses.replace(manifest, seeds=(5,))
    assert single.run("kappa=4", None) == Run(cell, 5)
    named = [cell for cell in manifest.cells if cell.label.startswith("k")]
    assert len(named) > 1
    said = ", ".join(f"{cell.label!r} ({cell.id})" for cell in named)
    with pytest.raises(ConfigError) as ambiguous:
        manifest.cell("k")
    assert f"'k' is ambiguous: {len(named)} cells of {manifest.name} begin so: {said}. Give" in str(ambiguous.value)
    with pytest.raises(LedgerError, match="no grid"):
        find_grid(tmp_path, tmp_path / "runs")


def test_ten_thousand_runs_are_planned_and_shown(tmp_path: Path) -> None:
    kappas, etas = list(range(1, 26)), [round(0.01 * step, 2) for step in range(1, 41)]
    path = write_grid(
        tmp_path, grid={"curriculum.kappa": kappas, "curriculum.eta": etas}, seeds={"count": 10}
    )  # fmt: skip
    made = plan(path, tmp_path / "runs")
    found = run_statuses(made.grid, made.manifest, CODE)
    assert (len(made.manifest.cells), len(found), exit_code(found)) == (1000, 10_000, 3)
    assert len({cell.id for cell in made.manifest.cells}) == len({cell.label for cell in made.manifest.cells}) == 1000
    with pytest.raises(ConfigError, match=r"^'kappa=3 ' is ambiguous: 40 cells of small begin so: 'k.* and 35 more\. "):
        made.manifest.cell("kappa=3 ")
    twin = max(cells := [cell.id[:2] for cell in made.manifest.cells], key=cells.count)
    with pytest.raises(ConfigError, match=f"^'{twin}' is ambiguous"):
        made.manifest.cell(twin)


# ---- where runs stand -----------------------------------------------------------------------------------------------


@pytest.fixture
def one(tmp_path: Path) -> tuple[Grid, Manifest, Run]:
    made = plan(write_grid(tmp_path, retry={"crash": 1, "killed": 0}), tmp_path / "runs")
    return made.grid, made.manifest, made.manifest.runs()[0]


def run_status(one: tuple[Grid, Manifest, Run]) -> tuple[str, Cause | None]:
    grid, manifest, run = one
    found = run_status_of(run, grid.ledger(run), manifest.retry, CODE)
    return found.condition, found.cause


def test_conditions_follow_the_history_of_attempts(one: tuple[Grid, Manifest, Run]) -> None:
    grid, _, run = one
    attempts = Attempts(grid.ledger(run))
    assert run_status(one) == ("waiting", None)
    attempts.begin(1, {})
    assert run_status(one) == ("running", None)  # this process has begun it, and lives
    attempts.end(1, Ended(Cause.CRASH, "oh"))
    assert run_status(one) == ("waiting", Cause.CRASH)
    attempts.begin(2, {})
    attempts.end(2, Ended(Cause.PREEMPTED))
    assert run_status(one) == ("waiting", Cause.PREEMPTED)
    attempts.begin(3, {})
    attempts.end(3, Ended(Cause.CRASH, "oh again"))
    assert run_status(one) == ("failed", Cause.CRASH)
    attempts.forgive()
    assert run_status(one) == ("waiting", None)
    attempts.end(4, Ended(Cause.KILLED))
    assert run_status(one) == ("failed", Cause.KILLED)
    attempts.forgive()
    attempts.end(5, Ended(Cause.CONFIG_ERROR, "bad"))
    assert run_status(one) == ("failed", Cause.CONFIG_ERROR)
    attempts.end(6, Ended(Cause.STOPPED))
    assert run_status(one) == ("waiting", Cause.STOPPED)


def test_a_supervisor_that_is_gone_leaves_a_killed_run(one: tuple[Grid, Manifest, Run]) -> None:
    grid, _, run = one
    code = f"""
from pathlib import Path
from space_dist.ledger import Ledger
from space_dist.experiment.status import Attempts
Attempts(Ledger({str(grid.ledger(run).folder)!r})).begin(1, {{}})
"""
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert run_status(one) == ("waiting", Cause.KILLED)


def test_torn_and_foreign_rows_are_passed_over(one: tuple[Grid, Manifest, Run]) -> None:
    grid, _, run = one
    attempts = Attempts(grid.ledger(run))
    attempts.begin(1, {})
    attempts.end(1, Ended(Cause.CRASH, "oh"))
    content = attempts.path.read_bytes()
    for length in range(len(content) + 1):
        attempts.path.write_bytes(content[:length])
        attempts.history()
        attempts.end(2, Ended(Cause.TIMEOUT, "x"))
        last = attempts.history().last
        assert last is not None
        assert last.cause is Cause.TIMEOUT
    attempts.path.write_bytes(b'{"event":"end"}\n\xff\xfe\n[]\n' + content)
    assert attempts.history().begun == 1


def test_a_damaged_status_is_a_failure_that_says_so(
    one: tuple[Grid, Manifest, Run], capsys: pytest.CaptureFixture[str]
) -> None:
    """To forgive would change nothing: what to do is told instead."""
    grid, manifest, run = one
    ledger = grid.ledger(run)
    ledger.folder.mkdir(parents=True)
    ledger.status_file.write_text("{}")
    found = run_status_of(run, ledger, manifest.retry, CODE)
    assert (found.condition, found.cause, "damaged" in found.detail) == ("failed", Cause.UNREADABLE, True)
    grid_retry(grid.folder, ["unreadable"])
    said = " ".join(capsys.readouterr().out.split())
    assert f"remove {ledger.folder}, and it begins anew" in said
    assert said.endswith("0 runs may be tried again")
    assert not Attempts(ledger).path.exists()
    ledger.status_file.unlink()
    assert run_status_of(run, ledger, manifest.retry, CODE).condition == "waiting"


def test_last_lines_of_anything(tmp_path: Path) -> None:
    path = tmp_path / "x"
    assert last_lines(path) == []
    path.write_bytes(b"a\n\n" * 100_000 + b"\xff\nlast\n")
    assert last_lines(path, 2) == ["\ufffd", "last"]


def test_a_stopped_run_lacks_no_explanation(
    one: tuple[Grid, Manifest, Run], capsys: pytest.CaptureFixture[str]
) -> None:
    grid, manifest, run = one
    attempts = Attempts(grid.ledger(run))
    said = {}
    for number, cause in enumerate((Cause.STOPPED, Cause.KILLED), 1):
        attempts.begin(number, {})
        attempts.end(number, Ended(cause))
        print_failures(run_statuses(grid, manifest, CODE), by_cause=False)
        said[cause] = capsys.readouterr().out
    assert said[Cause.STOPPED].rstrip().endswith("waiting: stopped")
    what, way = said[Cause.KILLED].splitlines()
    assert what.endswith("failed: killed by an unknown hand; no more is known")
    assert way == f"`space-dist grid retry {grid.folder} --cause killed` gives another try"


def between_looks(monkeypatch: pytest.MonkeyPatch, then: Mapping[int, Callable[[], object]], most: int) -> list[int]:
    """How often a command that watches has looked; `then`: what happens behind its n-th look."""
    looks = [0]

    def look(seconds: float) -> None:  # noqa: ARG001 - the signature is `time.sleep`'s
        looks[0] += 1
        then.get(looks[0], lambda: None)()
        assert looks[0] < most

    monkeypatch.setattr("space_dist.cli.grids.time.sleep", look)
    return looks


def test_watching_from_a_pipe_prints_what_has_changed(
    one: tuple[Grid, Manifest, Run], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, _, run = one
    lock, attempts = Lock(grid.lock_file), Attempts(grid.ledger(run))
    looks = between_looks(monkeypatch, {
        3: lock.acquire, 6: lambda: attempts.begin(1, {}), 8: lambda: attempts.end(1, Ended(Cause.STOPPED)),
        9: lock.release,
    }, most=20)  # fmt: skip
    assert command(monkeypatch, "grid", "status", grid.folder, "--watch") == 3
    assert looks[0] > 8
    assert 3 <= capsys.readouterr().out.count("runs done") <= 5


def test_a_row_of_the_display_is_as_far_as_its_evaluation(one: tuple[Grid, Manifest, Run]) -> None:
    """An evaluation may come before the first iteration ends, with which its set is written."""
    grid, manifest, run = one
    ledger = start_run(grid.ledger(run).folder)
    with RunWriter(ledger) as writer:
        writer.status = ledger.status()
        writer.append(METRICS, {"kind": "evaluation", "steps": 2048, "test": {"return": 4.16}})
    overview = Overview(total=1, steps_left=4096, running=[run])
    shown = Console(file=io.StringIO(), width=200)
    shown.print(_live_table(manifest, grid, overview, ""))
    told = " ".join(shown.file.getvalue().split())  # type: ignore[attr-defined]
    assert f"2,048 of {run.cell.steps_to_take:,} steps set — test return 4.16" in told


def test_following_a_run_ends_when_nobody_works_any_more(
    one: tuple[Grid, Manifest, Run], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, _, run = one
    lock = Lock(grid.lock_file)
    looks = between_looks(monkeypatch, {3: lock.acquire, 5: lock.release}, most=10)
    monkeypatch.setattr("space_dist.cli.grids.STOP", StopRequests())
    follow = ("grid", "logs", grid.folder, "kappa=1", "--seed", run.seed, "--follow")
    assert command(monkeypatch, *follow) == 0
    assert looks[0] == 6  # somebody was waited for, who came, and was gone at two looks
    Attempts(grid.ledger(run)).begin(1, {})
    Attempts(grid.ledger(run)).end(1, Ended(Cause.STOPPED))
    looks[0] = 6
    assert command(monkeypatch, *follow) == 0
    assert looks[0] == 7  # somebody had begun it
    said = capsys.readouterr().err
    assert said.count("nobody works on the grid any more") == 2
    assert f"going on with it: `space-dist grid run {grid.folder}`" in said


def test_what_an_earlier_attempt_has_printed_does_not_pass_for_the_last_ones(
    one: tuple[Grid, Manifest, Run], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, _, run = one
    ledger = grid.ledger(run)
    Attempts(ledger).begin(1, {})
    output = ledger.folder / "output.txt"
    output.write_text("Traceback of the first\n")
    ledger.log.write_text("log of both\n")
    os.utime(output, (before := time.time() - 60.0, before))
    logs = ("grid", "logs", grid.folder, "kappa=1", "--seed", run.seed)
    assert command(monkeypatch, *logs) == 0
    assert capsys.readouterr().out == "log of both\nTraceback of the first\n"  # as long as there is no other
    Attempts(ledger).begin(2, {})
    assert command(monkeypatch, *logs) == 0
    said = capsys.readouterr()
    assert said.out == "log of both\n"
    assert f"what an earlier attempt printed beside its log is in {output}\n" in said.err
    with output.open("a") as file:
        file.write("Traceback of the second\n")
    os.utime(output, (after := time.time() + 1.0, after))
    assert command(monkeypatch, *logs) == 0
    said = capsys.readouterr()
    assert said.out == "log of both\nTraceback of the first\nTraceback of the second\n"
    assert "earlier attempt" not in said.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("grid", "run", "GRID", "--address", "foo:bar:baz"),
         "--address must be local, auto or HOST:PORT, not 'foo:bar:baz'"),
        (("grid", "run", "GRID", "--address", "http://x"),
         "--address must be local, auto or HOST:PORT (a job server has http://HOST:PORT, which "
         "`grid submit --address` takes), not 'http://x'"),
        (("tune", "run", "GRID", "--address", "atuo"),
         "--address must be local, auto or HOST:PORT (did you mean 'auto'?), not 'atuo'"),
        *(((*named, "GRID", "--address", "head:8265"),
           "--address 'head:8265' is no job server: http://HOST:PORT, like http://127.0.0.1:8265")
          for named in (("grid", "submit"), ("grid", "status"), ("grid", "stop"))),
    ],
)  # fmt: skip
def test_a_wrong_address_is_refused_before_anything_is_printed_or_written(
    arguments: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    path = write_grid(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    named = [str(path) if one == "GRID" else one for one in arguments]
    assert command(monkeypatch, *named, "--root", tmp_path / "runs") == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", f"space-dist: {said}\n")
    assert sorted(tmp_path.rglob("*")) == before


def test_the_log_of_a_run_that_ends_by_episodes_ends_with_these(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = dict(SMALL) | {"budget.episodes": 40}
    grid = plan(write_grid(tmp_path, set=limits, seeds=[0]), tmp_path / "runs").grid
    assert command(monkeypatch, "grid", "logs", grid.folder, "kappa=1") == 0
    assert f"waiting, 0 of {SMALL['budget.steps']:,} steps, 0 of 40 episodes. " in capsys.readouterr().err


def test_a_plan_tells_budgets_from_the_updates_that_fit_into_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An update takes 1,024 steps; cells show budgets. What may probe may leave room for fewer."""
    path = write_grid(tmp_path, set=dict(SMALL) | {"budget.steps": 2500}, seeds=[0])
    assert command(monkeypatch, "grid", "plan", path, "--root", tmp_path / "runs") == 0
    said = capsys.readouterr().out
    fit = "= 2 runs, 4,096 environment steps in whole updates (budgets: 5,000, which no further update fits into); "
    assert fit in said
    assert said.count("0% of 2,500") == 2

    probing = {"curriculum": {"kind": "learnability"}}
    path = write_grid(tmp_path, set=dict(SMALL) | probing, seeds=[0], grid={"learner.gamma": [0.9, 0.99]})
    assert command(monkeypatch, "grid", "plan", path, "--root", tmp_path / "runs") == 0
    assert "= 2 runs, at most 4,096 environment steps in whole updates; " in capsys.readouterr().out


def test_episodes_that_end_runs_are_planned_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_grid(tmp_path, set=dict(SMALL) | {"budget.episodes": 40}, seeds=[0])
    assert command(monkeypatch, "grid", "plan", path, "--root", tmp_path / "runs") == 0
    said = capsys.readouterr().out
    assert "environment steps in whole updates, or 40 episodes a run; " in said
    assert said.count("at most 40 episodes a run") == len(plan(path, tmp_path / "runs").manifest.cells)


def test_a_folder_of_grids_that_is_named_as_one_is_told_which_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("one", "two"):
        plan(write_grid(tmp_path, name=name), tmp_path / "runs")
    assert command(monkeypatch, "grid", "status", tmp_path / "runs") == 2
    named = f"{tmp_path / 'runs/one'}, {tmp_path / 'runs/two'}"
    said = capsys.readouterr().err
    assert f"it has no manifest.json; 2 folders below it do, of which one is to be named: {named}" in said


def test_a_pipe_in_a_grids_folder_keeps_nobody_waiting(tmp_path: Path) -> None:
    made = plan(write_grid(tmp_path), tmp_path / "runs")
    grid, ledger = made.grid, made.grid.ledger(made.manifest.runs()[0])
    ledger.folder.mkdir(parents=True)
    attempts, instances = Attempts(ledger), grid.instances / next(iter(made.manifest.instances))
    for path in (attempts.path, instances, grid.folder / JOBS, grid.manifest_file):
        path.unlink(missing_ok=True)
        os.mkfifo(path)
    for read in (attempts.rows, lambda: grid.instance_files(made.manifest), grid.manifest):
        with pytest.raises(LedgerError, match="is no regular file"):
            read()
    assert queue_of(grid.folder) is None
    assert last_lines(attempts.path) == []


@pytest.mark.parametrize(
    ("instances", "label"),
    [
        ({"train": "../sets/maze_dfs_train.csv", "test": "../sets/maze_dfs_test.csv"}, "maze_dfs kappa=4"),
        ({"train": "a_train.csv", "test": "b_test.csv"}, "train=a_train test=b_test kappa=4"),
        ({"train": "sets/one.csv"}, "train=one kappa=4"),
    ],
)
def test_cells_are_called_by_their_instance_sets(instances: dict[str, str], label: str) -> None:
    point = {"instances": instances, "curriculum.kappa": 4}
    assert label_of(point, list(point)) == label
