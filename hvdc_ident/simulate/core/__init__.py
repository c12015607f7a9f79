"""The integrators and the steady-state solvers in C: their records, and their functions by ctypes.

The library is built when the package is installed, for any processor and for those with AVX2. The layout of a run's record, the
statuses and shared numbers are read from `core.h`, where they stand once.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, cast

import llvmlite.binding as llvm
import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import InstallationError

if TYPE_CHECKING:
    from typing_extensions import Buffer

FOLDER = Path(__file__).parent
BUILDS = {"avx2": ("avx2", "fma"), "baseline": ()}
"""The builds of the library, best first, with the features of the processor that each needs."""
LIBRARY = "core-{build}.so.1"
REBUILD = (
    "`pip install --force-reinstall hvdc_ident`; in a checkout `python build_backend.py`, which needs a C compiler"
)
Record = NDArray[np.int64]


_HEADER = re.sub(r"/\*.*?\*/", "", (FOLDER / "core.h").read_text(), flags=re.DOTALL)
STATUSES = tuple(
    re.sub("[^A-Z_,]", "", re.findall(r"enum status \{(.*?)\}", _HEADER)[0]).lower().replace("_", "-").split(",")
)
"""Statuses with which a run ends, by their number."""
NUMBERS = {
    name: float.fromhex(value) if value.startswith("0x") else float(value)
    for name, value in re.findall(r"#define (\w+) (0x\S+|[0-9]\S*)", _HEADER)
}
"""Numbers that the core and its caller share, by name."""


def _fields(*lists: str) -> tuple[str, ...]:
    """Return the names that the header's lists of fields hold, in their order."""
    names: list[str] = []
    for name in lists:
        body = re.search(rf"#define {name}\(.*?\)((?:.*\\\n)*.*)", _HEADER)
        assert body is not None
        names += re.findall(r"\b[A-Z]+\((\w+)\)", body[1])
    return tuple(names)


HEAD_FIELDS = _fields("SIZES", "FUNCTIONS", "SECOND_DERIVATIVES")
"""Fields that one set of equations brings; first in a run's record."""
_STATED, _STATED_INSTANTS = _fields("GIVEN"), _fields("GIVEN_INSTANTS")
RUN_FIELDS = (
    *HEAD_FIELDS, *_STATED, *_STATED_INSTANTS, *_fields("VECTORS", "INDICES", "COUNTS", "FLAGS", "INSTANTS"),
)  # fmt: skip
"""Fields of a run's record, eight bytes each."""
PLACE = {name: k for k, name in enumerate(RUN_FIELDS)}
GIVEN = slice(len(HEAD_FIELDS), len(HEAD_FIELDS) + len(_STATED))
"""Where in the record stands what the caller states: addresses of p, constants, scale, t_out, out, breaks, pointer, times, values;
numbers of breaks and outputs, the most steps, whether the run may slide."""
GIVEN_INSTANTS = slice(GIVEN.stop, GIVEN.stop + len(_STATED_INSTANTS))
"""Then, as doubles, start, end and the tolerances, relative and absolute."""


def core_sources() -> dict[str, str]:
    """Return the core's files, {name: text}, for a program that includes `core.c`, which includes the others."""
    return {p.name: p.read_text("utf-8") for p in sorted(FOLDER.glob("*.[ch]")) if p.name != "all.c"}


@cache
def library() -> ctypes.CDLL:
    """Return the library that suits this processor. Raises InstallationError where it was not built."""
    features = llvm.get_host_cpu_features()
    for build, needed in BUILDS.items():
        path = FOLDER / LIBRARY.format(build=build)
        if path.exists() and all(features.get(f) for f in needed):
            core = ctypes.CDLL(str(path))
            core.hvdc_ident_room.restype = core.hvdc_ident_fields.restype = ctypes.c_int64
            if core.hvdc_ident_fields() != len(RUN_FIELDS):
                raise InstallationError(
                    "the installation is incomplete: the compiled core is of another version",
                    where=str(path),
                    hint=REBUILD,
                )
            core.hvdc_ident_judge.restype = core.hvdc_ident_repeat.restype = None
            return core
    raise InstallationError(
        "the installation is incomplete: the compiled core is not there",
        where=str(FOLDER),
        expected=LIBRARY.format(build="baseline"),
        hint=REBUILD,
    )


_NOTHING = ctypes.c_char * 0


def address(array: Array | Record) -> int:
    """Return the address of a writable array's data; a quarter of the time that `array.ctypes` takes."""
    return ctypes.addressof(_NOTHING.from_buffer(cast("Buffer", array)))


def _pointers(*arrays: Array | Record) -> list[ctypes.c_void_p]:
    return [ctypes.c_void_p(address(a)) for a in arrays]


def room(record: Record) -> int:
    """Return how many doubles of workspace a run takes, from a record that has its sizes."""
    return int(library().hvdc_ident_room(*_pointers(record)))


def integrate(record: Record, work: Array, y: Array, w: Array) -> str:
    """Run as `hvdc_ident_integrate` says, and return how it ended. Raises MemoryError."""
    status = STATUSES[library().hvdc_ident_integrate(*_pointers(record, work, y, w))]
    if status == "out-of-memory":
        raise MemoryError
    return status


def repeat(function: int, y: Array, w: Array, p: Array, m: Array, out: Array, count: int) -> None:
    """Call a generated function, by address, so many times: to measure what it costs."""
    library().hvdc_ident_repeat(ctypes.c_void_p(function), *_pointers(y, w, p, m, out), ctypes.c_int64(count))


class SteadyEquations:
    """The record of a model's steady-state equations and the vectors that stand in it.

    functions: addresses of modes, rest, rest_jac, rest_p. sizes: states, elements of y, elements of w before the unknowns in it,
    unknowns, width of a row over the parameters. y, w, wd, p, m: vectors, which the solvers read and write; p is a copy.
    """

    def __init__(
        self, functions: Sequence[int], sizes: Sequence[int], values: Sequence[float], p: Array, switches: int
    ) -> None:
        """values: what comes from outside, time first; the unknowns beyond it, and y, are 0."""
        _, inner, first, n, width = sizes
        lengths = (
            inner * (1 + width),
            first + (n - inner) * (1 + width),
            first + (n - inner) * (1 + width),
            p.size,
            switches,
        )
        ends = list(accumulate(lengths))
        block = np.zeros(ends[-1] + 1)  # never empty, so that it has an address
        self.y, self.w, self.wd, self.p, self.m = (block[e - k : e] for k, e in zip(lengths, ends, strict=True))
        self.w[:first], self.p[:] = values, p
        base = address(block)
        places = (base + 8 * (e - k) for k, e in zip(lengths, ends, strict=True))
        self.record = np.array([*functions, *sizes, switches, p.size, first, *places], dtype=np.int64)
        self.unknowns = n

    def newton(self, rule: Array) -> bool:
        """Return True where the steady state was found, as `hvdc_ident_newton` says. Raises MemoryError."""
        return self._called("newton", rule) > 0

    def continuation(self, ends_p: Array, ends_w: Array, v: Array, way: Array) -> None:
        """Move v along a path of values, as `hvdc_ident_continuation` says. Raises MemoryError."""
        self._called("continuation", ends_p, ends_w, v, way)

    def pseudo_transient(self, size: Array, v: Array) -> None:
        """Move v by implicit Euler steps that follow the model. size: the most that each unknown counts for. Raises MemoryError."""
        self._called("pseudo_transient", size, v)

    def implicit_euler(self, size: Array, v: Array) -> None:
        """Move v by implicit Euler steps that are solved each. size: the most that each unknown counts for. Raises MemoryError."""
        self._called("implicit_euler", size, v)

    def judged(self, size: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return the residual at v, (n,), its Jacobian, (n, n), and what each equation's residual is measured by, (n,).

        size: the most that each unknown counts for.
        """
        n = self.unknowns
        r, jac, weights = np.zeros(n), np.zeros((n, n)), np.zeros(n)
        library().hvdc_ident_judge(*_pointers(self.record, size, v, r, jac, weights))
        return r, jac, weights

    def _called(self, name: str, *arrays: Array) -> int:
        answer = int(getattr(library(), f"hvdc_ident_{name}")(*_pointers(self.record, *arrays)))
        if answer < 0:
            raise MemoryError
        return answer
