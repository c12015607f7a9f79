"""Findings of effects, values and components, with their sentences, and descriptions of forms outside the catalogue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from hvdc_ident.discrepancy.hypothesis import Refit, built_in, uncertainty_of
from hvdc_ident.discrepancy.options import CERTAIN, SearchContext
from hvdc_ident.discrepancy.result import CARD, DescribedForm, EffectSize, Finding, FoundEffect, Place, Rival, ValueAt
from hvdc_ident.discrepancy.rivals import EffectClass, credible
from hvdc_ident.discrepancy.score import Ruler, apart, implied
from hvdc_ident.discrepancy.sentences import (
    base_factor,
    card_sentence,
    elsewhere,
    expression,
    interval_sentence,
    labelled,
    sentence,
    value_sentence,
    with_values,
)
from hvdc_ident.effects import effects
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import listed

SHARED = ("s", "rad/s", "Hz", "")
"""Units of parameters that mean the same at every place."""


def finding(
    one: EffectClass,
    put_in: FoundEffect | None = None,
    values: Mapping[str, EffectSize] | None = None,
    *,
    with_intervals: bool = True,
) -> Finding:
    """The class in a sentence: what one of its likely members does, and where else it may be.

    put_in: what was put into the model: where that is a likely member, it is the one, with its sizes beside all other effects;
    else it is the likeliest, as its own refit has it. values: of the model's own parameters beside what was put in.
    with_intervals: whether the sentence has the intervals of the sizes.
    """
    likely_ones = credible(one.members)
    there = next((r for r, _ in likely_ones if put_in is not None and _key(r) == _key(put_in)), None)
    own = put_in if there else None
    best = there or one.best
    parameters = {}
    for n, q in effects()[best.effect].parameters.items():
        if n not in best.parameters or (q.optional and best.parameters[n] == q.neutral):
            continue
        same = [r for r, _ in likely_ones if r.effect == best.effect and (q.unit in SHARED or r is best)]
        spans = [s for r in same if (s := _span(r, n)) is not None]
        before = EffectSize(best.parameters[n], _span(best, n), q.unit)
        parameters[n] = _over_places(before if own is None else own.parameters.get(n, before), before, spans)
    late = best.late if own is None else own.late
    delay = None
    if late is not None and best.late is not None:
        spans = [s for r, _ in likely_ones if (s := _delay_span(r)) is not None]
        before = EffectSize(best.late, _delay_span(best), "s")
        delay = _over_places(EffectSize(late, _moved(before, late), "s"), before, spans)
    by_place: dict[tuple[tuple[str, ...], str], float] = {}
    for r, p in likely_ones:
        by_place[r.at, r.source] = by_place.get((r.at, r.source), 0.0) + p / one.probability
    each = _one_each(likely_ones, best)
    shown = [
        Place(at, p, source, r.effect, _with_spans(r), r.values)
        for (at, source), p in sorted(by_place.items(), key=lambda kv: (kv[0] != (best.at, best.source), -kv[1]))
        for r in [each[at, source]]
    ]
    if own is not None and (shown[0].at, shown[0].source) == (best.at, best.source):
        # Values that effects found later have moved are not to be compared with those of the other places.
        latest = FrozenMap(values) if values and not apart(best.values, values) else best.values
        shown[0] = replace(shown[0], parameters=own.parameters, values=latest)
    places = tuple(shown)
    does = (
        own.text if own is not None else sentence(best, best.parameters, with_values(best.expression, best.parameters))
    )
    sizes = interval_sentence(parameters) if with_intervals else ""
    text = f"{does}{sizes}{_others(one, best)}{elsewhere(best, places)}."
    return Finding(best.effect, _names(one, best.effect), one.probability, FrozenMap(parameters), places, text, delay)


def finding_beside(one: Rival, probability: float, search: SearchContext) -> Finding:
    """The finding that a stated value is another, or a component of another type."""
    refit, (name,) = one.refit, one.at
    assert refit is not None
    if one.effect == CARD:
        sizes = {n: v for n, v in implied(refit).items() if n.startswith(f"{name}.")}
        text = card_sentence(name, one.source, search.components.get(name), sizes)
    else:
        stated = next(f.given for f in (*search.held, *search.stated) if f.name == name)
        value, std, unit = refit.values[name], refit.std.get(name), refit.model.parameters[name].unit
        sizes = {name: EffectSize(value, None if std is None else (value - 1.96 * std, value + 1.96 * std), unit)}
        error = 0.0 if std is None else 2.0 * std / abs(value)
        known = base_factor(refit.model, unit, value / stated, error) if stated else ""
        text = value_sentence(name, value, std, stated, unit, known)
    place = Place(one.at, 1.0, one.source, one.effect, FrozenMap(sizes))
    return Finding(one.effect, (one.effect,), probability, FrozenMap(sizes), (place,), text)


def _one_each(members: Sequence[tuple[Rival, float]], best: Rival) -> dict[tuple[tuple[str, ...], str], Rival]:
    """Return by place and source one hypothesis: of the effect of `best` where that was refitted, else the likeliest that was."""
    order = sorted((r for r, _ in members), key=lambda r: (r is not best, not r.refitted, r.effect != best.effect))
    return {(r.at, r.source): r for r in reversed(order)}


def _with_spans(rival: Rival) -> FrozenMap[EffectSize]:
    """The sizes of a hypothesis with their intervals; none that its effect does not have there."""
    known = effects()[rival.effect].parameters
    sizes = {
        n: v for n, v in rival.parameters.items() if n in known and not (known[n].optional and v == known[n].neutral)
    }
    return FrozenMap({n: EffectSize(v, _span(rival, n), known[n].unit) for n, v in sizes.items()})


def values_by_place(each: Sequence[Finding]) -> dict[str, tuple[ValueAt, ...]]:
    """Return by parameter of the model its value at every likely place of findings that stand for one effect, where these differ.

    A value that is the same at all of them, within its interval, is left out: it does not depend on what is missing where.
    """
    places = [p for f in each for p in f.places if p.values]
    names = dict.fromkeys(n for one, other in combinations(places, 2) for n in apart(one.values, other.values))
    return {
        n: tuple(
            ValueAt(p.values[n].value, p.values[n].ci95, p.values[n].unit, p.effect, p.at, p.source)
            for p in places
            if n in p.values
        )
        for n in names
    }


def _over_places(size: EffectSize, before: EffectSize, spans: Sequence[tuple[float, float]]) -> EffectSize:
    """The size with its interval wider by as much as its likely places make it.

    before: the same where nothing was put in after it; spans: the intervals at the likely places.
    """
    # At a place where the size is another, of other sign say, it is no uncertainty of this one.
    alike = [s for s in spans if s[0] <= before.value <= s[1]]
    (low, high), (first, last) = (s.ci95 or (None, None) for s in (size, before))
    if not alike or low is None or high is None or first is None or last is None:
        return size
    return replace(size, ci95=(low - first + min(s[0] for s in alike), high - last + max(s[1] for s in alike)))


def _delay_span(rival: Rival) -> tuple[float, float] | None:
    """The 95 % interval of a rival's equivalent delay, s; None for what is no delay, and where more than one size makes it, for
    how these go together is not known here."""
    spans = {n: s for n in rival.parameters if (s := _span(rival, n)) is not None}
    if rival.late is None or len(spans) != 1:
        return None
    ((name, ends),) = spans.items()
    low, high = (effects()[rival.effect].delay_with({**rival.parameters, name: end}) for end in ends)
    return None if low is None or high is None else (min(low, high), max(low, high))


def _moved(before: EffectSize, value: float) -> tuple[float | None, float | None] | None:
    """The interval of a size, moved with it to another value."""
    low, high = before.ci95 or (None, None)
    return None if low is None or high is None else (low + value - before.value, high + value - before.value)


def _equation(one: str, other: str) -> bool:
    """Return True for two names that may stand for one equation."""
    return one == other or one in effects()[other].equals or other in effects()[one].equals


def _key(rival: Rival | FoundEffect) -> tuple[str, tuple[str, ...], str]:
    return rival.effect, rival.at, rival.source


def _span(rival: Rival, name: str) -> tuple[float, float] | None:
    """The 95 % interval of a parameter of a rival; None where it is not known."""
    refit = rival.refit
    if refit is None or not rival.refitted:
        return None
    placed = refit.placed[-1]
    std, value = refit.std.get(placed.names.get(name, "")), refit.sizes(placed).get(name)
    if std is None or value is None:
        return None
    q = effects()[placed.candidate.effect].parameters[name]
    return max(value - 1.96 * std, q.min), min(value + 1.96 * std, q.max)


def _likely(one: EffectClass) -> list[str]:
    """The effects of a class that the records do not distinguish from its best, the likeliest first: whether one does the same is for
    the data alone to say, however many places each was looked for at."""
    least = min(r.delta_bic for r, _ in one.members)
    near = {r.same_as or r.effect for r, _ in one.members if np.exp(0.5 * (least - r.delta_bic)) >= 1.0 - CERTAIN}
    return [n for n in one.equations if n in near]


def _names(one: EffectClass, own: str) -> tuple[str, ...]:
    """The names of a class: its own, then those of its likely effects, each followed by others for the same equation."""
    alike = [r.effect for name in _likely(one) for r, _ in one.members if (r.same_as or r.effect) == name]
    return tuple(dict.fromkeys((own, *alike)))


def _others(one: EffectClass, best: Rival) -> str:
    """The other effects of a class than its best, as its sentence goes on."""
    others = [n for n in _likely(one) if n in one.kinds and not _equation(n, best.effect)]
    kind = (
        "another kind of delay as long"
        if best.late is not None
        else "another effect that does the same in these records"
    )
    return f", or {kind} ({', '.join(others)})" if others else ""


def described(before: Refit, form: Refit, others: Sequence[Refit] = ()) -> DescribedForm:
    """Return the description of a form, which is compiled into its model: its formula, its transfer function or its curve.

    before: the model without it; others: refits of other forms, or of the same elsewhere, that explain as much.
    """
    gain = Ruler.of(form).between(before, form)
    refit = built_in(before, form)
    placed = refit.placed[-1]
    if refit.failure:
        text = f"{labelled(form)} explains it, but cannot be put into the model: {refit.failure}"
        return DescribedForm("nothing", placed.candidate.at[0], text)
    entry, (place,) = effects()[placed.candidate.effect], placed.candidate.at
    said = [f"Found from the data, outside the catalogue: {sentence(placed.candidate, refit.sizes(placed))}."]
    if others:
        said.append(f"As good: {listed([labelled(r) for r in others])}.")
    text = " ".join(said)
    if entry.outside == "curve":
        return DescribedForm("curve", place, text, delta_bic=gain, curve=_curve(refit), refit=refit)
    return DescribedForm(entry.outside, place, text, expression(refit), _coefficients(refit), gain, refit=refit)


def _coefficients(refit: Refit) -> FrozenMap[Any]:
    """Return by parameter of the form its value, and the interval that holds it in 95 of 100 cases where that is known."""
    placed, shown = refit.placed[-1], {}
    for n, name in placed.names.items():
        value, std = refit.sizes(placed)[n], refit.std.get(name)
        shown[n] = {"value": value, "ci95": None if std is None else [value - 1.96 * std, value + 1.96 * std]}
    return FrozenMap(shown)


def _curve(refit: Refit) -> dict[str, Any]:
    """Return the curve {over, at, value, std}: what is added, with its standard deviation where the records determine it."""
    placed = refit.placed[-1]
    entry, sizes = effects()[placed.candidate.effect], refit.sizes(placed)
    assert entry.curve is not None
    known = uncertainty_of(refit.problem, refit.problem.blocks(refit.theta))
    at, value = entry.curve(sizes)
    names = [n for n in placed.bounds if n in placed.names]
    slopes = np.column_stack(
        [entry.curve({**sizes, n: sizes[n] + 1.0})[1] - value for n in names]
    )  # it is linear in each
    where = [known.names.index(placed.names[n]) for n in names]
    variance = np.einsum("ij,jk,ik->i", slopes, known.corrected[np.ix_(where, where)], slopes)
    unknown = [placed.names[n] in known.reasons for n in names]
    hidden = np.any(slopes[:, unknown] != 0.0, axis=1)
    std = [None if h else float(np.sqrt(max(v, 0.0))) for v, h in zip(variance, hidden, strict=True)]
    over = (placed.candidate.source or placed.candidate.at[0]).removeprefix("outputs.")
    return {"over": over, "at": at.tolist(), "value": value.tolist(), "std": std}
