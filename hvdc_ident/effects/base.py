"""What an effect is: how readers of a slot see something else than the slot's own signal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import sympy as sp

from hvdc_ident.errors import ModelError, unknown_name
from hvdc_ident.expression.functions import symbol
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Delay, Model, Sampled, State
from hvdc_ident.model.transform import fresh, rewritten
from hvdc_ident.parameters import Parameter

SLOT_KINDS = ("input", "signal", "algebraic", "state", "output")


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    value: what it starts at where none is given. neutral: the value at which the effect is not there (None: this
    parameter does not switch it off). probes: sizes worth trying when the effect is looked for.
    """

    value: float
    neutral: float | None = None
    unit: str = ""
    min: float = 0.0
    max: float = math.inf
    probes: tuple[float, ...] = ()
    description: str = ""


class Additions:
    """What an effect adds to the model: states, delays, sampled values, under names that are free."""

    def __init__(self, model: Model, prefix: str) -> None:
        self.model, self._prefix = model, prefix

    def state(
        self, label: str, derivative: Callable[[sp.Symbol], sp.Expr], rest: sp.Expr | None = None, unit: str = ""
    ) -> sp.Symbol:
        """The symbol of a new state; `derivative` gets it. rest: what the state equals at rest, where the derivative leaves it open."""
        name = fresh(self.model, f"{self._prefix}_{label}")
        x = symbol(name)
        self.model = replace(self.model, states=self.model.states | {name: State(derivative(x), rest=rest, unit=unit)})
        return x

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
    """y, what readers of the slot see: from u, the slot's own signal, the effect's parameters, and room for additions."""

    def __call__(self, u: sp.Expr, p: Mapping[str, sp.Symbol], add: Additions) -> sp.Expr: ...


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    places: kinds of slot where it may sit. sentence: for the report, with {at} and the parameters by name.
    excited_by: the experiment that makes it visible.
    """

    name: str
    summary: str
    parameters: FrozenMap[EffectParameter]
    rewrite: Rewrite
    sentence: str
    excited_by: str
    places: tuple[str, ...] = SLOT_KINDS

    def is_neutral(self, values: Mapping[str, float]) -> bool:
        """Whether a parameter stands at the value at which the effect is not there."""
        return any(q.neutral is not None and values[n] == q.neutral for n, q in self.parameters.items())


@dataclass(frozen=True)
class EffectUse:
    """An effect at one or more slots that share its parameters.

    parameters: values that differ from the effect's own. prefix: of its names in the model; default EFFECT_SLOT.
    """

    effect: str
    at: tuple[str, ...]
    parameters: FrozenMap[float] = field(default_factory=FrozenMap)
    prefix: str = ""

    @classmethod
    def of(cls, given: EffectUse | Mapping[str, Any]) -> EffectUse:
        """From itself or from a mapping as in a study file."""
        if isinstance(given, EffectUse):
            return given
        known = ("effect", "at", "parameters", "prefix")
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
        )

    @property
    def label(self) -> str:
        """The effect's name as part of an identifier."""
        return self.effect.replace("-", "_")

    def parameter_name(self, name: str) -> str:
        """What a parameter of the effect is called in the model."""
        prefix = self.prefix or f"{self.label}_{self.at[0].replace('.', '_')}"
        return f"{prefix}_{name}"


def apply(model: Model, use: EffectUse, effect: Effect) -> Model:
    """The model with the effect in it; the same model where the effect is neutral."""
    from hvdc_ident.model.transform import slot

    where = f"effect '{use.effect}' at {', '.join(use.at)}"
    for name in use.parameters:
        if name not in effect.parameters:
            raise unknown_name("parameter", name, effect.parameters, where=where)
    if not use.at:
        raise ModelError("the effect has no place", where=where, expected="at least one slot")
    for place in use.at:
        kind = slot(model, place)[0]
        if kind not in effect.places:
            raise ModelError(
                f"the effect cannot sit at the {kind} '{place}'", where=where, expected=" or ".join(effect.places)
            )
    values = {n: float(use.parameters.get(n, q.value)) for n, q in effect.parameters.items()}
    if effect.is_neutral(values):
        return model
    names = {n: fresh(model, use.parameter_name(n)) for n in effect.parameters}
    try:
        added = {
            names[n]: Parameter(values[n], q.unit, q.min, q.max, description=q.description)
            for n, q in effect.parameters.items()
        }
    except ModelError as e:
        raise e.at(where) from None
    model = replace(model, parameters=model.parameters | added)
    symbols = {n: symbol(v) for n, v in names.items()}
    for place in use.at:

        def rewrite(m: Model, u: sp.Expr, place: str = place) -> tuple[Model, sp.Expr]:
            add = Additions(m, f"{use.label}_{place.replace('.', '_')}")
            y = effect.rewrite(u, symbols, add)
            return add.model, y

        model = rewritten(model, place, use.label, rewrite)
    return model
