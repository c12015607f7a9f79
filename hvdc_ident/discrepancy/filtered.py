"""A linear filter that no chain of the catalogue's effects is: a notch or a resonance somewhere in the model.

What passes a band of frequencies differently leaves a trace that lags and lead-lags come near to and never explain. The
filter of second order is looked for as any effect is, by its scores at finite sizes and by refits, where none of them leaves
noise.
"""

from __future__ import annotations

from dataclasses import replace

from hvdc_ident.discrepancy.candidates import Candidate, candidates
from hvdc_ident.discrepancy.formula import Law
from hvdc_ident.discrepancy.law import standing
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.scores import scored
from hvdc_ident.discrepancy.select import Trial, best_of
from hvdc_ident.discrepancy.state import Round, Search, slot_signals
from hvdc_ident.discrepancy.trials import refitted
from hvdc_ident.frozen import FrozenMap

BESIDES = ("low", "high")
"""Parameters of the filter below and above its band."""
PLACES = 4
"""Places, the best by score, at which the filter is refitted."""
LATE = -0.5
"""Real part of the zeros, from -1 (those of a filter that only delays, in place of its poles) to 1, from which they are a
notch's or a resonance's."""


def filtered(search: Search, found: Round, nominal: Nominal, best: Refit) -> Law | None:
    """The filter that comes near the noise, clearly nearer than `best`, the best refit of the catalogue; None where there is
    none. nominal: the model before the round, projected."""
    refits = [t.refit for t in filters(search, found, nominal)]
    return standing(search, found, refits, [None] * len(refits), best)[1]


def filters(search: Search, found: Round, nominal: Nominal) -> list[Trial]:
    """Filters refitted where they score best, those that no chain of the catalogue's effects is: first a band alone, then one
    that is off below and above it too."""
    paths, before = found.answers(), found.before
    signals, times = slot_signals(paths, before.placed), [path.time for path in paths.values()]
    everywhere = candidates(before.model, signals, times, ("filter",), search.places)
    whole = tuple(c for c in everywhere if found.reaches(c))
    scores = scored(nominal, whole, paths, bootstraps=0, seed=search.seed, executor=search.executor)
    picks = best_of(scores, whole)[:PLACES]
    both = replace(found, candidates=(*map(_band, whole), *whole), scores=scores)
    wider = [replace(p, candidate=p.candidate + len(whole)) for p in picks]
    trials = refitted(search, both, [*picks, *wider], "outside the catalogue")
    return [t for t in trials if not t.refit.failure and _rings(t.refit)]


def _band(candidate: Candidate) -> Candidate:
    """The filter that changes nothing but a band."""
    free = [FrozenMap({n: b for n, b in p.free.items() if n not in BESIDES}) for p in candidate.probes]
    return replace(candidate, probes=tuple(replace(p, free=f) for p, f in zip(candidate.probes, free, strict=True)))


def _rings(refit: Refit) -> bool:
    """Whether poles and zeros of the filter are complex, as of no chain of lags and lead-lags, and the zeros not a delay's."""
    own = refit.sizes(refit.placed[-1])
    high, low = 1.0 + own["k"] * own["high"], 1.0 + own["k"] * own["low"]
    at = own["zeta"] * (1.0 + own["k"])
    return own["zeta"] < 1.0 and at**2 < high * low and at / high > LATE * own["zeta"]
