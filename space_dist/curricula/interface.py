"""What every curriculum is: a pure function from a state and what was observed to the next state and selection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from space_dist.instances import InstanceSet

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Numbers = dict[str, float | int | bool | None]


@dataclass(frozen=True)
class Selection:
    """What to train on until the next decision.

    ids: (k,) instance ids in the order in which they are walked.
    contexts: (k, d) their contexts in environment units.
    version: counts decisions; whatever was computed for another version is refused.
    order_version: the version at which ids last changed; while it stays, the walk goes on where it stopped.
    """

    version: int
    ids: IntArray
    contexts: FloatArray
    order_version: int


@dataclass(frozen=True)
class Feedback:
    """What one iteration showed.

    version: of the selection that was trained on.
    values_before, values_after: (n,) start values V(s0, c_i) of *all* instances, in id order, before and after the
        iteration's updates, in reward units.
    gradient_steps: how many the iteration made on the network that is scored.
    """

    version: int
    values_before: FloatArray
    values_after: FloatArray
    gradient_steps: int


@dataclass(frozen=True)
class State:
    """A curriculum's memory: plain numbers and arrays, so that it can be stored and moved anywhere.

    version, order_version: of the last selection.
    size: S, the number of instances selected.
    selected: (size,) indices into the instance set, in walking order.
    tests, growths, stalled: how often growth was tested, how often it was granted, and the tests since it last was.
    mean_value: mean |V| over the set trained on in the last iteration, as of its end; None before the first.
    eta: the growth threshold in force, where it is adapted for good; None where it is the configured one.
    """

    version: int
    order_version: int
    size: int
    selected: IntArray
    tests: int = 0
    growths: int = 0
    stalled: int = 0
    mean_value: float | None = None
    eta: float | None = None


def selection_of(instances: InstanceSet, state: State) -> Selection:
    """The instances that a state has selected, in its order."""
    return Selection(
        version=state.version,
        ids=instances.ids[state.selected],
        contexts=np.take(instances.contexts, state.selected, axis=0),  # four times as fast as indexing a million rows
        order_version=state.order_version,
    )


class Curriculum(Protocol):
    """Chooses what to train on next. Implementations hold the instance set and constants only, never a state."""

    def start(self) -> tuple[State, Selection]:
        """The first selection, before anything was observed."""

    def step(self, state: State, feedback: Feedback) -> tuple[State, Selection, Numbers]:
        """The next state and selection, and numbers for the log. Pure: same arguments, same answer."""

    def selection(self, state: State) -> Selection:
        """The selection that belongs to a state."""
