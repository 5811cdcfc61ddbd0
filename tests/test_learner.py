from __future__ import annotations

import dataclasses
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from space_dist import config as configs
from space_dist.config import LearnerConfig, PPOConfig, TRPOConfig
from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, make_batched
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.learner import Learner, OnPolicyLearner, make_learner
from space_dist.ledger import Checkpoint, decode_checkpoint, encode_checkpoint
from space_dist.rollout import Episodes, Rollout, Shard, Stage, collect
from space_dist.rollout.walk import Unfinished
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests

POINTMASS, LINE, DISCRETE_LINE = "space_dist/PointMass-v0", "tests.tiny_env:make", "tests.tiny_env:make_discrete"
SLOTS, LENGTH = 3, 16  # per shard, where nothing else is said
BOX = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)


def small(kind: str = "ppo", **changes: Any) -> LearnerConfig:
    settings: dict[str, Any] = {"kind": kind, "net_arch": (8,), "n_steps": 2 * SLOTS * LENGTH, "batch_size": 32}
    settings |= {"n_epochs": 3} if kind == "ppo" else {"n_critic_updates": 3, "target_kl": 0.02}
    return (PPOConfig if kind == "ppo" else TRPOConfig)(**(settings | changes))


def learner_for(
    config: LearnerConfig, env_id: str = LINE, *, seed: int = 0, n_slots: int = 2 * SLOTS, length: int = LENGTH,
    updates: int = 4,
) -> Any:  # fmt: skip
    env = make_batched(env_id, 1, context_visible=True)
    return make_learner(
        config, env.observation_space, env.action_space,
        seed=seed, n_slots=n_slots, slot_length=length, total_steps=updates * n_slots * length,
    )  # fmt: skip


def shards_of(learner: Learner, env_id: str = LINE, *, round: int = 0, length: int = LENGTH, n: int = 2) -> list[Shard]:
    """What `n` shards collect with the learner's present weights."""
    env: BatchedEnv = make_batched(env_id, SLOTS, context_visible=True)
    bounds = env.context_bounds
    contexts = np.random.default_rng(0).uniform(bounds.low, bounds.high, size=(5, len(bounds.names)))
    selection = Selection(0, np.arange(5), contexts, 0)
    policy = learner.policy(round)
    return [
        collect(
            Stage(env), [Rollout(policy, selection, 2 * shard, 0.9, seed=1, round=round, shard=shard)], length=length
        )[0]
        for shard in range(n)
    ]


def update(learner: Learner, number: int, env_id: str = LINE) -> dict[str, float]:
    """Collect and learn; the update's metrics."""
    done = learner.update(
        shards_of(learner, env_id, round=number), round=number, steps=(number + 1) * 2 * SLOTS * LENGTH
    )
    return done.metrics


def bits(learner: Learner) -> dict[str, bytes]:
    """Everything an update changes."""
    state = {name: tensor.numpy().tobytes() for name, tensor in learner.model.policy.state_dict().items()}
    for index, slots in learner.model.policy.optimizer.state_dict()["state"].items():
        state |= {f"{index}/{name}": np.asarray(tensor).tobytes() for name, tensor in slots.items()}
    return state


def hand_made(rewards: Any, terminated: Any, truncated: Any, *, shard: int = 0) -> Shard:
    """A shard of two-dimensional observations and actions, all zero, with (length, slots) rewards and ends."""
    rewards, terminated, truncated = np.array(rewards, dtype=np.float64), np.array(terminated), np.array(truncated)
    length, slots = rewards.shape
    none, nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
    return Shard(
        shard=shard, round=0, policy_version=0, selection_version=0, order_version=0,
        observations=np.zeros((length, slots, 2), dtype=np.float32),
        actions=np.zeros((length, slots, 2), dtype=np.float32), rewards=rewards,
        terminated=terminated, truncated=truncated,
        last_observations=np.zeros((slots, 2), dtype=np.float32),
        truncated_observations=np.zeros((int(truncated.sum()), 2), dtype=np.float32), next_observations=None,
        starts=np.ones(slots, dtype=np.bool_), begun=slots,
        episodes=Episodes(none, np.zeros((0, 1)), none, none, none, nothing, nothing, nothing),
        unfinished=Unfinished(none, nothing, none, none, nothing, nothing, nothing, nothing),
    )  # fmt: skip


# ---- filling the buffer ----


class Replay(VecEnv):
    """Shows Stable-Baselines3 the steps of recorded shards again, side by side."""

    def __init__(self, shards: list[Shard], observation_space: spaces.Box, action_space: spaces.Space[Any]) -> None:
        super().__init__(len(shards) * SLOTS, observation_space, action_space)
        self.observations = np.concatenate([shard.observations for shard in shards], axis=1)
        self.actions = np.concatenate([shard.actions for shard in shards], axis=1)
        self.rewards = np.concatenate([shard.rewards for shard in shards], axis=1).astype(np.float32)
        self.terminated = np.concatenate([shard.terminated for shard in shards], axis=1)
        self.truncated = np.concatenate([shard.truncated for shard in shards], axis=1)
        self.last = np.concatenate([shard.last_observations for shard in shards])
        self.behind = {
            (time, slot + index * SLOTS): observation
            for index, shard in enumerate(shards)
            for (time, slot), observation in zip(
                np.argwhere(shard.truncated).tolist(), shard.truncated_observations, strict=True
            )
        }
        self.time, self.given = 0, []

    def reset(self) -> NDArray[np.float32]:
        return self.observations[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        self.given.append(actions)

    def step_wait(self) -> Any:
        time, self.time = self.time, self.time + 1
        dones = self.terminated[time] | self.truncated[time]
        if self.time < len(self.rewards):
            following = self.observations[self.time]
        else:  # ended slots would show their next start by now; what that is must not matter
            following = np.where(dones[:, None], np.float32(123.0), self.last)
        infos: list[dict[str, Any]] = [{} for _ in dones]
        for slot in np.flatnonzero(dones):
            nowhere = np.full(self.observation_space.shape, 55.0, dtype=np.float32)
            infos[slot] = {
                "terminal_observation": self.behind.get((time, slot), nowhere),
                "TimeLimit.truncated": bool(self.truncated[time, slot]),
            }
        return following, self.rewards[time].copy(), dones, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:  # noqa: ARG002
        return [None] * self.num_envs  # "render_mode", when a model is made

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002
        return [False] * self.num_envs

    def set_attr(self, *_: Any) -> None:
        raise NotImplementedError

    env_method = set_attr


class Ignore(BaseCallback):
    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("kind", ["ppo", "trpo"])
@pytest.mark.parametrize(("env_id", "length"), [(POINTMASS, 130), (POINTMASS, 200), (DISCRETE_LINE, 19)])
def test_buffer_equals_stable_baselines3s_own_collecting(env_id: str, length: int, kind: str) -> None:
    config = small(kind, gamma=0.9, gae_lambda=0.8, n_steps=2 * SLOTS * length, log_std_init=0.7)
    learner = learner_for(config, env_id, length=length)
    policy = learner.model.policy
    with torch.no_grad():
        policy.value_net.weight.mul_(5.0)  # values that matter beside the rewards
        policy.value_net.bias.fill_(1.5)
        if env_id == POINTMASS:
            policy.action_net.bias.copy_(torch.tensor([0.0, -0.35]))  # some crash on the wall, some run out of time
    shards = shards_of(learner, env_id, length=length)
    ours = learner.fill(shards)
    names = ("observations", "actions", "rewards", "episode_starts", "values", "log_probs", "advantages", "returns")
    ours = {name: getattr(ours, name).copy() for name in names}

    env = Replay(shards, learner.model.observation_space, learner.model.action_space)
    model = (PPO if kind == "ppo" else TRPO)(
        "MlpPolicy", env, n_steps=length, batch_size=length * env.num_envs, gamma=0.9, gae_lambda=0.8,
        policy_kwargs={"net_arch": [8]}, device="cpu",
    )  # fmt: skip
    model.policy.load_state_dict(policy.state_dict())

    def recorded(observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        actions = torch.as_tensor(env.actions[env.time])
        values, log_probs, _ = model.policy.evaluate_actions(observations, actions)
        return actions, values, log_probs

    model.policy.forward = recorded
    _, callback = model._setup_learn(length * env.num_envs, Ignore())
    assert model.collect_rollouts(env, callback, model.rollout_buffer, length)
    for name in names:
        theirs = getattr(model.rollout_buffer, name)
        assert ours[name].shape == theirs.shape, name
        assert ours[name].dtype == theirs.dtype, name
        np.testing.assert_allclose(ours[name], theirs, rtol=1e-5, atol=1e-5, err_msg=name)

    running = np.concatenate([shard.unfinished.lengths for shard in shards])
    if env_id == POINTMASS:
        assert env.terminated.any()
        assert length < 200 or env.truncated[-1].any()  # bootstrapped as a timeout, not as one that goes on
    assert env.truncated.any()
    assert (running > 0).any()
    low, high = getattr(env.action_space, "low", 0), getattr(env.action_space, "high", 2)
    assert all((given >= low).all() and (given <= high).all() for given in env.given)


@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_advantages_by_hand(kind: str) -> None:
    # V = 4 everywhere, rewards 1, gamma 1/2, lambda 1/2: delta = 1 + 2 - 4 = -1, and 1 - 4 = -3 at a terminal step;
    # A_t = delta_t + A_{t+1} / 4 within an episode. Beyond the round and a timeout the value is 4 all the same.
    config = small(kind, gamma=0.5, gae_lambda=0.5, n_steps=16)
    learner = OnPolicyLearner(config, BOX, BOX, seed=0, n_slots=4, slot_length=4, total_steps=16)
    with torch.no_grad():
        learner.model.policy.value_net.weight.zero_()
        learner.model.policy.value_net.bias.fill_(4.0)
    no = [False, False]
    first = hand_made(np.ones((4, 2)), [no, [True, False], no, no], [no, no, no, [False, True]])
    second = hand_made(np.ones((4, 2)), [no, no, no, [True, False]], [no, [False, True], no, no], shard=1)
    buffer = learner.fill([first, second])
    expected = [  # terminated at 1 and cut; truncated at 3; terminated at 3; truncated at 1 and cut
        [-1.75, -1.328125, -1.359375, -1.25],
        [-3.0, -1.3125, -1.4375, -1.0],
        [-1.25, -1.25, -1.75, -1.25],
        [-1.0, -1.0, -3.0, -1.0],
    ]
    np.testing.assert_allclose(buffer.advantages, expected, rtol=1e-6)
    np.testing.assert_allclose(buffer.returns, np.array(expected) + 4.0, rtol=1e-6)
    np.testing.assert_allclose(buffer.rewards, [[1, 1, 1, 1], [1, 1, 1, 3], [1, 1, 1, 1], [1, 3, 1, 1]])
    np.testing.assert_array_equal(buffer.episode_starts, [[1, 1, 1, 1], [0, 0, 0, 0], [1, 0, 0, 1], [0, 0, 0, 0]])
    # Actions of 0 under means of about 0 and a standard deviation of 1, in two dimensions.
    expected_log_prob = -np.log(2 * np.pi) - (learner.policy(0).actor[-1][1] ** 2).sum() / 2
    np.testing.assert_allclose(buffer.log_probs, expected_log_prob, rtol=1e-5)


def test_filling_leaves_the_shards_alone() -> None:
    learner = learner_for(small())
    shards = shards_of(learner)
    before = [{name: np.copy(value) for name, value in vars(shard).items() if isinstance(value, np.ndarray)}
              for shard in shards]  # fmt: skip
    learner.update(shards, round=0, steps=96)
    for shard, arrays in zip(shards, before, strict=True):
        for name, array in arrays.items():
            np.testing.assert_array_equal(getattr(shard, name), array)


def test_shards_in_another_order_are_refused() -> None:
    learner = learner_for(small())
    with pytest.raises(RuntimeError, match=r"\[1, 0\]"):
        learner.update(shards_of(learner)[::-1], round=0, steps=96)


# ---- updating ----


def resumed_to_the_bit(config: LearnerConfig, env_id: str) -> tuple[Any, Any]:
    """A learner after four updates, and one that began otherwise and went on from its checkpoint of the second."""
    learner = learner_for(config, env_id)
    for number in range(2):
        update(learner, number, env_id)
    stored = encode_checkpoint(Checkpoint(2, *learner.save()))
    at_the_time = bits(learner)
    metrics = [update(learner, number, env_id) for number in (2, 3)]
    assert bits(learner) != at_the_time

    fresh = learner_for(config, env_id, seed=5)  # whose initial network is another one
    again = decode_checkpoint(stored)
    fresh.load(again.arrays, again.data)
    assert bits(fresh) == at_the_time
    fresh._seed = learner._seed
    assert [update(fresh, number, env_id) for number in (2, 3)] == metrics
    assert bits(fresh) == bits(learner)
    return learner, fresh


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE])
@pytest.mark.parametrize("config", [small(), small(learning_rate_schedule="linear"), small("trpo")],
                         ids=["ppo", "linear", "trpo"])  # fmt: skip
def test_a_checkpoint_restores_the_learner_bit_for_bit(config: LearnerConfig, env_id: str) -> None:
    learner, fresh = resumed_to_the_bit(config, env_id)
    told, expected = fresh.policy(4), learner.policy(4)
    for part, part_expected in ((told.actor, expected.actor), (told.critics[0], expected.critics[0])):
        for (matrix, bias), (matrix_expected, bias_expected) in zip(part, part_expected, strict=True):
            np.testing.assert_array_equal(matrix, matrix_expected)
            np.testing.assert_array_equal(bias, bias_expected)


def test_what_was_saved_does_not_change_with_the_learner() -> None:
    learner = learner_for(small())
    update(learner, 0)
    arrays, _ = learner.save()
    before = {name: array.copy() for name, array in arrays.items()}
    update(learner, 1)
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


def global_generators() -> tuple[Any, ...]:
    numpy_state = np.random.get_state(legacy=False)  # noqa: NPY002 - it is what SB3 draws from
    state = numpy_state["state"]
    return random.getstate(), state["key"].tobytes(), state["pos"], torch.get_rng_state().numpy().tobytes()


def shake_global_generators() -> None:
    random.seed(99)
    np.random.seed(98)  # noqa: NPY002
    torch.manual_seed(97)


@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_global_generators_decide_nothing_and_are_left_alone(kind: str) -> None:
    results = []
    for prepare in (lambda: None, shake_global_generators, lambda: torch.rand(7)):
        prepare()
        before = global_generators()
        learner = learner_for(small(kind))
        metrics = [update(learner, number) for number in range(2)]
        assert global_generators() == before
        results.append((metrics, bits(learner)))
    assert results[0] == results[1] == results[2]
    other_seed = learner_for(small(kind), seed=1)
    assert bits(other_seed) != bits(learner_for(small(kind)))


def test_each_round_shuffles_anew() -> None:
    # The same shards, learnt in two rounds: the minibatches differ, and so do the networks.
    shards = shards_of(learner_for(small()))
    learners = [learner_for(small()) for _ in range(3)]
    for learner, number in zip(learners, (0, 1, 1), strict=True):
        learner.update(shards, round=number, steps=96)
    first, second, third = map(bits, learners)
    assert first != second == third


def test_initial_networks_depend_on_the_seed_alone() -> None:
    shake_global_generators()
    first = bits(learner_for(small(), seed=3))
    torch.manual_seed(0)
    assert bits(learner_for(small(gamma=0.5), seed=3)) == first
    assert bits(learner_for(small(), seed=4)) != first


class Rates(BaseCallback):
    """The optimiser's learning rate as each update left it."""

    def __init__(self) -> None:
        super().__init__()
        self.rates: list[float] = []

    def _on_rollout_start(self) -> None:
        self.rates.append(self.model.policy.optimizer.param_groups[0]["lr"])

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_linear_schedule_is_stable_baselines3s(kind: str) -> None:
    updates = 4
    learner = learner_for(small(kind, learning_rate=0.01, learning_rate_schedule="linear"), updates=updates)
    told = [update(learner, number)["learning_rate"] for number in range(updates)]
    steady = learner_for(small(kind, learning_rate=0.01), updates=updates)
    assert [update(steady, number)["learning_rate"] for number in range(updates)] == [0.01] * updates

    algorithm = PPO if kind == "ppo" else TRPO
    model = algorithm("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, learning_rate=lambda left: 0.01 * left)
    callback = Rates()
    model.learn(8 * updates, callback=callback)
    rates = [*callback.rates[1:], model.policy.optimizer.param_groups[0]["lr"]]
    np.testing.assert_allclose(told, rates, rtol=1e-12)
    np.testing.assert_allclose(told, [0.0075, 0.005, 0.0025, 0.0], rtol=1e-12)
    assert learner.model.policy.optimizer.param_groups[0]["lr"] == 0.0


@pytest.mark.parametrize(
    ("config", "steps"),
    [
        (small(batch_size=32, n_epochs=3), 9),  # 96 transitions: 3 minibatches
        (small(batch_size=64, n_epochs=2), 4),  # a whole one and a half one
        (small(batch_size=1000, n_epochs=2), 2),
        (small("trpo", batch_size=32, n_critic_updates=5), 15),
        (small("trpo", batch_size=50, n_critic_updates=1), 2),
    ],
)
def test_gradient_steps_are_counted(config: LearnerConfig, steps: int) -> None:
    learner = learner_for(config)
    counted = [learner.update(shards_of(learner), round=number, steps=96).gradient_steps for number in range(2)]
    assert counted == [steps, steps]


def test_an_update_that_stops_early_counts_what_it_did() -> None:
    learner = learner_for(small(learning_rate=0.1, target_kl=1e-6, n_epochs=50))
    done = learner.update(shards_of(learner), round=0, steps=96)
    assert 1 <= done.gradient_steps < 6


@pytest.mark.parametrize(
    "observation_space",
    [spaces.Box(-1.0, 1.0, shape=(2, 2)), spaces.Box(-1.0, 1.0, shape=()), spaces.Discrete(4), spaces.Dict({"x": BOX})],
)
def test_observations_that_are_not_flat_are_refused(observation_space: spaces.Space[Any]) -> None:
    with pytest.raises(ConfigError, match="MlpPolicy needs flat observations"):
        make_learner(small(), observation_space, BOX, seed=0, n_slots=1, slot_length=4, total_steps=4)


@pytest.mark.parametrize(
    "action_space",
    [
        spaces.Box(-1.0, 1.0, shape=(2, 2)), spaces.Box(-1.0, 1.0, shape=()), spaces.Discrete(4, start=1),
        spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2), spaces.Tuple([BOX]),
    ],
)  # fmt: skip
def test_actions_that_are_neither_flat_nor_counted_from_0_are_refused(action_space: spaces.Space[Any]) -> None:
    with pytest.raises(ConfigError, match="one-dimensional Box or Discrete from 0"):
        make_learner(small(), BOX, action_space, seed=0, n_slots=1, slot_length=4, total_steps=4)


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE])
@pytest.mark.parametrize("kind", ["ppo", "trpo"])
@pytest.mark.parametrize("reward", [np.nan, np.inf])
def test_rewards_that_are_no_numbers_end_as_divergence(env_id: str, kind: str, reward: float) -> None:
    learner = learner_for(small(kind), env_id)
    first, second = shards_of(learner, env_id)
    rewards = second.rewards.copy()
    rewards[5, 1] = reward
    with pytest.raises(SpaceDistError, match="training diverged in update 8"):
        learner.update([first, dataclasses.replace(second, rewards=rewards)], round=7, steps=96)


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE])
@pytest.mark.parametrize("kind", ["ppo", "trpo"])
@pytest.mark.parametrize("rate", [1e30, 1e38])
def test_an_absurd_learning_rate_ends_as_divergence(env_id: str, kind: str, rate: float) -> None:
    learner = learner_for(small(kind, learning_rate=rate), env_id)
    with pytest.raises(SpaceDistError, match=r"training diverged in update \d.*learning_rate"):  # noqa: PT012
        for number in range(4):  # TRPO's policy sees its critic's nonsense an update later
            update(learner, number, env_id)


def test_divergence_in_the_last_minibatch_is_told_too() -> None:
    # Nothing looks at the policy after it within the update: a run that ends here would be done with a model of NaN.
    learner = learner_for(small(n_epochs=1, batch_size=96))
    first, second = shards_of(learner)
    broken = dataclasses.replace(second, rewards=np.full_like(second.rewards, np.nan))
    with pytest.raises(SpaceDistError, match="training diverged in update 1"):
        learner.update([first, broken], round=0, steps=96)


# ---- learning ----

# Who does not look at the target earns 1 - |x - target| = 0.25 a step on average over targets at -0.75 and 0.75, 2 in
# an episode; who goes there straight earns 7.2.
THRESHOLD = 6.0


def final_return(folder: Path, env_id: str, learner: dict[str, Any], *, seed: int = 0) -> float:
    """Mean return on both training instances at the end of a run under SPaCE."""
    folder.mkdir()
    train, test = folder / "train.csv", folder / "test.csv"
    train.write_text("id,target\n0,-0.75\n1,0.75\n")
    test.write_text("id,target\n0,-0.7\n1,0.7\n")
    config = configs.parse(
        {
            "name": "tiny", "seed": seed, "env": {"id": env_id},
            "instances": {"train": str(train), "test": str(test)}, "curriculum": {"kind": "space"},
            "learner": {"n_steps": 256, "net_arch": [16], "learning_rate": 3e-3} | learner,
            "rollout": {"shards": 2, "slots": 4}, "budget": {"steps": 16_384}, "evaluation": {"every_steps": 16_384},
            "tracking": {"uri": None}, "resources": {"workers": 0},
        },
        "test",
    )  # fmt: skip
    rows = launch(config, folder / "run", resume=False, stop=StopRequests()).ledger.rows(committed_only=True)
    last = [row for row in rows if row["kind"] == "evaluation"][-1]
    assert last["steps"] == 16_384
    sizes = [row["curriculum"]["size"] for row in rows if row["kind"] == "iteration" and row["complete"]]
    assert sizes[-1] == 2
    return float(last["train"]["return"])


PPO_SETTINGS = {"kind": "ppo", "batch_size": 64, "n_epochs": 5}
TRPO_SETTINGS = {"kind": "trpo", "batch_size": 64, "n_critic_updates": 5, "target_kl": 0.05}


@pytest.mark.parametrize(
    ("env_id", "settings"),
    [(LINE, PPO_SETTINGS), (DISCRETE_LINE, PPO_SETTINGS), (LINE, TRPO_SETTINGS)],
    ids=["ppo", "ppo-discrete", "trpo"],
)
def test_space_learns_a_tiny_environment(env_id: str, settings: dict[str, Any], tmp_path: Path) -> None:
    assert final_return(tmp_path / "learning", env_id, settings) >= THRESHOLD
    frozen_settings = settings | {"learning_rate": 1e-12}
    if settings["kind"] == "trpo":  # whose learning rate is the critic's
        frozen_settings["target_kl"] = 1e-12
    frozen = final_return(tmp_path / "frozen", env_id, frozen_settings)
    assert frozen < THRESHOLD / 2
