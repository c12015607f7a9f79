"""A linear filter that no chain of the catalogue's effects is: a notch or a resonance somewhere in the model.

What passes a band of frequencies differently leaves a trace that lags and lead-lags come near to and never explain. The
filter of second order is looked for as any effect is, by its scores at finite sizes and by refits, where none of them leaves
noise.
"""

from __future__ import annotations

from dataclasses import replace

from hvdc_ident.discrepancy.candidates import candidates
from hvdc_ident.discrepancy.formula import Law
from hvdc_ident.discrepancy.law import standing
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.scores import scored
from hvdc_ident.discrepancy.select import best_of
from hvdc_ident.discrepancy.state import Round, Search, slot_signals
from hvdc_ident.discrepancy.trials import refitted

PLACES = 4
"""Places, the best by score, at which the filter is refitted."""
LATE = -0.5
"""Real part of the zeros, from -1 (those of a filter that only delays, in place of its poles) to 1, from which they are a
notch's or a resonance's."""


def filtered(search: Search, found: Round, nominal: Nominal, best: Refit) -> Law | None:
    """The filter that comes near the noise, clearly nearer than `best`, the best refit of the catalogue, and that no chain of
    its effects is; None where there is none. nominal: the model before the round, projected."""
    paths, before = found.answers(), found.before
    signals, times = slot_signals(paths, before.placed), [path.time for path in paths.values()]
    everywhere = candidates(before.model, signals, times, ("filter",), search.places)
    sought = tuple(c for c in everywhere if found.reaches(c))
    scores = scored(nominal, sought, paths, bootstraps=0, seed=search.seed, executor=search.executor)
    mine, picks = replace(found, candidates=sought, scores=scores), best_of(scores, sought)[:PLACES]
    trials = refitted(search, mine, picks, "outside the catalogue")
    refits = [t.refit for t in trials if not t.refit.failure and _rings(t.refit)]
    return standing(search, found, refits, [None] * len(refits), best)[1]


def _rings(refit: Refit) -> bool:
    """Whether the zeros of the filter are complex, as of no chain of lags and lead-lags, and not those of a delay."""
    own = refit.sizes(refit.placed[-1])
    high, low = 1.0 + own["k"] * own["high"], 1.0 + own["k"] * own["low"]
    at = own["zeta"] * (1.0 + own["k"])
    return at**2 < high * low and at / high > LATE * own["zeta"]
