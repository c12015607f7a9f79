"""Statistics over fits to single experiments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.special import stdtrit

from hvdc_ident.data import Array
from hvdc_ident.errors import StudyError, unknown_name
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.fit.estimate import fit
from hvdc_ident.fit.optimiser import Optimiser
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.result import FitResult
from hvdc_ident.fit.unknown import FitParameter


def fit_each(
    problem: Problem,
    *,
    runs: Mapping[str, Sequence[str]] | None = None,
    starts: int = 1,
    seed: int = 0,
    optimiser: Optimiser | str | None = None,
    whiten: str = "no",
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """By parameter: the estimates of each experiment alone, and their spread, as the JSON's `per_experiment`.

    runs: by a name of its own, the experiments of each fit, where one fit is to see several; left out: each alone.
    executor: the fits are shared out over it.
    Each: experiments {name: {value, std, status}}, on_bound, and what `spread` gives, all in the parameter's unit.
    Fits that failed or did not converge are listed and left out of the spread; so are estimates on a bound, whose
    number is `on_bound`. Raises UnknownNameError for a run's experiment that is not fitted, StudyError for an empty run.
    """
    parts = _parts(problem, runs)
    one = partial(_alone, starts=starts, seed=seed, optimiser=optimiser, whiten=whiten)
    outcomes: Iterator[FitResult] = mapped(executor, one, list(parts.values()))
    results: dict[str, FitResult] = {}
    for name, result in zip(parts, outcomes, strict=True):
        results[name] = result
        if progress:
            progress(len(results), len(parts), f"'{name}': {result.status}")
    return {f.name: _row(f, results) for f in problem.free}


def _parts(problem: Problem, runs: Mapping[str, Sequence[str]] | None) -> dict[str, Problem]:
    """The problem of each run."""
    known = {e.name: e for e in problem.fitted_experiments}
    parts = {}
    for run, names in ({n: (n,) for n in known} if runs is None else runs).items():
        for name in names:
            if name not in known:
                raise unknown_name("fitted experiment", name, known, where=f"run '{run}'")
        if not names:
            raise StudyError("a run without experiments", where=f"run '{run}'", expected="at least one experiment")
        parts[run] = problem.with_(experiments=[known[n] for n in names])
    return parts


def _alone(problem: Problem, *, starts: int, seed: int, optimiser: Optimiser | str | None, whiten: str) -> FitResult:
    return fit(problem, starts=starts, seed=seed, optimiser=optimiser, whiten=whiten, assess=False)


def _row(free: FitParameter, results: Mapping[str, FitResult]) -> dict[str, Any]:
    """One parameter's estimates by run, and their spread."""
    rows: dict[str, dict[str, Any]] = {}
    for run, result in results.items():
        e = result.estimates.get(free.name)
        rows[run] = {"value": None if e is None else e.value, "std": None if e is None else e.std}
        rows[run]["status"] = result.status
    ended = [r for r in rows.values() if r["status"] in ("converged", "at-bound")]
    inside = np.array([r["value"] for r in ended if r["std"] is not None], dtype=float)
    on_bound = sum(r["value"] is not None and not free.min < r["value"] < free.max for r in ended)
    return {"experiments": rows, "on_bound": on_bound, **spread(inside)}


def spread(values: Array) -> dict[str, Any]:
    """n, mean, std (n - 1), variance, cv (std over |mean|), and two 95 % intervals; None where n is too small.

    `ci95` = mean -+ t std sqrt(1 + 1/n) is where one more value falls; `ci95_of_mean` = mean -+ t std/sqrt(n) is an
    interval of the mean over runs, which shrinks with their number: neither is an interval of the parameter.
    """
    n = values.size
    names = ("mean", "std", "variance", "cv", "ci95", "ci95_of_mean")
    table: dict[str, Any] = {"n": n, **dict.fromkeys(names)}
    if n:
        table["mean"] = float(values.mean())
    if n < 2:
        return table
    mean, std = table["mean"], float(values.std(ddof=1))
    one = half_width(std, n) * math.sqrt(n + 1.0)
    return table | {
        "std": std,
        "variance": std**2,
        "cv": std / abs(mean) if mean else None,
        "ci95": [mean - one, mean + one],
        "ci95_of_mean": [mean - half_width(std, n), mean + half_width(std, n)],
    }


def half_width(std: float, n: int) -> float:
    """t std/sqrt(n): half the 95 % interval of the mean of n values with that standard deviation, in its unit."""
    return float(stdtrit(n - 1, 0.975)) * std / math.sqrt(n)
