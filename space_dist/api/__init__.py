"""What the command does, for scripts and notebooks: `train`, `run_grid`, `report_on`, `load_policy` (docs/python.md).

    run = space_dist.train("shipped:pointmass_space", overrides={"budget.steps": 20_000}, workers=0)
    run.final, run.rows(), run.policy().predict(observation)

All of it is `space_dist.NAME`, imported when it is first asked for: `import space_dist` alone costs next to nothing.
"""

from __future__ import annotations

from space_dist.api.grids import GridRun, run_grid
from space_dist.api.policies import ActingPolicy, load_policy
from space_dist.api.reports import ReportView, report_on
from space_dist.api.training import Run, train

__all__ = ["ActingPolicy", "GridRun", "ReportView", "Run", "load_policy", "report_on", "run_grid", "train"]
