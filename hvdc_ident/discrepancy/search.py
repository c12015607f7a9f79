"""The search: a queue of hypotheses and moves, the best first by one score.

A hypothesis is the nominal model with terms: effects at places, stated values set free, another component, clocks that are off. A move
(`moves`) makes of a hypothesis others with one term more; doing without a term, or with another one in its stead, is a move of the
hypothesis without it.
The best hypothesis so far is the answer at every instant. The search ends when no hypothesis that is still open can come near the best,
or when the budget is over.

The score is minus twice the log evidence, up to a constant: chi2 of the fitted and of the held-out records in units of what the best
hypothesis leaves, the logarithm of the independent rows for each unknown, and minus twice the log prior of the terms. Slight errors of
what is stated go with every hypothesis (`stated`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

from hvdc_ident.discrepancy.candidates import leaks
from hvdc_ident.discrepancy.expansion import Expansion, ExpansionModel
from hvdc_ident.discrepancy.hypothesis import (
    FAILURES,
    Refit,
    built_in,
    last_placed,
    refit_again,
    without_bias,
)
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.nominal import noise_left
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.result import CARD, VALUE
from hvdc_ident.discrepancy.score import (
    P_VALUE,
    TIED,
    Ruler,
    implied,
    nearest,
    objections,
    off_given,
)
from hvdc_ident.discrepancy.stated import Errors, SlightErrors, with_held
from hvdc_ident.effects import effects
from hvdc_ident.fit.noise import SURE

CLOCKS = "clocks"
"""Kind of the term that the clocks of records are off."""
GIVEN = "as given"
"""Kind of the term that fitted parameters are as they were given."""
BEAM = 3
"""Hypotheses of one number of terms, of different kinds, that are opened."""


@dataclass(frozen=True)
class Term:
    """A part of a hypothesis that the nominal model has not.

    kind: an effect of the catalogue, `VALUE`, `CARD`, `CLOCKS` or `GIVEN`; at: its places, the value's name, the component, the records
    whose clocks are off, or the fitted parameters that are as given; source: the signal that an effect brings in, or the card. prior:
    its probability before any data.
    """

    kind: str
    at: tuple[str, ...] = ()
    source: str = ""
    prior: float = field(default=1.0, compare=False)

    @property
    def is_effect(self) -> bool:
        """True for an effect that stands in the model."""
        return self.kind not in (VALUE, CARD, CLOCKS, GIVEN)

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

    @property
    def may_be_named(self) -> bool:
        """True where every term has a name: a form is told as what it is, and an effect beside given values is told beside others."""
        return not any(t.is_form or t.kind == GIVEN for t in self.terms)

    @property
    def effects(self) -> tuple[Term, ...]:
        """The terms that are effects, in the order in which they stand in the model."""
        return tuple(t for t in self.terms if t.is_effect)

    @property
    def label(self) -> str:
        """The terms in tables."""
        return " and ".join(t.label for t in self.terms)

    def without(self, term: Term) -> frozenset[Term]:
        """The key of the hypothesis without one of its terms."""
        return self.key - {term}

    def refit_of(self, term: Term) -> Refit:
        """The refit; of an effect with that as its last one."""
        return last_placed(self.refit, self.effects.index(term)) if term.is_effect else self.refit


@dataclass(frozen=True, eq=False)
class SearchOutcome:
    """Where the search ended.

    best: the hypothesis that is the answer, its effects in the model. pool: every hypothesis, the best first, with its score less that of
    the model without terms. expansions: what was looked for beside a hypothesis, by its terms, the first first. ruler: what scores are
    counted by. forms: those outside the catalogue that stand, the best first; ahead: of these, those that are better than the answer.
    objection: why a better hypothesis is not the answer; empty where the best is. exhausted: whether nothing that was open could have
    come near; notes: what could not be done, or was not.
    """

    best: Hypothesis
    pool: tuple[tuple[Hypothesis, float], ...]
    expansions: Mapping[frozenset[Term], Expansion]
    ruler: Ruler
    slight: Errors
    forms: tuple[Hypothesis, ...] = ()
    ahead: tuple[Hypothesis, ...] = ()
    objection: str = ""
    exhausted: bool = True
    notes: tuple[str, ...] = ()

    @property
    def refit(self) -> Refit:
        """The best hypothesis, refitted."""
        return self.best.refit

    @property
    def named(self) -> tuple[Term, ...]:
        """The terms of the best hypothesis that are said to be wrong or missing: all but clocks."""
        return tuple(t for t in self.best.terms if t.kind != CLOCKS)

    @property
    def opened(self) -> Expansion | None:
        """The expansion of the model without terms; None where the search did not come to effects."""
        return next(iter(self.expansions.values()), None)

    @cached_property
    def hypotheses(self) -> dict[frozenset[Term], Hypothesis]:
        """Every hypothesis by its terms."""
        return {h.key: h for h, _ in self.pool}

    def in_stead_of(self, term: Term) -> list[tuple[Term, Hypothesis, float]]:
        """Return the terms that were looked for in the stead of one of the best hypothesis beside its others, and that one: each with its
        hypothesis and the score of that less the prior of its terms, the best first."""
        less = self.best.without(term)
        found = []
        for h, score in self.pool:
            own = h.key - less
            if len(own) == 1 and less < h.key:
                (other,) = own
                if other.kind not in (CLOCKS, GIVEN):
                    found.append((other, h, score - h.prior_cost))
        return sorted(found, key=lambda one: one[2])

    @property
    def explained_by_errors(self) -> bool:
        """True where slight errors of what is stated explain what the best hypothesis leaves, and it is no noise without them."""
        misfit = misfit_of(self.refit)
        power = (self.refit.chi2 - self.slight.fall_fitted) / self.refit.rows
        return not misfit.is_noise and power <= misfit.floor * (1.0 + SURE * misfit.power_error)


@dataclass(frozen=True)
class Move:
    """What makes of a hypothesis others. rank: when its turn is, beside the same of a hypothesis with a term less or more. of_root:
    whether it is one of the model without terms alone. in_stead: whether something in the stead of a term is looked for by it, too."""

    name: str
    rank: int
    make: Callable[[Search, Hypothesis], list[Hypothesis]]
    of_root: bool = False
    in_stead: bool = False


TERM_RANK = 2
"""Ranks by which the moves of a hypothesis come after those of one with a term less."""


class Search:
    """A search at work: its hypotheses, and what has been looked for beside which of them.

    moves: what it looks for.
    """

    def __init__(self, context: SearchContext, first: Refit, moves: Sequence[Move]) -> None:
        self.context = context
        self.moves = moves
        self.root = Hypothesis(first, first)
        self.slight = {id(first.problem.experiments): SlightErrors.of(first, context.stated)}
        self.floor = noise_left(first.nominal())
        self.pool: dict[frozenset[Term], Hypothesis] = {}
        self.models: dict[frozenset[Term], ExpansionModel] = {}
        self.expansions: dict[frozenset[Term], Expansion] = {}
        self.done: set[tuple[frozenset[Term], str]] = set()
        self.errors: dict[frozenset[Term], tuple[Refit, Errors]] = {}
        self.noisy: dict[frozenset[Term], tuple[Refit, bool]] = {}
        self.settled: set[tuple[frozenset[Term], Term]] = set()
        self.bettered = 0
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
        # A model that follows less of the noise of what it is played leaves less, and is no better for it.
        chi2 -= r.followed - self.root.refit.followed
        if known is not None and r.holdout is None and r.predicted is not None:
            # Parts of the fitted records, predicted from the rest: errors explain as much of these.
            chi2 += r.predicted**2 * r.unseen_rows * known / r.chi2
        # The row that leaves a record with a late clock takes its share of the noise along.
        chi2 += r.chi2 * (self.root.refit.rows / r.rows - 1.0)
        count = len(r.problem.names) + sum(len(t.at) for t in h.terms if t.kind == CLOCKS)
        return ruler.share * chi2 + ruler.price * count + h.prior_cost

    def ranked(self) -> list[Hypothesis]:
        """Every hypothesis, the best first; of those far behind without slight errors."""
        return [h for h, _ in self._scored(self.ruler)]

    def _scored(self, ruler: Ruler) -> list[tuple[Hypothesis, float]]:
        rough = sorted(self.pool.values(), key=lambda h: self.cost(h, ruler, rough=True))
        # Slight errors take off the most where nothing else explains the records: by so much the first order may be wrong.
        most = max(self.cost(self.root, ruler, rough=True) - self.cost(self.root, ruler), 0.0)
        limit = min(self.cost(h, ruler) for h in rough[:3]) + most + self.near
        close = [h for h in rough if self.cost(h, ruler, rough=True) <= limit]
        scored = sorted(((h, self.cost(h, ruler)) for h in close), key=lambda one: one[1])
        # Of the model without terms the errors are known anyway.
        far = ((h, self.cost(h, ruler, rough=h is not self.root)) for h in rough[len(close) :])
        return [*scored, *far]

    @property
    def near(self) -> float:
        """By how much the score of a hypothesis may be behind the best for it to stand beside that."""
        return self.context.options.set_bic

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
                self.bettered += 1
                continue
            more = h.refit.chi2 - had.refit.chi2
            if more < -TIED or (more <= TIED and off_given(h.refit, h.values) < off_given(had.refit, h.values)):
                self.pool[h.key] = h
                self.bettered += 1

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
                self.notes.append(f"nothing was looked for beside {h.label or 'the model'} ({move.name}): {error}")
            best = self.ranked()[0]
            self.context.lead(best.label, self.left(best))
        if exhausted:
            self._exchanged()
        return self.outcome(exhausted=exhausted)

    def _next(self) -> tuple[Hypothesis, Move] | None:
        """The next hypothesis and move; None where nothing open can come near the best."""
        ranked, ruler = self.ranked(), self.ruler
        best = ranked[0]
        satisfied = self.is_noise(best)
        order: list[tuple[int, int, Hypothesis, Move]] = []
        # Where a form explains the records no other effects are looked for in pairs, but clocks and values that are off are.
        ends = bool(best.terms) and best.terms[-1].is_form and bool(self._unrefuted_forms())
        sizes: Counter[int] = Counter()
        for n, h in enumerate(self._beam(ranked)):
            more = len(h.terms) + 1
            # The others of so many terms come after what is dear beside fewer.
            turn = TERM_RANK * len(h.terms) + (1 if sizes[more] else 0)
            sizes[more] += 1
            if more > self.context.options.most or not self._may_win(h, best, ruler):
                continue
            # Beside the best that leaves noise only rivals of its own terms are looked for, and only by what is cheap.
            if satisfied and h.terms and not h.key < best.key:
                continue
            for move in self.moves:
                if (h.key, move.name) in self.done:
                    continue
                if move.of_root and h.terms:
                    continue
                if (satisfied and move.rank > 1) or (ends and more > 1 and move.rank > 0):
                    continue
                order.append((move.rank + turn, n, h, move))
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
            if not h.may_be_named:
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
        return ideal < self.cost(best, ruler) + self.near

    def answer(self) -> tuple[Hypothesis, str]:
        """The best hypothesis to whose terms nothing objects, ready, and what spoke against the best of those before it.

        A refit that was made for an objection may be better than the hypothesis in question: then the best is asked for anew.
        """
        before = -1
        while before != self.bettered:
            before = self.bettered
            found = self._unopposed()
        return found

    def _unopposed(self) -> tuple[Hypothesis, str]:
        against = ""
        for h in self.ranked():
            if h.key == self.root.key:
                break
            if not h.may_be_named:
                continue
            why = self._objection(h)
            if not why:
                built = self.ready(self._preferred(h))
                why = built.refit.failure
                if not why:
                    return built, against
            against = against or f"{h.label}: {why}"
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
            and h.may_be_named
            and not self._objection(h)
        ]
        best = nearest(best, tied, lambda h: implied(h.refit), lambda h: off_given(h.refit, h.values))
        last = best.terms[-1]
        if last.kind != "conductance" or all(leaks(best.refit.model, last.at, s) for s in last.source.split(",")):
            return best
        like = [h for h in tied if h.terms[-1].kind in ("droop", "coupling")]
        there = [h for h in like if (h.terms[-1].at, h.terms[-1].source) == (last.at, last.source)]
        return next(iter(there), best)

    def _objection(self, h: Hypothesis) -> str:
        """Return in words an objection to one of the terms of a hypothesis; empty where there is none."""
        ruler, options = self.ruler, self.context.options
        for t in h.terms:
            less = None if t.kind in (CLOCKS, GIVEN) else self._without(h, t)
            if less is None:
                continue
            if not t.is_effect:
                if self.cost(less, ruler) - self.cost(h, ruler) <= self.near:
                    return "it explains no more than its probability takes away"
                continue
            known = self.expansions.get(less.key) or self.expansions.get(self.root.key)
            p = 1.0 if known is None else known.screen.p(less.refit.chi2 - h.refit.chi2)
            gain, first = ruler.between(less.refit, h.refit), less.key == self.root.key
            if why := objections(less.refit, h.refit_of(t), gain, p, options, self.context.tolerance, first=first):
                return why
        return ""

    def _without(self, h: Hypothesis, term: Term) -> Hypothesis | None:
        """The hypothesis with one term less, refitted from where `h` stands where it has others; None where it cannot be had."""
        key = h.without(term)
        if key in self.pool and (not key or (h.key, term) in self.settled):
            return self.pool[key]
        self.settled.add((h.key, term))
        known = self.pool.get(key)
        if term.kind == CLOCKS or (h.before is not None and not (h := self.ready(h)).refit.placed):
            return known
        base = h.base
        if term.kind == CARD:
            base = self.root.base
        if term.kind == VALUE:
            (f,) = (f for f in (*self.context.held, *self.context.stated) if f.name == term.at[0])
            base = with_held(base, f)
        placed = [p for t, p in zip(h.effects, h.refit.placed, strict=True) if t != term]
        refit = refit_again(base, h.refit, placed)
        if refit.failure:
            return known
        self.add([Hypothesis(refit, base, tuple(t for t in h.terms if t != term))])
        return self.pool[key]

    def _exchanged(self) -> None:
        """Look for something else in the stead of each term of the best hypothesis of several, until nothing else is better."""
        for _ in range(self.context.options.most):
            best, _ = self.answer()
            if len(best.terms) < 2:
                return
            for t in best.terms:
                less = self._without(best, t)
                if less is None or self.context.spent:
                    continue
                for move in (m for m in self.moves if m.in_stead):
                    if (less.key, move.name) not in self.done and not self.context.spent:
                        self.done.add((less.key, move.name))
                        with suppress(*FAILURES):  # it cannot be run without the term: nothing stands in its stead
                            self.add(move.make(self, less))
            if self.answer()[0].key == best.key:
                return

    def outcome(self, *, exhausted: bool) -> SearchOutcome:
        """Return what is known now. exhausted: whether nothing is open that could come near the best."""
        best, against = self.answer()
        if best.terms:
            best = replace(best, refit=without_bias(best.refit))
            self.pool[best.key] = best
        ruler, standing = self.ruler, self.forms()
        none = self.cost(self.root, ruler)
        return SearchOutcome(
            best,
            tuple((h, score - none) for h, score in self._scored(ruler)),
            dict(self.expansions),
            ruler,
            self.errors_under(best),
            tuple(standing),
            tuple(self.forms_ahead(best, standing)),
            against,
            exhausted,
            tuple(self.notes),
        )

    def forms(self) -> list[Hypothesis]:
        """The forms outside the catalogue that stand: what they leave does not refute them, and nothing speaks against them, the best
        first."""
        return [h for h in self._unrefuted_forms() if not self._objection(h)]

    def forms_ahead(self, answer: Hypothesis, standing: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Of standing forms those that are better than the answer by more than chance, and as likely as the best of them."""
        ruler = self.ruler
        ahead = [h for h in standing if self.cost(answer, ruler) - self.cost(h, ruler) > self.near]
        return [h for h in ahead if self.cost(h, ruler) - self.cost(ahead[0], ruler) <= self.near]

    def _unrefuted_forms(self) -> list[Hypothesis]:
        before = misfit_of(self.root.refit)
        alone = [h for h in self.ranked() if len(h.terms) == 1 and h.terms[0].is_form]
        return [h for h in alone if not misfit_of(h.refit).refutes(before)]


def _chi2(refit: Refit) -> float:
    """Return chi2 of the fitted records and the score of the others."""
    return refit.chi2 + (0.0 if refit.predicted is None else refit.predicted**2 * refit.unseen_rows)
