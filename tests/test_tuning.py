"""Searches: the file, the draws, what becomes of trials, and racing. What follows: tests/test_tuning_reports.py."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import random
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.errors import ConfigError, LedgerError
from space_dist.experiment.endings import Cause
from space_dist.experiment.grid_file import load_grid
from space_dist.experiment.manifest import Manifest, Run
from space_dist.experiment.sampling import given_up
from space_dist.experiment.status import Attempts
from space_dist.experiment.tuning import Distribution, Objective, Pruner, TuneConfig, find_tune, load_tune
from space_dist.grid.planning import plan
from space_dist.grid.trials import HeldUpError, advance, open_runs
from space_dist.grid.tuning import confirmation, plan_search
from space_dist.report import load_run
from space_dist.report.objective import over_seeds
from space_dist.report.search_report import build_search_report
from tests.commanding import command
from tests.grids import SMALL, write_grid
from tests.test_report import continue_run, start_run
from tests.tunes import ARMS, RATE, ROOT, end, reached, search_of, search_through, write_tune

GOAL = str(ROOT / "configs/instances/pointmass_goal_test.csv")
UNIFORM = str(ROOT / "configs/instances/pointmass_uniform_test.csv")


def choices(manifest: Manifest) -> list[tuple[str, int, dict[str, Any]]]:
    return [(trial.arm, trial.number, dict(trial.parameters)) for trial in search_of(manifest).trials]


# ---- the file -------------------------------------------------------------------------------------------------------


def arm(**changes: Any) -> dict[str, Any]:
    """The arms, with these changes of SPaCE's section."""
    changed = copy.deepcopy(ARMS)
    changed["space"].update(changes)
    return changed


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"search": {"learner.learning_rat": RATE}}, ("learner.learning_rat", "did you mean 'learning_rate'")),
        ({"search": {"learnr.gamma": RATE}}, ("learnr", "did you mean 'learner'")),
        ({"search": {"learner.gamma": {"float": [0.9, 1.5]}}}, ("learner.gamma", "1.5")),
        ({"search": {"learner.gamma": {"float": [0.9, 0.9]}}}, ("search.learner.gamma", "empty", "under set")),
        ({"search": {"learner.gamma": {"float": [0.99, 0.9]}}}, ("[0.99, 0.9] is empty",)),
        ({"search": {"learner.gamma": {}}}, ("search.learner.gamma", "exactly one of float, int and choice")),
        ({"search": {"learner.gamma": {"float": [0.9, 1.0], "int": [1, 2]}}}, ("not float and int",)),
        ({"search": {"learner.gamma": {"floats": [0.9, 1.0]}}}, ("search.learner.gamma.floats", "mean 'float'")),
        ({"search": {"learner.gamma": {"float": [0.9]}}}, ("search.learner.gamma.float",)),
        ({"search": {"learner.ent_coef": {"float": [0.0, 1.0], "log": True}}}, ("log needs a range above 0",)),
        ({"search": {"learner.batch_size": {"choice": []}}}, ("at least two values",)),
        ({"search": {"learner.batch_size": {"choice": [32, 32]}}}, ("each of them once",)),
        ({"search": {"learner.batch_size": {"choice": [32, -1]}}}, ("learner.batch_size", "-1")),
        ({"search": {"budget.steps": {"int": [2048, 4096]}}}, ("search.budget.steps", "not better tuned")),
        ({"search": {"instances.test": {"choice": ["a", "b"]}}}, ("search.instances.test", "another task")),
        ({"search": {"env": {"choice": ["a", "b"]}}}, ("search.env", "another environment")),
        ({"search": {"seed": {"int": [0, 9]}}}, ("search.seed", "same `seeds`")),
        ({"set": {"tracking.uri": None}}, ("set.tracking.uri",)),
        ({"set": {**SMALL, "learner.learning_rate": 1e-3}}, ("learner.learning_rate is given twice",)),
        ({"search": {"learner": {"choice": ["a", "b"]}}, "set": SMALL}, ("is a part of learner",)),
        ({"search": {}}, ("arms.round_robin has nothing to search",)),
        ({"arms": arm(search={"curriculum.kapa": {"int": [1, 2]}})}, ("kapa", "did you mean 'kappa'")),
        ({"arms": arm(search={"learner.learning_rate": RATE})}, ("given twice",)),
        ({"arms": arm(set={"budget.steps": 9999})}, ("arms.space.set.budget.steps",)),
        ({"arms": {"../x": {}}}, ("arms", "'../x'")),
        ({"arms": {}}, ("arms",)),
        ({"arms": arm(search={"curriculum.eta": {**RATE, "when": {"curriculum.pic": "nothing"}}})}, ("never drawn",)),
        ({"arms": arm(search={"curriculum.eta": {**RATE, "when": {"curriculum.pick": "abs"}}})},
         ("curriculum.pick", "no such key", "did you mean 'curriculum.pic'")),
        ({"arms": arm(search={"curriculum.eta": {**RATE, "when": {"curriculum.kappa": 2}},
                              "curriculum.kappa": {"int": [1, 3], "when": {"curriculum.eta": 0.1}}})},
         ("go round in a circle",)),
        ({"search": {"learner.learning_rate": RATE, "learner.gamma": {
            "float": [0.9, 0.99], "when": {"curriculum.kind": "plr"}}}}, ("search.learner.gamma", "in no arm")),
        ({"trials": 0}, ("trials",)),
        ({"seeds": []}, ("seeds", "at least one")),
        ({"confirm": {"seeds": [2, 9], "instances": {"test": UNIFORM}}}, ("confirm.seeds", "2 is one of the search's")),
        ({"confirm": {"seeds": [9], "instances": {"test": GOAL}}}, ("confirm.instances", "shares 100 of its 100")),
        ({"confirm": {"seeds": [9], "instances": {"test": "gone.csv"}}}, ("gone.csv",)),
        ({"confirm": {"seeds": [9], "instances": {"test": UNIFORM}, "set": {"seed": 1}}}, ("confirm.set.seed",)),
        ({"confirm": {"seeds": [9], "instances": {"test": UNIFORM}, "set": {"budget.step": 1}}},
         ("confirm.set", "budget.step", "did you mean 'steps'")),
        ({"confirm": {"seeds": [9], "instances": {"test": UNIFORM}, "set": {"instances.test": GOAL}}},
         ("named by confirm.instances",)),
        ({"confirm": None}, ("confirm", "required")),
        ({"objective": {"kind": "steps"}}, ("objective", "needs a threshold")),
        ({"objective": {"kind": "final", "threshold": 1.0}}, ("threshold says nothing",)),
        ({"objective": {"kind": "worst"}}, ("evaluation.episodes of 2 or more",)),
        ({"objective": {"kind": "best"}}, ("objective.kind", "best")),
        ({"sampler": {"kind": "tpee"}}, ("sampler.kind",)),
        ({"pruner": {"rungs": [3]}}, ("pruner.rungs", "fewer than the 3")),
        ({"pruner": {"rungs": [2, 1]}}, ("ascending",)),
        ({"extends": "nowhere.yaml"}, ("nowhere.yaml", "does not exist")),
        ({"nme": "x"}, ("nme", "did you mean 'name'")),
        ({"trials": 10_000, "seeds": {"count": 100}}, ("more than 100,000 runs",)),
    ],
)  # fmt: skip
def test_hostile_searches_are_refused_in_a_sentence(
    sections: dict[str, Any], words: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as caught:
        plan_search(write_tune(tmp_path, **sections), tmp_path / "runs")
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert "tune.yaml" in text or "nowhere.yaml" in text
    assert len(text) < 2000
    assert not list(tmp_path.glob("runs/*/manifest.json"))


@pytest.mark.parametrize(
    ("sections", "told"),
    [
        ({"arms": arm(set={"curriculum": {"kind": "spce"}})}, "arms.space.set: curriculum.kind: 'spce' is not known"),
        ({"search": {"learner.learnin_rate": RATE}},
         "search: learner.learnin_rate: unknown key; did you mean 'learning_rate'"),
        ({"arms": arm(search={"curriculum.kapa": {"int": [1, 2]}})},
         "arms.space.search: curriculum.kapa: unknown key"),
        ({"set": {**SMALL, "learner.n_stps": 3}}, "set: learner.n_stps: unknown key"),
    ],
)  # fmt: skip
def test_a_fault_is_told_where_the_file_has_it(sections: dict[str, Any], told: str, tmp_path: Path) -> None:
    path = write_tune(tmp_path, **sections)
    with pytest.raises(ConfigError) as caught:
        plan_search(path, tmp_path / "runs")
    assert str(caught.value).startswith(f"{path}: {told}")


def test_a_fault_of_the_run_config_names_it(tmp_path: Path) -> None:
    base = tmp_path / "base.yaml"
    text = (ROOT / "configs/pointmass_round_robin.yaml").read_text()
    base.write_text(text.replace("instances/", f"{ROOT}/configs/instances/").replace("gamma:", "gama:"))
    with pytest.raises(ConfigError, match=r"tune\.yaml: extends: base\.yaml: learner\.gama: unknown key"):
        plan_search(write_tune(tmp_path, extends="base.yaml"), tmp_path / "runs")


def test_every_field_of_a_search_is_explained() -> None:
    seen = {TuneConfig, Distribution}
    for field in TuneConfig.model_fields.values():
        seen |= {one for one in [field.annotation] if hasattr(one, "model_fields")}
    for model in seen:
        for name, field in model.model_fields.items():
            assert hasattr(field.annotation, "model_fields") or len(field.description or "") > 10, (model, name)


def test_what_was_never_begun_is_the_users_mistake_and_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 1 of `status` would say that runs have failed."""
    tune, grid = write_tune(tmp_path), write_grid(tmp_path, name="other")
    for words, said in [
        (("tune", "status", tune), "tune plan"),
        (("tune", "report", tune), "tune plan"),
        (("tune", "confirm", tune), "tune plan"),
        (("tune", "status", tmp_path), "holds no search"),
        (("grid", "status", grid), "grid plan"),
        (("grid", "status", tmp_path), "holds no grid"),
        (("grid", "status", tmp_path / "manifest.json"), "holds no grid"),
    ]:
        assert command(monkeypatch, *words, "--root", tmp_path / "runs") == 2, words
        assert said in capsys.readouterr().err.replace("\n", " "), words


def test_a_search_is_no_grid_and_a_grid_no_search(tmp_path: Path) -> None:
    tune, grid = write_tune(tmp_path), write_grid(tmp_path, name="search")
    with pytest.raises(ConfigError, match="is a search: space-dist tune run"):
        load_grid(tune)
    with pytest.raises(ConfigError, match="is a search"):
        configs.read(tune)
    with pytest.raises(ConfigError, match="is a grid: space-dist grid run"):
        load_tune(grid)
    with pytest.raises(LedgerError, match="tune plan"):
        find_tune(tune, tmp_path / "runs")
    plan_search(tune, tmp_path / "runs")
    with pytest.raises(ConfigError, match="holds a search of this name"):
        plan(grid, tmp_path / "runs")
    plan(grid, tmp_path / "others")
    with pytest.raises(ConfigError, match="holds a grid of this name"):
        plan_search(tune, tmp_path / "others")


def test_a_value_that_only_some_company_takes_is_no_fault(tmp_path: Path) -> None:
    """growth: multiply needs a kappa of two or more, so it cannot be had with a kappa of one."""
    kappa = {"choice": [1, 2]}
    made = plan_search(
        write_tune(tmp_path, generation=6, arms=arm(
            search={"curriculum.growth": {"choice": ["add", "multiply"]}, "curriculum.kappa": kappa}
        )), tmp_path / "runs",
    )  # fmt: skip
    refused = [trial for trial in search_of(made.manifest).trials if not trial.cell]
    assert [trial.state for trial in refused] == ["failed"] * len(refused)
    assert all(dict(trial.parameters)["curriculum.kappa"] == 1 for trial in refused)
    assert all("kappa" in trial.remark for trial in refused)
    assert refused


# ---- draws ----------------------------------------------------------------------------------------------------------


KNOWN = [
    ("round_robin", 0, [0.000833998]),
    ("round_robin", 1, [0.000338427]),
    ("space", 0, [0.00462023, 16, "add"]),
    ("space", 1, [0.00283335, 14, "multiply"]),
    ("round_robin", 2, [0.00228317]),
    ("round_robin", 3, [0.00891681]),
    ("space", 2, [0.000589286, 8, "multiply"]),
    ("space", 3, [0.000170571, 2, "multiply"]),
    ("round_robin", 4, [0.000118387]),
    ("round_robin", 5, [0.000976755]),
    ("space", 4, [0.000204358, 6, "multiply"]),
    ("space", 5, [0.000959871, 10, "add"]),
]


def test_draws_are_known_numbers(tmp_path: Path) -> None:
    """Of the seed, the arm and the generation: another Optuna, or a change of ours, would move them."""
    _, manifest = search_through(write_tune(tmp_path), tmp_path / "runs", generations=2)
    found = [(name, number, [*setting.values()]) for name, number, setting in choices(manifest)]
    assert found == KNOWN


def test_the_same_choices_whoever_ends_first(tmp_path: Path) -> None:
    orders = [list, lambda runs: list(reversed(runs)), lambda runs: random.Random(5).sample(list(runs), len(runs))]
    made = [search_through(write_tune(tmp_path), tmp_path / f"{place}", order=order)
            for place, order in enumerate(orders)]  # fmt: skip
    contents = {grid.manifest_file.read_bytes() for grid, _ in made}
    assert len(contents) == 1
    assert search_of(made[0][1]).over
    assert len({json.dumps(setting) for *_, setting in choices(made[0][1])}) == 12


def test_an_arm_is_drawn_for_itself(tmp_path: Path) -> None:
    _, both = search_through(write_tune(tmp_path / "a"), tmp_path / "a")
    _, alone = search_through(write_tune(tmp_path / "b", arms={"space": ARMS["space"]}), tmp_path / "b")
    assert [one for one in choices(both) if one[0] == "space"] == choices(alone)
    _, other = search_through(write_tune(tmp_path / "c", seed=1), tmp_path / "c")
    assert choices(other) != choices(both)


def test_what_was_told_moves_later_generations_and_nothing_before(tmp_path: Path) -> None:
    _, one = search_through(write_tune(tmp_path), tmp_path / "a")
    _, other = search_through(write_tune(tmp_path), tmp_path / "b", outcome=lambda run: -reached(run))
    first, later = ([trial.generation == 0 for trial in search_of(one).trials].count(True), len(choices(one)))
    assert choices(one)[:first] == choices(other)[:first]
    assert choices(one)[first:later] != choices(other)[first:later]


def test_tpe_learns_where_random_does_not(tmp_path: Path) -> None:
    """Thirty trials on a peak at a learning rate of 0.001: the last ones of TPE are nearer to it."""

    def distance(kind: str) -> float:
        path = write_tune(tmp_path / kind, trials=30, generation=5, seeds=[0], arms={"a": {}},
                          sampler={"kind": kind, "startup": 10})  # fmt: skip
        _, manifest = search_through(path, tmp_path / kind)
        late = [float(dict(trial.parameters)["learner.learning_rate"]) for trial in search_of(manifest).trials[15:]]
        return float(np.mean(np.abs(np.log10(late) + 3.0)))

    assert distance("tpe") < 0.7 * distance("random")


def test_conditions_decide_what_is_drawn(tmp_path: Path) -> None:
    space = {
        "curriculum.patience": {"int": [2, 9], "when": {"curriculum.adaptive_eta": ["once", "persistent"]}},
        "curriculum.adaptive_eta": {"choice": ["off", "once", "persistent"]},
    }
    eta = {"float": [0.01, 0.5], "when": {"curriculum.kind": "space"}}
    made = plan_search(
        write_tune(tmp_path, arms=arm(search=space), generation=6, search={"learner.learning_rate": RATE,
                                                                           "curriculum.eta": eta}), tmp_path,
    )  # fmt: skip
    drawn = [dict(trial.parameters) for trial in search_of(made.manifest).of_arm("space")]
    for one in drawn:
        assert ("curriculum.patience" in one) == (one["curriculum.adaptive_eta"] != "off")
        assert "curriculum.eta" in one
    assert len({"curriculum.patience" in one for one in drawn}) == 2
    assert all(
        [*trial.parameters] == ["learner.learning_rate"] for trial in search_of(made.manifest).of_arm("round_robin")
    )


def test_values_have_six_digits_and_stay_in_their_range(tmp_path: Path) -> None:
    space = {"learner.learning_rate": {"float": [0.00123456789, 0.0012345679], "log": True}}
    made = plan_search(write_tune(tmp_path, search=space, arms={"a": {}}), tmp_path / "runs")
    rates = [float(dict(trial.parameters)["learner.learning_rate"]) for trial in search_of(made.manifest).trials]
    assert all(0.00123456789 <= rate <= 0.0012345679 for rate in rates)
    made = plan_search(write_tune(tmp_path, arms={"a": {}}, name="b"), tmp_path / "runs")
    for trial in search_of(made.manifest).trials:
        rate = float(dict(trial.parameters)["learner.learning_rate"])
        assert rate == float(f"{rate:.6g}")


# ---- trials ---------------------------------------------------------------------------------------------------------


def test_trials_are_cells_with_the_objective_over_their_seeds(tmp_path: Path) -> None:
    grid, manifest = search_through(write_tune(tmp_path), tmp_path / "runs")
    search = search_of(manifest)
    assert Counter(trial.arm for trial in search.trials) == {"round_robin": 6, "space": 6}
    assert grid.manifest() == manifest
    for trial in search.trials:
        cell = manifest.cell(trial.cell)
        finals = [reached(Run(cell, seed)) for seed in (0, 1, 2)]
        assert trial.value == pytest.approx(float(np.mean(finals)))
        assert cell.settings == {"arm": trial.arm, "trial": trial.number, **trial.parameters}
        assert cell.config["learner"]["learning_rate"] == trial.parameters["learner.learning_rate"]
    for name in search.arms:
        best = search.best(name)
        assert best is not None
        assert best.value == max(trial.value or -math.inf for trial in search.of_arm(name))
    assert advance(grid, manifest) == manifest


def test_a_search_whose_runs_are_not_over_waits(tmp_path: Path) -> None:
    made = plan_search(write_tune(tmp_path), tmp_path / "runs")
    runs = open_runs(made.manifest)
    assert len(runs) == 12
    for run in runs[:-1]:
        end(made.grid, run, 1.0)
    content = made.grid.manifest_file.read_bytes()
    assert advance(made.grid, made.manifest) is None
    assert made.grid.manifest_file.read_bytes() == content


@pytest.mark.parametrize("cause", [Cause.CRASH, Cause.OUT_OF_MEMORY, Cause.TIMEOUT, Cause.CONFIG_ERROR])
def test_a_trial_that_fails_is_told_and_the_search_goes_on(cause: Cause, tmp_path: Path) -> None:
    def outcome(run: Run) -> float | Cause:
        return cause if run.cell.label == "space 1" and run.seed > 0 else reached(run)

    for place in ("a", "b"):
        _, manifest = search_through(write_tune(tmp_path), tmp_path / place, outcome=outcome)
        search = search_of(manifest)
        failed = [trial for trial in search.trials if trial.state == "failed"]
        assert [(one.arm, one.number, one.remark) for one in failed] == [("space", 1, f"seed 1: {cause.in_words}")]
        assert search.over
    assert (tmp_path / "a/search/manifest.json").read_bytes() == (tmp_path / "b/search/manifest.json").read_bytes()


def test_an_objective_that_is_no_number_fails_a_trial(tmp_path: Path) -> None:
    def outcome(run: Run) -> float | None:
        return None if run.cell.label == "round_robin 3" and run.seed == 2 else reached(run)

    _, manifest = search_through(write_tune(tmp_path), tmp_path / "runs", outcome=outcome)
    (failed,) = [trial for trial in search_of(manifest).trials if trial.state == "failed"]
    assert (failed.number, failed.remark, failed.value) == (3, "its objective is no number", None)


def test_a_search_in_which_everything_fails_ends(tmp_path: Path) -> None:
    grid, manifest = search_through(write_tune(tmp_path), tmp_path / "runs", outcome=lambda run: Cause.CRASH)
    search = search_of(manifest)
    assert search.over
    assert {trial.state for trial in search.trials} == {"failed"}
    assert [search.best(name) for name in search.arms] == [None, None]
    with pytest.raises(ConfigError, match="none of its 6 trials is complete"):
        confirmation(grid, manifest)
    assert "12 failed" in build_search_report(grid).summary[0]


@pytest.mark.parametrize("cause", [Cause.KILLED, Cause.NODE_LOST, Cause.PREEMPTED])
def test_an_end_that_says_nothing_of_the_setting_holds_the_search_up(cause: Cause, tmp_path: Path) -> None:
    retry = {"killed": 0, "node_lost": 0, "preempted": 0}
    made = plan_search(write_tune(tmp_path, retry=retry), tmp_path / "runs")
    first, *others = open_runs(made.manifest)
    end(made.grid, first, cause)
    for run in others:
        end(made.grid, run, reached(run))
    with pytest.raises(HeldUpError, match=f"--cause {cause}"):
        advance(made.grid, made.manifest)
    Attempts(made.grid.ledger(first)).forgive()
    assert advance(made.grid, made.manifest) is None  # it waits for the run
    end(made.grid, first, reached(first))
    after = advance(made.grid, made.manifest)
    assert after is not None
    _, alone = search_through(write_tune(tmp_path, retry=retry), tmp_path / "alone", generations=1)
    assert choices(alone)[:4] == choices(after)


def test_a_run_that_cannot_be_read_says_nothing_of_its_setting(tmp_path: Path) -> None:
    made = plan_search(write_tune(tmp_path), tmp_path / "runs")
    first, *others = open_runs(made.manifest)
    for run in others:
        end(made.grid, run, reached(run))
    ledger = made.grid.ledger(first)
    ledger.folder.mkdir(parents=True, exist_ok=True)
    ledger.status_file.write_text("{}")
    with pytest.raises(HeldUpError, match=f"unreadable, which says nothing of its setting.*remove {ledger.folder}"):
        advance(made.grid, made.manifest)


def test_what_was_told_stays_though_a_run_is_tried_again(tmp_path: Path) -> None:
    grid, manifest = search_through(
        write_tune(tmp_path), tmp_path / "runs", generations=1,
        outcome=lambda run: Cause.CRASH if run.cell.label == "space 0" else reached(run),
    )  # fmt: skip
    crashed = next(run for run in manifest.runs() if run.cell.label == "space 0")
    Attempts(grid.ledger(crashed)).forgive()
    end(grid, crashed, 99.0)
    _, after = search_through(write_tune(tmp_path), tmp_path / "runs")
    assert search_of(after).of_arm("space")[0].state == "failed"


def test_the_same_setting_twice_has_the_same_runs(tmp_path: Path) -> None:
    arms = {"a": {"search": {"learner.n_epochs": {"choice": [1, 2]}}}}
    grid, manifest = search_through(write_tune(tmp_path, search=None, arms=arms, set={
        key: value for key, value in {**SMALL, "instances.test": GOAL}.items() if key != "learner.n_epochs"
    }), tmp_path / "runs")  # fmt: skip
    trials = search_of(manifest).trials
    assert (len(trials), len(manifest.cells), len(manifest.runs())) == (6, 2, 6)
    assert {trial.value is not None for trial in trials} == {True}
    assert grid.manifest() == manifest


def test_a_search_goes_on_from_what_its_folder_holds(tmp_path: Path) -> None:
    base, root = tmp_path / "base.yaml", tmp_path / "runs"
    text = (ROOT / "configs/pointmass_round_robin.yaml").read_text()
    base.write_text(text.replace("instances/", f"{ROOT}/configs/instances/"))
    path = write_tune(tmp_path, extends=str(base))
    for generation in (1, 2):
        search_through(path, root, generations=generation)
    grid, manifest = search_through(path, root)
    alone, _ = search_through(path, tmp_path / "alone")
    assert grid.manifest_file.read_bytes() == alone.manifest_file.read_bytes()
    with pytest.raises(ConfigError, match="planned with another seed"):
        plan_search(write_tune(tmp_path, extends=str(base), seed=3), root)
    other = {"learner.learning_rate": {**RATE, "float": [1e-5, 1e-2]}}
    with pytest.raises(ConfigError, match=r"planned with another search\.learner\.learning_rate\.float"):
        plan_search(write_tune(tmp_path, extends=str(base), search=other), root)
    with pytest.raises(ConfigError, match=r"with 6, and 6 of each arm were asked; .* not fewer than were asked"):
        plan_search(write_tune(tmp_path, extends=str(base), trials=4), root)
    path = write_tune(tmp_path, extends=str(base), trials=8)
    grid, more = search_through(path, root)
    assert choices(more)[: len(choices(manifest))] == choices(manifest)
    assert len(choices(more)) == 16
    whole, _ = search_through(path, tmp_path / "whole")
    assert whole.manifest_file.read_bytes() == grid.manifest_file.read_bytes()
    base.write_text(base.read_text().replace("gamma: 0.95", "gamma: 0.9"))
    with pytest.raises(ConfigError, match="the run config that it extends"):
        plan_search(path, root)


def test_a_plan_binds_no_more_than_what_was_asked(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    grid, done = search_through(write_tune(tmp_path, trials=2), root)
    ended = grid.manifest_file.read_bytes()
    plan_search(write_tune(tmp_path, trials=3), root)  # a third was planned, and not asked
    assert plan_search(write_tune(tmp_path, trials=2), root).manifest == done
    assert grid.manifest_file.read_bytes() == ended
    with pytest.raises(ConfigError, match="planned with 2, and 2 of each arm were asked") as told:
        plan_search(write_tune(tmp_path, trials=1), root)
    assert "remove" not in str(told.value)  # runs of it are there
    search_through(write_tune(tmp_path, trials=3), root)
    with pytest.raises(ConfigError, match="where those it has are a multiple of generation: 2"):
        plan_search(write_tune(tmp_path, trials=4), root)


def test_a_search_of_which_nothing_has_run_says_what_frees_its_name(tmp_path: Path) -> None:
    grid = plan_search(write_tune(tmp_path), tmp_path / "runs").grid
    for other in (write_tune(tmp_path, seed=3), write_tune(tmp_path, trials=1)):
        with pytest.raises(ConfigError, match=f"since nothing of it has run yet, remove {grid.folder}$"):
            plan_search(other, tmp_path / "runs")
        plan_search(other, tmp_path / "elsewhere")
        shutil.rmtree(tmp_path / "elsewhere")


def test_another_optuna_draws_nothing_in_a_search_of_this_one(tmp_path: Path) -> None:
    made = plan_search(write_tune(tmp_path), tmp_path / "runs")
    older = dataclasses.replace(search_of(made.manifest), optuna="1.0.0")
    manifest = dataclasses.replace(made.manifest, search=older)
    for run in open_runs(manifest):
        end(made.grid, run, reached(run))
    judged = advance(made.grid, manifest)  # which draws nothing
    assert judged is not None
    with pytest.raises(ConfigError, match=r"begun with Optuna 1\.0\.0"):
        advance(made.grid, judged)


def test_a_changed_record_is_refused(tmp_path: Path) -> None:
    grid, manifest = search_through(write_tune(tmp_path), tmp_path / "runs", generations=1)
    content = grid.manifest_file.read_bytes()
    assert Manifest.from_json(content, "it") == manifest
    rng = random.Random(0)
    for position in rng.sample(range(len(content)), 40):
        grid.manifest_file.write_bytes(content[:position] + b"#" + content[position + 1 :])
        with pytest.raises(LedgerError, match=r"damaged|format"):
            grid.manifest()
    trials = search_of(manifest).trials
    for forged in (
        dataclasses.replace(trials[0], number=1), dataclasses.replace(trials[0], cell="0" * 12),
        dataclasses.replace(trials[0], values={}), dataclasses.replace(trials[0], values={3: math.nan}),
        dataclasses.replace(trials[0], state="lost"),
    ):  # fmt: skip
        changed = dataclasses.replace(
            manifest, search=search_of(manifest).with_trials([forged, *trials[1:]])
        )  # fmt: skip
        with pytest.raises(LedgerError, match="damaged"):
            Manifest.from_json(changed.to_json(), "it")


# ---- racing ---------------------------------------------------------------------------------------------------------


def test_halving_gives_more_seeds_to_the_best_third(tmp_path: Path) -> None:
    path = write_tune(tmp_path, generation=6, pruner={"rungs": [1, 2]})
    grid, manifest = search_through(path, tmp_path / "runs")
    search = search_of(manifest)
    for name in search.arms:
        trials = search.of_arm(name)
        by_first_seed = sorted(trials, key=lambda trial: -trial.values[1])
        assert [trial.seeds for trial in by_first_seed] == [3, 2, 1, 1, 1, 1]
        assert [trial.state for trial in by_first_seed] == ["complete", *["pruned"] * 5]
        for trial in trials:
            assert [*trial.values] == [1, 2, 3][: trial.seeds]
            assert len(manifest.seeds_of(manifest.cell(trial.cell))) == trial.seeds
    assert len(manifest.runs()) == 2 * (6 + 2 + 1)
    assert sorted({run.seed for run in manifest.runs()}) == [0, 1, 2]
    other, _ = search_through(path, tmp_path / "other", order=lambda runs: list(reversed(runs)))
    assert other.manifest_file.read_bytes() == grid.manifest_file.read_bytes()


def test_less_is_better_where_steps_are_counted(tmp_path: Path) -> None:
    made = plan_search(write_tune(tmp_path, objective={"kind": "steps", "threshold": 0.0}), tmp_path / "runs")
    search = search_of(made.manifest)
    trials = [dataclasses.replace(trial, seeds=1, values={1: value}) for trial, value in
              zip(search.of_arm("space"), (500.0, 900.0), strict=True)]  # fmt: skip
    assert given_up(search, "space", trials, Pruner(keep=0.5)) == {1}
    complete = [dataclasses.replace(trial, state="complete", seeds=3, values={3: value})
                for trial, value in zip(search.of_arm("space"), (500.0, 400.0), strict=True)]  # fmt: skip
    best = search.with_trials(complete).best("space")
    assert best is not None
    assert best.number == 1


def test_the_median_gives_up_whoever_is_below_that_of_complete_trials(tmp_path: Path) -> None:
    path = write_tune(tmp_path, trials=10, generation=5, pruner={"kind": "median", "rungs": [1], "startup": 5})
    _, manifest = search_through(path, tmp_path / "runs")
    for name in search_of(manifest).arms:
        trials = search_of(manifest).of_arm(name)
        assert [trial.state for trial in trials[:5]] == ["complete"] * 5
        median = float(np.median([trial.values[1] for trial in trials[:5]]))
        for trial in trials[5:]:
            assert (trial.state == "pruned") == (trial.values[1] < median)


# ---- the objective --------------------------------------------------------------------------------------------------


def test_objectives_are_the_reports_statistics(tmp_path: Path) -> None:
    """Returns at 0, 1000, 2000, 3000 and 4000 steps of a budget of 4000."""
    curves = (
        [0.0, 4.0, 4.0, 4.0, 4.0],
        [0.0, 0.0, 4.0, 4.0, 8.0],
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 4.0, 4.0, 4.0],
    )
    runs = []
    for seed, curve in enumerate(curves):
        ledger = start_run(tmp_path / str(seed), seed=seed)
        continue_run(ledger, curve, [[0]] * 4, state="done")
        runs.append(load_run(ledger))
    # Of 0, 4, 4 and 8 the middle half is 4 and 4; areas are 3.5, 3, 0 and 2.5, their middle half 3 and 2.5.
    assert over_seeds(runs, Objective(kind="final"), 4000) == 4.0
    assert over_seeds(runs, Objective(kind="area"), 4000) == pytest.approx(2.75)
    # 4 is reached at 1000, 2000, never (censored at 4000), and 2000.
    assert over_seeds(runs, Objective(kind="steps", threshold=4.0), 4000) == pytest.approx(9000 / 4)
    assert math.isnan(over_seeds(runs, Objective(kind="worst"), 4000))  # one episode each: there are no halves
    # As they were at 2000 steps: 4, 4, 0 and 4; areas 3, 1, 0 and 1.
    early = [run.until(1500) for run in runs]
    assert all(run.evaluation_steps[-1] == 2000 for run in early)
    assert over_seeds(early, Objective(kind="final"), 2000) == 4.0
    assert over_seeds(early, Objective(kind="area"), 2000) == pytest.approx(1.0)
    assert all(run.until(4001) is run for run in runs)  # they ended before
    unfinished = start_run(tmp_path / "more", seed=7)
    continue_run(unfinished, [0.0, 1.0], [[0]], state="failed")
    assert math.isnan(over_seeds([*runs, load_run(unfinished)], Objective(), 4000))
