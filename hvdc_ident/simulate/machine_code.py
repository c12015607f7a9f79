"""Machine code of a model's functions, compiled by LLVM when a structure is first used in a process."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import cache

import llvmlite.binding as llvm
import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.simulate.codegen import Function, declarations, function_text
from hvdc_ident.simulate.graph import Graph

WELL, QUICK = 2, 0
"""LLVM's efforts."""


@cache
def _target() -> llvm.Target:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple()


@cache
def _processor() -> tuple[str, str]:
    """Return the processor's name, and what it can do."""
    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def _machine(effort: int) -> llvm.TargetMachine:
    cpu, features = _processor()
    return _target().create_target_machine(opt=effort, cpu=cpu, features=features)


@cache
def _simplifier() -> tuple[llvm.ModulePassManager, llvm.PassBuilder]:
    """The pass that simplifies instructions. One for the process: LLVM keeps 10 KiB of each that is made, for ever.

    The ready-made pipelines would keep 60 KiB of every module besides.
    """
    passes = llvm.create_new_module_pass_manager()
    passes.add_instruction_combine_pass()
    return passes, llvm.create_pass_builder(_machine(WELL), llvm.create_pipeline_tuning_options(speed_level=WELL))


def _compiled(text: str, well: bool) -> llvm.ExecutionEngine:
    """Return the engine of a module of LLVM IR, compiled well or quickly: in half the time, for code that runs a few times.

    The graph is free of common parts and its rows are vectors already: little is left for the optimiser.
    """
    effort = WELL if well else QUICK
    module = llvm.parse_assembly(text, llvm.create_context())
    module.verify()
    module.triple = llvm.get_default_triple()
    if well:
        passes, builder = _simplifier()
        passes.run(module, builder)
    code = bytes(_machine(effort).emit_object(module))
    # An engine keeps its module: with an empty one it takes 0.7 MB, a fifth of what it takes with the text's.
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly("", llvm.create_context()), _machine(QUICK))
    engine.set_object_cache(getbuffer_func=lambda _: code)
    engine.finalize_object()
    engine.set_object_cache()  # it has read the code
    return engine


class Code:
    """Compiled functions of one module: `address[name]`. The code lives as long as this object."""

    def __init__(
        self,
        graph: Graph,
        functions: Sequence[Function],
        width: int,
        written: Mapping[str, Callable[[str], str]] | None = None,
        *,
        brief: bool = False,
    ) -> None:
        """written: further hot functions as text, by name; each is called with the symbol it has to define. brief: whether all are
        compiled quickly."""
        self._engines: list[llvm.ExecutionEngine] = []
        self.address: dict[str, int] = {}
        # Where all are compiled alike they are one module: each takes a millisecond besides.
        for hot in (True,) if brief else (True, False):
            own = [f for f in functions if brief or f.hot == hot]
            texts = {f.name: function_text(graph, f, _symbol(f.name), width) for f in own}
            if hot:
                texts |= {n: text(_symbol(n)) for n, text in (written or {}).items()}
            if texts:
                engine = _compiled("\n".join([*declarations(), *texts.values()]), hot and not brief)
                self._engines.append(engine)
                self.address |= {n: engine.get_function_address(_symbol(n)) for n in texts}
        # Freed with this object, but not at the end of the process, when LLVM may be gone before it.
        weakref.finalize(self, _close, self._engines).atexit = False


def _close(engines: list[llvm.ExecutionEngine]) -> None:
    for engine in engines:
        engine.close()


def _symbol(name: str) -> str:
    return f"hvdcident_{name}"


_GENERATED = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 7)


def evaluate(address: int, y: Array, w: Array, p: Array, m: Array, out: Array) -> None:
    """Call one generated function from Python."""
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (y, y, w, np.zeros_like(w), p, m)]
    _GENERATED(int(address))(*(a.ctypes.data for a in arrays), out.ctypes.data)
