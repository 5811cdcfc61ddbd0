"""What a worker must know of a run, and how its work is cut into pieces: by the config, never by who is there."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from space_dist.curricula import Selection
from space_dist.envs.spec import EnvironmentSpec
from space_dist.instances import InstanceSet
from space_dist.rollout.collecting import Rollout
from space_dist.rollout.evaluation import Trial
from space_dist.rollout.policy import Policy, Several, policies_of
from space_dist.rollout.walk import IntArray, Walk
from space_dist.seeding import Purpose, episode_seeds, generator

Split = Literal["train", "test"]

CHUNK = 65_536  # start observations scored by one call. Part of every result


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
    given: Mapping[str, bytes] = field(default_factory=dict)  # by other runs: `RunConfig.given_paths`
    memory_size: int = 0  # numbers that a policy remembers of an episode: 0 unless it is recurrent
    policies: int = 1  # policies; each has an equal share of the shards, and of the parts of an evaluation

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
        """Shards that share an order: one policy's. Every policy meets the whole selection."""
        return self.shards // self.policies

    @property
    def evaluation_parts(self) -> int:
        """Pieces into which the evaluation of one split, by every policy, is cut."""
        return self.shards

    def _policy(self, policy: Policy | Several, part: int) -> Policy:
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
            self._policy(policy, shard), selection, start=walk.position(selection, shard, self.walks),
            gamma=self.gamma, seed=self.seed, round=round, shard=shard,
            steps=steps + shard * self.slots * self.slot_length, unfinished=walk.running(shard),
        )  # fmt: skip

    def trial(self, policy: Policy | Several, split: Split, part: int, *, stochastic: bool = False) -> Trial:
        """Episodes on one part of a split: deterministic ones, or `stochastic` ones for the released code's metric."""
        instances, number = self.instances(split), 0 if split == "train" else 1
        count = len(instances) * self.evaluation_episodes
        parts_each = self.evaluation_parts // self.policies
        mine = np.array_split(np.arange(count), parts_each)[part % parts_each]
        return Trial(
            self._policy(policy, part), instances.contexts[mine // self.evaluation_episodes],
            # Drawn for the whole split and then cut: an episode's seed does not depend on the parts.
            episode_seeds(self.seed, Purpose.EVALUATION, number, count=count)[mine], self.gamma,
            # 2 + number: keys that the seeds of episodes (0 and 1) do not have.
            functools.partial(generator, self.seed, Purpose.EVALUATION, 2 + number, part) if stochastic else None,
        )  # fmt: skip

    def probe(self, policy: Policy, indices: IntArray, version: int, part: int) -> Trial:
        """Episodes of the acting policy, noise and all, on one part of the training instances at (k,) `indices`."""
        seeds = episode_seeds(self.seed, Purpose.PROBE_EPISODES, version, count=len(indices))
        mine = np.array_split(np.arange(len(indices)), self.evaluation_parts)[part]
        random = functools.partial(generator, self.seed, Purpose.PROBE_EPISODES, version, part)
        return Trial(policy, self.train.contexts[indices[mine]], seeds[mine], self.gamma, random)
