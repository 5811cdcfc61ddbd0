"""Whoever computes pieces of a run's work: a rollout actor, or the run's own process."""

from __future__ import annotations

import numpy as np

from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, Observations, close
from space_dist.envs.observations import distinct, rows, take
from space_dist.rollout.collecting import Shard, Stage, collect
from space_dist.rollout.evaluation import Outcomes, Trial, evaluate
from space_dist.rollout.policy import Policy, Several, Valuing, can_be_batched, policies_of
from space_dist.rollout.setup import Setup, Split
from space_dist.rollout.walk import FloatArray, IntArray, Walk
from space_dist.seeding import Purpose, episode_seeds

_SHARED, _TOGETHER = -1, -2  # the stages of all shards beyond LIVE, and of all in one batch
BLOCK = 2_048  # rows of one matrix product: what fits the cache. Part of every result: rows are rounded by their place
LIVE = 64  # shards whose episodes a worker keeps going between rounds. Decides no result


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
        # One environment for each number of slots: parts of a split differ by one episode at most.
        slots = self._setup.spec.slots_for(len(trial))
        if slots not in self._evaluating:
            self._evaluating[slots] = self._make(slots)
        return evaluate(self._evaluating[slots], [trial])[0]

    def close(self) -> None:
        """Close its environments; what is asked for afterwards makes new ones."""
        self._first, self._stages, self._evaluating, self._scoring = [], {}, {}, None
        while self._open:
            close(self._open.pop())

    def _make(self, n_slots: int) -> BatchedEnv:
        env = self._setup.spec.make(n_slots)
        self._open.append(env)
        return env


def start_observations(setup: Setup, chunk: int) -> Observations:
    """`(chunk_size * start_states, ...)` where a chunk's episodes begin; on an environment of its own."""
    first = chunk * setup.chunk_size
    contexts = setup.train.contexts[first : first + setup.chunk_size]
    contexts = np.repeat(contexts, setup.start_states, axis=0)
    with setup.spec.opened(len(contexts)) as env:
        # By chunk, whoever scores it: no result depends on which worker that is.
        seeds = episode_seeds(setup.seed, Purpose.START_STATES, chunk, count=len(contexts))
        return take(env.reset(np.arange(len(contexts)), contexts, seeds), slice(None))
