"""An effect put into a model: where it sits, with which values, and what signal it brings in."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.errors import InputError, ModelError, unknown_name
from hvdc_ident.expression import parse, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, Model, fresh, insertion_point, insertion_point_of, rewritten
from hvdc_ident.parameters import Parameter

COEFFICIENT = EffectParameter(0.0, neutral=0.0, min=-math.inf, optional=True, description="coefficient of the term")


@dataclass(frozen=True)
class EffectUse:
    """An effect at one or more slots that share its parameters.

    parameters: values that differ from the effect's own; a text is the name of a parameter of the model that stands
    in for it. source: the other signal that the effect brings in (`from` in a study file): any slot; or, joined by commas,
    one for each of its places, as each station brings in a signal of its own. prefix: of its names in the model; default
    EFFECT_SLOT. expression: the term, where the effect is one.
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
        at, source = given["at"], given.get("from", "")
        return cls(
            str(given["effect"]),
            (at,) if isinstance(at, str) else tuple(at),
            FrozenMap(given.get("parameters", {})),
            str(given.get("prefix", "")),
            source if isinstance(source, str) else joined(source),
            str(given.get("expression", "")),
        )

    def to_dict(self) -> dict[str, Any]:
        """The use as it stands in a study file; `of` gives it back."""
        result: dict[str, Any] = {"effect": self.effect, "at": list(self.at), "parameters": dict(self.parameters)}
        source = list(self.sources) if "," in self.source else self.source
        extra = {"from": source, "expression": self.expression, "prefix": self.prefix}
        return result | {key: told for key, told in extra.items() if told}

    def within(self, model: AnyModel) -> EffectUse:
        """Return the use at this model's slots: what sat behind an effect that the model lacks sits where that one did."""
        source = joined(insertion_point_of(model.slots, s) for s in self.sources)
        return replace(self, at=tuple(insertion_point_of(model.slots, place) for place in self.at), source=source)

    @property
    def sources(self) -> tuple[str, ...]:
        """By place the signal that is brought in there; () where the effect brings none in. Raises ModelError where they
        are neither one for all places nor one for each."""
        return each_its_own(self.source, self.at)

    @property
    def label(self) -> str:
        """The effect's name as part of an identifier."""
        return self.effect.replace("-", "_")

    def parameter_name(self, name: str) -> str:
        """Name of a parameter of the effect in the model."""
        prefix = self.prefix or self.prefix_at(self.at[0])
        return f"{prefix}_{name}"

    def made(self, name: str) -> bool:
        """True for a state or signal of the model that is part of this effect, False for a slot that it sits at."""
        return any(name.startswith(f"{self.prefix_at(place)}_") for place in self.at)

    def prefix_at(self, place: str) -> str:
        """Prefix of the names of all that the effect adds at a place."""
        return f"{self.label}_{place.replace('.', '_')}"


def joined(sources: Iterable[str]) -> str:
    """One text of what is brought in by place: of one signal its name."""
    own = list(sources)
    return ", ".join(own[:1] if len(set(own)) == 1 else own)


def each_its_own(source: str, at: Sequence[str]) -> tuple[str, ...]:
    """By place what `joined` put into one text: one signal for all, or one for each."""
    names = tuple(name.strip() for name in source.split(",")) if source else ()
    if len(names) > 1 and len(names) != len(at):
        raise ModelError(
            "an effect brings in one signal, or one for each of its places",
            where=f"the effect at {', '.join(at)}, from",
            expected=f"1 or {len(at)} names",
            got=source,
        )
    return names * len(at) if len(names) == 1 else names


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
    for place, source in zip(use.at, use.sources or ("",) * len(use.at), strict=True):
        model = _at_one(model, place, source, use, effect, symbols, where)
    return model


def _at_one(
    model: Model,
    place: str,
    source: str,
    use: EffectUse,
    effect: Effect,
    symbols: Mapping[str, sp.Expr],
    where: str,
) -> Model:
    """The model with the effect at one of its slots. source: what is brought in there."""
    kind, name = insertion_point(model, place)
    circular = kind in ("signal", "algebraic") and _leads_back(model, name)

    def rewrite(m: Model, u: sp.Expr) -> tuple[Model, sp.Expr]:
        p = dict(symbols)
        # The slot's own name stands for what it was before the effect: after it, it would run in a circle.
        own = {symbol(name): u} if kind in ("signal", "algebraic") else {}
        if effect.needs_source:
            p["from"] = _source(m, source, where).xreplace(own)
        if effect.needs_expression:
            p["expression"] = _term(use, symbols, where).xreplace(own)
        add = Additions(m, use.prefix_at(place), kind, circular)
        y = effect.rewrite(u, p, add)
        return add.model, y

    try:
        return rewritten(model, place, use.label, rewrite)
    except InputError as e:
        raise e.at(where) from None


def _leads_back(model: Model, name: str) -> bool:
    """True where a signal or unknown is computed from itself, through other signals and unknowns alone."""
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
        kind = insertion_point(model, place)[0]
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
    kind, name = insertion_point(model, name) if name in model.slots else _no_source(model, name, where)
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
