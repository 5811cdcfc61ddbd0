"""docs/wins.md: its worlds are what its commands draw, its arms what its searches found, its table what was kept."""

from __future__ import annotations

import csv
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.config import read_yaml
from space_dist.experiment.grid_file import load_grid
from space_dist.grid.planning import plan
from tests.commanding import command
from tests.shell import Shell, bash_blocks, one_server
from tests.test_paper import load_job

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs/wins.md").read_text()
WINS, SETS = ROOT / "configs/wins", ROOT / "configs/instances/wins"
WORLDS = ("gates", "gates_padded", "narrow_padded", "goalmaze_padded", "dense")
SECOND = ("gates_padded", "narrow_padded")
ARMS = ("round_robin", "uniform", "edge")
SEARCHED = ("learning_rate", "ent_coef", "n_epochs", "n_steps", "unrewarded")
OF_EDGE = {"outcome", "memory", "width", "strength", "uniform_share"}


def test_the_sets_are_what_the_pages_commands_draw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = bash_blocks("wins.md")[0].replace("\\\n", "")
    lines = [line for line in block.splitlines() if line.startswith("space-dist ")]
    assert len(lines) == 8
    for folder, seed in (("final", "2200"), ("development", "2100"), ("second", "2300")):
        for line in lines:
            words = shlex.split(Template(line).substitute(F=tmp_path / folder, S=seed))
            assert command(monkeypatch, *words[1:]) == 0
        kept = sorted((SETS / folder).iterdir())
        assert len(kept) == 7
        for path in kept:
            assert path.read_bytes() == (tmp_path / folder / path.name).read_bytes(), path


def contexts(path: Path) -> set[tuple[str, ...]]:
    with path.open() as file:
        return {tuple(row[1:]) for row in list(csv.reader(file))[1:]}


@pytest.mark.parametrize("folder", ["final", "second"])
def test_final_instances_are_none_that_anything_was_chosen_on(folder: str) -> None:
    final = set[tuple[str, ...]]().union(*map(contexts, (SETS / folder).iterdir()))
    # `share` is the second round's open gates, with more or fewer closed ones, and nothing was chosen on it.
    apart = (SETS / folder, SETS / "share")
    other = [path for path in (ROOT / "configs/instances").rglob("*.csv") if path.parent not in apart]
    assert len(other) > 40
    for path in other:
        assert not final & contexts(path), path


@pytest.mark.parametrize("world", SECOND)
def test_the_second_round_has_what_more_seeds_chose_and_all_else_as_the_first(world: str) -> None:
    with (ROOT / f"docs/results/wins/tuning/choose_{world}.csv").open() as file:
        tried = list(csv.DictReader(file))
    assert {row["seeds"] for row in tried} == {"10"}
    grid, cells = load_grid(WINS / f"choose/{world}.yaml")
    assert (len(cells), grid.seed_list()) == (12, tuple(range(100, 110)))
    for arm in ARMS:
        own = [row for row in tried if row["arm"] == arm]
        assert len(own) == 4
        best = max(own, key=lambda row: float(row["mean_area"]))
        first, second = (read_yaml(WINS / name / f"{arm}.yaml") for name in (world, f"{world}_second"))
        for key in SEARCHED:
            found = str(second["learner"].pop(key))
            assert found == best[f"learner.{key}"] or float(found) == float(best[f"learner.{key}"])
            first["learner"].pop(key, None)
        assert second.pop("name") == first.pop("name").replace(world, f"{world}_second")
        assert second.pop("instances") == {
            split: path.replace("/final/", "/second/") for split, path in first.pop("instances").items()
        }
        assert first == second
    grids = [read_yaml(WINS / f"{name}.yaml") for name in (world, f"{world}_second")]
    assert [one["seeds"]["start"] for one in grids] == [1000, 2000]
    assert len({json.dumps([one["set"], one["threshold"], one["seeds"]["count"]]) for one in grids}) == 1


@pytest.mark.parametrize("world", WORLDS)
def test_arms_differ_in_what_was_searched_and_in_nothing_else(world: str) -> None:
    """The best trial's settings, of the search that docs/results/wins keeps."""
    with (ROOT / f"docs/results/wins/tuning/{world}.csv").open() as file:
        trials = list(csv.DictReader(file))
    rest = []
    for arm in ARMS:
        data = read_yaml(WINS / world / f"{arm}.yaml")
        config = configs.load(WINS / world / f"{arm}.yaml")
        own = [trial for trial in trials if trial["arm"] == arm]
        assert len(own) == 12
        best = max(
            (trial for trial in own if trial["search_objective"]), key=lambda trial: float(trial["search_objective"])
        )
        for key in SEARCHED:
            text = best.get(f"learner.{key}", "")
            expected: Any = "critic" if (arm, key) == ("edge", "unrewarded") and world != "dense" else text
            if expected:
                found = data["learner"][key]
                assert found == expected if isinstance(found, str) else float(found) == float(expected)
            data["learner"].pop(key, None)
        assert data.pop("curriculum") == {"kind": arm}  # of edge: all of its numbers are the defaults
        assert config.curriculum.kind == arm
        data.pop("name")
        rest.append(data)
    assert rest[0] == rest[1] == rest[2]
    assert {*configs.load(WINS / world / "edge.yaml").curriculum.model_dump()} >= OF_EDGE


@pytest.mark.parametrize("world", WORLDS)
def test_a_world_has_its_budget_threshold_and_seeds_as_the_page_says(world: str) -> None:
    [row] = re.findall(rf"^\| `{world}` \|.*\|$", PAGE.partition("## What came out")[0], re.MULTILINE)
    *_, budget, threshold = (part.strip() for part in row.strip("|").split("|"))
    grid, cells = load_grid(WINS / f"{world}.yaml")
    assert {data["budget"]["steps"] for _, data in cells} == {int(budget.replace(",", ""))}
    assert grid.threshold == (None if threshold == "none" else float(threshold))
    assert grid.seed_list() == tuple(range(1000, 1020))
    search = read_yaml(ROOT / f"configs/tune/wins/{world}.yaml")
    assert (search["trials"], search["seeds"]) == (12, {"start": 0, "count": 3})
    assert list(search["arms"]) == list(ARMS)
    for split in ("train", "test"):
        [used] = {Path(data["instances"][split]).resolve() for _, data in cells}
        assert used.parent == SETS / "final"
        assert Path(search["set"][f"instances.{split}"]).parts[-2:] == ("development", used.name)


def test_the_commands_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In small, by bash; the first block is what the sets were drawn by, above."""
    drawn, ours, theirs = bash_blocks("wins.md")
    assert drawn.startswith("F=")
    shell = Shell(tmp_path / "clone", monkeypatch)
    sets = "configs/instances/wins/development/pointmass_uniform_"
    with one_server():
        shell.run(ours)
        shell.run(theirs, {"TRAIN.csv": f"{sets}padded.csv", "TEST.csv": f"{sets}test.csv"})
    runs = tmp_path / "clone/runs"
    [changed] = runs.glob("wins-gates-padded-second-set-*")
    assert {path.parent.parent.name for path in runs.glob("*/report/report.html")} == {
        "wins-gates-padded-second", changed.name
    }  # fmt: skip
    assert {path.name for path in runs.glob("wins-*")} - {changed.name} == {
        f"wins-{path.stem.replace('_', '-')}" for path in WINS.glob("*.yaml")
    }
    assert "Not as the grid's file has it" in (changed / "report/report.md").read_text()


@pytest.mark.parametrize("path", sorted([*WINS.glob("*.yaml"), *WINS.glob("why/*.yaml")]), ids=lambda path: path.stem)
def test_a_grid_can_be_run_in_small_and_on_other_instances(path: Path, tmp_path: Path) -> None:
    small = plan(path, tmp_path, 0.02)
    assert len(small.manifest.seeds) == 1
    test = Path(next(data["instances"]["test"] for _, data in load_grid(path)[1]))
    other = test.parents[1] / "development" / test.name
    if "replay" not in path.read_text():  # which follows recorded instances, and takes no other
        changed = plan(path, tmp_path, 1.0, [f"instances.test={other}"])
        assert len(changed.manifest.cells) == len(small.manifest.cells)
        assert changed.manifest.name.startswith(f"{load_grid(path)[0].name}-set-")


def test_the_page_says_what_the_kept_results_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """Number for number: the tables are made of them again."""
    tables = load_job("wins", monkeypatch).TABLES
    for world in (*WORLDS, *(f"{one}_second" for one in SECOND)):
        assert f"results/wins/{world}/report.md" in tables["worlds"]()
    for name, made in tables.items():
        there = PAGE.partition(f"<!-- {name}: made by jobs/wins.py -->")[2].partition(f"<!-- end of {name} -->")[0]
        assert there.strip() == made()


class Kept:
    """Runs as `make results` keeps them: success jumps from 0 to a level, at a step of each seed."""

    def __init__(self, folder: Path, jumps: dict[str, tuple[list[int], float]], threshold: str = "0.8") -> None:
        folder.mkdir(parents=True)
        (folder / "provenance.json").write_text(json.dumps({"scale": 1.0}))
        evaluated = range(0, 101_000, 1_000)
        own = {label: number for number, label in enumerate(jumps)}  # seeds and arms differ a little
        rows = [
            f"x,{label},{seed},{step},{level + 1e-3 * own[label] * (seed % 5 - 2) if step >= jump else 0.0}"
            for label, (found, level) in jumps.items() for seed, jump in enumerate(found) for step in evaluated
        ]  # fmt: skip
        (folder / "seeds.csv").write_text("\n".join(["cell,label,seed,steps,test_return", *rows]) + "\n")
        cells = [f"{label},{threshold},0.5,," for label in jumps]
        (folder / "cells.csv").write_text(
            "\n".join(["configuration,threshold,worst_iqm,worst_iqm_low,worst_iqm_high", *cells]) + "\n"
        )


@pytest.fixture
def wins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """jobs/wins.py, which looks for kept results in `tmp_path`."""
    monkeypatch.syspath_prepend(str(ROOT / "jobs"))
    module = load_job("wins", monkeypatch)
    monkeypatch.setattr(module, "FOLDER", tmp_path / "docs/results/wins")
    monkeypatch.setattr(module, "budget_of", lambda name: 100_000)
    return module


def spread(centre: int) -> list[int]:
    return [centre + 1_000 * (number % 5 - 2) for number in range(20)]


@pytest.mark.parametrize(
    ("jumps", "verdict"),
    [
        ({"round_robin": 60_000, "uniform": 70_000, "edge": 20_000}, "*a win*"),
        ({"round_robin": 60_000, "uniform": 70_000, "edge": 30_000}, "*a win*"),  # exactly half
        ({"round_robin": 60_000, "uniform": 70_000, "edge": 31_000}, "*no win*"),
        ({"round_robin": 60_000, "uniform": 30_000, "edge": 20_000}, "*no win*"),  # uniform is a baseline as well
        ({"round_robin": 200_000, "uniform": 200_000, "edge": 20_000}, "*a win*"),  # who never arrives has the budget
        ({"round_robin": 200_000, "uniform": 200_000, "edge": 60_000}, "*no win*"),
    ],
)
def test_a_win_is_half_of_the_steps_against_both(
    wins: Any, tmp_path: Path, jumps: dict[str, int], verdict: str
) -> None:
    Kept(tmp_path / "docs/results/wins/gates", {arm: (spread(jump), 0.9) for arm, jump in jumps.items()})
    made = wins.worlds()
    assert made.count("[`gates`]") == 1
    assert verdict in made
    expected = (
        np.minimum(spread(jumps["edge"]), 100_000).mean() / np.minimum(spread(jumps["round_robin"]), 100_000).mean()
    )
    assert f"{expected:.2f}" in next(line for line in made.splitlines() if "| round_robin |" in line)


def test_a_win_must_be_sure(wins: Any, tmp_path: Path) -> None:
    """Half of the steps on average, while a fifth of the seeds are no better."""
    some = spread(20_000)
    some[:5] = [95_000] * 5
    found = {"round_robin": (spread(90_000), 0.9), "uniform": (spread(90_000), 0.9), "edge": (some, 0.9)}
    Kept(tmp_path / "docs/results/wins/gates", found)
    assert "*no win*" in wins.worlds()


def test_what_was_run_in_small_has_no_verdict(wins: Any, tmp_path: Path) -> None:
    folder = tmp_path / "docs/results/wins/gates"
    Kept(folder, {arm: (spread(20_000), 0.9) for arm in ARMS})
    (folder / "provenance.json").write_text(json.dumps({"scale": 0.1}))
    assert "*not run whole*" in wins.worlds()


@pytest.mark.parametrize(("level", "words"), [(1.0, "*nothing lost*"), (0.97, "*nothing lost*"), (0.9, "*lost*")])
def test_the_dense_world_may_lose_a_twentieth(wins: Any, tmp_path: Path, level: float, words: str) -> None:
    found = {arm: (spread(50_000), level if arm == "edge" else 1.0) for arm in ARMS}
    Kept(tmp_path / "docs/results/wins/dense", found, threshold="1.0")
    assert words in wins.worlds()


@pytest.mark.parametrize("script", ["wins.py", "claims.py"])
def test_a_word_that_a_script_does_not_know_is_refused(script: str) -> None:
    """Where it is not looked at, `--wirte` prints, and nothing is written."""

    def said(*words: str) -> tuple[int, str]:
        done = subprocess.run(
            [sys.executable, ROOT / "jobs" / script, *words], capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout + done.stderr

    assert said("--wirte") == (2, f"'--wirte' is not known. {said('--help')[1]}")
    assert said("--help")[0] == 0
