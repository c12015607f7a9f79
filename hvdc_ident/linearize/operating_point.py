"""Operating points: any state, unknown, input, output or parameter fixed, free or bounded; exact Jacobians; trim."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from hvdc_ident.display import Shown, Table, first_rows
from hvdc_ident.errors import LinearizationError, SteadyStateError, require_known, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.equilibrium import At, Equations, EquilibriumSearch, Root, homotopy, newton, weights
from hvdc_ident.linearize.limits import Limit, limits
from hvdc_ident.linearize.stability import Characteristic, stability
from hvdc_ident.linearize.system import Array
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.simulate import ACCURACY, Equilibria, equilibria, resting

Bounds = Mapping[str, tuple[float, float]]
Side = Literal["here", "below", "above"]
Branch = Literal["own", "unconnected", "other", "trimmed"]
ZERO = 1e-8
"""An eigenvalue below this share of the fastest one (or of 1 rad/s) counts as zero."""


@dataclass(frozen=True, eq=False, repr=False)
class OperatingPoint(Shown):
    """A point of a model: values by name, in the model's units.

    extras: values of delays and sampled blocks. residual: the largest scaled residual of the equations that define it.
    limits: every limiter in use with its margin. at: "steady", or "start" where states stand at their given start.
    method: "newton" or "homotopy"; underdetermined points say "newton, least norm".
    branch: "own", the steady state that a simulation starts from: connected with the one that the model has at its own
    values; "unconnected", found by a new search where following that one ended at a jump; "other", another one, to which
    a given guess led; "trimmed" where outputs or states are fixed, something is free, or states stand at their start.
    """

    model: AnyModel
    states: FrozenMap[float]
    unknowns: FrozenMap[float]
    extras: FrozenMap[float]
    inputs: FrozenMap[float]
    outputs: FrozenMap[float]
    parameters: FrozenMap[float]
    residual: float
    limits: tuple[Limit, ...]
    iterations: int
    method: str
    at: At = "steady"
    time: float = 0.0
    search: EquilibriumSearch | None = field(default=None, repr=False)
    branch: Branch = "own"

    def _screen(self) -> Iterator[str | Table]:
        yield f"Operating point of {self.model.name} ({self.at}, {self.method}), residual {self.residual:.2g}"
        parts = (("state", self.states), ("input", self.inputs), ("output", self.outputs))
        rows = tuple((n, kind, v) for kind, values in parts for n, v in values.items())
        yield from first_rows(("name", "kind", "value"), rows)
        yield "\n".join([x.text for x in self.active_limits] or ["no limit is active"])
        yield "\n".join(self.notes)

    @property
    def active_limits(self) -> tuple[Limit, ...]:
        """The limiters that hold their signal here."""
        return tuple(x for x in self.limits if x.active)

    @cached_property
    def stable(self) -> bool | None:
        """True where no eigenvalue of the linear model lies right of the imaginary axis, delays exact.

        None for an FMU, on a kink, and where a gain around a delay leaves it undecided.
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

    def to_dict(self) -> dict[str, Any]:
        """Return the point as plain numbers; active limits with what is limited, by what, and the margin."""
        return {
            "states": dict(self.states),
            "unknowns": dict(self.unknowns),
            "inputs": dict(self.inputs),
            "outputs": dict(self.outputs),
            "parameters": dict(self.parameters),
            "residual": self.residual,
            "active_limits": [x.to_dict() for x in self.active_limits],
            "margins": [x.to_dict() for x in self.limits if not x.active and x.kind != "branch"],
            "at": self.at,
            "method": self.method,
            "iterations": self.iterations,
            "branch": self.branch,
            "stable": self.stable,
            "notes": list(self.notes),
        }


def find_operating_point(
    model: AnyModel,
    fixed: Mapping[str, float] | None = None,
    free: Collection[str] = (),
    bounds: Bounds | None = None,
    guess: Mapping[str, float] | None = None,
    *,
    inputs: Mapping[str, float] | None = None,
    outputs: Mapping[str, float] | None = None,
    at: At = "steady",
    moving: Collection[str] = (),
    time: float = 0.0,
) -> OperatingPoint:
    """Return the operating point at which every derivative is 0 and the fixed values hold.

    With inputs and parameters alone it is the steady state that a simulation starts from.

    fixed: values of inputs, parameters, states, unknowns, signals or outputs. free: inputs and parameters to be found.
    inputs: values of inputs. outputs: values that outputs are to have (a trimmed point); where nothing is free the inputs
    that move these outputs at rest are, if they are as many.
    bounds: (low, high) of anything but a fixed name. guess: where the search begins. moving: states whose derivative
    need not be 0. at="start": states with a given start stand there instead, and only the rest is solved.
    All in the model's units; an input that is not named keeps the model's value.

    Raises UnknownNameError for a name the model lacks; SteadyStateError, with the worst equation, where there is none.

    >>> from hvdc_ident import find_operating_point, load_model
    >>> rest = find_operating_point(load_model("vsc-hvdc-link"), {"Pref2": 0.5})
    >>> round(rest.outputs["P2"], 9), round(rest.outputs["Irorder1"], 3)
    (0.5, -0.5)
    >>> trimmed = find_operating_point(load_model("vsc-hvdc-link"), outputs={"P2": 0.6})
    >>> round(trimmed.inputs["Pref2"], 9)
    0.6
    """
    if inputs or outputs:
        fixed = {**(fixed or {}), **known_inputs(model, inputs or {})}
        if outputs and not free:
            base = find_operating_point(model, fixed, (), bounds, guess, at=at, moving=moving, time=time)
            free = freed_inputs(model, base, outputs, fixed)
            guess = {**base.states, **base.unknowns, **base.extras, **(guess or {})}
        fixed = {**fixed, **(outputs or {})}
    if not isinstance(model, Model):
        from hvdc_ident.linearize.fmu_linear import find_point

        return find_point(model, fixed or {}, free, bounds or {}, guess or {}, at, moving, time)
    search = EquilibriumSearch.of(model, fixed or {}, free, bounds or {}, at=at, moving=moving, time=time)
    return solve(model, search, guess or {})


def solve(model: Model, search: EquilibriumSearch, guess: Mapping[str, float] | None = None) -> OperatingPoint:
    """Return the point a search leads to; SteadyStateError with the worst equation where it leads to none."""
    if search.is_plain and not guess:
        return point_of(model, search, *steady(model, search))
    own = _own(model, search)
    root = _constrained(model, search, guess or {}, own)
    if not search.is_plain:
        return point_of(model, search, root, "trimmed")
    same = own is not None and np.allclose(
        root.v, own, rtol=1e-6, atol=1e-6 * max(1.0, float(np.abs(own).max(initial=0.0)))
    )
    return point_of(model, search, root, "own" if own is None or same else "other")


def steady(model: Model, search: EquilibriumSearch) -> tuple[Root, Branch]:
    """Return the steady state that a simulation of the same inputs and parameters starts from, and its branch."""
    free = model if search.at == "start" else resting(model)
    try:
        at = equilibria(free)
        found = at.start(free, search.p, search.u, search.time)
    except SteadyStateError as e:
        raise SteadyStateError(
            e.what,
            where=e.where,
            expected=e.expected,
            got=e.got,
            hint=f"{e.hint}; states that need not rest can be named in `moving`",
        ) from None
    v = found.v
    with np.errstate(all="ignore"):
        r, jac = search.equations(v)
        shares = np.abs(r) / weights(jac, v)
    return Root(v, r, shares, 0, "newton"), found.branch


def _own(model: Model, search: EquilibriumSearch) -> Array | None:
    """Return the model's own steady state at the search's inputs and parameters; None where it has none there."""
    free = model if search.at == "start" else resting(model)
    at = equilibria(free)
    try:
        return at.start(free, search.p, search.u, search.time).v
    except SteadyStateError:
        return None


def _constrained(model: Model, search: EquilibriumSearch, guess: Mapping[str, float], own: Array | None) -> Root:
    """Return the root that the guess leads to, else one near the model's own steady state, else near its guesses."""
    best: Root | None = None
    starts = search.guesses(guess)
    near = (
        None if own is None else search.guesses({**dict(zip(search.variables, own.tolist(), strict=False)), **guess})[0]
    )
    tries: list[tuple[Callable[[Equations, Array, Array, Array], Root], Array | None]]
    tries = [(newton, v) for v in ([*starts[:1], near, *starts[1:]] if guess else [near, *starts])]
    tries += [(homotopy, v) for v in (near, *starts[:1])]
    with np.errstate(all="ignore"):
        for solve, v in tries:
            if v is None:
                continue
            root = solve(search.equations, v, search.low, search.high)
            if root.found:
                return root
            best = root if best is None or root.shares.max() < best.shares.max() else best
    assert best is not None
    raise _not_found(model, search, best)


def _not_found(model: Model, search: EquilibriumSearch, root: Root) -> SteadyStateError:
    worst = int(np.argmax(root.shares))
    names = search.variables
    on_bound = [n for n, v, a, b in zip(names, root.v, search.low, search.high, strict=True) if v in (a, b)]
    bound = f"; on its bound: {', '.join(on_bound)}" if on_bound else ""
    hint = "check the fixed values and limits, give a guess near the solution, or free another input"
    return SteadyStateError(
        "no operating point was found",
        where=f"model '{model.name}'",
        expected=f"every equation met to {ACCURACY:g} of its terms",
        got=f"{search.rows[worst]} left with {root.residual[worst]:.3g} (scaled {root.shares[worst]:.2g}){bound}",
        hint=hint if search.at == "start" else hint + "; states that need not rest can be named in `moving`",
    )


def point_of(model: Model, search: EquilibriumSearch, root: Root, branch: Branch = "own") -> OperatingPoint:
    """Return the point of a solved search."""
    y, w, p = search.vectors(root.v)
    s, size = search.system, search.system.layout
    values = s.values(y, w, p, s.modes(y, w, p))
    shown = values[size.n + size.ne : size.main]
    wanted = {n: float(v) for n, v in zip(s.outputs, shown, strict=True) if n in model.outputs}
    n_extra = 1 + size.nu
    method = root.method + (", least norm" if len(search.rows) < len(search.variables) else "")
    return OperatingPoint(
        model,
        _named(s.states, y[: size.nx]),
        _named(s.unknowns, y[size.nx :]),
        _named(s.extras, w[n_extra:]),
        _named(s.inputs, w[1:n_extra]),
        FrozenMap(wanted),
        _named(s.parameters, p),
        float(root.shares.max(initial=0.0)),
        limits(s.structure, s.conditions, s.switches(y, w, p)),
        root.iterations,
        method,
        search.at,
        search.time,
        search,
        branch,
    )


def _named(names: Sequence[str], values: Array) -> FrozenMap[float]:
    return FrozenMap(zip(names, (float(v) for v in values), strict=True))


def point_at(
    model: AnyModel,
    states: Mapping[str, float],
    inputs: Mapping[str, float] | None = None,
    parameters: Mapping[str, float] | None = None,
    *,
    time: float = 0.0,
) -> OperatingPoint:
    """Return the operating point at given states, which need not be at rest; unknowns are solved for.

    Raises UnknownNameError for a name that is not a state, input or parameter, or a state left out; SteadyStateError
    where the unknowns have no solution.
    """
    missing = [n for n in model.states if n not in states]
    if missing:
        raise unknown_name("value given for state", missing[0], list(states), where=f"model '{model.name}'")
    fixed = {**(inputs or {}), **(parameters or {}), **states}
    return find_operating_point(model, fixed, moving=tuple(model.states), time=time)


def continuation(
    model: AnyModel, name: str, values: Sequence[float], fixed: Mapping[str, float] | None = None
) -> tuple[OperatingPoint, ...]:
    """Return the operating points along values of one parameter or input, each searched from the one before.

    A step that fails is halved up to ten times on the way. Raises SteadyStateError with the last value reached.
    """
    if name not in model.parameters and name not in model.inputs:
        raise unknown_name("parameter or input", name, (*model.parameters, *model.inputs), where="continuation")
    points: list[OperatingPoint] = []
    guess: dict[str, float] = {}
    last: float | None = None
    for value in values:
        point = _step_to(model, name, last, float(value), {**(fixed or {})}, guess, 0)
        points.append(point)
        guess = {**point.states, **point.unknowns, **point.extras}
        last = float(value)
    return tuple(points)


def _step_to(
    model: AnyModel,
    name: str,
    last: float | None,
    value: float,
    fixed: dict[str, float],
    guess: dict[str, float],
    depth: int,
) -> OperatingPoint:
    try:
        return find_operating_point(model, {**fixed, name: value}, guess=guess)
    except SteadyStateError as e:
        if last is None or depth == 10:
            reached = f", reached {last:g}" if last is not None else ""
            raise e.at(f"continuation along '{name}' at {value:g}{reached}") from None
        half = _step_to(model, name, last, 0.5 * (last + value), fixed, guess, depth + 1)
        return _step_to(
            model, name, 0.5 * (last + value), value, fixed, {**half.states, **half.unknowns, **half.extras}, depth + 1
        )


def _notes(point: OperatingPoint) -> tuple[str, ...]:
    """Return sentences on a point that is unstable, not the model's own steady state, or far outside its states' own range.

    Each names the other steady state where one is found: the model's own one, or those that the model runs to from here.
    """
    model = point.model
    if point.search is None or point.at != "steady" or not isinstance(model, Model):
        return ()
    model = resting(model)
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
    from hvdc_ident.linearize.jacobian import characteristic

    assert point.search is not None and isinstance(point.model, Model)
    try:
        return characteristic(point.model, point.search.system, y, w, point.p)
    except LinearizationError:
        return None


def _stable(point: OperatingPoint, y: Array, w: Array) -> bool | None:
    """Return whether no root lies right of the imaginary axis; None where there is no linear model, or it cannot be told."""
    equation = _equation(point, y, w)
    if equation is None:
        return None
    if equation.channels:
        unstable = stability(equation).unstable
        return None if unstable is None else unstable == 0
    values = np.linalg.eigvals(equation.matrix) if equation.nx else np.zeros(1)
    return bool(values.real.max() <= ZERO * max(1.0, float(np.abs(values).max())))


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


# --- trim: inputs that are set so that outputs have given values ---


DEPENDENT = 1e-8
"""Share of its length that is left of an output's row of gains, below which it follows from other outputs': gains are sums
of products that rounding changes by 1e-16 of their terms, and these may be a hundred million times what is left."""
NEGLIGIBLE = 1e-9
"""Share of the largest gain below which an input is taken for without effect: it would have to move a billion times as far
as the other one, in their units, and rounding leaves about 1e-16."""


def known_inputs(model: AnyModel, inputs: Mapping[str, float]) -> dict[str, float]:
    """Return the inputs' values. Raises UnknownNameError for a name that is no input."""
    require_known("input", inputs, model.inputs, f"operating point of model '{model.name}'")
    return dict(inputs)


def freed_inputs(model: AnyModel, point: OperatingPoint, outputs: Collection[str], held: Collection[str]) -> list[str]:
    """Return the inputs that set some outputs at rest, where these are as many as the outputs; else SteadyStateError.

    point: where the dc gains are taken. held: inputs that stay. An input counts where its gain on one of the outputs
    is above NEGLIGIBLE of the largest that an input has on it.
    """
    gains = _dc_gains(model, point, outputs)
    names = [n for n in model.inputs if n not in held]
    columns = [list(model.inputs).index(n) for n in names]
    _independent(model, list(outputs), gains[:, columns])
    sizes = np.abs(gains[:, columns])
    effective = sizes > NEGLIGIBLE * sizes.max(axis=1, initial=0.0)[:, None]
    moving = [n for n, hit in zip(names, effective.any(axis=0), strict=True) if hit]
    if len(moving) == len(outputs):
        return moving
    listed = "; ".join(
        f"{n} moves {', '.join(f'{o} by {gains[i, k]:.3g}' for i, o in enumerate(outputs) if effective[i, j])}"
        for j, (n, k) in enumerate(zip(names, columns, strict=True))
        if n in moving
    )
    first = [moving[k] for k in np.argsort([-sizes[:, names.index(n)].max() for n in moving], kind="stable")]
    raise SteadyStateError(
        f"which inputs are to set {', '.join(outputs)}?",
        where=f"operating point of model '{model.name}'",
        expected=f"{len(outputs)} input{'s' if len(outputs) > 1 else ''} that can",
        got=listed or "no input moves them at rest",
        hint=f"name them: free={first[: len(outputs)]!r}" if moving else "free a parameter: free=[...]",
    )


def _independent(model: AnyModel, outputs: list[str], gains: Array) -> None:
    """Raise SteadyStateError where outputs move together at rest, so that no inputs give all of them values of their own.

    gains: (outputs, inputs). Each row is compared with what the rows before it make of it (modified Gram-Schmidt, with
    the inputs as they are).
    """
    lengths = np.linalg.norm(gains, axis=1)
    chosen: list[int] = []
    for i in (k for k in range(len(outputs)) if lengths[k] > 0.0):
        others = gains[chosen] / lengths[chosen, None]
        row = gains[i] / lengths[i]
        share = np.linalg.lstsq(others.T, row, rcond=DEPENDENT)[0] if chosen else np.zeros(0)
        if np.linalg.norm(row - share @ others) > DEPENDENT:
            chosen.append(i)
            continue
        parts = [
            (chosen[k], share[k] * lengths[i] / lengths[chosen[k]])
            for k in range(len(chosen))
            if abs(share[k]) > DEPENDENT
        ]
        rule = " + ".join(f"{factor:.4g} d({outputs[k]})" for k, factor in parts).replace("+ -", "- ")
        names = [outputs[i], *(outputs[k] for k, _ in parts)]
        raise SteadyStateError(
            f"{', '.join(outputs)} cannot all be set: at rest {outputs[i]} moves only with {' and '.join(names[1:])}",
            where=f"operating point of model '{model.name}'",
            expected="outputs that inputs can set one by one",
            got=f"d({outputs[i]}) = {rule}, whichever inputs move them",
            hint=f"leave out {' or '.join(names)}, or free a parameter: free=[...]",
        )


def _dc_gains(model: AnyModel, point: OperatingPoint, outputs: Collection[str]) -> Array:
    """Return (outputs, all inputs) gains at rest; 0 for an input that drives an integrator: there is no rest with another value."""
    from hvdc_ident.linearize.jacobian import linearize

    a, b, c, d = linearize(model, point, outputs=list(outputs)).standard()
    if not a.shape[0]:
        return d
    x = np.linalg.lstsq(a, -b, rcond=1e-13)[0]
    rest = np.linalg.norm(a @ x + b, axis=0) <= 1e-8 * np.maximum(np.linalg.norm(b, axis=0), 1e-300)
    return np.asarray(np.where(rest, d + c @ x, 0.0))
