"""Which terms explain the data as well as one of the answer's in its stead, and which of them are one effect."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeVar

import numpy as np

from hvdc_ident.discrepancy.expansion import Expansion
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.movable import in_proportion
from hvdc_ident.discrepancy.options import CERTAIN, TOLERANCE, DiagnosisOptions
from hvdc_ident.discrepancy.result import VALUE, ComparedHypothesis, Rival
from hvdc_ident.discrepancy.score import TIED, Ruler, apart, at_edge, implied, nearest, off_given, same_answers
from hvdc_ident.discrepancy.search import SearchOutcome, Term
from hvdc_ident.discrepancy.sentences import expression
from hvdc_ident.effects import effects, split_sources
from hvdc_ident.immutable import FrozenMap

UNNOTICED_SHARE = 0.15
"""Share of an effect's answer that a parameter more may change and not be missed where the evidence is weak."""


def rivals(
    outcome: SearchOutcome, term: Term, options: DiagnosisOptions, tries: Callable[[str], bool] = lambda _: True
) -> tuple[Rival, ...]:
    """A term of the best hypothesis and everything that explains the records as well in its stead beside the others, the best first.

    What does the same within the tolerance, with no parameter more, is listed however far behind it is: no model is right to
    the last unit of evidence. So are effects that are the same equation. tries: whether an effect is one of those that are looked for.
    """
    less = outcome.best.without(term)
    base, found = outcome.hypotheses.get(less), outcome.expansions.get(less)
    before = None if base is None else base.refit
    every = [(t, h.refit_of(t), score) for t, h, score in outcome.in_stead_of(term)]
    members = [(t, refit, score) for t, refit, score in every if t == term or _stands(t, refit, before)]
    best = min(score for _, _, score in members)
    each = [_rival(t, refit, score - best) for t, refit, score in members]
    own = next(r for r, (t, _, _) in zip(each, members, strict=True) if t == term)
    # Where several explain the data anyway, one with a parameter more that explains as much is not refuted by its price.
    alone = sum(r.delta_bic <= options.set_bic for r in each if r.is_effect) < 2
    price = outcome.ruler.price
    fall = 0.0 if before is None or own.refit is None else outcome.ruler.between(before, own.refit)
    weak = fall * UNNOTICED_SHARE**2 < options.set_bic + price
    likeliest = min(r.delta_bic - 2.0 * math.log(r.prior) for r in each)

    def behind(r: Rival) -> float:
        """By how much it is behind the best, by evidence or with the priors of the terms."""
        return min(r.delta_bic, r.delta_bic - 2.0 * math.log(r.prior) - likeliest)

    within = [
        r
        for r in each
        if r is own
        or behind(r)
        <= options.set_bic + (price if _more(r, own) == 1 and (not alone or _as_likely(own, r, weak)) else 0.0)
    ]
    further: list[Rival] = []
    if found is not None and before is not None:
        none = next(s - h.prior_cost for h, s in outcome.pool if h.key == less)
        most = (1.0 - TOLERANCE) * (none - own.delta_bic - best)
        further = [
            r
            for r in each
            if r not in within and r.is_effect and none - best - r.delta_bic >= most and _more(r, own) <= 0
        ]
        gain = max(outcome.ruler.between(before, r.refit) for r in within if r.refit is not None)
        within += _unfitted(found, gain, outcome.ruler, options)
        within += _at_rest(found, within)
        within += _equal(found, within, tries)
    once: dict[tuple[str, tuple[str, ...], str, str], Rival] = {}
    same: dict[tuple[str, tuple[str, ...], str, str], str] = {}
    for r in sorted(within, key=lambda r: (r.is_form, r.delta_bic, not r.refitted)):
        once.setdefault(_key(r), r)
        if r.same_as:
            same[_key(r)] = r.same_as
    within = [replace(r, same_as=same.get(key, "")) for key, r in once.items()]
    further = [r for r in further if _key(r) not in once]
    akin = [] if before is None else akin_of(before, within, further)
    whole = [replace(r, akin=a) for r, a in zip([*within, *further], akin, strict=True)] if akin else within
    kept = [r for k, r in enumerate(whole) if k < len(within) or r.akin]
    return tuple(sorted(kept, key=lambda r: r.delta_bic))


def _stands(term: Term, refit: Refit, before: Refit | None) -> bool:
    """Return True for a term that something may be called by: no effect at its edge, which is another's work, and of forms a formula or
    filter that what it leaves does not refute.

    A curve of free values bends to what other values of the parameters would make good: it is told where nothing else explains anything.
    """
    if term.is_effect and at_edge(refit, len(refit.placed) - 1):
        return False
    if not term.is_form or before is None:
        return not term.is_form
    return effects()[term.kind].outside != "curve" and not misfit_of(refit).refutes(misfit_of(before))


def _key(r: Rival) -> tuple[str, tuple[str, ...], str, str]:
    return r.effect, r.at, r.source, r.expression


def _more(one: Rival, other: Rival) -> int:
    """Return how many parameters more a rival has than another."""
    assert one.refit is not None and other.refit is not None
    return len(one.refit.problem.free) - len(other.refit.problem.free)


def _as_likely(own: Rival, other: Rival, weak: bool) -> bool:
    """Return True where a form with one more parameter stays possible though no other explains as much: at the same place, where the data
    would not show what the parameter does (`weak`), or where both are kinds of delay and the one is no case of the other."""
    if not (own.is_effect and other.is_effect) or own.is_form or other.is_form or own.at != other.at:
        return False
    one, two = effects()[own.effect], effects()[other.effect]
    delays = one.equivalent_delay is not None and two.equivalent_delay is not None and one.name not in two.generalises
    return weak or delays


def _rival(term: Term, refit: Refit, behind: float) -> Rival:
    """The member of a set that a hypothesis is, by its term. refit: with the term's effect last; behind: the best, in evidence."""
    values, formula, name = implied(refit), "", term.kind
    if term.is_effect:
        sizes = FrozenMap(refit.sizes(refit.placed[-1]))
        if term.is_form:
            name = effects()[term.kind].outside
            formula = expression(refit) if name == "term" else ""
    else:
        sizes = FrozenMap({n: refit.values[n] for n in term.at} if term.kind == VALUE else {})
        values = FrozenMap({n: v for n, v in values.items() if n not in sizes})
    return Rival(
        name, term.at, behind, sizes, term.source, expression=formula, prior=term.prior, values=values,
        off_given=off_given(refit, sizes), refit=refit,
    )  # fmt: skip


def akin_of(before: Refit, group: Sequence[Rival], further: Sequence[Rival] = ()) -> list[str]:
    """For each of both the first effect of the group before it that does the same at its place in these records, within the
    tolerance; empty where none does. before: the model without them.

    A dead band whose signal stays beyond its edge is an offset; so are, where a signal hardly moves, its gain error and
    what is lost in proportion to it.
    """
    both = [*group, *further]
    akin = []
    for k, r in enumerate(both):
        earlier = (
            q.effect
            for q in group[:k]
            if r.refit is not None
            and q.refit is not None
            and (r.refitted and q.refitted and r.is_effect and q.is_effect)
            and q.at == r.at
            and q.kind != r.kind
            # Records in which a form does the same as an effect of the catalogue do not tell which of both laws it is.
            and not (q.is_form or r.is_form)
            and same_answers(r.refit, q.refit, before)
        )
        akin.append(next(earlier, ""))
    return akin


def _unfitted(found: Expansion, best: float, ruler: Ruler, options: DiagnosisOptions) -> list[Rival]:
    """Candidates that were not refitted but, being linear in their size, gain what their screen says.

    best: what the best of those refitted gains on the fitted records.
    """
    done = {t.score.candidate for t in found.trials}
    group = []
    for k, score in found.screen.best().items():
        c = found.candidates[k]
        if k in done or score.probe >= len(c.probes) or not in_proportion(c, score.probe):
            continue
        probe = c.probes[score.probe]
        behind = best - ruler.gain(score.fall, 0.0, len(probe.free))
        if behind <= options.set_bic:
            only = dict(probe.values) if len(probe.free) == 1 else {}
            sizes = FrozenMap({n: score.factor * v if n in probe.free else v for n, v in only.items()})
            prior = found.prior(c.effect)
            group.append(Rival(c.effect, c.at, max(behind, 0.0), sizes, c.source, refitted=False, prior=prior))
    return group


def _at_rest(found: Expansion, group: Sequence[Rival]) -> list[Rival]:
    """Nonlinear effects at a signal that never moves: they act as a gain there and have no signature of their own.

    A limit, a saturation and a deadband take away; levels may add too.
    """
    gains = {r.at: r for r in group if r.effect == "gain"}
    likes: list[Rival] = []
    for c in found.candidates:
        entry, gain = effects()[c.effect], gains.get(c.at)
        bends = c.still and entry.equivalent_delay is None and entry.states == "none" and not entry.needs_source
        if gain is not None and bends and (entry.needs_grid or gain.parameters.get("k", 0.0) < 1.0):
            like = Rival(c.effect, c.at, gain.delta_bic, FrozenMap(), refitted=False, same_as="gain", prior=gain.prior)
            likes.append(replace(like, values=gain.values, off_given=gain.off_given))
    return likes


def _equal(found: Expansion, group: Sequence[Rival], tries: Callable[[str], bool]) -> list[Rival]:
    """The effects that are the same equation as one of the group at its place, under their own names."""
    known = [
        (r, other, equality)
        for r in group
        if r.is_effect and not r.is_form
        for other, equality in effects()[r.effect].equals.items()
        if tries(other)
    ]
    equal = []
    for r, other, equality in known:
        own = [s for s in split_sources(r.source, r.at) if s in found.signals]
        brought = [u for s in own for u in found.signals[s]] or [np.empty(0)]
        equal_sizes = [equality(r.parameters, signal) if r.parameters or not r.refitted else None for signal in brought]
        if all(t is not None for t in equal_sizes):
            sizes = FrozenMap(equal_sizes[0] or {})
            equal.append(
                replace(r, effect=other, parameters=sizes, refitted=False, same_as=r.effect, akin="", refit=None)
            )
    return equal


MAX_HYPOTHESES = 20
"""Hypotheses in the result at most, the likeliest."""


@dataclass(frozen=True)
class EffectClass:
    """Hypotheses that are one effect. names: the effects that are the same equation or do the same, the likeliest first;
    probability: of all members together; members: the hypotheses, the likeliest first, with their probabilities."""

    names: tuple[str, ...]
    probability: float
    members: tuple[tuple[Rival, float], ...]

    @property
    def equations(self) -> dict[str, float]:
        """The probability of each effect, over all its places, the likeliest first; of one equation with two names, of the first."""
        total: dict[str, float] = {}
        for r, p in self.members:
            total[r.same_as or r.effect] = total.get(r.same_as or r.effect, 0.0) + p
        return dict(sorted(total.items(), key=lambda kv: -kv[1]))

    @property
    def best(self) -> Rival:
        """The likeliest member of the likeliest effect; of those that are as likely the one with the values nearest to the given."""
        own = next(iter(self.equations))
        first = next(r for r, _ in self.members if (r.same_as or r.effect) == own)
        likely_ones = [r for r, _ in credible(self.members) if (r.same_as or r.effect) == own and r.refitted]
        tied = [r for r in likely_ones if r.delta_bic <= first.delta_bic + TIED]
        return nearest(first, tied, lambda r: r.values, lambda r: r.off_given)

    @property
    def differs(self) -> bool:
        """True where its likely places imply different values of the model's parameters: what these are is not known then."""
        kind = self.best.effect
        likely_ones = [r.values for r, _ in credible(self.members) if r.refitted and r.effect == kind]
        return any(apart(one, other) for one, other in combinations(likely_ones, 2))

    @property
    def kinds(self) -> tuple[str, ...]:
        """The effects that were refitted, the likeliest first."""
        return tuple(dict.fromkeys(r.effect for r, _ in self.members if r.refitted)) or self.names[:1]


def classes(group: Sequence[Rival]) -> tuple[EffectClass, ...]:
    """The classes of an ambiguity set, the likeliest first. Evidence is exp(-delta BIC/2), every effect as likely before.

    Effects that are the same equation are one, and so are effects that add the same to a signal, and kinds of delay that are as
    long: what differs is within the tolerance.
    """
    parent = {r.kind: r.kind for r in group} | {r.same_as: r.same_as for r in group if r.same_as}

    def root(name: str) -> str:
        while parent[name] != name:
            name = parent[name]
        return name

    for r in group:
        for name in filter(None, (r.same_as, r.akin)):
            parent[root(r.kind)] = root(name)
    for one, other in combinations([r for r in group if (r.late or 0.0) > 0.0], 2):
        if _as_long(one, other):
            parent[root(other.kind)] = root(one.kind)
    there = {(r.effect, r.at, r.source) for r in group}
    # One hypothesis under two names is one hypothesis.
    weights = [
        0.0
        if r.same_as and (not r.refitted or (r.same_as, r.at, r.source) in there)
        else r.prior * float(np.exp(-0.5 * r.delta_bic))
        for r in group
    ]
    total = sum(weights)
    found: dict[str, list[tuple[Rival, float]]] = {}
    for r, w in zip(group, weights, strict=True):
        found.setdefault(root(r.kind), []).append((r, w / total))
    each = []
    for members in found.values():
        ordered = sorted(members, key=lambda m: (-m[1], m[0].delta_bic))
        names = tuple(dict.fromkeys(r.effect for r, _ in ordered))
        each.append(EffectClass(names, sum(p for _, p in members), tuple(ordered)))
    return tuple(sorted(each, key=lambda c: -c.probability))


def _as_long(one: Rival, other: Rival) -> bool:
    """Return True for two delays whose difference is within the tolerance: that share of the squared gap that they make good."""
    a, b = one.late or 0.0, other.late or 0.0
    return abs(a - b) <= np.sqrt(TOLERANCE) * max(a, b)


def likely(each: Sequence[EffectClass]) -> list[EffectClass]:
    """The likeliest classes, as many as hold 95 % together."""
    return [c for c, _ in credible([(c, c.probability) for c in each])]


T = TypeVar("T")


def credible(each: Sequence[tuple[T, float]]) -> list[tuple[T, float]]:
    """Of things with their probabilities, the likeliest first, as many as hold 95 % of them together."""
    before = np.cumsum([0.0, *(p for _, p in each)])
    return [one for one, held in zip(each, before, strict=False) if held < CERTAIN * before[-1]]


def compared(outcome: SearchOutcome) -> tuple[ComparedHypothesis, ...]:
    """Every hypothesis that was refitted, the likeliest first, by its score."""
    most = min(score for _, score in outcome.pool)
    total = sum(math.exp(0.5 * (most - score)) for _, score in outcome.pool)
    return tuple(
        ComparedHypothesis(
            tuple(t.label for t in h.terms),
            -0.5 * score,
            h.refit.unseen,
            math.exp(0.5 * (most - score)) / total,
            tuple(FrozenMap(h.refit.sizes(p)) for p in h.refit.placed),
            FrozenMap({n: size.value for n, size in implied(h.refit).items()}),
        )
        for h, score in outcome.pool[:MAX_HYPOTHESES]
    )
