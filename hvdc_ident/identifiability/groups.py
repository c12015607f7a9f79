"""The report for the individual mode: every group of parameters judged on its own outputs and experiments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

from hvdc_ident.data import Experiment
from hvdc_ident.errors import StudyError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.partial_fits import Group, part_of
from hvdc_ident.fit.simulator import Simulator
from hvdc_ident.identifiability.assess import identifiability
from hvdc_ident.identifiability.heterogeneity import Misspecification
from hvdc_ident.identifiability.report import IdentifiabilityReport
from hvdc_ident.identifiability.structure import Structure
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.simulate import ModelSimulator


def identifiability_by_group(
    subject: Model | Simulator,
    experiments: Iterable[Experiment],
    candidates: Iterable[FitParameter],
    groups: Sequence[Group],
    *,
    pair: tuple[str, str] | None = None,
    **options: Any,
) -> IdentifiabilityReport:
    """What each group's outputs and experiments tell about its parameters while the others are held, as one report.

    The groups follow each other as in the fit: a later one holds what the earlier ones found, and those to come at their
    given value. Every verdict is its group's; the others' values are taken as known in it, and a note says so. Other arguments
    as in `identifiability`. Raises StudyError where a candidate stands in no group, or in two.
    """
    simulator: Simulator = ModelSimulator(subject) if isinstance(subject, Model) else subject
    problem = Problem(simulator, tuple(experiments), tuple(candidates))
    names = [f.name for f in problem.free]
    listed = [n for g in groups for n in g.parameters]
    if sorted(listed) != sorted(names):
        expected, got = ", ".join(names), ", ".join(listed)
        raise StudyError("groups must hold every candidate once", where="fit groups", expected=expected, got=got)
    current = {f.name: f.given for f in problem.free}
    reports = []
    for group in groups:
        part = part_of(problem, group, current)
        both = pair if pair and set(pair) <= set(group.parameters) else None
        report = identifiability(subject, part.experiments, part.free, held=part.held, pair=both, **options)
        current |= {n: v.value for n, v in report.parameters.items()}
        reports.append(_noted(report, group, part))
    merged = _advised(reduce(_merged, reports), reports)
    if pair and merged.pair is None and not any(set(pair) <= set(g.parameters) for g in groups):
        note = f"No common profile of {' and '.join(pair)}: they stand in two groups."
        merged = replace(merged, notes=(*merged.notes, note))
    return _ordered(merged, names)


def _noted(report: IdentifiabilityReport, group: Group, part: Problem) -> IdentifiabilityReport:
    """A group's report, its notes begun with whose they are."""
    mine = ", ".join(group.parameters)
    data = f"{', '.join(part.outputs)} in {', '.join(e.name for e in part.fitted_experiments)}"
    first = f"{mine}: judged alone, on {data}, the other candidates held."
    notes = (first, *(f"{mine}: {n}" for n in report.notes))
    signs = tuple(f"{mine}: {s}" for s in report.misspecification.signs)
    pilot = {"groups": [{"parameters": list(group.parameters), **report.pilot}]}
    return replace(report, notes=notes, misspecification=replace(report.misspecification, signs=signs), pilot=pilot)


def _merged(a: IdentifiabilityReport, b: IdentifiabilityReport) -> IdentifiabilityReport:
    """Two groups' reports as one, without what to measure next."""
    experiments = list(dict.fromkeys((*a.shares, *b.shares)))
    shares = {e: FrozenMap({**a.shares.get(e, {}), **b.shares.get(e, {})}) for e in experiments}
    return IdentifiabilityReport(
        parameters=a.parameters | b.parameters,
        identifiable=(*a.identifiable, *b.identifiable),
        held=a.held | b.held,
        structure=_structure(a.structure, b.structure),
        combinations=(*a.combinations, *b.combinations),
        collinear=(*a.collinear, *b.collinear),
        correlation={**a.correlation, **b.correlation},
        shares=FrozenMap(shares),
        heterogeneity=a.heterogeneity | b.heterogeneity,
        misspecification=_misspecified(a.misspecification, b.misspecification),
        thresholds=a.thresholds | b.thresholds,
        pilot=_pilots(a.pilot, b.pilot),
        notes=(*a.notes, *b.notes),
        pair=a.pair or b.pair,
        not_judged=(*a.not_judged, *b.not_judged),
        optima=(*a.optima, *b.optima),
    )


def _advised(merged: IdentifiabilityReport, reports: Sequence[IdentifiabilityReport]) -> IdentifiabilityReport:
    """With what to measure next for the first group that needs it, and in the notes what the others would."""
    chosen = next((r for r in reports if _needy(r)), reports[0])
    notes = tuple(
        f"To measure next for {', '.join(r.parameters)}: {r.recommended.text}"
        for r in reports
        if r is not chosen and r.recommended is not None
    )
    return replace(merged, recommended=chosen.recommended, notes=(*merged.notes, *notes))


def _needy(report: IdentifiabilityReport) -> bool:
    """Whether something in it is not identifiable."""
    return any(v.verdict not in ("identifiable", "at-bound") for v in report.parameters.values())


def _structure(a: Structure, b: Structure) -> Structure:
    return Structure(
        "decided" if a.status == b.status == "decided" else "not decided",
        a.method if a.method == b.method else f"{a.method}; {b.method}",
        (*a.admissible, *b.admissible),
        (*a.combinations, *b.combinations),
        "; ".join(n for n in (a.note, b.note) if n),
        (*a.unmoved, *b.unmoved),
    )


def _misspecified(a: Misspecification, b: Misspecification) -> Misspecification:
    return Misspecification(a.flag or b.flag, (*a.signs, *b.signs), a.pointer or b.pointer)


def _pilots(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
    return {"groups": [*a["groups"], *b["groups"]]}


def _ordered(report: IdentifiabilityReport, names: Sequence[str]) -> IdentifiabilityReport:
    """The report with the candidates in their own order."""
    shares = {e: FrozenMap({n: line.get(n, 0.0) for n in names}) for e, line in report.shares.items()}
    return replace(
        report,
        parameters=FrozenMap({n: report.parameters[n] for n in names}),
        identifiable=tuple(n for n in names if n in report.identifiable),
        held=FrozenMap({n: report.held[n] for n in names if n in report.held}),
        shares=FrozenMap(shares),
    )
