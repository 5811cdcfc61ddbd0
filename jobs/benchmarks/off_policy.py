"""What SB3's `train()` is of a run of DQN, TD3 and SAC, and what is left of it with `learner.update: lean`."""

from __future__ import annotations

import itertools
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from stable_baselines3 import DQN, SAC, TD3

from space_dist import config as configs
from space_dist.kernels import Layout, Settings, Shape, aligned, prepare
from space_dist.kernels.ppo import N_RECORDED
from space_dist.learner.lean_replay import LEAN
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests

CONFIGS = Path(__file__).resolve().parent.parent.parent / "configs"
COMMON = ["tracking.uri=null", "resources.workers=0"]
SAMPLES, SIZE = 2048, 64  # of PPO's update: transitions, and a minibatch
STOCK: dict[str, Any] = {"dqn": DQN, "td3": TD3, "sac": SAC}
console = Console()


@dataclass(frozen=True)
class Work:
    """A run: its shipped config and settings. operations: multiplications and additions of a gradient step."""

    config: str
    settings: tuple[str, ...]
    operations: float


@dataclass(frozen=True)
class Spent:
    """CPU seconds of a run, and of its gradient steps."""

    run: float
    train: float
    steps: int


def _operations(sizes: Sequence[int]) -> tuple[int, int]:
    """Of a network's pass forward for one sample, and of its first layer."""
    layers = [2 * a * b for a, b in itertools.pairwise(sizes)]
    return sum(layers), layers[0]


def _works(steps: int) -> dict[str, Work]:
    value, value_first = _operations((5, 128, 64, 64, 2))
    works = {"dqn": Work("cartpole_dqn_space", (), 32 * (4 * value - value_first))}
    for kind, outputs, actors_share in (("td3", 2, 0.5), ("sac", 4, 1.0)):
        (actor, actor_first), (critic, critic_first) = _operations((6, 64, 64, outputs)), _operations((8, 64, 64, 1))
        critics = actor + 2 * critic + 2 * (3 * critic - critic_first)
        scored = 1 if kind == "td3" else 2  # critics that an actor learns from
        improved = 3 * actor - actor_first + 2 * scored * critic
        learner = f"kind: {kind}, n_steps: 512, batch_size: 256, net_arch: [64, 64]"
        works[kind] = Work(
            "pointmass_space", (f"budget.steps={steps}", f"learner={{{learner}}}"),
            256 * (critics + actors_share * improved),
        )  # fmt: skip
    return works


def off_policy(
    rounds: Annotated[int, typer.Option(min=1, help="Interleaved pairs of runs.")] = 3,
    steps: Annotated[int, typer.Option(min=512, help="Of runs of TD3 and SAC.")] = 1536,
) -> None:
    """CPU time of whole runs and of their gradient steps, stock and lean, and what the arithmetic alone would take."""
    rate = _rate()
    console.print(f"PPO's compiled update, 64-64, minibatches of {SIZE}: {rate / 1e9:.0f} GFLOP/s")
    columns = {}
    for kind, work in _works(steps).items():
        _run(kind, work, "lean")  # compiles or loads
        stock, lean = zip(*((_run(kind, work, "stock"), _run(kind, work, "lean")) for _ in range(rounds)), strict=True)
        step, ours = (statistics.median(one.train / one.steps for one in runs) for runs in (stock, lean))
        columns[kind] = {
            "train(), stock": _share(stock),
            "a gradient step, stock": f"{1e6 * step:,.0f} us",
            "of that, arithmetic alone": f"{work.operations / rate / step:.1%}",
            "a gradient step, lean": f"{1e6 * ours:,.0f} us",
            "train(), lean": _share(lean),
            "ratio of gradient steps": _ratios(*([one.train / one.steps for one in runs] for runs in (stock, lean))),
            "ratio of runs": _ratios(*([one.run / one.steps for one in runs] for runs in (stock, lean))),
        }
    table = Table("", *columns)
    for name in columns["dqn"]:
        table.add_row(name, *(column[name] for column in columns.values()))
    console.print(table)
    console.print(
        "CPU time; medians, least and most of interleaved pairs; ratios of runs are per gradient step as well."
    )


def _share(runs: Sequence[Spent]) -> str:
    return f"{statistics.median(one.train / one.run for one in runs):.0%}"


def _ratios(stock: Sequence[float], lean: Sequence[float]) -> str:
    ratios = [one / other for one, other in zip(stock, lean, strict=True)]
    return f"{statistics.median(ratios):.1f} ({min(ratios):.1f}-{max(ratios):.1f})"


def _run(kind: str, work: Work, update: str) -> Spent:
    algorithm: Any = LEAN[kind] if update == "lean" else STOCK[kind]
    train, spent, made = algorithm.train, 0.0, 0

    def timed(self: Any, gradient_steps: int, batch_size: int) -> None:
        nonlocal spent, made
        start = time.process_time()
        train(self, gradient_steps=gradient_steps, batch_size=batch_size)
        spent, made = spent + time.process_time() - start, made + gradient_steps

    settings = [*COMMON, *work.settings, f"learner.update={update}"]
    config = configs.load(CONFIGS / f"{work.config}.yaml", settings)
    algorithm.train = timed
    try:
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            launch(config, Path(folder) / "run", resume=False, stop=StopRequests())
            return Spent(time.process_time() - start, spent, made)
    finally:
        algorithm.train = train


def _rate() -> float:
    """Operations per second of PPO's compiled update: of ten measurements the least time."""
    random, dtype = np.random.default_rng(0), np.dtype(np.float32)
    layout = Layout.of(Shape(6, 2, False, (64, 64), "tanh"), SIZE, dtype.itemsize)
    m, samples = aligned(layout.size, dtype), np.zeros((SAMPLES, layout.plan.record), dtype)
    for places in layout.places.values():
        m[places] = 0.1 * random.normal(size=len(places))
    samples[:, :6] = random.normal(size=(SAMPLES, 6))
    fields = samples[:, layout.record_at : layout.record_at + layout.plan.fields]
    fields[:] = random.normal(size=fields.shape)
    orders, told = random.permutation(SAMPLES)[None], np.zeros((SAMPLES // SIZE, N_RECORDED))
    settings = Settings(1e-5, 0.9, 0.999, 1e-5, 0, 0.2, np.inf, 0.0, 0.5, 0.5, np.inf, True)
    update, times = prepare(dtype).update, []
    for _ in range(10):
        start = time.process_time()
        update(m, layout.plan, layout.layers, settings, samples.ravel(), orders, SIZE, told)
        times.append(time.process_time() - start)
    (actor, first), (critic, _) = _operations((6, 64, 64, 2)), _operations((6, 64, 64, 1))
    return SAMPLES * (3 * actor + 3 * critic - 2 * first) / min(times)
