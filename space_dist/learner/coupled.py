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
from space_dist.policy import Several, Statistics
from space_dist.rollout import Shard


class CoupledLearner:
    """`len(members)` PPO learners with seeds of their own; each learns from its own equal part of a round's shards.

    To the curriculum they are one: an instance's value is the mean of theirs (`policy.Several`).
    """

    normalises = False
    statistics = Statistics()
    seen = capacity = 0

    def __init__(self, members: Sequence[PopulationLearner]) -> None:
        self.members = tuple(members)

    def policy(self, version: int) -> Several:
        """As `Learner.policy`."""
        return Several(version, tuple(member.policy(version) for member in self.members))

    def scored(self) -> Arrays:
        """As `Learner.scored`, of all members."""
        return {f"{number}/{name}": array for number, member in enumerate(self.members)
                for name, array in member.scored().items()}  # fmt: skip

    def parts(self, shards: Sequence[Shard]) -> list[list[Shard]]:
        """Each member's own shards, counted from 0."""
        each = len(shards) // len(self.members)
        return [
            [dataclasses.replace(shard, shard=number) for number, shard in enumerate(shards[first : first + each])]
            for first in range(0, len(shards), each)
        ]

    def joined(self, updates: Sequence[Update | SpaceDistError]) -> Update:
        """The members' updates as one: means of what they report. Raises what one of them failed with."""
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
        """As `Learner.update`; `steps` are those of all members together."""
        if acted is not None:
            raise RuntimeError("a population learns from rounds of its present weights only")
        count = len(self.members)
        return self.joined(
            learn_together(self.members, self.parts(shards), round=[round] * count, steps=[steps] * count)
        )

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """As `Learner.save`."""
        saved = [member.save() for member in self.members]
        arrays = {f"{number}/{name}": array for number, (mine, _) in enumerate(saved) for name, array in mine.items()}
        return arrays, {str(number): data for number, (_, data) in enumerate(saved)}

    def load(self, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """As `Learner.load`."""
        for number, member in enumerate(self.members):
            prefix = f"{number}/"
            member.load(
                {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)},
                data[str(number)],
            )

    def transitions(self, first: int) -> Arrays:  # noqa: ARG002 - there is no replay buffer
        """As `Learner.transitions`."""
        return {}

    def observe(self, shards: Sequence[Shard]) -> None:
        """As `Learner.observe`: nothing is normalised."""

    def remember(self, arrays: Mapping[str, NDArray[Any]], first: int) -> None:  # noqa: ARG002 - as above
        """As `Learner.remember`."""
        raise RuntimeError("this learner keeps no replay buffer")
