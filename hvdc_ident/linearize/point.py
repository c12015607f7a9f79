"""Operating points: values by name with their limits, and whether a point is stable, the model's own, or far off."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from hvdc_ident.codec import NOT_STORED, Coded, read_fields, stored_as
from hvdc_ident.display import Shown, Table, first_rows
from hvdc_ident.errors import LinearizationError, SteadyStateError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.derivatives import characteristic
from hvdc_ident.linearize.equilibrium import At, EquilibriumSearch, Root
from hvdc_ident.linearize.limits import Limit
from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array, CompiledSystem
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.simulate import Equilibria, equilibria, resting

Branch = Literal["own", "unconnected", "other", "trimmed"]


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
    model: AnyModel | None = field(default=None, metadata=NOT_STORED)
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
    def of(cls, model: AnyModel, search: EquilibriumSearch, root: Root, branch: Branch) -> OperatingPoint:
        """Return the point of a solved search."""
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
            model,
            search,
        )

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
    def stable(self) -> bool | None:
        """True where no eigenvalue of the linear model lies right of the imaginary axis, delays exact.

        None on a kink, and where a gain around a delay leaves it undecided. An FMU's delays are not seen.
        """
        return None if self.search is None else _stable(self, self.y, self.w)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the point: that it is unstable, not the model's own one, or far off; with the other one's place."""
        return _notes(self)

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


def _notes(point: OperatingPoint) -> tuple[str, ...]:
    """Return sentences on a point that is unstable, not the model's own steady state, or far outside its states' own range.

    Each names the other steady state where one is found: the model's own one, or those that the model runs to from here.
    """
    if point.search is None or point.at != "steady":
        return ()
    if not isinstance(point.model, Model):
        return (f"Unstable: {_fastest(point)}.",) if point.stable is False else ()
    model = resting(point.model)
    at = equilibria(model)
    v = np.array([*point.y, *point.extras.values()])
    found = []
    if point.branch == "unconnected":
        found.append(
            "Followed from the model's own values, its steady state ends at a jump before these: this one is from a new search."
        )
    if point.branch == "other":
        own = at.start(model, point.p, point.w[1 : 1 + len(point.inputs)], point.time).v
        found.append(f"This is not the model's own steady state, which stands at {at.text(own)}.")
    far = at.far(v)
    if far:
        shown = ", ".join(f"'{n}' at {point.states[n]:.4g} (guess {model.states[n].guess:g})" for n in far)
        found.append(f"Far outside the states' own range: {shown}.")
    if point.stable is False:
        found.append(f"Unstable: {_fastest(point)}. {_elsewhere(at, point, v)}")
    return tuple(found)


def _equation(point: OperatingPoint, y: Array, w: Array) -> Characteristic | None:
    """Return the characteristic equation at values of a point's model; None where it has no linear model there."""
    assert point.search is not None
    s = point.search.system
    if isinstance(point.model, Model):
        assert isinstance(s, CompiledSystem)
        try:
            return characteristic(point.model, s, y, w, point.p)
        except LinearizationError:
            return None
    n = s.layout.nx
    a = s.evaluate(y, w, point.p)[1][:n, :n]
    none = np.zeros((0, 0))
    return Characteristic.rational(a, np.zeros((n, 0)), np.zeros((0, n)), none, s.accuracy) if np.isfinite(a).all() else None


def _stable(point: OperatingPoint, y: Array, w: Array) -> bool | None:
    """Return whether no root lies right of the imaginary axis; None where there is no linear model, or it cannot be told."""
    equation = _equation(point, y, w)
    unstable = None if equation is None else equation.roots.unstable
    return None if unstable is None else unstable == 0


def _fastest(point: OperatingPoint) -> str:
    equation = _equation(point, point.y, point.w)
    assert equation is not None
    worst = equation.roots.values[:1]
    if not worst.size or worst[0].real <= 0:
        return "roots of its characteristic equation grow"
    turning = f" +- {abs(worst[0].imag):.3g}j" if worst[0].imag else ""
    return f"the eigenvalue {worst[0].real:.3g}{turning} 1/s grows"


def _direction(equation: Characteristic) -> Array:
    """Return (states,) the shape of the rightmost mode, a delay's share in it left out."""
    root = equation.roots.values[:1]
    if not root.size:
        return np.ones(equation.nx)
    return np.asarray(np.linalg.svd(equation.whole.pencil(root)[0])[2][-1].conj()[: equation.nx].real)


def _elsewhere(at: Equilibria, point: OperatingPoint, v: Array) -> str:
    """Return a sentence on the nearest stable steady state that the model runs to from here, or that its guesses lead to."""
    equation = _equation(point, point.y, point.w)
    assert equation is not None
    nx = len(point.states)
    direction = _direction(equation)
    size = np.maximum(np.abs(point.y[:nx]), 1e-2)
    direction = 1e-2 * direction / max(float(np.abs(direction / size).max()), 1e-300)
    u = point.w[1 : 1 + len(point.inputs)]
    others = at.neighbours(point.p, u, point.time, v, direction)
    with suppress(SteadyStateError):  # then the guesses offer none
        others.append(at.search(point.p, u, point.time).v)
    stable = [
        x for x in others if not np.allclose(x, v, rtol=1e-6, atol=1e-6) and _stable(point, *_split(at, point, x))
    ]
    stable.sort(key=lambda x: float(np.abs((x[:nx] - v[:nx]) / size).max()))  # of a machine's turns the nearest
    if not stable:
        return "No stable steady state was found nearby."
    return f"A stable one stands at {at.text(stable[0])}; a `guess` there in the model's states leads to it."


def _split(at: Equilibria, point: OperatingPoint, x: Array) -> tuple[Array, Array]:
    n = at.n
    return x[:n].copy(), np.concatenate([point.w[: 1 + len(point.inputs)], x[n:]])
