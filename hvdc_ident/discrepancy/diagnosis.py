"""The verb `diagnose`: locate, test, refit, choose, add, show."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np

from hvdc_ident.budget import Budget
from hvdc_ident.codec import plain
from hvdc_ident.data import Experiment
from hvdc_ident.discrepancy.candidate_table import lines
from hvdc_ident.discrepancy.candidates import entries
from hvdc_ident.discrepancy.classes import compared
from hvdc_ident.discrepancy.evidence import all_far_from_noise, louder_than_noise
from hvdc_ident.discrepancy.explain import at_given, beside_stand_ins, found_of, gap, off_given
from hvdc_ident.discrepancy.findings import separating
from hvdc_ident.discrepancy.forms import DescribedForm, best_form, described, disturbance_course, refitted_forms
from hvdc_ident.discrepancy.hypothesis import Refit, judged
from hvdc_ident.discrepancy.location import localise
from hvdc_ident.discrepancy.moves import clock_sentence, clocks, stated
from hvdc_ident.discrepancy.nominal import Nominal, nominal
from hvdc_ident.discrepancy.options import Course, DiagnosisOptions, SearchContext
from hvdc_ident.discrepancy.remainder import share_left
from hvdc_ident.discrepancy.residual_checks import Binned
from hvdc_ident.discrepancy.result import AUGMENTED, Diagnosis, FoundEffect, StandIn
from hvdc_ident.discrepancy.rounds import Round
from hvdc_ident.discrepancy.screen import NOT_TRIED as NOT_BEGUN
from hvdc_ident.discrepancy.search import SearchOutcome, two_start_search
from hvdc_ident.discrepancy.stand_ins import stand_ins
from hvdc_ident.discrepancy.unknown_noise import noise_with, without_names
from hvdc_ident.discrepancy.verdict import (
    Conclusion,
    findings_of,
    headline,
    judge,
    keeps_tolerance,
    leaves_a_gap,
    leaves_more_than_noise,
    noise_floor,
    tests_of,
)
from hvdc_ident.errors import StudyError, unknown_name
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import FitParameter, Simulator
from hvdc_ident.fit.noise import LOUDER, QUIETER, OutputNoise, misfit_sentence, of_misfit
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, is_white_box, recording
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.text import figures, quantity

CLOSED = (
    "The model is closed inside: effects were tried at its inputs and outputs only; its signals, states and loops were "
    "not, and no form outside the catalogue was looked for."
)

UNFINISHED = "The diagnosis was ended by its budget, and says nothing yet of what is missing, or where."
UNTESTED = "The budget ended: neither forms outside the catalogue nor whether anything else is missing was asked."
UNTRIED = (
    "No single effect came near the noise. {} candidates that promise less were not refitted; a thorough search refits more of "
    "them (thorough = true in [diagnose])."
)


def diagnose(
    subject: AnyModel | Simulator,
    experiments: Iterable[Experiment],
    parameters: Iterable[FitParameter],
    *,
    effects: Iterable[str] | Literal["all"] = "all",
    places: Iterable[str | tuple[str, ...]] | None = None,
    tolerance: Mapping[str, float] | None = None,
    held: Mapping[str, float] | None = None,
    report: IdentifiabilityReport | None = None,
    options: DiagnosisOptions | None = None,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Return what the model lacks, as far as the data show: the effect with its place and size, the model with it, and the gap.

    subject: a model; or anything that can be simulated, with effects at its inputs and outputs only.
    experiments: with measured outputs; those of role "holdout" judge, the others are fitted. parameters: what may be
    fitted, with start and bounds, and with the given value, with which the results are compared. effects: names of the catalogue
    to try, "all" beside others for what is tried by default. places: slots to try them at, a tuple for one effect at several
    slots with shared parameters (default:
    every slot, and families of like slots).
    tolerance: by output, an error (in its unit) below which a gap is of no interest. held: values of other parameters.
    report: of these data, whose identifiable set is fitted; without one, the set that
    the sensitivities at the pilot fit can distinguish.

    Raises StudyError or UnknownNameError where there is nothing to diagnose, SimulationError where the nominal model
    cannot be run.
    """
    chosen = options or DiagnosisOptions()
    given, free = tuple(experiments), tuple(parameters)
    model = recording(_model_of(subject), (o for e in given for o in e.outputs))
    names: Any = "all" if effects == "all" else tuple(e.name for e in entries(effects))
    _check_tolerance(tolerance or {}, given)
    search = SearchContext(
        names, None if places is None else tuple(places), FrozenMap(tolerance or {}), chosen, seed, executor,
        None if progress is None else Course(progress),
        Budget.of(chosen.budget) if isinstance(chosen.budget, float | int) else chosen.budget,
    )  # fmt: skip
    search.tell(0, 1, "the nominal model, refitted")
    start, notes = nominal(
        ModelSimulator(model), given, free, held or {}, report, starts=chosen.starts, seed=seed, executor=executor
    )
    first = judged(Refit(model, (), start.problem, start.noise, start.theta))
    held_now = tuple(f for f in free if f.name not in first.problem.names)
    search = replace(search, held=held_now, stated=stated(model, free), records=first.problem.experiments)
    outcome = two_start_search(search, first)
    if search.spent:
        judgement, notes = unfinished(search, first, outcome), (*notes, UNTESTED)
    else:
        judgement = judge(search, first, outcome)
    inside = is_white_box(model)
    other = None
    if judgement.instead is not None:
        other = described(judgement.instead)
    elif judgement.verdict == "unnameable" and chosen.fallback and inside:
        other = _outside(search, outcome.rounds[0])
    best = outcome.refit if other is None or other.refit is None else other.refit
    noise = noise_with(best)
    sure = without_names(search, first, best, noise, judgement)
    if sure is not judgement:
        judgement, other, noise = sure, None, noise_with(first)
    if not inside:
        notes = (*notes, CLOSED)
    if left := 0 if chosen.thorough else _left_out(first, outcome.rounds[0]):
        notes = (*notes, UNTRIED.format(left))
    if left := sum(why == NOT_BEGUN for r in outcome.rounds for why in r.screen.failures.values()):
        notes = (*notes, f"The budget ended before {left} candidates were looked at: their status is {NOT_BEGUN!r}.")
    if left := sum(t.refit.failure == NOT_BEGUN for r in outcome.rounds for t in r.failed):
        notes = (*notes, f"The budget ended before {left} refits of candidates: their status is {NOT_BEGUN!r}.")
    return _assembled(search, model, first, outcome, judgement, other, free, (*notes, *outcome.notes), noise)


def unfinished(search: SearchContext, first: Refit, outcome: SearchOutcome) -> Conclusion:
    """The conclusion of a search that its budget has ended: no effect and no place, for what was not tried may explain more.

    What comes nearest so far is told as that, without its place.
    """
    found = outcome.rounds[-1]
    refitted, every = len({t.pick.candidate for t in found.trials}), len(found.candidates)
    tried = f"Of {every} candidates of round {len(outcome.rounds)} {refitted} were refitted to their ends"
    left = min((math.sqrt(t.refit.chi2 / t.refit.rows) for r in outcome.rounds for t in r.trials), default=math.inf)
    before = math.sqrt(first.chi2 / first.rows)
    best = (
        f"; the best of them leaves {figures(left, 3)} times the noise, the model alone {figures(before, 3)}"
        if left < before
        else ""
    )
    return Conclusion("unfinished", f"{UNFINISHED} {tried}{best}.", tests_of(search, first))


def _outside(search: SearchContext, opened: Round) -> DescribedForm:
    """Return the form outside the catalogue that explains most of the gap, or what is missing over time where none stands."""
    forms = refitted_forms(search, opened) if opened.forms is None else opened.forms
    form = best_form(search, opened, forms)
    return disturbance_course(search, opened) if form is None else described(form)


def _left_out(first: Refit, found: Round) -> int:
    """Return how many candidates of a round were not refitted, where those that were leave more than anybody asks about; else 0."""
    if not found.significant or not all_far_from_noise(first, found.trials):
        return 0
    tried = {t.pick.candidate for t in (*found.trials, *found.failed)}
    return len(set(found.screen.best()) - tried)


def _model_of(subject: AnyModel | Simulator) -> AnyModel:
    """The model behind the subject. Raises StudyError for something that effects cannot be put on."""
    if isinstance(subject, ModelSimulator):
        return subject.model
    if is_white_box(subject) or hasattr(subject, "with_effects"):
        return cast("AnyModel", subject)
    raise StudyError(
        "effects cannot be put on it",
        where="what is to be diagnosed",
        expected="a model, or an FMU: something with insertion points and `with_effects`",
        got=type(subject).__name__,
    )


def _check_tolerance(tolerance: Mapping[str, float], experiments: tuple[Experiment, ...]) -> None:
    measured = list(dict.fromkeys(o for e in experiments for o in e.outputs))
    for output, band in tolerance.items():
        if output not in measured:
            raise unknown_name("measured output", output, measured, where="tolerance")
        if not band > 0:
            raise StudyError(
                "an error band is not above 0", where=f"tolerance of '{output}'", expected="above 0", got=f"{band:g}"
            )


def _assembled(
    search: SearchContext,
    model: AnyModel,
    first: Refit,
    outcome: SearchOutcome,
    judgement: Conclusion,
    other: DescribedForm | None,
    free: tuple[FitParameter, ...],
    notes: tuple[str, ...],
    noise: Mapping[str, OutputNoise],
) -> Diagnosis:
    search.tell(0, 1, "before and after")
    unknown = of_misfit({o: n.source for o, n in noise.items()})
    in_place = judgement.verdict in ("named", "ambiguous")
    tests = judgement.tests
    effects: tuple[FoundEffect, ...] = ()
    last = outcome.refit if judgement.verdict == "no-evidence" and not outcome.refit.placed else first
    done = judgement.verdict != "unfinished"
    if in_place:
        last = outcome.refit
        effects = tuple(found_of(last, p, len(r.trials)) for p, r in zip(last.placed, outcome.kept, strict=True))
    elif other is not None and other.refit is not None:
        last = other.refit
        tests = tests_of(search, last)
    augmented = last.model.with_values(_own(last)) if last.placed else None
    given = at_given(first, {f.name: f.given for f in free})
    sets = tuple(g for g in judgement.sets if len(g) > 1 or judgement.doubt)
    rest = remaining(first, last, tests, search)
    beyond = leaves_more_than_noise(
        judgement, last, adequate=rest["adequate"], significance=search.options.significance
    )
    findings, depend = findings_of(search, outcome, judgement, effects, with_intervals=not beyond) if done else ((), {})
    text = headline(judgement, findings, depend, tolerated=keeps_tolerance(search, last))
    others: tuple[StandIn, ...] = ()
    if judgement.verdict == "no-evidence":
        moved = off_given(last, given, rest["adequate"], leaves_a_gap(search, last), known=not unknown)
        if moved is not None:
            others = () if unknown else stand_ins(search, last, outcome.rounds[0], tuple(moved.parameters))
            moved = beside_stand_ins(moved, others)
            findings, text = (moved,), moved.text if not unknown else f"{text} {moved.text}"
    if off := clocks(search, last):
        text = f"{text} {clock_sentence(off)}"
    if louder := contradiction(model, first.noise, LOUDER):
        text = f"{text} {louder}"
    if unknown:
        text = f"{text} {misfit_sentence(unknown)}"
    notes = (*notes, *filter(None, [contradiction(model, first.noise, QUIETER)]))
    left = judgement.remainder
    return Diagnosis(
        verdict=judgement.verdict,
        text=text if other is None else f"{text} {other.text}",
        effects=effects,
        ambiguity=sets,
        separating_experiment=separating(sets, {o for e in last.problem.experiments for o in e.outputs}) or judgement.experiment,
        candidates=lines(outcome),
        location=localise(first.nominal()),
        gap=gap(given, first, last),
        remaining=rest,
        beyond_noise=beyond,
        parameters_before=FrozenMap({f.name: f.given for f in free}),
        parameters_refitted=FrozenMap({f.name: first.values.get(f.name, f.given) for f in free}),
        parameters_after=FrozenMap({f.name: last.values.get(f.name, f.given) for f in free}),
        augmented=augmented,
        augmented_model=AUGMENTED if is_white_box(augmented) else None,
        fallback=None if other is None else other.to_dict(),
        noise={o: noise_told(n) for o, n in noise.items()},
        notes=notes,
        doubt=judgement.doubt,
        findings=findings,
        remainder={} if left is None else plain(left) | {"below_tolerance": left.below_tolerance},
        hypotheses=compared(first, outcome) if done and not unknown else (),
        values_by_place=FrozenMap(depend),
        stand_ins=others,
    )  # fmt: skip


def noise_told(noise: OutputNoise) -> dict[str, Any]:
    """Return the noise of an output for the results: what was taken, how well it is known, and what was stated."""
    return {
        "std": noise.std, "ar": list(noise.model), "resolution": noise.step, "source": noise.source, "error": noise.std_error,
        "stated": noise.stated, "contradicted": noise.contradicted,
    }  # fmt: skip


def contradiction(model: AnyModel, noise: Mapping[str, OutputNoise], how: str) -> str:
    """Return in a sentence what the records say against the stated noise of some outputs, "louder" or "quieter"; else nothing."""
    each = []
    for o, n in noise.items():
        if n.contradicted == how and n.stated is not None and n.std is not None:
            unit = model.outputs[o].unit if o in model.outputs else ""
            stated, shown = quantity(n.stated, unit, 3), quantity(n.shown, unit, 3)
            each.append(f"{o} (stated {stated}, shown {shown})")
    if not each:
        return ""
    if how == LOUDER:
        return f"The records are noisier than was stated, and the noise they show was used: {', '.join(each)}."
    return f"The records before the event are less noisy than was stated; the stated noise was used: {', '.join(each)}."


def _own(refit: Refit) -> dict[str, float]:
    """The estimated values, inside the model's own bounds to the last digit."""
    known = refit.model.parameters
    return {n: float(np.clip(v, known[n].min, known[n].max)) for n, v in refit.values.items() if n in known}


def remaining(first: Refit, last: Refit, tests: tuple[Binned, ...], search: SearchContext) -> dict[str, Any]:
    """Return the remaining residual: a test against noise, the explained share, and where it lies."""
    rest: Nominal = last.nominal()
    left = share_left(first, last, noise_floor(last, rest, tests, search.options.significance))
    place = localise(rest)
    worst = min(tests, key=lambda b: b.p, default=None)
    return {
        "adequate": worst is None or worst.p > 0.05 / max(len(tests), 1),
        "explained_share": None if left is None else 1.0 - left,
        "band_hz": place["band_hz"],
        "block": next(iter(place["outputs"]), None),
        "material": louder_than_noise(last, search.options.holdout_share),
        "tests": [{"bins": b.name, "statistic": b.statistic, "expected": b.expected, "p": b.p} for b in tests],
    }
