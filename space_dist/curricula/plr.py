"""Prioritised level replay (Jiang et al. 2021) over a finite set, with the score `value_l1`: mean |GAE|.

The paper decides before every episode; here the episodes of an iteration are drawn at once, for scores are only known
behind its update. Drawn from the paper's chances as they stand (`fixed_chances`), nearly all episodes of an iteration
are of one instance: with beta = 0.1 the first rank has 99.9 % of its term, and nothing happens between two draws that
could take it away. In the paper's loop it is taken away: an instance that was played is learned from, its score falls,
and its staleness is 0. So by default what was drawn leaves the ranking until everything else was drawn
(`without_repetition`), and staleness grows with every draw. What still runs when an iteration ends was drawn, too: its
score is not known yet, and it is not begun a second time meanwhile.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from typing import Literal

import numpy as np

from space_dist.curricula.draws import Drawn, DrawnState, Draws, effective_size, uniform
from space_dist.curricula.interface import BoolArray, Feedback, FloatArray, IntArray, Numbers, Selection, Wants
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, UInt64Array, generator, instance_keys

WithinUpdate = Literal["without_repetition", "fixed_chances"]


@dataclass(frozen=True)
class ReplayState(DrawnState):
    """chances: (n,) the paper's, as of the first draw.

    scores: (n,) mean |GAE| when an instance was last trained on, in reward units; 0 where it never was.
    last: (n,) the episode of the run, counted from 0, in which it was last trained on; -1 where it never was.
    episodes: how many the run has trained on.
    running: (k,) indices of the instances of which an episode runs on, ascending.
    """

    scores: FloatArray
    last: IntArray
    episodes: int
    running: IntArray


class LevelReplay(Drawn):
    """Instances that were never trained on come first, in a seeded order; then they are replayed by rank and staleness.

    temperature: beta; the chance of rank r is proportional to r^(-1/beta).
    staleness_share: rho, the weight of the episodes since an instance was last trained on.
    within_update: see the module.
    """

    state_type = ReplayState
    wants = Wants(episodes=True, advantages=True)

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, temperature: float, staleness_share: float,
        within_update: WithinUpdate,
    ) -> None:  # fmt: skip
        super().__init__(instances, seed=seed, draws=draws)
        self._temperature, self._staleness_share = temperature, staleness_share
        self._within_update = within_update
        self._ties = instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts)

    def start(self) -> tuple[ReplayState, Selection]:
        """Nothing was trained on yet."""
        n = len(self._instances)
        state = ReplayState(0, uniform(n), scores=np.zeros(n), last=np.full(n, -1), episodes=0, running=np.arange(0))
        return state, self.selection(state)

    def step(self, state: ReplayState, feedback: Feedback) -> tuple[ReplayState, Selection, Numbers]:
        """Score what was trained on, and weigh anew. An instance trained on more than once has its episodes' mean."""
        episodes = feedback.episodes
        if episodes is None or np.isnan(episodes.advantages).any():
            raise ValueError("PLR needs the advantages of each episode")
        n, m = len(self._instances), len(episodes.indices)
        counts = np.bincount(episodes.indices, minlength=n)
        sums = np.bincount(episodes.indices, weights=episodes.advantages, minlength=n)
        scores = np.where(counts > 0, sums / np.maximum(counts, 1), state.scores)
        last = state.last.copy()
        # `at`: an instance may have ended more than once, and the last time counts.
        np.maximum.at(last, episodes.indices, state.episodes + np.arange(m))
        count = state.episodes + m
        chances = (
            replay_chances(
                scores, count - 1 - last, last >= 0, self._ties, self._temperature, self._staleness_share
            ) if count else uniform(n)
        )  # fmt: skip
        new = ReplayState(state.version + 1, chances, scores, last, count, np.unique(episodes.running))
        seen, sequence = last >= 0, self._sequence(new)
        shares = np.bincount(sequence[: max(1, m)], minlength=n) / max(1, min(m, len(sequence)))
        numbers = self._numbers(feedback, chances)
        numbers |= {
            "effective_size": effective_size(shares),  # of as many draws as there were episodes
            "seen": int(seen.sum()),
            "mean_score": float(scores[seen].mean()) if seen.any() else None,
            "largest_score": float(scores.max()),
        }
        return new, self._drawn(new.version, sequence), numbers

    def selection(self, state: ReplayState) -> Selection:
        """What was never begun, then draws by rank and staleness."""
        return self._drawn(state.version, self._sequence(state))

    def _sequence(self, state: ReplayState) -> IntArray:
        """`(count,)` indices in the order in which they are to be used."""
        runs = np.isin(np.arange(len(state.last)), state.running)
        unseen = np.flatnonzero((state.last < 0) & ~runs)
        unseen = unseen[np.argsort(self._ties[unseen], kind="stable")][: self._draws.count]
        if self._within_update == "fixed_chances":
            drawn = self._by_chance(state.version, state.chances)
        else:
            begun = (state.last >= 0) | runs
            candidates = np.flatnonzero(begun if begun.any() else ~begun)
            ranked = candidates[np.lexsort((self._ties[candidates], -state.scores[candidates]))]
            # Draws of what was never seen are episodes as well: what was seen is staler behind them.
            now = state.episodes - 1 + len(unseen)
            random = generator(self._seed, Purpose.DRAWS, state.version).random((self._draws.count - len(unseen), 2))
            staleness = np.where(runs, len(unseen), now - state.last)[ranked]
            drawn = replayed(
                ranked, staleness, random, self._temperature, self._staleness_share, already=runs[ranked]
            )  # fmt: skip
        return np.concatenate([unseen, drawn])[: self._draws.count]


def replay_chances(
    scores: FloatArray, staleness: IntArray, seen: BoolArray, ties: UInt64Array, temperature: float, share: float
) -> FloatArray:
    """`(n,)` chances (1 - share) * rank^(-1/temperature) + share * staleness, each term with sum 1 over those seen.

    scores: (n,), the highest has rank 1, equal ones are ranked by `ties`.  staleness: (n,) episodes since an instance
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


def replayed(
    ranked: IntArray, staleness: IntArray, random: FloatArray, temperature: float, share: float, *,
    already: BoolArray | None = None,
) -> IntArray:  # fmt: skip
    """`(k,)` of the (m,) instances `ranked`, the first of them the best, drawn without repetition; then all anew.

    Each draw has the chances of `replay_chances` over what was not drawn yet in this pass, with ranks from 1, and
    staleness as of then.
    staleness: (m,) at the first draw, in episodes.  random: (k, 2) uniform numbers; the first of a row says by which
    term it draws, the second what.  already: (m,) what has been drawn in the first pass; None: nothing.
    """
    m = len(ranked)
    below = np.cumsum(np.arange(1, m + 1) ** (-1.0 / temperature)).tolist()  # chances of the first ranks, not scaled
    fresh_at = -staleness.astype(np.int64)  # the draw at which the staleness of each is 0
    drawn: list[int] = []
    begun = np.zeros(m, dtype=np.bool_) if already is None else already
    left = np.flatnonzero(~begun)[::-1].tolist()  # places in `ranked`, the best last: where a list is quick to lose one
    for place, (term, point) in enumerate(random.tolist()):
        if not left:
            left = list(range(m - 1, -1, -1))
        if term < share:
            stale = np.cumsum(place - fresh_at[left[::-1]])
            # Nothing is stale: all that is left counts alike, as in `replay_chances`.
            if not stale[-1]:
                stale = np.arange(1, len(left) + 1)
            rank = int(np.searchsorted(stale, point * float(stale[-1]), side="right"))
        else:
            rank = bisect.bisect_right(below, point * below[len(left) - 1], 0, len(left))
        # min: rounding may put a number at the very end of the sums.
        one = left.pop(len(left) - 1 - min(rank, len(left) - 1))
        drawn.append(one)
        fresh_at[one] = place + 1
    return ranked[drawn]
