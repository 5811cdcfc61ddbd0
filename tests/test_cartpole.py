from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from space_dist.envs import BatchedCartPole, ContextObservation, ContextVisible, make_batched
from space_dist.envs.cartpole import BOUNDS as CARTPOLE_BOUNDS
from space_dist.instances import read_csv, refuse_overlap
from tests.one_slot import seen_by

ENV_ID = "space_dist/CartPole-v0"
INSTANCES = Path(__file__).parent.parent / "configs" / "instances"
FloatArray = NDArray[np.float64]
Observations = NDArray[np.float32]


def reset(
    env: BatchedCartPole | ContextVisible, lengths: Sequence[float] | FloatArray, seeds: Sequence[int]
) -> Observations:
    return env.reset(np.arange(env.n_slots), np.array(lengths)[:, None], np.array(seeds, dtype=np.uint64))


def balancing(observations: Observations) -> NDArray[np.int64]:
    """Keeps any pole of at least 0.2 up for 200 steps, and the cart near the middle."""
    return (observations[:, :4] @ np.float32([0.1, 0.4, 3.0, 1.0]) > 0).astype(np.int64)


def gymnasiums(length: float, state: FloatArray) -> CartPoleEnv:
    env = CartPoleEnv()
    env.reset(seed=0)
    env.length, env.polemass_length, env.state = length, env.masspole * length, state.copy()
    return env


def ride(
    env: gym.Env, actions: NDArray[np.int64], *, seed: int | None, length: float
) -> list[tuple[bytes, float, bool, bool, bool]]:
    """(observation, reward, terminated, truncated, success) at reset and after each step, to the episode's end."""
    observation, _ = env.reset(seed=seed, options={"context": np.array([length])})
    told = [(observation.tobytes(), 0.0, False, False, False)]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        told.append((observation.tobytes(), reward, terminated, truncated, info["success"]))
        if terminated or truncated:
            break
    return told


# ---- the physics


@pytest.mark.parametrize("length", [0.1, 0.3, 0.4, 0.5, 0.77, 1.0])
def test_follows_gymnasiums_physics_step_for_step(length: float) -> None:
    """Half of the slots act at random and fall; the others balance, with a tenth of their actions random."""
    n, horizon, random = 12, 300, np.random.default_rng(0)
    env = BatchedCartPole(n, horizon=horizon)
    observations = reset(env, np.full(n, length), range(n))
    references = []
    for seed in range(n):
        start = CartPoleEnv()
        start_observation, _ = start.reset(seed=seed)  # the same seed starts Gymnasium's own in the same state
        np.testing.assert_array_equal(observations[seed], start_observation)
        references.append(gymnasiums(length, np.asarray(start.state)))
    ended: dict[int, int] = {}
    for time in range(1, horizon + 1):
        wild = (np.arange(n) < n // 2) | (random.random(n) < 0.1)
        actions = np.where(wild, random.integers(2, size=n), balancing(observations))
        step = env.step(actions)
        observations = step.observations
        for slot in set(range(n)).difference(ended):
            expected, reward, fell, _, _ = references[slot].step(actions[slot])
            np.testing.assert_allclose(observations[slot], expected, rtol=1e-6, atol=1e-6)
            assert (bool(step.terminated[slot]), step.rewards[slot]) == (fell, reward)
            if fell or step.truncated[slot]:
                ended[slot] = time
    assert len(ended) == n
    assert len(set(ended.values())) >= 5
    assert min(ended.values()) < 40 < 70 < max(ended.values())


@pytest.mark.parametrize(("place", "edge"), [(0, 2.4), (2, np.deg2rad(12.0))])
def test_the_thresholds_are_gymnasiums_on_both_sides(place: int, edge: float) -> None:
    for sign in (-1.0, 1.0):
        for value in (edge - 1e-9, edge + 1e-9):
            state = np.zeros(4)
            state[place] = sign * value  # at rest: after the first step still here
            env = BatchedCartPole(1)
            reset(env, [0.5], range(1))
            env._state[:, 0] = state
            fell = gymnasiums(0.5, state).step(1)[2]
            assert fell == (value > edge)
            assert bool(env.step(np.array([1])).terminated[0]) == fell


def test_the_cart_can_leave_the_track_before_the_pole_falls() -> None:
    env = BatchedCartPole(1, horizon=500)
    observations = reset(env, [1.0], range(1))
    for _ in range(500):
        tilted = observations[:, 2] + 0.5 * observations[:, 3] > 0.04  # a pole kept leaning to the right drives there
        step = env.step(tilted.astype(np.int64))
        observations = step.observations
        if step.terminated[0]:
            break
    assert step.terminated[0]
    assert observations[0, 0] > 2.4
    assert abs(observations[0, 2]) < np.deg2rad(11.0)


def test_the_length_changes_the_dynamics() -> None:
    env = BatchedCartPole(3)
    starts = reset(env, [0.3, 0.4, 0.5], [7, 7, 7])
    np.testing.assert_array_equal(starts, np.tile(starts[0], (3, 1)))
    for action in (0, 1, 1, 0, 1, 0, 0, 1):
        states = env.step(np.full(3, action)).observations
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert abs(states[one, 3] - states[other, 3]) > 0.01  # rad/s


def test_the_angles_first_acceleration_by_hand() -> None:
    # Upright and at rest, pushed right: temp = 10 / 1.1, so the angle's acceleration is -temp / (l (4/3 - 0.1 / 1.1))
    # = -7.3171 / l, and the cart's is temp + 0.1 * 7.3171 / 1.1 = 9.7561 at every length.
    env = BatchedCartPole(4)
    reset(env, [0.1, 0.3, 0.5, 1.0], range(4))
    env._state[:] = 0.0
    x, velocity, angle, spin = env.step(np.ones(4, dtype=np.int64)).observations.T
    np.testing.assert_allclose(spin, 0.02 * -7.317073 / np.array([0.1, 0.3, 0.5, 1.0]), rtol=1e-6)
    np.testing.assert_allclose(velocity, 0.02 * 9.756098, rtol=1e-6)
    assert not x.any()
    assert not angle.any()


def test_a_longer_pole_falls_slower() -> None:
    lengths = np.linspace(0.1, 1.0, 10)
    env = BatchedCartPole(10)
    reset(env, lengths, [3] * 10)
    fell_at = np.zeros(10, dtype=np.int64)
    for time in range(1, 30):
        fallen = env.step(np.ones(10, dtype=np.int64)).terminated
        fell_at[fallen & (fell_at == 0)] = time
    assert (fell_at > 0).all()
    assert (np.diff(fell_at) >= 0).all()
    assert fell_at[-1] >= 2 * fell_at[0]


# ---- an episode is a pure function of (length, seed, actions)


def test_slots_of_any_age_equal_the_single_environment() -> None:
    n, random = 7, np.random.default_rng(1)
    env, single = BatchedCartPole(n), gym.make(ENV_ID)
    lengths, seeds = random.uniform(0.1, 1.0, size=n), list(range(n))
    observations = reset(env, lengths, seeds)
    told = [[(observations[slot].tobytes(), 0.0, False, False, False)] for slot in range(n)]
    done: list[list[np.int64]] = [[] for _ in range(n)]
    compared: list[int] = []
    for _ in range(500):
        actions = np.where(np.arange(n) < 3, random.integers(2, size=n), balancing(observations))
        step = env.step(actions)
        observations = step.observations.copy()
        assert step.success is not None
        for slot in range(n):
            ended = bool(step.terminated[slot]), bool(step.truncated[slot])
            done[slot].append(actions[slot])
            told[slot].append(
                (observations[slot].tobytes(), float(step.rewards[slot]), *ended, bool(step.success[slot]))
            )
            if any(ended):
                expected = ride(single, np.array(done[slot]), seed=seeds[slot], length=lengths[slot])
                assert told[slot] == expected
                compared.append(len(expected))
                lengths[slot], seeds[slot] = random.uniform(0.1, 1.0), seeds[slot] + n
                one = np.array([slot])
                start = env.reset(one, lengths[one, None], np.array([seeds[slot]], dtype=np.uint64))
                observations[slot] = start[0]
                told[slot], done[slot] = [(start[0].tobytes(), 0.0, False, False, False)], []
    assert len(set(compared)) > 10
    assert 201 in compared


def test_neighbours_and_the_number_of_slots_do_not_matter() -> None:
    random = np.random.default_rng(2)
    actions = random.integers(2, size=200)

    def among(n: int, slot: int) -> list[tuple[bytes, float]]:
        lengths, seeds = random.uniform(0.1, 1.0, size=n), random.integers(1 << 40, size=n)
        lengths[slot], seeds[slot] = 0.6, 11
        env = BatchedCartPole(n)
        reset(env, lengths, seeds.tolist())
        return seen_by(slot, env, actions, lambda: random.integers(2, size=n))

    alone = among(1, 0)
    assert len(alone) > 10
    assert all(among(n, slot) == alone for n, slot in ((2, 1), (8, 3), (33, 32), (256, 100)))


def test_what_was_ridden_before_does_not_matter() -> None:
    random = np.random.default_rng(4)
    env, actions = gym.make(ENV_ID), np.tile([0, 1], 100)
    first = ride(env, actions, seed=6, length=0.5)
    assert len(first) > 20
    for steps in (1, 3, 200):
        ride(env, random.integers(2, size=steps), seed=steps, length=random.uniform(0.1, 1.0))
        assert ride(env, actions, seed=6, length=0.5) == first
    assert ride(env, actions, seed=7, length=0.5) != first
    assert ride(env, actions, seed=6, length=0.4)[0] == first[0]  # the start is the seed's alone
    assert ride(env, actions, seed=6, length=0.4) != first


def test_starts_fill_their_cube() -> None:
    starts = reset(BatchedCartPole(2000), np.full(2000, 0.5), range(2000))
    assert np.abs(starts).max() <= np.float32(0.05)
    np.testing.assert_allclose(starts.mean(axis=0), 0.0, atol=5 * 0.1 / np.sqrt(12 * 2000))
    assert (np.ptp(starts, axis=0) > 0.099).all()


# ---- ends, rewards, spaces


@pytest.mark.parametrize("end_reward", [None, -100.0, 0.0])
def test_the_horizon_and_what_an_end_pays(end_reward: float | None) -> None:
    n = 8
    env = BatchedCartPole(n, horizon=60, end_reward=end_reward)
    observations = reset(env, np.linspace(0.2, 1.0, n), range(n))
    returns, lengths, alive = np.zeros(n), np.zeros(n), np.ones(n, dtype=np.bool_)
    for time in range(1, 61):
        step = env.step(np.where(np.arange(n) < 4, 1, balancing(observations)))
        observations = step.observations
        ended = step.terminated | step.truncated
        np.testing.assert_array_equal(step.truncated[alive], (time == 60) & ~step.terminated[alive])
        np.testing.assert_array_equal(step.success, step.truncated)
        np.testing.assert_array_equal(step.rewards, np.where(ended & (end_reward is not None), end_reward or 0.0, 1.0))
        returns += alive * step.rewards
        lengths += alive
        alive &= ~ended
    assert (lengths[:4] < 30).all()
    assert (lengths[4:] == 60).all()
    np.testing.assert_array_equal(returns, lengths if end_reward is None else lengths - 1 + end_reward)


def test_who_falls_in_the_very_last_step_has_fallen() -> None:
    for horizon, ends in ((8, (False, True)), (9, (True, False)), (10, (True, False))):
        env = BatchedCartPole(1, horizon=horizon, end_reward=-100.0)
        reset(env, [0.5], range(1))
        env._state[:] = 0.0
        for time in range(1, horizon + 1):
            step = env.step(np.array([1]))
            assert (time < min(horizon, 9)) == (step.rewards[0] == 1.0)
            if step.terminated[0]:
                break
        assert (bool(step.terminated[0]), bool(step.truncated[0])) == ends


def test_the_default_horizon_is_the_papers() -> None:
    env = gym.make(ENV_ID)
    observation, _ = env.reset(seed=0, options={"context": np.array([0.5])})
    for time in range(1, 201):
        observation, reward, terminated, truncated, info = env.step(balancing(observation[None])[0])
        assert (reward, terminated, truncated, info) == (1.0, False, time == 200, {"success": time == 200})


@pytest.mark.parametrize("context_visible", [False, True])
def test_gymnasiums_own_checker_accepts_it(context_visible: bool) -> None:
    env = gym.make(ENV_ID, disable_env_checker=True).unwrapped
    check_env(ContextObservation(env) if context_visible else env, skip_render_check=True)


def test_its_spaces_are_gymnasiums_and_the_context_is_appended() -> None:
    env, visible = BatchedCartPole(2), make_batched(ENV_ID, 2, context_visible=True)
    assert (env.observation_space, env.action_space) == (CartPoleEnv().observation_space, CartPoleEnv().action_space)
    assert visible.observation_space == ContextObservation(gym.make(ENV_ID)).observation_space
    started = visible.reset(np.arange(2), np.array([[0.1], [0.775]]), np.array([3, 4], dtype=np.uint64))
    stepped = visible.step(np.array([0, 1])).observations
    np.testing.assert_array_equal(started[:, :4], reset(env, [0.1, 0.775], [3, 4]))
    for observations in (started, stepped):
        np.testing.assert_allclose(observations[:, 4], [-1.0, 0.5], atol=1e-7)
        assert observations.dtype == np.float32


@pytest.mark.parametrize("actions", [[0, 2], [-1, 1], [0.5, 1.0], [np.nan, 0.0]])
def test_an_action_that_is_neither_left_nor_right_is_refused(actions: list[float]) -> None:
    env = BatchedCartPole(2)
    reset(env, [0.5, 0.5], range(2))
    with pytest.raises(ValueError, match="must be 0 or 1, not"):
        env.step(np.array(actions))


def test_observations_are_the_callers() -> None:
    env, other = BatchedCartPole(1), BatchedCartPole(1)
    for one in (env, other):
        reset(one, [0.5], range(1))[:] = 9.0
    env.step(np.array([1])).observations[:] = 9.0
    other.step(np.array([1]))
    np.testing.assert_array_equal(env.step(np.array([1])).observations, other.step(np.array([1])).observations)


def test_the_papers_poles_and_those_we_hold_out() -> None:
    train, test = (read_csv(INSTANCES / f"cartpole_{part}.csv", CARTPOLE_BOUNDS) for part in ("train", "test"))
    assert (train.ids.tolist(), train.contexts[:, 0].tolist()) == ([0, 1, 2], [0.3, 0.4, 0.5])
    assert (test.ids.tolist(), test.contexts[:, 0].tolist()) == ([3, 4, 5, 6], [0.25, 0.35, 0.45, 0.55])
    refuse_overlap(train, test, "train", "test")
