"""An ensemble of value functions, trained on the rollouts beside the learner, for curricula that ask who disagrees."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.config import LearnerConfig, ValueDisagreementConfig
from space_dist.envs import Observations
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.learner.interface import Arrays
from space_dist.rollout import Shard
from space_dist.rollout.policy import EnsemblePolicy, Layers, Statistics, seen_by_members
from space_dist.seeding import Purpose, generator

Array = NDArray[np.float32]


@dataclass(frozen=True)
class _Targets:
    """inputs: (n, obs_dim) flat observations as members see them.  returns: (members, n) what each is fitted to."""

    inputs: Array
    returns: Array


class Ensemble:
    """State-value functions of one architecture that differ by their first weights.

    After each round, every member is fitted to the lambda-returns of that round's transitions, bootstrapped from itself
    as it was before, also where an episode goes on behind the round. All members see the same minibatches. Their
    parameters lie stacked along a leading axis, so that a step of all costs little more than one of one.

    Raises ConfigError where observations are not flat, or hold no context although some of it shall stay unseen.
    """

    def __init__(
        self, settings: ValueDisagreementConfig, learner: LearnerConfig, observation_space: spaces.Space[Any],
        features: Sequence[str], *, seed: int,
    ) -> None:  # fmt: skip
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise ConfigError(
                f"curriculum.kind: vds needs flat observations (a one-dimensional Box), not {observation_space}"
            )
        self._settings, self._seed, self._gamma = settings, seed, learner.gamma
        self._activation = learner.activation
        size = observation_space.shape[0]
        seen = set(features if settings.members_see is None else settings.members_see)
        hidden = [size - len(features) + place for place, name in enumerate(features) if name not in seen]
        self._unseen = np.array(hidden, dtype=np.int64)
        random = torch.Generator().manual_seed(
            int(generator(seed, Purpose.ENSEMBLE).integers(1 << 62))
        )  # fmt: skip
        sizes = [size, *learner.net_arch, 1]
        self._parameters: list[torch.Tensor] = []
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            is_hidden = layer < len(learner.net_arch)
            weight = torch.empty(settings.members, n_in, n_out)
            for member in weight:
                # SB3's gains of an actor-critic's hidden layers and of its value.
                torch.nn.init.orthogonal_(member, gain=np.sqrt(2.0) if is_hidden else 1.0, generator=random)
            self._parameters += [weight.requires_grad_(), torch.zeros(settings.members, 1, n_out, requires_grad=True)]
        # eps: SB3's for actor-critics.
        self._optimizer = torch.optim.Adam(self._parameters, lr=settings.learning_rate, eps=1e-5)

    def update(self, shards: Sequence[Shard], statistics: Statistics, *, round: int) -> dict[str, float]:
        """Fit every member to one round. Returns the mean loss. Raises SpaceDistError if a weight is no number.

        statistics: the scales of observations and rewards that the round was collected under.
        """
        targets = self._targets(shards, statistics)
        inputs, returns = torch.as_tensor(targets.inputs), torch.as_tensor(targets.returns)
        random = generator(self._seed, Purpose.ENSEMBLE_UPDATE, round)
        size = min(self._settings.batch_size, len(inputs))
        losses = []
        for _ in range(self._settings.n_batches):
            batch = torch.as_tensor(random.choice(len(inputs), size=size, replace=False))
            # The sum over members: each has the gradient that it would have alone.
            loss = ((self._forward(inputs[batch]) - returns[:, batch]) ** 2).mean(dim=1).sum()
            self._optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimizer.step()
            losses.append(loss.item() / self._settings.members)
        if not all(bool(torch.isfinite(parameter).all()) for parameter in self._parameters):
            raise SpaceDistError(
                f"the ensemble of value functions diverged in update {round + 1}: its networks are no longer numbers. "
                "A smaller curriculum.learning_rate usually helps"
            )
        return {"ensemble_loss": float(np.mean(losses))}

    def policy(self, statistics: Statistics) -> EnsemblePolicy:
        """A copy of the members, for workers to score instances with."""
        layers = [tensor.detach().numpy().copy() for tensor in self._parameters]
        members: list[Layers] = [
            tuple((weight[member], bias[member, 0]) for weight, bias in zip(layers[::2], layers[1::2], strict=True))
            for member in range(self._settings.members)
        ]
        return EnsemblePolicy(self._activation, tuple(members), self._unseen, statistics)

    def save(self) -> Arrays:
        """Arrays from which `load` restores everything."""
        arrays: Arrays = {}
        for index, parameter in enumerate(self._parameters):
            arrays[f"{index}/weight"] = parameter.detach().numpy().copy()
            for name, value in self._optimizer.state.get(parameter, {}).items():
                arrays[f"{index}/{name}"] = value.detach().numpy().copy()
        return arrays

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore what `save` gave."""
        states: dict[int, dict[str, torch.Tensor]] = {}
        for key, array in arrays.items():
            index, _, name = key.partition("/")
            tensor = torch.as_tensor(array.copy())
            if name == "weight":
                with torch.no_grad():
                    self._parameters[int(index)].copy_(tensor)
            else:
                states.setdefault(int(index), {})[name] = tensor
        groups = self._optimizer.state_dict()["param_groups"]
        self._optimizer.load_state_dict({"state": states, "param_groups": groups})

    def _forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """`(n, obs_dim) -> (members, n)`."""
        values = inputs.expand(self._settings.members, *inputs.shape)
        last = len(self._parameters) - 2
        for index in range(0, len(self._parameters), 2):
            values = torch.baddbmm(self._parameters[index + 1], values, self._parameters[index])
            if index != last:
                values = torch.tanh(values) if self._activation == "tanh" else torch.relu(values)
        return values[:, :, 0]

    def _targets(self, shards: Sequence[Shard], statistics: Statistics) -> _Targets:
        inputs, returns = [], []
        for shard in shards:
            length, slots = shard.rewards.shape
            now = self._seen(shard.observations, statistics)
            values = self._values(now).reshape(-1, length, slots)
            behind = np.zeros_like(values)  # the value of the state that each step led to
            behind[:, :-1] = values[:, 1:]
            behind[:, -1] = self._values(self._seen(shard.last_observations, statistics))
            if shard.truncated.any():
                truncated = self._values(self._seen(shard.truncated_observations, statistics))
                places = np.argwhere(shard.truncated)
                behind[:, places[:, 0], places[:, 1]] = truncated
            behind[:, shard.terminated] = 0.0
            ended = shard.terminated | shard.truncated
            rewards = (shard.rewards / statistics.reward_std).astype(np.float32)
            returns.append(self._lambda_returns(rewards, behind, ended).reshape(len(values), -1))
            inputs.append(now)
        return _Targets(np.concatenate(inputs), np.concatenate(returns, axis=1))

    def _lambda_returns(self, rewards: Array, behind: Array, ended: NDArray[np.bool_]) -> Array:
        """`(members, length, slots)` from rewards (length, slots) and the values behind each step (members, ...)."""
        gamma, trace = np.float32(self._gamma), np.float32(self._settings.td_lambda)
        returns = np.empty_like(behind)
        following = behind[:, -1]
        for time in range(len(rewards) - 1, -1, -1):
            mixed = (1 - trace) * behind[:, time] + trace * following
            # No trace leads across an end: there `behind` is 0, or the value of the truncated state.
            returns[:, time] = rewards[time] + gamma * np.where(ended[time], behind[:, time], mixed)
            following = returns[:, time]
        return returns

    def _seen(self, observations: Observations, statistics: Statistics) -> Array:
        scaled = statistics.scaled(observations)
        if isinstance(scaled, dict):
            raise TypeError("an ensemble takes flat observations")
        return seen_by_members(scaled.reshape(-1, scaled.shape[-1]).astype(np.float32), self._unseen)

    def _values(self, inputs: Array) -> Array:
        with torch.no_grad():
            values: Array = self._forward(torch.as_tensor(inputs)).numpy()
        return values
