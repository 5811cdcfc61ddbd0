"""What SPaCE costs: revaluing and selecting among N instances."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.measure import duration, median, median_cpu
from benchmarks.results import JsonFile, keep, refuse_if
from space_dist import config as configs
from space_dist.curricula import SetState
from space_dist.envs.distributions import sample
from space_dist.rollout.walk import Walk
from space_dist.run.building import Blueprint
from space_dist.run.cluster import Central, Evidence, InProcess
from space_dist.system.workplace import private_ray

ROOT = Path(__file__).resolve().parents[2]
console = Console()

# Shares of one stock PPO update that revaluing and selecting may cost, by number of instances.
LIMITS = {100: 0.001, 1_600: 0.002, 100_000: 0.05, 1_000_000: 0.5}


def curriculum(
    repeats: Annotated[int, typer.Option(min=3, help="Measurements of each; the median counts.")] = 7,
    json_file: JsonFile = None,
) -> None:
    """What SPaCE costs: revaluing and selecting among N instances, as a share of one PPO update."""
    threadpool_limits(limits=1)
    private_ray()
    base = configs.load(ROOT / "configs/pointmass_space.yaml", ["tracking.uri=null"])
    update = ppo_update_seconds(base, repeats)
    console.print(f"one stock PPO update (2,048 steps, minibatch 64, 10 epochs): {update:.3f} s of CPU time")
    table = Table(title="SPaCE's own cost per iteration (median CPU time, one thread)")
    for column in ("instances", "revalue", "select", "both", "share of an update", "at most", "transport on Ray"):
        table.add_column(column, justify="right")
    rows = []
    for n_instances, limit in LIMITS.items():
        row = _curriculum_row(base, n_instances, repeats)
        row |= {"share": (row["revalue"] + row["select"]) / update, "limit": limit, "update": update}
        rows.append(row)
        table.add_row(
            f"{n_instances:,}",
            *(duration(row[key]) for key in ("revalue", "select")),
            duration(row["revalue"] + row["select"]),
            f"{row['share']:.3%}",
            f"{limit:.1%}",
            duration(row["transport"]),
        )
    console.print(table)
    console.print(
        "Selecting is timed with the whole set selected, where it costs most. Transport: wall time of the same "
        "decision through one rollout actor and the curriculum actor, less the CPU time of the work itself."
    )
    keep(rows, json_file)
    refuse_if(any(row["share"] > row["limit"] for row in rows), console)


def ppo_update_seconds(config: configs.RunConfig, repeats: int) -> float:
    """CPU seconds of one stock PPO update on PointMass: the median of `repeats`."""
    train, test = sample("pointmass_uniform", 100, 100, 0)
    setup = Blueprint.of(config).setup(train, test)
    cluster, learner = InProcess(config, setup), Blueprint(config, setup.spec).learner()
    weights = learner.policy(0)
    decision = cluster.begin(cluster.start_values(weights))
    shards = cluster.collect(weights, decision.selection, Walk(-1, ()), round=0, steps=0, version=0)
    return median_cpu(lambda: learner.update(shards, round=0, steps=config.learner.n_steps), repeats)


def _curriculum_row(config: configs.RunConfig, n_instances: int, repeats: int) -> dict[str, float]:
    train, test = sample("pointmass_uniform", n_instances, 1, 0)
    setup = Blueprint.of(config).setup(train, test)
    cluster, central = InProcess(config, setup), Central(config, train, setup.spec.context_bounds)
    weights = Blueprint(config, setup.spec).learner().policy(0)
    chunks = cluster.start_values(weights)  # the first time, start observations are made and cached
    before = central.begin(*chunks)[3]
    everything = SetState(version=0, order_version=0, size=n_instances, selected=np.arange(n_instances))
    noise = np.random.default_rng(0).standard_normal(n_instances)
    changed = np.array_split(before + noise, len(chunks))
    revalue = median_cpu(lambda: cluster.start_values(weights), repeats)
    select = median_cpu(lambda: central.decide(everything, before, 0, 1, {"after": len(changed)}, *changed), repeats)
    return {
        "instances": n_instances, "revalue": revalue, "select": select,
        "transport": max(0.0, _through_ray(config, setup, everything, before, repeats) - revalue - select),
    }  # fmt: skip


def _through_ray(config: configs.RunConfig, setup: Any, state: Any, before: Any, repeats: int) -> float:
    """Median wall seconds of one decision through actors: weights out, values across, decision made."""
    from space_dist.run.ray_cluster import RayCluster

    local = config.model_copy(update={"resources": config.resources.model_copy(update={"workers": 1})})
    weights = Blueprint(config, setup.spec).learner().policy(0)
    with RayCluster(local, setup) as cluster:
        state_handle, before_handle = cluster.put(state), cluster.put(before)

        def decide() -> None:
            values = cluster.start_values(cluster.put(weights))
            decision = cluster.decide(state_handle, before_handle, Evidence(values), version=0, gradient_steps=1)
            cluster.get([decision.numbers])

        decide()
        return median(decide, repeats, time.perf_counter)
