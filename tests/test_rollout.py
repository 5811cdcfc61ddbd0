from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.config import PPOConfig
from space_dist.curricula import Selection
from space_dist.envs import ContextObservation, make_batched
from space_dist.envs.interface import FloatArray, IntArray, Observations, Step
from space_dist.envs.spec import read_spec
from space_dist.errors import SpaceDistError
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.learner import make_learner
from space_dist.rollout import (
    Outcomes,
    Rollout,
    Setup,
    Shard,
    Stage,
    Trial,
    Worker,
    collect,
    evaluate,
)
from space_dist.rollout.policy import Actions, Head, MlpPolicy, Noise, Statistics, forward, from_arrays, to_arrays
from space_dist.rollout.walk import Walk
from space_dist.seeding import Purpose, episode_seeds, generator

POINTMASS = "space_dist/PointMass-v0"
CARTPOLE = "space_dist/CartPole-v0"
LOW, HIGH = np.array([-4.0, 0.5, 0.0]), np.array([4.0, 8.0, 4.0])


class Countdown:
    """Ends by itself after `length` steps, or is truncated after 5. Observes (length, steps so far), earns the step."""

    def __init__(self, n_slots: int) -> None:
        self.n_slots, self.horizon = n_slots, 5
        self.observation_space = spaces.Box(0.0, 100.0, shape=(2,), dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
        self.context_bounds = ContextBounds(("length",), np.array([1.0]), np.array([100.0]))
        self.length, self.time = np.zeros(n_slots), np.zeros(n_slots)
        self.ready = np.zeros(n_slots, dtype=np.bool_)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        assert len(slots) == len(contexts) == len(seeds)
        self.length[slots], self.time[slots], self.ready[slots] = contexts[:, 0], 0.0, True
        return self.observe()[slots]

    def step(self, actions: NDArray[np.generic]) -> Step:
        assert self.ready.all(), "an ended slot was not reset"
        assert (np.abs(actions.astype(np.float64)) <= 1.0).all()
        self.time += 1
        terminated, truncated = self.time >= self.length, self.time >= self.horizon
        self.ready = ~(terminated | truncated)
        return Step(self.observe(), self.time.copy(), terminated, truncated, None)

    def observe(self) -> Observations:
        return np.stack([self.length, self.time], axis=1).astype(np.float32)


def weights_for(
    observation_dim: int, outputs: int,
    *, discrete: bool = False, version: int = 0, seed: int = 0, bias: float = 0.0, bound: float = 1.0, hidden: int = 8,
) -> MlpPolicy:  # fmt: skip
    """A random network whose actions depend on what it sees; `bias` is added to its last output."""
    random = np.random.default_rng(seed)

    def layers(*sizes: int) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]:
        return tuple(
            (random.normal(0.0, 1.0, size=(n, m)).astype(np.float32), random.normal(size=m).astype(np.float32))
            for n, m in itertools.pairwise(sizes)
        )

    actor, critic = layers(observation_dim, hidden, outputs), layers(observation_dim, hidden, 1)
    actor[-1][1][-1] += np.float32(bias)
    low, high = np.full(outputs, -bound, dtype=np.float32), np.full(outputs, bound, dtype=np.float32)
    log_std = np.full(outputs, 0.3, dtype=np.float32)
    head = Head("categorical") if discrete else Head("gaussian", log_std, low, high)
    return MlpPolicy(version, "tanh", head, actor, (critic,))


def best(policy: MlpPolicy, observations: NDArray[np.float32]) -> Actions:
    return policy.head.best(policy.outputs(observations))


def falling(version: int = 0, seed: int = 0) -> MlpPolicy:
    """PointMass weights (context visible) that mostly fall onto the wall, but not always."""
    return weights_for(7, 2, version=version, seed=seed, bias=-2.0, bound=10.0)


def select(contexts: FloatArray, *, version: int = 0, ids: IntArray | None = None) -> Selection:
    return Selection(version, 100 + np.arange(len(contexts)) if ids is None else ids, contexts, 0)


def uniform(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(LOW, HIGH, size=(n, 3))


def setup_for(env_id: str = POINTMASS, *, context_visible: bool = True, **changes: Any) -> Setup:
    names = ("gate_x", "gate_width", "friction")
    setup = Setup(
        spec=read_spec(env_id, context_visible=context_visible), seed=3, gamma=0.9, shards=3, slots=4, slot_length=120,
        start_states=1, evaluation_episodes=1, train=InstanceSet(np.arange(10), uniform(10), names),
        test=InstanceSet(np.arange(5), uniform(5, seed=1), names),
    )  # fmt: skip
    return dataclasses.replace(setup, **changes)


def bits(answer: Shard | Outcomes) -> dict[str, Any]:
    """Everything in it, comparable with `==`, NaN included."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value.dtype.str, value.shape, value.tobytes()
        return {name: plain(item) for name, item in value.items()} if isinstance(value, dict) else value

    return plain(dataclasses.asdict(answer))


def falls(worker: Worker, *, round: int = 0, shard: int = 0, start: Walk | None = None) -> Shard:
    selection = select(uniform(6), version=4)
    walk = start or Walk(-1, ())
    return worker.collect(
        falling(version=round), selection, walk, round=round, steps=0, shard=shard, selection_version=4
    )


# ---- policies in NumPy ----


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("action_space", [spaces.Box(-0.7, 0.4, shape=(3,), dtype=np.float32), spaces.Discrete(5)])
@pytest.mark.parametrize("net_arch", [(), (16,), (32, 7, 12)])
def test_networks_equal_stable_baselines3s(
    activation: Any, action_space: spaces.Space[Any], net_arch: tuple[int, ...]
) -> None:
    space = spaces.Box(-np.inf, np.inf, shape=(6,), dtype=np.float32)
    config = PPOConfig(kind="ppo", activation=activation, net_arch=net_arch, log_std_init=-0.5)
    learner = make_learner(config, space, action_space, seed=0, n_slots=2, slot_length=4, total_steps=8)
    policy = learner.model.policy
    with torch.no_grad():  # far from their initial scale, biases included
        generator = torch.Generator().manual_seed(1)
        for parameter in policy.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.5)
    weights = learner.policy(7)
    assert isinstance(weights, MlpPolicy)
    assert weights.version == 7
    random = np.random.default_rng(2)
    observations = random.normal(0.0, 2.0, size=(500, 6)).astype(np.float32)
    tensor = torch.as_tensor(observations)
    with torch.no_grad():
        distribution = policy.get_distribution(tensor).distribution
        expected_values = policy.predict_values(tensor).numpy()[:, 0]
    np.testing.assert_allclose(weights.values(observations), expected_values, rtol=1e-5, atol=1e-5)
    outputs = forward(weights.actor, weights.activation, observations)
    executed = weights.head.executed(best(weights, observations))
    expected_best, _ = policy.predict(observations, deterministic=True)
    if isinstance(action_space, spaces.Box):
        np.testing.assert_allclose(outputs, distribution.mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(executed, expected_best, rtol=1e-5, atol=1e-5)
        noise = random.normal(size=(500, 3)).astype(np.float32)
        expected = distribution.mean + distribution.stddev * torch.as_tensor(noise)
        sampled = weights.head.sampled(outputs, Noise(noise[None], noise[None]), 0, np.arange(500))
        np.testing.assert_allclose(sampled, expected, rtol=1e-5, atol=1e-5)
    else:
        shifted = outputs - np.logaddexp.reduce(outputs, axis=1, keepdims=True)
        np.testing.assert_allclose(shifted, distribution.logits, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(executed, expected_best)


@pytest.mark.parametrize(("inputs", "outputs"), [(2, 2), (1, 1)])
def test_weights_are_a_copy_and_inputs_stay_untouched(inputs: int, outputs: int) -> None:
    space, actions = (spaces.Box(-1.0, 1.0, shape=(n,), dtype=np.float32) for n in (inputs, outputs))
    learner = make_learner(PPOConfig(kind="ppo"), space, actions, seed=0, n_slots=1, slot_length=4, total_steps=8)
    weights, observations = learner.policy(0), np.ones((3, inputs), dtype=np.float32)
    before = best(weights, observations), weights.values(observations)
    with torch.no_grad():
        for parameter in learner.model.policy.parameters():
            parameter.add_(1.0)
    np.testing.assert_array_equal(best(weights, observations), before[0])
    np.testing.assert_array_equal(weights.values(observations), before[1])
    np.testing.assert_array_equal(observations, 1.0)


@pytest.mark.parametrize("discrete", [False, True])
def test_a_policy_survives_being_arrays(discrete: bool) -> None:
    weights = weights_for(4, 3, discrete=discrete, version=9)
    again = from_arrays(*to_arrays(weights))
    observations = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
    assert (again.version, again.activation) == (9, "tanh")
    np.testing.assert_array_equal(best(again, observations), best(weights, observations))
    np.testing.assert_array_equal(again.values(observations), weights.values(observations))
    assert again.head.kind == weights.head.kind
    for name in ("log_std", "low", "high"):
        np.testing.assert_array_equal(getattr(again.head, name), getattr(weights.head, name))


def test_actions_are_clipped_as_stable_baselines3_clips_them() -> None:
    head = Head("gaussian", np.zeros(2, np.float32), np.float32([-1.0, -2.0]), np.float32([0.5, 4.0]))
    actions = np.float32([[-3.0, -3.0], [0.6, 4.5], [0.1, 0.2], [np.inf, -np.inf]])
    given = actions.copy()
    np.testing.assert_array_equal(
        head.executed(actions), np.float32([[-1.0, -2.0], [0.5, 4.0], [0.1, 0.2], [0.5, -2.0]])
    )
    np.testing.assert_array_equal(actions, given)
    head = Head("gaussian", np.zeros(2, np.float32), np.float32([-1.0, -1.0]), np.float32([2.0, 2.0]))
    alike = head.executed(actions)
    np.testing.assert_array_equal(alike, np.float32([[-1.0, -1.0], [0.6, 2.0], [0.1, 0.2], [2.0, -1.0]]))
    assert alike.dtype == np.float32
    np.testing.assert_array_equal(Head("categorical").executed(np.array([0, 2, 1])), [0, 2, 1])


def test_discrete_actions_are_drawn_from_the_softmax() -> None:
    env = make_batched("tests.tiny_env:make_discrete", 256, context_visible=True)
    weights = weights_for(2, 3, discrete=True)
    contexts = np.random.default_rng(0).uniform(-1.0, 1.0, size=(50, 1))
    (shard,) = collect(Stage(env), [Rollout(weights, select(contexts), 0, 0.9, seed=0, round=0, shard=0)], length=160)
    outputs = forward(weights.actor, weights.activation, shard.observations.reshape(-1, 2)).astype(np.float64)
    chances = np.exp(outputs - outputs.max(axis=1, keepdims=True))
    chances /= chances.sum(axis=1, keepdims=True)
    drawn = np.eye(3)[shard.actions.reshape(-1)]
    assert (np.ptp(chances, axis=0) > 0.05).all()  # chances that depend on what is seen
    assert np.ptp(chances) > 0.8
    # Given the past, drawn - chances has mean 0 and lies in an interval of length 1; so does its product with a
    # weight in [0, 1]. Azuma-Hoeffding: P(|mean| > b) <= 2 exp(-2 n b^2), here 1e-9 over all 12 tests together.
    bound = np.sqrt(np.log(2 * 12 / 1e-9) / (2 * len(drawn)))
    assert bound < 0.02
    for weight in (np.ones(len(drawn)), *chances.T):
        assert (np.abs((weight[:, None] * (drawn - chances)).mean(axis=0)) < bound).all()


# ---- collecting ----


def by_hand(lengths: list[float], *, start: int, length: int, slots: int = 2) -> Shard:
    contexts = np.array(lengths)[:, None]
    selection = select(contexts, ids=10 * np.arange(len(lengths)))
    rollout = Rollout(weights_for(2, 1), selection, start, gamma=0.5, seed=1, round=0, shard=0)
    return collect(Stage(Countdown(slots)), [rollout], length=length)[0]


def test_the_walk_by_hand() -> None:
    # Instances 0, 10, 20 live 2, 3 and 9 steps (the last is truncated after 5); the walk starts at instance 10.
    #   time    0  1  2  3  4  5  6  7
    #   slot 0  10 10 10  0  0 10 10 10
    #   slot 1  20 20 20 20 20 20 20 20
    # Slot 0 takes 0 at t = 3 (3-4); both slots end at t = 4 and take 10 and 20 in slot order; 20 runs on.
    shard = by_hand([2.0, 3.0, 9.0], start=1, length=8)
    episodes = shard.episodes
    assert episodes.ids.tolist() == [10, 0, 20, 10]
    assert episodes.contexts.tolist() == [[3.0], [2.0], [9.0], [3.0]]
    assert episodes.slots.tolist() == [0, 0, 1, 0]
    assert episodes.times.tolist() == [2, 4, 4, 7]
    assert episodes.lengths.tolist() == [3, 2, 5, 3]
    assert episodes.returns.tolist() == [6.0, 3.0, 15.0, 6.0]
    # 1 + 2/2 + 3/4 = 2.75; 1 + 2/2 = 2; ... + 4/8 + 5/16 = 3.5625
    assert episodes.discounted_returns.tolist() == [2.75, 2.0, 3.5625, 2.75]
    assert np.isnan(episodes.success).all()
    assert shard.begun == 5
    assert shard.starts.all()
    assert [shard.terminated[4, 0], shard.truncated[4, 1], shard.terminated[7, 0]] == [True] * 3
    left = shard.unfinished
    assert (left.ids.tolist(), left.contexts.tolist(), left.lengths.tolist()) == ([0, 20], [[0.0], [9.0]], [0, 3])
    assert (left.returns.tolist(), left.discounted_returns.tolist(), left.discounts.tolist()) == (
        [0.0, 6.0], [0.0, 2.75], [0.0, 0.125]
    )  # fmt: skip
    assert left.seeds.tolist() == [0, int(episode_seeds(1, Purpose.EPISODES, 0, 0, count=16)[4])]
    np.testing.assert_array_equal(left.actions[:, 1], np.clip(shard.actions[5:, 1], -1.0, 1.0))
    assert not left.actions[:, 0].any()
    assert shard.observations[:, 0].tolist() == [[3, 0], [3, 1], [3, 2], [2, 0], [2, 1], [3, 0], [3, 1], [3, 2]]
    assert shard.observations[:, 1].tolist() == [[9, 0], [9, 1], [9, 2], [9, 3], [9, 4], [9, 0], [9, 1], [9, 2]]
    assert shard.last_observations.tolist() == [[3, 3], [9, 3]]
    assert shard.truncated_observations.tolist() == [[9, 5]]


def test_slots_that_end_together_take_the_next_instances_in_slot_order() -> None:
    # Lives 1, 2, 2, 5: slots 0-2 start with 0, 10, 20; slot 0 takes 30 at t = 1; slots 1 and 2 take 0 and 10 at t = 2.
    shard = by_hand([1.0, 2.0, 2.0, 5.0], start=0, length=4, slots=3)
    episodes = shard.episodes
    assert shard.unfinished.ids.tolist() == [30, 20, 0]
    # Slot 1 (0 lived one step) takes 20 at t = 3, which runs on, as 30 does.
    assert episodes.ids.tolist() == [0, 10, 20, 0, 10]
    assert episodes.slots.tolist() == [0, 1, 2, 1, 2]
    assert episodes.times.tolist() == [0, 1, 1, 2, 3]


def test_what_ends_at_the_last_step_is_not_unfinished() -> None:
    # Both live exactly to the round's last step: one by itself (a terminated step is never truncated too), one not.
    shard = by_hand([5.0, 9.0], start=0, length=5)
    assert (shard.episodes.lengths.tolist(), shard.unfinished.lengths.tolist()) == ([5, 5], [0, 0])
    assert shard.unfinished.actions.shape == (0, 2, 1)
    assert not (shard.terminated & shard.truncated).any()
    assert shard.truncated_observations.tolist() == [[9, 5]]


def test_truncated_observations_stand_in_the_order_of_argwhere() -> None:
    # Slot 0 is truncated at t = 4; slot 1 lives 2 steps first, so it is truncated at t = 6; slot 2 with slot 0.
    shard = by_hand([50.0, 2.0, 60.0, 70.0], start=0, length=9, slots=3)
    assert np.argwhere(shard.truncated).tolist() == [[4, 0], [4, 2], [6, 1]]
    assert shard.truncated_observations.tolist() == [[50, 5], [60, 5], [70, 5]]


def test_a_shards_table_tells_what_its_arrays_hold() -> None:
    length, slots, gamma = 230, 16, 0.9
    env = make_batched(POINTMASS, slots, context_visible=True)
    contexts = uniform(7)
    selection = dataclasses.replace(select(contexts, version=3), order_version=2)
    rollout = Rollout(falling(version=5), selection, 4, gamma, seed=2, round=5, shard=1)
    (shard,) = collect(Stage(env), [rollout], length=length)
    assert (shard.shard, shard.round, shard.policy_version, shard.selection_version, shard.order_version) == (
        1, 5, 5, 3, 2
    )  # fmt: skip
    assert shard.observations.shape == (length, slots, 7)
    assert shard.observations.dtype == np.float32
    assert shard.actions.shape == (length, slots, 2)
    assert shard.rewards.shape == shard.terminated.shape == shard.truncated.shape == (length, slots)
    assert shard.last_observations.shape == (slots, 7)
    assert not (shard.terminated & shard.truncated).any()

    ended = shard.terminated | shard.truncated
    begun, found = [], []
    for slot in range(slots):
        begin = 0
        for time in range(length):
            if ended[time, slot] or time == length - 1:
                begun.append((begin, slot))
                if ended[time, slot]:
                    found.append((time, slot, begin))
                begin = time + 1
    begun.sort()  # episodes begin in the order of time, and of slots within a step
    found.sort()  # and are told as they end
    episodes = shard.episodes
    assert list(zip(episodes.times, episodes.slots, strict=True)) == [one[:2] for one in found]
    assert episodes.lengths.tolist() == [time + 1 - begin for time, _, begin in found]
    assert shard.begun == len(begun) == len(episodes) + (~ended[-1]).sum()
    assert episodes.lengths.sum() + shard.unfinished.lengths.sum() == length * slots
    assert episodes.lengths.max() == 100
    assert shard.terminated.any()
    assert shard.truncated.any()

    order = {one: (4 + place) % 7 for place, one in enumerate(begun)}
    scaled = 2.0 * (contexts - LOW) / (HIGH - LOW) - 1.0
    for row, (time, slot, begin) in enumerate(found):
        mine, steps, place = (slice(begin, time + 1), slot), time + 1 - begin, order[begin, slot]
        assert episodes.ids[row] == selection.ids[place]
        np.testing.assert_array_equal(episodes.contexts[row], contexts[place])
        rewards = shard.rewards[mine]
        assert episodes.returns[row] == pytest.approx(rewards.sum(), rel=1e-12)
        assert episodes.discounted_returns[row] == pytest.approx((gamma ** np.arange(steps) * rewards).sum(), rel=1e-12)
        np.testing.assert_array_equal(shard.observations[begin, slot, :4], [0, 0, 3, 0])  # a fresh reset
        np.testing.assert_allclose(shard.observations[mine][:, 4:], np.tile(scaled[place], (steps, 1)), rtol=1e-6)
        if shard.truncated[time, slot]:  # rewards are those of where the step led
            behind = shard.truncated_observations[np.argwhere(shard.truncated).tolist().index([time, slot])]
            distance = np.hypot(behind[0], behind[2] + 3.0)
            assert rewards[-1] == pytest.approx(np.exp(-0.6 * distance), rel=1e-5)
            assert episodes.success[row] == (distance < 0.25)


def test_a_shard_replays_by_hand_from_its_seeds() -> None:
    # Every episode, flown by the registered environment with the recorded actions, clipped, and the stated seed.
    length, slots, seed = 110, 3, 6
    env = make_batched(POINTMASS, slots, context_visible=True)
    weights, selection = falling(version=2), select(uniform(4))
    (told,) = collect(Stage(env), [Rollout(weights, selection, 0, 0.9, seed=seed, round=2, shard=1)], length=length)
    seeds = episode_seeds(seed, Purpose.EPISODES, 2, 1, count=slots * length)
    single = ContextObservation(gym.make(POINTMASS))
    starts = np.concatenate([told.starts[None], (told.terminated | told.truncated)[:-1]])
    for row, (begin, slot) in enumerate(np.argwhere(starts)):
        observation, _ = single.reset(seed=int(seeds[row]), options={"context": selection.contexts[row % 4]})
        for time in range(begin, length):
            if time > begin and starts[time, slot]:
                break
            np.testing.assert_array_equal(told.observations[time, slot], observation)
            observation, reward, *_ = single.step(np.clip(told.actions[time, slot], -10.0, 10.0))
            assert told.rewards[time, slot] == reward
    # Actions are the policy's, with the stated noise.
    noise = generator(seed, Purpose.ACTIONS, 2, 1).standard_normal((length, slots, 2), dtype=np.float32)
    means = forward(weights.actor, "tanh", told.observations.reshape(-1, 7)).reshape(length, slots, 2)
    np.testing.assert_allclose(told.actions, means + np.exp(weights.head.log_std) * noise, rtol=1e-5, atol=1e-5)


def test_a_shard_is_a_pure_function_of_what_was_asked() -> None:
    setup = setup_for()
    worker = Worker(setup)
    first = bits(falls(worker))
    assert bits(falls(worker)) == first
    falls(worker, round=1, shard=2)
    worker.evaluate(falling(seed=4), "test", 0)
    worker.start_values(falling(seed=4), 0)
    np.random.seed(0)  # noqa: NPY002 - the global generator must play no part
    assert bits(falls(worker)) == first
    assert bits(falls(Worker(setup))) == first


@pytest.mark.parametrize(
    "other",
    [
        lambda: falls(Worker(setup_for()), round=1),
        lambda: falls(Worker(setup_for()), shard=1, start=Walk(0, (0, 0, 0))),
        lambda: falls(Worker(setup_for(seed=4))),
    ],
    ids=["round", "shard", "seed"],
)
def test_another_round_shard_or_seed_gives_other_noise(other: Callable[[], Shard]) -> None:
    first, second = falls(Worker(setup_for())), other()
    same_start = first.observations[0] == second.observations[0]  # and so the same instances
    assert same_start.all()
    assert not (first.actions[0] == second.actions[0]).any()
    assert not (first.observations[1, :, 0] == second.observations[1, :, 0]).any()


def test_where_shards_walk() -> None:
    selection = select(uniform(6))
    fresh = Walk(-1, ())
    assert [fresh.position(selection, shard, 3) for shard in range(3)] == [0, 2, 4]
    assert [fresh.position(selection, shard, 4) for shard in range(4)] == [0, 1, 3, 4]
    assert [fresh.position(select(uniform(2)), shard, 4) for shard in range(4)] == [0, 0, 1, 1]
    going_on = Walk(0, (5, 7, 1))
    assert [going_on.position(selection, shard, 3) for shard in range(3)] == [5, 1, 1]
    new_order = dataclasses.replace(selection, order_version=1)
    assert [going_on.position(new_order, shard, 3) for shard in range(3)] == [0, 2, 4]
    shard = falls(Worker(setup_for()), shard=2, start=Walk(0, (0, 0, 3)))
    scaled = 2.0 * (selection.contexts[[3, 4, 5, 0]] - LOW) / (HIGH - LOW) - 1.0
    np.testing.assert_allclose(shard.observations[0, :, 4:], scaled, rtol=1e-6)


@pytest.mark.parametrize(("selection_version", "weights_version"), [(3, 0), (5, 0), (4, 1)])
def test_a_version_that_was_not_asked_for_is_refused(selection_version: int, weights_version: int) -> None:
    selection = select(uniform(6), version=4)
    with pytest.raises(RuntimeError, match=f"selection {selection_version} "):
        Worker(setup_for()).collect(
            falling(version=weights_version), selection, Walk(-1, ()),
            round=0, steps=0, shard=0, selection_version=selection_version,
        )  # fmt: skip


# ---- side by side ----


def same(one: object, other: object) -> bool:
    """Equal to the last bit: two dataclasses of arrays, numbers and such dataclasses."""
    for field in dataclasses.fields(one):  # type: ignore[arg-type]
        left, right = getattr(one, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(left):
            equal = same(left, right)
        elif isinstance(left, np.ndarray):
            equal = left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()
        else:
            equal = left == right
        if not equal:
            return False
    return True


def several(env_id: str, *, normalised: bool = False) -> list[MlpPolicy]:
    space = make_batched(env_id, 1, context_visible=True)
    size, n_actions = space.observation_space.shape[0], 2  # type: ignore[index]
    policies = []
    for seed in range(5):
        policy = weights_for(size, n_actions, discrete=env_id == CARTPOLE, seed=seed)
        scales = np.random.default_rng(seed)
        statistics = Statistics(scales.normal(size=size), scales.uniform(0.5, 2.0, size=size), 1.5)
        policies.append(dataclasses.replace(policy, version=seed, statistics=statistics) if normalised
                        else dataclasses.replace(policy, version=seed))  # fmt: skip
    return policies


@pytest.mark.parametrize(("env_id", "normalised"), [(POINTMASS, False), (POINTMASS, True), (CARTPOLE, False)])
@pytest.mark.parametrize("slots", [1, 3, 16])
def test_a_shard_is_the_same_whoever_is_collected_beside_it(env_id: str, normalised: bool, slots: int) -> None:
    bounds = make_batched(env_id, 1, context_visible=True).context_bounds
    rollouts = []
    for seed, policy in enumerate(several(env_id, normalised=normalised)):
        contexts = np.random.default_rng(seed).uniform(bounds.low, bounds.high, size=(seed + 1, len(bounds.names)))
        selection = select(contexts, version=seed)
        rollouts.append(
            Rollout(policy, selection, seed, 0.9 + seed / 100, seed=seed, round=policy.version, shard=seed % 2)
        )
    length = make_batched(env_id, 1, context_visible=True).horizon + 7
    alone = [
        collect(Stage(make_batched(env_id, slots, context_visible=True)), [one], length=length)[0] for one in rollouts
    ]
    for chosen in ([0, 1, 2, 3, 4], [4, 2], [3, 0, 1]):
        env = make_batched(env_id, slots * len(chosen), context_visible=True)
        together = collect(Stage(env), [rollouts[index] for index in chosen], length=length)
        assert all(same(shard, alone[index]) for shard, index in zip(together, chosen, strict=True))
    assert not same(alone[0].episodes, alone[1].episodes)


@pytest.mark.parametrize(("env_id", "normalised"), [(POINTMASS, False), (POINTMASS, True), (CARTPOLE, False)])
@pytest.mark.parametrize("noisy", [False, True])
def test_outcomes_are_the_same_whatever_is_measured_beside_them(env_id: str, normalised: bool, noisy: bool) -> None:
    bounds = make_batched(env_id, 1, context_visible=True).context_bounds

    def trials() -> list[Trial]:
        made = []
        for seed, policy in enumerate(several(env_id, normalised=normalised)):
            random = np.random.default_rng(seed)
            contexts = random.uniform(bounds.low, bounds.high, size=(7, len(bounds.names)))
            seeds = random.integers(1 << 62, size=7).astype(np.uint64)
            noise = functools.partial(np.random.default_rng, seed)
            made.append(Trial(policy, contexts, seeds, 0.9 + seed / 100, noise if noisy else None))
        return made

    alone = [evaluate(make_batched(env_id, 7, context_visible=True), [trial])[0] for trial in trials()]
    for chosen in ([0, 1, 2, 3, 4], [4, 2], [3, 0, 1]):
        env, again = make_batched(env_id, 7 * len(chosen), context_visible=True), trials()
        together = evaluate(env, [again[index] for index in chosen])
        assert all(same(outcomes, alone[index]) for outcomes, index in zip(together, chosen, strict=True))
    assert not same(alone[0], alone[1])
    for slots in (1, 4, 34):  # fewer than episodes: the next begins where one has ended
        in_turns = evaluate(make_batched(env_id, slots, context_visible=True), trials())
        assert all(same(outcomes, expected) for outcomes, expected in zip(in_turns, alone, strict=True))


class Unpunctual(Countdown):
    """Ends its episodes, but two steps behind its horizon."""

    made = 0

    def __init__(self, n_slots: int) -> None:
        super().__init__(n_slots)
        self.horizon -= 2

    def step(self, actions: NDArray[np.generic]) -> Step:
        self.made += 1
        step = super().step(actions)
        late = self.time >= self.horizon + 2
        self.ready = ~(step.terminated | late)
        return dataclasses.replace(step, truncated=late)


def test_an_episode_beyond_the_horizon_is_noticed_at_its_step() -> None:
    env = Unpunctual(2)
    slot, policy = Stage(env), weights_for(2, 1)  # type: ignore[arg-type]
    rollout = Rollout(policy, select(np.array([[2.0], [100.0]])), 0, 0.9, seed=0, round=0, shard=0)
    with pytest.raises(SpaceDistError, match="after its horizon of 3 steps, neither terminated nor truncated"):
        collect(slot, [rollout], length=40)
    assert env.made == 3
    (shard,) = collect(slot, [rollout], length=2)  # and where it has run since the round before
    again = dataclasses.replace(rollout, round=1, unfinished=shard.unfinished)
    with pytest.raises(SpaceDistError, match="after its horizon of 3 steps"):
        collect(slot, [dataclasses.replace(again, policy=dataclasses.replace(policy, version=1))], length=40)
    assert env.made == 3 + 2 + 1


def test_an_episode_beyond_the_horizon_is_noticed_where_it_is_measured_after_others() -> None:
    env, seeds = Unpunctual(1), np.arange(3, dtype=np.uint64)
    trial = Trial(weights_for(2, 1), np.array([[2.0], [1.0], [100.0]]), seeds, 0.9)
    with pytest.raises(SpaceDistError, match="after its horizon of 3 steps"):
        evaluate(env, [trial])  # type: ignore[arg-type]
    assert env.made == 2 + 1 + 3


def test_only_equals_act_side_by_side() -> None:
    env = make_batched(POINTMASS, 4, context_visible=True)
    size = env.observation_space.shape[0]  # type: ignore[index]
    one, other = weights_for(size, 2), weights_for(size, 2, hidden=9)
    rollouts = [Rollout(policy, select(uniform(3)), 0, 0.9, seed=0, round=0, shard=0) for policy in (one, other)]
    with pytest.raises(TypeError, match="one shape"):
        collect(Stage(env), rollouts, length=5)
