"""One point of a sweep: parameter values in, RMSE, poles and frequency response out, packed in bytes without pickles."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from hvdc_ident.errors import HvdcIdentError, SimulationError
from hvdc_ident.experiment import Experiment
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model
from hvdc_ident.model.external import AnyModel
from hvdc_ident.simulate.engine import Method, simulate
from hvdc_ident.trajectory import Array

DONE, FAILED = b"\x00", b"\x01"


@dataclass(frozen=True, eq=False)
class Reference:
    """What an output of an experiment is compared with: values at the experiment's rows, (m,), in the output's unit."""

    experiment: str
    output: str
    rows: NDArray[np.intp]
    values: Array


@dataclass(frozen=True, eq=False)
class PointTask:
    """The work of a point, the same in every process: called with (k,) values it returns packed bytes.

    values: parameters and inputs held at other than the model's values. references: what is compared, in order.
    poles: how many poles are wanted (0: none). omega, inputs, outputs: of the frequency response (empty: none).
    method: the integrator of every run, fixed beforehand so that no point depends on those before it.
    """

    model: AnyModel
    experiments: tuple[Experiment, ...]
    names: tuple[str, ...]
    values: FrozenMap[float]
    references: tuple[Reference, ...]
    poles: int = 0
    omega: Array = field(default_factory=lambda: np.empty(0))
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    method: Method = "rosenbrock"

    @cached_property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers in a packed point: RMSE, poles (two each), response (two each)."""
        return len(self.references), 2 * self.poles, 2 * self.omega.size * len(self.outputs) * len(self.inputs)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k in self.__dataclass_fields__}

    def __call__(self, point: Array) -> bytes:
        """The point, packed; a run that fails is the reason, packed."""
        given = FrozenMap({**self.values, **dict(zip(self.names, map(float, point), strict=True))})
        try:
            numbers = np.concatenate([self._errors(given), self._linear(given)])
        except HvdcIdentError as e:
            return FAILED + str(e).encode()
        if not np.isfinite(numbers).all():
            return FAILED + b"a result is not finite"
        return DONE + numbers.astype("<f8").tobytes()

    def _errors(self, given: FrozenMap[float]) -> Array:
        """(references,) RMSE in the outputs' units."""
        found = np.empty(len(self.references))
        for experiment in self.experiments:
            chosen = [(i, r) for i, r in enumerate(self.references) if r.experiment == experiment.name]
            if not chosen:
                continue
            run = simulated(self.model, experiment, given, tuple(r.output for _, r in chosen), self.method)
            for column, (i, r) in enumerate(chosen):
                difference = run[r.rows, column] - r.values
                found[i] = np.sqrt(np.mean(difference * difference))
        return found

    def _linear(self, given: FrozenMap[float]) -> Array:
        """Poles, then the response, real and imaginary parts in turn."""
        if not self.poles and not self.omega.size:
            return np.empty(0)
        from hvdc_ident.linearize import find_operating_point, linearize

        at = find_operating_point(self.model, given)
        linear = linearize(self.model, at, inputs=self.inputs or None, outputs=self.outputs or None)
        parts = []
        if self.poles:
            poles = np.asarray(linear.poles(), dtype=complex)
            if poles.size != self.poles:
                raise SimulationError(
                    "the number of poles changed", expected=str(self.poles), got=str(poles.size)
                )  # e.g. a loop that becomes ill-posed
            parts.append(poles[np.lexsort((poles.imag, poles.real))])
        if self.omega.size:
            parts.append(np.asarray(linear.response(self.omega), dtype=complex).ravel())
        return np.concatenate(parts).view(float)

    def unpacked(self, packed: bytes) -> tuple[Array, Array, Array] | str:
        """RMSE (references,), poles and response as complex numbers; or the reason of a failure."""
        if packed[:1] != DONE:
            return packed[1:].decode()
        numbers = np.frombuffer(packed, dtype="<f8", offset=1)
        a, b, c = self.sizes
        response = numbers[a + b :].view(complex).reshape(self.omega.size, len(self.outputs), len(self.inputs))
        assert numbers.size == a + b + c
        return numbers[:a], numbers[a : a + b].view(complex), response

    @cached_property
    def fingerprint(self) -> str:
        """A hash of all that decides a point's result but the point itself and the code."""
        parts: list[Any] = [model_text(self.model), self.names, dict(self.values), self.method, self.poles]
        parts += [self.inputs, self.outputs, self.omega.tobytes()]
        for r in self.references:
            parts += [r.experiment, r.output, r.rows.tobytes(), r.values.tobytes()]
        for e in self.experiments:
            parts += [e.name, e.time.tobytes(), dict(e.values), e.drive, {k: dict(v) for k, v in e.instrument.items()}]
            for name, u in e.inputs.items():
                parts += [name, u.times.tobytes(), u.values.tobytes(), u.breaks.tobytes()]
        return hashlib.sha256("\n".join(map(repr, parts)).encode()).hexdigest()


def simulated(model: AnyModel, experiment: Experiment, given: Any, outputs: tuple[str, ...], method: Method) -> Array:
    """(n, outputs) of one run whose integrator does not depend on the runs before it."""
    try:
        return simulate(model, experiment, given, outputs=outputs, method=method).trajectory.values
    except SimulationError as e:
        if method != "explicit" or "stiff" not in e.what:
            raise
    return simulate(model, experiment, given, outputs=outputs, method="rosenbrock").trajectory.values


def model_text(model: AnyModel) -> str:
    """The model as text that differs where its equations or its values do, to the last digit."""
    if not isinstance(model, Model):
        return model.text
    lines = [model.name, repr(model.values), repr({n: i.value for n, i in model.inputs.items()})]
    for kind in ("states", "signals", "algebraic", "outputs", "delays", "sampled"):
        for name, item in getattr(model, kind).items():
            fields = [f"{f}={_exact(getattr(item, f))}" for f in item.__dataclass_fields__]
            lines.append(f"{kind} {name} {' '.join(fields)}")
    return "\n".join(lines)


def _exact(value: Any) -> str:
    return str(sp.srepr(value)) if isinstance(value, sp.Basic) else repr(value)
