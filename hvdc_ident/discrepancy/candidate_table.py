"""One line for every candidate: its score, what a refit made of it, and the smallest size that would have been seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hvdc_ident.discrepancy.context import Round
from hvdc_ident.discrepancy.evidence import CandidateFit
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refit import unseen
from hvdc_ident.discrepancy.result import Line
from hvdc_ident.discrepancy.search import SearchOutcome
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.effects import distance_from_neutral, effects
from hvdc_ident.immutable import FrozenMap

ABSORBED = 0.99


def lines(outcome: SearchOutcome) -> tuple[Line, ...]:
    """Every candidate of every round, those of the first round first, each round by what was found of them."""
    found: list[Line] = []
    for number, r in enumerate(outcome.rounds, start=1):
        refits = {t.pick.candidate: t for t in (*r.trials, *r.failed)}
        threshold = r.scores.threshold(0.01)
        by_candidate = _columns(r)
        # Of later rounds what was not refitted says nothing that the first has not said.
        listed = [(k, c) for k, c in enumerate(r.candidates) if number == 1 or k in refits]
        own = [_line(r, k, c, by_candidate.get(k, []), refits.get(k), threshold, number) for k, c in listed]
        found += sorted(own, key=lambda x: (-(x.delta_bic if x.delta_bic is not None else -np.inf), -x.score))
    return tuple(found)


def _columns(r: Round) -> dict[int, list[int]]:
    found: dict[int, list[int]] = {}
    for k, column in enumerate(r.scores.columns):
        found.setdefault(column.candidate, []).append(k)
    return found


def _line(
    r: Round,
    number: int,
    c: CandidateEffect,
    columns: Sequence[int],
    trial: CandidateFit | None,
    threshold: float,
    round_: int,
) -> Line:
    s = r.scores
    if not columns:
        return Line(c.effect, c.at, 0.0, 1.0, "not-excited", source=c.source, round=round_)
    best = max(columns, key=lambda k: (s.t[k], s.left[k]))
    score = float(s.t[best])
    values = c.probes[s.columns[best].probe].values
    status = "scored"
    if not any(s.usable[k] for k in columns):
        seen = [k for k in columns if s.size[k] >= 1.0]
        status = "absorbed" if seen and all(s.absorbed[k] > ABSORBED for k in seen) else "not-excited"
        if seen and not any(s.sound[k] for k in seen):
            status = "scored: its loop would not settle at any size tried"
    delta = hold = None
    if trial is not None:
        status = f"failed: {trial.refit.failure}" if trial.refit.failure else "refitted"
        if not trial.refit.failure:
            delta, hold = trial.gain, unseen(trial.refit)
            values = FrozenMap(trial.refit.sizes(trial.refit.placed[-1]))
    return Line(
        c.effect, c.at, score, s.p(score), status, FrozenMap(dict(values)), delta, hold, float(s.absorbed[best]),
        smallest(r, c, columns, threshold), c.source, round_,
    )  # fmt: skip


def smallest(r: Round, c: CandidateEffect, columns: Sequence[int], threshold: float) -> FrozenMap[float] | None:
    """The smallest size whose expected score noise alone would hardly reach; None where no size tried would.

    Between the sizes tried the score is taken to follow a power of the distance from neutral; below them its square.
    """
    s, entry = r.scores, effects()[c.effect]
    points = []
    for k in columns:
        away = distance_from_neutral(entry, dict(c.probes[s.columns[k].probe].values))
        distance = max((abs(v) for v in away.values()), default=0.0)
        if s.sound[k] and distance > 0 and s.left[k] > 0 and s.absorbed[k] < 1.0 - 1e-6:
            points.append((distance, float(s.left[k]), k))
    if not points:
        return None
    points.sort()
    over = [p for p in points if p[1] >= threshold]
    if not over:
        if points[-1][1] < 1.0:
            return None
        distance, left, k = points[-1]
        wanted = distance * np.sqrt(threshold / left)
        if wanted > 10.0 * distance:
            return None
    else:
        distance, left, k = over[0]
        below = [p for p in points if p[0] < distance and p[1] < threshold]
        power = 2.0
        if below:
            d0, l0, _ = below[-1]
            power = max(np.log(left / max(l0, 1e-12)) / np.log(distance / d0), 0.5)
        wanted = distance * (threshold / left) ** (1.0 / power)
    return _scaled(c, s.columns[k].probe, float(wanted / distance))


def _scaled(c: CandidateEffect, probe: int, factor: float) -> FrozenMap[float]:
    entry, values = effects()[c.effect], dict(c.probes[probe].values)
    for n, q in entry.parameters.items():
        if q.neutral is None or (q.optional and values[n] == q.neutral):
            continue
        neutral = values[q.neutral] if isinstance(q.neutral, str) else float(q.neutral)
        values[n] = values[n] / factor if np.isinf(neutral) else neutral + factor * (values[n] - neutral)
    return FrozenMap(values)


def detectable(outcome: SearchOutcome, options: DiagnosisOptions) -> dict[str, Any]:
    """By candidate, the smallest size that would have been seen in the first round; None: none that was tried."""
    r = outcome.rounds[0]
    threshold, by_candidate = r.scores.threshold(options.significance), _columns(r)
    return {
        c.label: (None if (size := smallest(r, c, by_candidate.get(k, []), threshold)) is None else dict(size))
        for k, c in enumerate(r.candidates)
    }
