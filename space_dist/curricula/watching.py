"""Uniform draws that remember what every instance showed: what `space-dist headroom` measures with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from space_dist.curricula.draws import DrawnState, Draws, Uniform, needed_episodes
from space_dist.curricula.interface import Feedback, FloatArray, IntArray, Numbers, Selection, Wants
from space_dist.instances import InstanceSet


@dataclass(frozen=True)
class WatchedState(DrawnState):
    """What the n instances have shown so far, in w equal shares of the run.

    episodes, successes: (w, n) training episodes that ended, and how many of these succeeded, of which there are none
        where the environment knows no success.
    sizes: (w, n) sums over these episodes of their mean |GAE|; 0 for learners without advantages.
    failed, every: (2,) least and greatest return of the episodes that did not succeed, and of all; infinite before any.
    knows_success: whether every episode said whether it succeeded.
    """

    episodes: IntArray
    successes: IntArray
    sizes: FloatArray
    failed: FloatArray
    every: FloatArray
    knows_success: bool


class Watched(Uniform):
    """Domain randomisation that counts, instance by instance and over time.

    iterations: of the whole run.  shares: into which it is cut.  advantages: whether the learner has such.
    """

    state_type = WatchedState

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, iterations: int, shares: int, advantages: bool
    ) -> None:
        super().__init__(instances, seed=seed, draws=draws)
        self.wants = Wants(episodes=True, advantages=advantages)
        self._iterations, self._shares = iterations, shares

    def start(self) -> tuple[WatchedState, Selection]:
        """Nothing was seen."""
        drawn, selection = super().start()
        shape = (self._shares, len(self._instances))
        none = np.zeros(shape, dtype=np.int64)
        empty = np.array([np.inf, -np.inf])
        return WatchedState(drawn.version, drawn.chances, none, none, np.zeros(shape), empty, empty, True), selection

    def step(self, state: DrawnState, feedback: Feedback) -> tuple[WatchedState, Selection, Numbers]:
        """The same chances; what the iteration's episodes showed is added to what was known."""
        if not isinstance(state, WatchedState):
            raise TypeError(f"a state of {type(state).__name__}")
        seen, n = needed_episodes(feedback, "headroom"), len(self._instances)
        share = min(state.version * self._shares // self._iterations, self._shares - 1)
        episodes, successes, sizes = state.episodes.copy(), state.successes.copy(), state.sizes.copy()
        episodes[share] += np.bincount(seen.indices, minlength=n)
        successes[share] += np.bincount(seen.indices[seen.success == 1.0], minlength=n)
        if self.wants.advantages:
            sizes[share] += np.bincount(seen.indices, weights=seen.advantages, minlength=n)
        new = WatchedState(
            state.version + 1, state.chances, episodes, successes, sizes,
            _widened(state.failed, seen.returns[seen.success != 1.0]), _widened(state.every, seen.returns),
            state.knows_success and not bool(np.isnan(seen.success).any()),
        )  # fmt: skip
        return new, self.selection(new), self._numbers(feedback, new.chances)


def _widened(span: FloatArray, values: FloatArray) -> FloatArray:
    """(2,) least and greatest of what was known and of more values."""
    return np.array([values.min(initial=span[0]), values.max(initial=span[1])])
