"""Definition of a model: states, index-1 unknowns, named signals, parameters, inputs and outputs, in sympy expressions."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import sympy as sp
from typing_extensions import TypeIs

from hvdc_ident.display import Shown, Table
from hvdc_ident.errors import unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.parameters import Input, Parameter, with_values

if TYPE_CHECKING:
    from hvdc_ident.data import Experiment

Start: TypeAlias = sp.Expr | Literal["free"] | None


@dataclass(frozen=True)
class State:
    """x' = derivative. start: an expression of parameters, "free" (unknown: becomes the parameter NAME_start) or None: the steady state.

    guess: where the search for the steady state begins; None: at `rest` where that is given, else several places are tried.
    rest: what the state equals at rest, which a derivative may leave open (0 wherever the state is) or hide (clipped).
    vanishes: an expression of parameters, a time constant in s: where it is 0 the state is a signal that equals its rest.
    """

    derivative: sp.Expr
    start: Start = None
    guess: float | None = None
    rest: sp.Expr | None = None
    unit: str = ""
    description: str = ""
    vanishes: sp.Expr | None = None

    @property
    def is_reference(self) -> bool:
        """True where it never moves, and its rest tells where it stands: a reference that is found with the start."""
        return self.derivative == 0 and self.rest is not None


@dataclass(frozen=True)
class Signal:
    """A named intermediate signal: a point where an effect can be inserted."""

    value: sp.Expr
    unit: str = ""
    description: str = ""


@dataclass(frozen=True)
class Algebraic:
    """An unknown z that equals the expression, which may lead back to z. start: where the search begins."""

    equation: sp.Expr
    start: float = 0.0
    unit: str = ""
    description: str = ""


@dataclass(frozen=True)
class Output:
    """Quantity that can be recorded: an expression with its unit."""

    value: sp.Expr
    unit: str = ""
    description: str = ""


@dataclass(frozen=True)
class Delay:
    """d(t) = of(t - time), a true delay; `time` is an expression of parameters in s, 0 or above; at 0 d is `of` itself.

    A parameter that is the time gets 0 as its lower bound, where it has no higher one.
    """

    of: sp.Expr
    time: sp.Expr


@dataclass(frozen=True)
class Sampled:
    """A discrete state: `value` is taken every `period` s, from the start of the experiment on, and published `compute` s later."""

    value: sp.Expr
    period: sp.Expr
    compute: sp.Expr = sp.S.Zero


@dataclass(frozen=True)
class Parameterisation:
    """Other parameters for some of the model's: each replaced one is an expression of the new ones."""

    parameters: FrozenMap[Parameter]
    replaces: FrozenMap[sp.Expr]
    description: str = ""


@dataclass(frozen=True)
class ModelOrigin:
    """The model that another one was made from, whose steady state the other one's is connected with.

    root: the model as it was given, with its own values. neutral: by rewritten signal or unknown of the other model,
    what its readers see in the root.
    """

    root: Model
    neutral: FrozenMap[sp.Expr] = field(default_factory=FrozenMap)


@dataclass(frozen=True, repr=False)
class Model(Shown):
    """A continuous-time model with limits, delays and sampled parts.

    Every name is one symbol; an expression may use `time`, parameters, inputs, states, signals, unknowns, delays and
    sampled values by name, in any order, as long as no circle is closed but through `algebraic`, `delays` or `sampled`.
    Plain values are accepted where an object with more detail is stored: a number for a Parameter or an Input, an
    expression for a State, Signal, Algebraic or Output.

    origin: what it was made from by `with_values` and `hvdc_ident.effects.apply_effects`; no part of its definition.
    components: by component of its card the name of the model that it is, as gen: genrou; no part of its definition either.

    Raises ModelError where names clash, are unknown, or signals run in a circle.
    """

    name: str
    parameters: FrozenMap[Parameter] = field(default_factory=FrozenMap)
    inputs: FrozenMap[Input] = field(default_factory=FrozenMap)
    states: FrozenMap[State] = field(default_factory=FrozenMap)
    signals: FrozenMap[Signal] = field(default_factory=FrozenMap)
    algebraic: FrozenMap[Algebraic] = field(default_factory=FrozenMap)
    outputs: FrozenMap[Output] = field(default_factory=FrozenMap)
    delays: FrozenMap[Delay] = field(default_factory=FrozenMap)
    sampled: FrozenMap[Sampled] = field(default_factory=FrozenMap)
    parameterisations: FrozenMap[Parameterisation] = field(default_factory=FrozenMap)
    description: str = ""
    origin: ModelOrigin | None = field(default=None, compare=False, repr=False)
    components: FrozenMap[str] = field(default_factory=FrozenMap, compare=False, repr=False)

    def __post_init__(self) -> None:
        from hvdc_ident.model.check import check, coerced

        for name, value in coerced(self).items():
            object.__setattr__(self, name, value)
        check(self)

    @cached_property
    def insertion_points(self) -> tuple[str, ...]:
        """Names at which an effect may sit: inputs, named signals, unknowns, states; outputs as "outputs.NAME" where the name is taken."""
        inner = [*self.inputs, *self.signals, *self.algebraic, *self.states]
        return (*inner, *(o if o not in inner else f"outputs.{o}" for o in self.outputs))

    @property
    def values(self) -> dict[str, float]:
        """The parameters' values by name."""
        return {name: p.value for name, p in self.parameters.items()}

    @cached_property
    def text(self) -> str:
        """Text that differs where the equations or the values do, to the last digit."""
        lines = [self.name, repr(self.values), repr({n: i.value for n, i in self.inputs.items()})]
        for kind in ("states", "signals", "algebraic", "outputs", "delays", "sampled"):
            for name, item in getattr(self, kind).items():
                parts = [f"{f.name}={_exact(getattr(item, f.name))}" for f in fields(item)]
                lines.append(f"{kind} {name} {' '.join(parts)}")
        return "\n".join(lines)

    def with_values(self, values: Mapping[str, float]) -> Model:
        """The model with other parameter or input values; bounds of a parameter that the value leaves are an error."""

        def unknown(name: str) -> Exception:
            known = [*self.parameters, *self.inputs]
            return unknown_name("parameter or input", name, known, where=f"model '{self.name}'")

        from hvdc_ident.model.transform import without_vanished

        parameters, inputs = with_values(self.parameters, self.inputs, values, unknown)
        changed = replace(self, parameters=parameters, inputs=inputs, origin=self.origin or ModelOrigin(self))
        return without_vanished(changed)

    def driven(self, points: Iterable[str]) -> Model:
        """Return the model in which these insertion points are inputs that follow a recorded column, not their equation."""
        from hvdc_ident.model.transform import driven

        return driven(self, tuple(points))

    def parameterised(self, name: str) -> Model:
        """Return the model in another of its own parameterisations; the values follow from the new parameters' start values."""
        from hvdc_ident.model.transform import parameterised

        return parameterised(self, name)

    def tied(self, ties: Mapping[str, sp.Expr | str]) -> Model:
        """Return the model in which some parameters are expressions of others, as {"KIQ2": "KIQ"}."""
        from hvdc_ident.expression import parse
        from hvdc_ident.model.transform import tied

        return tied(self, {n: parse(e) if isinstance(e, str) else e for n, e in ties.items()})

    def _screen(self) -> Iterator[str | Table]:
        counts = f"{len(self.states)} states, {len(self.algebraic)} unknowns, {len(self.signals)} signals"
        yield f"Model {self.name}: {counts}, outputs {', '.join(self.outputs)}"
        yield self.description
        inputs = [(n, q.value, q.unit, q.description) for n, q in self.inputs.items()]
        yield Table(("input", "value", "unit", ""), tuple(inputs)) if inputs else ""
        rows = [(n, q.value, q.unit, q.min, q.max, q.about) for n, q in self.parameters.items()]
        yield Table(("parameter", "value", "unit", "min", "max", ""), tuple(rows)) if rows else ""
        outputs = [(n, o.unit, o.description) for n, o in self.outputs.items()]
        yield Table(("output", "unit", ""), tuple(outputs)) if outputs else ""

    def __getitem__(self, name: str) -> sp.Symbol:
        """The symbol of one of the model's names, for use in expressions."""
        if name not in self.names:
            raise unknown_name("variable", name, self.names, where=f"model '{self.name}'")
        return symbol(name)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Every name an expression may use."""
        return (
            *self.parameters,
            *self.inputs,
            *self.states,
            *self.signals,
            *self.algebraic,
            *self.delays,
            *self.sampled,
        )

    @cached_property
    def structure(self) -> tuple[Any, ...]:
        """Tuple of all that the machine code depends on: names and equations, without the values of parameters and inputs."""
        return (
            tuple(self.parameters),
            tuple(self.inputs),
            self.states,
            self.signals,
            self.algebraic,
            self.outputs,
            self.delays,
            self.sampled,
        )

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(
            (
                self.name,
                self.parameters,
                self.inputs,
                self.states,
                self.signals,
                self.algebraic,
                self.outputs,
                self.delays,
                self.sampled,
            )
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpacked, (self._packed,)

    @cached_property
    def _packed(self) -> bytes:
        """The definition alone, which travels to another process: symbols hash anew there."""
        return pickle.dumps({k: v for k, v in self.__dict__.items() if k in self.__dataclass_fields__})


@lru_cache(maxsize=128)
def _unpacked(packed: bytes) -> Model:
    """Return the model of a packed definition: of hundreds of jobs on one model each brings it, and sympy simplifies it anew."""
    model = object.__new__(Model)
    model.__dict__.update(pickle.loads(packed))  # by this package, as all that workers are sent
    return model


class External(Protocol):
    """An FMU, or anything else with a model's names that can be run. Its insertion points are its inputs and outputs."""

    @property
    def name(self) -> str:
        """Name of the model."""

    @property
    def parameters(self) -> FrozenMap[Parameter]:
        """The parameters by name, with start values, units and bounds."""

    @property
    def inputs(self) -> FrozenMap[Input]:
        """The inputs by name."""

    @property
    def outputs(self) -> FrozenMap[Output]:
        """Outputs by name, with units; their expressions have no meaning."""

    @property
    def states(self) -> FrozenMap[Any]:
        """The states by name, with units; none where it does not show them."""

    @property
    def signals(self) -> FrozenMap[Any]:
        """None: it is closed."""

    @property
    def algebraic(self) -> FrozenMap[Any]:
        """None: it is closed."""

    @property
    def insertion_points(self) -> tuple[str, ...]:
        """Names at which an effect may sit."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters, inputs and states."""

    @property
    def values(self) -> dict[str, float]:
        """The parameters' values by name."""

    @property
    def text(self) -> str:
        """Text that differs where the model or a value does."""

    def with_values(self, values: Mapping[str, float]) -> External:
        """Return the model with other parameter or input values."""

    def recording(self, names: Iterable[str]) -> External:
        """Return the model with these variables among its outputs. Raises InputError for what it cannot record."""

    def records(self, name: str) -> bool:
        """Return whether `recording` takes the name."""

    def with_effects(self, effects: Iterable[Any]) -> External:
        """Return the model with effects at its insertion points, for `hvdc_ident.effects.apply_effects`."""

    def driven(self, points: Iterable[str]) -> External:
        """Return the model in which these insertion points follow a recorded column."""

    def parameterised(self, name: str) -> External:
        """Return the model in another parameterisation."""

    def simulate(
        self,
        experiment: Experiment,
        values: Mapping[str, float] | None = None,
        sensitivities: Sequence[str] = (),
        *,
        outputs: Sequence[str] | None = None,
        tolerance: Any = None,
        partial: bool = False,
    ) -> Any:
        """Return a run: a `hvdc_ident.simulate.Simulation`."""


def _exact(value: Any) -> str:
    return str(sp.srepr(value)) if isinstance(value, sp.Basic) else repr(value)


AnyModel: TypeAlias = Model | External


def is_white_box(model: object) -> TypeIs[Model]:
    """Return whether a model is known by its equations: derivatives are taken of them, and effects put in anywhere.

    Of a black box, as an FMU is, only what goes in and comes out is known.
    """
    return isinstance(model, Model)


def recording(model: AnyModel, names: Iterable[str]) -> AnyModel:
    """Return the model with the names among its outputs; equations have what they declare, and stay as they are."""
    return model if is_white_box(model) else model.recording(names)
