"""Base of the effects: each makes readers of a slot see something else than the slot's own signal.

An effect is data (`Effect`). Its use in a model is in `hvdc_ident.effects.placing`; the sizes worth trying when one is
looked for are in `hvdc_ident.effects.probing`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import sympy as sp

from hvdc_ident.data import Array
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Delay, Model, Sampled, Signal, State, fresh

SLOT_KINDS = ("input", "signal", "algebraic", "state", "output")
FOLLOW = 2e-4
"""s: how fast an effect that follows its signal without a lag of its own does so (rate limit, play)."""

Measure = Literal[
    "one",
    "time",
    "record/n",
    "time*R",
    "rate",
    "range",
    "peak",
    "peak/n",
    "excursion",
    "range/time",
    "range/source",
    "range/source2",
    "of T2",
]


class Extent(Protocol):
    """Largest magnitude (`peak`) and peak-to-peak range (`range`) of a slot's signal, in its unit."""

    @property
    def peak(self) -> float: ...
    @property
    def range(self) -> float: ...


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    value: what it starts at where none is given. neutral: the value at which the effect is not there; a text: the
    other parameter that it then equals; None: this parameter does not switch it off.
    optional: at its neutral value only this parameter is left out; the effect is still there while another one acts.
    measure: what a size is counted in when the effect is looked for; probes: the sizes worth trying, counted so;
    search: the bounds of a refit, counted so (None: those of the measure). near: instead, a factor up and down from the
    probe. held: a refit leaves it where it stands. companion: an optional one that is tried with the others only.
    scan: from a slot's signal the sizes of a closer look, where neighbouring sizes have little in common and no slope
    leads from one to the next; counted in scanned_in (None: the measure).
    """

    value: float
    neutral: float | str | None = None
    unit: str = ""
    min: float = 0.0
    max: float = math.inf
    description: str = ""
    measure: Measure = "one"
    probes: tuple[float, ...] = ()
    scan: Callable[[Extent], Sequence[float]] | None = None
    scanned_in: Measure | None = None
    search: tuple[float, float] | None = None
    near: float | None = None
    optional: bool = False
    held: bool = False
    companion: bool = False


class Additions:
    """Variables that an effect adds to the model: states, delays, sampled values, signals, under names that are free.

    kind: of the slot, one of SLOT_KINDS. circular: whether the slot lies on an algebraic loop.
    """

    def __init__(self, model: Model, prefix: str, kind: str, circular: bool) -> None:
        self.model, self._prefix, self.kind, self.circular = model, prefix, kind, circular

    def state(
        self, label: str, derivative: Callable[[sp.Symbol], sp.Expr], rest: sp.Expr | None = None, unit: str = ""
    ) -> sp.Symbol:
        """The symbol of a new state; `derivative` gets it. rest: what the state equals at rest, where its search begins."""
        name = fresh(self.model, f"{self._prefix}_{label}")
        x = symbol(name)
        self.model = replace(self.model, states=self.model.states | {name: State(derivative(x), rest=rest, unit=unit)})
        return x

    def states(
        self,
        labels: Sequence[str],
        derivatives: Callable[[tuple[sp.Symbol, ...]], Sequence[sp.Expr]],
        rests: Sequence[sp.Expr],
    ) -> tuple[sp.Symbol, ...]:
        """The symbols of new states that depend on each other; `derivatives` gets them all. rests: as for `state`, by label."""
        names = [fresh(self.model, f"{self._prefix}_{label}") for label in labels]
        symbols = tuple(symbol(n) for n in names)
        added = {n: State(d, rest=r) for n, d, r in zip(names, derivatives(symbols), rests, strict=True)}
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

    def signals(
        self, labels: Sequence[str], values: Callable[[tuple[sp.Symbol, ...]], Sequence[sp.Expr]]
    ) -> tuple[sp.Symbol, ...]:
        """The symbols of new named signals that use each other; `values` gets them all. One model is made, not one a signal."""
        names = [fresh(self.model, f"{self._prefix}_{label}") for label in labels]
        symbols = tuple(symbol(n) for n in names)
        added = {n: Signal(v) for n, v in zip(names, values(symbols), strict=True)}
        self.model = replace(self.model, signals=self.model.signals | added)
        return symbols

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
    report, with {at}, {from}, {late} and the parameters by name. excited_by: the experiment that makes it visible.
    example: values that show on a per-unit signal of some tenths, as the list of effects and the tests use them.
    confusable: other effects that may explain the same data, each with what separates them.
    needs_source: whether it brings another signal in (`from`). needs_expression: whether its form is given with it,
    with coefficients of the user's own names. sought: whether a search for every effect tries it; what stands for many others
    is tried where none of them is enough. resistance: the parameter for which a resistance of the model stands in.
    restless: whether it moves the model by itself, so that a record of it does not begin at rest. late: by how long, s, it
    delays a slow signal, from its parameters' values: what effects that are hard to tell apart have in common. quick: the
    same y of u as the equations, in numpy, where those are too many to be evaluated for thousands of sizes. widens: effects
    that it turns into where one of its parameters ends: what they explain it explains as well, at the price of that. turns: the
    parameter by more than which the slot's signal has to turn for the effect to be more than a shift of what has moved.
    """

    name: str
    summary: str
    parameters: FrozenMap[EffectParameter]
    rewrite: Rewrite
    sentence: str
    excited_by: str
    example: FrozenMap[float]
    places: tuple[str, ...] = SLOT_KINDS
    states: str = "none"
    confusable: FrozenMap[str] = field(default_factory=FrozenMap)
    needs_source: bool = False
    needs_expression: bool = False
    sought: bool = True
    resistance: str = ""
    restless: bool = False
    late: Callable[[Mapping[str, float]], float] | None = None
    quick: Callable[[Array, Mapping[str, Array]], Array] | None = None
    widens: tuple[str, ...] = ()
    turns: str = ""

    def late_by(self, values: Mapping[str, float]) -> float | None:
        """By how long it delays a slow signal with these values, s; None for what is no delay of any kind."""
        return None if self.late is None else float(self.late(values))

    @property
    def scanned(self) -> bool:
        """True where a parameter of the effect must be searched over many values."""
        return any(q.scan is not None for q in self.parameters.values())

    @property
    def shown(self) -> str:
        """The example in words, with units."""
        units = {n: q.unit for n, q in self.parameters.items()}
        return "e.g. " + ", ".join(f"{n} = {v:g} {units.get(n, '')}".rstrip() for n, v in self.example.items())

    def is_neutral(self, values: Mapping[str, float | str]) -> bool:
        """True where the effect is absent: a parameter switches it off, or none of the optional ones acts."""
        switches = {n: q for n, q in self.parameters.items() if q.neutral is not None and not q.optional}
        if switches:
            return any(_at_neutral(q, values[n], values) for n, q in switches.items())
        return all(_at_neutral(q, values[n], values) for n, q in self.parameters.items() if q.optional)


def _at_neutral(q: EffectParameter, value: float | str, values: Mapping[str, float | str]) -> bool:
    return value == (values[q.neutral] if isinstance(q.neutral, str) else q.neutral)
