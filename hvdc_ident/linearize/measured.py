"""Frequency responses that were measured: from recordings with coherence, and on the nonlinear model itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hvdc_ident.errors import LinearizationError, WaveformError, unknown_name
from hvdc_ident.experiment import Experiment
from hvdc_ident.expression import parse
from hvdc_ident.expression.functions import TIME
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.frequency import Response
from hvdc_ident.linearize.jacobian import linearize
from hvdc_ident.linearize.operating_point import find_operating_point
from hvdc_ident.model.definition import Model
from hvdc_ident.model.transform import rewritten


def from_record(
    time: Array, u: Array, y: Array, *, input: str = "u", output: str = "y", segments: int = 8, window: str = "hann"
) -> Response:
    """The response from recorded input to recorded output by Welch's averages, with coherence and standard deviation.

    time: (n,) s; uneven rows are put on an even grid by straight lines. segments: how many, half overlapped; more give
    a surer and coarser estimate. The standard deviation is sqrt((1 - g2)/(2 k g2)) |H| (Bendat and Piersol, 9.2) with k
    the effective number of averages. Raises WaveformError for data that are too short, constant or not finite.
    """
    import scipy.signal

    t, u, y = (np.asarray(v, dtype=float) for v in (time, u, y))
    if not (t.ndim == 1 and t.shape == u.shape == y.shape and t.size >= 16 * max(segments, 1)):
        raise WaveformError(
            "too few rows for a frequency response",
            expected=f"three columns of at least {16 * segments} rows",
            got=f"{t.size}",
        )
    if not (np.isfinite(t).all() and np.isfinite(u).all() and np.isfinite(y).all()):
        raise WaveformError("a recorded value is not finite")
    even = np.linspace(t[0], t[-1], t.size)
    if np.abs(t - even).max() > 1e-6 * (even[1] - even[0]):
        u, y = np.interp(even, t, u), np.interp(even, t, y)
    if np.ptp(u) == 0.0:
        raise WaveformError(f"the input '{input}' never changes: it excites nothing", hint="choose an input that moves")
    length = 2 * t.size // (segments + 1)
    rate = 1.0 / (even[1] - even[0])
    common: dict[str, Any] = {"fs": rate, "nperseg": length, "window": window, "detrend": "constant"}
    f, cross = scipy.signal.csd(u, y, **common)
    own, other = scipy.signal.welch(u, **common)[1], scipy.signal.welch(y, **common)[1]
    keep = (f > 0) & (own > 1e-14 * own.max())
    h = cross[keep] / own[keep]
    power = own[keep] * other[keep]
    coherence = np.where(power > 0, np.abs(cross[keep]) ** 2 / np.where(power > 0, power, 1.0), 0.0).clip(0.0, 1.0)
    averages = max(1.0, segments * 0.947)  # half-overlapped Hann segments (Welch 1967)
    std = np.abs(h) * np.sqrt((1.0 - coherence) / (2.0 * averages * np.maximum(coherence, 1e-12)))
    shape = (-1, 1, 1)
    return Response(
        2 * np.pi * f[keep], h.reshape(shape), (output,), (input,), (("", ""),),
        std.reshape(shape), coherence.reshape(shape), "recording",
    )  # fmt: skip


def from_experiment(experiment: Experiment, input: str, output: str, segments: int = 8) -> Response:
    """The response between an experiment's input and a measured output, over the recorded rows of its window."""
    if input not in experiment.inputs:
        raise unknown_name("input", input, experiment.inputs, where=f"experiment '{experiment.name}'")
    if experiment.measured is None or output not in experiment.measured.names:
        raise unknown_name("measured output", output, experiment.outputs, where=f"experiment '{experiment.name}'")
    rows = experiment.compared & np.isfinite(experiment.measured[output])
    t = experiment.time[rows]
    u, y = experiment.inputs[input](t), experiment.measured[output][rows]
    return from_record(t, u, y, input=input, output=output, segments=segments)


def by_simulation(
    model: Model,
    input: str,
    outputs: Sequence[str],
    omega: Sequence[float] | Array,
    amplitude: float,
    *,
    values: Mapping[str, float] | None = None,
    periods: int = 1,
    rtol: float = 1e-9,
    seed: int = 0,
) -> Response:
    """The response measured on the nonlinear model by a multisine about its steady state: a check on the linear one.

    omega: wanted frequencies, rad/s; each is moved to a multiple of one base frequency, so read them from the result.
    amplitude: of every sine, in the input's unit, small enough for no limit to act and large enough for the solver's
    tolerance. Transients are waited for as long as the linear model's slowest stable mode asks.

    Raises UnknownNameError, LinearizationError for an unstable point, SimulationError.
    """
    from hvdc_ident.simulate import simulate

    if input not in model.inputs:
        raise unknown_name("input", input, model.inputs, where=f"model '{model.name}'")
    wanted = np.unique(np.asarray(omega, dtype=float))
    if wanted.size == 0 or not (wanted > 0).all() or not np.isfinite(wanted).all() or not amplitude > 0:
        raise LinearizationError(
            "a multisine needs frequencies and an amplitude above 0", where="response by simulation"
        )
    base = wanted[0]
    harmonics = np.unique(np.maximum(1, np.rint(wanted / base)).astype(int))
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, harmonics.size)
    period = 2 * np.pi / base
    settle = _settling(model, values or {}) + 1e-9
    begin = period * np.ceil(settle / period)
    count = int(2 ** np.ceil(np.log2(max(64, 8 * harmonics.max()))))
    time = np.concatenate([[0.0], begin + period * periods * np.arange(count * periods) / (count * periods)])

    def multisine(m: Model, u: Any) -> tuple[Model, Any]:
        terms = [
            parse(repr(float(amplitude))) * _sine(float(k * base), float(q))
            for k, q in zip(harmonics, phases, strict=True)
        ]
        return m, sum(terms, start=u)

    excited = rewritten(model, input, "multisine", multisine)
    run = simulate(excited, Experiment("multisine", time), values, outputs=list(outputs), rtol=rtol)
    found = np.empty((harmonics.size, len(outputs), 1), dtype=complex)
    drive = amplitude * np.exp(1j * (phases - np.pi / 2)) / 2
    for i, name in enumerate(outputs):
        spectrum = np.fft.fft(run.trajectory[name][1:]) / (count * periods)
        found[:, i, 0] = spectrum[harmonics * periods] / drive
    units = tuple((model.outputs[o].unit if o in model.outputs else "", model.inputs[input].unit) for o in outputs)
    return Response(harmonics * base, found, tuple(outputs), (input,), units, source="simulation")


def _sine(omega: float, phase: float) -> Any:
    import sympy as sp

    return sp.sin(sp.Float(omega, 17) * TIME + sp.Float(phase, 17))


def _settling(model: Model, values: Mapping[str, float]) -> float:
    """Seconds until the slowest stable mode has decayed by 1e-9; LinearizationError for an unstable point."""
    point = find_operating_point(model, dict(values))
    rates = linearize(model, point).poles().real
    if (rates > 1e-6).any():
        raise LinearizationError("the operating point is unstable: nothing to measure", where=f"model '{model.name}'")
    slow = np.abs(rates[np.abs(rates) > 1e-6])
    return float(np.log(1e9) / slow.min()) if slow.size else 0.0
