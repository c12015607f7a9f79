"""Consistency of a model: numbers, texts and dicts become the objects that a model stores; then names, symbols and
circles of signals are checked."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, cast

import sympy as sp

from hvdc_ident.errors import InputError, ModelError, UnknownNameError, require_known, unknown_name
from hvdc_ident.expression import EXACT, FUNCTIONS, is_identifier, is_reserved, normal, parse
from hvdc_ident.immutable import FrozenMap
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
    """Return the mappings of the model with every value as the object that the model stores.

    A number becomes a Parameter or Input; a text of the grammar, a sympy expression or a number a State (its
    derivative), Signal, Algebraic or Output; a dict is taken by the names of the object's fields. Symbols become the
    models' real ones. A state with a free start adds the parameter NAME_start. A parameter that is the time of a delay is
    bounded by 0 from below. Coercing twice changes nothing.

    Raises ModelError, UnknownNameError or ExpressionError with the place.
    """
    place = f"model '{model.name}'"
    result = {section: _section(getattr(model, section), section, place) for section in SECTIONS}
    free = {f"{n}_start": Parameter(0.0, s.unit) for n, s in result["states"].items() if s.start == "free"}
    missing = {n: p for n, p in free.items() if n not in result["parameters"]}
    if missing:
        result["parameters"] = result["parameters"] | missing
    times = {d.time.name for d in result["delays"].values() if isinstance(d.time, sp.Symbol)}
    below_zero = {n: p for n, p in result["parameters"].items() if n in times and p.min < 0.0}
    if below_zero:
        result["parameters"] = result["parameters"] | {n: _not_negative(n, p, place) for n, p in below_zero.items()}
    return result


def _not_negative(name: str, parameter: Parameter, place: str) -> Parameter:
    """Return the parameter with 0 as its lower bound. Raises ModelError where its value is below."""
    if parameter.value < 0.0:
        raise ModelError(
            "the time of a delay is negative",
            where=f"{place}, parameter '{name}'",
            expected="0 s or more",
            got=f"{parameter.value:g}",
        )
    return replace(parameter, min=0.0)


def _section(items: object, section: str, place: str) -> FrozenMap[Any]:
    kind, main, noun = SECTIONS[section]
    if not isinstance(items, Mapping):
        raise ModelError(
            f"{section} is no mapping", where=place, expected="names to values", got=f"a {type(items).__name__}"
        )
    return FrozenMap((n, _made(kind, main, v, f"{place}, {noun} '{n}'")) for n, v in items.items())


def _made(kind: type[Any], main: str, value: object, place: str) -> Any:
    if isinstance(value, kind):
        given = {n: getattr(value, n) for n in _keys_of(kind)}
    elif isinstance(value, Mapping):
        given = dict(value)
    else:
        given = {main: value}
    _require_keys(given, kind, place)
    converted = {k: _field(kind, k, v, place) for k, v in given.items()}
    if isinstance(value, kind) and all(converted[k] is v for k, v in given.items()):
        return value
    try:
        return kind(**converted)
    except InputError as e:
        raise e.at(place) from None


def _require_keys(given: Mapping[str, object], kind: type[Any], place: str) -> None:
    """Refuse keys that are no fields of the class, and the lack of a field without a default."""
    known = _keys_of(kind)
    for key in given:
        if key not in known:
            raise unknown_name("key", str(key), known, where=place)
    for name, required in known.items():
        if required and given.get(name) is None:
            raise ModelError(f"has no {name}", where=place, expected=f"{name} = ...")


def _read(kind: type[Any]) -> FrozenMap[bool]:
    """Return the fields of a class, and whether each has to be given."""
    return FrozenMap({f.name: f.default is MISSING and f.default_factory is MISSING for f in fields(kind)})


_keys_of = cast("Callable[[type[Any]], FrozenMap[bool]]", cache(_read))
"""`_read`, once a class: it is asked for every value of every model that is made."""


def _field(kind: type[Any], key: str, value: object, place: str) -> Any:
    if kind is Parameterisation and key in ("parameters", "replaces"):
        return _inner(key, value, place)
    if key in ("unit", "description"):
        if not isinstance(value, str):
            raise ModelError(f"its {key} is no text", where=place, expected="a text", got=_shown(value))
        return value
    if key == "settable":
        if not isinstance(value, bool):
            raise ModelError(
                f"its {key} is neither true nor false", where=place, expected="true or false", got=_shown(value)
            )
        return value
    if key == "usual":
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise ModelError("its usual values are no range", where=place, expected="[low, high]", got=_shown(value))
        own = tuple(_number(v, key, place) for v in value)
        return value if own == value else own  # the object itself where it is one: what is unchanged is not made anew
    if key in EXPRESSIONS or (key == "value" and kind not in (Parameter, Input)):
        return expression(value, place if key in ("value", "derivative", "equation", "of") else f"{place}, {key}")
    if kind is State and key in ("guess", "rest", "vanishes") and value is None:
        return None
    if kind is State and key in ("rest", "vanishes"):
        return expression(value, f"{place}, {key}")
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
    """Return the sympy expression of a text, a number or a sympy expression, in the normal form of models."""
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


# --- consistency ---

VARIABLES = ("parameters", "inputs", "states", "signals", "algebraic", "delays", "sampled")


def check(model: Model) -> None:
    """Refuse a coerced model that is not consistent.

    Raises ModelError for bad or doubled names, circles of signals and impossible constants, UnknownNameError for a
    symbol that is no variable of the model.
    """
    if not isinstance(model.name, str) or not model.name.strip():
        raise ModelError("a model needs a name", expected="a text that is not empty", got=repr(model.name)[:40])
    if not isinstance(model.description, str):
        raise ModelError("the description is no text", where=_model(model), got=type(model.description).__name__)
    if not (model.states or model.outputs or model.sampled):
        raise ModelError("the model is empty", where=_model(model), expected="at least one state or output")
    _check_names(model)
    _check_symbols(model)
    _check_constants(model)
    for name, parameterisation in model.parameterisations.items():
        _check_parameterisation(model, name, parameterisation)
    ordered_signals(model)


def _model(model: Model) -> str:
    return f"model '{model.name}'"


def _place(model: Model, section: str, name: str, part: str = "") -> str:
    return f"model '{model.name}', {SECTIONS[section][2]} '{name}'" + (f", {part}" if part else "")


def _check_names(model: Model) -> None:
    owner: dict[str, str] = {}
    for section in (*VARIABLES, "outputs"):
        for name in getattr(model, section):
            check_name(name, _place(model, section, name))
            if section == "outputs":
                continue
            if name in owner:
                what = f"the name is taken: it is also a {SECTIONS[owner[name]][2]}"
                raise ModelError(what, where=_place(model, section, name), expected="one variable a name")
            owner[name] = section


def check_name(name: object, place: str) -> None:
    """Refuse what cannot name a variable: ModelError with the place."""
    if not is_identifier(name):
        raise ModelError(
            f"{name!r} cannot name a variable", where=place, expected="letters, digits and _, no digit first"
        )
    if is_reserved(name):
        what = "function" if name in FUNCTIONS else "constant" if name == "pi" else "clock"
        raise ModelError(f"the name '{name}' is the {what} of expressions", where=place, expected="another name")


def _expressions(model: Model) -> Iterator[tuple[str, str, str, sp.Expr, bool]]:
    """Yield (section, name, part, expression, whether only parameters may be used) of every expression of the model."""
    for name, state in model.states.items():
        yield "states", name, "", state.derivative, False
        if isinstance(state.start, sp.Expr):
            yield "states", name, "start", state.start, True
        if state.rest is not None:
            yield "states", name, "rest", state.rest, False
        if state.vanishes is not None:
            yield "states", name, "vanishes", state.vanishes, True
    for name, signal in model.signals.items():
        yield "signals", name, "", signal.value, False
    for name, unknown in model.algebraic.items():
        yield "algebraic", name, "", unknown.equation, False
    for name, output in model.outputs.items():
        yield "outputs", name, "", output.value, False
    for name, delay in model.delays.items():
        yield "delays", name, "", delay.of, False
        yield "delays", name, "time", delay.time, True
    for name, sampled in model.sampled.items():
        yield "sampled", name, "", sampled.value, False
        yield "sampled", name, "period", sampled.period, True
        yield "sampled", name, "compute", sampled.compute, True


def used_names(model: Model) -> frozenset[str]:
    """Return the names that stand in any expression of the model."""
    return frozenset().union(*(_used(e) for _, _, _, e, _ in _expressions(model)))


def reached(begin: Iterable[str], onwards: Callable[[str], Iterable[str]]) -> Iterator[str]:
    """Yield the names that some lead to step by step, these included, each once. onwards: the names that one leads to at once."""
    seen: set[str] = set()
    left = list(begin)
    while left:
        name = left.pop()
        if name not in seen:
            seen.add(name)
            yield name
            left.extend(onwards(name))


def _check_symbols(model: Model) -> None:
    names = {*model.names, "time"}
    for section, name, part, expression, only_parameters in _expressions(model):
        used = _used(expression)
        place = _place(model, section, name, part)
        if only_parameters:
            _only_parameters(model, used, names, place)
        elif not names.issuperset(used):
            raise _unknown(model, min(used - names), place)


@lru_cache(maxsize=4096)
def _used(expression: sp.Expr) -> frozenset[str]:
    """Names in an expression; an effect leaves most of a model's as they were."""
    return frozenset(s.name for s in expression.free_symbols)


def _only_parameters(model: Model, used: Iterable[str], names: Collection[str], place: str) -> None:
    for name in sorted(used):
        if name in model.parameters:
            continue
        if name in names:
            raise ModelError(f"'{name}' is no parameter", where=place, expected="an expression of parameters only")
        raise unknown_name("parameter", name, model.parameters, where=place)


def _unknown(model: Model, name: str, place: str) -> UnknownNameError:
    error = unknown_name("variable", name, model.names, where=place)
    if name in model.outputs:
        hint = f'an output cannot be read; name it in signals and write {name} = "{name}" in outputs'
        return UnknownNameError(error.what, where=place, expected=error.expected, hint=hint)
    return error


def _check_constants(model: Model) -> None:
    for name, state in model.states.items():
        if state.vanishes is not None and state.rest is None:
            place = _place(model, "states", name)
            raise ModelError("a state that vanishes has no rest", where=place, expected='rest = "..."')
    for name, delay in model.delays.items():
        _bounded(delay.time, False, _place(model, "delays", name, "time"))
    for name, sampled in model.sampled.items():
        _bounded(sampled.period, True, _place(model, "sampled", name, "period"))
        _bounded(sampled.compute, False, _place(model, "sampled", name, "compute"))
    guesses = [("states", n, "guess", s.guess) for n, s in model.states.items() if s.guess is not None]
    for section, name, part, value in [
        *guesses,
        *(("algebraic", n, "start", a.start) for n, a in model.algebraic.items()),
    ]:
        if not math.isfinite(value):
            place = _place(model, section, name, part)
            raise ModelError(f"the {part} is not finite", where=place, expected="a finite number", got=f"{value}")


def _bounded(time: sp.Expr, above: bool, place: str) -> None:
    if time.is_number and (time < 0 or (above and time == 0)):
        raise ModelError(
            "the time is wrong", where=place, expected=f"s, {'above 0' if above else 'at least 0'}", got=f"{time}"
        )


def _check_parameterisation(model: Model, name: str, parameterisation: Parameterisation) -> None:
    place = _place(model, "parameterisations", name)
    if not isinstance(name, str) or not name.strip():
        raise ModelError("a parameterisation needs a name", where=_model(model))
    if not parameterisation.replaces and not parameterisation.parameters:
        return  # the model's own parameters, under a name
    if not parameterisation.replaces:
        raise ModelError("it replaces nothing", where=place, expected="a parameter of the model and its expression")
    for replaced in parameterisation.replaces:
        if replaced not in model.parameters:
            raise unknown_name("parameter", str(replaced), model.parameters, where=f"{place}, replaces")
    kept = set(model.names) - set(parameterisation.replaces)
    for new in parameterisation.parameters:
        check_name(new, f"{place}, parameter '{new}'")
        if new in kept:
            raise ModelError(f"the name '{new}' is taken in the model", where=place, expected="another name")
    known = [*parameterisation.parameters, *(p for p in model.parameters if p in kept)]
    for replaced, expression in parameterisation.replaces.items():
        require_known("parameter", sorted(_used(expression)), known, f"{place}, replaced '{replaced}'")


def ordered_signals(model: Model) -> tuple[str, ...]:
    """Return the names of the signals, each after the signals it uses, otherwise as they were defined.

    Raises ModelError with the circle where signals use each other in one.
    """
    return dependency_order(model, {n: s.value for n, s in model.signals.items()})


def dependency_order(model: Model, definitions: Mapping[str, sp.Expr]) -> tuple[str, ...]:
    """Return the defined names of a model, each after those it uses, else in their order. Raises ModelError with a circle."""
    uses = {n: [s for s in sorted(_used(e)) if s in definitions] for n, e in definitions.items()}
    order: list[str] = []
    done: set[str] = set()
    for first in uses:
        path = [(first, iter(uses[first]))] if first not in done else []
        open_names = {first: 0}
        while path:
            name, rest = path[-1]
            used = next((u for u in rest if u not in done), None)
            if used is None:
                path.pop()
                open_names.pop(name)
                done.add(name)
                order.append(name)
            elif used in open_names:
                raise _circle(model, [n for n, _ in path[open_names[used] :]])
            else:
                open_names[used] = len(path)
                path.append((used, iter(uses[used])))
    return tuple(order)


def _circle(model: Model, names: list[str]) -> ModelError:
    shown = names if len(names) <= 12 else [*names[:11], f"({len(names) - 11} more)"]
    return ModelError(
        f"signals run in a circle: {' -> '.join([*shown, names[0]])}",
        where=_model(model),
        expected="signals that lead to states, inputs and parameters",
        hint=f"make one of them an unknown: move '{names[0]}' from signals to `algebraic` (give a connection a start), "
        "or put a state or delay in",
    )
