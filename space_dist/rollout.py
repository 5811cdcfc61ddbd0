"""Collecting episodes, evaluating policies and scoring instances: pure functions of (weights, selection, seed).

Policies are evaluated here in NumPy, so a rollout actor imports neither torch nor Stable-Baselines3. The number of
shards, the slots of a shard and the size of every chunk are fixed by the config: whoever computes a piece of work, and
how often, it gives the same bits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, make_batched
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, episode_seeds, generator

Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Layers = tuple[tuple[Array, Array], ...]
Split = Literal["train", "test"]

CHUNK = 65_536  # start observations scored by one call
BLOCK = 2_048  # rows of one matrix product: what fits the cache. Both are part of every result
TERMINATED, TRUNCATED, CUT = 0, 1, 2


@dataclass(frozen=True)
class MlpWeights:
    """An actor-critic of two multilayer perceptrons, as NumPy sees it.

    version: how many updates made these weights.
    actor, critic: layers of (weights (n_in, n_out), biases (n_out,)).
    log_std: (action_dim,) of a Gaussian policy; None for a categorical one.
    """

    version: int
    activation: Literal["tanh", "relu"]
    actor: Layers
    critic: Layers
    log_std: Array | None


def to_arrays(weights: MlpWeights) -> tuple[dict[str, Array], dict[str, Any]]:
    """A policy as arrays and a description, for `model.npz` and `model.json`: usable without this package."""
    arrays: dict[str, Array] = {}
    for part in ("actor", "critic"):
        for index, (matrix, bias) in enumerate(getattr(weights, part)):
            arrays |= {f"{part}.{index}.weight": matrix, f"{part}.{index}.bias": bias}
    if weights.log_std is not None:
        arrays["log_std"] = weights.log_std
    return arrays, {
        "format": 1,
        "version": weights.version,
        "activation": weights.activation,
        "policy": "categorical" if weights.log_std is None else "gaussian",
        "formula": "x = activation(x @ weight + bias) per layer; the last layer is linear",
        "shapes": {name: list(array.shape) for name, array in arrays.items()},
    }


def from_arrays(arrays: Mapping[str, Array], description: Mapping[str, Any]) -> MlpWeights:
    """The inverse of `to_arrays`. Raises KeyError or ValueError for anything else."""
    if description["format"] != 1 or description["activation"] not in ("tanh", "relu"):
        raise ValueError("not a model description of format 1")

    def layers(part: str) -> Layers:
        count = sum(name.startswith(f"{part}.") for name in arrays) // 2
        return tuple((arrays[f"{part}.{index}.weight"], arrays[f"{part}.{index}.bias"]) for index in range(count))

    log_std = arrays["log_std"] if description["policy"] == "gaussian" else None
    activation: Literal["tanh", "relu"] = description["activation"]
    return MlpWeights(int(description["version"]), activation, layers("actor"), layers("critic"), log_std)


def forward(layers: Layers, activation: str, inputs: Array) -> Array:
    """`(n, n_in) -> (n, n_out)`; the last layer is linear."""
    for weights, biases in layers[:-1]:
        inputs = inputs @ weights
        inputs += biases
        if activation == "tanh":
            np.tanh(inputs, out=inputs)
        else:
            np.maximum(inputs, 0.0, out=inputs)
    weights, biases = layers[-1]
    return inputs @ weights + biases


def values(weights: MlpWeights, observations: Array) -> Array:
    """`(n, obs_dim) -> (n,)` V(s) of the critic."""
    return forward(weights.critic, weights.activation, observations)[:, 0]


def act(weights: MlpWeights, observations: Array, noise: Array | None) -> NDArray[np.generic]:
    """Actions for `(n, obs_dim)` observations: sampled with `noise`, the most likely ones without.

    noise: (n, action_dim), standard normal for Gaussian policies and Gumbel for categorical ones.
    """
    outputs = forward(weights.actor, weights.activation, observations)
    actions: NDArray[np.generic] = outputs
    if weights.log_std is None:
        actions = np.argmax(outputs if noise is None else outputs + noise, axis=1)
    elif noise is not None:
        actions = outputs + np.exp(weights.log_std) * noise
    return actions


def executed(action_space: spaces.Space[NDArray[np.generic]], actions: NDArray[np.generic]) -> NDArray[np.generic]:
    """What the environment is given: Gaussian actions are clipped to the action space, as SB3 does."""
    if isinstance(action_space, spaces.Box):
        return np.clip(actions.astype(np.float32, copy=False), action_space.low, action_space.high)
    return actions


@dataclass(frozen=True)
class Episodes:
    """One entry per episode, in the order in which they started.

    ids: instance.  slots, starts, lengths: where in the shard, in steps.  returns, discounted_returns: sums of rewards.
    success: whether the goal was reached at the last step; NaN where the environment knows no success.
    ends: TERMINATED, TRUNCATED (by the environment's horizon) or CUT (by the end of the round).
    """

    ids: IntArray
    slots: IntArray
    starts: IntArray
    lengths: IntArray
    returns: FloatArray
    discounted_returns: FloatArray
    success: FloatArray
    ends: IntArray

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Shard:
    """What one shard collected in one round; time runs along axis 0, slots along axis 1.

    observations (length, slots, obs_dim), actions (length, slots, ...) as sampled, rewards (length, slots),
    terminated, truncated (length, slots).
    last_observations: (slots, obs_dim) behind the last step, from which cut episodes are bootstrapped.
    truncated_observations: (k, obs_dim) the last observation of each truncated episode, in the order of
        `np.argwhere(truncated)`.
    """

    shard: int
    round: int
    weights_version: int
    selection_version: int
    order_version: int
    observations: Array
    actions: NDArray[np.generic]
    rewards: FloatArray
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    last_observations: Array
    truncated_observations: Array
    episodes: Episodes


@dataclass(frozen=True)
class Outcomes:
    """Evaluation episodes, one entry per instance and episode, instances in id order.

    returns, discounted_returns (n,) in reward units; lengths (n,) in steps; success (n,) as in `Episodes`.
    """

    weights_version: int
    returns: FloatArray
    discounted_returns: FloatArray
    lengths: IntArray
    success: FloatArray


@dataclass(frozen=True)
class Walk:
    """Where each shard goes on in the selection; void once the selection's order has changed.

    positions: (shards,) of the next episode's instance in the selection's order.
    """

    order_version: int
    positions: tuple[int, ...]

    def position(self, selection: Selection, shard: int, n_shards: int) -> int:
        """The place in `selection` of a shard's next episode: shards start spread over a new order."""
        if selection.order_version == self.order_version:
            return self.positions[shard] % len(selection.ids)
        return shard * len(selection.ids) // n_shards


@dataclass(frozen=True)
class Setup:
    """Everything a worker must know to compute any piece of a run's work."""

    env_id: str
    context_visible: bool
    seed: int
    gamma: float
    shards: int
    slots: int
    slot_length: int
    start_states: int
    evaluation_episodes: int
    train: InstanceSet
    test: InstanceSet

    def instances(self, split: Split) -> InstanceSet:
        """The instance set of a split."""
        return self.train if split == "train" else self.test

    @property
    def chunks(self) -> int:
        """Pieces into which the start values of all training instances are cut."""
        return -(-len(self.train) // self.chunk_size)

    @property
    def chunk_size(self) -> int:
        """Instances per piece of start values."""
        return max(1, CHUNK // self.start_states)

    @property
    def evaluation_parts(self) -> int:
        """Pieces into which the evaluation of one split is cut."""
        return self.shards


class Worker:
    """Computes pieces of a run's work. What it keeps between calls are environments and start observations: caches."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._collecting = self._make(setup.slots)
        self._evaluating: dict[int, BatchedEnv] = {}
        self._starts: dict[int, Array] = {}

    def _make(self, n_slots: int) -> BatchedEnv:
        return make_batched(self._setup.env_id, n_slots, context_visible=self._setup.context_visible)

    def collect(
        self, weights: MlpWeights, selection: Selection, walk: Walk, *, round: int, shard: int, selection_version: int
    ) -> Shard:
        """One shard of one round. Raises RuntimeError if weights or selection are not the ones asked for."""
        if selection.version != selection_version or weights.version != round:
            raise RuntimeError(
                f"round {round} asked for selection {selection_version} and weights {round}, "
                f"and got selection {selection.version} and weights {weights.version}"
            )
        setup = self._setup
        return collect(
            self._collecting, weights, selection,
            start=walk.position(selection, shard, setup.shards),
            length=setup.slot_length, gamma=setup.gamma, seed=setup.seed, round=round, shard=shard,
        )  # fmt: skip

    def start_values(self, weights: MlpWeights, chunk: int) -> FloatArray:
        """`(chunk_size,)` V(s0, c_i) of one chunk of the training instances: means over their start observations."""
        if chunk not in self._starts:
            self._starts[chunk] = start_observations(self._setup, chunk)
        observations = self._starts[chunk]
        blocks = [values(weights, observations[row : row + BLOCK]) for row in range(0, len(observations), BLOCK)]
        scores = np.concatenate(blocks).astype(np.float64)
        means: FloatArray = scores.reshape(-1, self._setup.start_states).mean(axis=1)
        return means

    def evaluate(self, weights: MlpWeights, split: Split, part: int) -> Outcomes:
        """Deterministic episodes on one part of a split."""
        setup, instances = self._setup, self._setup.instances(split)
        episodes = setup.evaluation_episodes
        seeds = episode_seeds(
            setup.seed, Purpose.EVALUATION, 0 if split == "train" else 1, count=len(instances) * episodes
        )
        contexts = np.repeat(instances.contexts, episodes, axis=0)
        mine = np.array_split(np.arange(len(seeds)), setup.evaluation_parts)[part]
        if not len(mine):
            nothing = np.zeros(0)
            return Outcomes(weights.version, nothing, nothing, nothing.astype(np.int64), nothing)
        if len(mine) not in self._evaluating:
            self._evaluating[len(mine)] = self._make(len(mine))
        return evaluate(self._evaluating[len(mine)], weights, contexts[mine], seeds[mine], gamma=setup.gamma)


def collect(
    env: BatchedEnv, weights: MlpWeights, selection: Selection,
    *, start: int, length: int, gamma: float, seed: int, round: int, shard: int,
) -> Shard:  # fmt: skip
    """Collect exactly `length * env.n_slots` transitions, all from fresh resets, walking `selection` from `start`.

    Slots that end their episode at the same step take the next instances in slot order. The last episode of a slot is
    cut where the round ends.
    """
    n = env.n_slots
    seeds = episode_seeds(seed, Purpose.EPISODES, round, shard, count=n * length)
    noise = _action_noise(env.action_space, generator(seed, Purpose.ACTIONS, round, shard), (length, n))
    observations = np.empty((length, n, *env.observation_space.shape), dtype=np.float32)
    rewards = np.empty((length, n))
    terminated = np.zeros((length, n), dtype=np.bool_)
    truncated = np.zeros((length, n), dtype=np.bool_)
    actions: list[NDArray[np.generic]] = []
    last: list[Array] = []
    table = _EpisodeTable(n, gamma)

    current = np.empty((n, *env.observation_space.shape), dtype=np.float32)
    ended = np.arange(n)
    for time in range(length):
        if len(ended):
            first = len(table)
            places = (start + first + np.arange(len(ended))) % len(selection.ids)
            current[ended] = env.reset(ended, selection.contexts[places], seeds[first : first + len(ended)])
            table.begin(ended, selection.ids[places], time)
        sampled = act(weights, current, noise[time])
        step = env.step(executed(env.action_space, sampled))
        observations[time], rewards[time] = current, step.rewards
        terminated[time], truncated[time] = step.terminated, step.truncated & ~step.terminated
        actions.append(sampled)
        table.add(step.rewards, step.success)
        last.append(step.observations[truncated[time]])
        ended = np.flatnonzero(terminated[time] | truncated[time])
        table.end(ended, np.where(terminated[time], TERMINATED, TRUNCATED)[ended])
        current = step.observations.copy()
    table.end(table.running(), np.full(len(table.running()), CUT))
    return Shard(
        shard=shard, round=round, weights_version=weights.version,
        selection_version=selection.version, order_version=selection.order_version,
        observations=observations, actions=np.stack(actions), rewards=rewards,
        terminated=terminated, truncated=truncated,
        last_observations=current, truncated_observations=np.concatenate(last), episodes=table.episodes(),
    )  # fmt: skip


def evaluate(
    env: BatchedEnv, weights: MlpWeights, contexts: FloatArray, seeds: NDArray[np.uint64], *, gamma: float
) -> Outcomes:
    """One deterministic episode per row of `contexts` (n_slots, d), all at once."""
    slots = np.arange(env.n_slots)
    observations = env.reset(slots, contexts, seeds)
    alive = np.ones(env.n_slots, dtype=np.bool_)
    returns, discounted, success = np.zeros(env.n_slots), np.zeros(env.n_slots), np.full(env.n_slots, np.nan)
    lengths = np.zeros(env.n_slots, dtype=np.int64)
    discount = 1.0
    while alive.any():
        step = env.step(executed(env.action_space, act(weights, observations, None)))
        returns += np.where(alive, step.rewards, 0.0)
        discounted += np.where(alive, discount * step.rewards, 0.0)
        lengths += alive
        if step.success is not None:
            success = np.where(alive, step.success, success)
        discount *= gamma
        ended = np.flatnonzero(step.terminated | step.truncated)
        alive[ended] = False
        observations = step.observations.copy()
        if len(ended) and alive.any():  # every slot must be steppable; what follows in these is not counted
            observations[ended] = env.reset(ended, contexts[ended], seeds[ended])
    return Outcomes(weights.version, returns, discounted, lengths, success)


def start_observations(setup: Setup, chunk: int) -> Array:
    """`(chunk_size * start_states, obs_dim)` where a chunk's episodes begin; on an environment of its own."""
    first = chunk * setup.chunk_size
    contexts = setup.train.contexts[first : first + setup.chunk_size]
    contexts = np.repeat(contexts, setup.start_states, axis=0)
    env = make_batched(setup.env_id, len(contexts), context_visible=setup.context_visible)
    seeds = episode_seeds(setup.seed, Purpose.START_STATES, chunk, count=len(contexts))
    return env.reset(np.arange(len(contexts)), contexts, seeds).copy()


def joined(parts: list[Outcomes]) -> Outcomes:
    """The parts of one split's evaluation as one, in order."""
    fields = [field.name for field in dataclasses.fields(Outcomes) if field.name != "weights_version"]
    return Outcomes(parts[0].weights_version, **{name: np.concatenate([getattr(part, name) for part in parts])
                                                 for name in fields})  # fmt: skip


def _action_noise(
    space: spaces.Space[NDArray[np.generic]], random: np.random.Generator, shape: tuple[int, int]
) -> Array:
    if isinstance(space, spaces.Discrete):
        return random.gumbel(size=(*shape, int(space.n))).astype(np.float32)
    return random.standard_normal(size=(*shape, *(space.shape or ())), dtype=np.float32)


class _EpisodeTable:
    """Sums up the episodes that run in the slots of one shard."""

    def __init__(self, n_slots: int, gamma: float) -> None:
        self._gamma = gamma
        self._rows: list[list[float]] = []  # id, slot, start, length, return, discounted return, success, end
        self._row_of = np.full(n_slots, -1)
        self._returns, self._discounted, self._discount = np.zeros(n_slots), np.zeros(n_slots), np.ones(n_slots)
        self._success = np.full(n_slots, np.nan)
        self._time = 0

    def __len__(self) -> int:
        return len(self._rows)

    def begin(self, slots: IntArray, ids: IntArray, time: int) -> None:
        self._row_of[slots] = len(self._rows) + np.arange(len(slots))
        self._rows += [[instance, slot, time] for instance, slot in zip(ids.tolist(), slots.tolist(), strict=True)]
        self._returns[slots], self._discounted[slots], self._discount[slots] = 0.0, 0.0, 1.0

    def add(self, rewards: FloatArray, success: NDArray[np.bool_] | None) -> None:
        self._returns += rewards
        self._discounted += self._discount * rewards
        self._discount *= self._gamma
        if success is not None:
            self._success = success.astype(np.float64)
        self._time += 1

    def end(self, slots: IntArray, ends: IntArray) -> None:
        for slot, end in zip(slots.tolist(), ends.tolist(), strict=True):
            row = self._rows[self._row_of[slot]]
            row += [self._time - row[2], self._returns[slot], self._discounted[slot], self._success[slot], end]
            self._row_of[slot] = -1

    def running(self) -> IntArray:
        return np.flatnonzero(self._row_of >= 0)

    def episodes(self) -> Episodes:
        ids, slots, starts, lengths, returns, discounted, success, ends = zip(*self._rows, strict=True)
        return Episodes(
            ids=np.array(ids, dtype=np.int64),
            slots=np.array(slots, dtype=np.int64),
            starts=np.array(starts, dtype=np.int64),
            lengths=np.array(lengths, dtype=np.int64),
            returns=np.array(returns),
            discounted_returns=np.array(discounted),
            success=np.array(success),
            ends=np.array(ends, dtype=np.int64),
        )
