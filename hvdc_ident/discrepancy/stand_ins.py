"""Effects that values of the parameters stand for: with the given values they explain the records as well.

A signal that is 0.8 times what the record says, and a gain of the model that is 0.8 of its given value, may be one model. The
fitted parameters take up all of such an effect, so no score shows it: it is refitted with the parameters as they were given.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.expansion import Expansion, refits_of
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, refit_job
from hvdc_ident.discrepancy.options import SHORTLIST, SearchContext
from hvdc_ident.discrepancy.result import StandIn
from hvdc_ident.discrepancy.score import Ruler, at_edge, evidence_between, is_clear
from hvdc_ident.discrepancy.sentences import sentence
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.immutable import FrozenMap


def stand_ins(search: SearchContext, last: Refit, opened: Expansion, moved: Sequence[str]) -> tuple[StandIn, ...]:
    """Return the effects that explain the records as well as other values of the parameters, with these as given, the best first.

    Only one in place of all of them: beside values that are off, an effect in place of another such value explains nothing more.
    last: the model without effects, refitted; opened: the first round of the search, whose screen shows which effects the
    parameters take up; moved: the parameters whose values are off the given ones.
    """
    found = opened.candidates
    taken_up = opened.screen.absorbed()
    if not taken_up or search.spent:
        return ()
    # One that brings another signal in has many likes: those that do not are asked first.
    first = sorted(taken_up, key=lambda k: (bool(found[k].source), len(found[k].at), k))[:SHORTLIST]
    jobs = []
    for k in first:
        with suppress(HvdcIdentError):  # it cannot sit there
            jobs.append(_with_given(_job(last, found[k]), moved))
    found_ones: list[StandIn] = []
    ruler = Ruler.of(last)
    values = FrozenMap({f.name: f.given for f in last.problem.free if f.name in moved})
    for refit in refits_of(search, jobs, [f"with the given values: {j.placed[-1].candidate.label}" for j in jobs]):
        if refit.failure or at_edge(refit, 0) or not is_clear(refit, 0):
            continue
        evidence = evidence_between(last, refit, ruler, refit.count - len(moved))
        if evidence >= -search.options.set_bic:
            c, sizes = refit.placed[-1].candidate, FrozenMap(refit.sizes(refit.placed[-1]))
            found_ones.append(StandIn(c.effect, c.at, max(-evidence, 0.0), sizes, values, sentence(c, sizes), c.source))
    return tuple(sorted(found_ones, key=lambda s: round(s.delta_bic, 1)))  # as good is as good: then as asked


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
