"""ProCuRL from the critic (Tzannetos et al. 2023, "Proximal Curriculum for Reinforcement Learning Agents").

Train where the learner neither fails nor is done: p (1 - p) is largest at 1/2. p, the probability of success, is what
the value function says of the start, so nothing is probed. Beside it the distribution that its authors compare with as
`space-alt`: by how much values have risen.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from space_dist.curricula.draws import Drawn, DrawnState, Draws
from space_dist.curricula.interface import Feedback, FloatArray, Numbers, Selection
from space_dist.instances import InstanceSet

Score = Literal["zone", "improvement"]
Scale = Literal["largest", "set"]


def scaled(values: FloatArray, scale: Scale, largest: float) -> FloatArray:
    """`(n,)` start values as probabilities of success, within [0, 1].

    largest: by the largest return there is, and cut off at both ends. set: so that the least of the set is 0 and the
    greatest 1; 0 where all are equal.
    """
    if scale == "largest":
        return np.clip(values / largest, 0.0, 1.0)
    width = float(values.max() - values.min())
    return (values - values.min()) / width if width > 0.0 else np.zeros_like(values)


def softmax(scores: FloatArray, beta: float) -> FloatArray:
    """`(n,)` chances in proportion to exp(beta * score)."""
    weights = np.exp(beta * (scores - scores.max()))
    chances: FloatArray = weights / weights.sum()
    return chances


class Proximal(Drawn):
    """An instance's chance is a softmax of its score, with `beta` for the inverse of a temperature.

    score: zone: p (1 - p), p the scaled start value. improvement: the rise of the start value in this iteration; with
    scale `set` again scaled over the set, with `largest` divided by it.
    """

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, beta: float, score: Score, scale: Scale,
        largest: float,
    ) -> None:  # fmt: skip
        super().__init__(instances, seed=seed, draws=draws)
        self._beta, self._score, self._scale, self._largest = beta, score, scale, largest

    def step(self, state: DrawnState, feedback: Feedback) -> tuple[DrawnState, Selection, Numbers]:
        """The next chances, from the values as they are now."""
        scores = self._scores(feedback)
        new = DrawnState(state.version + 1, softmax(scores, self._beta))
        numbers = self._numbers(feedback, new.chances)
        numbers |= {"mean_score": float(scores.mean()), "largest_score": float(scores.max())}
        return new, self.selection(new), numbers

    def _scores(self, feedback: Feedback) -> FloatArray:
        if self._score == "zone":
            p = scaled(feedback.values_after, self._scale, self._largest)
            return p * (1.0 - p)
        risen = feedback.values_after - feedback.values_before
        return scaled(risen, "set", self._largest) if self._scale == "set" else risen / self._largest
