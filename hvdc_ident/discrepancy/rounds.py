"""One round of the search: score everything on the model as it stands, refit the best, judge the winner."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.discrepancy.context import Round, SearchContext, slot_signals
from hvdc_ident.discrepancy.evidence import CandidateFit, Ruler, behinds, best_of, evidence_between, objections
from hvdc_ident.discrepancy.explore import explored
from hvdc_ident.discrepancy.implied import TIED, implied, nearest, off_given
from hvdc_ident.discrepancy.latent import reach
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.options import FIELD
from hvdc_ident.discrepancy.proposals import by_latent, views_of
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.refitted import all_far, excess, like_noise, once_more, refitted
from hvdc_ident.discrepancy.scores import runs, scored, tones
from hvdc_ident.discrepancy.signatures.candidates import candidates

SCORED = 0.25
"""Part of a refit's fall of chi2 that counts as a score: a refit moves more than a score does, and ends at sizes not scored."""
LARGE = 2.0
"""Times its rows: chi2 of a model with an effect in it from which it is asked where anything would explain the rest."""
NEARLY = 0.1
"""Chance under noise of the best score below which a closer look is taken before nothing is said to be there."""


BEYOND = "none of it leaves noise, and what is found from the data alone does"


def one_round(search: SearchContext, before: Refit, number: int) -> Round:
    """A round on the model as it stands. Raises SimulationError where that model cannot be run."""
    options, nominal = search.options, before.nominal()
    search.tell(0, 1, f"round {number}: the model's answers at every slot")
    paths = runs(before.model, nominal)
    signals = slot_signals(before.model, paths, before.placed)
    found = candidates(
        before.model,
        signals,
        [a.time for a in paths.values()],
        search.effects,
        search.places,
        tones(nominal),
    )
    there = {(p.candidate.effect, p.candidate.at, p.candidate.source) for p in before.placed}
    found = tuple(c for c in found if (c.effect, c.at, c.source) not in there and c.probes)
    search.tell(0, 1, f"round {number}: scores of {len(found)} candidates")
    scores = scored(
        nominal, found, paths, bootstraps=options.bootstraps, seed=search.seed + number,
        executor=search.executor,
    )  # fmt: skip
    opened = Round(before, paths, found, scores, (), (), None, "", False, None)
    picks = best_of(scores, found)
    if not picks:
        return replace(opened, why="no candidate leaves a trace in these data")
    p = scores.p(picks[0].score)
    if p > options.significance:
        nothing = replace(opened, why=f"the best score of all is what noise gives (p = {p:.2g})")
        worth = p < NEARLY or (excess(before) and not like_noise(before))
        return _met(search, nothing, nominal) if number == 1 and worth else nothing
    opened = replace(opened, significant=True)
    if number == 1 or before.chi2 > LARGE * before.rows:  # else too little is left to save by it
        search.tell(0, 1, f"round {number}: what could be made good at each slot")
        opened = replace(opened, reach=reach(nominal, paths, list(signals), search.executor))
    return closed(search, *explored(search, opened, nominal, number), number)


def _met(search: SearchContext, opened: Round, nominal: Nominal) -> Round:
    """The round with sizes that the scores did not look at, where nothing else has a score though more than noise is left."""
    opened, picks = by_latent(search, opened, views_of(opened, nominal), 1, lambda _: True)
    if not picks or opened.scores.p(max(p.score for p in picks)) > search.options.significance:
        return opened
    trials = refitted(search, opened, picks[:FIELD], "round 1: refits of many sizes")
    if all_far(opened.before, trials):
        trials = once_more(search, opened, trials, "round 1: once more")
    return closed(search, replace(opened, significant=True, why=""), trials, 1)


def closed(search: SearchContext, opened: Round, trials: Sequence[CandidateFit], number: int) -> Round:
    """The round with its refits ranked and its winner, or what speaks against the best.

    Ranked by what the fitted and the held-out data say together. Of those that are as good the likeliest wins: an effect's
    probability before any data is shared by all its places and sources, so an offset goes before one of many couplings. Of those
    that are as likely and imply other values of the parameters that one wins whose values are nearest to the given ones.
    """
    tried = {t.pick.candidate for t in trials}
    trials = [*trials, *(t for t in opened.failed if t.pick.candidate not in tried)]
    sound, failed = [t for t in trials if not t.refit.failure], tuple(t for t in trials if t.refit.failure)
    if not sound:
        return replace(opened, failed=failed, why="no candidate could be refitted")
    before, found = opened.before, opened.candidates
    ruler = Ruler.of(min(sound, key=lambda t: t.refit.chi2).refit)
    ranked = sorted((gained(t, before, ruler) for t in sound), key=lambda t: -t.told)
    if opened.law is not None:
        return replace(opened, trials=tuple(ranked), failed=failed, ruler=ruler, why=BEYOND)
    level = [t for t, behind in zip(ranked, behinds(ranked), strict=True) if behind <= search.options.set_bic]
    refused = {id(t): against(search, before, t, opened, first=number == 1) for t in level}
    many = Counter(c.effect for c in found)
    unlikely = {id(t): 2.0 * np.log(many[found[t.pick.candidate].effect]) - t.told for t in level}
    likeliest = sorted((t for t in level if not refused[id(t)]), key=lambda t: unlikely[id(t)])
    winner = next(iter(likeliest), None)
    if winner is not None:
        tied = [t for t in likeliest if unlikely[id(t)] <= unlikely[id(winner)] + TIED]
        winner = nearest(winner, tied, lambda t: implied(t.refit), lambda t: off_given(t.refit))
    why = "" if winner else f"{found[level[0].pick.candidate].label}: {refused[id(level[0])]}"
    return replace(opened, trials=tuple(ranked), failed=failed, winner=winner, why=why, ruler=ruler)


def gained(trial: CandidateFit, before: Refit, ruler: Ruler) -> CandidateFit:
    """The trial with what it gains in BIC over the model before, and what the held-out data add to that."""
    more = len(trial.refit.problem.free) - len(before.problem.free)
    gain = ruler.gain(before.chi2, trial.refit.chi2, more)
    return CandidateFit(trial.pick, trial.refit, gain, evidence_between(before, trial.refit, ruler, more))


def against(search: SearchContext, before: Refit, trial: CandidateFit, opened: Round, *, first: bool) -> str:
    """Objection to naming a trial's effect, in words; empty where there is none. opened: the round whose scores it has.

    A refit may end at another size than it began at, so the candidate's best score counts; one whose answer no expansion
    gave is scored by its refit. Where a refit brings many times what scores do at the sizes tried, these were the wrong ones.
    """
    best, fall = max(trial.pick.score, opened.score_p(trial.pick.candidate)[0]), before.chi2 - trial.refit.chi2
    score = max(best, SCORED * fall)
    return objections(before, trial, opened.scores.p(score), search.options, search.tolerance, first=first)
