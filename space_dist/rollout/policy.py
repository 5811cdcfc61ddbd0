"""Policies as actors see them: act on observations, and say what a state is worth. NumPy only.

The multilayer perceptrons of Stable-Baselines3's learners are evaluated here without torch. Anything else (CNNs,
dictionary observations, a user's own policy) comes from `learner` as another `Policy`, which acts through torch. What
recurrent ones have seen of an episode is kept beside them (`memory`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs import Observations
from space_dist.envs.observations import rows

Array = NDArray[np.float32]
Actions = NDArray[Any]
Layers = tuple[tuple[Array, Array], ...]
Activation = Literal["tanh", "relu"]

LOG_STD_RANGE = (-20.0, 2.0)  # of SAC's actor; stable_baselines3/sac/policies.py
OBSERVATION_CLIP = 10.0  # of normalised observations; SB3's VecNormalize


@dataclass(frozen=True)
class Exploration:
    """What an off-policy learner does to its actions while it collects, as a function of the environment step.

    learning_starts: before this step, actions are uniformly random.
    epsilon_initial, epsilon_final, decay_steps: of epsilon-greedy: linear in the step, as SB3's schedule.
    noise_std: of Gaussian noise on actions scaled to [-1, 1] (TD3).
    """

    learning_starts: int = 0
    epsilon_initial: float = 0.0
    epsilon_final: float = 0.0
    decay_steps: float = 1.0
    noise_std: float = 0.0

    def epsilon(self, steps: NDArray[np.int64]) -> NDArray[np.float64]:
        """The probability of a random action at each step."""
        share = np.minimum(steps / self.decay_steps, 1.0) if self.decay_steps > 0 else np.ones(len(steps))
        return self.epsilon_initial + share * (self.epsilon_final - self.epsilon_initial)


@dataclass(frozen=True)
class Head:
    """How a network's outputs become actions.

    kind: gaussian (mean; `log_std` apart), categorical (logits), greedy (values of actions), squashed (mean and log
        std of a Gaussian before tanh), deterministic (before tanh).
    low, high: (action_dim,) bounds of a continuous action space.
    """

    kind: Literal["gaussian", "categorical", "greedy", "squashed", "deterministic"]
    log_std: Array | None = None
    low: Array | None = None
    high: Array | None = None
    exploration: Exploration = Exploration()

    @functools.cached_property
    def _limits(self) -> list[Any]:
        """`low` and `high`; a number where all dimensions have it, by which NumPy clips three times as fast."""
        sides = [np.zeros(0) if side is None else side for side in (self.low, self.high)]
        return [side[0] if len(side) and (side == side[0]).all() else side for side in sides]

    def best(self, outputs: Array) -> Actions:
        """The most likely or most valuable actions, as a replay or rollout buffer stores them: `(n, ...)`."""
        best: Actions = outputs
        if self.kind in ("categorical", "greedy"):
            best = np.argmax(outputs, axis=1)
        elif self.kind != "gaussian":
            best = np.tanh(outputs if self.kind == "deterministic" else np.split(outputs, 2, axis=1)[0])
        return best

    def sampled(self, outputs: Array, noise: Noise, time: int, steps: NDArray[np.int64]) -> Actions:
        """Exploring actions, as a buffer stores them. steps: (n,) the environment step of each transition."""
        drawn = noise.drawn[time]
        sampled: Actions = outputs
        if self.kind == "gaussian" and self.log_std is not None:
            sampled = outputs + np.exp(self.log_std) * drawn
        elif self.kind == "categorical":
            # The Gumbel-max trick: with such noise on the logits, the largest is a draw from their softmax.
            sampled = np.argmax(outputs + drawn, axis=1)
        else:
            # SB3's warm-up: uniformly random actions until learning starts.
            early = steps < self.exploration.learning_starts
            uniform = noise.uniform[time]
            if self.kind == "greedy":
                count = outputs.shape[1]
                explore = early | (uniform[:, 0] < self.exploration.epsilon(steps))
                # min: in float32 the product of a number just below 1 may round up to `count`.
                random = np.minimum((uniform[:, 1] * count).astype(np.int64), count - 1)
                sampled = np.where(explore, random, np.argmax(outputs, axis=1))
            elif self.kind == "squashed":
                mean, log_std = np.split(outputs, 2, axis=1)
                acting = np.tanh(mean + np.exp(np.clip(log_std, *LOG_STD_RANGE)) * drawn)
                sampled = np.where(early[:, None], 2.0 * uniform - 1.0, acting).astype(np.float32)
            else:
                acting = np.clip(np.tanh(outputs) + np.float32(self.exploration.noise_std) * drawn, -1.0, 1.0)
                sampled = np.where(early[:, None], 2.0 * uniform - 1.0, acting).astype(np.float32)
        return sampled

    def executed(self, actions: Actions) -> Actions:
        """What the environment is given for stored actions: clipped (SB3's PPO) or scaled to the bounds (SB3's SAC)."""
        if self.low is None or self.high is None:
            return actions
        continuous: Actions = actions.astype(np.float32, copy=False)
        if self.kind == "gaussian":
            clipped: Actions = np.clip(continuous, *self._limits)
            return clipped
        scaled: Actions = self.low + np.float32(0.5) * (continuous + np.float32(1.0)) * (self.high - self.low)
        return scaled


@dataclass(frozen=True)
class Noise:
    """All random numbers a shard acts with, drawn at once: (length, slots, ...) each."""

    drawn: Array
    uniform: Array

    @classmethod
    def draw(cls, head: Head, space: spaces.Space[Any], random: np.random.Generator, shape: tuple[int, int]) -> Noise:
        """`head`'s numbers for actions of `space`."""
        nothing = np.zeros((shape[0], 0), dtype=np.float32)
        if head.kind == "categorical" and isinstance(space, spaces.Discrete):
            return cls(random.gumbel(size=(*shape, int(space.n))).astype(np.float32), nothing)
        if head.kind == "greedy":
            return cls(nothing, random.random(size=(*shape, 2), dtype=np.float32))
        drawn = random.standard_normal(size=(*shape, *(space.shape or ())), dtype=np.float32)
        if head.kind == "gaussian":
            return cls(drawn, nothing)
        return cls(drawn, random.random(size=drawn.shape, dtype=np.float32))

    @classmethod
    def joined(cls, parts: Sequence[Noise]) -> Noise:
        """The numbers of several shards, whose slots lie one after another."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate([getattr(part, name) for part in parts], axis=1) for name in ("drawn", "uniform")))

    def at(self, times: NDArray[np.int64]) -> Noise:
        """The numbers of a single step, which is another for each slot: `(slots,)` times, the last where beyond it."""
        slots = np.arange(len(times))
        drawn, uniform = (
            part[np.minimum(times, len(part) - 1), slots][None] if part.size else part
            for part in (self.drawn, self.uniform)
        )
        return Noise(drawn, uniform)


@dataclass(frozen=True)
class Statistics:
    """Scales of observations and rewards, as of one version of the weights; None where nothing is normalised.

    mean, std: (obs_dim,) of observations.  reward_std: of discounted returns, by which rewards were divided.
    """

    mean: NDArray[np.float64] | None = None
    std: NDArray[np.float64] | None = None
    reward_std: float = 1.0

    def scaled(self, observations: Observations) -> Observations:
        """Normalised observations, clipped as SB3's VecNormalize does."""
        if self.mean is None or self.std is None or isinstance(observations, dict):
            return observations
        scaled = (observations - self.mean) / self.std
        return np.clip(scaled, -OBSERVATION_CLIP, OBSERVATION_CLIP).astype(np.float32)


class Valuing(Protocol):
    """Whatever says what states are worth."""

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """`(n, obs_dim) -> (n, ...)` what the states are worth, in unscaled reward units."""


class Acting(Protocol):
    """Whatever acts."""

    @property
    def head(self) -> Head:
        """How outputs become actions."""

    def outputs(self, observations: Observations) -> Array:
        """`(n, obs_dim) -> (n, n_outputs)` for the head."""


class Policy(Acting, Protocol):
    """A policy and its value function as of one update."""

    @property
    def version(self) -> int:
        """How many updates made it."""

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """`(n, obs_dim) -> (n,)` what the states are worth, in unscaled reward units."""


@dataclass(frozen=True)
class MlpPolicy:
    """Multilayer perceptrons.

    actor: layers of (weights (n_in, n_out), biases (n_out,)).
    critics: V(s), one network; or Q(s, a), one or more, whose least counts. A greedy policy's actor is Q itself; a
        critic, if there is one, is the network that scores in its stead.
    """

    version: int
    activation: Activation
    head: Head
    actor: Layers
    critics: tuple[Layers, ...]
    critics_take_actions: bool = False
    statistics: Statistics = Statistics()

    def outputs(self, observations: Observations) -> Array:
        """See `Policy`."""
        return forward(self.actor, self.activation, _flat(self.statistics.scaled(observations)))

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """See `Policy`: V(s), max_a Q(s, a), or min_k Q_k(s, pi(s))."""
        scaled = _flat(self.statistics.scaled(observations))
        if self.head.kind == "greedy":
            scoring = self.critics[0] if self.critics else self.actor
            values = forward(scoring, self.activation, scaled).max(axis=1)
        else:
            inputs = scaled
            if self.critics_take_actions:
                best = self.head.best(forward(self.actor, self.activation, scaled)).astype(np.float32)
                inputs = np.concatenate([scaled, best], axis=1)
            values = forward(self.critics[0], self.activation, inputs)[:, 0]
            # The least of them, as SAC and TD3 bootstrap: a single one overestimates (Fujimoto et al. 2018).
            for critic in self.critics[1:]:
                values = np.minimum(values, forward(critic, self.activation, inputs)[:, 0])
        scaled_values: NDArray[np.float64] = values.astype(np.float64) * self.statistics.reward_std
        return scaled_values


@dataclass(frozen=True)
class Several:
    """Policies that share a curriculum: each acts for itself; a state is worth what they think of it on average."""

    version: int
    policies: tuple[Policy, ...]

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """`(n, obs_dim) -> (n,)` the mean of the policies' values, in unscaled reward units."""
        values: NDArray[np.float64] = np.mean([policy.values(observations) for policy in self.policies], axis=0)
        return values


def policies_of(policy: Policy | Several) -> tuple[Policy, ...]:
    """The policies that act."""
    return policy.policies if isinstance(policy, Several) else (policy,)


@dataclass(frozen=True)
class EnsemblePolicy:
    """The value functions of an ensemble, each for itself; none of them acts.

    members: the layers of each.  unseen: (k,) positions in an observation that all members see as 0.
    """

    activation: Activation
    members: tuple[Layers, ...]
    unseen: NDArray[np.int64]
    statistics: Statistics = Statistics()

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """`(n, obs_dim) -> (n, members)`."""
        inputs = seen_by_members(_flat(self.statistics.scaled(observations)), self.unseen)
        values = np.concatenate([forward(member, self.activation, inputs) for member in self.members], axis=1)
        scaled: NDArray[np.float64] = values.astype(np.float64) * self.statistics.reward_std
        return scaled


def seen_by_members(inputs: Array, unseen: NDArray[np.int64]) -> Array:
    """`(n, obs_dim)` flat observations without what an ensemble's members do not see."""
    if not len(unseen):
        return inputs
    seen = inputs.copy()
    seen[:, unseen] = 0.0
    return seen


@dataclass(frozen=True)
class BlindPolicy:
    """Actions that ignore the observation: what the first scales of observations and rewards are measured with."""

    version: int
    head: Head
    n_outputs: int

    def outputs(self, observations: Observations) -> Array:
        """See `Policy`: always 0."""
        return np.zeros((rows(observations), self.n_outputs), dtype=np.float32)

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """See `Policy`: unknown, so 0."""
        return np.zeros(rows(observations))


def blind(policy: Policy, action_space: spaces.Space[Any], version: int) -> BlindPolicy:
    """A policy with `policy`'s head that sees nothing; off-policy heads act uniformly at random."""
    head = dataclasses.replace(policy.head, exploration=Exploration(learning_starts=1 << 62))
    if isinstance(action_space, spaces.Discrete):
        return BlindPolicy(version, head, int(action_space.n))
    n_actions = int(np.prod(action_space.shape or ()))
    return BlindPolicy(version, head, 2 * n_actions if head.kind == "squashed" else n_actions)


def batched(policies: Sequence[Policy], rows: int) -> Acting:
    """One policy that acts for several, of which each has `rows` rows of the observations, in order.

    Each acts as it does alone, bit for bit. Raises TypeError for several that cannot: see `can_be_batched`.
    """
    if len(policies) == 1:
        return policies[0]
    return _BatchedPolicies(policies, rows)


def can_be_batched(policies: Sequence[Policy]) -> bool:
    """Whether all are multilayer perceptrons of one shape with the same kind of head, Gaussian or categorical."""
    mlps = [policy for policy in policies if isinstance(policy, MlpPolicy)]
    shapes = {(one.head.kind, one.activation, *(weight.shape for weight, _ in one.actor)) for one in mlps}
    return len(mlps) == len(policies) and len(shapes) == 1 and mlps[0].head.kind in ("gaussian", "categorical")


class _BatchedPolicies:
    def __init__(self, policies: Sequence[Policy], rows: int) -> None:
        if not can_be_batched(policies):
            raise TypeError("only multilayer perceptrons of one shape, Gaussian or categorical, act side by side")
        mlps = [policy for policy in policies if isinstance(policy, MlpPolicy)]
        first = mlps[0]
        self._shape, self._activation = (len(mlps), rows), first.activation
        self._layers = tuple(
            (np.stack([weight for weight, _ in layer]), np.stack([bias for _, bias in layer])[:, None])
            for layer in zip(*(one.actor for one in mlps), strict=True)
        )
        self._statistics = _stacked([one.statistics for one in mlps])
        self.head = first.head
        if first.head.log_std is not None:
            log_std = np.stack([one.head.log_std for one in mlps if one.head.log_std is not None])
            self.head = dataclasses.replace(first.head, log_std=np.repeat(log_std, rows, axis=0))

    def outputs(self, observations: Observations) -> Array:
        inputs = _flat(self._statistics.scaled(_flat(observations).reshape(*self._shape, -1)))
        return forward(self._layers, self._activation, inputs).reshape(self._shape[0] * self._shape[1], -1)


def _stacked(statistics: Sequence[Statistics]) -> Statistics:
    """Scales of observations for `(len(statistics), rows, obs_dim)` of them; all are normalised or none is."""
    if statistics[0].mean is None:
        return Statistics()
    means, stds = ([getattr(one, name) for one in statistics] for name in ("mean", "std"))
    return Statistics(np.stack(means)[:, None], np.stack(stds)[:, None])


def forward(layers: Layers, activation: Activation, inputs: Array) -> Array:
    """`(n, n_in) -> (n, n_out)`; the last layer is linear. Leading axes of layers and inputs are stacks of networks."""
    for weights, biases in layers[:-1]:
        inputs = inputs @ weights
        inputs += biases
        if activation == "tanh":
            np.tanh(inputs, out=inputs)
        else:
            np.maximum(inputs, 0.0, out=inputs)
    weights, biases = layers[-1]
    return inputs @ weights + biases


def _flat(observations: Observations) -> Array:
    if isinstance(observations, dict):
        raise TypeError("a multilayer perceptron takes flat observations")
    return observations.astype(np.float32, copy=False)


def to_arrays(policy: MlpPolicy) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A policy as arrays and a description, for `model.npz` and `model.json`: usable without this package."""
    arrays: dict[str, NDArray[Any]] = {}
    for part, layers in _parts(policy):
        for index, (matrix, bias) in enumerate(layers):
            arrays |= {f"{part}.{index}.weight": matrix, f"{part}.{index}.bias": bias}
    head, statistics = policy.head, policy.statistics
    optional = {
        "log_std": head.log_std, "action_low": head.low, "action_high": head.high,
        "observation_mean": statistics.mean, "observation_std": statistics.std,
    }  # fmt: skip
    arrays |= {name: array for name, array in optional.items() if array is not None}
    return arrays, {
        "format": 2,
        "version": policy.version,
        "activation": policy.activation,
        "policy": head.kind,
        "critics": len(policy.critics),
        "critics_take_actions": policy.critics_take_actions,
        "reward_std": statistics.reward_std,
        "formula": "x = activation(x @ weight + bias) per layer; the last layer is linear",
        "shapes": {name: list(array.shape) for name, array in arrays.items()},
    }


def from_arrays(arrays: Mapping[str, NDArray[Any]], description: Mapping[str, Any]) -> MlpPolicy:
    """The inverse of `to_arrays`, less exploration. Raises KeyError or ValueError for anything else."""
    if description["format"] != 2 or description["activation"] not in ("tanh", "relu"):
        raise ValueError("not a model description of format 2")
    kinds = ("gaussian", "categorical", "greedy", "squashed", "deterministic")
    if description["policy"] not in kinds or not math.isfinite(description["reward_std"]):
        raise ValueError("not a policy this version knows")

    def layers(part: str) -> Layers:
        count = sum(name.startswith(f"{part}.") for name in arrays) // 2
        return tuple((arrays[f"{part}.{index}.weight"], arrays[f"{part}.{index}.bias"]) for index in range(count))

    return MlpPolicy(
        version=int(description["version"]),
        activation=description["activation"],
        head=Head(
            description["policy"], arrays.get("log_std"), arrays.get("action_low"), arrays.get("action_high")
        ),
        actor=layers("actor"),
        critics=tuple(layers(f"critic{index}") for index in range(int(description["critics"]))),
        critics_take_actions=bool(description["critics_take_actions"]),
        statistics=Statistics(
            arrays.get("observation_mean"), arrays.get("observation_std"), float(description["reward_std"])
        ),
    )  # fmt: skip


def _parts(policy: MlpPolicy) -> list[tuple[str, Layers]]:
    return [("actor", policy.actor), *((f"critic{index}", layers) for index, layers in enumerate(policy.critics))]
