"""Operating points: values by name with their limits, and what is said of a point: whether it is stable, the model's own, far off."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from hvdc_ident.codec import NOT_STORED, Coded, read_fields, stored_as
from hvdc_ident.display import Shown, Table, first_rows
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.equilibrium import At, EquilibriumSearch, Root
from hvdc_ident.linearize.limits import Limit
from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array
from hvdc_ident.model import AnyModel

Branch = Literal["own", "unconnected", "other", "trimmed"]


class Judge(Protocol):
    """A kind of model, which tells the equation at a point of it, and remarks on the point."""

    @property
    def model(self) -> AnyModel: ...

    def equation(self, point: OperatingPoint) -> Characteristic | None:
        """Return the characteristic equation at a point; None where the model has no linear model there."""
        ...

    def notes(self, point: OperatingPoint) -> tuple[str, ...]:
        """Return sentences on a steady state that is unstable, not the model's own one, or far off."""
        ...


@dataclass(frozen=True)
class _Judged:
    """Limits of a point as its JSON holds them, and the stability and notes that only its model tells."""

    active_limits: tuple[Limit, ...]
    margins: tuple[Limit, ...]
    stable: bool | None
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, repr=False)
class OperatingPoint(Shown, Coded):
    """A point of a model: values by name, in the model's units. name: of the model; one read from JSON does not have the model itself.

    extras: values of delays and sampled blocks. residual: the largest scaled residual of the equations that define it.
    limits: every limiter in use with its margin. at: "steady", or "start" where states stand at their given start.
    method: "newton" or "homotopy"; underdetermined points say "newton, least norm".
    branch: "own", the steady state that a simulation starts from: connected with the one that the model has at its own
    values; "unconnected", found by a new search where following that one ended at a jump; "other", another one, to which
    a given guess led; "trimmed" where outputs or states are fixed, something is free, or states stand at their start.
    """

    name: str = field(metadata=stored_as("model"))
    states: FrozenMap[float]
    unknowns: FrozenMap[float]
    extras: FrozenMap[float]
    inputs: FrozenMap[float]
    outputs: FrozenMap[float]
    parameters: FrozenMap[float]
    residual: float
    iterations: int
    method: str
    at: At = "steady"
    time: float = 0.0
    branch: Branch = "own"
    limits: tuple[Limit, ...] = field(default=(), metadata=NOT_STORED)
    judge: Judge | None = field(default=None, metadata=NOT_STORED)
    search: EquilibriumSearch | None = field(default=None, metadata=NOT_STORED)
    stored_properties: ClassVar[tuple[str, ...]] = ("active_limits", "margins", "stable", "notes")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> OperatingPoint:
        """Return the point that `to_dict` wrote, without its model and without conditions that are no limiters.

        Raises InputError for anything else.
        """
        judged = read_fields(_Judged, data)
        point = replace(read_fields(cls, data), limits=(*judged.active_limits, *judged.margins))
        vars(point).update(stable=judged.stable, notes=judged.notes)  # the cached properties, which need the model
        return point

    @classmethod
    def of(cls, judge: Judge, search: EquilibriumSearch, root: Root, branch: Branch) -> OperatingPoint:
        """Return the point of a solved search."""
        model = judge.model
        y, w, p = search.vectors(root.v)
        s, size = search.system, search.system.layout
        values, _ = s.evaluate(y, w, p)
        shown = values[size.n + size.ne : size.main]
        wanted = {n: float(v) for n, v in zip(s.outputs, shown, strict=True) if n in model.outputs}
        n_extra = 1 + size.nu
        method = root.method + (", least norm" if len(search.rows) < len(search.variables) else "")
        return cls(
            model.name,
            _named(s.states, y[: size.nx]),
            _named(s.unknowns, y[size.nx :]),
            _named(s.extras, w[n_extra:]),
            _named(s.inputs, w[1:n_extra]),
            FrozenMap(wanted),
            _named(s.parameters, p),
            float(root.shares.max(initial=0.0)),
            root.iterations,
            method,
            search.at,
            search.time,
            branch,
            s.limits(y, w, p),
            judge,
            search,
        )

    @property
    def model(self) -> AnyModel | None:
        """The model itself; None for a point read from JSON."""
        return None if self.judge is None else self.judge.model

    def _screen(self) -> Iterator[str | Table]:
        yield f"Operating point of {self.name} ({self.at}, {self.method}), residual {self.residual:.2g}"
        parts = (("state", self.states), ("input", self.inputs), ("output", self.outputs))
        rows = tuple((n, kind, v) for kind, values in parts for n, v in values.items())
        yield from first_rows(("name", "kind", "value"), rows)
        yield "\n".join([x.text for x in self.active_limits] or ["no limit is active"])
        yield "\n".join(self.notes)

    @property
    def active_limits(self) -> tuple[Limit, ...]:
        """The limiters that hold their signal here."""
        return tuple(x for x in self.limits if x.active)

    @property
    def margins(self) -> tuple[Limit, ...]:
        """The limiters that do not hold their signal here."""
        return tuple(x for x in self.limits if not x.active and x.kind != "branch")

    @cached_property
    def equation(self) -> Characteristic | None:
        """The characteristic equation here; None on a kink, and for a point read from JSON."""
        return None if self.judge is None else self.judge.equation(self)

    @cached_property
    def stable(self) -> bool | None:
        """True where no eigenvalue of the linear model lies right of the imaginary axis, delays exact.

        None on a kink, and where a gain around a delay leaves it undecided. An FMU's delays are not seen.
        """
        return is_stable(self.equation)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the point: that it is unstable, not the model's own one, or far off; with the other one's place."""
        return () if self.judge is None or self.at != "steady" else self.judge.notes(self)

    @property
    def y(self) -> Array:
        """(states + unknowns,) as the machine code takes them."""
        return np.array([*self.states.values(), *self.unknowns.values()], dtype=float)

    @property
    def w(self) -> Array:
        """(1 + inputs + delays + sampled,) as the machine code takes them, time first."""
        return np.array([self.time, *self.inputs.values(), *self.extras.values()], dtype=float)

    @property
    def p(self) -> Array:
        """(parameters,) as the machine code takes them."""
        return np.array([*self.parameters.values()], dtype=float)


def _named(names: Sequence[str], values: Array) -> FrozenMap[float]:
    return FrozenMap(zip(names, (float(v) for v in values), strict=True))


def is_stable(equation: Characteristic | None) -> bool | None:
    """Return whether no root lies right of the imaginary axis; None where there is no equation, or it cannot be told."""
    unstable = None if equation is None else equation.roots.unstable
    return None if unstable is None else unstable == 0


def unstable_by(equation: Characteristic | None) -> str:
    """Return the sentence on an unstable point, with its first root."""
    assert equation is not None
    worst = equation.roots.values[:1]
    if not worst.size or worst[0].real <= 0:
        return "Unstable: roots of its characteristic equation grow."
    turning = f" +- {abs(worst[0].imag):.3g}j" if worst[0].imag else ""
    return f"Unstable: the eigenvalue {worst[0].real:.3g}{turning} 1/s grows."
