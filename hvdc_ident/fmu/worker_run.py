"""An experiment as a worker runs it, after trials of how its FMU has to be run. In worker processes only."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import astuple, replace
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu import co_simulation
from hvdc_ident.fmu.co_simulation import CallPattern
from hvdc_ident.fmu.derivatives import SensitivityEquations
from hvdc_ident.fmu.description import Message
from hvdc_ident.fmu.fmi import VariableGroup
from hvdc_ident.fmu.instance import Instance, RunEnded, RunFailed
from hvdc_ident.fmu.model_exchange import Counts, ModelExchangeRun, SensitivitiesLost
from hvdc_ident.fmu.request import RunRequest
from hvdc_ident.fmu.runner import Runner, moving

PERTURBATION = 0.1  # step of an input that shows whether a run is repeated, in sizes of the input


class ExperimentRun:
    """A request of a run: the trials that it can make of an FMU that is not known yet, and the run itself."""

    def __init__(self, runner: Runner, heading: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
        self.runner, self.description, self.learned = runner, runner.description, runner.learned
        self.heading, self.arrays = heading, arrays
        self.run: RunRequest = heading["run"]
        self.partial = bool(heading.get("partial"))  # whether a run that the FMU ends is accepted, with its rows

    def answer(self) -> Message:
        """Return outputs and, where they are asked for, their sensitivities.

        "end" in the heading: the instant at which the FMU asked for the end, s, or None. "lost": why there are no
        sensitivities, "" where there are.
        """
        if "restart" not in self.learned:
            self._find_reuse()
        if names := tuple(self.heading.get("sensitivities", ())):
            return self.runner.perform(lambda instance: self._with_sensitivities(instance, names))
        if self.description.interface == "model-exchange":
            return self.runner.perform(self._plain)
        co_simulation.find_calls(self.learned, self.description, self.run, self._co_simulated)
        answer, arrays = self.runner.perform(self._plain)
        if answer["end"] is None and self.description.variable_step and moving(arrays["outputs"]).any():
            calls = CallPattern.learned(self.learned)
            with contextlib.suppress(RunFailed):
                co_simulation.find_held(self.learned, self.run.time, lambda time: self._co_simulated(calls, time))
        return answer, arrays

    def _plain(self, instance: Instance) -> Message:
        return self._checked(*self._made(instance, self.run))

    def _made(
        self, instance: Instance, run: RunRequest, calls: CallPattern | None = None
    ) -> tuple[Array, Counts, float | None]:
        """Return the rows, (n, names), the counts, and the instant at which the FMU asked for the end, where that is accepted."""
        counts = Counts(segments=int(not instance.library.exchange))
        try:
            if not instance.library.exchange:
                return co_simulation.made(instance, run, calls), counts, None
            integration = ModelExchangeRun(instance, run, counts=counts)
            integration.begin()
            integration.go()
            return integration.outputs, counts, None
        except RunEnded as e:
            if not self.partial or e.rows is None or not e.rows.size:
                raise
            return e.rows, counts, e.t

    def _with_sensitivities(self, instance: Instance, names: tuple[str, ...]) -> Message:
        """Return the run with its sensitivities, which are lost where the FMU moves a parameter as it gives a derivative."""
        equations = SensitivityEquations(instance, names, self.heading["sizes"], self.run.names)
        run = ModelExchangeRun(instance, self.run, equations, self.arrays["start"])
        run.max_steps = self.heading["max_steps"] or run.max_steps
        run.begin()
        parameters = VariableGroup(instance.library, tuple(self.description.parameters.values()))
        before, lost = parameters.get().copy(), ""
        try:
            run.go()
            if not np.array_equal(before, parameters.get(), equal_nan=True):
                lost = "the FMU moves a parameter"
        except SensitivitiesLost as e:
            lost = str(e)
        instance.renew(names)
        if lost:
            return {"lost": lost}, {}
        if not np.isfinite(run.gradients).all():
            raise RunFailed("a sensitivity of an output is not finite", hint="check parameter values and limits")
        answer, arrays = self._checked(run.outputs, run.counts)
        return {**answer, "lost": ""}, {**arrays, "gradients": run.gradients}

    def _checked(self, rows: Array, counts: Counts, end: float | None = None) -> Message:
        """Return the answer. Raises RunFailed where a row is not finite."""
        finite = np.isfinite(rows)
        if not finite.all():
            row, column = np.argmin(finite.all(axis=1)), np.argmin(finite.all(axis=0))
            what = f"output '{self.run.names[column]}' is not finite"
            raise RunFailed(what, float(self.run.time[row]), "check parameter values and limits")
        return {"counts": list(astuple(counts)), "end": end}, {"outputs": rows}

    # --- trials ---

    def _find_reuse(self) -> None:
        """Learn how the FMU is brought back to its start, from runs of this experiment in separate processes."""
        d = self.description
        run = replace(self.run, names=tuple(dict.fromkeys([*self.run.names, *d.outputs, *d.states])))
        reuse, rows = self.runner.find_reuse(lambda instance: self._trial(instance, run))
        steps = [PERTURBATION * max(abs(v.start or 0.0), v.nominal) * v.continuous for v in d.inputs.values()]
        if any(steps) and not moving(rows).any():  # at rest throughout: the start of a run is its end
            third = float(run.time[0] + (run.time[-1] - run.time[0]) / 3.0)
            moved = run.stepped(steps, third)
            with contextlib.suppress(RunFailed):
                reuse, _ = self.runner.find_reuse(lambda instance: self._trial(instance, moved))
        self.learned["restart"] = reuse

    def _co_simulated(self, calls: CallPattern, time: Array) -> Array:
        """(n, outputs) of a run that calls the FMU in some way, of the outputs asked for and all others."""
        run = replace(self.run, time=time, names=tuple(dict.fromkeys([*self.run.names, *self.description.outputs])))

        def work(instance: Instance) -> Message:
            return {}, {"rows": self._trial(instance, run, calls)}

        return self.runner.perform(work)[1]["rows"]

    def _trial(self, instance: Instance, run: RunRequest, calls: CallPattern | None = None) -> Array:
        """(n, names) of a run; NaN after an end that the FMU asked for, where such a run is accepted."""
        rows, _, _ = self._made(instance, run, calls)
        return np.vstack([rows, np.full((run.time.size - rows.shape[0], rows.shape[1]), np.nan)])
