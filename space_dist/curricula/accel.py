"""ACCEL (Parker-Holder et al. 2022, "Evolving Curricula with Regret-Based Environment Design").

Contexts are generated, scored by an estimate of regret, and those of high score kept in a buffer, from which they are
replayed as prioritised level replay replays. What was replayed is edited a little, and edits whose score is high enough
join the buffer: so it climbs to where the policy is not good yet. An iteration is one of three: it plays what is *new*,
what is *replayed*, or what was *edited*. The learner learns from what is replayed alone.

A score belongs to the context whose episode it was, whichever iteration it ended in: episodes go on from one iteration
to the next. What the paper does otherwise stands in docs/curricula.md ("ACCEL").
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula.draws import Draws, mean_values, needed_episodes
from space_dist.curricula.generating import Unheld
from space_dist.curricula.interface import (
    GENERATED,
    BoolArray,
    Curriculum,
    Episodes,
    Feedback,
    FloatArray,
    IntArray,
    Numbers,
    Selection,
    State,
    Wants,
)
from space_dist.curricula.plr import Score, replayed
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, generator

NEW, REPLAYED, EDITED = range(3)  # what an iteration plays
Edited = Literal["easiest", "batch"]
EASIEST: Final = 4  # contexts that are edited of those that were replayed (the authors' code)
_COIN = 1  # a stream of random numbers beside that of the draws


@dataclass(frozen=True)
class EditedState(State):
    """The buffer, oldest first, and what is played now. Scores and returns are in reward units.

    contexts: (k, d) in environment units, all different.  scores: (k,) as of when each was last played.
    best: (k,) the highest discounted return of an episode on it.
    last: (k,) the episode of the run, counted from 0, in which it was last played.
    episodes: how many the run has played.
    phase: NEW, REPLAYED or EDITED.  playing: (b, d) the contexts of this iteration, in the order in which they begin.
    """

    contexts: FloatArray
    scores: FloatArray
    best: FloatArray
    last: IntArray
    episodes: int
    phase: int
    playing: FloatArray


@dataclass(frozen=True)
class Replays:
    """How contexts are replayed.

    share: the chance that an iteration replays, once the buffer holds `filled` contexts.
    temperature, staleness_share: beta and rho of prioritised level replay.
    """

    share: float
    filled: int
    temperature: float
    staleness_share: float


class Played(NamedTuple):
    """The g different contexts whose episodes ended in an iteration.

    contexts: (g, d).  places: (g,) of each in the buffer; -1 where it is not there.  returns, scores, best: (g,) mean
    undiscounted return, score, and the highest discounted return so far.  last: (g,) as `EditedState.last`.
    """

    contexts: FloatArray
    places: IntArray
    returns: FloatArray
    scores: FloatArray
    best: FloatArray
    last: IntArray

    @property
    def known(self) -> BoolArray:
        """`(g,)` whether a context is in the buffer."""
        return self.places >= 0


class Accel(Curriculum):
    """Contexts that are generated, replayed by regret and staleness, and edited.

    source: makes and edits contexts.  new_from: instances that new contexts are drawn from; None: `source` makes them.
    buffer: how many contexts it holds at most.  batch: contexts of an iteration.  edits: changes of an edited context.
    edited: of what was replayed, the four easiest or all.  robust: whether replays alone are learned from.
    """

    state_type = EditedState

    def __init__(
        self, *, seed: int, draws: Draws, source: Unheld, new_from: InstanceSet | None, buffer: int, batch: int,
        edits: int, edited: Edited, score: Score, replays: Replays, robust: bool,
    ) -> None:  # fmt: skip
        self._seed, self._draws, self._source, self._new_from = seed, draws, source, new_from
        self._buffer, self._batch, self._edits, self._edited = buffer, batch, edits, edited
        self._score, self._replays, self._robust = score, replays, robust
        self.wants = Wants(
            episodes=True, advantages=score != "max_mc", unlearned=robust,
            advantage_part="positive" if score == "positive_value_loss" else "size",
        )  # fmt: skip

    def start(self) -> tuple[EditedState, Selection]:
        """New contexts, and an empty buffer."""
        playing = self._new(0)
        nothing = np.zeros(0)
        state = EditedState(0, playing[:0], nothing, nothing, np.zeros(0, dtype=np.int64), 0, NEW, playing)
        return state, self.selection(state)

    def step(self, state: EditedState, feedback: Feedback) -> tuple[EditedState, Selection, Numbers]:
        """Score what was played, keep the best, and choose what to play next."""
        episodes = needed_episodes(feedback, "ACCEL")
        played = self._played(state, episodes)
        kept = with_played(state, played, self._buffer)
        before = len(state.contexts)
        entered = int(np.isin(kept.last, played.last[~played.known]).sum())
        episode_count = state.episodes + len(episodes.indices)
        new = dataclasses.replace(kept, version=state.version + 1, episodes=episode_count)
        phase, playing = self._next(new, state.phase, played)
        new = dataclasses.replace(new, phase=phase, playing=playing)
        numbers: Numbers = {
            "size": len(played.contexts),
            **mean_values(feedback),
            "new": state.phase == NEW,
            "replayed": state.phase == REPLAYED,
            "edited": state.phase == EDITED,
            "learned": self._learns(state.phase),  # from what this iteration has played
            "buffer": len(new.contexts),
            "entered": entered,
            "left": before + entered - len(new.contexts),
            "mean_score": float(new.scores.mean()) if len(new.scores) else None,
            "largest_score": float(new.scores.max()) if len(new.scores) else None,
        }
        return new, self.selection(new), numbers

    def selection(self, state: EditedState) -> Selection:
        """The contexts of the iteration over and over, as many as its round can use."""
        count = self._draws.count
        contexts = self._draws.dealt(state.playing[np.arange(count) % len(state.playing)])
        return Selection(
            state.version, np.full(count, GENERATED), contexts, order_version=state.version, drawn=True,
            learned=self._learns(state.phase),
        )  # fmt: skip

    def _learns(self, phase: int) -> bool:
        return phase == REPLAYED or not self._robust

    # ---- what was played ----

    def _played(self, state: EditedState, episodes: Episodes) -> Played:
        """What the episodes that ended say of their contexts."""
        m = len(episodes.indices)
        contexts, inverse = np.unique(episodes.contexts + 0.0, axis=0, return_inverse=True)
        group, g = inverse.reshape(m), len(contexts)
        counts = np.bincount(group, minlength=g)

        def mean(of: FloatArray) -> FloatArray:
            found: FloatArray = np.bincount(group, weights=of, minlength=g) / counts
            return found

        there = {row.tobytes(): place for place, row in enumerate(state.contexts)}
        places = np.array([there.get(row.tobytes(), -1) for row in contexts], dtype=np.int64)
        known = places >= 0
        best, last = np.full(g, -np.inf), np.zeros(g, dtype=np.int64)
        best[known] = state.best[places[known]]
        np.maximum.at(best, group, episodes.discounted_returns)
        np.maximum.at(last, group, state.episodes + np.arange(m))
        if self._score == "max_mc":
            scores = best - mean(episodes.start_values)
        elif np.isnan(episodes.advantages).any():
            raise ValueError("ACCEL needs the advantages of each episode")
        else:
            scores = mean(episodes.advantages)
        return Played(contexts, places, mean(episodes.returns), scores, best, last)

    # ---- what to play next ----

    def _next(self, state: EditedState, phase: int, played: Played) -> tuple[int, FloatArray]:
        """What the iteration of `state`, which is not settled yet, plays behind one of `phase`, and its contexts."""
        version, replays = state.version, self._replays
        if phase == REPLAYED:
            parents = self._parents(played)
            random = generator(self._seed, Purpose.GENERATION, version, EDITED)
            # `edit` may leave some out, for what must not be trained on.
            if len(parents) and len(edited := self._source.edit(random, parents, self._edits)):
                return EDITED, edited
        coin = generator(self._seed, Purpose.DRAWS, version, _COIN).random()
        if len(state.contexts) >= replays.filled and coin < replays.share:
            return REPLAYED, state.contexts[self._replayed(state)]
        return NEW, self._new(version)

    def _parents(self, played: Played) -> FloatArray:
        """`(b, d)` of what was replayed what is edited, each as often as there is room; none where nothing ended."""
        contexts = played.contexts[played.known]
        if self._edited == "easiest":
            contexts = contexts[easiest(played.returns[played.known], played.scores[played.known])]
        count = max(self._batch, len(contexts)) if len(contexts) else 0
        return contexts[np.arange(count) % max(1, len(contexts))]

    def _replayed(self, state: EditedState) -> IntArray:
        """`(b,)` places in the buffer, by rank and staleness, without repetition as long as there are others."""
        ranked = np.argsort(-state.scores, kind="stable")  # of equal scores, what is longer in the buffer comes first
        random = generator(self._seed, Purpose.DRAWS, state.version).random((self._batch, 2))
        staleness = state.episodes - 1 - state.last[ranked]
        return replayed(ranked, staleness, random, self._replays.temperature, self._replays.staleness_share)

    def _new(self, version: int) -> FloatArray:
        """`(b, d)` contexts, made or of instances."""
        random = generator(self._seed, Purpose.GENERATION, version, NEW)
        if self._new_from is None:
            return self._source.sample(random, self._batch)
        n = len(self._new_from)
        drawn: FloatArray = self._new_from.contexts[random.choice(n, size=min(n, self._batch), replace=False)]
        return drawn


def with_played(state: EditedState, played: Played, most: int) -> EditedState:
    """The state whose buffer knows what was played: of all that were in it or played, the `most` of highest score.

    Of equal scores what is in the buffer stays, and of those the older.
    """
    known, old = played.known, played.places[played.known]
    updated: dict[str, NDArray[Any]] = {}
    for name in ("contexts", "scores", "best", "last"):
        column, mine = getattr(state, name).copy(), getattr(played, name)
        column[old] = mine[known]
        updated[name] = np.concatenate([column, mine[~known]])
    stays = np.sort(np.argsort(-updated["scores"], kind="stable")[:most])
    return dataclasses.replace(
        state, contexts=updated["contexts"][stays], scores=updated["scores"][stays], best=updated["best"][stays],
        last=updated["last"][stays],
    )  # fmt: skip


def easiest(returns: FloatArray, scores: FloatArray) -> IntArray:
    """`(e,)` places of the four, or fewer, of highest mean return less score, the easiest first.

    returns: (g,) undiscounted means, scores: (g,); both in reward units. Equal ones stand in their order.
    """
    return np.argsort(scores - returns, kind="stable")[:EASIEST]
