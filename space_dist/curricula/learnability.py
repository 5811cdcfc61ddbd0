"""Sampling for learnability (SFL; Rutherford et al. 2024): train where the policy succeeds sometimes, not always."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from space_dist.curricula.draws import Drawn, DrawnState, Draws, uniform
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


@dataclass(frozen=True)
class ProbedState(DrawnState):
    """success: (n,) rate when an instance was last probed; 0 where it never was.  probed: (n,) whether it was.

    succeeded: whether any training episode has.  due: the version from which on the next probe is made.
    """

    success: FloatArray
    probed: BoolArray
    succeeded: bool
    due: int


class Learnability(Drawn):
    """Draws from the instances of highest p (1 - p), mixed with all of them.

    p is the success rate of the acting policy, noise and all, in probe episodes, which cost environment steps. As long
    as no training episode succeeds, a probe would find 0 everywhere: there is none, and draws are uniform.

    top: how many instances are drawn as learnable.
    uniform_share: the chance of a draw to be from all instances.
    every: iterations between two probes; the first follows the first iteration in which an episode succeeds.
    candidates: how many instances a probe takes, chosen at random; None: all.
    episodes: probe episodes of each.
    """

    state_type = ProbedState
    wants = Wants(episodes=True, probes=True)

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, top: int, uniform_share: float,
        every: int, candidates: int | None, episodes: int,
    ) -> None:  # fmt: skip
        super().__init__(instances, seed=seed, draws=draws)
        self._top, self._uniform_share, self._every = top, uniform_share, every
        self._candidates, self._episodes = candidates, episodes
        self._ties = instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts)

    def probes(self, state: ProbedState, episodes: Episodes | None) -> IntArray | None:
        """Every candidate as often as it has episodes."""
        version = state.version
        if version < state.due or not _succeeded(state, episodes):
            return None
        n = len(self._instances)
        candidates = np.arange(n)
        if self._candidates is not None and self._candidates < n:
            random = generator(self._seed, Purpose.PROBED, version)
            candidates = np.sort(random.choice(n, size=self._candidates, replace=False))
        return np.repeat(candidates, self._episodes)

    def start(self) -> tuple[ProbedState, Selection]:
        """Nothing was probed yet, so every instance has the same chance."""
        n = len(self._instances)
        state = ProbedState(
            0, uniform(n), success=np.zeros(n), probed=np.zeros(n, dtype=np.bool_), succeeded=False, due=0
        )  # fmt: skip
        return state, self.selection(state)

    def step(self, state: ProbedState, feedback: Feedback) -> tuple[ProbedState, Selection, Numbers]:
        """New success rates where instances were probed; the old ones stand elsewhere."""
        success, probed, due, steps, n = state.success, state.probed, state.due, 0, len(self._instances)
        if feedback.probes is not None:
            counts = np.bincount(feedback.probes.indices, minlength=n)
            sums = np.bincount(feedback.probes.indices, weights=feedback.probes.success, minlength=n)
            success = np.where(counts > 0, sums / np.maximum(counts, 1), success)
            probed, steps = probed | (counts > 0), int(feedback.probes.lengths.sum())
            # Counted from the last probe that was made: where the budget had no room, it stays due.
            due = state.version + self._every
        scores = learnability(success)
        chances = learnable_chances(scores, self._ties, self._top, self._uniform_share)
        succeeded = _succeeded(state, feedback.episodes)
        new = ProbedState(state.version + 1, chances, success, probed, succeeded, due)
        numbers = self._numbers(feedback, chances)
        numbers |= {"probe_steps": steps, "probed": int(probed.sum()), "learnable": int((scores > 0.0).sum()),
                    "mean_learnability": float(scores.mean()),
                    "mean_success": float(success[probed].mean()) if probed.any() else None}  # fmt: skip
        return new, self.selection(new), numbers


def _succeeded(state: ProbedState, episodes: Episodes | None) -> bool:
    """Whether a training episode has succeeded, in this iteration or before it."""
    return state.succeeded or (episodes is not None and bool((episodes.success == 1.0).any()))


def learnability(success: FloatArray) -> FloatArray:
    """`(n,)` p (1 - p): the variance of success."""
    return success * (1.0 - success)


def learnable_chances(scores: FloatArray, ties: UInt64Array, top: int, uniform_share: float) -> FloatArray:
    """`(n,)` chances: uniform_share over all instances, the rest over the `top` of highest score.

    Equal scores stand in the order of `ties`. A score of 0 is never among the top; where all are 0, chances are equal.
    """
    chosen = np.lexsort((ties, -scores))[:top]
    # Always or never solved: there is nothing to learn, or no way to (docs/curricula.md).
    chosen = chosen[scores[chosen] > 0.0]
    chances = uniform(len(scores))
    if len(chosen):
        chances *= uniform_share
        chances[chosen] += (1.0 - uniform_share) / len(chosen)
    return chances
