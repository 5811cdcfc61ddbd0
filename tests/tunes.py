"""Small searches for tests, and runs of theirs that were never trained: a search reads nothing but ledgers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from space_dist import config as configs
from space_dist.experiment.endings import Cause, Ended
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.search import Search
from space_dist.experiment.status import Attempts
from space_dist.grid.trials import advance, open_runs
from space_dist.grid.tuning import plan_search
from tests.grids import ROOT, SMALL
from tests.test_report import continue_run, start_run

Outcome = float | Cause | None
RATE = {"float": [1.0e-4, 1.0e-2], "log": True}
ARMS: dict[str, Any] = {
    "round_robin": {"set": {"curriculum": {"kind": "round_robin"}}},
    "space": {
        "set": {"curriculum": {"kind": "space"}},
        "search": {"curriculum.kappa": {"int": [2, 16]}, "curriculum.growth": {"choice": ["add", "multiply"]}},
    },
}


def write_tune(folder: Path, **sections: Any) -> Path:
    """A search's file: two arms on PointMass, six trials of three seeds each, in generations of two."""
    instances = ROOT / "configs/instances"
    data: dict[str, Any] = {
        "name": "search", "extends": str(ROOT / "configs/pointmass_round_robin.yaml"),
        "set": {**SMALL, "instances.test": str(instances / "pointmass_goal_test.csv")},
        "search": {"learner.learning_rate": RATE}, "arms": ARMS, "trials": 6, "seeds": [0, 1, 2], "generation": 2,
        "sampler": {"kind": "tpe", "startup": 2},
        "confirm": {"seeds": {"start": 100, "count": 3},
                    "instances": {"test": str(instances / "pointmass_uniform_test.csv")}},
        "tracking": {"uri": None}, **sections,
    }  # fmt: skip
    folder.mkdir(exist_ok=True, parents=True)
    path = folder / "tune.yaml"
    path.write_text(configs.to_yaml({key: value for key, value in data.items() if value is not None}))
    return path


def reached(run: Run) -> float:
    """A return that settings decide: best at a learning rate of 0.001, with some noise of the seed's."""
    rate = float(run.cell.config["learner"]["learning_rate"])
    kappa = float(run.cell.config["curriculum"].get("kappa", 1))
    return -abs(float(np.log10(rate)) + 3.0) - 0.01 * kappa + 0.001 * run.seed


def end(grid: Grid, run: Run, outcome: Outcome) -> None:
    """Have a run end: with this final return (None: NaN), or for this cause."""
    ledger = grid.ledger(run)
    if isinstance(outcome, Cause):
        Attempts(ledger).begin(1, {})
        Attempts(ledger).end(1, Ended(outcome, "the ground gave way"))
        return
    sets = [(grid.folder / run.cell.config["instances"][split]).read_text() for split in ("train", "test")]
    start_run(ledger.folder, seed=run.seed, sets=sets)
    continue_run(ledger, [-9.0, outcome], [[0]], state="done", success=0.5)


def search_through(
    path: Path, root: Path, outcome: Callable[[Run], Outcome] = reached,
    order: Callable[[Sequence[Run]], Sequence[Run]] = lambda runs: runs, generations: int | None = None,
) -> tuple[Grid, Manifest]:  # fmt: skip
    """A search whose runs end as `outcome` says, in this order; as far as so many generations."""
    made = plan_search(path, root)
    grid, manifest = made.grid, made.manifest
    while manifest.search is not None and not manifest.search.over:
        if generations is not None and manifest.search.generation >= generations:
            break
        for run in order(open_runs(manifest)):
            if not grid.ledger(run).status_file.exists() and not Attempts(grid.ledger(run)).path.exists():
                end(grid, run, outcome(run))
        after = advance(grid, manifest)
        assert after is not None
        manifest = after
    return grid, manifest


def search_of(manifest: Manifest) -> Search:
    assert manifest.search is not None
    return manifest.search
