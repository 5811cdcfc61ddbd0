"""SPaCE: Self-Paced Context Evaluation (Eimer et al., ICML 2021, Algorithm 1).

`Space.step` is lines 6-13 of Algorithm 1, in order; line 5 (collect and update) is `training.py`. docs/algorithm.md
maps the lines and names every place where the paper is silent or contradicts itself.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula.interface import Feedback, FloatArray, IntArray, Numbers, Selection, State
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, UInt64Array, combine, instance_keys


class Space:
    """The instances whose start value rose most, from a set that grows whenever values settle.

    eta: growth threshold: the relative change of the mean start value below which the set grows (paper: eta).
    kappa: how many instances a growth adds (paper: kappa).
    seed: decides the first instance and ties.
    """

    def __init__(self, instances: InstanceSet, *, eta: float, kappa: int, seed: int) -> None:
        self._instances, self._eta, self._kappa = instances, eta, kappa
        self._ties = instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts)

    def start(self) -> tuple[State, Selection]:
        """Lines 1-3: one instance, chosen by the seed. Line 1's S := 0 would empty the set: S starts at 1."""
        state = State(version=0, order_version=0, size=1, selected=np.argsort(self._ties)[:1])
        return state, self.selection(state)

    def step(self, state: State, feedback: Feedback) -> tuple[State, Selection, Numbers]:
        """Lines 6-13: compare values on the set just trained on, maybe grow, and select by PIC."""
        n, trained = len(self._instances), self._membership(state.selected)
        before, after = feedback.values_before[trained], feedback.values_after[trained]

        # Line 6: V_t := mean |V_t(s0, c_i)|. V_{t-1} is taken over the same instances, or the comparison in line 7
        # would mix a change of values with a change of set.
        mean_before, mean_after = float(np.abs(before).mean()), float(np.abs(after).mean())

        # Lines 7-8: if V_t is within eta of V_{t-1}, grow. Without a gradient step nothing was learnt that could
        # have settled.
        tested = feedback.gradient_steps > 0
        settled = tested and abs(mean_after - mean_before) <= self._eta * max(mean_before, 1e-8)
        size = min(state.size + self._kappa, n) if settled else state.size
        grew = size > state.size

        # Lines 10-11: d_t(i) := V_t(s0, c_i) - V_{t-1}(s0, c_i), signed (Definition 1).
        pic = feedback.values_after - feedback.values_before

        # Line 12: I_curr := the S instances with the highest d_t(i), best first.
        selected = _highest(self._scores(pic, feedback.version), size, self._ties)
        chosen = self._membership(selected)

        new = dataclasses.replace(
            state,
            version=state.version + 1,
            order_version=state.order_version if np.array_equal(selected, state.selected) else state.version + 1,
            size=size,
            selected=selected,
            tests=state.tests + tested,
            growths=state.growths + grew,
            stalled=0 if grew or size == n else state.stalled + tested,
            mean_value=mean_after,
        )
        numbers: Numbers = {
            "size": size,
            "trained_size": state.size,
            "grew": grew,
            "tests": new.tests,
            "growths": new.growths,
            "stalled": new.stalled,
            "mean_value_before": mean_before,
            "mean_value_after": mean_after,
            "relative_change": _relative_change(mean_before, mean_after),
            # Two other readings of lines 6-7 (docs/algorithm.md), logged so that they can be compared.
            "relative_change_as_printed": _relative_change(state.mean_value, mean_after),
            "relative_change_each": float(np.abs(after - before).mean()) / max(mean_before, 1e-8),
            "largest_pic": float(pic.max()),
            "smallest_pic": float(pic.min()),
            "kept": int((trained & chosen).sum()),
        }
        return new, self.selection(new), numbers

    def _scores(self, pic: FloatArray, version: int) -> FloatArray:  # noqa: ARG002 - RandomGrowth needs the version
        """`(n,)` what instances are ranked by: their performance improvement capacity."""
        return pic

    def _membership(self, indices: IntArray) -> NDArray[np.bool_]:
        """`(n,)` whether an instance is among `indices`; means over it do not depend on their order."""
        members = np.zeros(len(self._instances), dtype=np.bool_)
        members[indices] = True
        return members

    def selection(self, state: State) -> Selection:
        """The instances a state has selected."""
        return Selection(
            version=state.version,
            ids=self._instances.ids[state.selected],
            contexts=np.take(self._instances.contexts, state.selected, axis=0),
            order_version=state.order_version,
        )


class RandomGrowth(Space):
    """A control: the set grows exactly when SPaCE's rule says so, but *which* instances are in it is random."""

    def __init__(self, instances: InstanceSet, *, eta: float, kappa: int, seed: int) -> None:
        super().__init__(instances, eta=eta, kappa=kappa, seed=seed)
        self._random = instance_keys(seed, Purpose.RANDOM_GROWTH, instances.ids, instances.contexts)

    def _scores(self, pic: FloatArray, version: int) -> FloatArray:  # noqa: ARG002 - whatever was learnt
        """`(n,)` random numbers, drawn afresh for every decision."""
        return combine(self._random, version).astype(np.float64)


def _highest(scores: FloatArray, size: int, ties: UInt64Array) -> IntArray:
    """`(size,)` indices of the highest scores, best first; equal scores stand in the order of their tie keys."""
    if size < len(scores):  # sorting a million scores for the best hundred would cost more than the values themselves
        candidates = np.flatnonzero(scores >= np.partition(scores, len(scores) - size)[len(scores) - size])
        order = candidates[np.argsort(-scores[candidates])]
    else:
        order = np.argsort(-scores)
    ranked = scores[order]
    tied = np.zeros(len(order) + 1, dtype=np.bool_)
    tied[1:-1] = ranked[1:] == ranked[:-1]
    if tied.any():  # the order within a tie is still the sort's own whim
        members = tied[1:] | tied[:-1]
        order[members] = order[members][np.lexsort((ties[order[members]], -ranked[members]))]
    return order[:size]


def _relative_change(before: float | None, after: float) -> float | None:
    """|after - before| as a share of `before`; None where there is no `before` yet."""
    return None if before is None else abs(after - before) / max(before, 1e-8)
