"""The whole update of PPO, as Stable-Baselines3's `PPO.train` makes it, in one compiled function."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from space_dist.kernels.build import ready
from space_dist.kernels.functions import exp, log
from space_dist.kernels.lanes import (
    entry,
    every,
    fma,
    function,
    load,
    root,
    store,
    total,
    where_equal,
    where_greater,
    width,
)
from space_dist.kernels.networks import ACTOR, CRITIC, Layout, Shape, backward, forward, padded
from space_dist.kernels.optimiser import adam, clipping, norm

_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
# What a minibatch tells of itself: columns.
POLICY_LOSS, VALUE_LOSS, ENTROPY, DIVERGENCE, CLIPPED, NORM = range(6)
N_RECORDED = 6


class Settings(NamedTuple):
    """PPO's and Adam's. clip_range_vf, max_grad_norm, target_kl: infinite for none. steps: that Adam has made."""

    learning_rate: float
    beta: float
    beta_square: float
    eps: float
    steps: int
    clip_range: float
    clip_range_vf: float
    ent_coef: float
    vf_coef: float
    max_grad_norm: float
    target_kl: float
    normalize_advantage: bool


@function
def _gather(m: Any, plan: Any, samples: Any, order: Any, first: int, count: int) -> None:
    """Inputs and fields of `count` samples; nothing in the rows too many."""
    lanes, rows = width(m), plan.rows
    inputs, share = padded(plan.inputs, lanes), 1.0 / count
    for row in range(rows):
        sample = order[first + row] * plan.record if row < count else 0
        for part in range(inputs // lanes):
            at = plan.inputs_at + (part * rows + row) * lanes
            store(m, at, load(samples, sample + part * lanes) if row < count else every(m, 0.0))
        for field in range(plan.fields):
            m[plan.fields_at + field * rows + row] = samples[sample + inputs + field] if row < count else 0.0
        m[plan.shares_at + row] = share if row < count else 0.0


@function
def _normalize(m: Any, plan: Any, count: int) -> None:
    """Advantages with mean 0 and standard deviation 1."""
    lanes, rows, zero = width(m), plan.rows, every(m, 0.0)
    at = plan.fields_at + (plan.fields - 3) * rows
    found = zero
    for row in range(0, rows, lanes):
        found = found + load(m, at + row)
    mean = every(m, total(found) / count)
    found = zero
    for row in range(0, rows, lanes):
        away = where_greater(load(m, plan.shares_at + row), zero, load(m, at + row) - mean, zero)
        store(m, at + row, away)
        found = fma(away, away, found)
    # SB3's 1e-8, and the n - 1 of torch's `std`.
    scale = every(m, root(np.float64(total(found)) / (count - 1)) + 1e-8)
    for row in range(0, rows, lanes):
        store(m, at + row, load(m, at + row) / scale)


@function
def _gaussian(m: Any, plan: Any, layers: Any, row: int) -> Any:
    """Log-probabilities of a few rows' actions; their deviations take the gradient's place meanwhile."""
    rows = plan.rows
    means_at, deviations_at = layers[ACTOR, plan.depth][5], layers[ACTOR, plan.depth][6]
    squares, volume = every(m, 0.0), 0.0
    for output in range(plan.outputs):
        log_std = m[plan.log_std_at + output]
        scale = exp(every(m, -log_std))
        at = output * rows + row
        deviation = (load(m, plan.fields_at + at) - load(m, means_at + at)) * scale
        store(m, deviations_at + at, deviation)
        squares = fma(deviation, deviation, squares)
        volume += log_std
    volume += plan.outputs * _HALF_LOG_2_PI
    return fma(squares, every(m, -0.5), every(m, -volume)), every(m, volume + 0.5 * plan.outputs)


@function
def _gaussian_backward(m: Any, plan: Any, layers: Any, row: int, by: Any, bonus: Any) -> None:
    """Gradients of the means, and of log standard deviations in the same place as far as they are summed up."""
    rows, deviations_at = plan.rows, layers[ACTOR, plan.depth][6]
    for output in range(plan.outputs):
        at = deviations_at + output * rows + row
        deviation = load(m, at)
        here = plan.length + plan.log_std_at + output
        m[here] += total(fma(by * deviation, deviation, every(m, 0.0) - by - bonus))
        store(m, at, by * deviation * exp(every(m, -m[plan.log_std_at + output])))


@function
def _categorical(m: Any, plan: Any, layers: Any, row: int) -> Any:
    """Log-probabilities of a few rows' actions, and entropies; all log-probabilities take the gradient's place."""
    rows = plan.rows
    logits_at, logs_at = layers[ACTOR, plan.depth][5] + row, layers[ACTOR, plan.depth][6] + row
    # Taken off all logits, so that no exponential overflows.
    largest = load(m, logits_at)
    for output in range(1, plan.outputs):
        logit = load(m, logits_at + output * rows)
        largest = where_greater(logit, largest, logit, largest)
    sums = every(m, 0.0)
    for output in range(plan.outputs):
        sums = sums + exp(load(m, logits_at + output * rows) - largest)
    logarithm, actions = log(sums), load(m, plan.fields_at + row)
    found = entropies = every(m, 0.0)
    for output in range(plan.outputs):
        one = load(m, logits_at + output * rows) - largest - logarithm
        store(m, logs_at + output * rows, one)
        entropies = entropies - exp(one) * one
        found = where_equal(actions, every(m, output), one, found)
    return found, entropies


@function
def _categorical_backward(m: Any, plan: Any, layers: Any, row: int, by: Any, bonus: Any, entropies: Any) -> None:
    rows, logs_at = plan.rows, layers[ACTOR, plan.depth][6] + row
    actions, zero = load(m, plan.fields_at + row), every(m, 0.0)
    for output in range(plan.outputs):
        one = load(m, logs_at + output * rows)
        taken = where_equal(actions, every(m, output), by, zero)
        found = exp(one) * ((one + entropies) * bonus - by) + taken
        store(m, logs_at + output * rows, found)


@function
def _losses(m: Any, plan: Any, layers: Any, settings: Any, recorded: Any) -> None:
    """Losses of a minibatch, into `recorded`, and the gradients of the networks' outputs."""
    lanes, rows, fields = width(m), plan.rows, plan.fields_at + (plan.fields - 4) * plan.rows
    zero, one = every(m, 0.0), every(m, 1.0)
    low, high = every(m, 1.0 - settings.clip_range), every(m, 1.0 + settings.clip_range)
    values_at, by_values_at = layers[CRITIC, plan.depth][5], layers[CRITIC, plan.depth][6]
    if not plan.discrete:
        for output in range(plan.outputs):
            m[plan.length + plan.log_std_at + output] = 0.0
    policy = squares = entropy = divergence = clips = zero
    for row in range(0, rows, lanes):
        share = load(m, plan.shares_at + row)
        if plan.discrete:
            log_probs, entropies = _categorical(m, plan, layers, row)
        else:
            log_probs, entropies = _gaussian(m, plan, layers, row)
        # In rows too many 0: what stands there may have an infinite ratio, and 0 times that is NaN.
        log_ratios = where_greater(share, zero, log_probs - load(m, fields + row), zero)
        ratios = exp(log_ratios)
        gains = (zero - load(m, fields + rows + row)) * share
        within = where_greater(ratios, high, high, ratios)
        within = where_greater(low, within, low, within)
        unclipped, clipped = gains * ratios, gains * within
        # The larger loss counts, and has a gradient where it is not the clipped one.
        policy = policy + where_greater(clipped, unclipped, clipped, unclipped)
        by = where_greater(clipped, unclipped, zero, unclipped)
        entropy = fma(entropies, share, entropy)
        divergence = fma(ratios - one - log_ratios, share, divergence)
        away = ratios - one
        away = where_greater(zero, away, zero - away, away)
        clips = clips + where_greater(away, every(m, settings.clip_range), share, zero)
        bonus = share * every(m, settings.ent_coef)
        if plan.discrete:
            _categorical_backward(m, plan, layers, row, by, bonus, entropies)
        else:
            _gaussian_backward(m, plan, layers, row, by, bonus)

        values, returns = load(m, values_at + row), load(m, fields + 2 * rows + row)
        slope = share * every(m, 2.0 * settings.vf_coef)
        if settings.clip_range_vf < math.inf:
            before, end = load(m, fields + 3 * rows + row), every(m, settings.clip_range_vf)
            moved = values - before
            kept = where_greater(moved, end, end, moved)
            kept = where_greater(zero - end, kept, zero - end, kept)
            slope = where_equal(kept, moved, slope, zero)
            values = before + kept
        errors = values - returns
        squares = fma(errors * errors, share, squares)
        store(m, by_values_at + row, errors * slope)
    recorded[POLICY_LOSS], recorded[VALUE_LOSS], recorded[ENTROPY] = total(policy), total(squares), total(entropy)
    recorded[DIVERGENCE], recorded[CLIPPED] = total(divergence), total(clips)


@entry
def update(
    m: Any, plan: Any, layers: Any, settings: Any, samples: Any, orders: Any, size: int, recorded: Any
) -> tuple[int, int, int]:
    """All epochs and minibatches.

    m: the array of a `Layout`.  samples: (n * plan.record,).  orders: (epochs, n) permutations.  size: of minibatches.
    recorded: (minibatches, N_RECORDED) is filled.  Returns how many minibatches were computed, the last of which makes
    no step where `target_kl` has stopped the update; how many steps were made; and how many epochs were begun.
    """
    n, done, steps = orders.shape[1], 0, 0
    for epoch in range(len(orders)):
        for first in range(0, n, size):
            count = min(size, n - first)
            _gather(m, plan, samples, orders[epoch], first, count)
            if settings.normalize_advantage and count > 1:
                _normalize(m, plan, count)
            forward(m, plan, layers, ACTOR)
            forward(m, plan, layers, CRITIC)
            _losses(m, plan, layers, settings, recorded[done])
            done += 1
            # 1.5: SB3's.
            if recorded[done - 1, DIVERGENCE] > 1.5 * settings.target_kl:
                return done, steps, epoch + 1
            backward(m, plan, layers, ACTOR, count)
            backward(m, plan, layers, CRITIC, count)
            length = norm(m, plan.length, 2 * plan.length)
            recorded[done - 1, NORM] = length
            steps += 1
            factor = clipping(settings.max_grad_norm, length)
            adam(m, plan.length, 0, plan.length, settings, settings.steps + steps, factor)
    return done, steps, len(orders)


@entry
def evaluate(
    m: Any, plan: Any, layers: Any, samples: Any, order: Any, outputs: Any, values: Any, log_probs: Any
) -> None:
    """What the networks say of (n,) samples: (n, outputs), (n,), and log-probabilities (n,) of their actions."""
    lanes, rows = width(m), plan.rows
    n = len(order)
    outputs_at, values_at = layers[ACTOR, plan.depth][5], layers[CRITIC, plan.depth][5]
    for first in range(0, n, rows):
        count = min(rows, n - first)
        _gather(m, plan, samples, order, first, count)
        forward(m, plan, layers, ACTOR)
        forward(m, plan, layers, CRITIC)
        for row in range(0, rows, lanes):
            if plan.discrete:
                found, _ = _categorical(m, plan, layers, row)
            else:
                found, _ = _gaussian(m, plan, layers, row)
            store(m, plan.shares_at + row, found)
        for row in range(count):
            for output in range(plan.outputs):
                outputs[first + row, output] = m[outputs_at + output * rows + row]
            values[first + row] = m[values_at + row]
            log_probs[first + row] = m[plan.shares_at + row]


@entry
def advantages(
    rewards: Any, values: Any, starts: Any, last_values: Any, last_ends: Any, gamma: float, decay: float, found: Any
) -> None:
    """Generalised advantages as SB3's `RolloutBuffer` computes them, to the bit, into `found`.

    rewards, values, starts (1 where a step begins an episode), found: (length, slots) of float32.  last_values,
    last_ends: (slots,) behind the last step; if the former are of float64, SB3's sums are.  decay: gamma lambda.
    """
    length, slots = rewards.shape
    one, discount, share = np.float32(1.0), np.float32(gamma), np.float32(decay)
    for slot in range(slots):
        last = length - 1
        going_on = one - last_ends[slot]
        delta = rewards[last, slot] + last_values.dtype.type(gamma) * last_values[slot] * going_on - values[last, slot]
        following = delta + share * going_on * last_values.dtype.type(0.0)
        found[last, slot] = following
        for time in range(length - 2, -1, -1):
            going_on = one - starts[time + 1, slot]
            change = rewards[time, slot] + discount * values[time + 1, slot] * going_on - values[time, slot]
            following = change + share * going_on * following
            found[time, slot] = following


class Entries(NamedTuple):
    """What is compiled, for arrays of one type."""

    update: Any
    evaluate: Any
    advantages: Any


@functools.cache
def prepare(dtype: Any) -> Entries:
    """All entries, compiled for arrays of `dtype`, which are the only ones they then take."""
    layout = Layout.of(Shape(1, 1, False, (1,), "tanh"), 1, np.dtype(dtype).itemsize)
    m, row, rows = np.zeros(1, dtype), np.zeros(1, dtype), np.zeros((1, 1), dtype)
    orders, recorded = np.zeros((1, 1), np.int64), np.zeros((1, N_RECORDED))
    settings = Settings(0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False)
    entries, singles = Entries(update, evaluate, advantages), np.zeros((1, 1), np.float32)
    for one in entries:
        one.disable_compile(False)
    ready(
        [
            (update, (m, layout.plan, layout.layers, settings, row, orders, 1, recorded)),
            (evaluate, (m, layout.plan, layout.layers, row, orders[0], rows, row, row)),
            (advantages, (singles, singles, singles, row, singles[0], 0.0, 0.0, singles)),
        ]
    )
    for one in entries:
        one.disable_compile()
    return entries
