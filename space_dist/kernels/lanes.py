"""Vectors of 64 bytes for compiled functions: arithmetic whose every rounding and every order of a sum is written here.

A compiler that may contract or reassociate decides bits, and decides them by CPU. Nothing is left to it: no function
here is compiled with `fastmath`, a fused multiply-add is one because it says `fma`, and what runs in parallel are
independent lanes. So the same source has the same bits on every CPU that rounds as IEEE 754 says, with vectors of any
width. LLVM cuts a `Lanes` into what the CPU has: two AVX2 registers, or one of AVX-512.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing import signature
from numba.core.typing.templates import ConcreteTemplate, infer_global
from numba.extending import intrinsic as _intrinsic
from numba.extending import lower_builtin, models, overload, register_model

COMPILES = not numba.config.DISABLE_JIT
"""Whether Numba was left to compile when these functions were defined. Else they stay Python's, which runs none."""

F = TypeVar("F", bound=Callable[..., Any])
BYTES = 64  # of a vector: one of AVX-512's registers, two of AVX2's, and a cache line
# Nothing here allocates, and nothing but what is compiled calls it: reference counts and wrappers cost compile time.
_OPTIONS = {
    "boundscheck": False, "error_model": "numpy", "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip
_INLINED = {**_OPTIONS, "forceinline": True}


class Lanes(types.Type):
    """Sixteen numbers of float32, or eight of float64."""

    def __init__(self, dtype: Any) -> None:
        self.dtype = dtype
        self.count = 8 * BYTES // dtype.bitwidth
        super().__init__(name=f"Lanes({dtype})")


_LANES = {dtype: Lanes(dtype) for dtype in (types.float32, types.float64)}


@register_model(Lanes)
class _Model(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Lanes) -> None:
        super().__init__(manager, kind, ir.VectorType(manager.lookup(kind.dtype).get_value_type(), kind.count))


def compiled(body: F) -> F:
    """A compiled function that becomes part of every one that calls it."""
    return cast(F, numba.njit(**_INLINED)(body))


def function(body: F) -> F:
    """A compiled function of its own, called by compiled functions."""
    return cast(F, numba.njit(**_OPTIONS)(body))


def entry(body: F) -> F:
    """A compiled function that Python calls."""
    return cast(F, numba.njit(boundscheck=False, error_model="numpy", _nrt=False)(body))


def implementation(function: Callable[..., Any]) -> Callable[[F], F]:
    """Say what compiled functions take for `function`, by the types of its arguments."""
    made: Callable[[F], F] = overload(function, strict=False, jit_options=_INLINED)
    return made


def intrinsic(typed: Callable[..., Any]) -> Any:
    """A function of compiled functions, from what types it and emits its code: without the first argument, `typing`."""
    return _intrinsic(typed)


def _vector(value: ir.Value, lanes: Lanes, builder: ir.IRBuilder) -> ir.Value:
    """A number in every lane."""
    shape = ir.VectorType(value.type, lanes.count)
    one = builder.insert_element(ir.Constant(shape, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), lanes.count), [0] * lanes.count)
    return builder.shuffle_vector(one, ir.Constant(shape, ir.Undefined), order)


def _pointer(context: Any, builder: ir.IRBuilder, kind: Any, array: ir.Value, index: ir.Value) -> ir.Value:
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(data, [index])


def _call(builder: ir.IRBuilder, name: str, *values: ir.Value) -> ir.Value:
    """One of LLVM's intrinsics, of equal types."""
    kind = values[0].type
    suffix = f"v{kind.count}" if isinstance(kind, ir.VectorType) else ""
    element = kind.element if isinstance(kind, ir.VectorType) else kind
    suffix += "f32" if isinstance(element, ir.FloatType) else "f64"
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [kind] * len(values)), f"llvm.{name}.{suffix}"
    )
    return builder.call(function, values)


def _load(builder: ir.IRBuilder, pointer: ir.Value, lanes: Lanes) -> ir.Value:
    shape = ir.VectorType(pointer.type.pointee, lanes.count)
    found = builder.load(builder.bitcast(pointer, shape.as_pointer()))
    # A number's alignment, not a vector's: LLVM would else move it with instructions that fault elsewhere.
    found.align = lanes.dtype.bitwidth // 8
    return found


def _store(builder: ir.IRBuilder, value: ir.Value, pointer: ir.Value, lanes: Lanes) -> None:
    made = builder.store(value, builder.bitcast(pointer, value.type.as_pointer()))
    made.align = lanes.dtype.bitwidth // 8


# ---- memory ----


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """The lanes that begin at `array[index]`."""
    lanes = _LANES[array.dtype]

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _load(builder, _pointer(context, builder, signature.args[0], *values), lanes)

    return lanes(array, types.intp), code


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write lanes from `array[index]` on."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        _store(builder, values[2], _pointer(context, builder, signature.args[0], *values[:2]), value)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), code


@intrinsic
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Have the cache fetch the line of `array[index]`, which is read soon. Changes nothing else."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = builder.bitcast(_pointer(context, builder, signature.args[0], *values), cgutils.voidptr_t)
        number = ir.IntType(32)
        function = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number]),
            "llvm.prefetch.p0",
        )
        builder.call(function, [place, *(ir.Constant(number, value) for value in (0, 3, 1))])  # to read, keep, data
        return context.get_dummy_value()

    return types.void(array, types.intp), code


@intrinsic
def every(typing: Any, like: Any, number: Any) -> Any:
    """`number` in every lane; `like`: lanes or an array of the type wanted."""
    lanes = like if isinstance(like, Lanes) else _LANES[like.dtype]

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _vector(context.cast(builder, values[1], signature.args[1], lanes.dtype), lanes, builder)

    return lanes(like, number), code


@intrinsic
def width(typing: Any, array: Any) -> Any:
    """How many numbers of an array are lanes."""
    count = _LANES[array.dtype].count

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return context.get_constant(types.intp, count)

    return types.intp(array), code


# ---- arithmetic ----


def _operation(name: str, function: Any) -> None:
    class _Template(ConcreteTemplate):  # type: ignore[misc]
        cases = [signature(lanes, lanes, lanes) for lanes in _LANES.values()]  # noqa: RUF012

    infer_global(function)(_Template)
    for lanes in _LANES.values():

        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return getattr(builder, name)(*values)

        lower_builtin(function, lanes, lanes)(code)


for _name, _function in {
    "fadd": operator.add, "fsub": operator.sub, "fmul": operator.mul, "fdiv": operator.truediv,
}.items():  # fmt: skip
    _operation(_name, _function)


@intrinsic
def fma(typing: Any, first: Any, second: Any, third: Any) -> Any:
    """`first * second + third`, rounded once."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _call(builder, "fma", *values)

    return first(first, first, first), code


@intrinsic
def root(typing: Any, value: Any) -> Any:
    """Square roots."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return _call(builder, "sqrt", *values)

    return value(value), code


def polynomial(coefficients: tuple[float, ...]) -> Any:
    """The intrinsic `x -> sum_k coefficients[k] x^k`, by Horner's rule."""

    def typed(typing: Any, x: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            def each(number: float) -> Any:
                return _vector(context.get_constant(x.dtype, number), x, builder)

            found = each(coefficients[-1])
            for coefficient in coefficients[-2::-1]:
                found = _call(builder, "fma", found, values[0], each(coefficient))
            return found

        return x(x), code

    return intrinsic(typed)


def _choice(comparison: str) -> Any:
    def choose(typing: Any, left: Any, right: Any, then: Any, otherwise: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return builder.select(builder.fcmp_ordered(comparison, *values[:2]), *values[2:])

        return left(left, left, left, left), code

    return intrinsic(choose)


where_greater = _choice(">")
"""`then` where `left > right`, otherwise (also where one is no number) `otherwise`."""
where_equal = _choice("==")
"""The same of `left == right`."""


@intrinsic
def total(typing: Any, value: Any) -> Any:
    """The sum of all lanes: halves are added, then halves of that."""
    count, element = value.count, value.dtype

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        found, size = values[0], count
        while size > 1:
            size //= 2
            halves = [
                builder.shuffle_vector(
                    found, found, ir.Constant(ir.VectorType(ir.IntType(32), size), list(range(first, first + size)))
                )
                for first in (0, size)
            ]
            found = builder.fadd(*halves)
        return builder.extract_element(found, ir.Constant(ir.IntType(32), 0))

    return element(value), code


# ---- bits of numbers ----


def _integers(lanes: Lanes) -> tuple[ir.Type, int, int]:
    """Of the same size: their type, the bits of a mantissa, and the exponent of 1."""
    bits, mantissa, bias = (32, 23, 127) if lanes.dtype == types.float32 else (64, 52, 1023)
    return ir.VectorType(ir.IntType(bits), lanes.count), mantissa, bias


@intrinsic
def scaled(typing: Any, value: Any, shifted: Any) -> Any:
    """`value` times two to the power that the last bits of `shifted` are; the product must be a normal number."""
    kind, mantissa, _ = _integers(value)

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        power = builder.shl(builder.bitcast(values[1], kind), ir.Constant(kind, [mantissa] * value.count))
        return builder.bitcast(builder.add(builder.bitcast(values[0], kind), power), values[0].type)

    return value(value, value), code


@intrinsic
def mantissa(typing: Any, value: Any) -> Any:
    """Of positive normal numbers, the m in [1, 2) of m * 2^e."""
    kind, size, bias = _integers(value)

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        low = builder.and_(builder.bitcast(values[0], kind), ir.Constant(kind, [(1 << size) - 1] * value.count))
        return builder.bitcast(builder.or_(low, ir.Constant(kind, [bias << size] * value.count)), values[0].type)

    return value(value), code


@intrinsic
def exponent(typing: Any, value: Any) -> Any:
    """Of positive normal numbers, the e of m * 2^e, as a number."""
    kind, size, bias = _integers(value)

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        high = builder.lshr(builder.bitcast(values[0], kind), ir.Constant(kind, [size] * value.count))
        return builder.sitofp(builder.sub(high, ir.Constant(kind, [bias] * value.count)), values[0].type)

    return value(value), code


# ---- blocks ----


def product(rows: int, panels: int) -> Any:
    """The innermost loop of every matrix product, for so many rows by so many panels of results.

    The intrinsic made computes, within one array m, for rows r and panels p, where [:] are L lanes,

        m[c + r L + p c_panel][:] = m[start + r start_row + p start_panel][:]
                                    + sum_t m[a + r a_row + t a_step + (t // span) a_jump] * m[b + t L + p b_panel][:]

    Every sum is a chain of fused multiply-adds with t ascending from 0 to `count`, whatever rows and panels are.
    """

    def typed(
        typing: Any, m: Any, c: Any, c_panel: Any, start: Any, start_row: Any, start_panel: Any,
        a: Any, a_row: Any, a_step: Any, a_jump: Any, span: Any, b: Any, b_panel: Any, count: Any,
    ) -> Any:  # fmt: skip
        lanes = _LANES[m.dtype]

        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            (m, c, c_panel, start, start_row, start_panel, a, a_row, a_step, a_jump, span, b, b_panel, count) = values

            def number(value: int) -> ir.Constant:
                return ir.Constant(c.type, value)

            def place(at: Any) -> Any:
                return _pointer(context, builder, signature.args[0], m, at)

            def places(first: Any, row: Any, panel: Any) -> list[list[Any]]:
                tops = [builder.gep(place(first), [builder.mul(panel, number(p))]) for p in range(panels)]
                return [[builder.gep(top, [builder.mul(row, number(r))]) for top in tops] for r in range(rows)]

            sums = [
                [_variable(builder, _load(builder, pointer, lanes)) for pointer in row]
                for row in places(start, start_row, start_panel)
            ]
            a_rows = [builder.gep(place(a), [builder.mul(a_row, number(r))]) for r in range(rows)]
            spans = builder.sdiv(builder.add(count, builder.sub(span, number(1))), span)
            with cgutils.for_range(builder, spans) as outer:
                first = builder.mul(outer.index, span)
                left = builder.sub(count, first)
                steps = builder.select(builder.icmp_signed("<", left, span), left, span)
                ahead = builder.add(builder.mul(outer.index, a_jump), builder.mul(first, a_step))
                a_here = [builder.gep(one, [ahead]) for one in a_rows]
                b_here = places(builder.add(b, builder.mul(first, number(lanes.count))), number(0), b_panel)[0]
                with cgutils.for_range(builder, steps) as inner:
                    down, along = builder.mul(inner.index, number(lanes.count)), builder.mul(inner.index, a_step)
                    b_now = [_load(builder, builder.gep(pointer, [down]), lanes) for pointer in b_here]
                    for r in range(rows):
                        a_now = _vector(builder.load(builder.gep(a_here[r], [along])), lanes, builder)
                        for p in range(panels):
                            longer = _call(builder, "fma", a_now, b_now[p], builder.load(sums[r][p]))
                            builder.store(longer, sums[r][p])
            for row, ends in zip(sums, places(c, number(lanes.count), c_panel), strict=True):
                for value, pointer in zip(row, ends, strict=True):
                    _store(builder, builder.load(value), pointer, lanes)
            return context.get_dummy_value()

        return types.void(m, *[types.intp] * 13), code

    return intrinsic(typed)


def _variable(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Something that changes in a loop; LLVM keeps it in a register."""
    pointer = cgutils.alloca_once(builder, value.type)
    builder.store(value, pointer)
    return pointer


@intrinsic
def transpose(typing: Any, m: Any, source: Any, target: Any) -> Any:
    """The L x L numbers from `m[source]` on, rows and columns exchanged, from `m[target]` on."""
    lanes = _LANES[m.dtype]

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        def row(at: Any, r: int) -> Any:
            pointer = _pointer(context, builder, signature.args[0], values[0], at)
            return builder.gep(pointer, [ir.Constant(at.type, r * lanes.count)])

        found = [_load(builder, row(values[1], r), lanes) for r in range(lanes.count)]
        size = 1
        while size < lanes.count:
            # Pairs of rows `size` apart exchange what lies off the diagonal of their 2 x 2 blocks of that size.
            order = [
                [lane + shift if lane & size == there else lane + other for lane in range(lanes.count)]
                for there, shift, other in ((0, 0, lanes.count - size), (size, lanes.count, size))
            ]
            masks = [ir.Constant(ir.VectorType(ir.IntType(32), lanes.count), mask) for mask in order]
            for r in range(lanes.count):
                if not r & size:
                    pair = found[r], found[r + size]
                    found[r], found[r + size] = (builder.shuffle_vector(*pair, mask) for mask in masks)
            size *= 2
        for r, value in enumerate(found):
            _store(builder, value, row(values[2], r), lanes)
        return context.get_dummy_value()

    return types.void(m, types.intp, types.intp), code
