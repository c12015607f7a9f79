"""Statistics over fits to single experiments."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hvdc_ident.fit.estimate import Executor, Progress, fit
from hvdc_ident.fit.optimiser import Optimiser
from hvdc_ident.fit.problem import Problem
from hvdc_ident.trajectory import Array


def fit_each(
    problem: Problem,
    *,
    starts: int = 1,
    seed: int = 0,
    optimiser: Optimiser | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """By parameter: the estimates of each experiment alone, and their spread, as the JSON's `per_experiment`.

    Each: experiments {name: {value, std, status}}, n, mean, std, ci95 of one run and ci95_of_mean, all in the
    parameter's unit. `ci95_of_mean` = mean -+ t std/sqrt(n) is an interval of the mean over runs, not of the parameter.
    Fits that failed or did not converge are listed and left out of the spread; so are estimates on a bound.
    """
    results = {
        e.name: fit(
            problem.with_(experiments=[e]),
            starts=starts,
            seed=seed,
            optimiser=optimiser,
            executor=executor,
            progress=progress,
        )
        for e in problem.fitted_experiments
    }
    table: dict[str, Any] = {}
    for name in (f.name for f in problem.free):
        rows: dict[str, dict[str, Any]] = {}
        for experiment, result in results.items():
            e = result.estimates.get(name)
            rows[experiment] = {
                "value": None if e is None else e.value,
                "std": None if e is None else e.std,
                "status": result.status,
            }
        good = [
            row["value"]
            for row in rows.values()
            if row["status"] in ("converged", "at-bound") and row["std"] is not None
        ]
        table[name] = {"experiments": rows, **spread(np.array(good, dtype=float))}
    return table


def spread(values: Array) -> dict[str, Any]:
    """n, mean, std (n - 1), the 95 % interval of one more value and of the mean; None where n is too small."""
    from scipy.stats import t

    n = values.size
    empty = {"n": n, "mean": float(values.mean()) if n else None, "std": None, "ci95": None, "ci95_of_mean": None}
    if n < 2:
        return empty
    mean, std = float(values.mean()), float(values.std(ddof=1))
    half = float(t.ppf(0.975, n - 1)) * std
    one, centre = half * math.sqrt(1.0 + 1.0 / n), half / math.sqrt(n)
    return {**empty, "std": std, "ci95": [mean - one, mean + one], "ci95_of_mean": [mean - centre, mean + centre]}
