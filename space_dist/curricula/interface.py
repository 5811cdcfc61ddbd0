"""What every curriculum is: a pure function from a state and what was observed to the next state and selection."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from space_dist.instances import InstanceSet

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Numbers = dict[str, float | int | bool | None]
AdvantagePart = Literal["size", "positive"]

GENERATED = -1  # the id, and the index, of a context that is not of the instance set


@dataclass(frozen=True)
class Selection:
    """What to train on until the next decision.

    ids: (k,) instance ids in the order in which they are walked; GENERATED for contexts that are no instance's.
    contexts: (k, d) their contexts in environment units.
    version: counts decisions; whatever was computed for another version is refused.
    order_version: the version at which ids last changed; while it stays, the walk goes on where it stopped.
    drawn: whether these are draws, at least one for each episode that a round can hold, instead of a set to be passed
        over: an iteration is one round then, and what counts as trained on are the draws whose episodes ended.
    learned: whether the learner learns from these rounds. Where not, they are played for what they show, and charged to
        the budget all the same; `Wants.unlearned`.
    """

    version: int
    ids: IntArray
    contexts: FloatArray
    order_version: int
    drawn: bool = False
    learned: bool = True


@dataclass(frozen=True)
class Episodes:
    """The m training episodes that ended in one iteration, round after round, shard after shard.

    Whole ones: what of an episode was played in earlier iterations counts, too. m may be 0.

    indices: (m,) into the instance set, GENERATED for generated contexts.  contexts: (m, d) in environment units.
    returns, discounted_returns: (m,) in reward units.
    lengths: (m,) in steps.  success: (m,) 1 or 0, NaN where the environment knows no success.
    start_values: (m,) V(s0, c) behind the iteration's updates, in reward units.
    advantages: (m,) mean |GAE| over the episode's steps, or mean max(GAE, 0), as `Wants.advantage_part` says, in reward
        units; NaN for learners without advantages.
    running: (k,) the instances, one an episode, of what had begun and not ended when the iteration did; into the set.
    """

    indices: IntArray
    contexts: FloatArray
    returns: FloatArray
    discounted_returns: FloatArray
    lengths: IntArray
    success: FloatArray
    start_values: FloatArray
    advantages: FloatArray
    running: IntArray


@dataclass(frozen=True)
class Probes:
    """Episodes that were run only to learn how hard instances are; their steps count in the budget.

    indices: (k,) into the instance set.  returns: (k,) in reward units.  lengths: (k,) in steps.  success: (k,).
    """

    indices: IntArray
    returns: FloatArray
    lengths: IntArray
    success: FloatArray


@dataclass(frozen=True)
class Feedback:
    """What one iteration showed.

    version: of the selection that was trained on.
    values_before, values_after: (n,) start values V(s0, c_i) of *all* instances, in id order, before and after the
        iteration's updates, in reward units.
    gradient_steps: how many the iteration made on the network that is scored.
    episodes: the iteration's, if `Wants.episodes`.
    ensemble: (n, members) start values of all instances by each member of an ensemble, if `Wants.ensemble`.
    probes: of the instances that `Curriculum.probes` named; None where it named none, or the budget had no room.
    """

    version: int
    values_before: FloatArray
    values_after: FloatArray
    gradient_steps: int
    episodes: Episodes | None = None
    ensemble: FloatArray | None = None
    probes: Probes | None = None


@dataclass(frozen=True)
class Wants:
    """What a curriculum asks of its feedback, beside the start values of all instances.

    episodes: `Feedback.episodes`.
    advantages: `Episodes.advantages`, which only learners with advantages have.
    advantage_part: what of each step's advantage these are means of. size: |GAE|.  positive: max(GAE, 0).
    ensemble: an ensemble of value functions, trained on the rollouts, and its `Feedback.ensemble`.
    probes: to be asked, by `Curriculum.probes`, which instances shall be probed; the environment must report success.
    success: `Episodes.success`, which only some environments report.
    unlearned: to have rounds played that the learner does not learn from (`Selection.learned`); on-policy learners.
    """

    episodes: bool = False
    advantages: bool = False
    advantage_part: AdvantagePart = "size"
    ensemble: bool = False
    probes: bool = False
    success: bool = False
    unlearned: bool = False

    def counted(self, advantages: FloatArray) -> FloatArray:
        """What of each GAE counts: an array of the same shape and units."""
        parts: FloatArray = np.abs(advantages) if self.advantage_part == "size" else np.maximum(advantages, 0.0)
        return parts


@dataclass(frozen=True)
class State:
    """A curriculum's memory: plain numbers and arrays, so that it can be stored and moved anywhere.

    Every curriculum adds its own fields: int, float, bool, None, or NumPy arrays.
    version: of the last selection.
    """

    version: int


@dataclass(frozen=True)
class SetState(State):
    """The memory of a curriculum that trains on a set of instances.

    order_version: the version at which `selected` last changed.
    size: S, the number of instances selected.
    selected: (size,) indices into the instance set, in walking order.
    tests, growths, stalled: how often growth was tested, how often it was granted, and the tests since it last was.
    mean_value: mean |V| over the set trained on in the last iteration, as of its end; None before the first.
    eta: the growth threshold in force, where it is adapted for good; None where it is the configured one.
    """

    order_version: int
    size: int
    selected: IntArray
    tests: int = 0
    growths: int = 0
    stalled: int = 0
    mean_value: float | None = None
    eta: float | None = None


AnyState = TypeVar("AnyState", bound=State)


def encode_state(state: State) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A state as arrays and JSON data, by field."""
    fields = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    arrays = {name: value for name, value in fields.items() if isinstance(value, np.ndarray)}
    return arrays, {name: value for name, value in fields.items() if name not in arrays}


def decode_state(kind: type[AnyState], arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, Any]) -> AnyState:
    """The inverse of `encode_state`."""
    fields: dict[str, Any] = {**arrays, **numbers}
    return kind(**fields)


def selection_of(instances: InstanceSet, state: SetState) -> Selection:
    """The instances that a state has selected, in its order."""
    return Selection(
        version=state.version,
        ids=instances.ids[state.selected],
        contexts=np.take(instances.contexts, state.selected, axis=0),  # four times as fast as indexing a million rows
        order_version=state.order_version,
    )


class Curriculum(abc.ABC):
    """Chooses what to train on next. Implementations hold the instance set and constants only, never a state.

    state_type: what it remembers from one decision to the next.  wants: what it is told and asked.
    """

    state_type: type[State]
    wants: Wants = Wants()

    @abc.abstractmethod
    def start(self) -> tuple[State, Selection]:
        """The first selection, before anything was observed."""

    @abc.abstractmethod
    def step(self, state: Any, feedback: Feedback) -> tuple[State, Selection, Numbers]:
        """The next state and selection, and numbers for the log. Pure: same arguments, same answer.

        state: a `state_type`.
        """

    @abc.abstractmethod
    def selection(self, state: Any) -> Selection:
        """The selection that belongs to a state."""

    def probes(self, state: Any, episodes: Episodes | None) -> IntArray | None:  # noqa: ARG002 - most ask for none
        """`(k,)` indices of instances, one for each episode that the feedback on `state`'s selection shall probe.

        Asked if `Wants.probes`.  episodes: the iteration's, if `Wants.episodes`; their start values need not be known
        yet. Pure.
        """
        return None
