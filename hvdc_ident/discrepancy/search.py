"""Forward addition round by round, pairs where one masks the other, then backward deletion and swaps."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.discrepancy.adequacy import adequacy
from hvdc_ident.discrepancy.pairs import pair
from hvdc_ident.discrepancy.race import done
from hvdc_ident.discrepancy.refit import PATIENCE, Job, Placed, Refit, run
from hvdc_ident.discrepancy.rounds import Round, Search, excess, one_round
from hvdc_ident.discrepancy.select import Trial
from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.fit import Free
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.simulate.model_simulator import ModelSimulator

OTHERS = 6
"""Rivals of each effect that are tried again once the other effects are in."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Where the search ended. rounds: all of them; kept: by effect of the final model, the round that judges its rivals."""

    refit: Refit
    rounds: tuple[Round, ...]
    kept: tuple[Round, ...]


def forward(search: Search, first: Refit) -> Outcome:
    """The effects that are added one after the other, each with all others refitted, until nothing is worth adding."""
    here, rounds, kept = first, [], []
    for number in range(1, search.options.most + 1):
        found = one_round(search, here, number)
        rounds.append(found)
        if found.winner is None:
            both = pair(search, here, found) if found.significant and number < search.options.most else None
            if both is None:
                break
            rounds[-1] = both[0]
            kept += [both[0], both[1]]
            here = both[1].winner.refit if both[1].winner else here
            break
        kept.append(found)
        here = found.winner.refit
        if is_noise(here, search):
            break
    outcome = Outcome(here, tuple(rounds), tuple(kept))
    return _settled(search, first, outcome) if len(kept) > 1 else outcome


def is_noise(refit: Refit, search: Search) -> bool:
    """Whether what a model leaves is noise, by its size and over time: then there is nothing more to look for."""
    if excess(refit):
        return False
    tests = adequacy(refit.nominal(), {}, bootstraps=100, seed=search.seed)
    return all(b.p > 0.05 for b in tests)


def _settled(search: Search, first: Refit, outcome: Outcome) -> Outcome:
    """The outcome after trying each effect's rivals, and doing without it, beside the others."""
    here, kept = outcome.refit, list(outcome.kept)
    k = 0
    while k < len(kept):
        search.tell(k, len(kept), f"again with the others: {here.placed[k].candidate.label}")
        others = tuple(p for j, p in enumerate(here.placed) if j != k)
        without = _again(first, here, others)
        if without.failure:
            k += 1
            continue
        ruler = kept[k].ruler
        assert ruler is not None
        if ruler.gain(without.chi2, here.chi2, here.count - without.count) <= search.options.named_bic:
            here = without
            del kept[k]
            continue
        trials = _beside(search, first, here, kept[k], k, without)
        best = max(trials, key=lambda t: t.gain)
        here = best.refit
        kept[k] = replace(kept[k], trials=tuple(sorted(trials, key=lambda t: -t.gain)), winner=best)
        k += 1
    return Outcome(here, outcome.rounds, tuple(kept))


def _beside(search: Search, first: Refit, here: Refit, found: Round, k: int, without: Refit) -> list[Trial]:
    """The effect in place k and its rivals, each refitted with the other effects; gains over doing without."""
    assert found.ruler is not None and found.winner is not None
    own = here.placed[k]
    refits: list[tuple[Trial, Refit]] = []
    others: list[tuple[Trial, Job]] = []
    for trial in found.trials[: OTHERS + 1]:
        placed = trial.refit.placed[-1]
        if (placed.candidate.effect, placed.candidate.at, placed.candidate.source) == (
            own.candidate.effect, own.candidate.at, own.candidate.source,
        ):  # fmt: skip
            refits.append((trial, here))
            continue
        among = tuple(placed if j == k else p for j, p in enumerate(here.placed))
        with suppress(HvdcIdentError):  # it cannot sit there beside the others: no rival
            others.append((trial, job_of(first, here, among, {k: trial.refit.sizes(placed)})))
    texts = [f"again with the others: {t.refit.placed[-1].candidate.label}" for t, _ in others]
    found_again = done(search, [j for _, j in others], texts)
    refits += [(t, r) for (t, _), r in zip(others, found_again, strict=True)]
    trials = [
        # The rivals' own effect stands last in their list, as elsewhere.
        Trial(t.pick, _last(r, k), found.ruler.gain(without.chi2, r.chi2, r.count - without.count))
        for t, r in refits
        if not r.failure
    ]
    if not any(t.refit.placed[-1].candidate == own.candidate for t in trials):
        trials.append(
            Trial(
                found.winner.pick, _last(here, k), found.ruler.gain(without.chi2, here.chi2, here.count - without.count)
            )
        )
    return trials


def _last(refit: Refit, k: int) -> Refit:
    order = [*(p for j, p in enumerate(refit.placed) if j != k), refit.placed[k]]
    return replace(refit, placed=tuple(order))


def _again(
    first: Refit, here: Refit, placed: Sequence[Placed], sizes: dict[int, dict[str, float]] | None = None
) -> Refit:
    """The nominal model with these effects, refitted from where they stand."""
    try:
        return run(job_of(first, here, placed, sizes or {}))
    except HvdcIdentError as error:
        return replace(here, failure=str(error))


def job_of(first: Refit, here: Refit, placed: Sequence[Placed], sizes: dict[int, dict[str, float]]) -> Job:
    """The refit of the nominal model with these effects; sizes: of some, by their place, instead of where they stand."""
    model, free, again = first.model, list(first.problem.free), []
    at = here.values
    for k, p in enumerate(placed):
        own = sizes.get(k) or {n: at.get(name, p.start[n]) for n, name in p.names.items()}
        values = {n: float(np.clip(own.get(n, v), *p.bounds[n])) if n in p.bounds else v for n, v in p.start.items()}
        named = {n: v for n, v in p.use.parameters.items() if isinstance(v, str)}
        parameters: dict[str, float | str] = {**values, **named}
        use = EffectUse(p.use.effect, p.use.at, FrozenMap(parameters), source=p.use.source, expression=p.use.expression)
        before = set(model.parameters)
        model = model.with_effects([use])
        new = [n for n in model.parameters if n not in before]
        names = dict(zip(p.names, new, strict=True))
        free += [Free(names[n], values[n], *p.bounds[n]) for n in p.bounds]
        again.append(replace(p, use=use, names=FrozenMap(names), start=FrozenMap(values)))
    unsettled = any(effects()[p.use.effect].restless for p in placed)
    problem = replace(here.problem, simulator=ModelSimulator(model, PATIENCE), free=tuple(free), unsettled=unsettled)
    nuisance = here.theta[len(here.problem.free) :]
    gains = [at[f.name] for f in first.problem.free]
    begin = np.concatenate([gains, [f.start for f in free[len(gains) :]], nuisance])
    return Job(model, tuple(again), problem, (begin,), here.noise)
