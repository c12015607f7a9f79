"""The integrators in this process: loaded as object code, compiled where this installation has not compiled them as they are."""

from __future__ import annotations

import ctypes
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import llvmlite.binding as llvm

from hvdc_ident.simulate.objects import compiled, kept, loaded
from hvdc_ident.simulate.structure import NAMES

ARGUMENTS = {"rest": 10, "room": 1, "integrate": 18}
MAX_STEPS = 4  # the one argument of `integrate` that is no array


@dataclass(frozen=True)
class Integrators:
    """Functions of `entries`, to be called from Python; arguments as stated there."""

    rest: Callable[..., int]
    room: Callable[..., int]
    integrate: Callable[..., int]
    engines: tuple[llvm.ExecutionEngine, ...]  # what holds the code in memory


@cache
def integrators() -> Integrators:
    """The integrators; from the first call on they stay."""
    found = {name: entry(name) for name in ARGUMENTS}
    return Integrators(**{name: call for name, (call, _) in found.items()}, engines=tuple(e for _, e in found.values()))


@cache
def entry(name: str) -> tuple[Callable[..., int], llvm.ExecutionEngine]:
    """One of the functions of `entries`, to be called from Python, and what holds its code in memory."""
    import numba

    from hvdc_ident.simulate.kernel import stamp

    _prepare_runtime()
    facts = f"{stamp(NAMES)} {numba.__version__} {platform.python_version()}"
    engine = loaded(kept(f"{name} {facts}", lambda: _made(name)))
    kinds = [
        ctypes.c_int64 if k == MAX_STEPS and name == "integrate" else ctypes.py_object for k in range(ARGUMENTS[name])
    ]
    prototype = ctypes.PYFUNCTYPE(ctypes.c_int64, *kinds)
    return prototype(engine.get_function_address(_symbol(name))), engine


def _symbol(name: str) -> str:
    return f"hvdcident_{name}"


def _prepare_runtime() -> None:
    """Make the functions of numba's runtime that compiled code calls (memory, errors) known by their names."""
    from numba.core.registry import cpu_target
    from numba.core.runtime import rtsys

    rtsys.initialize(cpu_target.target_context)


def _made(name: str) -> bytes:
    _announce()
    from hvdc_ident.simulate import entries

    return compiled(entries.text(getattr(entries, name), _symbol(name)), effort=3)


@cache
def _announce() -> None:
    print(
        "hvdc_ident: compiling the integrators, once for this installation (about half a minute) ...",
        file=sys.stderr,
        flush=True,
    )
