"""Collecting episodes, evaluating policies and scoring instances: pure functions of (policy, selection, seed).

A round is a fixed number of steps, and episodes go on across rounds: what a shard leaves unfinished is part of its
answer, and of the question that the next round asks. Whoever still has these very episodes in its environment goes on
at once; anybody else plays the recorded actions again, which the contract of environments makes exact.

A rollout actor imports neither torch nor Stable-Baselines3, unless the policy it is sent does. The number of shards,
the slots of a shard and the size of every chunk are fixed by the config: whoever computes a piece of work, and how
often, it gives the same bits.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, Observations, close
from space_dist.envs.observations import allocate, concatenate, distinct, put, rows, take
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.rollout.policy import Noise, Policy, Several, Valuing, batched, can_be_batched, policies_of
from space_dist.rollout.walk import Unfinished, Walk
from space_dist.seeding import Purpose, episode_seeds, generator

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Split = Literal["train", "test"]

CHUNK = 65_536  # start observations scored by one call
_SHARED, _TOGETHER = -1, -2  # the stages of all shards beyond LIVE, and of all in one batch
BLOCK = 2_048  # rows of one matrix product: what fits the cache. Both are part of every result
LIVE = 64  # shards whose episodes a worker keeps going between rounds. Decides no result


@dataclass(frozen=True)
class Episodes:
    """The episodes that ended in a round, whole ones, in the order in which they ended: time, then slots.

    ids: instance.  contexts: (m, d) in environment units.  slots, times: where in the shard, and at which of the
    round's steps, each ended.  lengths: in steps, of which those before the round count.  returns, discounted_returns:
    sums of all rewards.
    success: whether the goal was reached at the last step; NaN where the environment knows no success.
    """

    ids: IntArray
    contexts: FloatArray
    slots: IntArray
    times: IntArray
    lengths: IntArray
    returns: FloatArray
    discounted_returns: FloatArray
    success: FloatArray

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Shard:
    """What one shard collected in one round; time runs along axis 0, slots along axis 1.

    observations (length, slots, ...), actions (length, slots, ...) as a buffer stores them, rewards (length, slots),
    terminated, truncated (length, slots).
    starts: (slots,) whether a slot's first step began an episode, and did not go on with one.
    last_observations: (slots, ...) behind the last step, from which episodes that go on are bootstrapped.
    truncated_observations: (k, ...) the last observation of each truncated episode, in the order of
        `np.argwhere(truncated)`.
    next_observations: (length, slots, ...) behind every step, if asked for: replay buffers need them.
    begun: how many episodes were begun.  unfinished: what runs on.
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
    starts: NDArray[np.bool_]
    last_observations: Observations
    truncated_observations: Observations
    next_observations: Observations | None
    episodes: Episodes
    begun: int
    unfinished: Unfinished

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


class Route(Protocol):
    """Which episodes the slots of a shard go on with in a round, and which they begin: `selection`, from `start`."""

    @property
    def selection(self) -> Selection:
        """What is walked."""

    @property
    def start(self) -> int:
        """The place in `selection` of the next episode."""

    @property
    def gamma(self) -> float:
        """Discount per step."""

    @property
    def seed(self) -> int:
        """The run's; with `round` and `shard` it decides the episodes' own."""

    @property
    def round(self) -> int:
        """Of the run, from 0."""

    @property
    def shard(self) -> int:
        """Of the round, from 0."""

    @property
    def unfinished(self) -> Unfinished | None:
        """What runs in the slots; None: nothing."""


@dataclass(frozen=True)
class Rollout:
    """One shard to be collected: going on with what is `unfinished`, then walking `selection` from `start`.

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
    unfinished: Unfinished | None = None


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

    spec: EnvironmentSpec
    seed: int
    gamma: float
    shards: int
    slots: int
    slot_length: int
    start_states: int
    evaluation_episodes: int
    train: InstanceSet
    test: InstanceSet
    episodes_per_round: int | None = None  # a round ends with this many episodes instead of with its slots' length
    keep_next_observations: bool = False
    members: int = 1  # policies; each has an equal share of the shards, and of the parts of an evaluation

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
    def walks(self) -> int:
        """Shards that share an order: a member's. Every member meets the whole selection."""
        return self.shards // self.members

    @property
    def evaluation_parts(self) -> int:
        """Pieces into which the evaluation of one split, by every member, is cut."""
        return self.shards

    def _member(self, policy: Policy | Several, part: int) -> Policy:
        return policies_of(policy)[part // self.walks]

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
            self._member(policy, shard), selection, start=walk.position(selection, shard, self.walks),
            gamma=self.gamma, seed=self.seed, round=round, shard=shard,
            steps=steps + shard * self.slots * self.slot_length, unfinished=walk.running(shard),
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
        self._open: list[BatchedEnv] = []
        self._first: list[BatchedEnv] = []
        self._stages: dict[int, Stage] = {}  # by shard; what is beyond LIVE shares one
        self._evaluating: dict[int, BatchedEnv] = {}
        self._scoring: BatchedEnv | None = None
        self._starts: dict[int, tuple[Observations, IntArray | None]] = {}

    def make_first(self) -> None:
        """Make the first environment: what is wrong with it is then known before any work is asked."""
        self._first.append(self._make(self._setup.slots))

    def collect_all(self, policy: Policy | Several, selection: Selection, walk: Walk, **asked: int) -> list[Shard]:
        """All shards of one round; `asked`: see `Setup.rollout`.

        They are collected in one batch if the policy can act so: a step of many slots takes hardly longer than one of
        few. The bits are the same.
        """
        setup, shards = self._setup, range(self._setup.shards)
        together = 1 < len(shards) <= LIVE and setup.episodes_per_round is None
        if not together or not can_be_batched(policies_of(policy)):
            return [self.collect(policy, selection, walk, shard=shard, **asked) for shard in shards]
        if _TOGETHER not in self._stages:
            self._stages[_TOGETHER] = Stage(self._make(len(shards) * setup.slots))
        return collect(
            self._stages[_TOGETHER],
            [setup.rollout(policy, selection, walk, shard=shard, **asked) for shard in shards],
            length=setup.slot_length, keep_next_observations=setup.keep_next_observations,
        )  # fmt: skip

    def collect(self, policy: Policy | Several, selection: Selection, walk: Walk, **asked: int) -> Shard:
        """One shard of one round; `asked`: see `Setup.rollout`."""
        setup, shard = self._setup, asked["shard"]
        key = shard if shard in self._stages or len(self._stages) < LIVE else _SHARED
        if key not in self._stages:
            self._stages[key] = Stage(self._first.pop() if self._first else self._make(setup.slots))
        return collect(
            self._stages[key], [setup.rollout(policy, selection, walk, **asked)], length=setup.slot_length,
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

    def context_values(self, policy: Valuing, contexts: FloatArray, version: int) -> FloatArray:
        """`(m,)` V(s0, c) of any (m, d) contexts: means over start observations whose seeds belong to `version`."""
        setup = self._setup
        if self._scoring is None:
            self._scoring = self._make(setup.slots)
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
            self._evaluating[len(trial)] = self._make(len(trial))
        return evaluate(self._evaluating[len(trial)], [trial])[0]

    def close(self) -> None:
        """Close its environments; what is asked for afterwards makes new ones."""
        self._first, self._stages, self._evaluating, self._scoring = [], {}, {}, None
        while self._open:
            close(self._open.pop())

    def _make(self, n_slots: int) -> BatchedEnv:
        env = self._setup.spec.make(n_slots)
        self._open.append(env)
        return env


class Stage:
    """An environment and the episodes that run in it between rounds."""

    def __init__(self, env: BatchedEnv) -> None:
        self.env = env
        self._running: list[Unfinished] = []  # shard by shard; empty where nobody knows
        self._current: Observations = {}

    def leave(self, running: list[Unfinished], current: Observations) -> None:
        """Note what runs on, and the observations (n_slots, ...) that it has come to."""
        self._running, self._current = running, current

    def resume(self, wanted: Sequence[Unfinished | None]) -> Observations | None:
        """The observations (n_slots, ...) from which to go on, if exactly what is wanted runs here.

        Until `leave`, nobody knows what does: whoever goes on may fail halfway.
        """
        running, self._running = self._running, []
        live = len(running) == len(wanted) and all(one.same(two) for one, two in zip(running, wanted, strict=True))
        return self._current if live else None


def collect(
    stage: Stage, rollouts: Sequence[Rollout], *, length: int, episodes: int | None = None,
    keep_next_observations: bool = False,
) -> list[Shard]:  # fmt: skip
    """Collect `length * slots` transitions for each rollout, in one batch: an equal share of the slots is each one's.

    A shard has the same bits whoever is collected beside it, and whether its episodes still run on the stage or are
    played again. Slots that end their episode at the same step take the next instances in slot order. What runs at the
    end is unfinished. With `episodes`, which takes a single rollout and slot, the round ends when that many have.

    Raises SpaceDistError if an episode goes on beyond the environment's horizon, or goes another way when played again.
    """
    env, slots = stage.env, stage.env.n_slots // len(rollouts)
    walk = Walking(rollouts, slots, length)
    acting = batched([rollout.policy for rollout in rollouts], slots)
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
    executed: list[NDArray[np.generic]] = []
    last: list[Observations] = []
    table = EpisodeTable(rollouts, slots)

    live = stage.resume([rollout.unfinished for rollout in rollouts])
    current = live if live is not None else replayed(env, table)
    ended = starting = np.flatnonzero(~table.runs)
    for time in range(length):
        if len(ended):
            if episodes is not None and table.ended == episodes:
                length = time
                break
            ids, contexts, seeds = walk.next(ended)
            put(current, ended, env.reset(ended, contexts, seeds))
            table.begin(ended, ids, contexts, seeds, time)
        stored = acting.head.sampled(acting.outputs(current), noise, time, first_steps + time * slots)
        given = acting.head.executed(stored)
        step = env.step(given)
        put(observations, time, current)
        rewards[time] = step.rewards
        terminated[time], truncated[time] = step.terminated, step.truncated & ~step.terminated
        actions.append(stored)
        executed.append(given)
        table.add(step.rewards)
        last.append(take(step.observations, truncated[time]))
        if following is not None:
            put(following, time, step.observations)
        ended = np.flatnonzero(terminated[time] | truncated[time])
        table.end(ended, time, step.success)
        if table.overdue(time + 1, env.horizon):
            raise endless(env)
        put(current, slice(None), step.observations)
    stored, lasts = np.stack(actions), concatenate(last)
    owners = np.nonzero(truncated[:length])[1] // slots  # of each last observation
    told, unfinished = table.episodes(len(rollouts)), table.unfinished(len(rollouts), np.stack(executed))
    starts = np.zeros(env.n_slots, dtype=np.bool_)
    starts[starting] = True
    shards = []
    for index, rollout in enumerate(rollouts):
        mine = (slice(length), slice(index * slots, (index + 1) * slots))
        shards.append(
            Shard(
                shard=rollout.shard, round=rollout.round, policy_version=rollout.policy.version,
                selection_version=rollout.selection.version, order_version=rollout.selection.order_version,
                observations=take(observations, mine), actions=stored[mine].copy(), rewards=rewards[mine].copy(),
                terminated=terminated[mine].copy(), truncated=truncated[mine].copy(), starts=starts[mine[1]].copy(),
                last_observations=take(current, mine[1]), truncated_observations=take(lasts, owners == index),
                next_observations=None if following is None else take(following, mine), episodes=told[index],
                begun=int(walk.begun[index]), unfinished=unfinished[index],
            )
        )  # fmt: skip
    stage.leave(unfinished, current)
    return shards


def replayed(env: BatchedEnv, table: EpisodeTable) -> Observations:
    """`(n_slots, ...)` the observations that all running episodes have come to, played again; anything in other slots.

    Episodes are begun one after another, such that all arrive at the same time. Until its own begins, a slot plays the
    longest: every slot must be steppable. Raises SpaceDistError if an episode ends, or earns, other than it did.
    """
    current = allocate(env.observation_space, env.n_slots)
    lengths = np.where(table.runs, table.lengths(0), 0)
    leader, steps = int(lengths.argmax()), int(lengths.max())
    if not steps:
        return current
    begins = steps - lengths
    own = begins == 0
    contexts = np.where(own[:, None], table.contexts, table.contexts[leader])
    seeds = np.where(own, table.seeds, table.seeds[leader])
    put(current, slice(None), env.reset(np.arange(env.n_slots), contexts, seeds))
    returns = np.zeros(env.n_slots)
    for time in range(steps):
        late = np.flatnonzero(begins == time)
        if time and len(late):
            put(current, late, env.reset(late, table.contexts[late], table.seeds[late]))
            own[late], returns[late] = True, 0.0
        actions = table.actions[time].copy()
        actions[~own] = actions[leader]
        step = env.step(actions)
        returns += step.rewards
        put(current, slice(None), step.observations)
        ended = np.flatnonzero(step.terminated | step.truncated)
        if len(ended):
            slot = ended[0] if own[ended[0]] else leader
            raise _another_way(f"ended after {time + 1 - begins[slot]} steps, and had gone on for {lengths[slot]}")
    differ = np.flatnonzero(table.runs & (returns != table.returns) & ~(np.isnan(returns) & np.isnan(table.returns)))
    if len(differ):
        slot = differ[0]
        earned, before = float(returns[slot]), float(table.returns[slot])
        raise _another_way(f"earned {earned!r} in {lengths[slot]} steps, and had earned {before!r}")
    return current


def _another_way(how: str) -> SpaceDistError:
    return SpaceDistError(
        "the environment breaks its word: an episode that was played again with the same context, seed and actions "
        f"{how}. Everything random in an episode must come from the seed of its reset, and nothing may be left of "
        "earlier episodes; `space-dist env check` looks for the cause"
    )


def endless(env: BatchedEnv) -> SpaceDistError:
    """That an episode has gone on beyond its horizon, for users."""
    return SpaceDistError(
        f"the environment does not end its episodes: after its horizon of {env.horizon} steps, neither terminated nor "
        "truncated was set"
    )


class Walking:
    """Which instance, with which seed, each slot's next episode has, over several rollouts of `slots` slots each."""

    def __init__(self, rollouts: Sequence[Route], slots: int, length: int) -> None:
        self._slots = slots
        self.begun = np.zeros(len(rollouts), dtype=np.int64)  # episodes
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
        numbers = self.begun[owners] + np.arange(len(slots)) - np.searchsorted(owners, owners)
        self.begun += np.bincount(owners, minlength=len(self.begun))
        places = self._firsts[owners] + (self._starts[owners] + numbers) % self._sizes[owners]
        return self._ids[places], self._contexts[places], self._seeds[owners, numbers]


def evaluate(env: BatchedEnv, trials: Sequence[Trial]) -> list[Outcomes]:
    """Measure trials of equally many episodes in one batch, all deterministic or none.

    The outcomes of one have the same bits whatever is measured beside it.
    """
    count, slots, n_slots = len(trials[0]), np.arange(env.n_slots), env.n_slots
    acting = batched([trial.policy for trial in trials], count)
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
            raise endless(env)
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
    with setup.spec.opened(len(contexts)) as env:
        seeds = episode_seeds(setup.seed, Purpose.START_STATES, chunk, count=len(contexts))
        return take(env.reset(np.arange(len(contexts)), contexts, seeds), slice(None))


def joined(parts: list[Outcomes]) -> Outcomes:
    """The parts of one split's evaluation as one, in order."""
    fields = [field.name for field in dataclasses.fields(Outcomes) if field.name != "policy_version"]
    return Outcomes(parts[0].policy_version, **{name: np.concatenate([getattr(part, name) for part in parts])
                                                 for name in fields})  # fmt: skip


class EpisodeTable:
    """The episodes that run in the slots of several rollouts, one rollout's after another's, and those that have ended.

    runs: (n_slots,) whether a slot has an episode.  ids, contexts, seeds, returns: (n_slots, ...) of these.
    actions: (steps, n_slots, ...) given before this round, as in `Unfinished`.  ended: how many have.
    """

    def __init__(self, rollouts: Sequence[Route], slots: int) -> None:
        known = [rollout.unfinished or _nothing(rollout, slots) for rollout in rollouts]

        def column(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(one, name) for one in known])

        self._slots = slots
        self._gamma = np.repeat([rollout.gamma for rollout in rollouts], slots)
        self.ids, self.contexts, self.seeds = column("ids"), column("contexts"), column("seeds")
        self.returns, self._discounted, self._discount = (
            column(name) for name in ("returns", "discounted_returns", "discounts")
        )
        self._starts = -column("lengths")  # at which step of this round; negative: before it
        self.runs = self._starts < 0
        self.actions = _side_by_side([one.actions for one in known], slots)
        self.ended = 0
        self._due = 0  # no running episode is as long as the horizon before this step
        self._ended: list[tuple[Any, ...]] = []  # in the order of the fields of `Episodes`

    def lengths(self, time: int) -> IntArray:
        """`(n_slots,)` steps that the running episodes have made, before step `time` of this round."""
        return time - self._starts

    def overdue(self, time: int, horizon: int) -> bool:
        """Whether an episode runs on that has made `horizon` steps before step `time` of this round."""
        if time < self._due:  # looked at about once a horizon: what begins later is due later
            return False
        self._due = int(self._starts[self.runs].min(initial=time)) + horizon
        return time >= self._due

    def begin(self, slots: IntArray, ids: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64], time: int) -> None:
        """Have episodes run in `slots` (k,), from step `time` of this round on."""
        self.ids[slots], self.contexts[slots], self.seeds[slots] = ids, contexts, seeds
        self._starts[slots], self.runs[slots] = time, True
        self.returns[slots], self._discounted[slots], self._discount[slots] = 0.0, 0.0, 1.0

    def add(self, rewards: FloatArray) -> None:
        """Count one step of every slot."""
        self.returns += rewards
        self._discounted += self._discount * rewards
        self._discount *= self._gamma

    def end(self, slots: IntArray, time: int, success: NDArray[np.bool_] | None) -> None:
        """Note that the episodes in `slots` (k,) ended with step `time`."""
        if not len(slots):
            return
        reached = np.full(len(slots), np.nan) if success is None else success[slots].astype(np.float64)
        self._ended.append(
            (self.ids[slots], self.contexts[slots], slots, np.full(len(slots), time), time + 1 - self._starts[slots],
             self.returns[slots], self._discounted[slots], reached)
        )  # fmt: skip
        self.runs[slots] = False
        self.ended += len(slots)

    def episodes(self, owners: int) -> list[Episodes]:
        """Every owner's own that have ended."""
        if not self._ended:
            none, numbers = np.zeros(0, dtype=np.int64), np.zeros(0)
            return [Episodes(none, self.contexts[:0], none, none, none, numbers, numbers, numbers)] * owners
        ids, contexts, slots, *others = (np.concatenate(column) for column in zip(*self._ended, strict=True))
        owner = slots // self._slots
        return [
            Episodes(ids[mine], contexts[mine], slots[mine] % self._slots, *(column[mine] for column in others))
            for index in range(owners)
            for mine in [owner == index]
        ]

    def unfinished(self, owners: int, executed: NDArray[np.generic]) -> list[Unfinished]:
        """Every owner's own that run on, after the actions `executed` (length, n_slots, ...) of this round."""
        runs, time = self.runs, len(executed)
        lengths = np.where(runs, self.lengths(time), 0)
        actions = np.concatenate([self.actions, executed]) if len(self.actions) else executed
        actions = actions[len(actions) - lengths.max() :].copy()
        early = np.arange(len(actions))[:, None] < len(actions) - lengths
        actions[early] = 0
        found = []
        for index in range(owners):
            mine = slice(index * self._slots, (index + 1) * self._slots)
            running, steps = runs[mine], int(lengths[mine].max())
            found.append(
                Unfinished(
                    ids=np.where(running, self.ids[mine], 0),
                    contexts=np.where(running[:, None], self.contexts[mine], 0.0),
                    seeds=np.where(running, self.seeds[mine], np.uint64(0)), lengths=lengths[mine].copy(),
                    returns=np.where(running, self.returns[mine], 0.0),
                    discounted_returns=np.where(running, self._discounted[mine], 0.0),
                    discounts=np.where(running, self._discount[mine], 0.0),
                    actions=actions[len(actions) - steps :, mine].copy(),
                )
            )  # fmt: skip
        return found


def _nothing(rollout: Route, slots: int) -> Unfinished:
    """That no episode runs in a shard's slots."""
    zeros, whole = np.zeros(slots), np.zeros(slots, dtype=np.int64)
    contexts = np.zeros((slots, rollout.selection.contexts.shape[1]))
    return Unfinished(whole, contexts, whole.astype(np.uint64), whole, zeros, zeros, zeros, np.zeros((0, slots)))


def _side_by_side(actions: Sequence[NDArray[np.generic]], slots: int) -> NDArray[np.generic]:
    """`(steps, all slots, ...)` from the recorded actions of several shards, whose last steps are everybody's last."""
    longest = max(actions, key=len)
    joined = np.zeros((len(longest), len(actions) * slots, *longest.shape[2:]), dtype=longest.dtype)
    for index, mine in enumerate(actions):
        if len(mine):
            joined[len(longest) - len(mine) :, index * slots : (index + 1) * slots] = mine
    return joined
