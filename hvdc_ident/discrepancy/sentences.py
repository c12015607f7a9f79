"""Effects in words, with their sizes and intervals."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import sympy as sp

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import Placed, Refit
from hvdc_ident.discrepancy.movable import equations
from hvdc_ident.discrepancy.options import LISTED, DiagnosisOptions
from hvdc_ident.discrepancy.prediction import held_out
from hvdc_ident.discrepancy.result import (
    CARD,
    VALUE,
    EffectSize,
    Finding,
    FoundEffect,
    Gap,
    Place,
    Rival,
    StandIn,
    Table,
)
from hvdc_ident.discrepancy.score import apart, implied, off_by_more_than_chance
from hvdc_ident.discrepancy.search import GIVEN, SearchOutcome
from hvdc_ident.effects import effects, split_sources
from hvdc_ident.errors import SimulationError
from hvdc_ident.expression import parse, symbol, to_text
from hvdc_ident.fit import Problem
from hvdc_ident.fit.noise import SURE
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.text import figures, figures_of, gap_text, listed, quantity


def found_of(refit: Refit, placed: Placed, chosen_from: int) -> FoundEffect:
    """An effect of the refitted model with its sizes, their 95 % intervals, and its sentence."""
    entry = effects()[placed.candidate.effect]
    sizes = refit.sizes(placed)
    shown = {}
    for n, q in entry.parameters.items():
        if n in sizes and not (q.optional and sizes[n] == q.neutral):
            std = refit.std.get(placed.names.get(n, ""))
            interval = None if std is None else _within(sizes[n] - 1.96 * std, sizes[n] + 1.96 * std, q.min, q.max)
            shown[n] = EffectSize(sizes[n], interval, q.unit)
    return FoundEffect(
        placed.candidate.effect, placed.candidate.at, FrozenMap(shown), sentence(placed.candidate, sizes), chosen_from,
        placed.candidate.source,
    )  # fmt: skip


def _within(low: float, high: float, least: float, most: float) -> tuple[float, float]:
    return max(low, least), min(high, most)


def sentence(of: CandidateEffect | Rival, sizes: Mapping[str, float], expression: str = "") -> str:
    """The effect's sentence from the catalogue, filled in; without sizes its name and place. expression: of a term, filled in."""
    entry = effects()[of.effect]
    if not sizes:
        return f"{of.effect} at {listed(of.at)}"
    units = {n: q.unit for n, q in entry.parameters.items()}
    words = {n: quantity(v, units.get(n, "")) for n, v in sizes.items()}
    at, own = of.at, dict.fromkeys(split_sources(of.source, of.at))
    brought = f"its own of {listed(tuple(own))}" if len(own) > 1 else of.source
    words |= {"at": f"each of {listed(at)}" if len(at) > 1 else at[0], "from": brought, "expression": expression}
    if (late := entry.delay_with(sizes)) is not None:
        words["equivalent_delay"] = quantity(late, "s")
    if entry.words is not None:
        words |= entry.words(sizes)
    absent = {n for n, q in entry.parameters.items() if q.optional and sizes.get(n, q.neutral) == q.neutral}
    absent |= {n for n, q in entry.parameters.items() if q.fixed and sizes.get(n) == 0.0}
    text = _without(entry.sentence, absent)
    for name, value in words.items():
        text = text.replace("{" + name + "}", value)
    return text[:1].upper() + text[1:] if text and not text.startswith(at[0]) else text


def _without(sentence: str, absent: Collection[str]) -> str:
    """Return an effect's sentence without the bracketed summands, or the bracketed part, of absent parameters, and without the
    brackets."""
    whole = re.search(r"\[.*\]", sentence)
    if whole is None:
        return sentence
    summands = re.findall(r"\[(.*?)\]", whole[0])
    kept = [s for s in summands if not any(f"{{{n}}}" in s for n in absent)]
    return sentence.replace(whole[0], " + ".join(kept))


def advice(
    first: str, others: list[tuple[str, tuple[str, ...]]], at: tuple[str, ...], recorded: Collection[str] = ()
) -> str:
    """Return the experiment or record that would distinguish the members of an ambiguity set, in words; nothing already recorded."""
    entry = effects()[first]
    parts = []
    for name in dict.fromkeys(n for n, _ in others if n != first):
        how = entry.confusable.get(name) or effects()[name].confusable.get(first)
        parts.append(f"{first} or {name}: {how or f'{entry.excited_by}; {effects()[name].excited_by}'}")
    wanted = [at[0]]  # a signal of each place that is not of the others
    for name, place in others:
        own = [p for p in place if p not in at] or [p for p in at if p not in place]
        if name == first and own and own[0] not in wanted and len(wanted) < LISTED:
            wanted.append(own[0])
    if len(wanted) > 1:
        wanted = list(dict.fromkeys(p.removeprefix("outputs.") for p in wanted))
        missing = [p for p in wanted if p not in recorded]
        if missing:
            parts.append(
                f"record {listed(missing)} as well: what is missing sits before the first signal that shows it"
            )
        else:
            parts.append(f"step an input that acts on some of {listed(wanted)} and not on the others")
    return "; ".join(parts)


def gap(given: Refit, refitted: Refit, augmented: Refit) -> Gap:
    """RMSE by output and experiment of the model with the given gains, refitted, and with the effects."""
    tables = [_tables(r.problem, r.theta) for r in (given, refitted, augmented)]
    pooled: dict[str, Mapping[str, float | None]] = {
        name: {"fit": _pooled(r.problem, r.theta), "holdout": r.unseen if name != "nominal" else _held(r)}
        for name, r in (("nominal", given), ("refitted", refitted), ("augmented", augmented))
    }
    was, now = refitted.unseen, augmented.unseen
    shrink = None if was is None or now is None or not was > 0 or not np.isfinite(was) else 1.0 - now / was
    floor = {o: n.std for o, n in refitted.noise.items() if n.std is not None}
    held = "experiments" if refitted.holdout is not None else "parts of the fitted experiments, predicted from the rest"
    return Gap(tables[0], tables[1], tables[2], FrozenMap(floor), pooled, shrink, held)


def _tables(problem: Problem, theta: Array) -> dict[str, Table]:
    roles = {e.name: e.role for e in problem.experiments}
    found: dict[str, dict[str, dict[str, float | None]]] = {"fit": {}, "holdout": {}}
    for output, row in problem.rmse(theta).items():
        for name, value in row.items():
            found[roles[name]].setdefault(output, {})[name] = value
    return dict(found)


def _pooled(problem: Problem, theta: Array) -> float | None:
    try:
        blocks = problem.blocks(theta, derivatives=False)
    except SimulationError:
        return None
    return float(np.sqrt(np.mean(np.concatenate([b.squares for b in blocks]))))


def _held(refit: Refit) -> float | None:
    """The held-out residual of the given gains; None without held-out experiments, or where a run fails."""
    blocks = held_out(refit.problem, refit.theta)
    return float(np.sqrt(np.mean(np.concatenate([b.squares for b in blocks])))) if blocks else None


def at_given(refitted: Refit, given: Mapping[str, float]) -> Refit:
    """The nominal model at the given values, nuisances as they were found. given: of all candidates, held ones too."""
    held = refitted.problem.held | {n: v for n, v in given.items() if n in refitted.problem.held}
    return replace(refitted, problem=replace(refitted.problem, held=held), theta=refitted.theta_at_given)


def off_given(last: Refit, given: Refit, adequate: bool, matters: bool, *, known: bool = True) -> Finding | None:
    """The parameters of a model without effects that explain its gap at the given values; None where it shows none there.

    last: the model, refitted; given: the same at the given values. adequate: whether what `last` leaves looks like noise, which is
    then the noise, as loud as it is; matters: whether that is clearly louder than was supposed, or beyond the tolerance. known:
    whether the noise is: taken from the misfit it does not tell that nothing is missing.
    """
    try:
        before = sum(b.chi2 for b in given.problem.blocks(given.theta, derivatives=False))
    except SimulationError:  # with the values as given it need not run
        return None
    if before <= last.chi2 + SURE * np.sqrt(2.0 * last.rows):
        return None
    found = moved_parameters(last)
    if found is None:
        return None
    noise = max(last.chi2, last.rows) if adequate else last.rows
    share = 1.0 - max(last.chi2 - noise, 0.0) / (before - noise)
    explains, louder = (
        f"That explains {gap_text(share)} of the gap",
        f"{figures(np.sqrt(last.chi2 / last.rows), 3)} times",
    )
    if not known:  # what is left is no gap beyond noise, whatever it is: none of it tells of a share
        return found
    if matters and not adequate:
        rest = (
            f"what remains is {louder} the noise and does not look like noise, but no effect that was tried explains it"
        )
        text = f"{found.text} {explains}; {rest}."
    else:
        text = f"No effect is missing: {found.text} {explains}"
        text += f"; what remains looks like noise, {louder} as loud as supposed." if matters else "."
    return replace(found, text=text, share=share)


def stand_ins(outcome: SearchOutcome, options: DiagnosisOptions) -> tuple[StandIn, ...]:
    """Return the effects that explain the records as well as other values of the parameters, with these as given, the best first."""
    found = []
    for h, score in outcome.pool:
        given = [n for t in h.terms if t.kind == GIVEN for n in t.at]
        behind = score - h.prior_cost
        if given and behind <= options.set_bic:
            c, sizes = h.refit.placed[-1].candidate, FrozenMap(h.refit.sizes(h.refit.placed[-1]))
            values = FrozenMap({f.name: f.given for f in outcome.refit.problem.free if f.name in given})
            found.append(StandIn(c.effect, c.at, max(behind, 0.0), sizes, values, sentence(c, sizes), c.source))
    return tuple(sorted(found, key=lambda s: round(s.delta_bic, 1)))  # as good is as good: then as it was found


def beside_stand_ins(moved: Finding, others: Sequence[StandIn]) -> Finding:
    """The finding on parameters that are off, beside the effects that explain the records as well with these as given."""
    if not others:
        return moved
    others_text = "; or ".join(f"{s.text} (with {listed(s.values)} as given)" for s in others[:LISTED])
    more = f"; or one of {len(others) - LISTED} more effects" if len(others) > LISTED else ""
    text = moved.text.replace("No effect is missing:", "No effect is needed:")
    return replace(moved, text=f"{text} The records do not distinguish this from: {others_text}{more}.")


def moved_parameters(last: Refit) -> Finding | None:
    """The parameters whose estimates are clearly off the given values, as one finding; None where none is."""
    known = implied(last)
    sizes = {n: known[n] for n in off_by_more_than_chance(last)}
    if not sizes:
        return None
    given = {f.name: f.given for f in last.problem.free}
    texts = [f"{n} is {quantity(v.value, v.unit)}, not {quantity(given[n], v.unit)}" for n, v in sizes.items()]
    places = tuple(Place((n,), 1.0) for n in sizes)
    return Finding("parameter", ("parameter",), 1.0, FrozenMap(sizes), places, f"{listed(texts)}.")


def in_words(rival: Rival) -> str:
    """Return what a stated value that is another, or a component of another type, is called beside effects."""
    (name,) = rival.at
    return f"another value of {name}" if rival.effect == VALUE else f"{rival.source} as {name}"


def card_sentence(component: str, card: str, there: str | None, sizes: Mapping[str, EffectSize]) -> str:
    """The sentence that a component is of another type, or missing. there: the card that the model has."""
    each = listed([f"{n} {quantity(v.value, v.unit)}" for n, v in sizes.items()])
    text = (
        f"{component} answers like {card}, not like {there.upper()}" if there else f"{card} is missing as {component}"
    )
    return f"{text} ({each})." if each else f"{text}."


def value_sentence(name: str, value: float, std: float | None, stated: float, unit: str, factor: str) -> str:
    """The sentence that a stated value is another.

    std: its standard deviation, None where it is not known; factor: what the ratio is (`base_factor`).
    """
    around = "" if std is None else f" ± {quantity(1.96 * std, unit, 2)}"
    return f"{name} is {quantity(value, unit)}{around}, not {quantity(stated, unit)}{factor}."


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


def labelled(refit: Refit) -> str:
    """Return the form that a refit ends with, and where."""
    c = refit.placed[-1].candidate
    return f"{expression(refit, filled=True) or c.effect} at {listed(c.at)}"


def expression(refit: Refit, *, filled: bool = False) -> str:
    """Return what the form that a refit ends with adds, in the model's names, or its transfer function; empty for a curve.

    filled: whether its coefficients stand there as numbers.
    """
    placed = refit.placed[-1]
    c, sizes = placed.candidate, refit.sizes(placed)
    entry = effects()[c.effect]
    if entry.outside == "curve":
        return ""
    if entry.words is not None:
        return entry.words(sizes)["transfer"]
    alone = equations(c.effect, entry.present(sizes))
    names = {"u": c.at[0].removeprefix("outputs."), "source": c.source.removeprefix("outputs.")}
    known = {symbol(n): symbol(name) for n, name in names.items() if name}
    text = to_text((alone.outputs["y"].value - symbol("u")).expand().xreplace(known))
    return with_values(text, sizes) if filled else text


def with_values(text: str, sizes: Mapping[str, float]) -> str:
    """Return a formula with numbers for its coefficients, to four digits."""
    return to_text(parse(text).xreplace({symbol(n): sp.Float(f"{v:.4g}") for n, v in sizes.items()})) if text else ""


def interval_sentence(parameters: Mapping[str, EffectSize]) -> str:
    """The intervals of the sizes, each with its name where there are several."""
    known = {n: s for n, s in parameters.items() if s.ci95 is not None and None not in s.ci95}
    each = []
    for n, s in known.items():
        low, high = (quantity(v, s.unit, figures_of(s.ci95, 4)) for v in s.ci95 or () if v is not None)
        each.append(f"{n} {low} to {high}" if len(parameters) > 1 else f"{low} to {high}")
    return f" (95 %: {', '.join(each)})" if each else ""


def elsewhere(best: Rival, places: Sequence[Place]) -> str:
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
        group = [r for r in group if r.is_effect]
        if len(group) > 1:
            first = group[0]
            # No experiment distinguishes one equation from itself under another name.
            others = [(r.effect, r.at) for r in group[1:] if not r.same_as]
            how = advice(first.effect, others, first.at, recorded)
            if how:
                texts.append(how)
    return {"text": ". ".join(t[:1].upper() + t[1:] for t in texts)} if texts else {}
