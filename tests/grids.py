"""Small grids for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from space_dist import config as configs

ROOT = Path(__file__).resolve().parent.parent
SPACE = ROOT / "configs/pointmass_space.yaml"
# A run of two updates that takes a fraction of a second.
SMALL = {
    "budget.steps": 2048, "learner.n_steps": 1024, "learner.n_epochs": 1, "rollout.slots": 2,
    "evaluation.every_steps": 100000, "checkpoint.every_rounds": 1,
}  # fmt: skip
TINY = {
    "env": {"id": "tests.fault_env:make"}, "budget.steps": 768, "learner.n_steps": 256, "learner.n_epochs": 1,
    "rollout.slots": 2, "evaluation.every_steps": 512, "checkpoint.every_rounds": 1,
}  # fmt: skip


def write_grid(folder: Path, **sections: Any) -> Path:
    """A grid file; by default two cells and two seeds of PointMass, without MLflow."""
    data: dict[str, Any] = {
        "name": "small", "extends": str(SPACE), "set": dict(SMALL), "grid": {"curriculum.kappa": [1, 4]},
        "seeds": [0, 1], "tracking": {"uri": None}, **sections,
    }  # fmt: skip
    path = folder / "grid.yaml"
    path.write_text(configs.to_yaml({key: value for key, value in data.items() if value is not None}))
    return path


def write_line_instances(folder: Path) -> dict[str, str]:
    """Instances of the line, as a grid's `set` section takes them."""
    for name, targets in (("train", np.linspace(-1.0, 1.0, 6)), ("test", np.linspace(-0.9, 0.9, 4))):
        rows = [f"{number},{target}" for number, target in enumerate(targets)]
        (folder / f"{name}.csv").write_text("\n".join(["id,target", *rows]) + "\n")
    return {"instances.train": str(folder / "train.csv"), "instances.test": str(folder / "test.csv")}
