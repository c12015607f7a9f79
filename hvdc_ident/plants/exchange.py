"""The units that a unit may be instead: one of its controls of another type, or with a control that it lacks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import sympy as sp

from hvdc_ident.expression import at_values, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, parse_card, reached, shelf_model
from hvdc_ident.model.transform import without_vanished
from hvdc_ident.parameters import Parameter
from hvdc_ident.plants.meaning import Said, meaning_of, of_class, said_by, taken
from hvdc_ident.plants.unit import AHEAD, UNCONNECTED, UnitPart, idle_parts, part_name, unit_card, uses
from hvdc_ident.shelf import components, outputs_of

ADDED = ("stabiliser", "load controller", "plant control")
"""Classes of controls that are added where a unit has none."""
NETWORK = ("bus", "freq")
"""Components of a unit that is played back which are not its own parts."""


@dataclass(frozen=True)
class CardChange:
    """A unit with another component.

    component: its name in the unit, as gov. klass: governor. stated: the component on the shelf that was there, None where there was
    none; card: the one that is there now. model: the changed unit; its other parts keep the names and values of their parameters, those
    of the exchanged one are gone. Effects, ties and columns that the stated model was driven by are not in it. free: parameters of the
    new component that a fit frees, each at its value in `model` and within its usual range. carried: those that follow from the stated
    unit, each with the parameters there that it is made of; none of them where the stated component has by itself what the parameter
    says, as no transducer. Every other parameter has the typical value of the card.
    """

    component: str
    klass: str
    stated: str | None
    card: str
    model: Model
    free: FrozenMap[Parameter]
    carried: FrozenMap[Said]


def exchanges(model: Model) -> tuple[CardChange, ...]:
    """Return the units that a unit may be instead: each control as every other card of its class that can be connected in its place, and
    each control that it lacks as every card of its class.

    model: of a card that `unit_card` writes for a unit that is played back, with the values that a study sets, whatever was made of it
    by effects, ties or recorded columns. Of any other model there are none: at an infinite bus, where a reference is an input, its
    meaning would change with the type. The levels of the unit stay; the references are found anew from them at the start.
    """
    unit = _Unit.of(model)
    if unit is None:
        return ()
    return (*unit.exchanged(), *unit.extended())


@dataclass(frozen=True)
class _Unit:
    """A unit that is played back. parts: with their values; levels: of its inputs; signals: inputs and references, which no part gives;
    name, f0: of its card."""

    parts: Mapping[str, UnitPart]
    levels: Mapping[str, float]
    signals: frozenset[str]
    name: str
    f0: float

    @classmethod
    def of(cls, model: Model) -> _Unit | None:
        """Return the unit of a model; None for one that is not as `unit_card` writes it."""
        root = _root(model)
        sources = {n: s for n, s in root.components.items() if n not in NETWORK}
        if root.components.get("bus") != "playback" or not set(sources.values()) <= set(components()):
            return None
        named = [f"{n}.{p}" for n, s in sources.items() for p in shelf_model(s).parameters]
        if not set(named) <= root.parameters.keys() or not any("Ir" in outputs_of(s) for s in sources.values()):
            return None
        levels = {n: i.value for n, i in model.inputs.items() if n in root.inputs}
        signals = frozenset((*root.inputs, *(n for n, s in root.states.items() if s.is_reference)))
        unit = cls(_parts(root, sources), levels, signals, root.name, root.values["bus.f0"])
        if unit.model(unit.parts).structure != without_vanished(root).structure:
            return None
        return replace(unit, parts=_parts(model, sources))

    def model(self, parts: Mapping[str, UnitPart]) -> Model:
        """Return the unit of these parts, read from its card."""
        return parse_card(unit_card(parts, name=self.name, network="playback", f0=self.f0, levels=self.levels))

    def exchanged(self) -> Iterator[CardChange]:
        """Yield the units in which one part is of another type."""
        for name, part in self.parts.items():
            own, others = _said(name, part), {n: p for n, p in self.parts.items() if n != name}
            asked = outputs_of(part.source) & _asked(others)
            for card in of_class(meaning_of(part.source).klass):
                values = taken(card, self._said() | own)
                if card != part.source and asked <= outputs_of(card) and _unmoved(others, own, name, card, values):
                    yield from self._changed(others, name, part.source, card, values)

    def extended(self) -> Iterator[CardChange]:
        """Yield the units with a part more, of a class of which there is none; others follow all that it gives."""
        has = {meaning_of(p.source).klass for p in self.parts.values()}
        for card in (c for klass in ADDED if klass not in has for c in of_class(klass)):
            gives, name = outputs_of(card), part_name(card)
            if name not in self.parts and gives <= _asked(self.parts) and not gives & _given(self.parts):
                yield from self._changed(self.parts, name, None, card, taken(card, self._said()))

    def _changed(
        self, others: Mapping[str, UnitPart], name: str, stated: str | None, card: str, values: Mapping[str, Said]
    ) -> Iterator[CardChange]:
        """Yield the unit with a new part beside the others, unless an input of it has no source or nothing follows another part now."""
        carried = {n: s.value for n, s in values.items()}
        free = _free(card, carried)
        part = UnitPart(card, carried | {n: p.value for n, p in free.items()})
        order = self.parts if stated else (*self.parts, name)
        parts = {n: others.get(n, part) for n in order}
        if self._has_sources(others, card) and set(idle_parts(parts)) <= set(idle_parts(self.parts)):
            yield CardChange(
                name,
                meaning_of(card).klass,
                stated,
                card,
                self.model(parts),
                free=FrozenMap({f"{name}.{n}": p for n, p in free.items()}),
                carried=FrozenMap({f"{name}.{n}": s for n, s in values.items()}),
            )

    def _has_sources(self, others: Mapping[str, UnitPart], card: str) -> bool:
        """Return whether each input of a component follows a part, or is a set-point, or what the unit has without it."""
        known = self.signals | UNCONNECTED.keys() | {o for p in others.values() for o in outputs_of(p.source)}
        return all(u.settable or AHEAD.get(n, n) in known for n, u in shelf_model(card).inputs.items())

    def _said(self) -> dict[str, Said]:
        return {q: s for n, p in self.parts.items() for q, s in _said(n, p).items()}


def _root(model: Model) -> Model:
    """Return the model as its card has it."""
    return model.origin.root if model.origin else model


def _parts(model: Model, sources: Mapping[str, str]) -> dict[str, UnitPart]:
    """Return the parts of a unit with the values that differ from their cards'."""
    at = {symbol(n): sp.Float(v) for n, v in model.values.items()}

    def value(name: str) -> float:
        """Return a parameter's value; one that is tied, or written in others, is a signal of them."""
        known = model.parameters.get(name)
        return known.value if known else float(at_values(model.signals[name].value, at))

    own = {n: {p: value(f"{n}.{p}") for p in shelf_model(s).parameters} for n, s in sources.items()}
    return {
        n: UnitPart(s, FrozenMap({p: v for p, v in own[n].items() if v != shelf_model(s).values[p]}))
        for n, s in sources.items()
    }


def _said(name: str, part: UnitPart) -> dict[str, Said]:
    return said_by(part.source, shelf_model(part.source).values | dict(part.values), name)


def _asked(parts: Mapping[str, UnitPart]) -> set[str]:
    """Return the signals that inputs of the parts follow."""
    return {AHEAD.get(u, u) for p in parts.values() for u in shelf_model(p.source).inputs}


def _given(parts: Mapping[str, UnitPart]) -> set[str]:
    """Return the signals that the parts give, but for those that a part only gives on."""
    models = [shelf_model(p.source) for p in parts.values()]
    return {o for m in models for o in m.outputs if not any(AHEAD.get(u) == o for u in m.inputs)}


def _unmoved(
    others: Mapping[str, UnitPart], own: Mapping[str, Said], name: str, card: str, values: Mapping[str, Said]
) -> bool:
    """Return whether what other parts take from this one stays: the values of theirs do."""
    asked = {
        s.name
        for p in others.values()
        for of in meaning_of(p.source).takes.values()
        for e in of
        for s in e.free_symbols
    }
    now = _said(name, UnitPart(card, {n: s.value for n, s in values.items()}))
    return all(math.isclose(own[q].value, now[q].value) for q in asked & own.keys() & now.keys())


def _free(card: str, carried: Mapping[str, float]) -> dict[str, Parameter]:
    """Return what a fit frees of a component, at its values: one that lies outside its range widens it.

    A value of 0 below the range takes a block out, which no fit can bring back: there the search begins at the range's low end. What
    the flags switch off is left out.
    """
    free, model = dict[str, Parameter](), shelf_model(card)
    for name, (low, high) in meaning_of(card).free.items():
        typical = model.parameters[name]
        value = carried.get(name, typical.value)
        value = low if value == 0.0 < low else value
        free[name] = replace(typical, value=value, min=min(low, value), max=max(high, value))
    made = model.with_values({**carried, **{n: p.value for n, p in free.items()}})
    used = uses(made, free)
    acting = set(reached(made.outputs, lambda name: used.get(name, ())))
    return {n: p for n, p in free.items() if n in acting}
