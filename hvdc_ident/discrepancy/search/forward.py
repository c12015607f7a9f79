"""Forward addition round by round, and pairs where one masks the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

from hvdc_ident.discrepancy.refits.refit import Refit, judged
from hvdc_ident.discrepancy.search.pairs import pair
from hvdc_ident.discrepancy.search.rounds import one_round
from hvdc_ident.discrepancy.search.settle import settled
from hvdc_ident.discrepancy.trials.context import Round, SearchContext
from hvdc_ident.discrepancy.trials.refit_jobs import as_given
from hvdc_ident.discrepancy.trials.refitted import is_far, is_noise
from hvdc_ident.discrepancy.trials.select import Ruler
from hvdc_ident.errors import SimulationError


@dataclass(frozen=True, eq=False)
class SearchOutcome:
    """Where the search ended.

    rounds: all of them; kept: by effect of the final model, the round that judges its rivals; notes: what could not be done.
    """

    refit: Refit
    rounds: tuple[Round, ...]
    kept: tuple[Round, ...]
    notes: tuple[str, ...] = ()


def from_either_side(search: SearchContext, first: Refit) -> SearchOutcome:
    """The search from the refitted gains; where that leaves more than noise, from the given ones if it then ends nearer.

    Gains that have moved far to make up for what is missing may leave no room for it: beside them a lag of its true size is
    unstable, and no score tells of it. first: the nominal model, refitted.
    """
    outcome = forward(search, first)
    theta = as_given(first)
    if theta is None or not is_far(first, outcome.refit):
        return outcome
    search.tell(0, 1, "once more, from the given values")
    try:
        again = forward(search, judged(replace(first, theta=theta)))
    except SimulationError as error:
        return replace(outcome, notes=(*outcome.notes, f"from the given values nothing was looked for: {error}"))
    ruler = Ruler.of(min(outcome.refit, again.refit, key=lambda r: r.chi2))
    more = again.refit.count - outcome.refit.count
    nearer = bool(again.kept) and ruler.gain(outcome.refit.chi2, again.refit.chi2, more) > search.options.named_bic
    return again if nearer else outcome


def forward(search: SearchContext, first: Refit) -> SearchOutcome:
    """The effects that are added one after the other, each with all others refitted, until nothing is worth adding."""
    rounds: list[Round] = []
    kept: list[Round] = []
    here = first
    notes: tuple[str, ...] = ()
    for number in range(1, search.options.most + 1):
        if kept:
            rounds[-1] = kept[-1] = kept[-1].light()
        try:
            found = one_round(search, here, number)
        except SimulationError as error:
            if number == 1:
                raise
            notes = (f"nothing was looked for beside {here.placed[-1].candidate.label}: {error}",)
            break
        rounds.append(found)
        if found.winner is None:
            hopeful = found.significant and found.law is None and number < search.options.most
            both = pair(search, here, found) if hopeful else None
            if both is None:
                break
            rounds[-1] = both[0]
            kept += [both[0], both[1]]
            here = both[1].winner.refit if both[1].winner else here
            break
        kept.append(found)
        here = found.winner.refit
        if is_noise(here, search.seed):
            break
    if len(kept) > 1:
        here, kept, more = settled(search, first, here, kept, len(rounds))
        notes += more
    return SearchOutcome(here, tuple(rounds), tuple(kept), notes)
