"""Models made from models: insertion points rewritten, driven by recordings, or written in other parameters."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

import sympy as sp

from hvdc_ident.errors import ModelError, unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model.definition import Algebraic, Model, ModelOrigin, Signal
from hvdc_ident.parameters import Input, Parameter

Renaming = Mapping[sp.Symbol, sp.Expr]


def fresh(model: Model, name: str) -> str:
    """Return a name like the one given that the model does not use yet."""
    taken = {*model.names, *(f"{s}_start" for s in model.states)}
    if name not in taken:
        return name
    return next(f"{name}_{k}" for k in range(2, 10_000) if f"{name}_{k}" not in taken)


def substituted(model: Model, renaming: Renaming) -> dict[str, Any]:
    """Return the model's equations with symbols exchanged, as fields for `dataclasses.replace`."""

    def new(e: Any) -> Any:
        return e.xreplace(renaming) if isinstance(e, sp.Basic) else e

    return {
        "states": FrozenMap(
            {n: replace(s, derivative=new(s.derivative), rest=new(s.rest)) for n, s in model.states.items()}
        ),
        "signals": FrozenMap({n: replace(s, value=new(s.value)) for n, s in model.signals.items()}),
        "algebraic": FrozenMap({n: replace(a, equation=new(a.equation)) for n, a in model.algebraic.items()}),
        "outputs": FrozenMap({n: replace(o, value=new(o.value)) for n, o in model.outputs.items()}),
        "delays": FrozenMap({n: replace(d, of=new(d.of)) for n, d in model.delays.items()}),
        "sampled": FrozenMap({n: replace(s, value=new(s.value)) for n, s in model.sampled.items()}),
    }


CONSTANT = ("start", "vanishes", "time", "period", "compute")
"""Fields of a model's objects that are expressions of parameters alone."""


def with_constants(item: Any, written: Renaming) -> Any:
    """Return an object of a model in whose constant fields parameters are expressions of other parameters."""
    fields = {n: getattr(item, n, None) for n in CONSTANT}
    changed = {n: e.xreplace(written) for n, e in fields.items() if isinstance(e, sp.Basic)}
    return replace(item, **changed) if changed else item


def insertion_point(model: Model, name: str) -> tuple[str, str]:
    """Return (kind, name) of an insertion point: input, signal, algebraic, state or output; "outputs.NAME" asks for the output."""
    if name.startswith("outputs."):
        if name[8:] in model.outputs:
            return "output", name[8:]
    else:
        for kind, names in (
            ("input", model.inputs),
            ("signal", model.signals),
            ("algebraic", model.algebraic),
            ("state", model.states),
            ("output", model.outputs),
        ):
            if name in names:
                return kind, name
    raise unknown_name("insertion point", name, model.insertion_points, where=f"model '{model.name}'")


def rewritten(model: Model, name: str, label: str, rewrite: Callable[[Model, sp.Expr], tuple[Model, sp.Expr]]) -> Model:
    """Return the model in which all readers of an insertion point see another expression of it.

    rewrite(model, u) returns the model with what it needs added, and the expression y of u that readers see. Before the
    rewrite u is a name of its own: `NAME_before_LABEL` for signals and unknowns (readers keep the name), else readers
    of an input or a state see `NAME_after_LABEL`. An unknown whose circle the effect opens becomes a signal by itself.
    """
    kind, name = insertion_point(model, name)
    origin = model.origin or ModelOrigin(model)
    if kind == "output":
        model, y = rewrite(model, model.outputs[name].value)
        return replace(model, outputs=model.outputs | {name: replace(model.outputs[name], value=y)})
    if kind in ("input", "state"):
        seen = fresh(model, f"{name}_after_{label}")
        unit = model.inputs[name].unit if kind == "input" else model.states[name].unit
        signals = {seen: Signal(symbol(name), unit)}
        fields = substituted(model, {symbol(name): symbol(seen)})
        model = replace(model, **fields | {"signals": fields["signals"] | signals})
        model, y = rewrite(model, symbol(name))
        neutral = {n: e.xreplace({symbol(name): symbol(seen)}) for n, e in origin.neutral.items()} | {
            seen: symbol(name)
        }
        return replace(
            model,
            signals=model.signals | {seen: Signal(y, unit)},
            origin=ModelOrigin(origin.root, FrozenMap(neutral)),
        )
    before = fresh(model, f"{name}_before_{label}")
    # What stood there so far, with the effects that it had, is now what readers of `before` see.
    moved = {before: origin.neutral[name]} if name in origin.neutral else {}
    origin = ModelOrigin(origin.root, origin.neutral | moved | {name: symbol(before)})
    if kind == "signal":
        old = model.signals[name]
        model = replace(model, signals=_inserted(model.signals, name, before, replace(old)))
        model, y = rewrite(model, symbol(before))
        return replace(model, signals=model.signals | {name: replace(old, value=y)}, origin=origin)
    unknown = model.algebraic[name]
    model = replace(
        model,
        signals=model.signals | {before: Signal(unknown.equation, unknown.unit)},
        algebraic=model.algebraic | {name: replace(unknown, equation=symbol(before))},
    )
    model, y = rewrite(model, symbol(before))
    return replace(model, algebraic=model.algebraic | {name: replace(unknown, equation=y)}, origin=origin)


def without_delays(model: Model, names: Collection[str]) -> Model:
    """Return the model in which these delayed signals are the signals themselves, as with a time of 0.

    Where a delay alone opened a circle its signal is an algebraic unknown.
    """
    unknowns = {n: Algebraic(model.delays[n].of) for n in names}
    return replace(
        model,
        delays=FrozenMap({n: d for n, d in model.delays.items() if n not in unknowns}),
        algebraic=model.algebraic | unknowns,
        origin=model.origin or ModelOrigin(model),
    )


def without_vanished(model: Model) -> Model:
    """Return the model in which each state whose time constant `vanishes` is 0 at the parameters' values is a signal, its rest.

    A lag of 0 s is a wire. Where the time constant is a parameter, conditions on it are decided and it cannot leave 0: the block
    that it belongs to is gone. Raises ModelError where what is left runs in a circle.
    """
    gone = [n for n, s in model.states.items() if s.vanishes is not None and _is_zero(model, s.vanishes)]
    if not gone:
        return model
    times = {s.vanishes for n, s in model.states.items() if n in gone and isinstance(s.vanishes, sp.Symbol)}
    zero = {t: sp.S.Zero for t in times if t.name in model.parameters}
    decided = substituted(model, zero)  # before the model is checked: a condition may be what opens a circle
    wires = {}
    for n in gone:
        state = decided["states"][n]
        assert state.rest is not None  # the model was checked
        wires[n] = Signal(state.rest, state.unit, state.description)
    fixed = {t.name: replace(model.parameters[t.name], min=0.0, max=0.0) for t in zero}
    changed = decided | {
        "parameters": model.parameters | fixed,
        "states": decided["states"].without(*gone),
        "signals": FrozenMap({**wires, **decided["signals"]}),
    }
    return replace(model, **changed, origin=model.origin or ModelOrigin(model))


def _is_zero(model: Model, time: sp.Expr) -> bool:
    """Return True where a time constant is 0 at the parameters' values."""
    at = {s: sp.Float(model.parameters[s.name].value) for s in time.free_symbols}
    return float(time.xreplace(at)) == 0.0


def with_derivative_signal(model: Model, state: str) -> tuple[Model, str]:
    """Return the model in which a state's derivative is a named signal, `der_STATE`, and that name: a place of its own."""
    name, derivative = f"der_{state}", model.states[state].derivative
    if name in model.signals and derivative == symbol(name):
        return model, name
    name = fresh(model, name)
    states = model.states | {state: replace(model.states[state], derivative=symbol(name))}
    origin = model.origin or ModelOrigin(model)
    return replace(model, states=states, signals=model.signals | {name: Signal(derivative)}, origin=origin), name


def blended(model: Model) -> tuple[Model, str]:
    """Return the model with a parameter that scales its effects from 0 to 1, and its name ("" without effects).

    Readers of an insertion point see u + blend (y - u): at 0 they see what they see in the model of origin, at 1 the model is itself.
    """
    if model.origin is None or not model.origin.neutral:
        return model, ""
    neutral, name = model.origin.neutral, fresh(model, "blend")
    share = symbol(name)

    def seen(point: str, value: sp.Expr) -> sp.Expr:
        return neutral[point] + share * (value - neutral[point]) if point in neutral else value

    signals = {n: replace(s, value=seen(n, s.value)) for n, s in model.signals.items()}
    algebraic = {n: replace(a, equation=seen(n, a.equation)) for n, a in model.algebraic.items()}
    share_of_effects = Parameter(1.0, min=0.0, max=1.0)
    made = replace(
        model,
        parameters=model.parameters | {name: share_of_effects},
        signals=FrozenMap(signals),
        algebraic=FrozenMap(algebraic),
    )
    return made, name


def insertion_point_of(points: Collection[str], name: str) -> str:
    """Return the insertion point among these that `rewritten` made the name at; the name itself where it is one of them."""
    point = name
    while point not in points:
        base = max(point.rpartition("_before_")[0], point.rpartition("_after_")[0], key=len)
        if not base:
            return name
        point = base
    return point


def _inserted(signals: FrozenMap[Signal], name: str, before: str, value: Signal) -> FrozenMap[Signal]:
    """Return the signals with `before` put in front of `name`, which for now only repeats it."""
    items: dict[str, Signal] = {}
    for n, s in signals.items():
        if n == name:
            items[before] = value
            items[n] = replace(s, value=symbol(before))
        else:
            items[n] = s
    return FrozenMap(items)


def _derived(model: Model) -> Model:
    """Return the model, with itself as what it comes from where it does not come from another."""
    return model if model.origin else replace(model, origin=ModelOrigin(model))


def driven(model: Model, points: tuple[str, ...]) -> Model:
    """Return the model in which the insertion points are inputs of the same name, to follow a recorded column."""
    model = _derived(model) if points else model
    for given in points:
        kind, name = insertion_point(model, given)
        if kind == "output":
            raise ModelError(
                "an output cannot be driven",
                where=f"model '{model.name}', drive '{given}'",
                expected="a signal, unknown, state or input",
                hint="drive the signal that the output shows",
            )
        if kind == "input":
            continue
        section = {"signal": "signals", "algebraic": "algebraic", "state": "states"}[kind]
        items = getattr(model, section)
        column = Input(0.0, items[name].unit, "driven by a recording")
        fields = {section: items.without(name), "inputs": model.inputs | {name: column}}
        if kind == "state" and items[name].start == "free":
            fields["parameters"] = model.parameters.without(f"{name}_start")
        model = replace(model, **fields)
    return model


def parameterised(model: Model, name: str) -> Model:
    """Return the model with some parameters written as expressions of the parameterisation's own."""
    if name not in model.parameterisations:
        raise unknown_name("parameterisation", name, model.parameterisations, where=f"model '{model.name}'")
    chosen = model.parameterisations[name]
    if not chosen.replaces:
        return model
    parameters: dict[str, Parameter] = {}
    for n, p in model.parameters.items():
        if n in chosen.replaces:
            parameters |= {k: v for k, v in chosen.parameters.items() if k not in parameters}
        else:
            parameters[n] = p
    signals = {
        n: Signal(e, model.parameters[n].unit, model.parameters[n].description) for n, e in chosen.replaces.items()
    }
    others = FrozenMap(
        {k: v for k, v in model.parameterisations.items() if k != name and not set(v.replaces) & set(chosen.replaces)}
    )
    return replace(
        _derived(model),
        parameters=FrozenMap(parameters),
        signals=FrozenMap({**signals, **model.signals}),
        parameterisations=others,
    )


def tied(model: Model, ties: Mapping[str, sp.Expr]) -> Model:
    """Return the model in which some parameters are expressions of others; they become signals of their names.

    Raises ModelError for an expression that uses anything but parameters that are not tied, UnknownNameError for a tie
    of what is no parameter.
    """
    free = [n for n in model.parameters if n not in ties]
    for name, expression in ties.items():
        if name not in model.parameters:
            raise unknown_name("parameter", name, model.parameters, where="ties")
        wrong = sorted(s.name for s in expression.free_symbols if s.name not in free)
        if wrong:
            known = wrong[0] in model.parameters
            raise ModelError(
                f"the tie of '{name}' uses '{wrong[0]}', which is {'tied itself' if known else 'no parameter'}",
                where=f"tie of '{name}'",
                expected="an expression of parameters that are not tied",
                got=str(expression),
            )
    signals = {
        n: Signal(e, model.parameters[n].unit, model.parameters[n].description or f"tied to {e}")
        for n, e in ties.items()
    }
    others = {k: v for k, v in model.parameterisations.items() if not set(v.replaces) & set(ties)}
    written = {symbol(n): e for n, e in ties.items()}
    constants: dict[str, Any] = {
        section: FrozenMap({n: with_constants(i, written) for n, i in getattr(model, section).items()})
        for section in ("states", "delays", "sampled")
    }
    return replace(
        _derived(model),
        **constants,
        parameters=model.parameters.without(*ties),
        signals=FrozenMap({**signals, **model.signals}),
        parameterisations=FrozenMap(others),
    )
