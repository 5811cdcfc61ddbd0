"""What a run must remember to go on, beside what its learner, ensemble and curriculum save of themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import Episodes
from space_dist.ledger import Checkpoint
from space_dist.rollout import Setup
from space_dist.rollout.episodes import joined_episodes
from space_dist.rollout.walk import Walk, stacked, unstacked

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Form:
    """How a field lies in a checkpoint.

    pack: (name, value) -> its part of the run's data, as JSON has it, and its arrays. unpack: the value, from these.
    """

    pack: Callable[[str, Any], tuple[dict[str, Any], Arrays]]
    unpack: Callable[[str, Checkpoint, Setup], Any]


def _under(folder: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    return {f"{folder}/{name}": array for name, array in arrays.items()}


def _walk_in(name: str, checkpoint: Checkpoint, setup: Setup) -> Walk:
    order_version, positions = checkpoint.data["run"][name]
    # Before the first round nothing is under way.
    if not positions:
        return Walk(order_version, ())
    return Walk(
        order_version, tuple(positions),
        unstacked(
            checkpoint.under("unfinished/"), shards=setup.shards, slots=setup.slots, features=len(setup.train.names),
            horizon=setup.spec.horizon, action_shape=setup.spec.action_space.shape or (),
            memory_size=setup.memory_size,
        ),
    )  # fmt: skip


_DATA = _Form(lambda name, value: ({name: value}, {}), lambda name, checkpoint, _: checkpoint.data["run"][name])
_LATER = _Form(  # left out where it is 0, as it is in runs of earlier versions
    lambda name, value: ({name: value} if value else {}, {}),
    lambda name, checkpoint, _: checkpoint.data["run"].get(name, 0),
)
_ARRAY = _Form(
    lambda name, value: ({}, {} if value is None else {name: value}),
    lambda name, checkpoint, _: checkpoint.arrays.get(name),
)
_ARRAYS = _Form(
    lambda name, value: ({}, _under(name, value)), lambda name, checkpoint, _: checkpoint.under(f"{name}/")
)  # fmt: skip
_EPISODES = _Form(  # of several rounds as those of one: nobody tells them apart
    lambda name, value: ({}, _under(name, vars(joined_episodes(value))) if value else {}),
    lambda name, checkpoint, _: [Episodes(**found)] if (found := checkpoint.under(f"{name}/")) else [],
)
_WALK = _Form(
    lambda name, walk: ({name: [walk.order_version, list(walk.positions)]}, _under("unfinished", stacked(walk))),
    _walk_in,
)


@dataclass
class RunState:
    """Everything of a run's own that changes from round to round and cannot be asked for again.

    Every field is stored, plain ones as JSON, in the order in which they stand here, which is that of the file.

    scored: weights that the kept start values belong to, where scales change.
    acted: weights that collect the next round already, if any do.
    seen: the episodes of this iteration's rounds, where anyone asks for them.
    round, steps, episodes: rounds, real environment steps, and training episodes that ended.
    iteration: counted from 1.  rounds_left: in it; None until the selection is known.
    version: of the selection being trained on.  walk: where the next round goes on in it.
    rows: of the ledger.  evaluated_at: steps at the last evaluation.
    rollouts, updates, gradient_steps: what this iteration's rounds and updates showed.
    sizes: (slots,) sums of what counts of their advantages over running episodes, where anyone asks.
    curriculum_number: curricula that were in force before the one whose state is stored.
    """

    scored: Arrays = field(default_factory=dict, metadata={"form": _ARRAYS})
    acted: Arrays = field(default_factory=dict, metadata={"form": _ARRAYS})
    seen: list[Episodes] = field(default_factory=list, metadata={"form": _EPISODES})
    round: int = 0
    steps: int = 0
    episodes: int = 0
    iteration: int = 1
    rounds_left: int | None = None
    version: int = 0
    walk: Walk = field(default_factory=lambda: Walk(-1, ()), metadata={"form": _WALK})
    rows: int = 0
    evaluated_at: int = -1
    rollouts: list[dict[str, float]] = field(default_factory=list)
    updates: list[dict[str, float]] = field(default_factory=list)
    gradient_steps: int = 0
    sizes: NDArray[np.float64] | None = field(default=None, metadata={"form": _ARRAY})
    curriculum_number: int = field(default=0, metadata={"form": _LATER})

    def save(self) -> tuple[dict[str, Any], Arrays]:
        """What `restored` makes this of again: a checkpoint's `run` data, and arrays."""
        data: dict[str, Any] = {}
        arrays: Arrays = {}
        for one in fields(self):
            numbers, columns = _form(one.metadata).pack(one.name, getattr(self, one.name))
            data |= numbers
            arrays |= columns
        return data, arrays

    @classmethod
    def restored(cls, checkpoint: Checkpoint, setup: Setup) -> RunState:
        """As it was saved. Raises SpaceDistError if the checkpoint's episodes in progress cannot be this run's."""
        return cls(**{one.name: _form(one.metadata).unpack(one.name, checkpoint, setup) for one in fields(cls)})


def _form(metadata: Mapping[str, Any]) -> _Form:
    form: _Form = metadata.get("form", _DATA)
    return form
