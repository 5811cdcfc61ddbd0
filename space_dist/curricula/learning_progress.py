"""Bidirectional learning progress over a finite set (Kanitscheider et al. 2021, "Multi-task curriculum learning in a
complex, visual, hard-exploration domain: Minecraft").

Train where the success rate changes, upwards or downwards: what is forgotten counts like what is learned. The rate of
an instance is followed by two exponential averages, a fast and a slow one, and progress is the size of their
difference, after a reweighing by which changes of a rate near 0 count most. Rates are those of the training episodes,
so nothing is probed; docs/curricula.md ("Learning progress") says what follows from that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from space_dist.curricula.draws import Drawn, DrawnState, Draws, Outcome, needed_episodes, outcomes, uniform
from space_dist.curricula.interface import (
    BoolArray,
    Feedback,
    FloatArray,
    Numbers,
    Selection,
    Wants,
)
from space_dist.instances import InstanceSet

UNKNOWN_WEIGHT = 0.5  # of an instance that was never played: that of mean progress


@dataclass(frozen=True)
class ProgressState(DrawnState):
    """fast, slow: (n,) averages of the rate of each instance, in [0, 1]; 0 where it was never played.

    played: (n,) whether an episode on it has ended.
    """

    fast: FloatArray
    slow: FloatArray
    played: BoolArray


class LearningProgress(Drawn):
    """An instance's chance is the logistic function of its progress, in standard deviations from the mean progress.

    outcome: what an episode counts as; `return`: its return, moved from [`lowest`, `largest`] to [0, 1] and cut off.
    smoothing: weight of the new in both averages.
    theta: the rate that the reweighing makes 1 / 2 of.
    uniform_share: the chance of a draw to be from all instances.
    """

    state_type = ProgressState

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, outcome: Outcome, lowest: float, largest: float,
        smoothing: float, theta: float, uniform_share: float,
    ) -> None:  # fmt: skip
        super().__init__(instances, seed=seed, draws=draws)
        self._outcome, self._lowest, self._largest = outcome, lowest, largest
        self._smoothing, self._theta, self._uniform_share = smoothing, theta, uniform_share
        self.wants = Wants(episodes=True, success=outcome == "success")

    def start(self) -> tuple[ProgressState, Selection]:
        """Nothing was played yet, so every instance has the same chance."""
        n = len(self._instances)
        state = ProgressState(0, uniform(n), fast=np.zeros(n), slow=np.zeros(n), played=np.zeros(n, dtype=np.bool_))
        return state, self.selection(state)

    def step(self, state: ProgressState, feedback: Feedback) -> tuple[ProgressState, Selection, Numbers]:
        """Take in the rates of this iteration's episodes: one rate for each instance, however many it had."""
        episodes = needed_episodes(feedback, "learning progress")
        n = len(self._instances)
        counts = np.bincount(episodes.indices, minlength=n)
        sums = np.bincount(
            episodes.indices, weights=outcomes(episodes, self._outcome, self._lowest, self._largest), minlength=n
        )
        now, rates = counts > 0, sums / np.maximum(counts, 1)
        fast = averaged(state.fast, rates, now, state.played, self._smoothing)
        slow = averaged(state.slow, fast, now, state.played, self._smoothing)
        played = state.played | now
        progress = np.abs(reweighed(fast, self._theta) - reweighed(slow, self._theta))
        chances = progress_chances(progress, fast, played, self._uniform_share)
        new = ProgressState(state.version + 1, chances, fast, slow, played)
        numbers = self._numbers(feedback, chances)
        numbers |= {
            "seen": int(played.sum()),
            "mean_rate": float(fast[played].mean()) if played.any() else None,
            "mean_progress": float(progress[played].mean()) if played.any() else None,
            "largest_progress": float(progress.max()),
        }
        return new, self.selection(new), numbers


def averaged(
    average: FloatArray, new: FloatArray, now: BoolArray, known: BoolArray, smoothing: float
) -> FloatArray:  # fmt: skip
    """`(n,)` the exponential averages, with `smoothing` of what is `new` where it is there `now`.

    The first value that is ever there stands for all before it.
    """
    moved = np.where(known, average + smoothing * (new - average), new)
    return np.where(now, moved, average)


def reweighed(rates: FloatArray, theta: float) -> FloatArray:
    """`(n,)` rates p in [0, 1] as (1 - theta) p / (p + theta (1 - 2 p)), in [0, 1] and rising."""
    weighed: FloatArray = (1.0 - theta) * rates / (rates + theta * (1.0 - 2.0 * rates))
    return weighed


def progress_chances(
    progress: FloatArray, fast: FloatArray, played: BoolArray, uniform_share: float
) -> FloatArray:  # fmt: skip
    """`(n,)` chances: uniform_share over all instances, the rest by weights.

    The weight of an instance is 1 / (1 + exp(-z)), z its progress less the mean, in standard deviations (0 where all
    progress is the same), over those that ever succeeded. What was played and always failed has none: of these the
    published code draws none, either. What was never played weighs `UNKNOWN_WEIGHT`.
    """
    weights = np.where(played, 0.0, UNKNOWN_WEIGHT)
    moving = played & (fast > 0.0)
    if moving.any():
        known = progress[moving]
        deviation = float(known.std())
        weights[moving] = 1.0 / (1.0 + np.exp(-(known - known.mean()) / (deviation if deviation > 0.0 else 1.0)))
    chances = uniform(len(progress))
    if weights.any():
        chances = uniform_share * chances + (1.0 - uniform_share) * weights / weights.sum()
    return chances
