"""DQN's gradient steps, as Stable-Baselines3's `DQN.train` makes them, in one compiled function."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

from space_dist.kernels.lanes import (
    entry,
    every,
    fma,
    function,
    load,
    store,
    total,
    where_equal,
    where_greater,
    width,
)
from space_dist.kernels.networks import backward, forward
from space_dist.kernels.optimiser import adam, clipping, norm
from space_dist.kernels.replay import VALUES, columns, panels, prepared, set_goals, share_out

# What a minibatch tells of itself: columns.
LOSS, NORM = range(2)
N_RECORDED = 2


class Settings(NamedTuple):
    """DQN's and Adam's. max_grad_norm: infinite for none. steps: that Adam has made."""

    learning_rate: float
    beta: float
    beta_square: float
    eps: float
    steps: int
    max_grad_norm: float


@function
def _goals(m: Any, plan: Any, layers: Any) -> None:
    """What the best action of the target network promises."""
    rows, lanes = plan.rows, width(m)
    values_at = layers[plan.networks + VALUES, plan.depth][5]
    for row in range(0, rows, lanes):
        best = load(m, values_at + row)
        for action in range(1, plan.outputs):
            value = load(m, values_at + action * rows + row)
            best = where_greater(value, best, value, best)
        set_goals(m, plan, row, best)


@function
def _loss(m: Any, plan: Any, layers: Any) -> Any:
    """Huber's, and the gradient of the network's outputs."""
    rows, lanes = plan.rows, width(m)
    zero, half, one = every(m, 0.0), every(m, 0.5), every(m, 1.0)
    values_at, gradient_at = layers[VALUES, plan.depth][5], layers[VALUES, plan.depth][6]
    loss = zero
    for row in range(0, rows, lanes):
        share, taken = load(m, plan.shares_at + row), load(m, plan.actions_at + row)
        value = zero
        for action in range(plan.outputs):
            value = where_equal(taken, every(m, action), load(m, values_at + action * rows + row), value)
        error = value - load(m, plan.goals_at + row)
        size = where_greater(zero, error, zero - error, error)
        # SB3's `smooth_l1_loss`, with its beta of 1.
        loss = fma(where_greater(one, size, half * size * size, size - half), share, loss)
        slope = where_greater(error, one, one, error)
        slope = where_greater(zero - one, slope, zero - one, slope) * share
        for action in range(plan.outputs):
            store(m, gradient_at + action * rows + row, where_equal(taken, every(m, action), slope, zero))
    return total(loss)


@entry
def update(
    m: Any, plan: Any, layers: Any, settings: Any, observations: Any, next_observations: Any, actions: Any,
    rewards: Any, factors: Any, size: int, recorded: Any,
) -> None:  # fmt: skip
    """Gradient steps on minibatches of `size`, one after the other's samples.

    m: the array of a `ReplayLayout`.  observations, next_observations: (n, inputs).  actions, rewards, factors (of what
    the next observation promises): (n, 1).  recorded: (minibatches, N_RECORDED) is filled.
    """
    share_out(m, plan, size)
    for step in range(len(recorded)):
        first, rows = step * size, plan.rows
        columns(m, rows, plan.actions_at, actions, first, size)
        columns(m, rows, plan.rewards_at, rewards, first, size)
        columns(m, rows, plan.factors_at, factors, first, size)
        panels(m, rows, plan.inputs_at, next_observations, first, size)
        forward(m, plan, layers, plan.networks + VALUES)
        _goals(m, plan, layers)
        panels(m, rows, plan.inputs_at, observations, first, size)
        forward(m, plan, layers, VALUES)
        recorded[step, LOSS] = _loss(m, plan, layers)
        backward(m, plan, layers, VALUES, size)
        length = norm(m, plan.length, 2 * plan.length)
        recorded[step, NORM] = length
        factor = clipping(settings.max_grad_norm, length)
        adam(m, plan.length, 0, plan.length, settings, settings.steps + step + 1, factor)


@functools.cache
def prepare(dtype: Any) -> Any:
    """`update`, compiled for arrays of `dtype`, which are the only ones it then takes."""
    return prepared(update, dtype, "dqn", Settings(0.0, 0.0, 0.0, 0.0, 0, 0.0), 0, N_RECORDED)
