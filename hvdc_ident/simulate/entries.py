"""The integrators as C functions: kept as object code, they can be called without the compiler that made them.

Their arguments are NumPy arrays as Python holds them, contiguous and of the right type: that is for the caller to see to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import cfunc, int64, types

from hvdc_ident.simulate import driver
from hvdc_ident.simulate import rest as start
from hvdc_ident.simulate.kernel import kernel
from hvdc_ident.simulate.memory import indices, table, vector

# An array's object: Python's head, the address of its data, the number of its dimensions, the address of its lengths.
# NumPy's headers compile these places into every extension module, so they cannot move.
_DATA = object.__basicsize__
_LENGTHS = _DATA + 16

# As parts of the functions below: with entries from Python of their own they would take seconds more to compile.
_part = kernel(inline="always")
_rest, _room, _integrate = (_part(f.py_func) for f in (start.rest, driver.room, driver.integrate))


@_part
def _data(a):  # type: ignore[no-untyped-def]
    return indices(a + _DATA, 1)[0]


@_part
def _length(a, dimension):  # type: ignore[no-untyped-def]
    return indices(indices(a + _LENGTHS, 1)[0], 2)[dimension]


@_part
def _numbers(a):  # type: ignore[no-untyped-def]
    return vector(_data(a), _length(a, 0))


@_part
def _integers(a):  # type: ignore[no-untyped-def]
    return indices(_data(a), _length(a, 0))


@_part
def _matrix(a):  # type: ignore[no-untyped-def]
    return table(_data(a), _length(a, 0), _length(a, 1))


def rest(address, dims, p, y, w, wd, m, jac, worst, rule):  # type: ignore[no-untyped-def]
    """A status of `rest.rest`, and 1; 0 where there was no memory."""
    return 1 + _rest(
        _integers(address), _integers(dims), _numbers(p), _numbers(y), _numbers(w), _numbers(wd), _numbers(m),
        _matrix(jac), _numbers(worst), _numbers(rule),
    )  # fmt: skip


def room(state):  # type: ignore[no-untyped-def]
    """Number of doubles of workspace that a run of a state takes."""
    return _room(_integers(state))


# fmt: off
def integrate(  # type: ignore[no-untyped-def]
    state, work, span, tolerance, max_steps, y, w, p, constants, breaks, pointer, times, values, t_out, out, scale,
    hess_row, hess_column,
):
    # fmt: on
    """A status of `driver.integrate`, and 1; 0 where there was no memory. On return span[0] is the time reached."""
    ends, allowed = _numbers(span), _numbers(tolerance)
    status, reached = _integrate(
        _integers(state), _numbers(work), (ends[0], ends[1]), (allowed[0], allowed[1]), max_steps, _numbers(y),
        _numbers(w), _numbers(p), _numbers(constants), _numbers(breaks), _integers(pointer), _numbers(times),
        _numbers(values), _numbers(t_out), _matrix(out), _numbers(scale), _integers(hess_row), _integers(hess_column),
    )  # fmt: skip
    ends[0] = reached
    return 1 + status


def text(function: Callable[..., Any], symbol: str) -> str:
    """LLVM IR that defines the symbol as a function of this file. Compiles the integrators."""
    arguments = [int64] * function.__code__.co_argcount  # of an array, the address of its object
    made = cfunc(types.int64(*arguments), error_model="numpy")(function)
    return str(made.inspect_llvm()).replace(made.native_name, symbol)
