"""The Stable-Baselines3 adapter: networks, updates, and what a checkpoint must hold of them.

Nothing of SB3 is written twice: rollouts are put into SB3's own buffer, SB3 computes advantages and runs its own
`train()`. What SB3 does outside `train()` while collecting (bootstrapping of timeouts, progress of schedules) is done
here, in `fill`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger

from space_dist.config import LearnerConfig, PPOConfig
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.rollout import Layers, MlpWeights, Shard
from space_dist.seeding import Purpose, global_generators, seed_sequence

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Update:
    """What one update reported: SB3's own training metrics, and how many optimiser steps it took."""

    metrics: dict[str, float]
    gradient_steps: int


class Learner:
    """PPO or TRPO on rollouts that somebody else collected.

    Raises ConfigError if the spaces are not ones that a policy in NumPy can act in.
    """

    def __init__(
        self,
        config: LearnerConfig,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        seed: int,
        n_slots: int,
        slot_length: int,
        total_steps: int,
    ) -> None:
        torch.set_num_threads(1)  # 1 and 2 threads give different gradients
        _refuse_spaces(observation_space, action_space)
        self._seed, self._total_steps = seed, total_steps
        self._activation = config.activation
        with _seeded(seed, Purpose.INITIAL_NETWORK):
            self.model = _build(config, observation_space, action_space, n_slots, slot_length)
        self.model.set_logger(Logger(folder=None, output_formats=[]))

    def weights(self, version: int) -> MlpWeights:
        """A copy of the networks for NumPy."""
        state = {name: tensor.detach().numpy() for name, tensor in self.model.policy.state_dict().items()}

        def layers(body: str, head: str) -> Layers:
            names = sorted(
                {name.rsplit(".", 1)[0] for name in state if name.startswith(body)},
                key=lambda name: int(name.rsplit(".", 1)[1]),
            )
            return tuple(
                (np.array(state[f"{name}.weight"].T, order="C"), state[f"{name}.bias"].copy())
                for name in [*names, head]
            )

        return MlpWeights(
            version=version,
            activation=self._activation,
            actor=layers("mlp_extractor.policy_net.", "action_net"),
            critic=layers("mlp_extractor.value_net.", "value_net"),
            log_std=state["log_std"].copy() if "log_std" in state else None,
        )

    def update(self, shards: Sequence[Shard], *, round: int, steps: int) -> Update:
        """One update on one round's shards, in shard order. `steps`: environment steps including this round's."""
        before = self._optimizer_steps()
        with _divergence_explained(round):
            self.fill(shards)
        self.model.num_timesteps = steps
        self.model._update_current_progress_remaining(steps, self._total_steps)
        with _seeded(self._seed, Purpose.UPDATE, round), _divergence_explained(round):
            self.model.train()
            if not all(torch.isfinite(parameter).all() for parameter in self.model.policy.parameters()):
                raise ValueError("a weight is not a number")
        recorded = self.model.logger.name_to_value
        metrics = {
            name.removeprefix("train/"): float(value)
            for name, value in recorded.items()
            if isinstance(value, int | float | np.number) and np.isfinite(value)
        }
        recorded.clear()
        return Update(metrics, self._optimizer_steps() - before)

    def fill(self, shards: Sequence[Shard]) -> RolloutBuffer:
        """Fill SB3's rollout buffer: values and log-probabilities by its policy, returns and advantages by its buffer.

        As in SB3's own collecting, the value behind a truncated step is added to its reward, and an episode still
        running at the end is bootstrapped from the value of its last observation.
        """
        policy, buffer = self.model.policy, self.model.rollout_buffer
        observations, actions = _along_slots(shards, "observations"), _along_slots(shards, "actions")
        rewards = _along_slots(shards, "rewards").astype(np.float32)
        truncated = _along_slots(shards, "truncated")
        ended = _along_slots(shards, "terminated") | truncated
        length, n_slots = rewards.shape
        with torch.no_grad():
            flat = torch.as_tensor(observations.reshape(length * n_slots, -1))
            flat_actions = torch.as_tensor(actions.reshape(length * n_slots, -1).astype(np.float32))
            if isinstance(self.model.action_space, spaces.Discrete):
                flat_actions = flat_actions.long().flatten()
            values, log_probs, _ = policy.evaluate_actions(flat, flat_actions)
            for index, shard in enumerate(shards):
                if len(shard.truncated_observations):
                    behind = policy.predict_values(torch.tensor(shard.truncated_observations)).numpy()[:, 0]
                    mine = np.argwhere(shard.truncated)
                    rewards[mine[:, 0], mine[:, 1] + index * shard.rewards.shape[1]] += self.model.gamma * behind
            last = np.concatenate([shard.last_observations for shard in shards])
            last_values = policy.predict_values(torch.as_tensor(last))
        buffer.reset()
        buffer.observations[:] = observations.reshape(buffer.observations.shape)
        buffer.actions[:] = actions.reshape(buffer.actions.shape)
        buffer.rewards[:] = rewards
        buffer.episode_starts[:] = np.concatenate([np.ones((1, n_slots), dtype=np.bool_), ended[:-1]])
        buffer.values[:] = values.numpy().reshape(length, n_slots)
        buffer.log_probs[:] = log_probs.numpy().reshape(length, n_slots)
        buffer.pos, buffer.full = length, True
        buffer.compute_returns_and_advantage(last_values=last_values, dones=ended[-1])
        return buffer

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and plain data from which `load` restores the learner bit for bit."""
        arrays: Arrays = {
            f"policy/{name}": tensor.detach().numpy().copy() for name, tensor in self.model.policy.state_dict().items()
        }
        for index, slots in self.model.policy.optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{index}/{name}": tensor.numpy().copy() for name, tensor in slots.items()}
        return arrays, {"n_updates": self.model._n_updates}

    def load(self, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """Restore what `save` gave."""
        policy = self.model.policy
        policy.load_state_dict(
            {name.removeprefix("policy/"): torch.as_tensor(array.copy())
             for name, array in arrays.items() if name.startswith("policy/")}
        )  # fmt: skip
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, array in arrays.items():
            if name.startswith("optimizer/"):
                _, index, slot = name.split("/")
                state.setdefault(int(index), {})[slot] = torch.as_tensor(array.copy())
        groups = policy.optimizer.state_dict()["param_groups"]
        policy.optimizer.load_state_dict({"state": state, "param_groups": groups})
        self.model._n_updates = int(data["n_updates"])

    def _optimizer_steps(self) -> int:
        """Steps the optimiser of the scored network (the critic; PPO shares it with the actor) has made so far."""
        states = self.model.policy.optimizer.state.values()
        return max((int(state["step"]) for state in states), default=0)


def _build(
    config: LearnerConfig, observation_space: spaces.Space[Any], action_space: spaces.Space[Any],
    n_slots: int, slot_length: int,
) -> PPO | TRPO:  # fmt: skip
    rate = config.learning_rate
    linear = config.learning_rate_schedule == "linear"
    policy_kwargs = {
        "net_arch": list(config.net_arch),
        "activation_fn": torch.nn.Tanh if config.activation == "tanh" else torch.nn.ReLU,
        "log_std_init": config.log_std_init,
    }
    ours = {"kind", "n_steps", "learning_rate", "learning_rate_schedule", "net_arch", "activation", "log_std_init"}
    settings = {name: value for name, value in dict(config).items() if name not in ours}
    if isinstance(config, PPOConfig) and settings["max_grad_norm"] is None:
        settings["max_grad_norm"] = float("inf")
    algorithm = PPO if isinstance(config, PPOConfig) else TRPO
    model = algorithm(
        "MlpPolicy",
        env=None,  # type: ignore[arg-type] # as in SB3's own `load`; the spaces are set below
        n_steps=slot_length,
        learning_rate=(lambda remaining: rate * remaining) if linear else rate,
        policy_kwargs=policy_kwargs,
        device="cpu",
        _init_setup_model=False,
        **settings,
    )
    model.observation_space, model.action_space, model.n_envs = observation_space, action_space, n_slots
    model._setup_model()
    return model


def _refuse_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
        raise ConfigError(f"env.id: observations must be flat (a one-dimensional Box), not {observation_space}")
    flat_box = isinstance(action_space, spaces.Box) and len(action_space.shape) == 1
    if not flat_box and not (isinstance(action_space, spaces.Discrete) and action_space.start == 0):
        raise ConfigError(f"env.id: actions must be a one-dimensional Box or Discrete from 0, not {action_space}")


def _along_slots(shards: Sequence[Shard], field: str) -> NDArray[Any]:
    """`(length, all slots, ...)`: the shards side by side, in shard order."""
    order = [shard.shard for shard in shards]
    if order != list(range(len(shards))):
        raise RuntimeError(f"shards arrived in the order {order}")
    return np.concatenate([getattr(shard, field) for shard in shards], axis=1)


@contextmanager
def _seeded(seed: int, purpose: Purpose, *keys: int) -> Iterator[None]:
    """Python's, NumPy's and torch's global generators seeded for one piece of work, and restored."""
    with global_generators(seed, purpose, *keys), torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(seed_sequence(seed, purpose, *keys).generate_state(3, np.uint32)[2]))
        yield


@contextmanager
def _divergence_explained(round: int) -> Iterator[None]:
    """Users need the cause: torch refuses distributions of NaN, and steps beyond float32, with errors about tensors."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "overflow" not in str(error):
            raise
        raise SpaceDistError(
            f"training diverged in update {round + 1}: the networks are no longer numbers. A smaller "
            f"learner.learning_rate usually helps ({str(error).splitlines()[0][:120]})"
        ) from error
