"""Refits to be done: a model, and the effects that candidates would add to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.movable import Movable
from hvdc_ident.discrepancy.placed import PATIENCE, Placed, added, begins_anywhere, moved, reaching
from hvdc_ident.discrepancy.refit import FAILURES, Refit, RefitJob, run
from hvdc_ident.effects import Probe, apply_effects, effects
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator


def job(
    before: Refit,
    candidate: CandidateEffect,
    probe: int,
    factor: float,
    theta: Array,
    movable: Movable | None = None,
) -> RefitJob:
    """Return the refit of a model with one more effect, at a probe times a factor, begun beside the unknowns `theta`.

    movable: the model with an effect of this form that can be moved, where there is one; else the effect is put in.
    Raises ModelError where the effect cannot sit there.
    """
    k = len(before.problem.free)
    if movable is None:
        model, problem, placed, sizes = added(before.model, before.problem, candidate, probe, factor)
    else:
        candidate = reaching(candidate, probe, factor)
        values, chosen = moved(candidate, probe, factor), candidate.probes[probe]
        model = movable.model
        known = before.values
        named = {n: known.get(p, model.parameters[p].value) for n, p in candidate.named.items()}
        names = {n: name for n, name in movable.names.items() if n not in candidate.named}
        bounds = {n: b for n, b in chosen.free.items() if n in names}
        free = tuple(FitParameter(names[n], values[n], low, high) for n, (low, high) in bounds.items())
        weights = movable.placed(candidate) | movable.sized({**values, **named})
        held = {n: v for n, v in weights.items() if n not in {f.name for f in free}}
        use = candidate.use(replace(chosen, values=FrozenMap(values)))
        entry = effects()[candidate.effect]
        anywhere = before.problem.free_initial_states or entry.self_exciting
        if entry.holds and not anywhere:
            anywhere = begins_anywhere(apply_effects(before.model, [use]), before.model, [use])
        problem = replace(
            before.problem,
            simulator=movable.simulator(PATIENCE),
            free=(*before.problem.free, *free),
            held=before.problem.held | held,
            free_initial_states=anywhere,
        )
        placed = Placed(candidate, use, FrozenMap(names), FrozenMap(bounds), FrozenMap(values), movable=True)
        sizes = np.array([f.start for f in free])
    begin = np.concatenate([theta[:k], sizes, theta[k:]])
    return RefitJob(model, (*before.placed, placed), problem, (begin,), before.noise)


BIASED = 0.4
"""Share of its given value by which a gain has moved when it may have taken an effect's place."""


def moved_far(refit: Refit) -> bool:
    """Return True where a gain has moved so far, or stands on a bound, that it may have taken an effect's place."""
    gains = ((refit.problem.free[k], float(refit.theta[k])) for k in refit.gains)
    return any(abs(value - f.given) > BIASED * abs(f.given) or f.on_bound(value) for f, value in gains)


def as_given(refit: Refit) -> Array | None:
    """The unknowns with the gains at their given values, as near as the bounds let; None where they are there already."""
    theta = refit.theta_at_given
    for k in refit.gains:
        f = refit.problem.free[k]
        theta[k] = min(max(theta[k], f.min), f.max)
    return None if np.array_equal(theta, refit.theta) else theta


def in_place(before: Refit, trial: Refit) -> Refit:
    """Return a refit with its last effect put into the model `before` for good, refitted from there; a failure is told."""
    placed = trial.placed[-1]
    if not placed.movable:
        return trial
    sizes = FrozenMap(trial.sizes(placed))
    probe = Probe(placed.candidate.effect, sizes, placed.bounds)
    try:
        only = replace(placed.candidate, probes=(probe,))
        found = run(replace(job(before, only, 0, 1.0, before.theta), begins=(trial.theta,)))
    except FAILURES as error:
        return replace(trial, failure=str(error))
    candidate = replace(found.placed[-1].candidate, probes=placed.candidate.probes)
    return replace(found, placed=(*found.placed[:-1], replace(found.placed[-1], candidate=candidate)))


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
