"""SPaCE: Self-Paced Context Evaluation (Eimer et al., ICML 2021, Algorithm 1).

`Space.step` is lines 6-13 of Algorithm 1, in order; line 5 (collect and update) is `run/training.py`. docs/algorithm.md
maps the lines and names every place where the paper is silent or contradicts itself. The defaults are the paper's
SPaCE; what the named variants do instead is in `variants.py`.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from space_dist.curricula.interface import (
    Curriculum,
    Feedback,
    FloatArray,
    IntArray,
    Numbers,
    Selection,
    SetState,
    selection_of,
)
from space_dist.curricula.variants import AdaptiveEta, Growth, Mean, Members, Rank, grown, improvement, readings
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, UInt64Array, instance_keys


class Space(Curriculum):
    """The instances whose start value rose most, from a set that grows whenever values settle.

    instances: the training instances, n of them.
    seed: decides the first instance and ties.
    first: (n,) scores of which the highest decides the first instance instead; None: the seed.
    eta: growth threshold: the relative change of the mean start value below which the set grows (paper: eta).
    kappa: how many instances a growth adds (paper: kappa).
    rank: what line 12 ranks by (paper: d_t(i)): a function of the feedback and of which instances were trained on that
        gives (n,) scores, highest first. By default the change of the start value, as `pic: improvement`.
    mean: which reading of lines 6-7 decides: `same_set`, `as_printed` or `mean_abs_change` (docs/algorithm.md).
    growth: `add`; `multiply` multiplies the size by kappa; `schedule` adds kappa without asking the values (in a
        config of `kind: cspace` and `manual` alone, whose ranks need no values).
    adaptive_eta, patience, epsilon: Theorem 2 (`off`, `once`, `persistent`): behind `patience` tests in a row without
        growth, the next one is made with an eta that lets the set grow; `persistent` never lowers it again.
    """

    state_type = SetState

    def __init__(
        self,
        instances: InstanceSet,
        *,
        seed: int,
        eta: float,
        kappa: int,
        rank: Rank = improvement,
        first: FloatArray | None = None,
        mean: Mean = "same_set",
        growth: Growth = "add",
        adaptive_eta: AdaptiveEta = "off",
        patience: int = 5,
        epsilon: float = 1e-3,
    ) -> None:
        self._instances, self._eta, self._kappa = instances, eta, kappa
        self._rank, self._mean, self._growth = rank, mean, growth
        self._adaptive_eta, self._patience, self._epsilon = adaptive_eta, patience, epsilon
        self._ties = instance_keys(seed, Purpose.TIES, instances.ids, instances.contexts)
        # Decision 2 of docs/algorithm.md.
        self._first = np.argsort(self._ties)[:1] if first is None else _highest(first, 1, self._ties)

    def start(self) -> tuple[SetState, Selection]:
        """Lines 1-3: one instance, chosen by the seed. Line 1's S := 0 would empty the set: S starts at 1."""
        state = SetState(version=0, order_version=0, size=1, selected=self._first)
        return state, self.selection(state)

    def step(self, state: SetState, feedback: Feedback) -> tuple[SetState, Selection, Numbers]:
        """Lines 6-13: compare values on the set just trained on, maybe grow, and select by PIC."""
        n, trained = len(self._instances), self._membership(state.selected)
        before, after = feedback.values_before[trained], feedback.values_after[trained]

        # Line 6: V_t := mean |V_t(s0, c_i)|. V_{t-1} is taken over the same instances, or the comparison in line 7
        # would mix a change of values with a change of set. (`mean` names other readings.)
        mean_after = float(np.abs(after).mean())
        read = readings(before, after, state.mean_value)
        reading = read[self._mean]

        # Line 7: is V_t within eta of V_{t-1}? Without a gradient step nothing was learnt that could have settled.
        tested = feedback.gradient_steps > 0
        eta = self._eta if state.eta is None else state.eta
        settled = tested and (self._growth == "schedule" or reading.within(eta))
        if tested and not settled and self._adaptive_eta != "off" and state.stalled >= self._patience:
            # Theorem 2. That the set grows now must not hang on how the raised eta is rounded.
            eta, settled = max(eta, reading.eta_to_grow(self._epsilon)), True

        # Line 8: S := S + kappa.
        size = min(grown(self._growth, state.size, self._kappa), n) if settled else state.size
        grew = size > state.size

        # Lines 10-11: d_t(i) := V_t(s0, c_i) - V_{t-1}(s0, c_i), signed (Definition 1).
        pic = feedback.values_after - feedback.values_before

        # Line 12: I_curr := the S instances with the highest d_t(i), or what else `rank` scores, best first.
        selected = _highest(self._rank(feedback, trained), size, self._ties)
        chosen = self._membership(selected)

        new = dataclasses.replace(
            state,
            version=state.version + 1,
            # Only another order sends the walk back to its beginning (docs/algorithm.md, "The walk").
            order_version=state.order_version if np.array_equal(selected, state.selected) else state.version + 1,
            size=size,
            selected=selected,
            tests=state.tests + tested,
            growths=state.growths + grew,
            # A whole set cannot grow, and so does not stall.
            stalled=0 if grew or size == n else state.stalled + tested,
            mean_value=mean_after,
            eta=eta if self._adaptive_eta == "persistent" else None,
        )
        numbers: Numbers = {
            "size": size,
            "trained_size": state.size,
            "grew": grew,
            "tests": new.tests,
            "growths": new.growths,
            "stalled": new.stalled,
            "mean_value_before": read["same_set"].reference,
            "mean_value_after": mean_after,
            "eta": eta if tested and self._growth != "schedule" else None,
            # Every reading of lines 6-7, so that they can be compared; `mean` says which one decided.
            "relative_change": read["same_set"].relative(),
            "relative_change_as_printed": None if state.mean_value is None else read["as_printed"].relative(),
            "relative_change_each": read["mean_abs_change"].relative(),
            "largest_pic": float(pic.max()),
            "smallest_pic": float(pic.min()),
            "kept": int((trained & chosen).sum()),
        }
        return new, self.selection(new), numbers

    def _membership(self, indices: IntArray) -> Members:
        """`(n,)` whether an instance is among `indices`; means over it do not depend on their order."""
        inside = np.zeros(len(self._instances), dtype=np.bool_)
        inside[indices] = True
        return inside

    def selection(self, state: SetState) -> Selection:
        """The instances a state has selected."""
        return selection_of(self._instances, state)


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
        inside = tied[1:] | tied[:-1]
        order[inside] = order[inside][np.lexsort((ties[order[inside]], -ranked[inside]))]
    return order[:size]
