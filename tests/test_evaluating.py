"""Evaluation and start values: every instance once, the same wherever it is played."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from space_dist.envs import ContextObservation
from space_dist.envs.interface import FloatArray
from space_dist.envs.observations import distinct
from space_dist.instances import InstanceSet
from space_dist.rollout import (
    Setup,
    Worker,
    joined,
)
from space_dist.rollout.policy import MlpPolicy, forward
from space_dist.rollout.setup import CHUNK
from space_dist.seeding import Purpose, episode_seeds
from tests import tiny_env
from tests.test_rollout import HIGH, LOW, POINTMASS, bits, falling, falls, setup_for, uniform, weights_for

# ---- evaluating ----


def flown(weights: MlpPolicy, context: FloatArray, seed: int, gamma: float) -> tuple[float, float, int, float]:
    """Return, discounted return, length and success of one deterministic episode, stepped alone."""
    env = ContextObservation(gym.make(POINTMASS))
    observation, _ = env.reset(seed=seed, options={"context": context})
    rewards, ended = [], False
    while not ended:
        action = forward(weights.actor, weights.activation, observation[None])[0]
        observation, reward, terminated, truncated, info = env.step(np.clip(action, -10.0, 10.0))
        rewards.append(reward)
        ended = terminated or truncated
    return sum(rewards), sum(gamma**t * reward for t, reward in enumerate(rewards)), len(rewards), info["success"]


@pytest.mark.parametrize("split", ["train", "test"])
def test_evaluation_is_one_whole_episode_per_row(split: Any) -> None:
    setup = setup_for(evaluation_episodes=2)
    weights, instances = falling(version=8), setup.instances(split)
    worker = Worker(setup)
    parts = [worker.evaluate(weights, split, part) for part in range(setup.evaluation_parts)]
    told = joined(parts)
    assert told.policy_version == 8
    assert len(told.returns) == 2 * len(instances)
    seeds = episode_seeds(3, Purpose.EVALUATION, int(split == "test"), count=2 * len(instances))
    expected = [flown(weights, instances.contexts[row // 2], int(seed), setup.gamma) for row, seed in enumerate(seeds)]
    returns, discounted, lengths, success = zip(*expected, strict=True)
    np.testing.assert_array_equal(told.lengths, lengths)
    np.testing.assert_allclose(told.returns, returns, rtol=1e-5)
    np.testing.assert_allclose(told.discounted_returns, discounted, rtol=1e-5)
    np.testing.assert_array_equal(told.success, success)
    assert min(lengths) < max(lengths) == 100  # some crashed while others went on
    again = joined([Worker(setup).evaluate(weights, split, part) for part in range(setup.evaluation_parts)])
    assert bits(again) == bits(told)


def test_finished_slots_are_not_counted() -> None:
    # Two slots of one environment: what happens to the first after its end changes neither its numbers nor the other's.
    setup = setup_for("tests.test_rollout:Countdown", context_visible=False, shards=1, gamma=0.5,
                      train=InstanceSet(np.arange(3), np.array([[1.0], [3.0], [9.0]]), ("length",)))  # fmt: skip
    told = Worker(setup).evaluate(weights_for(2, 1), "train", 0)
    assert told.lengths.tolist() == [1, 3, 5]
    assert told.returns.tolist() == [1.0, 6.0, 15.0]
    assert told.discounted_returns.tolist() == [1.0, 2.75, 3.5625]
    assert np.isnan(told.success).all()


def test_more_parts_than_episodes() -> None:
    setup = setup_for(shards=7)
    parts = [Worker(setup).evaluate(falling(), "test", part) for part in range(7)]
    assert [len(part.returns) for part in parts] == [1, 1, 1, 1, 1, 0, 0]
    whole = Worker(setup_for(shards=1)).evaluate(falling(), "test", 0)
    np.testing.assert_allclose(joined(parts).returns, whole.returns, rtol=1e-5)


def test_measuring_never_touches_training() -> None:
    setup = setup_for(slots=5)  # as many slots as one part of the test split has episodes
    undisturbed, measured = Worker(setup), Worker(setup)
    before = [bits(falls(undisturbed, round=number)) for number in range(3)]
    after = []
    for number in range(3):
        measured.evaluate(falling(), "test", 0)
        measured.start_values(falling(), 0)
        after.append(bits(falls(measured, round=number)))
        measured.evaluate(falling(), "train", 0)
    assert after == before


# ---- start values ----


def lines(n: int, **changes: Any) -> Setup:
    instances = InstanceSet(np.arange(n), np.linspace(-1.0, 1.0, n)[:, None], ("target",))
    return setup_for("tests.tiny_env:make", train=instances, test=instances, **changes)


def test_start_values_are_means_over_seeded_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("space_dist.rollout.setup.CHUNK", 4096)  # a smaller one, or starts alone would take seconds
    size, n = 4, 10
    setup = lines(n, start_states=1000)
    assert (setup.chunk_size, setup.chunks) == (size, 3)
    weights, worker = weights_for(2, 1), Worker(setup)
    told = [worker.start_values(weights, chunk) for chunk in range(setup.chunks)]
    assert [len(chunk) for chunk in told] == [size, size, 2]
    for instance in range(n):
        chunk, place = divmod(instance, size)
        seeds = episode_seeds(3, Purpose.START_STATES, chunk, count=len(told[chunk]) * 1000)
        mine = seeds[1000 * place : 1000 * (place + 1)]
        target = np.full((1000, 1), setup.train.contexts[instance, 0])
        starts = tiny_env.make(1000).reset(np.arange(1000), target, mine)
        assert np.ptp(starts) > tiny_env.START
        observed = np.concatenate([starts, target], axis=1).astype(np.float32)
        expected = weights.values(observed).mean()
        assert told[chunk][place] == pytest.approx(expected, rel=1e-5)
    # Whoever computes a chunk, in whatever order and how often, it has the same bits.
    late = Worker(setup)
    for chunk in (2, 0, 1, 0):
        assert late.start_values(weights, chunk).tobytes() == told[chunk].tobytes()


def test_joined_chunks_equal_one_big_evaluation() -> None:
    n = 2 * CHUNK + 100
    contexts = uniform(n)
    setup = setup_for(train=InstanceSet(np.arange(n), contexts, ("gate_x", "gate_width", "friction")))
    assert setup.chunks == 3
    weights, worker = falling(), Worker(setup)
    told = np.concatenate([worker.start_values(weights, chunk) for chunk in range(3)])
    scaled = 2.0 * (contexts - LOW) / (HIGH - LOW) - 1.0
    observed = np.concatenate([np.tile([0.0, 0.0, 3.0, 0.0], (n, 1)), scaled], axis=1).astype(np.float32)
    np.testing.assert_allclose(told, weights.values(observed), rtol=1e-5, atol=1e-6)


def test_equal_starts_have_equal_values_wherever_they_stand() -> None:
    """A matrix product rounds a row by its place in it: hidden contexts tied, or did not, by their row."""
    n = 150
    hidden = setup_for(
        context_visible=False,
        train=InstanceSet(np.arange(n), uniform(n), ("gate_x", "gate_width", "friction")),
    )
    worker = Worker(hidden)
    for seed in range(5):
        assert len(set(worker.start_values(weights_for(4, 2, seed=seed, hidden=64), 0).tolist())) == 1
    # Seven different contexts, again and again.
    few = np.random.default_rng(0).integers(7, size=n)
    setup = setup_for(train=InstanceSet(np.arange(n), uniform(7)[few], ("gate_x", "gate_width", "friction")))
    values = Worker(setup).start_values(weights_for(7, 2, hidden=64), 0)
    assert len(set(values.tolist())) == 7
    assert len(set(zip(values.tolist(), few.tolist(), strict=True))) == 7


def test_rows_that_differ_are_found_once_and_all_stay_as_they_stand_where_all_differ() -> None:
    table = np.array([[0.0, 2.0], [1.0, 2.0], [-0.0, 2.0], [1.0, 2.0]])
    found, which = distinct({"a": table, "b": np.zeros((4, 1, 2), dtype=np.int64)})
    assert which is not None
    assert isinstance(found, dict)
    assert which[0] == which[2] != which[1] == which[3]
    np.testing.assert_array_equal(found["a"][which], table)
    assert found["b"].shape == (2, 1, 2)
    same, none = distinct(table[:2])
    assert same is not None
    assert none is None
    turned, other = distinct(table[::-1])  # the order of the rows that differ is their own
    assert other is not None
    np.testing.assert_array_equal(turned, distinct(table)[0])
    assert distinct(np.zeros((3, 0)))[1] is None
