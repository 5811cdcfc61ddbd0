"""What the released SPaCE code would have plotted of a run: its return, over what it counts as steps.

Both beside what they are here, for runs with `evaluation.legacy_metric`: so that a reader of its figures sees what of
them is the policy, and what is the way of counting.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from space_dist.report.analyses import released_steps
from space_dist.report.analysis_figures import draw_both_counts
from space_dist.report.document import Picture, Section
from space_dist.report.figures import png
from space_dist.report.grid import CellRuns
from space_dist.report.load import FloatArray, IntArray, Run

COUNTED: Final = 100  # steps for each instance of the set and iteration, whatever was really played
_DRAWN: Final = 8  # cells
_TEXT: Final = (
    "The released code acts stochastically when it evaluates, sums r_t gamma^(T-1-t), so that the last reward counts "
    f"most, and counts {COUNTED} steps for every instance of the set in every iteration, however many were taken. "
    "Left: over real environment steps. Right: the same policies over its count, shorter the smaller the set is."
)


def released_section(cells: Sequence[CellRuns], note: str) -> list[Section]:
    """A figure of the cells whose runs have that return; none where no cell has."""
    found = [(cell.caption, curves) for cell in cells if (curves := _curves(cell))][:_DRAWN]
    if not found:
        return []
    caption = "The released code's return on the held-out instances, over real steps and over its count of them"
    picture = Picture("released.png", caption, png(draw_both_counts(found), note))
    return [Section("As the released code shows it", [_TEXT], pictures=[picture])]


def _curves(cell: CellRuns) -> list[tuple[IntArray, FloatArray, FloatArray]]:
    """Of each finished run `(k,)` real steps, what is counted at them, and the released code's return."""
    return [
        (run.evaluation_steps, counted(run), returns)
        for run in cell.configuration.finished
        if (returns := run.legacy_returns) is not None
    ]


def counted(run: Run) -> FloatArray:
    """`(k,)` what the released code would have counted at a run's evaluations: within an iteration, in proportion."""
    ends = np.concatenate(([0], run.iteration_ends))
    counts = np.concatenate(([0], released_steps(run.set_sizes, COUNTED)))
    return np.asarray(np.interp(run.evaluation_steps, ends, counts))
