"""Collecting episodes, evaluating policies and scoring instances: pure functions of (policy, selection, seed).

A rollout actor imports neither torch nor Stable-Baselines3, unless the policy it is sent does. The number of shards,
the slots of a shard and the size of every chunk are fixed by the config: whoever computes a piece of work, and how
often, it gives the same bits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, Observations, make_batched
from space_dist.envs.observations import allocate, concatenate, put, rows, take
from space_dist.errors import SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.policy import Noise, Policy, Valuing
from space_dist.seeding import Purpose, episode_seeds, generator

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Split = Literal["train", "test"]

CHUNK = 65_536  # start observations scored by one call
BLOCK = 2_048  # rows of one matrix product: what fits the cache. Both are part of every result
TERMINATED, TRUNCATED, CUT = 0, 1, 2


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

    observations (length, slots, ...), actions (length, slots, ...) as a buffer stores them, rewards (length, slots),
    terminated, truncated (length, slots).
    last_observations: (slots, ...) behind the last step, from which cut episodes are bootstrapped.
    truncated_observations: (k, ...) the last observation of each truncated episode, in the order of
        `np.argwhere(truncated)`.
    next_observations: (length, slots, ...) behind every step, if asked for: replay buffers need them.
    """

    shard: int
    round: int
    policy_version: int
    selection_version: int
    order_version: int
    observations: Observations
    actions: NDArray[np.generic]
    rewards: FloatArray
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    last_observations: Observations
    truncated_observations: Observations
    next_observations: Observations | None
    episodes: Episodes

    @property
    def steps(self) -> int:
        """Environment steps."""
        return int(self.rewards.size)


@dataclass(frozen=True)
class Outcomes:
    """Evaluation episodes, one entry per instance and episode, instances in id order.

    returns, discounted_returns (n,) in reward units; lengths (n,) in steps; success (n,) as in `Episodes`.
    backward_discounted_returns: (n,) sum of r_t gamma^(T-1-t), the released SPaCE code's metric.
    """

    policy_version: int
    returns: FloatArray
    discounted_returns: FloatArray
    lengths: IntArray
    success: FloatArray
    backward_discounted_returns: FloatArray


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

    def places(self, selection: Selection, shard: int, n_shards: int, episodes: int) -> IntArray:
        """`(episodes,)` the places in `selection` of a shard's next episodes."""
        places: IntArray = (self.position(selection, shard, n_shards) + np.arange(episodes)) % len(selection.ids)
        return places


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
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    episodes_per_round: int | None = None  # a round ends with this many episodes instead of with its slots' length
    keep_next_observations: bool = False

    def make_env(self, n_slots: int) -> BatchedEnv:
        """An environment of the run, as its policy sees it."""
        return make_batched(self.env_id, n_slots, context_visible=self.context_visible, kwargs=self.env_kwargs)

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
        self._collecting = setup.make_env(setup.slots)
        self._evaluating: dict[int, BatchedEnv] = {}
        self._scoring: BatchedEnv | None = None
        self._starts: dict[int, Observations] = {}

    def collect(
        self, policy: Policy, selection: Selection, walk: Walk,
        *, round: int, steps: int, shard: int, selection_version: int,
    ) -> Shard:  # fmt: skip
        """One shard of one round, which begins after `steps` environment steps.

        Raises RuntimeError if policy or selection are not the ones asked for.
        """
        if selection.version != selection_version or policy.version != round:
            raise RuntimeError(
                f"round {round} asked for selection {selection_version} and policy {round}, "
                f"and got selection {selection.version} and policy {policy.version}"
            )
        setup = self._setup
        return collect(
            self._collecting, policy, selection,
            start=walk.position(selection, shard, setup.shards), length=setup.slot_length, gamma=setup.gamma,
            seed=setup.seed, round=round, shard=shard, steps=steps + shard * setup.slots * setup.slot_length,
            episodes=setup.episodes_per_round, keep_next_observations=setup.keep_next_observations,
        )  # fmt: skip

    def start_values(self, policy: Valuing, chunk: int) -> FloatArray:
        """`(chunk_size, ...)` V(s0, c_i) of one chunk of the training instances: means over their start observations.

        `...` is what follows the first axis of `policy.values`.
        """
        if chunk not in self._starts:
            self._starts[chunk] = start_observations(self._setup, chunk)
        observations = self._starts[chunk]
        starts = range(0, rows(observations), BLOCK)
        values = np.concatenate([policy.values(take(observations, slice(row, row + BLOCK))) for row in starts])
        means: FloatArray = values.reshape(-1, self._setup.start_states, *values.shape[1:]).mean(axis=1)
        return means

    def context_values(self, policy: Policy, contexts: FloatArray, version: int) -> FloatArray:
        """`(m,)` V(s0, c) of any (m, d) contexts: means over start observations whose seeds belong to `version`."""
        setup = self._setup
        if self._scoring is None:
            self._scoring = setup.make_env(setup.slots)
        wanted = np.repeat(contexts, setup.start_states, axis=0)
        seeds = episode_seeds(setup.seed, Purpose.CONTEXT_STARTS, version, count=len(wanted))
        values = np.empty(len(wanted))
        for first in range(0, len(wanted), setup.slots):
            some = slice(first, first + setup.slots)
            observations = self._scoring.reset(np.arange(len(wanted[some])), wanted[some], seeds[some])
            values[some] = policy.values(take(observations, slice(None)))
        means: FloatArray = values.reshape(-1, setup.start_states).mean(axis=1)
        return means

    def probe(self, policy: Policy, indices: IntArray, version: int, part: int) -> Outcomes:
        """Episodes of the acting policy, noise and all, on one part of the training instances at (k,) `indices`."""
        setup = self._setup
        seeds = episode_seeds(setup.seed, Purpose.PROBE_EPISODES, version, count=len(indices))
        mine = np.array_split(np.arange(len(indices)), setup.evaluation_parts)[part]
        random = generator(setup.seed, Purpose.PROBE_EPISODES, version, part)
        return self._episodes(policy, setup.train.contexts[indices[mine]], seeds[mine], random)

    def evaluate(self, policy: Policy, split: Split, part: int, *, stochastic: bool = False) -> Outcomes:
        """Episodes on one part of a split: deterministic ones, or `stochastic` ones for the released code's metric."""
        setup, instances = self._setup, self._setup.instances(split)
        episodes = setup.evaluation_episodes
        seeds = episode_seeds(
            setup.seed, Purpose.EVALUATION, 0 if split == "train" else 1, count=len(instances) * episodes
        )
        contexts = np.repeat(instances.contexts, episodes, axis=0)
        mine = np.array_split(np.arange(len(seeds)), setup.evaluation_parts)[part]
        random = generator(setup.seed, Purpose.EVALUATION, 2 if split == "train" else 3, part) if stochastic else None
        return self._episodes(policy, contexts[mine], seeds[mine], random)

    def _episodes(
        self, policy: Policy, contexts: FloatArray, seeds: NDArray[np.uint64], random: np.random.Generator | None
    ) -> Outcomes:
        """One episode for each of the (k, d) contexts, at once, on environments of their own."""
        count = len(contexts)
        if not count:
            nothing = np.zeros(0)
            return Outcomes(policy.version, nothing, nothing, nothing.astype(np.int64), nothing, nothing)
        if count not in self._evaluating:
            self._evaluating[count] = self._setup.make_env(count)
        env = self._evaluating[count]
        noise = None
        if random is not None:
            noise = Noise.draw(policy.head, env.action_space, random, (env.horizon, env.n_slots))
        return evaluate(env, policy, contexts, seeds, gamma=self._setup.gamma, noise=noise)


def collect(
    env: BatchedEnv, policy: Policy, selection: Selection,
    *, start: int, length: int, gamma: float, seed: int, round: int, shard: int, steps: int = 0,
    episodes: int | None = None, keep_next_observations: bool = False,
) -> Shard:  # fmt: skip
    """Collect exactly `length * env.n_slots` transitions, all from fresh resets, walking `selection` from `start`.

    Slots that end their episode at the same step take the next instances in slot order. The last episode of a slot is
    cut where the round ends. With `episodes`, which takes a single slot, the round ends when that many have.
    steps: environment steps of the run before this shard's first, in the order of a replay buffer (time, then slots).
    """
    n = env.n_slots
    seeds = episode_seeds(seed, Purpose.EPISODES, round, shard, count=n * length)
    noise = Noise.draw(policy.head, env.action_space, generator(seed, Purpose.ACTIONS, round, shard), (length, n))
    observations = allocate(env.observation_space, length, n)
    following = allocate(env.observation_space, length, n) if keep_next_observations else None
    rewards = np.empty((length, n))
    terminated = np.zeros((length, n), dtype=np.bool_)
    truncated = np.zeros((length, n), dtype=np.bool_)
    actions: list[NDArray[np.generic]] = []
    last: list[Observations] = []
    table = _EpisodeTable(n, gamma)

    current = allocate(env.observation_space, n)
    ended = np.arange(n)
    for time in range(length):
        if len(ended):
            if episodes is not None and len(table) == episodes:
                length = time
                break
            first = len(table)
            places = (start + first + np.arange(len(ended))) % len(selection.ids)
            put(current, ended, env.reset(ended, selection.contexts[places], seeds[first : first + len(ended)]))
            table.begin(ended, selection.ids[places], time)
        stored = policy.head.sampled(policy.outputs(current), noise, time, steps + time * n + np.arange(n))
        step = env.step(policy.head.executed(stored))
        put(observations, time, current)
        rewards[time] = step.rewards
        terminated[time], truncated[time] = step.terminated, step.truncated & ~step.terminated
        actions.append(stored)
        table.add(step.rewards, step.success)
        last.append(take(step.observations, truncated[time]))
        if following is not None:
            put(following, time, step.observations)
        ended = np.flatnonzero(terminated[time] | truncated[time])
        table.end(ended, np.where(terminated[time], TERMINATED, TRUNCATED)[ended])
        put(current, slice(None), step.observations)
    table.end(table.running(), np.full(len(table.running()), CUT))
    return Shard(
        shard=shard, round=round, policy_version=policy.version,
        selection_version=selection.version, order_version=selection.order_version,
        observations=take(observations, slice(length)), actions=np.stack(actions), rewards=rewards[:length],
        terminated=terminated[:length], truncated=truncated[:length],
        last_observations=current, truncated_observations=concatenate(last),
        next_observations=None if following is None else take(following, slice(length)), episodes=table.episodes(),
    )  # fmt: skip


def evaluate(
    env: BatchedEnv, policy: Policy, contexts: FloatArray, seeds: NDArray[np.uint64],
    *, gamma: float, noise: Noise | None = None,
) -> Outcomes:  # fmt: skip
    """One episode per row of `contexts` (n_slots, d), at once; deterministic unless there is `noise` to act with."""
    slots = np.arange(env.n_slots)
    observations = take(env.reset(slots, contexts, seeds), slice(None))
    alive = np.ones(env.n_slots, dtype=np.bool_)
    returns, discounted, success = np.zeros(env.n_slots), np.zeros(env.n_slots), np.full(env.n_slots, np.nan)
    lengths, backward = np.zeros(env.n_slots, dtype=np.int64), np.zeros(env.n_slots)
    discount, time = 1.0, 0
    trained = np.full(env.n_slots, np.iinfo(np.int64).max)  # behind every warm-up and schedule of exploration
    while alive.any():
        outputs = policy.outputs(observations)
        chosen = policy.head.best(outputs) if noise is None else policy.head.sampled(outputs, noise, time, trained)
        step = env.step(policy.head.executed(chosen))
        backward = np.where(alive, gamma * backward + step.rewards, backward)
        time += 1
        if time == env.horizon and (alive & ~(step.terminated | step.truncated)).any():
            raise SpaceDistError(
                f"the environment does not end its episodes: after its horizon of {env.horizon} steps, neither "
                "terminated nor truncated was set"
            )
        returns += np.where(alive, step.rewards, 0.0)
        discounted += np.where(alive, discount * step.rewards, 0.0)
        lengths += alive
        if step.success is not None:
            success = np.where(alive, step.success, success)
        discount *= gamma
        ended = np.flatnonzero(step.terminated | step.truncated)
        alive[ended] = False
        put(observations, slice(None), step.observations)
        if len(ended) and alive.any():  # every slot must be steppable; what follows in these is not counted
            put(observations, ended, env.reset(ended, contexts[ended], seeds[ended]))
    return Outcomes(policy.version, returns, discounted, lengths, success, backward)


def start_observations(setup: Setup, chunk: int) -> Observations:
    """`(chunk_size * start_states, ...)` where a chunk's episodes begin; on an environment of its own."""
    first = chunk * setup.chunk_size
    contexts = setup.train.contexts[first : first + setup.chunk_size]
    contexts = np.repeat(contexts, setup.start_states, axis=0)
    env = setup.make_env(len(contexts))
    seeds = episode_seeds(setup.seed, Purpose.START_STATES, chunk, count=len(contexts))
    return take(env.reset(np.arange(len(contexts)), contexts, seeds), slice(None))


def joined(parts: list[Outcomes]) -> Outcomes:
    """The parts of one split's evaluation as one, in order."""
    fields = [field.name for field in dataclasses.fields(Outcomes) if field.name != "policy_version"]
    return Outcomes(parts[0].policy_version, **{name: np.concatenate([getattr(part, name) for part in parts])
                                                 for name in fields})  # fmt: skip


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
