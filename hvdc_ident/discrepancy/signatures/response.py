"""Answers of a model to small disturbances at its slots along the run of an experiment: linear, varying with time.

The base run is the model's own, exact and nonlinear; the answer to a disturbance added to a slot's signal is that of
the equations linearised along it, limits as they stand. Every slot is had from one compilation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.signatures.partials import EquationPartials, Partials, tangent
from hvdc_ident.discrepancy.signatures.propagation import propagate
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output
from hvdc_ident.simulate import Tolerance, simulate, with_recording

CHUNK = 128
FEWEST = 600
"""Fewer instants over a record are filled up."""
AFTER = np.geomspace(2e-5, 2e-2, 22)
"""Where instants are put after a jump, s: what a missing lag or delay does happens there."""
AROUND = AFTER[10:17:6]
"""Parts after a corner, where less happens at once: an input that was recorded has one at every row."""


@dataclass(frozen=True, eq=False)
class System:
    """x' = phi x + g0 e + g1 e_next + ..., for all slots; the names are those of `propagation.propagate`."""

    phi: Array
    g0: Array
    g1: Array
    gw0: Array
    gw1: Array
    cs: Array
    ds: Array
    csw: Array
    co: Array
    do: Array
    dow: Array
    cf: Array
    df: Array
    dfw: Array
    start: Array
    start_w: Array


@dataclass(frozen=True, eq=False)
class Along:
    """A model's run of an experiment, and its answer to disturbances at the slots.

    time: (K,) s. rows: (K,) the record's row, or -1. values: by name, (K,) of every state, signal and input.
    outputs: names of the answers; slots: places a disturbance may be put at.
    """

    time: Array
    rows: NDArray[np.int64]
    values: Mapping[str, Array]
    outputs: tuple[str, ...]
    slots: tuple[str, ...]
    system: System
    before: NDArray[np.int64]
    share: Array
    count: int

    def signal(self, place: str) -> Array:
        """(K,): the slot's own signal on the base run."""
        return self.values[place]

    def answer(self, places: Sequence[str], d: Array) -> tuple[Array, Array]:
        """Return the slots' signals, (m, K, nc), and the outputs at the rows, (o, R, nc), in answer to disturbances d (m, K, nc).

        The start is the steady state of the disturbance's first value.
        """
        s, at = self.system, [self.slots.index(p) for p in places]
        m, count, nc = d.shape
        u, y = np.empty((m, count, nc)), np.empty((len(self.outputs), self.count, nc))
        pick = np.ix_(np.arange(count), np.array(at, dtype=np.intp), np.array(at, dtype=np.intp))
        propagate(
            s.phi, _of(s.g0, at), _of(s.g1, at), s.gw0, s.gw1, np.ascontiguousarray(s.cs[:, at]),
            np.ascontiguousarray(s.ds[pick]), np.ascontiguousarray(s.csw[:, at]), s.co, _of(s.do, at), s.dow, s.cf,
            _of(s.df, at), s.dfw, self.rows, self.before, self.share, s.start[:, at] @ d[:, 0],
            s.start_w[:, at] @ d[:, 0], np.ascontiguousarray(d), u, y,
        )  # fmt: skip
        return u, y

    def only(self, place: str) -> Along:
        """Return the run with one slot alone: small enough to be sent to a worker."""
        s, k = self.system, self.slots.index(place)
        at = [k]
        system = replace(
            s, g0=_of(s.g0, at), g1=_of(s.g1, at), cs=s.cs[:, at], ds=s.ds[:, at][:, :, at], csw=s.csw[:, at],
            do=_of(s.do, at), df=_of(s.df, at), start=s.start[:, at], start_w=s.start_w[:, at],
        )  # fmt: skip
        return replace(self, values={place: self.values[place]}, slots=(place,), system=system)

    def starts(self) -> Array:
        """(o, R, nx): what the outputs show of a unit change of each state at the start."""
        s, count = self.system, self.time.size
        nx, nw = s.phi.shape[1], s.gw0.shape[2]
        y = np.empty((len(self.outputs), self.count, nx))
        none = np.empty((0, count, nx))
        propagate(
            s.phi, _of(s.g0, []), _of(s.g1, []), s.gw0, s.gw1, s.cs[:, :0].copy(), np.empty((count, 0, 0)),
            s.csw[:, :0].copy(), s.co, _of(s.do, []), s.dow, s.cf, _of(s.df, []), s.dfw, self.rows, self.before,
            self.share, np.eye(nx), np.zeros((nw, nx)), none, none.copy(), y,
        )  # fmt: skip
        return y


def _of(matrix: Array, at: Sequence[int]) -> Array:
    return np.ascontiguousarray(matrix[:, :, at])


def alone(paths: Mapping[str, Along], place: str) -> dict[str, Along]:
    """The runs, by experiment, with one slot alone."""
    return {name: path.only(place) for name, path in paths.items()}


def _observed(model: Model, parts: EquationPartials) -> Model:
    """The model whose outputs are all its variables."""
    return replace(model, outputs=FrozenMap({n: Output(symbol(n)) for n in parts.variables}))


def along(
    model: Model, experiment: Experiment, values: Mapping[str, float], tolerance: Tolerance | None = None
) -> Along:
    """The model's run of the experiment with the answers of its measured outputs.

    tolerance: of the run (default: the engine's own). Raises SimulationError where the run fails.
    """
    plant = with_recording(model, experiment)
    outputs = experiment.outputs
    parts = tangent(plant, outputs)
    time, rows = instants(experiment)
    asked = experiment.with_(time=time, measured=None, drive=(), instrument={})
    run = simulate(_observed(plant, parts), asked, values, tolerance=tolerance)
    states = np.column_stack([run[n] for n in parts.variables])
    given = {**experiment.values, **values}
    p = np.array([float(given.get(n, q.value)) for n, q in plant.parameters.items()])
    system = _system(parts, plant, time, rows, states, p)
    before, share = _memory(parts, plant, time, p)
    seen = {n: states[:, k] for n, k in parts.place.items()}
    recorded = simulate(plant, asked, values, outputs=outputs, tolerance=tolerance)
    seen |= {f"outputs.{o}": recorded[o] for o in outputs}
    seen |= {o: recorded[o] for o in outputs if o not in seen}
    return Along(time, rows, seen, outputs, places(plant, outputs), system, before, share, experiment.time.size)


def instants(experiment: Experiment) -> tuple[Array, NDArray[np.int64]]:
    """(K,) instants, s, a jump's twice; and (K,) the row of the record that each is, -1 where it is none."""
    time = experiment.time
    begin, end = float(time[0]), float(time[-1])
    rows = np.unique(time)
    pieces = max(1, int(np.ceil(FEWEST / max(rows.size - 1, 1))))
    inner = [rows[:-1] + k / pieces * np.diff(rows) for k in range(1, pieces)]
    inputs = experiment.inputs.values()
    breaks = np.unique([b for s in inputs for b in s.breaks.tolist() if begin < b < end])
    jumps = np.intersect1d(breaks, [t for s in inputs for t in s.jumps.tolist()])
    after = [b + (AFTER if b in jumps else AROUND) for b in breaks]
    inside = np.concatenate([np.empty(0), *after])
    every = np.unique(np.concatenate([rows, *inner, inside[inside < end], breaks]))
    close = np.append(False, np.diff(every) < 1e-9 * max(end - begin, 1e-12)) & ~np.isin(every, rows)
    every = every[~close]
    grid = np.sort(np.concatenate([every, np.intersect1d(every, jumps)]))
    row = np.full(grid.size, -1, dtype=np.int64)
    # Of an instant that stands twice on the grid and once in the record the later one is compared: after the jump.
    left, right = np.searchsorted(grid, time, "left"), np.searchsorted(grid, time, "right") - 1
    first = np.append(np.diff(time) == 0, False)
    row[np.where(first, left, right)] = np.arange(time.size)
    return grid, row


def places(model: Model, outputs: Sequence[str]) -> tuple[str, ...]:
    """Every slot of the model, measured outputs last; outputs that are not measured have no place."""
    inner = (*model.states, *model.signals, *model.algebraic, *model.inputs)
    return (*inner, *(o if o not in inner else f"outputs.{o}" for o in outputs))


def _system(
    parts: EquationPartials, plant: Model, time: Array, rows: NDArray[np.int64], states: Array, p: Array
) -> System:
    blocks = [
        _matrices(parts, plant, parts.partials(time[k : k + CHUNK], states[k : k + CHUNK], p))
        for k in range(0, time.size, CHUNK)
    ]
    a, b, bw, cs, ds, csw, co, do, dow, cf, df, dfw = (np.concatenate(m) for m in zip(*blocks, strict=True))
    h = np.diff(time)
    phi, one, two = _exponentials(_middle(a) * h[:, None, None])
    b_mid, bw_mid = _middle(b) * h[:, None, None], _middle(bw) * h[:, None, None]
    compared = np.flatnonzero(rows >= 0)
    compared = compared[np.argsort(rows[compared])]
    first = parts.partials(time[:1], states[:1], p)
    start, start_w = _start(parts, plant, first)
    return System(
        phi, (one - two) @ b_mid, two @ b_mid, (one - two) @ bw_mid, two @ bw_mid, cs, ds, csw,
        co[compared], do[compared], dow[compared], cf, df, dfw, start, start_w,
    )  # fmt: skip


def _middle(m: Array) -> Array:
    return 0.5 * (m[1:] + m[:-1])


def _exponentials(z: Array) -> tuple[Array, Array, Array]:
    """exp(z), phi_1(z), phi_2(z) of matrices (K, n, n) by the (1, 2) Padé form: third order, and blind to what is very fast."""
    one = np.eye(z.shape[1])
    z2 = z @ z
    below = np.linalg.inv(one - 2 / 3 * z + z2 / 6)
    return below @ (one + z / 3), below @ (one - z / 6), below @ (one / 2 - z / 6)


@dataclass(frozen=True, eq=False)
class _Split:
    """Columns of a matrix of partial derivatives by what they belong to."""

    x: Array
    v: Array
    u: Array
    w: Array


def _split(parts: EquationPartials, m: Array) -> _Split:
    nx, nv, nu = len(parts.states), len(parts.signals), len(parts.inputs)
    return _Split(*np.split(m, np.cumsum([nx, nv, nu]), axis=2))


def _columns(through: Array, s: _Split, own: Array) -> Array:
    """Answers to disturbances at [states, signals, inputs, outputs]: directly, and through the signals (K, v, slots)."""
    direct = np.concatenate([s.x, np.zeros_like(s.v), s.u, own], axis=2)
    return direct + s.v @ through


def _matrices(parts: EquationPartials, plant: Model, d: Partials) -> tuple[Array, ...]:
    h, f, c, r = (_split(parts, m) for m in (d.signals, d.states, d.outputs, d.sources))
    k, no, nx, nv, nu = h.x.shape[0], len(parts.outputs), len(parts.states), len(parts.signals), len(parts.inputs)

    def nothing(n: int) -> Array:
        return np.zeros((k, n, no))

    inverse = np.linalg.inv(np.eye(nv) - h.v)
    through = inverse @ np.concatenate([h.x, np.broadcast_to(np.eye(nv), h.v.shape), h.u, nothing(nv)], axis=2)
    vx, vw = inverse @ h.x, inverse @ h.w
    outputs = np.broadcast_to(np.eye(no), (k, no, no))
    a, b, bw = f.x + f.v @ vx, _columns(through, f, nothing(nx)), f.w + f.v @ vw
    co, do, dow = c.x + c.v @ vx, _columns(through, c, outputs), c.w + c.v @ vw
    cf, df, dfw = r.x + r.v @ vx, _columns(through, r, nothing(r.x.shape[1])), r.w + r.v @ vw
    rest, slots = nu + no, nx + nv + nu + no
    cs = np.concatenate([np.broadcast_to(np.eye(nx), (k, nx, nx)), vx, np.zeros((k, rest, nx))], axis=1)
    own = np.concatenate([np.zeros((nv, nx)), np.eye(nv), np.zeros((nv, rest))], axis=1)
    ds = np.concatenate([np.zeros((k, nx, slots)), through - own, np.zeros((k, rest, slots))], axis=1)
    nw = len(parts.memory)
    csw = np.concatenate([np.zeros((k, nx, nw)), vw, np.zeros((k, rest, nw))], axis=1)
    return a, b, bw, cs, ds, csw, co, do, dow, cf, df, dfw


def _start(parts: EquationPartials, plant: Model, d: Partials) -> tuple[Array, Array]:
    """(x, slots) and (w, slots): the shift of the steady start by a constant disturbance; of a given start none."""
    h, q, r = (_split(parts, m) for m in (d.signals, d.rest, d.sources))
    nx, nv, no, nw = len(parts.states), len(parts.signals), len(parts.outputs), len(parts.memory)
    inverse = np.linalg.inv(np.eye(nv) - h.v)
    none = np.zeros((1, nv, no))
    through = inverse @ np.concatenate([h.x, np.eye(nv)[None], h.u, none], axis=2)
    vx, vw = inverse @ h.x, inverse @ h.w

    def rows(s: _Split) -> tuple[Array, Array]:
        inner = np.concatenate([s.x + s.v @ vx, s.w + s.v @ vw], axis=2)[0]
        return inner, _columns(through, s, np.zeros((1, s.x.shape[1], no)))[0]

    left_x, right_x = rows(q)
    left_w, right_w = rows(r)
    for i, state in enumerate(plant.states.values()):
        if state.start is not None:
            left_x[i], right_x[i] = np.eye(nx + nw)[i], 0.0
    left = np.vstack([left_x, left_w - np.eye(nx + nw)[nx:]])
    found = np.asarray(np.linalg.lstsq(left, -np.vstack([right_x, right_w]), rcond=1e-12)[0])
    return found[:nx], found[nx:]


def _memory(parts: EquationPartials, plant: Model, time: Array, p: Array) -> tuple[NDArray[np.int64], Array]:
    """For each instant and delayed or sampled value: between which instants its source lies, and how far."""
    nd = len(plant.delays)
    before = np.full((time.size, len(parts.memory)), -1, dtype=np.int64)
    share = np.zeros(before.shape)
    at = {symbol(n): sp.Float(v, 17) for n, v in zip(plant.parameters, p.tolist(), strict=True)}

    def number(e: object) -> float:
        return float(e.xreplace(at)) if isinstance(e, sp.Basic) else float(e)  # type: ignore[arg-type]

    lags = [number(d.time) for d in plant.delays.values()]
    taken = [(number(s.period), number(s.compute)) for s in plant.sampled.values()]
    for q in range(len(parts.memory)):
        if q < nd:
            when = time - lags[q]
        else:
            period, compute = taken[q - nd]
            when = time[0] + np.floor((time - time[0] - compute) / period + 1e-9) * period
        low = np.clip(np.searchsorted(time, when, "right") - 1, 0, time.size - 2)
        width = time[low + 1] - time[low]
        share[:, q] = np.clip((when - time[low]) / np.where(width > 0, width, 1.0), 0.0, 1.0)
        before[:, q] = np.where(when < time[0], -1, low)
    return before, share


__all__ = ["Along", "along", "instants", "places"]
