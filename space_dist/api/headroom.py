"""Measure, before anything is claimed, how much a curriculum could save: a short run of uniform draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from space_dist import config as configs
from space_dist.api.arguments import Overrides, as_count, as_path, refuse_progress
from space_dist.api.grids import GridRun, run_grid
from space_dist.api.training import Config, as_config
from space_dist.config import RunConfig
from space_dist.curricula import decode_state
from space_dist.curricula.watching import WatchedState
from space_dist.errors import ConfigError, LedgerError, SpaceDistError, about
from space_dist.experiment.manifest import MANIFEST
from space_dist.grid.conductor import Overview
from space_dist.instances import InstanceSet
from space_dist.report import headroom as reports
from space_dist.report.figures import save
from space_dist.report.headroom import Headroom
from space_dist.report.headroom_figure import draw_headroom
from space_dist.report.tables import to_csv
from space_dist.run.building import Blueprint
from space_dist.system.workplace import workplace

SHARES: Final = 10  # of the steps, over which signal is followed
MOST_SEEDS: Final = 1000
_BASE, _GRID, _NAME = "config.yaml", "headroom.yaml", "headroom"


@dataclass(frozen=True)
class Measured:
    """What was measured, and of which instances.

    headroom: the numbers, by seed and share of the steps.  train: the training instances.  states: what the curriculum
    of each run had counted, instance by instance, at its end.  folder: where everything about it lies.
    """

    headroom: Headroom
    train: InstanceSet
    states: list[WatchedState]
    folder: Path

    def __repr__(self) -> str:
        return f"Measured({str(self.folder)!r}: {reports.verdict(self.headroom)})"


def measure_headroom(
    config: Config,
    *,
    out: Path | str | None = None,
    steps: int | None = None,
    seeds: int = 5,
    overrides: Overrides = (),
    progress: bool | Callable[[Overview], None] = True,
) -> Measured:
    """Train with uniform draws, and count what every instance shows, as `space-dist headroom` does.

    config, overrides: as of `train`; its curriculum plays no part.
    out: a folder; None: `runs/<name>_headroom` here. Measured twice, it goes on where it stopped; with more `steps`, it
        runs anew.
    steps: environment steps of each run; None: a fifth of the config's budget.  seeds: how many runs, from seed 0 on.
    progress: as of `run_grid`.

    Raises ConfigError for every fault of the config and the arguments, or if the folder holds anything else than a
    measurement of this config; SpaceDistError if a run fails.
    """
    refuse_progress(progress)
    runs = as_count(seeds, "seeds", least=1, most=MOST_SEEDS)
    budget = None if steps is None else as_count(steps, "steps", least=1)
    settings = as_config(config, overrides)
    default = workplace() / "runs" / f"{settings.name}_headroom"
    folder = (default if out is None else as_path(out, "out")).absolute()
    with about(str(config) if isinstance(config, str | Path) else "config"):
        blueprint = _watched(settings, budget)
        train, test = blueprint.instances()
        blueprint.setup(train, test)  # for its errors: whatever cannot be measured leaves no folder
    _refuse_others(folder, blueprint.config)
    _write(folder, blueprint.config, runs)
    grid = run_grid(folder / _GRID, root=folder, progress=progress)
    states = _states(grid)
    found = Measured(reports.measured(states, blueprint.total_steps), train, states, folder)
    (folder / "instances.csv").write_text(to_csv(_rows(found)))
    save(draw_headroom(found.headroom, states), folder / "headroom.png")
    return found


def _refuse_others(folder: Path, config: RunConfig) -> None:
    """Refuse a folder that holds anything else than a measurement of this config, which may have had other steps."""
    instead = "--out DIR measures in another folder (from Python: out=DIR)"
    for file, what in (("status.json", "a run"), (MANIFEST, "a grid")):
        if (folder / file).exists():
            raise ConfigError(f"{folder} already holds {what}: {instead}")
    if not (folder / _BASE).exists():
        return
    if not (folder / _GRID).exists():
        raise ConfigError(f"{folder} already holds a {_BASE}, of no measurement: {instead}")
    before, now = (_apart_from_steps(one) for one in (as_config(folder / _BASE), config))
    if other := [key for key in now | before if now.get(key) != before.get(key)]:
        shown = ", ".join(other[:5]) + (", ..." if len(other) > 5 else "")
        raise ConfigError(f"{folder} already holds the measurement of another config, with another {shown}: {instead}")


def _apart_from_steps(config: RunConfig) -> dict[str, Any]:
    """What is measured, by key, without what is decided by its steps, or by where it runs."""
    data = config.model_dump(mode="json", exclude={"seed", "curriculum", "resources", "tracking"})
    found: dict[str, Any] = {}
    for name, section in data.items():
        found |= (
            {f"{name}.{key}": value for key, value in section.items()} if isinstance(section, dict) else {name: section}
        )
    return {key: value for key, value in found.items() if key not in ("budget.steps", "evaluation.every_steps")}


def _write(folder: Path, config: RunConfig, seeds: int) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _BASE).write_text(configs.dump(config))
        (folder / _GRID).write_text(configs.to_yaml({
            "name": _NAME, "extends": _BASE, "seeds": {"count": seeds}, "tracking": {"uri": None},
        }))  # fmt: skip
    except OSError as error:
        raise LedgerError(f"cannot write the folder {folder}: {error.strerror}") from None


def _watched(config: RunConfig, steps: int | None) -> Blueprint:
    """The config that is measured with: uniform draws that are counted, few evaluations, and no mirror."""
    first = Blueprint.of(config)
    if config.n_policies > 1:
        raise ConfigError("headroom: curriculum.aggregate: population trains several policies; use aggregate: own")
    by_episodes = config.n_episodes is not None
    round_steps = config.round_steps(first.spec.horizon)
    budget = max(config.budget.steps // 5, round_steps) if steps is None else steps
    iterations = budget // round_steps
    shares = 1 if by_episodes else min(SHARES, max(1, iterations))
    data = config.model_dump(mode="json")
    data |= {
        "name": _NAME,
        # Decided when the grid is frozen: a config that names an update keeps it.
        "engine": "auto" if config.engine == "single" and not config.learner.is_compiled("single") else config.engine,
        "curriculum": {
            "kind": "watched", "iterations": max(1, iterations), "shares": shares,
            "advantages": config.learner.has_advantages,
        },
        "budget": {**data["budget"], "steps": budget, "episodes": None},
        "schedule": [], "fork": None,
        "evaluation": {**data["evaluation"], "every_steps": budget},
        "rollout": {**data["rollout"], "overlap": False},
        "tracking": {"uri": None},
    }  # fmt: skip
    return Blueprint.of(configs.parse(data, "headroom"), first.spec)


def _states(grid: GridRun) -> list[WatchedState]:
    states = []
    for status in grid.statuses:
        checkpoint = status.ledger.last_checkpoint() if status.condition == "done" else None
        if checkpoint is None:
            raise SpaceDistError(
                f"headroom: {status.run.title} is {status.in_words}: {status.detail or 'run it again'}"
            )
        states.append(decode_state(WatchedState, checkpoint.under("curriculum/"), checkpoint.data["curriculum"]))
    return states


def _rows(found: Measured) -> list[dict[str, Any]]:
    """One row per instance: its context, and over all seeds how often it was played and succeeded, share by share."""
    episodes = np.sum([state.episodes for state in found.states], axis=0)
    successes = np.sum([state.successes for state in found.states], axis=0)
    known = all(state.knows_success for state in found.states)
    rows = []
    for place, instance in enumerate(found.train.ids):
        row: dict[str, Any] = {"id": int(instance)}
        row |= dict(zip(found.train.names, found.train.contexts[place].tolist(), strict=True))
        row |= {"episodes": int(episodes[:, place].sum())}
        if known:
            row |= {"successes": int(successes[:, place].sum())}
            row |= {
                f"success_{share + 1}": float(won / played) if played else None
                for share, (won, played) in enumerate(zip(successes[:, place], episodes[:, place], strict=True))
            }
        rows.append(row)
    return rows
