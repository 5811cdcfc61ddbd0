"""TD3's gradient steps, as Stable-Baselines3's `TD3.train` makes them, in one compiled function."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

from space_dist.kernels.functions import tanh
from space_dist.kernels.lanes import entry, every, fma, function, load, store, total, where_greater, width
from space_dist.kernels.networks import backward, forward, pull
from space_dist.kernels.optimiser import adam, follow
from space_dist.kernels.replay import (
    ACTOR,
    FIRST,
    SECOND,
    clear,
    columns,
    fit_critics,
    join,
    lower_targets,
    panels,
    part,
    prepared,
    set_goals,
    share_out,
)

# What a minibatch tells of itself: columns. The actor's loss where it makes a step.
CRITIC_LOSS, ACTOR_LOSS = range(2)
N_RECORDED = 2


class Settings(NamedTuple):
    """TD3's and Adam's. updates: critics' steps that `policy_delay` counts so far.

    critic_steps, actor_steps: that their Adams have made.
    """

    learning_rate: float
    beta: float
    beta_square: float
    eps: float
    critic_steps: int
    actor_steps: int
    updates: int
    policy_delay: int
    tau: float


@function
def _goals(m: Any, plan: Any, layers: Any) -> None:
    """What the lower target critic promises of the target actor's actions."""
    rows, lanes = plan.rows, width(m)
    for row in range(0, rows, lanes):
        set_goals(m, plan, row, lower_targets(m, plan, layers, row))


@function
def _act(m: Any, plan: Any, layers: Any, noisy: bool) -> None:
    """Actions by the actor's outputs."""
    rows, lanes = plan.rows, width(m)
    one, minus = every(m, 1.0), every(m, -1.0)
    outputs_at = layers[ACTOR, plan.depth][5]
    for at in range(0, plan.outputs * rows, lanes):
        action = tanh(load(m, outputs_at + at))
        if noisy:
            action = action + load(m, plan.noise_at + at)
            action = where_greater(action, one, one, action)
            action = where_greater(minus, action, minus, action)
        store(m, plan.actions_at + at, action)


@function
def _improve(m: Any, plan: Any, layers: Any, size: int) -> Any:
    """The actor's loss, whose gradients are then there; the inputs hold what was observed."""
    rows, lanes = plan.rows, width(m)
    zero, one = every(m, 0.0), every(m, 1.0)
    forward(m, plan, layers, ACTOR)
    _act(m, plan, layers, False)
    join(m, plan, size)
    forward(m, plan, layers, FIRST)
    values_at, by_values_at = layers[FIRST, plan.depth][5], layers[FIRST, plan.depth][6]
    loss = zero
    for row in range(0, rows, lanes):
        share = zero - load(m, plan.shares_at + row)
        loss = fma(load(m, values_at + row), share, loss)
        store(m, by_values_at + row, share)
    clear(m, plan.pulls_at, plan.pulls_end)
    pull(m, plan, layers, FIRST, plan.pulls_at)
    part(m, plan)
    gradient_at = layers[ACTOR, plan.depth][6]
    for at in range(0, plan.outputs * rows, lanes):
        action = load(m, plan.actions_at + at)
        store(m, gradient_at + at, load(m, plan.pulled_at + at) * fma(zero - action, action, one))
    backward(m, plan, layers, ACTOR, size)
    return total(loss)


@entry
def update(
    m: Any, plan: Any, layers: Any, settings: Any, observations: Any, next_observations: Any, actions: Any,
    rewards: Any, factors: Any, noise: Any, size: int, recorded: Any,
) -> int:  # fmt: skip
    """Gradient steps on minibatches of `size`, one after the other's samples.

    m: the array of a `ReplayLayout`.  observations, next_observations: (n, inputs).  actions: (n, outputs).
    rewards, factors (of what the next observation promises): (n, 1).  noise: (n, outputs) on target actions.
    recorded: (minibatches, N_RECORDED) is filled.  Returns how many steps the actor has made.
    """
    share_out(m, plan, size)
    made = 0
    for step in range(len(recorded)):
        first, rows = step * size, plan.rows
        columns(m, rows, plan.rewards_at, rewards, first, size)
        columns(m, rows, plan.factors_at, factors, first, size)
        columns(m, rows, plan.noise_at, noise, first, size)
        panels(m, rows, plan.inputs_at, next_observations, first, size)
        panels(m, rows, plan.joint_at, next_observations, first, size)
        forward(m, plan, layers, plan.networks + ACTOR)
        _act(m, plan, layers, True)
        join(m, plan, size)
        forward(m, plan, layers, plan.networks + FIRST)
        forward(m, plan, layers, plan.networks + SECOND)
        _goals(m, plan, layers)

        columns(m, rows, plan.actions_at, actions, first, size)
        panels(m, rows, plan.joint_at, observations, first, size)
        join(m, plan, size)
        recorded[step, CRITIC_LOSS] = fit_critics(m, plan, layers, 1.0, size)
        critic_step = settings.critic_steps + step + 1
        adam(m, plan.length, plan.critics_at, plan.log_alpha_at, settings, critic_step, 1.0)

        if (settings.updates + step + 1) % settings.policy_delay == 0:
            panels(m, rows, plan.inputs_at, observations, first, size)
            recorded[step, ACTOR_LOSS] = _improve(m, plan, layers, size)
            made += 1
            adam(m, plan.length, 0, plan.critics_at, settings, settings.actor_steps + made, 1.0)
            follow(m, plan.targets, 0, plan.log_alpha_at, settings.tau)
    return made


@functools.cache
def prepare(dtype: Any) -> Any:
    """`update`, compiled for arrays of `dtype`, which are the only ones it then takes."""
    return prepared(update, dtype, "td3", Settings(0.0, 0.0, 0.0, 0.0, 0, 0, 0, 1, 0.0), 1, N_RECORDED)
