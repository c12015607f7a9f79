"""Frequency responses of the nominal and the augmented model beside what the records show."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.errors import InputError
from hvdc_ident.experiment import Experiment
from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.linearize.frequency import frequency_response
from hvdc_ident.model.external import AnyModel
from hvdc_ident.trajectory import Array

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

    Both records are differentiated first, so that a step between two levels has a finite spectrum.
    """
    assert e.measured is not None
    keep = e.compared & np.isfinite(e.measured[output])
    t, y = e.time[keep], e.measured[output][keep]
    even = np.linspace(t[0], t[-1], t.size)
    u, y = np.asarray(e.inputs[name](even)), np.interp(even, t, y)
    step = float(even[1] - even[0])
    frequency = np.fft.rfftfreq(u.size - 1, step)
    du, dy = np.fft.rfft(np.diff(u)), np.fft.rfft(np.diff(y))
    inner = np.flatnonzero((frequency > 0) & (frequency < 0.4 / step) & (np.abs(du) > 0.02 * np.abs(du).max()))
    if not inner.size:
        return np.empty(0), np.empty(0, dtype=complex)
    picked = np.unique(inner[np.unique(np.round(np.geomspace(1, inner.size, POINTS)).astype(int) - 1)])
    h = dy[picked] / du[picked]
    # The noise of a difference grows with frequency: what it drowns is left out.
    floor = noise * np.sqrt(2.0 * u.size) * 2.0 * np.sin(np.pi * frequency[picked] * step) / np.abs(du[picked])
    clear = np.abs(h) > floor
    return 2 * np.pi * frequency[picked][clear], h[clear]
