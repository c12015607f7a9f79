"""The verdict: named, ambiguous, unnameable, no evidence, or not excited."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.description import finding, finding_beside, values_by_place
from hvdc_ident.discrepancy.hypothesis import Refit, signal
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.options import CERTAIN, LISTED, REFUTED, TOLERANCE, SearchContext
from hvdc_ident.discrepancy.remainder import Remainder, remainder_of, share_left
from hvdc_ident.discrepancy.residual_checks import Binned, constancy, residual_tests
from hvdc_ident.discrepancy.result import Finding, FoundEffect, Rival, ValueAt, Verdict
from hvdc_ident.discrepancy.rivals import EffectClass, classes, likely, rivals
from hvdc_ident.discrepancy.score import implied
from hvdc_ident.discrepancy.search import SearchOutcome
from hvdc_ident.discrepancy.sentences import in_words
from hvdc_ident.effects import effects
from hvdc_ident.errors import SimulationError
from hvdc_ident.text import figures, gap_text, listed, probability_text, value_by_place

LEAST_EXPLAINED = 0.5
"""Share of the gap that what is named has to explain."""
ONLY_A_FORM = "what is found from the data alone explains more than any of it"
STRONG_SHARE = 0.1
"""Share of the rows' number that a score, or what bins hold beyond noise, has to reach before something is called missing
that has no name: less is what a wrong idea of the noise makes."""


@dataclass(frozen=True)
class Conclusion:
    """The verdict, why, and the tests of what is left.

    sets: by effect that was put in, it and what cannot be distinguished from it. experiment: what would show more where nothing was
    excited, or what the doubt is about. instead: refits of forms outside the catalogue, the best first, that explain more than what
    would have been named. doubt: what shows that something else stands behind what was put in, though nothing else that
    was tried explains as much. caveat: what the records do not show of a form that is named.
    """

    verdict: Verdict
    text: str
    tests: tuple[Binned, ...]
    sets: tuple[tuple[Rival, ...], ...] = ()
    experiment: Mapping[str, Any] = field(default_factory=dict)
    instead: tuple[Refit, ...] = ()
    doubt: str = ""
    caveat: str = ""
    remainder: Remainder | None = None


def judge(search: SearchContext, first: Refit, outcome: SearchOutcome) -> Conclusion:
    """The verdict on a search that has ended."""
    options, last = search.options, outcome.refit
    tests = tests_of(search, last)
    if outcome.ahead:
        text = f"Something is missing, and nothing of the catalogue can be named: {ONLY_A_FORM}."
        return Conclusion("unnameable", text, tests, instead=tuple(h.refit for h in outcome.ahead))
    if not outcome.named:
        return _nothing(search, last, outcome, tests)
    labels = ", ".join(t.label for t in outcome.named)
    looked = outcome.exhausted or bool(outcome.expansions)
    remainder = _with_terms(remainder_of(search, first, last, misfit_of(last).floor), outcome)
    if looked and remainder.share > 1.0 - LEAST_EXPLAINED:
        text = f"Something is missing; the best of what was tried ({labels}) explains only {gap_text(1.0 - remainder.share)} of the gap."
        return Conclusion("unnameable", text, tests, remainder=remainder)
    sets = tuple(rivals(outcome, t, options, search.tries) for t in outcome.named)
    for group in sets:
        likeliest = classes(group)[0]
        if likeliest.best.is_form and likeliest.probability >= CERTAIN:
            text = (
                f"Something is missing, and what the catalogue has for it ({labels}) explains less than a formula does."
            )
            forms = tuple(r.refit for r, _ in likeliest.members if r.refit is not None)
            return Conclusion("unnameable", text, tests, instead=forms[:1], remainder=remainder)
    found = Conclusion("named", "", tests, sets, remainder=remainder)
    if not looked:
        return _in_doubt(found, labels, NOT_LOOKED_AT)
    return _weighed(outcome, last.nominal(), first.chi2 - last.chi2, found, labels, options.significance)


def _with_terms(remainder: Remainder, outcome: SearchOutcome) -> Remainder:
    """The remainder with what is left as a share of what each term explains beside the others."""
    last, floor = outcome.refit, misfit_of(outcome.refit).floor
    without = [outcome.hypotheses.get(outcome.best.without(t)) for t in outcome.named]
    shares = [None if less is None else share_left(less.refit, last, floor) for less in without]
    # Without a gap, or a model to compare with, a term explains none of what is left.
    none = float(last.chi2 > floor * last.rows)
    return replace(remainder, of_terms=tuple(none if share is None else share for share in shares))


def _weighed(
    outcome: SearchOutcome, left: Nominal, explained: float, found: Conclusion, labels: str, significance: float
) -> Conclusion:
    """The judgement: named; ambiguous where several classes are likely, where something else may be behind one, or where the likely
    places of one imply other values of the parameters; or unnameable where too much is left that a latent input would explain."""
    assert found.remainder is not None
    remainder, each = found.remainder, [classes(g) for g in found.sets]
    sure = all(c[0].probability >= CERTAIN for c in each)
    names = "; and ".join(_class_text(c) for c in each)
    rest = _remainder_text(remainder, significance)
    if rest and remainder.largest > REFUTED:
        if sure or _all_of_one_kind(found.sets):
            text = f"{_prefix(found)}: something like {names}. It is not all of it: {rest}."
            return replace(
                found,
                verdict="ambiguous",
                text=text,
                doubt=rest,
                experiment={"text": doubt_of_remainder(_names(found), rest).advice},
            )
        text = f"Something is missing, and no form of the catalogue has its shape: with {labels} {rest}."
        return replace(found, verdict="unnameable", text=text, sets=())
    against = doubt_of_size(outcome.refit, left, explained)
    if against is None and rest and not remainder.below_tolerance:
        against = doubt_of_remainder(_names(found), rest)
    if against is not None and sure:
        return _in_doubt(found, labels, against)
    if sure and any(c[0].differs for c in each):
        return replace(
            found, verdict="ambiguous", text=f"{_prefix(found)}: {names}; the records do not distinguish these places."
        )
    unseen_of_it = doubt_of_direction(outcome.refit) if sure else None
    if unseen_of_it is not None:
        found = replace(found, caveat=unseen_of_it.why, experiment={"text": unseen_of_it.advice})
    return replace(found, verdict="named" if sure else "ambiguous", text=f"{_prefix(found)}: {names}.")


def leaves_more_than_noise(judgement: Conclusion, last: Refit, *, adequate: bool, significance: float) -> bool:
    """Return True where what the model `last` leaves is more than noise: by the tests of it, by the remainder, or by a doubt.

    Its values, and the sizes of its effects, then make up for what is left as well. They hold only if nothing else is missing, and
    an interval that takes the residual for noise does not cover the truth as often as it says. adequate: whether the tests take the
    residual for noise. One that they do not has to be louder too, as for a fit: noise is known to so much, and noise of another
    colour than was supposed is no misfit.
    """
    left = judgement.remainder if judgement.verdict in ("named", "ambiguous") else None
    shown = bool(judgement.doubt) or (left is not None and bool(_remainder_text(left, significance)))
    return shown or (not adequate and misfit_of(last).matters)


def findings_of(
    search: SearchContext,
    outcome: SearchOutcome,
    judgement: Conclusion,
    placed: Sequence[FoundEffect],
    *,
    with_intervals: bool = True,
) -> tuple[tuple[Finding, ...], dict[str, tuple[ValueAt, ...]]]:
    """Return the findings: of each effect that was put in its likely classes, then the held parameters whose values are off.

    placed: the effects that were put in, with their sentences. Beside them the values of those parameters of the model that depend
    on which of the likely effects and places is the true one, by place. with_intervals: whether sentences have the intervals of sizes.
    """
    share = None if judgement.remainder is None else 1.0 - judgement.remainder.share
    found: list[Finding] = []
    values, depend = implied(outcome.refit), dict[str, tuple[ValueAt, ...]]()
    put_in = dict(zip(outcome.best.effects, placed, strict=False))
    for term, group in zip(outcome.named, judgement.sets, strict=False):
        each = [
            replace(
                finding(one, put_in.get(term), values, with_intervals=with_intervals)
                if one.best.is_effect
                else finding_beside(one.best, one.probability, search),
                share=share,
            )
            for one in likely(classes(group))
        ]
        depend = values_by_place(each) | depend
        found += each
    return tuple(found), depend


def headline(
    judgement: Conclusion,
    findings: Sequence[Finding],
    depend: Mapping[str, Sequence[ValueAt]] | None = None,
    *,
    tolerated: bool = False,
) -> str:
    """The verdict in a few sentences. depend: values that depend on what is missing where. tolerated: whether every signal keeps the
    tolerance that is stated for it."""
    left = judgement.remainder
    if judgement.verdict != "named" or left is None:
        values = [f"{n} is {value_by_place(each)}." for n, each in (depend or {}).items()]
        return " ".join([judgement.text, *values])
    explains = "Together they explain" if len(findings) > 1 else "It explains"
    rest = f"what remains is {figures(left.noise_units, 3)} times the noise"
    rest += ", within the stated tolerance" if tolerated else ""
    caveat = f" {judgement.caveat[:1].upper()}{judgement.caveat[1:]}." if judgement.caveat else ""
    return f"{' '.join(f.text for f in findings)} {explains} {gap_text(1.0 - left.share)} of the gap; {rest}.{caveat}"


def _remainder_text(remainder: Remainder, significance: float) -> str:
    """Return the remainder in words; empty where it may be noise, at this level."""
    parts = []
    own = max(remainder.of_terms, default=0.0)
    if remainder.p <= significance and max(remainder.share, own) > TOLERANCE:
        left = gap_text(remainder.share)
        explains = f" and which an unknown input at {remainder.at} would explain" if remainder.at else ""
        said = f"{left} of the gap is left, which is no noise{explains}"
        if len(remainder.of_terms) > 1 and own > REFUTED:
            said += f"; one of them explains {figures((1.0 - own) / own, 2)} times as much as that"
        parts.append(said)
    held = remainder.held_out or 0.0
    if held > TOLERANCE and remainder.held_out_p <= significance:
        record = f", most of it in '{remainder.record}' ({figures(remainder.record_units, 3)} times the noise)"
        parts.append(f"{gap_text(held)} of the held-out gap is left{record if remainder.record else ''}")
    return "; ".join(parts)


def _prefix(found: Conclusion) -> str:
    """Return what a list of terms begins with: of effects, or of values and components too."""
    return "Missing" if all(r.is_effect for g in found.sets for r in g) else "Wrong or missing"


def _names(found: Conclusion) -> list[str]:
    return [g[0].effect for g in found.sets]


def _class_text(each: Sequence[EffectClass]) -> str:
    """The classes of one effect in words, those that hold 95 % together."""
    texts = []
    for c in likely(each):
        at = list(dict.fromkeys([c.best.at, *(r.at for r, _ in c.members)]))
        where = ", or at ".join(listed(places) for places in at[:LISTED])
        more = f", or at one of {len(at) - LISTED} more places" if len(at) > LISTED else ""
        kinds = c.kinds if c.best.is_effect else [in_words(c.best)]
        where = f" at {where}{more}" if c.best.is_effect else ""
        texts.append(f"{' or '.join(kinds)} ({probability_text(c.probability)}){where}")
    return "; or ".join(texts)


def tests_of(search: SearchContext, last: Refit) -> tuple[Binned, ...]:
    """Tests of the residual against noise, over time and over the signals at the slots of the effects."""
    return residual_tests(last.nominal(), _signals(last), bootstraps=search.options.bootstraps, seed=search.seed)


def _in_doubt(found: Conclusion, labels: str, against: Doubt) -> Conclusion:
    """Ambiguous, though nothing else that was tried explains as much."""
    they = "they" if len(found.sets) > 1 else "it"
    text = f"{_prefix(found)}: something like {labels}; {against.why}, so {they} may stand for something that is none of those tried."
    return replace(found, verdict="ambiguous", text=text, experiment={"text": against.advice}, doubt=against.why)


def _all_of_one_kind(sets: tuple[tuple[Rival, ...], ...]) -> bool:
    """Return True where all that explain most of a gap are of one kind: it is named then, though none of them is to be believed."""
    return max(len(g) for g in sets) > 1 and all(_one_kind(g) for g in sets)


def _one_kind(group: Sequence[Rival]) -> bool:
    """Return True where the members of a set are one effect at several places, or delays of one kind or another."""
    if len({r.kind for r in group}) == 1:
        return True
    return all(r.is_effect and effects()[r.effect].equivalent_delay is not None for r in group)


def _nothing(search: SearchContext, last: Refit, outcome: SearchOutcome, tests: tuple[Binned, ...]) -> Conclusion:
    """The conclusion where no hypothesis is better than the model as it is, or something speaks against each that is."""
    options, found = search.options, outcome.opened
    if found is None:
        return Conclusion("no-evidence", "The data give no sign of a missing effect.", tests)
    if not any(found.screen.usable(column) for column in found.screen.size):
        still = list(dict.fromkeys(c.effect for c in found.candidates))
        text = "None of the effects looked for is excited by these experiments."
        advice = {"text": ". ".join(f"{e}: {effects()[e].excited_by}" for e in still)}
        return Conclusion("not-excited", text, tests, experiment=advice)
    if outcome.explained_by_errors:
        text = f"Stated values and recorded levels that are off by no more than they may be explain the gap ({outcome.slight})."
        return Conclusion("no-evidence", f"No effect is named: {text[:1].lower()}{text[1:]}", tests)
    refused = any(b.p <= options.significance and b.excess > STRONG_SHARE * last.rows for b in tests)
    p = found.screen.p(max(found.screen.scores[0].fall, 0.0)) if found.screen.scores else 1.0
    strong = p <= options.significance and found.screen.scores[0].fall > STRONG_SHARE * last.rows
    if (strong or refused) and misfit_of(last).is_material(search.tolerance, options):
        why = outcome.objection or "the residuals are not noise"
        return Conclusion(
            "unnameable", f"Something is missing, but nothing of the catalogue can be named: {why}.", tests
        )
    if outcome.objection and p <= options.significance:
        return Conclusion("no-evidence", f"No gap that matters: {outcome.objection}.", tests)
    why = (
        f"the best of all is what noise gives (p = {p:.2g})"
        if p > options.significance
        else "nothing explains more than its price"
    )
    return Conclusion("no-evidence", f"The data give no sign of a missing effect: {why}.", tests)


def _signals(last: Refit) -> dict[str, dict[str, Array]]:
    """The signal at the slots of each effect that was put in, at the rows of every fitted experiment."""
    found: dict[str, dict[str, Array]] = {}
    for place in dict.fromkeys(p for placed in last.placed for p in placed.candidate.at):
        with suppress(SimulationError):  # a place whose signal cannot be had bounds no region
            found[place] = signal(last, place)
    return found


VARYING_P = 1e-4
"""Chance under noise of experiments that agree on a size: the test is of first order, and a name is not to be lost by that."""


@dataclass(frozen=True)
class Doubt:
    """Why something else may stand behind what was put in, as a sentence goes on; advice: the experiment that would show it."""

    why: str
    advice: str


NOT_LOOKED_AT = Doubt("the budget ended before effects were looked for", "Nothing yet: a larger budget may tell.")


def doubt_of_size(last: Refit, left: Nominal, explained: float) -> Doubt | None:
    """Doubt because the experiments ask for different sizes of an effect in the refit `last`; None where they do not.

    left: its residuals; explained: by how much chi2 fell, beside which a disagreement is nothing.
    """
    for placed in last.placed:
        (fall, p), label = constancy(last, left, placed), placed.candidate.label
        if p < VARYING_P and fall > TOLERANCE * explained:
            why = f"the experiments ask for different sizes of {label} (p = {p:.1g})"
            return Doubt(why, f"The same input in several sizes, in which {label} answers.")
    return None


def doubt_of_remainder(names: Sequence[str], left: str) -> Doubt:
    """Doubt because more than noise is left: the true effect leaves nothing, one in its place does.

    A relay looks like a coupling with a backlash, or like a quantiser. names: the effects that were put in; left: where the
    rest is, as a sentence.
    """
    each = [n for n in dict.fromkeys(names) if n in effects()]
    apart = "Each of them by itself. " if len(names) > 1 else ""
    more = ". ".join(f"{n}: {effects()[n].excited_by}" for n in each)
    return Doubt(left, apart + (more or "Larger inputs, and the signals between the places that are in question"))


def doubt_of_direction(last: Refit) -> Doubt | None:
    """Doubt because a play was passed in one direction only: whatever shifts a signal once it has moved does the same.

    It takes away no name, for nothing that shifts a signal so is among the hypotheses: it is said beside the name.
    """
    for placed in last.placed:
        width = last.sizes(placed).get(effects()[placed.candidate.effect].reversal)
        if width is None:
            continue
        try:
            seen = [u for place in placed.candidate.at for u in signal(last, place).values()]
        except SimulationError:  # of a place whose signal cannot be had nothing is known
            continue
        if not any(_turned(u, width) for u in seen):
            return Doubt(
                f"in no record does the signal at {placed.candidate.at[0]} turn by more than {width:.3g}, so another "
                "hysteresis may look the same",
                f"{placed.candidate.effect}: {effects()[placed.candidate.effect].excited_by}.",
            )
    return None


def _turned(u: Array, width: float) -> bool:
    """Return True where a signal that has moved turns and goes back by more than a width."""
    risen, fallen = u - np.minimum.accumulate(u), np.maximum.accumulate(u) - u
    # After a turn both are large at once: how far it rose before its highest value yet, and how far it fell from there.
    return bool(
        np.any(np.minimum(np.maximum.accumulate(risen), fallen) > width)
        or np.any(np.minimum(np.maximum.accumulate(fallen), risen) > width)
    )
