"""DQN, SAC and TD3 against Stable-Baselines3's own: the same updates, the same buffers, the same exploration."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv

from space_dist.config import DQNConfig, SACConfig, TD3Config
from space_dist.curricula import Selection
from space_dist.learner import OffPolicyLearner, make_learner
from space_dist.learner.interface import _seeded
from space_dist.rollout import Setup, Shard, Worker
from space_dist.rollout.policy import Exploration, Head, MlpPolicy, Noise
from space_dist.rollout.walk import Walk
from space_dist.seeding import Purpose, generator
from tests.test_learner import bits, hand_made
from tests.test_rollout import setup_for

KINDS = ("dqn", "sac", "td3")
CONFIGS: dict[str, Any] = {"dqn": DQNConfig, "sac": SACConfig, "td3": TD3Config}
OBSERVED = spaces.Box(-5.0, 5.0, shape=(3,), dtype=np.float32)
LOW, HIGH = np.float32([-2.0, 0.5]), np.float32([1.0, 4.0])
STEPS, ROUND = 600, 20  # of the stream; transitions per round
SEED = 11


def action_space(kind: str) -> spaces.Space[Any]:
    return spaces.Discrete(4) if kind == "dqn" else spaces.Box(LOW, HIGH)


def learner_for(kind: str, **changes: Any) -> Any:
    settings: dict[str, Any] = {
        "kind": kind, "n_steps": ROUND, "net_arch": (12, 7), "batch_size": 8, "buffer_size": 256, "learning_starts": 50,
        "gradient_steps_per_step": 0.5, "learning_rate": 3e-3, "gamma": 0.9,
    }  # fmt: skip
    settings |= {"target_update_interval": 30, "tau": 0.5} if kind == "dqn" else {}
    return make_learner(
        CONFIGS[kind](**(settings | changes)), OBSERVED, action_space(kind),
        seed=SEED, n_slots=1, slot_length=ROUND, total_steps=STEPS,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Stream:
    """Transitions in the order of a replay buffer; ends are what the environment says."""

    observations: NDArray[np.float32]
    following: NDArray[np.float32]
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


def stream_for(kind: str, steps: int = STEPS) -> Stream:
    random = np.random.default_rng(5)
    shown = random.normal(size=(2 * steps + 1, 3)).astype(np.float32)
    terminated, truncated = random.random(steps) < 0.05, random.random(steps) < 0.05
    truncated &= ~terminated
    assert terminated.sum() > 10
    assert truncated.sum() > 10
    # Behind a step stands the next step's observation, or one that is never seen again where an episode ended.
    ended = terminated | truncated
    observations = shown[:steps]
    following = np.where(ended[:, None], shown[steps + 1 :], shown[1 : steps + 1])
    if kind == "dqn":
        actions: NDArray[Any] = random.integers(0, 4, size=steps)
    else:
        actions = random.uniform(-1.0, 1.0, size=(steps, 2)).astype(np.float32)
    return Stream(observations, following, actions, random.normal(size=steps), terminated, truncated)


def rounds_of(stream: Stream, *, shards: int = 2, slots: int = 2, size: int = ROUND) -> list[list[Shard]]:
    """The stream as rounds of shards: time, then slots, then shards make its order."""
    rounds = []
    for first in range(0, len(stream.rewards), size):
        parts = []
        for shard in range(shards):
            begin = first + shard * (size // shards)

            def cut(array: NDArray[Any], begin: int = begin) -> NDArray[Any]:
                mine = array[begin : begin + size // shards]
                return mine.reshape(-1, slots, *array.shape[1:])

            made = hand_made(cut(stream.rewards), cut(stream.terminated), cut(stream.truncated), shard=shard)
            shown = {"observations": cut(stream.observations), "next_observations": cut(stream.following)}
            parts.append(dataclasses.replace(made, actions=cut(stream.actions), **shown))
        rounds.append(parts)
    return rounds


def learn(learner: OffPolicyLearner, rounds: list[list[Shard]], first: int = 0) -> list[Any]:
    size = sum(shard.steps for shard in rounds[0])
    return [
        learner.update(shards, round=number, steps=(number + 1) * size)
        for number, shards in enumerate(rounds)
        if number >= first
    ]


class Recorded(gym.Env[Any, Any]):
    """Shows the stream, whatever is done."""

    def __init__(self, stream: Stream, space: spaces.Space[Any]) -> None:
        self.stream, self.time = stream, 0
        self.observation_space, self.action_space = OBSERVED, space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        return self.stream.observations[min(self.time, STEPS - 1)], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        at, stream = self.time, self.stream
        self.time += 1
        ends = bool(stream.terminated[at]), bool(stream.truncated[at])
        return stream.following[at], float(stream.rewards[at]), *ends, {}


BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def stable_baselines3(kind: str, learner: Any, stream: Stream) -> Any:
    """SB3's own `learn` on the stream, from the learner's initial networks, with the learner's random numbers."""
    config = learner._settings
    rate = (lambda left: config.learning_rate * left) if config.learning_rate_schedule == "linear" else 3e-3
    own = {"target_update_interval": 30} if kind == "dqn" else {}
    model: Any = {"dqn": DQN, "sac": SAC, "td3": TD3}[kind](
        "MlpPolicy", DummyVecEnv([lambda: Recorded(stream, action_space(kind))]), learning_rate=rate,
        buffer_size=256, learning_starts=50, batch_size=8, tau=config.tau, gamma=0.9, train_freq=(ROUND, "step"),
        gradient_steps=ROUND // 2, policy_kwargs={"net_arch": [12, 7]}, device="cpu", **own,
    )  # fmt: skip
    model.policy.load_state_dict(learner.model.policy.state_dict())
    train, executed = model.train, 0

    def sample_action(*_: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        nonlocal executed
        action = stream.actions[executed : executed + 1]
        executed += 1
        return (action if kind == "dqn" else model.policy.unscale_action(action)), action

    def train_seeded(**arguments: Any) -> None:
        with _seeded(SEED, Purpose.UPDATE, model.num_timesteps // ROUND - 1):
            train(**arguments)

    model._sample_action, model.train = sample_action, train_seeded
    model.set_logger(Logger(folder=None, output_formats=[]))  # else it makes a folder
    model.learn(STEPS)
    return model


@pytest.mark.parametrize("schedule", ["constant", "linear"])
@pytest.mark.parametrize("kind", KINDS)
def test_updates_equal_stable_baselines3s_own_learning(kind: str, schedule: str) -> None:
    stream = stream_for(kind)
    learner = learner_for(kind, learning_rate_schedule=schedule)
    model = stable_baselines3(kind, learner, stream)
    updates = learn(learner, rounds_of(stream))
    steps = [update.gradient_steps for update in updates]
    assert steps == [0, 0] + [10] * 28  # 20 and 40 transitions are not more than learning_starts = 50
    assert model._n_updates == learner.model._n_updates == 280
    ours, theirs = learner.model.policy.state_dict(), model.policy.state_dict()
    assert list(ours) == list(theirs)
    for name, tensor in ours.items():
        assert torch.equal(tensor, theirs[name]), name
    initial = learner_for(kind).model.policy.state_dict()
    assert not any(torch.equal(tensor, initial[name]) for name, tensor in ours.items())
    if kind == "sac":
        assert torch.equal(learner.model.log_ent_coef, model.log_ent_coef)
        assert float(model.log_ent_coef.detach()) != 0.0
    for name in BUFFER:
        np.testing.assert_array_equal(
            getattr(learner.model.replay_buffer, name), getattr(model.replay_buffer, name), err_msg=name
        )
    assert (learner.model.replay_buffer.pos, learner.model.replay_buffer.full) == (STEPS % 256, True)
    assert (model.replay_buffer.pos, model.replay_buffer.full) == (STEPS % 256, True)
    if kind == "dqn":
        assert learner.model.exploration_rate == model.exploration_rate
        logged = ["exploration_rate" in update.metrics for update in updates]
        assert logged == [False, False] + [True] * 28  # before learning starts no action hangs on it
    rates = {group["lr"] for one in learner._optimizers().values() for group in one.param_groups}
    assert rates == {0.0 if schedule == "linear" else 3e-3}


def test_ends_matter_to_what_is_learnt() -> None:
    # Else the equality above would say nothing about timeouts and terminations.
    stream = stream_for("dqn")
    none = np.zeros(STEPS, dtype=np.bool_)
    variants = [
        stream,
        dataclasses.replace(stream, truncated=none),  # cut by nothing: as a timeout, nothing ends
        dataclasses.replace(stream, terminated=none),
        dataclasses.replace(stream, terminated=stream.terminated | stream.truncated, truncated=none),
    ]
    states = []
    for variant in variants:
        learner = learner_for("dqn")
        learn(learner, rounds_of(variant))
        states.append(bits(learner))
    assert states[0] == states[1]
    assert states[0] != states[2]
    assert states[0] != states[3]


@pytest.mark.parametrize("kind", KINDS)
def test_the_ratio_of_gradient_steps_holds_over_rounds(kind: str) -> None:
    learner = learner_for(kind, gradient_steps_per_step=0.13, learning_starts=0)
    steps = [update.gradient_steps for update in learn(learner, rounds_of(stream_for(kind)))]
    assert set(steps) == {2, 3}
    assert sum(steps) == 78  # 600 * 0.13


# ---- the replay buffer ----


def buffer_of(learner: Any) -> dict[str, Any]:
    buffer = learner.model.replay_buffer
    return {name: getattr(buffer, name).tobytes() for name in BUFFER} | {"pos": buffer.pos, "full": buffer.full}


@pytest.mark.parametrize("capacity", [1, 7, ROUND - 1, ROUND, 33, 599, 600, 601])
@pytest.mark.parametrize("kind", ["dqn", "sac"])
def test_the_ring_is_stable_baselines3s(kind: str, capacity: int) -> None:
    stream = stream_for(kind)
    learner = learner_for(kind, buffer_size=capacity, learning_starts=10_000)
    oracle = ReplayBuffer(capacity, OBSERVED, action_space(kind))
    for number, shards in enumerate(rounds_of(stream)):
        learner.update(shards, round=number, steps=(number + 1) * ROUND)
        for at in range(number * ROUND, (number + 1) * ROUND):
            done = np.array([stream.terminated[at] | stream.truncated[at]])
            oracle.add(
                stream.observations[at], stream.following[at], stream.actions[at], stream.rewards[at, None], done,
                [{"TimeLimit.truncated": bool(stream.truncated[at])}],
            )  # fmt: skip
        assert (learner.model.replay_buffer.pos, learner.model.replay_buffer.full) == (oracle.pos, oracle.full)
        for name in BUFFER:
            ours, theirs = getattr(learner.model.replay_buffer, name), getattr(oracle, name)
            assert ours.dtype == theirs.dtype, name
            np.testing.assert_array_equal(ours, theirs, err_msg=name)
    assert (learner.seen, learner.capacity) == (STEPS, capacity)


@pytest.mark.parametrize(  # the ring is the same for all kinds
    ("kind", "capacity"),
    [("dqn", 7), ("dqn", 33), ("dqn", 256), ("dqn", 1000), ("sac", 7), ("sac", 256), ("td3", 33), ("td3", 1000)],
)
def test_pieces_restore_the_buffer_and_all_that_follows(kind: str, capacity: int) -> None:
    rounds = rounds_of(stream_for(kind))
    learner = learner_for(kind, buffer_size=capacity)
    pieces = []
    stored = 0
    for number, shards in enumerate(rounds[:20]):
        learner.update(shards, round=number, steps=(number + 1) * ROUND)
        if number in (2, 3, 9, 19):  # seldom enough for the ring to overtake what was stored
            first = max(stored, learner.seen - learner.capacity)
            piece = learner.transitions(stored)
            assert len(piece["rewards"]) == learner.seen - first
            pieces.append((first, piece))
            stored = learner.seen
    saved = learner.save()
    again = learner_for(kind, buffer_size=capacity)
    again.load(*saved)
    remembered = learner.seen - learner.capacity
    for first, piece in pieces:
        if first + len(piece["rewards"]) > remembered:
            again.remember(piece, first)
    assert buffer_of(again) == buffer_of(learner)
    assert again.seen == learner.seen
    expected = learn(learner, rounds[:25], first=20)
    assert learn(again, rounds[:25], first=20) == expected
    assert sum(update.gradient_steps for update in expected) == 50
    assert buffer_of(again) == buffer_of(learner)
    for name, array in learner.save()[0].items():
        np.testing.assert_array_equal(again.save()[0][name], array, err_msg=name)


def test_transitions_are_a_copy() -> None:
    rounds = rounds_of(stream_for("sac"))
    learner = learner_for("sac", buffer_size=30, learning_starts=10_000)
    learn(learner, rounds[:1])
    piece = learner.transitions(0)
    before = {name: array.copy() for name, array in piece.items()}
    learn(learner, rounds[:3], first=1)
    for name, array in piece.items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


# ---- exploration ----


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.37, 1.0])
def test_epsilon_falls_as_stable_baselines3s(fraction: float) -> None:
    total = 1000
    learner = make_learner(
        DQNConfig(kind="dqn", exploration_fraction=fraction, exploration_initial_eps=0.9, exploration_final_eps=0.07),
        OBSERVED, spaces.Discrete(4), seed=0, n_slots=1, slot_length=8, total_steps=total,
    )  # fmt: skip
    told = learner.policy(0).head.exploration.epsilon(np.arange(1, total + 1))
    schedule = LinearSchedule(0.9, 0.07, fraction)
    # SB3 acts in step t (from 0) with the epsilon it set behind step t - 1, from the share of the run left there.
    expected = [schedule(1.0 - step / total) for step in range(1, total + 1)]
    np.testing.assert_allclose(told, expected, rtol=1e-12)
    assert told[-1] == pytest.approx(0.07)


def worker_for(kind: str, *, shards: int = 3, slots: int = 4, length: int = 16) -> tuple[Setup, Worker]:
    env_id = "tests.tiny_env:make_discrete" if kind == "dqn" else "tests.tiny_env:make"
    setup = dataclasses.replace(
        setup_for(env_id), shards=shards, slots=slots, slot_length=length, keep_next_observations=True
    )
    return setup, Worker(setup)


def selection() -> Selection:
    return Selection(0, np.arange(5), np.random.default_rng(0).uniform(-1.0, 1.0, size=(5, 1)), 0)


def collected(kind: str, head: Head, before: int) -> tuple[list[Shard], list[Noise], MlpPolicy]:
    """A round that begins after `before` steps, the numbers its shards drew, and the policy."""
    setup, worker = worker_for(kind)
    random = np.random.default_rng(1)
    outputs = {"greedy": 3, "squashed": 2, "deterministic": 1}[head.kind]
    layer = random.normal(size=(2, outputs)).astype(np.float32), random.normal(size=outputs).astype(np.float32)
    policy = MlpPolicy(4, "relu", head, (layer,), ())
    asked = {"round": 4, "steps": before, "selection_version": 0}
    shards = [worker.collect(policy, selection(), Walk(-1, ()), shard=shard, **asked) for shard in range(setup.shards)]
    space = setup.spec.action_space
    noise = [Noise.draw(head, space, generator(setup.seed, Purpose.ACTIONS, 4, shard), (16, 4)) for shard in range(3)]
    return shards, noise, policy


def step_numbers(before: int, shard: int) -> NDArray[np.int64]:
    """(16, 4) the environment step of each of a shard's transitions, in the order of a replay buffer."""
    return before + shard * 64 + np.arange(64).reshape(16, 4)


@pytest.mark.parametrize("before", [0, 100, 10_000])
def test_dqn_explores_by_the_step(before: int) -> None:
    exploration = Exploration(learning_starts=before + 85, epsilon_initial=0.9, epsilon_final=0.1, decay_steps=200.0)
    shards, noise, policy = collected("dqn", Head("greedy", exploration=exploration), before)
    random_ones = greedy_ones = 0
    for shard, drawn in zip(shards, noise, strict=True):
        steps = step_numbers(before, shard.shard)
        outputs = policy.outputs(shard.observations.reshape(-1, 2)).reshape(16, 4, 3)
        epsilon = np.maximum(0.1, 0.9 - 0.8 * np.minimum(steps / 200.0, 1.0))
        explores = (steps < before + 85) | (drawn.uniform[..., 0] < epsilon)
        expected = np.where(explores, np.floor(drawn.uniform[..., 1] * 3), outputs.argmax(axis=2))
        np.testing.assert_array_equal(shard.actions, expected)
        random_ones += int(explores.sum())
        greedy_ones += int((~explores).sum())
    assert random_ones > 85
    assert greedy_ones > 20
    # Uniform ones: 85 draws of 3, each action's count is binomial (mean 28, standard deviation 4.3).
    warmup = np.concatenate([shard.actions.reshape(-1) for shard in shards])[:85]
    assert np.bincount(warmup, minlength=3).min() > 10


BOUNDED = {"low": LOW[:1], "high": HIGH[:1]}


def test_td3_clips_its_noise_and_starts_at_random() -> None:
    before, learning_starts = 40, 130
    head = Head("deterministic", exploration=Exploration(learning_starts, noise_std=2.0), **BOUNDED)
    shards, noise, policy = collected("td3", head, before)
    clipped = inside = 0
    for shard, drawn in zip(shards, noise, strict=True):
        early = step_numbers(before, shard.shard)[..., None] < learning_starts
        outputs = policy.outputs(shard.observations.reshape(-1, 2)).reshape(16, 4, 1)
        acting = np.tanh(outputs) + 2.0 * drawn.drawn
        expected = np.where(early, 2.0 * drawn.uniform - 1.0, np.clip(acting, -1.0, 1.0))
        np.testing.assert_allclose(shard.actions, expected, rtol=1e-5, atol=1e-6)
        assert shard.actions.dtype == np.float32
        clipped += int((np.abs(shard.actions) == 1.0).sum())
        inside += int((~early & (np.abs(shard.actions) < 1.0)).sum())
    assert clipped > 20
    assert inside > 20


def test_sac_starts_at_random_and_then_samples() -> None:
    head = Head("squashed", exploration=Exploration(130), **BOUNDED)
    shards, noise, policy = collected("sac", head, 40)
    for shard, drawn in zip(shards, noise, strict=True):
        early = step_numbers(40, shard.shard)[..., None] < 130
        outputs = policy.outputs(shard.observations.reshape(-1, 2)).reshape(16, 4, 2)
        acting = np.tanh(outputs[..., :1] + np.exp(np.clip(outputs[..., 1:], -20.0, 2.0)) * drawn.drawn)
        np.testing.assert_allclose(
            shard.actions, np.where(early, 2.0 * drawn.uniform - 1.0, acting), rtol=1e-5, atol=1e-6
        )


def perturbed(kind: str, scale: float = 0.5, **changes: Any) -> Any:
    """A learner whose networks are far from their initial scale, biases included."""
    learner = learner_for(kind, **changes)
    random = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in learner.model.policy.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=random), alpha=scale)
    return learner


def test_sacs_samples_are_torchs() -> None:
    learner = perturbed("sac", scale=3.0, learning_starts=0)
    policy, actor = learner.policy(0), learner.model.actor
    observations = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    noise = np.random.default_rng(1).normal(size=(1, 500, 2)).astype(np.float32)
    outputs = policy.outputs(observations)
    with torch.no_grad():
        mean, log_std, _ = actor.get_action_dist_params(torch.as_tensor(observations))
        actor.action_dist.proba_distribution(mean, log_std)
        gaussian = actor.action_dist.distribution
        expected = torch.tanh(gaussian.mean + gaussian.stddev * torch.as_tensor(noise[0]))
    assert float(log_std.min()) == -20.0  # both of SB3's limits are met
    assert float(log_std.max()) == 2.0
    told = policy.head.sampled(outputs, Noise(noise, np.zeros_like(noise)), 0, np.arange(500))
    np.testing.assert_allclose(told, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_executed_actions_are_scaled_as_stable_baselines3_scales_them(kind: str) -> None:
    learner = perturbed(kind)
    policy = learner.policy(0)
    stored = np.random.default_rng(0).uniform(-1.0, 1.0, size=(300, 2)).astype(np.float32)
    stored[:2] = [[-1.0, 1.0], [1.0, -1.0]]
    np.testing.assert_array_equal(policy.head.executed(stored), learner.model.policy.unscale_action(stored))
    np.testing.assert_allclose(policy.head.executed(stored[:2]), [[LOW[0], HIGH[1]], [HIGH[0], LOW[1]]], rtol=1e-6)
    observations = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    expected, _ = learner.model.predict(observations, deterministic=True)
    told = policy.head.executed(policy.head.best(policy.outputs(observations)))
    np.testing.assert_allclose(told, expected, rtol=1e-5, atol=1e-5)


def test_dqn_is_evaluated_greedily() -> None:
    learner = perturbed("dqn")
    observations = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    expected, _ = learner.model.predict(observations, deterministic=True)
    policy = learner.policy(0)
    told = policy.head.executed(policy.head.best(policy.outputs(observations)))
    np.testing.assert_array_equal(told, expected)
    assert len(np.unique(told)) > 1


# ---- start values ----


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("kind", KINDS)
def test_values_are_those_of_the_online_networks(kind: str, activation: str) -> None:
    learner = perturbed(kind, activation=activation)
    observations = np.random.default_rng(0).normal(size=(400, 3)).astype(np.float32)
    inputs, model = torch.as_tensor(observations), learner.model
    with torch.no_grad():
        if kind == "dqn":
            expected, other = model.q_net(inputs).max(dim=1).values, model.q_net_target(inputs).max(dim=1).values
        else:
            best = model.actor(inputs, deterministic=True) if kind == "sac" else model.actor(inputs)
            gap = torch.diff(torch.cat(model.critic(inputs, best), dim=1)).median()
            model.critic.q_networks[1][-1].bias.sub_(gap)
            each = torch.cat(model.critic(inputs, best), dim=1)
            expected, other = each.min(dim=1).values, torch.cat(model.critic_target(inputs, best), dim=1)[:, 0]
            assert bool((each[:, 0] < each[:, 1]).any())  # now one critic is the lower one, now the other
            assert bool((each[:, 0] > each[:, 1]).any())
    told = learner.policy(0).values(observations)
    assert told.dtype == np.float64
    np.testing.assert_allclose(told, expected, rtol=1e-5, atol=1e-5)
    assert not np.allclose(told, other, atol=1e-2)


def test_sac_logs_its_entropy_coefficient() -> None:
    rounds = rounds_of(stream_for("sac"))[:10]
    learner = learner_for("sac")
    told = [update.metrics for update in learn(learner, rounds)]
    assert "log_alpha" not in told[0]  # nothing was learnt yet
    # SB3 logs the mean of what it used in each gradient step, the one before the last update included.
    assert told[2]["log_alpha"] == pytest.approx(np.log(told[2]["ent_coef"]))
    assert told[-1]["log_alpha"] == pytest.approx(float(learner.model.log_ent_coef.detach()), abs=0.05)
    fixed = learner_for("sac", ent_coef=0.2)
    assert learn(fixed, rounds)[-1].metrics["log_alpha"] == pytest.approx(np.log(0.2))
    none = learner_for("sac", ent_coef=0.0)
    assert "log_alpha" not in learn(none, rounds)[-1].metrics
