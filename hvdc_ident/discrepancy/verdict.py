"""The verdict: named, ambiguous, unnameable, no evidence, or not excited."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hvdc_ident.data import FEWEST_QUIET, Array, event_time, quiet_rows
from hvdc_ident.discrepancy.classes import EffectClass, classes, formula_rivals, likely, rivals
from hvdc_ident.discrepancy.evidence import largest_rmse, louder_than_noise, material_gap
from hvdc_ident.discrepancy.explain import moved_parameters
from hvdc_ident.discrepancy.findings import finding, values_by_place
from hvdc_ident.discrepancy.forms import alternatives
from hvdc_ident.discrepancy.hypothesis import Refit, signal
from hvdc_ident.discrepancy.implied import implied
from hvdc_ident.discrepancy.known_errors import known_errors
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.options import CERTAIN, LISTED, REFUTED, TOLERANCE, SearchContext
from hvdc_ident.discrepancy.remainder import Remainder, remainder_of
from hvdc_ident.discrepancy.residual_checks import Binned, constancy, residual_tests
from hvdc_ident.discrepancy.result import Finding, FoundEffect, Rival, ValueAt, Verdict
from hvdc_ident.discrepancy.rounds import FoundForm
from hvdc_ident.discrepancy.search import SearchOutcome
from hvdc_ident.effects import effects
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.adequacy import MATTERS
from hvdc_ident.text import figures, gap_text, listed, probability_text, value_by_place

LEAST_EXPLAINED = 0.5
"""Share of the gap that what is named has to explain."""
OUTSIDE = ("term", "filter")
"""Forms that no name of the catalogue stands for."""
STRONG_SHARE = 0.1
"""Share of the rows' number that a score, or what bins hold beyond noise, has to reach before something is called missing
that has no name: less is what a wrong idea of the noise makes."""


@dataclass(frozen=True)
class Conclusion:
    """The verdict, why, and the tests of what is left.

    sets: by effect that was put in, it and what cannot be distinguished from it. experiment: what would show more where nothing was
    excited, or what the doubt is about. instead: the refit of a formula outside the catalogue that explains more than what
    would have been named. doubt: what shows that something else stands behind what was put in, though nothing else that
    was tried explains as much. caveat: what the records do not show of a form that is named.
    """

    verdict: Verdict
    text: str
    tests: tuple[Binned, ...]
    sets: tuple[tuple[Rival, ...], ...] = ()
    experiment: Mapping[str, Any] = field(default_factory=dict)
    instead: FoundForm | None = None
    doubt: str = ""
    caveat: str = ""
    remainder: Remainder | None = None


def judge(search: SearchContext, first: Refit, outcome: SearchOutcome) -> Conclusion:
    """The verdict on a search that has ended."""
    options, last = search.options, outcome.refit
    left = last.nominal()
    tests = tests_of(search, last)
    if not outcome.kept:
        return _nothing(search, last, outcome, tests)
    remainder = remainder_of(search, first, last, noise_floor(last, left, tests, options.significance))
    labels = ", ".join(p.candidate.label for p in last.placed)
    if remainder.share > 1.0 - LEAST_EXPLAINED:
        text = f"Something is missing; the best of the catalogue ({labels}) explains only {gap_text(1.0 - remainder.share)} of the gap."
        return Conclusion("unnameable", text, tests, remainder=remainder)
    sets = tuple(rivals(r, options, search.tries) for r in outcome.kept)
    sets, better = _with_formulas(search, outcome, sets)
    if better is not None:
        text = f"Something is missing, and what the catalogue has for it ({labels}) explains less than a formula does."
        return Conclusion("unnameable", text, tests, instead=better, remainder=remainder)
    explained = first.chi2 - last.chi2
    found = Conclusion("named", "", tests, sets, remainder=remainder)
    weighed = _weighed(outcome, left, explained, found, labels, options.significance)
    against = doubt_of_known_errors(search, outcome) if weighed.verdict == "named" else None
    return weighed if against is None else _in_doubt(found, labels, against)


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
            text = f"Missing: something like {names}. It is not all of it: {rest}."
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
            found, verdict="ambiguous", text=f"Missing: {names}; the records do not distinguish these places."
        )
    unseen_of_it = doubt_of_direction(outcome.refit) if sure else None
    if unseen_of_it is not None:
        found = replace(found, caveat=unseen_of_it.why, experiment={"text": unseen_of_it.advice})
    return replace(found, verdict="named" if sure else "ambiguous", text=f"Missing: {names}.")


def leaves_more_than_noise(judgement: Conclusion, last: Refit, *, adequate: bool, significance: float) -> bool:
    """Return True where what the model `last` leaves is more than noise: by the tests of it, by the remainder, or by a doubt.

    Its values, and the sizes of its effects, then make up for what is left as well. They hold only if nothing else is missing, and
    an interval that takes the residual for noise does not cover the truth as often as it says. adequate: whether the tests take the
    residual for noise. One that they do not has to be louder too, as for a fit: noise is known to so much, and noise of another
    colour than was supposed is no misfit.
    """
    left = judgement.remainder if judgement.verdict in ("named", "ambiguous") else None
    shown = bool(judgement.doubt) or (left is not None and bool(_remainder_text(left, significance)))
    return shown or (not adequate and max(_power_by_output(last.nominal()).values(), default=0.0) > MATTERS)


def _power_by_output(left: Nominal) -> dict[str, float]:
    """The mean square of the residual of each output, in units of its noise."""
    each: dict[str, list[Array]] = {}
    for b in left.blocks:
        each.setdefault(b.output, []).append(b.residual)
    return {o: float(np.mean(np.concatenate(parts) ** 2)) for o, parts in each.items()}


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
    for of, own, group in zip(outcome.kept, placed, judgement.sets, strict=False):
        each = [
            replace(finding(of, one, own, values, with_intervals=with_intervals), share=share)
            for one in likely(classes(group))
        ]
        depend = values_by_place(each) | depend
        found += each
    freed = {f.name for f in (*search.held, *search.stated)} & set(outcome.refit.problem.names)
    if placed and freed and (moved := moved_parameters(outcome.refit, freed)) is not None:
        found.append(replace(moved, share=share))
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
    if remainder.p <= significance and remainder.share > TOLERANCE:
        left = gap_text(remainder.share)
        parts.append(
            f"{left} of the gap is left, which is no noise and which an unknown input at {remainder.at} would explain"
        )
    held = remainder.held_out or 0.0
    if held > TOLERANCE and remainder.held_out_p <= significance:
        record = f", most of it in '{remainder.record}' ({figures(remainder.record_units, 3)} times the noise)"
        parts.append(f"{gap_text(held)} of the held-out gap is left{record if remainder.record else ''}")
    return "; ".join(parts)


def _names(found: Conclusion) -> list[str]:
    return [g[0].effect for g in found.sets]


def _class_text(each: Sequence[EffectClass]) -> str:
    """The classes of one effect in words, those that hold 95 % together."""
    texts = []
    for c in likely(each):
        at = list(dict.fromkeys([c.best.at, *(r.at for r, _ in c.members)]))
        where = ", or at ".join(listed(places) for places in at[:LISTED])
        more = f", or at one of {len(at) - LISTED} more places" if len(at) > LISTED else ""
        texts.append(f"{' or '.join(c.kinds)} ({probability_text(c.probability)}) at {where}{more}")
    return "; or ".join(texts)


def tests_of(search: SearchContext, last: Refit) -> tuple[Binned, ...]:
    """Tests of the residual against noise, over time and over the signals at the slots of the effects."""
    return residual_tests(last.nominal(), _signals(last), bootstraps=search.options.bootstraps, seed=search.seed)


def _with_formulas(
    search: SearchContext, outcome: SearchOutcome, sets: tuple[tuple[Rival, ...], ...]
) -> tuple[tuple[tuple[Rival, ...], ...], FoundForm | None]:
    """The sets with formulas from outside the catalogue that explain as much, and a formula that explains more than an effect does.

    They are tried in the stead of an effect that would be named by the catalogue alone, unless no form outside it is asked for.
    """
    wider: list[tuple[Rival, ...]] = []
    for found, group in zip(outcome.kept, sets, strict=True):
        if not search.options.fallback or search.spent or classes(group)[0].probability < CERTAIN:
            wider.append(group)
            continue
        formulas = alternatives(search, found)
        behind, near = formula_rivals(found, formulas, search.options)
        best = max((t for t, _ in formulas), key=lambda t: t.total_gain, default=None)
        if best is not None and np.isinf(behind):
            return (), FoundForm(found.before, best.refit, best.gain)
        wide = (*(replace(r, delta_bic=r.delta_bic + behind) for r in group), *near)
        likeliest = classes(wide)[0]
        if best is not None and likeliest.names[0] in OUTSIDE and likeliest.probability >= CERTAIN:
            return (), FoundForm(found.before, best.refit, best.gain)
        wider.append(wide)
    return tuple(wider), None


def _in_doubt(found: Conclusion, labels: str, against: Doubt) -> Conclusion:
    """Ambiguous, though nothing else that was tried explains as much."""
    they = "they" if len(found.sets) > 1 else "it"
    text = f"Missing: something like {labels}; {against.why}, so {they} may stand for something that is none of those tried."
    return replace(found, verdict="ambiguous", text=text, experiment={"text": against.advice}, doubt=against.why)


def _all_of_one_kind(sets: tuple[tuple[Rival, ...], ...]) -> bool:
    """Return True where all that explain most of a gap are of one kind: it is named then, though none of them is to be believed."""
    return max(len(g) for g in sets) > 1 and all(_one_kind(g) for g in sets)


def _one_kind(group: Sequence[Rival]) -> bool:
    """Return True where the members of a set are one effect at several places, or delays of one kind or another."""
    return len({r.effect for r in group}) == 1 or all(effects()[r.effect].equivalent_delay is not None for r in group)


def noise_floor(last: Refit, left: Nominal, tests: Sequence[Binned], significance: float) -> float:
    """The mean square of the residuals of `last` that counts as noise. left: its residuals, tests: those of them."""
    floor = noise_left(left)
    # What looks like noise is the noise, as loud as it is: that of rounded records is not known beforehand.
    return max(floor, last.chi2 / last.rows) if all(b.p > significance for b in tests) else floor


def noise_left(left: Nominal) -> float:
    """The mean square that noise alone leaves in whitened residuals, from the rows before the events that are at rest; at least 1.

    It is 1 where the noise is as supposed. AR coefficients from few rows are not: with a standard deviation that is
    given, a coefficient that is wrong by a tenth makes of whitened noise half or three times its size.
    """
    experiments = {e.name: e for e in left.problem.fitted_experiments}
    rows: dict[str, int] = {}
    quiet: dict[str, list[Array]] = {}
    for b, run in zip(left.blocks, left.fitted(), strict=True):
        e = experiments[b.experiment]
        event = e.event if e.event is not None else event_time(e.inputs)
        rows[b.output] = rows.get(b.output, 0) + b.residual.size
        if b.slope is None:  # one level between two steps is no measure of the others
            rest = quiet_rows(e.time[b.rows], b.misfit + run, event, run, b.profile)
            quiet.setdefault(b.output, []).append(b.residual[rest.rows])
    total = 0.0
    for output, count in rows.items():
        own = np.concatenate(quiet.get(output) or [np.zeros(0)])
        total += count * (float(np.mean(own**2)) if own.size >= FEWEST_QUIET else 1.0)
    return max(total / max(sum(rows.values()), 1), 1.0)


def keeps_tolerance(search: SearchContext, last: Refit) -> bool:
    """Return True where a tolerance is stated and a model keeps it in every signal that has one."""
    largest = largest_rmse(last)
    return bool(search.tolerance) and all(largest.get(o, np.inf) <= band for o, band in search.tolerance.items())


def leaves_a_gap(search: SearchContext, last: Refit) -> bool:
    """Return True where a model leaves more than the tolerance, or where none is stated clearly more than the noise."""
    share, tolerance = search.options.holdout_share, search.tolerance
    beyond_tolerance = largest_rmse(last), dict.fromkeys(tolerance, 0.0)
    if not tolerance and louder_than_noise(last, share):
        return True
    return material_gap(last.unseen, 1.0, share, tolerance, beyond_tolerance)


def _nothing(search: SearchContext, last: Refit, outcome: SearchOutcome, tests: tuple[Binned, ...]) -> Conclusion:
    found = outcome.rounds[-1]
    options = search.options
    if found.form is not None:
        text = f"Something is missing, and nothing of the catalogue can be named: {found.why}."
        return Conclusion("unnameable", text, tests, instead=found.form)
    refused = any(b.p <= options.significance and b.excess > STRONG_SHARE * last.rows for b in tests)
    strong = found.significant and found.screen.scores[0].fall > STRONG_SHARE * last.rows
    if (strong or refused) and leaves_a_gap(search, last):
        why = found.why or "the residuals are not noise"
        return Conclusion(
            "unnameable", f"Something is missing, but nothing of the catalogue can be named: {why}.", tests
        )
    if not any(found.screen.usable(column) for column in found.screen.size):
        still = list(dict.fromkeys(c.effect for c in found.candidates))
        text = "None of the effects looked for is excited by these experiments."
        advice = {"text": ". ".join(f"{e}: {effects()[e].excited_by}" for e in still)}
        return Conclusion("not-excited", text, tests, experiment=advice)
    if found.significant:
        return Conclusion("no-evidence", f"No gap that matters: {found.why}.", tests)
    return Conclusion("no-evidence", f"The data give no sign of a missing effect: {found.why}.", tests)


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


def doubt_of_size(last: Refit, left: Nominal, explained: float) -> Doubt | None:
    """Doubt because the experiments ask for different sizes of an effect in the refit `last`; None where they do not.

    left: its residuals; explained: by how much chi2 fell, beside which a disagreement is nothing.
    """
    for placed in last.placed:
        found, label = constancy(last, left, placed), placed.candidate.label
        if found.p < VARYING_P and found.chi2_fall > TOLERANCE * explained:
            why = f"the experiments ask for different sizes of {label} (p = {found.p:.1g})"
            return Doubt(why, f"The same input in several sizes, in which {label} answers.")
    return None


def doubt_of_known_errors(search: SearchContext, outcome: SearchOutcome) -> Doubt | None:
    """Doubt because errors that stated values and recorded levels are known to have explain as much as an effect that was put in."""
    for found in outcome.kept:
        assert found.winner is not None
        errors = known_errors(search, found.before)
        if errors.in_place_of(found.before, found.winner.refit):
            label = found.candidates[found.winner.pick.candidate].label
            why = f"stated values and recorded levels that are off by no more than they may be explain as much as {label} ({errors})"
            return Doubt(why, f"Stated values known better, or fitted, and larger inputs, in which {label} answers.")
    return None


def doubt_of_remainder(names: Sequence[str], left: str) -> Doubt:
    """Doubt because more than noise is left: the true effect leaves nothing, one in its place does.

    A relay looks like a coupling with a backlash, or like a quantiser. names: the effects that were put in; left: where the
    rest is, as a sentence.
    """
    each = list(dict.fromkeys(names))
    apart = "Each of them by itself. " if len(names) > 1 else ""
    return Doubt(left, apart + ". ".join(f"{n}: {effects()[n].excited_by}" for n in each))


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
