"""The goal maze's steps, slot by slot: what `BatchedGoalMaze` says in NumPy, as a compiled loop with the same bits."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from space_dist.kernels.build import ready
from space_dist.kernels.lanes import compiled, entry
from space_dist.kernels.scalars import clipped


class World(NamedTuple):
    """Its lengths. wall: |x| and |y| at most.  block: nobody is where both are less.  stride: of the longest step."""

    wall: float
    block: float
    stride: float


@compiled
def _pushed_back(before: Any, after: Any, block: Any) -> Any:
    """A coordinate in the block, moved to the side that it came from, if it came from one."""
    if before <= -block:
        return -block
    if before >= block:
        return block
    return after


@entry
def advance(world: Any, position: Any, context: Any, actions: Any, reached: Any) -> None:
    """Move every slot on by one step, in place; `reached` (n_slots,) says who is near enough to the goal.

    position: (2, n_slots).  context: (3, n_slots).  actions: (n_slots, 2).
    """
    for slot in range(position.shape[1]):
        step_x, step_y = clipped(actions[slot, 0], 1.0), clipped(actions[slot, 1], 1.0)
        length = math.sqrt(step_x * step_x + step_y * step_y)
        if length <= 1.0:  # so that what is no number stays none
            length = 1.0
        x_before, y_before = position[0, slot], position[1, slot]
        x = clipped(x_before + world.stride * (step_x / length), world.wall)
        y = clipped(y_before + world.stride * (step_y / length), world.wall)
        if abs(x) < world.block and abs(y) < world.block:
            x = _pushed_back(x_before, x, world.block)
            y = _pushed_back(y_before, y, world.block)
        position[0, slot], position[1, slot] = x, y
        off_x, off_y = context[0, slot] - x, context[1, slot] - y
        reached[slot] = off_x * off_x + off_y * off_y < context[2, slot] * context[2, slot]


@functools.cache
def prepare() -> Any:
    """`advance`, compiled."""
    made: Any = advance
    made.disable_compile(False)
    ready(
        [(made, (World(0.0, 0.0, 0.0), np.zeros((2, 1)), np.zeros((3, 1)), np.zeros((1, 2)), np.zeros(1, np.bool_)))]
    )  # fmt: skip
    made.disable_compile()
    return made
