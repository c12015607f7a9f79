"""Calling a generated function from compiled code by its address."""

from __future__ import annotations

from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.extending import intrinsic

from hvdc_ident.simulate.machine import ARGUMENTS


def _is_memory(kind: Any) -> bool:
    return isinstance(kind, types.Integer) or (isinstance(kind, types.Array) and kind.dtype == types.float64)


@intrinsic
def call(typing_context: Any, address: Any, y: Any, yd: Any, w: Any, wd: Any, p: Any, m: Any, out: Any) -> Any:
    """Calls `void f(y, yd, w, wd, p, m, out)`, pointers to doubles, at an address known only at run time.

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
