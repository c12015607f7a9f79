"""Effects in words, with their sizes and intervals."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from hvdc_ident.discrepancy.findings.conclusion import EffectSize, FoundEffect
from hvdc_ident.discrepancy.refits.begin import Placed
from hvdc_ident.discrepancy.refits.refit import Refit
from hvdc_ident.effects import effects
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import listed, quantity

MOST_PLACES = 4
"""Signals at most that are asked for."""


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
        placed.candidate.effect, placed.candidate.at, FrozenMap(shown), sentence(placed, sizes), chosen_from,
        placed.candidate.source,
    )  # fmt: skip


def _within(low: float, high: float, least: float, most: float) -> tuple[float, float]:
    return max(low, least), min(high, most)


def sentence(placed: Placed, sizes: Mapping[str, float]) -> str:
    """The effect's sentence from the catalogue, filled in."""
    entry = effects()[placed.candidate.effect]
    units = {n: q.unit for n, q in entry.parameters.items()}
    words = {n: quantity(v, units.get(n, "")) for n, v in sizes.items()}
    at = placed.candidate.at
    own = dict.fromkeys(placed.candidate.sources)
    brought = f"its own of {listed(tuple(own))}" if len(own) > 1 else placed.candidate.source
    words |= {"at": f"each of {listed(at)}" if len(at) > 1 else at[0], "from": brought}
    if (late := entry.delay_with(sizes)) is not None:
        words["equivalent_delay"] = quantity(late, "s")
    text = entry.sentence
    for name, value in words.items():
        text = text.replace("{" + name + "}", value)
    return text[:1].upper() + text[1:] if text and not text.startswith(at[0]) else text


def advice(
    first: str, others: list[tuple[str, tuple[str, ...]]], at: tuple[str, ...], recorded: Collection[str] = ()
) -> str:
    """Experiment or record that would tell the members of an ambiguity set apart, in words; nothing already recorded."""
    entry = effects()[first]
    parts = []
    for name in dict.fromkeys(n for n, _ in others if n != first):
        told = entry.confusable.get(name) or effects()[name].confusable.get(first)
        parts.append(f"{first} or {name}: {told or f'{entry.excited_by}; {effects()[name].excited_by}'}")
    wanted = [at[0]]  # a signal of each place that is not of the others
    for name, place in others:
        own = [p for p in place if p not in at] or [p for p in at if p not in place]
        if name == first and own and own[0] not in wanted and len(wanted) < MOST_PLACES:
            wanted.append(own[0])
    if len(wanted) > 1:
        wanted = list(dict.fromkeys(p.removeprefix("outputs.") for p in wanted))
        missing = [p for p in wanted if p not in recorded]
        record = f"record {listed(missing)} as well, and " if missing else ""
        parts.append(f"{record}step what acts on one side of {listed(wanted)} and not on the other")
    return "; ".join(parts)
