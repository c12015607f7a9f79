"""The impedance and admittance of a port: dq in the network's frame, whatever frame the model computes in, or dc."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp

from hvdc_ident.errors import LinearizationError
from hvdc_ident.expression import parse
from hvdc_ident.expression.functions import symbol
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.frequency import Response, sensitivity
from hvdc_ident.linearize.jacobian import linearize
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.operating_point import OperatingPoint, find_operating_point
from hvdc_ident.model.definition import Model, Output
from hvdc_ident.model.transform import fresh, rewritten
from hvdc_ident.parameters import Input

Names = tuple[str, str] | tuple[str]


@dataclass(frozen=True)
class Port:
    """Where an impedance is seen: d and q of an ac port, or one signal each of a dc port.

    source: the signals of a voltage (or current) behind the port that is disturbed; which side of the port it lies on
    decides what is seen: a source in the grid shows the station. voltage, current: expressions at the port, the current
    counted towards what is to be seen. angle: of the model's frame ahead of the network's, rad, as an expression.

    Raises LinearizationError where the three differ in their number of signals.
    """

    source: Names
    voltage: Names
    current: Names
    angle: str = "0"

    def __post_init__(self) -> None:
        sizes = [len(part) for part in (self.source, self.voltage, self.current)]
        if sizes not in ([1, 1, 1], [2, 2, 2]) or (sizes[0] == 1 and self.angle != "0"):
            raise LinearizationError(
                "the signals of a port do not fit together",
                expected="source, voltage and current of two signals each (d, q), or of one each and no angle (dc)",
                got=f"{sizes[0]}, {sizes[1]} and {sizes[2]} signals, angle {self.angle}",
            )

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes: d and q, or dc."""
        return ("d", "q") if len(self.source) == 2 else ("dc",)


def port_impedance(
    model: Model, port: Port, omega: Sequence[float] | Array, point: OperatingPoint | None = None
) -> Response:
    """Return the impedance seen at a port at omega, rad/s: (n, 2, 2) over [d, q] in the network's frame, or (n, 1, 1).

    In voltage unit per current unit, delays exact. Raises UnknownNameError for a signal that is not there,
    LinearizationError where the disturbance drives no current.
    """
    return port_response(port_model(model, port, point), port, omega, "impedance")


def port_admittance(
    model: Model, port: Port, omega: Sequence[float] | Array, point: OperatingPoint | None = None
) -> Response:
    """Return the admittance seen at a port, the inverse of `port_impedance`; raises as it does."""
    return port_response(port_model(model, port, point), port, omega, "admittance")


def port_model(
    model: Model, port: Port, point: OperatingPoint | None = None, sensitivities: Sequence[str] = ()
) -> LinearModel:
    """Return the linear model from the disturbances of a port's source to its voltages, then its currents."""
    disturbed, inputs, outputs = disturbed_model(model, port)
    given = {} if point is None else {**point.inputs, **point.parameters}
    guess = {} if point is None else {**point.states, **point.unknowns, **point.extras}
    at = find_operating_point(disturbed, given, guess=guess)
    return linearize(disturbed, at, inputs=inputs, outputs=outputs, sensitivities=sensitivities)


def port_response(linear: LinearModel, port: Port, omega: Sequence[float] | Array, kind: str) -> Response:
    """Return the "impedance" or "admittance" that a port's linear model (`port_model`) shows."""
    top, bottom = _parts(linear.response(np.asarray(omega, dtype=float)), port, kind)
    if (np.linalg.cond(bottom) > 1e14).any():
        hint = "choose a source on the other side of the port"
        moved = "both axes of the port" if len(port.axes) == 2 else "the port"
        raise LinearizationError(f"the {kind} does not exist: the disturbance does not move {moved}", hint=hint)
    values = top @ np.linalg.inv(bottom)
    return Response(np.atleast_1d(np.asarray(omega, dtype=float)), values, port.axes, port.axes, source=kind)


def port_sensitivity(linear: LinearModel, port: Port, omega: Array, kind: str, names: Sequence[str]) -> Array:
    """(n, k, k, parameters) derivatives of a port's response: dZ = (dV - Z dI) I^-1, the operating point's shift included."""
    top, bottom = _parts(linear.response(omega), port, kind)
    inverse = np.linalg.inv(bottom)
    ratio = top @ inverse
    found = []
    for slope in sensitivity(linear, omega, names).values():
        d_top, d_bottom = _parts(slope, port, kind)
        found.append((d_top - ratio @ d_bottom) @ inverse)
    return np.stack(found, axis=-1) if found else np.zeros((*ratio.shape, 0), dtype=complex)


def _parts(values: Array, port: Port, kind: str) -> tuple[Array, Array]:
    """Numerator and denominator of a response from the disturbances to [voltages, currents]."""
    k = len(port.axes)
    voltage, current = values[:, :k], values[:, k:]
    return (voltage, current) if kind == "impedance" else (current, voltage)


def disturbed_model(model: Model, port: Port) -> tuple[Model, list[str], list[str]]:
    """(model, inputs, outputs): with the source's disturbances as inputs, and voltages and currents at the port as outputs."""
    inputs = [fresh(model, f"disturbance_{axis}") for axis in port.axes]
    angle = parse(port.angle)
    turned = _turned(tuple(symbol(n) for n in inputs), -angle)
    new = replace(model, inputs=model.inputs | FrozenMap({n: Input(0.0, "pu") for n in inputs}))
    seen: dict[sp.Symbol, sp.Symbol] = {}
    for name, part in zip(port.source, turned, strict=True):

        def add(m: Model, u: Any, part: sp.Expr = part) -> tuple[Model, Any]:
            return m, u + part

        before = set(new.signals)
        new = rewritten(new, name, "disturbance", add)
        if name in model.inputs or name in model.states:  # readers see another name, and so does the port
            seen |= {symbol(name): symbol(n) for n in new.signals if n not in before}
    outputs: dict[str, Output] = {}
    for kind, signals in (("voltage", port.voltage), ("current", port.current)):
        values = _turned(tuple(parse(s).xreplace(seen) for s in signals), angle)
        outputs |= {fresh(new, f"port_{kind}_{axis}"): Output(v) for axis, v in zip(port.axes, values, strict=True)}
    return replace(new, outputs=new.outputs | FrozenMap(outputs)), inputs, list(outputs)


def _turned(signals: tuple[sp.Expr, ...], angle: sp.Expr) -> tuple[sp.Expr, ...]:
    """d + jq turned ahead by an angle; one signal as it is."""
    if len(signals) == 1:
        return signals
    d, q = signals
    return d * sp.cos(angle) - q * sp.sin(angle), d * sp.sin(angle) + q * sp.cos(angle)
