"""Where model and data differ: by output, experiment, time, frequency and region, and in their frequency responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.errors import InputError
from hvdc_ident.linearize import find_operating_point, frequency_response, linearize
from hvdc_ident.model import AnyModel

LARGE_SHARE = 0.8
"""Share of the gap that a time window, a band or a region has to hold."""
SEGMENTS = 6


def localise(nominal: Nominal) -> dict[str, Any]:
    """Shares of the gap beyond noise, by what it can be sorted by."""
    power = {(b.experiment, b.output): b.chi2 - b.residual.size for b in nominal.blocks}
    return {
        "outputs": _shares(power, 1),
        "experiments": _shares(power, 0),
        "time_window": _window(nominal),
        "phases": _phases(nominal),
        "band_hz": _band(nominal),
        "region": _region(nominal),
    }


def _shares(power: Mapping[tuple[str, str], float], by: int) -> dict[str, float]:
    """Share of the excess chi2 by name, the largest first."""
    found: dict[str, float] = {}
    for key, value in power.items():
        found[key[by]] = found.get(key[by], 0.0) + value
    total = sum(max(v, 0.0) for v in found.values())
    if total <= 0:
        return dict.fromkeys(found, 0.0)
    return {n: max(v, 0.0) / total for n, v in sorted(found.items(), key=lambda item: -item[1])}


def _times(nominal: Nominal) -> tuple[Array, Array]:
    """(N,) seconds from the event, and (N,) squared residuals beyond noise."""
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    since = [experiments[b.experiment].time[b.rows] - _event(experiments[b.experiment]) for b in nominal.blocks]
    return np.concatenate(since), np.concatenate([b.squares for b in nominal.blocks]) - 1.0


def _event(e: Experiment) -> float:
    return e.event if e.event is not None else float(e.time[0])


def _window(nominal: Nominal) -> dict[str, float] | None:
    """The shortest stretch of time, s from the event, that holds most of the gap; None without one."""
    since, excess = _times(nominal)
    edges = np.linspace(since.min(), since.max() + 1e-12, 201)
    per = np.bincount(np.clip(np.searchsorted(edges, since, "right") - 1, 0, 199), weights=excess, minlength=200)
    total = float(per.sum())
    if total <= 4.0 * np.sqrt(2.0 * since.size):
        return None
    sums = np.concatenate([[0.0], np.cumsum(np.maximum(per, 0.0))])
    goal = LARGE_SHARE * sums[-1]
    best, width = (0, 199), np.inf
    for i in range(200):
        j = int(np.searchsorted(sums, sums[i] + goal))
        if j <= 200 and edges[j] - edges[i] < width:
            best, width = (i, j), float(edges[j] - edges[i])
    return {"from": float(edges[best[0]]), "to": float(edges[best[1]]), "share": LARGE_SHARE}


def _phases(nominal: Nominal) -> dict[str, float]:
    """Share of the gap before the event, while the outputs move fastest, while they settle, and after."""
    since, excess = _times(nominal)
    last = max(float(since.max()), 1e-12)
    edges = {"before": (-np.inf, 0.0), "rise": (0.0, 0.05 * last), "recovery": (0.05 * last, 0.4 * last)}
    edges["after"] = (0.4 * last, np.inf)
    sums = {n: max(float(excess[(since >= a) & (since < b)].sum()), 0.0) for n, (a, b) in edges.items()}
    total = sum(sums.values())
    return {n: v / total if total > 0 else 0.0 for n, v in sums.items()}


def _band(nominal: Nominal) -> list[float] | None:
    """[low, high] Hz that holds most of what the residual has in common with the moved inputs; None without any."""
    from scipy import signal

    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    powers: list[tuple[Array, Array]] = []
    for b in nominal.blocks:
        e = experiments[b.experiment]
        t = e.time[b.rows]
        if t.size < 16 * SEGMENTS or np.ptp(np.diff(t)) > 0.05 * float(np.median(np.diff(t))):
            continue
        rate = 1.0 / float(np.median(np.diff(t)))
        length = 2 * t.size // (SEGMENTS + 1)
        for s in e.inputs.values():
            u = s(t)
            if np.ptp(u) == 0.0:
                continue
            common: dict[str, Any] = {"fs": rate, "nperseg": length, "detrend": "constant"}
            f, own = signal.welch(b.residual, **common)
            with np.errstate(invalid="ignore", divide="ignore"):
                c = signal.coherence(u, b.residual, **common)[1]
            beyond = np.maximum(own - 2.0 / rate, 0.0) * np.where(np.isfinite(c), c, 0.0)
            powers.append((f, beyond))
    total = sum(float(p.sum()) for _, p in powers)
    if not powers or total <= 0:
        return None
    longest = int(np.argmax([g.size for g, _ in powers]))
    f = powers[longest][0]
    whole = np.sum([np.interp(f, g, p) for g, p in powers], axis=0)
    sums = np.cumsum(whole) / whole.sum()
    ends = np.searchsorted(sums, [0.5 * (1.0 - LARGE_SHARE), 0.5 * (1.0 + LARGE_SHARE)])
    return [float(v) for v in f[np.minimum(ends, f.size - 1)]]


def _region(nominal: Nominal) -> dict[str, Any] | None:
    """Where in the recorded signals the gap is densest: signal, range, direction, share of the gap and of the rows."""
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    _, excess = _times(nominal)
    if float(excess.sum()) <= 4.0 * np.sqrt(2.0 * excess.size):
        return None
    best: dict[str, Any] | None = None
    for name in nominal.problem.outputs:
        if not all(name in experiments[b.experiment].outputs for b in nominal.blocks):
            continue
        value = np.concatenate([_smooth(_measured(experiments[b.experiment], name))[b.rows] for b in nominal.blocks])
        slope = np.concatenate(
            [np.gradient(_smooth(_measured(experiments[b.experiment], name)))[b.rows] for b in nominal.blocks]
        )
        for label, v in ((name, value), (f"|{name}|", np.abs(value)), (f"d{name}/dt", slope)):
            edges = np.unique(np.quantile(v, np.linspace(0, 1, 9)))
            if edges.size < 3:
                continue
            at = np.clip(np.searchsorted(edges, v, "right") - 1, 0, edges.size - 2)
            gains = np.maximum(np.bincount(at, weights=excess, minlength=edges.size - 1), 0.0)
            rows = np.bincount(at, minlength=edges.size - 1)
            k = int(np.argmax(gains / np.maximum(rows, 1)))
            share, of_rows = float(gains[k] / max(gains.sum(), 1e-300)), float(rows[k] / v.size)
            if best is None or share / of_rows > best["share"] / best["rows"]:
                best = {
                    "signal": label, "from": float(edges[k]), "to": float(edges[k + 1]), "share": share, "rows": of_rows,
                }  # fmt: skip
    return best


def _measured(e: Experiment, output: str) -> Array:
    assert e.measured is not None
    v = e.measured[output]
    return np.asarray(np.where(np.isfinite(v), v, np.nanmean(v)))


def _smooth(v: Array) -> Array:
    """The signal over five rows: a level is no level where noise moves it."""
    if v.size < 5:
        return v
    return np.convolve(np.pad(v, 2, mode="edge"), np.ones(5) / 5.0, "valid")


MAX_FREQUENCIES = 60
MAX_CHANNELS = 12
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
            if len(found) < MAX_CHANNELS:
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
    picked = np.unique(inner[np.unique(np.round(np.geomspace(1, inner.size, MAX_FREQUENCIES)).astype(int) - 1)])
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
