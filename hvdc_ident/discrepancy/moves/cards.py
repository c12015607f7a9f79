"""Cards as terms: another component in the place of one, or one more, where the model is built of components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.expansion import Race
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, refit_again
from hvdc_ident.discrepancy.moves.values import worth_of
from hvdc_ident.discrepancy.result import CARD
from hvdc_ident.discrepancy.score import P_CARD
from hvdc_ident.discrepancy.search import BEAM, Hypothesis, Move, Search, Term
from hvdc_ident.discrepancy.stated import stated, with_free
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import is_white_box, recording
from hvdc_ident.plants.exchange import CardChange, exchanges
from hvdc_ident.simulate import ModelSimulator

CARD_LAPS = (8, 12)
"""Evaluations of the laps of a race of cards: with six values free beside the others they come near their ends in so many."""


def exchanged(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """The units with another card in the place of one, or with one more, where the model is a unit and nothing explains the records."""
    context, first = search.context, h.refit
    if not is_white_box(first.model) or search.is_noise(search.ranked()[0]):
        return []
    places = [n for n in context.components if context.may_exchange(n)]
    changes = [c for c in exchanges(first.model) if (c.component in places if c.stated else places)]
    bases = [_with_card(first, c) for c in changes]
    jobs = [RefitJob(b.model, (), b.problem, _begins(b, c), b.noise) for b, c in zip(bases, changes, strict=True)]
    refits = Race(CARD_LAPS).run(context, first, jobs, [f"with {c.card.upper()} as {c.component}" for c in changes])
    prior = P_CARD / max(len(changes), 1)
    each = [
        Hypothesis(r, replace(b, theta=r.theta), (Term(CARD, (c.component,), c.card.upper(), prior),))
        for c, b, r in zip(changes, bases, refits, strict=True)
        if not r.failure and r.rows
    ]
    search.add(each)
    return [_all_of_it(search, h) for h in search.ranked() if h.kind == CARD and len(h.terms) == 1][:BEAM]


def _all_of_it(search: Search, h: Hypothesis) -> Hypothesis:
    """Return a hypothesis of another card with as many of the card's typical values set free as the records ask for, the most wanted
    first: nobody has stated them."""
    (component,) = h.terms[0].at
    while not (search.context.spent or search.is_noise(h)):
        own = [f for f in stated(h.base.model, h.base.problem.free) if f.name.startswith(f"{component}.")]
        worth, _ = worth_of(h.refit, own, [0.0] * len(own))
        if not worth.size or worth.max() <= 0.0:
            break
        wider = with_free(h.base, own[int(np.argmax(worth))])
        refit = refit_again(wider, h.refit, ())
        more = Hypothesis(refit, replace(wider, theta=refit.theta), h.terms)
        ruler = search.ruler
        if refit.failure or search.cost(more, ruler, rough=True) >= search.cost(h, ruler, rough=True):
            break
        h = more
    return h


def _begins(base: Refit, change: CardChange) -> tuple[Array, ...]:
    """Return where the refit of another card may begin: at its start, and there with one value a quarter of its range from either end.

    No slope leads to a level that nothing reaches at the start.
    """
    begins = [base.theta]
    for k, f in enumerate(base.problem.free):
        for share in (0.25, 0.75) if f.name in change.free else ():
            begins.append(np.concatenate([base.theta[:k], [f.min + share * (f.max - f.min)], base.theta[k + 1 :]]))
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


MOVE = Move("cards", 0, exchanged, of_root=True)
