"""Where model and data differ: by output, experiment, time, frequency and region."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.nominal import Nominal

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
