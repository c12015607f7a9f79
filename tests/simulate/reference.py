"""An independent reference: sympy differentiates the equations, scipy integrates the augmented system at tight tolerance."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import sympy as sp
from scipy.integrate import solve_ivp
from scipy.optimize import root

from hvdc_ident.expression import symbol


class root_of(sp.Function):
    """The square root whose slope at 0 is 0, as sqrt(max(0, x)) needs it where x is cut."""

    nargs = 1
    is_real = True

    def fdiff(self, argindex=1):
        x = self.args[0]
        return sp.Piecewise((0, x <= 0), (1 / (2 * sp.sqrt(sp.Max(x, 1e-300))), True))


class Reference:
    """States, unknowns and their sensitivities of a model without delays and samples, by other people's code."""

    def __init__(self, model, sensitivities):
        self.model, self.names = model, list(sensitivities)
        definitions = {symbol(n): s.value for n, s in model.signals.items()}

        def flat(e):
            for _ in range(60):
                new = e.xreplace(definitions)
                if new == e:
                    return e.replace(
                        lambda q: q.is_Pow and q.exp == sp.Rational(1, 2) and not q.base.is_number,
                        lambda q: root_of(q.base),
                    )
                e = new
            raise AssertionError("signals do not end")

        x, z = [symbol(n) for n in model.states], [symbol(n) for n in model.algebraic]
        p, u = [symbol(n) for n in model.parameters], [symbol(n) for n in model.inputs]
        f = sp.Matrix([flat(s.derivative) for s in model.states.values()])
        g = sp.Matrix([flat(a.equation) - symbol(n) for n, a in model.algebraic.items()]) if z else sp.zeros(0, 1)
        h = sp.Matrix([flat(o.value) for o in model.outputs.values()])
        theta = [symbol(n) for n in self.names]
        clip = {"clip": lambda v, a, b: min(max(v, a), b), "root_of": lambda v: np.sqrt(max(v, 0.0))}
        arguments = (x, z, p, u, symbol("time"))

        def compiled(m):
            code = sp.lambdify(arguments, m, modules=[clip, "numpy"], cse=True)
            return lambda *a: np.asarray(code(*a), dtype=float)

        y = x + z
        parts = {"F": sp.Matrix([*f, *g]), "H": h}
        self.F, self.H = (compiled(parts[k]) for k in "FH")
        self.FY, self.FP = compiled(parts["F"].jacobian(y)), compiled(parts["F"].jacobian(theta)) if theta else None
        self.HY, self.HP = compiled(h.jacobian(y)), compiled(h.jacobian(theta)) if theta else None
        self.nx, self.nz, self.np = len(x), len(z), len(theta)

    def unknowns(self, x, z, p, u, t):
        for _ in range(50):
            r = self.F(x, z, p, u, t).ravel()[self.nx :]
            step = np.linalg.solve(self.FY(x, z, p, u, t)[self.nx :, self.nx :], r) if self.nz else r
            z = z - step
            if not self.nz or np.abs(step).max() < 1e-15:
                break
        return z

    def run(self, inputs, time, breaks, values=None, start=None, rtol=1e-12, method="Radau"):
        """Outputs (n, no) and their derivatives (n, no, np); inputs: callables of (t, side)."""
        m = self.model
        p = [(values or {}).get(n, q.value) for n, q in m.parameters.items()]
        nx, nz, k = self.nx, self.nz, self.np
        t0 = time[0]

        def level(t, side):
            return [inputs[n](t, side) if n in inputs else i.value for n, i in m.inputs.items()]

        u = level(t0, -1)
        guess = (
            np.array([1.0 if s.guess is None else s.guess for s in m.states.values()] + [0.0] * nz)
            if start is None
            else np.asarray(start)
        )
        found = root(
            lambda y: self.F(y[:nx], y[nx:], p, u, t0).ravel() * np.where(np.arange(nx + nz) < nx, 1e-3, 1.0),
            guess,
            tol=1e-14,
        )
        y = found.x
        for _ in range(3):
            y = y - np.linalg.solve(self.FY(y[:nx], y[nx:], p, u, t0), self.F(y[:nx], y[nx:], p, u, t0).ravel())
        x, z = y[:nx], y[nx:]
        S = -np.linalg.solve(self.FY(x, z, p, u, t0), self.FP(x, z, p, u, t0))[:nx] if k else np.zeros((nx, 0))
        out, grad = np.zeros((len(time), len(m.outputs))), np.zeros((len(time), len(m.outputs), k))
        memory = {"z": z}
        stops = [t0, *[b for b in breaks if t0 < b < time[-1]], time[-1]]
        for a, b in pairwise(stops):

            def rhs(t, v, a=a, b=b):
                x, S = v[:nx], v[nx:].reshape(nx, k)
                u = level(t, 1 if t < b else -1)
                z = memory["z"] = self.unknowns(x, memory["z"], p, u, t)
                J = self.FY(x, z, p, u, t)
                d = self.F(x, z, p, u, t).ravel()[:nx]
                if not k:
                    return d
                P = self.FP(x, z, p, u, t)
                Sz = -np.linalg.solve(J[nx:, nx:], J[nx:, :nx] @ S + P[nx:]) if nz else np.zeros((0, k))
                return np.concatenate([d, (J[:nx, :nx] @ S + J[:nx, nx:] @ Sz + P[:nx]).ravel()])

            inside = (time >= a) & ((time < b) if b < time[-1] else (time <= b))
            v0 = np.concatenate([x, S.ravel()])
            wanted = np.unique(np.concatenate([time[inside], [b]]))
            solution = solve_ivp(rhs, (a, b), v0, method=method, t_eval=wanted, rtol=rtol, atol=rtol * 1e-1)
            assert solution.success, solution.message
            for row, t in zip(np.flatnonzero(inside), time[inside], strict=True):
                v = solution.y[:, np.searchsorted(wanted, t)]
                xr, Sr = v[:nx], v[nx:].reshape(nx, k)
                ur = level(t, 1)
                zr = self.unknowns(xr, memory["z"], p, ur, t)
                out[row] = self.H(xr, zr, p, ur, t).ravel()
                if k:
                    J, P = self.FY(xr, zr, p, ur, t), self.FP(xr, zr, p, ur, t)
                    Sz = -np.linalg.solve(J[nx:, nx:], J[nx:, :nx] @ Sr + P[nx:]) if nz else np.zeros((0, k))
                    grad[row] = self.HY(xr, zr, p, ur, t) @ np.vstack([Sr, Sz]) + self.HP(xr, zr, p, ur, t)
            x, S = solution.y[:nx, -1], solution.y[nx:, -1].reshape(nx, k)
        return out, grad


def sided(signal):
    """An input signal as a callable of (t, side): side < 0 is the value before a jump."""
    return lambda t, side: float(signal(t)) if side > 0 else float(signal(np.nextafter(t, -np.inf)))
