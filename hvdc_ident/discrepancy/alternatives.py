"""Alternatives to a named effect outside the catalogue: powers, magnitudes and products of signals at its slot, a notch,
a resonance.

A saturation bends by the third order, a coupling is a product at its operating point: whoever has only the catalogue's
name for it takes a form for told that the data do not tell.
"""

from __future__ import annotations

from collections.abc import Mapping

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import additive, proportional, source_signals
from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit, alike
from hvdc_ident.discrepancy.formula import Term, at_run, at_runs, formula_job, terms
from hvdc_ident.discrepancy.movable import added, in_proportion
from hvdc_ident.discrepancy.outside.filtered import filters
from hvdc_ident.discrepancy.outside.law import regression
from hvdc_ident.discrepancy.pushes import Pushed
from hvdc_ident.discrepancy.race import done
from hvdc_ident.discrepancy.refit import RefitJob
from hvdc_ident.discrepancy.rounds import gained
from hvdc_ident.effects import effects
from hvdc_ident.errors import ModelError
from hvdc_ident.model import Model


def beyond(search: SearchContext, found: Round) -> tuple[tuple[CandidateFit, float], ...]:
    """The refits of forms outside the catalogue in the winner's stead, each with its prior; none that failed.

    Of what bends a signal or brings one in, without memory, at one slot inside a model: formulas there, each with the
    winner's pick. No formula of signals at one time is a delay: for one kind of these or another filters, wherever they are.
    A form is as likely before any data as an effect of the catalogue, and shares that with all places and sources, as one does.
    One that does the same as a winner that is linear is no other hypothesis, its prior 0: where signals move so little, a
    formula is its own tangent.
    """
    winner = found.winner
    assert winner is not None and found.ruler is not None
    placed = winner.refit.placed[-1]
    effect = effects()[placed.candidate.effect]
    if effect.equivalent_delay is not None and not effect.needs_grid:
        tried = filters(search, found) if found.filters is None else found.filters
        places = {c.at for c in found.candidates if c.effect == effect.name}
        return tuple((gained(t, found.before, found.ruler), 1.0 / len(places)) for t in tried)
    # Of what is brought in the start value alone is kept: that is no memory of where the signal has been.
    remembers = effect.states != "none" and not effect.needs_source
    if remembers or effect.needs_grid or additive(effect):
        return ()
    if not isinstance(found.before.model, Model) or len(placed.candidate.at) > 1:
        return ()
    place, source, paths = placed.candidate.at, placed.candidate.source, found.answers()
    jobs, shares = _jobs(found, paths, place[0], source)
    elsewhere = sum(c.effect == effect.name and len(c.at) == 1 for c in found.candidates)
    texts = [f"outside the catalogue: {job.placed[-1].use.expression} at {place[0]}" for job in jobs]
    linear = in_proportion(found.candidates[winner.pick.candidate], winner.pick.probe)
    weighed = []
    for refit, share in zip(done(search, jobs, texts), shares, strict=True):
        if refit.failure:
            continue
        same = linear and alike(winner.refit, refit, found.before)
        trial = gained(CandidateFit(winner.pick, refit, 0.0), found.before, found.ruler)
        weighed.append((trial, 0.0 if same else share / elsewhere))
    return tuple(weighed)


def _jobs(found: Round, paths: Mapping[str, Pushed], place: str, source: str) -> tuple[list[RefitJob], list[float]]:
    """Return for each form the refit of the formula that by regression leaves least, and its share of the form.

    Of formulas that are the same signal in these records the first is tried: of a signal above 0 the magnitude is itself.
    """
    library, formulas = _formulas(found, paths, place, source)
    regressed = regression(found.before.nominal(), paths, place, [at_run(t) for t in library])
    of_form: dict[tuple[str, ...], list[tuple[float, tuple[int, ...], Array]]] = {}
    for formula in formulas:
        coefficients, gain = regressed.solved(formula)
        if coefficients.all():
            of_form.setdefault(tuple(library[k].form for k in formula), []).append((gain, formula, coefficients))
    jobs, shares = [], []
    shapes: list[tuple[int, list[Array]]] = []
    for members in of_form.values():
        _, formula, coefficients = max(members, key=lambda m: m[0])
        shape = at_runs(library[formula[0]], paths)
        if any(n == len(formula) and proportional(shape, other) for n, other in shapes):
            continue
        try:
            jobs.append(formula_job(found.before, place, [library[k] for k in formula], coefficients))
        except ModelError:  # a formula that would close a loop through itself is none of this model
            continue
        shapes.append((len(formula), shape))
        shares.append(1.0 / len(members))
    return jobs, shares


def _formulas(
    found: Round, paths: Mapping[str, Pushed], place: str, source: str
) -> tuple[tuple[Term, ...], list[tuple[int, ...]]]:
    """A library, the slot's own signal first in it, and formulas as places in that: powers, magnitudes and products of the
    signal with what is brought in, or with any; each also beside a gain. None that an effect of the catalogue is."""
    own = place.removeprefix("outputs.")
    others = (source,) if source else source_signals(found.before.model, found.signals)
    library = terms([own, *(s for s in others if s != own)])
    within = [t.form != "x" and (own in t.signals or source in t.signals) for t in library]
    stated = _stated(found, paths, place) if any(within) else []

    def is_stated(term: Term) -> bool:
        own_runs = at_runs(term, paths)
        return any(proportional(own_runs, one) for one in stated)

    near = [k for k, t in enumerate(library) if within[k] and not is_stated(t)]
    return library, [*((k,) for k in near), *((k, 0) for k in near)]


def _stated(found: Round, paths: Mapping[str, Pushed], place: str) -> list[list[Array]]:
    """By run what each effect of the catalogue that is one number times a function of signals adds at the place.

    A formula in proportion to one of them is that effect: a square of a signal is the loss by it.
    """
    shapes = []
    for c in found.candidates:
        if c.at != (place,):
            continue
        for k, probe in enumerate(c.probes):
            if len(probe.free) == 1 and in_proportion(c, k):
                brought = [path.signal(c.source) if c.source else None for path in paths.values()]
                own = [path.signal(place) for path in paths.values()]
                shapes.append([added(c, probe, u, s) for u, s in zip(own, brought, strict=True)])
    return shapes
