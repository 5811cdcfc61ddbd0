"""What policies remember of the episodes they act in: nothing, unless they are recurrent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from space_dist.envs import Observations
from space_dist.rollout.policy import Acting, Array
from space_dist.rollout.walk import IntArray, Unfinished


@runtime_checkable
class Recurrent(Protocol):
    """Whatever acts by what it has seen of an episode so far. Without a memory (`Acting`), as at an episode's start."""

    @property
    def memory_size(self) -> int:
        """How many numbers it remembers of an episode."""

    def recalling(self, observations: Observations, memory: Array) -> tuple[Array, Array]:
        """`(n, obs_dim), (n, memory_size) -> (n, n_outputs), (n, memory_size)`: outputs, and the memory from then on.

        memory: zeros where an episode begins.
        """


class Memory:
    """A policy at work in `n_slots` slots, and what it remembers of the episode in each.

    values: (n_slots, memory_size); zeros at an episode's start; None where the policy is not recurrent.
    """

    def __init__(self, acting: Acting, n_slots: int) -> None:
        self._acting = acting
        self._recurrent = acting if isinstance(acting, Recurrent) else None
        self.values = (
            None if self._recurrent is None else np.zeros((n_slots, self._recurrent.memory_size), dtype=np.float32)
        )

    def outputs(self, observations: Observations) -> Array:
        """`(n_slots, obs_dim) -> (n_slots, n_outputs)` for the policy's head; the observations are remembered."""
        if self._recurrent is None or self.values is None:
            return self._acting.outputs(observations)
        outputs, self.values = self._recurrent.recalling(observations, self.values)
        return outputs

    def forget(self, slots: IntArray) -> None:
        """Episodes begin in `slots` (k,)."""
        if self.values is not None:
            self.values[slots] = 0.0

    def recall(self, running: Sequence[Unfinished | None], slots: int) -> None:
        """Go on with what runs in several shards of `slots` slots each, one shard's after another's."""
        if self.values is None:
            return
        for shard, unfinished in enumerate(running):
            if unfinished is not None and unfinished.memory is not None:
                self.values[shard * slots : (shard + 1) * slots] = unfinished.memory
