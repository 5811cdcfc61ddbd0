"""SAC's gradient steps, as Stable-Baselines3's `SAC.train` makes them, in one compiled function."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

from space_dist.kernels.functions import exp, log
from space_dist.kernels.lanes import entry, every, fma, function, load, store, total, where_equal, where_greater, width
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

_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
# Ends of the log standard deviation, and what keeps the logarithm of the squashing's slope finite; SB3.
_LEAST, _MOST, _SPARE = -20.0, 2.0, 1e-6
# What a minibatch tells of itself: columns.
CRITIC_LOSS, ACTOR_LOSS, ENT_COEF, ENT_COEF_LOSS = range(4)
N_RECORDED = 4


class Settings(NamedTuple):
    """SAC's and Adam's. steps: that all Adams have made.  made: gradient steps that `target_update_interval` counts.

    ent_coef: the entropy coefficient, unless it is `learned`.
    """

    learning_rate: float
    beta: float
    beta_square: float
    eps: float
    steps: int
    made: int
    target_update_interval: int
    tau: float
    learned: bool
    ent_coef: float
    target_entropy: float


@function
def _sample(m: Any, plan: Any, layers: Any) -> None:
    """Actions by the actor's outputs and the noise, slopes of their squashing, and their log-probabilities."""
    rows, lanes = plan.rows, width(m)
    zero, one, two = every(m, 0.0), every(m, 1.0), every(m, 2.0)
    means_at = layers[ACTOR, plan.depth][5]
    scales_at = means_at + plan.outputs * rows
    for row in range(0, rows, lanes):
        log_probs = every(m, -plan.outputs * _HALF_LOG_2_PI)
        for output in range(plan.outputs):
            at = output * rows + row
            log_std, noise = _limited(load(m, scales_at + at)), load(m, plan.noise_at + at)
            unsquashed = fma(exp(log_std), noise, load(m, means_at + at))
            # tanh and its derivative by exp(-2 |x|): where tanh is near 1, 1 - tanh^2 would have few digits left.
            size = where_greater(zero, unsquashed, zero - unsquashed, unsquashed)
            power = exp(zero - two * size)
            part_of_one = one / (one + power)
            slope = two * two * power * part_of_one * part_of_one
            action = (one - power) * part_of_one
            store(m, plan.actions_at + at, where_greater(zero, unsquashed, zero - action, action))
            store(m, plan.slopes_at + at, slope)
            log_probs = log_probs - fma(every(m, 0.5) * noise, noise, log_std + log(slope + every(m, _SPARE)))
        store(m, plan.log_probs_at + row, log_probs)


@function
def _limited(log_std: Any) -> Any:
    """Between SB3's ends."""
    least, most = every(log_std, _LEAST), every(log_std, _MOST)
    found = where_greater(log_std, most, most, log_std)
    return where_greater(least, found, least, found)


@function
def _goals(m: Any, plan: Any, layers: Any, alpha: Any) -> None:
    """What the lower target critic promises of the actor's next actions, and their bonus for uncertainty."""
    rows, lanes = plan.rows, width(m)
    for row in range(0, rows, lanes):
        bonus = alpha * load(m, plan.log_probs_at + row)
        set_goals(m, plan, row, lower_targets(m, plan, layers, row) - bonus)


@function
def _excess(m: Any, plan: Any, target: float) -> Any:
    """The mean of log-probabilities and the target entropy: how much too certain actions are."""
    found = every(m, 0.0)
    for row in range(0, plan.rows, width(m)):
        log_probs = load(m, plan.log_probs_at + row)
        found = fma(log_probs + every(m, target), load(m, plan.shares_at + row), found)
    return total(found)


@function
def _improve(m: Any, plan: Any, layers: Any, alpha: Any, size: int) -> Any:
    """The actor's loss, whose gradients are then there; the critics' inputs hold what was observed, and its actions."""
    rows, lanes = plan.rows, width(m)
    zero, two = every(m, 0.0), every(m, 2.0)
    forward(m, plan, layers, FIRST)
    forward(m, plan, layers, SECOND)
    one_at, other_at = layers[FIRST, plan.depth][5], layers[SECOND, plan.depth][5]
    by_one_at, by_other_at = layers[FIRST, plan.depth][6], layers[SECOND, plan.depth][6]
    loss = zero
    for row in range(0, rows, lanes):
        share = load(m, plan.shares_at + row)
        one, other = load(m, one_at + row), load(m, other_at + row)
        least = where_greater(one, other, other, one)
        loss = fma(fma(alpha, load(m, plan.log_probs_at + row), zero - least), share, loss)
        store(m, by_one_at + row, where_greater(one, other, zero, zero - share))
        store(m, by_other_at + row, where_greater(one, other, zero - share, zero))
    clear(m, plan.pulls_at, plan.pulls_end)
    pull(m, plan, layers, FIRST, plan.pulls_at)
    pull(m, plan, layers, SECOND, plan.pulls_at)
    part(m, plan)
    scales_at = layers[ACTOR, plan.depth][5] + plan.outputs * rows
    by_means_at = layers[ACTOR, plan.depth][6]
    by_scales_at = by_means_at + plan.outputs * rows
    for output in range(plan.outputs):
        for row in range(0, rows, lanes):
            at = output * rows + row
            weight = alpha * load(m, plan.shares_at + row)
            slope, given = load(m, plan.slopes_at + at), load(m, scales_at + at)
            log_std = _limited(given)
            bonus = two * weight * load(m, plan.actions_at + at) * slope / (slope + every(m, _SPARE))
            pulled = fma(load(m, plan.pulled_at + at), slope, bonus)
            store(m, by_means_at + at, pulled)
            by_log_std = fma(pulled * exp(log_std), load(m, plan.noise_at + at), zero - weight)
            # Beyond its ends a clamped log standard deviation has no gradient.
            store(m, by_scales_at + at, where_equal(log_std, given, by_log_std, zero))
    backward(m, plan, layers, ACTOR, size)
    return total(loss)


@entry
def update(
    m: Any, plan: Any, layers: Any, settings: Any, observations: Any, next_observations: Any, actions: Any,
    rewards: Any, factors: Any, noise: Any, next_noise: Any, size: int, recorded: Any,
) -> None:  # fmt: skip
    """Gradient steps on minibatches of `size`, one after the other's samples.

    m: the array of a `ReplayLayout`.  observations, next_observations: (n, inputs).  actions: (n, outputs).
    rewards, factors (of what the next observation promises): (n, 1).  noise, next_noise: (n, outputs) standard normal
    numbers, of actions in both observations.  recorded: (minibatches, N_RECORDED) is filled.
    """
    share_out(m, plan, size)
    for step in range(len(recorded)):
        first, rows, number = step * size, plan.rows, settings.steps + step + 1
        # As of before this step's own change of it, for critics and actor alike; SB3.
        alpha = every(m, settings.ent_coef)
        if settings.learned:
            alpha = exp(every(m, m[plan.log_alpha_at]))
        recorded[step, ENT_COEF] = total(alpha) / width(m)

        columns(m, rows, plan.rewards_at, rewards, first, size)
        columns(m, rows, plan.factors_at, factors, first, size)
        columns(m, rows, plan.noise_at, next_noise, first, size)
        panels(m, rows, plan.inputs_at, next_observations, first, size)
        panels(m, rows, plan.joint_at, next_observations, first, size)
        forward(m, plan, layers, ACTOR)
        _sample(m, plan, layers)
        join(m, plan, size)
        forward(m, plan, layers, plan.networks + FIRST)
        forward(m, plan, layers, plan.networks + SECOND)
        _goals(m, plan, layers, alpha)

        columns(m, rows, plan.actions_at, actions, first, size)
        panels(m, rows, plan.joint_at, observations, first, size)
        join(m, plan, size)
        recorded[step, CRITIC_LOSS] = fit_critics(m, plan, layers, 0.5, size)
        adam(m, plan.length, plan.critics_at, plan.log_alpha_at, settings, number, 1.0)

        columns(m, rows, plan.noise_at, noise, first, size)
        panels(m, rows, plan.inputs_at, observations, first, size)
        forward(m, plan, layers, ACTOR)
        _sample(m, plan, layers)
        if settings.learned:
            excess = _excess(m, plan, settings.target_entropy)
            recorded[step, ENT_COEF_LOSS] = -m[plan.log_alpha_at] * excess
            m[plan.length + plan.log_alpha_at] = -excess
            adam(m, plan.length, plan.log_alpha_at, plan.log_alpha_at + width(m), settings, number, 1.0)
        join(m, plan, size)
        recorded[step, ACTOR_LOSS] = _improve(m, plan, layers, alpha, size)
        adam(m, plan.length, 0, plan.critics_at, settings, number, 1.0)
        if (settings.made + step) % settings.target_update_interval == 0:
            follow(m, plan.targets, plan.critics_at, plan.log_alpha_at, settings.tau)


@functools.cache
def prepare(dtype: Any) -> Any:
    """`update`, compiled for arrays of `dtype`, which are the only ones it then takes."""
    settings = Settings(0.0, 0.0, 0.0, 0.0, 0, 0, 1, 0.0, False, 0.0, 0.0)
    return prepared(update, dtype, "sac", settings, 2, N_RECORDED)
