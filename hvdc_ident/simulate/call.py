"""Calling a generated function from compiled code by its address."""

from __future__ import annotations

from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.extending import intrinsic

from hvdc_ident.simulate.machine import ARGUMENTS

_POINTERS = len(ARGUMENTS)


@intrinsic
def call(typing_context: Any, address: Any, y: Any, yd: Any, w: Any, wd: Any, p: Any, m: Any, out: Any) -> Any:
    """Calls `void f(y, yd, w, wd, p, m, out)`, pointers to doubles, at an address known only at run time."""
    signature = types.void(types.intp, *[types.CPointer(types.float64)] * _POINTERS)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.DoubleType().as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * _POINTERS).as_pointer()
        builder.call(builder.inttoptr(arguments[0], kind), arguments[1:])
        return context.get_dummy_value()

    return signature, code
