"""One line for every candidate: its screen, and what a refit made of it."""

from __future__ import annotations

import numpy as np

from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.evidence import CandidateFit
from hvdc_ident.discrepancy.result import Line
from hvdc_ident.discrepancy.rounds import LEFT_BEHIND, Round
from hvdc_ident.discrepancy.screen import Score
from hvdc_ident.discrepancy.search import SearchOutcome
from hvdc_ident.immutable import FrozenMap


def lines(outcome: SearchOutcome) -> tuple[Line, ...]:
    """Every candidate of every round, those of the first round first, each round by what was found of them."""
    found: list[Line] = []
    for number, r in enumerate(outcome.rounds, start=1):
        refits = {t.pick.candidate: t for t in (*r.failed, *r.trials)}
        best, absorbed = r.screen.best(), set(r.screen.absorbed())
        # Of later rounds what was not refitted says nothing that the first has not said.
        listed = [(k, c) for k, c in enumerate(r.candidates) if number == 1 or k in refits]
        own = [_line(r, k, c, best.get(k), refits.get(k), number, absorbed=k in absorbed) for k, c in listed]
        found += sorted(own, key=lambda x: (-(x.delta_bic if x.delta_bic is not None else -np.inf), -x.score))
    return tuple(found)


def _line(
    r: Round,
    k: int,
    c: CandidateEffect,
    score: Score | None,
    trial: CandidateFit | None,
    number: int,
    *,
    absorbed: bool,
) -> Line:
    status = f"failed: {r.screen.failures[k]}" if k in r.screen.failures else "not-excited"
    fall, values, delta, hold = 0.0, FrozenMap[float](), None, None
    if score is not None:
        fall, values = max(score.fall, 0.0), c.probes[score.probe].values
        excited = any(r.screen.usable(column) for column in r.screen.size if column[0] == k)
        status = "absorbed" if absorbed else "screened" if excited else "not-excited"
    if trial is not None and trial.refit.failure != LEFT_BEHIND:
        status = f"failed: {trial.refit.failure}" if trial.refit.failure else "refitted"
        if not trial.refit.failure:
            delta, hold = trial.gain, trial.refit.unseen
            values = FrozenMap(trial.refit.sizes(trial.refit.placed[-1]))
    return Line(c.effect, c.at, fall, r.screen.p(fall), status, values, delta, hold, c.source, number)
