"""Candidates related to the best refits so far: other places, other forms, other kinds of delay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from hvdc_ident.discrepancy.scores.dense import bent, by_level
from hvdc_ident.discrepancy.scores.scored import SEEN
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.trials.context import Round, SearchContext
from hvdc_ident.discrepancy.trials.refit_jobs import job_of
from hvdc_ident.discrepancy.trials.refitted import (
    HEAT,
    SPRINT,
    best_each,
    by_cost,
    cost_of,
    excess,
    misses,
    once_more,
    refitted,
)
from hvdc_ident.discrepancy.trials.select import CandidateFit, Pick
from hvdc_ident.effects import effects
from hvdc_ident.errors import HvdcIdentError

ELSEWHERE = 40
"""Other places at most at which the best effects are refitted."""
ALIKE = 0.9
"""Share of the best fall of chi2 from which a refit is tried in the effect's other forms."""
FORMS = 16
"""Of these refits at most."""
LEADERS = 4
"""Of the refits the best, whose places other kinds of delay are tried at."""
STARTS = 2
"""Sizes that another kind of delay is begun at."""
EFFORT = 600_000
"""Sizes of what bends its signal, times the rows of the records."""
LIKE = 0.15
"""Of a logarithm: up to where two delays are alike."""


def elsewhere(
    search: SearchContext, opened: Round, picks: Sequence[Pick], trials: Sequence[CandidateFit], number: int
) -> list[CandidateFit]:
    """Refits of the best effects at every other place where they score more than noise: the places that cannot be told from
    theirs are to be had by no other way, for a score is that of one size and of gains that are biased."""
    found = opened.candidates
    sound = by_cost(trials)
    if not sound:
        return []
    margin = 2.0 * search.options.set_bic
    least, cost = min(t.refit.chi2 for t in sound) + margin, cost_of(sound[0]) + margin
    leading = {found[t.pick.candidate].effect for t in sound if t.refit.chi2 < least or cost_of(t) < cost}
    twins = {
        p.candidate for k, same in opened.same.items() for p in same if found[p.candidate].source == found[k].source
    }
    tried = {t.pick.candidate for t in trials} | twins
    threshold = opened.scores.threshold(search.options.significance)
    left = [
        p for p in picks if found[p.candidate].effect in leading and p.candidate not in tried and p.score > threshold
    ]
    return refitted(
        search, opened, left[:ELSEWHERE], f"round {number}: {', '.join(sorted(leading))} elsewhere", trials, HEAT
    )


def other_forms(opened: Round, trials: Sequence[CandidateFit], was: float) -> list[Pick]:
    """The best candidates with other parts of the effect, where it is made of optional ones: a score is that of one of them.

    was: chi2 of the model before. A loss in proportion to a current is no better told from its square by the gains as they
    are than other sizes are.
    """
    found, scores = opened.candidates, opened.scores
    sound = by_cost(trials)
    most = was - min((t.refit.chi2 for t in sound), default=was)
    good = [t for t in sound if was - t.refit.chi2 > ALIKE * most]
    picks: list[Pick] = []
    for k in dict.fromkeys(t.pick.candidate for t in good):
        done_here = {frozenset(found[k].probes[t.pick.probe].free) for t in trials if t.pick.candidate == k}
        columns = [(float(scores.t[n]), n, c.probe) for n, c in enumerate(scores.columns) if c.candidate == k]
        for score, n, probe in sorted(columns, reverse=True):
            form = frozenset(found[k].probes[probe].free)
            if score > 0 and form not in done_here:
                done_here.add(form)
                picks.append(Pick(k, probe, float(scores.expected[n]), score))
    return picks[:FORMS]


def as_late(opened: Round, trials: Sequence[CandidateFit]) -> list[Pick]:
    """The other kinds of delay at the best places of one, to be begun where they delay a slow signal by as much.

    A score is had at few sizes, and from a wrong one no slope leads to the right one: a window to another of its zeros.
    """
    found = opened.candidates
    sound = by_cost(trials)
    goals: dict[tuple[str, ...], float] = {}
    for t in sound[:LEADERS]:
        late = _late(t)
        if late and late > 0.0:
            goals.setdefault(found[t.pick.candidate].at, late)
    done_here = {t.pick.candidate: late for t in sound if (late := _late(t)) and late > 0.0}
    picks = []
    for k, c in enumerate(found):
        late_of, goal = effects()[c.effect].equivalent_delay, goals.get(c.at)
        if late_of is None or goal is None or (k in done_here and _apart(done_here[k], goal) < LIKE):
            continue
        lates = {n: late_of(p.values) for n, p in enumerate(c.probes)}
        nearest = sorted((n for n in lates if lates[n] > 0.0), key=lambda n: _apart(lates[n], goal))
        picks += [Pick(k, n, goal / lates[n], opened.score_p(k)[0]) for n in nearest[:STARTS]]
    return picks


def with_begun(
    search: SearchContext, opened: Round, trials: Sequence[CandidateFit], picks: Sequence[Pick], number: int
) -> list[CandidateFit]:
    """The trials with those picks, of each candidate the best.

    A period that has to be met is looked for where there is something left for it to explain, in the first round: of
    the two minutes that a hard case took it was half a minute beside effects that were there already.
    """
    text = f"round {number}: as late as the best"
    begun = refitted(search, opened, picks, text, trials, SPRINT)
    sound = by_cost(trials)
    if number == 1 and sound and (excess(sound[0].refit) or misses(sound[0].refit)):
        begun = once_more(search, opened, begun, text, most=1, best=sound[0].refit.chi2)
    return best_each([*trials, *begun])


def carried(search: SearchContext, opened: Round, trials: Sequence[CandidateFit], number: int) -> list[CandidateFit]:
    """The best, where its size has to be met, with that size and those gains at every other place within reach.

    The scores that put it where it is are of other sizes, and of gains that are biased.
    """
    found, sound = opened.candidates, by_cost(trials)
    best = found[sound[0].pick.candidate] if sound else None
    if best is None or not effects()[best.effect].needs_grid or len(best.at) > 1:
        return []
    refit, placed = sound[0].refit, sound[0].refit.placed[-1]
    picks, jobs = [], []
    for k, c in enumerate(found):
        if c.effect == best.effect and len(c.at) == 1 and c.at != best.at and opened.reaches(c) and not c.still:
            there = replace(placed, candidate=replace(placed.candidate, at=c.at), use=replace(placed.use, at=c.at))
            with suppress(HvdcIdentError):  # it cannot sit there
                jobs.append(job_of(opened.before, refit, [there], {0: refit.sizes(placed)}))
                picks.append(Pick(k, 0, 1.0, opened.score_p(k)[0]))
    texts = [f"round {number}: {best.effect} elsewhere: {found[p.candidate].label}" for p in picks]
    ends = SPRINT.run(search, opened.before.chi2, jobs, texts, refit.chi2)
    return [CandidateFit(p, r, -np.inf) for p, r in zip(picks, ends, strict=True)]


def bends(opened: Round) -> list[Pick]:
    """Nonlinear effects at one slot, at every size probed: as many as records of this length leave time for.

    Where a loop answers such an effect otherwise than a linear one would, no score tells of it, and from a size at which it
    does nothing, or nearly all, no slope leads to the right one. The largest traces come first.
    """
    scores, found = opened.scores, opened.candidates
    order = np.argsort(-scores.size, kind="stable")
    columns = [scores.columns[k] for k in order if scores.size[k] > SEEN]
    at_one = [c for c in columns if len(found[c.candidate].at) == 1 and opened.reaches(found[c.candidate])]
    every = [c for c in at_one if bent(found[c.candidate]) or by_level(found[c.candidate])]
    # One after the other, for what is compiled for one size serves for all of its candidate.
    chosen = sorted(every[: EFFORT // opened.before.rows], key=lambda c: c.candidate)
    return [Pick(c.candidate, c.probe, 1.0, opened.score_p(c.candidate)[0]) for c in chosen]


def leaders(opened: Round, trials: Sequence[CandidateFit]) -> list[CandidateEffect]:
    """The candidates whose refits are the best, the best first."""
    return [opened.candidates[t.pick.candidate] for t in by_cost(trials)[:LEADERS]]


def is_akin(candidate: CandidateEffect, best: Sequence[CandidateEffect]) -> bool:
    """Return True for a candidate related to the best so far, worth a grid refinement: the same at any place, where its size has
    to be met; a bend at any place, where something bends its signal; a sampler where something delays it."""
    if effects()[candidate.effect].needs_grid and best and best[0].effect == candidate.effect:
        return True
    if effects()[candidate.effect].equivalent_delay is not None:
        return any(effects()[c.effect].equivalent_delay is not None and c.at == candidate.at for c in best)
    return any(bent(c) for c in best) and not effects()[candidate.effect].needs_grid


def _apart(a: float, b: float) -> float:
    """Distance of two times from each other, as a logarithm."""
    return abs(math.log(a / b))


def _late(trial: CandidateFit) -> float | None:
    """By how long the effect that a trial added delays a slow signal, s; None for what is no kind of delay."""
    placed = trial.refit.placed[-1]
    return effects()[placed.candidate.effect].delay_with(trial.refit.sizes(placed))
