"""What gradients do to parameters: their norm, Adam's step as torch makes it, and targets that follow (Polyak)."""

from __future__ import annotations

from typing import Any

import numpy as np

from space_dist.kernels.lanes import compiled, every, fma, function, load, root, store, total, where_greater, width

# What moves no weight: float32's least normal number. Below it arithmetic takes many times as long.
_LEAST = 2.0**-126


@function
def norm(m: Any, first: int, last: int) -> Any:
    """Of the gradient that lies from `first` to `last`, a multiple of four lanes apart."""
    lanes = width(m)
    one = two = three = four = every(m, 0.0)
    for at in range(first, last, 4 * lanes):
        a, b = load(m, at), load(m, at + lanes)
        c, d = load(m, at + 2 * lanes), load(m, at + 3 * lanes)
        one, two = fma(a, a, one), fma(b, b, two)
        three, four = fma(c, c, three), fma(d, d, four)
    return root(np.float64(total((one + two) + (three + four))))


@compiled
def clipping(largest: float, norm: float) -> float:
    """The factor that makes a gradient's norm the largest there may be, or 1."""
    # 1e-6: as torch's `clip_grad_norm_`.
    factor = largest / (norm + 1e-6)
    return factor if factor < 1.0 else 1.0


@compiled
def _power(base: float, exponent: int) -> float:
    """By squaring: the C library's `pow` is another one on another machine."""
    found = 1.0
    while exponent:
        if exponent & 1:
            found *= base
        base *= base
        exponent >>= 1
    return found


@compiled
def _if_any(average: Any) -> Any:
    """An average, or 0 for one that has all but vanished, as those of units that are never active do."""
    zero = every(average, 0.0)
    size = where_greater(zero, average, zero - average, average)
    return where_greater(every(average, _LEAST), size, zero, average)


@function
def adam(m: Any, length: int, first: int, last: int, settings: Any, step: int, factor: float) -> None:
    """Adam's step number `step` (from 1) of the parameters from `first` to `last`, with `factor` times their gradient.

    length: how far gradients lie behind parameters, means behind those, and squares behind these.
    settings: a named tuple of learning_rate, beta, beta_square and eps among others.
    """
    lanes = width(m)
    clip = every(m, factor)
    mean_share = every(m, 1.0 - settings.beta)
    square_share, kept = every(m, 1.0 - settings.beta_square), every(m, settings.beta_square)
    rate = every(m, -settings.learning_rate / (1.0 - _power(settings.beta, step)))
    unbiased = every(m, 1.0 / root(1.0 - _power(settings.beta_square, step)))
    eps = every(m, settings.eps)
    for at in range(first, last, lanes):
        gradient = load(m, length + at) * clip
        mean, square = load(m, 2 * length + at), load(m, 3 * length + at)
        # torch's own form (`lerp`), which rounds otherwise than b m + (1 - b) g.
        mean = fma(gradient - mean, mean_share, mean)
        square = fma(gradient * square_share, gradient, square * kept)
        mean, square = _if_any(mean), _if_any(square)
        store(m, 2 * length + at, mean)
        store(m, 3 * length + at, square)
        store(m, at, fma(mean / fma(root(square), unbiased, eps), rate, load(m, at)))


@function
def follow(m: Any, to: int, first: int, last: int, tau: float) -> None:
    """Let the targets, `to` behind the parameters from `first` to `last`, take over a share of those."""
    lanes = width(m)
    share, kept = every(m, tau), every(m, 1.0 - tau)
    for at in range(first, last, lanes):
        store(m, to + at, fma(load(m, at), share, load(m, to + at) * kept))
