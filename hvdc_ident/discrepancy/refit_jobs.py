"""Refits to be done: a model, and the effects that picked candidates would add to it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.evidence import Pick
from hvdc_ident.discrepancy.placed import PATIENCE, Placed, added, begins_anywhere, moved
from hvdc_ident.discrepancy.refit import FAILURES, Refit, RefitJob, run
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import is_linear, kind_of
from hvdc_ident.effects import apply_effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.simulate import ModelSimulator

BIASED = 0.4
"""Share of its given value by which a gain has moved when it may have taken an effect's place."""


def job(
    before: Refit, found: Sequence[CandidateEffect], picks: Sequence[Pick], made: dict[Hashable, AnyModel] | None = None
) -> RefitJob:
    """The refit of a model with some more effects, from where their scores put them.

    Gains that have taken an effect's place hold the refit where they are: where one has moved far, or stands on a bound,
    another start is with the gains as they were given. A single effect, too, begins a second time where the score asks for a
    size far from the one probed, and is not right at every size; where a model does not run at its size, it begins at the
    next of those probed. made: models with the first of the picks, which may be used again, and are added to.
    Raises ModelError where an effect cannot sit there.
    """
    model, problem, placed, sizes = before.model, before.problem, list(before.placed), []
    for n, p in enumerate(picks):
        model, problem, one, start = added(
            model, problem, found[p.candidate], p.probe, p.factor, made if n == 0 else None
        )
        placed.append(one)
        sizes.append(start)
    asked = np.concatenate(sizes)
    begins = [_begin(before, np.array(p.gains), asked) for p in picks[:1] if p.gains]
    begins.append(_begin(before, before.theta, asked))
    only = found[picks[0].candidate]
    exact = is_linear(kind_of(only, picks[0].probe))
    if len(picks) == 1 and not exact and not 0.5 <= abs(picks[0].factor) <= 2.0:
        at = moved(only, picks[0].probe, float(np.sign(picks[0].factor)) or 1.0)
        begins.append(_begin(before, before.theta, np.array([at[n] for n in placed[-1].bounds])))
    if (given := as_given(before)) is not None:
        begins.append(_begin(before, given, asked))
    spare = [] if exact or len(picks) > 1 else [_begin(before, before.theta, s) for s in _sizes(only, placed[-1])]
    swept = placed[-1].names[next(iter(placed[-1].bounds))] if picks[0].swept else ""
    return RefitJob(model, tuple(placed), problem, tuple(begins), before.noise, spare=tuple(spare), swept=swept)


def _sizes(candidate: CandidateEffect, placed: Placed) -> list[Array]:
    """Of a candidate's probes that have the same parameters free, and lie within their bounds, the values of these."""
    bounds = placed.bounds
    alike = [p.values for p in candidate.probes if set(p.free) == set(bounds)]
    return [np.array([v[n] for n in bounds]) for v in alike if all(b[0] < v[n] < b[1] for n, b in bounds.items())]


def _begin(before: Refit, theta: Array, sizes: Array) -> Array:
    k = len(before.problem.free)
    return np.concatenate([theta[:k], sizes, theta[k:]])


def as_given(refit: Refit) -> Array | None:
    """The unknowns with the gains at their given values, as near as the bounds let; None where none of them has moved far."""
    theta, far = refit.theta_at_given, False
    for k in refit.gains:
        f, value = refit.problem.free[k], refit.theta[k]
        far = far or abs(value - f.given) > BIASED * abs(f.given) or f.on_bound(value)
        theta[k] = min(max(f.given, f.min), f.max)
    return theta if far else None


def refit_again(first: Refit, here: Refit, placed: Sequence[Placed]) -> Refit:
    """The nominal model `first` with these effects, refitted from where they stand in the hypothesis `here`; a failure is told."""
    try:
        return run(job_of(first, here, placed, {}))
    except FAILURES as error:
        return replace(here, failure=str(error))


def job_of(first: Refit, here: Refit, placed: Sequence[Placed], sizes: dict[int, dict[str, float]]) -> RefitJob:
    """The refit of the nominal model with these effects; sizes: of some, by their place, instead of where they stand."""
    model, free, again = first.model, list(first.problem.free), []
    at = here.values
    for k, p in enumerate(placed):
        own = sizes.get(k) or {n: at.get(name, p.start[n]) for n, name in p.names.items()}
        values = {n: float(np.clip(own.get(n, v), *p.bounds[n])) if n in p.bounds else v for n, v in p.start.items()}
        named = {n: v for n, v in p.use.parameters.items() if isinstance(v, str)}
        parameters: dict[str, float | str] = {**values, **named}
        use = replace(p.use, parameters=FrozenMap(parameters), prefix="").within(model)
        before = set(model.parameters)
        model = apply_effects(model, [use])
        new = [n for n in model.parameters if n not in before]
        names = dict(zip(p.names, new, strict=True))
        free += [FitParameter(names[n], values[n], *p.bounds[n]) for n in p.bounds]
        moved = replace(p.candidate, at=use.at, source=use.source)
        again.append(replace(p, candidate=moved, use=use, names=FrozenMap(names), start=FrozenMap(values)))
    problem = replace(
        here.problem,
        simulator=ModelSimulator(model, PATIENCE),
        free=tuple(free),
        held=first.problem.held,
        free_initial_states=begins_anywhere(model, first.model, [p.use for p in placed]),
    )
    nuisance = here.theta[len(here.problem.free) :]
    gains = [at.get(f.name, f.start) for f in first.problem.free]
    begin = np.concatenate([gains, [f.start for f in free[len(gains) :]], nuisance])
    return RefitJob(model, tuple(again), problem, (begin,), here.noise)
