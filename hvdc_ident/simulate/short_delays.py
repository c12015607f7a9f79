"""Runs of models whose delays may be 0 or shorter than any step that a run can afford.

No step of the integrators is longer than a delay. So a delay T below s, a small share of the run, is not simulated: the run
is interpolated between T = 0, where the delayed signal is the signal itself, and T = s, by the parabola in T through the
values at both and the derivative by T at s. Values and derivatives are so continuous in T from 0 on, and the derivative is that
of the values. Of a component of angular frequency w, the parabola is off by at most (w s)^3/40 of its size, and its slope by
(w s)^2/6. s is 0.1/w or less for the fastest mode w of the model without its delays, so that these are 3e-5 and 2e-3, as far as
`FINEST` steps in a run allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.expression import symbol
from hvdc_ident.model import Model, fresh, without_delays
from hvdc_ident.parameters import Parameter
from hvdc_ident.simulate.engine import EngineRuns, Method, Tolerance, engine_of
from hvdc_ident.simulate.simulation import Statistics

COARSEST = 2_500
"""Delays that go fewer times into a run are always simulated: so many steps take some milliseconds."""
FINEST = 20_000
"""Those that go more times into it never: so many steps take up to a second of a model with a dozen states and some
sensitivities."""
OVER = 0.1
"""The delay that is interpolated from is at most so much of the time constant of the fastest mode."""
PER_BREAK = 5
"""It goes so many times between two breaks of an input, whose waveform may be faster than the model."""

COUNTS = ("accepted", "rejected", "events", "evaluations", "segments", "forced")


@dataclass(frozen=True, eq=False)
class DelayedRun:
    """Outputs of a run, (n, outputs), their derivatives by the asked parameters, (n, outputs, parameters), and what it cost."""

    values: Array
    slopes: Array
    statistics: Statistics


@dataclass(frozen=True, eq=False)
class DelayedRuns:
    """Runs of a model, in which every delay may be 0 or short, that differ by the values of parameters alone.

    inputs: one InputSignal an input.
    """

    model: Model
    sensitivities: tuple[str, ...]
    outputs: tuple[str, ...] | None
    inputs: tuple[Any, ...]
    time: Array
    tolerance: Tolerance
    method: Method = "auto"

    def run(self, p: Array) -> DelayedRun:
        """Return the run at values (parameters,) in the model's order.

        Raises TimingError for a negative delay, and as `EngineRuns.run` does.
        """
        return self._with_delays(p) if self.model.delays else self._answer(self._own, p)

    @cached_property
    def _own(self) -> EngineRuns:
        """The runs with all delays as they are."""
        return self._prepared(self.model, self.sensitivities)

    def _prepared(self, model: Model, sensitivities: Sequence[str]) -> EngineRuns:
        engine = engine_of(model, sensitivities, self.outputs, brief=self.tolerance.brief)
        scale = np.array([model.parameters[n].size for n in sensitivities]) if sensitivities else None
        return engine.prepared(self.inputs, self.time, self.tolerance, self.method, scale, model)

    @staticmethod
    def _answer(runs: EngineRuns, p: Array) -> DelayedRun:
        s = runs.engine.structure.sizes
        out, statistics = runs.run(p)
        none = np.zeros((len(out), s.no, 0))
        slopes = out[:, s.no :].reshape(len(out), s.no, s.width)[:, :, : s.np] if s.width else none
        return DelayedRun(out[:, : s.no], slopes, statistics)

    def _with_delays(self, p: Array) -> DelayedRun:
        model, tolerance, inputs = self.model, self.tolerance, self.inputs
        span = float(self.time[-1] - self.time[0])
        times, by_parameters = self._own.engine.delay_times(p)
        shortest = 0.0
        if (times < span / COARSEST).any():
            plain = _without(model, tuple(model.delays))
            engine = engine_of(plain, self.sensitivities, self.outputs, brief=tolerance.brief)
            fastest = engine.fastest(p, inputs, self.time, tolerance, plain)
            shortest = span / _steps(span * fastest, inputs, tolerance)
        lengths = zip(model.delays, times.tolist(), by_parameters, strict=True)
        short = {name: (length, rows) for name, length, rows in lengths if length == 0.0 or length < shortest}
        if not short:
            return self._answer(self._own, p)
        so_far = self._answer(self._prepared(_without(model, tuple(short)), self.sensitivities), p)
        base, cost = so_far, [so_far.statistics]
        for name, (length, rows) in short.items():
            if shortest == 0.0 or not (length or rows.any()):
                continue
            longer, parameter = _with_time(model, name, tuple(n for n in short if n != name))
            end = self._answer(self._prepared(longer, (*self.sensitivities, parameter)), np.append(p, shortest))
            so_far = _between(so_far, base, end, length / shortest, shortest, rows)
            cost.append(end.statistics)
        return replace(so_far, statistics=_sum(cost))


def _steps(turns: float, inputs: Sequence[Any], tolerance: Tolerance) -> int:
    """Return how many times the shortest simulated delay goes into a run; half the steps of a run are left for what else there is.

    turns: the length of the run times the fastest mode, rad. The number is of a few, so that it rarely changes with parameters.
    """
    needed = max(turns / OVER, PER_BREAK * max((i.breaks.size for i in inputs), default=0))
    steps = COARSEST
    while steps < needed and steps < FINEST:
        steps *= 2
    return min(steps, max(tolerance.max_steps // 2, 1))


@lru_cache(maxsize=64)
def _without(model: Model, names: tuple[str, ...]) -> Model:
    """Return the model without these delays, kept for later runs."""
    return without_delays(model, names)


@lru_cache(maxsize=64)
def _with_time(model: Model, name: str, others: tuple[str, ...]) -> tuple[Model, str]:
    """Return the model without the other delays in which the named one has a time of its own, and that last parameter's name."""
    parameter = fresh(model, f"{name}_time")
    model = without_delays(model, others)
    delays = model.delays | {name: replace(model.delays[name], time=symbol(parameter))}
    return replace(model, parameters=model.parameters | {parameter: Parameter(0.0, "s")}, delays=delays), parameter


def _between(
    so_far: DelayedRun, base: DelayedRun, end: DelayedRun, share: float, shortest: float, rows: Array
) -> DelayedRun:
    """Return `so_far` with what a delay adds. base: all short ones at 0. end: this one at `shortest` s, its time the last parameter.

    share: its time over `shortest`. rows: (parameters,) derivatives of its time.
    """
    by_time = end.slopes[:, :, -1] * shortest
    rise = end.values - base.values
    first, second = 2.0 * rise - by_time, by_time - rise
    slope = (first + 2.0 * share * second) / shortest
    slopes = share * (end.slopes[:, :, :-1] - base.slopes) + slope[:, :, None] * rows
    return replace(so_far, values=so_far.values + share * (first + share * second), slopes=so_far.slopes + slopes)


def _sum(runs: Sequence[Statistics]) -> Statistics:
    """Return the counts of several runs together, with the status and the method of the last."""
    return replace(runs[-1], **{count: sum(getattr(r, count) for r in runs) for count in COUNTS})
