"""Cells of grids as curves in MLflow: the report's statistics, over the report's seeds, and each point once."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from mlflow import MlflowClient

from space_dist.experiment.endings import Cause, Ended
from space_dist.experiment.manifest import Grid
from space_dist.report import confidence_interval, interquartile_mean
from space_dist.tracking import NOTE_TAG, sync
from space_dist.tracking.cells import CellCurve, Evaluations, curve
from space_dist.tracking.snapshot import Point
from tests.test_grid_tracking import begin, levels, make_grid, reports, run_to
from tests.test_report import STARTED, STEPS
from tests.test_tracking import histories

__all__ = ["reports"]

TEST = [-10.0, -8.0, -6.0, -4.0]


def evaluations(steps: list[int], returns: list[float], late: int = 0) -> Evaluations:
    values = np.array(returns)
    return Evaluations(np.array(steps), np.array(steps) + late, {"test": values, "train": values - 1.0})


def named(rows: tuple[tuple[Point, ...], ...], name: str) -> list[tuple[int, float]]:
    return [(point.step, point.value) for row in rows for point in row if point.name == name]


def test_a_point_is_what_the_report_says_of_the_seeds_that_are_done() -> None:
    finals = np.array([1.0, 2.0, 6.0, 20.0])
    done = [evaluations([0, 10], [0.0, final], late=number) for number, final in enumerate(finals)]
    rows = curve(done, [evaluations([0], [99.0])])  # who is under way does not count once somebody is done
    low, high = confidence_interval(finals)
    assert named(rows, "test/return_iqm") == [(0, 0.0), (10, float(interquartile_mean(finals)))]
    assert named(rows, "test/return_low") == [(10, float(low))]  # none at 0, where seeds show no spread
    assert named(rows, "test/return_high") == [(10, float(high))]
    assert named(rows, "train/return_iqm") == [(0, -1.0), (10, float(interquartile_mean(finals)) - 1.0)]
    assert named(rows, "test/n_seeds") == [(0, 4.0), (10, 4.0)]
    assert {point.milliseconds for point in rows[1]} == {13}  # of the latest


def test_a_curve_ends_where_the_slowest_seed_is_and_only_gets_longer() -> None:
    fast, slow = evaluations([0, 10, 20], [0.0, 1.0, 2.0]), evaluations([0, 10], [0.0, 3.0])
    before = curve([], [fast, slow, Evaluations.none()])  # who has not begun keeps nobody waiting
    after = curve([], [fast, evaluations([0, 10, 20], [0.0, 3.0, 4.0])])
    assert named(before, "test/return_iqm") == [(0, 0.0), (10, 2.0)]
    assert after[: len(before)] == before
    assert named(after, "test/return_iqm") == [(0, 0.0), (10, 2.0), (20, 3.0)]
    assert curve([], [Evaluations.none()]) == curve([], []) == ()


def test_seeds_evaluated_at_different_steps_count_with_their_last_evaluation() -> None:
    rows = curve([evaluations([0, 10, 30], [0.0, 1.0, 2.0]), evaluations([0, 20], [0.0, 5.0])], [])
    assert named(rows, "test/return_iqm") == [(0, 0.0), (10, 0.5), (20, 3.0), (30, 3.5)]


def test_a_number_that_a_seed_lacks_is_one_that_the_cell_lacks() -> None:
    rows = curve([evaluations([0, 10], [0.0, math.nan]), evaluations([0, 10], [0.0, 1.0])], [])
    assert named(rows, "test/return_iqm") == [(0, 0.0)]
    assert named(rows, "test/n_seeds") == [(0, 2.0), (10, 2.0)]


def test_a_curve_knows_whether_it_goes_on_another() -> None:
    def made(*seeds: Evaluations) -> CellCurve:
        return CellCurve("k", "t", Path(), "n", "g", {}, {}, "RUNNING", 0.0, 0.0, "", curve([], seeds))

    short, long = (made(evaluations(steps, [0.0] * len(steps))) for steps in ([0, 10], [0, 10, 20]))
    assert long.continues(short.intent)
    assert not short.continues(long.intent)
    assert not long.continues(made(evaluations([0, 10], [0.0, 1.0])).intent)
    assert not any(long.continues(text) for text in ("", "2", "x y", f"{'9' * 40} 0"))


def points(uri: str, grid: Grid) -> dict[str, list[tuple[int, int, float]]]:
    sync([], grids=[grid])
    return histories(uri, levels(uri)[1]["eta=0.1"])


def test_a_cell_is_a_run_of_its_own_whose_curve_grows_with_its_seeds(uri: str, tmp_path: Path) -> None:
    grid, _ = make_grid(tmp_path / "demo", uri, etas=(0.1,), seeds=(0, 1, 2))
    for seed in (0, 1):
        run_to(grid, 0, seed, until=1, state="interrupted")
    found = points(uri, grid)
    first = levels(uri)[1]["eta=0.1"]
    assert [(step, value) for step, _, value in found["test/return_iqm"]] == [(0, -10.0), (STEPS, -8.0)]
    assert (first.info.status, first.info.start_time) == ("RUNNING", round(STARTED * 1000))
    assert first.data.params["curriculum.eta"] == "0.1"
    tags = first.data.tags
    assert (tags["space_dist.cell"], tags["setting.curriculum.eta"]) == ("000000000000", "0.1")

    for seed in (0, 1):
        run_to(grid, 0, seed, until=2, state="interrupted", attempt=2)
    longer = points(uri, grid)
    assert levels(uri)[1]["eta=0.1"].info.run_id == first.info.run_id  # points were added, and none changed
    assert longer["test/return_iqm"][:2] == found["test/return_iqm"]
    assert len(longer["test/return_iqm"]) == 3

    for seed, last in ((0, 1.0), (1, 2.0), (2, 6.0)):
        run_to(grid, 0, seed, attempt=3, last=last)
    whole = points(uri, grid)
    _, cells, children = levels(uri)  # others count now: the curve is another one, in a run of its own
    assert cells["eta=0.1"].info.run_id != first.info.run_id
    assert [step for step, _, _ in whole["test/return_iqm"]] == [n * STEPS for n in range(5)]
    low, high = confidence_interval(np.array([1.0, 2.0, 6.0]))
    final = {name: whole[name][-1][2] for name in ("test/return_iqm", "test/return_low", "test/return_high")}
    assert final == {"test/return_iqm": 3.0, "test/return_low": float(low), "test/return_high": float(high)}
    assert whole["test/n_seeds"][-1][2] == 3.0
    assert "IQM 3, 95 % interval" in cells["eta=0.1"].data.tags[NOTE_TAG]
    assert (cells["eta=0.1"].info.status, len(children)) == ("FINISHED", 3)

    before = {name: run.to_dictionary() for name, run in cells.items()}
    assert points(uri, grid) == whole
    assert {name: run.to_dictionary() for name, run in levels(uri)[1].items()} == before
    trash = MlflowClient(uri).search_runs(first.info.experiment_id, run_view_type=2)
    assert [run.info.run_id for run in trash] == [first.info.run_id]


def test_failed_seeds_count_in_no_curve(uri: str, tmp_path: Path) -> None:
    grid, _ = make_grid(tmp_path / "demo", uri, etas=(0.1,))
    run_to(grid, 0, 0, until=2, state="interrupted")
    begin(grid, 0, 0, 2).end(2, Ended(Cause.OUT_OF_MEMORY, "600 MB"))
    run_to(grid, 0, 1, until=1, state="interrupted")
    found = points(uri, grid)
    assert [(step, value) for step, _, value in found["test/n_seeds"]] == [(0, 1.0), (STEPS, 1.0)]


def test_the_parent_has_plan_numbers_and_report(uri: str, tmp_path: Path, reports: list[Path]) -> None:
    grid, _ = make_grid(tmp_path / "demo", uri, etas=(0.1, 0.2), seeds=(0, 1, 2))
    for seed, last in ((0, 1.0), (1, 2.0), (2, 6.0)):
        run_to(grid, 1, seed, last=last)
    sync([], grids=[grid])
    sync([], grids=[grid])
    parent, *_ = levels(uri)
    params = parent.data.params
    assert (params["cells"], params["seed_list"], params["varied.curriculum.eta"]) == ("2", "0, 1, 2", "0.1, 0.2")
    assert params["budget.steps"] == "4000"
    assert "curriculum.eta" not in params
    low, high = confidence_interval(np.array([1.0, 2.0, 6.0]))
    assert parent.data.metrics == {
        "test/return_iqm eta 0.2": 3.0, "test/return_low eta 0.2": float(low), "test/return_high eta 0.2": float(high),
    }  # fmt: skip
    found = {artifact.path for artifact in MlflowClient(uri).list_artifacts(parent.info.run_id)}
    assert found == {"manifest.json", "report.html"}
    assert reports == [grid.folder]  # made once
    experiment = MlflowClient(uri).get_experiment(parent.info.experiment_id)
    assert experiment.tags["mlflow.experimentKind"] == "custom_model_development"  # MLflow's pages open on its runs


@pytest.mark.parametrize("label", ["../..", "a/b", "", ".hidden", "x" * 120])
def test_a_hostile_label_leads_a_sink_nowhere_else(label: str) -> None:
    from space_dist.experiment.manifest import Cell
    from space_dist.tracking.grids import _place

    place = _place(Cell("0123456789ab", label, {}, {}))
    assert "/" not in place
    assert not place.startswith(".")
    assert place
