"""Entry of the catalogue of effects: each replaces the signal that readers of an insertion point see.

An effect is data (`Effect`). `hvdc_ident.effects.placement` inserts it into a model, and `hvdc_ident.effects.probing`
chooses the sizes at which a search begins.
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

INSERTION_POINT_KINDS = ("input", "signal", "algebraic", "state", "output")

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
    "range/record",
    "one/record",
    "one/source",
    "source peak",
    "source low",
    "source high",
    "bend 2",
    "bend 3",
    "of T2",
    "of up",
    "above low",
    "below high",
]


class Extent(Protocol):
    """Largest magnitude (`peak`) and peak-to-peak range (`range`) of a signal, in its unit."""

    @property
    def peak(self) -> float: ...
    @property
    def range(self) -> float: ...


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect: its default and bounds, and how a search scales it.

    value: default. neutral: the value at which the effect is absent; a text names the other parameter that it then equals;
    None: this parameter does not switch the effect off.
    optional: at its neutral value only this parameter is left out; the effect stays while another one acts.
    measure: the scale in which `probes`, the sizes to try, and `search`, the bounds of a refit (None: those of the measure),
    are counted. search_factor: instead of `search`, a factor up and down from the probe. fixed: not refitted. companion: an
    optional parameter that is tried only together with the others.
    grid: the sizes of a grid refinement, from a signal's scales, where neighbouring sizes have little in common and no slope
    leads from one to the next; counted in grid_measure (None: the measure).
    """

    value: float
    neutral: float | str | None = None
    unit: str = ""
    min: float = 0.0
    max: float = math.inf
    description: str = ""
    measure: Measure = "one"
    probes: tuple[float, ...] = ()
    grid: Callable[[Extent], Sequence[float]] | None = None
    grid_measure: Measure | None = None
    search: tuple[float, float] | None = None
    search_factor: float | None = None
    optional: bool = False
    fixed: bool = False
    companion: bool = False


class Additions:
    """Builder of the states, delays, sampled values and signals that an effect adds to the model, under unused names.

    kind: of the insertion point, one of INSERTION_POINT_KINDS. circular: True where it lies on an algebraic loop. neutral: by
    signal that the effect adds, what it is without the effect, for the way from the model's own steady state.
    """

    def __init__(self, model: Model, prefix: str, kind: str, circular: bool) -> None:
        self.model, self._prefix, self.kind, self.circular = model, prefix, kind, circular
        self.neutral: dict[str, sp.Expr] = {}

    def state(
        self, label: str, derivative: Callable[[sp.Symbol], sp.Expr], rest: sp.Expr | None = None, unit: str = ""
    ) -> sp.Symbol:
        """Return the symbol of a new state, which `derivative` is called with. rest: its value in steady state."""
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
        """Return the symbols of coupled new states, which `derivatives` is called with. rests: as for `state`, by label."""
        names = [fresh(self.model, f"{self._prefix}_{label}") for label in labels]
        symbols = tuple(symbol(n) for n in names)
        added = {n: State(d, rest=r) for n, d, r in zip(names, derivatives(symbols), rests, strict=True)}
        self.model = replace(self.model, states=self.model.states | added)
        return symbols

    def rest(self, x: sp.Expr, derivative: sp.Expr, held: Callable[[sp.Expr], sp.Expr] | None = None) -> None:
        """Let the model's state x rest where it would with this derivative, which the effect's own hides.

        held: from the way that x has to go to that rest to the way it goes, for an effect that moves the rest. Of a state that
        is chosen at run time the rest stays that of its derivative.
        """
        if str(x) not in self.model.states:
            return
        state = self.model.states[str(x)]
        way = derivative if state.rest is None else state.rest - x
        if held is not None:
            before, way = way, self.signal("to_rest", held(way))
            self.neutral[str(way)] = before
        elif state.rest is not None:
            return
        self.model = replace(self.model, states=self.model.states | {str(x): replace(state, rest=x + way)})

    def start(self, of: sp.Expr) -> sp.Symbol:
        """Return the symbol of an expression's value at the start: a state that never moves."""
        return self.state("start", lambda _: sp.S.Zero, rest=of)

    def signal(self, label: str, value: sp.Expr) -> sp.Symbol:
        """Return the symbol of a new named signal: an expression used more than once stands in the model once."""
        return self.signals([label], lambda _: [value])[0]

    def signals(
        self, labels: Sequence[str], values: Callable[[tuple[sp.Symbol, ...]], Sequence[sp.Expr]]
    ) -> tuple[sp.Symbol, ...]:
        """Return the symbols of new named signals that use each other; `values` is called with all of them."""
        names = [fresh(self.model, f"{self._prefix}_{label}") for label in labels]
        symbols = tuple(symbol(n) for n in names)
        added = {n: Signal(v) for n, v in zip(names, values(symbols), strict=True)}
        self.model = replace(self.model, signals=self.model.signals | added)
        return symbols

    def delay(self, of: sp.Expr, time: sp.Expr) -> sp.Symbol:
        """Return the symbol of u(t - time)."""
        name = fresh(self.model, f"{self._prefix}_delayed")
        self.model = replace(self.model, delays=self.model.delays | {name: Delay(of, time)})
        return symbol(name)

    def sampled(self, value: sp.Expr, period: sp.Expr, compute: sp.Expr) -> sp.Symbol:
        """Return the symbol of a value taken every period and published `compute` later."""
        name = fresh(self.model, f"{self._prefix}_held")
        self.model = replace(self.model, sampled=self.model.sampled | {name: Sampled(value, period, compute)})
        return symbol(name)


class Rewrite(Protocol):
    """Map u, the signal of the insertion point, to y, which its readers see instead.

    p: the parameters' symbols by name, without the optional ones that are left out; "from": the other signal, "expression":
    the term, and "state": the state whose derivative u is, where the effect has one. add: makes the states and signals that y needs.
    """

    def __call__(self, u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr: ...


Equality = Callable[[Mapping[str, float], Array], Mapping[str, float] | None]
"""Values of the other effect, as far as they are known, from the effect's own and from the signal that it brings in (empty where
it brings in none); None where the two are not the same equation."""


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    insertion_kinds: kinds of insertion point where it may sit. states: those it adds, as part of a sentence. sentence: for
    the report, with {at}, {from}, {equivalent_delay} and the parameters by name; summands of optional ones, and a part that falls
    away with a fixed one at 0, stand in brackets. asked: what the model's owner knows of it, for the letter ("the limit"); empty: its
    name is asked for. excited_by: the experiment that makes it visible. example: values that show on
    a per-unit signal of some tenths, as the list of effects and the tests use them.
    confusable: other effects that may explain the same data, each with what separates them.
    needs_source: True where it brings in another signal (`from`). needs_expression: True where its form is given with it,
    with coefficients of the user's own names. of_derivative: True where it changes the equation of the state at its place: u
    is the derivative that the state had, y the one that it has.
    tried_by_default: False for a form that is tried only where it is named, such as a general one that stands for many others.
    outside: kind of such a form that is tried, too, where no effect of the catalogue explains the records: "term", "filter" or
    "curve"; empty for the others. is_own: whether it is none of the catalogue's effects with these values (None: always).
    curve: of one whose values are a curve, its knots and what is added there, from its values. words: further words for the
    sentence, from its values.
    resistance: the parameter that a resistance of the model replaces.
    self_exciting: True where it moves the model by itself, so that a record of it does not begin in steady state.
    holds: True where it passes no small change on, so that what integrates its signal may rest at any level.
    equivalent_delay: delay of a slow signal, s, from its parameters' values, which effects that are hard to tell apart
    share; None for what is no delay of any kind. generalises: effects that it becomes at the end of a parameter's range, and whose data
    it therefore explains, at the price of that parameter. reversal: the parameter by more than which the signal has to
    reverse for the effect to be more than a shift. equals: other effects that are the same equation at the same place.
    """

    name: str
    summary: str
    parameters: FrozenMap[EffectParameter]
    rewrite: Rewrite
    sentence: str
    excited_by: str
    example: FrozenMap[float]
    asked: str = ""
    insertion_kinds: tuple[str, ...] = INSERTION_POINT_KINDS
    states: str = "none"
    confusable: FrozenMap[str] = field(default_factory=FrozenMap)
    needs_source: bool = False
    needs_expression: bool = False
    of_derivative: bool = False
    tried_by_default: bool = True
    outside: Literal["", "term", "filter", "curve"] = ""
    is_own: Callable[[Mapping[str, float]], bool] | None = None
    curve: Callable[[Mapping[str, float]], tuple[Array, Array]] | None = None
    words: Callable[[Mapping[str, float]], Mapping[str, str]] | None = None
    resistance: str = ""
    self_exciting: bool = False
    holds: bool = False
    equivalent_delay: Callable[[Mapping[str, float]], float] | None = None
    generalises: tuple[str, ...] = ()
    reversal: str = ""
    equals: FrozenMap[Equality] = field(default_factory=FrozenMap)

    def delay_with(self, values: Mapping[str, float]) -> float | None:
        """Return the equivalent delay with these values, s; None for what is no delay of any kind."""
        return None if self.equivalent_delay is None else float(self.equivalent_delay(values))

    def present(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return the parameters that stand in the equations with these values: optional ones at neutral are left out."""
        return tuple(
            n for n, q in self.parameters.items() if not (q.optional and values.get(n, q.neutral) == q.neutral)
        )

    @property
    def needs_grid(self) -> bool:
        """True where a parameter of the effect must be searched over many values."""
        return any(q.grid is not None for q in self.parameters.values())

    @property
    def example_text(self) -> str:
        """The example in words, with units."""
        units = {n: q.unit for n, q in self.parameters.items()}
        return "e.g. " + ", ".join(f"{n} = {v:g} {units.get(n, '')}".rstrip() for n, v in self.example.items())

    def is_neutral(self, values: Mapping[str, float | str]) -> bool:
        """True where the effect is absent: a parameter switches it off, or none of the optional ones acts."""

        def at_neutral(name: str) -> bool:
            neutral = self.parameters[name].neutral
            return values[name] == (values[neutral] if isinstance(neutral, str) else neutral)

        switches = [n for n, q in self.parameters.items() if q.neutral is not None and not q.optional]
        if switches:
            return any(at_neutral(n) for n in switches)
        return all(at_neutral(n) for n, q in self.parameters.items() if q.optional)
