"""Parameters as hypotheses: those that are held are set free where the records, under a hypothesis, speak against their values.

The report of a model that lacks something holds parameters for the misfit that is being diagnosed, and what a study states of
the others is known to a few per cent at best. What such a parameter is off would be told as an effect, so "these parameters are
off their values" is compared with the effects, and asked again beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.clocks import as_recorded, on_their_clocks
from hvdc_ident.discrepancy.context import SearchContext
from hvdc_ident.discrepancy.evidence import Ruler, evidence_between
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.refit_jobs import refit_again
from hvdc_ident.discrepancy.refitted import is_noise
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, Model

KNOWN = 0.02
"""Share by which the stated value of a parameter that is no candidate may be off: data sheets and tests are no better."""
SEEN = 1e-6
"""Share of its squared derivative that the others must not make good, for a parameter to be told at all."""
STEP = 1e-3
"""Share of a value, or of its range where that is 0, by which it is moved for a derivative."""


def stated(model: AnyModel, candidates: Sequence[FitParameter]) -> tuple[FitParameter, ...]:
    """Return the parameters of a model that are no candidates, with bounds as near as they are known.

    None of a model that is closed inside: each derivative would be a run.
    """
    if not isinstance(model, Model):
        return ()
    others = {n: p.value for n, p in model.parameters.items() if p.value and n not in {f.name for f in candidates}}
    return tuple(FitParameter(n, v, v - KNOWN * abs(v), v + KNOWN * abs(v)) for n, v in others.items())


def released(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return the nominal model and the hypothesis `here`, with those held parameters free, and the clocks of the records as far
    off, as bring more evidence than they cost.

    base: the nominal model that `here` adds effects to, at its values. One is set free at a time, the one that gains most, and has
    to gain as much in BIC as an effect needs to be named, until noise is left; one that ends on its bound stays held. here: a
    hypothesis that leaves more than noise.
    """
    refused: set[str] = set()
    while not search.spent:
        held = [f for f in (*search.held, *search.stated) if f.name not in (*here.problem.names, *refused)]
        best = _most_wanted(search, here, held)
        if best is None:
            break
        search.tell(0, 1, f"with {best.name} free")
        wider = _with_free(base, best)
        freed = refit_again(wider, here, here.placed)
        if freed.failure or not evidence_between(here, freed, Ruler.of(freed), 1) > search.options.named_bic:
            break
        # What asks for more than a value may be off is something else; free, the value would hide it from every score.
        if best.on_bound(freed.values[best.name]):
            refused.add(best.name)
            continue
        base, here = wider, freed
        if is_noise(here, search.seed):
            return base, here
    clocked = on_their_clocks(search, base, here)
    return clocked if clocked[1] is here else _parameters_held_again(search, *clocked)


def held_again(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return the nominal model and the hypothesis `here`, with those parameters held, and the records on their clocks, again that
    bring no evidence any more.

    A parameter that was set free may have stood for an effect that has been added since. base: the nominal model that `here` adds
    effects to.
    """
    return as_recorded(search, *_parameters_held_again(search, base, here))


def _parameters_held_again(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return both with those parameters held again that bring no evidence any more."""
    for f in (*search.held, *search.stated):
        if f.name not in here.problem.names or search.spent:
            continue
        fewer = _with_held(base, f)
        without = refit_again(fewer, here, here.placed)
        if not without.failure and evidence_between(without, here, Ruler.of(here), 1) <= search.options.named_bic:
            base, here = fewer, without
    return base, here


def _with_held(refit: Refit, parameter: FitParameter) -> Refit:
    """Return the nominal model with one parameter less among the free ones, at its given value."""
    at = refit.problem.names.index(parameter.name)
    free = tuple(f for f in refit.problem.free if f.name != parameter.name)
    held = FrozenMap({**refit.problem.held, parameter.name: parameter.given})
    return replace(refit, problem=replace(refit.problem, free=free, held=held), theta=np.delete(refit.theta, at))


def _with_free(refit: Refit, parameter: FitParameter) -> Refit:
    """Return the nominal model with one parameter more among the free ones, at the value that it was held at."""
    count, value = len(refit.problem.free), _value(refit, parameter)
    held = {n: v for n, v in refit.problem.held.items() if n != parameter.name}
    free = replace(parameter, start=float(np.clip(value, parameter.min, parameter.max)))
    problem = replace(refit.problem, free=(*refit.problem.free, free), held=FrozenMap(held))
    return replace(refit, problem=problem, theta=np.insert(refit.theta, count, free.start))


def _value(refit: Refit, parameter: FitParameter) -> float:
    return refit.problem.held.get(parameter.name, parameter.given)


def _most_wanted(search: SearchContext, here: Refit, held: Sequence[FitParameter]) -> FitParameter | None:
    """Return the held parameter with which chi2 falls most, to first order; None where it falls with none."""
    if not held:
        return None
    nominal = here.nominal()
    whole = np.column_stack([_derivative(here, f, nominal.residual) for f in held])
    columns = nominal.projected(whole)
    power = np.sum(columns**2, axis=0)
    told = power > SEEN * np.sum(whole**2, axis=0)
    falls = np.where(told, (columns.T @ nominal.residual) ** 2 / np.where(told, power, 1.0), 0.0)
    k = int(np.argmax(falls))
    # In chi2 of the noise: of a misfit its own size is no measure of what may be left.
    return held[k] if falls[k] > search.options.named_bic else None


def _derivative(here: Refit, parameter: FitParameter, residual: Array) -> Array:
    """Return (N,) the change of the whitened residual with a held parameter, by differences; 0 where it does not run.

    residual: (N,) with the parameter as it is held.
    """
    value = _value(here, parameter)
    extent = parameter.max - parameter.min
    step = STEP * (abs(value) or (extent if np.isfinite(extent) else 1.0))
    held = FrozenMap({**here.problem.held, parameter.name: value + step})
    try:
        moved = replace(here.problem, held=held).blocks(here.theta)
    except SimulationError:
        return np.zeros_like(residual)
    return (np.concatenate([b.residual for b in moved]) - residual) / step
