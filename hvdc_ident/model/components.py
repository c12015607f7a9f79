"""Models made of components: the equations of each under names that begin with the component's, connected by expressions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import sympy as sp

from hvdc_ident.errors import InputError, ModelError, unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model.definition import Algebraic, Model, Parameterisation, Signal
from hvdc_ident.model.transform import with_constants, without_vanished
from hvdc_ident.parameters import Parameter

RESERVED = ("outputs",)
"""Names that no component can have: the insertion point of an output P is `outputs.P`."""


@dataclass(frozen=True)
class ComponentEntry:
    """A component as a card states it. source: a name on the shelf or a card's path; parameters: values, numbers or expressions."""

    source: str
    parameters: Mapping[str, float | str] = field(default_factory=FrozenMap)


@dataclass(frozen=True)
class Component:
    """A model as a part of another: its equations, and values of some of its parameters, numbers or expressions of the whole's."""

    model: Model
    values: FrozenMap[float | sp.Expr] = field(default_factory=FrozenMap)


@dataclass(frozen=True)
class Connection:
    """What an input of a component follows. start: where the search for it begins, where it is an unknown of a circle."""

    value: sp.Expr
    start: float | None = None


PARTS: Mapping[str, tuple[type[Any], str, str]] = {
    "components": (ComponentEntry, "source", "component"),
    "connections": (Connection, "value", "connection"),
}
"""Sections of a card that a model does not have: the class of an entry, the field a plain value stands for, what one is called."""


def assembled(
    own: Mapping[str, Mapping[str, Any]],
    components: Mapping[str, Component],
    connections: Mapping[str, Connection],
    *,
    name: str,
    description: str = "",
) -> Model:
    """Return the model of components and the whole's own sections.

    A name `x` of a component `gen` is `gen.x`: parameters, states, signals, unknowns, delays and sampled values keep their kind;
    an input is a signal that follows its connection (an unknown, where that has a start); an output is a signal, unless it is only
    the name of something else; a parameter with an expression for its value is a signal too. Every place of a component is an insertion
    point of the whole. own: the sections of the whole, as `Model` takes them; their expressions use names of components.

    Raises ModelError for an input without a connection, a name that is taken, units that do not fit and signals in a circle;
    UnknownNameError for a parameter or an input that a component does not have.
    """
    sections: dict[str, dict[str, Any]] = {k: dict(v) for k, v in own.items()}
    inputs = {f"{c}.{u}": i for c, part in components.items() for u, i in part.model.inputs.items()}
    for part_name, part in components.items():
        place = f"[components.{part_name}]"
        if part_name in RESERVED or "." in part_name:
            raise ModelError(
                "a component cannot have this name", where=place, expected="letters, digits and _", got=part_name
            )
        try:
            flat = _sections(part_name, part)
        except InputError as e:
            raise e.at(place) from None
        for section, items in flat.items():
            _add(sections, section, items, place)
    for target in connections:
        if target not in inputs:
            raise unknown_name("input of a component", target, inputs, where=f"[connections] '{target}'")
    for target, quantity in inputs.items():
        place = f"[connections] '{target}'"
        found = connections.get(target)
        if found is None:
            raise ModelError(
                f"the input '{target}' is not connected",
                where=f"[components.{target.partition('.')[0]}]",
                expected=f'"{target}" = "..." in [connections]',
                hint=f"it is {quantity.description}" if quantity.description else "",
            )
        section = "signals" if found.start is None else "algebraic"
        made: Any = Signal(found.value, quantity.unit, quantity.description)
        if found.start is not None:
            made = Algebraic(found.value, found.start, quantity.unit, quantity.description)
        _add(sections, section, {target: made}, place)
    made_of: dict[str, Any] = {k: FrozenMap(v) for k, v in sections.items()}
    whole = without_vanished(Model(name=name, description=description, **made_of))
    for target, connection in connections.items():
        _check_unit(whole, target, connection.value, inputs[target].unit)
    return whole


def _sections(name: str, part: Component) -> dict[str, dict[str, Any]]:
    """Return the sections of a component under the names that they have in the whole."""
    model = part.model.with_values({n: v for n, v in part.values.items() if not isinstance(v, sp.Expr)})
    written: dict[str, sp.Expr] = {n: v for n, v in part.values.items() if isinstance(v, sp.Expr)}
    for n in written:
        if n not in model.parameters:
            raise unknown_name("parameter", n, model.parameters)
    new = {symbol(n): symbol(f"{name}.{n}") for n in model.names}

    constants = {symbol(f"{name}.{n}"): e for n, e in written.items()}

    def under(items: Iterable[tuple[str, Any]]) -> dict[str, Any]:
        return {f"{name}.{n}": with_constants(_renamed(item, new), constants) for n, item in items}

    parameters = {n: p for n, p in model.parameters.items() if n not in written}
    of_expressions = {
        f"{name}.{n}": Signal(e, model.parameters[n].unit, model.parameters[n].description) for n, e in written.items()
    }
    outputs = {
        f"{name}.{n}": Signal(o.value.xreplace(new), o.unit, o.description)
        for n, o in model.outputs.items()
        if n not in model.names
    }
    free = {n: p for n, p in model.parameterisations.items() if not set(p.replaces) & set(written)}
    return {
        "parameters": under(parameters.items()),
        "states": under(model.states.items()),
        "signals": of_expressions | under(model.signals.items()) | outputs,
        "algebraic": under(model.algebraic.items()),
        "delays": under(model.delays.items()),
        "sampled": under(model.sampled.items()),
        "parameterisations": {f"{name}.{n}": _under(name, p, new) for n, p in free.items()},
    }


def _renamed(item: Any, new: Mapping[sp.Symbol, sp.Symbol]) -> Any:
    """Return an object of a section with other symbols in its expressions."""
    if isinstance(item, Parameter):
        return item
    changed = {n: v.xreplace(new) for n, v in vars(item).items() if isinstance(v, sp.Basic)}
    return replace(item, **changed)


def _under(name: str, item: Parameterisation, new: Mapping[sp.Symbol, sp.Symbol]) -> Parameterisation:
    own = dict(new) | {symbol(n): symbol(f"{name}.{n}") for n in item.parameters}
    return replace(
        item,
        parameters=FrozenMap({f"{name}.{n}": p for n, p in item.parameters.items()}),
        replaces=FrozenMap({f"{name}.{n}": e.xreplace(own) for n, e in item.replaces.items()}),
    )


def _add(sections: dict[str, dict[str, Any]], section: str, items: Mapping[str, Any], place: str) -> None:
    known = sections.setdefault(section, {})
    for n, item in items.items():
        if n in known:
            raise ModelError(f"the name '{n}' is taken", where=place, expected="one variable a name")
        known[n] = item


def _check_unit(whole: Model, target: str, value: sp.Expr, unit: str) -> None:
    """Refuse to connect an input with a quantity of another unit; an expression of several may convert it."""
    if not isinstance(value, sp.Symbol) or not unit:
        return
    source = next(
        (
            getattr(whole, s)[value.name].unit
            for s in ("inputs", "states", "signals", "algebraic")
            if value.name in getattr(whole, s)
        ),
        "",
    )
    if source and source != unit:
        raise ModelError(
            f"'{target}' is in {unit} and '{value.name}' in {source}",
            where=f"[connections] '{target}'",
            expected=f"a quantity in {unit}",
            hint=f'convert it, as "{value.name} * factor"',
        )
