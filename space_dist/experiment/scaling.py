"""A grid otherwise than its file has it: fewer seeds and fewer steps, or other settings; it always says so."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

from space_dist import config as configs
from space_dist.config import RunConfig
from space_dist.errors import ConfigError

WHOLE = 1.0


def checked(scale: float) -> float:
    """A share of seeds and steps. Raises ConfigError unless it is above 0 and at most 1."""
    if not 0.0 < scale <= WHOLE:  # NaN neither
        raise ConfigError(f"--scale {scale:g}: a share of the grid's seeds and steps, above 0 and at most 1")
    return scale


def name_of(name: str, scale: float, changes: Sequence[str] = ()) -> str:
    """The name of a grid in small, or with other settings: never that of its file, whose folder and results are others.

    changes: `KEY=VALUE`, in any order; the same ones give the same name.
    """
    told = "\n".join(sorted(changes))
    changed = f"{name}-set-{hashlib.sha256(told.encode()).hexdigest()[:8]}" if changes else name
    return changed if scale == WHOLE else f"{changed}-scale-{scale:g}"


def fewer(seeds: Sequence[int], scale: float) -> tuple[int, ...]:
    """The first of the seeds: their share, rounded up."""
    return tuple(seeds[: math.ceil(len(seeds) * scale - 1e-9)])  # 0.1 * 30 is a little more than 3


def shorter(config: RunConfig, scale: float, where: str) -> RunConfig:
    """A run of that share of the budget, at least one update of it.

    There are fewer evaluations, by the share's square root rounded down, evenly spread, and always at the start and the
    end: curves remain, and evaluating, which is most of the cost of a short run, costs less as well. What changes on
    the way (`fork`, `schedule`) does so at the same share of the budget. All else stays, so a learning rate's schedule
    is steeper, and a set that grows by one gets less far. `where` names the config in errors. Raises ConfigError if the
    result is no config.
    """
    if scale == WHOLE:
        return config
    data: dict[str, Any] = config.model_dump(mode="json")
    budget, evaluation = data["budget"], data["evaluation"]
    whole = budget["steps"]
    budget["steps"] = max(math.ceil(budget["steps"] * scale - 1e-6), data["learner"].get("n_steps") or 1)
    if budget["episodes"] is not None:
        budget["episodes"] = math.ceil(budget["episodes"] * scale - 1e-6)
    if isinstance(evaluation["every_steps"], int):
        count = max(1, math.floor(whole / evaluation["every_steps"] * math.sqrt(scale) + 1e-6))
        evaluation["every_steps"] = math.ceil(budget["steps"] / count)
    for change in (*data["schedule"], *([data["fork"]] if data["fork"] else [])):
        change["steps"] = math.ceil(change["steps"] * scale - 1e-6)
    return configs.parse(data, where)


def in_words(scale: float, seeds: int) -> str:
    """For reports and figures; empty for a whole grid."""
    if scale == WHOLE:
        return ""
    return f"scale {scale:g}: {100.0 * scale:.3g} % of the whole grid's steps, {seeds} seed{'s' if seeds > 1 else ''}"
