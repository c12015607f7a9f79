"""The verb `diagnose`: locate, test, refit, choose, add, show."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np

from hvdc_ident.codec import plain
from hvdc_ident.data import Experiment
from hvdc_ident.discrepancy.candidates import CandidateEffect, entries
from hvdc_ident.discrepancy.conclusion import (
    Conclusion,
    findings_of,
    headline,
    judge,
    leaves_more_than_noise,
    tests_of,
)
from hvdc_ident.discrepancy.description import described
from hvdc_ident.discrepancy.expansion import LEFT_BEHIND, Expansion, Trial
from hvdc_ident.discrepancy.hypothesis import Refit, judged
from hvdc_ident.discrepancy.location import localise
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.moves import MOVES
from hvdc_ident.discrepancy.moves.clocks import clock_sentence, clocks
from hvdc_ident.discrepancy.nominal import Nominal, nominal
from hvdc_ident.discrepancy.options import Course, DiagnosisOptions, SearchContext
from hvdc_ident.discrepancy.remainder import disturbance_course, share_left
from hvdc_ident.discrepancy.residual_checks import Binned
from hvdc_ident.discrepancy.result import AUGMENTED, DescribedForm, Diagnosis, FoundEffect, Line, StandIn
from hvdc_ident.discrepancy.rivals import compared
from hvdc_ident.discrepancy.score import Ruler
from hvdc_ident.discrepancy.screen import NOT_TRIED as NOT_BEGUN
from hvdc_ident.discrepancy.screen import Score
from hvdc_ident.discrepancy.search import Search, SearchOutcome
from hvdc_ident.discrepancy.sentences import at_given, beside_stand_ins, found_of, gap, off_given, separating, stand_ins
from hvdc_ident.discrepancy.stated import stated
from hvdc_ident.discrepancy.unknown_noise import noise_with, without_names
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
UNTESTED = (
    "The budget ended before everything was tried that could come near: something else may explain the records as well."
)
SLIGHT = "What remains is explained by stated values and recorded levels that are off by no more than they may be ({})."
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
        chosen.budget_from_now(executor),
    )  # fmt: skip
    search.tell(0, 1, "the nominal model, refitted")
    start, notes = nominal(
        ModelSimulator(model), given, free, held or {}, report, starts=chosen.starts, seed=seed, executor=executor
    )
    first = judged(Refit(model, (), start.problem, start.noise, start.theta))
    held_now = tuple(f for f in free if f.name not in first.problem.names)
    search = replace(
        search,
        held=held_now,
        stated=stated(model, free),
        records=first.problem.experiments,
        components=components_of(model),
    )
    outcome = Search(search, first, MOVES).run()
    if not outcome.exhausted:
        notes = (*notes, UNTESTED)
    if not outcome.exhausted and not outcome.named:
        judgement = unfinished(search, first, outcome)
    else:
        judgement = judge(search, first, outcome)
    inside = is_white_box(model)
    other = None
    if judgement.instead:
        other = described(first, judgement.instead[0], judgement.instead[1:])
    elif judgement.verdict == "unnameable" and chosen.fallback and inside and outcome.opened is not None:
        other = _outside(search, first, outcome)
    best = outcome.refit if other is None or other.refit is None else other.refit
    noise = noise_with(best)
    sure = without_names(search, first, best, noise, judgement)
    if sure is not judgement:
        judgement, other, noise = sure, None, noise_with(first)
    if not inside:
        notes = (*notes, CLOSED)
    if left := 0 if chosen.thorough else _left_out(search, first, outcome):
        notes = (*notes, UNTRIED.format(left))
    if left := sum(why == NOT_BEGUN for r in outcome.expansions.values() for why in r.screen.failures.values()):
        notes = (*notes, f"The budget ended before {left} candidates were looked at: their status is {NOT_BEGUN!r}.")
    if left := sum(t.refit.failure == NOT_BEGUN for r in outcome.expansions.values() for t in r.trials):
        notes = (*notes, f"The budget ended before {left} refits of candidates: their status is {NOT_BEGUN!r}.")
    return _assembled(search, model, first, outcome, judgement, other, free, (*notes, *outcome.notes), noise)


def unfinished(search: SearchContext, first: Refit, outcome: SearchOutcome) -> Conclusion:
    """The conclusion of a search that its budget has ended: no effect and no place, for what was not tried may explain more.

    What comes nearest so far is told as that, without its place.
    """
    every = sum(len(r.candidates) for r in outcome.expansions.values())
    refitted = sum(not t.refit.failure for r in outcome.expansions.values() for t in r.trials)
    tried = f"Of {every} candidates {refitted} were refitted to their ends"
    left = min((math.sqrt(h.refit.chi2 / h.refit.rows) for h, _ in outcome.pool if h.terms), default=math.inf)
    before = math.sqrt(first.chi2 / first.rows)
    best = (
        f"; the best of them leaves {figures(left, 3)} times the noise, the model alone {figures(before, 3)}"
        if left < before
        else ""
    )
    return Conclusion("unfinished", f"{UNFINISHED} {tried}{best}.", tests_of(search, first))


def _outside(search: SearchContext, first: Refit, outcome: SearchOutcome) -> DescribedForm:
    """Return the form outside the catalogue that explains most of the gap, or what is missing over time where none stands."""
    assert outcome.opened is not None
    return described(first, outcome.forms[0].refit) if outcome.forms else disturbance_course(search, outcome.opened)


def _left_out(search: SearchContext, first: Refit, outcome: SearchOutcome) -> int:
    """Return how many candidates of the first expansion were not refitted, where those that were leave more than anybody asks about."""
    found = outcome.opened
    if found is None or search.spent:
        return 0
    before = misfit_of(first)
    if not all(misfit_of(h.refit).refutes(before) for h, _ in outcome.pool):
        return 0
    tried = {t.score.candidate for t in found.trials}
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


def components_of(model: AnyModel) -> FrozenMap[str]:
    """Return the components that a model is built of, by name, with their cards; none of a model that is closed inside."""
    if not is_white_box(model):
        return FrozenMap()
    return FrozenMap((model.origin.root if model.origin else model).components)


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
    last = outcome.refit if judgement.verdict == "no-evidence" and not outcome.named else first
    done = judgement.verdict != "unfinished"
    if in_place:
        last = outcome.refit
        effects = tuple(
            found_of(last, p, len(outcome.in_stead_of(t)))
            for p, t in zip(last.placed, outcome.best.effects, strict=True)
        )
    elif other is not None and other.refit is not None:
        last = other.refit
        tests = tests_of(search, last)
    freed = tuple(f for f in (*search.held, *search.stated) if f.name in outcome.best.values) if in_place else ()
    free = (*free, *(f for f in freed if f.name not in {c.name for c in free}))
    augmented = last.model.with_values(_own(last)) if last.placed or freed else None
    given = at_given(first, {f.name: f.given for f in free})
    sets = tuple(g for g in judgement.sets if len(g) > 1 or judgement.doubt)
    rest = remaining(first, last, tests, search)
    beyond = leaves_more_than_noise(
        judgement, last, adequate=rest["adequate"], significance=search.options.significance
    )
    findings, depend = findings_of(search, outcome, judgement, effects, with_intervals=not beyond) if done else ((), {})
    text = headline(judgement, findings, depend, tolerated=misfit_of(last).keeps(search.tolerance))
    others: tuple[StandIn, ...] = ()
    if judgement.verdict == "no-evidence":
        moved = off_given(
            last,
            given,
            rest["adequate"],
            misfit_of(last).is_material(search.tolerance, search.options) and not outcome.explained_by_errors,
            known=not unknown,
        )
        if moved is not None:
            others = () if unknown else stand_ins(outcome, search.options)
            moved = beside_stand_ins(moved, others)
            findings, text = (moved,), moved.text if not unknown else f"{text} {moved.text}"
        if outcome.explained_by_errors and moved is not None:
            text = f"{text} {SLIGHT.format(outcome.slight)}"
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
        hypotheses=compared(outcome) if done and not unknown else (),
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
    left = share_left(first, last, misfit_of(last).floor)
    place = localise(rest)
    worst = min(tests, key=lambda b: b.p, default=None)
    return {
        "adequate": worst is None or worst.p > 0.05 / max(len(tests), 1),
        "explained_share": None if left is None else 1.0 - left,
        "band_hz": place["band_hz"],
        "block": next(iter(place["outputs"]), None),
        "material": misfit_of(last).is_louder_than(search.options.holdout_share),
        "tests": [{"bins": b.name, "statistic": b.statistic, "expected": b.expected, "p": b.p} for b in tests],
    }


def lines(outcome: SearchOutcome) -> tuple[Line, ...]:
    """Every candidate of every round, those of the first round first, each round by what was found of them."""
    found: list[Line] = []
    for number, r in enumerate(outcome.expansions.values(), start=1):
        refits = {t.score.candidate: t for t in r.trials}
        best, absorbed = r.screen.best(), set(r.screen.absorbed())
        sound = [t.refit for t in r.trials if not t.refit.failure]
        ruler = Ruler.of(min(sound, key=lambda refit: refit.chi2, default=r.before))
        # Of later rounds what was not refitted says nothing that the first has not said.
        listed = [(k, c) for k, c in enumerate(r.candidates) if number == 1 or k in refits]
        own = [
            _line(r, k, c, best.get(k), refits.get(k), number, absorbed=k in absorbed, ruler=ruler) for k, c in listed
        ]
        found += sorted(own, key=lambda x: (-(x.delta_bic if x.delta_bic is not None else -np.inf), -x.score))
    return tuple(found)


def _line(
    r: Expansion,
    k: int,
    c: CandidateEffect,
    score: Score | None,
    trial: Trial | None,
    number: int,
    *,
    absorbed: bool,
    ruler: Ruler,
) -> Line:
    status = f"failed: {r.screen.failures[k]}" if k in r.screen.failures else "not-excited"
    fall, values, delta, hold = 0.0, FrozenMap[float](), None, None
    if score is not None:
        fall, values = max(score.fall, 0.0), c.probes[score.probe].values
        excited = any(r.screen.usable(column) for column in r.screen.size if column[0] == k)
        status = "absorbed" if absorbed else "screened" if excited else "not-excited"
    if trial is not None and trial.refit.failure != LEFT_BEHIND:
        status = f"failed: {trial.refit.failure}" if trial.refit.failure else "refitted"
        if not trial.refit.failure:
            delta, hold = ruler.between(r.before, trial.refit), trial.refit.unseen
            values = FrozenMap(trial.refit.sizes(trial.refit.placed[-1]))
    return Line(c.effect, c.at, fall, r.screen.p(fall), status, values, delta, hold, c.source, number)
