"""The goal maze: walls and block by a second reading of the facts, and which goals can be reached by a search."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from space_dist.envs import BatchedGoalMaze, ContextObservation, ContextVisible, make_batched
from space_dist.envs.distributions import sample
from space_dist.envs.goalmaze import BOUNDS, distances, reachable
from space_dist.errors import ConfigError
from space_dist.instances import read_csv, refuse_overlap

ENV_ID = "space_dist/GoalMaze-v0"
INSTANCES = Path(__file__).parent.parent / "configs" / "instances"
FAR = np.array([9.0, 9.0, 0.05])  # outside the walls: no episode succeeds


def reset(env: Any, contexts: NDArray[np.float64], first_seed: int = 0) -> Any:
    n = len(contexts)
    return env.reset(np.arange(n), contexts, np.arange(first_seed, first_seed + n, dtype=np.uint64))


def walked(x: float, y: float, dx: float, dy: float) -> tuple[float, float]:
    """One step, from the facts alone."""
    dx, dy = (min(max(part, -1.0), 1.0) for part in (dx, dy))
    length = max(1.0, math.sqrt(dx**2 + dy**2))
    u = min(max(x + 0.3 * dx / length, -7.0), 7.0)
    v = min(max(y + 0.3 * dy / length, -7.0), 7.0)
    if abs(u) < 5.0 and abs(v) < 5.0:  # back to the sides that it came from
        u = math.copysign(5.0, x) if abs(x) >= 5.0 else u
        v = math.copysign(5.0, y) if abs(y) >= 5.0 else v
    return u, v


def round_the_block(goal: NDArray[np.float64]) -> list[tuple[float, float]]:
    """The corner to pass, if there is one, and the goal: the shorter way round the block from the lower left corner."""
    x, y = goal.tolist()
    straight = x <= -5.0 or y <= -5.0
    return [(x, y)] if straight else [(6.0, -6.0) if x >= 5.0 else (-6.0, 6.0), (x, y)]


@pytest.mark.parametrize("compiled", [False, True])
def test_it_walks_as_the_facts_say(compiled: bool) -> None:
    """Against walls and block, also: the walkers turn seldom."""
    n, random = 60, np.random.default_rng(0)
    env = BatchedGoalMaze(n)
    if compiled:
        env.compile_physics()
    contexts = random.uniform(BOUNDS.low, BOUNDS.high, size=(n, 3))
    contexts[:, 2] = random.choice([0.05, 1.0, 4.0], size=n)
    seen = reset(env, contexts)
    assert ((seen >= -7.0) & (seen <= -5.0)).all()
    places = seen.astype(np.float64)
    at_walls, at_block, arrivals = 0, 0, 0
    actions = random.normal(0.0, 1.0, size=(n, 2))
    for time in range(1, 201):
        turned = random.random(n) < 0.05
        actions[turned] = random.normal(0.0, 1.0, size=(turned.sum(), 2))
        step = env.step(actions)
        places = np.array([walked(*place, *action) for place, action in zip(places, actions, strict=True)])
        np.testing.assert_allclose(step.observations, places, rtol=0.0, atol=2e-5)
        near = np.hypot(*(contexts[:, :2] - places).T)
        clear = np.abs(near - contexts[:, 2]) > 1e-4
        reached = near < contexts[:, 2]
        assert step.success is not None
        assert np.array_equal(step.success[clear], reached[clear])
        assert np.array_equal(step.rewards, step.success.astype(float))
        assert np.array_equal(step.terminated, step.success)
        assert np.array_equal(step.truncated, (time >= 200) & ~step.success)
        at_walls += int((np.abs(places) == 7.0).any(axis=1).sum())
        at_block += int((np.abs(places).max(axis=1) == 5.0).sum())
        arrivals += int(step.success.sum())
        assert not (np.abs(places) < 5.0 - 1e-9).all(axis=1).any()
    assert min(at_walls, at_block, arrivals) > 50


def test_who_knows_the_way_reaches_every_goal_in_the_corridor() -> None:
    contexts = sample("goalmaze_feasible", 1000, 200, 0)[1].contexts
    n = len(contexts)
    env = BatchedGoalMaze(n)
    places = reset(env, contexts).astype(np.float64)
    ways = [deque(round_the_block(context[:2])) for context in contexts]
    over = np.zeros(n, dtype=np.bool_)
    for _ in range(200):
        for slot in range(n):
            if len(ways[slot]) > 1 and math.dist(places[slot], ways[slot][0]) < 0.31:
                ways[slot].popleft()
        aims = np.array([way[0] for way in ways])
        step = env.step((aims - places) / 0.3)
        places = np.asarray(step.observations, dtype=np.float64)
        over |= step.terminated
        if over.all():
            break
    assert over.all()
    assert reachable(contexts).all()


def test_a_search_of_the_corridor_says_which_goals_can_be_reached() -> None:
    """Every place where one can be, on a grid, by a flood from the start: nearest places and so what is in reach."""
    spacing = 0.1
    line = np.round(np.arange(-7.0, 7.0 + spacing / 2, spacing), 6)
    free = ~((np.abs(line)[:, None] < 5.0) & (np.abs(line)[None, :] < 5.0))
    found, queue = np.zeros_like(free), deque([(10, 10)])  # (-6, -6)
    found[10, 10] = True
    while queue:
        x, y = queue.popleft()
        for u, v in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
            if 0 <= u < len(line) and 0 <= v < len(line) and free[u, v] and not found[u, v]:
                found[u, v] = True
                queue.append((u, v))
    assert np.array_equal(found, free)  # the corridor is one piece
    places = np.stack(np.meshgrid(line, line, indexing="ij"), axis=2)[found]
    goals = np.random.default_rng(1).uniform(-9.0, 9.0, size=(400, 2))
    searched = np.sqrt(((goals[:, None] - places) ** 2).sum(axis=2)).min(axis=1)
    assert np.abs(distances(goals) - searched).max() <= spacing
    assert distances(np.array([[0.0, 0.0], [9.0, 9.0], [-8.0, 0.0], [6.0, -2.0], [4.5, -4.9]])).tolist() == (
        pytest.approx([5.0, math.hypot(2.0, 2.0), 1.0, 0.0, 0.1])
    )


def test_the_distributions_are_those_of_the_paper() -> None:
    uniform, target, feasible = (
        sample(f"goalmaze_{name}", 20_000, 1, 0)[0].contexts for name in ("uniform", "target", "feasible")
    )
    in_corridor = distances(target[:, :2]) == 0.0
    assert abs(in_corridor.mean() - (14**2 - 10**2) / 18**2) < 0.015
    assert distances(feasible[:, :2]).max() == 0.0
    for drawn in (target, feasible):
        assert {*drawn[:, 2]} == {0.05}
    np.testing.assert_allclose(uniform.mean(axis=0), [0.0, 0.0, 9.025], atol=0.15)
    assert (np.ptp(uniform, axis=0) > 0.99 * (BOUNDS.high - BOUNDS.low)).all()
    graded, solvable = (sample(f"goalmaze_{name}", 20_000, 1, 0)[0].contexts for name in ("graded", "solvable"))
    thirds = np.histogram(np.log(graded[:, 2]), bins=3, range=(math.log(0.05), math.log(18.0)))[0]
    assert np.abs(thirds / 20_000 - 1 / 3).max() < 0.02
    assert abs(reachable(graded).mean() - 0.65) < 0.015
    assert reachable(solvable).all()


def test_the_larger_sets_are_what_is_drawn_and_share_nothing() -> None:
    kept = {}
    for name in ("uniform", "target", "graded", "solvable", "feasible"):
        for split, drawn in zip(("train", "test"), sample(f"goalmaze_{name}", 1000, 200, 0), strict=True):
            path = INSTANCES / f"goalmaze_{name}_1000_{split}.csv"
            if path.exists():
                assert path.read_text() == drawn.to_csv()
                kept[name, split] = read_csv(path, BOUNDS)
    trains, tests = ("uniform", "target", "graded"), ("solvable", "feasible")
    assert {*kept} == {*((name, "train") for name in trains), *((name, "test") for name in tests)}
    for name in trains:
        for tested in tests:
            refuse_overlap(kept[name, "train"], kept[tested, "test"], "train", "test")
            assert not {*kept[name, "train"].ids} & {*kept[tested, "test"].ids}
    assert all(reachable(kept[name, "test"].contexts).all() for name in tests)
    assert 0.6 < reachable(kept["graded", "train"].contexts).mean() < 0.7


@pytest.mark.parametrize("n_slots", [1, 3, 17])
@pytest.mark.parametrize("size", [0.3, 1.0, 40.0])
def test_the_compiled_twin_has_the_same_bits(n_slots: int, size: float) -> None:
    """Over ends and new episodes; and for actions that are no numbers."""
    plain, twin = BatchedGoalMaze(n_slots), BatchedGoalMaze(n_slots)
    twin.compile_physics()
    twin.compile_physics()
    random = np.random.default_rng(n_slots)
    drawn = random.uniform(BOUNDS.low, BOUNDS.high, size=(n_slots, 3))
    drawn[:, 2] = random.uniform(0.05, 3.0, size=n_slots)
    slots, seeds, heading = np.arange(n_slots), np.arange(n_slots, dtype=np.uint64), np.zeros((n_slots, 2))
    for number in range(600):
        starts = [env.reset(slots, drawn[slots], seeds[slots]) for env in (plain, twin)]
        assert starts[0].tobytes() == starts[1].tobytes()
        heading = np.where(random.random((n_slots, 1)) < 0.05, random.normal(0.0, size, (n_slots, 2)), heading)
        actions = heading.astype(np.float32)
        if number % 97 == 0:
            actions[0] = [np.nan, 1.0]
        elif number % 89 == 0:
            actions[0] = [np.inf, -np.inf]
        one, two = plain.step(actions), twin.step(actions)
        assert one.success is not None
        assert two.success is not None
        for first, second in (
            (one.observations, two.observations), (one.rewards, two.rewards), (one.success, two.success),
            (one.terminated, two.terminated), (one.truncated, two.truncated),
        ):  # fmt: skip
            assert np.asarray(first).tobytes() == np.asarray(second).tobytes()
        over = one.terminated | one.truncated
        if number % 97 == 0:
            over[0] = True  # it is nowhere now
        slots = np.flatnonzero(over)
        seeds[slots] += np.uint64(n_slots)
    assert seeds.max() > 2 * n_slots


def test_slots_of_any_age_equal_the_single_environment() -> None:
    n, random = 5, np.random.default_rng(2)
    env, single = BatchedGoalMaze(n), gym.make(ENV_ID)
    contexts = sample("goalmaze_uniform", n, 1, 3)[0].contexts.copy()
    contexts[:, 2] = [0.05, 0.5, 2.0, 5.0, 9.0]
    started = reset(env, contexts, 20)
    actions = random.normal(0.0, 1.0, size=(200, n, 2)).astype(np.float32)
    told = [env.step(row) for row in actions]
    for slot in (4, 0, 2, 4):  # after other episodes, in any order
        observation, _ = single.reset(seed=20 + slot, options={"context": contexts[slot]})
        assert np.array_equal(observation, started[slot])
        for time, step in enumerate(told):
            observation, reward, terminated, truncated, info = single.step(actions[time, slot])
            assert np.array_equal(observation, step.observations[slot])
            assert step.success is not None
            assert (reward, terminated, truncated, info["success"]) == (
                step.rewards[slot], step.terminated[slot], step.truncated[slot], step.success[slot]
            )  # fmt: skip
            if terminated or truncated:
                break


def test_a_step_may_cost() -> None:
    """With 1, what Klink et al.'s learner is paid: -1 a step, and 0 for the one that succeeds."""
    contexts = np.array([FAR, [-6.0, -6.0, 3.0]])
    env = make_batched(ENV_ID, 2, context_visible=False, kwargs={"step_cost": 1})
    reset(env, contexts)
    assert env.step(np.zeros((2, 2))).rewards.tolist() == [-1.0, 0.0]


@pytest.mark.parametrize("cost", [-0.1, 1.5, math.nan, "1", True])
def test_other_costs_are_refused(cost: Any) -> None:
    with pytest.raises(ConfigError, match=r"GoalMaze-v0.*step_cost is .*; allowed is a number from 0 to 1"):
        make_batched(ENV_ID, 1, context_visible=False, kwargs={"step_cost": cost})


@pytest.mark.parametrize("context", [[9.1, 0.0, 1.0], [0.0, 0.0, 0.04], [0.0, math.nan, 1.0], [0.0, 1.0]])
def test_other_contexts_are_refused(context: list[float]) -> None:
    with pytest.raises(ValueError, match="goal_x, goal_y, tolerance"):
        gym.make(ENV_ID).reset(seed=0, options={"context": np.array(context)})


def test_actions_are_cut_to_one_and_left_alone() -> None:
    wild = np.array([[30.0, 40.0], [1.0, 1.0], [0.3, 0.4], [np.inf, 0.0]])
    given, env = wild.copy(), BatchedGoalMaze(4)
    before = reset(env, np.tile(FAR, (4, 1))).astype(np.float64)
    moved = np.asarray(env.step(wild).observations, dtype=np.float64) - before
    np.testing.assert_array_equal(wild, given)
    diagonal = 0.3 / math.sqrt(2.0)
    np.testing.assert_allclose(moved, [[diagonal] * 2, [diagonal] * 2, [0.09, 0.12], [0.3, 0.0]], atol=1e-5)


def test_horizons_and_the_clock() -> None:
    env = BatchedGoalMaze(1, horizon=3)
    reset(env, FAR[None])
    ends = [bool(env.step(np.zeros((1, 2))).truncated[0]) for _ in range(3)]
    assert ends == [False, False, True]


@pytest.mark.parametrize("context_visible", [False, True])
def test_gymnasiums_own_checker_accepts_it(context_visible: bool) -> None:
    env = gym.make(ENV_ID, disable_env_checker=True).unwrapped
    check_env(ContextObservation(env) if context_visible else env, skip_render_check=True)


def test_a_visible_context_is_scaled() -> None:
    contexts = np.array([BOUNDS.low, BOUNDS.high, [0.0, 4.5, 9.025]])
    observations = reset(ContextVisible(BatchedGoalMaze(3)), contexts)
    assert (observations.dtype, observations.shape) == (np.float32, (3, 5))
    np.testing.assert_allclose(observations[:, 2:], [[-1, -1, -1], [1, 1, 1], [0, 0.5, 0]], atol=1e-6)
