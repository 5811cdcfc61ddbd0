"""Collecting episodes, evaluating policies and scoring instances: pure functions of (policy, selection, seed).

A rollout actor imports neither torch nor Stable-Baselines3, unless the policy it is sent does. The number of shards,
the slots of a shard and the size of every chunk are fixed by the config: whoever computes a piece of work, and how
often, it gives the same bits.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, Observations, make_batched
from space_dist.envs.observations import allocate, concatenate, distinct, put, rows, take
from space_dist.errors import SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.policy import Noise, Policy, Several, Valuing, members_of, side_by_side
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

    @classmethod
    def none(cls, policy_version: int) -> Outcomes:
        """Of no episodes."""
        nothing = np.zeros(0)
        return cls(policy_version, nothing, nothing, nothing.astype(np.int64), nothing, nothing)


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
class Rollout:
    """One shard to be collected: all from fresh resets, walking `selection` from `start`.

    steps: environment steps of the run before this shard's first, in the order of a replay buffer (time, then slots).
    """

    policy: Policy
    selection: Selection
    start: int
    gamma: float
    seed: int
    round: int
    shard: int
    steps: int = 0


@dataclass(frozen=True)
class Trial:
    """Episodes to be measured, one per row of `contexts` (k, d), with `seeds` (k,).

    Deterministic ones, unless there is a `random` generator, made anew each time, to act with.
    """

    policy: Policy
    contexts: FloatArray
    seeds: NDArray[np.uint64]
    gamma: float
    random: Callable[[], np.random.Generator] | None = None

    def __len__(self) -> int:
        return len(self.seeds)


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
    members: int = 1  # policies; each has an equal share of the shards, and of the parts of an evaluation

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
        """Pieces into which the evaluation of one split, by every member, is cut."""
        return self.shards

    def _member(self, policy: Policy | Several, part: int) -> Policy:
        return members_of(policy)[part // (self.shards // self.members)]

    def rollout(
        self, policy: Policy | Several, selection: Selection, walk: Walk,
        *, round: int, steps: int, shard: int, selection_version: int, lag: int = 0,
    ) -> Rollout:  # fmt: skip
        """One shard of one round, which begins after `steps` environment steps.

        lag: updates that the policy is behind. Raises RuntimeError if policy or selection are not the ones asked for.
        """
        if selection.version != selection_version or policy.version != round - lag:
            raise RuntimeError(
                f"round {round} asked for selection {selection_version} and policy {round - lag}, "
                f"and got selection {selection.version} and policy {policy.version}"
            )
        return Rollout(
            self._member(policy, shard), selection, start=walk.position(selection, shard, self.shards),
            gamma=self.gamma, seed=self.seed, round=round, shard=shard,
            steps=steps + shard * self.slots * self.slot_length,
        )  # fmt: skip

    def trial(self, policy: Policy | Several, split: Split, part: int, *, stochastic: bool = False) -> Trial:
        """Episodes on one part of a split: deterministic ones, or `stochastic` ones for the released code's metric."""
        instances, number = self.instances(split), 0 if split == "train" else 1
        count = len(instances) * self.evaluation_episodes
        parts_each = self.evaluation_parts // self.members
        mine = np.array_split(np.arange(count), parts_each)[part % parts_each]
        return Trial(
            self._member(policy, part), instances.contexts[mine // self.evaluation_episodes],
            episode_seeds(self.seed, Purpose.EVALUATION, number, count=count)[mine], self.gamma,
            functools.partial(generator, self.seed, Purpose.EVALUATION, 2 + number, part) if stochastic else None,
        )  # fmt: skip

    def probe(self, policy: Policy, indices: IntArray, version: int, part: int) -> Trial:
        """Episodes of the acting policy, noise and all, on one part of the training instances at (k,) `indices`."""
        seeds = episode_seeds(self.seed, Purpose.PROBE_EPISODES, version, count=len(indices))
        mine = np.array_split(np.arange(len(indices)), self.evaluation_parts)[part]
        random = functools.partial(generator, self.seed, Purpose.PROBE_EPISODES, version, part)
        return Trial(policy, self.train.contexts[indices[mine]], seeds[mine], self.gamma, random)


class Worker:
    """Computes pieces of a run's work. What it keeps between calls are environments and start observations: caches."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._collecting = setup.make_env(setup.slots)
        self._evaluating: dict[int, BatchedEnv] = {}
        self._scoring: BatchedEnv | None = None
        self._starts: dict[int, tuple[Observations, IntArray | None]] = {}

    def collect(self, policy: Policy | Several, selection: Selection, walk: Walk, **asked: int) -> Shard:
        """One shard of one round; `asked`: see `Setup.rollout`."""
        setup = self._setup
        return collect(
            self._collecting, [setup.rollout(policy, selection, walk, **asked)], length=setup.slot_length,
            episodes=setup.episodes_per_round, keep_next_observations=setup.keep_next_observations,
        )[0]  # fmt: skip

    def start_values(self, policy: Valuing, chunk: int) -> FloatArray:
        """`(chunk_size, ...)` V(s0, c_i) of one chunk of the training instances: means over their start observations.

        `...` is what follows the first axis of `policy.values`. Equal observations have equal values: each is scored
        once.
        """
        if chunk not in self._starts:
            self._starts[chunk] = distinct(start_observations(self._setup, chunk))
        observations, which = self._starts[chunk]
        starts = range(0, rows(observations), BLOCK)
        values = np.concatenate([policy.values(take(observations, slice(row, row + BLOCK))) for row in starts])
        values = values if which is None else values[which]
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
        """See `Setup.probe`."""
        return self._measured(self._setup.probe(policy, indices, version, part))

    def evaluate(self, policy: Policy | Several, split: Split, part: int, *, stochastic: bool = False) -> Outcomes:
        """See `Setup.trial`."""
        return self._measured(self._setup.trial(policy, split, part, stochastic=stochastic))

    def _measured(self, trial: Trial) -> Outcomes:
        """On an environment of its own, so that measuring never changes what is collected."""
        if not len(trial):
            return Outcomes.none(trial.policy.version)
        if len(trial) not in self._evaluating:
            self._evaluating[len(trial)] = self._setup.make_env(len(trial))
        return evaluate(self._evaluating[len(trial)], [trial])[0]


def collect(
    env: BatchedEnv, rollouts: Sequence[Rollout], *, length: int, episodes: int | None = None,
    keep_next_observations: bool = False,
) -> list[Shard]:  # fmt: skip
    """Collect `length * slots` transitions for each rollout, side by side: an equal share of the slots is each one's.

    A shard has the same bits whoever is collected beside it. Slots that end their episode at the same step take the
    next instances in slot order. The last episode of a slot is cut where the round ends. With `episodes`, which takes
    a single rollout and slot, the round ends when that many have.
    """
    slots = env.n_slots // len(rollouts)
    walk = _Walking(rollouts, slots, length)
    acting = side_by_side([rollout.policy for rollout in rollouts], slots)
    noise = Noise.joined([
        Noise.draw(one.policy.head, env.action_space, generator(one.seed, Purpose.ACTIONS, one.round, one.shard),
                   (length, slots))
        for one in rollouts
    ])  # fmt: skip
    first_steps = np.concatenate([rollout.steps + np.arange(slots) for rollout in rollouts])
    observations = allocate(env.observation_space, length, env.n_slots)
    following = allocate(env.observation_space, length, env.n_slots) if keep_next_observations else None
    rewards = np.empty((length, env.n_slots))
    terminated = np.zeros((length, env.n_slots), dtype=np.bool_)
    truncated = np.zeros((length, env.n_slots), dtype=np.bool_)
    actions: list[NDArray[np.generic]] = []
    last: list[Observations] = []
    table = _EpisodeTable(np.repeat([rollout.gamma for rollout in rollouts], slots))

    current = allocate(env.observation_space, env.n_slots)
    ended = np.arange(env.n_slots)
    for time in range(length):
        if len(ended):
            if episodes is not None and len(table) == episodes:
                length = time
                break
            ids, contexts, seeds = walk.next(ended)
            put(current, ended, env.reset(ended, contexts, seeds))
            table.begin(ended, ids, time)
        stored = acting.head.sampled(acting.outputs(current), noise, time, first_steps + time * slots)
        step = env.step(acting.head.executed(stored))
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
    stored, lasts = np.stack(actions), concatenate(last)
    owners = np.nonzero(truncated[:length])[1] // slots  # of each last observation
    shards = []
    for index, (rollout, told) in enumerate(zip(rollouts, table.episodes(len(rollouts)), strict=True)):
        mine = (slice(length), slice(index * slots, (index + 1) * slots))
        shards.append(
            Shard(
                shard=rollout.shard, round=rollout.round, policy_version=rollout.policy.version,
                selection_version=rollout.selection.version, order_version=rollout.selection.order_version,
                observations=take(observations, mine), actions=stored[mine].copy(), rewards=rewards[mine].copy(),
                terminated=terminated[mine].copy(), truncated=truncated[mine].copy(),
                last_observations=take(current, mine[1]), truncated_observations=take(lasts, owners == index),
                next_observations=None if following is None else take(following, mine), episodes=told,
            )
        )  # fmt: skip
    return shards


class _Walking:
    """Which instance, with which seed, each slot's next episode has, over several rollouts of `slots` slots each."""

    def __init__(self, rollouts: Sequence[Rollout], slots: int, length: int) -> None:
        self._slots = slots
        self._begun = np.zeros(len(rollouts), dtype=np.int64)
        self._starts = np.array([rollout.start for rollout in rollouts])
        self._sizes = np.array([len(rollout.selection.ids) for rollout in rollouts])
        self._firsts = np.cumsum(self._sizes) - self._sizes  # of each rollout's instances among all
        self._ids = np.concatenate([rollout.selection.ids for rollout in rollouts])
        self._contexts = np.concatenate([rollout.selection.contexts for rollout in rollouts])
        self._seeds = np.stack([
            episode_seeds(one.seed, Purpose.EPISODES, one.round, one.shard, count=slots * length) for one in rollouts
        ])  # fmt: skip

    def next(self, slots: IntArray) -> tuple[IntArray, FloatArray, NDArray[np.uint64]]:
        """(k,) ids, (k, d) contexts and (k,) seeds of the episodes that begin in `slots` (k,), which ascend."""
        owners = slots // self._slots
        numbers = self._begun[owners] + np.arange(len(slots)) - np.searchsorted(owners, owners)
        self._begun += np.bincount(owners, minlength=len(self._begun))
        places = self._firsts[owners] + (self._starts[owners] + numbers) % self._sizes[owners]
        return self._ids[places], self._contexts[places], self._seeds[owners, numbers]


def evaluate(env: BatchedEnv, trials: Sequence[Trial]) -> list[Outcomes]:
    """Measure trials of equally many episodes side by side, all at once, all deterministic or none.

    The outcomes of one have the same bits whatever is measured beside it.
    """
    count, slots, n_slots = len(trials[0]), np.arange(env.n_slots), env.n_slots
    acting = side_by_side([trial.policy for trial in trials], count)
    noise = None
    if trials[0].random is not None:
        shape = (env.horizon, count)
        noise = Noise.joined([Noise.draw(trial.policy.head, env.action_space, trial.random(), shape)
                              for trial in trials if trial.random is not None])  # fmt: skip
    contexts = np.concatenate([trial.contexts for trial in trials])
    seeds = np.concatenate([trial.seeds for trial in trials])
    gamma = np.repeat([trial.gamma for trial in trials], count)
    observations = take(env.reset(slots, contexts, seeds), slice(None))
    alive = np.ones(n_slots, dtype=np.bool_)
    returns, discounted, success = np.zeros(n_slots), np.zeros(n_slots), np.full(n_slots, np.nan)
    lengths, backward = np.zeros(n_slots, dtype=np.int64), np.zeros(n_slots)
    discount, time = np.ones(n_slots), 0
    trained = np.full(n_slots, np.iinfo(np.int64).max)  # behind every warm-up and schedule of exploration
    while alive.any():
        outputs = acting.outputs(observations)
        chosen = acting.head.best(outputs) if noise is None else acting.head.sampled(outputs, noise, time, trained)
        step = env.step(acting.head.executed(chosen))
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
    return [
        Outcomes(trial.policy.version, returns[mine], discounted[mine], lengths[mine], success[mine], backward[mine])
        for index, trial in enumerate(trials)
        for mine in [slice(index * count, (index + 1) * count)]
    ]


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
    """Sums up the episodes that run in `len(gamma)` slots, each with its own discount."""

    def __init__(self, gamma: FloatArray) -> None:
        n_slots = len(gamma)
        self._gamma = gamma
        self._count = 0
        self._begun: list[tuple[IntArray, IntArray, IntArray]] = []  # ids, slots, starts
        self._ended: list[tuple[Any, ...]] = []  # numbers, lengths, returns, discounted returns, success, ends
        self._row_of, self._start_of = np.full(n_slots, -1), np.zeros(n_slots, dtype=np.int64)
        self._returns, self._discounted, self._discount = np.zeros(n_slots), np.zeros(n_slots), np.ones(n_slots)
        self._success = np.full(n_slots, np.nan)
        self._time = 0

    def __len__(self) -> int:
        return self._count

    def begin(self, slots: IntArray, ids: IntArray, time: int) -> None:
        self._row_of[slots] = self._count + np.arange(len(slots))
        self._start_of[slots] = time
        self._count += len(slots)
        self._begun.append((ids, slots, np.full(len(slots), time)))
        self._returns[slots], self._discounted[slots], self._discount[slots] = 0.0, 0.0, 1.0

    def add(self, rewards: FloatArray, success: NDArray[np.bool_] | None) -> None:
        self._returns += rewards
        self._discounted += self._discount * rewards
        self._discount *= self._gamma
        if success is not None:
            self._success = success.astype(np.float64)
        self._time += 1

    def end(self, slots: IntArray, ends: IntArray) -> None:
        self._ended.append(
            (self._row_of[slots], self._time - self._start_of[slots], self._returns[slots], self._discounted[slots],
             self._success[slots], ends)
        )  # fmt: skip
        self._row_of[slots] = -1

    def running(self) -> IntArray:
        return np.flatnonzero(self._row_of >= 0)

    def episodes(self, owners: int) -> list[Episodes]:
        """Every owner's own, where owners have equally many slots, one after another."""
        slots_each = len(self._gamma) // owners
        ids, slots, starts = (np.concatenate(column) for column in zip(*self._begun, strict=True))
        rows, *sums = (np.concatenate(column) for column in zip(*self._ended, strict=True))
        order = np.argsort(rows)
        lengths, returns, discounted, success, ends = (column[order] for column in sums)
        owner = slots // slots_each
        return [
            Episodes(
                ids=ids[mine], slots=slots[mine] % slots_each, starts=starts[mine], lengths=lengths[mine],
                returns=returns[mine], discounted_returns=discounted[mine], success=success[mine], ends=ends[mine],
            )
            for index in range(owners)
            for mine in [owner == index]
        ]  # fmt: skip
