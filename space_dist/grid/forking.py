"""Forks: several continuations of one run, bit for bit the same until they part, as a grid.

What a decision was worth cannot be seen in a run that made it, nor beside another run, in which all else differs as
well. Here everything before it is the same: a run is a pure function of its config and seed, so a cell that has the
run's seed until then (`fork`), and another setting from there on (`schedule`), is a continuation of it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from space_dist import config as configs
from space_dist.errors import ConfigError
from space_dist.ledger import Ledger
from space_dist.run.claiming import stored_config

_FIRST_SEED: Final = 1000  # of continuations, unless the run has it itself


def forked(run: Path, steps: int, overrides: Sequence[str], seeds: int, out: Path) -> int:
    """Write the grid that continues a run from `steps` on: as it is, and once for each of `overrides` (KEY=VALUE).

    seeds: continuations of each.  out: a YAML file that is not there yet. Returns how many runs the grid has. Raises
    ConfigError for settings that cannot change on the way, and steps that the run does not have; LedgerError where
    there is no run.
    """
    ledger = Ledger(run)
    ledger.status()
    config = stored_config(ledger)
    if config.fork is not None:
        raise ConfigError(f"{run} is itself the continuation of a run with seed {config.fork.seed}: fork that one")
    if not 1 <= steps < config.budget.steps:
        raise ConfigError(
            f"--at {steps}: {run} has a budget of {config.budget.steps:,} steps, and forks before its end"
        )
    if out.exists():
        raise ConfigError(f"--out {out} exists already: name another file")
    before = [change.model_dump(mode="json") for change in config.schedule]
    branches = [before]
    whole = config.model_dump(mode="json")
    for override in overrides:
        branches.append(_with_change(before, steps, change_of(override)))
        configs.parse({**whole, "schedule": branches[-1]}, f"{run} with {configs.told(override)}")
    first = _FIRST_SEED if not _FIRST_SEED <= config.seed < _FIRST_SEED + seeds else config.seed + 1
    grid = {
        "name": f"{config.name[:60]}_s{config.seed}_from_{steps}",
        "extends": os.path.relpath(ledger.config, out.absolute().parent),
        "set": {"fork": {"seed": config.seed, "steps": steps}},
        "grid": {"schedule": branches},
        "seeds": {"start": first, "count": seeds},
        "tracking": config.tracking.model_dump(mode="json", include={"uri"}),
    }
    head = f"# Continuations of {ledger.folder} from {steps:,} environment steps on: as it is, and otherwise.\n"
    out.write_text(head + configs.to_yaml(grid))
    return len(branches) * seeds


def change_of(override: str) -> dict[str, Any]:
    """What `KEY=VALUE` changes; `curriculum.kind=K`, and `curriculum={kind: K, ...}`, put another in its place."""
    data: dict[str, Any] = {}
    configs.apply_override(data, override)
    section = data.get("curriculum")
    if isinstance(section, dict) and "kind" in section:
        return data
    return dict(configs.flattened(data))


def _with_change(schedule: Sequence[Mapping[str, Any]], steps: int, change: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A schedule with one more change among those that it has."""
    found = {int(one["steps"]): dict(one["set"]) for one in schedule}
    found[steps] = {**found.get(steps, {}), **change}
    return [{"steps": at, "set": found[at]} for at in sorted(found)]
