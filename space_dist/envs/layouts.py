"""Layouts of square mazes: carving them, reading them, the shortest way through, and walling the goal off.

A layout is one number a cell, 25 for a 5x5 maze, in reading order (x runs fastest, (0, 0) is the top left). A cell's
number is the sum of the bits of its open sides: north 1, east 2, south 4, west 8. Facts: docs/environments.md ("Maze").
"""

from __future__ import annotations

import functools
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

SIDE: Final = 5  # of gym-maze's smallest, in cells
START: Final = 0
NORTH, SOUTH, EAST, WEST = range(4)  # the actions, in gym-maze's order
BITS: Final = np.array([1, 4, 2, 8])  # of an opening, by action
OPPOSITE: Final = np.array([SOUTH, NORTH, WEST, EAST])

Layouts = NDArray[np.float64]
Cells = NDArray[np.int64]


@functools.cache
def neighbours(side: int) -> Cells:
    """`(cells, actions)` the cell next to each; -1 outside."""
    cells = np.arange(side * side)
    x, y = cells % side, cells // side
    found = np.stack(
        [
            np.where(y > 0, cells - side, -1),
            np.where(y < side - 1, cells + side, -1),
            np.where(x < side - 1, cells + 1, -1),
            np.where(x > 0, cells - 1, -1),
        ],
        axis=1,
    )
    found.setflags(write=False)
    return found


def successors(layouts: Layouts) -> Cells:
    """`(n, cells) -> (n, cells, actions)`: where each action leads; a blocked move stays.

    A passage is open if either of its two cells says so: that reads symmetrised and raw layouts alike.
    """
    cells = layouts.shape[1]
    beside = neighbours(math.isqrt(cells))
    said = (layouts.astype(np.int64)[:, :, None] & BITS) > 0
    there = said[:, np.maximum(beside, 0), OPPOSITE]  # what the cell on the other side says of the same wall
    open_ = (said | there) & (beside >= 0)
    found: Cells = np.where(open_, beside, np.arange(cells)[:, None])
    return found


def symmetrised(layouts: Layouts) -> Layouts:
    """`(n, cells)` layouts in which both cells of every passage say that it is open; outer openings are closed."""
    open_ = successors(layouts) != np.arange(layouts.shape[1])[:, None]
    numbers: Layouts = (open_ * BITS).sum(axis=2).astype(np.float64)
    return numbers


def shortest_ways(layouts: Layouts, goals: Cells | None = None) -> NDArray[np.float64]:
    """`(n, cells) -> (n,)` moves on the shortest way from start to goal; infinity where there is none.

    goals: `(n,)` cells; the last one, if left out.
    """
    n, cells = layouts.shape
    goals = np.full(n, cells - 1) if goals is None else goals
    following = successors(layouts)
    reached = np.zeros((n, cells), dtype=np.bool_)
    reached[:, START] = True
    moves = np.where(goals == START, 0.0, np.inf)
    rows = np.arange(n)
    for count in range(1, cells):
        spread = reached.copy()
        spread[rows[:, None, None], np.where(reached[:, :, None], following, START)] = True
        if np.array_equal(spread, reached):
            break
        reached = spread
        moves[np.isinf(moves) & reached[rows, goals]] = count
    return moves


def carve(rng: np.random.Generator, n: int, *, raw: bool = False, side: int = SIDE) -> Layouts:
    """`(n, cells)` perfect mazes (one way between any two cells), carved by a randomised depth-first search.

    With `raw`, only the newer cell of each passage says that it is open, as in the released layouts: the numbers then
    depend on where the carving began, and one maze has up to as many of them as cells.
    """
    cells = side * side
    beside = neighbours(side).tolist()
    layouts = np.zeros((n, cells))
    for layout in layouts:
        trail = [int(rng.integers(cells))]
        seen = set(trail)
        while trail:
            cell = trail[-1]
            fresh = [action for action in range(4) if (to := beside[cell][action]) >= 0 and to not in seen]
            if not fresh:
                trail.pop()
                continue
            action = fresh[int(rng.integers(len(fresh)))]
            new = beside[cell][action]
            layout[new] = BITS[OPPOSITE[action]]
            seen.add(new)
            trail.append(new)
    return layouts if raw else symmetrised(layouts)


def toggled(rng: np.random.Generator, layouts: Layouts, count: int) -> Layouts:
    """`(n, cells)` the layouts, symmetrised, in each of which `count` inner walls were opened or closed.

    These are drawn anew for each layout, and different; all of them, if there are fewer.
    """
    found = symmetrised(layouts)
    beside = neighbours(math.isqrt(layouts.shape[1]))
    walls = np.argwhere(beside[:, [EAST, SOUTH]] >= 0)  # each once: from the cell on its western or northern side
    for layout in found:
        for cell, side in walls[rng.choice(len(walls), size=min(count, len(walls)), replace=False)].tolist():
            action = (EAST, SOUTH)[side]
            sign = -1 if int(layout[cell]) & int(BITS[action]) else 1
            layout[cell] += sign * BITS[action]
            layout[beside[cell, action]] += sign * BITS[OPPOSITE[action]]
    return found


def grown(rng: np.random.Generator, layout: Layouts) -> Layouts:
    """`(cells,) -> (larger,)` the symmetrised layout with a column in the east and a row in the south more.

    Each new cell is open towards the cell to its west, or in the row to its north; the new corner, which is the goal,
    towards one of both. So there is a way to it if there was one to the corner before.
    """
    side = math.isqrt(len(layout))
    larger = placed(layout[None], side + 1)[0].reshape(side + 1, side + 1)
    larger[:side, side - 1] += BITS[EAST]
    larger[:side, side] += BITS[WEST]
    larger[side - 1, :side] += BITS[SOUTH]
    larger[side, :side] += BITS[NORTH]
    if rng.integers(2):
        larger[side, side - 1] += BITS[EAST]
        larger[side, side] += BITS[WEST]
    else:
        larger[side - 1, side] += BITS[SOUTH]
        larger[side, side] += BITS[NORTH]
    flat: Layouts = larger.ravel()
    return flat


def walled_off(rng: np.random.Generator, layouts: Layouts) -> Layouts:
    """`(n, cells)` the symmetrised perfect mazes, each with one passage of its way to the last cell closed.

    Which one is drawn: every passage of the way is as likely. As there is no other way, the goal cannot be reached.
    """
    closed = layouts.copy()
    for layout, following in zip(closed, successors(layouts).tolist(), strict=True):
        way = _way(following)
        cell, action = way[int(rng.integers(len(way)))]
        layout[cell] -= BITS[action]
        layout[following[cell][action]] -= BITS[OPPOSITE[action]]
    return closed


def _way(following: list[list[int]]) -> list[tuple[int, int]]:
    """The (cell, action) of each move from start to the last cell, in a maze where there is one way only."""
    came: dict[int, tuple[int, int]] = {}
    trail = [START]
    while trail:
        cell = trail.pop()
        for action, to in enumerate(following[cell]):
            if to != START and to not in came:
                came[to] = (cell, action)
                trail.append(to)
    way, cell = [], len(following) - 1
    while cell != START:
        way.append(came[cell])
        cell = came[cell][0]
    return way[::-1]


def placed(layouts: Layouts, side: int) -> Layouts:
    """`(n, cells) -> (n, side * side)` layouts in the top left of a larger square, whose other cells are closed."""
    n, own = len(layouts), math.isqrt(layouts.shape[1])
    larger = np.zeros((n, side, side))
    larger[:, :own, :own] = layouts.reshape(n, own, own)
    return larger.reshape(n, side * side)


def cut_out(layouts: Layouts, side: int) -> Layouts:
    """`(n, cells) -> (n, side * side)` the top left of larger layouts."""
    n, whole = len(layouts), math.isqrt(layouts.shape[1])
    return layouts.reshape(n, whole, whole)[:, :side, :side].reshape(n, side * side)
