"""Tools of compiled code: kernels, arrays by address, calls of generated functions, and small dense linear algebra.

A view of memory owns nothing, so that using it costs nothing: whoever hands out an address keeps the array alive behind
it for as long as it is used.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import llvmlite.ir as ir
from numba import from_dtype, njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from hvdc_ident.simulate.codegen import ARGUMENTS
from hvdc_ident.simulate.run_state import RUN

kernel = partial(njit, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Decorator of a function that only compiled code calls."""

# --- memory ---


def _view(context: Any, builder: Any, kind: Any, address: Any, shape: list[Any]) -> Any:
    array = context.make_array(kind)(context, builder)
    width = context.get_constant(types.intp, 8)
    strides = [builder.mul(width, shape[1]), width] if len(shape) == 2 else [width]
    data = builder.inttoptr(address, array.data.type)
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=width, meminfo=None)
    return array._getvalue()


def _viewer(kind: Any) -> Any:
    """Return the function of compiled code that views an address as an array of a kind, of a length."""

    @intrinsic
    def view(typing_context: Any, address: Any, count: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return _view(context, builder, kind, arguments[0], [arguments[1]])

        return kind(types.intp, types.intp), code

    return view


vector, indices = (_viewer(types.Array(t, 1, "C")) for t in (types.float64, types.int64))
_TABLE = types.Array(types.float64, 2, "C")


@intrinsic
def table(typing_context: Any, address: Any, rows: Any, columns: Any) -> Any:
    """Doubles at an address, (rows, columns)."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _view(context, builder, _TABLE, arguments[0], [arguments[1], arguments[2]])

    return _TABLE(types.intp, types.intp, types.intp), code


@intrinsic
def address_of(typing_context: Any, array: Any) -> Any:
    """Address of a contiguous array's first element."""
    if not (isinstance(array, types.Array) and array.layout == "C"):
        return None

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.ptrtoint(data, cgutils.intp_t)

    return types.intp(array), code


_RUN = from_dtype(RUN)


@intrinsic
def record(typing_context: Any, address: Any) -> Any:
    """The run's record at an address."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(_RUN))

    return _RUN(types.intp), code


# --- arguments of what Python calls: a tuple of contiguous arrays of doubles or 64-bit integers, as an address ---

# A tuple's items come after its head. An array's head is Python's; then come the address of its data, the number of its
# dimensions and the address of its lengths: NumPy's headers compile these places into every extension module.
_ITEMS = tuple.__basicsize__
_DATA = object.__basicsize__
_LENGTHS = _DATA + 16


@kernel()
def address(a, k):  # type: ignore[no-untyped-def]
    """Address of the data of argument k."""
    return indices(indices(a + _ITEMS, k + 1)[k] + _DATA, 1)[0]


@kernel()
def length(a, k, dimension):  # type: ignore[no-untyped-def]
    """Number of elements of argument k along a dimension."""
    return indices(indices(indices(a + _ITEMS, k + 1)[k] + _LENGTHS, 1)[0], 2)[dimension]


@kernel()
def numbers(a, k):  # type: ignore[no-untyped-def]
    """Argument k, a vector of doubles."""
    return vector(address(a, k), length(a, k, 0))


@kernel()
def integers(a, k):  # type: ignore[no-untyped-def]
    """Argument k, a vector of integers."""
    return indices(address(a, k), length(a, k, 0))


@kernel()
def matrix_of(a, k):  # type: ignore[no-untyped-def]
    """Argument k, a matrix of doubles."""
    return table(address(a, k), length(a, k, 0), length(a, k, 1))


# --- calls ---


def _is_memory(kind: Any) -> bool:
    return isinstance(kind, types.Integer) or (isinstance(kind, types.Array) and kind.dtype == types.float64)


@intrinsic
def call(typing_context: Any, address: Any, y: Any, yd: Any, w: Any, wd: Any, p: Any, m: Any, out: Any) -> Any:
    """Call `void f(y, yd, w, wd, p, m, out)`, pointers to doubles, at an address known only at run time.

    The arguments are arrays of doubles or addresses; only data pointers are passed, without touching reference counts.
    """
    arguments = (y, yd, w, wd, p, m, out)
    if not all(_is_memory(a) for a in arguments):
        return None
    signature = types.void(types.intp, *arguments)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.DoubleType().as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * len(ARGUMENTS)).as_pointer()
        data = [
            context.make_array(t)(context, builder, a).data
            if isinstance(t, types.Array)
            else builder.inttoptr(a, pointer)
            for t, a in zip(signature.args[1:], arguments[1:], strict=True)
        ]
        builder.call(builder.inttoptr(arguments[0], kind), data)
        return context.get_dummy_value()

    return signature, code


# --- linear algebra ---


@kernel(fastmath={"contract"})
def lu(a, pivots):  # type: ignore[no-untyped-def]
    """Factor a (n, n) in place; pivots (n,) are the row exchanges. False where it is singular."""
    n = a.shape[0]
    for k in range(n):
        best, row = abs(a[k, k]), k
        for i in range(k + 1, n):
            if abs(a[i, k]) > best:
                best, row = abs(a[i, k]), i
        pivots[k] = row
        if not best > 0.0:
            return False
        if row != k:
            for j in range(n):
                a[k, j], a[row, j] = a[row, j], a[k, j]
        inverse = 1.0 / a[k, k]
        a[k, k] = inverse
        for i in range(k + 1, n):
            if a[i, k] != 0.0:
                factor = a[i, k] * inverse
                a[i, k] = factor
                for j in range(k + 1, n):
                    a[i, j] -= factor * a[k, j]
    return True


@kernel()
def orientation(a, pivots):  # type: ignore[no-untyped-def]
    """Sign of the determinant, from the factors of `lu`."""
    sign = 1.0
    for k in range(a.shape[0]):
        if (a[k, k] < 0.0) != (pivots[k] != k):
            sign = -sign
    return sign


@kernel(fastmath={"contract"})
def solve(a, pivots, b):  # type: ignore[no-untyped-def]
    """Solve in place for b (n,) with the factors of `lu`, which store the diagonal's inverse."""
    n = a.shape[0]
    for k in range(n):
        row = pivots[k]
        if row != k:
            b[k], b[row] = b[row], b[k]
    for i in range(1, n):
        total = b[i]
        for j in range(i):
            total -= a[i, j] * b[j]
        b[i] = total
    for i in range(n - 1, -1, -1):
        total = b[i]
        for j in range(i + 1, n):
            total -= a[i, j] * b[j]
        b[i] = total * a[i, i]


@kernel(fastmath={"contract"})
def solve_rows(a, pivots, b):  # type: ignore[no-untyped-def]
    """Solve in place for b (n, k): k right-hand sides side by side, so that the inner loop runs along memory."""
    n, width = b.shape
    for k in range(n):
        row = pivots[k]
        if row != k:
            for c in range(width):
                b[k, c], b[row, c] = b[row, c], b[k, c]
    for i in range(1, n):
        for j in range(i):
            factor = a[i, j]
            if factor != 0.0:
                for c in range(width):
                    b[i, c] -= factor * b[j, c]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = a[i, j]
            if factor != 0.0:
                for c in range(width):
                    b[i, c] -= factor * b[j, c]
        inverse = a[i, i]
        for c in range(width):
            b[i, c] *= inverse
