"""Effects in words, with their sizes and intervals."""

from __future__ import annotations

from collections.abc import Mapping

from hvdc_ident.discrepancy.refit import Placed, Refit
from hvdc_ident.discrepancy.result import Found, Size
from hvdc_ident.effects import effects
from hvdc_ident.frozen import FrozenMap


def found_of(refit: Refit, placed: Placed, chosen_from: int) -> Found:
    """An effect of the refitted model with its sizes, their 95 % intervals, and its sentence."""
    entry = effects()[placed.candidate.effect]
    sizes = refit.sizes(placed)
    shown = {}
    for n, q in entry.parameters.items():
        if n in sizes and not (q.optional and sizes[n] == q.neutral):
            std = refit.std.get(placed.names.get(n, ""))
            interval = None if std is None else _within(sizes[n] - 1.96 * std, sizes[n] + 1.96 * std, q.min, q.max)
            shown[n] = Size(sizes[n], interval, q.unit)
    return Found(
        placed.candidate.effect, placed.candidate.at, FrozenMap(shown), sentence(placed, sizes), chosen_from,
        placed.candidate.source,
    )  # fmt: skip


def _within(low: float, high: float, least: float, most: float) -> tuple[float, float]:
    return max(low, least), min(high, most)


def sentence(placed: Placed, sizes: Mapping[str, float]) -> str:
    """The effect's sentence from the catalogue, filled in."""
    entry = effects()[placed.candidate.effect]
    units = {n: q.unit for n, q in entry.parameters.items()}
    words = {n: f"{v:.4g} {units.get(n, '')}".rstrip() for n, v in sizes.items()}
    words |= {"at": " and ".join(_listed(placed.candidate.at)), "from": placed.candidate.source}
    text = entry.sentence
    for name, value in words.items():
        text = text.replace("{" + name + "}", value)
    return text[:1].upper() + text[1:] if text and not text.startswith(placed.candidate.at[0]) else text


def _listed(names: tuple[str, ...]) -> tuple[str, ...]:
    return names if len(names) < 3 else (", ".join(names[:-1]), names[-1])


def advice(first: str, others: list[tuple[str, tuple[str, ...]]], at: tuple[str, ...]) -> str:
    """What experiment or record would tell the members of an ambiguity set apart."""
    entry = effects()[first]
    parts = []
    for name in dict.fromkeys(n for n, _ in others if n != first):
        told = entry.confusable.get(name) or effects()[name].confusable.get(first)
        parts.append(f"{first} or {name}: {told or f'{entry.excited_by}; {effects()[name].excited_by}'}")
    elsewhere = dict.fromkeys(p for n, a in others if n == first and a != at for p in a if p not in at)
    if elsewhere:
        parts.append(
            f"which place: record {', '.join(dict.fromkeys([*at, *list(elsewhere)[:6]]))} beside the present outputs, "
            f"and move the inputs on either side of them"
        )
    return "; ".join(parts)
