"""The search: a queue of hypotheses and moves, the best first by one score.

A hypothesis is the nominal model with terms: effects at places, stated values set free, another component, clocks that are off. A move
makes of a hypothesis others with one term more; doing without a term, or with another one in its stead, is a move of the hypothesis
without it.
The best hypothesis so far is the answer at every instant. The search ends when no hypothesis that is still open can come near the best,
or when the budget is over.

The score is minus twice the log evidence, up to a constant: chi2 of the fitted and of the held-out records in units of what the best
hypothesis leaves, the logarithm of the independent rows for each free parameter, and minus twice the log prior of the terms. Slight errors
of what is stated go with every hypothesis (`stated`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import leaks
from hvdc_ident.discrepancy.clocks import clocks, on_their_clocks
from hvdc_ident.discrepancy.effect_moves import (
    beside_leaders,
    best_from_given,
    from_given,
    opened,
    outside,
    raced,
    searched_sizes,
)
from hvdc_ident.discrepancy.expansion import Expansion, ExpansionModel, FoundForm, Race, refits_of, with_candidate
from hvdc_ident.discrepancy.hypothesis import (
    FAILURES,
    Refit,
    RefitJob,
    built_in,
    joint_refit_job,
    last_placed,
    refit_again,
    slot_signals,
)
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.nominal import noise_left
from hvdc_ident.discrepancy.options import REFUTED, SearchContext
from hvdc_ident.discrepancy.result import CARD, VALUE
from hvdc_ident.discrepancy.score import (
    TIED,
    CandidateFit,
    Pick,
    Ruler,
    implied,
    nearest,
    objections,
    off_given,
    with_gain,
)
from hvdc_ident.discrepancy.screen import Score, Screen
from hvdc_ident.discrepancy.stated import Errors, SlightErrors, differences, stated, with_free, with_held
from hvdc_ident.effects import effects
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.noise import SURE
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import is_white_box, recording
from hvdc_ident.plants.exchange import CardChange, exchanges
from hvdc_ident.simulate import ModelSimulator

P_VALUE, P_EFFECT, P_CARD, P_CLOCKS = 0.45, 0.45, 0.1, 0.25
"""Prior probability that a stated value is wrong, that an effect is missing, that a card is of another type, each in the stead of the
others, and that the clocks are off, beside them."""
SET = 6.0
"""In the score: within it a hypothesis stands beside the best."""
EXCHANGED = 4
"""Moves, the cheapest, by which something is looked for in the stead of a term."""
CARD_LAPS = (8, 12)
"""Evaluations of the laps of a race of cards: with six values free beside the others they come near their ends in so many."""
CLOCKS = "clocks"
"""Kind of the term that the clocks of records are off."""
NO_PICK = Pick(-1, 0, 1.0, 0.0)
"""Of a term that is no candidate of a screen."""
NO_SCREEN = Screen((), {}, {}, np.zeros(0), {})
"""Where no effects were looked for."""
BEAM = 3
"""Hypotheses of one number of terms, of different kinds, that are opened."""
VALUES = 8
"""Values that are refitted at a time, those that promise most."""
ELSEWHERE = (0.2, 0.35, 0.6, 1.6, 3.0)
"""Shares of a stated value without a trace at which it is run."""
LEAST_INDEPENDENT_POWER = 1e-6
"""Share of a squared derivative that the free parameters have to leave for a value to be determined."""


@dataclass(frozen=True)
class Term:
    """A part of a hypothesis that the nominal model has not.

    kind: an effect of the catalogue, `VALUE`, `CARD` or `CLOCKS`; at: its places, the value's name, the component, or the records whose
    clocks are off; source: the signal that an effect brings in, or the card. prior: its probability before any data.
    """

    kind: str
    at: tuple[str, ...] = ()
    source: str = ""
    prior: float = field(default=1.0, compare=False)

    @property
    def is_effect(self) -> bool:
        """True for an effect that stands in the model."""
        return self.kind not in (VALUE, CARD, CLOCKS)

    @property
    def is_form(self) -> bool:
        """True for a form outside the catalogue, which no name stands for."""
        return self.is_effect and bool(effects()[self.kind].outside)

    @property
    def label(self) -> str:
        """The term in tables."""
        return f"{self.kind} at {', '.join(self.at)}" + (f" from {self.source}" if self.source else "")


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """The nominal model with some terms, refitted.

    refit: judged. base: the nominal model that its effects are put on: with the values that are free, on the records as they are timed.
    before: the refit without the last effect, where that one is still a movable one.
    """

    refit: Refit
    base: Refit
    terms: tuple[Term, ...] = ()
    before: Refit | None = None

    @cached_property
    def key(self) -> frozenset[Term]:
        """The terms, whatever their order."""
        return frozenset(self.terms)

    @property
    def kind(self) -> str:
        """Kind of the last term; empty where there is none."""
        return self.terms[-1].kind if self.terms else ""

    @property
    def values(self) -> tuple[str, ...]:
        """Names of the stated values that are free."""
        return tuple(t.at[0] for t in self.terms if t.kind == VALUE)

    @property
    def prior_cost(self) -> float:
        """Minus twice the logarithm of the prior probability of the terms."""
        return -2.0 * sum(math.log(t.prior) for t in self.terms)

    def without(self, term: Term) -> frozenset[Term]:
        """The key of the hypothesis without one of its terms."""
        return self.key - {term}


@dataclass(frozen=True, eq=False)
class Kept:
    """A term of the best hypothesis, and what was looked for in its stead beside the others.

    expansion: of the hypothesis without it, its trials the best first, with the term's own as the winner where it is an effect. others:
    the stated values and cards that were tried in its stead, with their refits.
    """

    term: Term
    expansion: Expansion
    others: tuple[tuple[Term, CandidateFit], ...] = ()


@dataclass(frozen=True, eq=False)
class SearchOutcome:
    """Where the search ended.

    best: the hypothesis that is the answer, its effects in the model; kept: by term of it, clocks aside. pool: every hypothesis, the best
    first, with its score less that of the model without terms. expansions: what was looked for beside which hypothesis, the first
    first. form: outside the catalogue, where that is better than the answer and stands its tests. objection: why a better one is not
    the answer; empty where the best is. exhausted: whether nothing that was open could have come near; notes: what could not be done, or
    was not.
    """

    best: Hypothesis
    kept: tuple[Kept, ...]
    pool: tuple[tuple[Hypothesis, float], ...]
    expansions: tuple[Expansion, ...]
    slight: Errors
    form: FoundForm | None = None
    objection: str = ""
    exhausted: bool = True
    notes: tuple[str, ...] = ()

    @property
    def explained_by_errors(self) -> bool:
        """True where slight errors of what is stated explain what the best hypothesis leaves, and it is no noise without them."""
        misfit = misfit_of(self.refit)
        power = (self.refit.chi2 - self.slight.fall_fitted) / self.refit.rows
        return not misfit.is_noise and power <= misfit.floor * (1.0 + SURE * misfit.power_error)

    @property
    def refit(self) -> Refit:
        """The best hypothesis, refitted."""
        return self.best.refit


@dataclass(frozen=True)
class Move:
    """What makes of a hypothesis others. rank: when its turn is, beside the same of a hypothesis with a term less or more. of_root:
    whether it is one of the model without terms alone."""

    name: str
    rank: int
    make: Callable[[Search, Hypothesis], list[Hypothesis]]
    of_root: bool = False


TERM_RANK = 3
"""Ranks by which the moves of a hypothesis come after those of one with a term less."""


class Search:
    """A search at work: its hypotheses, and what has been looked for beside which of them."""

    def __init__(self, context: SearchContext, first: Refit) -> None:
        self.context = context
        self.root = Hypothesis(first, first)
        self.slight = {id(first.problem.experiments): SlightErrors.of(first, context.stated)}
        self.floor = noise_left(first.nominal())
        self.pool: dict[frozenset[Term], Hypothesis] = {}
        self.models: dict[frozenset[Term], ExpansionModel] = {}
        self.expansions: dict[frozenset[Term], Expansion] = {}
        self.done: set[tuple[frozenset[Term], str]] = set()
        self.errors: dict[frozenset[Term], tuple[Refit, Errors]] = {}
        self.noisy: dict[frozenset[Term], tuple[Refit, bool]] = {}
        self.notes: list[str] = []
        self.add([self.root])

    # --- the score ---

    @property
    def ruler(self) -> Ruler:
        """What scores are counted by: what the best hypothesis leaves, by chi2."""
        best = min(self.pool.values(), key=lambda h: h.refit.chi2 / h.refit.rows)
        errors = self.errors_under(best)
        if errors.total is None:
            return Ruler.of(best.refit)
        return Ruler.of(replace(best.refit, chi2=best.refit.chi2 - errors.fall_fitted, correlation=errors.correlation))

    def errors_under(self, h: Hypothesis) -> Errors:
        """The likeliest slight errors under a hypothesis."""
        known = self.errors.get(h.key)
        if known is None or known[0] is not h.refit:
            records = h.base.problem.experiments
            if id(records) not in self.slight:
                self.slight[id(records)] = SlightErrors.of(h.base, self.context.stated)
            slight = self.slight[id(records)]
            for card in (t for t in h.terms if t.kind == CARD):
                slight = slight.without(card.at[0])
            known = h.refit, slight.under(h.refit)
            self.errors[h.key] = known
        return known[1]

    def cost(self, h: Hypothesis, ruler: Ruler, *, rough: bool = False) -> float:
        """The score of a hypothesis: less is better. rough: without slight errors."""
        r = h.refit
        known = None if rough else self.errors_under(h).total
        chi2 = _chi2(r) if known is None else known
        if known is not None and r.holdout is None and r.predicted is not None:
            # Parts of the fitted records, predicted from the rest: errors explain as much of these.
            chi2 += r.predicted**2 * r.unseen_rows * known / r.chi2
        # The row that leaves a record with a late clock takes its share of the noise along.
        chi2 += r.chi2 * (self.root.refit.rows / r.rows - 1.0)
        count = len(r.problem.names) + sum(len(t.at) for t in h.terms if t.kind == CLOCKS)
        return ruler.share * chi2 + ruler.price * count + h.prior_cost

    def ranked(self) -> list[Hypothesis]:
        """Every hypothesis, the best first; of those far behind without slight errors."""
        ruler = self.ruler
        rough = sorted(self.pool.values(), key=lambda h: self.cost(h, ruler, rough=True))
        # Slight errors take off the most where nothing else explains the records: by so much the first order may be wrong.
        most = max(self.cost(self.root, ruler, rough=True) - self.cost(self.root, ruler), 0.0)
        limit = min(self.cost(h, ruler) for h in rough[:3]) + most + SET
        near = [h for h in rough if self.cost(h, ruler, rough=True) <= limit]
        return [*sorted(near, key=lambda h: self.cost(h, ruler)), *rough[len(near) :]]

    def is_noise(self, h: Hypothesis) -> bool:
        """Return True where a hypothesis leaves noise alone, by its size and over time, beside slight errors."""
        known = self.noisy.get(h.key)
        if known is None or known[0] is not h.refit:
            known = h.refit, self._is_noise(h)
            self.noisy[h.key] = known
        return known[1]

    def _is_noise(self, h: Hypothesis) -> bool:
        r, misfit = h.refit, misfit_of(h.refit)
        power = (r.chi2 - self.errors_under(h).fall_fitted) / r.rows
        small = power <= self.floor * (1.0 + SURE * misfit.power_error)
        return misfit.is_noise or (small and not misfit.has_shape)

    # --- the pool ---

    def add(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Put hypotheses into the pool; of those with the same terms the one that leaves least stays, and of those that leave as much
        the one whose values are nearest to the given ones."""
        for h in hypotheses:
            if h.refit.failure:
                continue
            had = self.pool.get(h.key)
            if had is None:
                self.pool[h.key] = h
                continue
            more = h.refit.chi2 - had.refit.chi2
            if more < -TIED or (more <= TIED and off_given(h.refit) < off_given(had.refit)):
                self.pool[h.key] = h

    def ready(self, h: Hypothesis) -> Hypothesis:
        """Return a hypothesis whose effects are in the model; one that cannot be is returned with its failure."""
        if h.before is None:
            return h
        built = replace(h, refit=built_in(h.before, h.refit), before=None)
        if not built.refit.failure:
            self.pool[h.key] = built
        return built

    def left(self, h: Hypothesis) -> float:
        """Return how many times the noise a hypothesis leaves."""
        return math.sqrt(max(h.refit.chi2 - self.errors_under(h).fall_fitted, 0.0) / h.refit.rows)

    # --- the queue ---

    def run(self) -> SearchOutcome:
        """Return where the search ends."""
        exhausted = False
        while not self.context.spent:
            todo = self._next()
            if todo is None:
                exhausted = True
                break
            h, move = todo
            self.done.add((h.key, move.name))
            try:
                self.add(move.make(self, h))
            except FAILURES as error:
                if not self.expansions and move.name == "effects":
                    raise
                self.notes.append(f"nothing was looked for beside {_labels(h) or 'the model'} ({move.name}): {error}")
            best = self.ranked()[0]
            self.context.lead(_labels(best), self.left(best))
        return self._outcome(exhausted)

    def _next(self) -> tuple[Hypothesis, Move] | None:
        """The next hypothesis and move; None where nothing open can come near the best."""
        ranked, ruler = self.ranked(), self.ruler
        best = ranked[0]
        satisfied = self.is_noise(best)
        order: list[tuple[int, int, Hypothesis, Move]] = []
        # Beside a form that explains the records nothing is looked for in pairs.
        ends = bool(ranked[0].terms) and ranked[0].terms[-1].is_form and bool(self._standing_forms())
        for n, h in enumerate(self._beam(ranked)):
            more = len(h.terms) + 1
            if more > (1 if ends else self.context.options.most) or not self._may_win(h, best, ruler):
                continue
            for move in MOVES:
                if (h.key, move.name) in self.done:
                    continue
                # A hypothesis that leaves noise is not bettered by more of its own kind: only what is cheap is still asked.
                if (move.of_root and h.terms) or (move.name == "outside" and not self.context.options.fallback):
                    continue
                if satisfied and (more > max(len(best.terms), 1) or move.rank > 1):
                    continue
                order.append((move.rank + TERM_RANK * len(h.terms), n, h, move))
        if not order:
            return None
        _, _, h, move = min(order, key=lambda o: o[:2])
        return h, move

    def _beam(self, ranked: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The best of each kind by number of terms: a pair whose members fail alone is reached from any of the first."""
        kept: list[Hypothesis] = []
        count: Counter[object] = Counter()
        for h in ranked:
            size = len(h.terms)
            if any(t.is_form for t in h.terms):
                continue
            if count[size] < BEAM and count[h.kind, size] < 1:
                count[size] += 1
                count[h.kind, size] += 1
                kept.append(h)
        return kept

    def _may_win(self, h: Hypothesis, best: Hypothesis, ruler: Ruler) -> bool:
        """Return True where the likeliest term more, leaving nothing but noise, could come near the best."""
        if h is best and self.is_noise(best) and h.terms:
            return False
        r = h.refit
        every = r.rows + (0 if r.predicted is None else r.unseen_rows)
        # Noise may be so much less than it was taken for, and than what the best leaves.
        rows = min(
            every, (self.cost(best, ruler) - self.cost(best, ruler, rough=True)) / ruler.share + _chi2(best.refit)
        )
        rows -= SURE * math.sqrt(2.0 * every)
        ideal = ruler.share * rows + ruler.price * (len(r.problem.names) + 1) + h.prior_cost - 2.0 * math.log(P_VALUE)
        return ideal < self.cost(best, ruler) + SET

    def _answer(self) -> tuple[Hypothesis, str]:
        """The best hypothesis to whose terms nothing objects, ready, and what spoke against the best of those before it."""
        against = ""
        for h in self.ranked():
            if h.key == self.root.key:
                break
            if any(t.is_form for t in h.terms):  # it has no name: told as what it is
                continue
            why = self._objection(h)
            if not why:
                built = self.ready(self._preferred(h))
                why = built.refit.failure
                if not why:
                    return built, against
            against = against or f"{_labels(h)}: {why}"
        return self.root, against

    def _preferred(self, best: Hypothesis) -> Hypothesis:
        """Of the hypotheses that are as likely as the best and differ in one term the one whose values are nearest to the given ones,
        where they are others; and of those that explain as much there the one whose name suits the signals.

        Reactive power that acts on a voltage is a droop, and no conductance.
        """
        ruler = self.ruler
        own = self.cost(best, ruler)
        tied = [
            h
            for h in tuple(self.pool.values())  # what speaks against one may add others
            if len(h.key) == len(best.key)
            and len(h.key - best.key) == 1
            and abs(self.cost(h, ruler, rough=True) - self.cost(best, ruler, rough=True)) <= ruler.effective
            and abs(self.cost(h, ruler) - own) <= TIED
            and not any(t.is_form for t in h.terms)
            and not self._objection(h)
        ]
        best = nearest(best, tied, lambda h: implied(h.refit), lambda h: off_given(h.refit))
        last = best.terms[-1]
        if last.kind != "conductance" or all(leaks(best.refit.model, last.at, s) for s in last.source.split(",")):
            return best
        like = [h for h in tied if h.terms[-1].kind in ("droop", "coupling")]
        there = [h for h in like if (h.terms[-1].at, h.terms[-1].source) == (last.at, last.source)]
        return next(iter(there), best)

    def _objection(self, h: Hypothesis) -> str:
        """Return in words an objection to one of the terms of a hypothesis; empty where there is none."""
        ruler, options = self.ruler, self.context.options
        effect = 0
        for t in h.terms:
            less = self._without(h, t)
            if less is None:
                continue
            if t.kind == CLOCKS:
                continue
            if not t.is_effect:
                if self.cost(less, ruler) - self.cost(h, ruler) <= SET:
                    return "it explains no more than its probability takes away"
                continue
            trial = CandidateFit(NO_PICK, last_placed(h.refit, effect), ruler.between(less.refit, h.refit))
            known = self.expansions.get(less.key) or self.expansions.get(self.root.key)
            p = 1.0 if known is None else known.screen.p(less.refit.chi2 - h.refit.chi2)
            first = less.key == self.root.key
            if why := objections(less.refit, trial, p, options, self.context.tolerance, first=first):
                return why
            effect += 1
        return ""

    def _without(self, h: Hypothesis, term: Term) -> Hypothesis | None:
        """The hypothesis with one term less, refitted where it is not in the pool; None where it cannot be had."""
        key = h.without(term)
        if key in self.pool:
            return self.pool[key]
        if term.kind == CLOCKS or (h.before is not None and not (h := self.ready(h)).refit.placed):
            return None
        base = h.base
        if term.kind == CARD:
            base = self.root.base
        if term.kind == VALUE:
            (f,) = (f for f in (*self.context.held, *self.context.stated) if f.name == term.at[0])
            base = with_held(base, f)
        own = [t for t in h.terms if t.is_effect]
        placed = [p for t, p in zip(own, h.refit.placed, strict=True) if t != term]
        refit = refit_again(base, h.refit, placed)
        if refit.failure:
            return None
        less = Hypothesis(refit, base, tuple(t for t in h.terms if t != term))
        self.add([less])
        return self.pool[less.key]

    def _exchanged(self) -> None:
        """Look for something else in the stead of each term of the best hypothesis of several, until nothing else is better."""
        for _ in range(self.context.options.most):
            best, _ = self._answer()
            if len(best.terms) < 2:
                return
            for t in best.terms:
                less = self._without(best, t)
                if less is None or self.context.spent:
                    continue
                for move in (m for m in MOVES[:EXCHANGED] if not m.of_root):
                    if (less.key, move.name) not in self.done and not self.context.spent:
                        self.done.add((less.key, move.name))
                        with suppress(*FAILURES):  # it cannot be run without the term: nothing stands in its stead
                            self.add(move.make(self, less))
            if self._answer()[0].key == best.key:
                return

    def _outcome(self, exhausted: bool) -> SearchOutcome:
        if exhausted:
            self._exchanged()
        best, against = self._answer()
        ranked, ruler = self.ranked(), self.ruler
        none = self.cost(self.root, ruler)
        return SearchOutcome(
            best,
            tuple(self._kept(best, t, ruler) for t in best.terms if t.kind != CLOCKS),
            tuple((h, self.cost(h, ruler, rough=n >= 2 * VALUES) - none) for n, h in enumerate(ranked)),
            tuple(self.expansions.values()),
            self.errors_under(best),
            self._form(best, ruler),
            against,
            exhausted,
            tuple(self.notes),
        )

    def _form(self, best: Hypothesis, ruler: Ruler) -> FoundForm | None:
        """The form outside the catalogue that is better than the answer by more than chance; None where none is."""
        forms = [h for h in self._standing_forms() if not self._objection(h)]
        ahead = [h for h in forms if self.cost(best, ruler) - self.cost(h, ruler) > SET]
        if not ahead:
            return None
        first, cost = ahead[0], self.cost(ahead[0], ruler)
        near = tuple(h.refit for h in ahead[1:] if self.cost(h, ruler) - cost <= SET)
        before = self.expansions[self.root.key].before
        return FoundForm(before, first.refit, ruler.between(before, first.refit), near)

    def _standing_forms(self) -> list[Hypothesis]:
        """Forms outside the catalogue that what they leave does not refute, the best first."""
        most = REFUTED * misfit_of(self.root.refit).beyond
        alone = [h for h in self.ranked() if len(h.terms) == 1 and h.terms[0].is_form]
        return [h for h in alone if misfit_of(h.refit).beyond <= most]

    def _kept(self, best: Hypothesis, term: Term, ruler: Ruler) -> Kept:
        """Return a term of the best hypothesis with what was looked for in its stead."""
        less = self._without(best, term) or self.root
        known = self.expansions.get(less.key)
        before = less.refit if known is None else known.before
        own: CandidateFit | None = None
        found: list[CandidateFit] = []
        failed: tuple[CandidateFit, ...] = ()
        if known is not None:
            found = [with_gain(t, before, ruler) for t in known.trials if not t.refit.failure]
            failed = tuple(t for t in known.trials if t.refit.failure)
        expansion = known or Expansion(before, slot_signals(before), (), NO_SCREEN)
        if term.is_effect:
            effects_of_best = [t for t in best.terms if t.is_effect]
            refit = last_placed(best.refit, effects_of_best.index(term))
            expansion, number = with_candidate(expansion, refit.placed[-1].candidate)
            mine = next((t for t in found if t.pick.candidate == number), None)
            pick = Pick(number, 0, 1.0, 0.0) if mine is None else mine.pick
            own = with_gain(CandidateFit(pick, refit, 0.0), before, ruler)
            found = [own, *(t for t in found if t.pick.candidate != number)]
        ranked = tuple(sorted(found, key=lambda t: -t.total_gain))
        expansion = replace(expansion, trials=ranked, failed=failed, winner=own, ruler=ruler)
        others = []
        for h in self.pool.values():
            more = h.key - less.key
            if len(more) != 1 or not less.key < h.key:
                continue
            (other,) = more
            if not other.is_effect and other.kind != CLOCKS:
                trial = CandidateFit(NO_PICK, best.refit if h.key == best.key else h.refit, 0.0)
                others.append((other, with_gain(trial, before, ruler)))
        return Kept(term, expansion, tuple(others))


def _chi2(refit: Refit) -> float:
    """Return chi2 of the fitted records and the score of the others."""
    return refit.chi2 + (0.0 if refit.predicted is None else refit.predicted**2 * refit.unseen_rows)


def _labels(h: Hypothesis) -> str:
    return " and ".join(t.label for t in h.terms)


# --- moves ---


def _values(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one stated value more set free: those with which chi2 falls most, to first order, or at another value where none
    shows at the stated one."""
    context, h = search.context, search.ready(h)
    if h.refit.failure:
        return []
    here, share = h.refit, P_VALUE / max(len(context.stated), 1)
    priors = {f.name: P_VALUE for f in context.held} | {f.name: share for f in context.stated}
    known = h.base.model.parameters.keys() - here.problem.names
    open_to = [f for f in (*context.held, *context.stated) if f.name in known]
    worth, starts = _worth(here, open_to, [-2.0 * math.log(priors[f.name]) for f in open_to])
    chosen = [k for k in np.argsort(-worth, kind="stable")[:VALUES] if worth[k] > 0.0]
    wider = [with_free(h.base, open_to[k]) for k in chosen]
    jobs = []
    for k, w in zip(chosen, wider, strict=True):
        job = joint_refit_job(w, here, here.placed, {})
        (begin,) = job.begins
        begin[job.problem.names.index(open_to[k].name)] = starts[k]
        jobs.append(replace(job, begins=(begin,)))
    refits = refits_of(context, jobs, [f"with {open_to[k].name} free" for k in chosen])
    return [
        Hypothesis(r, w, (*h.terms, Term(VALUE, (open_to[k].name,), prior=priors[open_to[k].name])))
        for k, r, w in zip(chosen, refits, wider, strict=True)
        if not r.failure and not open_to[k].on_bound(r.values[open_to[k].name])
    ]


def _worth(here: Refit, values: Sequence[FitParameter], prices: Sequence[float]) -> tuple[Array, list[float]]:
    """Return (m,) by how much chi2 falls with each held value set free, to first order and less its price, and where its refit begins.

    Of a value without a trace, such as a level that no signal reaches, the best of a few others is taken. prices: of the values' priors.
    """
    at = [here.values.get(f.name, f.given) for f in values]
    if not values:
        return np.zeros(0), at
    nominal = here.nominal()
    whole = differences(here.problem, here.theta, {f.name: v for f, v in zip(values, at, strict=True)})
    columns = nominal.projected(whole)
    power = np.sum(columns**2, axis=0)
    shown = power > LEAST_INDEPENDENT_POWER * np.sum(whole**2, axis=0)
    falls = np.where(shown, (columns.T @ nominal.residual) ** 2 / np.where(shown, power, 1.0), 0.0)
    for k in np.flatnonzero(~whole.any(axis=0)).tolist():
        for value in (v for share in ELSEWHERE if values[k].min < (v := share * at[k]) < values[k].max):
            with suppress(SimulationError):  # it does not run there
                moved = here.problem.residuals(here.problem.misfits(here.theta, {values[k].name: value})[:, None])
                left = nominal.projected(moved)[:, 0]
                fall = float(nominal.residual @ nominal.residual - left @ left)
                if fall > falls[k]:
                    falls[k], at[k] = fall, value
    # In chi2 of the noise: of a misfit its own size is no measure of what may be left.
    return np.asarray(falls - math.log(here.rows) - np.array(prices)), at


def _clocks(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """The hypothesis on records whose clocks are off, where they are."""
    if any(t.kind == CLOCKS for t in h.terms) or search.is_noise(h):
        return []
    h = search.ready(h)
    if h.refit.failure:
        return []
    base, refit = on_their_clocks(search.context, h.base, h.refit)
    if refit is h.refit:
        return []
    return [Hypothesis(refit, base, (*h.terms, Term(CLOCKS, tuple(clocks(search.context, refit)), prior=P_CLOCKS)))]


def _cards(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """The units with another card in the place of one, or with one more, where the model is a unit and nothing explains the records."""
    context, first = search.context, h.refit
    if not is_white_box(first.model) or search.is_noise(search.ranked()[0]):
        return []
    places = [n for n in context.components if context.may_exchange(n)]
    changes = [c for c in exchanges(first.model) if (c.component in places if c.stated else places)]
    bases = [_with_card(first, c) for c in changes]
    jobs = [RefitJob(b.model, (), b.problem, _begins(b, c), b.noise) for b, c in zip(bases, changes, strict=True)]
    refits = Race(CARD_LAPS).run(context, first, jobs, [f"with {c.card.upper()} as {c.component}" for c in changes])
    prior = P_CARD / max(len(changes), 1)
    each = [
        Hypothesis(r, replace(b, theta=r.theta), (Term(CARD, (c.component,), c.card.upper(), prior),))
        for c, b, r in zip(changes, bases, refits, strict=True)
        if not r.failure and r.rows
    ]
    search.add(each)
    return [_all_of_it(search, h) for h in search.ranked() if h.kind == CARD and len(h.terms) == 1][:BEAM]


def _all_of_it(search: Search, h: Hypothesis) -> Hypothesis:
    """Return a hypothesis of another card with as many of the card's typical values set free as the records ask for, the most wanted
    first: nobody has stated them."""
    (component,) = h.terms[0].at
    while not (search.context.spent or search.is_noise(h)):
        own = [f for f in stated(h.base.model, h.base.problem.free) if f.name.startswith(f"{component}.")]
        worth, _ = _worth(h.refit, own, [0.0] * len(own))
        if not worth.size or worth.max() <= 0.0:
            break
        wider = with_free(h.base, own[int(np.argmax(worth))])
        refit = refit_again(wider, h.refit, ())
        more = Hypothesis(refit, replace(wider, theta=refit.theta), h.terms)
        ruler = search.ruler
        if refit.failure or search.cost(more, ruler, rough=True) >= search.cost(h, ruler, rough=True):
            break
        h = more
    return h


def _begins(base: Refit, change: CardChange) -> tuple[Array, ...]:
    """Return where the refit of another card may begin: at its start, and there with one value a quarter of its range from either end.

    No slope leads to a level that nothing reaches at the start.
    """
    begins = [base.theta]
    for k, f in enumerate(base.problem.free):
        for share in (0.25, 0.75) if f.name in change.free else ():
            begins.append(np.concatenate([base.theta[:k], [f.min + share * (f.max - f.min)], base.theta[k + 1 :]]))
    return tuple(begins)


def _with_card(first: Refit, change: CardChange) -> Refit:
    """Return the nominal model with another card, what a fit frees of it at its start beside the parameters as they are refitted."""
    model = recording(change.model, (o for e in first.problem.experiments for o in e.outputs))
    own = tuple(FitParameter.of(n, p) for n, p in change.free.items())
    old = model.parameters.keys() - change.free.keys()
    stays = [k for k, f in enumerate(first.problem.free) if f.name in old]
    held = FrozenMap({n: v for n, v in first.problem.held.items() if n in old})
    free = (*(first.problem.free[k] for k in stays), *own)
    problem = replace(first.problem, simulator=ModelSimulator(model, first.patience), free=free, held=held)
    nuisance = first.theta[len(first.problem.free) :]
    theta = np.concatenate([first.theta[stays], [f.start for f in own], nuisance])
    return Refit(model, (), problem, first.noise, theta)


def _effects(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one effect more, as the screen beside this one ranks them."""
    h = search.ready(h)
    if h.refit.failure:
        return []
    number = len(search.expansions) + 1
    model, expansion = opened(search.context, h.refit, number)
    search.models[h.key] = model
    search.expansions[h.key] = expansion
    if not expansion.screen.scores:
        return []
    ruler, found = search.ruler, expansion.candidates
    best, noise, prior = search.ranked()[0], search.is_noise(h), _prior(expansion)

    def worth(s: Score) -> bool:
        c = found[s.candidate]
        price = ruler.price * len(c.probes[s.probe].free) - 2.0 * math.log(prior(c.effect))
        return not noise or ruler.share * s.fall > price

    reached = h.refit.chi2 - best.refit.chi2 if search.is_noise(best) else 0.0
    return _kept(search, h, raced(model, expansion, f"round {number}", reached, worth))


def _again(
    look: Callable[[ExpansionModel, Expansion, str], Expansion], text: str
) -> Callable[[Search, Hypothesis], list[Hypothesis]]:
    """A move that looks for more in an expansion that is open."""

    def move(search: Search, h: Hypothesis) -> list[Hypothesis]:
        expansion = search.expansions.get(h.key)
        if expansion is None or not expansion.trials:
            return []
        return _kept(search, h, look(search.models[h.key], expansion, text))

    return move


def _kept(search: Search, h: Hypothesis, expansion: Expansion) -> list[Hypothesis]:
    """Keep an expansion with its trials, and return these as hypotheses."""
    search.expansions[h.key] = expansion
    prior, children = _prior(expansion), []
    for t in (*expansion.trials, *(expansion.forms or ())):
        r = t.refit
        if r.failure or not r.rows or r.predicted is None:
            continue
        c = r.placed[-1].candidate
        term = Term(c.effect, c.at, c.source, prior(c.effect))
        children.append(Hypothesis(r, h.base, (*h.terms, term), expansion.before if r.placed[-1].movable else None))
    return children


def _prior(expansion: Expansion) -> Callable[[str], float]:
    """Return the probability of an effect at one of its places and sources, before any data: every effect is as likely as another, and
    shares that with all its candidates; a form outside the catalogue with all places."""
    many = Counter(c.effect for c in expansion.candidates)
    return lambda effect: P_EFFECT / max(len(many), 1) / (many[effect] or len(expansion.signals))


MOVES = (
    Move("values", 0, _values),
    Move("clocks", 0, _clocks),
    Move("cards", 0, _cards, of_root=True),
    Move("effects", 1, _effects),
    Move("the best from the given values", 1, _again(best_from_given, "from the given values")),
    Move("from the given values", 2, _again(from_given, "from the given values")),
    Move("beside the leaders", 2, _again(beside_leaders, "beside")),
    Move("beside the new leaders", 3, _again(beside_leaders, "beside")),
    Move("sizes", 3, _again(lambda m, e, t: searched_sizes(m, e, t, far=True), "sizes to be met")),
    Move("outside", 4, _again(outside, "outside the catalogue"), of_root=True),
)
"""The moves, the cheapest first."""


def search_from(context: SearchContext, first: Refit) -> SearchOutcome:
    """Return the best hypotheses beside the refitted nominal model `first`."""
    return Search(context, first).run()
