"""What the parameters of a component mean: quantities that components share by name, such as the droop that one has as R, one as 1/K."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import sympy as sp

from hvdc_ident.expression import at_values, parse, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import shelf_model
from hvdc_ident.shelf import components, exchange_of


@dataclass(frozen=True)
class Meaning:
    """The table [exchange] of a component's card.

    klass: empty where it stands in for no other. free: parameters that a fit frees, with their usual range. says: quantities as
    expressions of the parameters. takes: parameters as expressions of quantities and of parameters, the first that is known.
    """

    klass: str
    free: FrozenMap[tuple[float, float]]
    says: FrozenMap[sp.Expr]
    takes: FrozenMap[tuple[sp.Expr, ...]]


@dataclass(frozen=True)
class Said:
    """The value of a quantity. of: the parameters of the unit that it is made of; none where a card says it of itself."""

    value: float
    of: tuple[str, ...] = ()


@cache
def meaning_of(source: str) -> Meaning:
    """Return what the parameters of a component mean."""
    table = exchange_of(source)
    means: Mapping[str, str] = table.get("means", {})
    takes = {n: e if isinstance(e, list) else [e] for n, e in table.get("takes", {}).items()}
    return Meaning(
        table.get("class", ""),
        FrozenMap({n: (float(low), float(high)) for n, (low, high) in table.get("free", {}).items()}),
        FrozenMap({q: symbol(n) for n, q in means.items()} | {q: _parsed(e) for q, e in table.get("says", {}).items()}),
        FrozenMap(
            {n: (symbol(q),) for n, q in means.items()} | {n: tuple(map(_parsed, of)) for n, of in takes.items()}
        ),
    )


@cache
def of_class(klass: str) -> tuple[str, ...]:
    """Return the components of a class, by name."""
    return tuple(n for n in components() if klass and meaning_of(n).klass == klass)


def said_by(source: str, values: Mapping[str, float], part: str) -> dict[str, Said]:
    """Return the quantities that a component says at values of its parameters. part: its name in the unit."""
    at = {symbol(n): sp.Float(v) for n, v in values.items()}
    said = {}
    for quantity, expression in meaning_of(source).says.items():
        value = _number(expression, at)
        if value is not None:
            names = sorted(s.name for s in expression.free_symbols)
            said[quantity] = Said(value, tuple(f"{part}.{n}" for n in names))
    return said


def taken(source: str, said: Mapping[str, Said]) -> dict[str, Said]:
    """Return the parameters of a component that follow from quantities, by name.

    A value that the parameter's bounds exclude, as a droop of 0, is left out: the card's own value stays.
    """
    model, parameters = shelf_model(source), dict[str, Said]()
    own = {symbol(n): sp.Float(v) for n, v in model.values.items()}
    quantities = {symbol(q): sp.Float(s.value) for q, s in said.items()}
    for name, expressions in meaning_of(source).takes.items():
        limits = model.parameters[name]
        for e in expressions:
            value = _number(e, own | quantities) if e.free_symbols <= own.keys() | quantities.keys() else None
            if value is not None and limits.min <= value <= limits.max:
                used = sorted({n for s in e.free_symbols if s in quantities for n in said[s.name].of})
                parameters[name] = Said(value, tuple(used))
                own[symbol(name)] = sp.Float(value)
                break
    return parameters


def _parsed(expression: str | float) -> sp.Expr:
    return parse(expression) if isinstance(expression, str) else sp.Float(expression)


def _number(expression: sp.Expr, at: Mapping[sp.Symbol, sp.Expr]) -> float | None:
    """Return the value of an expression; None where it is no finite number."""
    value = at_values(expression, at)
    return float(value) if value.is_real and math.isfinite(float(value)) else None
