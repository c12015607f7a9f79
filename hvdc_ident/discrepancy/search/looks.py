"""The looks of a round, one after the other: what is refitted, each beside what those before it found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from hvdc_ident.discrepancy.outside.filtered import filtered, filters
from hvdc_ident.discrepancy.outside.law import law
from hvdc_ident.discrepancy.refits.nominal import Nominal
from hvdc_ident.discrepancy.scores.scored import signature_rows
from hvdc_ident.discrepancy.search.akin import (
    as_late,
    bends,
    carried,
    elsewhere,
    is_akin,
    leaders,
    other_forms,
    with_begun,
)
from hvdc_ident.discrepancy.search.closer import Views, closer_look, views_of
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import SignatureColumn
from hvdc_ident.discrepancy.trials.context import Round, SearchContext
from hvdc_ident.discrepancy.trials.race import Race
from hvdc_ident.discrepancy.trials.refitted import (
    HEAT,
    PROMISING,
    RACE,
    all_far,
    best_each,
    by_cost,
    is_noise,
    on_bound,
    once_more,
    refitted,
    telling,
)
from hvdc_ident.discrepancy.trials.select import CandidateFit, Pick, neighbours, others, shortlist

LOOKED_AT = 80
"""Candidates, the best by score, whose signatures are compared with each other."""
WIDER = 40
"""Candidates at most that are refitted besides, where none of those picked first comes near the noise."""
TWINS = 16
"""Candidates at most that are refitted though their traces are another's."""
BETTER = 0.02
"""Share by which chi2 is less at another place where a size is looked for there too."""
CLOSE = 0.01
"""Share of what the model before leaves beyond noise that a refit may leave for a closer look to be saved."""


@dataclass(frozen=True, eq=False)
class Stand:
    """State of a round between two stages.

    opened: the round with its scores; nominal: the model before. picks: each candidate at its best size; best: those of
    the best scores. trials: the refits so far. late: the other kinds of delay that were begun.
    """

    search: SearchContext
    opened: Round
    nominal: Nominal
    number: int
    picks: tuple[Pick, ...]
    best: tuple[Pick, ...]
    trials: tuple[CandidateFit, ...] = ()
    late: tuple[Pick, ...] = ()

    def text(self, look: str) -> str:
        """Progress text of a stage."""
        return f"round {self.number}: {look}"

    def refits(self, picks: Sequence[Pick], look: str, race: Race = RACE) -> list[CandidateFit]:
        """Some picks refitted in a race with those so far."""
        return refitted(self.search, self.opened, picks, self.text(look), self.trials, race)

    def with_more(self, trials: Sequence[CandidateFit]) -> Stand:
        """The stand with further refits."""
        return replace(self, trials=(*self.trials, *trials))

    def with_best(self, trials: Sequence[CandidateFit]) -> Stand:
        """The stand with further refits, of each candidate the best."""
        return replace(self, trials=tuple(best_each([*self.trials, *trials])))

    @property
    def tried(self) -> list[int]:
        """Candidates that were refitted, or whose twins were."""
        twins = [p.candidate for same in self.opened.same.values() for p in same]
        return [*(t.pick.candidate for t in self.trials), *twins]

    @property
    def far(self) -> bool:
        """True where no refit comes near the noise."""
        return all_far(self.opened.before, self.trials)

    @property
    def anything_told(self) -> bool:
        """True where a refit takes away a share of what is beyond noise: where none does, the noise is louder than stated."""
        least = self.opened.before.chi2 - telling(self.opened.before)
        return any(not t.refit.failure and t.refit.chi2 < least for t in self.trials)


Look = Callable[[Stand], Stand]


def looked(
    search: SearchContext, opened: Round, nominal: Nominal, number: int, picks: tuple[Pick, ...]
) -> tuple[Round, tuple[CandidateFit, ...]]:
    """The round and its refits, after all the looks that are worth their time."""
    threshold = opened.scores.threshold(0.5)  # what noise reaches every other time is not worth a look
    best = tuple(p for p in picks[:LOOKED_AT] if p.score > threshold)
    stand = Stand(search, opened, nominal, number, picks, best)
    for look in ALWAYS:
        stand = look(stand)
    # Beside an effect that is there already the others cost more than they have been seen to find.
    for look in AT_FIRST if number == 1 else ():
        stand = look(stand)
        if stand.opened.law:
            return stand.opened, stand.trials
    if number > 1 or not stand.anything_told:
        return stand.opened, stand.trials
    if not stand.far:
        return stand.opened, _met_elsewhere(stand).trials
    for look in (*WHERE_FAR, *THOROUGH):
        if not stand.far or stand.opened.law:
            break
        if look in THOROUGH and not search.options.thorough:
            stand = replace(stand, opened=replace(stand.opened, spared=True))
            break
        stand = look(stand)
    return stand.opened, stand.trials


def _shortlisted(stand: Stand) -> Stand:
    """The best by score, one of each that leave the same trace."""
    opened = stand.opened
    columns = [SignatureColumn(p.candidate, p.probe) for p in stand.best]
    rows = signature_rows(stand.nominal, opened.candidates, opened.paths, columns)
    chosen, same = shortlist(stand.best, opened.candidates, rows, stand.search.options)
    stand = replace(stand, opened=replace(opened, same=same))
    return stand.with_more(stand.refits(chosen, "refits"))


def _beside(stand: Stand) -> Stand:
    """The effects and places of the two best."""
    found = stand.opened.candidates
    two = [found[t.pick.candidate] for t in by_cost(stand.trials)[:2]]
    more = neighbours(stand.best, found, stand.tried, two, max(stand.search.options.refits // 3, 2))
    return stand.with_more(stand.refits(more, "refits beside the best"))


def _twins(stand: Stand) -> Stand:
    """Those that leave the same trace as one whose refit ended on a bound.

    A trace is one of small sizes. With gains that are free the speed's feedback times k is the set-point's over k: within
    bounds only one of them may reach what is there.
    """
    held = [t.pick.candidate for t in by_cost(stand.trials) if on_bound(t.refit)]
    refitted_already = {t.pick.candidate for t in stand.trials}
    alike = [p for k in held for p in stand.opened.same.get(k, ()) if p.candidate not in refitted_already]
    return stand.with_more(stand.refits(alike[:TWINS], "refits of what looks like it"))


def _elsewhere(stand: Stand) -> Stand:
    """The best effects at other places; beside effects that are there already where one of them comes near the noise."""
    if stand.number > 1 and stand.far:
        return stand
    return stand.with_more(elsewhere(stand.search, stand.opened, stand.picks, stand.trials, stand.number))


def _other_forms(stand: Stand) -> Stand:
    """The best in another form."""
    forms = other_forms(stand.opened, stand.trials, stand.opened.before.chi2)
    return stand.with_best(stand.refits(forms, "in another form", HEAT))


def _as_late(stand: Stand) -> Stand:
    """Other kinds of delay, as late as the best; those not that were begun before."""
    kin = as_late(stand.opened, stand.trials)
    new = [p for p in kin if p not in stand.late]
    begun = with_begun(stand.search, stand.opened, stand.trials, new, stand.number)
    return replace(stand, trials=tuple(begun), late=(*stand.late, *new))


def _closer(stand: Stand) -> Stand:
    """Sizes that a closer look finds: at what is akin to the best, and everywhere else where still nothing explains the data."""
    leading = leaders(stand.opened, stand.trials)
    views = views_of(stand.opened, stand.nominal)
    stand = _looked_closer(stand, views, lambda c: is_akin(c, leading))
    if not all_far(stand.opened.before, stand.trials, CLOSE):
        return stand
    return _looked_closer(stand, views, lambda c: not is_akin(c, leading))


def _looked_closer(stand: Stand, views: Views, wanted: Callable[[CandidateEffect], bool]) -> Stand:
    """The refits of a closer look at the candidates that are wanted, of those within reach."""
    reached = stand.opened.reaches
    opened, extra = closer_look(stand.search, stand.opened, views, stand.number, lambda c: reached(c) and wanted(c))
    stand = replace(stand, opened=opened)
    return stand.with_best(stand.refits(extra, "refits of the closer look"))


def _as_a_filter(stand: Stand) -> Stand:
    """A linear filter outside the catalogue, where no refit leaves noise."""
    best = next((t.refit for t in by_cost(stand.trials)), None)
    if best is None or not stand.search.options.fallback or is_noise(best, stand.search.seed):
        return stand
    tried = filters(stand.search, stand.opened, stand.nominal)
    opened = replace(stand.opened, filters=tried)
    found = filtered(stand.search, opened, tried, best)
    return replace(stand, opened=opened if found is None else replace(opened, laws=(found,)))


def _as_a_law(stand: Stand) -> Stand:
    """A formula outside the catalogue: one that leaves next to nothing but noise spares all looks that are left."""
    if not stand.search.options.fallback:
        return stand
    found = law(stand.search, stand.opened, next((t.refit for t in by_cost(stand.trials)), None))
    return replace(stand, opened=replace(stand.opened, laws=() if found is None else (found,)))


def _the_others(stand: Stand) -> Stand:
    """A candidate for every effect and place that was not tried."""
    opened = stand.opened
    beyond = [k for k, c in enumerate(opened.candidates) if not opened.reaches(c)]
    wide = others(stand.picks, opened.scores, opened.candidates, [*stand.tried, *beyond], WIDER)
    return _as_late(stand.with_more(stand.refits(wide, "the other candidates", HEAT)))


def _from_every_size(stand: Stand) -> Stand:
    """Refits of nonlinear effects from the sizes that promise most of every one probed."""
    return stand.with_best(stand.refits(bends(stand.opened), "from every size", PROMISING))


def _once_more(stand: Stand) -> Stand:
    """Sizes that have to be met, beside the gains that refits came to; and so where the best of them is better elsewhere."""
    stand = replace(stand, trials=tuple(_again(stand, stand.trials)))
    further = _met_elsewhere(stand)
    best, before = (next(iter(by_cost(s.trials)), None) for s in (further, stand))
    if best is None or before is None or best.refit.chi2 > (1.0 - BETTER) * before.refit.chi2:
        return further
    return further.with_best(_again(further, [best]))


def _again(stand: Stand, trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    return once_more(stand.search, stand.opened, trials, stand.text("once more"))


def _met_elsewhere(stand: Stand) -> Stand:
    """The best, where its size has to be met, with that size at the other places."""
    return stand.with_best(carried(stand.search, stand.opened, stand.trials, stand.number))


ALWAYS: tuple[Look, ...] = (_shortlisted, _beside, _twins, _elsewhere, _other_forms, _as_late, _elsewhere)
AT_FIRST: tuple[Look, ...] = (_as_a_filter, _closer, _as_late)
"""In the first round."""
WHERE_FAR: tuple[Look, ...] = (_as_a_law, _from_every_size, _once_more)
"""In the first round, as long as nothing comes near the noise."""
THOROUGH: tuple[Look, ...] = (_the_others,)
"""After these, where that is asked for: of 316 hidden effects it found none that the others had not."""
