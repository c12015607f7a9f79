"""Whether residuals look like noise: whiteness, runs of one sign, correlation with the inputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import chdtrc

from hvdc_ident.data import Array, Experiment
from hvdc_ident.fit.residual import ResidualBlock


def residual_tests(blocks: Sequence[ResidualBlock], experiments: Sequence[Experiment]) -> dict[str, dict[str, Any]]:
    """The tests by output and experiment; p is the chance of such a value from white noise, None where not defined.

    Each: n, mean and std (in sigma), ljung_box {statistic, lags, p}, runs {runs, expected, p},
    inputs {name: {correlation, lag, p}} with lag in rows, the input leading.
    """
    by_name = {e.name: e for e in experiments}
    table: dict[str, dict[str, Any]] = {}
    for block in blocks:
        table.setdefault(block.output, {})[block.experiment] = _tests(block, by_name[block.experiment])
    return table


def _tests(block: ResidualBlock, experiment: Experiment) -> dict[str, Any]:
    r = block.residual
    inputs = {}
    for name, signal in experiment.inputs.items():
        u = signal(experiment.time)[block.rows]
        if np.ptp(u) > 0:
            inputs[name] = cross_correlation(r, u)
    return {
        "n": int(r.size),
        "mean": float(r.mean()),
        "std": float(r.std()),
        "ljung_box": ljung_box(r, parts=block.stretches),
        "runs": runs(r),
        "inputs": inputs,
    }


def ljung_box(r: Array, lags: int | None = None, parts: Sequence[slice] = ()) -> dict[str, Any]:
    """Ljung and Box's (1978) statistic over the first lags (default: 10, or a fifth of the rows), with its p.

    parts: stretches of rows between which some are missing; none for one stretch.
    """
    n = r.size
    lags = min(10, n // 5) if lags is None else lags
    centred = r - r.mean()
    power = float(centred @ centred)
    if lags < 1 or power == 0.0:
        return {"statistic": None, "lags": lags, "p": None}
    records = [centred[part] for part in parts] or [centred]
    acf = np.array([sum(float(c[k:] @ c[:-k]) for c in records) / power for k in range(1, lags + 1)])
    statistic = float(n * (n + 2) * np.sum(acf**2 / (n - np.arange(1, lags + 1))))
    return {"statistic": statistic, "lags": lags, "p": float(chdtrc(lags, statistic))}


def runs(r: Array) -> dict[str, Any]:
    """The number of runs of one sign against what chance gives (Wald and Wolfowitz 1940), with its two-sided p."""
    signs = np.sign(r)
    signs = signs[signs != 0]
    up, down = int((signs > 0).sum()), int((signs < 0).sum())
    found = int(1 + (np.diff(signs) != 0).sum()) if signs.size else 0
    n = up + down
    if not up or not down or n < 3:
        return {"runs": found, "expected": None, "p": None}
    expected = 1.0 + 2.0 * up * down / n
    variance = (expected - 1.0) * (expected - 2.0) / (n - 1.0)
    if variance <= 0:
        return {"runs": found, "expected": expected, "p": None}
    return {"runs": found, "expected": expected, "p": math.erfc(abs(found - expected) / math.sqrt(2.0 * variance))}


def cross_correlation(r: Array, u: Array, lags: int | None = None) -> dict[str, Any]:
    """The largest correlation of the residual with the same or an earlier input row, its lag, and the p of all lags.

    Both are first filtered by their own AR(1) coefficient, so that two slow signals do not count as related; the
    statistic n sum(ccf^2) over lags 0 to 20 (or a fifth of the rows) is chi-square (Box and Jenkins, section 11.3).
    """
    n = r.size
    lags = min(20, n // 5) if lags is None else lags
    a, b = _innovation(r), _innovation(u)
    power = math.sqrt(float(a @ a) * float(b @ b))
    if power == 0.0 or n < 5:
        return {"correlation": None, "lag": None, "p": None}
    ccf = np.array([float(a[k:] @ b[: b.size - k]) / power for k in range(lags + 1)])
    lag = int(np.argmax(np.abs(ccf)))
    return {"correlation": float(ccf[lag]), "lag": lag, "p": float(chdtrc(lags + 1, n * float(ccf @ ccf)))}


def _innovation(signal: Array) -> Array:
    """The signal less its mean, filtered by its own AR(1) coefficient."""
    centred = signal - signal.mean()
    power = float(centred @ centred)
    rho = float(centred[1:] @ centred[:-1]) / power if power else 0.0
    return centred[1:] - rho * centred[:-1]
