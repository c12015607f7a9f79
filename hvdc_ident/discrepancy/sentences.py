"""Effects in words, with their sizes and intervals."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.hypothesis import Placed, Refit, uncertainty_of
from hvdc_ident.discrepancy.options import LISTED
from hvdc_ident.discrepancy.prediction import held_out
from hvdc_ident.discrepancy.result import EffectSize, Finding, FoundEffect, Gap, Place, Rival, StandIn, Table
from hvdc_ident.effects import effects, split_sources
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.fit.noise import SURE
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import figures, gap_text, listed, quantity


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
    found = moved_parameters(last, [f.name for f in last.problem.free])
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


def beside_stand_ins(moved: Finding, others: Sequence[StandIn]) -> Finding:
    """The finding on parameters that are off, beside the effects that explain the records as well with these as given."""
    if not others:
        return moved
    others_text = "; or ".join(f"{s.text} (with {listed(s.values)} as given)" for s in others[:LISTED])
    more = f"; or one of {len(others) - LISTED} more effects" if len(others) > LISTED else ""
    text = moved.text.replace("No effect is missing:", "No effect is needed:")
    return replace(moved, text=f"{text} The records do not distinguish this from: {others_text}{more}.")


def moved_parameters(last: Refit, names: Collection[str]) -> Finding | None:
    """The parameters, of those named, whose estimates are clearly off the given values, as one finding; None where none is."""
    problem = last.problem
    known = uncertainty_of(problem, problem.blocks(last.theta))
    sizes, texts = {}, []
    for k in last.gains:
        free, value, std = problem.free[k], float(last.theta[k]), known.std(problem.free[k].name)
        # A value on its bound is no estimate.
        if free.name not in names or free.on_bound(value) or std is None or abs(value - free.given) <= SURE * std:
            continue
        unit = last.model.parameters[free.name].unit
        sizes[free.name] = EffectSize(value, (value - 1.96 * std, value + 1.96 * std), unit)
        texts.append(f"{free.name} is {quantity(value, unit)}, not {quantity(free.given, unit)}")
    if not sizes:
        return None
    places = tuple(Place((n,), 1.0) for n in sizes)
    return Finding("parameter", ("parameter",), 1.0, FrozenMap(sizes), places, f"{listed(texts)}.")
