"""A linear filter that no chain of the catalogue's effects is: a notch or a resonance somewhere in the model.

What passes a band of frequencies differently leaves a trace that lags and lead-lags come near to and never explain. The
filter of second order is looked for as any effect is, by its scores at finite sizes and by refits, where none of them leaves
noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect, candidates
from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit
from hvdc_ident.discrepancy.formula import Law
from hvdc_ident.discrepancy.options import SHORTLIST
from hvdc_ident.discrepancy.outside.law import standing
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.stand import Stand
from hvdc_ident.immutable import FrozenMap

BESIDES = ("low", "high")
"""Parameters of the filter below and above its band."""
LATE = -0.5
"""Real part of the zeros, from -1 (those of a filter that only delays, in place of its poles) to 1, from which they are a
notch's or a resonance's."""


def filtered(search: SearchContext, found: Round, trials: Sequence[CandidateFit], best: Refit) -> Law | None:
    """The filter that comes near the noise, clearly nearer than `best`, the best refit of the catalogue; None where there is
    none. trials: those of `filters`."""
    refits = [t.refit for t in trials]
    return standing(search, found, refits, [None] * len(refits), best)[1]


def filters(search: SearchContext, found: Round) -> tuple[CandidateFit, ...]:
    """Filters refitted where they promise most, those that no chain of the catalogue's effects is: first a band alone, then one
    that is off below and above it too."""
    before, times = found.before, [e.time for e in found.before.problem.fitted_experiments]
    whole = candidates(before.model, found.signals, times, ("filter",), search.places)
    stand = Stand.of(search, before, whole, 1)
    both = (*map(_band, whole), *whole)
    screen = stand.screen(both, "outside the catalogue", range(len(whole)))
    picks = list(screen.best().values())[:SHORTLIST]
    wider = [replace(s, candidate=s.candidate + len(whole)) for s in picks]
    trials = stand.refitted(both, [*picks, *wider], "outside the catalogue")
    return tuple(t for t in trials if not t.refit.failure and _rings(t.refit))


def _band(candidate: CandidateEffect) -> CandidateEffect:
    """The filter that changes nothing but a band."""
    free = [FrozenMap({n: b for n, b in p.free.items() if n not in BESIDES}) for p in candidate.probes]
    return replace(candidate, probes=tuple(replace(p, free=f) for p, f in zip(candidate.probes, free, strict=True)))


def _rings(refit: Refit) -> bool:
    """Return True where poles and zeros are complex, as of no chain of lags and lead-lags, and the zeros not a delay's."""
    zeros, poles = _polynomials(refit)
    return _complex(zeros) and _complex(poles) and zeros[1] / zeros[0] > LATE * poles[1]


def _complex(quadratic: Array) -> bool:
    a, b, c = quadratic
    return bool(b**2 < 4.0 * a * c)


def _polynomials(refit: Refit) -> tuple[Array, Array]:
    """Numerator and denominator of the filter that a refit ends with, the highest power first."""
    p = refit.sizes(refit.placed[-1])
    band = 2.0 * p["zeta"] * p["wn"]
    above, below = 1.0 + p["k"] * p["high"], 1.0 + p["k"] * p["low"]
    return np.array([above, band * (1.0 + p["k"]), p["wn"] ** 2 * below]), np.array([1.0, band, p["wn"] ** 2])


def shape(refit: Refit) -> str:
    """The fitted filter in words: a notch or a resonance, and its frequency."""
    omega = refit.sizes(refit.placed[-1])["wn"] * np.geomspace(0.1, 10.0, 2001)
    numerator, denominator = _polynomials(refit)
    level = np.log(np.abs(np.polyval(numerator, 1j * omega) / np.polyval(denominator, 1j * omega)))
    most = np.argmax(np.abs(level))
    return f"a {'notch' if level[most] < 0 else 'resonance'} around {omega[most]:.3g} rad/s"


def transfer_function(refit: Refit) -> str:
    """The filter that a refit ends with, as a fraction of polynomials in s."""
    told = [" + ".join((f"{a:.4g} s^2", f"{b:.4g} s", f"{c:.4g}")) for a, b, c in _polynomials(refit)]
    return "/".join(f"({t.removeprefix('1 ').replace('+ -', '- ')})" for t in told)
