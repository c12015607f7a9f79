"""The report of an assessment that its budget has ended: the verdicts that stand by then, and what is known of the other candidates.

A verdict is told where no later stage would change it. What only the misfit led to may be taken back at the end, so under a misfit that
is no verdict yet.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hvdc_ident.budget import BudgetSpent, Known
from hvdc_ident.fit.profile import ProfilesSoFar
from hvdc_ident.fit.profile_path import Side
from hvdc_ident.fit.search import StartsSoFar, outcome_lines
from hvdc_ident.identifiability.practical import Assessment
from hvdc_ident.identifiability.report import Held, IdentifiabilityReport, Pilot, Unsettled
from hvdc_ident.identifiability.structural import StructuralAnalysis
from hvdc_ident.identifiability.verdicts import HIDDEN_BY_MISFIT, Verdict
from hvdc_ident.immutable import FrozenMap, joined
from hvdc_ident.text import listed, quantity

NOT_ENDED = "Its profile has come to no end: no interval of it is known."
"""Said of a candidate after the search for the optimum, where neither side of its profile has an end."""


@dataclass(frozen=True)
class ReportSoFar(Known):
    """The report of an assessment that its budget has ended."""

    report: IdentifiabilityReport = field(default_factory=IdentifiabilityReport)


def report_so_far(assessment: Assessment, known: Sequence[Known]) -> ReportSoFar:
    """Return what an assessment had come to when its budget ended. known: what the work inside had."""
    starts = next((k for k in known if isinstance(k, StartsSoFar)), None)
    walks = next((k for k in known if isinstance(k, ProfilesSoFar)), None)
    verdicts = {n: v for n, v in _verdicts(assessment).items() if n in assessment.free}
    pilot = assessment.pilot
    judged = None if pilot is None else pilot.adequacy
    unsettled = {
        n: _unsettled(assessment, n, starts, walks) for n in assessment.free if n not in verdicts
    }  # in the order of the candidates
    held = {
        n: Held(assessment.held_at.get(n, assessment.free[n].given), why)
        for n, why in assessment.held.items()
        if n in verdicts
    }
    report = IdentifiabilityReport(
        parameters=FrozenMap({n: verdicts[n] for n in assessment.free if n in verdicts}),
        unsettled=FrozenMap(unsettled),
        held=FrozenMap(held),
        structure=assessment.structure or StructuralAnalysis(),
        combinations=tuple(assessment.combinations),
        profiles=FrozenMap({n: v.profile for n, v in verdicts.items() if v.profile is not None}),
        pilot=Pilot()
        if pilot is None
        else Pilot(
            pilot.status, pilot.message, pilot.search_doubt, len(pilot.starts), pilot.starts, pilot.cost, pilot.chi2_per_dof,
            dict(pilot.effective_samples), dict(pilot.noise_source),
        ),
        notes=(*assessment.notes, *((f"{judged.text}.",) if judged is not None and judged.text else ())),
    )  # fmt: skip
    done = () if pilot is None else outcome_lines(pilot.starts)
    return ReportSoFar(
        (*done, *(line for k in known for line in k.done)), tuple(w for k in known for w in k.not_tried), (), report
    )


def joined_so_far(reports: Sequence[IdentifiabilityReport], end: BudgetSpent, later: Iterable[Sequence[str]]) -> None:
    """Put what all groups came to in place of what the last one did. reports: of the groups before it; later: those not begun."""
    own = next((k for k in end.known if isinstance(k, ReportSoFar)), ReportSoFar())
    not_begun = [n for group in later for n in group]
    text = "Nothing of it was tried: its group had not been begun."
    rest = {n: Unsettled(None, "", None, text) for n in not_begun}
    whole = joined([*reports, replace(own.report, unsettled=own.report.unsettled | rest)])
    before = tuple(line for r in reports for p in (r.pilot, *r.pilot.groups) for line in outcome_lines(p.ends))
    words = (f"all of {listed(not_begun)}",) if not_begun else ()
    end.known[:] = [ReportSoFar((*before, *own.done), own.not_tried, words, whole)]


def _verdicts(assessment: Assessment) -> Mapping[str, Verdict]:
    """Return the verdicts that nothing tried later would change."""
    judged = None if assessment.pilot is None else assessment.pilot.adequacy
    misfit = judged is not None and judged.widening != 1.0
    verdicts = {}
    for n, v in assessment.verdicts.items():
        if misfit and v.verdict in HIDDEN_BY_MISFIT:
            continue
        value = v.value
        if not np.isfinite(value):  # of one that is free, a member of a combination
            known = assessment.pilot.values if assessment.pilot is not None else {}
            value = known.get(n, assessment.free[n].given)
        told = replace(v.noted(assessment.remark), value=value)
        verdicts[n] = told.under_misfit() if judged is not None and judged.systematic else told
    return verdicts


def _unsettled(assessment: Assessment, name: str, starts: StartsSoFar | None, walks: ProfilesSoFar | None) -> Unsettled:
    """Return what is known of a candidate without a verdict."""
    unit, pilot = assessment.units[name], assessment.pilot
    if pilot is None:
        if starts is None or not starts.best:
            return Unsettled(None, unit, None, "The search for the optimum has not come to any end.")
        why = "Its value is that of the lowest start so far; the search for the optimum has not come to its end."
        return Unsettled(starts.best.get(name), unit, None, why)
    value = pilot.values.get(name)
    if pilot.adequacy is not None and pilot.adequacy.systematic:
        return Unsettled(value, unit, None, f"{NOT_ENDED} The model leaves more than noise: no interval would hold.")
    lower, upper = walks.ends.get(name, (None, None)) if walks is not None else (None, None)
    if lower is None and upper is None:
        if name in assessment.verdicts:
            return Unsettled(
                value, unit, None, f"So far: {assessment.verdicts[name].reason} The misfit may have led to it."
            )
        return Unsettled(value, unit, None, NOT_ENDED)
    text = f"Its profile {_end('below', lower, unit)}, and {_end('above', upper, unit)}; whether another optimum is as good was not asked."
    limits = tuple(None if side is None else side.limit for side in (lower, upper))
    return Unsettled(value, unit, (limits[0], limits[1]), text)


def _end(where: str, side: Side | None, unit: str) -> str:
    if side is None:
        return f"was not walked to its end {where}"
    if side.limit is None:
        return f"is open {where} ({side.reason})"
    return f"ends {where} at {quantity(side.limit, unit)}"
