"""sb3-contrib's RecurrentPPO: its LSTMs on the way to actors, and the states that its rollout buffer holds of them.

An LSTM's state belongs to an episode: it is nothing (zeros) at the start, and goes on with the episode from round to
round. Whoever acts keeps it as one row of numbers a slot, the *memory*: hidden and cell state of the actor's LSTM, and
of the critic's, if it has one of its own. As in sb3-contrib, what earlier weights remembered stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from space_dist.config import RecurrentPPOConfig
from space_dist.envs import Observations
from space_dist.envs.observations import rows, take
from space_dist.errors import ConfigError
from space_dist.learner.networks import TorchPolicy, network_of, tensors
from space_dist.learner.on_policy import Joined, OnPolicyLearner, Values
from space_dist.rollout import Shard
from space_dist.rollout.policy import Array


@dataclass(frozen=True)
class RecurrentTorchPolicy(TorchPolicy):
    """A policy of sb3-contrib's that remembers, acting through torch: a `Recurrent`.

    What is asked of it without a memory (`outputs`, `values`) is said of episodes' starts.
    """

    memory_size: int

    def recalling(self, observations: Observations, memory: Array) -> tuple[Array, Array]:
        """See `Recurrent`."""
        network: Any = network_of(self)
        with torch.no_grad(), _torchs_own_lstm():
            inputs, states = tensors(self.statistics.scaled(observations)), _states(network, memory)
            going_on = torch.zeros(len(memory))  # where an episode begins, its memory is zeros already
            distribution, actor = network.get_distribution(inputs, states.pi, going_on)
            after = RNNStates(actor, actor)
            if network.lstm_critic is not None:
                after = network.forward(inputs, states, going_on, deterministic=True)[3]
            told = distribution.distribution
            outputs: Array = (told.logits if self.head.kind == "categorical" else told.mean).numpy()
        return outputs, _memory(network, after)

    def outputs(self, observations: Observations) -> Array:
        """See `policy.Policy`."""
        return self.recalling(observations, self._nothing(observations))[0]

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """See `policy.Policy`."""
        network: Any = network_of(self)
        with torch.no_grad(), _torchs_own_lstm():
            nothing = _states(network, self._nothing(observations)).vf
            inputs = tensors(self.statistics.scaled(observations))
            values: torch.Tensor = network.predict_values(inputs, nothing, torch.zeros(rows(observations)))[:, 0]
        return values.numpy().astype(np.float64) * self.statistics.reward_std

    def _nothing(self, observations: Observations) -> Array:
        return np.zeros((rows(observations), self.memory_size), dtype=np.float32)


class RecurrentLearner(OnPolicyLearner):
    """RecurrentPPO, on our shards."""

    _settings: RecurrentPPOConfig

    def _build(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> OnPolicyAlgorithm:
        model, settings = super()._build(observation_space, action_space), self._settings
        actor: Any = model.policy.lstm_actor
        size = (2 if model.policy.lstm_critic is None else 4) * actor.num_layers * actor.hidden_size
        if size != settings.memory_size:
            raise ConfigError(
                f"learner.policy {settings.policy!r} remembers {size} numbers of an episode, and by "
                "learner.lstm_hidden_size, n_lstm_layers and enable_critic_lstm, which it is made with, they are "
                f"{settings.memory_size}"
            )
        return model

    def policy(self, version: int) -> RecurrentTorchPolicy:
        """See `Learner`."""
        plain = super().policy(version)
        return RecurrentTorchPolicy(**vars(plain), memory_size=self._settings.memory_size)

    def _learn(self, shards: Sequence[Shard], *, steps: int) -> None:
        with _torchs_own_lstm():
            super()._learn(shards, steps=steps)

    def _evaluated(
        self, shards: Sequence[Shard], joined: Joined, beyond: Sequence[Observations]
    ) -> tuple[Values, Values, list[Values]]:
        """See `OnPolicyLearner`. The states before each step go into the buffer, where `train()` starts from them."""
        policy: Any = self.model.policy
        policy.set_training_mode(False)  # as sb3-contrib has it while it collects
        with _torchs_own_lstm():
            actor, critic = self._states_of(shards, joined)
            before = RNNStates(_side_by_side(actor), _side_by_side(critic))
            observations, actions = joined.flat(self.model.action_space)
            starts = _floats(joined.episode_starts.reshape(-1))
            values, log_probs, _ = policy.evaluate_actions(tensors(observations), actions, before, starts)
            behind, first = [], 0
            for shard, others in zip(shards, beyond, strict=False):
                times, slots = np.nonzero(shard.truncated)
                after = tuple(part[times + 1, :, slots + first].transpose(0, 1).contiguous() for part in critic)
                behind.append(self._worth(others, after, np.zeros(len(times), dtype=np.bool_)))
                first += shard.rewards.shape[1]
            behind.append(self._worth(beyond[-1], tuple(part[-1] for part in critic), joined.ended[-1]))
        buffer: Any = self.model.rollout_buffer
        buffer.hidden_states_pi[:], buffer.cell_states_pi[:] = (part[:-1].numpy() for part in actor)
        buffer.hidden_states_vf[:], buffer.cell_states_vf[:] = (part[:-1].numpy() for part in critic)
        return values.numpy()[:, 0], log_probs.numpy(), behind

    def _states_of(self, shards: Sequence[Shard], joined: Joined) -> tuple[Sequence[torch.Tensor], ...]:
        """(hidden, cell) of actor and critic: (length + 1, layers, slots, units) before each step, and behind the last.

        From what was remembered before the round, step by step, as sb3-contrib's collecting makes them.
        """
        policy: Any = self.model.policy
        memory = np.concatenate([shard.memory for shard in shards if shard.memory is not None])
        states = [_states(policy, memory)]
        for time, starts in enumerate(joined.episode_starts):
            inputs = tensors(take(joined.observations, time))
            states.append(policy.forward(inputs, states[-1], _floats(starts), deterministic=True)[3])
        return tuple([torch.stack([one[of][part] for one in states]) for part in range(2)] for of in range(2))

    def _worth(self, observations: Observations, states: Sequence[torch.Tensor], starts: NDArray[np.bool_]) -> Values:
        """`(k,)` values of observations behind (layers, k, units) hidden and cell states of the critic."""
        if not rows(observations):
            return np.zeros(0, np.float32)
        policy: Any = self.model.policy
        values: Values = policy.predict_values(tensors(observations), tuple(states), _floats(starts)).numpy()[:, 0]
        return values


def _states(network: Any, memory: Array) -> RNNStates:
    """`(n, memory_size)` -> (layers, n, units) each."""
    lstm = network.lstm_actor
    split = torch.tensor(memory).reshape(len(memory), -1, lstm.num_layers, lstm.hidden_size)
    parts = split.permute(1, 2, 0, 3).contiguous()
    return RNNStates((parts[0], parts[1]), (parts[-2], parts[-1]))


def _memory(network: Any, states: RNNStates) -> Array:
    """The inverse of `_states`."""
    parts = [*states.pi, *(() if network.lstm_critic is None else states.vf)]
    memory: Array = torch.stack(parts).permute(2, 0, 1, 3).reshape(parts[0].shape[1], -1).numpy()
    return memory


def _side_by_side(parts: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """(length + 1, layers, slots, units) states as those, before each step, of (layers, length * slots, units)."""
    return tuple(part[:-1].transpose(0, 1).flatten(1, 2).contiguous() for part in parts)


def _floats(flags: NDArray[np.bool_]) -> torch.Tensor:
    return torch.as_tensor(flags.astype(np.float32))


@contextmanager
def _torchs_own_lstm() -> Iterator[None]:
    """Have torch compute LSTMs by its own products and functions, which `arithmetic` holds to one kernel each."""
    before = torch.backends.mkldnn.set_flags(_enabled=False, _fp32_precision=None)[0]  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        torch.backends.mkldnn.set_flags(_enabled=before, _fp32_precision=None)  # type: ignore[no-untyped-call]
