"""Models made of components: the equations of each under names of its own in the whole, connected by expressions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import sympy as sp

from hvdc_ident.errors import InputError, ModelError, unknown_name
from hvdc_ident.expression import TIME, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model.check import VARIABLES, check_name
from hvdc_ident.model.definition import Algebraic, Model, Parameterisation, Signal
from hvdc_ident.model.transform import with_constants, without_vanished
from hvdc_ident.parameters import Input, Parameter

RESERVED = ("outputs",)
"""Names that no component can have: the insertion point of an output P is `outputs.P`."""


@dataclass(frozen=True)
class Component:
    """A model as a part of another: its equations, and values of some of its parameters, numbers or expressions of the whole's.

    names: what its variables are called in the whole, by name or by a pattern with one *, which stands for any letters:
    {"*": "*1", "*_m": "*1_m", "xq": "x1"} makes V V1, V_m V1_m and xq x1. A name goes before a pattern, a longer pattern before a
    shorter one; a variable x that none fits is `NAME.x`, with the component's name.
    """

    model: Model
    values: FrozenMap[float | sp.Expr] = field(default_factory=FrozenMap)
    names: FrozenMap[str] = field(default_factory=FrozenMap)


@dataclass(frozen=True)
class Connection:
    """What an input of a component follows. start: where the search for it begins, where it is an unknown of a circle."""

    value: sp.Expr
    start: float | None = None


def assembled(
    own: Mapping[str, Mapping[str, Any]],
    components: Mapping[str, Component],
    connections: Mapping[str, Connection],
    *,
    name: str,
    description: str = "",
) -> Model:
    """Return the model of components and the whole's own sections.

    A variable `x` of a component `gen` is `gen.x`, or what the component's `names` say: parameters, states, signals, unknowns, delays
    and sampled values keep their kind. An input is a signal that follows its connection (an unknown, where that has a start); where
    the whole or another component has a variable of its name, the input is that variable. An output, and a parameter with an
    expression for its value, are signals, unless they are only the name of something else. Every place of a component is an insertion
    point of the whole. A section has the whole's own variables first, then those of each component. own: the sections of the whole, as
    `Model` takes them. Expressions and the keys of connections are in names of the whole.

    Raises ModelError for an input without a connection, a name that is taken, units that do not fit and signals in a circle;
    UnknownNameError for a parameter, an input or a variable that a component does not have.
    """
    sections: dict[str, dict[str, Any]] = {k: dict(v) for k, v in own.items()}
    owners = {n: "the model itself" for section in VARIABLES for n in sections.get(section, ())}
    inputs: dict[str, tuple[str, Input]] = {}
    agree: list[tuple[str, str, str, sp.Expr]] = []  # where, a component's variable, its unit, what it is in the whole
    for part_name, part in components.items():
        place = f"[components.{part_name}]"
        if part_name in RESERVED or "." in part_name:
            raise ModelError(
                "a component cannot have this name", where=place, expected="letters, digits and _", got=part_name
            )
        try:
            names = _names(part_name, part)
            flat = _sections(part, FrozenMap(names))
        except InputError as e:
            raise e.at(place) from None
        for section, items in flat.items():
            _add(sections, section, items, place, owners)
        for u, quantity in part.model.inputs.items():
            inputs.setdefault(names[u], (place, quantity))
            agree.append((place, u, quantity.unit, symbol(names[u])))
        agree += [(place, n, part.model.parameters[n].unit, e) for n, e in _written(part).items()]
    for target, connection in connections.items():
        place = f"[connections] '{target}'"
        if target not in inputs:
            raise unknown_name("input of a component", target, inputs, where=place)
        quantity = inputs[target][1]
        made: Any = Signal(connection.value, quantity.unit, quantity.description)
        if connection.start is not None:
            made = Algebraic(connection.value, connection.start, quantity.unit, quantity.description)
        _add(sections, "signals" if connection.start is None else "algebraic", [(target, made)], place, owners)
        agree.append((place, target, quantity.unit, connection.value))
    for target, (place, quantity) in inputs.items():
        if target not in owners:
            raise ModelError(
                f"the input '{target}' is not connected",
                where=place,
                expected=f'"{target}" = "..." in [connections]',
                hint=f"it is {quantity.description}" if quantity.description else "",
            )
    for place, _, _, value in agree:
        if isinstance(value, sp.Symbol) and value != TIME and value.name not in owners:
            raise unknown_name("variable", value.name, owners, where=place)
    made_of: dict[str, Any] = {k: FrozenMap(v) for k, v in sections.items()}
    made_of["components"] = FrozenMap({n: c.model.name for n, c in components.items()})
    whole = without_vanished(Model(name=name, description=description, **made_of))
    for units in agree:
        _check_unit(whole, *units)
    return whole


def _names(component: str, part: Component) -> dict[str, str]:
    """Return what each name of a component is in the whole: of its variables, outputs, parameterisations and their parameters."""
    model, given = part.model, part.names
    variables = dict.fromkeys((*model.names, *model.outputs))
    others = [n for key, p in model.parameterisations.items() for n in (key, *p.parameters)]
    starts = {f"{n}_start": n for n, s in model.states.items() if s.start == "free"}  # named as their states are
    known = [n for n in dict.fromkeys((*variables, *others)) if n not in starts]
    for key, value in given.items():
        if "*" not in key and key not in known:
            raise unknown_name("variable", key, known, where="names")
        if key.count("*") > 1 or value.count("*") != key.count("*"):
            raise ModelError(
                "no pattern of names",
                where="names",
                expected="one * on both sides, or on neither",
                got=f'"{key}" = "{value}"',
                hint='names = "*1", or names = {"*" = "*1", K = "K_gov"}',
            )
    patterns = {k: v for k, v in sorted(given.items(), key=lambda item: -len(item[0])) if "*" in k}

    def called(n: str) -> str:
        if n in given:
            return given[n]
        for pattern, new in patterns.items():
            head, _, tail = pattern.partition("*")
            if n.startswith(head) and n.endswith(tail) and len(n) > len(head + tail):
                return new.replace("*", n[len(head) : len(n) - len(tail)])
        return f"{component}.{n}"

    names = {n: called(n) for n in known} | {n: f"{called(state)}_start" for n, state in starts.items()}
    for n in variables:
        check_name(names[n], f"the name of '{n}'")
    return names


def _written(part: Component) -> dict[str, sp.Expr]:
    """Return the parameters of a component whose values are expressions of the whole, and those."""
    return {n: v for n, v in part.values.items() if isinstance(v, sp.Expr)}


@lru_cache(maxsize=128)
def _sections(part: Component, names: FrozenMap[str]) -> FrozenMap[tuple[tuple[str, Any], ...]]:
    """Return the sections of a component, each the objects with their names in the whole.

    Of units that differ in one component the others are the same, and most of the work.
    """
    written = _written(part)
    numbers = {n: v for n, v in part.values.items() if n not in written}
    model = part.model.with_values(numbers) if numbers else part.model
    for n in written:
        if n not in model.parameters:
            raise unknown_name("parameter", n, model.parameters)
    new = {symbol(n): symbol(names[n]) for n in model.names}
    new |= {symbol(n): e for n, e in written.items() if isinstance(e, sp.Symbol)}
    computed = {n: e for n, e in written.items() if not isinstance(e, sp.Symbol)}
    constants = {symbol(names[n]): e for n, e in computed.items()}

    def under(items: Mapping[str, Any]) -> list[tuple[str, Any]]:
        return [(names[n], with_constants(_renamed(item, new), constants)) for n, item in items.items()]

    of_expressions = [
        (names[n], Signal(e, model.parameters[n].unit, model.parameters[n].description)) for n, e in computed.items()
    ]
    outputs = {n: Signal(o.value, o.unit, o.description) for n, o in model.outputs.items() if n not in model.names}
    free = {n: p for n, p in model.parameterisations.items() if not set(p.replaces) & set(written)}
    sections = {
        "parameters": under(model.parameters.without(*written)),
        "states": under(model.states),
        "signals": of_expressions + under(model.signals) + under(outputs),
        "algebraic": under(model.algebraic),
        "delays": under(model.delays),
        "sampled": under(model.sampled),
        "parameterisations": [(names[n], _under(names, p, new)) for n, p in free.items()],
    }
    return FrozenMap({n: tuple(items) for n, items in sections.items()})


def _renamed(item: Any, new: Mapping[sp.Symbol, sp.Symbol]) -> Any:
    """Return an object of a section with other symbols in its expressions."""
    if isinstance(item, Parameter):
        return item
    changed = {n: v.xreplace(new) for n, v in vars(item).items() if isinstance(v, sp.Basic)}
    return replace(item, **changed)


def _under(names: Mapping[str, str], item: Parameterisation, new: Mapping[sp.Symbol, sp.Symbol]) -> Parameterisation:
    own = dict(new) | {symbol(n): symbol(names[n]) for n in item.parameters}
    return replace(
        item,
        parameters=FrozenMap({names[n]: p for n, p in item.parameters.items()}),
        replaces=FrozenMap({names[n]: e.xreplace(own) for n, e in item.replaces.items()}),
    )


def _add(
    sections: dict[str, dict[str, Any]],
    section: str,
    items: Iterable[tuple[str, Any]],
    place: str,
    owners: dict[str, str],
) -> None:
    """Add to a section what a component or a connection has there. owners: by variable, what has it."""
    known = sections.setdefault(section, {})
    for n, item in items:
        owner = owners.get(n) if section in VARIABLES else place if n in known else None
        if owner is not None:
            shared = f', or to share a parameter parameters = {{... = "{n}"}}' if section == "parameters" else ""
            raise ModelError(
                f"the name '{n}' is taken: {owner} has it",
                where=place,
                expected="one variable a name",
                hint=f'other names, as names = "*2"{shared}' if place.startswith("[components.") else "",
            )
        known[n] = item
        if section in VARIABLES:
            owners[n] = place


def _check_unit(whole: Model, place: str, name: str, unit: str, value: sp.Expr) -> None:
    """Refuse a variable of a component that is, or follows, one of another unit; an expression of several may convert it."""
    if not isinstance(value, sp.Symbol) or not unit:
        return
    sections = ("parameters", "inputs", "states", "signals", "algebraic")
    source = next((getattr(whole, s)[value.name].unit for s in sections if value.name in getattr(whole, s)), "")
    if source and source != unit:
        raise ModelError(
            f"'{name}' is in {unit} and '{value.name}' in {source}",
            where=place,
            expected=f"a quantity in {unit}",
            hint=f'convert it, as "{value.name} * factor"',
        )
