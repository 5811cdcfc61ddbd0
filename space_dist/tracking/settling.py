"""Where a run or a grid is shown, settled before it begins: `auto` and null come to what the environment says now."""

from __future__ import annotations

from typing import TypeVar

from space_dist.config import TrackingConfig
from space_dist.config.tracking_uri import settled_experiment, settled_uri
from space_dist.experiment.grid_file import GridTracking
from space_dist.system.workplace import absolute_uri
from space_dist.tracking.sinks import refuse_missing

_T = TypeVar("_T", TrackingConfig, GridTracking)


def settled(tracking: _T, experiment: str) -> _T:
    """The section with nothing left to the environment or the current folder. `experiment`: its name by default.

    Raises ConfigError for a variable of MLflow's in the environment that cannot be used, and for a sink whose package
    is not installed.
    """
    refuse_missing(tracking.sinks)
    name = settled_experiment(tracking.experiment, experiment)
    return tracking.model_copy(update={"uri": absolute_uri(settled_uri(tracking.uri)), "experiment": name})
