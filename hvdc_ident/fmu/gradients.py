"""A run of an FMU and its derivatives, each by the best method; the runs that they need are made in the pool's workers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fmu.description import Message, Variable
from hvdc_ident.fmu.differences import (
    SHORT_STEP,
    SUFFICIENT,
    Differences,
    ParameterRuns,
    difference,
    difference_pair,
    extrapolated_difference,
    first_difference,
    noise_of,
    rms,
    together,
)
from hvdc_ident.fmu.request import RunRequest
from hvdc_ident.fmu.worker_pool import WorkerPool

LOST_IN_NOISE = 0.5  # relative error from which a derivative is not distinguished from noise
START_STEP = 1e-3  # of differences of the initial state by a parameter, in its sizes
CONFIRMING_STEP = 1e-3  # of the differences that confirm directional derivatives, in sizes of the parameter
CONFIRMING_DOUBT = 0.1  # relative uncertainty of a difference of runs above which it confirms nothing
CONFIRMING_NOISE = 10.0  # times the noise that a run with sensitivities may differ from the run without
EXCESS_STEPS = 20  # times the steps of a plain run that one with sensitivities may take before it is given up


@dataclass(frozen=True, eq=False)
class Varied:
    """A parameter that a run is differentiated by, or a constant times which all inputs move along a direction.

    value: where the derivative is taken, within [low, high]. size: a typical one. variable: the FMU's parameter or input
    that it is, None for another direction. points: of that direction, to be added to those of each input; None for a parameter. key:
    shared by those that need the same difference step.
    """

    name: str
    key: str
    value: float = 0.0
    size: float = 1.0
    low: float = -math.inf
    high: float = math.inf
    variable: Variable | None = None
    points: tuple[Array, ...] | None = None

    @property
    def label(self) -> str:
        """Name of the column among those of a run: the parameter, and of a variable's points their digest."""
        return (
            self.name
            if self.points is None
            else f"{self.name} {sha256(np.concatenate(self.points).tobytes()).hexdigest()}"
        )

    def moved(self, run: RunRequest, value: float) -> RunRequest:
        """Return the run at another value."""
        if self.points is None:
            return replace(run, values={**run.values, self.name: value})
        return run.moved(value, self.points)

    def line(self, run: RunRequest, middle: Array) -> ParameterRuns[RunRequest]:
        """Return the runs along it. middle: the outputs at its value."""
        return ParameterRuns(lambda value: self.moved(run, value), self.value, self.size, self.low, self.high, middle)


@dataclass(frozen=True, eq=False)
class DifferentiatedRun:
    """A run with derivatives.

    outputs: (n, names). labels: of what it is differentiated by. gradients: (n, names, labels). errors: (labels,) relative.
    counts: steps, events, evaluations and segments. notes: on the methods. end: the instant at which the FMU asked for the
    end, s, or None. directional: whether derivatives of the FMU's own were integrated with it.
    """

    outputs: Array
    labels: tuple[str, ...]
    gradients: Array
    errors: Array
    counts: list[int]
    notes: Mapping[str, str]
    end: float | None
    directional: bool

    @property
    def size(self) -> int:
        """Bytes of its arrays."""
        return self.outputs.nbytes + self.gradients.nbytes

    def has(self, labels: Sequence[str]) -> bool:
        """Return whether it has these derivatives, and is the run that is made for them: plain where none are wanted."""
        return set(labels) <= set(self.labels) and bool(labels or not self.directional)


class Differentiation:
    """The making of a run with its derivatives.

    noise_key: shared by runs whose noise and difference steps are alike though their inputs differ. partial: whether the
    rows up to an end that the FMU asks for are accepted. known: the same run with other derivatives, or none.
    """

    def __init__(
        self,
        pool: WorkerPool,
        run: RunRequest,
        varied: Sequence[Varied],
        noise_key: str = "",
        partial: bool = False,
        known: DifferentiatedRun | None = None,
    ) -> None:
        self.pool, self.run, self.varied, self.partial = pool, run, varied, partial
        self.noise_key = run.experiment(noise_key)
        self.notes: dict[str, str] = {}
        self.counts = [0, 0, 0, 0]
        self.end: float | None = None
        self.gradients = np.zeros((run.time.size, len(run.names), len(varied)))
        self.errors = np.zeros(len(varied))
        self._made = (known.outputs, known.counts) if known is not None and not known.directional else None

    def result(self) -> DifferentiatedRun:
        """Make the runs that are needed. Raises SimulationError where one fails."""
        if "restart" not in self.pool.learned:
            self._plain()  # finds it out
        directional = self._confirmed()
        outputs = self._integrated(directional) if directional else None
        if outputs is None:
            directional, outputs = [], self._plain()
        others = [v for v in self.varied if v not in directional]
        for v, (column, error) in zip(others, self._by_differences(others, outputs), strict=True):
            self._enter(v, column)
            self.errors[self.varied.index(v)] = error
        lost = self.errors > LOST_IN_NOISE
        self.gradients[:, :, lost], self.errors[lost] = 0.0, 0.0  # a column of noise would pass for a direction
        if lost.any():
            unseen = [v.name for v, gone in zip(self.varied, lost.tolist(), strict=True) if gone]
            self.notes["not seen above the noise of the runs"] = ", ".join(unseen)
        methods: dict[str, list[str]] = {}
        for v in self.varied:
            method = "directional derivatives" if v in directional else "differences of runs"
            methods.setdefault(method, []).append(v.name)
        if methods:
            self.notes["sensitivities"] = "; ".join(f"{m}: {', '.join(names)}" for m, names in methods.items())
        labels, gradients = tuple(v.label for v in self.varied), self.gradients[: outputs.shape[0]]
        integrated = bool(directional)
        return DifferentiatedRun(outputs, labels, gradients, self.errors, self.counts, self.notes, self.end, integrated)

    def _enter(self, v: Varied, column: Array) -> None:
        self.gradients[:, :, self.varied.index(v)] = column

    def _plain(self) -> Array:
        """(n, outputs) of the run itself, which is made once."""
        if self._made is None:
            answer, out = self.pool.ask({"do": "run", "run": self.run, "partial": self.partial}, {})
            self._made, self.end = (out["outputs"], answer["counts"]), answer["end"]
            if self.end is not None:
                self.notes["end"] = f"the FMU asked for the end of the run at {self.end:.6g} s: the rows go up to there"
        outputs, self.counts = self._made
        return outputs

    def _rows(self, runs: Sequence[RunRequest]) -> list[Array]:
        """(n, outputs) of each run."""
        return [out["outputs"] for _, out in self.pool.ask_all([({"do": "run", "run": run}, {}) for run in runs])]

    # --- by differences of runs ---

    def _by_differences(self, varied: Sequence[Varied], outputs: Array) -> list[tuple[Array, float]]:
        """Return each derivative, (n, outputs), and its relative error. outputs: of the run itself."""
        steps, noise = self.pool.steps, np.empty(0)
        if any(self._step_key(v) not in steps for v in varied):
            noise = self._noise(outputs)

        def column(v: Varied) -> Differences[RunRequest, tuple[Array, float]]:
            line, key = v.line(self.run, outputs), self._step_key(v)
            if (step := steps.get(key)) is not None:
                return (yield from difference(line, step)), step.error
            rows, step = yield from first_difference(line, noise)
            steps[key] = step
            return rows, step.error

        return together([column(v) for v in varied], self._rows)

    def _step_key(self, v: Varied) -> bytes:
        """Return what runs share that need the same step; one chosen at half the value is chosen anew."""
        octave = round(float(np.log2(abs(v.value)))) if v.value else 0
        return self.noise_key + f"{v.key} {octave}".encode()

    def _noise(self, outputs: Array) -> Array:
        """(outputs,) noise of a run of this experiment."""

        def displaced(steps: float) -> RunRequest:
            """Every parameter moved by so many short steps, away from the nearer bound."""
            run = self.run
            for v in self.varied:
                side = 1.0 if v.high - v.value >= v.value - v.low else -1.0
                run = v.moved(run, v.value + side * steps * SHORT_STEP * v.size)
            return run

        known = self.pool.noise
        if self.noise_key not in known:
            (known[self.noise_key],) = together([noise_of(displaced, outputs)], self._rows)
        return known[self.noise_key]

    # --- by sensitivity equations ---

    def _confirmed(self) -> list[Varied]:
        """Return those whose directional derivatives a whole run has confirmed."""
        d, known = self.pool.description, self.pool.confirmed
        if self.pool.isolated or not (d.directional and d.states):
            return []
        real = [
            v
            for v in self.varied
            if v.variable is not None
            and v.variable.kind in ("Real", "Float64")
            and (v.points is None or v.variable.continuous)
        ]
        new = [v for v in real if v.name not in known]
        if new:
            known |= self._confirm(new)
        return [v for v in real if known[v.name]]

    def _confirm(self, varied: Sequence[Varied]) -> dict[str, bool]:
        """Return which directional derivatives hold over this whole run.

        The FMI standard takes states and inputs as knowns of a directional derivative. By parameters some FMUs give
        other figures, and some move the parameter: so the run with sensitivities has to be the run without, the
        parameters have to have their values after it, and each column has to be the difference of runs.
        """
        outputs, steps = self._plain(), self.counts[0]
        (finer,) = self._rows([replace(self.run, tolerance=0.5 * self.run.tolerance)])
        noise, size = rms(outputs - finer), np.abs(outputs).max(axis=0, initial=0.0)
        try:
            answer, out = self._asked(varied, EXCESS_STEPS * steps + 1000)
            lost = bool(answer["lost"])
        except SimulationError:
            lost = True
        allowed = CONFIRMING_NOISE * (noise + self.run.tolerance * size)
        if lost or (rms(out["outputs"] - outputs) > allowed).any():
            return {v.name: len(varied) > 1 and self._confirm([v])[v.name] for v in varied}

        def agrees(v: Varied, column: Array) -> Differences[RunRequest, bool]:
            h = CONFIRMING_STEP * v.size
            slope, curvature = yield from difference_pair(v.line(self.run, outputs), h)
            strength = rms(slope)
            doubt = rms(curvature) * h + 2.0 * noise / h
            conclusive = (doubt <= CONFIRMING_DOUBT * strength) | (strength <= 2.0 * noise / h)
            return bool((conclusive & (rms(column - slope) <= doubt + SUFFICIENT * strength)).all())

        held = together([agrees(v, out["gradients"][:, :, j]) for j, v in enumerate(varied)], self._rows)
        return {v.name: holds for v, holds in zip(varied, held, strict=True)}

    def _integrated(self, varied: Sequence[Varied]) -> Array | None:
        """(n, outputs) with the gradients filled in; None where an event makes the columns wrong."""
        answer, out = self._asked(varied, None)
        if answer["lost"]:
            self.notes["events"] = f"{answer['lost']}: derivatives come from differences of runs"
            return None
        self.counts = answer["counts"]
        for j, v in enumerate(varied):
            self._enter(v, out["gradients"][:, :, j])
        return out["outputs"]

    def _asked(self, varied: Sequence[Varied], max_steps: int | None) -> Message:
        """Return the answer to the request of a run with its sensitivities. max_steps: after which it is given up."""
        names, sizes = [v.name for v in varied], [v.size for v in varied]
        start = np.column_stack(self._start_derivatives(varied))
        wanted = {"sensitivities": names, "sizes": sizes, "max_steps": max_steps}
        return self.pool.ask({"do": "run", "run": self.run, **wanted}, {"start": start})

    def _start_derivatives(self, varied: Sequence[Varied]) -> list[Array]:
        """Return each (nx,) dx0/dp, from initialisations at two steps, extrapolated."""

        def column(v: Varied) -> Differences[RunRequest, Array]:
            (middle,) = yield [self.run]
            return (yield from extrapolated_difference(v.line(self.run, middle), START_STEP * v.size))

        return together([column(v) for v in varied], self._initial_states)

    def _initial_states(self, runs: Sequence[RunRequest]) -> list[Array]:
        """(nx,) the states that each run begins with."""
        if not runs:
            return []
        inputs = np.array([run.at(run.time[:1], before_jump=True)[0] for run in runs])
        heading = {"do": "initial", "values": [run.values for run in runs], "time": float(self.run.time[0])}
        return list(self.pool.ask({**heading, "tolerance": self.run.tolerance}, {"u": inputs})[1]["states"])
