"""PointMass with a sparse reward: the same world, another end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from space_dist.envs import BatchedPointMass, BatchedSparsePointMass, ContextObservation, make_single
from space_dist.envs.distributions import sample
from space_dist.envs.sparse_pointmass import GOAL_RADIUS

ENV_ID = "space_dist/SparsePointMass-v0"
CONTEXTS = sample("pointmass_uniform", 60, 4, 7)[0].contexts
SEEDS = np.arange(len(CONTEXTS), dtype=np.uint64)


def steered(positions: NDArray[Any], contexts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Actions in [-1, 1] towards the gate, and behind it towards the goal."""
    x, vx, y, vy = positions.astype(np.float64).T
    aim_x = np.where(y > 0.2, contexts[:, 0], 0.0)
    aim_y = np.where((y > 0.2) & (np.abs(x - aim_x) > 0.2), y, -3.0)
    return np.clip(np.column_stack((2.0 * (aim_x - x) - 1.5 * vx, 0.5 * (aim_y - y) - 0.5 * vy)), -1.0, 1.0)


@pytest.mark.parametrize("compiled", [False, True])
def test_it_is_pointmass_until_the_goal_is_near(compiled: bool) -> None:
    ours, dense = BatchedSparsePointMass(len(CONTEXTS)), BatchedPointMass(len(CONTEXTS))
    if compiled:
        ours.compile_physics()
    slots = np.arange(len(CONTEXTS))
    seen = ours.reset(slots, CONTEXTS, SEEDS)
    assert np.array_equal(seen, dense.reset(slots, CONTEXTS, SEEDS))
    over, succeeded = np.zeros(len(CONTEXTS), dtype=bool), np.zeros(len(CONTEXTS), dtype=bool)
    for time in range(1, 101):
        actions = np.where(slots[:, None] % 3 == 0, 0.0, steered(seen, CONTEXTS))  # some stay where they are
        mine, theirs = ours.step(actions), dense.step(10.0 * actions)
        assert np.array_equal(mine.observations, theirs.observations)
        seen = np.asarray(mine.observations)
        near = np.hypot(seen[:, 0].astype(float), seen[:, 2].astype(float) + 3.0)
        clear = np.abs(near - GOAL_RADIUS) > 1e-5  # observations are rounded to float32
        reached = near < GOAL_RADIUS
        assert np.array_equal((mine.rewards == 1.0)[clear], reached[clear])
        assert mine.success is not None
        assert np.array_equal(mine.success, mine.rewards == 1.0)
        assert set(mine.rewards) <= {0.0, 1.0}
        assert np.array_equal(mine.terminated, theirs.terminated | mine.success)
        assert np.array_equal(mine.truncated, (time == 100) & ~mine.terminated)
        succeeded |= ~over & mine.success
        over |= mine.terminated | mine.truncated
    assert not succeeded[::3].any()
    assert succeeded.mean() > 0.6


def test_gymnasiums_checker_finds_nothing() -> None:
    check_env(ContextObservation(make_single(ENV_ID)), skip_render_check=True)


def test_bimodal_gates_are_narrow_and_on_both_sides() -> None:
    train, test = sample("pointmass_bimodal", 400, 100, 0)
    contexts = np.vstack((train.contexts, test.contexts))
    assert {*contexts[:, 0]} == {-3.0, 3.0}
    assert 0.4 < (contexts[:, 0] > 0).mean() < 0.6
    assert {*contexts[:, 1]} == {0.5}
    assert contexts[:, 2].min() < 0.2 < 3.8 < contexts[:, 2].max()


def test_half_of_mixed_gates_are_bimodal_and_the_others_anywhere() -> None:
    train, test = sample("pointmass_mixed", 400, 100, 0)
    contexts = np.vstack((train.contexts, test.contexts))
    narrow = contexts[:, 1] == 0.5
    assert 0.4 < narrow.mean() < 0.6
    assert {*contexts[narrow, 0]} == {-3.0, 3.0}
    anywhere = contexts[~narrow]
    assert anywhere[:, 0].min() < -3.5 < 3.5 < anywhere[:, 0].max()
    assert anywhere[:, 1].min() < 1.0 < 7.0 < anywhere[:, 1].max()
