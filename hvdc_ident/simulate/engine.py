"""The engine: a model's machine code with the compiled integrators, behind one verb."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, InputSignal
from hvdc_ident.errors import ModelError, SimulationError, TimingError
from hvdc_ident.model import Model
from hvdc_ident.simulate.codegen import NAMES
from hvdc_ident.simulate.core import GIVEN, GIVEN_INSTANTS, HEAD_FIELDS, PLACE, RUN_FIELDS, address, integrate, room
from hvdc_ident.simulate.equations import ModelEquations, by_structure
from hvdc_ident.simulate.machine_code import Code, evaluate
from hvdc_ident.simulate.simulation import HINTS, Statistics
from hvdc_ident.simulate.steady_state import Equilibria

Method = Literal["auto", "nonstiff", "explicit", "rosenbrock"]
"""auto: chosen by the first run of a structure in a process. nonstiff: the explicit pair where it can be, and the Rosenbrock method for
a run that proves stiff, whatever was run before."""
Integers = NDArray[np.int64]
COUNTED = [PLACE[n] for n in ("accepted", "rejected", "events", "evaluations", "segments", "forced_steps")]
"""Places in the record of the counts that a run reports."""


@dataclass(frozen=True)
class Tolerance:
    """Error control: relative and absolute tolerance (states' own units) per step, and the step budget of one run.

    search: whether a steady start that Newton's method does not find at once is looked for by slower means. brief: whether the model
    has few runs to come: its machine code is then made in a fraction of the time, and takes longer to run. slides: whether a run may slide
    along the surface of a switch, for which more has to be compiled; one that may not chatters there.
    """

    rtol: float = 1e-8
    atol: float = 1e-10
    max_steps: int = 200_000
    search: bool = True
    brief: bool = False
    slides: bool = True


def check_times(model: Model, times: Array) -> None:
    """Raise TimingError for a negative delay, or a sampling period that is not above 0. times: delays, then periods, s."""
    for name, value in zip((*model.delays, *model.sampled), times.tolist(), strict=True):
        if name in model.delays and not value >= 0.0:
            raise TimingError(
                f"the delay of '{name}' is negative",
                where=f"model '{model.name}'",
                expected="0 s or more",
                got=f"{value:g} s",
                hint="bounds within which the expression of its time is not negative",
            )
        if name in model.sampled and not value > 0.0:
            raise TimingError(
                f"the sampling period of '{name}' is not above 0",
                where=f"model '{model.name}'",
                got=f"{value:g} s",
                hint="give it a positive time, or leave the effect out; where it is estimated, `min` above 0",
            )


class _Equations:
    """One set of equations with its machine code: of the model as it is, or of a slide."""

    def __init__(self, structure: ModelEquations) -> None:
        self.structure = structure
        self.address = np.zeros(len(NAMES), dtype=np.int64)
        self._codes: list[Code] = []
        self._keep(structure.compile())
        self._deferred = set(structure.deferred)
        self._late = False
        self._second = [np.zeros(0, dtype=np.int64)] * 2

    def _keep(self, code: Code) -> None:
        """Keep the code as long as this object, and know where its functions are."""
        self._codes.append(code)
        for name, start in code.address.items():
            self.address[NAMES.index(name)] = start

    def need(self, *names: str) -> None:
        """Compile what is not there yet of these functions."""
        missing = [n for n in names if n in self._deferred]
        if missing:
            self._keep(self.structure.compile_deferred(missing))
            self._deferred.difference_update(missing)

    def head(self, rosenbrock: bool, slides: bool) -> Integers:
        """Return the part of a run's record that describes these equations, (head fields,) integers: sizes, and addresses that live
        as long as this object.

        The code that only the Rosenbrock method, or only a slide, needs is compiled when it is first asked for.
        """
        if slides:
            self.need("swd")
        if rosenbrock and not self._late:
            self.need("jac", "ft")
            self._keep(self.structure.compile_late())
            self._late = True
            second = self.structure.second
            self._second = [np.array([entry[k] for entry in second], dtype=np.int64) for k in (0, 1)]
        width, address = self.structure.sizes.width, dict(zip(NAMES, self.address.tolist(), strict=True))
        given: dict[str, int] = {
            **self.structure.head(rosenbrock),
            **{f"do_{k}": v for k, v in address.items()},
            "do_rhs": address["fs" if width else "f"],
            "do_observe": address["outs" if width else "out"],
            "do_sources": address["srcs" if width else "src"],
            "hess_row": self._second[0].ctypes.data,
            "hess_column": self._second[1].ctypes.data,
        }
        return np.array([given[name] for name in HEAD_FIELDS], dtype=np.int64)


class Engine:
    """Machine code of one model structure for one list of sensitivity parameters and outputs; reusable for any values."""

    def __init__(
        self,
        model: Model,
        sensitivities: Sequence[str] = (),
        outputs: Sequence[str] | None = None,
        brief: bool = False,
    ) -> None:
        self.structure = ModelEquations(model, sensitivities, outputs, brief=brief)
        self._equations = _Equations(self.structure)
        self._slides: dict[int, _Equations] = {}
        self._address = self._equations.address
        self._equilibria = Equilibria(self.structure, self._address)
        self._explicit: bool | None = None
        self._lock = Lock()
        self._records: dict[tuple[bool, bool], tuple[Integers, Integers, int]] = {}

    # --- the start ---

    def start(
        self, p: Array, u: Array, time: float = 0.0, *, search: bool = True, model: Model | None = None
    ) -> tuple[Array, Array]:
        """The flat vectors y and w of the steady state, with their rows; arguments and errors as in `Equilibria.start`.

        model: whose values and origin tell which steady state (default: the model that the engine was made for).
        """
        steady = self._equilibria.start(model or self.structure.model, p, u, time, search=search)
        return steady.y, steady.w

    def constants(self, p: Array) -> Array:
        """Delay times, sampling periods and compute times, with their rows over the parameters."""
        s = self.structure.sizes
        count = s.nd + 2 * s.nq
        values = np.zeros(count * (1 + s.width) + 1)
        if count:
            evaluate(self._address[NAMES.index("const")], np.zeros(1), np.zeros(1), p, np.zeros(1), values)
            m = self.structure.model
            check_times(m, values[: s.nd + s.nq])
            for k, name in enumerate(m.sampled):
                period, compute = values[s.nd + k], values[s.nd + s.nq + k]
                if not 0.0 <= compute <= period:
                    raise TimingError(
                        f"the compute time of '{name}' does not fit its period",
                        where=f"model '{m.name}'",
                        expected=f"between 0 and {period:g} s",
                        got=f"{compute:g} s",
                    )
        return values

    def delay_times(self, p: Array) -> tuple[Array, Array]:
        """Return the time of each delay, (nd,) s, and its derivatives by the sensitivity parameters, (nd, np).

        Raises TimingError for a negative one.
        """
        s = self.structure.sizes
        constants = self.constants(p)
        first = s.nd + 2 * s.nq
        rows = constants[first : first + s.nd * s.width].reshape(s.nd, s.width)
        return constants[: s.nd], rows[:, : s.np]

    # --- the runs ---

    def prepared(
        self,
        inputs: Sequence[Any],
        time: Array,
        tolerance: Tolerance,
        method: Method = "auto",
        scale: Array | None = None,
        model: Model | None = None,
    ) -> EngineRuns:
        """Return the runs with these inputs, one InputSignal each, and outputs at these times; the parameters' values are open.

        scale: size of each sensitivity parameter. model: as in `start`. No step is longer than a delay: `short_delays` is for models
        with delays that may be short.
        """
        begin, end = float(time[0]), float(time[-1])
        u, (n_breaks, *tables), kept = _tables(tuple(inputs), begin, end)
        t_out = np.array(time, dtype=float)
        scales = np.ones(max(self.structure.sizes.np, 1)) if scale is None else np.array(scale, dtype=float)
        return EngineRuns(
            self, model or self.structure.model, tolerance, method, (begin, end), u,
            (address(scales), address(t_out)),
            (*tables, n_breaks, time.size, tolerance.max_steps, tolerance.slides),
            (kept, t_out, scales),
        )  # fmt: skip

    @property
    def slides(self) -> tuple[int, ...]:
        """The switches along whose surfaces runs have slid so far."""
        return tuple(sorted(self._slides))

    def note_stiff(self, method: Method) -> None:
        """Let later runs begin with the Rosenbrock method, where the method is chosen by a run."""
        if method == "auto":
            self._explicit = False

    def compile_slide(self, switch: int) -> None:
        """Make the equations of the slide on a switch known to later runs."""
        m = self.structure
        with self._lock:
            if switch not in self._slides:
                equations = ModelEquations(m.model, m.sensitivities, m.outputs, switch, brief=m.brief)
                self._slides[switch] = _Equations(equations)
                self._records.clear()

    def record(self, rosenbrock: bool, slides: bool) -> tuple[Integers, Integers, Array]:
        """A new run's record, the heads of the equations it may use, and its workspace."""
        kind = rosenbrock, slides
        with self._lock:  # two threads that compile would free the code that one of them runs
            if kind not in self._records:
                self._records[kind] = self._template(*kind)
            template, heads, doubles = self._records[kind]
        return template.copy(), heads, np.zeros(doubles)

    def _template(self, rosenbrock: bool, slides: bool) -> tuple[Integers, Integers, int]:
        """The record before a run, its heads, and how many doubles of workspace a run takes."""
        heads = np.zeros((self.structure.sizes.ns + 1, len(HEAD_FIELDS)), dtype=np.int64)
        for row, equations in {**self._slides, -1: self._equations}.items():
            heads[row] = equations.head(rosenbrock, slides)
        record = np.zeros(len(RUN_FIELDS), dtype=np.int64)
        record[: len(HEAD_FIELDS)] = heads.max(axis=0)  # room for the largest
        doubles = room(record)
        record[PLACE["heads"]] = address(heads)
        return record, heads, doubles

    def is_explicit(self, method: Method, p: Array, y: Array, w: Array, span: float) -> bool:
        """True where the explicit pair is the better choice: no unknowns, and no eigenvalue so fast that it would rule the step."""
        s = self.structure.sizes
        if method == "nonstiff":
            return not s.nz
        if method != "auto":
            if method == "explicit" and s.nz:
                raise ModelError(
                    "the explicit method cannot solve algebraic unknowns",
                    where=f"model '{self.structure.model.name}'",
                    hint="use method='rosenbrock' or 'auto'",
                )
            return method == "explicit"
        if self._explicit is None:
            if s.nz:
                self._explicit = False
            else:
                # The other side of a switch need not be defined here: the root of a signal that is below 0 now.
                known = [j for j in self._jacobians(p, y, w) if np.isfinite(j).all()]
                fastest = max((np.abs(np.linalg.eigvals(j)).max(initial=0.0) for j in known), default=np.inf)
                # The explicit pair takes some fastest * span / 3 steps whatever the tolerance, each for about half the
                # work of one of the other's, which needs some hundreds to follow a waveform.
                self._explicit = bool(fastest * span < 3e3)
        return self._explicit

    def fastest(self, p: Array, inputs: Sequence[Any], time: Array, tolerance: Tolerance, model: Model) -> float:
        """Return the largest modulus of an eigenvalue at the start, rad/s; infinite where one cannot be told.

        inputs, time, tolerance: as in `prepared`.
        """
        s = self.structure.sizes
        u, *_ = _tables(tuple(inputs), float(time[0]), float(time[-1]))
        y, w = self.start(p, u, float(time[0]), search=tolerance.search, model=model)
        jac = self.jacobian(p, y, w)
        if not np.isfinite(jac).all() or np.linalg.matrix_rank(jac[s.nx :, s.nx :]) < s.nz:
            return np.inf
        unknowns = np.linalg.solve(jac[s.nx :, s.nx :], jac[s.nx :, : s.nx])
        return float(np.abs(np.linalg.eigvals(jac[: s.nx, : s.nx] - jac[: s.nx, s.nx :] @ unknowns)).max(initial=0.0))

    def jacobian(self, p: Array, y: Array, w: Array) -> Array:
        """d[f; g]/d[x; z], (n, n), at y and w with modes as the values say."""
        return next(self._jacobians(p, y, w))

    def _jacobians(self, p: Array, y: Array, w: Array) -> Iterator[Array]:
        """The Jacobian in the mode that the values say, then with each switch the other way: a play is slow until it is passed."""
        s = self.structure.sizes
        n = s.nx + s.nz
        m = np.zeros(max(s.ns, 1))
        with self._lock:
            self._equations.need("jac")
        evaluate(self._address[NAMES.index("modes")], y, w, p, m, m)
        for other in (None, *range(s.ns)):
            mode, jac = m.copy(), np.zeros((n, n))
            if other is not None:
                mode[other] = 1.0 - mode[other]
            evaluate(self._address[NAMES.index("jac")], y, w, p, mode, jac.reshape(-1))
            yield jac


@dataclass(frozen=True, eq=False)
class EngineRuns:
    """Runs of an engine that differ by the values of parameters alone.

    span: their start and end, s. u: inputs at the start. There follow addresses of the parameters' sizes and the outputs' times, and the
    rest of what the caller states of a run, in the order of its record; kept: what these addresses are of.
    """

    engine: Engine
    model: Model
    tolerance: Tolerance
    method: Method
    span: tuple[float, float]
    u: Array
    scale_and_times: tuple[int, int]
    tables: tuple[int, ...]
    kept: tuple[Any, ...]

    def run(self, p: Array) -> tuple[Array, Statistics]:
        """Outputs at the times, (n, outputs (1 + width)): values, then rows; and what it cost."""
        engine, tolerance, (begin, end) = self.engine, self.tolerance, self.span
        s = engine.structure.sizes
        p = np.array(p, dtype=float)  # one that may be written, for it has an address then
        y, w = engine.start(p, self.u, begin, search=tolerance.search, model=self.model)
        constants = engine.constants(p)
        out = np.empty((self.tables[-3], max(s.no * (1 + s.width), 1)))
        given = [address(p), address(constants), *self.scale_and_times, address(out), *self.tables]
        instants = [begin, end, tolerance.rtol, tolerance.atol]
        explicit = engine.is_explicit(self.method, p, y, w, end - begin)
        while True:
            # The heads, as the tables above, live as long as the record that has their addresses.
            record, _heads, work = engine.record(not explicit, tolerance.slides)
            record[GIVEN] = given
            reals = record.view(float)
            reals[GIVEN_INSTANTS] = instants
            status = integrate(record, work, y, w)
            if status == "stiff" and self.method in ("auto", "nonstiff"):
                explicit = False
                engine.note_stiff(self.method)
                continue
            if status == "sliding":  # now with the code of that slide
                engine.compile_slide(int(record[PLACE["last_switch"]]))
                continue
            break
        counts = record[COUNTED].tolist()
        statistics = Statistics(status, "explicit" if explicit else "rosenbrock", *counts)
        if status != "converged":
            raise SimulationError(
                f"the simulation of model '{engine.structure.model.name}' stopped: {status}",
                where=f"t = {reals[PLACE['t']]:.6g} s",
                got=f"{statistics.accepted} steps accepted, {statistics.rejected} rejected, {statistics.events} switches",
                hint=HINTS[status],
            )
        return out, statistics


@lru_cache(maxsize=64)
def _tables(inputs: tuple[InputSignal, ...], begin: float, end: float) -> tuple[Any, ...]:
    """Return what an integration reads of its inputs: start values; the number of stops and the addresses of the tables; the tables.

    The tables are the stops, where the pieces of each input begin, and the points of all of them: times, values.
    """
    # "At the first row" is what stood before anything happened: the value from the left.
    u = [
        float(i.values[0] if i.times.size == 1 or i.times[0] >= begin else i(np.nextafter(begin, -np.inf)))
        for i in inputs
    ]
    at = np.unique(np.concatenate([np.empty(0), *(i.stops for i in inputs)]))
    at = at[(begin < at) & (at < end)]
    stops = np.vstack([at, np.isin(at, np.concatenate([np.empty(0), *(i.breaks for i in inputs)]))])
    pointer = np.cumsum([0, *(i.times.size for i in inputs)]).astype(np.int64)
    times = np.concatenate([i.times for i in inputs]) if inputs else np.empty(0)
    values = np.concatenate([i.values for i in inputs]) if inputs else np.empty(0)
    tables = (stops, pointer, times, values)
    return np.array(u), (stops.shape[1], *(address(a) for a in tables)), tables


ROOM = 128
"""Engines that are kept: one takes a megabyte, a search tries a hundred structures and comes back to the best."""

_engine = by_structure(Engine, room=ROOM)


def engine_of(
    model: Model, sensitivities: Sequence[str] = (), outputs: Sequence[str] | None = None, *, brief: bool = False
) -> Engine:
    """The engine of a model's structure, compiled at the first call and kept for later ones (the last `ROOM`).

    brief: as in `Tolerance`.
    """
    return _engine(model, tuple(sensitivities), tuple(model.outputs if outputs is None else outputs), brief)
