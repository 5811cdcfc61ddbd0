"""exp, log and tanh of `Lanes`, written out: a library's have the CPU's bits.

Largest errors in units of the last place, as `tests/test_kernels.py` measures them:

| | float32 | float64 |
|---|---|---|
| exp, where the result is a normal number (otherwise it is 0 or infinity) | 1 | 1 |
| log, of positive normal numbers | 1 | 1 |
| tanh | 6 | an absolute 4e-16, as 1 - 2 / (exp(2 x) + 1) loses digits near 0 |
"""

from __future__ import annotations

import math
from typing import Any

from numba.core import types

from space_dist.kernels.lanes import (
    compiled,
    every,
    exponent,
    fma,
    implementation,
    mantissa,
    polynomial,
    scaled,
    where_greater,
)


def exp(value: Any) -> Any:
    """Euler's number to the power of `value`."""
    raise NotImplementedError("of lanes, in compiled functions")


def log(value: Any) -> Any:
    """The natural logarithm of positive normal numbers."""
    raise NotImplementedError("of lanes, in compiled functions")


def tanh(value: Any) -> Any:
    """The hyperbolic tangent, never beyond -1 and 1."""
    raise NotImplementedError("of lanes, in compiled functions")


def _exp(shift: float, high: float, low: float, least: float, largest: float, terms: int) -> Any:
    """exp(x) = 2^n exp(x - n log 2), the latter by its series.

    shift: adding it rounds to an integer, which then stands in the last bits. high, low: log 2 in two parts, the first
    with so few bits that n times it is exact. least, largest: arguments whose results are normal numbers.
    """
    log2_e, infinity = 1.0 / math.log(2.0), math.inf
    series = polynomial(tuple(1.0 / math.factorial(k) for k in range(terms + 1)))

    @compiled
    def made(x: Any) -> Any:
        shifted = fma(x, every(x, log2_e), every(x, shift))
        whole = shifted - every(x, shift)
        rest = fma(whole, every(x, -low), fma(whole, every(x, -high), x))
        power = scaled(series(rest), shifted)
        power = where_greater(every(x, least), x, every(x, 0.0), power)
        return where_greater(x, every(x, largest), every(x, infinity), power)

    return made


def _log(high: float, low: float, terms: int) -> Any:
    """log(2^e m) = e log 2 + 2 artanh((m - 1) / (m + 1)), the latter by its series, for m about 1."""
    series = polynomial(tuple(2.0 / (2 * k + 3) for k in range(terms)))
    root_2 = math.sqrt(2.0)

    @compiled
    def made(x: Any) -> Any:
        m, e, one = mantissa(x), exponent(x), every(x, 1.0)
        large = every(x, root_2)
        e = where_greater(m, large, e + one, e)
        m = where_greater(m, large, m * every(x, 0.5), m)
        f = m - one
        s = f / (m + one)
        z = s * s
        half = every(x, 0.5) * f * f
        # log(1 + f) = f - f^2/2 + s (f^2/2 + z R(z)): what is added to f is small, so that f's bits count.
        correction = fma(s, fma(z, series(z), half), e * every(x, low))
        return fma(e, every(x, high), f - (half - correction))

    return made


# x P(x^2) / Q(x^2): of these degrees the least relative error, 2.1e-8, on (0, 9.02], from where on tanh is 1 in
# float32; by Lawson's weighted least squares at 600 Chebyshev points.
_TANH_ENDS = 9.02
_P = (0.9999999790548473, 0.13379701562499768, 0.0034940149985260255, 2.0583159854759376e-05, 1.3318636341235934e-08)
_Q = (1.0, 0.4671301681625132, 0.02587099900944998, 0.00032830608079023425, 7.761838660729295e-07)


def _tanh() -> Any:
    above, below = polynomial(_P), polynomial(_Q)

    @compiled
    def made(x: Any) -> Any:
        end, one, minus = every(x, _TANH_ENDS), every(x, 1.0), every(x, -1.0)
        x = where_greater(x, end, end, x)
        x = where_greater(minus * end, x, minus * end, x)
        square = x * x
        found = x * above(square) / below(square)
        found = where_greater(found, one, one, found)
        return where_greater(minus, found, minus, found)

    return made


def _tanh_by_exp(exponential: Any) -> Any:
    @compiled
    def made(x: Any) -> Any:
        one, two = every(x, 1.0), every(x, 2.0)
        return one - two / (exponential(two * x) + one)

    return made


# log 2 in two parts: Cephes's in single precision, fdlibm's in double.
_EXP = {
    types.float32: _exp(1.5 * 2.0**23, 0.693359375, -2.12194440e-4, -87.33654, 88.72283, 7),
    types.float64: _exp(1.5 * 2.0**52, 6.93147180369123816490e-1, 1.90821492927058770002e-10, -708.396, 709.7827, 13),
}
_LOG = {
    types.float32: _log(0.693359375, -2.12194440e-4, 5),
    types.float64: _log(6.93147180369123816490e-1, 1.90821492927058770002e-10, 11),
}
_TANH = {types.float32: _tanh(), types.float64: _tanh_by_exp(_EXP[types.float64])}


@implementation(exp)
def _exp_of(value: Any) -> Any:
    function = _EXP[value.dtype]
    return lambda value: function(value)  # noqa: PLW0108 - Numba compiles what is returned


@implementation(log)
def _log_of(value: Any) -> Any:
    function = _LOG[value.dtype]
    return lambda value: function(value)  # noqa: PLW0108 - likewise


@implementation(tanh)
def _tanh_of(value: Any) -> Any:
    function = _TANH[value.dtype]
    return lambda value: function(value)  # noqa: PLW0108 - likewise
