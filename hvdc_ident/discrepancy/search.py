"""Forward addition round by round, and pairs where one masks the other."""

from __future__ import annotations

from dataclasses import dataclass

from hvdc_ident.discrepancy.adequacy import adequacy
from hvdc_ident.discrepancy.pairs import pair
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.rounds import Round, Search, excess, one_round
from hvdc_ident.discrepancy.settle import settled


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
    if len(kept) > 1:
        here, kept = settled(search, first, here, kept, len(rounds))
    return Outcome(here, tuple(rounds), tuple(kept))


def is_noise(refit: Refit, search: Search) -> bool:
    """Whether what a model leaves is noise, by its size and over time: then there is nothing more to look for."""
    if excess(refit):
        return False
    tests = adequacy(refit.nominal(), {}, bootstraps=100, seed=search.seed)
    return all(b.p > 0.05 for b in tests)
