"""What the diagnosis of a unit tells, beside the truth. See README.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from units import Card, Hidden, Plant

NEAR = 0.05
"""Share of the truth within which an estimate is near it."""


@dataclass(frozen=True)
class Told:
    """One thing that a diagnosis tells: an effect at a place, a card for a part of the unit, or the value of a parameter."""

    effect: str
    place: str
    card: str = ""

    def __str__(self) -> str:
        return f"{' '.join(filter(None, (self.effect, self.card)))} at {self.place}"


def judged(plant: Plant, diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """Return the diagnosis beside the truth.

    effect: named, place (the effect at another place), covered (among the likely places or in the ambiguity set), wrong, or held (no
    name: the text says why). parameter: found (the 95 % interval has the truth in it), near (the value is within `NEAR` of it), or wrong.
    card and named, of units with a wrong card or value: named, covered (among those of an ambiguous diagnosis), wrong, or held.
    """
    findings, verdict = diagnosis["findings"], diagnosis["verdict"]
    effects = [f for f in findings if f["effect"] != "parameter"]
    first = [t for f in effects for t in _at(f["effect"], f, _places(f)[0])]
    likely = [t for f in effects for n in f["same_as"] or [f["effect"]] for p in _places(f) for t in _at(n, f, p)]
    others = [t for group in diagnosis["ambiguity"] for r in group for t in _at(r["effect"], r, r)]
    told = likely + others
    found: dict[str, Any] = {}
    if isinstance(plant.hidden, Hidden):
        found |= {"effect": _effect_outcome(plant.hidden, verdict, first, told), "hidden": plant.hidden.told}
    elif isinstance(plant.hidden, Card):
        card = plant.hidden
        outcome = _outcome(verdict, [_is(card, t) for t in first], [_is(card, t) for t in told])
        found |= {"card": outcome, "true": card.model, "stated": ", ".join(card.stated)}
    else:
        values = [f["parameters"] for f in findings if f["effect"] == "parameter"]
        right = [plant.wrong in v for v in values]
        beside = [plant.wrong == t.place for t in others]
        found |= {"named": _outcome(verdict, right + [False for _ in first], right + beside)}
        first = [Told("value", n) for v in values for n in v] + first
    if plant.wrong:
        size = _value(plant, diagnosis, effects)
        found |= {"parameter": _parameter_outcome(plant, size), "wrong": plant.wrong, "said": plant.said()}
        found |= {"truth": plant.truth(), **size}
    return found | {
        "verdict": verdict,
        "text": diagnosis["text"],
        "told": sorted({str(t) for t in first}),
        "also": sorted({str(t) for t in {*told} - {*first}}),
        "residual": {n: diagnosis["gap"]["pooled"][n]["fit"] for n in ("nominal", "refitted", "augmented")},
        "doubt": diagnosis["doubt"],
    }


def _places(finding: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """Return the likely places of a finding; a card may have its component itself."""
    return finding.get("places") or [finding]


def _at(effect: str, finding: Mapping[str, Any], place: Mapping[str, Any]) -> list[Told]:
    """Return what a finding tells at one of its places. A card's name is in the key `from`, the source of what is put in."""
    card = ""
    if effect == "card":
        card = next((str(d[k]) for d in (place, finding) for k in ("from", "source") if d.get(k)), "").upper()
    return [Told(effect, p, card) for p in place.get("at") or finding["at"]]


def _is(card: Card, told: Told) -> bool:
    return told.effect == "card" and card.right(told.card, told.place)


def _outcome(verdict: str, first: Sequence[bool], told: Sequence[bool]) -> str:
    """Return the outcome of a diagnosis that should name one thing. first, told: of what it tells first, and in all, what is right."""
    if verdict == "named":
        return "wrong" if not any(first) else "named" if all(first) else "named, with another"
    return "covered" if verdict == "ambiguous" and any(told) else "held"


def _value(plant: Plant, diagnosis: Mapping[str, Any], effects: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return value and interval of the wrong parameter with what was found, None for what is not told."""
    sources = [_places(f)[0].get("values", {}) for f in effects] + [f["parameters"] for f in diagnosis["findings"]]
    found = next((v[plant.wrong] for v in sources if plant.wrong in v), None)
    found = found or diagnosis.get("estimates_after", {}).get(plant.wrong)
    value = diagnosis["parameters_after"].get(plant.wrong)
    return {"value": value, "ci95": None} if found is None else {n: found.get(n) for n in ("value", "ci95")}


def _effect_outcome(hidden: Hidden, verdict: str, first: Sequence[Told], told: Sequence[Told]) -> str:
    right = [hidden.right(t.effect, t.place) for t in first]
    if verdict == "named" and right and all(right):
        return "named"
    if any(hidden.right(t.effect, t.place) for t in told):
        return "covered" if len(first) < 2 or verdict == "ambiguous" or all(right) else "covered, with another"
    if not first:
        return "held"
    return "place" if all(t.effect in hidden.effects for t in first) else "wrong"


def _parameter_outcome(plant: Plant, size: dict[str, Any]) -> str:
    value, ends = size["value"], size["ci95"]
    if value is None:
        return "held"
    truth = plant.truth()
    low, high = ends if ends is not None else (None, None)
    if low is not None and high is not None and low <= truth <= high:
        return "found"
    return "near" if abs(value - truth) <= NEAR * truth else "wrong"
