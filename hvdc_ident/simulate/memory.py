"""Addresses as arrays and arrays as addresses, in compiled code: views that own nothing, so that using them costs nothing.

Whoever hands out an address keeps the array alive behind it for as long as it is used.
"""

from __future__ import annotations

from typing import Any

from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from hvdc_ident.simulate.state import RUN

_RUN = from_dtype(RUN)
_VECTOR = types.Array(types.float64, 1, "C")
_TABLE = types.Array(types.float64, 2, "C")
_INDICES = types.Array(types.int64, 1, "C")


def _view(context: Any, builder: Any, kind: Any, address: Any, shape: list[Any]) -> Any:
    array = context.make_array(kind)(context, builder)
    width = context.get_constant(types.intp, 8)
    strides = [builder.mul(width, shape[1]), width] if len(shape) == 2 else [width]
    data = builder.inttoptr(address, array.data.type)
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=width, meminfo=None)
    return array._getvalue()


@intrinsic
def address_of(typing_context: Any, array: Any) -> Any:
    """The address of a contiguous array's first element."""
    if not (isinstance(array, types.Array) and array.layout == "C"):
        return None

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.ptrtoint(data, cgutils.intp_t)

    return types.intp(array), code


@intrinsic
def vector(typing_context: Any, address: Any, count: Any) -> Any:
    """The `count` doubles at an address."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _view(context, builder, _VECTOR, arguments[0], [arguments[1]])

    return _VECTOR(types.intp, types.intp), code


@intrinsic
def indices(typing_context: Any, address: Any, count: Any) -> Any:
    """The `count` integers at an address."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _view(context, builder, _INDICES, arguments[0], [arguments[1]])

    return _INDICES(types.intp, types.intp), code


@intrinsic
def table(typing_context: Any, address: Any, rows: Any, columns: Any) -> Any:
    """The doubles at an address as (rows, columns)."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _view(context, builder, _TABLE, arguments[0], [arguments[1], arguments[2]])

    return _TABLE(types.intp, types.intp, types.intp), code


@intrinsic
def record(typing_context: Any, address: Any) -> Any:
    """The run's record at an address."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(_RUN))

    return _RUN(types.intp), code
