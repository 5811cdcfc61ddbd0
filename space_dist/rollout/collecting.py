"""Collecting a round: shards of exactly so many transitions, whose episodes go on where the round before left them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, Observations, Step
from space_dist.envs.observations import allocate, concatenate, put, take
from space_dist.errors import SpaceDistError
from space_dist.rollout.memory import Memory
from space_dist.rollout.policy import Array, Noise, Policy, batched
from space_dist.rollout.table import Episodes, EpisodeTable
from space_dist.rollout.walk import FloatArray, IntArray, Unfinished, Walking
from space_dist.seeding import Purpose, generator


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
    memory: (slots, memory_size) what a recurrent policy remembered before the first step; None of others.
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
    memory: Array | None = None

    @property
    def steps(self) -> int:
        """Environment steps."""
        return int(self.rewards.size)


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


class _Recording:
    """What the steps of a round showed, of all slots; time runs along axis 0."""

    def __init__(self, env: BatchedEnv, length: int, *, next_observations: bool) -> None:
        self._observations = allocate(env.observation_space, length, env.n_slots)
        self._next = allocate(env.observation_space, length, env.n_slots) if next_observations else None
        self._rewards = np.empty((length, env.n_slots))
        self._terminated = np.zeros((length, env.n_slots), dtype=np.bool_)
        self._truncated = np.zeros((length, env.n_slots), dtype=np.bool_)
        # Of a shape and type that the policy decides, so they are known with the first step.
        self._stored: list[NDArray[np.generic]] = []
        self._executed: list[NDArray[np.generic]] = []
        self._truncated_observations: list[Observations] = []

    def add(
        self, time: int, before: Observations, stored: NDArray[np.generic], executed: NDArray[np.generic], step: Step
    ) -> IntArray:
        """Keep step `time`, made from observations `before`; returns the slots whose episodes ended with it, in order.

        An episode that reached a terminal state with its last step was not cut off, whatever the environment says: what
        is truncated is bootstrapped (https://github.com/DLR-RM/stable-baselines3/issues/633), and nothing follows a
        terminal state.
        """
        put(self._observations, time, before)
        self._rewards[time] = step.rewards
        self._terminated[time], self._truncated[time] = step.terminated, step.truncated & ~step.terminated
        self._stored.append(stored)
        self._executed.append(executed)
        self._truncated_observations.append(take(step.observations, self._truncated[time]))
        if self._next is not None:
            put(self._next, time, step.observations)
        return np.flatnonzero(self._terminated[time] | self._truncated[time])

    def shards(
        self, rollouts: Sequence[Rollout], table: EpisodeTable, begun: IntArray, starts: NDArray[np.bool_],
        current: Observations, remembered: Array | None, memory: Array | None,
    ) -> list[Shard]:  # fmt: skip
        """What was recorded, one shard for each rollout: copies, for one shard would keep the arrays of all alive.

        begun: (len(rollouts),) episodes.  starts, current: (n_slots, ...) as in `Shard`, where they are split up.
        remembered, memory: (n_slots, memory_size) before the first step and behind the last, of a recurrent policy.
        """
        length, stored, count = len(self._stored), np.stack(self._stored), len(rollouts)
        slots = self._rewards.shape[1] // count
        episodes, unfinished = table.episodes(count), table.unfinished(count, np.stack(self._executed), memory)
        lasts = concatenate(self._truncated_observations)
        owners = np.nonzero(self._truncated[:length])[1] // slots  # of each last observation
        shards = []
        for index, rollout in enumerate(rollouts):
            own = slice(index * slots, (index + 1) * slots)
            mine = (slice(length), own)
            shards.append(
                Shard(
                    shard=rollout.shard, round=rollout.round, policy_version=rollout.policy.version,
                    selection_version=rollout.selection.version, order_version=rollout.selection.order_version,
                    observations=take(self._observations, mine), actions=stored[mine].copy(),
                    rewards=self._rewards[mine].copy(), terminated=self._terminated[mine].copy(),
                    truncated=self._truncated[mine].copy(), starts=starts[own].copy(),
                    last_observations=take(current, own), truncated_observations=take(lasts, owners == index),
                    next_observations=None if self._next is None else take(self._next, mine),
                    episodes=episodes[index], begun=int(begun[index]), unfinished=unfinished[index],
                    memory=None if remembered is None else remembered[own].copy(),
                )
            )  # fmt: skip
        return shards


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
    walking, table = Walking(rollouts, slots), EpisodeTable(rollouts, slots)
    acting = batched([rollout.policy for rollout in rollouts], slots)
    noise = _noise(env, rollouts, (length, slots))
    first_steps = np.concatenate([rollout.steps + np.arange(slots) for rollout in rollouts])
    recording = _Recording(env, length, next_observations=keep_next_observations)

    live = stage.resume([rollout.unfinished for rollout in rollouts])
    current = live if live is not None else replayed(env, table)
    starts = ~table.runs  # now: the table goes on with the round
    memory = Memory(acting, env.n_slots)
    memory.recall([rollout.unfinished for rollout in rollouts], slots)
    remembered = memory.values
    ended = np.flatnonzero(starts)
    for time in range(length):
        if len(ended):
            if episodes is not None and table.ended == episodes:
                break
            ids, contexts, seeds = walking.next(ended)
            put(current, ended, env.reset(ended, contexts, seeds))
            table.begin(ended, ids, contexts, seeds, time)
            memory.forget(ended)
        stored = acting.head.sampled(memory.outputs(current), noise, time, first_steps + time * slots)
        executed = acting.head.executed(stored)
        step = env.step(executed)
        ended = recording.add(time, current, stored, executed, step)
        table.add(step.rewards)
        table.end(ended, time, step.success)
        if table.overdue(time + 1, env.horizon):
            raise endless(env)
        # Behind an episode's end this is void: `recording` has kept what is truncated, and a reset comes first.
        put(current, slice(None), step.observations)

    shards = recording.shards(rollouts, table, walking.begun, starts, current, remembered, memory.values)
    stage.leave([shard.unfinished for shard in shards], current)
    return shards


def _noise(env: BatchedEnv, rollouts: Sequence[Rollout], shape: tuple[int, int]) -> Noise:
    """All rollouts' random numbers to act with, `shape` (length, slots) each: each its own, whoever is beside it."""
    return Noise.joined([
        Noise.draw(one.policy.head, env.action_space, generator(one.seed, Purpose.ACTIONS, one.round, one.shard), shape)
        for one in rollouts
    ])  # fmt: skip


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
            raise another_way(f"ended after {time + 1 - begins[slot]} steps, and had gone on for {lengths[slot]}")
    # Equal to the bit or not at all; NaN, as a diverged run's, is equal to itself here.
    differ = np.flatnonzero(table.runs & (returns != table.returns) & ~(np.isnan(returns) & np.isnan(table.returns)))
    if len(differ):
        slot = differ[0]
        earned, before = float(returns[slot]), float(table.returns[slot])
        raise another_way(f"earned {earned!r} in {lengths[slot]} steps, and had earned {before!r}")
    return current


def another_way(how: str) -> SpaceDistError:
    """That an episode, played again, did not go as it had gone, for users."""
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
