"""Curricula compared: which instances come when, how alike seeds and cells are in that, and how far the set moves.

For cells that train on sets of instances, by the definitions of `analyses` (the SPaCE paper's appendix).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from space_dist.errors import LedgerError
from space_dist.report.analyses import (
    agreement,
    consistency,
    feature_means,
    feature_rank_correlations,
    features_by_rank,
    frequencies,
    inclusion_order,
    rank_changes,
    share_below,
    shares_of_first,
    shifts,
    stretches,
    weighted_frequencies,
)
from space_dist.report.analysis_figures import draw_features, draw_frequencies
from space_dist.report.document import Picture, Section
from space_dist.report.figures import png
from space_dist.report.grid import CellRuns
from space_dist.report.load import FloatArray, IntArray, Run
from space_dist.report.statistics import Interval, estimate
from space_dist.report.tables import NONE, Value, interval_numbers, interval_text, number_text

_OF_SETS: Final = ("space", "cspace", "random_growth", "manual", "round_robin", "fixed")
FIRST_EPISODES: Final = 40  # in which the paper's SPaCE hardly trains CartPole's long pole (section 4.1)
MAX_DRAWN: Final = 8  # cells in a figure of curricula
MAX_AGREEING: Final = 12  # cells of the table of agreement
_NAMED: Final = 4  # features in a title


@dataclass(frozen=True, eq=False)
class RunCurriculum:
    """What one run did with its n training instances, in T iterations.

    order, frequencies, weighted, first `(n,)`: first iteration, share of iterations in the set, the same weighted by
    rank, share of the first episodes. changes: instances that stand elsewhere when weighted. stretch: median iterations
    that the set stays the same. below: share of the steps spent on less than half of the instances. shift_mean,
    shift_most, jaccard: how far the set moves until it is whole; NaN where it never moved, or bounds are unknown.
    means: `(T,)` steps at the iterations' ends and `(T, d)` mean features; None where bounds are unknown.
    """

    order: IntArray
    frequencies: FloatArray
    weighted: FloatArray
    first: FloatArray
    changes: float
    stretch: float
    below: float
    shift_mean: float
    shift_most: float
    jaccard: float
    means: tuple[IntArray, FloatArray] | None


@dataclass(frozen=True, eq=False)
class CellCurricula:
    """The curricula of a cell's s finished runs over its n training instances.

    ids `(n,)`; contexts `(n, d)`, scaled from their bounds to [0, 1], of `features`: None and empty where bounds are
    unknown.
    """

    cell: CellRuns
    ids: IntArray
    contexts: FloatArray | None
    features: tuple[str, ...]
    runs: tuple[RunCurriculum, ...]

    @property
    def label(self) -> str:
        """The cell's."""
        return self.cell.label

    @property
    def orders(self) -> IntArray:
        """`(s, n)` orders of inclusion."""
        return np.array([run.order for run in self.runs])

    def mean(self, name: Literal["frequencies", "weighted", "first"]) -> FloatArray:
        """`(n,)` over runs."""
        return np.asarray(np.mean([getattr(run, name) for run in self.runs], axis=0))

    def each(self, name: Literal["changes", "stretch", "below", "shift_mean", "shift_most", "jaccard"]) -> FloatArray:
        """`(s,)` a number of every run."""
        return np.array([getattr(run, name) for run in self.runs])


def curricula_of(cells: Sequence[CellRuns]) -> list[CellCurricula]:
    """Those of the cells whose finished runs trained on sets; not of drawn or generated contexts.

    Raises LedgerError for a run that was trained on what is not of its instances.
    """
    return [found for cell in cells if (found := _curricula_of(cell)) is not None]


def _curricula_of(cell: CellRuns) -> CellCurricula | None:
    runs = [run for run in cell.configuration.finished if len(run.set_sizes)]
    # Of other kinds the ledger's `trained` are the draws whose episodes ended.
    of_sets = cell.cell.config.get("curriculum", {}).get("kind") in _OF_SETS
    if not runs or not of_sets or any(run.generates_contexts for run in runs):
        return None
    contexts = runs[0].instance_contexts
    features = runs[0].features[: 0 if contexts is None else contexts.shape[1]]
    return CellCurricula(
        cell, runs[0].instance_ids, contexts, features, tuple(_curriculum_of(run, contexts) for run in runs)
    )


def _curriculum_of(run: Run, contexts: FloatArray | None) -> RunCurriculum:
    trained, ids = run.trained, run.instance_ids
    try:
        order, found = inclusion_order(trained, ids), frequencies(trained, ids)
    except ValueError as error:
        raise LedgerError(f"{run.ledger.folder} has iterations that cannot be read: {error}") from None
    weighted = weighted_frequencies(found, order)
    moved = None if contexts is None else shifts(trained, ids, contexts)
    shifted = moved is not None and len(moved.steps) > 0
    return RunCurriculum(
        order, found, weighted, shares_of_first(trained, ids, FIRST_EPISODES),
        changes=float(rank_changes(found, weighted)), stretch=float(np.median(stretches(trained, ids))),
        below=share_below(trained, ids, run.iteration_ends),
        shift_mean=float(moved.steps.mean()) if moved is not None and shifted else math.nan,
        shift_most=float(moved.steps.max()) if moved is not None and shifted else math.nan,
        jaccard=float(moved.jaccard.mean()) if moved is not None and shifted else math.nan,
        means=None if contexts is None else (run.iteration_ends, feature_means(trained, ids, contexts)),
    )  # fmt: skip


def curriculum_sections(found: Sequence[CellCurricula], note: str) -> list[Section]:
    """Tables and figures of the cells whose sets change; nothing where none does. `note` is written on figures."""
    growing = [one for one in found if len(np.unique(one.orders)) > 1]
    if not growing:
        return []
    return [_table(growing), *_agreement(growing), *_figures(growing, note)]


def _table(found: Sequence[CellCurricula]) -> Section:
    rows = []
    for one in found:
        alike = consistency(one.orders)
        rows.append(
            {
                "curriculum": one.label,
                "seeds": f"{len(one.orders)}/{one.cell.summary.n_runs}",
                "tau with the other seeds: mean, least": _mean_and_least(alike.with_others),
                "tau of pairs: mean": _mean(alike.pairs, 3),
                "set moves an iteration: mean, most": _movement(one),
                "Jaccard distance: mean": _mean(one.each("jaccard"), 3),
                "instances that change places by weight": _mean(one.each("changes"), 1),
                "steps on less than half of the set [95 %]": _percent(
                    estimate(one.each("below")).mean.within(0.0, 1.0)
                ),
            }
        )
    text = (
        "Order: the iteration in which an instance is first in the set. Tau: Kendall's tau-b, of a seed's order with "
        "the mean of the others', and of all pairs of seeds. The set's movement: distance of its mean context from one "
        "iteration to the next, in % of the diagonal of the bounds, until the set is first whole. Places by weight: "
        "instances that stand elsewhere when frequencies are weighted by the rank of inclusion."
    )
    return Section("Curricula", [text], rows)


def _agreement(found: Sequence[CellCurricula]) -> list[Section]:
    """How alike the mean orders of two cells are, where both train on the same instances."""
    rows = []
    shown = found[:MAX_AGREEING]
    for one in shown:
        row = {"curriculum": one.label}
        for other in shown:
            row[other.label] = f"{agreement(one.orders, other.orders):.2f}" if _alike(one, other) else NONE
        rows.append(row)
    if len(shown) < 2:
        return []
    text = "Kendall's tau-b between the mean orders of inclusion of two cells."
    return [Section("Agreement between curricula", [text], rows)]


def _alike(one: CellCurricula, other: CellCurricula) -> bool:
    """Whether both train on the same instances, as far as is known."""
    if not np.array_equal(one.ids, other.ids) or one.cell.task != other.cell.task:
        return False
    return one.contexts is None or other.contexts is None or np.array_equal(one.contexts, other.contexts)


def _figures(found: Sequence[CellCurricula], note: str) -> list[Section]:
    drawn = found[:MAX_DRAWN]
    text = [] if len(drawn) == len(found) else [f"The first {MAX_DRAWN} of {len(found):,} cells."]
    pictures = [
        Picture(
            "frequencies.png",
            "Share of iterations that an instance was in the set: as it is, and weighted by the rank of inclusion",
            png(
                draw_frequencies(
                    [(one.cell.caption, _ranked(one), one.mean("frequencies"), one.mean("weighted")) for one in drawn]
                ),
                note,
            ),
        )
    ]
    sections = [Section("When instances come", text, pictures=pictures)]
    for features in dict.fromkeys(one.features for one in drawn if one.features):  # those of one environment
        sections.append(_contexts([one for one in drawn if one.features == features], len(sections), note))
    return sections


def _contexts(found: Sequence[CellCurricula], number: int, note: str) -> Section:
    """Of cells whose contexts have the same features, and known bounds."""
    known = [(one, one.contexts, [run.means for run in one.runs if run.means is not None])
             for one in found if one.contexts is not None]  # fmt: skip
    names = found[0].features
    curves = [(one.cell.caption, curves, features_by_rank(one.orders, contexts)) for one, contexts, curves in known]
    caption = "Context features, scaled from their bounds: mean of the set, and of the instance at each rank"
    file = "context_features.png" if number == 1 else f"context_features_{number}.png"
    rows = []
    for one, contexts, _ in known:
        taus = feature_rank_correlations(one.orders, contexts)
        rows.append({"curriculum": one.label, **{name: number_text(float(tau), 2)
                                                 for name, tau in zip(names, taus, strict=True)}})  # fmt: skip
    text = "Table: Kendall's tau-b between an instance's mean order of inclusion and each feature."
    picture = Picture(file, caption, png(draw_features(names, curves), note))
    return Section("Contexts: " + ", ".join(names[:_NAMED]), [text], rows, pictures=[picture])


def curriculum_rows(found: Sequence[CellCurricula]) -> list[dict[str, Value]]:
    """For CSV: a row a cell."""
    rows: list[dict[str, Value]] = []
    for one in found:
        alike = consistency(one.orders)
        rows.append(
            {
                "cell": one.cell.cell.id,
                "label": one.label,
                "seeds": len(one.orders),
                "tau_with_others_mean": _or_none(alike.with_others, np.mean),
                "tau_with_others_least": _or_none(alike.with_others, np.min),
                "tau_with_others_most": _or_none(alike.with_others, np.max),
                "tau_pairs_mean": _or_none(alike.pairs, np.mean),
                "shift_mean": _or_none(one.each("shift_mean"), np.mean),
                "shift_most": _or_none(one.each("shift_most"), np.max),
                "stretch_median": _or_none(one.each("stretch"), np.median),
                "jaccard_mean": _or_none(one.each("jaccard"), np.mean),
                "rank_changes_mean": _or_none(one.each("changes"), np.mean),
                **interval_numbers("steps_below_half", estimate(one.each("below")).mean.within(0.0, 1.0)),
            }
        )
    return rows


def agreement_rows(found: Sequence[CellCurricula]) -> list[dict[str, Value]]:
    """For CSV: a row for every two cells on the same instances."""
    return [
        {"cell": one.cell.cell.id, "label": one.label, "other": other.cell.cell.id, "other_label": other.label,
         "tau": agreement(one.orders, other.orders)}
        for one, other in itertools.combinations(found, 2)
        if _alike(one, other) and len(np.unique(one.orders)) > 1 < len(np.unique(other.orders))
    ]  # fmt: skip


def _or_none(values: FloatArray, statistic: Callable[[FloatArray], Any]) -> float | None:
    return None if not len(values) or np.isnan(values).any() else float(statistic(values))


def _ranked(one: CellCurricula) -> IntArray:
    """Places of instances, by mean order of inclusion."""
    return np.argsort(one.orders.mean(axis=0), kind="stable")


def inclusion_rows(found: Sequence[CellCurricula]) -> list[dict[str, Value]]:
    """For CSV: a row a cell and instance."""
    return [row for one in found for row in _instance_rows(one)]


def _instance_rows(one: CellCurricula) -> list[dict[str, Value]]:
    mean_order = one.orders.mean(axis=0)
    frequency, weighted, first = one.mean("frequencies"), one.mean("weighted"), one.mean("first")
    return [
        {
            "cell": one.cell.cell.id, "label": one.label, "instance": int(identity), "seeds": len(one.orders),
            "mean_order_of_inclusion": float(mean_order[place]), "frequency": float(frequency[place]),
            "weighted_frequency": float(weighted[place]),
            f"share_of_first_{FIRST_EPISODES}_episodes": float(first[place]),
        }
        for place, identity in enumerate(one.ids)
    ]  # fmt: skip


# ---- texts ----------------------------------------------------------------------------------------------------------


def _mean(values: FloatArray, decimals: int) -> str:
    return NONE if not len(values) or np.isnan(values).any() else number_text(float(values.mean()), decimals)


def _mean_and_least(values: FloatArray) -> str:
    return NONE if not len(values) or np.isnan(values).any() else f"{values.mean():.3f}, {values.min():.3f}"


def _movement(one: CellCurricula) -> str:
    means, most = one.each("shift_mean"), one.each("shift_most")
    return NONE if np.isnan(means).any() else f"{100.0 * means.mean():.1f} %, {100.0 * most.max():.1f} %"


def _percent(found: Interval) -> str:
    if math.isnan(found.value):
        return NONE
    low, high = (None if end is None else 100.0 * end for end in (found.low, found.high))
    return f"{interval_text(Interval(100.0 * found.value, low, high), 1)} %"
