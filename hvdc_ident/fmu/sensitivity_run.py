"""An experiment as a worker runs it, with derivatives by the best method for each parameter. In worker processes only."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu import co_simulation, model_exchange
from hvdc_ident.fmu.derivatives import (
    SHORT_STEP,
    SUFFICIENT,
    SensitivityEquations,
    difference,
    difference_pair,
    first_difference,
    noise_of,
    rms,
)
from hvdc_ident.fmu.description import Message
from hvdc_ident.fmu.fmi import FmiError, VariableGroup
from hvdc_ident.fmu.instance import (
    NOISE_FACTOR,
    Instance,
    RunEnded,
    RunFailed,
    find_reuse,
    isolated,
    moving,
    quoting,
)
from hvdc_ident.fmu.piecewise_linear import PackedInputs

if TYPE_CHECKING:
    from hvdc_ident.fmu.worker import RequestHandler

STEPS_KEPT = 1000  # of differences, and noise levels, that a worker remembers
LOST_IN_NOISE = 0.5  # relative error from which a derivative is not distinguished from noise
START_STEP = 1e-3  # of differences of the initial state by a parameter, in its sizes
PERTURBATION = 0.1  # step of an input that shows whether a run is repeated, in sizes of the input
CONFIRMING_STEP = 1e-3  # of the differences that confirm directional derivatives, in sizes of the parameter
CONFIRMING_DOUBT = 0.1  # relative uncertainty of a difference of runs above which it confirms nothing
EXCESS_STEPS = 20  # times the steps of a plain run that one with sensitivities may take before it is given up
REUSE_NOTES = {
    "instance": "a reset does not bring the FMU back to its start: each run has a new instance",
    "process": "neither a reset nor a new instance brings the FMU back to its start: each run has a new process",
}


class SensitivityRun:
    """One experiment: a run, and derivatives by the best method for each parameter.

    Parameters include inputs, whose derivatives are by constants added to them, and directions of all inputs: constants
    0, of size 1, that move them along a line of points.
    """

    def __init__(self, handler: RequestHandler, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
        self.handler, self.description, self.learned = handler, handler.description, handler.learned
        self.values: dict[str, float] = heading["values"]
        self.names = tuple(heading["outputs"])
        self.parameters: list[str] = heading["parameters"]
        self.wanted: list[str] = heading.get("wanted", self.parameters)  # other workers compute the other columns
        self.sizes = dict(zip(self.parameters, heading["sizes"], strict=True))
        self.bounds: dict[str, tuple[float, float]] = dict(zip(self.parameters, heading["bounds"], strict=True))
        self.starts: dict[str, float] = dict(zip(self.parameters, heading["starts"], strict=True))
        self.tolerance: float = heading["tolerance"]
        self.time = arrays["time"]
        self.signals = PackedInputs(arrays["sizes"], arrays["times"], arrays["points"], arrays["breaks"])
        self.inputs = list(self.description.inputs)
        self.direction_keys: dict[str, str] = heading.get("directions", {})
        self.directions = dict(zip(self.direction_keys, arrays.get("directions", np.empty((0, 0))), strict=True))
        request = repr((self.names, self.tolerance)).encode()
        self.key = sha256(b"".join(arrays[n].tobytes() for n in ("time", "times", "points")) + request).digest()
        # Noise and difference steps are those of one experiment, whatever its inputs pass through before they enter.
        noise_key = str(heading.get("noise key", "")).encode()
        self.noise_key = sha256(arrays["time"].tobytes() + noise_key + request).digest() if noise_key else self.key
        self.partial = bool(heading.get("partial"))  # whether a run that the FMU ends is accepted, with its rows
        self.ended: tuple[float, int] | None = None  # instant of such an end, s, and the rows up to it
        self.notes: dict[str, str] = {}
        self.counts = model_exchange.Counts()
        if heading.get("fresh"):
            self.handler.last = None
        if "base" in arrays:
            self.handler.last = (self._key_of(self.values, self.signals), arrays["base"])

    def answer(self) -> Message:
        """Return outputs and their derivatives, with notes on the methods and the relative errors."""
        co_simulated = self.description.interface == "co-simulation"
        if "restart" not in self.learned:
            self._find_reuse()
        if self.learned["restart"] in REUSE_NOTES:
            self.notes["restart"] = REUSE_NOTES[self.learned["restart"]]
        if co_simulated:
            self._find_calls()
        gradients = np.zeros((self.time.size, len(self.names), len(self.parameters)))
        errors = np.zeros(len(self.parameters))
        directional = self._confirmed_parameters()
        integrated = self._integrated(directional, gradients) if directional else None
        by_differences = [n for n in self.parameters if integrated is None or n not in directional]
        outputs = self._run() if integrated is None else integrated
        for name in by_differences:
            if name in self.wanted:
                j = self.parameters.index(name)
                gradients[:, :, j], errors[j] = self._by_differences(name, outputs)
        lost = [j for j, e in enumerate(errors.tolist()) if e > LOST_IN_NOISE]
        gradients[:, :, lost], errors[lost] = 0.0, 0.0  # a column of noise would pass for a direction
        if lost:
            self.notes["not seen above the noise of the runs"] = ", ".join(self.parameters[j] for j in lost)
        if self.parameters:
            methods: dict[str, list[str]] = {}
            for name in self.parameters:
                method = "differences of runs" if name in by_differences else "directional derivatives"
                methods.setdefault(method, []).append(name)
            self.notes["sensitivities"] = "; ".join(f"{m}: {', '.join(names)}" for m, names in methods.items())
        if co_simulated:
            self._find_held(outputs)
            self.notes |= co_simulation.notes(self.learned)
        if self.ended is not None:
            t, count = self.ended
            self.notes["end"] = f"the FMU asked for the end of the run at {t:.6g} s: the rows go up to there"
            outputs, gradients = outputs[:count], gradients[:count]
        arrays = {"outputs": outputs, "gradients": gradients, "errors": errors}
        return {"notes": self.notes, "counts": list(astuple(self.counts))}, arrays

    # --- properties of the FMU, found in its first runs ---

    def _find_reuse(self) -> None:
        """Learn how the FMU is brought back to its start, from runs of this experiment in separate processes."""
        d = self.description
        names = tuple(dict.fromkeys([*self.names, *d.outputs, *d.states]))

        def run_on(signals: PackedInputs) -> Callable[[Instance], Array]:
            def run(instance: Instance) -> Array:
                self.handler.restart_deadline()
                return self._rows(instance, self.values, signals, names, model_exchange.Counts())

            return run

        reuse, rows = find_reuse(self.handler.load_fmu, run_on(self.signals), self.handler.new_watch)
        steps = [PERTURBATION * max(abs(v.start or 0.0), v.nominal) * v.continuous for v in d.inputs.values()]
        if any(steps) and not moving(rows).any():  # at rest throughout: the start of a run is its end
            third = float(self.time[0] + (self.time[-1] - self.time[0]) / 3.0)
            with contextlib.suppress(RunFailed):
                moved = run_on(self.signals.stepped(steps, third))
                reuse, _ = find_reuse(self.handler.load_fmu, moved, self.handler.new_watch)
        self.learned["restart"] = reuse

    def _find_calls(self) -> None:
        """Learn how a co-simulation FMU has to be called, where this experiment can show it."""
        co_simulation.find_calls(
            self.learned, self.description, self.signals, self.time, self.tolerance, self._co_simulated
        )

    def _find_held(self, outputs: Array) -> None:
        """Learn whether outputs of a co-simulation FMU are older than their rows, where it says so and they move."""
        if self.ended is None and self.description.variable_step and moving(outputs).any():
            calls = co_simulation.CallPattern.learned(self.learned)
            with contextlib.suppress(RunFailed):
                co_simulation.find_held(self.learned, self.time, lambda time: self._co_simulated(calls, time))

    def _co_simulated(self, calls: co_simulation.CallPattern, time: Array) -> Array:
        """(n, outputs) of a run that calls the FMU in some way, of the outputs asked for and all others."""
        names = tuple(dict.fromkeys([*self.names, *self.description.outputs]))
        self.handler.restart_deadline()

        def rows(instance: Instance) -> Array:
            try:
                return co_simulation.run(instance, self.values, self.signals, time, names, self.tolerance, calls)
            except RunEnded as e:
                return self._padded(e, time.size)

        if self.handler.isolated:
            return self._in_new_process(rows, model_exchange.Counts())
        self.handler.runs += 1
        try:
            return rows(self.handler.instance)
        except (FmiError, RunFailed) as e:
            raise self.handler.failed(e) from None

    # --- runs ---

    def _value_of(self, name: str) -> float:
        """Return a parameter's value; of an input or a direction the constant that is added, 0."""
        return 0.0 if name in self.inputs or name in self.directions else self.values.get(name, self.starts[name])

    def _moved(self, moved: Mapping[str, float]) -> tuple[dict[str, float], PackedInputs]:
        """Return values and signals with parameters at other values, or constants added to inputs."""
        signals, values = self.signals, dict(self.values)
        for name, value in moved.items():
            if name in self.directions:
                signals = replace(signals, values=signals.values + value * self.directions[name])
            elif name in self.inputs:
                signals = signals.raised(self.inputs.index(name), value)
            else:
                values[name] = value
        return values, signals

    def _run(self, moved: Mapping[str, float] | None = None) -> Array:
        """(n, outputs) of a run, with parameters moved to other values; checked to be finite. The last unmoved one is kept."""
        values, signals = self._moved(moved or {})
        key = self._key_of(values, signals)
        if not moved and self.handler.last is not None and self.handler.last[0] == key:
            return self.handler.last[1]
        counts = model_exchange.Counts() if moved else self.counts

        def run(instance: Instance) -> Array:
            return self._rows(instance, values, signals, self.names, counts)

        outputs = self._in_new_process(run, counts) if self.handler.isolated else run(self.handler.instance)
        recorded = outputs if self.ended is None else outputs[: self.ended[1]]
        finite = np.isfinite(recorded)
        if not finite.all():
            row, column = np.argmin(finite.all(axis=1)), np.argmin(finite.all(axis=0))
            what = f"output '{self.names[column]}' is not finite"
            raise RunFailed(what, float(self.time[row]), "check parameter values and limits")
        if not moved and self.ended is None:
            self.handler.last = (key, outputs)
        return outputs

    def _key_of(self, values: Mapping[str, float], signals: PackedInputs) -> bytes:
        """Return everything that decides the outputs of a run."""
        return self.key + signals.values.tobytes() + repr(sorted(values.items())).encode()

    def _in_new_process(self, run: Callable[[Instance], Array], counts: model_exchange.Counts) -> Array:
        """(n, outputs) of a run in a process started for it; what it finds out about the FMU is kept."""

        def work() -> Message:
            instance = self.handler.load_fmu({k: v for k, v in self.learned.items() if k != "restart"})
            with quoting(instance):
                rows = run(instance)
            return {"learned": instance.learned, "counts": asdict(counts), "end": self.ended}, {"rows": rows}

        heading, arrays = isolated(lambda send: send(work()))[0]
        self.handler.runs += 1
        self.learned |= heading["learned"]
        vars(counts).update(heading["counts"])
        self.ended = tuple(heading["end"]) if heading["end"] else None
        return arrays["rows"]

    def _rows(
        self,
        instance: Instance,
        values: Mapping[str, float],
        signals: PackedInputs,
        names: tuple[str, ...],
        counts: model_exchange.Counts,
        refinement: float = 1.0,
    ) -> Array:
        """(n, names) of a run; NaN after an end that the FMU asked for, where such a run is accepted.

        refinement: factor on the integrator's tolerance.
        """
        self.handler.runs += 1
        try:
            if instance.library.exchange:
                run = model_exchange.ModelExchangeRun(
                    instance, signals, self.time, names, refinement * self.tolerance, counts=counts
                )
                run.go(values)
                return run.outputs
            counts.segments += 1
            return co_simulation.run(instance, values, signals, self.time, names, self.tolerance)
        except RunEnded as e:
            rows = self._padded(e, self.time.size)
            self.ended = (float(e.t or 0.0), len(e.rows) if e.rows is not None else 0)
            return rows

    def _padded(self, ended: RunEnded, count: int) -> Array:
        """(count, names) of a run that the FMU ended, NaN after that. Raises the end where such a run is not accepted."""
        rows = ended.rows
        if not self.partial or rows is None or not rows.size:
            raise ended
        return np.vstack([rows, np.full((count - rows.shape[0], rows.shape[1]), np.nan)])

    # --- derivatives from sensitivity equations ---

    def _confirmed_parameters(self) -> list[str]:
        """Return the parameters and inputs whose directional derivatives a whole run has confirmed."""
        d = self.description
        if not self.parameters or self.handler.isolated or not (d.directional and d.states):
            return []
        variables = {**d.parameters, **{n: v for n, v in d.inputs.items() if v.continuous}}
        plain = [n for n in self.parameters if n in variables and n not in self.directions]
        real = [n for n in plain if variables[n].kind in ("Real", "Float64")]
        confirmed: dict[str, bool] = self.learned.setdefault("derivatives", {})
        new = [n for n in real if n not in confirmed]
        if new:
            confirmed |= self._confirmed(new)
        return [n for n in real if confirmed.get(n)]

    def _confirmed(self, names: list[str]) -> dict[str, bool]:
        """Return which directional derivatives hold over this whole run.

        The FMI standard takes states and inputs as knowns of a directional derivative. By parameters some FMUs give
        other figures, and some move the parameter: so the run with sensitivities has to be the run without, the
        parameters have to have their values after it, and each column has to be the difference of runs.
        """
        instance = self.handler.instance
        plain = model_exchange.Counts()
        outputs = self._rows(instance, self.values, self.signals, self.names, plain)
        finer = self._rows(instance, self.values, self.signals, self.names, model_exchange.Counts(), 0.5)
        noise = rms(outputs - finer)
        parameters = VariableGroup(instance.library, tuple(self.description.parameters.values()))
        before = parameters.get().copy()
        try:
            run = self._sensitivity_run(names, model_exchange.Counts(), EXCESS_STEPS * plain.accepted + 1000)
            moved = not np.array_equal(before, parameters.get(), equal_nan=True)
        except (RunFailed, FmiError, model_exchange.SensitivitiesLost):
            moved = True
        instance.renew(names)
        size = np.abs(outputs).max(axis=0, initial=0.0)
        if moved or (rms(run.outputs - outputs) > NOISE_FACTOR * (noise + self.tolerance * size)).any():
            return {n: len(names) > 1 and self._confirmed([n])[n] for n in names}
        return {n: self._agrees(n, run.gradients[:, :, j], outputs, noise) for j, n in enumerate(names)}

    def _agrees(self, name: str, column: Array, outputs: Array, noise: Array) -> bool:
        """Return whether a column is the difference of two runs, as far as their curvature and noise show."""
        h = CONFIRMING_STEP * self.sizes[name]
        found, curvature = difference_pair(self._run_by(name), self._value_of(name), h, *self.bounds[name], outputs)
        strength = rms(found)
        doubt = rms(curvature) * h + 2.0 * noise / h
        conclusive = (doubt <= CONFIRMING_DOUBT * strength) | (strength <= 2.0 * noise / h)
        return bool((conclusive & (rms(column - found) <= doubt + SUFFICIENT * strength)).all())

    def _sensitivity_run(
        self, names: Sequence[str], counts: model_exchange.Counts, max_steps: int = model_exchange.MAX_STEPS
    ) -> model_exchange.ModelExchangeRun:
        """Return the run with sensitivities. Raises SensitivitiesLost where an event makes them wrong."""
        instance = self.handler.instance
        start = np.column_stack([self._start_derivative(n) for n in names])
        equations = SensitivityEquations(instance, names, [self.sizes[n] for n in names], self.names)
        run = model_exchange.ModelExchangeRun(
            instance, self.signals, self.time, self.names, self.tolerance, equations, start, counts, max_steps
        )
        run.go(self.values)
        return run

    def _integrated(self, names: Sequence[str], gradients: Array) -> Array | None:
        """(n, outputs) with the gradients filled in; None where an event makes the columns wrong."""
        try:
            run = self._sensitivity_run(names, self.counts)
        except model_exchange.SensitivitiesLost as e:
            self.notes["events"] = f"{e}: derivatives come from differences of runs"
            return None
        gradients[:, :, [self.parameters.index(n) for n in names]] = run.gradients
        if not (np.isfinite(run.outputs).all() and np.isfinite(run.gradients).all()):
            raise RunFailed("an output or its sensitivity is not finite", hint="check parameter values and limits")
        return run.outputs

    def _start_derivative(self, name: str) -> Array:
        """(nx,) dx0/dp, from initialisations at two steps, extrapolated."""
        t = float(self.time[0])
        instance = self.handler.instance

        def start(value: float) -> Array:
            values, signals = self._moved({name: value})
            instance.begin(values, signals.at(self.time[:1], "left")[0], t, None, self.tolerance)
            return instance.library.get_states()[:, None]

        value, h = self._value_of(name), START_STEP * self.sizes[name]
        middle = start(value)
        coarse, fine = (
            difference_pair(start, value, step, *self.bounds[name], middle)[0][:, 0] for step in (h, 0.5 * h)
        )
        return np.asarray((4.0 * fine - coarse) / 3.0)

    # --- derivatives from differences of runs ---

    def _run_by(self, name: str) -> Callable[[float], Array]:
        """Return the run as a function of one parameter."""

        def run(value: float) -> Array:
            self.handler.restart_deadline()
            return self._run({name: value})

        return run

    def _by_differences(self, name: str, outputs: Array) -> tuple[Array, float]:
        """(n, outputs) derivatives by one parameter, and their relative error."""
        run, value, bounds = self._run_by(name), self._value_of(name), self.bounds[name]
        octave = round(float(np.log2(abs(value)))) if value else 0  # a step chosen at half the value is chosen anew
        key = self.noise_key + f"{self.direction_keys.get(name, name)} {octave}".encode()
        step = self.handler.steps.get(key)
        if step is not None:
            return difference(run, value, step, *bounds, outputs), step.error
        column, step = first_difference(run, value, self.sizes[name], *bounds, outputs, self._noise(outputs))
        if len(self.handler.steps) < STEPS_KEPT:
            self.handler.steps[key] = step
        return column, step.error

    def _noise(self, outputs: Array) -> Array:
        """(outputs,) noise of a run of this experiment."""
        noise = self.handler.noise.get(self.noise_key)
        if noise is None:
            noise = noise_of(self._displaced, outputs)
            if len(self.handler.noise) < STEPS_KEPT:
                self.handler.noise[self.noise_key] = noise
        return noise

    def _displaced(self, steps: float) -> Array:
        """(n, outputs) of a run with every parameter moved by so many short steps, away from the nearer bound."""
        self.handler.restart_deadline()
        moved = {}
        for name in self.parameters:
            value, (low, high) = self._value_of(name), self.bounds[name]
            moved[name] = value + (steps if high - value >= value - low else -steps) * SHORT_STEP * self.sizes[name]
        return self._run(moved)
