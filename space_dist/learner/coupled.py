"""Several policies that share one curriculum: one learner to the run, a population to the engine."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.errors import SpaceDistError
from space_dist.learner.interface import Arrays, Update
from space_dist.learner.population import PopulationLearner, learn_together
from space_dist.rollout import Shard
from space_dist.rollout.policy import Several, Statistics


class CoupledLearner:
    """`len(learners)` learners with seeds of their own; each learns from its own equal part of a round's shards.

    A `Learner`: to the curriculum they are one, and an instance's value is the mean of theirs (`policy.Several`).
    """

    normalises = False
    statistics = Statistics()
    seen = capacity = 0

    def __init__(self, learners: Sequence[PopulationLearner]) -> None:
        self.learners = tuple(learners)

    @property
    def policy_name(self) -> str:
        """See `Learner`."""
        return self.learners[0].policy_name

    def policy(self, version: int) -> Several:
        """See `Learner`."""
        return Several(version, tuple(learner.policy(version) for learner in self.learners))

    def scored(self) -> Arrays:
        """See `Learner`: of all learners."""
        return {f"{number}/{name}": array for number, learner in enumerate(self.learners)
                for name, array in learner.scored().items()}  # fmt: skip

    def policy_of(self, scored: Mapping[str, NDArray[Any]], version: int) -> Several:
        """See `Learner`."""
        each = (learner.policy_of(_under(number, scored), version) for number, learner in enumerate(self.learners))
        return Several(version, tuple(each))

    def parts(self, shards: Sequence[Shard]) -> list[list[Shard]]:
        """See `Learner`."""
        each = len(shards) // len(self.learners)
        return [
            [dataclasses.replace(shard, shard=number) for number, shard in enumerate(shards[first : first + each])]
            for first in range(0, len(shards), each)
        ]

    def combined(self, updates: Sequence[Update | SpaceDistError]) -> Update:
        """See `Learner`: means of what the learners report."""
        done = []
        for update in updates:
            if isinstance(update, SpaceDistError):
                raise update
            done.append(update)
        names = [name for name in done[0].metrics if all(name in one.metrics for one in done)]
        metrics = {name: float(np.mean([one.metrics[name] for one in done])) for name in names}
        return Update(metrics, done[0].gradient_steps)

    def update(
        self, shards: Sequence[Shard], *, round: int, steps: int, acted: Mapping[str, NDArray[Any]] | None = None
    ) -> Update:  # fmt: skip
        """See `Learner`; `steps` are those of all policies together."""
        if acted is not None:
            raise RuntimeError("a population learns from rounds of its present weights only")
        count = len(self.learners)
        return self.combined(
            learn_together(self.learners, self.parts(shards), round=[round] * count, steps=[steps] * count)
        )

    def look_at(
        self, shards: Sequence[Shard], *, round: int, acted: Mapping[str, NDArray[Any]] | None = None
    ) -> Update:  # fmt: skip
        """See `Learner`."""
        if acted is not None:
            raise RuntimeError("a population looks at rounds of its present weights only")
        each = zip(self.learners, self.parts(shards), strict=True)
        return self.combined([learner.look_at(mine, round=round) for learner, mine in each])

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """See `Learner`."""
        saved = [learner.save() for learner in self.learners]
        arrays = {f"{number}/{name}": array for number, (mine, _) in enumerate(saved) for name, array in mine.items()}
        return arrays, {str(number): data for number, (_, data) in enumerate(saved)}

    def load(self, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """See `Learner`."""
        for number, learner in enumerate(self.learners):
            learner.load(_under(number, arrays), data[str(number)])

    def transitions(self, first: int) -> Arrays:  # noqa: ARG002 - there is no replay buffer
        """See `Learner`."""
        return {}

    def observe(self, shards: Sequence[Shard]) -> None:
        """See `Learner`: nothing is normalised."""

    def remember(self, arrays: Mapping[str, NDArray[Any]], first: int) -> None:  # noqa: ARG002 - as above
        """See `Learner`."""
        raise RuntimeError("this learner keeps no replay buffer")


def _under(number: int, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """One learner's, of arrays that are named by learners."""
    prefix = f"{number}/"
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
