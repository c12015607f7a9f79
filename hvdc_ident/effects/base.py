"""What an effect is: how readers of a slot see something else than the slot's own signal.

An effect is data (`Effect`), its use in a model is data (`EffectUse`), and `apply` makes the model. The sizes worth
trying when an effect is looked for are in `hvdc_ident.effects.probing`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import sympy as sp

from hvdc_ident.errors import InputError, ModelError, unknown_name
from hvdc_ident.expression.functions import symbol
from hvdc_ident.expression.parser import parse
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Delay, Model, Sampled, Signal, State
from hvdc_ident.model.transform import fresh, rewritten, slot
from hvdc_ident.parameters import Parameter

SLOT_KINDS = ("input", "signal", "algebraic", "state", "output")
FOLLOW = 2e-4
"""s: how fast an effect that follows its signal without a lag of its own does so (rate limit, play)."""

Measure = Literal[
    "one",
    "time",
    "time*R",
    "rate",
    "range",
    "peak",
    "excursion",
    "range/time",
    "range/source",
    "range/source2",
    "of T2",
]


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    value: what it starts at where none is given. neutral: the value at which the effect is not there; a text: the
    other parameter that it then equals; None: this parameter does not switch it off.
    optional: at its neutral value only this parameter is left out; the effect is still there while another one acts.
    measure: what a size is counted in when the effect is looked for; probes: the sizes worth trying, counted so;
    search: the bounds of a refit, counted so (None: those of the measure). near: instead, a factor up and down from the
    probe. held: a refit leaves it where it stands. companion: an optional one that is tried with the others only.
    """

    value: float
    neutral: float | str | None = None
    unit: str = ""
    min: float = 0.0
    max: float = math.inf
    description: str = ""
    measure: Measure = "one"
    probes: tuple[float, ...] = ()
    search: tuple[float, float] | None = None
    near: float | None = None
    optional: bool = False
    held: bool = False
    companion: bool = False


class Additions:
    """What an effect adds to the model: states, delays, sampled values, signals, under names that are free.

    kind: of the slot, one of SLOT_KINDS. circular: whether the slot lies on an algebraic loop.
    """

    def __init__(self, model: Model, prefix: str, kind: str, circular: bool) -> None:
        self.model, self._prefix, self.kind, self.circular = model, prefix, kind, circular

    def state(
        self, label: str, derivative: Callable[[sp.Symbol], sp.Expr], rest: sp.Expr | None = None, unit: str = ""
    ) -> sp.Symbol:
        """The symbol of a new state; `derivative` gets it. rest: what the state equals at rest, where the derivative leaves it open."""
        name = fresh(self.model, f"{self._prefix}_{label}")
        x = symbol(name)
        self.model = replace(self.model, states=self.model.states | {name: State(derivative(x), rest=rest, unit=unit)})
        return x

    def states(
        self, labels: Sequence[str], derivatives: Callable[[tuple[sp.Symbol, ...]], Sequence[sp.Expr]]
    ) -> tuple[sp.Symbol, ...]:
        """The symbols of new states that depend on each other; `derivatives` gets them all."""
        names = [fresh(self.model, f"{self._prefix}_{label}") for label in labels]
        symbols = tuple(symbol(n) for n in names)
        added = {n: State(d) for n, d in zip(names, derivatives(symbols), strict=True)}
        self.model = replace(self.model, states=self.model.states | added)
        return symbols

    def start(self, of: sp.Expr) -> sp.Symbol:
        """The symbol of the value that an expression has at the start: a state that never moves."""
        return self.state("start", lambda _: sp.S.Zero, rest=of)

    def signal(self, label: str, value: sp.Expr) -> sp.Symbol:
        """The symbol of a new named signal: an expression used more than once stands in the model once."""
        name = fresh(self.model, f"{self._prefix}_{label}")
        self.model = replace(self.model, signals=self.model.signals | {name: Signal(value)})
        return symbol(name)

    def delay(self, of: sp.Expr, time: sp.Expr) -> sp.Symbol:
        """The symbol of u(t - time)."""
        name = fresh(self.model, f"{self._prefix}_delayed")
        self.model = replace(self.model, delays=self.model.delays | {name: Delay(of, time)})
        return symbol(name)

    def sampled(self, value: sp.Expr, period: sp.Expr, compute: sp.Expr) -> sp.Symbol:
        """The symbol of a value taken every period and published `compute` later."""
        name = fresh(self.model, f"{self._prefix}_held")
        self.model = replace(self.model, sampled=self.model.sampled | {name: Sampled(value, period, compute)})
        return symbol(name)


class Rewrite(Protocol):
    """y, what readers of the slot see: from u, the slot's own signal, the effect's parameters, and room for additions.

    p: the parameters' symbols by name, without the optional ones that are left out; "from": the other signal, and
    "expression": the term, where the effect has one.
    """

    def __call__(self, u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr: ...


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    places: kinds of slot where it may sit. states: those it adds, a sentence's part for people. sentence: for the
    report, with {at}, {from} and the parameters by name. excited_by: the experiment that makes it visible.
    confusable: other effects that may explain the same data, each with what separates them.
    needs_source: whether it brings another signal in (`from`). needs_expression: whether its form is given with it,
    with coefficients of the user's own names. resistance: the parameter for which a resistance of the model stands in.
    """

    name: str
    summary: str
    parameters: FrozenMap[EffectParameter]
    rewrite: Rewrite
    sentence: str
    excited_by: str
    places: tuple[str, ...] = SLOT_KINDS
    states: str = "none"
    confusable: FrozenMap[str] = field(default_factory=FrozenMap)
    needs_source: bool = False
    needs_expression: bool = False
    resistance: str = ""

    def is_neutral(self, values: Mapping[str, float | str]) -> bool:
        """Whether the effect is not there: a parameter switches it off, or none of the optional ones acts."""
        switches = {n: q for n, q in self.parameters.items() if q.neutral is not None and not q.optional}
        if switches:
            return any(_at_neutral(q, values[n], values) for n, q in switches.items())
        return all(_at_neutral(q, values[n], values) for n, q in self.parameters.items() if q.optional)


def _at_neutral(q: EffectParameter, value: float | str, values: Mapping[str, float | str]) -> bool:
    return value == (values[q.neutral] if isinstance(q.neutral, str) else q.neutral)


COEFFICIENT = EffectParameter(0.0, neutral=0.0, min=-math.inf, optional=True, description="coefficient of the term")


@dataclass(frozen=True)
class EffectUse:
    """An effect at one or more slots that share its parameters.

    parameters: values that differ from the effect's own; a text is the name of a parameter of the model that stands
    in for it. source: the other signal that the effect brings in (`from` in a study file): any slot. prefix: of its
    names in the model; default EFFECT_SLOT. expression: the term, where the effect is one.
    """

    effect: str
    at: tuple[str, ...]
    parameters: FrozenMap[float | str] = field(default_factory=FrozenMap)
    prefix: str = ""
    source: str = ""
    expression: str = ""

    @classmethod
    def of(cls, given: EffectUse | Mapping[str, Any]) -> EffectUse:
        """From itself or from a mapping as in a study file."""
        if isinstance(given, EffectUse):
            return given
        known = ("effect", "at", "parameters", "from", "expression", "prefix")
        for key in given:
            if key not in known:
                raise unknown_name("key", key, known, where="an effect")
        if "effect" not in given or "at" not in given:
            raise ModelError(
                "an effect needs its name and its place",
                expected="effect = NAME, at = SLOT or [SLOT, ...]",
                got=str(dict(given)),
            )
        at = given["at"]
        return cls(
            str(given["effect"]),
            (at,) if isinstance(at, str) else tuple(at),
            FrozenMap(given.get("parameters", {})),
            str(given.get("prefix", "")),
            str(given.get("from", "")),
            str(given.get("expression", "")),
        )

    def to_dict(self) -> dict[str, Any]:
        """The use as it stands in a study file; `of` gives it back."""
        result: dict[str, Any] = {"effect": self.effect, "at": list(self.at), "parameters": dict(self.parameters)}
        extra = {"from": self.source, "expression": self.expression, "prefix": self.prefix}
        return result | {key: text for key, text in extra.items() if text}

    @property
    def label(self) -> str:
        """The effect's name as part of an identifier."""
        return self.effect.replace("-", "_")

    def parameter_name(self, name: str) -> str:
        """What a parameter of the effect is called in the model."""
        prefix = self.prefix or f"{self.label}_{self.at[0].replace('.', '_')}"
        return f"{prefix}_{name}"


def apply(model: Model, use: EffectUse, effect: Effect) -> Model:
    """The model with the effect in it; the same model where the effect is neutral.

    Raises ModelError or UnknownNameError for parameters, places and signals that do not fit, with the effect's place.
    """
    where = f"effect '{use.effect}' at {', '.join(use.at)}"
    parameters = _parameters(use, effect, where)
    _check_places(model, use, effect, where)
    given = {n: use.parameters.get(n, q.value) for n, q in parameters.items()}
    values = {n: _resolved(model, v, f"{where}, parameter '{n}'") for n, v in given.items()}
    if replace(effect, parameters=FrozenMap(parameters)).is_neutral(values):
        return model
    if bool(use.source) != effect.needs_source:
        raise ModelError(
            "the effect needs another signal" if effect.needs_source else "the effect brings no other signal in",
            where=where,
            expected="from = SLOT" if effect.needs_source else "no `from`",
            got=repr(use.source) if use.source else "nothing",
        )
    symbols: dict[str, sp.Expr] = {}
    added: dict[str, Parameter] = {}
    for n, q in parameters.items():
        if q.optional and values[n] == q.neutral:
            continue
        if isinstance(given[n], str):
            symbols[n] = symbol(str(given[n]))
            continue
        name = fresh(model, use.parameter_name(n))
        try:
            added[name] = Parameter(values[n], q.unit, q.min, q.max, description=q.description)
        except ModelError as e:
            raise e.at(f"{where}, parameter '{n}'") from None
        symbols[n] = symbol(name)
    model = replace(model, parameters=model.parameters | added)
    for place in use.at:
        model = _at_one(model, place, use, effect, symbols, where)
    return model


def _at_one(
    model: Model, place: str, use: EffectUse, effect: Effect, symbols: Mapping[str, sp.Expr], where: str
) -> Model:
    """The model with the effect at one of its slots."""
    kind, name = slot(model, place)
    circular = kind in ("signal", "algebraic") and _leads_back(model, name)

    def rewrite(m: Model, u: sp.Expr) -> tuple[Model, sp.Expr]:
        p = dict(symbols)
        # The slot's own name stands for what it was before the effect: after it, it would run in a circle.
        own = {symbol(name): u} if kind in ("signal", "algebraic") else {}
        if effect.needs_source:
            p["from"] = _source(m, use.source, where).xreplace(own)
        if effect.needs_expression:
            p["expression"] = _term(use, symbols, where).xreplace(own)
        add = Additions(m, f"{use.label}_{place.replace('.', '_')}", kind, circular)
        y = effect.rewrite(u, p, add)
        return add.model, y

    try:
        return rewritten(model, place, use.label, rewrite)
    except InputError as e:
        raise e.at(where) from None


def _leads_back(model: Model, name: str) -> bool:
    """Whether a signal or unknown is computed from itself, through other signals and unknowns alone."""
    equations = {n: s.value for n, s in model.signals.items()} | {n: a.equation for n, a in model.algebraic.items()}
    seen: set[str] = set()
    stack = [name]
    while stack:
        used = {s.name for s in equations[stack.pop()].free_symbols} & equations.keys()
        if name in used:
            return True
        stack.extend(used - seen)
        seen |= used
    return False


def _parameters(use: EffectUse, effect: Effect, where: str) -> Mapping[str, EffectParameter]:
    """The effect's parameters in this use: its own, or the coefficients of a term."""
    if effect.needs_expression:
        if not use.expression or not use.parameters:
            raise ModelError(
                "a term needs its form and at least one coefficient",
                where=where,
                expected='expression = "k*w**3", parameters = {k = 0.1}',
                got=f"expression {use.expression!r}, parameters {dict(use.parameters)}",
            )
        return dict.fromkeys(use.parameters, COEFFICIENT)
    if use.expression:
        raise ModelError("only a term has an expression", where=where, got=repr(use.expression))
    for name in use.parameters:
        if name not in effect.parameters:
            raise unknown_name("parameter", name, effect.parameters, where=where)
    return effect.parameters


def _check_places(model: Model, use: EffectUse, effect: Effect, where: str) -> None:
    if not use.at:
        raise ModelError("the effect has no place", where=where, expected="at least one slot")
    for place in use.at:
        kind = slot(model, place)[0]
        if kind not in effect.places:
            raise ModelError(
                f"the effect cannot sit at the {kind} '{place}'", where=where, expected=" or ".join(effect.places)
            )


def _resolved(model: Model, value: float | str, where: str) -> float:
    """The number of a parameter that is given as one or as the name of a parameter of the model."""
    if isinstance(value, str):
        if value not in model.parameters:
            raise unknown_name("parameter", value, model.parameters, where=where)
        return model.parameters[value].value
    return float(value)


def _source(model: Model, name: str, where: str) -> sp.Expr:
    kind, name = slot(model, name) if name in model.slots else _no_source(model, name, where)
    return model.outputs[name].value if kind == "output" else symbol(name)


def _no_source(model: Model, name: str, where: str) -> tuple[str, str]:
    raise unknown_name("signal", name, model.slots, where=f"{where}, from")


def _term(use: EffectUse, symbols: Mapping[str, sp.Expr], where: str) -> sp.Expr:
    """The term's expression, its coefficients under the names they have in the model; those at 0 are gone."""
    coefficients = {symbol(n): symbols.get(n, sp.S.Zero) for n in use.parameters}
    expression = parse(use.expression, where=f"{where}, expression")
    missing = sorted(c.name for c in coefficients if c not in expression.free_symbols)
    if missing:
        raise ModelError(f"the term does not use its coefficient '{missing[0]}'", where=where, got=use.expression)
    return expression.xreplace(coefficients)
