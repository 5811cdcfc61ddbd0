"""A figure of headroom: the signal over time, and which instances succeed when."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from space_dist.curricula.watching import WatchedState
from space_dist.report.figures import dress, empty_figure
from space_dist.report.headroom import Headroom


def draw_headroom(found: Headroom, states: Sequence[WatchedState]) -> Figure:
    """Left: signal and evenness over environment steps, a thin line a seed, their mean thick. Right: success rates.

    The right part has an instance a row, the one that succeeds most at the bottom, over all seeds; white: not played.
    """
    known = all(state.knows_success for state in states)
    figure = empty_figure(11.0 if known else 6.0, 4.4)
    left, *right = figure.subplots(1, 2 if known else 1, squeeze=False)[0]
    shares = found.signal.shape[1]
    ends = (np.arange(shares) + 1) * found.steps / shares
    for name, values, colour, style in (
        ("signal", found.signal, "tab:blue", "-"), ("evenness of advantages", found.evenness, "tab:orange", "--"),
    ):  # fmt: skip
        if np.isnan(values).all():
            continue
        for row in values:
            left.plot(ends, row, color=colour, alpha=0.3, linewidth=0.8, linestyle=style)
        counted = ~np.isnan(values)
        means = np.where(counted, values, 0.0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
        left.plot(ends, np.where(counted.any(axis=0), means, np.nan), color=colour, linewidth=2.2, linestyle=style,
                  label=f"{name}, mean of {len(values)} seeds")  # fmt: skip
    left.set_ylim(0.0, 1.02)
    left.set_ylabel("signal, and evenness (1: all teach alike)")
    dress(left, "What uniform draws teach", over_steps=True)
    left.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    if known:
        episodes = np.sum([state.episodes for state in states], axis=0)
        successes = np.sum([state.successes for state in states], axis=0)
        rates = np.where(episodes > 0, successes / np.maximum(episodes, 1), np.nan)
        order = np.argsort(-successes.sum(axis=0) / np.maximum(episodes.sum(axis=0), 1), kind="stable")
        (axes,) = right
        image = axes.imshow(
            rates[:, order].T, aspect="auto", origin="lower", cmap="viridis", vmin=0.0, vmax=1.0,
            extent=(0.0, float(found.steps), 0.0, float(len(order))), interpolation="nearest",
        )  # fmt: skip
        figure.colorbar(image, ax=axes, label="success rate of training episodes")
        axes.set_ylabel("instances, by how often they succeed")
        dress(axes, "Which instances succeed when", over_steps=True)
        axes.grid(visible=False)
    return figure
