"""Figures of instances and of curricula: profiles, curves of each instance, frequencies, contexts over training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from space_dist.report.figures import COLOURS, dress, empty_figure, style_of, wrapped
from space_dist.report.load import FloatArray, IntArray
from space_dist.report.outcomes import profile
from space_dist.report.statistics import confidence_interval, interquartile_mean

FeatureCurves = Sequence[tuple[IntArray, FloatArray]]
"""Of each run `(T,)` environment steps at the iterations' ends, and `(T, d)` mean features of their sets."""

_THRESHOLDS: Final = 201
_COLUMNS: Final = 3
_TITLE: Final = 46  # characters in a line above a diagram
_TENTHS: Final = (0.1, 0.5, 0.9)
_PLACES: Final = 200  # of environment steps, where curves of several runs meet


def draw_profiles(labels: Sequence[str], scores: Sequence[FloatArray]) -> Figure:
    """Performance profiles of one task: for each label, the share of its `(m,)` scores above tau."""
    figure = empty_figure(8.0, 5.0 + 0.22 * len(labels))
    axes = figure.subplots()
    low, high = min(own.min() for own in scores), max(own.max() for own in scores)
    thresholds = np.linspace(low, high, _THRESHOLDS)
    for number, (label, own) in enumerate(zip(labels, scores, strict=True)):
        axes.plot(thresholds, profile(own, thresholds), label=wrapped(label, 90), linewidth=1.8, **style_of(number))
    axes.set_xlabel("tau: undiscounted return of an episode, mean of a held-out instance")
    axes.set_ylabel("share of runs × instances above tau")
    axes.set_ylim(0.0, 1.0)
    dress(axes)
    figure.legend(loc="outside lower center", frameon=False, fontsize=8)
    return figure


def draw_instances(labels: Sequence[str], curves: Sequence[tuple[IntArray, FloatArray]]) -> Figure:
    """A diagram a label: `(k,)` steps and `(k, n)` returns, a thin line for each instance, and their tenths."""
    columns = min(_COLUMNS, len(labels))
    rows = -(-len(labels) // columns)
    figure = empty_figure(4.8 * columns, 3.4 * rows)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, label, (steps, returns) in zip(grid.flat, labels, curves, strict=False):
        lines = [np.column_stack((steps, own)) for own in returns.T]
        axes.add_collection(LineCollection(lines, colors=COLOURS[4], linewidths=0.5, alpha=0.5))
        for share, line in zip(_TENTHS, ("--", "-", ":"), strict=True):
            name = "median" if share == 0.5 else f"{'worst' if share < 0.5 else 'best'} tenth begins"
            axes.plot(
                steps, np.quantile(returns, share, axis=1), color="black", linestyle=line, linewidth=1.6, label=name
            )
        dress(axes, wrapped(label, _TITLE), over_steps=True)
        axes.set_ylabel("return of an episode")
    for axes in grid.flat[len(labels) :]:
        axes.set_axis_off()
    figure.legend(*grid.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def draw_both_counts(found: Sequence[tuple[str, Sequence[tuple[IntArray, FloatArray, FloatArray]]]]) -> Figure:
    """Two diagrams of the same returns. `found`: label; of each run `(k,)` real steps, counted ones, and returns."""
    figure = empty_figure(11.0, 4.4 + 0.22 * len(found))
    real, counted = figure.subplots(1, 2, sharey=True)
    for number, (label, curves) in enumerate(found):
        for axes, which in ((real, 0), (counted, 1)):
            last = min(float(curve[which][-1]) for curve in curves)
            steps = np.linspace(0.0, last, _PLACES)
            returns = np.stack([np.interp(steps, curve[which], curve[2]) for curve in curves])
            axes.plot(steps, interquartile_mean(returns), label=wrapped(label, 90), linewidth=1.6, **style_of(number))
            if len(returns) > 1:
                low, high = confidence_interval(returns)
                axes.fill_between(steps, low, high, alpha=0.15, color=style_of(number)["color"], lw=0)
    dress(real, "over real environment steps", over_steps=True)
    dress(counted, "over the released code's count", over_steps=True)
    counted.set_xlabel("steps as the released code counts them")
    real.set_ylabel("sum of r_t gamma^(T-1-t), stochastic policy\n(IQM over seeds, 95 % interval)")
    figure.legend(*real.get_legend_handles_labels(), loc="outside lower center", frameon=False, fontsize=8)
    return figure


def draw_frequencies(found: Sequence[tuple[str, IntArray, FloatArray, FloatArray]]) -> Figure:
    """A diagram for each (label, places of the n instances by rank, `(n,)` frequencies, `(n,)` weighted ones)."""
    columns = min(_COLUMNS, len(found))
    rows = -(-len(found) // columns)
    figure = empty_figure(4.8 * columns, 3.2 * rows)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, (label, places, frequencies, weighted) in zip(grid.flat, found, strict=False):
        ranks = np.arange(1, len(places) + 1)
        axes.plot(ranks, frequencies[places], color=COLOURS[0], marker=".", markersize=4, linewidth=0.8, label="plain")
        axes.plot(ranks, weighted[places], color=COLOURS[1], linestyle="--", linewidth=1.6, label="weighted by rank")
        axes.set_xlabel("instance, by mean rank of inclusion")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.set_ylabel("share of iterations in the set")
        axes.set_ylim(0.0, 1.02)
        dress(axes, wrapped(label, _TITLE))
    for axes in grid.flat[len(found) :]:
        axes.set_axis_off()
    figure.legend(*grid.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def draw_features(names: Sequence[str], found: Sequence[tuple[str, FeatureCurves, FloatArray]]) -> Figure:
    """Two rows of diagrams, a column a feature: its mean over the set while training, and by rank of inclusion.

    `found`: label, curves of its runs, and `(n, d)` mean features of the instance at each rank. Of more than six
    features the first six are drawn.
    """
    shown = min(6, len(names))
    figure = empty_figure(4.2 * shown, 6.4 + 0.22 * len(found))
    grid = figure.subplots(2, shown, sharey=True, squeeze=False)
    for number, (label, curves, by_rank) in enumerate(found):
        steps, features = _met(curves)
        for feature in range(shown):
            above, below = grid[:, feature]
            values = features[:, :, feature]
            above.plot(steps, values.mean(axis=0), linewidth=1.6, label=wrapped(label, 90), **style_of(number))
            if len(values) > 1:
                above.fill_between(
                    steps, *confidence_interval(values, "mean"), alpha=0.15, color=style_of(number)["color"], lw=0
                )
            window = max(1, len(by_rank) // 10)
            smooth = np.convolve(by_rank[:, feature], np.ones(window) / window, mode="valid")
            below.plot(np.arange(len(smooth)) + (window + 1) / 2, smooth, linewidth=1.6, **style_of(number))
            below.set_xlabel(f"rank of inclusion (mean of {window} in a row)")
            dress(above, names[feature], over_steps=True)
            dress(below)
    grid[0, 0].set_ylim(0.0, 1.0)  # whatever the interval over a few seeds
    grid[0, 0].set_ylabel("mean of the set, share of the bounds\n(mean over seeds, 95 % interval)")
    grid[1, 0].set_ylabel("mean of the instances\n(share of the bounds)")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", frameon=False, fontsize=8)
    return figure


def _met(curves: FeatureCurves) -> tuple[FloatArray, FloatArray]:
    """`(p,)` steps that all runs reached, and `(runs, p, d)` the features of the iteration that each was in there."""
    last = min(int(ends[-1]) for ends, _ in curves)
    steps = np.linspace(0.0, last, _PLACES)
    at = [means[np.minimum(np.searchsorted(ends, steps, side="left"), len(means) - 1)] for ends, means in curves]
    return steps, np.stack(at)
