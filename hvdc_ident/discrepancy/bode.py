"""Frequency responses of the nominal and the augmented model beside what the records show."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.errors import InputError
from hvdc_ident.linearize import find_operating_point, frequency_response, linearize
from hvdc_ident.model import AnyModel

POINTS = 60
MOST = 12
"""Channels that are drawn at most."""


def responses(model: AnyModel, first: Refit, augmented: AnyModel | None, last: Refit) -> tuple[Mapping[str, Any], ...]:
    """For each moved input and measured output: gain by frequency of nominal, augmented and recorded responses.

    The models are linear about the start of the experiment that moves the input; a point without one is a reason.
    """
    found: list[Mapping[str, Any]] = []
    for e in first.problem.fitted_experiments:
        moved = [n for n, s in e.inputs.items() if not s.is_constant and n in model.inputs]
        if len(moved) != 1 or e.drive or any(f["input"] == moved[0] for f in found):
            continue
        for output in e.outputs:
            if len(found) < MOST:
                found.append(_channel(model, first, augmented, last, e, moved[0], output))
    return tuple(found)


def _channel(
    model: AnyModel, first: Refit, augmented: AnyModel | None, last: Refit, e: Experiment, name: str, output: str
) -> Mapping[str, Any]:
    omega, data = recorded(e, name, output, first.noise[output].std or 0.0)
    line: dict[str, Any] = {
        "input": name,
        "output": output,
        "experiment": e.name,
        "omega": omega.tolist(),
        "data": _pairs(data),
    }
    for label, m, values in (("nominal", model, first.values), ("augmented", augmented, last.values)):
        if m is None:
            line[label] = None
            continue
        try:
            line[label] = _pairs(_model(m, e, values, name, output, omega))
        except InputError as error:
            line[label], line[f"{label}_reason"] = None, str(error)
    return line


def _model(model: AnyModel, e: Experiment, values: Mapping[str, float], name: str, output: str, omega: Array) -> Array:
    begin = float(e.time[0])
    levels = {n: float(s(np.nextafter(begin, -np.inf))) for n, s in e.inputs.items() if n in model.inputs}
    at = {**e.values, **levels, **{n: v for n, v in values.items() if n in model.parameters}}
    point = find_operating_point(model, at)
    found = frequency_response(linearize(model, point, inputs=[name], outputs=[output]), omega)
    return np.asarray(found.values[:, 0, 0])


def _pairs(values: Array) -> list[list[float]]:
    return [[float(v.real), float(v.imag)] for v in values]


def recorded(e: Experiment, name: str, output: str, noise: float) -> tuple[Array, Array]:
    """(n,) rad/s and (n,) complex: what the record shows, where the input's own spectrum stands clear of the noise.

    Of both the derivative is transformed, so that a step between two levels has a finite spectrum: of the input, whose
    course between the rows is known, exactly; of the output, known at its rows alone, as if it held nothing beyond half
    their rate. Differences of both at the rows would show a delay of up to a row that is not there.
    """
    assert e.measured is not None
    keep = e.compared & np.isfinite(e.measured[output])
    t, y = e.time[keep], e.measured[output][keep]
    even = np.linspace(t[0], t[-1], t.size)
    step = float(even[1] - even[0])
    omega = 2 * np.pi * np.fft.rfftfreq(t.size - 1, step)
    du = derivative_spectrum(e.inputs[name], float(t[0]), float(t[-1]), np.asarray(omega, dtype=float))
    inner = np.flatnonzero((omega > 0) & (omega < 0.8 * np.pi / step) & (np.abs(du) > 0.02 * np.abs(du).max()))
    if not inner.size:
        return np.empty(0), np.empty(0, dtype=complex)
    picked = np.unique(inner[np.unique(np.round(np.geomspace(1, inner.size, POINTS)).astype(int) - 1)])
    omega, du = omega[picked], du[picked]
    middles = 0.5 * (even[1:] + even[:-1])
    half = 0.5 * omega * step
    dy = np.exp(-1j * np.outer(omega, middles)) @ np.diff(np.interp(even, t, y)) * (half / np.sin(half))
    h = dy / du
    # The noise of a derivative grows with frequency: what it drowns is left out.
    clear = np.abs(h) > noise * np.sqrt(2.0 * t.size) * omega * step / np.abs(du)
    return omega[clear], h[clear]


def derivative_spectrum(signal: InputSignal, start: float, end: float, omega: Array) -> Array:
    """(n,) complex: the Fourier integral of a signal's derivative from start to end, exact; omega: (n,) rad/s.

    A jump counts with its height at its instant, a line with its slope between its ends.
    """
    inside = (signal.times > start) & (signal.times < end)
    first, last = float(signal(np.nextafter(start, -np.inf))), float(signal(np.nextafter(end, -np.inf)))
    at_start = float(signal(start))
    times = np.concatenate([[start, start], signal.times[inside], [end]])
    values = np.concatenate([[first, at_start], signal.values[inside], [last]])
    t0, t1, rise = times[:-1], times[1:], np.diff(values)
    # A line's integral is that of a jump in its middle, spread out: sinc, which is 1 for a jump.
    spread = np.sinc(np.outer(omega, t1 - t0) / (2 * np.pi))
    found = (np.exp(-0.5j * np.outer(omega, t0 + t1)) * spread) @ rise
    return np.asarray(found)
