"""Searches: their confirmation, what reports, MLflow and the command say of them."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path

import pytest

from space_dist.cli import terminal
from space_dist.errors import ConfigError
from space_dist.experiment.endings import Cause
from space_dist.experiment.grid_file import GridConfig, load_grid
from space_dist.experiment.manifest import Grid, Run
from space_dist.experiment.sampling import draw, importance
from space_dist.experiment.search import Search, Trial
from space_dist.grid.planning import plan
from space_dist.grid.trials import advance, open_runs
from space_dist.grid.tuning import confirmation, plan_search
from space_dist.ledger import Ledger
from space_dist.report import build_grid_report
from space_dist.report.search_report import build_search_report
from space_dist.tracking import sync
from tests.commanding import command
from tests.test_grid_tracking import levels
from tests.tunes import RATE, ROOT, end, reached, search_of, search_through, write_tune

GOAL = str(ROOT / "configs/instances/pointmass_goal_test.csv")
UNIFORM = str(ROOT / "configs/instances/pointmass_uniform_test.csv")


# ---- the confirmation and the report --------------------------------------------------------------------------------


def test_the_confirmation_is_a_grid_of_the_best_with_fresh_seeds_on_final_instances(tmp_path: Path) -> None:
    path = write_tune(tmp_path, confirm={"seeds": {"start": 100, "count": 3}, "instances": {"test": UNIFORM},
                                         "set": {"budget.steps": 4096}})  # fmt: skip
    root = tmp_path / "runs"
    grid, manifest = search_through(path, root, generations=1)
    with pytest.raises(ConfigError, match="is not over"):
        confirmation(grid, manifest)
    grid, manifest = search_through(path, root)
    written = confirmation(grid, manifest)
    config, _ = load_grid(written)
    assert isinstance(config, GridConfig)
    made = plan(written, root)
    assert made.manifest.seeds == (100, 101, 102)
    assert made.grid.folder == root / "search-confirm"
    for cell in made.manifest.cells:
        best = search_of(manifest).best(cell.label)
        assert best is not None
        run = made.grid.run_config(made.manifest, Run(cell, 100))
        assert run.learner.learning_rate == best.parameters["learner.learning_rate"]
        assert run.budget.steps == 4096
        assert run.curriculum.kind == cell.label
        assert run.instances.test.read_text().splitlines()[1:] == sorted(
            Path(UNIFORM).read_text().splitlines()[1:], key=lambda line: int(line.split(",")[0])
        )


def test_the_report_keeps_search_and_confirmation_apart(tmp_path: Path) -> None:
    path, root = write_tune(tmp_path, trials=20, generation=10, seeds=[0]), tmp_path / "runs"
    grid, manifest = search_through(path, root)
    search = search_of(manifest)
    with pytest.raises(ConfigError, match="space-dist tune report"):
        build_grid_report(grid)
    report = build_search_report(grid)
    assert "not confirmed yet, so there is no number to report" in report.summary[1]
    assert "## Confirmation" not in report.markdown
    assert "## Importance of settings" in report.markdown
    for name in search.arms:
        best = search.best(name)
        assert best is not None
        assert best.value is not None
        assert f"trial {best.number}" in report.markdown
        assert f"{best.value:.2f}" not in report.markdown  # which is the luckiest, and no result
    confirming = plan(confirmation(grid, manifest), root)
    for run in confirming.manifest.runs():
        end(confirming.grid, run, 40.0 + run.seed)
    report = build_search_report(grid)
    assert "## Confirmation" in report.markdown
    assert "141" in report.markdown.partition("## Search")[0]  # the mean of 140, 141 and 142
    assert {path.name for path in report.folder.glob("*.png")} >= {"trials.png", "importance.png", "confirmation.png"}
    rows = (report.folder / "trials.csv").read_text().splitlines()
    assert len(rows) == 41
    again = build_search_report(grid, tmp_path / "again")
    assert again.markdown == report.markdown
    for name in ("importance.png", "trials.csv"):
        assert (again.folder / name).read_bytes() == (report.folder / name).read_bytes()


def test_a_confirmation_of_something_else_is_none(tmp_path: Path) -> None:
    path, root = write_tune(tmp_path), tmp_path / "runs"
    grid, manifest = search_through(path, root)
    written = confirmation(grid, manifest)
    text = (written.parent / "space.yaml").read_text()
    (written.parent / "space.yaml").write_text(re.sub(r"learning_rate: \S+", "learning_rate: 0.5", text))
    plan(written, root)
    assert "has another setting of space" in build_search_report(grid).summary[1]
    confirmation(grid, manifest)
    grids = written.read_text()
    written.write_text(grids.replace("[100, 101, 102]", "[100, 1]"))
    plan(written, root)
    assert "has seeds of the search" in build_search_report(grid).summary[1]


def test_the_report_names_which_step_to_a_confirmation_is_missing(tmp_path: Path) -> None:
    root = tmp_path / "runs"

    def what_is_missing(grid: Grid) -> str:
        return build_search_report(grid).summary[1]

    grid, manifest = search_through(write_tune(tmp_path, trials=2, sampler={"kind": "random"}), root)
    assert f"`space-dist tune confirm {grid.folder}` writes the grid" in what_is_missing(grid)
    written = confirmation(grid, manifest)
    to_run = f"`space-dist grid run {written} --root {root}` runs the grid"
    assert to_run in what_is_missing(grid)
    plan(written, root)
    assert to_run not in what_is_missing(grid)

    before = {arm: search_of(manifest).best(arm) for arm in search_of(manifest).arms}
    grid, manifest = search_through(write_tune(tmp_path, trials=8, sampler={"kind": "random"}), root)
    assert {arm: search_of(manifest).best(arm) for arm in search_of(manifest).arms} != before
    assert f"`space-dist tune confirm {grid.folder}` writes the grid that does it anew" in what_is_missing(grid)
    confirmation(grid, manifest)
    assert "has another setting of" in what_is_missing(grid)
    assert to_run in what_is_missing(grid)
    plan(written, root)
    assert "not confirmed yet" not in what_is_missing(grid)
    written.write_text("seeds: 3\n")
    (root / "search-confirm/manifest.json").unlink()
    assert "tune confirm" in what_is_missing(grid)


def test_importance_finds_what_decides(tmp_path: Path) -> None:
    _, manifest = search_through(
        write_tune(tmp_path, trials=20, generation=20, seeds=[0], search={
            "learner.learning_rate": RATE, "learner.gae_lambda": {"float": [0.8, 0.99]}
        }), tmp_path / "runs",
    )  # fmt: skip
    shares = importance(search_of(manifest), "round_robin")
    assert next(iter(shares)) == "learner.learning_rate"
    assert shares["learner.learning_rate"] > 0.8
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares == importance(search_of(manifest), "round_robin")
    few = search_of(manifest).with_trials(search_of(manifest).trials[:19])
    assert importance(few, "round_robin") == {}


def test_drawing_reads_the_record_alone(tmp_path: Path) -> None:
    """A study is rebuilt from the manifest's bytes: nothing of the one that drew before is needed."""
    _, manifest = search_through(write_tune(tmp_path), tmp_path / "runs", generations=2)
    search = search_of(manifest)
    before = search.with_trials([trial for trial in search.trials if trial.generation < 2])
    reread = Search.from_json(json.loads(json.dumps(before.to_json())))
    asked = [dict(trial.parameters) for trial in search.of_arm("space") if trial.generation == 2]
    assert draw(reread, "space", 2) == asked
    assert isinstance(reread.trials[0], Trial)


def test_mlflow_has_one_run_for_the_search_and_one_for_each_trial(
    uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[Path] = []

    def build(grid: Grid, out: Path) -> None:  # drawing takes seconds
        reported.append(grid.folder)
        (out / "report.html").write_text("a report")

    drawn: list[bool] = []

    def draw(ledger: Ledger, folder: Path, *, episodes: bool) -> list[Path]:  # noqa: ARG001
        drawn.append(episodes)
        return []

    monkeypatch.setattr("space_dist.report.search_report.build_search_report", build)
    monkeypatch.setattr("space_dist.tracking.store.draw", draw)
    path, root = write_tune(tmp_path, seeds=[0], tracking={"uri": uri, "experiment": "demo"}), tmp_path / "runs"
    ids = set()
    for generations in (1, 2):
        grid, manifest = search_through(path, root, generations=generations)
        sync([], grids=[grid])
        parent, trials, runs = levels(uri)
        ids.add(parent.info.run_id)
        begun = [trial for trial in search_of(manifest).trials if trial.state != "open"]
        assert {*trials} == {f"{trial.arm} {trial.number}" for trial in begun}
        assert len(runs) == len(begun)
    assert len(ids) == 1  # though the plan has grown
    assert drawn
    assert not any(drawn)  # drawing what every trial's policy does would take longer than training it
    assert reported == [grid.folder] * 2
    assert parent.data.params["arms"] == "round_robin, space"
    assert trials["space 3"].data.tags["setting.learner.learning_rate"]


# ---- the command ----------------------------------------------------------------------------------------------------


def test_commands_tell_how_a_search_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, root = write_tune(tmp_path), tmp_path / "runs"

    def said(*words: object, code: int = 0) -> str:
        assert command(monkeypatch, "tune", *words, "--root", root) == code
        return capsys.readouterr().out

    assert "tune plan" in _refused(monkeypatch, capsys, "status", path, root)
    planned = json.loads(said("plan", path, "--json"))
    assert (planned["new"], planned["trials_in_all"], len(planned["trials"])) == (True, 12, 4)
    assert "2 arms x 6 trials x 3 seeds = 36 runs" in said("plan", path)
    alone = write_tune(tmp_path / "alone", name="alone", seeds=[0], trials=1)
    assert "2 arms x 1 trial x 1 seed = 2 runs" in said("plan", alone)
    assert "goes on in" in said("plan", path)
    assert "4 of 12 trials asked: 4 open" in said("status", path, code=3)
    underway = said("report", path)
    assert "not confirmed yet" in underway
    assert f"space-dist tune run {root / 'search'}" in " ".join(underway.split())
    for run in open_runs(Grid(root / "search").manifest()):
        end(Grid(root / "search"), run, Cause.NODE_LOST if run.seed == 2 else reached(run))
    said("status", path, code=3)  # it will be tried again
    search_through(path, tmp_path / "done")
    root = tmp_path / "done"
    found = json.loads(said("status", path, "--json"))
    assert (found["over"], found["counts"]) == (True, {"complete": 12})
    assert "report.html" in said("report", root / "search")
    told = " ".join(said("confirm", path).split())
    assert "grid run" in told
    assert f"`space-dist tune report {root / 'search'}` shows it" in told
    assert "12 complete" in said("run", path)  # nothing is left to do
    assert "12 complete" in said(path)  # the same, in short
    assert "12 complete" in said(root / "search")
    assert "12 complete" in said("search")  # by its name below the root
    assert "12 complete" in said("run", "search")
    write_tune(tmp_path, seed=5, trials=8)
    for what in ("status", "report"):
        assert command(monkeypatch, "tune", what, path, "--root", root) == 0
        told = " ".join(capsys.readouterr().err.split())
        assert f"tune.yaml has another seed and 1 other key than the search that {root / 'search'} holds" in told
    write_tune(tmp_path)
    assert "141" not in said("report", path)
    confirming = plan(root / "search/confirm/search-confirm.yaml", root)
    for run in confirming.manifest.runs():
        end(confirming.grid, run, 40.0 + run.seed)
    assert "141" in said("report", path)  # the mean of 140, 141 and 142, as in report.html
    assert command(monkeypatch, "grid", "run", root / "search") == 2
    assert "holds a search: space-dist tune run" in capsys.readouterr().err
    assert command(monkeypatch, "slurm", "export", root / "search", "--out", tmp_path / "out") == 2
    assert "holds a search that has begun" in capsys.readouterr().err


def test_a_missing_optuna_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("space_dist.grid.tuning", "space_dist.experiment.sampling"):
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert command(monkeypatch, "tune", "plan", write_tune(tmp_path)) == 2
    assert "a search needs Optuna: pip install 'space-dist[tune]'" in capsys.readouterr().err


def test_a_search_without_a_cell_can_be_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every setting of the generation was refused."""
    made = plan_search(write_tune(tmp_path), tmp_path)
    search = search_of(made.manifest)
    refused = [dataclasses.replace(trial, cell="", state="failed") for trial in search.trials]
    manifest = dataclasses.replace(made.manifest, cells=(), baseline="", search=search.with_trials(refused))
    made.grid.freeze(manifest, {})
    assert command(monkeypatch, "grid", "status", made.grid.folder) == 0
    assert "has no cells yet" in capsys.readouterr().out
    assert "Failed trials" in build_search_report(made.grid).markdown
    after = advance(made.grid, manifest)
    assert after is not None
    assert len(search_of(after).open) == 4


def test_no_number_of_a_setting_is_broken_whatever_the_width(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    named = "learning_progress_with_a_name_of_some_length"
    arms = {"space": {"set": {"curriculum": {"kind": "space"}}}, named: {"set": {"curriculum": {"kind": "space"}}}}
    path = write_tune(tmp_path, arms=arms, generation=1)
    for columns in (80, 200):
        monkeypatch.setattr(terminal.console, "_width", columns)  # COLUMNS is read when it is made
        assert command(monkeypatch, "tune", "plan", path, "--root", tmp_path / str(columns)) == 0
        told = capsys.readouterr().out
        rates = [trial.parameters["learner.learning_rate"]
                 for trial in search_of(Grid(tmp_path / f"{columns}/search").manifest()).trials]  # fmt: skip
        assert all(re.search(rf"learning_rate={rate}\b", told) for rate in rates)
        in_lines = f"{named}, trial 0\n  state open, seeds 3\n  learning_rate="
        assert (in_lines in told) == (columns == 80)


def _refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], what: str, path: Path, root: Path
) -> str:
    assert command(monkeypatch, "tune", what, path, "--root", root) == 2  # 1: runs of it have failed
    return capsys.readouterr().err
