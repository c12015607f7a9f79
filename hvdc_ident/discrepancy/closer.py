"""A closer look within a round: which candidates it is worth, and the refits that it leads to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace

from hvdc_ident.discrepancy.candidates import Candidate, candidates
from hvdc_ident.discrepancy.jobs import as_given
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.response import Along
from hvdc_ident.discrepancy.scan import View, bent, joined, scan, widened
from hvdc_ident.discrepancy.scores import Path, runs
from hvdc_ident.discrepancy.select import Pick
from hvdc_ident.discrepancy.signatures import Column
from hvdc_ident.discrepancy.state import Round, Search, slot_signals
from hvdc_ident.effects import effects
from hvdc_ident.errors import SimulationError
from hvdc_ident.model.definition import Model


def closer_look(
    search: Search, opened: Round, nominal: Nominal, number: int, wanted: Callable[[Candidate], bool] = lambda _: True
) -> tuple[Round, tuple[Pick, ...]]:
    """The round with the sizes that a closer look found, and the picks to refit for them. wanted: what is looked at."""
    before, found, options = opened.before, opened.candidates, search.options
    known = {(c.effect, c.at): k for k, c in enumerate(found)}
    # Their many sizes are made for those alone that are to be looked at.
    asked = [c for c in found if effects()[c.effect].scanned and _worth_a_scan(c) and wanted(c)]
    dense = candidates(
        before.model,
        slot_signals(opened.paths, before.placed),
        [a.time for a in opened.paths.values()],
        list(dict.fromkeys(c.effect for c in asked)),
        list(dict.fromkeys(c.at for c in asked)),
        closer=True,
    )
    dense = tuple(c for c in dense if (c.effect, c.at) in known and _worth_a_scan(c))
    if all(isinstance(p, Along) for p in opened.paths.values()):
        dense += tuple(widened(c) for c in found if not c.still and bent(c))
    dense = tuple(c for c in dense if wanted(c))
    if not dense:
        return opened, ()
    text = f"round {number}: a closer look at {', '.join(dict.fromkeys(c.effect for c in dense))}"
    seen = scan(
        before,
        _views(before, nominal, opened.paths),
        dense,
        options.bootstraps,
        search.seed + number,
        search.executor,
        search.progress,
        text,
    )
    found = joined(found, [s.candidate for s in seen.spots])
    at = [known[s.candidate.effect, s.candidate.at] for s in seen.spots]
    columns = tuple(Column(k, len(found[k].probes) - 1) for k in at)
    scores = opened.scores.joined(replace(seen.scores, columns=columns, beside=seen.largest))
    picks = [
        Pick(c.candidate, c.probe, 1.0, s.score, tuple(s.theta.tolist()))
        for c, s in zip(columns, seen.spots, strict=True)
    ]
    return replace(opened, candidates=found, scores=scores), tuple(picks)


def _views(before: Refit, nominal: Nominal, paths: Mapping[str, Path]) -> list[View]:
    """The model at its optimum, and with the gains as they were given, where one has moved so far that it may stand for what
    is missing: a loop with such gains answers otherwise."""
    views, given = [View(nominal, paths)], as_given(before)
    if given is not None and isinstance(before.model, Model):
        there = replace(nominal, theta=given)
        with suppress(SimulationError):  # with the gains as given it need not run
            views.append(View(there, runs(before.model, there)))
    return views


def _worth_a_scan(candidate: Candidate) -> bool:
    """Whether many sizes are looked at: at one slot that moves."""
    return len(candidate.at) == 1 and not candidate.still
