"""A closer look within a round: which candidates it is worth, and the refits that it leads to."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache

from hvdc_ident.discrepancy.refits.nominal import Nominal
from hvdc_ident.discrepancy.refits.refit import Refit
from hvdc_ident.discrepancy.scores.dense import bent, every_size, widened
from hvdc_ident.discrepancy.scores.scan import View, scan
from hvdc_ident.discrepancy.scores.scored import Path, runs
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import SignatureColumn
from hvdc_ident.discrepancy.signatures.response import Along
from hvdc_ident.discrepancy.trials.context import Round, SearchContext, slot_signals
from hvdc_ident.discrepancy.trials.refit_jobs import as_given
from hvdc_ident.discrepancy.trials.select import Pick
from hvdc_ident.effects import SignalScales, effects
from hvdc_ident.errors import SimulationError
from hvdc_ident.model import Model

Views = Callable[[], Sequence[View]]
"""The models that are looked at, worked out when they are asked for first."""


def closer_look(
    search: SearchContext,
    opened: Round,
    views: Views,
    number: int,
    wanted: Callable[[CandidateEffect], bool] = lambda _: True,
) -> tuple[Round, tuple[Pick, ...]]:
    """The round with the sizes that a closer look found, and the picks to refit for them. wanted: what is looked at."""
    before, found, options = opened.before, opened.candidates, search.options
    asked = [c for c in found if effects()[c.effect].needs_grid and _worth_a_scan(c) and wanted(c)]
    times = [a.time for a in opened.paths.values()]
    signals = slot_signals(before.model, opened.paths, before.placed)
    dense = [every_size(c, SignalScales.of(times, signals[c.at[0]])) for c in asked]
    if all(isinstance(p, Along) for p in opened.paths.values()):
        dense += [widened(c) for c in found if not c.still and bent(c) and wanted(c)]
    if not dense:
        return opened, ()
    text = f"round {number}: a closer look at {', '.join(dict.fromkeys(d.candidate.effect for d in dense))}"
    seen = scan(
        before,
        views(),
        dense,
        options.bootstraps,
        search.seed + number,
        search.executor,
        search.progress,
        text,
    )
    better = [s.dense.alone(0) for s in seen.spots]
    found = _joined(found, better)
    known = {_key(c): k for k, c in enumerate(found)}
    at = [known[_key(c)] for c in better]
    columns = tuple(SignatureColumn(k, len(found[k].probes) - 1) for k in at)
    scores = opened.scores.joined(replace(seen.scores, columns=columns, beside=seen.largest))
    picks = [
        Pick(c.candidate, c.probe, 1.0, s.score, tuple(s.theta.tolist()))
        for c, s in zip(columns, seen.spots, strict=True)
    ]
    return replace(opened, candidates=found, scores=scores), tuple(picks)


def views_of(opened: Round, nominal: Nominal) -> Views:
    """The views of a round's closer looks."""
    return cache(lambda: _views(opened.before, nominal, opened.paths))


def _views(before: Refit, nominal: Nominal, paths: Mapping[str, Path]) -> list[View]:
    """The model at its optimum, and with the gains as they were given, where one has moved so far that it may stand for what
    is missing: a loop with such gains answers otherwise."""
    views, given = [View(nominal, paths)], as_given(before)
    if given is not None and isinstance(before.model, Model):
        there = replace(nominal, theta=given)
        with suppress(SimulationError):  # with the gains as given it need not run
            views.append(View(there, runs(before.model, there)))
    return views


def _joined(found: Sequence[CandidateEffect], better: Sequence[CandidateEffect]) -> tuple[CandidateEffect, ...]:
    """The candidates, with the sizes that a scan found after their own."""
    more = {_key(c): c.probes for c in better}
    return tuple(replace(c, probes=(*c.probes, *more.get(_key(c), ()))) for c in found)


def _key(candidate: CandidateEffect) -> Hashable:
    return candidate.effect, candidate.at, candidate.named


def _worth_a_scan(candidate: CandidateEffect) -> bool:
    """Return True where many sizes are scored: at one slot that moves."""
    return len(candidate.at) == 1 and not candidate.still
