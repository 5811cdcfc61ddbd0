"""The worked example of docs/tuning.md says what its kept files hold."""

from __future__ import annotations

import csv

from space_dist.experiment.tuning import load_tune
from tests.grids import ROOT

KEPT = ROOT / "docs/results/pointmass_tuned"
PAGE = (ROOT / "docs/tuning.md").read_text()


def rows(name: str) -> list[dict[str, str]]:
    with (KEPT / name).open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_trial_of_the_search_is_kept() -> None:
    config = load_tune(ROOT / "configs/tune/pointmass.yaml")
    trials = rows("trials.csv")
    assert [(row["arm"], row["state"]) for row in trials] == [
        (arm, "complete") for _ in range(config.trials // config.generation) for arm in config.arms
        for _ in range(config.generation)
    ]  # fmt: skip
    for arm in config.arms:
        best = max((row for row in trials if row["arm"] == arm), key=lambda row: float(row["search_objective"]))
        assert f"trial {best['trial']} " in PAGE
        assert f"| {float(best['search_objective']):.2f} |" in PAGE
        for key in ("learning_rate", "ent_coef", "clip_range"):
            assert best[f"learner.{key}"] in PAGE
        for key in ("eta", "kappa", "adaptive_eta"):
            assert best[f"curriculum.{key}"] in PAGE


def test_the_confirmed_numbers_are_those_of_the_files() -> None:
    for row in rows("cells.csv"):
        assert row["finished"] == "10"
        for measure in ("final", "early"):
            value, low, high = (float(row[f"{measure}_iqm{end}"]) for end in ("", "_low", "_high"))
            assert f"{value:.2f} [{low:.2f}, {high:.2f}]" in PAGE
        if row["configuration"] == "space":
            better, low, high = (float(row[f"final_probability_of_improvement{end}"]) for end in ("", "_low", "_high"))
            assert f"{better:.2f} [{low:.2f}, {high:.2f}]" in PAGE
