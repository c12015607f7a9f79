"""An experiment as a worker runs it, with derivatives by the best method for each parameter. In worker processes only."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu import co_simulation, model_exchange
from hvdc_ident.fmu.derivatives import (
    ENOUGH,
    SHORT,
    DifferenceStep,
    PointEvaluation,
    VariationalEquations,
    derivative,
    first,
    noise_of,
    pair,
    rms,
)
from hvdc_ident.fmu.description import Description
from hvdc_ident.fmu.fmi import FmiError, VariableGroup
from hvdc_ident.fmu.instance import SPREAD, Instance, LoadFmu, Reuse, RunEnded, RunFailed, failure, find_reuse, moving
from hvdc_ident.fmu.piecewise_linear import PackedInputs
from hvdc_ident.processes.messages import Message
from hvdc_ident.processes.server import die_like, in_new_process

KEPT_STEPS = 1000
LOST = 0.5  # relative error from which a derivative is not told from noise
START_STEP = 1e-3  # of differences of the start by a parameter, in its sizes
STIRRED = 0.1  # step of an input that shows whether a run is repeated, in sizes of the input
NEAR = 1e-3  # step of the differences that confirm derivatives, in sizes of the parameter
TOLD = 0.1  # relative doubt of a difference of runs above which it confirms nothing
EXCESS = 20  # times the steps of a plain run that one with sensitivities may take before it is given up
REPEATED = {
    "reset": "",
    "instance": "a reset does not bring the FMU back to its start: each run has a new instance",
    "process": "neither a reset nor a new instance brings the FMU back to its start: each run has a new process",
}


@dataclass
class RequestHandler:
    """An FMU with what was learned of it.

    make: loads it into this process. tell: called between runs of one job, so that nobody waits in vain. learned: kept
    by the pool over workers, see `hvdc_ident.fmu.worker_pool`.
    """

    description: Description
    make: LoadFmu
    tell: Callable[[], None]
    learned: dict[str, Any] = field(default_factory=dict)
    steps: dict[bytes, DifferenceStep] = field(default_factory=dict)
    noise: dict[bytes, Array] = field(default_factory=dict)
    last: tuple[bytes, Array] | None = None
    made: Instance | None = None
    runs: int = 0

    @property
    def instance(self) -> Instance:
        """The FMU in this process; it is loaded where it was not."""
        if self.made is None:
            self.made = self.make(self.learned)
        return self.made

    @property
    def isolated(self) -> bool:
        """True where the FMU is kept out of this process: each of its runs has one, or how it restarts is not known yet."""
        return self.learned.get("restart", "process") == "process"

    def load(self) -> Message:
        """Make an instance, or a first one in a process of its own, so that what cannot be loaded says so."""
        return isolated_result(self._loaded) if self.isolated else self._loaded()

    def _loaded(self) -> Message:
        self.instance.instantiate()
        return {}, {}

    def failed(self, error: Exception) -> RunFailed:
        """Return what an error amounts to; the instance is given up, for it cannot be trusted even to free itself."""
        found = failure(error, self.made.library.messages if self.made else ())
        if self.made:
            self.made.abandon()
        return found

    def do(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        """Return the answer to a request, with what was learned."""
        self.runs = 0
        self._take_over(heading.get("found", {}))
        known = len(self.steps), len(self.noise)
        work = {"simulate": self._simulate, "point": self._point, "starts": self._starts}[heading["do"]]
        if heading["do"] != "simulate" and self.isolated:
            found, out = isolated_result(lambda: work(heading, arrays))
        else:
            found, out = work(heading, arrays)
        news = {f"step {k.hex()}": astuple(s) for k, s in islice(self.steps.items(), known[0], None)}
        news |= {f"noise {k.hex()}": n.tolist() for k, n in islice(self.noise.items(), known[1], None)}
        return {**found, "found": news, "learned": self.learned, "whole runs": self.runs}, out

    def _take_over(self, found: Mapping[str, Any]) -> None:
        """Take over the steps of differences and the noise of runs that other workers have found."""
        for name, value in found.items():
            kind, _, key = name.partition(" ")
            if kind == "step":
                self.steps.setdefault(bytes.fromhex(key), DifferenceStep(*value))
            else:
                self.noise.setdefault(bytes.fromhex(key), np.array(value))

    def _simulate(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        return _ExperimentRun(self, heading, arrays).answer()

    def _point(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        point = PointEvaluation(
            self.instance, heading["values"], arrays.get("x"), arrays["u"], heading["time"], tuple(heading["outputs"])
        )
        slopes, outputs = point.evaluate()
        found = {"x": point.x, "slopes": slopes, "outputs": outputs}
        if not heading["jacobian"]:
            return {}, found
        d = point.derivatives(heading["parameters"], heading["sizes"], check=heading["check"])
        return {"error": d.error, "near": d.near}, {
            **found, "jacobian": d.matrix, "directional": d.directional.astype(float), "nominals": self.instance.nominals()
        }  # fmt: skip

    def _starts(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Message:
        """Return what the parameters stand at where nobody sets them."""
        d = self.description
        u = np.array([v.start or 0.0 for v in d.inputs.values()])
        self.instance.begin({}, u, 0.0, None, None)
        return {}, {"parameters": VariableGroup(self.instance.library, tuple(d.parameters.values())).get().copy()}


class _ExperimentRun:
    """One experiment: a run, and derivatives by the best way there is for each parameter."""

    def __init__(self, jobs: RequestHandler, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
        self.jobs, self.description, self.learned = jobs, jobs.description, jobs.learned
        self.values: dict[str, float] = heading["values"]
        self.names = tuple(heading["outputs"])
        self.parameters: list[str] = heading["parameters"]
        self.wanted: list[str] = heading.get("wanted", self.parameters)  # the other columns are made elsewhere
        self.sizes = dict(zip(self.parameters, heading["sizes"], strict=True))
        self.bounds = dict(zip(self.parameters, heading["bounds"], strict=True))
        self.starts: dict[str, float] = dict(zip(self.parameters, heading["starts"], strict=True))
        self.tolerance: float = heading["tolerance"]
        self.time = arrays["time"]
        self.signals = PackedInputs(arrays["sizes"], arrays["times"], arrays["points"], arrays["breaks"])
        self.inputs = list(self.description.inputs)
        # Constants of the inputs' directions: parameters 0, of size 1, that move all inputs along a line of points.
        self.directions: dict[str, str] = heading.get("directions", {})
        self.along = dict(zip(self.directions, arrays.get("directions", np.empty((0, 0))), strict=True))
        asked = repr((self.names, self.tolerance)).encode()
        key = b"".join(arrays[n].tobytes() for n in ("time", "times", "points"))
        self.key = hashlib.sha256(key + asked).digest()
        # Noise and steps are those of one experiment, whatever its inputs go through before they enter.
        kin = str(heading.get("kin", "")).encode()
        self.kin = hashlib.sha256(arrays["time"].tobytes() + kin + asked).digest() if kin else self.key
        self.partial = bool(heading.get("partial"))  # whether a run that the FMU ends counts, with its rows
        self.ended: tuple[float, int] | None = None  # when it ended this one, s, and the rows up to there
        self.notes: dict[str, str] = {}
        self.counts = model_exchange.Counts()
        if "base" in arrays:
            self.jobs.last = (self._key_of(self.values, self.signals), arrays["base"])

    def answer(self) -> Message:
        if "restart" not in self.learned:
            self._find_reuse()
        if REPEATED[self.learned["restart"]]:
            self.notes["restart"] = REPEATED[self.learned["restart"]]
        if self.description.interface == "co-simulation":
            self._find_calls()
        gradients = np.zeros((self.time.size, len(self.names), len(self.parameters)))
        errors = np.zeros(len(self.parameters))
        smooth = self._trusted()
        found = self._with_tangent(smooth, gradients) if smooth else None
        rest = [n for n in self.parameters if found is None or n not in smooth]
        outputs = self._run(self.values) if found is None else found
        for name in rest:
            if name in self.wanted:
                j = self.parameters.index(name)
                gradients[:, :, j], errors[j] = self._by_differences(name, outputs)
        unseen = [n for n, e in zip(self.parameters, errors.tolist(), strict=True) if e > LOST]
        for name in unseen:  # a column of noise would pass for a direction
            j = self.parameters.index(name)
            gradients[:, :, j], errors[j] = 0.0, 0.0
        if unseen:
            self.notes["not seen above the noise of the runs"] = ", ".join(unseen)
        if self.parameters:
            ways = {n: "differences of runs" if n in rest else "directional derivatives" for n in self.parameters}
            self.notes["sensitivities"] = "; ".join(
                f"{way}: {', '.join(n for n in ways if ways[n] == way)}" for way in dict.fromkeys(ways.values())
            )
        if self.description.interface == "co-simulation":
            self.notes |= co_simulation.notes(self.learned)
        c = self.counts
        counts = [c.accepted, c.events, c.evaluations, c.segments]
        if self.ended is not None:
            t, count = self.ended
            self.notes["end"] = f"the FMU asked for the end of the run at {t:.6g} s: the rows go up to there"
            outputs, gradients = outputs[:count], gradients[:count]
        return {"notes": self.notes, "counts": counts}, {"outputs": outputs, "gradients": gradients, "errors": errors}

    def _find_reuse(self) -> None:
        """Learn how the FMU is brought back to its start, from runs of this experiment in processes of their own."""
        d = self.description
        names = tuple(dict.fromkeys([*self.names, *d.outputs, *d.states]))

        def run(signals: PackedInputs) -> Callable[[Instance], Array]:
            def made(instance: Instance) -> Array:
                self.jobs.tell()
                return self._rows(instance, self.values, signals, names, model_exchange.Counts())

            return made

        way, rows = find_reuse(self.jobs.make, run(self.signals))
        steps = [STIRRED * max(abs(v.start or 0.0), v.nominal) * v.continuous for v in d.inputs.values()]
        if any(steps) and not moving(rows).any():  # at rest throughout: the start of a run is its end
            third = float(self.time[0] + (self.time[-1] - self.time[0]) / 3.0)
            way = self._stirred(run(self.signals.stirred(steps, third)), way)
        self.learned["restart"] = way

    def _stirred(self, run: Callable[[Instance], Array], way: Reuse) -> Reuse:
        """Return the way as a run with inputs that move has it; the one found before where that run fails."""
        try:
            return find_reuse(self.jobs.make, run)[0]
        except RunFailed:
            return way

    def _find_calls(self) -> None:
        """Learn how a co-simulation FMU has to be called, where this experiment can show it."""
        names = tuple(dict.fromkeys([*self.names, *self.description.outputs]))

        def run(calls: co_simulation.CallPattern, time: Array) -> Array:
            self.jobs.tell()

            def rows(instance: Instance) -> Array:
                try:
                    return co_simulation.run(instance, self.values, self.signals, time, names, self.tolerance, calls)
                except RunEnded as e:
                    return self._padded(e, time.size)

            if self.jobs.isolated:
                return self._in_its_own_process(rows, model_exchange.Counts())
            self.jobs.runs += 1
            try:
                return rows(self.jobs.instance)
            except (FmiError, RunFailed) as e:
                raise self.jobs.failed(e) from None

        co_simulation.find_calls(self.learned, self.description, self.signals, self.time, self.tolerance, run)

    # --- runs ---

    def _now(self, name: str) -> float:
        """Where a parameter stands; for an input, or a direction of inputs, what is added of it, 0."""
        return 0.0 if name in self.inputs or name in self.along else self.values.get(name, self.starts[name])

    def _with(self, moved: Mapping[str, float]) -> tuple[dict[str, float], PackedInputs]:
        """Return the values and signals of a run with parameters at other values, or constants added to inputs."""
        signals, values = self.signals, dict(self.values)
        for name, value in moved.items():
            if name in self.along:
                signals = replace(signals, values=signals.values + value * self.along[name])
            elif name in self.inputs:
                signals = signals.raised(self.inputs.index(name), value)
            else:
                values[name] = value
        return values, signals

    def _run(self, values: Mapping[str, float], signals: PackedInputs | None = None) -> Array:
        """(n, outputs) of a run without derivatives, checked to be finite; the last one is kept for whoever asks again."""
        moved = self.signals if signals is None else signals
        own = values is self.values and moved is self.signals
        key = self._key_of(values, moved)
        if own and self.jobs.last is not None and self.jobs.last[0] == key:
            return self.jobs.last[1]
        counts = self.counts if own else model_exchange.Counts()
        if self.jobs.isolated:
            outputs = self._in_its_own_process(lambda p: self._rows(p, values, moved, self.names, counts), counts)
        else:
            outputs = self._rows(self.jobs.instance, values, moved, self.names, counts)
        reached = outputs if self.ended is None else outputs[: self.ended[1]]
        bad = ~np.isfinite(reached).all(axis=0)
        if bad.any():
            row = int(np.flatnonzero(~np.isfinite(reached).all(axis=1))[0])
            name = self.names[int(np.flatnonzero(bad)[0])]
            raise RunFailed(
                f"output '{name}' is not finite", float(self.time[row]), "check parameter values and limits"
            )
        if own and self.ended is None:
            self.jobs.last = (key, outputs)
        return outputs

    def _key_of(self, values: Mapping[str, float], signals: PackedInputs) -> bytes:
        """Return everything that decides the outputs of a run."""
        return self.key + signals.values.tobytes() + repr(sorted(values.items())).encode()

    def _in_its_own_process(self, run: Callable[[Instance], Array], counts: model_exchange.Counts) -> Array:
        """(n, outputs) of a run in a process made for it; what it finds out of the FMU is kept."""

        def work() -> Message:
            instance = self.jobs.make({k: v for k, v in self.learned.items() if k != "restart"})
            rows = run(instance)
            return {"learned": instance.learned, "counts": asdict(counts), "end": self.ended}, {"rows": rows}

        heading, arrays = isolated_result(work)
        self.jobs.runs += 1
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
        finer: float = 1.0,
    ) -> Array:
        """(n, names) of a run as the FMU gives them; NaN after an end that it asked for, where such a run counts.

        finer: factor on the integrator's tolerance.
        """
        self.jobs.runs += 1
        try:
            if instance.library.exchange:
                run = model_exchange.ModelExchangeRun(
                    instance, signals, self.time, names, finer * self.tolerance, counts=counts
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
        """(count, names) of a run that the FMU ended, NaN after that. Raises the end where such a run does not count."""
        rows = ended.rows
        if not self.partial or rows is None or not rows.size:
            raise ended
        return np.vstack([rows, np.full((count - rows.shape[0], rows.shape[1]), np.nan)])

    # --- derivatives that ride along ---

    def _trusted(self) -> list[str]:
        """The parameters, and inputs, whose directional derivatives a whole run has confirmed."""
        d = self.description
        if not self.parameters or self.jobs.isolated or not (d.directional and d.states):
            return []
        known = {**d.parameters, **{n: v for n, v in d.inputs.items() if v.continuous}}
        plain = [n for n in self.parameters if n in known and n not in self.along]
        fit = [n for n in plain if known[n].kind in ("Real", "Float64")]
        confirmed: dict[str, bool] = self.learned.setdefault("derivatives", {})
        new = [n for n in fit if n not in confirmed]
        if new:
            confirmed |= self._confirmed(new)
        return [n for n in fit if confirmed.get(n)]

    def _confirmed(self, names: list[str]) -> dict[str, bool]:
        """Return which directional derivatives hold over this whole run.

        The FMI standard takes states and inputs as knowns of a directional derivative. By parameters some FMUs give
        other figures, and some move the parameter: so the run with sensitivities has to be the run without, the
        parameters have to stand after it as before, and each column has to be the difference of runs.
        """
        instance = self.jobs.instance
        plain = model_exchange.Counts()
        outputs = self._rows(instance, self.values, self.signals, self.names, plain)
        noise = rms(outputs - self._rows(instance, self.values, self.signals, self.names, model_exchange.Counts(), 0.5))
        parameters = VariableGroup(instance.library, tuple(self.description.parameters.values()))
        before = parameters.get().copy()
        try:
            run = self._tangent_run(names, model_exchange.Counts(), EXCESS * plain.accepted + 1000)
            moved = not np.array_equal(before, parameters.get(), equal_nan=True)
        except (RunFailed, FmiError, model_exchange.SensitivitiesLost):
            moved = True
        instance.renew()
        size = np.abs(outputs).max(axis=0, initial=0.0)
        if moved or (rms(run.outputs - outputs) > SPREAD * (noise + self.tolerance * size)).any():
            return {n: len(names) > 1 and self._confirmed([n])[n] for n in names}
        return {n: self._agrees(n, run.gradients[:, :, j], outputs, noise) for j, n in enumerate(names)}

    def _agrees(self, name: str, column: Array, outputs: Array, noise: Array) -> bool:
        """Return whether a column is the difference of two runs, as far as their bend and noise let it be told."""
        low, high = self.bounds[name]
        size = self.sizes[name]
        runs = self._moving(name)
        found, bend = pair(runs, self._now(name), NEAR * size, low, high, outputs)
        strength = rms(found)
        doubt = rms(bend) * NEAR * size + 2.0 * noise / (NEAR * size)
        told = (doubt <= TOLD * strength) | (strength <= 2.0 * noise / (NEAR * size))
        return bool((told & (rms(column - found) <= doubt + ENOUGH * strength)).all())

    def _tangent_run(
        self, names: Sequence[str], counts: model_exchange.Counts, most: int = model_exchange.MOST_STEPS
    ) -> model_exchange.ModelExchangeRun:
        """Return the run with sensitivities. Raises SensitivitiesLost where an event makes them wrong."""
        instance = self.jobs.instance
        start = np.column_stack([self._start_slope(n) for n in names])
        tangent = VariationalEquations(instance, names, [self.sizes[n] for n in names], self.names)
        run = model_exchange.ModelExchangeRun(
            instance, self.signals, self.time, self.names, self.tolerance, tangent, start, counts=counts, most=most
        )
        run.go(self.values)
        return run

    def _with_tangent(self, names: Sequence[str], gradients: Array) -> Array | None:
        """(n, outputs) with the gradients filled in; None where an event makes the columns wrong."""
        try:
            run = self._tangent_run(names, self.counts)
        except model_exchange.SensitivitiesLost as e:
            self.notes["events"] = f"{e}: derivatives come from differences of runs"
            return None
        gradients[:, :, [self.parameters.index(n) for n in names]] = run.gradients
        if not (np.isfinite(run.outputs).all() and np.isfinite(run.gradients).all()):
            raise RunFailed("an output or its sensitivity is not finite", hint="check parameter values and limits")
        return run.outputs

    def _start_slope(self, name: str) -> Array:
        """(nx,) dx0/dp, from initialisations at two steps, extrapolated."""
        t = float(self.time[0])
        low, high = self.bounds[name]
        instance = self.jobs.instance

        def start(value: float) -> Array:
            values, signals = self._with({name: value})
            instance.begin(values, signals.at(self.time[:1], "left")[0], t, None, self.tolerance)
            return instance.library.get_states()[:, None]

        at = self._now(name)
        h = START_STEP * self.sizes[name]
        middle = start(at)
        coarse, fine = (pair(start, at, s, low, high, middle)[0][:, 0] for s in (h, 0.5 * h))
        return np.asarray((4.0 * fine - coarse) / 3.0)

    # --- derivatives from runs ---

    def _moving(self, name: str) -> Callable[[float], Array]:
        """Return the run as a function of one parameter."""

        def run(value: float) -> Array:
            self.jobs.tell()
            return self._run(*self._with({name: value}))

        return run

    def _by_differences(self, name: str, outputs: Array) -> tuple[Array, float]:
        """(n, outputs) derivatives by one parameter, and their relative error."""
        low, high = self.bounds[name]
        at = self._now(name)
        octave = round(float(np.log2(abs(at)))) if at else 0  # a step chosen at half the value is chosen anew
        key = self.kin + f"{self.directions.get(name, name)} {octave}".encode()
        step = self.jobs.steps.get(key)
        if step is not None:
            return derivative(self._moving(name), at, step, low, high, outputs), step.error
        column, step = first(self._moving(name), at, self.sizes[name], low, high, outputs, self._noise(outputs))
        if len(self.jobs.steps) < KEPT_STEPS:
            self.jobs.steps[key] = step
        return column, step.error

    def _noise(self, outputs: Array) -> Array:
        """(outputs,) noise of a run of this experiment."""
        found = self.jobs.noise.get(self.kin)
        if found is None:
            found = noise_of(self._aside, outputs)
            if len(self.jobs.noise) < KEPT_STEPS:
                self.jobs.noise[self.kin] = found
        return found

    def _aside(self, steps: float) -> Array:
        """(n, outputs) of a run with every parameter so many short steps away, to the side where there is room."""
        self.jobs.tell()
        moved = {}
        for name in self.parameters:
            at, (low, high) = self._now(name), self.bounds[name]
            moved[name] = at + (steps if high - at >= at - low else -steps) * SHORT * self.sizes[name]
        return self._run(*self._with(moved))


def isolated_result(work: Callable[[], Message]) -> Message:
    """Return what the work returns, done in a new process. Raises its failure; ends this process as that one ended."""
    parts, end = in_new_process(lambda hand: hand(work()), lambda e: failure(e).told())
    if isinstance(end, dict):
        raise RunFailed.heard(end)
    if isinstance(end, int):
        die_like(end)
    return parts[0]
