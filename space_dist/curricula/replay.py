"""Another run's curriculum, replayed: is it adaptivity that helps, or just the mixture that came of it?

A *yoked* learner gets, iteration after iteration, what somebody else's learner was given, whatever it shows itself.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula.draws import Draws, distinct, mean_values
from space_dist.curricula.interface import (
    GENERATED,
    Curriculum,
    Feedback,
    FloatArray,
    IntArray,
    Numbers,
    Selection,
    State,
    Wants,
)
from space_dist.instances import InstanceSet
from space_dist.ledger import decode_arrays, encode_arrays

_KINDS = {
    "drawn": "b", "budget_steps": "i", "round_steps": "i", "lengths": "i", "ids": "i", "generated": "f",
    "set_ids": "i", "set_contexts": "f",
}  # fmt: skip
_NUMBERS = ("drawn", "budget_steps", "round_steps")


@dataclass(frozen=True, eq=False)
class Recording:
    """What a run was trained on.

    drawn: an instance was drawn for each episode, instead of a set being passed over.  budget_steps, round_steps:
    environment steps of the run, and of a round, at most.
    lengths: (t,) instances of each iteration.  ids: (sum of lengths,) these, in the order in which they were trained
    on; of draws those whose episodes ended.  generated: (g, d) contexts of those that are GENERATED, in that order.
    set_ids, set_contexts: (n,) and (n, d) the run's training instances.
    """

    drawn: bool
    budget_steps: int
    round_steps: int
    lengths: IntArray
    ids: IntArray
    generated: FloatArray
    set_ids: IntArray
    set_contexts: FloatArray

    def encode(self) -> bytes:
        """As an npz; equal recordings make equal bytes."""
        return encode_arrays({name: np.asarray(getattr(self, name)) for name in _KINDS})

    @classmethod
    def decode(cls, content: bytes) -> Recording:
        """The inverse of `encode`. Raises ValueError for anything else."""
        arrays = decode_arrays(content)
        if arrays.keys() != _KINDS.keys() or any(arrays[name].dtype.kind != kind for name, kind in _KINDS.items()):
            raise ValueError("it holds other arrays than a recording has")
        numbers = [arrays.pop(name) for name in _NUMBERS]
        lengths, ids, generated = (arrays[name] for name in ("lengths", "ids", "generated"))
        fits = (
            [one.ndim for one in (*numbers, lengths, ids, generated)] == [0, 0, 0, 1, 1, 2]
            and len(ids) > 0
            and bool((lengths >= 0).all())
            and int(lengths.sum()) == len(ids)
            and len(generated) == int((ids == GENERATED).sum())
            and arrays["set_ids"].ndim == 1
            and arrays["set_contexts"].shape == (len(arrays["set_ids"]), generated.shape[1])
            and bool(np.isin(ids[ids != GENERATED], arrays["set_ids"]).all())
            and bool(np.isfinite(generated).all())
        )
        if not fits:
            raise ValueError("its arrays do not belong together")
        drawn, budget_steps, round_steps = numbers
        return cls(bool(drawn), int(budget_steps), int(round_steps), **arrays)

    def strangers(self, instances: InstanceSet) -> IntArray:
        """Those of the recorded instances that `instances` does not have, or with another context."""
        used = np.unique(self.ids[self.ids != GENERATED])
        theirs = self.set_contexts[np.searchsorted(self.set_ids, used)]
        known = np.isin(used, instances.ids)
        places = np.searchsorted(instances.ids, used[known])
        known[known] = (instances.contexts[places] == theirs[known]).all(axis=1)
        return used[~known]


class Replay(Curriculum):
    """Iteration t trains on what iteration t of the recording was trained on; behind its end, on its last.

    Of draws every iteration repeats the recorded ones in their order, as often as a round can use. An iteration in
    which no episode ended has those of the one before it, and the first ones those of the first that has any.
    """

    state_type = State

    def __init__(self, instances: InstanceSet, recording: Recording, *, draws: Draws) -> None:
        self.recording, self._draws, self._drawn = recording, draws, recording.drawn
        self.wants = Wants(episodes=recording.drawn)
        ids, ends = recording.ids, np.cumsum(recording.lengths)
        of_set = ids != GENERATED
        contexts = np.empty((len(ids), recording.generated.shape[1]))
        contexts[~of_set] = recording.generated
        contexts[of_set] = instances.contexts[np.searchsorted(instances.ids, ids[of_set])]
        self._ids, self._contexts = ids, contexts
        some = np.flatnonzero(recording.lengths)
        # (t,) the iteration whose instances each has: its own, or where that is empty the last before it.
        at = np.searchsorted(some, np.arange(len(ends)), side="right") - 1
        self._ends, self._starts = ends, ends - recording.lengths
        self._source = some[np.maximum(at, 0)]

    def start(self) -> tuple[State, Selection]:
        """The first iteration's."""
        state = State(version=0)
        return state, self.selection(state)

    def step(self, state: State, feedback: Feedback) -> tuple[State, Selection, Numbers]:
        """The next iteration's; values are reported, not used."""
        new = State(state.version + 1)
        selection = self.selection(new)
        size = distinct(feedback) if self._drawn else len(selection.ids)
        return new, selection, {"size": size, **mean_values(feedback)}

    def selection(self, state: State) -> Selection:
        """See `Curriculum`."""
        ids, contexts = self._recorded(state.version)
        if not self._drawn:
            return Selection(state.version, ids, contexts, order_version=int(self._changed[self._place(state.version)]))
        dealt = self._draws.dealt(np.resize(np.arange(len(ids)), self._draws.count))
        return Selection(state.version, ids[dealt], contexts[dealt], order_version=state.version, drawn=True)

    def _place(self, version: int) -> int:
        return min(version, len(self._source) - 1)

    def _recorded(self, version: int) -> tuple[IntArray, FloatArray]:
        source = self._source[self._place(version)]
        mine = slice(self._starts[source], self._ends[source])
        return self._ids[mine], self._contexts[mine]

    @functools.cached_property
    def _changed(self) -> NDArray[Any]:
        """(t,) the version at which the order of each iteration came up: the walk goes on while it stays."""
        changed = np.zeros(len(self._source), dtype=np.int64)
        for version in range(1, len(changed)):
            same = np.array_equal(self._recorded(version)[0], self._recorded(version - 1)[0])
            changed[version] = changed[version - 1] if same else version
        return changed
