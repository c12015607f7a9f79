"""Cards as terms: another component in the place of one, or one more, where the model is built of components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.expansion import Race
from hvdc_ident.discrepancy.hypothesis import FAILURES, Refit, RefitJob, with_given_gains
from hvdc_ident.discrepancy.moves.values import left_with, promising
from hvdc_ident.discrepancy.result import CARD
from hvdc_ident.discrepancy.score import P_CARD
from hvdc_ident.discrepancy.search import BEAM, Hypothesis, Move, Search, Term
from hvdc_ident.discrepancy.stated import stated, with_free
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.problem import stacked
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import is_white_box, recording
from hvdc_ident.plants.exchange import CardChange, exchanges
from hvdc_ident.simulate import ModelSimulator

CARD_RACE = Race((3, 8, 12), least=6)
"""Race of cards: with six values free beside the others a refit comes near its end in so many evaluations as its laps have."""


def exchanged(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """The units with another card in the place of one, or with one more, where the model is a unit and nothing explains the records."""
    context, first = search.context, h.refit
    if not is_white_box(first.model) or search.is_noise(search.ranked()[0]):
        return []
    places = [n for n in context.components if context.may_exchange(n)]
    changes = [c for c in exchanges(first.model) if (c.component in places if c.stated else places)]
    bases = [_with_card(first, c) for c in changes]
    jobs = [RefitJob(b.model, (), b.problem, _begins(b, c), b.noise) for b, c in zip(bases, changes, strict=True)]
    refits = CARD_RACE.run(context, first, jobs, [f"with {c.card.upper()} as {c.component}" for c in changes])
    prior = P_CARD / max(len(changes), 1)
    return [
        Hypothesis(r, replace(b, theta=r.theta), (Term(CARD, (c.component,), c.card.upper(), prior),))
        for c, b, r in zip(changes, bases, refits, strict=True)
        if not r.failure and r.rows
    ]


def with_typical_values(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """The units with another card that promise most with one of its typical values free, with as many free as the records ask for."""
    cards = [c for c in search.pool.values() if c.kind == CARD and len(c.terms) == 1]
    found: list[Hypothesis] = []
    for card in sorted(cards, key=_promise)[:BEAM]:
        if search.context.spent or any(map(search.is_noise, found)):
            break
        found.append(_all_of_it(search, card))
    return found


def _own_values(h: Hypothesis) -> list[FitParameter]:
    """Return the values of another card that are not free yet: nobody has stated them."""
    (component,) = h.terms[0].at
    return [f for f in stated(h.base.model, h.base.problem.free) if f.name.startswith(f"{component}.")]


def _points(refit: Refit) -> list[Refit]:
    """Return a refit of another card as it stands, and at the given values: values that make up for what is missing hide it."""
    given = with_given_gains(refit)
    return [refit] if given is None else [refit, replace(refit, theta=given)]


def _promise(h: Hypothesis) -> float:
    """Return chi2 of another card with the value free that promises most."""
    own = _own_values(h)
    return min([h.refit.chi2, *(float(x) for point in _points(h.refit) for x in left_with(point, own)[0])])


def _all_of_it(search: Search, h: Hypothesis) -> Hypothesis:
    """Return a hypothesis of another card with as many of its typical values set free as the records ask for, one after the other."""
    while not (search.context.spent or search.is_noise(h)):
        own = _own_values(h)
        free = [(point, f) for point in _points(h.refit) for f in promising(point, own, [0.0] * len(own))]
        wider = [with_free(replace(h.base, theta=point.theta), f) for point, f in free]
        jobs = [RefitJob(w.model, (), w.problem, (w.theta,), w.noise) for w in wider]
        if not jobs:
            break
        refits = Race().run(search.context, h.refit, jobs, [f"{h.label} with {f.name} free" for _, f in free])
        found = [
            Hypothesis(r, replace(w, theta=r.theta), h.terms)
            for w, r in zip(wider, refits, strict=True)
            if not r.failure and r.rows
        ]
        ruler = search.ruler
        best = min([h, *found], key=lambda x: search.cost(x, ruler, rough=True))
        if best is h:
            break
        h = best
    return h


def _begins(base: Refit, change: CardChange) -> tuple[Array, ...]:
    """Return where the refit of another card may begin: at its start beside the parameters as they are refitted and as they are given, and
    there with one value a quarter of its range from either end that leaves no trace, as a level that nothing reaches, or is at an end of
    its range, where what it sets is hardly there."""
    try:
        traces = np.any(stacked(base.problem.blocks(base.theta))[1] != 0.0, axis=0)
    except FAILURES:  # it may run elsewhere
        traces = np.zeros(base.theta.size, bool)
    hidden = [
        (k, f)
        for k, f in enumerate(base.problem.free)
        if f.name in change.free and (not traces[k] or f.on_bound(f.start))
    ]
    begins = [p.theta for p in _points(base)]
    for point in tuple(begins):
        for k, f in hidden:
            for share in (0.25, 0.75):
                begins.append(np.concatenate([point[:k], [f.min + share * (f.max - f.min)], point[k + 1 :]]))
    return tuple(begins)


def _with_card(first: Refit, change: CardChange) -> Refit:
    """Return the nominal model with another card, what a fit frees of it at its start beside the parameters as they are refitted."""
    model = recording(change.model, (o for e in first.problem.experiments for o in e.outputs))
    own = tuple(FitParameter.of(n, p) for n, p in change.free.items())
    old = model.parameters.keys() - change.free.keys()
    stays = [k for k, f in enumerate(first.problem.free) if f.name in old]
    held = FrozenMap({n: v for n, v in first.problem.held.items() if n in old})
    free = (*(first.problem.free[k] for k in stays), *own)
    problem = replace(first.problem, simulator=ModelSimulator(model, first.patience), free=free, held=held)
    nuisance = first.theta[len(first.problem.free) :]
    theta = np.concatenate([first.theta[stays], [f.start for f in own], nuisance])
    return Refit(model, (), problem, first.noise, theta)


MOVES = (
    Move("cards", 0, exchanged, of_root=True),
    Move("typical values of cards", 2, with_typical_values, of_root=True),
)
