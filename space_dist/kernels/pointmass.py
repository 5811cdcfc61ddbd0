"""PointMass's physics for one action, slot by slot: what `BatchedPointMass` says in NumPy, as a compiled loop.

The same operations on float64, each rounded by itself and in the same order, so both have the same bits
(`tests/test_pointmass.py` compares them). With 16 slots NumPy spends its time on calls, not on numbers.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from space_dist.kernels.build import ready
from space_dist.kernels.lanes import BYTES, entry, prefetch
from space_dist.kernels.scalars import clipped

_AHEAD = 6  # slots whose numbers are on their way from memory
_LINE = BYTES // 8  # numbers of float64 in a line of the cache


class Physics(NamedTuple):
    """The world's constants. step: seconds.  force: acceleration per unit of action.  noise: of the acceleration."""

    step: float
    force: float
    noise: float
    action_limit: float
    position_limit: float


@entry
def advance(
    physics: Any, position: Any, velocity: Any, context: Any, actions: Any, noise: Any, times: Any, crashed: Any
) -> None:
    """Move every slot on by one action, in place; `crashed` (n_slots,) says who has hit the wall, where it then is.

    position, velocity: (2, n_slots).  context: (3, n_slots).  actions: (n_slots, 2).  noise: (n_slots, horizon, inner
    steps, 2) of unit variance, of which row `times` (n_slots,) is used, the last one behind the horizon.
    """
    step, limit, most = physics.step, physics.position_limit, physics.action_limit
    slots, size = position.shape[1], noise.shape[2] * noise.shape[3]
    for slot in range(slots):
        # Every slot's numbers lie an episode apart, where no CPU expects them: waiting took more time than computing.
        ahead = min(slot + _AHEAD, slots - 1)
        behind = (ahead * noise.shape[1] + min(times[ahead], noise.shape[1] - 1)) * size
        for line in range(0, size, _LINE):
            prefetch(noise, behind + line)
        time = min(times[slot], noise.shape[1] - 1)
        gate_x, half_width, decay = context[0, slot], context[1, slot] / 2, 1.0 - step * context[2, slot]
        force_x = physics.force * clipped(actions[slot, 0], most)
        force_y = physics.force * clipped(actions[slot, 1], most)
        x, y, vx, vy = position[0, slot], position[1, slot], velocity[0, slot], velocity[1, slot]
        hit, wall_x = False, 0.0
        for inner in range(noise.shape[2]):
            x_before, y_before = x, y
            x = clipped(vx * step + x_before, limit)
            y = clipped(vy * step + y_before, limit)
            if not hit and y_before * y <= 0.0 and y_before != y:
                wall_x = x_before + y_before / (y_before - y) * (x - x_before)
                hit = abs(wall_x - gate_x) > half_width or half_width == 0.0
            vx = vx * decay + (noise[slot, time, inner, 0] * physics.noise + force_x) * step
            vy = vy * decay + (noise[slot, time, inner, 1] * physics.noise + force_y) * step
        if hit:
            x, y, vx, vy = wall_x, 0.0, 0.0, 0.0
        position[0, slot], position[1, slot], velocity[0, slot], velocity[1, slot] = x, y, vx, vy
        crashed[slot] = hit


@functools.cache
def prepare() -> Any:
    """`advance`, compiled."""
    made: Any = advance
    pair, slot = np.zeros((2, 1)), np.zeros(1, np.int64)
    made.disable_compile(False)
    ready(
        [(made, (Physics(0.0, 0.0, 0.0, 0.0, 0.0), pair, pair, np.zeros((3, 1)), np.zeros((1, 2)),
                    np.zeros((1, 1, 1, 2)), slot, slot > 0))]
    )  # fmt: skip
    made.disable_compile()
    return made
