"""Plain values to the objects that a model stores: numbers, texts, sympy expressions and dicts."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import sympy as sp

from hvdc_ident.errors import InputError, ModelError, unknown_name
from hvdc_ident.expression.normal import EXACT, normal
from hvdc_ident.expression.parser import parse
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Algebraic, Delay, Output, Parameterisation, Sampled, Signal, State
from hvdc_ident.parameters import Input, Parameter

if TYPE_CHECKING:
    from hvdc_ident.model.definition import Model

EXPRESSIONS = frozenset(("derivative", "equation", "of", "time", "period", "compute"))

SECTIONS: dict[str, tuple[type[Any], str, str]] = {
    "parameters": (Parameter, "value", "parameter"),
    "inputs": (Input, "value", "input"),
    "states": (State, "derivative", "state"),
    "signals": (Signal, "value", "signal"),
    "algebraic": (Algebraic, "equation", "algebraic"),
    "outputs": (Output, "value", "output"),
    "delays": (Delay, "of", "delay"),
    "sampled": (Sampled, "value", "sampled"),
    "parameterisations": (Parameterisation, "parameters", "parameterisation"),
}
"""Field of Model: the class of its values, the field a plain value stands for, and what one is called."""


def coerced(model: Model) -> dict[str, FrozenMap[Any]]:
    """The mappings of the model with every value as the object that the model stores.

    A number becomes a Parameter or Input; a text of the grammar, a sympy expression or a number a State (its
    derivative), Signal, Algebraic or Output; a dict is taken by the names of the object's fields. Symbols become the
    models' real ones. A state with a free start adds the parameter NAME_start. Coercing twice changes nothing.

    Raises ModelError, UnknownNameError or ExpressionError with the place.
    """
    place = f"model '{model.name}'"
    result = {section: _section(getattr(model, section), section, place) for section in SECTIONS}
    free = {f"{n}_start": Parameter(0.0, s.unit) for n, s in result["states"].items() if s.start == "free"}
    missing = {n: p for n, p in free.items() if n not in result["parameters"]}
    if missing:
        result["parameters"] = result["parameters"] | missing
    return result


def _section(items: object, section: str, place: str) -> FrozenMap[Any]:
    kind, main, noun = SECTIONS[section]
    if not isinstance(items, Mapping):
        raise ModelError(
            f"{section} is no mapping", where=place, expected="names to values", got=f"a {type(items).__name__}"
        )
    return FrozenMap((n, _made(kind, main, v, f"{place}, {noun} '{n}'")) for n, v in items.items())


def _made(kind: type[Any], main: str, value: object, place: str) -> Any:
    if isinstance(value, kind):
        given = {n: getattr(value, n) for n in _fields(kind)}
    elif isinstance(value, Mapping):
        given = dict(value)
    else:
        given = {main: value}
    required_keys(given, kind, place)
    converted = {k: _field(kind, k, v, place) for k, v in given.items()}
    if isinstance(value, kind) and all(converted[k] is v for k, v in given.items()):
        return value
    try:
        return kind(**converted)
    except InputError as e:
        raise e.at(place) from None


def required_keys(given: Mapping[str, object], kind: type[Any], place: str) -> None:
    """Refuse keys that are no fields of the class, and the lack of a field without a default."""
    known = _fields(kind)
    for key in given:
        if key not in known:
            raise unknown_name("key", str(key), known, where=place)
    for name, required in known.items():
        if required and given.get(name) is None:
            raise ModelError(f"has no {name}", where=place, expected=f"{name} = ...")


def _read(kind: type[Any]) -> FrozenMap[bool]:
    """The fields of a class, and whether each has to be given."""
    return FrozenMap({f.name: f.default is MISSING and f.default_factory is MISSING for f in fields(kind)})


_fields = cast("Callable[[type[Any]], FrozenMap[bool]]", cache(_read))
"""The same, read once: it is asked for every value of every model that is made."""


def _field(kind: type[Any], key: str, value: object, place: str) -> Any:
    if kind is Parameterisation and key in ("parameters", "replaces"):
        return _inner(key, value, place)
    if key in ("unit", "description"):
        if not isinstance(value, str):
            raise ModelError(f"its {key} is no text", where=place, expected="a text", got=_shown(value))
        return value
    if key in EXPRESSIONS or (key == "value" and kind not in (Parameter, Input)):
        return expression(value, place if key in ("value", "derivative", "equation", "of") else f"{place}, {key}")
    if kind is State and key in ("guess", "rest") and value is None:
        return None
    if kind is State and key == "rest":
        return expression(value, f"{place}, rest")
    if kind is State and (value is None or (key == "start" and isinstance(value, str) and value == "free")):
        return value
    if kind is State and key in ("start", "rest"):
        return expression(value, f"{place}, {key}")
    return _number(value, key, place)


def _inner(key: str, value: object, place: str) -> FrozenMap[Any]:
    if not isinstance(value, Mapping):
        raise ModelError(f"its {key} is no mapping", where=place, expected="names to values", got=_shown(value))
    if key == "parameters":
        made = {n: _made(Parameter, "value", v, f"{place}, parameter '{n}'") for n, v in value.items()}
    else:
        made = {n: expression(v, f"{place}, replaced '{n}'") for n, v in value.items()}
    same = isinstance(value, FrozenMap) and all(made[n] is v for n, v in value.items())
    return value if same else FrozenMap(made)  # type: ignore[return-value]


def _number(value: object, key: str, place: str) -> float:
    if isinstance(value, float):
        return value
    is_sympy = isinstance(value, sp.Expr) and value.is_number and value.is_real
    if isinstance(value, bool) or not (isinstance(value, numbers.Real) or is_sympy):
        raise ModelError(f"its {key} is no number", where=place, expected="a number", got=_shown(value))
    try:
        return float(value)  # type: ignore[arg-type]
    except OverflowError:
        raise ModelError(f"its {key} is too large for a double", where=place) from None


def _shown(value: object) -> str:
    text = repr(value)
    return f"{text[:40]}{'…' if len(text) > 40 else ''} ({type(value).__name__})"


def expression(value: object, place: str) -> sp.Expr:
    """The sympy expression of a text, a number or a sympy expression, in the normal form of models."""
    if isinstance(value, str):
        return parse(value, where=place)
    if isinstance(value, sp.Expr):
        return _sympy(value, place)
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        number = _number(value, "value", place)
        if not math.isfinite(number):
            raise ModelError("the number is not finite", where=place, expected="a finite number", got=f"{number}")
        if isinstance(value, numbers.Integral) and abs(int(value)) <= EXACT:
            return sp.Integer(int(value))
        return sp.Float(number)
    raise ModelError(
        "this is no expression", where=place, expected="a text, a number or a sympy expression", got=_shown(value)
    )


def _sympy(value: sp.Expr, place: str) -> sp.Expr:
    try:
        result = normal(value)
    except RecursionError:
        raise ModelError("the expression is nested too deeply", where=place, hint="name parts as signals") from None
    if result is None:
        raise ModelError(
            f"the expression {_short(value)} is not a real, finite function of the model's variables",
            where=place,
            expected="symbols and functions of them, no unknown functions, derivatives, infinities or complex numbers",
        )
    return result


def _short(value: sp.Expr) -> str:
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."
