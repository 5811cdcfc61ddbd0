"""Draw the figures of docs/concepts.md: `python jobs/concepts.py RUN [FOLDER]`.

RUN is a finished run of SPaCE on PointMass; they go into docs/figures, or into FOLDER.

Two are drawn from words; `docs/figures/selections.png` shows which instances RUN trained on, as its ledger says.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from ruamel.yaml import YAML

FIGURES: Final = Path(__file__).parents[1] / "docs/figures"
INK, ARROW, FILL, QUIET = "#1a1a1a", "#4d4d4d", "#e9e9e9", "#b8b8b8"
MOMENTS: Final = 3  # selections shown of a run

Point = tuple[float, float]


def canvas(width: float, height: float) -> tuple[Figure, Any]:
    """A figure of inches by inches, with axes in inches over all of it."""
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    return figure, axes


def box(axes: Any, at: Point, size: Point, title: str, words: str = "", *, fill: str = "white") -> None:
    """A box around `at` with a bold title and words below it."""
    (x, y), (width, height) = at, size
    axes.add_patch(FancyBboxPatch(
        (x - width / 2, y - height / 2), width, height, boxstyle="round,pad=0,rounding_size=0.06", facecolor=fill,
        edgecolor=INK, lw=1.1, zorder=3,
    ))  # fmt: skip
    lines = words.count("\n") + 1 if words else 0
    axes.text(x, y + 0.085 * lines, title, ha="center", va="center", fontsize=10, weight="bold", color=INK, zorder=4)
    if words:
        axes.text(x, y - 0.12, words, ha="center", va="center", fontsize=8.5, color=INK, zorder=4, linespacing=1.25)


def arrow(axes: Any, start: Point, end: Point, words: str = "", shift: Point = (0.0, 0.0), bend: float = 0.0) -> None:
    """An arrow with words beside its middle."""
    axes.add_patch(FancyArrowPatch(
        start, end, arrowstyle="-|>", mutation_scale=11, color=ARROW, lw=1.2, shrinkA=0, shrinkB=0, zorder=2,
        connectionstyle=f"arc3,rad={bend}",
    ))  # fmt: skip
    if words:
        x, y = (start[0] + end[0]) / 2 + shift[0], (start[1] + end[1]) / 2 + shift[1]
        axes.text(x, y, words, ha="center", va="center", fontsize=8.5, style="italic", color=INK, linespacing=1.2)


def iteration() -> Figure:
    """From instances to the next selection, and what is written down."""
    figure, axes = canvas(7.6, 3.9)
    size = (1.75, 0.8)
    instances, selection, rounds = (1.1, 3.2), (3.8, 3.2), (6.5, 3.2)
    curriculum, values, ledger = (3.8, 1.75), (6.5, 1.75), (6.5, 0.5)
    box(axes, instances, size, "instances", "id and context\n(a CSV file)", fill=FILL)
    box(axes, selection, size, "selection", "the instances that\nare trained on now")
    box(axes, rounds, size, "rounds", "collect n_steps\ntransitions, update")
    box(axes, values, size, "start values", "V(s0) of every\ninstance, new policy")
    box(axes, curriculum, size, "curriculum", "SPaCE, or a rival:\na pure function", fill=FILL)
    box(axes, ledger, size, "ledger", "rows, checkpoints,\nthe policy", fill=FILL)
    half_x, half_y = size[0] / 2, size[1] / 2
    arrow(axes, (instances[0] + half_x, 3.2), (selection[0] - half_x, 3.2), "some", (0, 0.14))
    arrow(axes, (selection[0] + half_x, 3.2), (rounds[0] - half_x, 3.2), "one pass:\nan iteration", (0, 0.25))
    arrow(axes, (rounds[0], 3.2 - half_y), (values[0], 1.75 + half_y))
    arrow(axes, (values[0] - half_x, 1.75), (curriculum[0] + half_x, 1.75), "feedback", (0, 0.14))
    arrow(axes, (curriculum[0], 1.75 + half_y), (selection[0], 3.2 - half_y), "the next\none", (-0.42, 0))
    arrow(axes, (values[0], 1.75 - half_y), (ledger[0], 0.5 + half_y))
    arrow(axes, (curriculum[0], 1.75 - half_y), (ledger[0] - half_x, 0.5), "its state", (-0.35, -0.1))
    arrow(axes, (instances[0], 3.2 - half_y), (curriculum[0] - half_x, 1.75), "all of them", (-0.5, -0.12))
    return figure


def grid() -> Figure:
    """Cells by seeds: every square is a run with a folder of its own."""
    figure, axes = canvas(7.6, 3.3)
    cells = ("kappa=4, eta=0.1", "kappa=16, eta=0.1", "round_robin")
    for column, seed in enumerate(("seed 0", "seed 1", "seed 2")):
        axes.text(2.7 + 0.95 * column, 2.95, seed, ha="center", va="center", fontsize=9, color=INK)
        for row in range(len(cells)):
            chosen = (row, column) == (1, 2)
            box(axes, (2.7 + 0.95 * column, 2.4 - 0.75 * row), (0.8, 0.58), "run", fill=FILL if chosen else "white")
    for row, cell in enumerate(cells):
        axes.text(2.1, 2.4 - 0.75 * row, cell, ha="right", va="center", fontsize=9, color=INK)
    axes.text(0.2, 2.95, "cells: settings", ha="left", va="center", fontsize=9, style="italic", color=INK)
    axes.text(3.65, 0.3, "a row of the report: one cell, with an interval over its seeds", ha="center", va="center",
              fontsize=8.5, style="italic", color=INK)  # fmt: skip
    arrow(axes, (5.0, 1.65), (5.6, 1.65))
    files = "config.yaml\nmetrics.jsonl\ncurriculum.jsonl\ncheckpoints/\nmodel.npz"
    axes.add_patch(FancyBboxPatch(
        (5.65, 0.75), 1.75, 1.8, boxstyle="round,pad=0,rounding_size=0.06", facecolor=FILL, edgecolor=INK, lw=1.1,
    ))  # fmt: skip
    axes.text(6.52, 2.35, "its ledger", ha="center", va="center", fontsize=10, weight="bold", color=INK)
    axes.text(5.85, 1.5, files, ha="left", va="center", fontsize=8.5, family="monospace", color=INK, linespacing=1.4)
    return figure


def selections(run: Path) -> Figure:
    """Contexts of the training instances of a run, and which of them it trained on at first, midway and at last."""
    with (run / "instances_train.csv").open() as file:
        rows = list(csv.DictReader(file))
    contexts = {int(row["id"]): (float(row["gate_x"]), float(row["gate_width"])) for row in rows}
    decisions = [json.loads(line) for line in (run / "curriculum.jsonl").read_text().splitlines()]
    figure = Figure(figsize=(7.6, 2.7), layout="constrained")
    FigureCanvasAgg(figure)
    shown = _changes(decisions)
    for axes, decision in zip(figure.subplots(1, len(shown), sharey=True), shown, strict=True):
        chosen = np.array([contexts[one] for one in decision["trained"]])
        axes.scatter(*np.array(list(contexts.values())).T, s=14, facecolor="white", edgecolor=QUIET, lw=0.9)
        axes.scatter(*chosen.T, s=16, color=INK)
        axes.set(
            title=f"iteration {decision['iteration']}: {len(chosen)} of {len(contexts)}", xlabel="position of the gate"
        )
        axes.title.set_fontsize(10)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("width of the gate")
    return figure


def why_not_drawn(run: Path) -> str | None:
    """What a folder lacks whose selections are to be drawn, in words; None if it lacks nothing."""
    needed = ("config.yaml", "instances_train.csv", "curriculum.jsonl")
    if missing := [name for name in needed if not (run / name).is_file()]:
        return f"it has no {missing[0]}; the folder of one run is wanted, runs/pointmass_space/s0 for one"
    config = YAML(typ="safe").load((run / "config.yaml").read_text())
    kind, environment = config["curriculum"]["kind"], config["env"]["id"]
    if (kind, environment) != ("space", "space_dist/PointMass-v0"):
        return f"it is a run of {kind} on {environment}; one of space on space_dist/PointMass-v0 is wanted"
    return None


def _changes(decisions: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first iteration, the last one, and those between whose selections are nearest to even steps in size."""
    sizes = np.array([len(one["trained"]) for one in decisions])
    wanted = np.linspace(sizes.min(), sizes.max(), MOMENTS)
    return [decisions[int(np.argmin(np.abs(sizes - size)))] for size in wanted]


def main(arguments: Sequence[str]) -> None:
    """Write the figures."""
    if len(arguments) not in (1, 2) or arguments[0].startswith("-"):
        sys.exit(
            "usage: python jobs/concepts.py RUN [FOLDER]: RUN holds a run of SPaCE on PointMass; FOLDER is where the "
            "figures go, docs/figures if it is left out"
        )
    run, folder = Path(arguments[0]), Path(arguments[1]) if len(arguments) == 2 else FIGURES
    if (fault := why_not_drawn(run)) is not None:
        sys.exit(f"concepts: {run}: {fault}")
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in (("iteration", iteration()), ("grid", grid()), ("selections", selections(run))):
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=120, metadata={"Software": None})
        print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
