"""Edge: train at the edge of what the policy can do, by what its episodes and its value function say together. Ours.

An episode teaches most where its outcome is least certain: the variance p (1 - p) of success (Tzannetos et al. 2023;
Rutherford et al. 2024). Nobody tells p, and an instance out of hundreds is played too seldom to count its successes.
So what is known of others is used three times over, one line of `Edge.step` each:

1. remember    successes w_i and failures l_i of every instance, of which a share is forgotten every iteration
2. neighbours  W = K w and L = K l, with K_ij = exp(-|z_i - z_j|^2 / 2 width^2), z the contexts within their bounds
3. critic      c_i, the chance of success that the value V(s0, i) stands for: a logistic regression of all that is
               remembered on the values as they are now, so that scale and discount of returns make no difference
4. together    p_i ~ Beta(strength c_i + W_i, strength (1 - c_i) + L_i)
5. the edge    chance_i in proportion to E[p_i (1 - p_i)]^2, mixed with `uniform_share` of equal chances

Where nothing was remembered, all chances are equal: breadth. The first success makes its neighbours likely. What is
solved everywhere, or can be solved nowhere, keeps its equal share, so that no instance is ever given up. No probes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from space_dist.curricula.draws import Drawn, DrawnState, Draws, Outcome, needed_episodes, outcomes, uniform
from space_dist.curricula.interface import Feedback, FloatArray, IntArray, Numbers, Selection, Wants
from space_dist.instances import ContextBounds, InstanceSet

REMEMBERED: Final = 1e-3  # of an episode: less is forgotten
_CHUNK: Final = 1 << 22  # distances computed at once
_RIDGE: Final = (0.1, 1.0)  # precisions of the prior of intercept and slope, per standard deviation of the values
_NEWTON_STEPS: Final = 8
_LONGEST_STEP: Final = 2.0
_FAR: Final = 6.0  # standard deviations from the mean behind which a value says nothing more


@dataclass(frozen=True)
class EdgeState(DrawnState):
    """won, lost: (n,) the successes and failures that are remembered of each instance, in episodes."""

    won: FloatArray
    lost: FloatArray


class Edge(Drawn):
    """See the module.

    outcome: what an episode counts as; `return`: its return, moved from [`lowest`, `largest`] to [0, 1] and cut off.
    memory: the share of what is remembered that one iteration leaves.
    width: of the neighbourhood, in widths of the contexts' bounds; 0: nothing is told of neighbours.
    strength: episodes that the critic's word counts as; 0: it has none.
    """

    state_type = EdgeState

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, bounds: ContextBounds, outcome: Outcome,
        lowest: float, largest: float, memory: float, width: float, strength: float, uniform_share: float,
    ) -> None:  # fmt: skip
        super().__init__(instances, seed=seed, draws=draws)
        self._outcome, self._lowest, self._largest = outcome, lowest, largest
        self._memory, self._width, self._strength, self._uniform_share = memory, width, strength, uniform_share
        self._places = bounds.scale(instances.contexts) / 2.0  # bounds.scale gives [-1, 1]
        self.wants = Wants(episodes=True, success=outcome == "success")

    def start(self) -> tuple[EdgeState, Selection]:
        """Nothing was played yet, so every instance has the same chance."""
        n = len(self._instances)
        state = EdgeState(0, uniform(n), won=np.zeros(n), lost=np.zeros(n))
        return state, self.selection(state)

    def step(self, state: EdgeState, feedback: Feedback) -> tuple[EdgeState, Selection, Numbers]:
        """The five lines of the module."""
        episodes = needed_episodes(feedback, "edge")
        came_of = outcomes(episodes, self._outcome, self._lowest, self._largest)
        won = remembered(state.won, self._memory, episodes.indices, came_of)
        lost = remembered(state.lost, self._memory, episodes.indices, 1.0 - came_of)
        near_won, near_lost = neighbours(self._places, self._width, won, lost)
        expected = critics_word(feedback.values_after, won, lost)
        successes, failures = self._strength * expected + near_won, self._strength * (1.0 - expected) + near_lost
        edges = variance(successes, failures)
        chances = edge_chances(edges, self._uniform_share)
        new = EdgeState(state.version + 1, chances, won, lost)
        numbers = self._numbers(feedback, chances)
        numbers |= {
            "remembered": float(won.sum() + lost.sum()),
            "mean_expected": float(expected.mean()),
            "mean_edge": float(edges.mean()),
            "largest_edge": float(edges.max()),
        }
        return new, self.selection(new), numbers


def remembered(before: FloatArray, memory: float, indices: IntArray, new: FloatArray) -> FloatArray:
    """`(n,)` what is left of `before`, and the (m,) `new` ones of the instances `indices`."""
    left = memory * before
    left[left < REMEMBERED] = 0.0
    return left + np.bincount(indices, weights=new, minlength=len(before))


def neighbours(
    places: FloatArray, width: float, won: FloatArray, lost: FloatArray
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """`(n,), (n,)` sums of what is remembered of all instances, each weighed by how near it is; itself by 1.

    places: (n, d). Takes time and no memory in proportion to n times the instances of which anything is remembered.
    """
    if width == 0.0:
        return won, lost
    known = np.flatnonzero(won + lost)
    near_won, near_lost = np.zeros(len(won)), np.zeros(len(won))
    each = max(1, _CHUNK // max(1, len(known)))
    for first in range(0, len(won) if len(known) else 0, each):
        here = slice(first, first + each)
        squares = np.zeros((len(places[here]), len(known)))
        for column in places.T:
            squares += (column[here, None] - column[None, known]) ** 2
        weights = np.exp(squares / (-2.0 * width**2))
        near_won[here], near_lost[here] = weights @ won[known], weights @ lost[known]
    return near_won, near_lost


def critics_word(values: FloatArray, won: FloatArray, lost: FloatArray) -> FloatArray:
    """`(n,)` chances of success that start values stand for: 1 / (1 + exp(-(a + b z))), z in standard deviations.

    a and b are the most likely ones for what was won and lost, under normal priors of precisions `_RIDGE` around no
    preference; by Newton's method with bounded steps. Mean and deviation are those of the remembered episodes.
    """
    weights = won + lost
    total = weights.sum()
    if total == 0.0:
        return np.full(len(values), 0.5)
    mean = (weights * values).sum() / total
    deviation = np.sqrt((weights * (values - mean) ** 2).sum() / total)
    z = np.clip((values - mean) / (deviation if deviation > 0.0 else 1.0), -_FAR, _FAR)
    a, b = math.log((won.sum() + 0.5) / (lost.sum() + 0.5)), 0.0
    for _ in range(_NEWTON_STEPS):
        p = _logistic(a + b * z)
        q, missed = weights * p * (1.0 - p), won - weights * p
        slope_a, slope_b = missed.sum() - _RIDGE[0] * a, (missed * z).sum() - _RIDGE[1] * b
        aa, ab, bb = q.sum() + _RIDGE[0], (q * z).sum(), (q * z * z).sum() + _RIDGE[1]
        determinant = aa * bb - ab * ab
        a += np.clip((bb * slope_a - ab * slope_b) / determinant, -_LONGEST_STEP, _LONGEST_STEP)
        b += np.clip((aa * slope_b - ab * slope_a) / determinant, -_LONGEST_STEP, _LONGEST_STEP)
    return _logistic(a + b * z)


def _logistic(x: FloatArray) -> FloatArray:
    return 1.0 / (1.0 + np.exp(-np.clip(x, -30.0, 30.0)))


def variance(successes: FloatArray, failures: FloatArray) -> FloatArray:
    """`(n,)` E[p (1 - p)] of p ~ Beta(successes, failures); 1/6, as of an even p, where there is neither."""
    total = successes + failures
    known = np.where(total > 0.0, total, 1.0)
    spread: FloatArray = np.where(total > 0.0, successes * failures / (known * (known + 1.0)), 1.0 / 6.0)
    return spread


def edge_chances(edges: FloatArray, uniform_share: float) -> FloatArray:
    """`(n,)` chances: uniform_share over all instances, the rest in proportion to the squares of `edges`."""
    chances = uniform(len(edges))
    largest = edges.max()
    if largest > 0.0:
        squares = (edges / largest) ** 2  # else very small ones would have squares of 0
        chances = uniform_share * chances + (1.0 - uniform_share) * squares / squares.sum()
    return chances
