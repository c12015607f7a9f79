"""Consistency checks of a model: its names, the symbols in its expressions, and no circle of signals."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from typing import TYPE_CHECKING

import sympy as sp

from hvdc_ident.errors import ModelError, UnknownNameError, unknown_name
from hvdc_ident.expression.functions import FUNCTIONS
from hvdc_ident.expression.grammar import is_identifier, is_reserved
from hvdc_ident.model.coerce import SECTIONS, coerced

if TYPE_CHECKING:
    from hvdc_ident.model.definition import Model, Parameterisation

__all__ = ["check", "coerced", "ordered_signals"]

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
            _check_name(name, _place(model, section, name))
            if section == "outputs":
                continue
            if name in owner:
                what = f"the name is taken: it is also a {SECTIONS[owner[name]][2]}"
                raise ModelError(what, where=_place(model, section, name), expected="one variable a name")
            owner[name] = section


def _check_name(name: object, place: str) -> None:
    if not is_identifier(name):
        raise ModelError(
            f"{name!r} cannot name a variable", where=place, expected="letters, digits and _, no digit first"
        )
    if is_reserved(name):
        what = "function" if name in FUNCTIONS else "constant" if name == "pi" else "clock"
        raise ModelError(f"the name '{name}' is the {what} of expressions", where=place, expected="another name")


def _expressions(model: Model) -> Iterator[tuple[str, str, str, sp.Expr, bool]]:
    """(section, name, part, expression, whether only parameters may be used) of every expression of the model."""
    for name, state in model.states.items():
        yield "states", name, "", state.derivative, False
        if isinstance(state.start, sp.Expr):
            yield "states", name, "start", state.start, True
        if state.rest is not None:
            yield "states", name, "rest", state.rest, False
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
    for name, delay in model.delays.items():
        _bounded(delay.time, True, _place(model, "delays", name, "time"))
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
        _check_name(new, f"{place}, parameter '{new}'")
        if new in kept:
            raise ModelError(f"the name '{new}' is taken in the model", where=place, expected="another name")
    known = [*parameterisation.parameters, *(p for p in model.parameters if p in kept)]
    for replaced, expression in parameterisation.replaces.items():
        for used in sorted(_used(expression)):
            if used not in known:
                raise unknown_name("parameter", used, known, where=f"{place}, replaced '{replaced}'")


def ordered_signals(model: Model) -> tuple[str, ...]:
    """The names of the signals, each after the signals it uses, otherwise as they were defined.

    Raises ModelError with the circle where signals use each other in one.
    """
    signals = model.signals
    uses = {n: [s for s in sorted(_used(signal.value)) if s in signals] for n, signal in signals.items()}
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
        hint=f"make one of them an unknown: move '{names[0]}' from signals to `algebraic`, or put a state or delay in",
    )
