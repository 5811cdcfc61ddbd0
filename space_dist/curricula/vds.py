"""The sampler of VDS (Zhang et al. 2020, "Automatic Curriculum Learning through Value Disagreement").

Theirs proposes goals to HER and DDPG, and its ensemble are Q-functions; here it samples from an instance set for any
learner, and the ensemble (`learner/ensemble.py`) are state-value functions trained on the same rollouts.
"""

from __future__ import annotations

from space_dist.curricula.draws import Drawn, DrawnState, proportional
from space_dist.curricula.interface import Feedback, FloatArray, Numbers, Selection, Wants
from space_dist.curricula.variants import FLOOR


def disagreement(members: FloatArray) -> FloatArray:
    """`(n,)` standard deviation over the (n, members) start values that an ensemble's members give each instance."""
    deviations: FloatArray = members.std(axis=1)
    return deviations


class ValueDisagreement(Drawn):
    """An instance's chance is proportional to how much the ensemble disagrees about its start value."""

    wants = Wants(episodes=True, ensemble=True)

    def step(self, state: DrawnState, feedback: Feedback) -> tuple[DrawnState, Selection, Numbers]:
        """The next chances; equal ones where nobody disagrees."""
        if feedback.ensemble is None:
            raise ValueError("VDS needs the values of an ensemble")
        found = disagreement(feedback.ensemble)
        # Below the floor members differ by rounding alone.
        new = DrawnState(state.version + 1, proportional(found, floor=FLOOR))
        numbers = self._numbers(feedback, new.chances)
        numbers |= {"mean_disagreement": float(found.mean()), "largest_disagreement": float(found.max())}
        return new, self.selection(new), numbers
