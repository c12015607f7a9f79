"""Loops over vectors of doubles, four at a time, for compiled code.

A loop over several vectors at once is limited by how often each is read, and a compiler that cannot know that they do
not overlap checks it at every call. Here the loop is written once for all, from one Python function over `Lanes`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

WIDTH = 4
_DOUBLE = ir.DoubleType()
_LANES = ir.VectorType(_DOUBLE, WIDTH)
_FUSED = ("contract",)


class Lanes:
    """Four doubles in the loop being written; arithmetic writes instructions."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _other(self, other: Any) -> Any:
        return other.value if isinstance(other, Lanes) else ir.Constant(_LANES, [float(other)] * WIDTH)

    def __add__(self, other: Any) -> Lanes:
        return Lanes(self.builder, self.builder.fadd(self.value, self._other(other), flags=_FUSED))

    def __sub__(self, other: Any) -> Lanes:
        return Lanes(self.builder, self.builder.fsub(self.value, self._other(other), flags=_FUSED))

    def __mul__(self, other: Any) -> Lanes:
        return Lanes(self.builder, self.builder.fmul(self.value, self._other(other), flags=_FUSED))

    def __truediv__(self, other: Any) -> Lanes:
        return Lanes(self.builder, self.builder.fdiv(self.value, self._other(other)))

    def __abs__(self) -> Lanes:
        kind = ir.FunctionType(_LANES, [_LANES])
        absolute = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.fabs.v{WIDTH}f64")
        return Lanes(self.builder, self.builder.call(absolute, [self.value]))

    def larger(self, other: Lanes) -> Lanes:
        """The larger of two; `other` where one is no number."""
        more = self.builder.fcmp_ordered(">", self.value, other.value)
        return Lanes(self.builder, self.builder.select(more, self.value, other.value))


def weighted(weights: Any, terms: Any) -> Lanes:
    """The sum of the terms with a weight other than 0."""
    total = None
    for weight, term in zip(weights, terms, strict=True):
        if weight != 0.0:
            total = term * weight if total is None else total + term * weight
    assert total is not None
    return total


def _load(builder: Any, address: Any, offset: Any) -> Lanes:
    place = builder.inttoptr(builder.add(address, offset), _LANES.as_pointer())
    return Lanes(builder, builder.load(place, align=8))


def _store(builder: Any, lanes: Lanes, address: Any, offset: Any) -> None:
    builder.store(lanes.value, builder.inttoptr(builder.add(address, offset), _LANES.as_pointer()), align=8)


def _splat(builder: Any, scalar: Any) -> Lanes:
    one = builder.insert_element(ir.Constant(_LANES, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return Lanes(builder, builder.shuffle_vector(one, ir.Constant(_LANES, ir.Undefined), mask))


def elementwise(body: Callable[..., tuple[Lanes, ...]]) -> Any:
    """A function of compiled code, `f(count, inputs, outputs, scalars)`, that stores `body(*inputs, *scalars)`, element by element.

    count: a multiple of four. inputs, outputs: tuples of addresses; an output may be one of the inputs, but must not
    overlap one otherwise. scalars: a tuple of doubles.
    """

    @intrinsic
    def loop(typing_context: Any, count: Any, inputs: Any, outputs: Any, scalars: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            end = builder.mul(arguments[0], ir.Constant(cgutils.intp_t, 8))
            sources, targets, numbers = (cgutils.unpack_tuple(builder, a) for a in arguments[1:])
            splats = [_splat(builder, s) for s in numbers]
            step = ir.Constant(cgutils.intp_t, 8 * WIDTH)
            with cgutils.for_range_slice(builder, ir.Constant(cgutils.intp_t, 0), end, step, cgutils.intp_t) as (at, _):
                results = body(*(_load(builder, s, at) for s in sources), *splats)
                for value, target in zip(results, targets, strict=True):
                    _store(builder, value, target, at)
            return context.get_dummy_value()

        return types.void(types.intp, inputs, outputs, scalars), code

    return loop


@intrinsic
def column_sums(
    typing_context: Any, rows: Any, width: Any, e: Any, y: Any, yn: Any, floors: Any, rtol: Any, sums: Any
) -> Any:
    """For tables (rows, width) at e, y, yn: writes sum_i (e / (floor + rtol max(|y|, |yn|)))^2 of each column to `sums`.

    width: a multiple of four; floors: one a column.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows, width, e, y, yn, floors, rtol, sums = arguments
        eight, zero = ir.Constant(cgutils.intp_t, 8), ir.Constant(cgutils.intp_t, 0)
        line = builder.mul(width, eight)
        step, end = ir.Constant(cgutils.intp_t, 8 * WIDTH), builder.mul(line, rows)
        slope = _splat(builder, rtol)
        total = cgutils.alloca_once(builder, _LANES)
        with cgutils.for_range_slice(builder, zero, line, step, cgutils.intp_t) as (column, _):
            builder.store(ir.Constant(_LANES, [0.0] * WIDTH), total)
            floor = _load(builder, floors, column)
            with cgutils.for_range_slice(builder, column, end, line, cgutils.intp_t) as (at, _):
                size = abs(_load(builder, y, at)).larger(abs(_load(builder, yn, at)))
                share = _load(builder, e, at) / (floor + slope * size)
                builder.store((Lanes(builder, builder.load(total)) + share * share).value, total)
            _store(builder, Lanes(builder, builder.load(total)), sums, column)
        return context.get_dummy_value()

    integers = [types.intp] * 6
    return types.void(*integers, types.float64, types.intp), code
