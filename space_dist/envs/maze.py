"""Maze (gym-maze, 5x5): find the way from the top left to the bottom right; the layout is the context.

Facts: docs/environments.md ("Maze").
"""

from __future__ import annotations

from typing import ClassVar, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import Distribution, FloatArray, IntArray, Step
from space_dist.envs.layouts import (
    SIDE,
    START,
    Cells,
    carve,
    shortest_ways,
    successors,
    symmetrised,
    toggled,
    walled_off,
)
from space_dist.instances import ContextBounds

GOAL_REWARD = 1.0
WAY_REWARD = -0.1  # of every step but the one onto the goal, divided by the number of cells
HORIZON = 200  # gym-maze registers 2,000: ours is shorter

BOUNDS: Final = ContextBounds(
    names=tuple(f"cell_{x}_{y}" for y in range(SIDE) for x in range(SIDE)),
    low=np.zeros(SIDE * SIDE),
    high=np.full(SIDE * SIDE, 15.0),
)
"""Maze: the bits of each cell's open sides (north 1, east 2, south 4, west 8), in reading order; `cell_x_y`."""


DISTRIBUTIONS: Final = {
    "maze_dfs": Distribution(
        description="Maze, perfect 5x5 mazes carved depth first from a random cell, symmetrised",
        source="gym-maze's generator; the paper released no settings",
        bounds=BOUNDS,
        draw=carve,
    ),
    "maze_dfs_raw": Distribution(
        description="Maze, the mazes of maze_dfs with the released code's numbers, which depend on where the carving "
        "began",
        source="gym-maze's generator",
        bounds=BOUNDS,
        draw=lambda rng, n: carve(rng, n, raw=True),
        content=symmetrised,
    ),
}


class BatchedMaze:
    """`n_slots` mazes. Context: the 25 numbers of a layout (see `space_dist.envs.layouts`); the whole maze, not a view.

    Observed are the integers (x, y); (0, 0) is the start. Actions: 0 north (y - 1), 1 south, 2 east, 3 west; a blocked
    move stays. The step onto the goal (4, 4) pays 1 and ends the episode, every other one costs 0.004. Nothing is
    random: seeds are accepted and decide nothing.
    """

    bounds: ClassVar[ContextBounds] = BOUNDS
    side: ClassVar[int] = SIDE  # of the square that cells are numbered in

    def __init__(self, n_slots: int, *, horizon: int = HORIZON) -> None:
        self.n_slots, self.horizon = n_slots, horizon
        self.observation_space = spaces.Box(0, self.side - 1, shape=(2,), dtype=np.int64)
        self.action_space = spaces.Discrete(4)
        self.context_bounds = self.bounds
        self._next = np.zeros((n_slots, self.side**2, 4), dtype=np.int64)
        self._slots = np.arange(n_slots)
        self._cell = np.full(n_slots, START)
        self._goal = np.full(n_slots, START)
        self._step_reward = np.zeros(n_slots)
        self._time = np.zeros(n_slots, dtype=np.int64)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> NDArray[np.int64]:  # noqa: ARG002
        """Start new episodes at (0, 0). Raises ValueError for contexts that are no layout, such as half a wall."""
        layouts, sides = self._read(contexts)
        self._next[slots] = successors(layouts)
        self._goal[slots], self._step_reward[slots] = self._goals(sides), WAY_REWARD / sides**2
        self._cell[slots], self._time[slots] = START, 0
        return self._observe(self._cell[slots])

    def step(self, actions: NDArray[np.generic]) -> Step:
        """One move. Raises ValueError unless every action is 0, 1, 2 or 3."""
        moves = actions.astype(np.int64)
        if ((moves != actions) | (moves < 0) | (moves > 3)).any():
            raise ValueError(f"actions must be 0, 1, 2 or 3, not {np.array2string(actions, threshold=10)}")
        self._cell = self._next[self._slots, self._cell, moves]
        self._time += 1
        arrived = self._cell == self._goal
        return Step(
            observations=self._observe(self._cell),
            rewards=np.where(arrived, GOAL_REWARD, self._step_reward),
            terminated=arrived,
            truncated=(self._time >= self.horizon) & ~arrived,
            success=arrived.copy(),
        )

    def draw_contexts(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, d)` perfect mazes: few layouts within the bounds are mazes with a way through."""
        return carve(rng, n)

    def draw_unsolvable(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, d)` perfect mazes with one passage of the way to the goal closed."""
        return walled_off(rng, carve(rng, n))

    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        """`(n, d)` the mazes, in each of which `edits` inner walls were opened or closed; some have no way through."""
        return toggled(rng, contexts, edits)

    def canonical(self, contexts: FloatArray) -> FloatArray:
        """`(n, d)` with the numbers of layouts of which both sides of a passage say that it is open."""
        return symmetrised(contexts)

    def optimal_returns(self, contexts: FloatArray) -> FloatArray:
        """`(n, d) -> (n,)` undiscounted returns of the shortest ways: 1 - 0.004 (L - 1) for L moves in a 5x5 maze.

        Where no way is short enough for the horizon, standing still is as good as anything.
        """
        layouts, sides = self._read(contexts)
        moves, step_reward = shortest_ways(layouts, self._goals(sides)), WAY_REWARD / sides**2
        inside = moves <= self.horizon
        best: FloatArray = np.where(
            inside, GOAL_REWARD + step_reward * (np.where(inside, moves, 1) - 1), step_reward * self.horizon
        )
        return best

    def _read(self, contexts: FloatArray) -> tuple[FloatArray, Cells]:
        """`(n, d) -> (n, cells), (n,)` layouts and the side of each maze, whose goal is its lower right cell.

        Raises ValueError for a layout of anything but whole numbers.
        """
        if (contexts != np.floor(contexts)).any():
            raise ValueError("a maze's layout is 25 whole numbers from 0 to 15")
        return contexts, np.full(len(contexts), self.side)

    def _goals(self, sides: Cells) -> Cells:
        return (sides - 1) * (self.side + 1)

    def _observe(self, cells: Cells) -> Cells:
        return np.stack([cells % self.side, cells // self.side], axis=1)
