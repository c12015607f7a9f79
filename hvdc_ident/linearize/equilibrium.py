"""Equations of an operating point with values fixed, free or bounded, and Newton's method and a homotopy that solve them.

They are those of a model's graph and of an FMU alike: both answer `System.evaluate`. A plain steady state of a graph is found
where simulation finds it, in `hvdc_ident.simulate.steady_state`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from hvdc_ident.errors import ModelError, SteadyStateError, require_known, unknown_name
from hvdc_ident.linearize.limits import Limit
from hvdc_ident.linearize.system import Array, CompiledSystem, Layout, system
from hvdc_ident.model import AnyModel, Model

Equations = Callable[[Array], tuple[Array, Array]]
SHORTEST = 2.0**-10
"""Shortest part of a homotopy's way: where one would have to be shorter, it ends."""


@dataclass(frozen=True)
class Root:
    """End of an iteration. v: unknowns; shares: (equations,) scaled residuals; method: "newton" or "homotopy"."""

    v: Array
    residual: Array
    shares: Array
    iterations: int
    method: str

    def reaches(self, accuracy: float) -> bool:
        """Return whether every scaled residual is below the accuracy."""
        return bool((self.shares < accuracy).all())


def weights(jacobian: Array, v: Array) -> Array:
    """Return the size of each equation's terms, (equations,), 1 for an equation without any."""
    if v.size == 0:
        return np.ones(jacobian.shape[0])
    size = np.abs(jacobian) @ np.maximum(np.abs(v), 1e-3)
    return np.where(size > 0.0, size, 1.0)


def newton(equations: Equations, v: Array, low: Array, high: Array, limit: int = 60) -> Root:
    """Return the root near v within [low, high], or the best point reached: read `reaches`.

    Steps are exact Newton steps where the Jacobian is square and regular, else of least norm; each is halved until the
    scaled residual falls. A variable on a bound that the step would leave is held there.
    """
    bounded = bool(np.isfinite(low).any() or np.isfinite(high).any())
    v = np.clip(v, low, high) if bounded else v
    r, jac = equations(v)
    small = 0
    k = 0
    for k in range(1, limit + 1):
        if not (np.isfinite(r).all() and np.isfinite(jac).all()):
            break
        weight = weights(jac, v)
        before = np.abs(r / weight).max(initial=0.0)
        step = _step(jac, r, weight, v, low, high) if bounded else _free_step(jac, r, weight)
        change = np.abs(step / (np.abs(v) + 1e-3)).max(initial=0.0)
        damping = 1.0
        while True:
            trial = np.clip(v + damping * step, low, high) if bounded else v + damping * step
            r_new, jac_new = equations(trial)
            after = np.abs(r_new / weight).max(initial=0.0)
            if after < before or after < 1e-13 or (change < 1e-9 and np.isfinite(after)):
                break
            damping /= 2
            if damping < 2e-4:
                return _root(v, r, jac, k, "newton")
        v, r, jac = trial, r_new, jac_new
        if damping == 1.0 and change < 1e-10:
            small += 2 if change < 1e-13 else 1
        if small >= 2 or (change == 0.0):
            break
    return _root(v, r, jac, k, "newton")


def _root(v: Array, r: Array, jac: Array, iterations: int, method: str) -> Root:
    with np.errstate(all="ignore"):
        shares = np.abs(r) / weights(jac, v)
    return Root(v, r, np.where(np.isfinite(shares), shares, np.inf), iterations, method)


def _free_step(jac: Array, r: Array, weight: Array) -> Array:
    if jac.shape[0] == jac.shape[1]:
        try:
            step = np.linalg.solve(jac, -r)
        except np.linalg.LinAlgError:
            pass
        else:
            if np.isfinite(step).all() and np.abs(step).max(initial=0.0) < 1e9:
                return np.asarray(step)
    return np.asarray(np.linalg.lstsq(jac / weight[:, None], -r / weight, rcond=1e-12)[0])


def _step(jac: Array, r: Array, weight: Array, v: Array, low: Array, high: Array) -> Array:
    free = np.ones(v.size, dtype=bool)
    step = np.zeros(v.size)
    for _ in range(v.size + 1):
        step = np.zeros(v.size)
        if not free.any():
            break
        step[free] = _free_step(jac[:, free], r, weight)
        stuck = free & (((v <= low) & (step < 0.0)) | ((v >= high) & (step > 0.0)))
        if not stuck.any():
            break
        free &= ~stuck
    return step


def homotopy(equations: Equations, v: Array, low: Array, high: Array, accuracy: float) -> Root:
    """Return the root reached from v while the residual at v is reduced to 0 step by step: read `reaches`.

    For what Newton's method does not reach at once from a known operating point: each part of the way is solved from the
    one before, and halved where it is not.
    """
    off, _ = equations(v)
    share, part, steps = 0.0, 0.5, 0
    while share < 1.0 and part > SHORTEST and np.isfinite(off).all():
        ahead = min(share + part, 1.0)
        left = (1.0 - ahead) * off

        def shifted(x: Array, left: Array = left) -> tuple[Array, Array]:
            r, jac = equations(x)
            return r - left, jac

        root = newton(shifted, v, low, high, 20)
        steps += root.iterations
        if root.reaches(accuracy):
            v, share, part = root.v, ahead, 2.0 * part
        else:
            part *= 0.5
    polished = newton(equations, v, low, high)
    return Root(polished.v, polished.residual, polished.shares, steps + polished.iterations, "homotopy")


At = Literal["steady", "start"]


@dataclass(frozen=True)
class PointOptions:
    """Request for an operating point: the arguments of `find_operating_point`."""

    fixed: Mapping[str, float] = field(default_factory=dict)
    free: Collection[str] = ()
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    guess: Mapping[str, float] = field(default_factory=dict)
    at: At = "steady"
    moving: Collection[str] = ()
    time: float = 0.0


class System(Protocol):
    """Protocol of a model whose points are searched for, be it a graph or an FMU: names, and values and derivatives at a point.

    accuracy: largest scaled residual that counts as a solution. with_rest, with_start: places of the states that have one.
    """

    states: tuple[str, ...]
    unknowns: tuple[str, ...]
    inputs: tuple[str, ...]
    extras: tuple[str, ...]
    parameters: tuple[str, ...]
    outputs: tuple[str, ...]
    layout: Layout
    with_rest: tuple[int, ...]
    with_start: tuple[int, ...]
    accuracy: float

    def evaluate(self, y: Array, w: Array, p: Array, parameters: Sequence[int] = ()) -> tuple[Array, Array]:
        """Return values (rows,) and Jacobian (rows, columns + parameters), over [x, z, inputs, delays, sampled] and some parameters."""
        ...

    def limits(self, y: Array, w: Array, p: Array) -> tuple[Limit, ...]:
        """Return every limiter that matters at the point, with its margin."""
        ...


@dataclass(frozen=True, eq=False)
class EquilibriumSearch:
    """The unknowns v = [x, z, delays and sampled, freed inputs, freed parameters, bounded signals] and their equations.

    equation_rows: which rows of the system are asked to be 0, after that come the fixed signals, then the bounded ones.
    """

    system: System
    at: At
    time: float
    u: Array
    p: Array
    freed_u: tuple[int, ...]
    freed_p: tuple[int, ...]
    equation_rows: tuple[int, ...]
    fixed_places: tuple[int, ...]
    fixed_rows: tuple[int, ...]
    fixed_values: Array
    bounded_rows: tuple[int, ...]
    low: Array
    high: Array
    start: Mapping[str, float]

    @classmethod
    def of_model(cls, model: Model, asked: PointOptions) -> EquilibriumSearch:
        """Return the equations for a model. Raises UnknownNameError, and ModelError for a value or bounds that cannot be."""
        variables_of = (model.states, model.inputs, model.parameters, model.delays, model.sampled)
        signals = [n for n in (*asked.fixed, *asked.bounds) if not any(n in group for group in variables_of)]
        s = system(model, tuple(dict.fromkeys((*model.outputs, *signals))))
        p = np.array([asked.fixed.get(n, q.value) for n, q in model.parameters.items()], dtype=float)
        return cls.of(model, s, asked, _starts(model, s, p))

    @classmethod
    def of(cls, model: AnyModel, s: System, asked: PointOptions, start: Mapping[str, float]) -> EquilibriumSearch:
        """Return the equations of a system that a model has. start: where states and unknowns are sought first. Raises as above."""
        _check(model, s, asked)
        fixed, free, bounds = asked.fixed, asked.free, asked.bounds
        size = s.layout
        inner = {n: k for k, n in enumerate((*s.states, *s.unknowns, *s.extras))}
        u = np.array([fixed.get(n, i.value) for n, i in model.inputs.items()], dtype=float)
        p = np.array([fixed.get(n, q.value) for n, q in model.parameters.items()], dtype=float)
        first = size.n + size.ne
        fixed_inner = [n for n in fixed if n in inner]
        fixed_signals = [n for n in fixed if n not in inner and n not in s.inputs and n not in s.parameters]
        bounded_signals = [n for n in bounds if n not in inner and n not in s.inputs and n not in s.parameters]
        freed_u = tuple(k for k, n in enumerate(s.inputs) if n in free)
        freed_p = tuple(k for k, n in enumerate(s.parameters) if n in free)
        variables = [*inner, *(s.inputs[k] for k in freed_u), *(s.parameters[k] for k in freed_p), *bounded_signals]
        low = np.array([bounds.get(n, (-np.inf, np.inf))[0] for n in variables], dtype=float)
        high = np.array([bounds.get(n, (-np.inf, np.inf))[1] for n in variables], dtype=float)
        return cls(
            s,
            asked.at,
            asked.time,
            u,
            p,
            freed_u,
            freed_p,
            _equation_rows(s, asked.at, asked.moving),
            tuple(inner[n] for n in fixed_inner),
            tuple(first + s.outputs.index(n) for n in fixed_signals),
            np.array([fixed[n] for n in (*fixed_inner, *fixed_signals)], dtype=float),
            tuple(first + s.outputs.index(n) for n in bounded_signals),
            low,
            high,
            _all_starts(model, start, bounds),
        )

    @property
    def is_plain(self) -> bool:
        """True where only the steady state at given inputs and parameters is asked for."""
        whole = len(self.equation_rows) == self.system.layout.n + self.system.layout.ne
        nothing = not (self.freed_u or self.freed_p or self.fixed_places or self.fixed_rows or self.bounded_rows)
        return whole and nothing and not (np.isfinite(self.low).any() or np.isfinite(self.high).any())

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the unknowns v."""
        s = self.system
        names = [*s.states, *s.unknowns, *s.extras, *(s.inputs[k] for k in self.freed_u)]
        first = s.layout.n + s.layout.ne
        names += [s.parameters[k] for k in self.freed_p]
        return (*names, *(s.outputs[k - first] for k in self.bounded_rows))

    @property
    def rows(self) -> tuple[str, ...]:
        """Each equation in words."""
        s, size = self.system, self.system.layout
        inner = [*s.states, *s.unknowns, *s.extras]
        first = size.n + size.ne
        main = [f"d({n})/dt = 0" for n in s.states] + [f"the equation of unknown '{n}'" for n in s.unknowns]
        main += [f"the rest of '{n}'" for n in s.extras] + [""] * size.no
        main += [f"the rest of state '{s.states[k]}'" for k in s.with_rest]
        main += [f"the start of state '{s.states[k]}'" for k in s.with_start]
        rows = [main[k] for k in self.equation_rows]
        names = [inner[k] for k in self.fixed_places] + [s.outputs[k - first] for k in self.fixed_rows]
        rows += [f"'{n}' = {v:g}" for n, v in zip(names, self.fixed_values, strict=True)]
        return (*rows, *(f"the bounds of '{s.outputs[k - first]}'" for k in self.bounded_rows))

    def vectors(self, v: Array) -> tuple[Array, Array, Array]:
        """Return (y, w, p) at the unknowns v."""
        size = self.system.layout
        w = np.empty(1 + size.nu + size.ne)
        w[0] = self.time
        w[1 : 1 + size.nu] = self.u
        w[1 + size.nu :] = v[size.n : size.n + size.ne]
        at = size.n + size.ne
        p = self.p
        if self.freed_u:
            w[[1 + k for k in self.freed_u]] = v[at : at + len(self.freed_u)]
        if self.freed_p:
            p = self.p.copy()
            p[list(self.freed_p)] = v[at + len(self.freed_u) : at + len(self.freed_u) + len(self.freed_p)]
        return v[: size.n].copy(), w, p

    def equations(self, v: Array) -> tuple[Array, Array]:
        """Return (residual, Jacobian) at v, modes from the values."""
        s, size = self.system, self.system.layout
        y, w, p = self.vectors(v)
        values, full = s.evaluate(y, w, p, self.freed_p)
        full = full[:, self._columns]
        full = np.concatenate([full, np.zeros((size.rows, len(self.bounded_rows)))], axis=1)
        if size.ne:
            extra = slice(size.n, size.n + size.ne)
            values[extra] -= v[extra]
            full[extra, extra] -= np.eye(size.ne)
        rows = [*self.equation_rows, *self.fixed_rows]
        r, jac = values[rows], full[rows]
        n_equations, n_inner = len(self.equation_rows), len(self.fixed_places)
        if not (n_inner or self.fixed_rows or self.bounded_rows):
            return r, jac
        r[n_equations:] -= self.fixed_values[n_inner:]
        own = np.zeros((n_inner, v.size))
        own[range(n_inner), self.fixed_places] = 1.0
        places = list(self.fixed_places)
        r = np.concatenate([r[:n_equations], v[places] - self.fixed_values[:n_inner], r[n_equations:]])
        jac = np.concatenate([jac[:n_equations], own, jac[n_equations:]])
        if self.bounded_rows:
            k = len(self.bounded_rows)
            r = np.concatenate([r, values[list(self.bounded_rows)] - v[-k:]])
            slack = full[list(self.bounded_rows)]
            slack[range(k), range(v.size - k, v.size)] -= 1.0
            jac = np.concatenate([jac, slack])
        return r, jac

    @cached_property
    def _columns(self) -> list[int]:
        """Places of the unknowns in a Jacobian, but for the bounded signals."""
        size = self.system.layout
        inner = [*range(size.n), *range(size.n + size.nu, size.columns)]
        return [*inner, *(size.n + k for k in self.freed_u), *range(size.columns, size.columns + len(self.freed_p))]

    def by_parameters(self, v: Array, which: list[int]) -> Array:
        """Return (unknowns, parameters) derivatives of the solution by fixed parameters, by implicit differentiation.

        Where the Jacobian is singular (a state that rests anywhere) the change of least norm.
        """
        s = self.system
        jac = self.equations(v)[1]
        full = s.evaluate(*self.vectors(v), which)[1][:, s.layout.columns :]
        n_inner = len(self.fixed_places)
        right = np.concatenate(
            [
                full[list(self.equation_rows)],
                np.zeros((n_inner, len(which))),
                full[list(self.fixed_rows)],
                full[list(self.bounded_rows)],
            ]
        )
        if jac.shape[0] == jac.shape[1]:
            try:
                slope = np.linalg.solve(jac, -right)
            except np.linalg.LinAlgError:
                pass
            else:
                if np.isfinite(slope).all() and (not jac.size or np.linalg.cond(jac) < 1e13):
                    return np.asarray(slope)
        return np.asarray(np.linalg.lstsq(jac, -right, rcond=1e-12)[0])

    def guesses(self, given: Mapping[str, float]) -> list[Array]:
        """Return starting points: the given values, the model's own, then 0, 1 and seeded random values."""
        s = self.system
        places: list[Array] = []
        known = {**self.start, **given}
        names = self.variables
        unknown = [k for k, n in enumerate(names) if n in s.states and n not in known]
        fills = [0.0] if not unknown else [0.0, 1.0, *np.random.default_rng(0).normal(size=4)]
        for fill in fills:
            v = np.array([known.get(n, fill if n in s.states else 0.0) for n in names], dtype=float)
            for k, place in enumerate(self.fixed_places):
                v[place] = self.fixed_values[k]
            places.append(np.clip(self._with_signals(v), self.low, self.high))
        return places

    def _with_signals(self, v: Array) -> Array:
        """Return the guess with delays, sampled values and bounded signals set to what they show."""
        s, size = self.system, self.system.layout
        k = len(self.bounded_rows)
        for _ in range(3 if size.ne or k else 0):
            values, _ = s.evaluate(*self.vectors(v))
            v = v.copy()
            if size.ne:
                v[size.n : size.n + size.ne] = np.nan_to_num(values[size.n : size.n + size.ne])
            if k:
                v[-k:] = np.nan_to_num(values[list(self.bounded_rows)])
        return v


def _starts(model: Model, s: CompiledSystem, p: Array) -> dict[str, float]:
    """Return the starting value of each state and unknown, as far as the model gives one."""
    starts = {n: st.guess for n, st in model.states.items() if st.guess is not None}
    starts |= {s.states[k]: v for k, v in s.start_values(p).items() if np.isfinite(v)}
    return starts | {n: model.algebraic[n].start for n in s.unknowns}


def _all_starts(
    model: AnyModel, start: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    """Return these, the values of inputs and parameters, and the middle of bounds of what has none."""
    starts = {
        **start,
        **{n: i.value for n, i in model.inputs.items()},
        **{n: q.value for n, q in model.parameters.items()},
    }
    for n, (low, high) in bounds.items():
        if n not in starts and np.isfinite(low + high):
            starts[n] = 0.5 * (low + high)
    return starts


def _equation_rows(s: System, at: At, moving: Collection[str]) -> tuple[int, ...]:
    size = s.layout
    rest = {k: size.main + i for i, k in enumerate(s.with_rest)}
    start = {k: size.main + size.n_rest + i for i, k in enumerate(s.with_start)} if at == "start" else {}
    states = [start.get(k, rest.get(k, k)) for k, n in enumerate(s.states) if n not in moving]
    return (*states, *range(size.nx, size.n + size.ne))


def _check(model: AnyModel, s: System, asked: PointOptions) -> None:
    fixed, free = asked.fixed, asked.free
    where = f"operating point of model '{model.name}'"
    require_known("state", asked.moving, model.states, where)
    for n in free:
        if n in model.states or n in s.unknowns or n in model.outputs or n in model.signals:
            continue  # free by nature
        if n not in model.inputs and n not in model.parameters:
            raise unknown_name("input or parameter", n, [*model.inputs, *model.parameters], where=where)
        if n in fixed:
            raise ModelError(f"'{n}' is both fixed and free", where=where, hint="leave it out of one of them")
    for n, value in fixed.items():
        if not np.isfinite(value):
            raise ModelError(f"the fixed value of '{n}' is not finite", where=where, got=f"{value}")
    for n, (low, high) in asked.bounds.items():
        if not low <= high:
            raise ModelError(
                f"the bounds of '{n}' are the wrong way round",
                where=where,
                expected="low <= high",
                got=f"{low}, {high}",
            )
        if (n in model.inputs or n in model.parameters) and n not in free:
            raise ModelError(f"'{n}' has bounds but is not free", where=where, hint=f"name it in `free`: free=['{n}']")
    constraints = [n for n in fixed if n not in model.inputs and n not in model.parameters]
    room = sum(n in model.inputs or n in model.parameters for n in free) + len(set(asked.moving))
    if len(constraints) > room:
        raise SteadyStateError(
            f"{len(constraints)} fixed values ({', '.join(constraints)}) for {room} that may move",
            where=where,
            expected="as many freed inputs, parameters or moving states as fixed states and outputs",
            hint=f"free {len(constraints) - room} more input or parameter",
        )


def solved(name: str, search: EquilibriumSearch, guess: Mapping[str, float], own: Array | None = None) -> Root:
    """Return the root that the guess leads to, else one near the model's own steady state, else near its guesses.

    name: of the model. Raises SteadyStateError, with the worst equation, where there is none.
    """
    best: Root | None = None
    starts = search.guesses(guess)
    near = (
        None if own is None else search.guesses({**dict(zip(search.variables, own.tolist(), strict=False)), **guess})[0]
    )
    accuracy = search.system.accuracy

    def continued(equations: Equations, v: Array, low: Array, high: Array) -> Root:
        return homotopy(equations, v, low, high, accuracy)

    tries: list[tuple[Callable[[Equations, Array, Array, Array], Root], Array | None]]
    tries = [(newton, v) for v in ([*starts[:1], near, *starts[1:]] if guess else [near, *starts])]
    tries += [(continued, v) for v in (near, *starts[:1])]
    with np.errstate(all="ignore"):
        for solve, v in tries:
            if v is None:
                continue
            root = solve(search.equations, v, search.low, search.high)
            if root.reaches(accuracy):
                return root
            best = root if best is None or root.shares.max() < best.shares.max() else best
    assert best is not None
    raise _not_found(name, search, best)


def _not_found(name: str, search: EquilibriumSearch, root: Root) -> SteadyStateError:
    worst = int(np.argmax(root.shares))
    names = search.variables
    on_bound = [n for n, v, a, b in zip(names, root.v, search.low, search.high, strict=True) if v in (a, b)]
    bound = f"; on its bound: {', '.join(on_bound)}" if on_bound else ""
    hint = "check the fixed values and limits, give a guess near the solution, or free another input"
    return SteadyStateError(
        "no operating point was found",
        where=f"model '{name}'",
        expected=f"every equation met to {search.system.accuracy:g} of its terms",
        got=f"{search.rows[worst]} left with {root.residual[worst]:.3g} (scaled {root.shares[worst]:.2g}){bound}",
        hint=hint if search.at == "start" else hint + "; states that need not rest can be named in `moving`",
    )
