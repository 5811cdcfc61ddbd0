"""Mazes of 3x3 to 11x11 in one world."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from space_dist.envs import BatchedMaze, BatchedMixedMaze, ContextObservation, ContextVisible
from space_dist.envs.distributions import sample
from space_dist.envs.layouts import carve, cut_out, placed, shortest_ways
from space_dist.envs.mixed_maze import BOUNDS, draw
from space_dist.instances import InstanceSet, read_csv, refuse_overlap

ENV_ID = "space_dist/MixedMaze-v0"
INSTANCES = Path(__file__).parent.parent / "configs" / "instances"
MOVES = ((0, -1, 1, 4), (0, 1, 4, 1), (1, 0, 2, 8), (-1, 0, 8, 2))  # dx, dy, bit of the opening, bit on the other side
FloatArray = NDArray[np.float64]


def leads(context: FloatArray, x: int, y: int, action: int) -> tuple[int, int]:
    """Where an action leads, from the facts alone; both sides of a passage say that it is open."""
    dx, dy, bit, back = MOVES[action]
    if not int(context[1 + 11 * y + x]) & bit:
        return x, y
    assert int(context[1 + 11 * (y + dy) + x + dx]) & back
    return x + dx, y + dy


def search(context: FloatArray) -> dict[tuple[int, int], list[int]]:
    """The actions of a shortest way from (0, 0) to every cell that can be come to (breadth first)."""
    ways: dict[tuple[int, int], list[int]] = {(0, 0): []}
    queue = deque(ways)
    while queue:
        cell = queue.popleft()
        for action in range(4):
            to = leads(context, *cell, action)
            if to not in ways:
                ways[to] = [*ways[cell], action]
                queue.append(to)
    return ways


def start(env: Any, contexts: FloatArray) -> Any:
    return env.reset(np.arange(env.n_slots), contexts, np.zeros(env.n_slots, dtype=np.uint64))


def test_the_larger_sets_are_what_is_drawn_perfect_and_disjoint() -> None:
    kept = [read_csv(INSTANCES / f"mixed_maze_1000_{split}.csv", BOUNDS) for split in ("train", "test")]
    assert [one.to_csv() for one in sample("mixed_maze", 1000, 200, 0)] == [one.to_csv() for one in kept]
    assert [len(one) for one in kept] == [1000, 200]
    refuse_overlap(*kept, "train", "test")
    for one in kept:
        sides = one.contexts[:, 0].astype(int)
        assert {*sides} == set(range(3, 12))
        assert np.bincount(sides)[3:].min() >= 0.03 * len(one)  # 3x3: repeats were drawn again
        for context, side in zip(one.contexts, sides.tolist(), strict=True):
            ways = search(context)
            assert set(ways) == {(x, y) for x in range(side) for y in range(side)}
            passages = sum(bin(int(number)).count("1") for number in context[1:]) // 2
            assert passages == side**2 - 1  # so there is one way only
            square = context[1:].reshape(11, 11)
            assert not square[side:].any()
            assert not square[:, side:].any()


def test_the_small_mazes_are_those_of_a_set_that_is_drawn() -> None:
    for split, drawn in zip(("train", "test"), sample("mixed_maze", 1000, 1000, 1), strict=True):
        small = drawn.contexts[:, 0] == 3
        kept = read_csv(INSTANCES / f"mixed_maze_3x3_{split}.csv", BOUNDS)
        assert kept == InstanceSet(drawn.ids[small], drawn.contexts[small], drawn.names)
        assert len(kept) == {"train": 64, "test": 18}[split]


def test_the_shortest_way_pays_the_optimum() -> None:
    contexts = sample("mixed_maze", 40, 1, 5)[0].contexts
    env = BatchedMixedMaze(40)
    sides = contexts[:, 0].astype(int)
    ways = [search(context)[side - 1, side - 1] for context, side in zip(contexts, sides.tolist(), strict=True)]
    best = env.optimal_returns(contexts)
    expected = [1.0 - 0.1 / side**2 * (len(way) - 1) for way, side in zip(ways, sides.tolist(), strict=True)]
    np.testing.assert_allclose(best, expected, rtol=1e-12)
    start(env, contexts)
    returns, ended = np.zeros(40), np.zeros(40, dtype=np.int64)
    for time in range(max(map(len, ways))):
        step = env.step(np.array([way[time] if time < len(way) else 0 for way in ways]))
        returns += np.where(ended == 0, step.rewards, 0.0)
        assert step.success is not None
        assert np.array_equal(step.success, step.terminated)
        ended[(ended == 0) & step.terminated] = time + 1
    assert ended.tolist() == [len(way) for way in ways]
    np.testing.assert_allclose(returns, best, rtol=1e-12)
    closed = np.zeros((1, 122))
    closed[0, 0] = 7.0
    np.testing.assert_allclose(env.optimal_returns(closed), [-200 * 0.1 / 49])


def test_a_maze_of_side_five_is_mazes_own() -> None:
    layouts = carve(np.random.default_rng(0), 20)
    ours, theirs = BatchedMixedMaze(20), BatchedMaze(20)
    contexts = np.column_stack((np.full(20, 5.0), placed(layouts, 11)))
    assert np.array_equal(start(ours, contexts), start(theirs, layouts))
    assert np.array_equal(cut_out(contexts[:, 1:], 5), layouts)
    random = np.random.default_rng(1)
    for _ in range(200):
        actions = random.integers(4, size=20)
        one, two = ours.step(actions), theirs.step(actions)
        for first, second in ((one.observations, two.observations), (one.rewards, two.rewards),
                              (one.terminated, two.terminated), (one.truncated, two.truncated)):  # fmt: skip
            assert np.asarray(first).tobytes() == np.asarray(second).tobytes()
    assert np.array_equal(ours.optimal_returns(contexts), theirs.optimal_returns(layouts))


@pytest.mark.parametrize("side", [3, 4, 8, 11])
def test_mazes_of_any_side_are_perfect(side: int) -> None:
    layouts = carve(np.random.default_rng(side), 30, side=side)
    assert layouts.shape == (30, side**2)
    larger = np.column_stack((np.full(30, side), placed(layouts, 11)))
    for context in larger:
        assert len(search(context)) == side**2
    ways = shortest_ways(layouts)
    assert ways.tolist() == [len(search(context)[side - 1, side - 1]) for context in larger]
    assert ((ways >= 2 * (side - 1)) & (ways < side**2)).all()


def test_observations_have_one_shape_and_contexts_are_scaled() -> None:
    contexts = draw(np.random.default_rng(2), 30)
    env = ContextVisible(BatchedMixedMaze(30))
    observations = start(env, contexts)
    assert observations.shape == (30, 124)
    np.testing.assert_allclose(observations[:, 2], (contexts[:, 0] - 7.0) / 4.0, rtol=1e-6)
    np.testing.assert_allclose(observations[:, 3:], 2.0 * contexts[:, 1:] / 15.0 - 1.0, rtol=1e-6)
    assert len({*contexts[:, 0]}) > 5


def test_the_single_version_agrees_with_a_slot_among_others() -> None:
    contexts = draw(np.random.default_rng(3), 6)
    actions = np.random.default_rng(4).integers(4, size=(200, 6))
    env, single = BatchedMixedMaze(6), gym.make(ENV_ID)
    start(env, contexts)
    told = [env.step(row) for row in actions]
    for slot in (5, 0, 3, 5):
        single.reset(seed=slot, options={"context": contexts[slot]})
        for time, step in enumerate(told):
            observation, reward, terminated, truncated, info = single.step(int(actions[time, slot]))
            assert observation.tolist() == step.observations[slot].tolist()
            assert (reward, terminated, truncated) == (step.rewards[slot], step.terminated[slot], step.truncated[slot])
            assert info["success"] == terminated
            if terminated or truncated:
                break


@pytest.mark.parametrize("context_visible", [False, True])
def test_gymnasiums_own_checker_accepts_it(context_visible: bool) -> None:
    env = gym.make(ENV_ID, disable_env_checker=True).unwrapped
    check_env(ContextObservation(env) if context_visible else env, skip_render_check=True)


def test_what_is_no_maze_is_refused() -> None:
    env, good = BatchedMixedMaze(1), draw(np.random.default_rng(0), 1)
    for place, value in ((0, 4.5), (7, 0.5)):
        wrong = good.copy()
        wrong[0, place] = value
        with pytest.raises(ValueError, match="its side, a whole number from 3 to 11, and 121 whole numbers"):
            start(env, wrong)
    leaving = np.column_stack(([4.0], placed(carve(np.random.default_rng(1), 1, side=6), 11)))
    with pytest.raises(ValueError, match="a maze of side 4 is open towards a cell beside it"):
        start(env, leaving)
    with pytest.raises(ValueError, match="side"):
        gym.make(ENV_ID).reset(seed=0, options={"context": np.array([12.0, *np.zeros(121)])})
