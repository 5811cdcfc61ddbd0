"""What the whole episodes of a run tell: to its curriculum, and to its log."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import GENERATED, Episodes
from space_dist.instances import InstanceSet
from space_dist.rollout import Shard

FloatArray = NDArray[np.float64]


def curriculum_episodes(train: InstanceSet, shards: Sequence[Shard], advantages: FloatArray | None) -> Episodes:
    """A round's episodes for the curriculum, shard after shard; their start values are not known.

    advantages: (m,) as `Episodes.advantages`; None where nobody asks for it.
    """
    tables = [shard.episodes for shard in shards]

    def column(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(table, name) for table in tables])

    ids = column("ids")
    unknown = np.full(len(ids), np.nan)
    running = np.concatenate([shard.unfinished.ids[shard.unfinished.lengths > 0] for shard in shards])
    return Episodes(
        # Instance sets are sorted by id.
        indices=np.where(ids == GENERATED, GENERATED, np.searchsorted(train.ids, ids)), contexts=column("contexts"),
        returns=column("returns"), discounted_returns=column("discounted_returns"), lengths=column("lengths"),
        success=column("success"), start_values=unknown, advantages=unknown if advantages is None else advantages,
        running=np.searchsorted(train.ids, running[running != GENERATED]),
    )  # fmt: skip


def joined_episodes(parts: Sequence[Episodes]) -> Episodes:
    """The episodes of all rounds of an iteration, in order; what runs on is what does after the last."""
    names = [field.name for field in dataclasses.fields(Episodes) if field.name != "running"]
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Episodes(**columns, running=parts[-1].running)


def mean_sizes(shards: Sequence[Shard], sizes: FloatArray, before: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`(m,)` the mean of `sizes` over all steps of each episode that ended, shard after shard; and `before` for later.

    sizes: (length, slots of all shards) of this round's steps.  before: (slots of all shards,) the sums over those
    steps of running episodes that came before this round.
    """
    sums = np.zeros((len(sizes) + 1, sizes.shape[1]))
    np.cumsum(sizes, axis=0, out=sums[1:])
    sums += np.where(np.concatenate([shard.starts for shard in shards]), 0.0, before)
    passed = np.zeros(sizes.shape[1])  # the sums where a slot's last episode ended
    means, first = [], 0
    for shard in shards:
        episodes, mine = shard.episodes, np.empty(len(shard.episodes))
        with np.errstate(invalid="ignore"):  # of infinite rewards: the update says that training diverged
            for number, (slot, time) in enumerate(zip(episodes.slots + first, episodes.times, strict=True)):
                reached = sums[time + 1, slot]
                mine[number] = (reached - passed[slot]) / episodes.lengths[number]
                passed[slot] = reached
        means.append(mine)
        first += shard.rewards.shape[1]
    with np.errstate(invalid="ignore"):
        return np.concatenate(means), sums[-1] - passed


def summed(shards: Sequence[Shard], *, lag: int) -> dict[str, float]:
    """Sums over the episodes that ended in a round, and how many did. lag: updates that the weights were behind."""
    sums = {"lagged": float(lag * sum(shard.steps for shard in shards))}
    sums |= dict.fromkeys(("episodes", "return", "discounted_return", "length", "success"), 0.0)
    for shard in shards:
        episodes = shard.episodes
        sums["episodes"] += len(episodes)
        sums["return"] += float(episodes.returns.sum())
        sums["discounted_return"] += float(episodes.discounted_returns.sum())
        sums["length"] += float(episodes.lengths.sum())
        sums["success"] += float(episodes.success.sum())
    return sums


def rounds_over(episodes: float, horizon: int, n_steps: int) -> int:
    """Rounds of `n_steps` transitions that have room for so many episodes at full horizon; at least one.

    Source: decision 8 of docs/algorithm.md.
    """
    # Multiplied first: 300 episodes of 7 steps in rounds of 300 steps are 7 rounds, and 300 / (300 / 7) is more than 7.
    return max(1, math.ceil(episodes * horizon / n_steps))
