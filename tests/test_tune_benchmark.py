"""The parts of `jobs/benchmark.py tune` whose faults would show in no number."""

from __future__ import annotations

import dataclasses
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from space_dist import config as configs
from space_dist.errors import SpaceDistError
from space_dist.grid.tuning import plan_search
from tests.grids import ROOT
from tests.tunes import ARMS, search_of, write_tune

sys.path.append(str(ROOT / "jobs"))

from benchmarks.optuna_study import Asked, studied
from benchmarks.tune import ARM, Row, Taken, _covered, _markdown, _ratios, _refuse_other_work, _search


def taken(seconds: float, steps: int = 1000) -> Taken:
    return Taken(seconds, steps, 10 * steps, (1.0, 4.0), {"working": 0.25, "waiting": 0.75})


def test_ratios_are_of_the_same_round_and_one_seed_there_is_held_against_all_here() -> None:
    # A machine that slows down to a tenth after the first round slows all.
    seconds = {"ours": (2.0, 20.0, 20.0), "optuna": (8.0, 80.0, 100.0), "one_seed": (1.0, 10.0, 40.0)}
    rows = {name: Row(name, [taken(one) for one in rounds]) for name, rounds in seconds.items()}
    assert _ratios(rows["optuna"], rows["ours"]) == [4.0, 4.0, 5.0]
    table = _markdown(rows, trials=2, seeds=3)
    assert "| optuna | 80.0 (8.0-100.0) s | 4.00 (4.00-5.00) | 1,000 | 10,000 | 12 (10-125) | 2.5 " in table
    assert "waiting 75%, working 25%" in table
    assert "3 seeds a trial cost 2.00 (0.50-2.00) times here" in table
    assert "one seed" not in _markdown({name: rows[name] for name in ("ours", "optuna")}, trials=2, seeds=3)


def test_searches_of_other_lengths_are_no_comparison() -> None:
    rows = {"ours": Row("", [taken(1.0)]), "optuna": Row("", [taken(1.0)]), "one_seed": Row("", [taken(1.0, 500)])}
    _refuse_other_work(rows)
    rows["optuna"].taken.append(taken(1.0, 1001))
    with pytest.raises(SpaceDistError, match="1,000 and 1,001 steps"):
        _refuse_other_work(rows)


def test_time_that_runs_share_counts_once() -> None:
    assert _covered([(5.0, 6.0), (0.0, 2.0), (1.0, 3.0), (1.5, 1.75)]) == pytest.approx(4.0)
    assert _covered([]) == 0.0


def test_the_shipped_search_is_taken_as_it_is_but_for_its_size(tmp_path: Path) -> None:
    search = _search(trials=3, seeds=2, steps=4096, generation=2)
    path = tmp_path / "search.yaml"
    path.write_text(configs.to_yaml(search))
    manifest = plan_search(path, tmp_path / "runs").manifest
    found = search_of(manifest)
    assert [*found.arms] == [ARM]
    assert [*found.arms[ARM].space] == ["learner.learning_rate", "learner.ent_coef", "learner.clip_range"]
    assert (found.total, len(found.trials), manifest.seeds) == (3, 2, (0, 1))
    assert all(cell.budget_steps == 4096 and cell.config["engine"] == "population" for cell in manifest.cells)


def test_a_study_that_comes_to_other_settings_is_refused(tmp_path: Path) -> None:
    path = write_tune(tmp_path, arms={"round_robin": ARMS["round_robin"]}, trials=2)
    made = plan_search(path, tmp_path / "runs")
    search = search_of(made.manifest)
    moved = [dataclasses.replace(trial, parameters={"learner.learning_rate": 0.5}) for trial in search.trials]
    made.grid.freeze(dataclasses.replace(made.manifest, search=search.with_trials(moved)), {})
    asked = Asked(str(made.grid.folder), 1, (0, 2048), 64, 1)
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.warns(UserWarning, match="out of range"),  # Optuna's, which draws another value then
        pytest.raises(SpaceDistError, match="trial 0 has other settings"),
    ):
        studied(asked, pool)
