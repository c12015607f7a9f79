"""Two effects at once, for one can mask the other: scored jointly, refitted jointly."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.refits.refit import Refit, RefitJob
from hvdc_ident.discrepancy.scores.scored import signature_rows
from hvdc_ident.discrepancy.search.rounds import against, gained
from hvdc_ident.discrepancy.signatures.finite import SignatureColumn
from hvdc_ident.discrepancy.trials.context import Round, SearchContext
from hvdc_ident.discrepancy.trials.race import Race
from hvdc_ident.discrepancy.trials.refit_jobs import job
from hvdc_ident.discrepancy.trials.select import CandidateFit, Pick, Ruler, best_of
from hvdc_ident.effects import effects
from hvdc_ident.errors import HvdcIdentError

LOOKED_AT = 60
TRIED = 3


def pair(search: SearchContext, before: Refit, found: Round) -> tuple[Round, Round] | None:
    """Two rounds, each with one of the pair as its winner, where a pair passes that no single effect does; else None."""
    nominal = before.nominal()
    # A size that has to be met cannot be told from the score while something else is missing.
    picks = [p for p in best_of(found.scores, found.candidates) if not _scanned(found, p)][:LOOKED_AT]
    if len(picks) < 2:
        return None
    rows = signature_rows(
        nominal, found.candidates, found.paths, [SignatureColumn(p.candidate, p.probe) for p in picks]
    )
    residual = nominal.projected(nominal.residual[:, None])[:, 0]
    couples = [(picks[i], picks[j]) for i, j in _best(rows, residual)[:TRIED]]
    best = min((t.refit.chi2 for t in found.trials), default=before.chi2)
    for couple, both in _refitted(search, before, found, couples, best):
        rounds = None if both.failure else _judged(search, before, found, couple, both)
        if rounds is not None:
            return rounds
    return None


def _scanned(found: Round, pick: Pick) -> bool:
    return effects()[found.candidates[pick.candidate].effect].needs_grid


def _best(rows: Array, residual: Array) -> list[tuple[int, int]]:
    """Pairs by falling joint score, those left out that hardly beat their better half or are nearly one."""
    g, b = rows @ rows.T, rows @ residual
    d = np.maximum(np.diag(g), 1e-300)
    single = b**2 / d
    found = []
    for i in range(len(b)):
        for j in range(i + 1, len(b)):
            det = g[i, i] * g[j, j] - g[i, j] ** 2
            if not det > 0.05 * g[i, i] * g[j, j]:  # also where one of them leaves no trace
                continue
            t = (b[i] ** 2 * g[j, j] - 2 * b[i] * b[j] * g[i, j] + b[j] ** 2 * g[i, i]) / det
            if t > 1.2 * max(single[i], single[j]) + 20.0:
                found.append((t, i, j))
    return [(i, j) for _, i, j in sorted(found, reverse=True)]


def _refitted(
    search: SearchContext, before: Refit, found: Round, groups: Sequence[tuple[Pick, ...]], best: float
) -> list[tuple[tuple[Pick, ...], Refit]]:
    """The refits of some effects together, group by group; those that cannot sit there beside each other left out."""
    jobs: list[tuple[tuple[Pick, ...], RefitJob]] = []
    for picks in groups:
        with suppress(HvdcIdentError):
            jobs.append((picks, job(before, found.candidates, picks)))
    texts = ["pair: " + " with ".join(found.candidates[p.candidate].label for p in picks) for picks, _ in jobs]
    refits = Race().run(search, before.chi2, [j for _, j in jobs], texts, best)
    return [(picks, refit) for (picks, _), refit in zip(jobs, refits, strict=True)]


def _halves(search: SearchContext, before: Refit, found: Round, couple: tuple[Pick, ...]) -> list[Refit]:
    """Each effect of a pair by itself, as it was refitted in the round, or now; fewer than two where one cannot be."""
    known = {t.pick.candidate: t.refit for t in found.trials}
    missing = [(p,) for p in couple if p.candidate not in known]
    known |= {p.candidate: refit for (p,), refit in _refitted(search, before, found, missing, np.inf)}
    return [known[p.candidate] for p in couple if p.candidate in known and not known[p.candidate].failure]


def _judged(
    search: SearchContext, before: Refit, found: Round, couple: tuple[Pick, ...], both: Refit
) -> tuple[Round, Round] | None:  # fmt: skip
    """The two rounds of a pair that passes; None where it does not."""
    one, two = couple
    ruler = Ruler.of(both)
    whole = gained(CandidateFit(two, both, 0.0), before, ruler)
    if against(search, before, whole, found, first=True):
        return None
    halves = _halves(search, before, found, couple)
    if len(halves) < 2:
        return None
    alone = min(halves, key=lambda h: h.chi2)
    trial = CandidateFit(two, both, ruler.gain(alone.chi2, both.chi2, both.count - alone.count))
    if against(search, alone, trial, found, first=True):
        return None
    first = CandidateFit(one, halves[0], ruler.gain(before.chi2, halves[0].chi2, halves[0].count - before.count))
    left = replace(found, trials=(first,), winner=first, ruler=ruler, same={}, why="")
    right = replace(found, before=halves[0], trials=(trial,), winner=trial, ruler=ruler, same={}, why="")
    return left, right
