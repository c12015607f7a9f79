"""The steady state that a model starts from: the one solver for simulation and linearisation.

A model may have several equilibria. Its own one is what the search from its guesses finds at its own values (`search`).
At other values, and with effects put in, the steady state is the one that is connected with it: found by Newton's method
where that cannot have left the branch, else followed along the values (`continuation`), the effects put in by and by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise, product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import SteadyStateError
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, State, blended
from hvdc_ident.simulate.codegen import NAMES
from hvdc_ident.simulate.core import SteadyEquations
from hvdc_ident.simulate.equations import ACCURACY, SHORTEST, TINY, ModelEquations, by_structure
from hvdc_ident.simulate.machine_code import Code, evaluate

Branch = Literal["own", "unconnected"]

CLOSE = 1e-3  # a guess that is not 0 tells a state's size up to 1 / CLOSE times
HALVES = 0.5
"""The most that an undamped Newton correction may keep of the one before: Kantorovich's condition (`rest` says how)."""
AWAY = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32)
"""Distances from its guess at which a reference is looked for, of 1 and its size: a control's range is some per cent of that."""
ROOM = 256
EPSILON = float(np.finfo(float).eps)
DOUBLINGS = 11  # of a hundredth of a state's size: to ten times that, beyond which a state is hardly a neighbour


@dataclass(frozen=True)
class ReferenceEquilibrium:
    """A known steady state: v = [x, z, delayed, sampled values] at parameters p and inputs u.

    sign: of the Jacobian's determinant there, 0 where it is singular.
    """

    p: Array
    u: Array
    v: Array
    sign: float


@dataclass(frozen=True)
class SteadyState:
    """Flat vectors y and w with their rows over the parameters, as the integrators take them.

    v: the unknowns [x, z, delayed, sampled values]. sign: of the Jacobian's determinant, 0 where it is singular.
    branch: "own" where it is connected with the steady state that the model has at its own values, or that one is not
    known; "unconnected" where following it ended at a jump and this one was found by a new search.
    """

    y: Array
    w: Array
    v: Array
    sign: float = 0.0
    branch: Branch = "own"


def minimum_norm(equations: SteadyEquations, size: Array, v: Array) -> None:
    """Move v (n,) by Newton steps of least norm, for a Jacobian that is singular where a state does not matter.

    size: the most that each unknown counts for.
    """
    there = equations.judged(size, v)
    for _ in range(50):
        r, jac, weights = there
        if not (np.isfinite(r).all() and np.isfinite(jac).all()):
            return
        step = np.linalg.lstsq(jac / weights[:, None], -r / weights, rcond=1e-12)[0]
        before, damping = float(np.linalg.norm(r / weights)), 1.0
        while damping > 1e-4:
            trial = v + damping * step
            there = equations.judged(size, trial)
            with np.errstate(all="ignore"):  # a trial may be beyond what numbers hold: it is none then
                after = float(np.linalg.norm(there[0] / weights))
            if after < before or before < 1e-14:
                break
            damping /= 2
        else:
            return
        v[:] = trial
        if np.abs(step).max(initial=0.0) < 1e-14:
            return


class Equilibria:
    """The steady states of one model structure; its machine code stays with whoever made it, as long as this is used."""

    def __init__(self, structure: ModelEquations, address: NDArray[np.int64], code: Code | None = None) -> None:
        self.structure, self._address, self._code = structure, address, code
        s = structure.sizes
        self.n, self.extra = s.nx + s.nz, s.nd + s.nq
        self._sizes = (s.nx, self.n, 1 + s.nu, self.n + self.extra, s.width)
        self._functions = [int(address[NAMES.index(n)]) for n in ("modes", "rest", "rest_jac", "rest_p")]
        self._references: dict[tuple[Model, bytes], ReferenceEquilibrium | None] = {}
        self.names = (*structure.states, *structure.unknowns, *structure.model.delays, *structure.model.sampled)

    # --- the steady state at given values ---

    def start(self, model: Model, p: Array, u: Array, time: float = 0.0, *, search: bool = True) -> SteadyState:
        """The steady state of a model of this structure at parameters p, inputs u and a time.

        search: whether more than Newton's method and the straight way from the model's own steady state may be tried. Raises
        SteadyStateError where none is found, or where the one that the model has at its own values ends before these.
        """
        p = np.ascontiguousarray(p, dtype=float)
        reference = self.reference(model, u)
        if reference is None or not reference.sign:
            return self.search(p, u, time, None if reference is None else reference.v, search=search)
        state = self._directly(reference, p, u, time)
        if state is not None:
            return state
        path = self._connected(model, reference, p, u, time, search)
        if path.ends == "arrived":
            state = self._newton(path.v, p, u, time)
            if state is not None:
                return state
        if not search:
            raise self._not_at_once()
        if path.ends == "fold":
            raise self._lost(path, p, u, time)
        return replace(self.search(p, u, time), branch="unconnected")

    def search(
        self, p: Array, u: Array, time: float = 0.0, first: Array | None = None, *, search: bool = True
    ) -> SteadyState:
        """The steady state that the model's guesses lead to, or one near `first`, wherever the model has others."""
        p = np.ascontiguousarray(p, dtype=float)
        limit = self._region.limit
        begins = self._begins(p, u, time)
        for begin in begins if first is None else (first, *begins):
            state = self._newton(begin, p, u, time)
            if state is not None and (np.abs(state.y[: self.n]) <= limit[: self.n]).all():
                return state
            if not search:
                raise self._not_at_once()
        return self._slowly(p, u, self._filled(self._guesses[0], p, u, time) if first is None else first, time)

    def reference(self, model: Model, u: Array) -> ReferenceEquilibrium | None:
        """The model's own steady state; None where it has none. u: what inputs rest at that the root of its origin lacks."""
        root = model.origin.root if model.origin else model
        own = tuple(model.inputs)
        foreign = (
            b""
            if own == tuple(root.inputs)
            else np.array([u[k] for k, n in enumerate(own) if n not in root.inputs]).tobytes()
        )
        key = (model, foreign)
        if key not in self._references:
            if len(self._references) >= ROOM:
                self._references.clear()
            self._references[key] = self._own(model) if root is model else self._inherited(model, root, u)
        return self._references[key]

    # --- the model's own steady state ---

    def _own(self, model: Model) -> ReferenceEquilibrium | None:
        """Return the steady state that the guesses lead to; where some states have one, the nearest of several searches.

        Newton's method may leave a guess for a far equilibrium, as where a limit holds on the way. Where it moves a guessed
        state by more than its size, the fallback solvers, which stay near or follow the model, are asked too.
        """
        p, u = _values(model)
        given = [(k, s.guess) for k, s in enumerate(model.states.values()) if s.guess is not None]
        if not given:
            try:
                return self._referenced(p, u, self.search(p, u).v)
            except SteadyStateError:
                return None
        places, guesses = [k for k, _ in given], np.array([g for _, g in given])

        def moved(v: Array) -> Array:
            """Return the distance of each guessed state from its guess, in its size."""
            return np.abs(v[places] - guesses) / (1.0 + np.abs(guesses))

        begun = (self._newton(begin, p, u, 0.0) for begin in self._begins(p, u, 0.0))
        ends = [end.v for end in begun if end is not None and (np.abs(end.v) <= self._region.limit).all()]
        if not any(moved(v).max() <= 1.0 for v in ends):
            slow = self._fallback_ends(p, u, self._filled(self._guesses[0], p, u, 0.0), 0.0)
            ends += [v for v, _, _, shares in slow if self._region.holds(shares, v)]
        if not ends:
            return None
        # Ends that rounding alone sets apart are one: the first of them stands for all.
        return self._referenced(p, u, min(ends, key=lambda v: float(np.round(np.linalg.norm(moved(v)), 6))))

    def _inherited(self, model: Model, root: Model, u: Array) -> ReferenceEquilibrium | None:
        """The root's own steady state, taken over by name, with the model's effects put in and at the model's own values."""
        known = self._of_root(model, root)
        if known is None:
            return None
        p_own, u_own = _values(model)
        foreign = [k for k, n in enumerate(model.inputs) if n not in root.inputs]
        u_own[foreign] = u[foreign]
        p_root = np.array(
            [root.parameters[n].value if n in root.parameters else q.value for n, q in model.parameters.items()]
        )
        u_root = u_own.copy()
        for k, n in enumerate(model.inputs):
            if n in root.inputs:
                u_root[k] = root.inputs[n].value
        v = self._filled(np.array([known.get(n, np.nan) for n in self.names]), p_root, u_root, 0.0)
        begun: ReferenceEquilibrium | None = self._referenced(p_root, u_root, v)
        _, _, shares = self._judged(v, p_root, u_root, 0.0)
        if not (shares < ACCURACY).all():
            path = (
                self._blend(model, known, (p_root, u_root, 0.0), (p_root, u_root, 0.0)) if _has_effects(model) else None
            )
            begun = self._referenced(p_root, u_root, path.v) if path is not None and path.ends == "arrived" else None
        if begun is None or not begun.sign or (np.array_equal(p_root, p_own) and np.array_equal(u_root, u_own)):
            return begun
        state = self._directly(begun, p_own, u_own, 0.0)
        if state is not None:
            return ReferenceEquilibrium(p_own, u_own, state.v, state.sign)
        path = self._follow_first(_ways(begun, p_own, u_own, 0.0), begun.v, begun.sign)
        return ReferenceEquilibrium(p_own, u_own, path.v, begun.sign) if path.ends == "arrived" else begun

    def _of_root(self, model: Model, root: Model) -> dict[str, float] | None:
        """The root's own steady state by name: states, unknowns and signals."""
        same = root.structure == self.structure.model.structure
        at = self if same else equilibria(root)
        reference = at.reference(root, np.array([i.value for i in root.inputs.values()]))
        return None if reference is None else dict(zip(at.names, reference.v.tolist(), strict=True))

    def _referenced(self, p: Array, u: Array, v: Array) -> ReferenceEquilibrium:
        state = self._newton(v, p, u, 0.0, HALVES)
        return ReferenceEquilibrium(p, u, v, 0.0 if state is None else state.sign)

    # --- paths ---

    def _connected(
        self, model: Model, reference: ReferenceEquilibrium, p: Array, u: Array, time: float, search: bool
    ) -> Path:
        """The way from the model's own steady state to the values; where it ends, from the root's, effects put in last.

        search: whether more ways than the straight one are tried.
        """
        ways = _ways(reference, p, u, time)
        if not search:
            return self._along(ways[0], reference.v, reference.sign, judged=False)
        path = self._follow_first(ways, reference.v, reference.sign)
        root = model.origin.root if model.origin else model
        if path.ends == "arrived" or not _has_effects(model):
            return path
        known = self._of_root(model, root)
        assert known is not None and model.origin is not None
        p0 = np.array(
            [root.parameters[n].value if n in root.parameters else p[k] for k, n in enumerate(model.parameters)]
        )
        u0 = np.array([root.inputs[n].value if n in root.inputs else u[k] for k, n in enumerate(model.inputs)])
        other = self._blend(model, known, (p0, u0, 0.0), (p, u, time))
        return path if other.ends == "no start" else other

    def _blend(self, model: Model, known: dict[str, float], a: _Values, b: _Values) -> Path:
        """The way from values a without effects to values b without them, then to b with them, or straight."""
        made, _ = blended(model)
        at = equilibria(made)
        p0, p1 = np.append(a[0], 0.0), np.append(b[0], 0.0)
        v = at._filled(np.array([known.get(n, np.nan) for n in at.names]), p0, a[1], a[2])
        begun = at._newton(v, p0, a[1], a[2], HALVES)
        place = {n: k for k, n in enumerate(at.names)}
        named = [place[n] for n in self.names]
        if begun is None:
            return Path(v[named], 0.0, "no start")
        full = np.append(b[0], 1.0)
        first, between, last = (p0, a[1], a[2]), (p1, b[1], b[2]), (full, b[1], b[2])
        path = at._follow_first(([first, between, last], [first, last]), begun.v, begun.sign)
        return replace(path, v=path.v[named])

    def _follow_first(self, ways: tuple[list[_Values], ...], v: Array, sign: float) -> Path:
        """The first of the ways that arrives, else the first."""
        paths: list[Path] = []
        for way in ways:
            path = self._along(way, v, sign)
            if path.ends == "arrived":
                return path
            paths.append(path)
        return paths[0]

    def _along(self, way: list[_Values], v: Array, sign: float, *, judged: bool = True) -> Path:
        """From v, a steady state at the way's first values with that sign of the determinant, from values to values.

        judged: whether a path that ends on its way is told as one that ends in a fold, where it does.
        """
        v, legs = v.copy(), len(way) - 1
        for k, (a, b) in enumerate(pairwise(way)):
            ends_p, ends_w = np.array([a[0], b[0]]), np.array([[a[2], *a[1]], [b[2], *b[1]]])
            equations, reached = self._equations(a[0].copy(), a[1], a[2]), np.array([sign, 0.0])
            equations.continuation(ends_p, ends_w, v, reached)
            if reached[0] < 1.0:
                w = equations.w
                at = (equations.p, w[1 : ends_w.shape[1]].copy(), float(w[0]))
                turned = judged and self._turns(v, at, ends_p, ends_w)
                return Path(v, (k + float(reached[0])) / legs, "fold" if turned else "jump", at)
        return Path(v, 1.0, "arrived")

    def _turns(self, v: Array, at: _Values, ends_p: Array, ends_w: Array) -> bool:
        """Return whether the branch turns back a little beyond v, where `continuation` ended: followed by its length, not by the values.

        Keller's bordered equations: the branch's own direction stays regular at a fold, where the values do not. A jump,
        behind which there is nothing to follow, is no fold, nor is a place where steady states lie side by side. Within
        the shortest step h of v the values go d <= h more to the fold; there they fall as c s^2 with the length s, so
        that v lies at s = 2 t d before it with the slope t = 1 / (2 c s), and 8 t h on they are at least 8 h back.
        """
        extent = np.maximum(np.abs(v), TINY)
        dp, dw = ends_p[1] - ends_p[0], ends_w[1] - ends_w[0]

        def equations(x: Array, beyond: float) -> tuple[Array, Array, Array]:
            """Residual, and its derivatives by x and by the share of the way."""
            t = at[2] + beyond * dw[0]
            before = beyond - SHORTEST
            r, jac, _ = self._judged(x, at[0] + beyond * dp, at[1] + beyond * dw[1:], t)
            r_before, _, _ = self._judged(x, at[0] + before * dp, at[1] + before * dw[1:], t - SHORTEST * dw[0])
            return r, jac, (r - r_before) / SHORTEST

        with np.errstate(all="ignore"):
            try:
                _, jac, by_share = equations(v, 0.0)
                slope = np.asarray(np.linalg.solve(jac, -by_share), dtype=np.float64)
                length = float(np.linalg.norm(slope / extent))
                if length == 0.0:  # what the way does not move does not turn on it: a jump ended it
                    return False
                for part in (1.0, 0.5, 0.25):
                    reached = self._bordered(equations, v, slope, extent, length, 8.0 * part * length * SHORTEST)
                    if reached is not None:
                        return reached < -SHORTEST
            except np.linalg.LinAlgError:
                return False
        return False

    @staticmethod
    def _bordered(
        equations: Callable[[Array, float], tuple[Array, Array, Array]],
        v: Array,
        slope: Array,
        extent: Array,
        length: float,
        ahead: float,
    ) -> float | None:
        """The share of the way, counted from v, at a length ahead on the branch; None where it is not found."""
        x, share = v + slope * ahead / length, ahead / length
        border = slope / extent**2 / length
        for _ in range(20):
            r, jac, by_share = equations(x, share)
            matrix = np.block([[jac, by_share[:, None]], [border[None, :], np.zeros((1, 1))]])
            change = np.linalg.solve(matrix, np.append(r, (x - v) @ border - ahead))
            x, share = x - change[:-1], share - float(change[-1])
            if not np.isfinite(x).all():
                return None
            if np.abs(change[:-1] / extent).max(initial=0.0) < 1e-10:
                return share
        return None

    # --- Newton's method ---

    def _newton(
        self, v: Array, p: Array, u: Array, time: float, contraction: float = np.inf, sign: float = 0.0
    ) -> SteadyState | None:
        """Solution that Newton's method finds from v; None where it finds none. contraction, sign: the rule of `newton`."""
        equations, rule = self._equations(p, u, time, v), np.array([contraction, sign])
        if not equations.newton(rule):
            return None
        y, w, first = equations.y, equations.w, 1 + self.structure.sizes.nu
        return SteadyState(y, w, np.concatenate([y[: self.n], w[first : first + self.extra]]), float(rule[1]))

    def _equations(self, p: Array, u: Array, time: float, v: Array | None = None) -> SteadyEquations:
        """The steady-state equations at parameters, inputs and a time, with the unknowns at v (default: 0)."""
        s = self.structure.sizes
        equations = SteadyEquations(self._functions, self._sizes, (time, *u), p, s.ns)
        if v is not None:
            equations.y[: self.n], equations.w[1 + s.nu : 1 + s.nu + self.extra] = v[: self.n], v[self.n :]
        return equations

    def _directly(self, reference: ReferenceEquilibrium, p: Array, u: Array, time: float) -> SteadyState | None:
        """Solution at other values that Newton's method finds from a known one, and leads back from.

        Corrections that halve are Kantorovich's condition as far as their own direction shows it: with an exponential rate
        they also halve on the way to another branch. From that one the way back ends elsewhere.
        """
        state = self._newton(reference.v, p, u, time, HALVES, reference.sign)
        if state is None:
            return None
        back = self._newton(state.v, reference.p, reference.u, 0.0, HALVES, reference.sign)
        return state if back is not None and _alike(back.v, reference.v) else None

    def _judged(self, v: Array, p: Array, u: Array, time: float) -> tuple[Array, Array, Array]:
        """(residual, Jacobian, scaled residuals) of the rest equations at v."""
        r, jac, weights = self._equations(p, u, time).judged(self._region.size, v)
        with np.errstate(all="ignore"):  # where something is no number, its share is none either
            rounding = np.abs(jac) @ np.abs(v)
            shares = np.where(np.abs(r) <= 16.0 * EPSILON * rounding, 0.0, np.abs(r) / weights)
        return r, jac, shares

    # --- where a search begins ---

    @cached_property
    def _guesses(self) -> list[Array]:
        """The model's own guesses, then the unknown ones at 0, at 1 and at seeded random places; nan where `rest` tells.

        References that the start is found with are moved a little either way, too: at their guess a limit may hold, behind which
        nothing tells in which direction they are.
        """
        m = self.structure.model
        given = [np.nan if s.guess is None and _tells_place(n, s) else s.guess for n, s in m.states.items()]
        tail = [m.algebraic[n].start for n in self.structure.unknowns]
        if all(g is not None for g in given):
            own = np.array([*given, *tail], dtype=float)
            references = [k for k, s in enumerate(m.states.values()) if s.is_reference]
            moves = sorted(
                product((0.0, *AWAY, *(-a for a in AWAY)), repeat=min(len(references), 2)), key=np.linalg.norm
            )
            guesses = [own.copy() for _ in moves]
            for guess, move in zip(guesses, moves, strict=True):
                for k, share in zip(references, move, strict=False):
                    guess[k] += share * (1.0 + abs(own[k]))
            return guesses
        random = np.random.default_rng(0)
        fills = [np.zeros(len(given)), np.ones(len(given)), *(random.normal(size=(4, len(given))))]
        return [np.array([f if g is None else g for g, f in zip(given, fill, strict=True)] + tail) for fill in fills]

    def _begins(self, p: Array, u: Array, time: float) -> Iterator[Array]:
        """Each guess with its delayed and sampled values as their sources are there, then with those at 0."""
        for guess in self._guesses:
            begin = self._filled(guess, p, u, time)
            yield begin
            if begin[self.n :].any():
                yield np.concatenate([begin[: self.n], np.zeros(self.extra)])

    def _filled(self, guess: Array, p: Array, u: Array, time: float) -> Array:
        """A place with what is not known of it: states as their `rest` is there, unknowns where they begin, delayed and
        sampled values as their sources are."""
        s = self.structure
        nx = s.sizes.nx
        v = np.zeros(self.n + self.extra)
        v[: guess.size] = guess
        model = s.model
        nowhere = np.flatnonzero(np.isnan(v[:nx]))
        open_states = [k for k in nowhere if _tells_place(s.states[k], model.states[s.states[k]])]
        held = [self.n + k for k in range(self.extra) if guess.size == self.n or np.isnan(v[self.n + k])]
        given = [x.guess for x in model.states.values()]
        fill = (
            [0.0 if g is None else g for g in given]
            + [model.algebraic[n].start for n in s.unknowns]
            + [0.0] * self.extra
        )
        unknown = [k for k in np.flatnonzero(np.isnan(v)) if nx <= k < self.n]
        v = np.where(np.isnan(v), fill, v)
        m, r, src = np.zeros(max(s.sizes.ns, 1)), np.zeros(v.size), np.zeros(max(self.extra, 1))
        p = np.ascontiguousarray(p, dtype=float)
        where = [*open_states, *unknown]
        with np.errstate(all="ignore"):
            for _ in (*where, *held):  # one may read another's value
                before = v.copy()
                w = np.concatenate([[time], u, v[self.n :]])
                evaluate(self._address[NAMES.index("modes")], v[: self.n], w, p, m, m)
                evaluate(self._address[NAMES.index("rest")], v[: self.n], w, p, m, r)
                for k in where:
                    v[k] += r[k]  # the equations read "rest - state" and "expression - unknown"
                if held:
                    evaluate(self._address[NAMES.index("src")], v[: self.n], w, p, m, src)
                    v[held] = src[[k - self.n for k in held]]
                if not np.isfinite(v).all():
                    v = np.where(np.isfinite(v), v, fill)
                    break
                if np.array_equal(v, before):
                    break
        return v

    # --- others ---

    def neighbours(self, p: Array, u: Array, time: float, v: Array, along: Array) -> list[Array]:
        """Other steady states near v: that the model runs to from there, moved a little along a direction (states,) and against
        it, and that Newton's method finds from farther and farther along it.

        What follows the model takes one Newton step for each in time and may leap over the nearest one.
        """
        nx = self.structure.sizes.nx
        ends: list[Array] = []
        for sign in (1.0, -1.0):
            x = v.copy()
            x[:nx] += sign * along
            self._move(("pseudo_transient", "minimum_norm"), x, p, u, time)
            ends.append(x)
            for far in 2.0 ** np.arange(DOUBLINGS):
                begin = v.copy()
                begin[:nx] += sign * far * along
                solved = self._newton(begin, p, u, time)
                ends += [] if solved is None else [solved.v]
        others: list[Array] = []
        for x in ends:
            _, _, shares = self._judged(x, p, u, time)
            if self._region.holds(shares, x) and not _alike(x, v) and not any(_alike(x, k) for k in others):
                others.append(x)
        return others

    def far(self, v: Array) -> list[str]:
        """The states that are out of question, by their guesses."""
        return [n for n, x, limit in zip(self.structure.states, v, self._region.limit, strict=False) if abs(x) > limit]

    # --- slower means ---

    @cached_property
    def _region(self) -> _Region:
        return _Region.of(self.structure, self._guesses[0][: self.n], self.extra)

    def _slowly(self, p: Array, u: Array, begin: Array, time: float) -> SteadyState:
        """The steady state by steps of least norm, or by following the model; SteadyStateError with the worst equation."""
        tried: list[tuple[Array, Array, Array, Array]] = []
        # The rest next to the guess comes first; where there are several, following the model may end at a far one.
        for end in self._fallback_ends(p, u, begin, time):
            tried.append(end)
            if self._region.holds(end[3], end[0]):
                break
        else:
            v, r, _, shares = tried[1]  # where the model went is what tells most
            raise self._refused(r, shares, v)
        v, _, jac, _ = tried[-1]
        s, n = self.structure.sizes, self.n + self.extra
        equations = self._equations(p, u, time, v)
        y, w, p, m = equations.y, equations.w, equations.p, equations.m
        if s.width:
            rows = np.zeros(n * s.width)
            evaluate(self._address[NAMES.index("modes")], y, w, p, m, m)
            evaluate(self._address[NAMES.index("rest_p")], y, w, p, m, rows)
            slope = np.linalg.lstsq(jac, -rows.reshape(n, s.width), rcond=1e-12)[0]
            y[self.n :], w[1 + s.nu + self.extra :] = slope[: self.n].ravel(), slope[self.n :].ravel()
        return SteadyState(y, w, v)

    def _fallback_ends(
        self, p: Array, u: Array, begin: Array, time: float
    ) -> Iterator[tuple[Array, Array, Array, Array]]:
        """(v, residual, Jacobian, scaled residuals) where each fallback solver ends."""
        for solvers in (("minimum_norm",), ("pseudo_transient", "minimum_norm"), ("implicit_euler",)):
            v = begin.copy()
            self._move(solvers, v, p, u, time)
            yield v, *self._judged(v, p, u, time)

    def _move(self, solvers: tuple[str, ...], v: Array, p: Array, u: Array, time: float) -> None:
        """Move v by fallback solvers, one after the other."""
        equations, size = self._equations(p, u, time), self._region.size
        for solver in solvers:
            if solver == "minimum_norm":
                minimum_norm(equations, size, v)
            else:
                getattr(equations, solver)(size, v)

    # --- what is told where there is none ---

    def _not_at_once(self) -> SteadyStateError:
        return SteadyStateError(
            "no steady state was found at once",
            where=f"model '{self.structure.model.name}'",
            hint="let it be searched for: Tolerance(search=True)",
        )

    def _lost(self, path: Path, p: Array, u: Array, time: float) -> SteadyStateError:
        """The error that says where the model's own steady state ends, and names another one where there is one."""
        try:
            other = self.search(p, u, time)
        except SteadyStateError:
            offered = "no other steady state was found either"
        else:
            offered = f"another steady state exists, at {self.text(other.v)}"
        return SteadyStateError(
            "the model's own steady state ends on the way to these values",
            where=f"model '{self.structure.model.name}'",
            expected="the steady state that the model has at its own values, moved without a jump",
            got=f"it turns back at {100 * path.share:.3g} % of the way, at {self.text(path.v)}; {offered}",
            hint="check the values of parameters, inputs and effects; where the other steady state is meant, give the "
            "states a `guess` there",
        )

    def text(self, v: Array) -> str:
        """The states by name and value, what rounding leaves of 0 as 0, for messages; the first six of a larger model."""
        shown = [f"{n} = {0.0 if abs(x) < ACCURACY else x:.4g}" for n, x in zip(self.structure.states, v, strict=False)]
        return ", ".join(shown[:6]) + (", ..." if len(shown) > 6 else "")

    def _refused(self, r: Array, shares: Array, v: Array) -> SteadyStateError:
        """The error that names the state that runs away, or else the worst equation."""
        worst = int(np.argmax(np.where(np.isfinite(shares), shares, np.inf)))
        got = f"{self._equation(worst)} left with {r[worst]:.3g} (scaled {shares[worst]:.2g})"
        far = np.abs(v) / self._region.limit
        away = int(np.argmax(np.where(np.isfinite(far), far, np.inf))) if v.size else 0
        if v.size and not far[away] <= 10 * CLOSE:
            name = self.structure.states[away]
            guess = self.structure.model.states[name].guess
            got = f"state '{name}' runs away to {v[away]:.4g} from its guess {guess:g}; {got}"
        return SteadyStateError(
            "no steady state was found",
            where=f"model '{self.structure.model.name}'",
            expected="every derivative 0, at states near their guesses",
            got=got,
            hint="check the input levels and limits, give states a `guess` near the solution, or a `start`",
        )

    def _equation(self, index: int) -> str:
        m = self.structure.model
        names = [f"d({n})/dt" for n in self.structure.states] + [f"unknown '{n}'" for n in self.structure.unknowns]
        names += [f"delay '{n}'" for n in m.delays] + [f"sampled value '{n}'" for n in m.sampled]
        return names[index]


def _tells_place(name: str, state: State) -> bool:
    """Return whether the rest of a state says where that is; one that reads the state itself is an equation for it."""
    return state.rest is not None and symbol(name) not in state.rest.free_symbols


_Values = tuple[Array, Array, float]
"""Parameters, inputs, time."""


@dataclass(frozen=True)
class Path:
    """End of a path from values to values.

    v: the last steady state on it. share: of the way, up to there. ends: "arrived"; "fold", where the branch turns back; "jump", where it
    breaks off; "no start", where none is known at its beginning. at: the values there, where it did not arrive.
    """

    v: Array
    share: float
    ends: Literal["arrived", "fold", "jump", "no start"]
    at: _Values | None = None


@dataclass(frozen=True)
class _Region:
    """Region in which a rest is looked for: the sizes of states, unknowns and held values as far as the model's guesses tell them.

    size: what is usual; a residual is judged against it, so that a value that grows without bound, as a dc voltage whose
    power balance P / Vdc goes to 0, cannot make its own residual small. limit: what is out of question (infinite: not known).
    """

    size: Array
    limit: Array

    @classmethod
    def of(cls, structure: ModelEquations, guess: Array, extra: int) -> _Region:
        given = [s.guess for s in structure.model.states.values()]
        sizes = [1 / CLOSE if g is None else max(abs(g), 1.0) for g in given]
        limits = [max(abs(g) / CLOSE, 1.0) if g else np.inf for g in given]
        rest = np.maximum(np.abs(guess[len(given) :]), 1.0)
        unknown = np.full(rest.size + extra, np.inf)
        return cls(np.concatenate([sizes, rest, np.full(extra, 1 / CLOSE)]), np.concatenate([limits, unknown]))

    def holds(self, shares: Array, v: Array) -> bool:
        """Return whether v solves the equations, by the scaled residuals there, within the limits."""
        return bool((shares < ACCURACY).all() and (np.abs(v) <= self.limit).all())


@lru_cache(maxsize=ROOM)
def resting(model: Model) -> Model:
    """The model whose states all begin at rest, whatever start they are given."""
    if all(s.start is None for s in model.states.values()):
        return model
    states = FrozenMap({n: replace(s, start=None) for n, s in model.states.items()})
    origin = model.origin and replace(model.origin, root=resting(model.origin.root))
    return replace(model, states=states, origin=origin)


def with_guesses(model: Model) -> Model:
    """The model with the guesses of all states and the starts of all unknowns at its own steady state.

    Written to a card it keeps its branch, for a card says nothing of where a model comes from. Raises SteadyStateError.
    """
    at = equilibria(model)
    values = dict(zip(at.names, at.start(model, *_values(model)).v.tolist(), strict=True))
    # What rounding leaves of 0 is no guess: it would tell the state's size.
    place = {n: 0.0 if abs(v) < ACCURACY else v for n, v in values.items()}
    states = {n: replace(s, guess=place[n]) for n, s in model.states.items()}
    algebraic = {n: replace(a, start=place[n]) if n in place else a for n, a in model.algebraic.items()}
    return replace(model, states=FrozenMap(states), algebraic=FrozenMap(algebraic))


def _alike(a: Array, b: Array) -> bool:
    return bool((np.abs(a - b) <= 1e-6 * (np.abs(a) + np.abs(b) + TINY)).all())


def _values(model: Model) -> tuple[Array, Array]:
    """The model's own values of parameters and inputs."""
    p = np.array([q.value for q in model.parameters.values()], dtype=float)
    return p, np.array([i.value for i in model.inputs.values()], dtype=float)


def _has_effects(model: Model) -> bool:
    return model.origin is not None and bool(model.origin.neutral)


def _ways(reference: ReferenceEquilibrium, p: Array, u: Array, time: float) -> tuple[list[_Values], ...]:
    """From the reference's values to others: straight; inputs first; parameters first. Either may leave where a rest exists."""
    begin, end = (reference.p, reference.u, 0.0), (p, u, time)
    return [begin, end], [begin, (reference.p, u, time), end], [begin, (p, reference.u, time), end]


def _made(model: Model) -> Equilibria:
    structure = ModelEquations(model, (), ())
    code = structure.compile_rest()
    return Equilibria(structure, np.array([code.address.get(n, 0) for n in NAMES], dtype=np.int64), code)


_equilibria = by_structure(_made, room=ROOM)


def equilibria(model: Model) -> Equilibria:
    """The steady states of a model's structure, kept for later calls."""
    return _equilibria(model)
