"""An independent solution of models with switches, delays and samples: sympy's derivatives, scipy's integrators, jumps by hand.

Every choice between branches (clip, min, where, ...) is a mode, 0 or 1, that is held between events. An event is where a switching
function passes 0; it is found on the dense output and then made exact by integrating to it again. Sensitivities S of the states
follow the variational equations, and at an instant t_e at which the rates jump S changes by (f_before - f_after) dt_e/dp.
Delays are integrated by the method of steps, the delayed signal kept as Chebyshev polynomials.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np
import sympy as sp
from numpy.polynomial import chebyshev
from scipy.integrate import DOP853, Radau, solve_ivp
from scipy.optimize import brentq

from hvdc_ident.expression import clip, symbol

NODES = 12  # of the polynomial that keeps a delayed signal over one step
CHECKS = 8  # places in a step where the switches are looked at
ECHOES = 6  # times that a corner is followed through a delay
GRAZING = 1e-3  # of a switch's range in a run's length: passed more slowly, its instant is not told by the tolerance
NEAR = 1e-6  # of a switch's range: nearer to it without passing, whether it is passed is not told by the tolerance


class Undecided(Exception):
    """The problem has no answer that a tolerance decides: a switch that is touched, slid along, or passed again and again."""


@dataclass
class Modes:
    """The switching functions of expressions, and the symbol that is 1 where each of them is negative."""

    switches: list[sp.Expr] = field(default_factory=list)
    known: dict[sp.Expr, sp.Expr] = field(default_factory=dict)

    def negative(self, s):
        """The mode of s < 0: a number where s is one."""
        s = sp.sympify(s)
        if s.is_number:
            return sp.Integer(bool(s < 0))
        if s not in self.known:
            mode = sp.Symbol(f"mode_{len(self.switches)}")
            self.switches.append(s)
            self.known[s], self.known[sp.expand(-s)] = mode, 1 - mode
        return self.known[s]

    def of(self, e):
        """The expression with every choice written with modes."""
        if not e.args:
            return e
        if isinstance(e, sp.Piecewise):
            result = self.of(e.args[-1][0])
            for value, condition in reversed(e.args[:-1]):
                holds = self.condition(condition)
                result = holds * self.of(value) + (1 - holds) * result
            return result
        args = [self.of(a) for a in e.args]
        if isinstance(e, clip):
            x, low, high = args
            below, above = self.negative(x - low), self.negative(high - x)
            return below * low + (1 - below) * (above * high + (1 - above) * x)
        if isinstance(e, (sp.Min, sp.Max)):
            result = args[0]
            for a in args[1:]:
                less = self.negative(result - a)
                first = less if isinstance(e, sp.Min) else 1 - less
                result = first * result + (1 - first) * a
            return result
        if isinstance(e, sp.Abs):
            return args[0] * (1 - 2 * self.negative(args[0]))
        if isinstance(e, sp.sign):
            return 1 - 2 * self.negative(args[0])
        return e.func(*args)

    def condition(self, c):
        """The mode of a comparison, or of several: 1 where it holds."""
        if c in (sp.true, sp.false):
            return sp.Integer(bool(c))
        if isinstance(c, sp.And):
            return sp.Mul(*map(self.condition, c.args))
        if isinstance(c, sp.Or):
            return 1 - sp.Mul(*(1 - self.condition(a) for a in c.args))
        if isinstance(c, sp.Not):
            return 1 - self.condition(c.args[0])
        if isinstance(c, sp.logic.boolalg.ITE):
            first, yes, no = map(self.condition, c.args)
            return first * yes + (1 - first) * no
        a, b = (self.of(x) for x in c.args)
        return self.negative(a - b) if isinstance(c, (sp.StrictLessThan, sp.LessThan)) else self.negative(b - a)


class _Compiled:
    """Expressions as one function of (x, z, w, p, m): their values, and the derivatives by y = (x, z), w and the parameters."""

    def __init__(self, expressions, y, w, p, m, by):
        self.shape = len(expressions), len(y), len(w), len(by)
        matrix, arguments = sp.Matrix(expressions), [*y, *w, *p, *m]
        parts = [list(matrix)] + [list(matrix.jacobian(v)) if expressions and v else [] for v in (y, w, by)]
        self._value = sp.lambdify(arguments, parts[0], modules="math", cse=True)
        self._all = sp.lambdify(arguments, [e for part in parts for e in part], modules="math", cse=True)

    def value(self, *vectors):
        return np.array(self._value(*np.concatenate(vectors).tolist()), dtype=float)

    def all(self, *vectors):
        n, *columns = self.shape
        flat = np.array(self._all(*np.concatenate(vectors).tolist()), dtype=float)
        ends = np.cumsum([n, *(n * c for c in columns)])[:-1]
        return flat[:n], *(flat[a : a + n * c].reshape(n, c) for a, c in zip(ends, columns, strict=True))


@dataclass
class Point:
    """Values at one instant: unknowns, what comes from outside with its rates and rows, rates and rows of the unknowns."""

    z: np.ndarray
    w: np.ndarray
    rate: np.ndarray  # of y
    rows: np.ndarray  # of y by the parameters
    w_rate: np.ndarray
    w_rows: np.ndarray


class Hybrid:
    """A model's trajectories and sensitivities by other people's code. Raises Undecided where there is no one answer.

    fast: whether the model has modes so fast that an implicit method is needed; only without delays.
    """

    def __init__(self, model, names, *, fast=False, rtol=1e-11):
        self.model, self.names, self.rtol = model, list(names), rtol
        self.method = Radau if fast else DOP853
        definitions = {symbol(n): s.value for n, s in model.signals.items()}
        modes = Modes()

        def flat(e):
            e = sp.sympify(e)
            while e.free_symbols & definitions.keys():
                e = e.xreplace(definitions)
            return modes.of(e)

        x, z, p = ([symbol(n) for n in part] for part in (model.states, model.algebraic, model.parameters))
        outside = [symbol(n) for n in ("time", *model.inputs, *model.delays, *model.sampled)]
        derivatives = [flat(s.derivative) for s in model.states.values()]
        loop = [flat(a.equation) - symbol(n) for n, a in model.algebraic.items()]
        sources = [flat(d.of) for d in model.delays.values()] + [flat(s.value) for s in model.sampled.values()]
        outputs = [flat(o.value) for o in model.outputs.values()]
        starts = [
            d if s.start is None else sp.sympify(s.start) - symbol(n)
            for (n, s), d in zip(model.states.items(), derivatives, strict=True)
        ]
        timing = [d.time for d in model.delays.values()]
        timing += [s.period for s in model.sampled.values()] + [s.compute for s in model.sampled.values()]
        first = 1 + len(model.inputs)
        held = [a - b for a, b in zip(sources, outside[first:], strict=True)]
        m = [sp.Symbol(f"mode_{k}") for k in range(len(modes.switches))]
        by = [symbol(n) for n in self.names]

        def compiled(expressions):
            return _Compiled(expressions, [*x, *z], outside, p, m, by)

        self.field, self.switch, self.source, self.output, self.rest, self.times = map(
            compiled, ([*derivatives, *loop], modes.switches, sources, outputs, [*starts, *loop, *held], timing)
        )
        self.nx, self.nz, self.nd, self.nq = len(x), len(z), len(model.delays), len(model.sampled)
        self.first, self.ns, self.k = first, len(m), len(by)
        self.p = np.array([q.value for q in model.parameters.values()])

    # --- at one instant ---

    def unknowns(self, x, w):
        """The unknowns in the present modes; the last ones found are where Newton's method begins."""
        nx = self.nx
        if not self.nz:
            return self.z
        for _ in range(60):
            r, by_y, _, _ = self.field.all(x, self.z, w, self.p, self.m)
            step = np.linalg.solve(by_y[nx:, nx:], r[nx:])
            self.z = self.z - step
            if np.abs(step).max() <= 1e-14 * (1.0 + np.abs(self.z).max()):
                return self.z
        raise Undecided("the unknowns have no solution")

    def point(self, t, v, segment):
        """Everything at t, inside the segment, with the states and their rows v."""
        nx, k = self.nx, self.k
        x, S = v[:nx], v[nx:].reshape(nx, k)
        w, w_rate, w_rows = self.outside(t, segment)
        z = self.unknowns(x, w)
        f, by_y, by_w, by_p = self.field.all(x, z, w, self.p, self.m)
        rate, rows = f[:nx], S
        if self.nz:
            pull = np.linalg.inv(by_y[nx:, nx:])
            rate = np.concatenate([rate, -pull @ (by_y[nx:, :nx] @ rate + by_w[nx:] @ w_rate)])
            rows = np.vstack([S, -pull @ (by_y[nx:, :nx] @ S + by_w[nx:] @ w_rows + by_p[nx:])])
        self._slope = np.concatenate([f[:nx], (by_y[:nx] @ rows + by_w[:nx] @ w_rows + by_p[:nx]).ravel()])
        return Point(z, w, rate, rows, w_rate, w_rows)

    def slope(self, t, v, segment):
        """d(states, rows)/dt."""
        self.point(t, v, segment)
        return self._slope

    def look(self, what, v, at):
        """Values, rates and rows of compiled expressions at a point."""
        value, by_y, by_w, by_p = what.all(v[: self.nx], at.z, at.w, self.p, self.m)
        return value, by_y @ at.rate + by_w @ at.w_rate, by_y @ at.rows + by_w @ at.w_rows + by_p

    def outside(self, t, segment):
        """Return what comes from outside at t, its rates and its rows; at the segment's ends as seen from the inside."""
        nd, first = self.nd, self.first
        w, rate, rows = np.zeros(first + nd + self.nq), np.zeros(first + nd + self.nq), np.zeros((0, self.k))
        w[0], rate[0] = t, 1.0
        middle = 0.5 * (segment[0] + segment[1])
        for i, points in enumerate(self.points):
            w[1 + i], rate[1 + i] = _on_line(points, t, middle)
        rows = np.zeros((w.size, self.k))
        for i in range(nd):
            lag, lag_p = self.timing[0][i], self.timing[1][i]
            edge = 1e-13
            back, inside = min(max(t, segment[0] + edge), segment[1] - edge) - lag, middle - lag
            if inside <= 0.0:
                w[first + i], rows[first + i] = self.before[0][i], self.before[1][i]
                continue
            a, b, polynomial, slope = self.history[max(bisect_right(self.steps, inside) - 1, 0)]
            if not a <= back <= b:  # within the segment there may be many steps of the history
                a, b, polynomial, slope = self.history[max(bisect_right(self.steps, back) - 1, 0)]
            at = (2 * back - a - b) / (b - a)
            value, speed = chebyshev.chebval(at, polynomial[:, i]), chebyshev.chebval(at, slope[:, i]) * 2 / (b - a)
            w[first + i], rate[first + i] = value[0], speed[0]
            rows[first + i] = value[1:] - speed[0] * lag_p
        w[first + nd :], rows[first + nd :] = self.held
        return w, rate, rows

    def remember(self, a, b, state, segment):
        """Keep the sources of the delays over a step as polynomials, of as many parts as they ask for."""
        if not self.nd or b <= a:
            return
        nodes = np.cos(np.pi * np.arange(NODES) / (NODES - 1))
        table = []
        for node in nodes:
            t = 0.5 * (a + b) + 0.5 * (b - a) * node
            v = state(t)
            value, _, rows = self.look(self.source, v, self.point(t, v, segment))
            table.append(np.column_stack([value, rows])[: self.nd])
        shape = (NODES, self.nd, 1 + self.k)
        polynomial = chebyshev.chebfit(nodes, np.reshape(table, (NODES, -1)), NODES - 1).reshape(shape)
        tail, size = np.abs(polynomial[-2:]).max(axis=0), np.abs(polynomial).max(axis=0)
        if (tail > self.rtol * (size + 0.01)).any() and b - a > 1e-4:
            self.remember(a, 0.5 * (a + b), state, segment)
            self.remember(0.5 * (a + b), b, state, segment)
            return
        slope = chebyshev.chebder(polynomial.reshape(NODES, -1)).reshape(NODES - 1, *shape[1:])
        self.steps.append(a)
        self.history.append((a, b, polynomial, slope))

    # --- the start, and what changes at an instant ---

    def settle(self, v, segment, flipped=None):
        """Find the modes that the values say, from the present ones on; `flipped` has been changed already and stays."""
        for _ in range(4 * self.ns + 4):
            at = self.point(segment[0], v, segment)
            value, _, _ = self.look(self.switch, v, at)
            wrong = (2 * self.m - 1) * np.where(np.abs(value) > 1e-11 * (1 + self.top), value, 0.0) > 0
            if flipped is not None:
                wrong[flipped] = False
            if not wrong.any():
                return
            worst = int(np.argmax(np.where(wrong, np.abs(value), 0.0)))
            self.m[worst] = 1 - self.m[worst]
        raise Undecided("the modes change without end")

    def begin(self):
        """States with their rows, modes, held values and the constants of time at the start."""
        nx, nz, first = self.nx, self.nz, self.first
        n, outer = nx + nz, self.nd + self.nq
        w = np.zeros(first + outer)
        w[1:first] = [points[0][1] for points in self.points]
        y = np.zeros(n)
        y[nx:] = [a.start for a in self.model.algebraic.values()]
        self.m = np.zeros(self.ns)
        for _ in range(200):
            self.m = (self.switch.value(y, w, self.p, self.m) < 0).astype(float)
            r, by_y, by_w, by_p = self.rest.all(y, w, self.p, self.m)
            jac = np.hstack([by_y, by_w[:, first:]])
            if np.linalg.cond(jac) > 1e12:
                raise Undecided("the steady state is not one point")
            step = np.linalg.solve(jac, -r)
            y, w[first:] = y + step[:n], w[first:] + step[n:]
            if np.abs(step).max(initial=0.0) < 1e-14 * (1 + np.abs(y).max(initial=0.0)):
                break
        else:
            raise Undecided("no steady state was found")
        value = self.switch.value(y, w, self.p, self.m)
        if (np.abs(value) < 1e-7).any():
            raise Undecided("the start lies on a switch")
        rows = np.linalg.solve(jac, -by_p) if self.k else np.zeros((jac.shape[0], 0))
        self.z, self.top = y[nx:], np.abs(value)
        constants, _, _, by_p = self.times.all(y, w, self.p, self.m)
        self.timing = constants, by_p
        self.before = w[first : first + self.nd].copy(), rows[n : n + self.nd]
        self.held = w[first + self.nd :].copy(), rows[n + self.nd :].copy()
        return np.concatenate([y[:nx], rows[:nx].ravel()])

    def rests(self, y):
        """Return whether states, unknowns and held values solve the equations of the start, in the modes that they say."""
        n, w = self.nx + self.nz, np.zeros(self.first + self.nd + self.nq)
        w[1 : self.first], w[self.first :] = [points[0][1] for points in self.points], y[n:]
        m = np.zeros(self.ns)
        for _ in range(self.ns + 1):
            m = (self.switch.value(y[:n], w, self.p, m) < 0).astype(float)
        r, by_y, by_w, _ = self.rest.all(y[:n], w, self.p, m)
        return np.abs(np.linalg.solve(np.hstack([by_y, by_w[:, self.first :]]), r)).max() < 1e-7

    def shifted(self, v, before, after, instant):
        """The states' rows after a jump of the rates at an instant with these derivatives by the parameters."""
        rows = v[self.nx :].reshape(self.nx, self.k) + np.outer(before - after, instant)
        return np.concatenate([v[: self.nx], rows.ravel()])

    def rates(self, t, v, segment):
        return self.slope(t, v, segment)[: self.nx].copy()

    # --- the run ---

    def run(self, points, time):
        """Outputs (n, no), their rows (n, no, k), and the instants of events.

        points: for each input the corners (time, value), two at one time for a jump. The first time is the start, 0.
        """
        self.points = [[(float(t), float(v)) for t, v in line] for line in points]
        end, k, zero = float(time[-1]), self.k, np.zeros(self.k)
        self.steps, self.history, self.events, self.trace, pending = [], [], [], [], {}
        v = self.begin()
        constants, by_p = self.timing
        lags, periods, computes = np.split(constants, [self.nd, self.nd + self.nq])
        # An instant: when, its derivatives by the parameters, what happens, to which sample, and how many delays or periods on.
        agenda = [(t, zero, "stop", 0, 0) for line in self.points for t, _ in line if 0 < t < end]
        agenda += [(0.0, zero, "stop", 0, 0)] + [(0.0, zero, "tick", i, 0) for i in range(self.nq)]
        out, grad = np.zeros((len(time), self.output.shape[0])), np.zeros((len(time), self.output.shape[0], k))
        row, t, segment = 0, 0.0, (-1.0, 0.0)
        while True:
            kinds = ("stop", "tick", "publish") if t == 0.0 else ("tick", "publish", "stop")
            now = sorted((a for a in agenda if a[0] <= t), key=lambda a: kinds.index(a[2]))
            agenda = [a for a in agenda if a[0] > t]
            for _, instant, kind, i, order in now:
                after = (t, self.next_stop(t, agenda, lags, end) if t < end else t + 1.0)
                if kind == "tick":
                    span = (t, t + 1e-9) if t == 0.0 else segment
                    value, rate, rows = self.look(self.source, v, self.point(t, v, span))
                    own = order * by_p[self.nd + i]
                    there = (value[self.nd + i], rows[self.nd + i] + rate[self.nd + i] * own)
                    ready = (t + computes[i], own + by_p[self.nd + self.nq + i], "publish", i, 0)
                    pending[i] = there
                    if ready[0] <= t:
                        now.append(ready)
                    else:
                        agenda.append(ready)
                    agenda.append(((order + 1) * periods[i], zero, "tick", i, order + 1))
                    continue
                before = self.rates(t, v, segment) if t > 0.0 else None
                if kind == "publish":
                    self.held[0][i], self.held[1][i] = pending[i]
                self.settle(v, after)
                if before is not None:
                    v = self.shifted(v, before, self.rates(t, v, after), instant)
                if order < ECHOES:
                    agenda += [
                        (t + lag, instant + by_p[i], "stop", 0, order + 1)
                        for i, lag in enumerate(lags)
                        if t + lag < end
                    ]
                segment = after
            if len(agenda) > 4000:
                raise Undecided("too many instants")
            if t >= end:
                break
            stop = self.next_stop(t, agenda, lags, end)
            segment = (t, stop)
            t, v, row, event = self.integrate(t, v, stop, segment, time, row, out, grad)
            if event is not None:
                agenda += [(t + lag, event + by_p[i], "stop", 0, 1) for i, lag in enumerate(lags) if t + lag < end]
        while row < len(time):
            self.write(row, t, v, (segment[0] - 1e-9, t), out, grad)
            row += 1
        return out, grad, np.array(self.events)

    def next_stop(self, t, agenda, lags, end):
        """The end of the segment that begins at t: no delay looks into it."""
        return min([end, *(a[0] for a in agenda if a[0] > t), *(t + lag for lag in lags)])

    def write(self, row, t, v, segment, out, grad):
        out[row], _, grad[row] = self.look(self.output, v, self.point(t, v, segment))

    def integrate(self, t, v, stop, segment, time, row, out, grad):
        """To the segment's end or the first event; returns where it is, the next row, and the event's derivatives or None."""

        def slope(s, u):
            return self.slope(s, u, segment)

        while row < len(time) and time[row] <= t:
            self.write(row, t, v, segment, out, grad)
            row += 1
        solver = self.method(slope, t, v, stop, rtol=self.rtol, atol=self.rtol * 1e-2, max_step=time[-1] / 50)
        while solver.status == "running":
            message = solver.step()
            if solver.status == "failed":
                raise Undecided(f"scipy: {message}")
            old, begin, dense = solver.t_old, v, solver.dense_output()

            def exact(s, old=old, begin=begin):  # dense output is less exact than a step
                return self.after(old, begin, s, slope)

            found = self.first_event(old, solver.t, dense, segment)
            last = solver.t if found is None else found[0]
            if found is not None:
                last, event = self.exact(found, old, begin, slope, segment)
            while row < len(time) and time[row] < last:
                self.write(row, time[row], exact(time[row]), segment, out, grad)
                row += 1
            v = solver.y.copy() if found is None else exact(last)
            self.remember(old, last, dense, segment)
            if found is not None:
                v, instant = self.cross(last, v, event, segment, stop)
                return last, v, row, instant
        return stop, v, row, None

    def after(self, a, v, b, slope):
        """The states and their rows at b, from those at a."""
        if b <= a:
            return v
        return solve_ivp(slope, (a, b), v, method=self.method, rtol=self.rtol, atol=self.rtol * 1e-2).y[:, -1]

    def first_event(self, a, b, dense, segment):
        """(instant, switch) of the first switch beyond its mode within a step, or None."""

        def value(s):
            x, w = dense(s)[: self.nx], self.outside(s, segment)[0]
            return self.switch.value(x, self.unknowns(x, w), w, self.p, self.m)

        if not self.ns:
            return None
        left = a
        for j in range(1, CHECKS + 1):
            right = a + (b - a) * j / CHECKS if j < CHECKS else b
            values = value(right)
            beyond = np.flatnonzero((2 * self.m - 1) * values > 1e-13 * (1 + self.top))
            self.top = np.maximum(self.top, np.abs(values))
            if beyond.size:
                roots = []
                for e in beyond:
                    low, high = value(left)[e], values[e]
                    at = (
                        left
                        if low * high > 0 or low == 0
                        else brentq(lambda s, e=e: value(s)[e], left, right, xtol=1e-15)
                    )
                    roots.append((at, int(e)))
                return min(roots)
            if self.trace:
                first, middle, last = np.abs(self.trace[0]), np.abs(self.trace[-1]), np.abs(values)
                noise = 0.01 * NEAR * self.top
                turned = np.minimum(first, last) - middle > noise
                if (turned & (middle < NEAR * self.top)).any():
                    raise Undecided("a switch is touched")
            self.trace = [*self.trace[-1:], values]
            left = right
        return None

    def exact(self, found, old, begin, slope, segment):
        """The instant of an event, made exact by integrating to it; with the switch."""
        at, event = found
        for _ in range(3):
            v = self.after(old, begin, at, slope)
            value, rate, _ = self.look(self.switch, v, self.point(at, v, segment))
            if rate[event] == 0.0:
                break
            at = min(max(at - value[event] / rate[event], old), segment[1])
        return at, event

    def cross(self, t, v, event, segment, stop):
        """States with their rows after an event, whose modes are set, and the event's derivatives by the parameters."""
        self.events.append(t)
        self.trace = []
        if len(self.events) > 60:
            raise Undecided("too many events")
        _, rate, rows = self.look(self.switch, v, self.point(t, v, segment))
        speed = rate[event]
        if abs(speed) < GRAZING * self.top[event] or (2 * self.m[event] - 1) * speed <= 0:
            raise Undecided("a switch is grazed")
        before = self.rates(t, v, segment)
        self.m[event] = 1 - self.m[event]
        after = (t, stop)
        self.settle(v, after, event)
        _, rate, _ = self.look(self.switch, v, self.point(t, v, after))
        if (2 * self.m[event] - 1) * rate[event] >= 0:
            raise Undecided("a switch is slid along")
        instant = -rows[event] / speed
        return self.shifted(v, before, self.rates(t, v, after), instant), instant


def _on_line(points, t, middle):
    """Value and slope at t of the line through points, on the piece in which `middle` lies."""
    times = [p[0] for p in points]
    j = bisect_right(times, middle)
    if j == 0 or j == len(points):
        return points[min(j, len(points) - 1)][1], 0.0
    (t0, v0), (t1, v1) = points[j - 1], points[j]
    slope = (v1 - v0) / (t1 - t0)
    return v0 + slope * (t - t0), slope
