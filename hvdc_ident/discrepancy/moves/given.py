"""Effects in the stead of other values of the parameters: with the given values they explain the records as well.

A signal that is 0.8 times what the record says, and a gain of the model that is 0.8 of its given value, may be one model. The
fitted parameters take up all of such an effect, so no score shows it: it is refitted with the parameters as they were given.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.expansion import refits_of
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, refit_job
from hvdc_ident.discrepancy.options import SHORTLIST
from hvdc_ident.discrepancy.score import at_edge, is_clear, off_by_more_than_chance
from hvdc_ident.discrepancy.search import GIVEN, Hypothesis, Move, Search, Term
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.immutable import FrozenMap


def as_given(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one effect beside the given values of the parameters that are off in the model without terms, which leaves noise.

    Only one in place of all of them: beside values that are off, an effect in place of another such value explains nothing more.
    """
    expansion = search.expansions.get(h.key)
    if expansion is None or not search.is_noise(h):
        return []
    moved = off_by_more_than_chance(h.refit)
    if not moved:
        return []
    found, last = expansion.candidates, expansion.before
    # One that brings another signal in has many likes: those that do not are asked first.
    first = sorted(expansion.screen.absorbed(), key=lambda k: (bool(found[k].source), len(found[k].at), k))[:SHORTLIST]
    jobs = []
    for k in first:
        with suppress(HvdcIdentError):  # it cannot sit there
            jobs.append(_with_given(_job(last, found[k]), moved))
    labels = [f"with the given values: {j.placed[-1].candidate.label}" for j in jobs]
    given = Term(GIVEN, moved)
    children = []
    for refit in refits_of(search.context, jobs, labels):
        if refit.failure or not refit.rows or at_edge(refit, 0) or not is_clear(refit, 0):
            continue
        c = refit.placed[-1].candidate
        terms = (*h.terms, given, Term(c.effect, c.at, c.source, expansion.prior(c.effect)))
        children.append(Hypothesis(refit, h.base, terms))
    return children


def _job(last: Refit, candidate: CandidateEffect) -> RefitJob:
    """Return the refit with a candidate, which may begin at each of its sizes."""
    begun = refit_job(last, candidate, 0, 1.0, last.theta)
    placed, k = begun.placed[-1], len(last.problem.free)
    alike = [p.values for p in candidate.probes[1:] if set(p.free) == set(placed.bounds)]
    sizes = [[v[n] for n in placed.bounds] for v in alike if all(b[0] < v[n] < b[1] for n, b in placed.bounds.items())]
    others = (np.concatenate([last.theta[:k], s, last.theta[k:]]) for s in sizes)
    return replace(begun, begins=(*begun.begins[:1], *others))


def _with_given(begun: RefitJob, names: Sequence[str]) -> RefitJob:
    """Return a refit with some free parameters of the model held at their given values."""
    problem = begun.problem
    own = {f.name: f.given for f in problem.free if f.name in names}
    at = [problem.names.index(n) for n in own]
    held = replace(
        problem,
        free=tuple(f for f in problem.free if f.name not in own),
        held=FrozenMap({**problem.held, **own}),
    )
    return replace(begun, problem=held, begins=tuple(np.delete(b, at) for b in begun.begins))


MOVE = Move("as given", 1, as_given, of_root=True)
