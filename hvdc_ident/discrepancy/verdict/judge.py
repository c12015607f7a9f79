"""The verdict: named, ambiguous, unnameable, no evidence, or not excited."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hvdc_ident.data import Array, event_time
from hvdc_ident.discrepancy.findings.ambiguity import formula_rivals, rivals
from hvdc_ident.discrepancy.findings.conclusion import Rival, Verdict
from hvdc_ident.discrepancy.noise.records import FEWEST
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refits.nominal import Nominal
from hvdc_ident.discrepancy.refits.refit import Refit, signal, unseen
from hvdc_ident.discrepancy.refits.residual_tests import Binned, residual_tests
from hvdc_ident.discrepancy.search.forward import SearchOutcome
from hvdc_ident.discrepancy.trials.context import SearchContext
from hvdc_ident.discrepancy.trials.formula import Law
from hvdc_ident.discrepancy.trials.objections import silent, worst
from hvdc_ident.discrepancy.trials.select import material_gap
from hvdc_ident.discrepancy.verdict.beyond import beyond
from hvdc_ident.discrepancy.verdict.doubts import TRIFLE, Doubt, doubt, remains
from hvdc_ident.effects import effects
from hvdc_ident.errors import SimulationError

DOMINANT = 0.5
"""Share of the gap that what is named has to explain."""
PREDICTED = 0.75
"""The same of the held-out gap, where it is told from noise: gains that make good a wrong form do not in other experiments."""
REFUTED_P = 0.01
STRONG = 0.1
"""Share of the rows' number that a score, or what bins hold beyond noise, has to reach before something is called missing
that has no name: less is what a wrong idea of the noise makes."""


@dataclass(frozen=True)
class Judgement:
    """The verdict, why, and the tests of what is left.

    sets: by effect that was put in, it and what cannot be told from it. experiment: what would show more where nothing was
    excited, or what the doubt is about. instead: the refit of a formula outside the catalogue that explains more than what
    would have been named. doubt: what tells that something else stands behind what was put in, though nothing else that
    was tried explains as much.
    """

    verdict: Verdict
    text: str
    tests: tuple[Binned, ...]
    sets: tuple[tuple[Rival, ...], ...] = ()
    experiment: Mapping[str, Any] = field(default_factory=dict)
    instead: Law | None = None
    doubt: str = ""


def judge(search: SearchContext, first: Refit, outcome: SearchOutcome) -> Judgement:
    """The verdict on a search that has ended."""
    options, last = search.options, outcome.refit
    left = last.nominal()
    tests = tests_of(search, last)
    if not outcome.kept:
        return _nothing(search, first, outcome, tests)
    explained = first.chi2 - last.chi2
    floor = noise_left(left)
    excess = max(first.chi2 - floor * first.rows, explained)
    labels = ", ".join(p.candidate.label for p in last.placed)
    if explained < DOMINANT * excess:
        return Judgement(
            "unnameable",
            f"Something is missing; the best of the catalogue ({labels}) explains only {explained / excess:.0%} of the gap.",
            tests,
        )
    # What looks like noise is the noise, as loud as it is: that of rounded records is not known beforehand.
    if all(b.p > REFUTED_P for b in tests):
        floor = max(floor, last.chi2 / last.rows)
    sets = tuple(rivals(r, options, search.tries("droop")) for r in outcome.kept)
    told = _predicted(first, last, floor, options)
    if told < PREDICTED:
        return _half_told(labels, sets, tests, told)
    sets, better = _with_formulas(search, outcome, sets)
    if better is not None:
        text = f"Something is missing, and what the catalogue has for it ({labels}) explains less than a formula does."
        return Judgement("unnameable", text, tests, instead=better)
    found = _named(labels, sets, tests, explained, options)
    if found.verdict != "named":
        return found
    against = doubt(outcome, left, explained, told, floor, options)
    return found if against is None else _in_doubt(found, labels, against)


def tests_of(search: SearchContext, last: Refit) -> tuple[Binned, ...]:
    """Tests of the residual against noise, over time and over the signals at the slots of the effects."""
    return residual_tests(last.nominal(), _signals(last), bootstraps=search.options.bootstraps, seed=search.seed)


def _with_formulas(
    search: SearchContext, outcome: SearchOutcome, sets: tuple[tuple[Rival, ...], ...]
) -> tuple[tuple[tuple[Rival, ...], ...], Law | None]:
    """By effect that was put in, it and what cannot be told from it; and a formula that explains more than one of them does.

    sets: by the catalogue alone. Formulas are tried where it has no rival, before a name is said, unless no form outside it
    is asked for.
    """
    options = search.options
    if not options.fallback or any(len(g) > 1 for g in sets):
        return sets, None
    wider: list[tuple[Rival, ...]] = []
    for found in outcome.kept:
        formulas = beyond(search, found)
        near = formula_rivals(found, formulas, options)
        if not near:
            best = max(formulas, key=lambda t: t.told)
            return (), Law(best.refit, best.gain)
        wider.append(near)
    return tuple(wider), None


def _named(
    labels: str,
    sets: tuple[tuple[Rival, ...], ...],
    tests: tuple[Binned, ...],
    explained: float,
    options: DiagnosisOptions,
) -> Judgement:
    """Named, or ambiguous where something else may be behind it; or unnameable where what is left is no noise in the region
    that the effect was put there for."""
    others = _or_others(sets)
    like = f"{labels}{others} that these data cannot tell from it" if others else labels
    kind: Verdict = "ambiguous" if others else "named"
    worst = max((b for b in tests if b.p <= REFUTED_P), key=lambda b: b.excess, default=None)
    if worst is None:
        return Judgement(kind, f"Missing: {like}.", tests, sets)
    left = f"the residuals over the {worst.name} are still not noise (p = {worst.p:.2g})"
    if worst.excess <= options.refuted * explained:
        if others or (len(sets) == 1 and worst.excess <= TRIFLE * explained):
            return Judgement(kind, f"Missing: {like}. It is not all of it: {left}.", tests, sets)
        together = f"{labels} beside each other" if len(sets) > 1 else labels
        return _in_doubt(Judgement(kind, "", tests, sets), together, remains([g[0].effect for g in sets], left))
    if _all_of_one_kind(sets) and worst.excess < (1.0 - DOMINANT) * explained:
        return Judgement(kind, f"Missing: something like {like}. None is all of it: {left}.", tests, sets)
    text = f"Something is missing, and no form of the catalogue has its shape: with {labels} {left}."
    return Judgement("unnameable", text, tests)


def _in_doubt(found: Judgement, labels: str, against: Doubt) -> Judgement:
    """Ambiguous, though nothing else that was tried explains as much."""
    they = "they" if len(found.sets) > 1 else "it"
    text = f"Missing: something like {labels}; {against.why}, so {they} may stand for something that is none of those tried."
    return replace(found, verdict="ambiguous", text=text, experiment={"text": against.advice}, doubt=against.why)


def _predicted(first: Refit, last: Refit, floor: float, options: DiagnosisOptions) -> float:
    """The share of the held-out gap that is explained; 1 where that gap is none, or what is left of it of no interest.

    floor: the mean square that noise leaves.
    """
    was, now = unseen(first), unseen(last)
    least = (1.0 + options.holdout_share) * np.sqrt(floor)
    if was is None or now is None or min(was, now) <= least or silent(first, last):
        return 1.0
    return float((was**2 - now**2) / (was**2 - floor))


def _or_others(sets: tuple[tuple[Rival, ...], ...]) -> str:
    """Number of others that explain the data as well, as the rest of a sentence; empty where none does."""
    others = max(len(g) for g in sets) - 1
    return f", or one of {others} others" if others > 1 else ", or another one" if others else ""


def _half_told(labels: str, sets: tuple[tuple[Rival, ...], ...], tests: tuple[Binned, ...], told: float) -> Judgement:
    """The verdict where held-out data tell that what was put in is not all of it; told: the share of their gap it explains."""
    only = f"only {max(told, 0.0):.0%} of the held-out gap"
    if told >= DOMINANT and _all_of_one_kind(sets):
        text = f"Missing: something like {labels}{_or_others(sets)}. None is all of it: they explain {only}."
        return Judgement("ambiguous", text, tests, sets)
    text = f"Something is missing; with {labels} the fitted records are explained but {only} is: the form is not the right one."
    return Judgement("unnameable", text, tests)


def _all_of_one_kind(sets: tuple[tuple[Rival, ...], ...]) -> bool:
    """Return True where all that explain most of a gap are of one kind: it is told then, though none of them is to be believed."""
    return max(len(g) for g in sets) > 1 and all(_one_kind(g) for g in sets)


def _one_kind(group: Sequence[Rival]) -> bool:
    """Return True where the members of a set are one effect at several places, or delays of one kind or another."""
    return len({r.effect for r in group}) == 1 or all(effects()[r.effect].equivalent_delay is not None for r in group)


def noise_left(left: Nominal) -> float:
    """The mean square that noise alone leaves in whitened residuals, from the rows before the events; at least 1.

    It is 1 where the noise is as supposed. AR coefficients from few rows are not: with a standard deviation that is
    given, a coefficient that is wrong by a tenth makes of whitened noise half or three times its size.
    """
    experiments = {e.name: e for e in left.problem.fitted_experiments}
    rows: dict[str, int] = {}
    quiet: dict[str, list[Array]] = {}
    for b in left.blocks:
        e = experiments[b.experiment]
        event = e.event if e.event is not None else event_time(e.inputs)
        rows[b.output] = rows.get(b.output, 0) + b.residual.size
        if event is not None and b.slope is None:  # one level between two steps is no measure of the others
            quiet.setdefault(b.output, []).append(b.residual[e.time[b.rows] < event - 1e-12])
    total = 0.0
    for output, count in rows.items():
        own = np.concatenate(quiet.get(output) or [np.zeros(0)])
        total += count * (float(np.mean(own**2)) if own.size >= FEWEST else 1.0)
    return max(total / max(sum(rows.values()), 1), 1.0)


def _nothing(search: SearchContext, first: Refit, outcome: SearchOutcome, tests: tuple[Binned, ...]) -> Judgement:
    found = outcome.rounds[-1]
    options = search.options
    if found.law is not None:
        text = f"Something is missing, and nothing of the catalogue can be named: {found.why}."
        return Judgement("unnameable", text, tests, instead=found.law)
    was = unseen(first)
    gap_there = material_gap(
        was, 1.0, options.holdout_share, search.material, (worst(first), dict.fromkeys(search.material, 0.0))
    )
    refused = any(b.p <= options.significance and b.excess > STRONG * first.rows for b in tests)
    fitted = float(np.sqrt(first.chi2 / first.rows)) > 1.0 + options.holdout_share
    strong = found.significant and float(found.scores.t.max(initial=0.0)) > STRONG * first.rows
    if (gap_there or (fitted and not search.material)) and (strong or refused):
        why = found.why or "the residuals are not noise"
        return Judgement(
            "unnameable", f"Something is missing, but nothing of the catalogue can be named: {why}.", tests
        )
    usable = found.scores.usable
    if not usable.any():
        still = list(dict.fromkeys(c.effect for c in found.candidates))
        text = "None of the effects looked for is excited by these experiments."
        advice = {"text": ". ".join(f"{e}: {effects()[e].excited_by}" for e in still)}
        return Judgement("not-excited", text, tests, experiment=advice)
    if found.significant:
        return Judgement("no-evidence", f"No gap that matters: {found.why}.", tests)
    return Judgement("no-evidence", f"The data give no sign of a missing effect: {found.why}.", tests)


def _signals(last: Refit) -> dict[str, dict[str, Array]]:
    """The signal at the slots of each effect that was put in, at the rows of every fitted experiment."""
    found: dict[str, dict[str, Array]] = {}
    for place in dict.fromkeys(p for placed in last.placed for p in placed.candidate.at):
        with suppress(SimulationError):  # a place whose signal cannot be had bounds no region
            found[place] = signal(last, place)
    return found
