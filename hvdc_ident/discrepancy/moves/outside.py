"""Forms outside the catalogue as terms: bends, products, drifts, dry friction, characteristics, filters.

Each is a kind of its own in `hvdc_ident.effects`, which is tried here only: in the stead of what explains the records best, for whoever has
only the catalogue's name for it takes a form for known that the data may not show; and at all places that promise much where nothing of
the catalogue explains them.
"""

from __future__ import annotations

from collections.abc import Collection

from hvdc_ident.discrepancy.candidates import candidates
from hvdc_ident.discrepancy.expansion import Expansion, ExpansionModel, Trial, best_each, gains_of
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.moves.effects import extended, kept, leaders_of
from hvdc_ident.discrepancy.options import FIELD, SearchContext
from hvdc_ident.discrepancy.screen import Score
from hvdc_ident.discrepancy.search import Hypothesis, Move, Search
from hvdc_ident.effects import effects
from hvdc_ident.model import is_white_box

FORM_PLACES = 12
"""Insertion points that forms are looked for at."""
REFITS_PER_FORM = 4
"""Refits of one form."""


def refitted_forms(
    search: SearchContext,
    opened: Expansion,
    at: Collection[str] | None = None,
    kinds: Collection[str] = ("term", "filter", "curve"),
) -> tuple[Trial, ...]:
    """Return the refits of forms of these kinds, each none of the catalogue's effects, the best of each candidate.

    at: places; those where effects of the catalogue explain most, where none are given. Values on a curve begin at no addition, so
    that their first step is the linear regression on it: curves are not screened.
    """
    before = opened.before
    if not is_white_box(before.model):
        return ()
    places = promising(opened) if at is None else at
    times = [e.time for e in before.problem.fitted_experiments]
    names = [n for n, e in effects().items() if e.outside in kinds]
    found = [
        c
        for c in candidates(before.model, opened.signals, times, names, search.places)
        if len(c.at) == 1 and c.at[0] in places and not c.still
    ]
    curves = [k for k, c in enumerate(found) if effects()[c.effect].outside == "curve"]
    model = ExpansionModel.of(search, before, found, 1)
    screen = model.screen(found, "outside the catalogue", [k for k in range(len(found)) if k not in curves])
    scores: list[Score] = []
    for effect in {c.effect: None for c in found}:
        scores += [s for k, s in screen.best().items() if found[k].effect == effect][:REFITS_PER_FORM]
    scores += [Score(k, 0, 0.0, before.theta) for k in curves]
    trials = best_each(model.refitted(found, scores, "outside the catalogue"))
    return tuple(t for t in trials if not t.refit.failure and _is_own(t.refit))


def promising(opened: Expansion) -> list[str]:
    """Return the places at which an effect of the catalogue, whichever, makes chi2 fall most."""
    order = [opened.candidates[k].at for k in opened.screen.best()]
    return list(dict.fromkeys(at[0] for at in order if len(at) == 1))[:FORM_PLACES]


def _is_own(refit: Refit) -> bool:
    entry = effects()[refit.placed[-1].candidate.effect]
    return entry.is_own is None or entry.is_own(refit.sizes(refit.placed[-1]))


def in_stead(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with a form in the stead of the effects that explain the records best beside this one, at their places.

    No term of signals at one time is a delay: in the stead of a delay filters are looked for.
    """
    expansion = search.expansions.get(h.key)
    if expansion is None or not search.context.options.fallback:
        return []
    places: dict[str, list[str]] = {}
    for t in leaders_of(expansion):
        c = t.refit.placed[-1].candidate
        entry = effects()[c.effect]
        delays = entry.equivalent_delay is not None and not entry.needs_grid
        if len(c.at) == 1:
            places.setdefault("filter" if delays else "term", []).append(c.at[0])
    return [
        child
        for kind, at in places.items()
        if not search.context.spent
        for child in extended(h, expansion, refitted_forms(search.context, expansion, at, (kind,)))
    ]


def anywhere(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with a form at the places that promise most, and with every effect at the place of the best form, from its gains.

    A form with many values finds the place and the gains where an effect, beside biased gains, did not: a filter whose poles and zeros
    meet is a gain.
    """
    expansion = search.expansions.get(h.key)
    if expansion is None or not search.context.options.fallback:
        return []
    context, model = search.context, search.models[h.key]
    forms = refitted_forms(context, expansion)
    found = extended(h, expansion, forms)
    search.add(found)
    first = search.forms_ahead(search.answer()[0], search.forms())
    if not first or context.spent:
        return found
    (term,) = first[0].terms
    at = term.at
    which = [k for k, c in enumerate(expansion.candidates) if c.at == at and not c.still]
    screen = model.screen(expansion.candidates, "outside", which, gains_of(expansion.before, first[0].refit))
    scores = list(screen.best().values())[:FIELD]
    more = model.refitted(expansion.candidates, scores, "outside", expansion.trials)
    return [*found, *kept(search, h, expansion.with_trials(more))]


MOVES = (
    Move("forms in the stead", 1, in_stead, in_stead=True),
    Move("forms", 4, anywhere, of_root=True),
)
