"""Grids in small: what a scale changes, what it leaves, and where it is said."""

from __future__ import annotations

import html
import math
from pathlib import Path

import pytest

from space_dist.api.grids import run_grid
from space_dist.config import flattened
from space_dist.errors import ConfigError, LedgerError
from space_dist.experiment import scaling
from space_dist.experiment.manifest import Manifest, find_grid
from space_dist.grid.planning import plan
from space_dist.report import build_grid_report
from tests.commanding import command
from tests.grids import TINY, write_grid, write_line_instances


@pytest.mark.parametrize(
    ("count", "scale", "expected"),
    [(10, 1.0, 10), (10, 0.1, 1), (10, 0.02, 1), (10, 0.25, 3), (30, 0.1, 3), (1, 0.5, 1)],
)
def test_seeds_are_the_first_and_their_share_is_rounded_up(count: int, scale: float, expected: int) -> None:
    assert scaling.fewer(range(5, 5 + count), scale) == tuple(range(5, 5 + expected))


@pytest.mark.parametrize("scale", [0.0, -0.1, 1.01, math.nan, math.inf])
def test_a_scale_that_is_no_share_is_refused(scale: float, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="above 0 and at most 1"):
        plan(write_grid(tmp_path), tmp_path / "runs", scale)
    assert not (tmp_path / "runs").exists()


def test_a_grid_in_small_has_less_of_seeds_and_steps_and_all_else(tmp_path: Path) -> None:
    settings = {"budget.steps": 40_000, "budget.episodes": 7, "evaluation.every_steps": 8_000, "learner.n_steps": 512}
    path = write_grid(tmp_path, set=settings, seeds=[3, 4, 5, 6])
    whole, small = (plan(path, tmp_path / "runs", scale) for scale in (1.0, 0.25))
    assert (small.grid.folder.name, small.manifest.name) == (f"{whole.manifest.name}-scale-0.25",) * 2
    assert (whole.manifest.seeds, small.manifest.seeds) == ((3, 4, 5, 6), (3,))
    assert len(small.manifest.cells) == len(whole.manifest.cells)
    for one, other in zip(whole.manifest.cells, small.manifest.cells, strict=True):
        assert one.id != other.id
        before, after = (dict(flattened(cell.config)) for cell in (one, other))
        assert {key: (value, after[key]) for key, value in before.items() if value != after[key]} == {
            "budget.steps": (40_000, 10_000),
            "budget.episodes": (7, 2),
            "evaluation.every_steps": (
                8_000,
                5_000,
            ),  # a quarter of the steps, two evaluations instead of five
        }


def test_what_changes_on_the_way_does_so_at_the_same_share(tmp_path: Path) -> None:
    changes = [{"steps": 10_000, "set": {"learner.gamma": 0.5}}, {"steps": 20_000, "set": {"learner.gamma": 0.9}}]
    settings = {
        "budget.steps": 40_000,
        "learner.n_steps": 512,
        "fork": {"seed": 7, "steps": 10_000},
        "schedule": changes,
    }
    path = write_grid(tmp_path, set=settings)
    for scale, expected in ((1.0, [10_000, 10_000, 20_000]), (0.25, [2_500, 2_500, 5_000])):
        for cell in plan(path, tmp_path / "runs", scale).manifest.cells:
            found = [cell.config["fork"]["steps"], *(change["steps"] for change in cell.config["schedule"])]
            assert found == expected
            assert cell.config["fork"]["seed"] == 7


def test_one_update_is_the_least(tmp_path: Path) -> None:
    path = write_grid(tmp_path, set={"budget.steps": 40_000, "learner.n_steps": 512})
    assert {cell.budget_steps for cell in plan(path, tmp_path / "runs", 0.001).manifest.cells} == {512}


def test_a_manifest_knows_its_scale(tmp_path: Path) -> None:
    path = write_grid(tmp_path, seeds=[0, 1])
    for scale in (1.0, 0.5):
        manifest = plan(path, tmp_path / "runs", scale).manifest
        content = manifest.to_json()
        assert Manifest.from_json(content, "test") == manifest
        assert manifest.scale == scale
        assert (b'"scale"' in content) == (scale != 1.0)  # manifests of before have none


def test_grids_in_small_are_found_by_their_scale(tmp_path: Path) -> None:
    path = write_grid(tmp_path, seeds=[0, 1])
    small = plan(path, tmp_path / "runs", 0.5).grid
    assert find_grid(path, tmp_path / "runs", 0.5).folder == small.folder
    assert find_grid(small.folder, tmp_path / "runs").folder == small.folder
    with pytest.raises(LedgerError, match=r"--scale 0\.25` freezes it there"):
        find_grid(path, tmp_path / "runs", 0.25)
    with pytest.raises(LedgerError, match="grid plan"):
        find_grid(path, tmp_path / "runs")
    for frozen in (small.folder, small.manifest_file):
        with pytest.raises(ConfigError, match="frozen already"):
            find_grid(frozen, tmp_path / "runs", 0.5)


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grid file whose half was run, in `runs` beside it."""
    folder = tmp_path_factory.mktemp("scaled")
    settings = {**TINY, **write_line_instances(folder)}
    path = write_grid(folder, set=settings, seeds=[0, 1, 2, 3])
    assert run_grid(path, root=folder / "runs", scale=0.5, progress=False).complete
    return path


def test_commands_take_a_scale_and_reports_say_it(
    ran: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--root", ran.parent / "runs", "--scale", "0.5"]
    assert command(monkeypatch, "grid", "plan", ran, *where) == 0
    assert command(monkeypatch, "grid", "run", ran, *where) == 0
    monkeypatch.setenv("COLUMNS", "200")
    capsys.readouterr()
    assert command(monkeypatch, "grid", "status", ran, *where) == 0
    # Done is done: a budget of 384 steps has no room for a second update of 256. Two runs in each of two cells.
    assert capsys.readouterr().out.count("100% of 512") == 2
    assert command(monkeypatch, "report", ran, *where) == 0
    words = "scale 0.5: 50 % of the whole grid's steps, 2 seeds"
    assert words in " ".join(capsys.readouterr().out.split())
    grid = find_grid(ran, ran.parent / "runs", 0.5)
    assert words in (grid.folder / "report/report.md").read_text()
    assert words in html.unescape((grid.folder / "report/report.html").read_text())
    assert command(monkeypatch, "report", grid.folder, "--scale", "0.5") == 2
    assert "frozen already" in capsys.readouterr().err


def test_figures_of_a_grid_in_small_say_so(ran: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every one of them: what is written above is asked for each."""
    notes: list[str] = []

    def png(_: object, note: str = "") -> bytes:
        notes.append(note)
        return b"\x89PNG" + bytes(20)

    for module in ("grid_report", "curricula", "instances"):
        monkeypatch.setattr(f"space_dist.report.{module}.png", png)
    report = build_grid_report(find_grid(ran, ran.parent / "runs", 0.5), tmp_path)
    assert len(notes) == len([*report.folder.glob("*.png")]) >= 3
    assert set(notes) == {"scale 0.5: 50 % of the whole grid's steps, 2 seeds"}
