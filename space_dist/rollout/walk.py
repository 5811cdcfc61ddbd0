"""Where a round goes on: in the selection's order, and in the episodes that the round before left unfinished."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import Selection
from space_dist.errors import SpaceDistError
from space_dist.seeding import Purpose, episode_seeds

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Unfinished:
    """The episodes that run in a shard's slots between two rounds: all that it takes to play them again, and go on.

    ids: (slots,) instance.  contexts: (slots, d) in environment units.  seeds: (slots,).
    lengths: (slots,) steps so far; 0 where no episode runs, and then everything else of the slot is 0.
    returns, discounted_returns: (slots,) sums of rewards so far.  discounts: (slots,) gamma^length.
    actions: (lengths.max(), slots, ...) as the environment was given them. The last row is everybody's last step; rows
        before an episode's first step are 0.
    memory: (slots, memory_size) what a recurrent policy remembers of each, by the weights that saw it; None of others.
    """

    ids: IntArray
    contexts: FloatArray
    seeds: NDArray[np.uint64]
    lengths: IntArray
    returns: FloatArray
    discounted_returns: FloatArray
    discounts: FloatArray
    actions: NDArray[np.generic]
    memory: NDArray[np.float32] | None = None

    def same(self, other: Unfinished | None) -> bool:
        """Whether both are the same to the bit."""
        if self is other:  # as whoever goes on at once is handed back what it gave
            return True
        if other is None or (self.memory is None) != (other.memory is None):
            return False
        return all(
            one.shape == two.shape and one.dtype == two.dtype and one.tobytes() == two.tobytes()
            for one, two in zip(vars(self).values(), vars(other).values(), strict=True)
            if one is not None
        )


@dataclass(frozen=True)
class Walk:
    """Where each shard goes on. Its place in the order is void once the order has changed; its episodes go on.

    positions: (shards,) of the next episode's instance in the selection's order.
    unfinished: (shards,) what runs in each; None: nothing.  Empty: nothing runs anywhere.
    """

    order_version: int
    positions: tuple[int, ...]
    unfinished: tuple[Unfinished | None, ...] = ()

    def position(self, selection: Selection, shard: int, n_shards: int) -> int:
        """The place in `selection` of a shard's next episode: `n_shards` shards start spread over a new order."""
        if selection.order_version == self.order_version:
            return self.positions[shard] % len(selection.ids)
        return shard % n_shards * len(selection.ids) // n_shards

    def running(self, shard: int) -> Unfinished | None:
        """The episodes that run in a shard's slots."""
        return self.unfinished[shard] if self.unfinished else None

    def of(self, shard: int) -> Walk:
        """The same, without what runs in other shards: what is sent to whoever collects this one."""
        mine = (one if number == shard else None for number, one in enumerate(self.unfinished))
        return dataclasses.replace(self, unfinished=tuple(mine))

    def after(
        self, selection: Selection, begun: Sequence[int], unfinished: Sequence[Unfinished], *, n_shards: int
    ) -> Walk:  # fmt: skip
        """Where the next round goes on. begun: episodes that each shard began; n_shards: as in `position`."""
        positions = tuple(
            (self.position(selection, shard, n_shards) + count) % len(selection.ids)
            for shard, count in enumerate(begun)
        )
        return Walk(selection.order_version, positions, tuple(unfinished))


class Route(Protocol):
    """Which episodes the slots of a shard go on with in a round, and which they begin: `selection`, from `start`."""

    @property
    def selection(self) -> Selection:
        """What is walked."""

    @property
    def start(self) -> int:
        """The place in `selection` of the next episode."""

    @property
    def gamma(self) -> float:
        """Discount per step."""

    @property
    def seed(self) -> int:
        """The run's; with `round` and `shard` it decides the episodes' own."""

    @property
    def round(self) -> int:
        """Of the run, from 0."""

    @property
    def shard(self) -> int:
        """Of the round, from 0."""

    @property
    def unfinished(self) -> Unfinished | None:
        """What runs in the slots; None: nothing."""


_EPISODES = 4  # of a slot in a round, whose seeds are drawn before it is known how many there are


class Walking:
    """Which instance, with which seed, each slot's next episode has, over several rollouts of `slots` slots each."""

    def __init__(self, rollouts: Sequence[Route], slots: int) -> None:
        self._rollouts, self._slots = rollouts, slots
        self.begun = np.zeros(len(rollouts), dtype=np.int64)  # episodes
        self._starts = np.array([rollout.start for rollout in rollouts])
        self._sizes = np.array([len(rollout.selection.ids) for rollout in rollouts])
        self._firsts = np.cumsum(self._sizes) - self._sizes  # of each rollout's instances among all
        self._ids = np.concatenate([rollout.selection.ids for rollout in rollouts])
        self._contexts = np.concatenate([rollout.selection.contexts for rollout in rollouts])
        self._seeds = self._drawn(_EPISODES * slots)

    def _drawn(self, count: int) -> NDArray[np.uint64]:
        """`(len(rollouts), count)` seeds of their first episodes: fewer are the beginning of more."""
        return np.stack([
            episode_seeds(one.seed, Purpose.EPISODES, one.round, one.shard, count=count) for one in self._rollouts
        ])  # fmt: skip

    def next(self, slots: IntArray) -> tuple[IntArray, FloatArray, NDArray[np.uint64]]:
        """(k,) ids, (k, d) contexts and (k,) seeds of the episodes that begin in `slots` (k,), which ascend."""
        owners = slots // self._slots
        numbers = self.begun[owners] + np.arange(len(slots)) - np.searchsorted(owners, owners)
        self.begun += np.bincount(owners, minlength=len(self.begun))
        # One for each step, as many as there may be, would take a twelfth of a round.
        while numbers.max(initial=0) >= self._seeds.shape[1]:
            self._seeds = self._drawn(2 * self._seeds.shape[1])
        places = self._firsts[owners] + (self._starts[owners] + numbers) % self._sizes[owners]
        return self._ids[places], self._contexts[places], self._seeds[owners, numbers]


def stacked(walk: Walk) -> dict[str, NDArray[Any]]:
    """All shards' unfinished episodes as arrays for a checkpoint: (shards, ...) each; none before the first round."""
    unfinished = [one for one in walk.unfinished if one is not None]
    if not unfinished:
        return {}
    length = max(len(one.actions) for one in unfinished)

    def padded(actions: NDArray[np.generic]) -> NDArray[np.generic]:
        return np.concatenate([np.zeros((length - len(actions), *actions.shape[1:]), actions.dtype), actions])

    names = [name for name, column in vars(unfinished[0]).items() if name != "actions" and column is not None]
    arrays = {name: np.stack([getattr(one, name) for one in unfinished]) for name in names}
    return {**arrays, "actions": np.stack([padded(one.actions) for one in unfinished])}


def unstacked(
    arrays: Mapping[str, NDArray[Any]], *, shards: int, slots: int, features: int, horizon: int,
    action_shape: tuple[int, ...], memory_size: int = 0,
) -> tuple[Unfinished, ...]:  # fmt: skip
    """The inverse of `stacked`. Raises SpaceDistError for anything that cannot be a run's of these numbers.

    memory_size: of its policy, for each slot; 0: it is not recurrent.
    """
    each = (shards, slots)
    shapes = {
        "ids": ("int64", each), "contexts": ("float64", (*each, features)), "seeds": ("uint64", each),
        "lengths": ("int64", each), "returns": ("float64", each), "discounted_returns": ("float64", each),
        "discounts": ("float64", each),
    }  # fmt: skip
    if memory_size:
        shapes["memory"] = ("float32", (*each, memory_size))
    fit = arrays.keys() == {*shapes, "actions"} and all(
        (arrays[name].dtype.name, arrays[name].shape) == expected for name, expected in shapes.items()
    )
    if fit:
        lengths, actions = arrays["lengths"], arrays["actions"]
        fit = (
            # A checkpoint is hostile until it fits: these numbers decide how many steps are played again.
            bool(((lengths >= 0) & (lengths < horizon)).all())
            and actions.dtype.kind in "if"
            and actions.shape == (shards, lengths.max(), slots, *action_shape)
        )
    if not fit:
        raise SpaceDistError(
            "the checkpoint's episodes in progress are not those of a run with this config: it was written by another "
            "version of space_dist, or the environment has changed. Use another folder"
        )
    longest = lengths.max(axis=1)
    return tuple(
        Unfinished(
            **{name: arrays[name][shard] for name in shapes},
            actions=actions[shard, actions.shape[1] - longest[shard] :],
        )
        for shard in range(shards)
    )
