"""Learning curves and the curriculum's course, drawn without any global state of Matplotlib."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from PIL import Image

from space_dist.errors import LedgerError
from space_dist.report.load import Configuration, FloatArray, IntArray, Run
from space_dist.report.statistics import confidence_interval, interquartile_mean
from space_dist.system.files import atomic_write

# Okabe and Ito's palette: told apart with every common colour blindness; its yellow is left out, too pale for lines.
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
LINE_STYLES: Final = ("-", "--", ":", "-.")
MAX_ROWS: Final = 500
MAX_COLUMNS: Final = 1000
MAX_LABELLED_INSTANCES: Final = 30
MAX_FEATURES: Final = 16  # of contexts, each with a panel
MAX_MARKED: Final = 40  # a line of fewer evaluations shows each: one alone would be invisible
MAX_WRITTEN: Final = 160  # places of a heat map that still have room for numbers
_PANEL_COLUMNS: Final = 3
_PANEL_LABEL: Final = 44  # characters in a line of a panel's legend
_STEPS_LABEL: Final = "environment steps"
_RETURN_LABEL: Final = "mean undiscounted return per episode"
_DPI: Final = 150
_COLOURS_KEPT: Final = 256


def draw_comparison(configurations: Sequence[Configuration]) -> Figure:
    """Test returns, train returns and set sizes over real environment steps, one colour for each configuration.

    Returns are IQMs over seeds with bands of 95 %, at the steps where any drawn seed was evaluated. Sizes are
    medians over seeds as far as all drawn seeds got, with a thin line for each seed.
    """
    figure = empty_figure(15.0, 4.6 + 0.25 * ((len(configurations) - 1) // 3))
    test, train, sizes = figure.subplots(1, 3)
    train.sharey(test)
    for number, configuration in enumerate(configurations):
        style = style_of(number)
        label = _legend(configuration)
        _draw_returns(test, *configuration.returns("test"), label, style)
        _draw_returns(train, *configuration.returns("train"), label, style)
        _draw_set_sizes(sizes, configuration, label, style)
    for axes, title, label in (
        (test, "Test instances", f"{_RETURN_LABEL}\n(IQM over seeds, 95 % interval)"),
        (train, "Training instances", _RETURN_LABEL),
        (sizes, "Curriculum", "instances trained on\n(median over seeds; thin: each seed)"),
    ):
        _dress(axes, title, label)
    _count_upwards(sizes)
    columns = min(3, len(configurations))
    figure.legend(handles=test.get_lines(), loc="outside lower center", ncols=columns, frameon=False)
    return figure


@dataclass(frozen=True)
class Panel:
    """Learning curves that are drawn into one diagram; `reference` is repeated, in grey, in every diagram."""

    title: str
    configurations: Sequence[Configuration]
    reference: Configuration | None = None


def draw_panels(panels: Sequence[Panel]) -> Figure:
    """Test returns over real environment steps: IQMs over seeds with bands of 95 %, on axes of one scale."""
    columns = min(_PANEL_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure = empty_figure(5.0 * columns, (3.6 + 0.17 * max(map(_legend_lines, panels))) * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, panel in zip(grid.flat, panels, strict=False):
        if panel.reference is not None:
            style = {"color": "#777777", "linestyle": "--"}
            _draw_returns(axes, *panel.reference.returns("test"), _legend(panel.reference, _PANEL_LABEL), style)
        for number, configuration in enumerate(panel.configurations):
            style = style_of(number)
            _draw_returns(axes, *configuration.returns("test"), _legend(configuration, _PANEL_LABEL), style)
        _dress(axes, plain(panel.title), _RETURN_LABEL)
        axes.tick_params(labelbottom=True, labelleft=True)
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.16), frameon=False, fontsize=8, handlelength=3)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    return figure


def _legend_lines(panel: Panel) -> int:
    """Lines of a panel's legend, below its axes."""
    shown = [*panel.configurations, *([panel.reference] if panel.reference is not None else [])]
    return sum(_legend(configuration, _PANEL_LABEL).count("\n") + 1 for configuration in shown)


@dataclass(frozen=True)
class HeatMap:
    """Final test returns over two parameters, like the paper's Table 1.

    `columns` and `rows` are the parameters' names and values as text; `means` and `spreads` are `(rows, columns)`: mean
    and standard deviation over the finished seeds, NaN where there is none; `seeds` says how many there are: `9/10`.
    """

    title: str
    column_name: str
    row_name: str
    columns: Sequence[str]
    rows: Sequence[str]
    means: FloatArray
    spreads: FloatArray
    seeds: Sequence[Sequence[str]]

    def text(self, row: int, column: int) -> str:
        """What is known of a place: `5.10 ± 0.70 (9/10)`; without seeds only how many are missing."""
        mean, spread = self.means[row, column], self.spreads[row, column]
        decimals = 2 if abs(mean) < 100 else 1 if abs(mean) < 10_000 else 0
        number = "—" if math.isnan(mean) else f"{mean:,.{decimals}f}"
        number += "" if math.isnan(spread) else f" ± {spread:,.{decimals}f}"
        return f"{number} ({self.seeds[row][column]})" if self.seeds[row][column] else "—"


def draw_heat_map(found: HeatMap, low: float, high: float) -> Figure:
    """One map; `low` and `high` are the ends of the colour scale, shared by maps that are to be compared."""
    n_rows, n_columns = found.means.shape
    figure = empty_figure(min(16.0, 2.8 + 1.25 * n_columns), min(16.0, 1.8 + 0.72 * n_rows))
    axes = figure.subplots()
    colours = colormaps["cividis"].with_extremes(bad="#EEEEEE")
    # Where all values are one, the scale still needs a width.
    image = axes.imshow(found.means, cmap=colours, vmin=low, vmax=max(high, low + 1e-9), aspect="auto")
    across, down = ([plain(textwrap.shorten(value, 24, placeholder="…")) for value in values]
                    for values in (found.columns, found.rows))  # fmt: skip
    axes.set_xticks(range(n_columns), across, rotation=90 if sum(map(len, across)) > 9 * n_columns else 0)
    axes.set_yticks(range(n_rows), down)
    axes.set_xlabel(plain(found.column_name))
    axes.set_ylabel(plain(found.row_name))
    axes.set_title(plain(found.title), fontsize=11)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    for row in range(n_rows) if n_rows * n_columns <= MAX_WRITTEN else ():
        for column in range(n_columns):
            shade = image.cmap(image.norm(found.means[row, column]))
            dark = not math.isnan(found.means[row, column]) and sum(shade[:3]) < 1.5
            axes.text(column, row, found.text(row, column).replace(" (", "\n("), ha="center", va="center", fontsize=9,
                      color="white" if dark else "black")  # fmt: skip
    figure.colorbar(image, ax=axes, label="mean test return")
    return figure


def draw_learning_curve(run: Run) -> Figure:
    """One run: mean undiscounted train and test return, and the set size below, over real environment steps.

    Raises LedgerError if the run was not evaluated yet.
    """
    if not len(run.evaluation_steps):
        raise LedgerError(f"{run.ledger.folder} holds no evaluation yet")
    figure = empty_figure(7.5, 6.5)
    returns, sizes = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for label, measures, colour, marker in (("test", run.test, COLOURS[0], "o"), ("train", run.train, COLOURS[1], "s")):
        marked = marker if len(run.evaluation_steps) <= MAX_MARKED else None
        returns.plot(run.evaluation_steps, measures["return"], color=colour, marker=marked, markersize=3.5, label=label)
    starts, trained = _set_size_steps(run)
    sizes.plot(starts, trained, color=COLOURS[2], drawstyle="steps-post")
    _dress(returns, f"{run.status.name}, seed {run.status.seed}", _RETURN_LABEL)
    _dress(sizes, "", f"instances trained on\n(of {len(run.instance_ids):,})")
    returns.set_xlabel("")
    returns.legend(title="instances", frameon=False)
    _count_upwards(sizes)
    return figure


def curriculum_shares(
    trained: Sequence[IntArray], instance_ids: IntArray, max_rows: int = MAX_ROWS, max_columns: int = MAX_COLUMNS
) -> tuple[IntArray, FloatArray]:
    """When each instance was trained on: `(n,)` ids in order of first inclusion, and `(rows, columns)` shares.

    Ties go by id, instances never trained on come last. A share is 1 where the row's instance was trained on in the
    column's iteration and 0 elsewhere; with more instances than `max_rows` or more iterations than `max_columns`, a
    row or column is a block of equally many (the last one may hold fewer) and the share is its mean.

    `instance_ids` are `(n,)`, ascending. Raises LedgerError if another id was trained on.
    """
    n, m = len(instance_ids), len(trained)
    first = np.full(n, m)
    present = []
    for iteration, ids in enumerate(trained):
        positions = np.searchsorted(instance_ids, np.unique(ids))
        if not np.array_equal(instance_ids[np.minimum(positions, n - 1)], np.unique(ids)):
            raise LedgerError(f"iteration {iteration + 1} was trained on contexts that are not of the instance set")
        first[positions] = np.minimum(first[positions], iteration)
        present.append(positions)
    order = np.argsort(first, kind="stable")
    rank = np.empty(n, dtype=np.int64)
    rank[order] = np.arange(n)
    height, width = -(-n // max_rows), -(-m // max_columns)
    counts = np.zeros((-(-n // height), -(-m // width) if m else 0))
    for iteration, positions in enumerate(present):
        counts[:, iteration // width] += np.bincount(rank[positions] // height, minlength=len(counts))
    row_sizes = np.minimum(height, n - height * np.arange(counts.shape[0]))
    column_sizes = np.minimum(width, m - width * np.arange(counts.shape[1]))
    return instance_ids[order], counts / np.outer(row_sizes, column_sizes)


def draw_curriculum(run: Run) -> Figure:
    """What the run was trained on: a heat map of instances (rows) by iterations (columns).

    Where contexts were generated there are no instances to show, and it is `draw_contexts`. Raises LedgerError if there
    is no iteration yet.
    """
    trained = run.trained
    if not trained:
        raise LedgerError(f"{run.ledger.folder} holds no iteration yet")
    if run.generates_contexts:
        return draw_contexts(run)
    order, shares = curriculum_shares(trained, run.instance_ids)
    n, m = len(order), len(trained)
    height, width = -(-n // MAX_ROWS), -(-m // MAX_COLUMNS)
    figure = empty_figure(7.5, 5.5)
    axes = figure.subplots()
    colours = LinearSegmentedColormap.from_list("share", ["#FFFFFF", COLOURS[0]])
    image = axes.imshow(
        shares, cmap=colours, vmin=0.0, vmax=1.0, aspect="auto", origin="lower", interpolation="nearest",
        extent=(0.5, 0.5 + width * shares.shape[1], 0.5, 0.5 + height * shares.shape[0]),
    )  # fmt: skip
    axes.set_xlim(0.5, m + 0.5)
    axes.set_ylim(0.5, n + 0.5)
    axes.set_title(f"{run.status.name}, seed {run.status.seed}: instances trained on", fontsize=11)
    axes.set_xlabel("iteration")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    if n <= MAX_LABELLED_INSTANCES:
        axes.set_yticks(np.arange(1, n + 1), [str(identity) for identity in order.tolist()], fontsize=8)
        axes.set_ylabel("instance id, in order of first inclusion")
    else:
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylabel("instance, in order of first inclusion")
    if height > 1 or width > 1:
        figure.colorbar(image, ax=axes, label=f"share of {height} instances × {width} iterations trained on")
    return figure


def draw_contexts(run: Run) -> Figure:
    """Generated contexts over real environment steps: mean and standard deviation of each feature in each iteration.

    Of more than 16 features the first 16, as the title says. With the target's, and the divergence from it, where the
    curriculum logged them. Raises LedgerError if no context was generated, or not in every iteration.
    """
    generated, features, decisions = run.contexts, run.features, run.decisions
    if not generated or len(generated) != len(run.set_sizes):
        raise LedgerError(f"{run.ledger.folder} was not trained on generated contexts in every iteration")
    every = features[: generated[0].shape[1]]
    names = every[:MAX_FEATURES]
    divergences = [(steps, numbers["kl_to_target"]) for steps, numbers in decisions if "kl_to_target" in numbers]
    panels = len(names) + bool(divergences)
    columns = 2 if panels <= 4 else 4
    rows = -(-panels // columns)
    figure = empty_figure(4.6 * columns, 3.0 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    means = np.array([contexts.mean(axis=0) for contexts in generated])
    deviations = np.array([contexts.std(axis=0) for contexts in generated])
    last: Mapping[str, Any] = decisions[-1][1] if decisions else {}
    for place, name in enumerate(names):
        mean, deviation, panel = means[:, place], deviations[:, place], axes[place]
        panel.fill_between(run.iteration_ends, mean - deviation, mean + deviation, color=COLOURS[0], alpha=0.2, lw=0)
        panel.plot(run.iteration_ends, mean, color=COLOURS[0], label="trained on: mean ± standard deviation")
        if f"target_mean_{name}" in last:
            centre, spread = last[f"target_mean_{name}"], last[f"target_std_{name}"]
            panel.axhspan(centre - spread, centre + spread, color=COLOURS[1], alpha=0.25, lw=0)
            panel.axhline(centre, color=COLOURS[1], linestyle="--", label="target: mean ± standard deviation")
        _dress(panel, "", name)
    if divergences:
        axes[len(names)].semilogy(*zip(*divergences, strict=True), color=COLOURS[2])
        _dress(axes[len(names)], "", "KL to the target (nats)")
    for empty in axes[panels:]:
        empty.set_axis_off()
    some = f", {len(names)} of {len(every)} features" if len(names) < len(every) else ""
    figure.suptitle(f"{run.status.name}, seed {run.status.seed}: generated contexts{some}", fontsize=11)
    figure.legend(handles=axes[0].get_lines(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all. Raises OSError."""
    atomic_write(path, png(figure))


def png(figure: Figure, note: str = "") -> bytes:
    """The figure as a PNG file of 256 colours, a third of the bytes; with a note, it is written above everything."""
    if note:
        figure.suptitle(plain(note), fontsize=10, color="#B00020")
    drawn, written = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI)
    Image.open(drawn).convert("RGB").quantize(_COLOURS_KEPT, dither=Image.Dither.NONE).save(
        written, "png", optimize=True
    )
    return written.getvalue()


def style_of(number: int) -> dict[str, Any]:
    """Colour and line of the number-th curve: neighbours differ in both, to be told apart in grey as well."""
    return {"color": COLOURS[number % len(COLOURS)], "linestyle": LINE_STYLES[number % len(LINE_STYLES)]}


def plain(text: str) -> str:
    """A user's words, which Matplotlib is not to read as mathematics."""
    return text.replace("$", r"\$")


def wrapped(label: str, width: int, more: str = "") -> str:
    """A user's label in at most three lines, for a legend or a title; `more` is put behind it."""
    words = f"{textwrap.fill(label, width, max_lines=3)}{more}"
    return plain(f" {words}" if words.startswith("_") else words)  # Matplotlib hides labels that begin so


def _legend(configuration: Configuration, width: int = 60) -> str:
    return wrapped(configuration.label, width, f" ({_seed_count(configuration)})")


def empty_figure(width: float, height: float) -> Figure:
    """An empty white figure, in inches, whose parts keep out of each other's way."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes, title: str = "", *, over_steps: bool = False) -> None:
    """What all diagrams have in common. over_steps: the horizontal axis counts environment steps."""
    axes.set_title(title, fontsize=11)
    if over_steps:
        axes.set_xlabel(_STEPS_LABEL)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 2.5, 5, 10], integer=True))
        axes.set_xlim(0, max(1.0, axes.get_xlim()[1]))
    axes.grid(visible=True, color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _dress(axes: Axes, title: str, label: str) -> None:
    dress(axes, title, over_steps=True)
    axes.set_ylabel(label)
    if not any(np.size(line.get_xdata()) for line in axes.get_lines()):
        axes.tick_params(labelleft=False, labelbottom=False)
        axes.text(0.5, 0.5, "nothing yet", transform=axes.transAxes, ha="center", va="center", color="#777777")


def _count_upwards(axes: Axes) -> None:
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axes.set_ylim(bottom=0)


def _draw_returns(axes: Axes, steps: IntArray, returns: FloatArray, label: str, style: dict[str, Any]) -> None:
    centre = interquartile_mean(returns) if len(returns) else np.zeros(0)
    marker = "o" if len(steps) <= MAX_MARKED else None
    axes.plot(steps, centre, label=label, marker=marker, markersize=3, linewidth=1.8, **style)
    if len(returns) > 1:
        low, high = confidence_interval(returns)
        axes.fill_between(steps, low, high, color=style["color"], alpha=0.18, linewidth=0)


def _draw_set_sizes(axes: Axes, configuration: Configuration, label: str, style: dict[str, Any]) -> None:
    curves = [_set_size_steps(run) for run in configuration.drawn if len(run.set_sizes)]
    if not curves:
        return
    for steps, sizes in curves:
        # Matplotlib leaves labels that begin with an underscore out of legends.
        axes.plot(steps, sizes, drawstyle="steps-post", linewidth=0.7, alpha=0.45, label=f"_{label}", **style)
    last = min(steps[-1] for steps, _ in curves)
    grid = np.unique(np.concatenate([steps[steps <= last] for steps, _ in curves]))
    at = [sizes[np.searchsorted(steps, grid, side="right") - 1] for steps, sizes in curves]
    axes.plot(grid, np.median(at, axis=0), drawstyle="steps-post", linewidth=2.0, label=label, **style)


def _set_size_steps(run: Run) -> tuple[IntArray, IntArray]:
    """Where the set size changes, for a line of steps: the iterations' starts, and the end of the last one."""
    starts, sizes = run.set_size
    return np.append(starts, run.iteration_ends[-1:]), np.append(sizes, sizes[-1:])


def _seed_count(configuration: Configuration) -> str:
    drawn, n = len(configuration.drawn), configuration.n_seeds
    unfinished = "" if configuration.finished else ", unfinished"
    return (f"{n} seed{'s' if n > 1 else ''}" if drawn == n else f"{drawn} of {n} seeds") + unfinished
