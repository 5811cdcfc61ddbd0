"""Mazes of 3x3 to 11x11 in one world: the mazes of `space_dist.envs.maze`, each of its own size.

Ours; what a maze is, pays and costs is gym-maze's. Facts: docs/environments.md ("Mazes of 3 to 11").
"""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np

from space_dist.envs.interface import Distribution, FloatArray
from space_dist.envs.layouts import Cells, carve, cut_out, grown, placed, successors, symmetrised, toggled, walled_off
from space_dist.envs.maze import BatchedMaze
from space_dist.instances import ContextBounds

LEAST, MOST = 3, 11  # cells of a maze's side
CELLS: Final = MOST**2
GOAL_SHARE: Final = 0.25  # of edits that move the goal, as in the code of Parker-Holder et al. 2022

BOUNDS: Final = ContextBounds(
    names=("side", *(f"cell_{x}_{y}" for y in range(MOST) for x in range(MOST))),
    low=np.array([LEAST, *np.zeros(CELLS)]),
    high=np.array([MOST, *np.full(CELLS, 15.0)]),
)
"""Mazes of 3 to 11: cells of the side, and the bits of each cell's open sides, as Maze's, in an 11x11 square.

A smaller maze lies in the top left of the square; all cells beside it are 0.
"""


def draw(rng: np.random.Generator, n: int, *, solvable: bool = True) -> FloatArray:
    """`(n, 122)` perfect mazes, every side from 3 to 11 as likely; if not `solvable`, with the goal walled off."""
    sides = rng.integers(LEAST, MOST, size=n, endpoint=True)
    contexts = np.zeros((n, 1 + CELLS))
    contexts[:, 0] = sides
    for place, side in enumerate(sides.tolist()):
        layout = carve(rng, 1, side=side)
        contexts[place, 1:] = placed(layout if solvable else walled_off(rng, layout), MOST)
    return contexts


DISTRIBUTIONS: Final = {
    "mixed_maze": Distribution(
        description="Perfect mazes of 3x3 to 11x11 cells, each side as likely, carved depth first from a random cell. "
        "There are 192 of 3x3: of what repeats, another is drawn, of any side",
        source="gym-maze's generator; the sizes are ours",
        bounds=BOUNDS,
        draw=draw,
    ),
}


class BatchedMixedMaze(BatchedMaze):
    """`n_slots` mazes of 3x3 to 11x11 cells. Context: the side, and the 121 numbers of a layout in an 11x11 square.

    Observation and actions are Maze's. The goal is the maze's lower right cell, (side - 1, side - 1); the step onto it
    pays 1 and ends the episode, every other one costs 0.1 / side^2. Observations have one shape whatever the side.
    """

    bounds: ClassVar[ContextBounds] = BOUNDS
    side: ClassVar[int] = MOST

    def draw_contexts(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, 122)` perfect mazes, every side as likely."""
        return draw(rng, n)

    def draw_unsolvable(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, 122)` perfect mazes with one passage of the way to the goal closed, every side as likely."""
        return draw(rng, n, solvable=False)

    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        """`(n, 122)` the mazes, each after `edits` changes; some have no way through.

        One change of four, by chance, moves the goal: the maze loses its last column and row, or gains ones. The others
        open or close an inner wall.
        """
        found = np.zeros_like(contexts)
        for edited, context in zip(found, contexts, strict=True):
            side = int(context[0])
            layout = symmetrised(cut_out(context[None, 1:], side))[0]
            moves = int((rng.random(edits) < GOAL_SHARE).sum())
            for _ in range(moves):
                larger = side == LEAST or (side < MOST and bool(rng.integers(2)))
                layout = grown(rng, layout) if larger else symmetrised(cut_out(layout[None], side - 1))[0]
                side += 1 if larger else -1
            edited[0], edited[1:] = side, placed(toggled(rng, layout[None], edits - moves), MOST)[0]
        return found

    def canonical(self, contexts: FloatArray) -> FloatArray:
        """`(n, 122)` with the numbers of layouts of which both sides of a passage say that it is open."""
        return np.concatenate([contexts[:, :1], symmetrised(contexts[:, 1:])], axis=1)

    def _read(self, contexts: FloatArray) -> tuple[FloatArray, Cells]:
        """`(n, 122) -> (n, 121), (n,)` layouts in the square, and the side of each maze.

        Raises ValueError for anything but whole numbers, and for a maze that is open towards cells beside it.
        """
        if (contexts != np.floor(contexts)).any():
            raise ValueError("a maze is its side, a whole number from 3 to 11, and 121 whole numbers from 0 to 15")
        sides, layouts = contexts[:, 0].astype(np.int64), contexts[:, 1:]
        outside = np.maximum(*np.divmod(np.arange(CELLS), MOST)) >= sides[:, None]
        leads_outside = outside[np.arange(len(sides))[:, None, None], successors(layouts)].any(axis=2)
        leaves = (leads_outside & ~outside).any(axis=1)
        if leaves.any():
            raise ValueError(f"a maze of side {sides[leaves][0]} is open towards a cell beside it")
        return layouts, sides
