"""Insertion of effects into a model: `EffectUse` says which effect sits where, with which values and which other signal.

`effects` is the catalogue, found by walking this folder; `apply_effects` inserts a list of uses, one after the other.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, overload

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.errors import InputError, ModelError, require_known
from hvdc_ident.expression import parse, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import (
    AnyModel,
    Model,
    fresh,
    insertion_point,
    insertion_point_of,
    is_white_box,
    reached,
    rewritten,
    with_derivative_signal,
)
from hvdc_ident.parameters import Parameter

COEFFICIENT = EffectParameter(0.0, neutral=0.0, min=-math.inf, optional=True, description="coefficient of the term")


NOT_EFFECTS = ("base", "placement", "probing")
"""Modules of this folder that hold no effect."""


@cache
def effects() -> FrozenMap[Effect]:
    """Return every effect of the catalogue by name."""
    names = [m.name for m in pkgutil.iter_modules([str(Path(__file__).parent)]) if m.name not in NOT_EFFECTS]
    entries = [importlib.import_module(f"hvdc_ident.effects.{name}").EFFECT for name in names]
    return FrozenMap({e.name: e for e in sorted(entries, key=lambda e: e.name)})


@dataclass(frozen=True)
class EffectUse:
    """An effect at one or more insertion points that share its parameters.

    parameters: values that differ from the effect's defaults; a text is the name of a parameter of the model that replaces
    it. source: the other signal that the effect brings in (`from` in a study file): any insertion point; or, joined by
    commas, one for each place of the effect, as each station brings in its own signal. prefix: of its names in the model;
    default EFFECT_PLACE. expression: the term, where the effect is one.
    """

    effect: str
    at: tuple[str, ...]
    parameters: FrozenMap[float | str] = field(default_factory=FrozenMap)
    prefix: str = ""
    source: str = ""
    expression: str = ""

    @classmethod
    def of(cls, given: EffectUse | Mapping[str, Any]) -> EffectUse:
        """Return the use itself, or that which a mapping describes as in a study file."""
        if isinstance(given, EffectUse):
            return given
        require_known("key", given, ("effect", "at", "parameters", "from", "expression", "prefix"), "an effect")
        if "effect" not in given or "at" not in given:
            raise ModelError(
                "an effect needs its name and its place",
                expected="effect = NAME, at = PLACE or [PLACE, ...]",
                got=str(dict(given)),
            )
        at, source = given["at"], given.get("from", "")
        return cls(
            str(given["effect"]),
            (at,) if isinstance(at, str) else tuple(at),
            FrozenMap(given.get("parameters", {})),
            str(given.get("prefix", "")),
            source if isinstance(source, str) else joined_sources(source),
            str(given.get("expression", "")),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the use as it stands in a study file; `of` is the inverse."""
        result: dict[str, Any] = {"effect": self.effect, "at": list(self.at), "parameters": dict(self.parameters)}
        source = list(self.sources) if "," in self.source else self.source
        extra = {"from": source, "expression": self.expression, "prefix": self.prefix}
        return result | {key: value for key, value in extra.items() if value}

    def within(self, model: AnyModel) -> EffectUse:
        """Return the use at this model's points: what sat behind an effect that the model lacks sits where that one did."""
        source = joined_sources(insertion_point_of(model.insertion_points, s) for s in self.sources)
        return replace(
            self, at=tuple(insertion_point_of(model.insertion_points, place) for place in self.at), source=source
        )

    @property
    def sources(self) -> tuple[str, ...]:
        """Name of the signal brought in at each place, () where the effect brings none in.

        Raises ModelError where there is neither one for all places nor one for each.
        """
        return split_sources(self.source, self.at)

    @property
    def label(self) -> str:
        """Name of the effect as part of an identifier."""
        return self.effect.replace("-", "_")

    def parameter_name(self, name: str) -> str:
        """Return the name of a parameter of the effect in the model."""
        prefix = self.prefix or self.prefix_at(self.at[0])
        return f"{prefix}_{name}"

    def made(self, name: str) -> bool:
        """Return True for a state or signal of the model that is part of this effect, False for its insertion points."""
        return any(name.startswith(f"{self.prefix_at(place)}_") for place in self.at)

    def prefix_at(self, place: str) -> str:
        """Return the prefix of the names of all that the effect adds at a place."""
        return f"{self.label}_{place.replace('.', '_')}"


def joined_sources(sources: Iterable[str]) -> str:
    """Return the names of the signals brought in, one a place, as one text; one name where all are the same."""
    names = list(sources)
    return ", ".join(names[:1] if len(set(names)) == 1 else names)


def split_sources(source: str, at: Sequence[str]) -> tuple[str, ...]:
    """Return the names that `joined_sources` put into one text, one a place. Raises ModelError for another number of names."""
    names = tuple(name.strip() for name in source.split(",")) if source else ()
    if len(names) > 1 and len(names) != len(at):
        raise ModelError(
            "an effect brings in one signal, or one for each of its places",
            where=f"the effect at {', '.join(at)}, from",
            expected=f"1 or {len(at)} names",
            got=source,
        )
    return names * len(at) if len(names) == 1 else names


@overload
def apply_effects(model: Model, uses: Iterable[EffectUse | Mapping[str, Any]]) -> Model: ...
@overload
def apply_effects(model: AnyModel, uses: Iterable[EffectUse | Mapping[str, Any]]) -> AnyModel: ...
def apply_effects(model: AnyModel, uses: Iterable[EffectUse | Mapping[str, Any]]) -> AnyModel:
    """Return the model with the effects inserted one after the other; an effect at its neutral value changes nothing.

    Parameters
    ----------
    model : Model
        The model; it stays as it is. An FMU takes the effects that act on its inputs and outputs.
    uses : list of EffectUse or dict
        `EffectUse` objects or dicts {"effect": name, "at": place or places, "parameters": {NAME: value}}. A place is an input, signal,
        algebraic unknown, state or output; a value is in the effect's unit, or a text: the parameter of the model that replaces it.

    Returns
    -------
    Model
        The model with the effects, whose parameters are named EFFECT_PLACE_NAME unless a use says otherwise.

    Raises
    ------
    ModelError
        An effect, parameters or places that do not fit the model.
    UnknownNameError
        An effect, a parameter, a place or a signal that is not there.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> lagging = hi.apply_effects(hi.load_model("vsc-hvdc-link"), [{"effect": "lag", "at": "Ir1", "parameters": {"T": 0.002}}])
    >>> [name for name in lagging.parameters if "Ir1" in name]
    ['lag_Ir1_T']
    """
    if not is_white_box(model):
        return model.with_effects(uses)
    catalogue = effects()
    for given in uses:
        use = EffectUse.of(given)
        require_known("effect", [use.effect], catalogue, "")
        model = _with_effect(model, use, catalogue[use.effect])
    return model


def _with_effect(model: Model, use: EffectUse, effect: Effect) -> Model:
    """Return the model with the effect in it; the model itself where the effect is neutral.

    Raises ModelError or UnknownNameError for parameters, places and signals that do not fit, with the effect's place.
    """
    where = f"effect '{use.effect}' at {', '.join(use.at)}"
    parameters = _parameters(use, effect, where)
    _check_places(model, use, effect, where)
    given = {n: use.parameters.get(n, q.value) for n, q in parameters.items()}
    values: dict[str, float] = {}
    for n, v in given.items():
        if isinstance(v, str):
            require_known("parameter", [v], model.parameters, f"{where}, parameter '{n}'")
        values[n] = model.parameters[v].value if isinstance(v, str) else float(v)
    if replace(effect, parameters=FrozenMap(parameters)).is_neutral(values):
        return model
    if bool(use.source) != effect.needs_source:
        raise ModelError(
            "the effect needs another signal" if effect.needs_source else "the effect brings no other signal in",
            where=where,
            expected="from = NAME" if effect.needs_source else "no `from`",
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
    """Return the model with the effect at one of its places. source: the signal brought in there."""
    kind, name = insertion_point(model, place)
    added: dict[str, sp.Expr] = {}
    circular = kind in ("signal", "algebraic") and leads_back(model, name)

    def rewrite(m: Model, u: sp.Expr) -> tuple[Model, sp.Expr]:
        p = dict(symbols)
        # In the effect the name of its place means the signal before the effect: the one after it would close a circle.
        before = {symbol(name): u} if kind in ("signal", "algebraic") else {}
        if effect.needs_source:
            p["from"] = _source(m, source, where).xreplace(before)
        if effect.needs_expression:
            p["expression"] = _term(use, symbols, where).xreplace(before)
        if effect.of_derivative:
            p["state"] = symbol(name)
        add = Additions(m, use.prefix_at(place), kind, circular)
        y = effect.rewrite(u, p, add)
        added.update(add.neutral)
        return add.model, y

    try:
        model, changed = with_derivative_signal(model, name) if effect.of_derivative else (model, place)
        made = rewritten(model, changed, use.label, rewrite)
    except InputError as e:
        raise e.at(where) from None
    if not added or made.origin is None:
        return made
    return replace(made, origin=replace(made.origin, neutral=made.origin.neutral | added))


def leads_back(model: Model, name: str) -> bool:
    """Return True where a signal or unknown is computed from itself, through other signals and unknowns alone."""
    equations = {n: s.value for n, s in model.signals.items()} | {n: a.equation for n, a in model.algebraic.items()}

    def used(n: str) -> set[str]:
        return {s.name for s in equations[n].free_symbols} & equations.keys()

    return name in reached(used(name), used)


def _parameters(use: EffectUse, effect: Effect, where: str) -> Mapping[str, EffectParameter]:
    """Return the effect's parameters in this use: those of the catalogue, or the coefficients of a term."""
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
    require_known("parameter", use.parameters, effect.parameters, where)
    return effect.parameters


def _check_places(model: Model, use: EffectUse, effect: Effect, where: str) -> None:
    if not use.at:
        raise ModelError("the effect has no place", where=where, expected="at least one insertion point")
    for place in use.at:
        kind = insertion_point(model, place)[0]
        if kind not in effect.insertion_kinds:
            raise ModelError(
                f"the effect cannot sit at the {kind} '{place}'",
                where=where,
                expected=" or ".join(effect.insertion_kinds),
            )


def _source(model: Model, name: str, where: str) -> sp.Expr:
    require_known("signal", [name], model.insertion_points, f"{where}, from")
    kind, name = insertion_point(model, name)
    return model.outputs[name].value if kind == "output" else symbol(name)


def _term(use: EffectUse, symbols: Mapping[str, sp.Expr], where: str) -> sp.Expr:
    """Return the term with its coefficients under the names they have in the model; those at 0 are left out."""
    coefficients = {symbol(n): symbols.get(n, sp.S.Zero) for n in use.parameters}
    expression = parse(use.expression, where=f"{where}, expression")
    missing = sorted(c.name for c in coefficients if c not in expression.free_symbols)
    if missing:
        raise ModelError(f"the term does not use its coefficient '{missing[0]}'", where=where, got=use.expression)
    return expression.xreplace(coefficients)
