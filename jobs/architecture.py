"""Draw the packages and who imports whom, from the code as it is: docs/figures/architecture.png.

Rows are the layers of the import contract in pyproject.toml. An arrow says that some module of a package imports some
module of another; it is left out where other arrows lead there already, which two of three do. The file holds what it
shows in words as well (`shown`), so that a test can tell whether it is of today's code.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import grimp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from numpy.typing import NDArray

ROOT: Final = Path(__file__).parents[1]
FIGURE: Final = ROOT / "docs/figures/architecture.png"
OWN: Final = "space_dist"
OTHERS: Final = {  # whose importers are marked, as the figure names them
    "ray": "Ray", "torch": "torch", "stable_baselines3": "SB3", "mlflow": "MLflow", "numba": "Numba",
}  # fmt: skip
KEY: Final = "Description"  # of the text in the PNG

_STEP: Final = (0.45, 0.58)  # inches from place to place, and from row to row
_BOX: Final = (1.15, 0.34)  # inches
PLACES: Final = {  # of the boxes in their rows, searched for with few crossings and no arrow over a box
    "cli": 3, "api": 5, "slurm": 1, "grid": 5, "sb3": 3, "run": 4, "tracking": 3, "report": 2, "experiment": 0,
    "learner": 15, "rollout": 10, "envs": 10, "curricula": 7, "instances": 13, "ledger": 1, "config": 0, "system": 3,
    "kernels": 11, "seeding": 6, "errors": 6, "arithmetic": 15,
}  # fmt: skip
_INK, _ARROW, _STRIPES = "#1a1a1a", "#4d4d4d", ("#f4f4f4", "#e9e9e9")

Edge = tuple[str, str]


@dataclass(frozen=True)
class House:
    """The packages in their layers, from the top; who imports whom; and whose libraries they import."""

    layers: tuple[tuple[str, ...], ...]
    edges: frozenset[Edge]
    libraries: Mapping[str, tuple[str, ...]]

    @property
    def arrows(self) -> tuple[Edge, ...]:
        """The edges that no way over other edges stands for."""
        below = {name: {b for a, b in self.edges if a == name} for layer in self.layers for name in layer}

        def reached(name: str) -> set[str]:
            return below[name].union(*(reached(other) for other in below[name]))

        return tuple(sorted((a, b) for a, b in self.edges if not any(b in reached(other) for other in below[a])))

    def shown(self) -> str:
        """What the figure shows, in words."""
        rows = [" | ".join(layer) for layer in self.layers]
        marks = [f"{name}: {', '.join(found)}" for name, found in sorted(self.libraries.items())]
        return "\n".join([*rows, "", *(f"{a} -> {b}" for a, b in self.arrows), "", *marks])


def read(root: Path = ROOT) -> House:
    """The house as the code and the contract have it today."""
    contracts: list[dict[str, Any]] = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    (layered,) = (contract for contract in contracts if contract["type"] == "layers")
    layers = tuple(tuple(name.strip() for name in layer.split("|")) for layer in layered["layers"])
    graph = grimp.build_graph(OWN, include_external_packages=True, cache_dir=None)
    edges: set[Edge] = set()
    libraries: dict[str, list[str]] = {}
    for module in graph.modules:
        _, _, inside = module.partition(f"{OWN}.")
        for imported in graph.find_modules_directly_imported_by(module) if inside else ():
            package, other = inside.partition(".")[0], imported.removeprefix(f"{OWN}.").partition(".")[0]
            if imported.startswith(f"{OWN}."):
                edges |= {(package, other)} - {(package, package)}
            elif other in OTHERS:
                libraries.setdefault(package, []).append(OTHERS[other])
    return House(
        layers, frozenset(edges), {name: tuple(sorted(set(found), key=str.lower)) for name, found in libraries.items()}
    )


class _Plan:
    """Boxes on places of their rows, and arrows from the lower edge of one to the upper edge of another."""

    def __init__(self, house: House) -> None:
        self.house = house
        self.names = [name for layer in house.layers for name in layer]
        self.row = {name: row for row, layer in enumerate(house.layers) for name in layer}
        self.arrows = house.arrows

    def segments(self, place: Mapping[str, int]) -> NDArray[np.float64]:
        """`(arrows, 2, 2)` from (x, y) to (x, y), in inches: the arrows of a box leave it, and reach it, in order."""
        ends = np.empty((len(self.arrows), 2, 2))
        for end in (0, 1):
            for name in self.names:
                own = [index for index, arrow in enumerate(self.arrows) if arrow[end] == name]
                own.sort(key=lambda index: self._slope(place, *self.arrows[index], end))
                middle, room = place[name] * _STEP[0], 0.62 * _BOX[0]
                shift = (np.arange(len(own)) - (len(own) - 1) / 2) * room / max(1, len(own) - 1)
                for index, offset in zip(own, shift, strict=True):
                    y = -self.row[name] * _STEP[1] + (-0.5, 0.5)[end] * _BOX[1]
                    ends[index, end] = middle + offset, y
        return ends

    def _slope(self, place: Mapping[str, int], above: str, below: str, end: int) -> float:
        """Whither an arrow leans: to the right of its upper end, or to the left of its lower one."""
        leaning = (place[below] - place[above]) / (self.row[below] - self.row[above])
        return leaning if end == 0 else -leaning


# ---- the picture ----------------------------------------------------------------------------------------------------


def draw(house: House) -> Figure:
    """The figure, legible in grey."""
    plan = _Plan(house)
    place = PLACES
    left = min(place.values()) * _STEP[0] - 0.9
    right = max(place.values()) * _STEP[0] + 0.9
    top, bottom = 0.4, -(len(house.layers) - 1) * _STEP[1] - 0.4
    figure = Figure(figsize=(right - left, top - bottom))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.axis("off")
    for row in range(len(house.layers)):
        axes.axhspan(-(row - 0.5) * _STEP[1], -(row + 0.5) * _STEP[1], color=_STRIPES[row % 2], lw=0, zorder=0)
    for start, end in plan.segments(place):
        axes.add_patch(FancyArrowPatch(
            tuple(start), tuple(end), arrowstyle="-|>", mutation_scale=8, color=_ARROW, lw=0.9, shrinkA=0, shrinkB=0,
            zorder=2,
        ))  # fmt: skip
    for name in plan.names:
        x, y = place[name] * _STEP[0], -plan.row[name] * _STEP[1]
        _box(axes, x, y, name, house.libraries.get(name, ()))
    return figure


def _box(axes: Any, x: float, y: float, name: str, libraries: Sequence[str]) -> None:
    width, height = _BOX
    axes.add_patch(FancyBboxPatch(
        (x - width / 2, y - height / 2), width, height, boxstyle="round,pad=0,rounding_size=0.06", facecolor="white",
        edgecolor=_INK, lw=1.1, zorder=3,
    ))  # fmt: skip
    raised = 0.065 if libraries else 0.0
    axes.text(x, y + raised, name, ha="center", va="center", fontsize=9.5, color=_INK, zorder=4, weight="bold")
    if libraries:
        axes.text(x, y - 0.09, ", ".join(libraries), ha="center", va="center", fontsize=6.5, color=_INK, zorder=4,
                  style="italic")  # fmt: skip


def main() -> None:
    """Write the figure."""
    house = read()
    draw(house).savefig(FIGURE, dpi=150, metadata={KEY: house.shown(), "Software": None})
    print(f"{FIGURE}: {len(house.edges)} imports between packages, {len(house.arrows)} arrows")


if __name__ == "__main__":
    main()
