"""Findings: an effect class in words, with its sizes, places and what would distinguish it from others."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, permutations
from typing import Any

import numpy as np

from hvdc_ident.discrepancy.classes import EffectClass, credible
from hvdc_ident.discrepancy.expansion import Expansion
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.options import CERTAIN, LISTED, SearchContext
from hvdc_ident.discrepancy.outside import with_values
from hvdc_ident.discrepancy.result import CARD, VALUE, EffectSize, Finding, FoundEffect, Place, Rival, ValueAt
from hvdc_ident.discrepancy.score import apart, implied
from hvdc_ident.discrepancy.search import Kept
from hvdc_ident.discrepancy.sentences import advice, sentence
from hvdc_ident.effects import effects, split_sources
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.text import figures_of, listed, quantity

SHARED = ("s", "rad/s", "Hz", "")
"""Units of parameters that mean the same at every place."""


def finding(
    found: Expansion,
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
    refits = {_key_of(t.refit): t.refit for t in found.trials}
    likely_ones = credible(one.members)
    there = next((r for r, _ in likely_ones if put_in is not None and _key(r) == _key(put_in)), None)
    own = put_in if there else None
    best = there or one.best
    parameters = {}
    for n, q in effects()[best.effect].parameters.items():
        if n not in best.parameters or (q.optional and best.parameters[n] == q.neutral):
            continue
        same = [r for r, _ in likely_ones if r.effect == best.effect and (q.unit in SHARED or r is best)]
        spans = [s for r in same if (s := _span(refits.get(_key(r)), n)) is not None]
        before = EffectSize(best.parameters[n], _span(refits.get(_key(best)), n), q.unit)
        parameters[n] = _over_places(before if own is None else own.parameters.get(n, before), before, spans)
    late = best.late if own is None else own.late
    delay = None
    if late is not None and best.late is not None:
        spans = [s for r, _ in likely_ones if (s := _delay_span(r, refits.get(_key(r)))) is not None]
        before = EffectSize(best.late, _delay_span(best, refits.get(_key(best))), "s")
        delay = _over_places(EffectSize(late, _moved(before, late), "s"), before, spans)
    by_place: dict[tuple[tuple[str, ...], str], float] = {}
    for r, p in likely_ones:
        by_place[r.at, r.source] = by_place.get((r.at, r.source), 0.0) + p / one.probability
    each = _one_each(likely_ones, best)
    shown = [
        Place(at, p, source, r.effect, _with_spans(r, refits.get(_key(r))), r.values)
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
    sizes = _sizes(parameters) if with_intervals else ""
    text = f"{does}{sizes}{_others(one, best)}{_apart(best, places)}."
    return Finding(best.effect, _names(one, best.effect), one.probability, FrozenMap(parameters), places, text, delay)


def in_words(rival: Rival) -> str:
    """Return what a stated value that is another, or a component of another type, is called beside effects."""
    (name,) = rival.at
    return f"another value of {name}" if rival.effect == VALUE else f"{rival.source} as {name}"


def finding_beside(one: Rival, probability: float, kept: Kept, last: Refit, search: SearchContext) -> Finding:
    """The finding that a stated value is another, or a component of another type, as the best hypothesis has it, or as its own refit has
    it in the stead of that."""
    own = next((t.refit for term, t in kept.others if (term.kind, term.at, term.source) == _key(one)), last)
    is_kept = (kept.term.kind, kept.term.at, kept.term.source) == _key(one)
    refit, (name,) = last if is_kept else own, one.at
    if one.effect == CARD:
        sizes = {n: v for n, v in implied(refit).items() if n.startswith(f"{name}.")}
        each = listed([f"{n} {quantity(v.value, v.unit)}" for n, v in sizes.items()])
        there = search.components.get(name)
        text = (
            f"{name} answers like {one.source}, not like {there.upper()}"
            if there
            else f"{one.source} is missing as {name}"
        )
        text = f"{text} ({each})." if each else f"{text}."
    else:
        stated = next(f.given for f in (*search.held, *search.stated) if f.name == name)
        value, std, unit = refit.values[name], refit.std.get(name), refit.model.parameters[name].unit
        interval = None if std is None else (value - 1.96 * std, value + 1.96 * std)
        sizes = {name: EffectSize(value, interval, unit)}
        around = "" if std is None else f" ± {quantity(1.96 * std, unit, 2)}"
        known = base_factor(refit.model, unit, value / stated, 0.0 if std is None else 2.0 * std / abs(value))
        text = f"{name} is {quantity(value, unit)}{around}, not {quantity(stated, unit)}{known}."
    place = Place(one.at, 1.0, one.source, one.effect, FrozenMap(sizes))
    return Finding(one.effect, (one.effect,), probability, FrozenMap(sizes), (place,), text)


OF_UNITS = FrozenMap(
    {
        "2 pi": (2.0 * math.pi, ("rad/s", "Hz", "1/s")),
        "sqrt 3": (math.sqrt(3.0), ("V", "kV", "A", "kA")),
        "3": (3.0, ("V", "kV", "A", "kA", "Ohm", "ohm")),
        "50 to 60 Hz": (1.2, ("Hz", "rad/s", "H", "mH", "F", "uF")),
    }
)
"""Factors by which a value is off that was given in another unit or for another frequency, with the units of such values."""
SURE_RATIO = 0.01
"""Relative error of a ratio, at two deviations, from which it may be any of several factors: these are a fifth apart and more."""


def base_factor(model: AnyModel, unit: str, ratio: float, error: float) -> str:
    """Return in words the factor of a unit or base that a ratio is; empty where it is none, or known to no better than `SURE_RATIO`.

    A value per unit may be on another of the model's own bases. unit: of the value; error: of the ratio, relative, two deviations.
    """
    if not 0.0 < error < SURE_RATIO:
        return ""
    factors = {n: f for n, (f, units) in OF_UNITS.items() if unit in units}
    if unit in ("", "pu"):
        bases = {n: p.value for n, p in model.parameters.items() if p.unit == "MVA" and p.value > 0.0}
        pairs = ((n, m) for n, m in permutations(bases, 2) if bases[n] > 1.2 * bases[m])
        factors |= {f"the bases {n} and {m}": bases[n] / bases[m] for n, m in pairs}
    near = [n for n, f in factors.items() if min(abs(ratio / f - 1.0), abs(ratio * f - 1.0)) <= error]
    return f" (the ratio is that of {near[0]})" if near else ""


def _one_each(members: Sequence[tuple[Rival, float]], best: Rival) -> dict[tuple[tuple[str, ...], str], Rival]:
    """Return by place and source one hypothesis: of the effect of `best` where that was refitted, else the likeliest that was."""
    order = sorted((r for r, _ in members), key=lambda r: (r is not best, not r.refitted, r.effect != best.effect))
    return {(r.at, r.source): r for r in reversed(order)}


def _with_spans(rival: Rival, refit: Refit | None) -> FrozenMap[EffectSize]:
    """The sizes of a hypothesis with their intervals; none that its effect does not have there."""
    known = effects()[rival.effect].parameters
    sizes = {
        n: v for n, v in rival.parameters.items() if n in known and not (known[n].optional and v == known[n].neutral)
    }
    return FrozenMap({n: EffectSize(v, _span(refit, n), known[n].unit) for n, v in sizes.items()})


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


def _delay_span(rival: Rival, refit: Refit | None) -> tuple[float, float] | None:
    """The 95 % interval of a rival's equivalent delay, s; None for what is no delay, and where more than one size makes it, for
    how these go together is not known here."""
    spans = {n: s for n in rival.parameters if (s := _span(refit, n)) is not None}
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


def _key_of(refit: Refit) -> tuple[str, tuple[str, ...], str]:
    candidate = refit.placed[-1].candidate
    return candidate.effect, candidate.at, candidate.source


def _span(refit: Refit | None, name: str) -> tuple[float, float] | None:
    """The 95 % interval of a parameter of the refit's last effect; None where it is not known."""
    if refit is None:
        return None
    placed = refit.placed[-1]
    std, value = refit.std.get(placed.names.get(name, "")), refit.sizes(placed).get(name)
    if std is None or value is None:
        return None
    q = effects()[placed.candidate.effect].parameters[name]
    return max(value - 1.96 * std, q.min), min(value + 1.96 * std, q.max)


def _sizes(parameters: Mapping[str, EffectSize]) -> str:
    """The intervals of the sizes, each with its name where there are several."""
    known = {n: s for n, s in parameters.items() if s.ci95 is not None and None not in s.ci95}
    each = []
    for n, s in known.items():
        low, high = (quantity(v, s.unit, figures_of(s.ci95, 4)) for v in s.ci95 or () if v is not None)
        each.append(f"{n} {low} to {high}" if len(parameters) > 1 else f"{low} to {high}")
    return f" (95 %: {', '.join(each)})" if each else ""


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


def _apart(best: Rival, places: Sequence[Place]) -> str:
    """The other places and sources, as the sentence goes on; with what each implies where that is another value of a parameter."""
    own = places[0]
    names = list(dict.fromkeys(n for p in places[1:] for n in apart(own.values, p.values)))
    others = [p for p in places[1:] if apart(own.values, p.values)]
    same = [p for p in places if p not in others]
    places_too = list(dict.fromkeys(listed(p.at) for p in same if p.at != best.at))
    sources_too = list(dict.fromkeys(_brought(p.source, p.at) for p in same if p.source and p.source != best.source))
    from_others = [f"this place from {_some(places_too)}"] if places_too else []
    from_others += (
        [f"{_brought(best.source, best.at)} from {_some(sources_too)}"] if best.source and sources_too else []
    )
    from_others += [f"this place from {_with_values(p, names)}" for p in others[:LISTED]]
    from_others += [f"from {len(others) - LISTED} more with other values"] if len(others) > LISTED else []
    then = f", where {_values(own.values, names)}" if others else ""
    return f"{then}; the records do not distinguish {', nor '.join(from_others)}" if from_others else ""


def _with_values(place: Place, names: Sequence[str]) -> str:
    """A place with the sizes of the effect there and the values that it implies."""
    brought = f" with {_brought(place.source, place.at)}" if place.source else ""
    return f"{listed(place.at)}{brought}, where {_values({**place.parameters, **place.values}, [*place.parameters, *names])}"


def _values(sizes: Mapping[str, EffectSize], names: Sequence[str]) -> str:
    return listed(f"{n} is {quantity(sizes[n].value, sizes[n].unit)}" for n in names if n in sizes)


def _brought(source: str, at: Sequence[str]) -> str:
    """The signals that an effect brings in at its places, in words."""
    return listed(tuple(dict.fromkeys(split_sources(source, at))))


def _some(names: Sequence[str]) -> str:
    """Up to four names, and how many more there are."""
    return listed(names[:4]) if len(names) <= 4 else f"{', '.join(names[:4])} or one of {len(names) - 4} more"


def separating(groups: Sequence[Sequence[Rival]], recorded: Collection[str]) -> Mapping[str, Any]:
    """For each set with more than one member what would distinguish them, in words; empty where there is none."""
    texts = []
    for group in groups:
        values = [r.at[0] for r in group if r.effect == VALUE]
        if values and len(group) > 1:
            texts.append(f"a value of {listed(values)} from another source, or a record in which they act apart")
        cards = [r.source for r in group if r.effect == CARD]
        if cards and len(group) > 1:
            texts.append(f"the type of the component ({listed(cards)}) from its vendor, or a larger step")
        group = [r for r in group if r.in_catalogue]
        if len(group) > 1:
            first = group[0]
            # No experiment distinguishes one equation from itself under another name.
            others = [(r.effect, r.at) for r in group[1:] if not r.same_as]
            how = advice(first.effect, others, first.at, recorded)
            if how:
                texts.append(how)
    return {"text": ". ".join(t[:1].upper() + t[1:] for t in texts)} if texts else {}
