"""Checks of what a result holds before it is told: the one place that decides whether the result of a stage is plausible."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from hvdc_ident.fit import FitResult
from hvdc_ident.fit.nonsmooth import LUCK
from hvdc_ident.fit.search import DISTINCT, TIE
from hvdc_ident.identifiability import IdentifiabilityReport, Verdict
from hvdc_ident.summary.linear import Linearisation, LinearResult
from hvdc_ident.summary.stage_results import diagnosis_of, fit_of, identified_of

ROUNDING = 1e-9
"""An interval may miss its estimate by this share of the two: they went through different arithmetic."""
FINISHED = ("converged", "at-bound", "two-optima")
"""Statuses of a fit that call its values estimates."""
ESTIMATED = ("identifiable", "locally-identifiable", "weak", "at-bound")
"""Verdicts of parameters that are told at their estimates; another one is told at the value that it is held at."""


def violations(stage: str, data: Mapping[str, Any]) -> list[str]:
    """Return what keeps the result of a stage from being told, in words; empty where nothing does. data: its JSON."""
    wrong: list[str] = []
    if stage == "fit" and (fit := fit_of(data)) is not None:
        wrong += [*intervals_contain(fit), *best_cost_is_told(fit), *fit_is_judged(fit)]
    elif stage == "identify":
        report = identified_of(data)
        wrong += [*intervals_contain(report), *pilot_is_judged(report)]
    elif stage == "diagnose":
        wrong += intervals_contain(diagnosis_of(data))
    elif stage == "linearize" and "modes" in data:
        linear = Linearisation.from_dict(data)
        for model in (linear.given, linear.at_fitted):
            wrong += [] if model is None else branch_is_told(model)
    return wrong


def intervals_contain(result: Any) -> Iterator[str]:
    """Every value told with a 95 % interval lies in it."""
    for place, told in _with_intervals(result, ()):
        for key in ("ci95", "ci95_independent"):
            low, high = getattr(told, key, None) or (None, None)
            value = told.value
            slack = ROUNDING * max(abs(value), *(abs(end) for end in (low, high) if end is not None), 0.0)
            if (low is not None and low > value + slack) or (high is not None and value - slack > high):
                ends = " to ".join("open" if end is None else f"{end:.6g}" for end in (low, high))
                yield f"{place} = {value:.6g} lies outside its own interval {ends}"


def _with_intervals(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """Yield the place, in words, of every number inside that is told with an interval, and what tells it."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _with_intervals(inner, (*path, str(key)))
    elif isinstance(value, tuple):
        for inner in value:
            yield from _with_intervals(inner, path)
    elif is_dataclass(value):
        held = isinstance(value, Verdict) and value.verdict not in ESTIMATED
        if getattr(value, "ci95", None) and _finite(getattr(value, "value", None)) and not held:
            yield " ".join(path), value
        for f in fields(value):
            yield from _with_intervals(getattr(value, f.name), (*path, f.name))


def best_cost_is_told(fit: FitResult) -> Iterator[str]:
    """No start of a fit reached a cost lower than the one told, by more than two costs that are as good may differ.

    Costs of groups fitted one after the other are not comparable with that of all together. Of a rough cost the optimum of
    its trend is told, not its lowest point: local minima within the intervals are lower, and elsewhere by luck.
    """
    rough = fit.roughness.get("delta_chi2", 0.0) / 2.0
    costs = [
        s.cost
        for s in fit.starts
        if s.cost is not None and s.group is None and not (rough and _within_intervals(s.end, fit))
    ]
    if fit.status not in FINISHED or fit.cost is None or not costs:
        return
    rows = sum(t.n for line in fit.residual_tests.values() for t in line.values())
    effective = sum(fit.effective_samples.values())
    worth = min(1.0, effective / rows) if rows and effective > 0 else 1.0
    fall = fit.cost - min(costs)
    if fall > max(TIE * fit.cost, DISTINCT / worth) + LUCK * rough:
        yield f"a start reached a cost {fall:.3g} below the one told ({fit.cost:.6g}): the estimates are not the best that was seen"


def _within_intervals(end: Mapping[str, float], fit: FitResult) -> bool:
    """Return whether the end of a start lies in the 95 % interval of every estimate; not where one has none."""
    for name, estimate in fit.estimates.items():
        low, high = estimate.ci95 or (None, None)
        if name not in end or low is None or high is None or not low <= end[name] <= high:
            return False
    return True


def fit_is_judged(fit: FitResult) -> Iterator[str]:
    """Beside the intervals of a fit stands chi2/dof, or that the noise is the residual's own, and what a misfit means."""
    stated = [n for n, e in fit.estimates.items() if e.ci95]
    if not stated or fit.status not in FINISHED:
        return
    judged = fit.adequacy
    noise_known = any(not source.startswith("misfit") for source in fit.noise_source.values())
    if judged is None:
        yield f"the intervals of {', '.join(stated)} stand without a verdict on the residuals"
    elif noise_known and not _finite(judged.chi2_per_dof) and judged.verdict != "not-judged":
        yield f"the intervals of {', '.join(stated)} stand without chi2/dof"
    elif judged.verdict == "does-not-fit" and not (judged.text and judged.next):
        yield "the model does not fit, and neither by how much nor what to do is said"


def pilot_is_judged(report: IdentifiabilityReport) -> Iterator[str]:
    """Beside the verdicts of `identify` stands the size of the pilot fit's residuals, of each group's where there are groups."""
    stated = [n for n in report.identifiable if any(e is not None for e in report.parameters[n].ci95 or ())]
    if stated and not all(_finite(p.chi2_per_dof) for p in report.pilot.groups or (report.pilot,)):
        yield f"the intervals of {', '.join(stated)} stand without chi2/dof of the pilot fit"


def branch_is_told(linear: LinearResult) -> Iterator[str]:
    """An operating point on another branch of steady states than the model's own says so."""
    if linear.point.branch in ("unconnected", "other") and not linear.point.notes:
        yield (
            f"the operating point lies on another branch of steady states ('{linear.point.branch}') than the model's own, "
            "and does not say so"
        )


def _finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)
