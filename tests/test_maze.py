from __future__ import annotations

import json
import subprocess
import sys
from collections import deque
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from space_dist import cli
from space_dist.cli import runs
from space_dist.envs import BatchedMaze, ContextObservation, ContextVisible
from space_dist.envs.distributions import sample
from space_dist.envs.layouts import carve, shortest_ways, symmetrised
from space_dist.envs.maze import BOUNDS as MAZE_BOUNDS
from space_dist.instances import InstanceSet, read_csv, refuse_overlap
from space_dist.system.interrupts import StopRequests

ENV_ID = "space_dist/Maze-v0"
INSTANCES = Path(__file__).parent.parent / "configs" / "instances"
MOVES = {0: (0, -1, 1), 1: (0, 1, 4), 2: (1, 0, 2), 3: (-1, 0, 8)}  # action: dx, dy, bit of the opening
BACK = {0: 1, 1: 0, 2: 3, 3: 2}
FloatArray = NDArray[np.float64]


def leads(layout: FloatArray, x: int, y: int, action: int) -> tuple[int, int]:
    """Where an action leads, from algorithm.md alone; either side of a wall may say that it is open."""
    dx, dy, bit = MOVES[action]
    u, v = x + dx, y + dy
    if not (0 <= u < 5 and 0 <= v < 5):
        return x, y
    said = int(layout[5 * y + x]) & bit or int(layout[5 * v + u]) & MOVES[BACK[action]][2]
    return (u, v) if said else (x, y)


def search(layout: FloatArray) -> dict[tuple[int, int], list[int]]:
    """The actions of a shortest way from (0, 0) to every cell that can be reached (breadth first)."""
    ways: dict[tuple[int, int], list[int]] = {(0, 0): []}
    queue = deque(ways)
    while queue:
        cell = queue.popleft()
        for action in MOVES:
            to = leads(layout, *cell, action)
            if to not in ways:
                ways[to] = [*ways[cell], action]
                queue.append(to)
    return ways


def passages(layout: FloatArray) -> int:
    return sum(leads(layout, x, y, action) != (x, y) for x in range(5) for y in range(5) for action in MOVES) // 2


def start(env: BatchedMaze | ContextVisible, layouts: FloatArray) -> NDArray[np.generic]:
    return env.reset(np.arange(env.n_slots), layouts, np.zeros(env.n_slots, dtype=np.uint64))


@pytest.fixture(scope="module")
def sets() -> list[InstanceSet]:
    return [read_csv(INSTANCES / f"maze_dfs_{split}.csv", MAZE_BOUNDS) for split in ("train", "test")]


def test_the_shipped_mazes_are_perfect_solvable_disjoint_and_all_different_paths(sets: list[InstanceSet]) -> None:
    refuse_overlap(*sets, "train", "test")
    assert [len(one) for one in sets] == [100, 100]
    for one in sets:
        for layout in one.contexts:
            assert len(search(layout)) == 25  # every cell can be reached,
            assert passages(layout) == 24  # and in one way only
    routes = {tuple(search(layout)[4, 4]) for one in sets for layout in one.contexts}
    assert len(routes) > 100  # not one way for all
    assert [one.to_csv() for one in sample("maze_dfs", 100, 100, 0)] == [one.to_csv() for one in sets]


@pytest.mark.parametrize("raw", [False, True])
def test_carved_mazes_are_perfect_and_seeded(raw: bool) -> None:
    layouts = carve(np.random.default_rng(0), 300, raw=raw)
    np.testing.assert_array_equal(layouts, carve(np.random.default_rng(0), 300, raw=raw))
    for layout in layouts:
        assert (len(search(layout)), passages(layout)) == (25, 24)
    one_bit = np.isin(layouts, [0, 1, 2, 4, 8]).all(axis=1)
    assert one_bit.all() if raw else not one_bit.any()
    if not raw:  # both cells of a passage say that it is open
        np.testing.assert_array_equal(layouts, symmetrised(layouts))


def test_raw_numbers_are_another_writing_of_the_same_maze() -> None:
    raw, plain = (carve(np.random.default_rng(3), 50, raw=raw) for raw in (True, False))
    np.testing.assert_array_equal(symmetrised(raw), plain)
    train, test = sample("maze_dfs_raw", 30, 30, 0)  # disjoint as mazes, not as numbers alone
    assert len(np.unique(symmetrised(np.vstack([train.contexts, test.contexts])), axis=0)) == 60


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 15), min_size=25, max_size=25))
def test_ways_through_any_layout_are_the_shortest(numbers: list[int]) -> None:
    layout = np.array(numbers, dtype=np.float64)
    way = search(layout).get((4, 4))
    assert shortest_ways(layout[None])[0] == (np.inf if way is None else len(way))


def test_the_optimal_return_is_reached_by_the_shortest_way_and_by_no_shorter_one(sets: list[InstanceSet]) -> None:
    layouts = sets[0].contexts
    env = BatchedMaze(100)
    best = env.optimal_returns(layouts)
    ways = [search(layout)[4, 4] for layout in layouts]
    np.testing.assert_allclose(best, [1 - 0.004 * (len(way) - 1) for way in ways], rtol=1e-12)
    start(env, layouts)
    returns, ended = np.zeros(100), np.zeros(100, dtype=np.int64)
    for time in range(24):
        step = env.step(np.array([way[time] if time < len(way) else 0 for way in ways]))
        returns += np.where(ended == 0, step.rewards, 0.0)
        arrives = np.array([len(way) == time + 1 for way in ways])
        np.testing.assert_array_equal(step.terminated[ended == 0], arrives[ended == 0])
        ended[(ended == 0) & step.terminated] = time + 1
    np.testing.assert_allclose(returns, best, rtol=1e-12)
    assert (ended == [len(way) for way in ways]).all()
    closed = np.zeros((1, 25))
    np.testing.assert_allclose(env.optimal_returns(closed), [-0.8])  # 200 steps of -0.004


@pytest.mark.parametrize("raw", [False, True])
def test_moves_as_written_in_slots_of_any_age(raw: bool) -> None:
    n = 40
    random = np.random.default_rng(1)
    layouts = carve(random, n, raw=raw)
    env = BatchedMaze(n, horizon=60)
    observed = start(env, layouts).copy()
    age = np.zeros(n, dtype=np.int64)
    arrivals = 0
    for time in range(1000):
        actions = random.integers(4, size=n)
        step = env.step(actions)
        age += 1
        for slot in range(n):
            to = leads(layouts[slot], *map(int, observed[slot]), int(actions[slot]))
            assert tuple(step.observations[slot]) == to
            arrived = to == (4, 4)
            assert step.rewards[slot] == (1.0 if arrived else -0.004)
            assert (step.terminated[slot], step.truncated[slot]) == (arrived, age[slot] == 60 and not arrived)
            assert step.success is not None
            assert step.success[slot] == arrived
            arrivals += arrived
        observed = step.observations.copy()
        ended = np.flatnonzero(step.terminated | step.truncated | (random.random(n) < 0.01))
        if len(ended):
            layouts[ended] = carve(random, len(ended), raw=raw)
            observed[ended] = env.reset(ended, layouts[ended], np.full(len(ended), time, dtype=np.uint64))
            age[ended] = 0
            assert (observed[ended] == 0).all()
    assert arrivals >= 10


def test_the_single_version_agrees_with_a_slot_among_others_and_the_layout_matters() -> None:
    random = np.random.default_rng(2)
    layouts, actions = carve(random, 6), random.integers(4, size=(200, 6))
    env, single = BatchedMaze(6), gym.make(ENV_ID)
    start(env, layouts)
    told = []
    for row in actions:
        step = env.step(row)
        told.append((step.observations.tolist(), step.rewards.tolist(), step.terminated.tolist()))
    alone = []
    for slot in (5, 0, 3, 5):  # after other episodes, in any order
        single.reset(seed=slot, options={"context": layouts[slot]})
        path = []
        for time in range(200):
            observation, reward, terminated, _, info = single.step(int(actions[time, slot]))
            path.append((observation.tolist(), reward, terminated))
            assert info["success"] == terminated
            if terminated:
                break
        assert path == [(seen[slot], rewards[slot], ends[slot]) for seen, rewards, ends in told[: len(path)]]
        single.reset(seed=slot, options={"context": layouts[slot]})
        path_of = [single.step(int(action))[0].tolist() for action in actions[:5, 0]]
        alone.append(path_of)
    assert alone[0] == alone[3]
    assert len({str(path) for path in alone}) > 1  # equal actions, other layouts, other paths


def test_observations_and_contexts_belong_to_the_caller() -> None:
    layouts = carve(np.random.default_rng(4), 1)
    env = BatchedMaze(1)
    first = start(env, layouts)
    action = search(layouts[0])[4, 4][0]
    layouts[:] = 0.0
    second = env.step(np.array([action])).observations
    assert first.tolist() == [[0, 0]]  # not moved along
    assert second.tolist() != [[0, 0]]  # the layout was copied
    second[:] = 4
    assert env.step(np.array([0])).observations.tolist() != [[4, 4]]


@pytest.mark.parametrize("context_visible", [False, True])
def test_gymnasiums_own_checker_accepts_it(context_visible: bool) -> None:
    env = gym.make(ENV_ID, disable_env_checker=True).unwrapped
    check_env(ContextObservation(env) if context_visible else env, skip_render_check=True)


def test_a_visible_layout_is_scaled_from_its_bits() -> None:
    layouts = carve(np.random.default_rng(5), 3)
    env = ContextVisible(BatchedMaze(3))
    observations = start(env, layouts)
    assert (observations.dtype, observations.shape) == (np.float32, (3, 27))
    np.testing.assert_allclose(observations[:, 2:], 2 * layouts / 15 - 1, rtol=1e-6)


@pytest.mark.parametrize("action", [-1, 4, 0.5])
def test_other_actions_are_refused(action: float) -> None:
    env = BatchedMaze(1)
    start(env, carve(np.random.default_rng(0), 1))
    with pytest.raises(ValueError, match="0, 1, 2 or 3"):
        env.step(np.array([action]))


def test_half_a_wall_is_refused() -> None:
    with pytest.raises(ValueError, match="whole numbers"):
        start(BatchedMaze(1), np.full((1, 25), 0.5))


WALK = """
import gymnasium, numpy, space_dist.envs
from space_dist.system.interrupts import StopRequests
from space_dist.envs.layouts import carve
env = gymnasium.make("space_dist/Maze-v0")
env.reset(seed=5, options={"context": carve(numpy.random.default_rng(7), 1)[0]})
print([env.step(int(action))[0].tolist() for action in numpy.random.default_rng(8).integers(4, size=60)])
"""


def test_another_process_carves_and_walks_the_same() -> None:
    answer = subprocess.run([sys.executable, "-c", WALK], capture_output=True, text=True, check=True)
    env = BatchedMaze(1)
    start(env, carve(np.random.default_rng(7), 1))
    here = [env.step(np.array([action])).observations[0].tolist()
            for action in np.random.default_rng(8).integers(4, size=60)]  # fmt: skip
    assert answer.stdout.strip() == str(here)


def test_evaluation_shows_the_share_of_the_optimum(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, sets: list[InstanceSet]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runs, "STOP", StopRequests())
    few = tmp_path / "few.csv"
    few.write_text(sets[1].subset(range(3)).to_csv())
    quick = ["budget.steps=2048", "learner.n_epochs=1", "tracking.uri=null", "resources.workers=0"]
    config = INSTANCES.parent / "maze_single.yaml"
    for arguments in (
        ["train", config, "--out", "run", *(part for setting in quick for part in ("--set", setting))],
        ["evaluate", "run", "--instances", few, "--json", "--out", "results.csv"],
    ):
        monkeypatch.setattr(sys, "argv", ["space-dist", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit, match=r"^0$"):
            cli.main()
    answer = json.loads(capsys.readouterr().out)
    best = [1 - 0.004 * (len(search(layout)[4, 4]) - 1) for layout in sets[1].contexts[:3]]
    assert answer["optimal_return"] == pytest.approx(np.mean(best))
    rows = [line.split(",") for line in (tmp_path / "results.csv").read_text().splitlines()]
    assert (rows[0][1], rows[0][-1]) == ("return", "optimal_return")
    assert [float(row[-1]) for row in rows[1:]] == pytest.approx(best)
    returns = [float(row[1]) for row in rows[1:]]
    assert answer["share_of_optimum"] == pytest.approx(sum(returns) / sum(best))
