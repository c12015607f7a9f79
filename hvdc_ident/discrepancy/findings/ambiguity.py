"""Which candidates explain the data as well as the one that was put in, and what would tell them apart."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.findings.conclusion import Rival
from hvdc_ident.discrepancy.findings.explain import advice
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refits.refit import Refit
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import is_linear, kind_of
from hvdc_ident.discrepancy.trials.context import Round
from hvdc_ident.discrepancy.trials.select import CandidateFit, at_edge, behinds, best_gain, best_of
from hvdc_ident.effects import effects, split_sources
from hvdc_ident.immutable import FrozenMap

NEEDED = 4.0
"""Standard deviations by which a coefficient has to be off 0 for a formula not to be another one with something idle in it."""
SLIGHT = 1e-3
"""Share of what a form explains by which a formula may explain more and not refute it: of so much the noise is not known."""
MISSED = 0.15
"""Share of an effect's answer that a parameter more may change and not be missed where the evidence is weak."""


def rivals(found: Round, options: DiagnosisOptions, droop: bool = True) -> tuple[Rival, ...]:
    """The winner and every candidate within delta BIC of it, the best first; those with its very signature too.

    droop: whether a negative coupling is one, for they are the same.
    """
    assert found.winner is not None and found.ruler is not None
    behind_by = behinds(found.trials)
    # One that explains as much is no nothing, even where gains make good any size of it; one at its edge is another's work.
    sound = [t is found.winner or not at_edge(t.refit, len(t.refit.placed) - 1) for t in found.trials]
    # Where several explain the data anyway, one with a parameter more that explains as much is not refuted by its price.
    alone = sum(s and b <= options.set_bic for s, b in zip(sound, behind_by, strict=True)) < 2
    group: list[Rival] = []
    for trial, behind, good in zip(found.trials, behind_by, sound, strict=True):
        c = found.candidates[trial.pick.candidate]
        one_more = trial.refit.count - found.winner.refit.count == 1
        spared = one_more and (not alone or _as_likely(found, c, options))
        if not good or behind > options.set_bic + (found.ruler.price if spared else 0.0):
            continue
        sizes = trial.refit.sizes(trial.refit.placed[-1])
        group.append(Rival(c.effect, c.at, behind, FrozenMap(sizes), c.source))
        signed = sizes.get("k", 0.0)
        group += _as_droop(Rival(c.effect, c.at, behind, FrozenMap(sizes), c.source), signed, droop)
        for twin in found.same.get(trial.pick.candidate, ()):
            other = found.candidates[twin.candidate]
            same = Rival(other.effect, other.at, behind, FrozenMap(), other.source, refitted=False)
            group += [same, *_as_droop(same, signed, droop)]
    group += _unfitted(found, best_gain(found.trials), options, droop)
    group += _at_rest(found, group)
    group += _as_loss(found, group)
    each: dict[tuple[str, tuple[str, ...], str], Rival] = {}
    for r in sorted(group, key=lambda r: (r.delta_bic, not r.refitted)):
        each.setdefault((r.effect, r.at, r.source), r)
    return tuple(each.values())


def _as_likely(found: Round, other: CandidateEffect, options: DiagnosisOptions) -> bool:
    """Return True where a form with one more parameter stays possible though the winner is alone: at the same place, where the
    data would not show what the parameter does, or where both are kinds of delay and the winner is no case of the other.
    """
    assert found.winner is not None and found.ruler is not None
    best = found.candidates[found.winner.pick.candidate]
    one, two = effects()[best.effect], effects()[other.effect]
    weak = found.winner.gain * MISSED**2 < options.set_bic + found.ruler.price
    delays = one.equivalent_delay is not None and two.equivalent_delay is not None and one.name not in two.generalises
    return other.at == best.at and (weak or delays)


def formula_rivals(found: Round, formulas: Sequence[CandidateFit], options: DiagnosisOptions) -> tuple[Rival, ...]:
    """The winner with the formulas outside the catalogue that are near it in BIC; () where one is further ahead of it.

    formulas: refitted in the winner's stead. One that explains as much with a parameter more, and would not without any of
    its own, is not refuted by the price of that: of a product around its operating point a gain makes a coupling.
    """
    assert found.winner is not None and found.ruler is not None
    own, *behind = behinds([found.winner, *formulas])
    within = max(options.set_bic, SLIGHT * found.winner.told)
    if own > within:
        return ()
    one_more = [t.refit.count - found.winner.refit.count == 1 and _all_needed(t.refit) for t in formulas]
    limits = [within + (found.ruler.price if more else 0.0) for more in one_more]
    near = [(b, t) for b, t, limit in zip(behind, formulas, limits, strict=True) if b <= limit]
    return tuple(sorted((_rival(found.winner, own), *(_rival(t, b) for b, t in near)), key=lambda r: r.delta_bic))


def _all_needed(refit: Refit) -> bool:
    """Return True where every parameter of the last effect is clearly off 0."""
    sizes, names = refit.sizes(refit.placed[-1]), refit.placed[-1].names
    stds = {n: refit.std.get(names[n]) for n in sizes}
    return all(std is not None and abs(sizes[n]) > NEEDED * std for n, std in stds.items())


def _rival(trial: CandidateFit, behind: float) -> Rival:
    placed = trial.refit.placed[-1]
    c, sizes = placed.candidate, FrozenMap(trial.refit.sizes(placed))
    return Rival(c.effect, c.at, behind, sizes, c.source, expression=placed.use.expression)


def _unfitted(found: Round, best: float, options: DiagnosisOptions, droop: bool) -> list[Rival]:
    """Candidates that were not refitted but, being linear in their size, gain what their score says."""
    assert found.ruler is not None
    done = {t.pick.candidate for t in (*found.trials, *found.failed)}
    done |= {p.candidate for twins in found.same.values() for p in twins}
    group = []
    for p in best_of(found.scores, found.candidates):
        c = found.candidates[p.candidate]
        if p.candidate in done or not is_linear(kind_of(c, p.probe)):
            continue
        probe = c.probes[p.probe]
        behind = best - found.ruler.gain(p.score, 0.0, len(probe.free))
        if behind <= options.set_bic:
            rival = Rival(c.effect, c.at, max(behind, 0.0), FrozenMap(), c.source, refitted=False)
            group += [rival, *_as_droop(rival, p.factor * float(probe.values.get("k", 0.0)), droop)]
    return group


def _at_rest(found: Round, group: Sequence[Rival]) -> list[Rival]:
    """Nonlinear effects at a signal that never moves: they act as a gain there and have no signature of their own.

    A limit, a saturation and a deadband take away; levels may add too.
    """
    gains = {r.at: r for r in group if r.effect == "gain"}
    likes: list[Rival] = []
    for c in found.candidates:
        entry, gain = effects()[c.effect], gains.get(c.at)
        bends = c.still and entry.equivalent_delay is None and entry.states == "none" and not entry.needs_source
        if gain is not None and bends and (entry.needs_grid or gain.parameters.get("k", 0.0) < 1.0):
            likes.append(Rival(c.effect, c.at, gain.delta_bic, FrozenMap(), refitted=False))
    return likes


def _as_loss(found: Round, group: Sequence[Rival]) -> list[Rival]:
    """Conductances under their other name: a loss by the magnitude of a signal that keeps its sign."""
    known = {(c.at, c.source) for c in found.candidates if c.effect == "loss"}
    leaks = [r for r in group if r.effect == "conductance" and (r.at, r.source) in known]
    paths = found.answers().values() if leaks else ()
    return [
        replace(r, effect="loss", parameters=FrozenMap(), refitted=False)
        for r in leaks
        if all(s in p.slots and _keeps_sign(p.signal(s)) for p in paths for s in split_sources(r.source, r.at))
    ]


def _keeps_sign(signal: Array) -> bool:
    return bool((signal > 0.0).all() or (signal < 0.0).all())


def _as_droop(rival: Rival, k: float, droop: bool) -> list[Rival]:
    """Droops that equal the rival: a negative coupling is a droop without deadband."""
    if rival.effect != "coupling" or k >= 0 or not droop:
        return []
    return [replace(rival, effect="droop", parameters=FrozenMap({"k": -k}), refitted=False)]


def separating(groups: Sequence[Sequence[Rival]], recorded: Collection[str]) -> Mapping[str, Any]:
    """For each set with more than one member what would tell them apart, in words; empty where there is none."""
    texts = []
    for group in groups:
        if len(group) > 1:
            first = group[0]
            told = advice(first.effect, [(r.effect, r.at) for r in group[1:]], first.at, recorded)
            if told:
                texts.append(told)
    return {"text": ". ".join(t[:1].upper() + t[1:] for t in texts)} if texts else {}
