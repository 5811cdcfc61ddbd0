"""What every learner does, and what all of them share: seeding, saving, and how divergence is told."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

from space_dist.config import LearnerConfig
from space_dist.envs.interface import refuse_actions
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.learner import custom
from space_dist.learner.networks import is_mlp, refuse_policy, torch_policy
from space_dist.learner.normaliser import Normaliser
from space_dist.rollout import Shard
from space_dist.rollout.policy import Policy, Several, Statistics
from space_dist.seeding import Purpose, global_generators, global_seeds

if TYPE_CHECKING:  # it derives from what is here
    from space_dist.learner.population import PopulationLearner

Arrays = dict[str, NDArray[Any]]
NOT_A_NUMBER = "a weight is not a number"


@dataclass(frozen=True)
class Update:
    """What one update reported: SB3's own training metrics, and how many optimiser steps the scored network took.

    advantages: (length, slots of all shards) GAE of each transition, in reward units; None for learners without
        advantages.
    """

    metrics: dict[str, float]
    gradient_steps: int
    advantages: NDArray[np.float64] | None = None


class Learner(Protocol):
    """What a run needs of whatever it trains.

    Stable-Baselines3's algorithms are `SB3Learner`s; several that share a curriculum are a `CoupledLearner`.
    """

    @property
    def learners(self) -> Sequence[PopulationLearner]:
        """Those whose updates, made together with others', make this one's; none where it is made alone."""

    @property
    def normalises(self) -> bool:
        """Whether observations or rewards are normalised: start values must then be compared at one scale."""

    @property
    def statistics(self) -> Statistics:
        """The scales in force: what actors act with until the next update."""

    @property
    def policy_name(self) -> str:
        """The class of the policy, in words."""

    def policy(self, version: int) -> Policy | Several:
        """A copy of the policy and its value function, for actors."""

    def scored(self) -> Arrays:
        """The weights of the networks as they are, for `policy_of` to score later under later scales."""

    def policy_of(self, scored: Mapping[str, NDArray[Any]], version: int) -> Policy | Several:
        """The policy of earlier weights, under the scales in force now."""

    def observe(self, shards: Sequence[Shard]) -> None:
        """Take a round's transitions into the statistics, in shard order, without learning from them."""

    def update(
        self, shards: Sequence[Shard], *, round: int, steps: int, acted: Mapping[str, NDArray[Any]] | None = None
    ) -> Update:  # fmt: skip
        """One update on one round's shards, in shard order. `steps`: environment steps including this round's.

        acted: the weights that the shards were collected with, if those are not the present ones (`scored` gave them).
        Raises SpaceDistError if the networks are no longer numbers.
        """

    def look_at(
        self, shards: Sequence[Shard], *, round: int, acted: Mapping[str, NDArray[Any]] | None = None
    ) -> Update:  # fmt: skip
        """What an update on these shards would say of their advantages, without one; otherwise as `update`.

        The shards enter the statistics. Raises RuntimeError for learners without advantages.
        """

    def parts(self, shards: Sequence[Shard]) -> list[list[Shard]]:
        """The shards of each of `learners`, counted from 0."""

    def combined(self, updates: Sequence[Update | SpaceDistError]) -> Update:
        """The updates of `learners` as one. Raises what one of them failed with."""

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and plain data from which `load` restores the learner bit for bit; replay buffers apart."""

    def load(self, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """Restore what `save` gave."""

    @property
    def seen(self) -> int:
        """How many transitions have entered the replay buffer so far."""

    @property
    def capacity(self) -> int:
        """How many the replay buffer remembers; 0 where there is none."""

    def transitions(self, first: int) -> Arrays:
        """What entered the replay buffer since it had seen `first` transitions; nothing where there is no buffer."""

    def remember(self, arrays: Mapping[str, NDArray[Any]], first: int) -> None:
        """Put back what `transitions(first)` gave. Raises RuntimeError where there is no buffer."""


class SB3Learner(abc.ABC):
    """One of Stable-Baselines3's algorithms, on transitions that somebody else collected: a `Learner`.

    model: SB3's algorithm object; it has no environment.
    """

    model: Any

    def __init__(
        self,
        config: LearnerConfig,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        seed: int,
        total_steps: int,
    ) -> None:
        self._config, self._seed, self._total_steps = config, seed, total_steps
        self._advantages: NDArray[np.float64] | None = None  # of the last update
        self._acted: Mapping[str, NDArray[Any]] | None = None  # for the present one
        refuse_spaces(config, observation_space, action_space)
        self._normaliser = (
            Normaliser(observation_space, config.gamma, config.normalize_observations, config.normalize_rewards)
            if config.normalize_observations or config.normalize_rewards
            else None
        )
        with _seeded(seed, Purpose.INITIAL_NETWORK):
            self.model = self._build(observation_space, action_space)
        # SB3 makes its logger in `learn()`, which is never called here, and `train()` records into one.
        self.model.set_logger(Logger(folder=None, output_formats=[]))

    @abc.abstractmethod
    def _build(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> BaseAlgorithm:
        """SB3's algorithm with fresh networks."""

    @abc.abstractmethod
    def _mlp(self, version: int, statistics: Statistics) -> Policy:
        """The networks for NumPy: copies."""

    @abc.abstractmethod
    def _learn(self, shards: Sequence[Shard], *, steps: int) -> None:
        """Fill SB3's buffer and train. `steps`: of the run, with these shards."""

    @abc.abstractmethod
    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """All of them, by name; the one of the scored network first."""

    @property
    def normalises(self) -> bool:
        """See `Learner`."""
        return self._normaliser is not None

    @property
    def statistics(self) -> Statistics:
        """See `Learner`."""
        return self._normaliser.statistics if self._normaliser else Statistics()

    def policy(self, version: int) -> Policy:
        """See `Learner`."""
        if is_mlp(self._config, self.model.observation_space):
            return self._mlp(version, self.statistics)
        return torch_policy(self._config, self.model, version, self.statistics, self._head())

    def scored(self) -> Arrays:
        """See `Learner`."""
        return {name: _copy(tensor) for name, tensor in self.model.policy.state_dict().items()}

    def policy_of(self, scored: Mapping[str, NDArray[Any]], version: int) -> Policy:
        """See `Learner`."""
        with self._weights(scored):
            return self.policy(version)

    @contextmanager
    def _weights(self, others: Mapping[str, NDArray[Any]] | None) -> Iterator[None]:
        """Have other weights meanwhile: what `scored` gave earlier. None: these."""
        if others is None:
            yield
            return
        now = self.scored()
        self.model.policy.load_state_dict({name: torch.as_tensor(array.copy()) for name, array in others.items()})
        try:
            yield
        finally:
            self.model.policy.load_state_dict({name: torch.as_tensor(array) for name, array in now.items()})

    @property
    def learners(self) -> Sequence[PopulationLearner]:
        """See `Learner`."""
        return ()

    @property
    def policy_name(self) -> str:
        """See `Learner`."""
        return str(type(self.model.policy))

    def parts(self, shards: Sequence[Shard]) -> list[list[Shard]]:
        """See `Learner`."""
        return [list(shards) for _ in self.learners]

    def combined(self, updates: Sequence[Update | SpaceDistError]) -> Update:
        """See `Learner`."""
        (update,) = updates
        if isinstance(update, SpaceDistError):
            raise update
        return update

    @abc.abstractmethod
    def _head(self) -> Any:
        """How outputs become actions."""

    def observe(self, shards: Sequence[Shard]) -> None:
        """See `Learner`."""
        if self._normaliser is not None:
            self._normaliser.update(shards)

    def update(
        self, shards: Sequence[Shard], *, round: int, steps: int, acted: Mapping[str, NDArray[Any]] | None = None
    ) -> Update:  # fmt: skip
        """See `Learner`."""
        require_order(shards)
        self._acted = acted
        before = self._gradient_steps()
        with _divergence_explained(round), _seeded(self._seed, Purpose.UPDATE, round):
            self._learn(shards, steps=steps)
            numbers = torch.cat([parameter.detach().flatten() for parameter in self.model.policy.parameters()])
            if not torch.isfinite(numbers).all():
                raise ValueError(NOT_A_NUMBER)
        return self._learnt(shards, before)

    def look_at(
        self, shards: Sequence[Shard], *, round: int, acted: Mapping[str, NDArray[Any]] | None = None
    ) -> Update:  # fmt: skip
        """See `Learner`."""
        require_order(shards)
        self._acted = acted
        with _divergence_explained(round), _seeded(self._seed, Purpose.UPDATE, round):
            advantages = self._gae(shards)
        self.observe(shards)
        return Update({}, 0, advantages)

    def _gae(self, shards: Sequence[Shard]) -> NDArray[np.float64]:  # noqa: ARG002 - on-policy learners need them
        """GAE of each transition, as `Update.advantages`."""
        raise RuntimeError(f"{type(self.model).__name__} computes no advantages")

    def _learnt(self, shards: Sequence[Shard], before: int) -> Update:
        """What an update reports, of the gradient steps since there were `before`; the statistics take in the shards.

        That comes after learning: advantages and actions belong to the statistics that acted.
        """
        self.observe(shards)
        recorded = self.model.logger.name_to_value
        metrics = {
            name.removeprefix("train/").removeprefix("rollout/"): float(value)
            for name, value in recorded.items()
            if isinstance(value, int | float | np.number) and np.isfinite(value)
        }
        # Else this update's numbers would stand in the next one's, where that records fewer.
        recorded.clear()
        return Update({**metrics, **self._more_metrics(metrics)}, self._gradient_steps() - before, self._advantages)

    def _more_metrics(self, metrics: Mapping[str, float]) -> dict[str, float]:  # noqa: ARG002 - SAC's needs them
        return {"reward_std": self.statistics.reward_std} if self.statistics.reward_std != 1.0 else {}

    def _gradient_steps(self) -> int:
        """Steps that the optimiser of the scored network has made so far."""
        # Of the scored network: without a step of its own no set may grow (docs/algorithm.md, decision 5).
        first = next(iter(self._optimizers().values()))
        return max((int(state["step"]) for state in first.state.values()), default=0)

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """See `Learner`."""
        arrays: Arrays = {f"policy/{name}": _copy(tensor) for name, tensor in self.model.policy.state_dict().items()}
        numbers: dict[str, float] = {}
        for kind, optimizer in self._optimizers().items():
            for index, slots in optimizer.state_dict()["state"].items():
                for name, value in slots.items():
                    if isinstance(value, torch.Tensor):
                        arrays[f"optimizer/{kind}/{index}/{name}"] = _copy(value)
                    else:
                        numbers[f"{kind}/{index}/{name}"] = value
        if self._normaliser is not None:
            arrays |= {f"normaliser/{name}": array for name, array in self._normaliser.save().items()}
        data = {"n_updates": self.model._n_updates, "optimizer_numbers": numbers}
        if self._config.import_path is None:
            return arrays, data
        with _seeded(self._seed, Purpose.INITIAL_NETWORK):
            # As a resumed run would make it.
            twin = self._build(self.model.observation_space, self.model.action_space)
        columns, own = custom.saved(self.model, twin, self._config)
        return {**arrays, **{f"own/{name}": array for name, array in columns.items()}}, {**data, "own": own}

    def load(self, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """See `Learner`."""
        self.model.policy.load_state_dict(
            {name.removeprefix("policy/"): torch.as_tensor(array.copy())
             for name, array in arrays.items() if name.startswith("policy/")}
        )  # fmt: skip
        states: dict[str, dict[int, dict[str, Any]]] = {kind: {} for kind in self._optimizers()}
        for name, array in arrays.items():
            if name.startswith("optimizer/"):
                _, kind, index, slot = name.split("/")
                states[kind].setdefault(int(index), {})[slot] = torch.as_tensor(array.copy())
        for name, number in data["optimizer_numbers"].items():
            kind, index, slot = name.split("/")
            states[kind].setdefault(int(index), {})[slot] = number
        for kind, optimizer in self._optimizers().items():
            groups = optimizer.state_dict()["param_groups"]
            optimizer.load_state_dict({"state": states[kind], "param_groups": groups})
        if self._normaliser is not None:
            prefix = "normaliser/"
            self._normaliser.load(
                {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
            )
        self.model._n_updates = int(data["n_updates"])
        if self._config.import_path is not None:
            columns = {
                name.removeprefix("own/"): array.copy() for name, array in arrays.items() if name.startswith("own/")
            }
            custom.load({**columns, **data["own"]}, self.model, self._config)

    def transitions(self, first: int) -> Arrays:  # noqa: ARG002 - the signature of those that have a buffer
        """See `Learner`."""
        return {}

    @property
    def seen(self) -> int:
        """See `Learner`."""
        return 0

    @property
    def capacity(self) -> int:
        """See `Learner`."""
        return 0

    def remember(self, arrays: Mapping[str, NDArray[Any]], first: int) -> None:  # noqa: ARG002 - as above
        """See `Learner`."""
        raise RuntimeError("this learner keeps no replay buffer")


def require_order(shards: Sequence[Shard]) -> None:
    """Raise RuntimeError unless a round's shards come in shard order."""
    if [shard.shard for shard in shards] != list(range(len(shards))):
        raise RuntimeError(f"shards arrived in the order {[shard.shard for shard in shards]}")


def schedule(rate: float, kind: str) -> Any:
    """A learning rate as SB3 takes it: a number, or a function of the remaining share of the run."""
    return (lambda remaining: rate * remaining) if kind == "linear" else rate


def _copy(tensor: torch.Tensor) -> NDArray[Any]:
    array: NDArray[Any] = tensor.detach().cpu().numpy().copy()
    return array


def refuse_spaces(config: LearnerConfig, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """Raise ConfigError if a learner cannot work with these spaces."""
    kind = config.kind
    flat = isinstance(observation_space, spaces.Box) and len(observation_space.shape) == 1
    refuse_policy(config, observation_space)
    custom.algorithm_class(config)
    if config.normalize_observations and not flat:
        raise ConfigError("learner.normalize_observations: only flat observations can be normalised")
    continuous = isinstance(action_space, spaces.Box) and len(action_space.shape) == 1
    discrete = isinstance(action_space, spaces.Discrete) and action_space.start == 0
    if config.actions == "discrete" and not discrete:
        raise ConfigError(f"learner.kind: {kind} needs discrete actions (Discrete from 0), not {action_space}")
    bounded = isinstance(action_space, spaces.Box) and action_space.is_bounded()
    if config.actions == "bounded" and not (continuous and bounded):
        raise ConfigError(f"learner.kind: {kind} needs bounded continuous actions (a flat Box), not {action_space}")
    refuse_actions(action_space)


@contextmanager
def _seeded(seed: int, purpose: Purpose, *keys: int) -> Iterator[None]:
    """Python's, NumPy's and torch's global generators seeded for one piece of work, and restored."""
    with global_generators(seed, purpose, *keys), torch.random.fork_rng(devices=[]):
        # Not torch.manual_seed, which takes note of its caller for every kind of device that it does not find.
        torch.default_generator.manual_seed(global_seeds(seed, purpose, *keys)[2])
        yield


@contextmanager
def _divergence_explained(round: int) -> Iterator[None]:
    """Users need the cause: torch refuses distributions of NaN, and steps beyond float32, with errors about tensors."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "overflow" not in str(error):
            raise
        raise divergence(round, str(error)) from error


def divergence(round: int, reason: str) -> SpaceDistError:
    """That an update's networks are no longer numbers, for users."""
    return SpaceDistError(
        f"training diverged in update {round + 1}: the networks are no longer numbers. A smaller "
        f"learner.learning_rate usually helps ({reason.splitlines()[0][:120]})"
    )
