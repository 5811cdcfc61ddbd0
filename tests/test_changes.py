"""Grids with other settings than their file has: `--set` for every cell, several grids in one command, a threshold."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from space_dist.api.grids import run_grid
from space_dist.cli.terminal import spread
from space_dist.errors import ConfigError, Interrupted, LedgerError
from space_dist.experiment.manifest import Manifest, find_grid
from space_dist.grid.planning import plan
from space_dist.report import build_grid_report
from tests import prepared
from tests.commanding import command
from tests.grids import TINY, write_grid, write_line_instances
from tests.patience import PATIENCE


def test_a_change_is_of_every_cell_and_in_a_folder_of_its_own(tmp_path: Path) -> None:
    path = write_grid(tmp_path)
    asis, changed = plan(path, tmp_path / "runs"), plan(path, tmp_path / "runs", 1.0, ["learner.gamma=0.5"])
    assert asis.grid.folder != changed.grid.folder
    assert changed.manifest.name.startswith(f"{asis.manifest.name}-set-")
    assert {cell.config["learner"]["gamma"] for cell in changed.manifest.cells} == {0.5}
    assert {cell.config["learner"]["gamma"] for cell in asis.manifest.cells} != {0.5}
    assert [cell.label for cell in asis.manifest.cells] == [cell.label for cell in changed.manifest.cells]


def test_changes_are_the_same_in_any_order(tmp_path: Path) -> None:
    path, changes = write_grid(tmp_path), ["learner.gamma=0.5", "learner.gae_lambda=0.7"]
    one, other = (plan(path, tmp_path / "runs", 1.0, given) for given in (changes, changes[::-1]))
    assert one.grid.folder == other.grid.folder
    assert other.new_runs == 0
    assert plan(path, tmp_path / "runs", 1.0, changes[:1]).grid.folder != one.grid.folder


def test_a_path_at_the_prompt_is_taken_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = tmp_path / "here"
    here.mkdir()
    for name, first in (("train", 0), ("test", 50)):
        rows = "\n".join(f"{first + i},{0.01 * (first + i)},1.0,1.0" for i in range(3))
        (here / f"{name}.csv").write_text(f"id,gate_x,gate_width,friction\n{rows}\n")
    monkeypatch.chdir(here)
    changes = ["instances.train=train.csv", "instances.test=test.csv"]
    manifest = plan(write_grid(tmp_path), tmp_path / "runs", 1.0, changes).manifest
    assert len(manifest.instances) == 2
    [train] = {cell.config["instances"]["train"] for cell in manifest.cells}
    stored = (tmp_path / "runs" / manifest.name / train).read_text()
    assert [line.split(",")[0] for line in stored.splitlines()] == ["id", "0", "1", "2"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("seed=3", "'seeds' is the grid's own"),
        ("tracking.uri=null", "'tracking' is the grid's own"),
        ("name=other", "'name' is the grid's own"),
        ("curriculum.kappa=2", "cells of this grid differ in curriculum.kappa"),
        ("curriculum={kind: uniform}", "cells of this grid differ in curriculum.kappa"),
        ("learner.gama=0.5", r"--set learner.gama=0.5: .*did you mean 'gamma'"),
        ("learner.gamma", "write KEY=VALUE"),
        ("instances.train=nowhere.csv", "nowhere.csv"),
    ],
)
def test_changes_that_are_refused_are_named(tmp_path: Path, change: str, said: str) -> None:
    path = write_grid(tmp_path, grid={"curriculum.kappa": [1, 4]})
    with pytest.raises(ConfigError, match=said):
        plan(path, tmp_path / "runs", 1.0, [change])
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("second", ["learner.gamma=0.7", "learner={gamma: 0.7}"])
def test_one_thing_is_changed_once(tmp_path: Path, second: str) -> None:
    """Else the order would decide, which neither the folder's name nor the report tells."""
    path, first = write_grid(tmp_path), "learner.gamma=0.5"
    for changes in ([first, second], [second, first]):
        with pytest.raises(ConfigError, match="is changed already; change everything once"):
            plan(path, tmp_path / "runs", 1.0, changes)


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("run g.yaml --set a.b=1 c=2 --root r", "run g.yaml --set a.b=1 --set c=2 --root r"),
        ("run g.yaml --set a=1 --set b=2 c=3", "run g.yaml --set a=1 --set b=2 --set c=3"),
        ("run --set a=1 g.yaml h=2", "run --set a=1 g.yaml h=2"),  # behind something else it is nobody's
        ("run --set a=1 x/y=2", "run --set a=1 x/y=2"),
        ("run a=1 --scale 0.5 b=2", "run a=1 --scale 0.5 b=2"),
        ("check --kwarg a=1 b=2", "check --kwarg a=1 --kwarg b=2"),
        ("run g.yaml --set", "run g.yaml --set"),
    ],
)
def test_several_settings_may_stand_behind_one_option(given: str, meant: str) -> None:
    assert spread(given.split()) == meant.split()


def test_a_setting_in_two_words_is_told_that_it_is_one() -> None:
    for option in ("--set", "--kwarg"):
        with pytest.raises(ConfigError, match=f"^{option} a.b 4: write it as one word, with `=`: {option} a.b=4$"):
            spread(["train", "x.yaml", option, "a.b", "4"])
    for words in (["train", "--set", "a.b", __file__], ["train", "--set", "budget.steps", "--seed", "1"]):
        assert spread(words) == words  # which have sentences of their own


def test_a_file_of_such_a_name_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "g=1.yaml").touch()
    assert spread(["--set", "a=1", "g=1.yaml", "b=2"]) == ["--set", "a=1", "g=1.yaml", "b=2"]


def test_several_settings_reach_a_grid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    changes, root = ["learner.gamma=0.5", "learner.gae_lambda=0.7"], tmp_path / "runs"
    path = write_grid(tmp_path)
    assert command(monkeypatch, "grid", "plan", path, "--set", *changes, "--root", root, "--json") == 0
    assert find_grid(path, root, 1.0, changes).manifest().changes == tuple(sorted(changes))
    assert command(monkeypatch, "grid", "plan", path, "learner.gamma=0.5", "--root", root) == 2
    assert "learner.gamma=0.5" in capsys.readouterr().err


def test_a_manifest_knows_its_changes_and_its_threshold(tmp_path: Path) -> None:
    path = write_grid(tmp_path, threshold=0.25)
    for changes in ((), ("learner.gamma=0.5",)):
        manifest = plan(path, tmp_path / "runs", 1.0, changes).manifest
        content = manifest.to_json()
        assert Manifest.from_json(content, "test") == manifest
        assert (manifest.changes, manifest.threshold) == (changes, 0.25)
        assert (b'"changes"' in content) == bool(changes)  # manifests of before have none


def test_changed_grids_are_found_by_their_changes(tmp_path: Path) -> None:
    path, change = write_grid(tmp_path), "learner.gamma=0.5"
    changed = plan(path, tmp_path / "runs", 1.0, [change]).grid
    assert find_grid(path, tmp_path / "runs", 1.0, [change]).folder == changed.folder
    with pytest.raises(LedgerError, match=r"--set learner.gamma=0.25` freezes it there"):
        find_grid(path, tmp_path / "runs", 1.0, ["learner.gamma=0.25"])
    with pytest.raises(LedgerError, match="grid plan"):
        find_grid(path, tmp_path / "runs")
    for frozen in (changed.folder, changed.manifest_file):
        with pytest.raises(ConfigError, match="frozen already, with its settings"):
            find_grid(frozen, tmp_path / "runs", 1.0, [change])


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two grids' files, of two tiny runs each."""
    folder = tmp_path_factory.mktemp("two")
    settings = {**TINY, **write_line_instances(folder)}
    for name in ("one", "other"):
        (folder / name).mkdir()
    return [write_grid(folder / name, name=name, set=settings, seeds=[0], threshold=0.25) for name in ("one", "other")]


def test_several_grids_run_one_after_the_other(
    two: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = two[0].parent / "runs"
    assert command(monkeypatch, "grid", "run", *two, "--root", root) == 0
    told = " ".join(capsys.readouterr().out.split())
    for name in ("one", "other"):
        assert f"{name}: 2 of 2 runs done" in told
        grid = find_grid(root / name, root)
        assert {grid.ledger(run).status().state for run in grid.manifest().runs()} == {"done"}


def test_a_grid_that_a_stop_came_before_is_named(two: list[Path], tmp_path: Path) -> None:
    """The first is done, so that its own exit code would be 0."""
    stop, said = tmp_path / "stop", tmp_path / "said"
    for words, code in (([two[0]], 0), ([*two, "--stop-file", stop], Interrupted.exit_code)):
        process = prepared.command(["grid", "run", *words, "--root", tmp_path], said)
        process.join(PATIENCE)
        assert process.exitcode == code, said.read_text()
        stop.touch()
    assert "stopped before other: run the same command again to go on" in " ".join(said.read_text().split())


@pytest.mark.parametrize("words", [["--part", "0-0"], ["--runs", "0123456789abcdef"]])
def test_what_is_of_one_grid_is_refused_for_two(
    two: list[Path], words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(monkeypatch, "grid", "run", *two, *words, "--root", two[0].parent / "none") == 2
    assert "are of one grid, and here are 2" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("part", ["0", "1-0", f"0-{'9' * 5000}"])
def test_a_part_that_is_none_is_refused(
    two: list[Path], part: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(monkeypatch, "grid", "run", two[0], "--part", part, "--root", two[0].parent / "none") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "write FIRST-LAST, like 0-3" in said
    assert len(said) < 200


def test_a_grid_named_twice_is_refused(
    two: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(monkeypatch, "grid", "run", two[0], two[0], "--root", two[0].parent / "twice") == 2
    assert "name each once" in capsys.readouterr().err


def test_one_faulty_grid_of_two_starts_neither(
    two: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = two[0].parent / "faulty"
    assert command(monkeypatch, "grid", "run", *two, "--set", "learner.gama=1", "--root", root) == 2
    assert "gama" in capsys.readouterr().err
    assert command(monkeypatch, "grid", "run", two[0], two[0].parent / "absent.yaml", "--root", root) == 2
    assert not [*root.glob("*/*/s0")]


def test_reports_say_the_changes_and_count_to_the_files_threshold(
    two: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    change = "learner.gamma=0.5"
    assert command(monkeypatch, "grid", "run", two[0], "--set", change, "--root", tmp_path) == 0
    monkeypatch.setenv("COLUMNS", "200")
    capsys.readouterr()
    assert command(monkeypatch, "grid", "status", two[0], "--set", change, "--root", tmp_path) == 0
    assert command(monkeypatch, "report", two[0], "--set", change, "--root", tmp_path) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert f"Not as the grid's file has it: --set {shlex.quote(change)}." in told
    assert "Threshold of the test return: 0.25" in told.replace("0.250", "0.25")
    grid = find_grid(two[0], tmp_path, 1.0, [change])
    asked = build_grid_report(grid, tmp_path / "report", threshold=0.5)
    assert any("Threshold of the test return: 0.5" in line for line in asked.summary)


def test_python_takes_changes_as_well(two: list[Path], tmp_path: Path) -> None:
    found = run_grid(two[0], root=tmp_path, overrides=["learner.gamma=0.5"], progress=False)
    assert found.complete
    assert found.manifest.changes == ("learner.gamma=0.5",)
