"""Prioritised level replay (Jiang et al. 2021) over a finite set, with the score `value_l1`: mean |GAE|.

What the paper decides before every episode is decided here once an iteration, for all of its episodes: scores and
staleness change between iterations only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from space_dist.curricula.draws import Drawn, DrawnState, Draws, uniform
from space_dist.curricula.interface import BoolArray, Feedback, FloatArray, IntArray, Numbers, Selection, Wants
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, UInt64Array, instance_keys


@dataclass(frozen=True)
class ReplayState(DrawnState):
    """scores: (n,) mean |GAE| when an instance was last trained on, in reward units; 0 where it never was.

    last: (n,) the version in which it was last trained on; -1 where it never was.
    """

    scores: FloatArray
    last: IntArray


class LevelReplay(Drawn):
    """Instances that were never trained on come first, in a seeded order; then they are replayed by rank and staleness.

    temperature: beta; the chance of rank r is proportional to r^(-1/beta).
    staleness_share: rho, the weight of the time since an instance was last trained on.
    """

    state_type = ReplayState
    wants = Wants(episodes=True, advantages=True)

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, temperature: float, staleness_share: float
    ) -> None:
        super().__init__(instances, seed=seed, draws=draws)
        self._temperature, self._staleness_share = temperature, staleness_share
        self._ties = instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts)

    def start(self) -> tuple[ReplayState, Selection]:
        """Nothing was trained on yet."""
        n = len(self._instances)
        state = ReplayState(0, uniform(n), scores=np.zeros(n), last=np.full(n, -1))
        return state, self.selection(state)

    def step(self, state: ReplayState, feedback: Feedback) -> tuple[ReplayState, Selection, Numbers]:
        """Score what was trained on, and weigh anew. An instance trained on more than once has its episodes' mean."""
        episodes = feedback.episodes
        if episodes is None or np.isnan(episodes.advantages).any():
            raise ValueError("PLR needs the advantages of each episode")
        n = len(self._instances)
        counts = np.bincount(episodes.indices, minlength=n)
        sums = np.bincount(episodes.indices, weights=episodes.advantages, minlength=n)
        trained = counts > 0
        scores = np.where(trained, sums / np.maximum(counts, 1), state.scores)
        last = np.where(trained, state.version, state.last)
        seen = last >= 0
        chances = uniform(n)
        if seen.any():  # an iteration may be over before its first episode is
            chances = replay_chances(
                scores, state.version - last, seen, self._ties, self._temperature, self._staleness_share
            )
        new = ReplayState(state.version + 1, chances, scores, last)
        numbers = self._numbers(feedback, chances)
        numbers |= {"seen": int(seen.sum()), "mean_score": float(scores[seen].mean()) if seen.any() else None,
                    "largest_score": float(scores.max())}  # fmt: skip
        return new, self.selection(new), numbers

    def selection(self, state: ReplayState) -> Selection:
        """What was never trained on, then draws by chance."""
        unseen = np.flatnonzero(state.last < 0)
        unseen = unseen[np.argsort(self._ties[unseen], kind="stable")]
        drawn = self._by_chance(state.version, state.chances)
        return self._drawn(state.version, np.concatenate([unseen, drawn])[: self._draws.count])


def replay_chances(
    scores: FloatArray, staleness: IntArray, seen: BoolArray, ties: UInt64Array, temperature: float, share: float
) -> FloatArray:
    """`(n,)` chances (1 - share) * rank^(-1/temperature) + share * staleness, each term with sum 1 over those seen.

    scores: (n,), the highest has rank 1, equal ones are ranked by `ties`.  staleness: (n,) iterations since an instance
    was last trained on.  Where none is stale, all that were seen count alike.
    """
    indices = np.flatnonzero(seen)
    ranks = np.empty(len(indices))
    ranks[np.lexsort((ties[indices], -scores[indices]))] = np.arange(1, len(indices) + 1)
    by_rank = ranks ** (-1.0 / temperature)
    stale = staleness[indices].astype(np.float64)
    by_staleness = stale / stale.sum() if stale.any() else uniform(len(indices))
    chances = np.zeros(len(scores))
    chances[indices] = (1.0 - share) * by_rank / by_rank.sum() + share * by_staleness
    return chances
