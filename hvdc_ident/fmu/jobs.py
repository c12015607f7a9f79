"""What a worker does when asked: whole runs with their derivatives, and points. Runs in the worker alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hvdc_ident.fmu import co_simulation, exchange
from hvdc_ident.fmu.binding import Failure
from hvdc_ident.fmu.differences import Step, choose, slope
from hvdc_ident.fmu.plant import Plant, RunFailed
from hvdc_ident.fmu.signals import Signals
from hvdc_ident.fmu.tangent import Point, Tangent
from hvdc_ident.trajectory import Array

KEPT_STEPS = 1000
Answer = tuple[dict[str, Any], dict[str, Array]]
LOST = 0.5  # relative error from which a derivative is not told from noise
START_STEP = 1e-3  # of differences of the start by a parameter, in its sizes


@dataclass
class Jobs:
    """A plant with what was learned of it. tell: called between runs of one job, so that nobody waits in vain."""

    plant: Plant
    tell: Callable[[], None]
    steps: dict[bytes, Step] = field(default_factory=dict)
    trusted: dict[str, bool] = field(default_factory=dict)
    runs: int = 0

    def do(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Answer:
        """The answer to a request."""
        kind = heading["do"]
        if kind == "simulate":
            return _Simulation(self, heading, arrays).answer()
        if kind == "point":
            return self._point(heading, arrays)
        if kind == "starts":
            return self._starts()
        raise ValueError(f"no job '{kind}'")

    def _point(self, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> Answer:
        point = Point(
            self.plant, heading["values"], arrays.get("x"), arrays["u"], heading["time"], tuple(heading["outputs"])
        )
        slopes, outputs = point.evaluate()
        found = {"x": point.x, "slopes": slopes, "outputs": outputs}
        if not heading["jacobian"]:
            return {}, found
        d = point.derivatives(heading["parameters"], heading["sizes"], check=heading["check"])
        return {"error": d.error, "near": d.near}, {
            **found, "jacobian": d.matrix, "directional": d.directional.astype(float), "nominals": self.plant.nominals()
        }  # fmt: skip

    def _starts(self) -> Answer:
        """What the parameters stand at where nobody sets them."""
        from hvdc_ident.fmu.binding import Block

        d = self.plant.description
        u = np.array([v.start or 0.0 for v in d.inputs.values()])
        self.plant.begin({}, u, 0.0, None, None)
        return {}, {"parameters": Block(self.plant.binding, tuple(d.parameters.values())).get().copy()}


class _Simulation:
    """One experiment: a run, and derivatives by the best way there is for each parameter."""

    def __init__(self, jobs: Jobs, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
        self.jobs, self.plant = jobs, jobs.plant
        self.values: dict[str, float] = heading["values"]
        self.names = tuple(heading["outputs"])
        self.parameters: list[str] = heading["parameters"]
        self.sizes = dict(zip(self.parameters, heading["sizes"], strict=True))
        self.bounds = dict(zip(self.parameters, heading["bounds"], strict=True))
        self.starts: dict[str, float] = dict(zip(self.parameters, heading["starts"], strict=True))
        self.tolerance: float = heading["tolerance"]
        self.time = arrays["time"]
        self.signals = Signals(arrays["sizes"], arrays["times"], arrays["points"], arrays["breaks"])
        self.inputs = list(self.plant.description.inputs)
        key = b"".join(arrays[n].tobytes() for n in ("time", "times", "points"))
        self.key = hashlib.sha256(key + repr((self.names, self.tolerance)).encode()).digest()
        self.notes: dict[str, str] = {}
        self.counts = exchange.Counts()

    def answer(self) -> Answer:
        gradients = np.zeros((self.time.size, len(self.names), len(self.parameters)))
        errors = np.zeros(len(self.parameters))
        smooth = self._trusted() if self.parameters and self.plant.binding.exchange else []
        found = self._with_tangent(smooth, gradients) if smooth else None
        rest = self.parameters if found is None else [n for n in self.parameters if n not in smooth]
        outputs = self._run(self.values) if found is None else found
        for name in rest:
            j = self.parameters.index(name)
            gradients[:, :, j], errors[j] = self._by_differences(name)
        unseen = [n for n, e in zip(self.parameters, errors.tolist(), strict=True) if e > LOST]
        for name in unseen:  # a column of noise would pass for a direction
            j = self.parameters.index(name)
            gradients[:, :, j], errors[j] = 0.0, 0.0
        if unseen:
            self.notes["not seen above the noise of the runs"] = ", ".join(unseen)
        if self.parameters:
            ways = {
                n: "central differences of runs" if n in rest else "directional derivatives" for n in self.parameters
            }
            self.notes["sensitivities"] = "; ".join(
                f"{way}: {', '.join(n for n in ways if ways[n] == way)}" for way in dict.fromkeys(ways.values())
            )
        c = self.counts
        counts = [c.accepted, c.events, c.evaluations, c.segments]
        return {"notes": self.notes, "counts": counts}, {"outputs": outputs, "gradients": gradients, "errors": errors}

    # --- runs ---

    def _now(self, name: str) -> float:
        """Where a parameter stands; for an input the constant that is added to it, 0."""
        return 0.0 if name in self.inputs else self.values.get(name, self.starts[name])

    def _with(self, name: str, value: float) -> tuple[dict[str, float], Signals]:
        """Values and signals of a run with a parameter elsewhere, or a constant added to an input."""
        if name in self.inputs:
            return self.values, self.signals.raised(self.inputs.index(name), value)
        return {**self.values, name: value}, self.signals

    def _run(self, values: Mapping[str, float], signals: Signals | None = None) -> Array:
        """(n, outputs) of a run without derivatives, checked to be finite."""
        moved = self.signals if signals is None else signals
        counts = self.counts if values is self.values and moved is self.signals else exchange.Counts()
        if self.plant.binding.exchange:
            run = exchange.Run(self.plant, moved, self.time, self.names, self.tolerance, counts=counts)
            run.go(values)
            outputs = run.outputs
        else:
            outputs = co_simulation.run(self.plant, values, moved, self.time, self.names, self.tolerance)
            counts.segments += 1
        bad = ~np.isfinite(outputs).all(axis=0)
        if bad.any():
            row = int(np.flatnonzero(~np.isfinite(outputs).all(axis=1))[0])
            name = self.names[int(np.flatnonzero(bad)[0])]
            raise RunFailed(
                f"output '{name}' is not finite", float(self.time[row]), "check parameter values and limits"
            )
        self.jobs.runs += 1
        return outputs

    def _with_tangent(self, names: Sequence[str], gradients: Array) -> Array | None:
        """(n, outputs) with the gradients filled in; None where an event makes the columns wrong."""
        sizes = [self.sizes[n] for n in names]
        start = np.column_stack([self._start_slope(n) for n in names])
        tangent = Tangent(self.plant, names, sizes, self.names)
        run = exchange.Run(
            self.plant, self.signals, self.time, self.names, self.tolerance, tangent, start, counts=self.counts
        )
        try:
            run.go(self.values)
        except exchange.SensitivitiesLost as e:
            self.notes["events"] = f"{e}: derivatives come from differences of runs"
            return None
        self.jobs.runs += 1
        places = [self.parameters.index(n) for n in names]
        gradients[:, :, places] = run.gradients
        if not (np.isfinite(run.outputs).all() and np.isfinite(run.gradients).all()):
            raise RunFailed("an output or its sensitivity is not finite", hint="check parameter values and limits")
        return run.outputs

    def _start_slope(self, name: str) -> Array:
        """(nx,) dx0/dp, from initialisations at two steps, extrapolated."""
        t = float(self.time[0])
        low, high = self.bounds[name]

        def start(value: float) -> Array:
            values, signals = self._with(name, value)
            self.plant.begin(values, signals.at(self.time[:1], "left")[0], t, None, self.tolerance)
            return self.plant.binding.get_states()[:, None]

        at = self._now(name)
        h = START_STEP * self.sizes[name]
        coarse, fine = (slope(start, at, s, low, high)[:, 0] for s in (h, 0.5 * h))
        return np.asarray((4.0 * fine - coarse) / 3.0)

    def _trusted(self) -> list[str]:
        """The parameters whose directional derivatives agree with differences, beside the start."""
        d = self.plant.description
        if not d.directional or not d.states:
            return []
        known = {**d.parameters, **{n: v for n, v in d.inputs.items() if v.continuous}}
        fit = [n for n in self.parameters if n in known and known[n].kind in ("Real", "Float64")]
        new = [n for n in fit if n not in self.jobs.trusted]
        if new:
            asked = [n for n in new if n in d.parameters]
            found = self._agreeing(asked)
            main = bool(found[: found.size - len(asked)].all())
            own = dict(zip(asked, found[found.size - len(asked) :].tolist(), strict=True))
            self.jobs.trusted |= {n: main and bool(own.get(n, True)) for n in new}
        return [n for n in self.parameters if self.jobs.trusted.get(n)]

    def _agreeing(self, names: list[str]) -> Array:
        """Which columns of states, inputs and parameters agree, a little beside the start, where no term is at rest."""
        u, t = self.signals.at(self.time[:1], "left")[0], float(self.time[0])
        start = Point(self.plant, self.values, None, u, t, self.names)
        moved = start.x + 1e-3 * self.plant.nominals() * (-1.0) ** np.arange(start.x.size)
        try:
            point = Point(self.plant, self.values, moved, u, t, self.names)
        except RunFailed:  # an event resets the states there: the start itself has to do
            point = Point(self.plant, self.values, None, u, t, self.names)
        return point.derivatives(names, [self.sizes[n] for n in names]).directional

    def _by_differences(self, name: str) -> tuple[Array, float]:
        """(n, outputs) derivatives by one parameter, and their relative error."""
        low, high = self.bounds[name]
        at = self._now(name)

        def runs(value: float) -> Array:
            self.jobs.tell()
            return self._run(*self._with(name, value))

        octave = round(float(np.log2(abs(at)))) if at else 0  # a step chosen at half the value is chosen anew
        key = self.key + f"{name} {octave}".encode()
        step = self.jobs.steps.get(key)
        if step is None:
            step = choose(runs, at, self.sizes[name], low, high)
            if len(self.jobs.steps) < KEPT_STEPS:
                self.jobs.steps[key] = step
        return slope(runs, at, step.h, low, high), step.error


__all__ = ["Failure", "Jobs"]
