"""The gated fit: only what the report calls identifiable is fitted, the rest is held, each with value and reason.

The estimates are stated as the verdicts allow: weak and locally identifiable ones with the profile's interval and without a
standard deviation, those on a bound with a one-sided limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.budget import BudgetSpent
from hvdc_ident.errors import SimulationError, require_known
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import Estimate, FitResult, Problem
from hvdc_ident.fit.assessment import in_final_weights
from hvdc_ident.fit.profile import Profile
from hvdc_ident.fit.result import FitSoFar
from hvdc_ident.fit.search import outcome_lines
from hvdc_ident.identifiability.pilot_fit import LocalAnalysis
from hvdc_ident.identifiability.practical import Assessment, profiles_of
from hvdc_ident.identifiability.report import Held, IdentifiabilityReport
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep

NOT_WALKED = "its profile was not walked to its end: no interval of it is known"
"""Why an estimate of a fit with forced ones has no interval, where the budget ended before its profile did."""


@dataclass(frozen=True)
class Gate:
    """Selection of the parameters that a report lets a fit estimate.

    fitted: the parameters to fit, in the order of the candidates. held: value and reason of the others.
    conditional_on: of a fitted one, those held without which it could not be told. forced: fitted against the report.
    """

    fitted: tuple[str, ...]
    held: FrozenMap[Held]
    conditional_on: FrozenMap[tuple[str, ...]]
    forced: tuple[str, ...] = ()


def gate(report: IdentifiabilityReport, force: Sequence[str] = (), *, diagnosis: bool = False) -> Gate:
    """Return the gate that a report sets up; `force` names parameters to fit all the same.

    diagnosis: free too what is not judged for the misfit alone: a parameter held at a wrong value is a gap of
    its own, and would be named as an effect.
    Raises UnknownNameError for a forced name that is no candidate.
    """
    parameters = report.parameters
    require_known("candidate", force, parameters, where="force")
    selectable = {*report.identifiable, *(report.not_judged if diagnosis else ())}
    forced = tuple(n for n in parameters if n in force and n not in selectable)
    fitted = tuple(n for n in parameters if n in selectable or n in forced)
    held = {}
    for n, h in report.held.items():
        if n not in fitted:
            at = f"{h.value:.6g} {parameters[n].unit}".rstrip()
            held[n] = Held(h.value, f"{parameters[n].verdict}, held at {at}: {h.reason}")
    given = {n: tuple(c for c in parameters[n].conditional_on if c in held) for n in fitted}
    return Gate(fitted, FrozenMap(held), FrozenMap({n: c for n, c in given.items() if c}), forced)


def gated(problem: Problem, selection: Gate) -> Problem:
    """Return the problem with only the fitted parameters free. Raises StudyError where none is left."""
    return replace(
        problem,
        free=tuple(f for f in problem.free if f.name in selection.fitted),
        held=problem.held | {n: h.value for n, h in selection.held.items()},
        why=problem.why | {n: h.reason for n, h in selection.held.items()},
        conditional_on=problem.conditional_on | selection.conditional_on,
    )


def gated_fit(
    problem: Problem,
    report: IdentifiabilityReport,
    fit: Callable[[Problem], FitResult],
    *,
    force: Sequence[str] = (),
    whole: bool = True,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """Return the fit of the identifiable set, its estimates as the report allows them to be stated.

    fit: does the fit it is given. Weak and local parameters get the profile's
    interval and no std; those at a bound stand at it with their one-sided limit. Where some are forced, the report's profiles are of
    another set: those of this fit are walked, and are the intervals of all; forced ones are marked.
    whole: the fit is of all data at once, as the report's profiles are; else only weak ones take theirs, and forced ones have none.
    Where nothing is left to fit the status is "failed" and the message says so. One that is held on a bound makes the
    status "at-bound", for that is where the fit of all would have ended. Where a budget ends what follows the estimates, `FitSoFar` has
    these.
    """
    selection = gate(report, force)
    if not selection.fitted:
        said = ", ".join(f"{n} is {v.verdict}" for n, v in report.parameters.items())
        diagnosis = (NextStep("diagnose"),) if report.not_judged else ()
        return FitResult(
            "failed",
            f"no candidate can be estimated from these data: {said}",
            (),
            FrozenMap({n: h.reason for n, h in selection.held.items()}),
            FrozenMap({n: h.value for n, h in selection.held.items()}),
            estimates=_at_bound(report, selection),
            rmse_given=problem.rmse_given,
            next=(*diagnosis, NextStep("identify"), NextStep("force")),
        )
    result: FitResult | None = None
    try:
        result = fit(gated(problem, selection))
        if result.status == "failed":
            return result
        walks = selection.forced and whole and not _is_systematic(result)
        walked = _profiles_of_fit(gated(problem, selection), result, executor, progress) if walks else None
    except BudgetSpent as end:
        own = [k for k in end.known if isinstance(k, FitSoFar)]
        if result is not None:
            done = (*outcome_lines(result.starts), *(line for k in end.known for line in k.done))
            own = [FitSoFar(done, tuple(w for k in end.known for w in k.not_tried), result=result)]
        if own and own[0].result is not None:
            stated = _allowed(problem, own[0].result, report, selection, None, whole=whole)
            end.known[:] = [replace(own[0], result=stated, forced=selection.forced)]
        raise
    return _allowed(problem, result, report, selection, walked, whole=whole)


def _is_systematic(result: FitResult) -> bool:
    """Return whether a fit leaves more than noise: then no estimate of it has an interval."""
    return result.adequacy is not None and result.adequacy.systematic


def _allowed(
    problem: Problem,
    result: FitResult,
    report: IdentifiabilityReport,
    selection: Gate,
    walked: FrozenMap[Profile] | None,
    *,
    whole: bool,
) -> FitResult:
    """Return a fit with its estimates as the report allows them to be stated. walked: the profiles of a fit with forced ones."""
    if _is_systematic(result):
        estimates = dict(result.estimates)
    elif walked is not None:
        estimates = {n: _by_profile(n, e, walked, report, selection) for n, e in result.estimates.items()}
    elif selection.forced and whole:
        estimates = {n: e.without_interval(NOT_WALKED) for n, e in result.estimates.items()}
    else:
        estimates = {n: _stated(n, e, report, selection, whole=whole) for n, e in result.estimates.items()}
    on_bound = _at_bound(report, selection)
    ordered = {n: {**estimates, **on_bound}.get(n) for n in report.parameters}
    stated = FrozenMap({n: e for n, e in ordered.items() if e is not None})
    # What is held on a bound was given elsewhere: before the fit it stood there.
    before = problem.rmse_given if on_bound else result.rmse_given
    result = replace(result, estimates=stated, rmse_given=before)
    if not on_bound or result.status not in ("converged", "at-bound"):
        return result
    held = f"held on a bound: {', '.join(on_bound)}"
    return replace(result, status="at-bound", message=f"{result.message}; {held}")


def _stated(name: str, e: Estimate, report: IdentifiabilityReport, selection: Gate, *, whole: bool) -> Estimate:
    """Return an estimate in the form its verdict allows."""
    line = report.parameters[name]
    if name in selection.forced:
        return e.without_interval(f"{_forced(line)}; of such a fit no profile is walked")
    interval = _interval(line)
    weak = line.verdict == "weak" or line.std is None
    if interval is None or (not whole and not weak):
        return replace(e, std=None, std_raw=None) if weak else e
    if line.verdict == "locally-identifiable" and not interval[0] <= e.value <= interval[1]:
        return replace(e, reason=f"at another optimum than the report's. {line.reason}")
    if not interval[0] <= e.value <= interval[1]:
        return (
            replace(e, std=None, std_raw=None, ci95=None, method="none", reason="the fit and the pilot fit disagree")
            if weak
            else e
        )
    if not weak:
        return replace(e, std=line.std, ci95=interval, method="profile")
    note = "" if whole else " (its interval is that of the report's own fit, of all data)"
    return replace(
        e, std=None, std_raw=None, ci95=interval, method="profile", reason=f"{line.verdict}: {line.reason}{note}"
    )


def _forced(line: Verdict) -> str:
    """Return the remark on a forced estimate."""
    return f"forced, against the report: {line.verdict}"


def _profiles_of_fit(
    problem: Problem, result: FitResult, executor: Executor | None, progress: Progress | None
) -> FrozenMap[Profile]:
    """Return the profiles around a fit's own optimum, by parameter; none where the model cannot be simulated there again."""
    final = in_final_weights(problem, result)
    theta = [result.values[f.name] for f in final.free]
    theta += [result.nuisance[e.name][n].value for e in final.fitted_experiments for n in e.nuisance]
    assessment = Assessment(final, progress=progress, placed=result.instants)
    try:
        return profiles_of(assessment, LocalAnalysis(final, np.array(theta, dtype=float)), executor)[1]
    except SimulationError:
        return FrozenMap()


def _by_profile(
    name: str, e: Estimate, walked: FrozenMap[Profile], report: IdentifiabilityReport, selection: Gate
) -> Estimate:
    """Return an estimate of a fit with forced ones, with the interval of its own profile; an end that is open is None, with the reason."""
    line = report.parameters[name]
    remarks = [_forced(line)] if name in selection.forced else []
    if name not in walked:
        return e.without_interval("; ".join([*remarks, "its profile cannot be walked: the simulation fails"]))
    profile = walked[name].within_bounds()
    low, high = profile.ci95
    if profile.one_sided:
        low, high = (e.value, high) if low is None else (low, e.value)
    sides = (("lower", walked[name].lower), ("upper", walked[name].upper))
    remarks += [
        f"{end} end: {s.reason}" for end, s in sides if s.reason and not (profile.one_sided and s.limit is None)
    ]
    remarks += [e.reason] if e.reason else []
    if low is None and high is None:
        return replace(
            e, std=None, std_raw=None, ci95=None, ci95_independent=None, method="none", reason="; ".join(remarks)
        )
    if (low is not None and e.value < low) or (high is not None and e.value > high):
        return e.without_interval("; ".join([*remarks, "its profile met a lower cost elsewhere"]))
    told = line.verdict == "identifiable" and name not in selection.forced and not profile.one_sided
    return replace(
        e,
        std=e.std if told else None,
        std_raw=e.std_raw if told else None,
        ci95=(low, high),
        ci95_independent=None,
        method="one-sided" if profile.one_sided else "profile",
        reason="; ".join(remarks),
    )


def _interval(line: Verdict) -> tuple[float, float] | None:
    low, high = line.ci95 or (None, None)
    return None if low is None or high is None else (low, high)


def _at_bound(report: IdentifiabilityReport, selection: Gate) -> FrozenMap[Estimate]:
    """Return the held ones that stand on a bound, with their one-sided limit."""
    on_bound = {}
    for n, line in report.parameters.items():
        if line.verdict == "at-bound" and n in selection.held:
            on_bound[n] = Estimate(line.value, None, _interval(line), "one-sided", unit=line.unit, reason=line.reason)
    return FrozenMap(on_bound)
