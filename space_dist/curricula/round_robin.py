"""Round robin: every instance in turn, in one random order that never changes (the paper's first baseline)."""

from __future__ import annotations

import dataclasses

import numpy as np

from space_dist.curricula.interface import Feedback, Numbers, Selection, State
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, instance_keys


class RoundRobin:
    """All instances, always. `seed` decides the order."""

    def __init__(self, instances: InstanceSet, *, seed: int) -> None:
        self._instances = instances
        self._order = np.argsort(instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts), kind="stable")

    def start(self) -> tuple[State, Selection]:
        """The whole set, in its order."""
        state = State(version=0, order_version=0, size=len(self._instances), selected=self._order)
        return state, self.selection(state)

    def step(self, state: State, feedback: Feedback) -> tuple[State, Selection, Numbers]:
        """The same set again; values are reported, not used."""
        mean_after = float(np.abs(feedback.values_after).mean())
        new = dataclasses.replace(state, version=state.version + 1, mean_value=mean_after)
        numbers: Numbers = {
            "size": state.size,
            "trained_size": state.size,
            "grew": False,
            "mean_value_before": float(np.abs(feedback.values_before).mean()),
            "mean_value_after": mean_after,
        }
        return new, self.selection(new), numbers

    def selection(self, state: State) -> Selection:
        """Every instance, in the run's order; `order_version` stays, so the walk never starts over."""
        return Selection(
            version=state.version,
            ids=self._instances.ids[state.selected],
            contexts=np.take(self._instances.contexts, state.selected, axis=0),
            order_version=state.order_version,
        )
