"""What is AntGoal's own; what it shares with every environment on PyBullet is in test_bullet.py."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401 - registers the environment to compare with
import pytest
from numpy.typing import NDArray

from space_dist.envs import BatchedAntGoal, make_batched
from space_dist.envs.antgoal import BOUNDS as ANTGOAL_BOUNDS
from space_dist.envs.antgoal import HEALTHY_HEIGHT
from space_dist.envs.distributions import sample

ENV_ID = "space_dist/AntGoal-v0"
FloatArray = NDArray[np.float64]


def start(env: BatchedAntGoal, context: tuple[float, float, float], seed: int = 0) -> NDArray[np.float32]:
    """The same in every slot."""
    n = env.n_slots
    return env.reset(np.arange(n), np.tile(context, (n, 1)), np.full(n, seed, dtype=np.uint64))


def gaits(seed: int, steps: int) -> NDArray[np.float32]:
    """(steps, 8) actions that are held for ten steps each, some beyond the limits."""
    drawn = np.random.default_rng(seed).uniform(-1.3, 1.3, size=(steps // 10 + 1, 8))
    return np.repeat(drawn, 10, axis=0)[:steps].astype(np.float32)


def test_it_is_pybullets_ant_step_for_step() -> None:
    """The same seed, a goal 1,000 m ahead, no leg disabled: the same observations, rewards and ends.

    AntBulletEnv counts the floor among the parts whose mean is the ant's position: that is not ours, and taken out.
    """
    reference = gym.make("AntBulletEnv-v0").unwrapped
    reference.reset(seed=99)  # its first episode is not restored from a saved state and differs from all others
    ours, ends = BatchedAntGoal(1), 0
    for seed in range(4):
        reference.reset(seed=seed)
        reference.robot.parts.pop("floor", None)
        expected = reference.robot.calc_state()
        reference.potential = reference.robot.calc_potential()
        np.testing.assert_allclose(start(ours, (1000.0, 0.0, -1.0), seed)[0], expected, atol=1e-5)
        for action in gaits(seed, 400):
            expected, reward, fallen, _, _ = reference.step(np.clip(action, -1.0, 1.0))
            step = ours.step(action[None])
            np.testing.assert_allclose(step.observations[0], expected, atol=1e-5)
            np.testing.assert_allclose(step.rewards[0], reward, atol=1e-5)
            assert bool(step.terminated[0]) == fallen
            if fallen:
                ends += 1
                break
    reference.close()
    assert 1 <= ends <= 4


@pytest.mark.parametrize("leg", range(4))
def test_a_disabled_legs_pair_does_nothing_and_costs_nothing(leg: int) -> None:
    """Every leg, leg 0 too: what the policy asks of it is irrelevant, and what it asks of the others is not."""
    disabled, zeroed, healthy = (BatchedAntGoal(1) for _ in range(3))
    start(disabled, (500.0, 100.0, float(leg)))
    start(zeroed, (500.0, 100.0, -1.0))
    start(healthy, (500.0, 100.0, -1.0))
    differs = False
    for action in gaits(leg, 30):
        without = action.copy()
        without[2 * leg : 2 * leg + 2] = 0.0
        given = action[None].copy()
        step, expected, other = disabled.step(given), zeroed.step(without[None]), healthy.step(action[None])
        np.testing.assert_array_equal(given[0], action)
        np.testing.assert_array_equal(step.observations, expected.observations)
        np.testing.assert_array_equal(step.rewards, expected.rewards)
        differs |= bool((step.observations != other.observations).any())
    assert differs


def test_the_joints_of_a_leg_are_neighbours_in_the_action() -> None:
    """Pushing one pair moves that leg's joints most, while the ant is in the air."""
    for leg in range(4):
        env = BatchedAntGoal(1)
        before = start(env, (500.0, 0.0, -1.0))
        action = np.zeros((1, 8))
        action[0, 2 * leg : 2 * leg + 2] = 0.3
        moved = np.abs(env.step(action).observations - before)[0, 8:24:2].reshape(4, 2).sum(axis=1)
        assert moved.argmax() == leg


def test_a_leg_between_two_is_the_nearest() -> None:
    near, exact = BatchedAntGoal(1), BatchedAntGoal(1)
    start(near, (500.0, 0.0, 0.6))
    start(exact, (500.0, 0.0, 1.0))
    for action in gaits(0, 10):
        np.testing.assert_array_equal(near.step(action[None]).observations, exact.step(action[None]).observations)


def test_the_goal_decides_direction_and_reward() -> None:
    """Seen from the start, and paid for by the metres gained: opposite goals pay opposite progress."""
    env = BatchedAntGoal(4)
    goals = np.array([[500.0, 0.0], [-500.0, 0.0], [0.0, 500.0], [0.0, -500.0]])
    observations = env.reset(
        np.arange(4), np.column_stack((goals, np.full(4, -1.0))), np.zeros(4, dtype=np.uint64)
    )  # fmt: skip
    np.testing.assert_allclose(observations[:, 1], [0.0, 0.0, 1.0, -1.0], atol=1e-3)  # sine
    np.testing.assert_allclose(observations[:, 2], [1.0, -1.0, 0.0, 0.0], atol=1e-3)  # cosine
    np.testing.assert_array_equal(observations[:, 3:], np.tile(observations[0, 3:], (4, 1)))
    for action in gaits(3, 15):
        step = env.step(np.tile(action, (4, 1)))
    progress = step.rewards - step.rewards.mean()
    assert np.abs(progress).max() > 0.03
    np.testing.assert_allclose(progress[:2].sum(), 0.0, atol=1e-4)
    np.testing.assert_allclose(progress[2:].sum(), 0.0, atol=1e-4)


def test_an_ant_that_does_nothing_sinks_to_the_floor_and_that_ends_it() -> None:
    env = BatchedAntGoal(1)
    start(env, (500.0, 500.0, -1.0))
    heights = []
    for _ in range(60):
        step = env.step(np.zeros((1, 8)))
        heights.append(0.75 + step.observations[0, 0])
        if step.terminated[0]:
            break
    assert step.terminated[0]
    assert not step.truncated[0]
    assert heights[-1] <= HEALTHY_HEIGHT < min(heights[:-1])
    assert step.rewards[0] < 0.0
    assert step.success is None


def test_the_horizon_is_an_argument_and_500() -> None:
    assert BatchedAntGoal(1).horizon == 500
    env = make_batched(ENV_ID, 1, context_visible=True, kwargs={"horizon": 5})
    env.reset(np.array([0]), np.array([[1.0, 2.0, 3.0]]), np.zeros(1, dtype=np.uint64))
    assert [bool(env.step(np.zeros((1, 8))).truncated[0]) for _ in range(5)] == [False] * 4 + [True]


@pytest.mark.parametrize(("distribution", "low"), [("antgoal_positive", 0.0), ("antgoal_all", -750.0)])
def test_the_samplers(distribution: str, low: float) -> None:
    contexts = sample(distribution, 20_000, 1, 0)[0].contexts
    goals, legs = contexts[:, :2], contexts[:, 2]
    assert (goals.min() - low) / 750 < 1e-3
    assert goals.max() <= ANTGOAL_BOUNDS.high[0]
    np.testing.assert_allclose(goals.mean(axis=0), (low + 750.0) / 2, atol=10.0)
    assert set(legs) == {-1.0, 0.0, 1.0, 2.0, 3.0}
    np.testing.assert_allclose([(legs == leg).mean() for leg in range(-1, 4)], 0.2, atol=0.015)


def test_a_context_survives_resets_without_one() -> None:
    env = gym.make(ENV_ID)
    context = np.array([300.0, -200.0, 2.0])
    env.reset(seed=0, options={"context": context})
    for _ in range(2):
        _, info = env.reset()
        np.testing.assert_array_equal(info["context"], context)
