"""Reports on grids: nothing hidden, dropped or believed."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import hashlib
import io
import math
import re
import shutil
from collections.abc import Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from space_dist.cli import main
from space_dist.cli.runs import print_grid_report
from space_dist.errors import ConfigError
from space_dist.experiment.endings import Cause, Ended
from space_dist.experiment.grid_file import GridTracking, Retry, RunResources
from space_dist.experiment.manifest import Cell, Grid, Manifest
from space_dist.experiment.status import Attempts
from space_dist.grid.planning import plan
from space_dist.ledger import Ledger, RunWriter
from space_dist.report import build_grid_report
from space_dist.report.document import Document, Section, escaped, to_html, to_markdown
from space_dist.report.grid import compare, heat_maps, pool, read_cells
from space_dist.report.statistics import (
    Interval,
)
from tests.commanding import Typed
from tests.grids import SMALL, write_grid
from tests.test_report import GROWTH, continue_run, start_run

START = (-10.0, -8.0, -6.0, -4.0)  # returns at steps 0 to 3,000; the fifth, at 4,000, is the final one


def make_grid(
    folder: Path, points: Sequence[Mapping[str, Any]], *, n_seeds: int = 3, baseline: int = 0,
    labels: Sequence[str] | None = None, code: str = "unknown", kind: str | None = None,
) -> Grid:  # fmt: skip
    """A frozen grid of 4,000 steps a run, none of which has begun."""
    cells = []
    for number, point in enumerate(points):
        env = {"id": point.get("env.id", "space_dist/PointMass-v0")}
        config = {"env": env, "instances": {"train": "a.csv", "test": "b.csv"}, "budget": {"steps": 4000}}
        config |= {} if kind is None else {"curriculum": {"kind": kind}}
        label = " ".join(f"{key}={value}" for key, value in point.items()) if labels is None else labels[number]
        cells.append(Cell(hashlib.sha256(str(number).encode()).hexdigest()[:12], label, point, config))
    axes = tuple(dict.fromkeys(key for point in points for key in point))
    manifest = Manifest(
        "grid", axes, tuple(cells), tuple(range(n_seeds)), RunResources(), Retry(), GridTracking(uri=None),
        cells[baseline].id, {}, code, {},
    )  # fmt: skip
    grid = Grid(folder)
    grid.freeze(manifest, {})
    return grid


def finish(grid: Grid, cell: int, seed: int, *returns: float | None, state: str = "done") -> Ledger:
    """A run with these test returns at steps 0, 1000, ...; given one, it is the final return."""
    ledger = grid.ledger(grid.manifest().run(grid.manifest().cells[cell].id, seed))
    start_run(ledger.folder, seed=seed)
    curve = returns if len(returns) > 1 else (*START, *returns)
    growth = [*GROWTH, *[GROWTH[-1]] * len(curve)][: len(curve) - 1]
    continue_run(ledger, curve, growth, state=state, success=0.5)
    return ledger


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# ---- a grid of a baseline and two by two cells, one run failed and one not begun -------------------------------------

POINTS = (
    {"curriculum": {"kind": "round_robin"}},
    *({"curriculum": {"kind": "space", "eta": eta, "kappa": kappa}} for eta in (0.1, 0.2) for kappa in (1, 4)),
)
FINALS = ((1.0, 2.0, 6.0), (2.0, 3.0, 7.0), (9.0, 9.0), (0.0, 1.0, 2.0), (4.0, 5.0))


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Grid:
    grid = make_grid(tmp_path_factory.mktemp("grid") / "grid", POINTS, labels=["robin", "a", "b", "c", "d"])
    for cell, finals in enumerate(FINALS):
        for seed, final in enumerate(finals):
            finish(grid, cell, seed, final)
    failed = finish(grid, 2, 2, -10.0, -8.0, state="failed")
    Attempts(failed).begin(1, {})
    Attempts(failed).end(1, Ended(Cause.OUT_OF_MEMORY, "4,100 MB of 4,000 MB\n<b>last words</b>"))
    other = grid.ledger(grid.manifest().run("a", 1))
    with RunWriter(other) as writer:
        writer.status = other.status()
        writer.set_status(
            dataclasses.replace(
                writer.status,
                fingerprint={
                    "cpu": "another",
                    "torch": "2.0",
                    "code": "new",
                    "scikit-learn": "1.0",
                },
            )
        )
    return grid


@pytest.fixture(scope="module")
def written(grid: Grid) -> Path:
    return build_grid_report(grid).folder


def test_a_grid_of_one_run_is_spoken_of_as_one(tmp_path: Path) -> None:
    grid = make_grid(tmp_path / "grid", POINTS[:1], n_seeds=1)
    finish(grid, 0, 0, 1.0)
    assert build_grid_report(grid).summary[0] == "Its one run is finished (1 cell × 1 seed)."


def test_every_number_says_how_many_seeds_it_rests_on(grid: Grid, written: Path) -> None:
    assert written == grid.folder / "report"
    text = (written / "report.md").read_text()
    assert "13 of 15 runs are finished (5 cells × 3 seeds); 1 failed, 1 waiting." in text
    assert "| robin (baseline) | 3/3 | — | 3.000 [-3.572, 9.572] (3/3) | 3.000 [-3.572, 9.572] (3/3) |" in text
    assert "| b | 2/3 | 1 failed: out of memory | 9.000 [—] (2/3) |" in text
    assert "| d | 2/3 | 1 waiting | 4.500 [—] (2/3) |" in text
    assert "1.00 [—] (2/3 seeds against 3/3)" in text
    page, before = (written / "report.html").read_text(), text.partition("| cell |")[0]
    for few in (
        "Intervals here rest on fewer than 10 seeds (robin: 3; a: 3; c: 3): they are wide, ",
        "Over fewer than 3 seeds there is no interval (b: 2; d: 2): ",
    ):
        assert few in before
        assert few in page
    checked = 0
    for head, body in re.findall(r"(?m)^(\| cell .*)\n\| ---.*\n((?:\|.*\n)+)", text):
        columns = head.split(" | ")
        for line in body.splitlines():
            for column, cell in zip(columns, line.split(" | "), strict=True):
                if column.strip("| ") not in ("cell", "threshold", "not finished") and re.search(r"\d", cell):
                    assert re.search(r"\d/\d", cell), line
                    checked += 1
    assert checked > 50


def test_the_same_runs_give_the_same_report(grid: Grid, written: Path, tmp_path: Path) -> None:
    again = build_grid_report(grid, tmp_path).folder
    for name in ("report.md", "report.html", "cells.csv", "runs.csv"):  # the page holds the figures
        assert (again / name).read_bytes() == (written / name).read_bytes()


def test_cells_csv_has_the_numbers_in_full(written: Path) -> None:
    found = {row["configuration"]: row for row in rows(written / "cells.csv")}
    assert [*found] == ["robin", "a", "b", "c", "d"]
    a = found["a"]
    half = 4.302653 * math.sqrt(7.0 / 3.0)  # of 2, 3 and 7
    found_in_a = [float(a[f"test_return_{name}"]) for name in ("iqm", "iqm_low", "iqm_high", "mean", "median")]
    assert found_in_a == pytest.approx([4.0, 4.0 - half, 4.0 + half, 4.0, 3.0], rel=1e-6)
    # 2 beats 1 and ties 2; 3 beats 1 and 2; 7 beats all
    assert float(a["probability_of_improvement"]) == pytest.approx(6.5 / 9)
    assert (a["runs"], a["finished"], a["baseline_return_seeds"]) == ("3", "3", "3")
    assert found["robin"]["probability_of_improvement"] == ""
    assert (found["b"]["finished"], found["b"]["not_finished"]) == ("2", "1 failed: out of memory")


def test_failed_runs_are_shown_with_their_cause(written: Path) -> None:
    text = (written / "report.md").read_text()
    assert "1 run failed and is in no number: 1 out of memory." in text
    assert "| b, seed 2 | out of memory | 4,100 MB of 4,000 MB | 1,000 of 4,000 | 1 |" in text
    assert "<pre>4,100 MB of 4,000 MB\n&lt;b&gt;last words&lt;/b&gt;</pre>" in (written / "report.html").read_text()
    listed = rows(written / "runs.csv")
    assert len(listed) == 15
    unfinished = [row for row in listed if row["condition"] != "done"]
    assert [(row["label"], row["seed"], row["condition"], row["cause"]) for row in unfinished] == [
        ("b", "2", "failed", "out_of_memory"), ("d", "2", "waiting", ""),
    ]  # fmt: skip


def test_runs_of_other_code_and_machines_are_named(written: Path) -> None:
    text = (written / "report.md").read_text()
    assert (
        "Finished by another code, and counted all the same: 1 run, a seed 1 (code new; the grid was frozen by unknown)"
        in text
    )
    assert (
        "Finished by another cpu, and counted all the same: 1 run, a seed 1 (cpu another; most runs have test)." in text
    )
    assert "another scikit-learn" not in text  # which the other runs do not use


def test_the_heat_map_is_that_of_the_two_parameters(grid: Grid, written: Path) -> None:
    (found,) = heat_maps(read_cells(grid, grid.manifest()))
    assert (found.title, found.column_name, found.row_name) == ("kind=space", "eta", "kappa")
    assert (found.columns, found.rows) == (["0.1", "0.2"], ["1", "4"])
    np.testing.assert_allclose(found.means, [[4.0, 1.0], [9.0, 4.5]])
    np.testing.assert_allclose(found.spreads, [[math.sqrt(7.0), 1.0], [0.0, math.sqrt(0.5)]])
    assert found.seeds == [["3/3", "3/3"], ["2/3", "2/3"]]
    assert "| 4 | 9.00 ± 0.00 (2/3) | 4.50 ± 0.71 (2/3) |" in (written / "report.md").read_text()
    assert (written / "heat_map_1.png").read_bytes().startswith(b"\x89PNG")


def test_settings_are_pooled_over_the_others(grid: Grid) -> None:
    found = {one.setting: one for one in pool(read_cells(grid, grid.manifest()))}
    assert [*found] == ["kind=round_robin", "kind=space", "eta=0.1", "eta=0.2", "kappa=1", "kappa=4"]
    kappa = found["kappa=1"]  # 2, 3, 7 and 0, 1, 2
    assert (kappa.n_cells, kappa.n_finished, kappa.n_runs, kappa.iqm.value) == (2, 6, 6, 2.0)
    assert (found["kappa=4"].n_finished, found["kappa=4"].n_runs) == (4, 6)


class Page(HTMLParser):
    """What a browser would see: tags, addresses, and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.addresses: list[str] = []
        self.attributes: set[str] = set()
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "action", "data", "srcset")]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_the_page_needs_nothing_else(written: Path) -> None:
    text = (written / "report.html").read_text()
    page = Page(text)
    assert not page.tags & {"script", "link", "iframe", "object", "b"}
    assert len(page.addresses) == 4  # curves, heat map, profiles, instances
    assert all(address.startswith("data:image/png;base64,") for address in page.addresses)
    assert "url(" not in text
    assert "@import" not in text
    assert "default-src 'none'" in text
    assert 'name="viewport"' in text


# ---- thresholds -----------------------------------------------------------------------------------------------------


def test_steps_to_the_threshold_with_censoring_and_pairs(tmp_path: Path) -> None:
    """The baseline's seeds end at 5, 5, 5; they reach it at 1,000, 2,000 and 2,000 steps. Of the cell, seed 0 reaches
    it at 1,000, seed 1 never, and seed 2 is missing: the ratio is (1,000 + 4,000) / (1,000 + 2,000)."""
    grid = make_grid(tmp_path / "g", [{"k": 1}, {"k": 2}, {"k": 3}])
    late = (0.0, 0.0, 5.0, 5.0, 5.0)
    for seed, curve in enumerate(((0.0, 5.0, 5.0, 5.0, 5.0), late, late)):
        finish(grid, 0, seed, *curve)
    finish(grid, 1, 0, 0.0, 6.0, 6.0, 6.0, 6.0)
    finish(grid, 1, 1, 0.0, 6.0, 6.0, 0.0, 6.0)
    cells = read_cells(grid, grid.manifest())
    base, cell, empty = compare(cells, cells[0])

    assert base.threshold == cell.threshold == 5.0
    assert base.reach is not None
    assert base.reach.times.tolist() == [1000, 2000, 2000]
    assert base.reach.mean == Interval(5000 / 3, pytest.approx(232.449, abs=1e-3), pytest.approx(3100.884, abs=1e-3))
    assert cell.reach is not None
    assert (cell.reach.censored, cell.reach.budget) == (1, 4000)
    assert cell.reach.mean == Interval(2500.0)
    assert cell.ratio == Interval(pytest.approx(5 / 3))
    assert cell.pairs == 2
    assert (empty.reach, empty.untestable) == (None, "no finished seed")

    text = build_grid_report(grid, tmp_path / "out").markdown
    assert "| k=2 | 5.000 | 1/2 | 1/2 at 4,000 steps | 2,500 [—] (2/3) | 1.67 [—] (2/3 pairs) |" in text
    assert compare(cells, cells[0], 100.0)[1].ratio is None  # reached by nobody: nothing is known, not a ratio of 1


def test_a_threshold_within_the_noise_of_step_0_is_untestable(tmp_path: Path) -> None:
    """Untrained seeds return 0, 1 and 2, so that one more may well return 1 + 4.303 * sqrt(4/3) = 5.97."""
    grid = make_grid(tmp_path / "g", [{"k": 1}, {"k": 2}])
    for cell, final in ((0, 5.9), (1, 6.0)):
        for seed in range(3):
            finish(grid, cell, seed, float(seed), final, final, final, final)
    cells = read_cells(grid, grid.manifest())
    for found in compare(cells, cells[0]):
        assert found.reach is None
        assert found.untestable == "untestable: within noise of step 0 (up to 5.968)"
    assert all(found.reach is not None for found in compare(cells, cells[1]))

    report = build_grid_report(grid)
    assert [row["steps to the threshold"] for row in report.table] == ["untestable", "untestable"]
    reason = "Untestable steps to the threshold, within noise of step 0: k=1 (up to 5.968), k=2 (up to 5.968)."
    assert reason in report.remarks
    shown = io.StringIO()
    print_grid_report(report, Console(file=shown, width=80))
    assert reason in " ".join(shown.getvalue().split())
    assert not any("ntestable" in line for line in build_grid_report(grid, baseline="k=2").remarks)


def test_where_runs_end_by_episodes_a_threshold_is_untestable(tmp_path: Path) -> None:
    """A seed that never comes there has been trained for fewer steps than another: nothing counts for both."""
    grid = make_grid(tmp_path / "g", [{"k": 1}])
    for seed, returns in enumerate(([0.0, 1.0, 9.0], [0.5, 1.0, 2.0, 9.0])):
        finish(grid, 0, seed, *returns)
    [cell] = read_cells(grid, grid.manifest())
    assert compare([cell], cell)[0].reach is not None
    config = {**cell.cell.config, "budget": {"steps": 4000, "episodes": 30}}
    by_episodes = dataclasses.replace(cell, cell=dataclasses.replace(cell.cell, config=config))
    [found] = compare([by_episodes], by_episodes)
    assert (found.reach, found.untestable) == (None, "untestable: runs end by episodes (at 2,000 to 3,000 steps)")
    alike = dataclasses.replace(by_episodes.configuration, runs=by_episodes.configuration.runs[:1])
    one = dataclasses.replace(by_episodes, configuration=alike)
    assert compare([one], one)[0].untestable == "untestable: runs end by episodes (at 2,000 steps)"


def test_a_report_on_a_folder_of_grids_says_what_it_leaves_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        finish(make_grid(tmp_path / "runs" / name, [{"k": 1}]), 0, 0 if name == "a" else 1, 3.0)
    finish(Grid(tmp_path / "runs/b"), 0, 2, 2.0)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["space-dist", "report", str(tmp_path / "runs"), "--out", "there"])
    with contextlib.suppress(SystemExit):
        main()
    said = capsys.readouterr().out
    assert "2 runs of the grid a have not begun, and have no part in this." in " ".join(said.split())
    assert "1 run of the grid b has not begun, and has no part in this." in " ".join(said.split())
    assert said.endswith(f"Figure and tables: {tmp_path / 'there'}\n")


# ---- odd grids ------------------------------------------------------------------------------------------------------


def test_a_grid_without_a_finished_run_says_so(tmp_path: Path) -> None:
    grid = make_grid(tmp_path / "g", [{"k": 1}, {"k": 2}])
    report = build_grid_report(grid)
    assert (
        "No run of this grid has finished yet, so there is no number to report: of its 6 runs (2 cells × 3 seeds), "
        "6 waiting." in report.markdown
    )
    assert not (report.folder / "curves.png").exists()
    assert "Steps to the threshold" not in report.markdown
    finish(grid, 1, 0, -1.0, 0.0, state="interrupted")
    report = build_grid_report(grid)
    assert report.summary[0].startswith("No run of this grid has finished yet")
    assert report.table[1]["test return, IQM [95 %]"] == "— (0/3)"
    assert (report.folder / "curves.png").exists()  # an unfinished curve is better than none, and is labelled so


def test_a_report_keeps_nothing_of_the_one_before(tmp_path: Path) -> None:
    """A grid that was planned anew: its first report was of other cells. What others put there stays."""
    folder = tmp_path / "g"
    grid = make_grid(folder, [{"k": 1}], n_seeds=1)
    finish(grid, 0, 0, 1.0)
    report = build_grid_report(grid)
    made = {path.name for path in report.folder.iterdir()}
    assert {"curves.png", "profiles.png", "curves.csv", "seeds.csv"} <= made
    (report.folder / "mine.png").touch()
    shutil.rmtree(grid.ledger(grid.manifest().runs()[0]).folder)
    build_grid_report(grid)
    left = {path.name for path in report.folder.iterdir()}
    assert left == {"mine.png", "cells.csv", "runs.csv", "report.md", "report.html"}
    (report.folder / "report.md").write_text("# My own\n\n![of mine](mine.png)\n")
    build_grid_report(grid)
    assert (report.folder / "mine.png").exists()


def test_a_run_that_cannot_be_read_is_a_failed_one(tmp_path: Path) -> None:
    grid = make_grid(tmp_path / "g", [{"k": 1}, {"k": 2}], n_seeds=2)
    for seed in range(2):
        finish(grid, 0, seed, 1.0)
    damaged = finish(grid, 1, 0, 1.0)
    (damaged.folder / "metrics.jsonl").write_text("{}\n")
    finish(grid, 1, 1, 2.0)
    report = build_grid_report(grid)
    assert report.table[1]["seeds"] == "1/2"
    assert "| k=2, seed 0 | unreadable |" in report.markdown
    assert "metrics.jsonl" in report.markdown


def test_a_run_on_foreign_instances_is_in_no_number_and_named(tmp_path: Path) -> None:
    """One was trained on an id that its set does not have; one is on another set than its cell's; the others count."""
    grid = make_grid(tmp_path / "g", [{"k": 1}, {"k": 2}], n_seeds=3, kind="space")
    for cell, seed in ((0, 0), (0, 1), (0, 2), (1, 2)):
        finish(grid, cell, seed, float(1 + seed))
    odd = start_run(grid.ledger(grid.manifest().run(grid.manifest().cells[1].id, 0)).folder)
    continue_run(odd, (*START, 50.0), [[0], [0, 77], [0, 78, 79, 80, 81], [0, 1]])
    other = start_run(grid.ledger(grid.manifest().run(grid.manifest().cells[1].id, 1)).folder, seed=1, n=6)
    continue_run(other, (*START, 60.0), GROWTH)
    report = build_grid_report(grid)
    assert [row["seeds"] for row in report.table] == ["3/3", "1/3"]
    assert report.table[1]["test return, IQM [95 %]"].startswith("3.00")  # neither 50 nor 60
    assert report.table[1]["not finished"] == "2 failed: not comparable"
    assert report.remarks[:2] == [
        f"In no number: k=2, seed 0: not comparable: iteration 2 was trained on the instance 77, not in "
        f"{odd.instances('train')}.",
        "In no number: k=2, seed 1: not comparable: the instances that it was trained on are not those of the grid "
        "(a.csv).",
    ]
    assert "2 runs failed and are in no number: 2 not comparable." in report.markdown
    assert "| k=2, seed 0 | not comparable |" in report.markdown
    assert [row["last_test_return"] for row in rows(report.folder / "runs.csv")][3:] == ["", "", "3.0"]


def test_whether_a_run_is_foreign_needs_no_other_run(tmp_path: Path) -> None:
    """The manifest knows the instances: the only run that is done need not be right."""
    grid = make_grid(tmp_path / "g", [{"k": 1}], n_seeds=2)
    own = finish(grid, 0, 0, 1.0)
    digest = hashlib.sha256(own.read(own.instances("train"))).hexdigest()
    tested = hashlib.sha256(own.read(own.instances("test"))).hexdigest()
    for instances, seeds in (
        ({"a.csv": digest, "b.csv": tested}, "1/2"),
        ({"a.csv": "0" * 64, "b.csv": tested}, "0/2"),
    ):
        grid.freeze(dataclasses.replace(grid.manifest(), instances=instances), {})
        report = build_grid_report(grid)
        assert report.table[0]["seeds"] == seeds
    assert "the instances that it was trained on are not those of the grid (a.csv)" in report.markdown


def test_returns_of_different_environments_are_never_mixed(tmp_path: Path) -> None:
    """The baseline of the second environment is the first one's counterpart; the third has none."""
    points = [{"env.id": env, "k": k} for env in ("one", "two") for k in (1, 2)] + [{"env.id": "three", "k": 2}]
    grid = make_grid(tmp_path / "g", points, n_seeds=1)
    for cell, final in enumerate((1.0, 2.0, 100.0, 90.0, 5.0)):
        finish(grid, cell, 0, final)
    cells = read_cells(grid, grid.manifest())
    found = compare(cells, cells[0])
    assert [None if one.reference is None else cells.index(one.reference) for one in found] == [0, 0, 2, 2, None]
    assert [one.improvement and one.improvement.value for one in found] == [None, 1.0, None, 0.0, None]
    assert [one.threshold for one in found[:4]] == [1.0, 1.0, 100.0, 100.0]
    assert pool(cells) == []
    report = build_grid_report(grid)
    assert any("no counterpart of the baseline: env.id=three k=2" in remark for remark in report.remarks)
    curves = [f"curves_{number}.png" for number in (1, 2, 3)]  # on axes of one scale, two of them were a line each
    assert sorted(path.name for path in report.folder.glob("curves*.png")) == curves
    assert all(f"({file})" in report.markdown for file in curves)


def test_a_task_with_a_base_config_of_its_own_has_a_counterpart_of_the_baseline(tmp_path: Path) -> None:
    """The cell with the baseline's curriculum and other settings; none where the curriculum is another, or two are."""
    worlds = [("one", "round_robin", 1), ("one", "uniform", 1), ("two", "uniform", 1), ("two", "round_robin", 1),
              ("two", "round_robin", 2), ("three", "uniform", 1)]  # fmt: skip
    points = [{"extends": f"{env}/{kind}.yaml", "k": k} for env, kind, k in worlds]
    grid = make_grid(tmp_path / "g", points, n_seeds=1)
    manifest = grid.manifest()
    made = [dataclasses.replace(cell, config=cell.config | {"env": {"id": env}, "curriculum": {"kind": kind}})
            for cell, (env, kind, _) in zip(manifest.cells, worlds, strict=True)]  # fmt: skip
    grid.freeze(dataclasses.replace(manifest, cells=tuple(made)), {})
    for cell in range(len(worlds)):
        finish(grid, cell, 0, float(cell))
    cells = read_cells(grid, grid.manifest())
    found = compare(cells, cells[0])
    assert [None if one.reference is None else cells.index(one.reference) for one in found] == [0, 0, 3, 3, 3, None]


@pytest.mark.parametrize(
    ("points", "titles"),
    [
        ([{"a": a, "b": b} for a in (1, 2) for b in (1, 2)], [""]),
        ([{"a": a, "b": b, "c": c} for a in (1, 2) for b in (1, 2) for c in (1, 2)], []),  # three parameters
        ([{"a": a} for a in (1, 2, 3)], []),
        ([{"a": a, "b": a} for a in (1, 2, 3)], []),  # they go together
        ([{"extends": x, "a": a, "b": b} for x in "xy" for a in (1, 2) for b in (1, 2)], ["extends=x", "extends=y"]),
        ([{"c.kind": x, "a": a, "b": b} for x in ("x", "y") for a in (1, 2) for b in (1, 2)], ["kind=x", "kind=y"]),
        ([{"n": n, "a": a, "b": b} for n in ([1], [2, 3]) for a in (1, 2) for b in (1, 2)], ["n=[1]", "n=[2, 3]"]),
        ([{"a": a, "b": b} for a in (1, 2) for b in (1, 2) if a + b < 4], [""]),  # one place is empty
    ],
)  # fmt: skip
def test_what_has_a_heat_map(tmp_path: Path, points: list[dict[str, Any]], titles: list[str]) -> None:
    grid = make_grid(tmp_path / "g", points)
    assert [found.title for found in heat_maps(read_cells(grid, grid.manifest()))] == titles


def test_labels_are_words_wherever_they_stand(tmp_path: Path) -> None:
    labels = [
        "<script>alert(1)</script>", "a | b", r"$\frac{", "_hidden", "=HYPERLINK(1)", "[x](javascript:y)",
        "\x1b[31mred", "'\"><img src=x onerror=y>", "</title><b>",
    ]  # fmt: skip
    grid = make_grid(tmp_path / "g", [{"k": k} for k in range(len(labels))], labels=labels, n_seeds=1)
    for cell in range(len(labels)):
        finish(grid, cell, 0, float(cell))
    report = build_grid_report(grid)
    page = Page((report.folder / "report.html").read_text())
    assert not page.tags & {"script", "b"}
    assert not page.attributes & {"onerror"}
    assert all(address.startswith("data:") for address in page.addresses)
    assert {"<script>alert(1)</script> (baseline)", "a | b", "'\"><img src=x onerror=y>"} <= {*page.words}
    assert "\x1b" not in report.markdown
    assert "<script" not in re.sub(r"\\<", "", report.markdown)
    assert r"| a \| b | 1/1 |" in report.markdown
    assert r"[x\](javascript:y)" in report.markdown
    assert "'=HYPERLINK(1)" in {row["configuration"] for row in rows(report.folder / "cells.csv")}


def test_markdown_and_html_of_text() -> None:
    text = "a_b *c* `d` <e> f|g [h](i) _j_ https://k & [1.0, 2.0]\nl"
    assert escaped(text) == (
        r"a_b \*c\* \`d\` \<e\> f\|g [h\](i) \_j\_ https:\//k \& [1.0, 2.0] l"
    )  # fmt: skip
    document = Document("<t>", [Section("s & t", ["p"], [{"x": "<1>", "y": "2"}], ["i"])])
    assert (
        to_markdown(document) == "# \\<t\\>\n\n## s \\& t\n\np\n\n| x | y |\n| --- | ---: |\n| \\<1\\> | 2 |\n\n- i\n"
    )
    assert "<h1>&lt;t&gt;</h1>" in to_html(document)


def test_many_cells_are_drawn_in_panels(tmp_path: Path) -> None:
    grid = make_grid(tmp_path / "g", [{"a": a, "b": b} for a in (1, 2, 3) for b in (1, 2, 3)], n_seeds=1)
    for cell in range(9):
        finish(grid, cell, 0, float(cell))
    report = build_grid_report(grid)
    assert "grey: the baseline" in report.markdown
    assert report.table[3]["steps to the threshold"] == "untestable"
    assert report.remarks[-1].startswith(
        "Untestable steps to the threshold, one seed shows no noise at step 0, more seeds do: a=1 b=1, a=1 b=2, "
    )
    assert report.table[3]["test return, IQM [95 %]"] == "3.000 [—] (1/1)"
    assert report.table[3]["P(better)"] == "1.00 [—] (1/1 seed against 1/1)"
    early = report.markdown.partition("## Early")[2].partition("## ")[0]
    assert early.count("(1/1 seed against 1/1) |") == early.count("(1/1 pair) |") == 8


# ---- the command line -----------------------------------------------------------------------------------------------


def test_the_command_knows_a_grid(grid: Grid, tmp_path: Path, type_in: Typed) -> None:
    def told(*words: object) -> tuple[int, str]:
        done = type_in("report", *words)
        return done.returncode, " ".join((done.stdout + done.stderr).split())

    file = tmp_path / "grid.yaml"
    file.write_text("name: grid\nextends: base.yaml\nseeds: [0]\n")
    words = [file, "--root", grid.folder.parent, "--out", tmp_path / "out", "--baseline", "c", "--threshold", 3]
    code, text = told(*words)
    assert (code, "Baseline: c. Threshold of the test return: 3.000 (as asked for)." in text) == (0, True)
    assert (tmp_path / "out/report.html").exists()
    for words, complaint in (
        ([grid.folder, "--baseline", "e"], "grid has no cell 'e'"),
        ([grid.manifest_file, "--baseline", "e"], "grid has no cell 'e'"),
        ([grid.folder, tmp_path], "is a grid: give it alone"),
        ([grid.folder, "kappa=1", "--baseline", "space"], "goes in quotes: --baseline 'space kappa=1'"),
        ([tmp_path, "--threshold", 3], "are for grids"),
        ([grid.folder, "--threshold", "nan"], "must be a finite number"),
    ):
        code, text = told(*words)
        assert (code, complaint in text) == (2, True), text
    code, text = told(file, "--root", tmp_path)
    assert (code, "grid plan" in text) == (2, True)


def test_an_unwritable_folder_is_one_sentence(grid: Grid, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        build_grid_report(grid, tmp_path / "file")


def test_policies_that_share_a_curriculum_are_one_sample(tmp_path: Path) -> None:
    shared = {"curriculum.aggregate": "population", "curriculum.policies": 2}
    settings = {**SMALL, **shared, "engine": "population", "budget.steps": 4096}
    made = plan(write_grid(tmp_path, set=settings, seeds=[0]), tmp_path / "runs")
    remarks = [line for line in build_grid_report(made.grid).remarks if "share one curriculum" in line]
    assert [line.partition(":")[0] for line in remarks] == ["kappa=1", "kappa=4"]
