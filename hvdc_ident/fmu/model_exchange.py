"""A run of a model-exchange FMU: scipy's LSODA between events, which are located on its interpolant. In worker processes only.

Sensitivities S = dx/dp are integrated as additional states, S' = A S + df/dp, each column one directional derivative.
"""

from __future__ import annotations

import warnings
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu.derivatives import SensitivityEquations
from hvdc_ident.fmu.fmi import DISCARD, FmiError, VariableGroup
from hvdc_ident.fmu.instance import Instance, RunEnded, RunFailed
from hvdc_ident.fmu.piecewise_linear import Interpolant
from hvdc_ident.fmu.request import RunRequest

MAX_STEPS = 200_000  # of a run
MAX_EVENTS = 100_000  # at states, of a run
MAX_CHATTER = 50  # events within CHATTER_SPAN of each other
CHATTER_SPAN = 1e-9  # share of the span
MAX_RETRIES = 8  # shorter steps tried where the FMU discards a point
JUMP_TOLERANCE = 1e-6  # change of a derivative at an event, against its size, that sensitivities cannot pass


class SensitivitiesLost(Exception):
    """An event at which a derivative or a state jumps: the columns S are not right after it."""


@dataclass
class Counts:
    """Counts of steps, events and evaluations of a run."""

    accepted: int = 0
    events: int = 0
    evaluations: int = 0
    segments: int = 0


@dataclass
class ModelExchangeRun:
    """One run. equations: of the sensitivities, or None. start: (nx, np) dx0/dp.

    max_steps: after which it is given up. outputs (n, names) and gradients (n, names, np) are filled row by row.
    """

    instance: Instance
    run: RunRequest
    equations: SensitivityEquations | None = None
    start: Array | None = None
    counts: Counts = field(default_factory=Counts)
    max_steps: int = MAX_STEPS

    def __post_init__(self) -> None:
        self.library, self.time = self.instance.library, self.run.time
        self.nx = self.library.nx
        self.inputs = [Interpolant(i) for i in self.run.inputs]
        variables = list(self.instance.description.inputs.values())
        # Inputs that are set at every instant; the others change at events alone.
        self.continuous = [
            k for k, (m, v) in enumerate(zip(self.inputs, variables, strict=True)) if v.continuous and not m.constant
        ]
        self.continuous_inputs = VariableGroup(self.library, [variables[k] for k in self.continuous])
        self.recorded = self.instance.variables(self.run.names)
        self.columns = self.equations.count if self.equations else 0
        self.outputs = np.empty((self.time.size, len(self.run.names)))
        self.gradients = np.zeros((self.time.size, len(self.run.names), self.columns))
        self.applied: list[float] | None = None  # present values of the continuous inputs
        self.flat = False  # whether they keep them until the segment's end
        self.row = 0
        self.end = float(self.time[-1])
        self.segment_end = self.end
        self.close: list[float] = []
        self.events = self.state_events = 0  # of this run
        self.last_digit = float(np.spacing(np.abs(self.time[[0, -1]]).max()))
        self.rounding = 0.0  # difference up to which instants are one

    def begin(self) -> None:
        """Initialise the instance. Raises RunFailed or FmiError."""
        t = float(self.time[0])
        self.instance.begin(self.run.values, self._inputs_at(t, before_jump=True), t, self.end, self.run.tolerance)

    def go(self) -> None:
        """Fill every row. Raises RunFailed, FmiError or SensitivitiesLost; RunEnded with the rows up to the end."""
        try:
            self._go()
        except RunEnded as e:
            while self.row < self.time.size and self.row > 0 and self.time[self.row] <= float(e.t or 0.0):
                self.outputs[self.row] = self.recorded.get()  # the FMU is at this instant
                self.row += 1
            e.rows = self.outputs[: self.row].copy()
            raise

    def _go(self) -> None:
        t = float(self.time[0])
        x = self.library.get_states()
        self.atol = 1e-2 * self.run.tolerance * self.instance.nominals()
        y = np.concatenate([x, *(self.start.T if self.start is not None and self.columns else [])])
        stops = sorted({*(s for s in self.run.breaks.tolist() if t <= s <= self.end), self.end})
        self.rounding = self._rounding(t)
        t, y = self._stop_at(t, y, stops)
        while t < self.end:
            stop = next(s for s in stops if s > t)
            due = self.instance.next_time
            self.rounding = self._rounding(stop)
            if due is not None and due <= t + self.rounding:
                t, y = self._stop_at(t, y, stops)
                continue
            self.segment_end = stop if due is None or abs(due - stop) <= self.rounding else min(due, stop)
            t, y = self._segment(t, y, self.segment_end)
            if t >= self.segment_end:
                t, y = self._stop_at(t, y, stops)

    def _rounding(self, t: float) -> float:
        """Return the difference up to which instants are one: no integrator can step from one to the other.

        Rows and jumps are off by some last digits of the largest instant. An FMU that adds its period to the last
        event's instant rounds each sum: after n events it is off by up to n/2 last digits.
        """
        return max(1e-12 * max(1.0, abs(t)), (8 + self.events) * self.last_digit)

    def _inputs_at(self, t: float, *, before_jump: bool) -> Array:
        """Return all inputs at an instant, before the jumps there or after them."""
        return np.array([m.at(t, before_jump) for m in self.inputs])

    # --- between stops ---

    def _segment(self, t: float, y: Array, end: float) -> tuple[float, Array]:
        """Integrate to `end` or to an event before it, which is processed; return the instant and the states."""
        self.counts.segments += 1
        self.positive = self.library.get_indicators() > 0.0
        self.flat = False
        self._set_point(t, y[: self.nx])
        self.flat = all(self.inputs[k].is_flat(t, end) for k in self.continuous)
        with warnings.catch_warnings(record=True) as caught:  # of the integrator, quoted where it gives up
            warnings.simplefilter("always")
            try:
                return self._steps(t, y, end, caught)
            finally:
                self.flat = False

    def _steps(self, t: float, y: Array, end: float, caught: list[warnings.WarningMessage]) -> tuple[float, Array]:
        solver = self._solver(t, y, end)
        rows, completed = self.time.tolist(), self.instance.description.completed_step
        retries = 0
        while solver.status == "running":
            before = float(solver.t)
            try:
                self._advance(solver, caught)
            except FmiError as e:
                if e.status != DISCARD or retries == MAX_RETRIES:
                    raise
                retries += 1
                solver = self._solver(before, y, end, (end - before) * 10.0**-retries)
                continue
            y = solver.y.copy() if self.nx else y
            if not np.isfinite(y.sum()):
                raise RunFailed("a state is not finite", float(solver.t), "check parameter values and limits")
            event = self._crossing(solver, before)
            t = float(solver.t) if event is None else event
            if self.row < len(rows) and rows[self.row] <= t:
                self._record_until(solver.dense_output(), min(t, end - self.rounding))
            if event is not None and self.nx:
                y = np.asarray(solver.dense_output()(event), dtype=float)
            if completed or event is not None or t >= end:
                self._set_point(t, y[: self.nx], before_jump=t >= end)
            wanted, over = self.library.completed_integrator_step() if completed else (False, False)
            if over:
                raise RunEnded(t)
            if event is not None:
                self._count_state_event(t)
                return t, self._event_at(t, y, None)
            if wanted:
                after = self._step_event(t, y, t - before)
                if after is not None:
                    return t, after
        return end, y

    def _solver(self, t: float, y: Array, end: float, most: float = np.inf) -> Any:
        from scipy.integrate import LSODA

        atol = np.concatenate([self.atol, *(self.atol / s for s in (self.equations.sizes if self.equations else []))])
        dummy = self.nx == 0
        if dummy:
            most = min(most, (end - t) / 50)
        jac = self._jacobian if self.equations is not None and not dummy else None
        return LSODA(
            (lambda _t, _y: np.zeros(1)) if dummy else self._derivatives,
            t,
            np.zeros(1) if dummy else y,
            end,
            rtol=self.run.tolerance,
            atol=1.0 if dummy else atol,
            jac=jac,
            max_step=most,
        )

    def _advance(self, solver: Any, caught: list[warnings.WarningMessage]) -> None:
        message = solver.step()
        self.counts.accepted += 1
        if solver.status == "failed":
            text = "; ".join([str(message or ""), *(str(w.message) for w in caught)])
            raise RunFailed(
                f"the integrator gave up: {' '.join(text.split())[:200]}", float(solver.t), "check parameter values"
            )
        if self.counts.accepted > self.max_steps:
            raise RunFailed(
                f"more than {self.max_steps} steps", float(solver.t), "look for a very fast part of the model"
            )

    def _set_point(self, t: float, x: Array, *, before_jump: bool = False) -> None:
        """Set the instant, the state and the continuous inputs."""
        self.library.set_time(t)
        self.library.set_states(x)
        if self.continuous and not (self.flat and t < self.segment_end):
            u = [self.inputs[k].at(t, before_jump or t >= self.segment_end) for k in self.continuous]
            if u != self.applied:  # held inputs keep their values for thousands of calls
                self.continuous_inputs.set(u)
                self.applied = u

    def _derivatives(self, t: float, y: Array) -> Array:
        self.counts.evaluations += 1
        self._set_point(t, y[: self.nx])
        derivatives = self.library.get_derivatives()
        if not self.columns:
            return derivatives.copy()
        result = np.empty(y.size)
        result[: self.nx] = derivatives
        assert self.equations is not None
        for j in range(self.columns):
            part = slice((j + 1) * self.nx, (j + 2) * self.nx)
            result[part] = self.equations.derivatives(j, y[part])
        return result

    def _jacobian(self, t: float, y: Array) -> Array:
        """Return the matrix of the stiff method's iteration: A on the diagonal, without the coupling of S to x."""
        assert self.equations is not None
        self._set_point(t, y[: self.nx])
        a = self.equations.state_matrix()
        return np.asarray(np.kron(np.eye(1 + self.columns), a), dtype=float) if self.columns else a

    # --- events ---

    def _crossing(self, solver: Any, before: float) -> float | None:
        """Return the instant just after the first indicator of a step changed its sign, or None."""
        if not self.library.indicators.size:
            return None
        t = float(solver.t)
        inside = [s for s in self.time[self.row :][: np.searchsorted(self.time[self.row :], t)].tolist() if s > before]
        dense: Any = None
        low = before
        for s in [*inside, t]:
            if s < t and dense is None:
                dense = solver.dense_output()
            z = self._indicators(s, (dense(s) if s < t else solver.y)[: self.nx])
            if ((z > 0.0) != self.positive).any():
                return self._located(dense or solver.dense_output(), low, s)
            low = s
        return None

    def _indicators(self, t: float, x: Array) -> Array:
        self._set_point(t, x)
        return self.library.get_indicators()

    def _located(self, dense: Any, low: float, high: float) -> float:
        """Return the right end of a bracket of the first change of sign, as narrow as the resolution of time allows."""
        z_low = self._indicators(low, dense(low)[: self.nx])
        z_high = self._indicators(high, dense(high)[: self.nx])
        width = 1e-13 * max(abs(low), abs(high), self.end - float(self.time[0]))
        halve = False
        while high - low > width:
            changed = np.flatnonzero((z_high > 0.0) != self.positive)
            middle = 0.5 * (low + high)
            steep = z_high[changed] - z_low[changed]
            if not halve and changed.size and (steep != 0.0).all():
                guess = float((low - z_low[changed] * (high - low) / steep).min())
                edge = 0.01 * (high - low)
                middle = (
                    min(max(guess + 1e-3 * (high - low), low + edge), high - edge) if np.isfinite(guess) else middle
                )
            halve = not halve
            z = self._indicators(middle, dense(middle)[: self.nx])
            if ((z > 0.0) != self.positive).any():
                high, z_high = middle, z
            else:
                low, z_low = middle, z
        return high

    def _count_state_event(self, t: float) -> None:
        """Count a state event. Raises RunFailed where there are too many in the run, or around this instant."""
        self.state_events += 1
        if self._count_event(t) or self.state_events > MAX_EVENTS:
            raise RunFailed(
                "a limit switches on and off without end", t, "add a hysteresis or a small lag where it acts"
            )

    def _count_event(self, t: float) -> bool:
        """Count an event; return whether there are too many around this instant."""
        self.counts.events += 1
        self.events += 1
        span = self.end - float(self.time[0])
        self.close = [s for s in self.close if t - s <= CHATTER_SPAN * span] + [t]
        return len(self.close) > MAX_CHATTER

    def _step_event(self, t: float, y: Array, step: float) -> Array | None:
        """Process the event that the FMU wants after a completed step of this length; return the states after it.

        Some FMUs want one after every step. Where it changes neither the states nor the next time event, and no
        derivative by so much that another such step would differ by its tolerance, it returns None: the integrator goes on.
        """
        due, old = self.instance.next_time, self.library.get_derivatives().copy()
        after = self._event_at(t, y, None)
        self.positive = self.library.get_indicators() > 0.0
        x = y[: self.nx]
        moved = step * np.abs(self.library.get_derivatives() - old) > self.atol + self.run.tolerance * np.abs(x)
        if np.array_equal(after[: self.nx], x) and due == self.instance.next_time and not moved.any():
            return None
        self._count_state_event(t)
        return after

    def _event_at(self, t: float, y: Array, u: Array | None) -> Array:
        """Return the states after event mode at t; inputs u are set in it where they jump.

        Some FMUs decide in event mode by what they computed last, in which a search for the event may have left them on
        its other side: so derivatives and indicators are computed here first.
        """
        old = self.library.get_derivatives().copy()
        self.library.get_indicators()
        changed = self.instance.handle_event(t, u)
        if u is not None:
            self.applied = None
        x = self.library.get_states() if changed else y[: self.nx]
        if self.columns:
            jumped = bool(np.abs(x - y[: self.nx]).max(initial=0.0) > 0.0)
            if u is None:
                size = np.abs(old).max(initial=0.0) + np.abs(self.library.derivatives.values).max(initial=0.0)
                jumped |= bool(
                    np.abs(self.library.get_derivatives() - old).max(initial=0.0) > JUMP_TOLERANCE * max(size, 1e-300)
                )
            if jumped:
                raise SensitivitiesLost(f"a state or a derivative jumps at {t:.6g} s")
        return np.concatenate([x, y[self.nx :]]) if changed else y

    def _stop_at(self, t: float, y: Array, stops: Sequence[float]) -> tuple[float, Array]:
        """Process a stop and those that differ from it by rounding; return the instant of the last and the states after it.

        Rows before its jump are recorded, then time events and inputs act, then rows after it.
        """
        self._set_point(t, y[: self.nx], before_jump=True)
        near = t + self.rounding
        while self.row + 1 < self.time.size and self.time[self.row] == self.time[self.row + 1] <= near:
            self._record(y)
        before, breaks = self._inputs_at(t, before_jump=True), stops[bisect_left(stops, t) : bisect_right(stops, near)]
        t = max([t, *breaks])
        while (due := self.instance.next_time) is not None and due <= near:
            t = max(t, due)  # before that instant, the FMU has no event
            if self._count_event(t):
                raise RunFailed("the FMU asks for time events without end", t, "export it again, or as co-simulation")
            self.library.set_time(t)
            y = self._event_at(t, y, None)
        u = self._inputs_at(t, before_jump=False)
        if breaks and (u != before).any():
            y = self._event_at(t, y, u)
        self.segment_end = self.end + 1.0 if t < self.end else t
        self._set_point(t, y[: self.nx])
        while self.row < self.time.size and self.time[self.row] <= t:
            self._record(y)
        return t, y

    # --- rows ---

    def _record_until(self, dense: Any, t: float) -> None:
        """Record the rows of a step that lie before t; those at a stop, but for rounding, are recorded there."""
        while self.row < self.time.size and self.time[self.row] < t:
            s = float(self.time[self.row])
            y = np.asarray(dense(s), dtype=float) if self.nx else np.zeros(0)
            self._set_point(s, y[: self.nx])
            self._record(y)

    def _record(self, y: Array) -> None:
        """Record the next row, at whose instant the FMU is."""
        self.outputs[self.row] = self.recorded.get()
        if self.equations is not None:
            for j in range(self.columns):
                self.gradients[self.row, :, j] = self.equations.outputs(j, y[(j + 1) * self.nx : (j + 2) * self.nx])
        self.row += 1
