"""Object code kept on disk: what was compiled once for a processor is loaded from then on, also by other processes.

A file's name is the digest of everything its content depends on (the text that was compiled, how, by which compiler,
for which processor), so that a file is never out of date: what has changed goes by another name. The content begins
with its own digest; what is damaged is compiled anew. A folder that cannot be written to costs time, nothing else.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import uuid
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.simulate.codegen import Function, declarations, function_text
from hvdc_ident.simulate.graph import Graph

ROOM = 128 * 2**20  # bytes kept in a folder; beyond, the half that was not used for the longest time goes
LOOK = 64  # writes between two looks at what a folder holds: to list thousands of files takes longer than to make one
_PREFIX, _DIGEST = "code-", hashlib.sha256().digest_size


def folders() -> Iterator[Path]:
    """Folders for object code, best first: where HVDC_IDENT_CACHE says; else beside the sources, then with the user's caches."""
    given = os.environ.get("HVDC_IDENT_CACHE")
    if given:
        yield Path(given)
        return
    yield Path(__file__).parent / "__pycache__"
    with contextlib.suppress(RuntimeError):  # a user without a home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hvdc_ident"


def kept(facts: str, make: Callable[[], bytes]) -> bytes:
    """The object code that the facts determine: from disk where it is there and whole, else made and kept."""
    name = _PREFIX + hashlib.sha256("\0".join((*_surroundings(), facts)).encode()).hexdigest()
    for folder in folders():
        found = _read(folder / name)
        if found is not None:
            return found
    code = make()
    for folder in folders():
        if _write(folder / name, code):
            break
    return code


def _read(path: Path) -> bytes | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if content[:_DIGEST] != _seal(path.name, content[_DIGEST:]):
        return None
    with contextlib.suppress(OSError):  # of a folder that may only be read, nothing is cleared either
        os.utime(path)
    return content[_DIGEST:]


def _write(path: Path, code: bytes) -> bool:
    """Write the file, whole or not at all; True where it is there now."""
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(_seal(path.name, code) + code)
        part.replace(path)
        if int(path.name[-8:], 16) % LOOK == 0:  # the digest is the dice: every process has the same and none counts
            _clear(path.parent)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        return False
    return True


def _seal(name: str, code: bytes) -> bytes:
    return hashlib.sha256(name.encode() + code).digest()


def _clear(folder: Path) -> None:
    """Delete the oldest object code until the folder's takes no more than ROOM, parts that a killed process left included."""
    with os.scandir(folder) as entries:
        files = [(e.stat().st_mtime, e.stat().st_size, e.path) for e in entries if e.name.startswith(_PREFIX)]
    total = sum(size for _, size, _ in files)
    if total <= ROOM:
        return
    for _, size, path in sorted(files):
        Path(path).unlink(missing_ok=True)
        total -= size
        if total <= ROOM // 2:
            return


@cache
def _surroundings() -> tuple[str, ...]:
    """Versions that every object code depends on beside its own text: the compiler, the processor, and how this file uses them."""
    return (
        llvmlite.__version__,
        ".".join(map(str, llvm.llvm_version_info)),
        llvm.get_default_triple(),
        *_processor(),
        hashlib.sha256(Path(__file__).read_bytes()).hexdigest(),
    )


@cache
def _processor() -> tuple[str, str]:
    """The processor's name, and what it can do: to ask takes as long as to load what was compiled."""
    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


@cache
def _target() -> llvm.Target:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple()


def _machine(effort: int) -> llvm.TargetMachine:
    cpu, features = _processor()
    return _target().create_target_machine(opt=effort, cpu=cpu, features=features)


@cache
def _simplifier(effort: int) -> tuple[llvm.ModulePassManager, llvm.PassBuilder]:
    """The pass that simplifies instructions. One for the process: LLVM keeps 10 KiB of each that is made, for ever.

    The ready-made pipelines would keep 60 KiB of every module besides.
    """
    passes = llvm.create_new_module_pass_manager()
    passes.add_instruction_combine_pass()
    return passes, llvm.create_pass_builder(_machine(effort), llvm.create_pipeline_tuning_options(speed_level=effort))


def compiled(text: str, effort: int, combine: bool = False) -> bytes:
    """The object code of a module of LLVM IR. effort: 0 (quick) to 3; combine: simplify the instructions before."""
    machine = _machine(effort)
    module = llvm.parse_assembly(text, llvm.create_context())
    module.verify()
    module.triple = llvm.get_default_triple()
    if combine:
        passes, builder = _simplifier(effort)
        passes.run(module, builder)
    return bytes(machine.emit_object(module))


def loaded(code: bytes) -> llvm.ExecutionEngine:
    """The object code in executable memory, until the engine is closed; its functions by `get_function_address`."""
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly("", llvm.create_context()), _machine(0))
    engine.set_object_cache(getbuffer_func=lambda module: code)
    engine.finalize_object()
    engine.set_object_cache()  # it has read the code
    return engine


# --- the generated functions of a model ---


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
        for hot in (True, False):
            texts = {f.name: function_text(graph, f, _symbol(f.name), width) for f in functions if f.hot == hot}
            if hot:
                texts |= {n: text(_symbol(n)) for n, text in (written or {}).items()}
            if texts:
                engine = _loaded_module("\n".join([*declarations(), *texts.values()]), hot and not brief)
                self._engines.append(engine)
                self.address |= {n: engine.get_function_address(_symbol(n)) for n in texts}
        # Freed with this object, but not at the end of the process, when LLVM may be gone before it.
        weakref.finalize(self, _close, self._engines).atexit = False


def _close(engines: list[llvm.ExecutionEngine]) -> None:
    for engine in engines:
        engine.close()


def _symbol(name: str) -> str:
    return f"hvdcident_{name}"


def _loaded_module(text: str, well: bool) -> llvm.ExecutionEngine:
    """The engine of a module, compiled well or quickly; quickly where it is cold halves the time of a new structure."""
    # The graph is free of common parts and its rows are vectors already: little is left for the optimiser.
    return loaded(kept(f"{well}\0{text}", lambda: compiled(text, effort=2 if well else 0, combine=well)))


_GENERATED = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 7)


def evaluate(address: int, y: Array, w: Array, p: Array, m: Array, out: Array) -> None:
    """Call one generated function from Python."""
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (y, y, w, np.zeros_like(w), p, m)]
    _GENERATED(int(address))(*(a.ctypes.data for a in arrays), out.ctypes.data)
