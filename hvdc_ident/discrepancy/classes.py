"""Which candidates explain the data as well as the one that was put in, and what would distinguish them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeVar

import numpy as np

from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.expansion import Expansion
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.movable import in_proportion
from hvdc_ident.discrepancy.options import CERTAIN, TOLERANCE, DiagnosisOptions
from hvdc_ident.discrepancy.outside import expression
from hvdc_ident.discrepancy.result import VALUE, Hypothesis, Rival
from hvdc_ident.discrepancy.score import (
    TIED,
    CandidateFit,
    apart,
    at_edge,
    best_gain,
    deficits,
    implied,
    nearest,
    off_given,
    same_answers,
)
from hvdc_ident.discrepancy.search import P_EFFECT, Kept, SearchOutcome, Term
from hvdc_ident.effects import effects, split_sources
from hvdc_ident.immutable import FrozenMap

SLIGHT_SHARE = 1e-3
"""Share of what a form explains by which a formula may explain more and not refute it: of so much the noise is not known."""
UNNOTICED_SHARE = 0.15
"""Share of an effect's answer that a parameter more may change and not be missed where the evidence is weak."""


def rivals(kept: Kept, options: DiagnosisOptions, tries: Callable[[str], bool] = lambda _: True) -> tuple[Rival, ...]:
    """The term that was kept and everything that explains the records as well in its stead, the best first.

    What does the same within the tolerance, with no parameter more, is listed however far behind it is: no model is right to
    the last unit of evidence. So are effects that are the same equation. tries: whether an effect is one of those that are looked for.
    """
    found = kept.expansion
    assert found.ruler is not None
    others = [t for _, t in kept.others]
    own = found.winner or next(t for term, t in kept.others if term == kept.term)
    behind_by = deficits([*found.trials, *others])
    # One that explains as much is no nothing, even where gains make good any size of it; one at its edge is another's work.
    sound = [t is own or not at_edge(t.refit, len(t.refit.placed) - 1) for t in found.trials]
    # Where several explain the data anyway, one with a parameter more that explains as much is not refuted by its price.
    alone = sum(s and b <= options.set_bic for s, b in zip(sound, behind_by, strict=False)) < 2
    count = Counter(c.effect for c in found.candidates)
    group: list[Rival] = []
    further: list[Rival] = []
    for trial, behind, good in zip(found.trials, behind_by, sound, strict=False):
        c = found.candidates[trial.pick.candidate]
        more = len(trial.refit.problem.free) - len(own.refit.problem.free)
        spared = more == 1 and found.winner is not None and (not alone or _as_likely(found, c, options))
        sizes = FrozenMap(trial.refit.sizes(trial.refit.placed[-1]))
        rival = Rival(
            c.effect, c.at, behind, sizes, c.source, values=implied(trial.refit), off_given=off_given(trial.refit)
        )
        if good and behind <= options.set_bic + (found.ruler.price if spared else 0.0):
            group.append(rival)
        elif good and more <= 0 and trial.total_gain >= (1.0 - TOLERANCE) * own.total_gain:
            further.append(rival)
    group += _unfitted(found, best_gain([*found.trials, *others]), options)
    group += _at_rest(found, group)
    group += _equal(found, group, tries)
    each: dict[tuple[str, tuple[str, ...], str], Rival] = {}
    same: dict[tuple[str, tuple[str, ...], str], str] = {}
    for r in sorted(group, key=lambda r: (r.delta_bic, not r.refitted)):
        each.setdefault((r.effect, r.at, r.source), r)
        if r.same_as:
            same[r.effect, r.at, r.source] = r.same_as
    within = [replace(r, same_as=same.get(key, "")) for key, r in each.items()]
    further = [r for r in further if (r.effect, r.at, r.source) not in each]
    akin = _akin(found, within, further)
    whole = [replace(r, akin=a) for r, a in zip([*within, *further], akin, strict=True)]
    whole = [replace(r, prior=1.0 / max(count[r.effect], 1)) for k, r in enumerate(whole) if k < len(within) or r.akin]
    beside = zip(kept.others, behind_by[len(found.trials) :], strict=True)
    kinds = max(len(count), 1)
    whole += [
        _other_rival(term, t.refit, behind, term.prior / P_EFFECT * kinds)
        for (term, t), behind in beside
        if behind <= options.set_bic
    ]
    return tuple(sorted(whole, key=lambda r: r.delta_bic))


def _other_rival(term: Term, refit: Refit, behind: float, prior: float) -> Rival:
    """The member of a set that says that a stated value is another, or a component of another type."""
    known = implied(refit)
    sizes = FrozenMap({n: refit.values[n] for n in term.at} if term.kind == VALUE else {})
    values = FrozenMap({n: v for n, v in known.items() if n not in sizes})
    return Rival(term.kind, term.at, behind, sizes, term.source, prior=prior, values=values)


def _akin(found: Expansion, group: Sequence[Rival], further: Sequence[Rival] = ()) -> list[str]:
    """For each of both the first effect of the group before it that does the same at its place in these records, within the
    tolerance; empty where none does.

    A dead band whose signal stays beyond its edge is an offset; so are, where a signal hardly moves, its gain error and
    what is lost in proportion to it.
    """
    both = [*group, *further]
    refits = {
        (
            t.refit.placed[-1].candidate.effect,
            t.refit.placed[-1].candidate.at,
            t.refit.placed[-1].candidate.source,
        ): t.refit
        for t in found.trials
    }
    own = [refits.get((r.effect, r.at, r.source)) if r.refitted else None for r in both]
    akin = []
    for k, r in enumerate(both):
        earlier = (
            q.effect
            for q, other in zip(group[:k], own, strict=False)
            if (one := own[k]) is not None
            and other is not None
            and q.at == r.at
            and q.effect != r.effect
            and same_answers(one, other, found.before)
        )
        akin.append(next(earlier, ""))
    return akin


def _as_likely(found: Expansion, other: CandidateEffect, options: DiagnosisOptions) -> bool:
    """Return True where a form with one more parameter stays possible though the winner is alone: at the same place, where the
    data would not show what the parameter does, or where both are kinds of delay and the winner is no case of the other.
    """
    assert found.winner is not None and found.ruler is not None
    best = found.candidates[found.winner.pick.candidate]
    one, two = effects()[best.effect], effects()[other.effect]
    weak = found.winner.gain * UNNOTICED_SHARE**2 < options.set_bic + found.ruler.price
    delays = one.equivalent_delay is not None and two.equivalent_delay is not None and one.name not in two.generalises
    return other.at == best.at and (weak or delays)


def formula_rivals(
    found: Expansion, formulas: Sequence[tuple[CandidateFit, float]], options: DiagnosisOptions
) -> tuple[float, tuple[Rival, ...]]:
    """By how much the winner is behind the best formula outside the catalogue, in BIC, and the formulas that are near it; infinite
    where one is further ahead than they can be distinguished.

    formulas: refitted in the winner's stead, each with its prior; none is near of which that is 0.
    """
    assert found.winner is not None
    own, *behind = deficits([found.winner, *(t for t, _ in formulas)])
    within = max(options.set_bic, SLIGHT_SHARE * found.winner.total_gain)
    if own > within:
        return np.inf, ()
    near = [
        replace(_rival(t, b), prior=prior)
        for b, (t, prior) in zip(behind, formulas, strict=True)
        if b <= within and prior > 0.0
    ]
    return own, tuple(sorted(near, key=lambda r: r.delta_bic))


def _rival(trial: CandidateFit, behind: float) -> Rival:
    placed = trial.refit.placed[-1]
    c, sizes = placed.candidate, FrozenMap(trial.refit.sizes(placed))
    values, off = implied(trial.refit), off_given(trial.refit)
    kind = effects()[c.effect].outside
    formula = expression(trial.refit) if kind == "term" else ""
    return Rival(kind, c.at, behind, sizes, c.source, expression=formula, values=values, off_given=off)


def _unfitted(found: Expansion, best: float, options: DiagnosisOptions) -> list[Rival]:
    """Candidates that were not refitted but, being linear in their size, gain what their screen says."""
    assert found.ruler is not None
    done = {t.pick.candidate for t in (*found.trials, *found.failed)}
    group = []
    for k, score in found.screen.best().items():
        c = found.candidates[k]
        if k in done or score.probe >= len(c.probes) or not in_proportion(c, score.probe):
            continue
        probe = c.probes[score.probe]
        behind = best - found.ruler.gain(score.fall, 0.0, len(probe.free))
        if behind <= options.set_bic:
            only = dict(probe.values) if len(probe.free) == 1 else {}
            sizes = FrozenMap({n: score.factor * v if n in probe.free else v for n, v in only.items()})
            group.append(Rival(c.effect, c.at, max(behind, 0.0), sizes, c.source, refitted=False))
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
            like = Rival(c.effect, c.at, gain.delta_bic, FrozenMap(), refitted=False, same_as="gain")
            likes.append(replace(like, values=gain.values, off_given=gain.off_given))
    return likes


def _equal(found: Expansion, group: Sequence[Rival], tries: Callable[[str], bool]) -> list[Rival]:
    """The effects that are the same equation as one of the group at its place, under their own names."""
    known = [
        (r, other, equality) for r in group for other, equality in effects()[r.effect].equals.items() if tries(other)
    ]
    equal = []
    for r, other, equality in known:
        own = [s for s in split_sources(r.source, r.at) if s in found.signals]
        brought = [u for s in own for u in found.signals[s]] or [np.empty(0)]
        equal_sizes = [equality(r.parameters, signal) if r.parameters or not r.refitted else None for signal in brought]
        if all(t is not None for t in equal_sizes):
            sizes = FrozenMap(equal_sizes[0] or {})
            equal.append(replace(r, effect=other, parameters=sizes, refitted=False, same_as=r.effect, akin=""))
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
        """True where likely members imply different values of the model's parameters: what these are is not known then."""
        likely_ones = [r.values for r, _ in credible(self.members) if r.refitted]
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


def compared(outcome: SearchOutcome) -> tuple[Hypothesis, ...]:
    """Every hypothesis that was refitted, the likeliest first, by its score."""
    most = min(score for _, score in outcome.pool)
    total = sum(math.exp(0.5 * (most - score)) for _, score in outcome.pool)
    return tuple(
        Hypothesis(
            tuple(t.label for t in h.terms),
            -0.5 * score,
            h.refit.unseen,
            math.exp(0.5 * (most - score)) / total,
            tuple(FrozenMap(h.refit.sizes(p)) for p in h.refit.placed),
            FrozenMap({n: size.value for n, size in implied(h.refit).items()}),
        )
        for h, score in outcome.pool[:MAX_HYPOTHESES]
    )
