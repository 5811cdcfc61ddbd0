"""Reports on curricula and instances: hand-made ledgers with answers worked out by hand, and ledgers of every kind."""

from __future__ import annotations

import csv
import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from space_dist.api.grids import run_grid
from space_dist.experiment.manifest import Grid
from space_dist.ledger import CURRICULUM, METRICS, VALUES, Checkpoint, Ledger, RunWriter
from space_dist.report import build_grid_report, load_run
from space_dist.report.released import counted
from space_dist.rollout import Outcomes
from space_dist.run.rows import summary
from tests.grids import TINY, write_grid, write_line_instances
from tests.test_grid_report import make_grid
from tests.test_report import start_run

EARLY = ([2], [1, 2], [0, 1, 2, 3], [0, 1, 2, 3])  # orders of inclusion (3, 2, 1, 3)
LATE = ([2], [2, 3], [2, 3], [0, 1, 2, 3])  # orders (4, 4, 1, 2)


def tables(text: str) -> dict[str, list[dict[str, str]]]:
    """The tables of a report, by the title above each."""
    found = {}
    for part in text.split("\n## ")[1:]:
        lines = [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("|")]
        if lines:
            found[part.splitlines()[0]] = [dict(zip(lines[0], line, strict=True)) for line in lines[2:]]
    return found


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def finish(
    grid: Grid, cell: int, seed: int, trained: Sequence[Sequence[int]], returns: Sequence[Sequence[float]],
    halves: Sequence[Sequence[float]] | None = None, legacy: bool = False,
) -> None:  # fmt: skip
    """A done run of iterations of 1,000 steps, after each of which four instances had these returns.

    Instance i's context is i + 1/2, the bounds are 0 and 5.
    """
    manifest = grid.manifest()
    ledger = start_run(grid.ledger(manifest.run(manifest.cells[cell].id, seed)).folder, seed=seed)
    with RunWriter(Ledger(ledger.folder)) as writer:
        writer.restore()
        before = writer.status = ledger.status()
        writer.append(VALUES, {"iteration": 0, "low": [0.0], "high": [5.0], "after": {"f8": ""}})
        for number, each in enumerate(returns):
            position = {"iteration": number, "round": number, "steps": 1000 * number}
            if number:
                ids = list(trained[number - 1])
                writer.append(CURRICULUM, {"iteration": number, "steps": 1000 * number, "trained": ids})
            split: dict[str, Any] = {
                "return": float(np.mean(each)), "discounted_return": 0.0, "length": 1.0, "success": None,
                "returns": list(each), **({"halves": [list(half) for half in halves]} if halves else {}),
                **({"legacy_return": float(number)} if legacy else {}),
            }  # fmt: skip
            writer.append(METRICS, {"kind": "evaluation", **position, "train": split, "test": split})
        steps = 1000 * (len(returns) - 1)
        status = dataclasses.replace(before, state="running", steps=steps, round=len(returns) - 1)
        writer.commit(Checkpoint(len(returns) - 1, {"weights": np.zeros(3)}, {}), status)
        writer.write_model({"weights": np.zeros(3)}, {"kind": "mlp"})
        writer.set_status(dataclasses.replace(status, state="done"))


def curve(*means: float) -> list[list[float]]:
    """Four instances at -3, -1, +1, +3 around each mean."""
    return [[mean - 3.0, mean - 1.0, mean + 1.0, mean + 3.0] for mean in means]


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Grid:
    """Two cells of three seeds: the first is the baseline."""
    made = make_grid(tmp_path_factory.mktemp("runs") / "grid", [{"kappa": 1}, {"kappa": 4}], kind="space")
    for seed, final in enumerate((10.0, 11.0, 12.0)):
        finish(made, 0, seed, EARLY, curve(0, 2, 4, 6, final), [[7, 9, 11, 1], [8, 2, 12, 14]])
    for seed, (trained, final) in enumerate(((EARLY, 11.0), (LATE, 13.0), (LATE, 15.0))):
        finish(made, 1, seed, trained, curve(0, 4, 8, 10, final), [[6, 9, 11, 13], [8, 10, 12, 14]])
    return made


@pytest.fixture(scope="module")
def report(grid: Grid) -> Path:
    return build_grid_report(grid).folder


def test_early_late_and_the_worst_tenth(report: Path) -> None:
    """Areas: (0/2 + 2 + 4 + 6 + final/2) / 4; the differences of the finals are 1, 2 and 3."""
    baseline, other = rows(report / "cells.csv")
    assert float(baseline["early_iqm"]) == pytest.approx((12.0 + 11.0 / 2.0) / 4.0)
    assert float(other["early_iqm"]) == pytest.approx((22.0 + 13.0 / 2.0) / 4.0)
    assert float(other["early_difference"]) == pytest.approx((10.0 + 1.0) / 4.0)
    assert float(other["final_difference"]) == pytest.approx(2.0)
    half = 4.302653 / np.sqrt(3.0)  # Student's t with two degrees, standard deviation 1
    assert float(other["final_difference_low"]) == pytest.approx(2.0 - half, rel=1e-6)
    assert float(other["final_wilcoxon_p"]) == pytest.approx(0.25)  # the least with three pairs
    assert (other["final_pairs"], baseline["final_pairs"]) == ("3", "0")
    # A tenth of four instances is one. Chosen by one half it earns, in the other: 14 and 9; 8 and 6.
    assert float(baseline["worst_iqm"]) == pytest.approx((14.0 + 9.0) / 2.0)
    assert float(other["worst_iqm"]) == pytest.approx((8.0 + 6.0) / 2.0)


def test_orders_of_inclusion_are_those_of_the_ledgers(report: Path) -> None:
    """(3, 2, 1, 3) once and (4, 4, 1, 2) twice; of four iterations each was in 2, 3, 4, 2 and in 1, 1, 4, 3 of them."""
    found = rows(report / "inclusion.csv")[4:]
    assert [float(row["mean_order_of_inclusion"]) for row in found] == pytest.approx([11 / 3, 10 / 3, 1.0, 7 / 3])
    assert [float(row["frequency"]) for row in found] == pytest.approx([4 / 12, 5 / 12, 1.0, 8 / 12])
    # Ranks 3.5, 2, 1, 3.5 weigh 3/8, 3/4, 1, 3/8; ranks 3.5, 3.5, 1, 2 weigh 3/8, 3/8, 1, 3/4.
    expected = [
        (2 * 3 / 8 + 2 * 1 * 3 / 8) / 12,
        (3 * 3 / 4 + 2 * 1 * 3 / 8) / 12,
        1.0,
        (2 * 3 / 8 + 2 * 3 * 3 / 4) / 12,
    ]
    assert [float(row["weighted_frequency"]) for row in found] == pytest.approx(expected)


def test_the_table_of_curricula(report: Path) -> None:
    """Sets' means go 2, 1.5 and 1.5, so the set moves by 1/2 of 5; 3/4 of the steps were on half of the set at most."""
    first, second = tables((report / "report.md").read_text())["Curricula"]
    assert first["tau with the other seeds: mean, least"] == "1.000, 1.000"
    # Iterations of one, two, four and four instances: less than half of four is one.
    assert first["steps on less than half of the set [95 %]"] == "25.0 [—] %"
    assert first["set moves an iteration: mean, most"] == "5.0 %, 10.0 %"
    assert first["seeds"] == "3/3"
    # (3, 2, 1, 3) with (4, 4, 1, 2): of six pairs (0, 1) and (0, 3) are tied in one of them each; (0, 2), (1, 2)
    # and (2, 3) agree, (1, 3) does not: 2 / sqrt(5 * 5). That is two of the three pairs of seeds.
    pairs = (0.4 + 0.4 + 1.0) / 3.0
    assert second["tau of pairs: mean"] == f"{pairs:.3f}"


def test_agreement_forgetting_and_figures(report: Path) -> None:
    text = (report / "report.md").read_text()
    found = tables(text)
    assert found["Agreement between curricula"][0]["kappa=1"] == "1.00"
    assert {row["fall by 10 % of the range, mean [95 %]"] for row in found["Forgetting"]} == {"0.0 [—] of 4 (3/3)"}
    for name in ("profiles", "instances", "frequencies", "context_features"):
        assert f"({name}.png)" in text
        assert (report / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_an_instance_that_falls_is_forgotten(tmp_path: Path) -> None:
    """Of 12 evaluations one instance earns 9 in the middle five and ends at 0: a fall of 9 in a range of 9."""
    made = make_grid(tmp_path / "grid", [{"kappa": 1}], n_seeds=1, kind="space")
    falling = [0.0, 3.0, 9.0, 9.0, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    growth = [EARLY[min(number, 3)] for number in range(11)]
    finish(made, 0, 0, growth, [[value, 0.0, number * 0.5, 1.0] for number, value in enumerate(falling)])
    (row,) = tables(build_grid_report(made).markdown)["Forgetting"]
    assert [text for name, text in row.items() if name.startswith("fall by")] == ["1.0 [—] of 4 (1/1)"] * 3


def test_where_nothing_is_learned_nothing_is_forgotten(tmp_path: Path) -> None:
    """Every return is 0, as on a sparse world at first; a NaN on another task is nobody's business."""
    points = [{"env.id": "space_dist/PointMass-v0"}, {"env.id": "space_dist/Maze-v0"}]
    made = make_grid(tmp_path / "grid", points, n_seeds=2, kind="space")
    for seed in range(2):
        finish(made, 0, seed, [EARLY[3]] * 6, [[0.0] * 4] * 7)
        finish(made, 1, seed, [EARLY[3]] * 6, [[0.0, 1.0, 2.0, number] for number in range(7)])
    report = build_grid_report(made)
    assert [row["cell"] for row in tables(report.markdown)["Forgetting"]] == ["env.id=space_dist/Maze-v0"]
    assert [float(row["test_return_iqm"]) for row in rows(report.folder / "cells.csv")] == [0.0, 2.25]


def test_each_task_has_figures_of_its_own(tmp_path: Path) -> None:
    """Returns of two environments have no common scale."""
    points = [{"env.id": "space_dist/PointMass-v0"}, {"env.id": "space_dist/Maze-v0"}]
    made = make_grid(tmp_path / "grid", points, n_seeds=1, kind="space")
    for cell in range(2):
        finish(made, cell, 0, EARLY, curve(0, 1, 2, 3, 4))
    report = build_grid_report(made)
    names = {path.stem for path in report.folder.glob("*.png")}
    assert {"profiles_1", "profiles_2", "instances_1", "instances_2"} <= names
    assert not {"profiles", "instances"} & names
    assert [*tables(report.markdown)["Agreement between curricula"][0].values()][1:] == ["1.00", "—"]


def test_a_run_on_other_instances_is_looked_at_by_nobody_and_named(tmp_path: Path) -> None:
    """It does not keep the report of the others from being made."""
    made = make_grid(tmp_path / "grid", [{"kappa": 1}], n_seeds=2, kind="space")
    finish(made, 0, 0, ([2], [7], [0], [1]), curve(0, 1, 2, 3, 4))
    finish(made, 0, 1, EARLY, curve(0, 1, 2, 3, 4))
    report = build_grid_report(made)
    assert re.search(r"seed 0: not comparable: iteration 2 was trained on the instance 7, not in ", report.remarks[0])
    (row,) = tables(report.markdown)["Curricula"]
    assert row["seeds"] == "1/2"


def test_without_halves_there_is_no_worst_tenth(tmp_path: Path) -> None:
    made = make_grid(tmp_path / "grid", [{"kappa": 1}], n_seeds=1, kind="space")
    finish(made, 0, 0, EARLY, curve(0, 1, 2, 3, 4))
    report = build_grid_report(made)
    assert "Worst tenth" not in [*tables(report.markdown)]
    assert [(row["worst_seeds"], row["worst_iqm"]) for row in rows(report.folder / "cells.csv")] == [("0", "")]


def test_a_short_look_has_neither(grid: Grid, tmp_path: Path) -> None:
    report = build_grid_report(grid, tmp_path, in_depth=False)
    assert not {"Curricula", "Forgetting"} & {*tables(report.markdown)}
    assert not (tmp_path / "curricula.csv").exists()


def test_both_halves_of_an_evaluation_are_kept() -> None:
    """Five episodes of two instances: the first, third and fifth, and the others."""
    returns = np.array([1.0, 2.0, 3.0, 4.0, 8.0, 10.0, 20.0, 30.0, 40.0, 80.0])
    outcomes = Outcomes(0, returns, returns, np.ones(10, dtype=np.int64), np.full(10, np.nan), returns)
    row = summary(outcomes, instances=2, episodes=5)
    assert row["returns"] == pytest.approx([3.6, 36.0])
    assert row["halves"] == [[4.0, 40.0], [3.0, 30.0]]
    assert summary(outcomes, instances=5, episodes=2)["halves"] == [[1, 3, 8, 20, 40], [2, 4, 10, 30, 80]]
    assert "halves" not in summary(outcomes, instances=10, episodes=1)


def test_steps_as_the_released_code_counts_them(tmp_path: Path) -> None:
    """Sets of 1, 2, 4 and 4 instances: 100, 300, 700 and 1,100 steps where 1,000 to 4,000 were taken."""
    made = make_grid(tmp_path / "grid", [{"kappa": 1}], n_seeds=1, kind="space")
    finish(made, 0, 0, EARLY, curve(0, 1, 2, 3, 4), legacy=True)
    run = load_run(made.ledger(made.manifest().runs()[0]))
    assert counted(run).tolist() == [0.0, 100.0, 300.0, 700.0, 1100.0]
    assert run.legacy_returns is not None
    assert run.legacy_returns.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    report = build_grid_report(made)
    assert "## As the released code shows it" in report.markdown
    assert (report.folder / "released.png").exists()


EVERY = [
    "{kind: round_robin}", "{kind: uniform}", "{kind: space, kappa: 2}", "{kind: random_growth, kappa: 2}",
    "{kind: cspace, kappa: 2}", "{kind: fixed, count: 3}", "{kind: plr}", "{kind: alp_gmm, fit_rate: 12}",
    "{kind: alp_gmm, fit_rate: 12, over: bounds}", "{kind: vds}", "{kind: learnability, every: 1, episodes: 2, top: 2}",
    "{kind: spdrl, warm_up: 0, offset: 0}", "{kind: procurl, score: improvement}", "{kind: learning_progress}",
    "{kind: edge}", "{kind: plr, robust: true}", "{kind: currot, delta: 0}", "{kind: currot, delta: 0, over: bounds}",
    "{kind: accel, buffer: 8, batch: 6, filled_share: 0.3}",
]  # fmt: skip


def test_ledgers_of_every_curriculum_are_looked_at(tmp_path: Path) -> None:
    kinds = [dict(YAML(typ="safe").load(text)) for text in EVERY]
    settings = {**TINY, **write_line_instances(tmp_path), "evaluation.episodes": 2, "evaluation.every_steps": 128}
    path = write_grid(tmp_path, set=settings, grid={"curriculum": kinds}, seeds=[0])
    ran = run_grid(path, root=tmp_path / "runs", progress=False)
    assert ran.complete, [one.detail for one in ran.statuses]
    report = build_grid_report(ran.grid)
    found = tables(report.markdown)
    labels = [cell.label for cell in ran.manifest.cells]
    assert [row["cell"].removesuffix(" (baseline)") for row in found[EARLIEST]] == labels
    growing = [row["curriculum"] for row in found["Curricula"]]
    assert {*growing} <= {label for label in labels if re.match("space|random|cspace|fixed", label)}
    assert any(label.startswith("space") for label in growing)
    assert {row["label"].partition(" ")[0] for row in rows(report.folder / "inclusion.csv")} == {
        "round_robin", "space", "random_growth", "cspace", "fixed"
    }  # fmt: skip
    run = load_run(ran.grid.ledger(ran.manifest.runs()[0]))
    halves = run.final_halves("test")
    assert halves is not None
    np.testing.assert_allclose(halves.mean(axis=0), run.instance_returns("test")[-1], rtol=1e-12)


EARLIEST = "Early: area under the curve of the return on the held-out instances"
