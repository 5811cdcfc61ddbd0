"""Layouts of 5x5 mazes: carving them, reading them, and the shortest way through.

A layout is 25 numbers, cell by cell in reading order (x runs fastest, (0, 0) is the top left). A cell's number is the
sum of the bits of its open sides: north 1, east 2, south 4, west 8. Facts: docs/environments.md ("Maze").
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

SIDE: Final = 5
CELLS: Final = SIDE * SIDE
START: Final = 0
GOAL: Final = CELLS - 1
NORTH, SOUTH, EAST, WEST = range(4)  # the actions, in gym-maze's order
BITS: Final = np.array([1, 4, 2, 8])  # of an opening, by action
OPPOSITE: Final = np.array([SOUTH, NORTH, WEST, EAST])

Layouts = NDArray[np.float64]


def _neighbours() -> NDArray[np.int64]:
    """`(cells, actions)` the cell next to each; -1 outside."""
    cells = np.arange(CELLS)
    x, y = cells % SIDE, cells // SIDE
    return np.stack(
        [
            np.where(y > 0, cells - SIDE, -1),
            np.where(y < SIDE - 1, cells + SIDE, -1),
            np.where(x < SIDE - 1, cells + 1, -1),
            np.where(x > 0, cells - 1, -1),
        ],
        axis=1,
    )


NEIGHBOURS: Final = _neighbours()


def successors(layouts: Layouts) -> NDArray[np.int64]:
    """`(n, 25) -> (n, cells, actions)`: where each action leads; a blocked move stays.

    A passage is open if either of its two cells says so: that reads symmetrised and raw layouts alike.
    """
    said = (layouts.astype(np.int64)[:, :, None] & BITS) > 0
    there = said[:, np.maximum(NEIGHBOURS, 0), OPPOSITE]  # what the cell on the other side says of the same wall
    open_ = (said | there) & (NEIGHBOURS >= 0)
    found: NDArray[np.int64] = np.where(open_, NEIGHBOURS, np.arange(CELLS)[:, None])
    return found


def symmetrised(layouts: Layouts) -> Layouts:
    """`(n, 25)` layouts in which both cells of every passage say that it is open; outer openings are closed."""
    open_ = successors(layouts) != np.arange(CELLS)[:, None]
    numbers: Layouts = (open_ * BITS).sum(axis=2).astype(np.float64)
    return numbers


def shortest_ways(layouts: Layouts) -> NDArray[np.float64]:
    """`(n, 25) -> (n,)` moves on the shortest way from start to goal; infinity where there is none."""
    following = successors(layouts)
    reached = np.zeros((len(layouts), CELLS), dtype=np.bool_)
    reached[:, START] = True
    moves = np.full(len(layouts), np.inf)
    rows = np.arange(len(layouts))[:, None, None]
    for count in range(1, CELLS):
        spread = reached.copy()
        spread[rows, np.where(reached[:, :, None], following, START)] = True
        reached = spread
        moves[np.isinf(moves) & reached[:, GOAL]] = count
    return moves


def carve(rng: np.random.Generator, n: int, *, raw: bool = False) -> Layouts:
    """`(n, 25)` perfect mazes (one way between any two cells), carved by a randomised depth-first search.

    With `raw`, only the newer cell of each passage says that it is open, as in the released layouts: the numbers then
    depend on where the carving began, and one maze has up to 25 of them.
    """
    layouts = np.zeros((n, CELLS))
    for layout in layouts:
        trail = [int(rng.integers(CELLS))]
        seen = set(trail)
        while trail:
            cell = trail[-1]
            fresh = [action for action in range(4) if (to := int(NEIGHBOURS[cell, action])) >= 0 and to not in seen]
            if not fresh:
                trail.pop()
                continue
            action = fresh[int(rng.integers(len(fresh)))]
            new = int(NEIGHBOURS[cell, action])
            layout[new] = BITS[OPPOSITE[action]]
            seen.add(new)
            trail.append(new)
    return layouts if raw else symmetrised(layouts)
