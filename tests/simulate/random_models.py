"""Random models of the grammar, and how far the engine is from `Hybrid` on them.

The right-hand sides are contractions beside some rotations, so that every model has one steady state and errors die out: what is
left of an error is the integrator's. Numbers are odd on purpose, so that no two instants coincide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy as sp
from hypothesis import strategies as st

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.expression import clip, deadband, nonwindup, symbol, where
from hvdc_ident.expression.blocks import table
from hvdc_ident.model import Delay, Model, Sampled, Signal, State
from hvdc_ident.simulate import simulate
from tests.simulate.hybrid import Hybrid, Undecided

END = 1.0
ALLOWED = 100.0
"""Largest error allowed, of rtol and of the largest value (or derivative): each of some hundreds of steps may add an error of rtol,
and most of it dies out; between the ends of steps what follows a ramp at once is less exact."""
BY_DELAY = 30.0
"""Factor of what is allowed for the derivative by a parameter of a delay's time: it has the slope of the delayed signal's dense output."""
KINDS = ("plain", "plain", "delay", "sampled", "both", "stiff")
FAST = 2e-4  # s; a shorter time constant makes a model stiff


@dataclass(frozen=True)
class Case:
    """A model, the corners of its inputs, the parameters of the sensitivities, and how the engine is to run."""

    model: Model
    points: tuple[tuple[tuple[float, float], ...], ...]
    names: tuple[str, ...]
    rtol: float
    method: str
    fast: bool


def number(low, high):
    """A strategy of odd numbers of four digits."""
    return st.integers(0, 997).map(lambda k: round(low + (high - low) * (k + 0.3719) / 998, 4))


def power_of_ten(low, high):
    """A strategy of numbers that are even in their logarithm."""
    return number(low, high).map(lambda e: float(f"{10**e:.4g}"))


SMOOTH = (
    lambda a, c: a,
    lambda a, c: sp.sin(a),
    lambda a, c: sp.cos(a + c),
    lambda a, c: sp.tanh(a),
    lambda a, c: sp.atan(a),
    lambda a, c: a / sp.sqrt(1 + a**2),
    lambda a, c: sp.log(1 + a**2) / 2,
    lambda a, c: sp.sqrt(c + a**2),
    lambda a, c: sp.exp(-(a**2) / 2),
    lambda a, c: sp.asin(0.7 * sp.tanh(a)),
    lambda a, c: sp.acos(0.7 * sp.tanh(a)),
    lambda a, c: sp.atan2(a, c + 1),
    lambda a, c: 0.5 * sp.tan(sp.tanh(a) / 1.2),
    lambda a, c: 0.35 * (2 + sp.tanh(a)) ** (c + sp.Rational(1, 2)),
    lambda a, c: a / (1 + a**2),
)
"""Functions of slope 1 at most, of an argument and a number in 0.2..0.9."""
BROKEN = (
    lambda a, c: sp.Abs(a - c),
    lambda a, c: sp.Min(a, c),
    lambda a, c: sp.Max(a, -c),
    lambda a, c: clip(a, -c, 0.7 * c),
    lambda a, c: deadband(a, 0.4 * c),
    lambda a, c: where(a > c, a - c, 0),
    lambda a, c: where(a < -c, 0.3 * (a + c) - c, a),
    lambda a, c: sp.Min(a, sp.Max(0.5 * a, c)),
    lambda a, c: table(a, [-c, 0.1, c], [-0.6 * c, 0.0, 0.5 * c]),
    lambda a, c: where(sp.And(a > -c, a < c), a, sp.sign(a) * c),
)
"""Continuous functions with corners, of slope 1 at most."""
JUMPS = (
    lambda a, c: where(a > c, 0.4, -0.2),
    lambda a, c: 0.3 * sp.sign(a - c),
    lambda a, c: where(sp.Or(a > c, a < -c), 0.5, sp.sin(a)),
)


class _Writer:
    """Draws expressions."""

    def __init__(self, draw, parameters, switches):
        self.draw, self.parameters, self.kinds = draw, parameters, (*SMOOTH, *(BROKEN * 2 if switches else ()))

    def gain(self, low=0.2, high=0.9):
        """A number in the range, or a parameter of about 0.3 to 1 times such a number."""
        found = self.draw(number(low, high))
        if self.parameters and self.draw(st.booleans()):
            return found * symbol(self.draw(st.sampled_from(list(self.parameters))))
        return sp.Float(found)

    def term(self, atoms, kinds=None):
        """An expression of slope 1 at most in atoms that are chosen from a list."""
        a = self.draw(st.sampled_from(atoms))
        if self.draw(st.integers(0, 3)) == 0:
            a = (a - self.draw(st.sampled_from(atoms))) / 2
        return self.draw(st.sampled_from(kinds or self.kinds))(a, self.gain())

    def sum(self, atoms, most, slope):
        """A sum of terms with a slope of at most so much."""
        count = self.draw(st.integers(1, most))
        signs = [self.draw(st.sampled_from((1, -1))) for _ in range(count)]
        return sp.Add(*(s * slope / count * self.gain(0.5, 1.0) * self.term(atoms) for s in signs))


@st.composite
def corners(draw):
    """The corners of an input: levels, ramps and jumps."""
    count = draw(st.integers(1, 4))
    times = sorted(draw(st.lists(number(0.02, 0.97), min_size=count, max_size=count, unique=True)))
    points, level = [(0.0, draw(number(-1.2, 1.2)))], 0.0
    for t in times:
        points.append((t, points[-1][1] if draw(st.booleans()) else draw(number(-1.2, 1.2))))
        level = draw(number(-1.2, 1.2))
        if draw(st.booleans()) and level != points[-1][1]:
            points.append((t, level))
    return tuple(points)


@st.composite
def cases(draw, most=8, kinds=KINDS):
    """A case of at most so many states and unknowns, and of one of these kinds."""
    size = draw(st.integers(1, most))
    nz = draw(st.integers(0, min(size - 1, 3)))
    nx = size - nz
    values = {f"p{k}": draw(number(0.3, 1.0)) for k in range(draw(st.integers(1, 3)))}
    kind = draw(st.sampled_from(kinds))
    switches = draw(st.booleans())
    writer = _Writer(draw, values, switches)
    inputs = [f"u{k}" for k in range(draw(st.integers(1, 2)))]
    states, unknowns = [f"x{k}" for k in range(nx)], [f"z{k}" for k in range(nz)]
    delays = ["d0", "d1"][: draw(st.integers(1, 2))] if kind in ("delay", "both") else []
    samples = ["q0", "q1"][: draw(st.integers(1, 2))] if kind in ("sampled", "both") else []
    x, z, held, u = ([symbol(n) for n in part] for part in (states, unknowns, (*delays, *samples), inputs))
    signals = {}
    if draw(st.booleans()):
        signals["s0"] = Signal(writer.term([*x, *u]))
    inner = [*x, *z, *held, *map(symbol, signals)]
    lowest = -5.5 if kind == "stiff" else (-2.0 if kind in ("delay", "both") else -2.7)
    derivatives, fastest = {}, 1.0
    for k, n in enumerate(states):
        T = draw(power_of_ten(lowest, 0.0))
        fastest = min(fastest, T)
        pull = writer.sum(inner, 3, 0.8)
        if draw(st.booleans()):
            pull += writer.gain(0.3, 1.5) * writer.term(u)
        if switches and draw(st.integers(0, 3)) == 0:
            others = [symbol(o) for o in states if o != n] + [*u, sp.sin(9 * symbol("time"))]
            pull += writer.term(others, JUMPS)
        if draw(st.integers(0, 5)) == 0:
            pull += writer.gain(0.1, 0.4) * sp.sin(draw(number(3.0, 40.0)) * symbol("time"))
        constant = T * symbol(draw(st.sampled_from(list(values)))) if draw(st.booleans()) else T
        rate = (pull - symbol(n)) / constant
        if k + 1 < nx and draw(st.integers(0, 4)) == 0:
            rate += draw(number(2.0, 30.0)) * symbol(states[k + 1])
        elif k > 0 and derivatives[states[k - 1]].has(symbol(n)) and draw(st.booleans()):
            rate -= draw(number(2.0, 30.0)) * symbol(states[k - 1])
        if switches and draw(st.integers(0, 9)) == 0 and kind != "stiff":
            rate = nonwindup(rate, symbol(n), -writer.gain(), writer.gain())
        derivatives[n] = rate
    starts = {n: writer.gain() if draw(st.integers(0, 3)) == 0 else None for n in states}
    algebraic = {n: writer.sum([*x, *z, *held, *u], 3, 0.45) + 0.2 * u[0] for n in unknowns}
    source = [*x, *z, *held, *u, *map(symbol, signals)]
    times = {n: draw(number(0.03, 0.4)) for n in (*delays, *samples)}
    time_of = {n: t * (writer.gain(0.9, 1.0) if draw(st.booleans()) else 1) for n, t in times.items()}
    shares = {n: draw(number(0.0, 0.95)) for n in samples}
    outputs = {f"y_{n}": symbol(n) for n in (*states, *unknowns, *delays, *samples)}
    outputs["y"] = writer.sum([*inner, *u], 2, 1.0)
    model = Model(
        "random",
        parameters=values,
        inputs=dict.fromkeys(inputs, 0.0),
        states={n: State(d, start=starts[n]) for n, d in derivatives.items()},
        signals=signals,
        algebraic=algebraic,
        delays={n: Delay(writer.term(source), sp.sympify(time_of[n])) for n in delays},
        sampled={
            n: Sampled(writer.term(source), sp.sympify(time_of[n]), sp.sympify(shares[n] * time_of[n])) for n in samples
        },
        outputs=outputs,
    )
    points = tuple(draw(corners()) for _ in inputs)
    method = draw(st.sampled_from(("auto", "rosenbrock", "rosenbrock" if nz or fastest < FAST else "explicit")))
    return Case(
        model, points, tuple(values), draw(st.sampled_from((1e-8, 1e-6, 1e-10))), method,
        fastest < FAST,
    )  # fmt: skip


@dataclass(frozen=True)
class Difference:
    """The largest error of a run, of the tolerance: of the values and of the derivatives, and where."""

    values: float
    rows: float
    where: str
    events: int


def difference(case, rtol=None):
    """Return the distance of the engine from the reference, in rtol of the largest value.

    Raises Undecided where there is nothing to compare.
    """
    rtol = case.rtol if rtol is None else rtol
    spread = np.random.default_rng(7).uniform(0.0, END, 60)
    time = np.concatenate([[0.0], np.sort(spread), [END]])
    reference = Hybrid(case.model, case.names, fast=case.fast, rtol=min(1e-11, rtol * 1e-2))
    with np.errstate(all="ignore"):
        theirs, rows, events = reference.run(case.points, time)
    inputs = {
        n: InputSignal.corners(p) if len(p) > 1 else InputSignal.constant(p[0][1])
        for n, p in zip(case.model.inputs, case.points, strict=True)
    }
    mine = simulate(case.model, experiment("random", time, inputs), {}, case.names, rtol=rtol, method=case.method)
    inner = [f"y_{n}" for n in (*case.model.states, *case.model.algebraic, *case.model.delays, *case.model.sampled)]
    begun = np.array([mine[n][0] for n in inner])
    if np.abs(begun - theirs[0, : begun.size]).max() > 1e-4 and reference.rests(begun):
        raise Undecided("there are several steady states")
    # Beside an event a value or a derivative may be that of its other side.
    away = np.ones(time.size, dtype=bool)
    for t in events:
        away &= np.abs(time - t) > 1e-6
    errors = []
    for k, name in enumerate(case.model.outputs):
        size = max(np.abs(theirs[:, k]).max(), 0.1)
        error = np.abs(mine[name] - theirs[:, k])[away] / size
        errors.append((error.max() / rtol, name, "", time[away][np.argmax(error)]))
        for j, parameter in enumerate(case.names):
            largest = max(np.abs(rows[:, k, j]).max(), 0.1 * size)
            error = np.abs(mine.gradients[:, k, j] - rows[:, k, j])[away] / largest
            error /= BY_DELAY if any(d.time.has(symbol(parameter)) for d in case.model.delays.values()) else 1.0
            errors.append((error.max() / rtol, name, parameter, time[away][np.argmax(error)]))
    values = max((e for e in errors if not e[2]), key=lambda e: e[0])
    slopes = max((e for e in errors if e[2]), key=lambda e: e[0])
    text = f"{values[1]} at {values[3]:.6g} s; d{slopes[1]}/d{slopes[2]} at {slopes[3]:.6g} s"
    return Difference(values[0], slopes[0], text, len(events))
