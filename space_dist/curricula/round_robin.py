"""Round robin: every instance in turn, in one random order that never changes (the paper's first baseline).

Over a part of the instances only, it is the control that trains on a fixed subset.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from space_dist.curricula.interface import Curriculum, Feedback, Numbers, Selection, SetState, selection_of
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, instance_keys


class RoundRobin(Curriculum):
    """The same instances, always: all of them, those with the given ids, or the first `count` of the order.

    `seed` decides the order. That of a subset is the whole set's with the others left out.
    """

    state_type = SetState

    def __init__(
        self, instances: InstanceSet, *, seed: int, ids: Sequence[int] | None = None, count: int | None = None
    ) -> None:
        self._instances = instances
        # Keys of ids and contexts: the order of rows in the file decides nothing.
        order = np.argsort(instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts), kind="stable")
        self._order = order[:count] if ids is None else order[np.isin(instances.ids[order], ids)]

    def start(self) -> tuple[SetState, Selection]:
        """The whole set, in its order."""
        state = SetState(version=0, order_version=0, size=len(self._order), selected=self._order)
        return state, self.selection(state)

    def step(self, state: SetState, feedback: Feedback) -> tuple[SetState, Selection, Numbers]:
        """The same set again; values are reported, not used."""
        trained = np.sort(state.selected)  # a mean must not depend on the order
        mean_after = float(np.abs(feedback.values_after[trained]).mean())
        new = dataclasses.replace(state, version=state.version + 1, mean_value=mean_after)
        numbers: Numbers = {
            "size": state.size,
            "trained_size": state.size,
            "grew": False,
            "mean_value_before": float(np.abs(feedback.values_before[trained]).mean()),
            "mean_value_after": mean_after,
        }
        return new, self.selection(new), numbers

    def selection(self, state: SetState) -> Selection:
        """The set in the run's order; `order_version` stays, so the walk never starts over."""
        return selection_of(self._instances, state)
