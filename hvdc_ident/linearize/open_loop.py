"""Loops opened at named signals: open-loop transfer, sensitivity, complementary sensitivity; plant and controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.errors import LinearizationError, unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.frequency import FrequencyResponse, default_omega, transfer
from hvdc_ident.linearize.jacobian import linearize
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.matrices import Array
from hvdc_ident.linearize.operating_point import OperatingPoint, find_operating_point, point_at
from hvdc_ident.linearize.reduce import without_sliding_means
from hvdc_ident.model import Model, Output, State, driven, fresh
from hvdc_ident.parameters import Input


@dataclass(frozen=True, eq=False)
class Loop:
    """A loop opened at a signal, or several opened together (their names joined by ", ").

    open: L, from what is injected to minus what comes back; det(1 + L) = 0 closes it.
    """

    signal: str
    open: LinearModel

    def response(self, omega: Array | None = None) -> FrequencyResponse:
        """L at omega in rad/s, delays exact."""
        return self.open.bode(omega)

    def closed_poles(self) -> Array:
        """Poles with the loop closed, delays in their Pade form, sliding means without their hidden zero.

        Raises LinearizationError for an ill-posed loop.
        """
        a, b, c, d = without_sliding_means(self.open)
        through = np.eye(d.shape[0]) + d
        if np.linalg.cond(through) > 1e12 or np.abs(np.linalg.det(through)) < 1e-12:
            raise LinearizationError(
                "the loop is ill-posed: its direct part is -1",
                where=f"loop at '{self.signal}'",
                hint="add the lag that is there",
            )
        return np.asarray(np.linalg.eigvals(a - b @ np.linalg.solve(through, c)), dtype=complex)

    def sensitivity(self, omega: Array | None = None) -> FrequencyResponse:
        """S = (1 + L)^-1."""
        return self._of(omega, lambda value, one: np.linalg.inv(one + value), "S")

    def complementary(self, omega: Array | None = None) -> FrequencyResponse:
        """T = (1 + L)^-1 L."""
        return self._of(omega, lambda value, one: np.linalg.solve(one + value, value), "T")

    def _of(self, omega: Array | None, of: Callable[[Array, Array], Array], name: str) -> FrequencyResponse:
        w = default_omega(self.open) if omega is None else np.atleast_1d(np.asarray(omega, dtype=float))
        values = transfer(self.open, 1j * w)
        signals = self.open.input_names
        names = (name,) if len(signals) == 1 else tuple(f"{name} {n}" for n in signals)
        return FrequencyResponse(
            w, of(values, np.eye(len(signals))), names, signals, source=f"{name} at '{self.signal}'"
        )


def open_model(model: Model, signal: str) -> tuple[Model, str]:
    """(model, output): the model in which the signal is an input, and the output that shows what it would have been.

    A state is opened between its integrator and its readers. Raises UnknownNameError, and LinearizationError for an
    input, where there is nothing to open.
    """
    if signal in model.inputs:
        raise LinearizationError(
            f"'{signal}' is an input: no loop runs through it", where=f"model '{model.name}'", hint="open at a signal"
        )
    returned = fresh(model, f"{signal}_returned")
    if signal in model.signals or signal in model.algebraic:
        value = model.signals[signal].value if signal in model.signals else model.algebraic[signal].equation
        unit = model.signals[signal].unit if signal in model.signals else model.algebraic[signal].unit
        opened = driven(model, (signal,))
        return replace(opened, outputs=opened.outputs | {returned: Output(value, unit)}), returned
    if signal in model.states:
        old = model.states[signal]
        opened = replace(
            model,
            states=FrozenMap({returned if n == signal else n: s for n, s in model.states.items()}),
            inputs=model.inputs | {signal: Input(0.0, old.unit)},
            outputs=model.outputs | {f"{returned}_shown": Output(symbol(returned), old.unit)},
            parameters=model.parameters.without(f"{signal}_start") if old.start == "free" else model.parameters,
        )
        state = State(old.derivative, None, old.guess, None, old.unit, old.description)
        return replace(opened, states=opened.states | {returned: state}), f"{returned}_shown"
    raise unknown_name(
        "signal", signal, [*model.signals, *model.algebraic, *model.states], where=f"model '{model.name}'"
    )


def loop(
    model: Model,
    signal: str | Sequence[str],
    point: OperatingPoint | None = None,
    *,
    sensitivities: Sequence[str] = (),
    pade_order: int = 5,
) -> Loop:
    """Return the loop opened at a named signal, unknown or state, or several opened together, at the operating point.

    point: of the closed model; default, its steady state.

    >>> from hvdc_ident import load_model, loop, margins
    >>> opened = loop(load_model("vsc-hvdc-link"), "Irorder1")
    >>> round(margins(opened).phase_margin.value, 1)
    65.3
    """
    signals = (signal,) if isinstance(signal, str) else tuple(signal)
    if not signals or len(set(signals)) < len(signals):
        raise LinearizationError(
            "a loop is opened at different signals", where=f"model '{model.name}'", got=", ".join(signals) or "none"
        )
    closed = find_operating_point(model) if point is None else point
    opened, outputs, states = model, [], dict(closed.states)
    for name in signals:
        if name in model.states:
            states[fresh(opened, f"{name}_returned")] = closed.states[name]
        opened, output = open_model(opened, name)
        outputs.append(output)
    inputs = {**closed.inputs, **{n: signal_value(model, closed, n) for n in signals}}
    parameters = {n: v for n, v in closed.parameters.items() if n in opened.parameters}
    at = point_at(opened, {n: states[n] for n in opened.states}, inputs, parameters, time=closed.time)
    if sensitivities:  # the derivatives need the shift of a point that is at rest
        at = find_operating_point(opened, {**inputs, **parameters}, guess=states)
    found = linearize(
        opened, at, inputs=list(signals), outputs=outputs, sensitivities=sensitivities, pade_order=pade_order
    )
    return Loop(", ".join(signals), negated(found))


def plant_and_controller(
    model: Model, inputs: Sequence[str], outputs: Sequence[str], point: OperatingPoint | None = None
) -> tuple[LinearModel, LinearModel]:
    """Return (plant, controller) of a closed model, cut at the signals that go into the plant and those measured on it.

    inputs, outputs: names of signals, unknowns or states. The plant is what lies between inputs and outputs with both cut,
    the controller what lies between outputs and inputs, with the sign of negative feedback. Raises LinearizationError
    where there is a way from inputs to inputs, or outputs to outputs, that passes neither: the cut does not part them.
    """
    both = loop(model, (*inputs, *outputs), point).open
    back = negated(both)
    k = len(inputs)
    names = both.output_names
    returned_inputs, returned_outputs = names[:k], names[k:]
    w = default_omega(both, 50)
    values = np.abs(transfer(both, 1j * w))
    size = np.maximum(values.max(axis=0), 1e-300)
    for part in ((slice(0, k), slice(0, k)), (slice(k, None), slice(k, None))):
        if (size[part] > 1e-9 * size.max()).any():
            i, j = (int(v) for v in np.argwhere(size[part] > 1e-9 * size.max())[0])
            signals = both.input_names[part[1]]
            raise LinearizationError(
                f"cutting at these signals does not part plant and controller: a way leads from '{signals[j]}' to "
                f"'{signals[i]}' beside them",
                where=f"model '{model.name}'",
                hint="name every signal that the controller sends or measures; of a state, a signal that only the "
                "controller reads",
            )
    plant = back.channel(list(inputs), list(returned_outputs))
    controller = both.channel(list(outputs), list(returned_inputs))
    return plant, controller


def signal_value(model: Model, point: OperatingPoint, name: str) -> float:
    """The value of any name at an operating point."""
    return signal_values(model, point, (name,))[name]


def signal_values(model: Model, point: OperatingPoint, names: Sequence[str]) -> dict[str, float]:
    """Return the values of any names at an operating point."""
    from hvdc_ident.linearize.system import system

    known = {**point.states, **point.unknowns, **point.extras, **point.inputs, **point.parameters}
    asked = tuple(n for n in names if n not in known)
    found = {n: float(known[n]) for n in names if n in known}
    if asked:
        s = system(model, asked)
        shown = s.values(point.y, point.w, point.p, s.modes(point.y, point.w, point.p))[s.layout.n + s.layout.ne :]
        found |= {n: float(v) for n, v in zip(s.outputs, shown, strict=False)}
    return found


def negated(model: LinearModel) -> LinearModel:
    """The model whose outputs have the other sign."""
    core = model.delay_free
    if core is not None:
        matrix = core.matrix.copy()
        matrix[core.nx : core.nx + core.no] *= -1.0
        core = replace(core, matrix=matrix)
    gradients = {}
    for n, g in model.gradients.items():
        free = g.delay_free
        if free is not None and core is not None:
            free = free.copy()
            free[core.nx : core.nx + core.no] *= -1.0
        gradients[n] = replace(g, C=-g.C, D=-g.D, delay_free=free)
    return replace(model, C=-model.C, D=-model.D, delay_free=core, gradients=FrozenMap(gradients))
