"""space_dist: reinforcement learning that generalises over instances, with self-paced curricula, on Ray.

What scripts and notebooks use of it is here by name (docs/python.md), and imported when it is first asked for.
"""

import importlib
import sys
from typing import TYPE_CHECKING

if sys.argv[:1] == ["-m"] and not sys.flags.safe_path and any("space_dist." in word for word in sys.orig_argv[1:]):
    # `python -m space_dist.cli` has Python look into the current folder before its own library: see `importing`.
    del sys.path[0]

from space_dist import arithmetic

arithmetic.settle()  # before any library is loaded that chooses its kernels by the CPU

from space_dist.errors import (  # noqa: E402
    ConfigError,
    Interrupted,
    LedgerError,
    NotPlannedError,
    RunLockedError,
    SpaceDistError,
    UnreadableError,
)

if TYPE_CHECKING:
    from space_dist.api.grids import GridRun, run_grid
    from space_dist.api.headroom import measure_headroom
    from space_dist.api.policies import ActingPolicy, load_policy
    from space_dist.api.reports import ReportView, report_on
    from space_dist.api.training import Run, train
    from space_dist.api.tuning import run_search
    from space_dist.config import RunConfig
    from space_dist.instances import InstanceSet
    from space_dist.sb3 import ContextVecEnv, CurriculumCallback

__version__ = "0.1.0"
__all__ = [
    "ActingPolicy",
    "ConfigError",
    "ContextVecEnv",
    "CurriculumCallback",
    "GridRun",
    "InstanceSet",
    "Interrupted",
    "LedgerError",
    "NotPlannedError",
    "ReportView",
    "Run",
    "RunConfig",
    "RunLockedError",
    "SpaceDistError",
    "UnreadableError",
    "__version__",
    "load_policy",
    "measure_headroom",
    "report_on",
    "run_grid",
    "run_search",
    "train",
]

_HOMES = {
    "ActingPolicy": "space_dist.api.policies",
    "ContextVecEnv": "space_dist.sb3",
    "CurriculumCallback": "space_dist.sb3",
    "GridRun": "space_dist.api.grids",
    "InstanceSet": "space_dist.instances",
    "ReportView": "space_dist.api.reports",
    "Run": "space_dist.api.training",
    "RunConfig": "space_dist.config",
    "load_policy": "space_dist.api.policies",
    "measure_headroom": "space_dist.api.headroom",
    "report_on": "space_dist.api.reports",
    "run_grid": "space_dist.api.grids",
    "run_search": "space_dist.api.tuning",
    "train": "space_dist.api.training",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found: object = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
