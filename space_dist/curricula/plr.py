"""Prioritised level replay (Jiang et al. 2021) over a finite set, by an episode's advantages or its highest return.

The paper decides before every episode; here the episodes of an iteration are drawn at once, for scores are only known
behind its update. Drawn from the paper's chances as they stand (`fixed_chances`), nearly all episodes of an iteration
are of one instance: with beta = 0.1 the first rank has 99.9 % of its term, and nothing happens between two draws that
could take it away. In the paper's loop it is taken away: an instance that was played is learned from, its score falls,
and its staleness is 0. So by default what was drawn leaves the ranking until everything else was drawn
(`without_repetition`), and staleness grows with every draw. What still runs when an iteration ends was drawn, too: its
score is not known yet, and it is not begun a second time meanwhile.

`positive_value_loss`, `max_mc` and `robust` are those of Jiang et al. 2021, "Replay-Guided Adversarial Environment
Design": a regret is estimated by what turned out better than the value function expected, mean max(GAE, 0), or by the
highest return that was seen, and the learner learns from what was replayed only. New levels are there drawn from a
generator; here an iteration that explores draws from the whole set, all alike.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from typing import Literal

import numpy as np

from space_dist.curricula.draws import Drawn, DrawnState, Draws, effective_size, needed_episodes, uniform
from space_dist.curricula.interface import (
    BoolArray,
    Episodes,
    Feedback,
    FloatArray,
    IntArray,
    Numbers,
    Selection,
    Wants,
)
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, UInt64Array, generator, instance_keys

WithinUpdate = Literal["without_repetition", "fixed_chances"]
Score = Literal["value_l1", "positive_value_loss", "max_mc"]
_COIN = 1  # a stream of random numbers beside that of the draws


@dataclass(frozen=True)
class Robust:
    """How often what is not learned from is played, to be scored.

    replay_share: the chance that an iteration replays.  scored_share: of the instances, before anything is replayed.
    """

    replay_share: float
    scored_share: float


@dataclass(frozen=True)
class ReplayState(DrawnState):
    """chances: (n,) the paper's, as of the first draw.

    scores: (n,) in reward units: mean |GAE| or mean max(GAE, 0) when an instance was last trained on, or for max_mc the
        highest return less the start value as of now; 0 where it never was.
    last: (n,) the episode of the run, counted from 0, in which it was last trained on; -1 where it never was.
    episodes: how many the run has trained on.
    running: (k,) indices of the instances of which an episode runs on, ascending.
    best: for max_mc (n,) the highest discounted return so far, in reward units; 0 where there was none.
    "Trained on" is here whatever was played, learned from or not.
    """

    scores: FloatArray
    last: IntArray
    episodes: int
    running: IntArray
    best: FloatArray | None = None


class LevelReplay(Drawn):
    """Instances that were never trained on come first, in a seeded order; then they are replayed by rank and staleness.

    temperature: beta; the chance of rank r is proportional to r^(-1/beta).
    staleness_share: rho, the weight of the episodes since an instance was last trained on.
    within_update, score, robust: see the module. robust: None: every round is learned from.
    """

    state_type = ReplayState

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, temperature: float, staleness_share: float,
        within_update: WithinUpdate, score: Score = "value_l1", robust: Robust | None = None,
    ) -> None:  # fmt: skip
        super().__init__(instances, seed=seed, draws=draws)
        self._temperature, self._staleness_share = temperature, staleness_share
        self._within_update, self._score, self._robust = within_update, score, robust
        self.wants = Wants(
            episodes=True, advantages=score != "max_mc", unlearned=robust is not None,
            advantage_part="positive" if score == "positive_value_loss" else "size",
        )  # fmt: skip
        self._ties = instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts)

    def start(self) -> tuple[ReplayState, Selection]:
        """Nothing was trained on yet."""
        n = len(self._instances)
        state = ReplayState(
            0, uniform(n), scores=np.zeros(n), last=np.full(n, -1), episodes=0, running=np.arange(0),
            best=np.zeros(n) if self._score == "max_mc" else None,
        )  # fmt: skip
        return state, self.selection(state)

    def step(self, state: ReplayState, feedback: Feedback) -> tuple[ReplayState, Selection, Numbers]:
        """Score what was played, and weigh anew. An instance played more than once has its episodes' mean."""
        episodes = needed_episodes(feedback, "PLR")
        n, m = len(self._instances), len(episodes.indices)
        last = state.last.copy()
        # `at`: an instance may have ended more than once, and the last time counts.
        np.maximum.at(last, episodes.indices, state.episodes + np.arange(m))
        scores, best = self._scored(state, episodes, feedback.values_after, last >= 0)
        count = state.episodes + m
        chances = (
            replay_chances(
                scores, count - 1 - last, last >= 0, self._ties, self._temperature, self._staleness_share
            ) if count else uniform(n)
        )  # fmt: skip
        new = ReplayState(state.version + 1, chances, scores, last, count, np.unique(episodes.running), best)
        seen, sequence = last >= 0, self._sequence(new)
        shares = np.bincount(sequence[: max(1, m)], minlength=n) / max(1, min(m, len(sequence)))
        numbers = self._numbers(feedback, chances)
        numbers |= {
            "effective_size": effective_size(shares),  # of as many draws as there were episodes
            "seen": int(seen.sum()),
            "mean_score": float(scores[seen].mean()) if seen.any() else None,
            "largest_score": float(scores.max()),
        }
        if self._robust is not None:
            numbers |= {"learned": not self._explores(state)}  # from what this iteration has played
        return new, self._drawn(new.version, sequence, learned=not self._explores(new)), numbers

    def selection(self, state: ReplayState) -> Selection:
        """What was never begun, then draws by rank and staleness."""
        return self._drawn(state.version, self._sequence(state), learned=not self._explores(state))

    def _scored(
        self, state: ReplayState, episodes: Episodes, values: FloatArray, seen: BoolArray
    ) -> tuple[FloatArray, FloatArray | None]:
        """`(n,)` scores, and the highest returns where these are what scores are made of."""
        n = len(seen)
        if state.best is not None:
            best = np.where(state.last >= 0, state.best, -np.inf)
            np.maximum.at(best, episodes.indices, episodes.discounted_returns)
            best = np.where(seen, best, 0.0)
            return np.where(seen, best - values, 0.0), best
        if np.isnan(episodes.advantages).any():
            raise ValueError("PLR needs the advantages of each episode")
        counts = np.bincount(episodes.indices, minlength=n)
        sums = np.bincount(episodes.indices, weights=episodes.advantages, minlength=n)
        return np.where(counts > 0, sums / np.maximum(counts, 1), state.scores), None

    def _explores(self, state: ReplayState) -> bool:
        """Whether the iteration plays what is not learned from: too little is scored yet, or the coin says so."""
        if self._robust is None:
            return False
        if (state.last >= 0).mean() < self._robust.scored_share:
            return True
        coin = generator(self._seed, Purpose.DRAWS, state.version, _COIN).random()
        return bool(coin >= self._robust.replay_share)

    def _sequence(self, state: ReplayState) -> IntArray:
        """`(count,)` indices in the order in which they are to be used."""
        count = self._draws.count
        runs = np.isin(np.arange(len(state.last)), state.running)
        unseen = np.flatnonzero((state.last < 0) & ~runs)
        unseen = unseen[np.argsort(self._ties[unseen], kind="stable")][:count]
        if self._explores(state):
            any_of_them = generator(self._seed, Purpose.DRAWS, state.version).integers(len(state.last), size=count)
            return np.concatenate([unseen, any_of_them])[:count]
        if self._robust is not None:
            unseen = unseen[:0]  # what was never scored is none of what is learned from
        if self._within_update == "fixed_chances":
            drawn = self._by_chance(state.version, state.chances)
        else:
            begun = state.last >= 0
            if self._robust is None:
                begun = begun | runs
            candidates = np.flatnonzero(begun if begun.any() else ~begun)
            ranked = candidates[np.lexsort((self._ties[candidates], -state.scores[candidates]))]
            # Draws of what was never seen are episodes as well: what was seen is staler behind them.
            now = state.episodes - 1 + len(unseen)
            random = generator(self._seed, Purpose.DRAWS, state.version).random((count - len(unseen), 2))
            staleness = np.where(runs, len(unseen), now - state.last)[ranked]
            drawn = replayed(
                ranked, staleness, random, self._temperature, self._staleness_share, already=runs[ranked]
            )  # fmt: skip
        return np.concatenate([unseen, drawn])[:count]


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
