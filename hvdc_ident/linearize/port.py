"""The dq impedance and admittance of a station, in the network's frame, whatever frame the model computes in."""

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
from hvdc_ident.linearize.frequency import Response
from hvdc_ident.linearize.jacobian import linearize
from hvdc_ident.linearize.operating_point import OperatingPoint, find_operating_point
from hvdc_ident.model.definition import Model, Output
from hvdc_ident.model.transform import fresh, rewritten
from hvdc_ident.parameters import Input


@dataclass(frozen=True)
class Port:
    """Where an impedance is seen.

    source: the d and q signals of a voltage behind the port that is disturbed, which side of the port it lies on decides
    what is seen: a source in the grid shows the station. voltage, current: d and q expressions at the port, the current
    counted towards what is to be seen. angle: of the model's frame ahead of the network's, rad, as an expression.
    """

    source: tuple[str, str]
    voltage: tuple[str, str]
    current: tuple[str, str]
    angle: str = "0"


def port_impedance(
    model: Model, port: Port, omega: Sequence[float] | Array, point: OperatingPoint | None = None
) -> Response:
    """(n, 2, 2) impedance over [d, q] in the network's frame at omega, rad/s, in voltage unit per current unit, delays exact.

    Raises UnknownNameError for a signal that is not there, LinearizationError where the disturbance drives no current.
    """
    voltage, current = _responses(model, port, omega, point)
    return _ratio(voltage, current, omega, "impedance")


def port_admittance(
    model: Model, port: Port, omega: Sequence[float] | Array, point: OperatingPoint | None = None
) -> Response:
    """(n, 2, 2) admittance over [d, q], the inverse of `port_impedance`; raises as it does."""
    voltage, current = _responses(model, port, omega, point)
    return _ratio(current, voltage, omega, "admittance")


def _ratio(top: Array, bottom: Array, omega: Sequence[float] | Array, kind: str) -> Response:
    if (np.linalg.cond(bottom) > 1e14).any():
        raise LinearizationError(
            f"the {kind} does not exist: the disturbance does not move both axes of the port",
            hint="choose a source on the other side of the port",
        )
    names = ("d", "q")
    return Response(
        np.atleast_1d(np.asarray(omega, dtype=float)), top @ np.linalg.inv(bottom), names, names, source=kind
    )


def _responses(
    model: Model, port: Port, omega: Sequence[float] | Array, point: OperatingPoint | None
) -> tuple[Array, Array]:
    """The port's voltage and current, (n, 2, 2) each, by a disturbance of the source in the network's frame."""
    disturbed, inputs, outputs = disturbed_model(model, port)
    given = {} if point is None else {**point.inputs, **point.parameters}
    guess = {} if point is None else {**point.states, **point.unknowns, **point.extras}
    at = find_operating_point(disturbed, given, guess=guess)
    values = linearize(disturbed, at, inputs=inputs, outputs=outputs).response(np.asarray(omega, dtype=float))
    return values[:, :2], values[:, 2:]


def disturbed_model(model: Model, port: Port) -> tuple[Model, list[str], list[str]]:
    """(model, inputs, outputs): with the source's two disturbances as inputs, and the port's d and q values as outputs."""
    inputs = [fresh(model, f"disturbance_{axis}") for axis in "dq"]
    angle = parse(port.angle)
    turned = _turned((symbol(inputs[0]), symbol(inputs[1])), -angle)
    new = replace(model, inputs=model.inputs | FrozenMap({n: Input(0.0, "pu") for n in inputs}))
    for name, part in zip(port.source, turned, strict=True):

        def add(m: Model, u: Any, part: sp.Expr = part) -> tuple[Model, Any]:
            return m, u + part

        new = rewritten(new, name, "disturbance", add)
    outputs: dict[str, Output] = {}
    for kind, pair in (("voltage", port.voltage), ("current", port.current)):
        values = _turned((parse(pair[0]), parse(pair[1])), angle)
        outputs |= {fresh(new, f"port_{kind}_{axis}"): Output(v) for axis, v in zip("dq", values, strict=True)}
    return replace(new, outputs=new.outputs | FrozenMap(outputs)), inputs, list(outputs)


def _turned(pair: tuple[sp.Expr, sp.Expr], angle: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """d + jq turned ahead by an angle."""
    d, q = pair
    return d * sp.cos(angle) - q * sp.sin(angle), d * sp.sin(angle) + q * sp.cos(angle)
