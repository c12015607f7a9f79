"""The engine: a model's machine code with the compiled integrators, behind one verb."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Any, Literal

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory
from hvdc_ident.errors import ModelError, SimulationError, SteadyStateError, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.simulate.integrators import integrators
from hvdc_ident.simulate.kept import by_structure
from hvdc_ident.simulate.machine import Code, evaluate
from hvdc_ident.simulate.result import Simulation, Statistics
from hvdc_ident.simulate.status import HINTS
from hvdc_ident.simulate.status import NAMES as STATUS
from hvdc_ident.simulate.steady_state import Equilibria
from hvdc_ident.simulate.structure import NAMES, Structure, padded

Method = Literal["auto", "explicit", "rosenbrock"]


@dataclass(frozen=True)
class Tolerance:
    """Error control: relative and absolute tolerance (states' own units) per step, and the step budget of one run.

    search: whether a steady start that Newton's method does not find at once is looked for by slower means.
    """

    rtol: float = 1e-8
    atol: float = 1e-10
    max_steps: int = 200_000
    search: bool = True


class Engine:
    """Machine code of one model structure for one list of sensitivity parameters and outputs; reusable for any values."""

    def __init__(self, model: Model, sensitivities: Sequence[str] = (), outputs: Sequence[str] | None = None) -> None:
        self._integrators = integrators()
        self.structure = Structure(model, sensitivities, outputs)
        self._code = self.structure.compile()
        self._late: Code | None = None
        self._address = np.array([self._code.address.get(n, 0) for n in NAMES], dtype=np.int64)
        self._equilibria = Equilibria(self.structure, self._address)
        second = self.structure.second
        self._hess_row = np.array([i for i, _, _ in second], dtype=np.int64)
        self._hess_column = np.array([j for _, j, _ in second], dtype=np.int64)
        self._explicit: bool | None = None
        self._lock = Lock()
        self._states: dict[bool, tuple[Any, int]] = {}

    # --- the start ---

    def start(
        self, p: Array, u: Array, time: float = 0.0, *, search: bool = True, model: Model | None = None
    ) -> tuple[Array, Array]:
        """The flat vectors y and w of the steady state, with their rows; arguments and errors as in `Equilibria.start`.

        model: whose values and origin tell which steady state (default: the model that the engine was made for).
        """
        found = self._equilibria.start(model or self.structure.model, p, u, time, search=search)
        return found.y, found.w

    def constants(self, p: Array) -> Array:
        """Delay times, sampling periods and compute times, with their rows over the parameters."""
        s = self.structure.sizes
        count = s.nd + 2 * s.nq
        values = np.zeros(count * (1 + s.width) + 1)
        if count:
            evaluate(self._address[NAMES.index("const")], np.zeros(1), np.zeros(1), p, np.zeros(1), values)
            m = self.structure.model
            names = [*m.delays, *m.sampled]
            for k, name in enumerate(names):
                if not values[k] > 0.0:
                    kind = "delay" if k < s.nd else "sampling period"
                    raise ModelError(
                        f"the {kind} of '{name}' is not above 0",
                        where=f"model '{m.name}'",
                        got=f"{values[k]:g} s",
                        hint="leave the effect out, or give it a positive time",
                    )
            for k, name in enumerate(m.sampled):
                period, compute = values[s.nd + k], values[s.nd + s.nq + k]
                if not 0.0 <= compute <= period:
                    raise ModelError(
                        f"the compute time of '{name}' does not fit its period",
                        where=f"model '{m.name}'",
                        expected=f"between 0 and {period:g} s",
                        got=f"{compute:g} s",
                    )
        return values

    # --- the run ---

    def run(
        self,
        p: Array,
        inputs: Sequence[Any],
        time: Array,
        tolerance: Tolerance,
        method: Method = "auto",
        scale: Array | None = None,
        first: float | None = None,
        model: Model | None = None,
    ) -> tuple[Array, Statistics]:
        """Outputs at the times, (n, outputs (1 + width)): values, then rows; and what it cost.

        inputs: one InputSignal an input. first: where the run starts, s (default: the first time). model: as in `start`.
        """
        s = self.structure.sizes
        begin, end = float(time[0] if first is None else first), float(time[-1])
        p = np.ascontiguousarray(p, dtype=float)
        u, *tables = _tables(tuple(inputs), begin, end)
        y, w = self.start(p, u, begin, search=tolerance.search, model=model)
        constants = self.constants(p)
        out = np.empty((time.size, max(s.no * (1 + s.width), 1)))
        sizes = np.ones(max(s.np, 1)) if scale is None else np.ascontiguousarray(scale, dtype=float)
        allowed = np.array([tolerance.rtol, tolerance.atol])
        t_out = np.ascontiguousarray(time, dtype=float)
        explicit = self._is_explicit(method, p, y, w, end - begin)
        while True:
            state, work = self._state(not explicit)
            span = np.array([begin, end])
            answer = self._integrators.integrate(
                state, work, span, allowed, tolerance.max_steps, y, w, p, constants, *tables,
                t_out, out, sizes, self._hess_row, self._hess_column,
            )  # fmt: skip
            status = _status(answer)
            if STATUS[status] == "stiff" and method == "auto":
                self._explicit = explicit = False
                continue
            break
        counts = state[self._counted].tolist()
        statistics = Statistics(STATUS[status], "explicit" if explicit else "rosenbrock", *counts)
        if status:
            raise SimulationError(
                f"the simulation of model '{self.structure.model.name}' stopped: {STATUS[status]}",
                where=f"t = {span[0]:.6g} s",
                got=f"{statistics.accepted} steps accepted, {statistics.rejected} rejected, {statistics.events} switches",
                hint=HINTS[STATUS[status]],
            )
        return out, statistics

    def _state(self, rosenbrock: bool) -> tuple[Any, Array]:
        """A new run's record as integers, with sizes and addresses, and its workspace.

        The code that only the Rosenbrock method needs is there afterwards.
        """
        with self._lock:  # two threads that compile would free the code that one of them runs
            if rosenbrock and self._late is None:
                self._late = self.structure.compile_late()
                for name, address in self._late.address.items():
                    self._address[NAMES.index(name)] = address
                self._states.clear()
            if rosenbrock not in self._states:
                self._states[rosenbrock] = self._template(rosenbrock)
            template, room = self._states[rosenbrock]
        return template.copy(), np.zeros(room)

    def _template(self, rosenbrock: bool) -> tuple[Any, int]:
        """The record before a run, and how many doubles of workspace a run takes."""
        from hvdc_ident.simulate.state import COUNTED, RUN, place

        s = self.structure.sizes
        n, address = s.nx + s.nz, dict(zip(NAMES, self._address.tolist(), strict=True))
        given = {k: getattr(s, k) for k in ("nx", "nz", "nu", "nd", "nq", "ns", "no", "np", "width")} | {
            "n": n,
            "size": n * (1 + s.width),
            "stride": padded(n * (1 + s.width)),
            "nw": 1 + s.nu + s.nd + s.nq,
            "hessians": s.n_hess if rosenbrock else 0,
            "factors": self.structure.elimination.count if rosenbrock and self.structure.elimination else 0,
            "timed": self.structure.moves_by_itself,
            "rosenbrock": rosenbrock,
            **{f"do_{k}": v for k, v in address.items()},
            "do_rhs": address["fs" if s.width else "f"],
            "do_observe": address["outs" if s.width else "out"],
            "do_sources": address["srcs" if s.width else "src"],
        }
        state = np.zeros(len(RUN.fields or ()), dtype=np.int64)
        for name, value in given.items():
            state[place(name)] = value
        self._counted = [place(name) for name in COUNTED]
        return state, self._integrators.room(state.copy())

    def _is_explicit(self, method: Method, p: Array, y: Array, w: Array, span: float) -> bool:
        """True where the explicit pair is the better choice: no unknowns, and no mode so fast that it would rule the step."""
        s = self.structure.sizes
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
                fastest = np.abs(np.linalg.eigvals(self.jacobian(p, y, w))).max(initial=0.0)
                # The explicit pair takes some fastest * span / 3 steps whatever the tolerance, each for about half the
                # work of one of the other's, which needs some hundreds to follow a waveform.
                self._explicit = bool(fastest * span < 3e3)
        return self._explicit

    def jacobian(self, p: Array, y: Array, w: Array) -> Array:
        """d[f; g]/d[x; z], (n, n), at y and w with modes as the values say."""
        s = self.structure.sizes
        n = s.nx + s.nz
        m, jac = np.zeros(max(s.ns, 1)), np.zeros((n, n))
        evaluate(self._address[NAMES.index("modes")], y, w, p, m, m)
        evaluate(self._address[NAMES.index("jac")], y, w, p, m, jac.reshape(-1))
        return jac


def _status(answer: int) -> int:
    """The status in what one of the integrators answered."""
    if answer == 0:
        raise MemoryError
    return answer - 1


@lru_cache(maxsize=64)
def _tables(inputs: tuple[InputSignal, ...], begin: float, end: float) -> tuple[Any, ...]:
    """Return the tables that an integration reads of its inputs: start values, breaks, then the pieces of all of them and their points."""
    # "At the first row" is what stood before anything happened: the value from the left.
    u = [
        float(i.values[0] if i.times.size == 1 or i.times[0] >= begin else i(np.nextafter(begin, -np.inf)))
        for i in inputs
    ]
    breaks = np.array(sorted({b for i in inputs if i.breaks.size for b in i.breaks.tolist() if begin < b < end}))
    pointer = np.cumsum([0, *(i.times.size for i in inputs)]).astype(np.int64)
    times = np.concatenate([i.times for i in inputs]) if inputs else np.empty(0)
    values = np.concatenate([i.values for i in inputs]) if inputs else np.empty(0)
    return np.array(u), breaks, pointer, times, values


ROOM = 128
"""Engines that are kept: one takes a megabyte, a search tries a hundred structures and comes back to the best."""

_engine = by_structure(Engine, room=ROOM)


def engine(model: Model, sensitivities: Sequence[str] = (), outputs: Sequence[str] | None = None) -> Engine:
    """The engine of a model's structure, compiled at the first call and kept for later ones (the last `ROOM`)."""
    return _engine(model, tuple(sensitivities), tuple(model.outputs if outputs is None else outputs))


@lru_cache(maxsize=256)
def _constant(value: float) -> InputSignal:
    return InputSignal.constant(value)


def simulate(
    model: AnyModel,
    experiment: Experiment,
    values: Mapping[str, float] | None = None,
    sensitivities: Sequence[str] = (),
    *,
    outputs: Sequence[str] | None = None,
    tolerance: Tolerance | None = None,
    rtol: float | None = None,
    method: Method = "auto",
    partial: bool = False,
) -> Simulation:
    """The model's outputs at the experiment's times and, exactly, their derivatives by the named parameters.

    values: parameters (and constant inputs) that differ from the model's. outputs: names of outputs or signals (default:
    all outputs). The start is the steady state of the inputs' first values unless a state says otherwise; it depends on
    the parameters, and so do the sensitivities at the start. rtol: shorthand for a Tolerance with atol = rtol / 100.
    The name of an input among the sensitivities asks for the derivative by a constant added to that input all along,
    that of a state for the derivative by its start, which is then no longer the steady one.
    A model that is external (an FMU) runs itself, from its own start; `method` is then its own. It may ask for the end
    of its run: partial gives the rows up to there, with status "ended" and the instant in the notes; else that has failed.

    Raises SteadyStateError where there is no steady start, SimulationError where the run does not reach its end.
    """
    from hvdc_ident.simulate.recording import with_own, with_recording

    if not isinstance(model, Model):
        chosen = tuple(model.outputs) if outputs is None else outputs
        tol = tolerance or (Tolerance() if rtol is None else Tolerance(rtol, rtol / 100))
        ending = {"partial": True} if partial else {}
        found: Simulation = model.simulate(experiment, values, sensitivities, outputs=chosen, tolerance=tol, **ending)
        return found
    plant = with_recording(model, experiment)
    given = {**experiment.values, **(values or {})}
    names = [*plant.parameters, *plant.inputs]
    for name in (*given, *experiment.inputs):
        if name not in plant.parameters and name not in plant.inputs:
            raise unknown_name("parameter or input", name, names, where=f"experiment '{experiment.name}'")
    for name in experiment.offsets:
        if name not in plant.inputs:
            raise unknown_name("input", name, plant.inputs, where=f"experiment '{experiment.name}'")
    for name in experiment.starts:
        if name not in plant.states:
            raise unknown_name("state", name, plant.states, where=f"experiment '{experiment.name}'")
    own = {**experiment.offsets, **experiment.starts}
    plant, parameter = with_own(plant, [n for n in (*plant.inputs, *plant.states) if n in own or n in sensitivities])
    given |= {parameter[n]: v for n, v in own.items()}
    code = engine(plant, [parameter.get(n, n) for n in sensitivities], outputs)
    p = [float(given.get(n, q.value)) for n, q in plant.parameters.items()]
    if not all(map(math.isfinite, p)):
        bad = [n for n, v in zip(plant.parameters, p, strict=True) if not math.isfinite(v)]
        raise ModelError(
            f"the value of parameter '{bad[0]}' is not finite",
            where=f"model '{model.name}'",
            hint="an effect at an infinite neutral value is left out: do not set it",
        )
    signals = [experiment.inputs.get(n) or _constant(float(given.get(n, i.value))) for n, i in plant.inputs.items()]
    tol = tolerance or (Tolerance() if rtol is None else Tolerance(rtol, rtol / 100))
    scale = np.array([plant.parameters[n].size for n in code.structure.sensitivities]) if sensitivities else None
    try:
        out, statistics = code.run(np.array(p), signals, experiment.time, tol, method, scale, model=plant)
    except (SimulationError, SteadyStateError) as e:
        raise e.at(f"experiment '{experiment.name}'") from None
    return _simulation(plant, code, experiment, out, statistics, tuple(sensitivities))


def _simulation(
    model: Model, code: Engine, experiment: Experiment, out: Array, statistics: Statistics, asked: tuple[str, ...]
) -> Simulation:
    s = code.structure.sizes
    names = code.structure.outputs
    units = tuple(model.outputs[n].unit if n in model.outputs else "" for n in names)
    gradient = (
        out[:, s.no :].reshape(experiment.time.size, s.no, s.width)[:, :, : s.np]
        if s.width
        else np.zeros((experiment.time.size, s.no, 0))
    )
    return Simulation(
        Trajectory(experiment.time, out[:, : s.no], names, units),
        asked,
        gradient,
        statistics,
        FrozenMap(),
    )
