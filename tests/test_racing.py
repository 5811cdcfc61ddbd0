"""Searches whose runs are paused and gone on with: racing over steps, and population-based training."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from space_dist.api.tuning import run_search
from space_dist.config import RunConfig
from space_dist.errors import ConfigError
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.search import Search, Trial
from space_dist.grid.tuning import confirmation, plan_search
from space_dist.ledger import CURRICULUM, METRICS
from space_dist.report.search_report import build_search_report
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests import prepared
from tests.grids import ROOT
from tests.patience import PATIENCE
from tests.test_tuning_runs import end_session, progress, tiny_tune
from tests.tunes import ARMS, RATE, search_of

BUDGET = 1024
SET = {"budget.steps": BUDGET, "evaluation.every_steps": 256, "engine": "auto"}
RUNGS = {"rungs": [{"seeds": 1, "steps": 256}, {"seeds": 2, "steps": 512}], "keep": 0.5}
POPULATION = {"every_steps": 256, "replace": 0.25}
KAPPAS = {**ARMS, "space": {**ARMS["space"], "search": {"curriculum.kappa": {"int": [2, 16]}}}}
RESULTS = (METRICS, CURRICULUM, "model.npz")


def racing_tune(folder: Path, **sections: Any) -> Path:
    changes = {**SET, **sections.pop("set", {})}
    return tiny_tune(folder, changes, **{"generation": 4, "pruner": RUNGS, **sections})


def population_tune(folder: Path, **sections: Any) -> Path:
    without = {"generation": None, "sampler": None, "search": {"learner.learning_rate": RATE}, "arms": KAPPAS}
    changes = {**SET, **sections.pop("set", {})}
    return tiny_tune(folder, changes, **{**without, "population": POPULATION, **sections})


@pytest.fixture(scope="module")
def raced(tmp_path_factory: pytest.TempPathFactory) -> Grid:
    folder = tmp_path_factory.mktemp("raced")
    return run_search(racing_tune(folder), root=folder / "runs", max_parallel=1, progress=False).grid


@pytest.fixture(scope="module")
def evolved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Grid]:
    folder = tmp_path_factory.mktemp("evolved")
    path = population_tune(folder)
    return path, run_search(path, root=folder / "runs", max_parallel=1, progress=False).grid


def results(grid: Grid, run: Run) -> dict[str, bytes]:
    return {name: (grid.ledger(run).folder / name).read_bytes() for name in RESULTS}


def runs_of(manifest: Manifest, trial: Trial) -> list[Run]:
    return [Run(manifest.cell(trial.cell), seed) for seed in manifest.seeds[: trial.seeds]]


def computed_anew(grid: Grid, run: Run, folder: Path) -> dict[str, bytes]:
    """What a run comes to that is made from its start to its end, by itself."""
    config: RunConfig = grid.run_config(grid.manifest(), run)
    launch(config, folder, resume=False, stop=StopRequests())
    return {name: (folder / name).read_bytes() for name in RESULTS}


# ---- racing ---------------------------------------------------------------------------------------------------------


def test_trials_race_over_seeds_and_steps(raced: Grid) -> None:
    manifest = raced.manifest()
    search = search_of(manifest)
    assert search.over
    for name in search.arms:
        trials = search.of_arm(name)
        assert sorted((trial.state, trial.rung, trial.seeds, trial.steps) for trial in trials) == [
            ("complete", 3, 2, 0), ("pruned", 1, 1, 256), ("pruned", 1, 1, 256), ("pruned", 2, 2, 512)
        ]  # fmt: skip
        first = {trial.number: trial.values[1] for trial in trials}
        second = {trial.number: trial.values[2] for trial in trials if 2 in trial.values}
        assert {*second} == {*sorted(first, key=lambda number: (-first[number], number))[:2]}
        for trial in trials:
            assert [*trial.values] == [*range(1, trial.rung + 1)]
            for run in runs_of(manifest, trial):
                status = raced.ledger(run).status()
                assert (status.state, status.paused_at) == (("paused", trial.steps) if trial.steps else ("done", 0))
                assert status.steps == (trial.steps or BUDGET)
                rows = [row for row in raced.ledger(run).rows() if row["kind"] == "evaluation"]
                assert [row["steps"] for row in rows] == [*range(0, status.steps + 1, 256)]
                if trial.seeds == 1:
                    assert rows[1]["test"]["return"] == trial.values[1]
    assert [search.best(name) for name in search.arms] == [
        next(trial for trial in search.of_arm(name) if trial.state == "complete") for name in search.arms
    ]


def test_who_comes_through_has_the_bits_of_a_run_that_never_paused(raced: Grid, tmp_path: Path) -> None:
    manifest = raced.manifest()
    for arm in search_of(manifest).arms:
        best = search_of(manifest).best(arm)
        assert best is not None
        run = runs_of(manifest, best)[1]
        assert results(raced, run) == computed_anew(raced, run, tmp_path / arm)


def test_the_report_of_a_race_counts_the_steps_that_were_taken(raced: Grid, tmp_path: Path) -> None:
    made = build_search_report(raced, tmp_path)
    # Two were given up after 256 steps of a seed, one after 512 of two, one had both seeds to the end.
    assert f"{2 * 256 + 2 * 512 + 2 * BUDGET:,}" in made.markdown


# ---- populations ----------------------------------------------------------------------------------------------------


def heirs_of(search: Search, arm: str) -> list[Trial]:
    return [trial for trial in search.of_arm(arm) if trial.parent >= 0]


def test_the_worst_go_on_from_the_best(evolved: tuple[Path, Grid]) -> None:
    search = search_of(evolved[1].manifest())
    assert search.over
    for arm in search.arms:
        trials, heirs = search.of_arm(arm), heirs_of(search, arm)
        assert [trial.generation for trial in heirs] == [1, 2, 3]  # one of four, at 256, 512 and 768 steps
        assert sorted(trial.state for trial in trials) == ["complete"] * 4 + ["pruned"] * 3
        for heir in heirs:
            at = heir.generation
            alive = [trial for trial in trials if at in trial.values]
            ranked = sorted(alive, key=lambda trial: (-trial.values[at], trial.number))
            assert heir.parent == ranked[0].number
            assert (ranked[-1].state, ranked[-1].rung) == ("pruned", at)
            assert heir.inherited == 2 * 256 * at
            assert heir.parameters != ranked[0].parameters
            for key, value in heir.parameters.items():
                low, high = search.arms[arm].space[key]["int" if key.endswith("kappa") else "float"]
                assert low <= value <= high


def test_an_heir_is_a_run_under_a_schedule(evolved: tuple[Path, Grid], tmp_path: Path) -> None:
    grid = evolved[1]
    manifest = grid.manifest()
    search = search_of(manifest)
    for arm in search.arms:
        heir = heirs_of(search, arm)[-1]
        schedule = manifest.cell(heir.cell).config["schedule"]
        lineage = search.lineage(heir)
        assert [change["set"] for change in schedule] == [dict(trial.parameters) for trial in lineage[1:]]
        assert [change["steps"] for change in schedule] == [256 * trial.generation for trial in lineage[1:]]
        run = runs_of(manifest, heir)[0]
        assert results(grid, run) == computed_anew(grid, run, tmp_path / arm)
        parent = runs_of(manifest, search.of_arm(arm)[heir.parent])[0]
        shared = [row for row in grid.ledger(parent).rows() if row["steps"] <= 256 * heir.generation]
        assert grid.ledger(run).rows()[: len(shared)] == shared
        assert grid.ledger(run).rows()[len(shared) :] != grid.ledger(parent).rows()[len(shared) :]


def test_what_a_population_found_is_confirmed_as_a_schedule(evolved: tuple[Path, Grid], tmp_path: Path) -> None:
    shutil.copytree(evolved[1].folder, tmp_path / "search")
    grid = Grid(tmp_path / "search")
    manifest = grid.manifest()
    written = confirmation(grid, manifest)
    found = 0
    for arm in search_of(manifest).arms:
        best = search_of(manifest).best(arm)
        assert best is not None
        text = (grid.folder / "confirm" / f"{arm}.yaml").read_text()
        assert ("schedule:" in text) == (best.parent >= 0)
        found += best.parent >= 0
    assert found
    assert f"space-dist grid run {written} " in build_search_report(grid, tmp_path / "before").summary[1]
    whole = grid.folder / "confirm/search-confirm.yaml"
    command = [sys.executable, "-m", "space_dist.cli", "grid", "run", whole, "--root", tmp_path]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, timeout=PATIENCE).returncode == 0
    made = build_search_report(grid, tmp_path / "report")
    assert "All 2 runs are finished" in made.summary[1]
    assert "; from 256 steps learner.learning_rate: " in made.markdown or "; from 512 steps" in made.markdown
    # Each of the four places of an arm has two seeds, trained to the end once.
    assert f"{4 * 2 * BUDGET:,}" in made.markdown
    assert "4/4 + 3 heirs" in made.markdown


def test_a_population_that_is_killed_ends_with_the_same_bytes(evolved: tuple[Path, Grid], tmp_path: Path) -> None:
    path, undisturbed = evolved
    root, moments, killed = tmp_path / "runs", random.Random(1), 0
    for attempt in range(20):
        words = ["tune", "run", path, "--root", root, "--max-parallel", 1 + attempt % 3]
        process = prepared.command(words, tmp_path / "said.txt")
        try:
            deadline, wanted = time.monotonic() + PATIENCE, moments.randrange(10, 90) if killed < 4 else 10**9
            before = progress(root)
            while process.is_alive() and progress(root) - before < wanted and time.monotonic() < deadline:
                time.sleep(0.02)
            if process.exitcode is not None:
                break
            killed += 1
        finally:
            end_session(process)
    assert killed >= 2
    assert process.exitcode == 0
    assert (root / "search/manifest.json").read_bytes() == undisturbed.manifest_file.read_bytes()
    ours = Grid(root / "search")
    for run in undisturbed.manifest().runs():
        if undisturbed.ledger(run).status().state == "done":
            assert results(ours, run) == results(undisturbed, run)


def test_a_member_that_fails_is_replaced(tmp_path: Path) -> None:
    rates = {"learner.learning_rate": {"choice": [1e-3, 1e30]}}
    never = {"every_steps": 512, "replace": 0.25, "resample": 0.0}
    path = population_tune(tmp_path, search=rates, arms={"a": {}}, population=never, seeds=[0])
    search = search_of(run_search(path, root=tmp_path / "runs", progress=False).manifest)
    failed = [trial for trial in search.trials if trial.state == "failed"]
    assert failed
    assert all(trial.parameters["learner.learning_rate"] == 1e30 for trial in failed)
    assert sum(trial.state == "complete" for trial in search.trials) == 4
    assert len(heirs_of(search, "a")) >= len(failed)


def test_status_tells_whose_copies_there_are(evolved: tuple[Path, Grid]) -> None:
    command = [sys.executable, "-m", "space_dist.cli", "tune", "status", str(evolved[1].folder)]
    table, told = (
        subprocess.run(
            [*command, *more],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=True,
            env={**os.environ, "COLUMNS": "200"},
        ).stdout
        for more in ([], ["--json"])
    )
    heads = next(line for line in table.splitlines() if "trial" in line)
    assert heads.replace("┃", " ").split() == ["arm", "trial", "from", "state", "seeds", "steps", "setting"]
    trials = json.loads(told)["trials"]
    assert sum(trial["parent"] is not None for trial in trials) == 6
    assert {trial["steps"] for trial in trials} == {None, 256, 512, 768}
    assert all(len(trial["values"]) >= 1 for trial in trials)


@pytest.mark.parametrize("path", sorted((ROOT / "configs/tune").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_search_of_the_repository_can_be_planned(path: Path, tmp_path: Path) -> None:
    assert plan_search(path, tmp_path).manifest.search is not None


# ---- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"pruner": {"rungs": [{"seeds": 1, "steps": 300}]}}, "compared at 300 steps"),
        ({"pruner": {"rungs": [{"steps": BUDGET}]}}, "no room for another round of 256 within budget.steps = 1,024"),
        ({"set": {"budget.steps": 1100, "evaluation.every_steps": 100}, "pruner": {"rungs": [{"steps": 1000}]}},
         "no room for another round"),
        ({"pruner": {"rungs": [{"seeds": 2}]}}, "pruner.rungs"),  # of two: that is the end
        ({"pruner": {"rungs": [{}]}}, "pruner.rungs"),
        ({"pruner": {"rungs": [{"seeds": 2, "steps": 256}, {"seeds": 1, "steps": 512}]}}, "of none of them less"),
        ({"pruner": {"rungs": [{"seeds": 1, "steps": 256}, {"seeds": 1, "steps": 256}]}}, "pruner.rungs"),
        ({"pruner": {"rungs": [{"seeds": 3, "steps": 256}]}}, "fewer than the 2 of a trial"),
        ({"pruner": {"rungs": [{"seed": 1}]}}, "did you mean 'seeds'"),
        ({"pruner": {"rungs": []}}, "pruner.rungs"),
    ],
)  # fmt: skip
def test_rungs_at_which_nothing_can_be_compared_are_refused(
    sections: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=words):
        plan_search(racing_tune(tmp_path, **sections), tmp_path / "runs")


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"population": {"every_steps": 300}}, "population.every_steps: trials cannot be compared at 300"),
        ({"population": {"every_steps": BUDGET}}, "must be less than budget.steps"),
        ({"population": {**POPULATION, "replace": 0.6}}, "population.replace"),
        ({"population": {**POPULATION, "factors": []}}, "population.factors"),
        ({"population": {**POPULATION, "factors": [0.0]}}, "population.factors"),
        ({"population": {}}, "population.every_steps"),
        ({"set": {"budget.episodes": 50}}, "budget.episodes, may have ended before"),
        ({"arms": {"a": {"set": {"curriculum": {"kind": "learnability", "top": 2}}}}}, "whose curriculum probes"),
        ({"pruner": {"rungs": [1]}}, "pruner says nothing with population"),
        ({"generation": 2}, "generation says nothing with population"),
        ({"sampler": {"kind": "random"}}, "sampler says nothing with population"),
        ({"trials": 1}, "at least 2 members"),
        ({"search": {"learner.net_arch": {"choice": [[8], [16]]}}}, "learner.net_arch cannot change on the way"),
        ({"arms": {"a": {"search": {"learner.learning_rat": RATE}}}}, "did you mean 'learner.learning_rate'"),
        ({"arms": {"a": {"set": {"schedule": [{"steps": 9, "set": {"learner.gamma": 0.5}}]}}}}, "a population finds"),
        ({"arms": {"a": {"search": {"learner.gamma": {"float": [0.5, 0.9], "when": {"learner.kind": "ppo"}}}}}},
         "no conditions"),
    ],
)  # fmt: skip
def test_populations_that_cannot_be_are_refused(sections: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        plan_search(population_tune(tmp_path, **sections), tmp_path / "runs")


def test_a_population_keeps_its_size(evolved: tuple[Path, Grid]) -> None:
    path, undisturbed = evolved
    larger = population_tune(path.parent, trials=5)
    try:
        with pytest.raises(ConfigError, match="has a population of 4, which cannot change its size"):
            plan_search(larger, undisturbed.folder.parent)
    finally:
        population_tune(path.parent)


def test_forged_lineages_are_refused(evolved: tuple[Path, Grid]) -> None:
    data = json.loads(evolved[1].manifest_file.read_bytes())["search"]
    heir = next(trial for trial in data["trials"] if trial["parent"] >= 0)
    for parent in (heir["number"], heir["number"] + 1, -2):
        heir["parent"] = parent
        with pytest.raises(ValueError, match="order"):
            Search.from_json(data)
