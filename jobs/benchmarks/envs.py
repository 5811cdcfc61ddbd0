"""How fast the environments step, each beside the obvious alternative, and whether their resets leak memory."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import psutil
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.results import JsonFile, keep
from space_dist.envs import make_batched, pointmass
from space_dist.envs.distributions import sample

console = Console()

SETTLED = 1_000  # resets before memory is first looked at
LEAK_LIMIT = 0.05  # of the memory then


@dataclass(frozen=True)
class Row:
    """One line of the table. `ours` and `theirs` do some work and return how many environment steps that was.

    limit: the least ratio of the two rates.
    """

    environment: str
    ours: Callable[[], int]
    alternative: str
    theirs: Callable[[], int] | None = None
    limit: float | None = None


def rows() -> list[Row]:
    """What is measured."""
    return [
        Row("PointMass, 256 slots", batched("space_dist/PointMass-v0", "pointmass_uniform", 256, 200),
            "plain NumPy, one at a time", plain(PlainPointMass(), "pointmass_uniform", 2_000), 50.0),
        Row("CartPole, 256 slots", batched("space_dist/CartPole-v0", "cartpole_uniform", 256, 500),
            "itself, 1 slot", batched("space_dist/CartPole-v0", "cartpole_uniform", 1, 2_000), 20.0),
        Row("Maze, 256 slots", batched("space_dist/Maze-v0", "maze_dfs", 256, 500),
            "itself, 1 slot", batched("space_dist/Maze-v0", "maze_dfs", 1, 2_000), 20.0),
        Row("AntGoal, 1 slot", batched("space_dist/AntGoal-v0", "antgoal_all", 1, 2_000),
            "pybullet_envs_gymnasium's Ant", bullet_ant(2_000), 0.95),
        Row("BallCatching, 1 slot", batched("space_dist/BallCatching-v0", "ballcatching_uniform", 1, 2_000),
            "none known"),
    ]  # fmt: skip


def envs(
    repeats: Annotated[int, typer.Option(min=3, help="Measurements of each; the median counts.")] = 7,
    resets: Annotated[
        int, typer.Option(min=0, help="Instead: reset each PyBullet environment so often and watch the memory.")
    ] = 0,
    json_file: JsonFile = None,
) -> None:
    """How fast the environments step, each beside the obvious alternative; or with --resets, whether they leak."""
    threadpool_limits(limits=1)
    found = leaks(resets) if resets else rates(repeats)
    keep(found, json_file)
    if not all(row["kept"] for row in found):
        console.print("A limit is not kept.", style="red")
        raise typer.Exit(1)


def rates(repeats: int) -> list[dict[str, Any]]:
    """Steps per second of this process's CPU time, resets included; ours and theirs measured in turn."""
    table = Table(title="Environment steps per second of CPU time, one thread, with resets")
    for column in ("environment", "ours", "alternative", "theirs", "ratio", "at least"):
        table.add_column(column, justify="left" if column in ("environment", "alternative") else "right")
    found = []
    for row in rows():
        ours, theirs = [], []
        for _ in range(repeats):
            ours.append(_rate(row.ours))
            theirs.append(_rate(row.theirs) if row.theirs else float("nan"))
        rate, other = statistics.median(ours), statistics.median(theirs)
        ratio = rate / other
        kept = row.limit is None or ratio >= row.limit
        found.append({"environment": row.environment, "ours": rate, "alternative": row.alternative, "theirs": other,
                      "ratio": ratio, "limit": row.limit, "kept": kept})  # fmt: skip
        compared = ("—", "—") if row.theirs is None else (f"{other:,.0f}", f"{ratio:.2f}")
        limit = "—" if row.limit is None else f"{row.limit:g}"
        table.add_row(row.environment, f"{rate:,.0f}", row.alternative, *compared, limit)
    console.print(table)
    return found


def leaks(resets: int) -> list[dict[str, Any]]:
    """Resident memory after the first resets and after the last, a step after each."""
    table = Table(title=f"Resident memory over {resets:,} resets, MiB")
    for column in ("environment", f"after {SETTLED:,}", "at the end", "growth", "at most"):
        table.add_column(column, justify="left" if column == "environment" else "right")
    found = []
    process = psutil.Process(os.getpid())
    for env_id, distribution in (
        ("space_dist/AntGoal-v0", "antgoal_all"), ("space_dist/BallCatching-v0", "ballcatching_uniform")
    ):  # fmt: skip
        env, contexts = make_batched(env_id, 1, context_visible=True), sample(distribution, 100, 1, 0)[0].contexts
        actions = np.ones((1, *(env.action_space.shape or ())))
        first = 0
        for count in range(SETTLED + resets):
            env.reset(np.zeros(1, dtype=np.int64), contexts[[count % 100]], np.array([count], dtype=np.uint64))
            env.step(actions)
            if count == SETTLED:
                first = process.memory_info().rss
        last = process.memory_info().rss
        growth = last / first - 1.0
        found.append({"environment": env_id, "resets": resets, "first": first, "last": last, "growth": growth,
                      "kept": growth <= LEAK_LIMIT})  # fmt: skip
        table.add_row(env_id, f"{first / 2**20:.1f}", f"{last / 2**20:.1f}", f"{growth:.2%}", f"{LEAK_LIMIT:.0%}")
    console.print(table)
    return found


def batched(env_id: str, distribution: str, n_slots: int, times: int) -> Callable[[], int]:
    """`times` steps of all slots, at random; slots that end their episode begin the next."""
    env = make_batched(env_id, n_slots, context_visible=False)
    contexts = sample(distribution, max(100, n_slots), 1, 0)[0].contexts
    random = np.random.default_rng(0)
    shape = (times, n_slots, *(env.action_space.shape or ()))
    space: Any = env.action_space
    if isinstance(space, gym.spaces.Discrete):
        actions = random.integers(space.n, size=shape)
    else:
        actions = random.uniform(space.low, space.high, size=shape).astype(space.dtype)
    env.reset(np.arange(n_slots), contexts[:n_slots], np.arange(n_slots, dtype=np.uint64))

    def work() -> int:
        for time_step in range(times):
            step = env.step(actions[time_step])
            ended = np.flatnonzero(step.terminated | step.truncated)
            if len(ended):
                places = random.integers(len(contexts), size=len(ended))
                env.reset(ended, contexts[places], places.astype(np.uint64))
        return times * n_slots

    return work


def plain(env: PlainPointMass, distribution: str, times: int) -> Callable[[], int]:
    """`times` steps of an environment of Gymnasium's kind, at random."""
    contexts = sample(distribution, 100, 1, 0)[0].contexts
    random = np.random.default_rng(0)
    actions = random.uniform(-pointmass.ACTION_LIMIT, pointmass.ACTION_LIMIT, size=(times, 2))
    env.reset(contexts[0], 0)

    def work() -> int:
        for action in actions:
            _, _, terminated, truncated = env.step(action)
            if terminated or truncated:
                place = int(random.integers(len(contexts)))
                env.reset(contexts[place], place)
        return times

    return work


def bullet_ant(times: int) -> Callable[[], int]:
    """`times` steps of AntBulletEnv-v0 without Gymnasium's wrappers, whose cost is not its own."""
    import pybullet_envs_gymnasium  # noqa: F401 - registers it

    env = gym.make("AntBulletEnv-v0").unwrapped
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, size=(times, 8)).astype(np.float32)
    env.reset(seed=0)

    def work() -> int:
        age = 0
        for action in actions:
            _, _, terminated, _, _ = env.step(action)
            age += 1
            if terminated or age == 500:
                env.reset()
                age = 0
        return times

    return work


class PlainPointMass:
    """PointMass as one writes it for a single mass, with NumPy's vectors for its two axes."""

    def reset(self, context: NDArray[np.float64], seed: int) -> NDArray[np.float32]:
        """Begin at (0, 3)."""
        self._gate_x, self._gate_width, self._friction = context
        self._random, self._time = np.random.default_rng(seed), 0
        self._position, self._velocity = pointmass.START[[0, 2]], pointmass.START[[1, 3]]
        return self._observe()

    def step(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float32], float, bool, bool]:
        """Ten inner steps."""
        force = pointmass.FORCE * np.clip(action, -pointmass.ACTION_LIMIT, pointmass.ACTION_LIMIT)
        crashed = False
        for _ in range(pointmass.INNER_STEPS):
            noise = pointmass.NOISE_STD * self._random.standard_normal(2)
            before = self._position
            after = np.clip(
                before + pointmass.DT * self._velocity, -pointmass.POSITION_LIMIT, pointmass.POSITION_LIMIT
            )  # fmt: skip
            self._velocity = self._velocity + pointmass.DT * (force - self._friction * self._velocity + noise)
            self._position = after
            if before[1] * after[1] <= 0.0 and before[1] != after[1]:
                wall_x = before[0] + before[1] / (before[1] - after[1]) * (after[0] - before[0])
                if abs(wall_x - self._gate_x) > self._gate_width / 2:
                    self._position, self._velocity, crashed = np.array([wall_x, 0.0]), np.zeros(2), True
                    break
        self._time += 1
        distance = float(np.linalg.norm(self._position - pointmass.GOAL))
        reward = float(np.exp(-pointmass.REWARD_DECAY * distance))
        return self._observe(), reward, crashed, self._time >= pointmass.HORIZON and not crashed

    def _observe(self) -> NDArray[np.float32]:
        (x, y), (vx, vy) = self._position, self._velocity
        return np.array([x, vx, y, vy], dtype=np.float32)


def _rate(work: Callable[[], int]) -> float:
    start = time.process_time()
    steps = work()
    return steps / (time.process_time() - start)
