"""The book of a round's episodes: those that run in the slots, and those that have ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.rollout.walk import FloatArray, IntArray, Route, Unfinished


@dataclass(frozen=True)
class Episodes:
    """The episodes that ended in a round, whole ones, in the order in which they ended: time, then slots.

    ids: instance.  contexts: (m, d) in environment units.  slots, times: where in the shard, and at which of the
    round's steps, each ended.  lengths: in steps, of which those before the round count.  returns, discounted_returns:
    sums of all rewards.
    success: whether the goal was reached at the last step; NaN where the environment knows no success.
    """

    ids: IntArray
    contexts: FloatArray
    slots: IntArray
    times: IntArray
    lengths: IntArray
    returns: FloatArray
    discounted_returns: FloatArray
    success: FloatArray

    def __len__(self) -> int:
        return len(self.ids)


class EpisodeTable:
    """The episodes that run in the slots of several rollouts, one rollout's after another's, and those that have ended.

    runs: (n_slots,) whether a slot has an episode.  ids, contexts, seeds, returns: (n_slots, ...) of these.
    actions: (steps, n_slots, ...) given before this round, as in `Unfinished`.  ended: how many have.
    """

    def __init__(self, rollouts: Sequence[Route], slots: int) -> None:
        known = [rollout.unfinished or _nothing(rollout, slots) for rollout in rollouts]

        def column(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(one, name) for one in known])

        self._slots = slots
        self._gamma = np.repeat([rollout.gamma for rollout in rollouts], slots)
        self.ids, self.contexts, self.seeds = column("ids"), column("contexts"), column("seeds")
        self.returns, self._discounted, self._discount = (
            column(name) for name in ("returns", "discounted_returns", "discounts")
        )
        self._starts = -column("lengths")  # at which step of this round; negative: before it
        self.runs = self._starts < 0
        self.actions = _aligned([one.actions for one in known], slots)
        self.ended = 0
        self._due = 0  # no running episode is as long as the horizon before this step
        self._ended: list[tuple[Any, ...]] = []  # in the order of the fields of `Episodes`

    def lengths(self, time: int) -> IntArray:
        """`(n_slots,)` steps that the running episodes have made, before step `time` of this round."""
        return time - self._starts

    def overdue(self, time: int, horizon: int) -> bool:
        """Whether an episode runs on that has made `horizon` steps before step `time` of this round."""
        if time < self._due:  # looked at about once a horizon: what begins later is due later
            return False
        self._due = int(self._starts[self.runs].min(initial=time)) + horizon
        return time >= self._due

    def begin(self, slots: IntArray, ids: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64], time: int) -> None:
        """Have episodes run in `slots` (k,), from step `time` of this round on."""
        self.ids[slots], self.contexts[slots], self.seeds[slots] = ids, contexts, seeds
        self._starts[slots], self.runs[slots] = time, True
        self.returns[slots], self._discounted[slots], self._discount[slots] = 0.0, 0.0, 1.0

    def add(self, rewards: FloatArray) -> None:
        """Count one step of every slot."""
        self.returns += rewards
        self._discounted += self._discount * rewards
        self._discount *= self._gamma

    def end(self, slots: IntArray, time: int, success: NDArray[np.bool_] | None) -> None:
        """Note that the episodes in `slots` (k,) ended with step `time`."""
        if not len(slots):
            return
        reached = np.full(len(slots), np.nan) if success is None else success[slots].astype(np.float64)
        self._ended.append(
            (self.ids[slots], self.contexts[slots], slots, np.full(len(slots), time), time + 1 - self._starts[slots],
             self.returns[slots], self._discounted[slots], reached)
        )  # fmt: skip
        self.runs[slots] = False
        self.ended += len(slots)

    def episodes(self, owners: int) -> list[Episodes]:
        """Every owner's own that have ended."""
        if not self._ended:
            none, numbers = np.zeros(0, dtype=np.int64), np.zeros(0)
            return [Episodes(none, self.contexts[:0], none, none, none, numbers, numbers, numbers)] * owners
        ids, contexts, slots, *others = (np.concatenate(column) for column in zip(*self._ended, strict=True))
        owner = slots // self._slots
        return [
            Episodes(ids[mine], contexts[mine], slots[mine] % self._slots, *(column[mine] for column in others))
            for index in range(owners)
            for mine in [owner == index]
        ]

    def unfinished(
        self, owners: int, executed: NDArray[np.generic], memory: NDArray[np.float32] | None = None
    ) -> list[Unfinished]:  # fmt: skip
        """Every owner's own that run on, after the actions `executed` (length, n_slots, ...) of this round.

        memory: (n_slots, memory_size) what their policy remembers, if it is recurrent.
        """
        runs, time = self.runs, len(executed)
        lengths = np.where(runs, self.lengths(time), 0)
        actions = np.concatenate([self.actions, executed]) if len(self.actions) else executed
        actions = actions[len(actions) - lengths.max() :].copy()
        early = np.arange(len(actions))[:, None] < len(actions) - lengths
        # Zeros, so that equal episodes are equal to the bit (`Unfinished.same`), whatever ran in the slot before.
        actions[early] = 0
        found = []
        for index in range(owners):
            mine = slice(index * self._slots, (index + 1) * self._slots)
            running, steps = runs[mine], int(lengths[mine].max())
            found.append(
                Unfinished(
                    ids=np.where(running, self.ids[mine], 0),
                    contexts=np.where(running[:, None], self.contexts[mine], 0.0),
                    seeds=np.where(running, self.seeds[mine], np.uint64(0)), lengths=lengths[mine].copy(),
                    returns=np.where(running, self.returns[mine], 0.0),
                    discounted_returns=np.where(running, self._discounted[mine], 0.0),
                    discounts=np.where(running, self._discount[mine], 0.0),
                    actions=actions[len(actions) - steps :, mine].copy(),
                    memory=None if memory is None else np.where(running[:, None], memory[mine], np.float32(0.0)),
                )
            )  # fmt: skip
        return found


def _nothing(rollout: Route, slots: int) -> Unfinished:
    """That no episode runs in a shard's slots."""
    zeros, whole = np.zeros(slots), np.zeros(slots, dtype=np.int64)
    contexts = np.zeros((slots, rollout.selection.contexts.shape[1]))
    return Unfinished(whole, contexts, whole.astype(np.uint64), whole, zeros, zeros, zeros, np.zeros((0, slots)))


def _aligned(actions: Sequence[NDArray[np.generic]], slots: int) -> NDArray[np.generic]:
    """`(steps, all slots, ...)` from the recorded actions of several shards, whose last steps are everybody's last."""
    longest = max(actions, key=len)
    joined = np.zeros((len(longest), len(actions) * slots, *longest.shape[2:]), dtype=longest.dtype)
    for index, mine in enumerate(actions):
        if len(mine):
            joined[len(longest) - len(mine) :, index * slots : (index + 1) * slots] = mine
    return joined
