"""Refits of the small drive of `cases`, to begin tests of the search from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident import Experiment, Model, simulate
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.expansion import Expansion, by_cost
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, judged, refit_job
from hvdc_ident.discrepancy.moves import MOVES
from hvdc_ident.discrepancy.nominal import nominal
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.search import Search, SearchOutcome
from hvdc_ident.effects import Probe
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator
from tests.discrepancy.cases import FREE, SIGMA, TRUE, model


def plain(records: Sequence[Experiment]) -> Refit:
    """The drive without any effect, refitted to the records."""
    start, _ = nominal(ModelSimulator(model()), records, FREE, {}, None, starts=1, seed=0, executor=None)
    return judged(Refit(model(), (), start.problem, start.noise, start.theta))


def answered(drive: Model, records: Sequence[Experiment], seed: int) -> tuple[Experiment, ...]:
    """The experiments with what some drive, a changed one say, answers to them, and white noise."""
    random, found = np.random.default_rng(seed), []
    for e in records:
        clean = simulate(drive, e, TRUE, outputs=tuple(SIGMA)).trajectory
        noisy = clean.values + random.standard_normal(clean.values.shape) * list(SIGMA.values())
        found.append(replace(e, measured=replace(clean, values=noisy)))
    return tuple(found)


def beside(
    before: Refit,
    effect: str,
    at: str,
    values: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    source: str = "",
) -> RefitJob:
    """The refit of a model with one more effect, from a size; what has no bounds stays."""
    probe = Probe(effect, FrozenMap(values), FrozenMap(bounds))
    candidate = CandidateEffect(effect, (at,), (probe,), source=source)
    return refit_job(before, candidate, 0, 1.0, before.theta)


def search_from(context: SearchContext, first: Refit) -> SearchOutcome:
    """Where a search with every move ends."""
    return Search(context, first, MOVES).run()


def expanded(context: SearchContext, first: Refit) -> Expansion:
    """What every move that looks for effects of the catalogue finds beside a model, with the trials that came to an end, the best first."""
    search = Search(context, first, MOVES)
    for move in MOVES:
        if move.name not in ("values", "clocks", "cards", "forms in the stead", "forms", "as given"):
            search.add(move.make(search, search.root))
    found = search.expansions[search.root.key]
    return replace(found, trials=tuple(by_cost(found.trials)))
