"""The named variants of Algorithm 1 (docs/algorithm.md, "Variants"): pure functions, for `Space.step` to call.

What line 12 ranks by, what line 7 compares, how line 8 grows, and the eta of Theorem 2.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula.interface import Feedback, FloatArray
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, combine, instance_keys

Members = NDArray[np.bool_]
Rank = Callable[[Feedback, Members], FloatArray]
"""From what was observed and (n,) which instances were trained on, the (n,) scores that line 12 ranks by."""
Mean = Literal["same_set", "as_printed", "mean_abs_change"]
Growth = Literal["add", "multiply", "schedule"]
AdaptiveEta = Literal["off", "once", "persistent"]

FLOOR: Final = 1e-8  # reward units: what a value counts at least where a change is taken as a share of it
_CHUNK_NUMBERS: Final = 1 << 20  # in one piece of a table of distances


# ---- Line 12: what the instances are ranked by, highest first ------------------------------------


def improvement(feedback: Feedback, trained: Members) -> FloatArray:  # noqa: ARG001 - a Rank
    """d_t(i), signed: the paper's Definition 1."""
    return feedback.values_after - feedback.values_before


def absolute(feedback: Feedback, trained: Members) -> FloatArray:
    """|d_t(i)|: a value that fell counts like one that rose."""
    return np.abs(improvement(feedback, trained))


def relative(feedback: Feedback, trained: Members) -> FloatArray:
    """d_t(i) / max(|V_{t-1}(i)|, 1e-8), signed."""
    with np.errstate(over="ignore"):  # infinities rank as they should
        return improvement(feedback, trained) / np.maximum(np.abs(feedback.values_before), FLOOR)


def lowest_value(feedback: Feedback, trained: Members) -> FloatArray:  # noqa: ARG001 - a Rank
    """-V_t(i): the released code's default."""
    return -feedback.values_after


BY_VALUE: Final[Mapping[Literal["improvement", "abs", "relative", "lowest_value"], Rank]] = {
    "improvement": improvement,
    "abs": absolute,
    "relative": relative,
    "lowest_value": lowest_value,
}


def at_random(instances: InstanceSet, *, seed: int) -> Rank:
    """Random numbers, drawn afresh for every decision, whatever was learnt."""
    keys = instance_keys(seed, Purpose.RANDOM_GROWTH, instances.ids, instances.contexts)
    return lambda feedback, trained: combine(keys, feedback.version).astype(np.float64)


def near_centroid(scaled: FloatArray) -> Rank:
    """cSPaCE: minus the Euclidean distance to the mean of the set trained on. scaled: (n, d) contexts in [-1, 1]."""
    return lambda feedback, trained: -np.linalg.norm(scaled - scaled[trained].mean(axis=0), axis=1)


def near_member(scaled: FloatArray) -> Rank:
    """cSPaCE: minus the Euclidean distance to the nearest instance trained on; those themselves come first.

    scaled: (n, d) contexts in [-1, 1].
    """

    def rank(feedback: Feedback, trained: Members) -> FloatArray:  # noqa: ARG001 - a Rank
        chosen, others = scaled[trained], np.flatnonzero(~trained)
        scores = np.ones(len(scaled))  # not 0, which is the score of a stranger with a member's context
        # Table by table: all distances at once would be (n, size, d) numbers.
        rows = max(1, _CHUNK_NUMBERS // chosen.size)
        for start in range(0, len(others), rows):
            some = others[start : start + rows]
            scores[some] = -np.linalg.norm(scaled[some, None] - chosen, axis=2).min(axis=1)
        return scores

    return rank


def in_order(scores: FloatArray) -> Rank:
    """A manual order: (n,) scores that never change."""
    return lambda feedback, trained: scores


def directed(rank: Rank, reverse: bool) -> Rank:
    """`rank`, or its reverse: a control."""
    return (lambda feedback, trained: -rank(feedback, trained)) if reverse else rank


# ---- Lines 6-7: has V_t settled? -----------------------------------------------------------------


class Reading(NamedTuple):
    """One reading of lines 6-7: how far the value moved, and from where. Both in reward units, not negative."""

    change: float
    reference: float

    def within(self, eta: float) -> bool:
        """Whether the change is at most the share eta."""
        return self.change <= eta * max(self.reference, FLOOR)

    def relative(self) -> float:
        """The change as a share."""
        return self.change / max(self.reference, FLOOR)

    def eta_to_grow(self, epsilon: float) -> float:
        """Theorem 2's (dV + epsilon) / V_{t-1}, finite for any values."""
        # epsilon also below, where the paper has V_{t-1} alone: near 0 that makes eta as large as it pleases.
        return min(sys.float_info.max, (self.change + epsilon) / max(self.reference, epsilon))


def readings(before: FloatArray, after: FloatArray, stored: float | None) -> dict[Mean, Reading]:
    """Every reading of lines 6-7.

    before, after: (k,) values of the set just trained on, before and after the iteration.
    stored: mean |V| that the last iteration ended with, over *its* set; None before the first: the printed V_0 = 0.
    """
    mean_before, mean_after = float(np.abs(before).mean()), float(np.abs(after).mean())
    last = 0.0 if stored is None else stored
    return {
        "same_set": Reading(abs(mean_after - mean_before), mean_before),
        "as_printed": Reading(abs(mean_after - last), last),
        "mean_abs_change": Reading(float(np.abs(after - before).mean()), mean_before),
    }


# ---- Line 8 --------------------------------------------------------------------------------------


def grown(growth: Growth, size: int, kappa: int) -> int:
    """The next size of a set that grows."""
    # `multiply` is the released code's `--multi`, and the paper's sets that grow fast.
    return size * kappa if growth == "multiply" else size + kappa
