"""Transfer functions: invariant zeros, zeros, poles and gain of a channel, and formulas in a few parameters.

Zeros come from the system matrix, scaled, never from polynomials; those of python-control 0.10.2 with Slycot 0.7.1 are off by more
than 1e-6 on 36 of 100 badly scaled systems (`benchmarks/linear_library.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg
import sympy as sp

from hvdc_ident.errors import LinearizationError, require_known, unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.linearize.delays import eliminate
from hvdc_ident.linearize.loops import signal_values
from hvdc_ident.linearize.operating_point import OperatingPoint, find_operating_point
from hvdc_ident.linearize.system import Array
from hvdc_ident.model import Model

if TYPE_CHECKING:
    from hvdc_ident.linearize.linear_model import LinearModel


# --- formulas in a few parameters, the rest being numbers at the operating point ---


S = sp.Symbol("s")
LARGEST = 6


@dataclass(frozen=True, eq=False)
class SymbolicTransfer:
    """numerator/denominator in s and the parameters; the operating point is held, numbers are right to 15 digits."""

    input: str
    output: str
    numerator: sp.Expr
    denominator: sp.Expr

    @property
    def expression(self) -> sp.Expr:
        """The transfer function."""
        return self.numerator / self.denominator

    def rounded(self, digits: int = 5) -> tuple[str, str]:
        """Numerator and denominator as text by powers of s, numbers to some digits."""
        return tuple(str(sp.N(sp.collect(e, S), digits)) for e in (self.numerator, self.denominator))  # type: ignore[return-value]

    def latex(self, digits: int = 5) -> str:
        """Return the formula in LaTeX, by powers of s, numbers to some digits."""
        top, bottom = (_latex(e, digits) for e in (self.numerator, self.denominator))
        return f"\\frac{{{top}}}{{{bottom}}}"

    def __call__(self, s: complex, values: Mapping[str, float]) -> complex:
        """Return the value at a complex frequency, rad/s, for values of the symbols."""
        known = {symbol(n): v for n, v in values.items()} | {S: s}
        return complex(self.expression.subs(known).evalf())


def symbolic_transfer(
    model: Model,
    input: str,
    output: str,
    parameters: Sequence[str],
    point: OperatingPoint | None = None,
    *,
    together: Mapping[str, str] | None = None,
) -> SymbolicTransfer:
    """Return the transfer function between an input and an output (or signal) with some parameters as symbols.

    together: parameters shown as one symbol, such as {"C1": "C", "C2": "C"}. Only the states that lie between input and
    output count. Raises UnknownNameError, and LinearizationError where more than six states do, or for delays.
    """
    if model.delays or model.sampled:
        raise LinearizationError("a model with delays has no rational formula", where=f"model '{model.name}'")
    require_known("parameter", (*parameters, *(together or {})), model.parameters, f"model '{model.name}'")
    if input not in model.inputs:
        raise unknown_name("input", input, model.inputs, where=f"model '{model.name}'")
    at = find_operating_point(model) if point is None else point
    kept = {symbol(n): symbol((together or {}).get(n, n)) for n in (*parameters, *(together or {}))}
    a, b, c, d = _matrices(model, at, input, output, kept)
    a, b, c = _between(a, b, c)
    if a.shape[0] > LARGEST:
        raise LinearizationError(
            f"{a.shape[0]} states lie between '{input}' and '{output}': no formula anyone would read",
            expected=f"at most {LARGEST}",
            hint="use transfer_function(), which gives zeros and poles",
        )
    top, bottom = _fraction(a, b, c, d)
    return SymbolicTransfer(input, output, sp.expand(top), sp.expand(bottom))


def _fraction(a: sp.Matrix, b: sp.Matrix, c: sp.Matrix, d: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Numerator and denominator, polynomials in s and the symbols; the denominator's leading number is 1."""
    n = a.shape[0]
    if n == 0:
        return sp.fraction(sp.together(d))
    # Each row times its denominators, so that the determinants are those of polynomials.
    lead = [sp.lcm_list([sp.denom(sp.together(x)) for x in (*a.row(i), b[i, 0])]) for i in range(n)]
    lead = [x / _number(x) for x in lead]
    pencil = sp.Matrix(n, n, lambda i, j: sp.expand(S * lead[i] * int(i == j) - sp.cancel(lead[i] * a[i, j])))
    drive = sp.Matrix(n, 1, lambda i, _: sp.cancel(lead[i] * b[i, 0]))
    own = sp.lcm_list([sp.denom(sp.together(x)) for x in (*c, d)])
    bottom = sp.expand(pencil.det(method="berkowitz") * own)
    read = (own * c).applyfunc(sp.cancel)
    top = sp.expand((read * pencil.adjugate() * drive)[0, 0] + d * bottom)
    first = _number(sp.Poly(bottom, S).LC())
    return sp.expand(top / first), sp.expand(bottom / first)


def _number(e: sp.Expr) -> sp.Expr:
    """Return the numeric factor of an expression's first term."""
    factor = sp.expand(e).as_ordered_terms()[0].as_coeff_Mul()[0]
    return factor if factor != 0 else sp.Integer(1)


def _matrices(
    model: Model, at: OperatingPoint, input: str, output: str, kept: dict[sp.Symbol, sp.Symbol]
) -> tuple[sp.Matrix, sp.Matrix, sp.Matrix, sp.Expr]:
    """A, B, C, D with numbers for all but the kept symbols; every branch held as it is at the point."""
    names = [*model.signals, *model.algebraic]
    everything = (*model.states, *names, *model.inputs, *model.parameters)
    values = {symbol(n): v for n, v in signal_values(model, at, everything).items()}
    values |= {sp.Symbol("time", real=True): at.time}
    inner = [*model.states, *names]

    def held(e: sp.Expr) -> sp.Expr:
        return e.replace(lambda q: _is_choice(q), lambda q: _branch(q, values))

    definitions = [model.states[n].derivative for n in model.states]
    definitions += [model.signals[n].value for n in model.signals] + [
        model.algebraic[n].equation for n in model.algebraic
    ]
    shown = model.outputs[output].value if output in model.outputs else symbol(output)
    if output not in model.outputs and output not in inner:
        raise unknown_name("output or signal", output, [*model.outputs, *inner], where=f"model '{model.name}'")
    numbers = {k: sp.Rational(repr(float(v))) for k, v in values.items() if k not in kept}

    def slope(e: sp.Expr, by: str) -> sp.Expr:
        if symbol(by) not in e.free_symbols:
            return sp.Integer(0)
        return _rational(sp.diff(e, symbol(by)).xreplace(numbers).evalf(17)).xreplace(kept)

    rows = [held(e) for e in (*definitions, shown)]
    table = [[slope(e, n) for n in (*inner, input)] for e in rows]
    n, k = len(model.states), len(names)
    whole = sp.Matrix(table)
    inside = sp.eye(k) - whole[n : n + k, n : n + k]
    order = [*range(n), n + k]
    right = inside.LUsolve(whole[n : n + k, [*range(n), n + k]]) if k else sp.zeros(0, n + 1)
    total = whole[order, [*range(n), n + k]] + whole[order, n : n + k] * right
    total = total.applyfunc(sp.together)
    return total[:n, :n], total[:n, n:], total[n:, :n], total[n, n]


def _rational(e: sp.Expr) -> sp.Expr:
    """Return the expression with its floating-point numbers as short fractions, right to 15 digits."""
    return e.xreplace({x: sp.Rational(f"{float(x):.15g}") for x in e.atoms(sp.Float)})


def _is_choice(e: sp.Basic) -> bool:
    return isinstance(e, (sp.Min, sp.Max, sp.Piecewise, sp.Abs, sp.sign)) or getattr(e.func, "__name__", "") == "clip"


def _branch(e: sp.Expr, values: Mapping[sp.Symbol, float]) -> sp.Expr:
    """Return the branch of a limiter or choice that is in use at the point."""

    def number(x: sp.Expr) -> float:
        return float(x.subs(values))

    if isinstance(e, sp.Piecewise):
        return next(x for x, condition in e.args if bool(condition.subs(values)))
    if isinstance(e, (sp.Min, sp.Max)):
        return (min if isinstance(e, sp.Min) else max)(e.args, key=number)
    if isinstance(e, sp.Abs):
        return e.args[0] if number(e.args[0]) >= 0 else -e.args[0]
    if isinstance(e, sp.sign):
        return sp.Float(number(e))
    x, low, high = e.args
    return low if number(x) < number(low) else high if number(x) > number(high) else x


def _between(a: sp.Matrix, b: sp.Matrix, c: sp.Matrix) -> tuple[sp.Matrix, sp.Matrix, sp.Matrix]:
    """Return the part that the input reaches and the output sees, by structure."""
    n = a.shape[0]
    reached = {i for i in range(n) if b[i, 0] != 0}
    seen = {i for i in range(n) if c[0, i] != 0}
    for _ in range(n):
        reached |= {i for i in range(n) if any(a[i, j] != 0 for j in reached)}
        seen |= {j for j in range(n) if any(a[i, j] != 0 for i in seen)}
    keep = sorted(reached & seen)
    return a.extract(keep, keep), b.extract(keep, [0]), c.extract([0], keep)


def _latex(e: sp.Expr, digits: int) -> str:
    polynomial = sp.Poly(e, S)
    parts = []
    for (power,), coefficient in polynomial.terms():
        rounded = sp.N(sp.expand(coefficient), digits)
        text = sp.latex(rounded, mul_symbol="dot")
        text = f"\\left({text}\\right)" if rounded.is_Add and power else text
        variable = "" if power == 0 else "s" if power == 1 else f"s^{{{power}}}"
        parts.append(variable if text in ("1", "1.0") and power else f"{text} {variable}".strip())
    return " + ".join(parts).replace("+ -", "- ") or "0"


# --- zeros, poles and gain ---


RANK = 1e-11
"""Singular values below this share of the largest count as 0 when ranks are decided."""


def zeros(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return the finite invariant zeros, complex, rad/s: infinite ones are deflated by orthogonal steps beforehand.

    Emami-Naeini and Van Dooren 1982 (doi 10.1016/0005-1098(82)90070-X): rank decisions on a balanced system, then a
    generalised eigenproblem. A system without any path from input to output has none by this definition.
    """
    if a.shape[0] == 0 or b.shape[1] == 0 or c.shape[0] == 0:
        return np.zeros(0, dtype=complex)
    a, b, c, d = _balanced(a, b, c, d)
    a, b, c, d = _deflate(a, b, c, d)
    a, b, c, d = _deflate(a.T, c.T, b.T, d.T)
    n, m = a.shape[0], d.shape[1]
    if n == 0 or m == 0 or d.shape[0] != m:
        return np.zeros(0, dtype=complex)
    # Compress the columns of [C D]: what remains is a square pencil of the zeros alone.
    q = scipy.linalg.qr(np.concatenate([d, c], axis=1).T[::-1], mode="full")[0]
    stacked = np.concatenate([b, a], axis=1)
    basis = q[::-1][:, m:]
    left = stacked @ basis
    right = np.concatenate([np.zeros((n, m)), np.eye(n)], axis=1) @ basis
    alpha, beta = scipy.linalg.eig(left, right, right=False, homogeneous_eigvals=True)
    keep = np.abs(beta) > 1e-13 * np.maximum(np.abs(alpha), 1.0)
    return np.asarray(alpha[keep] / beta[keep], dtype=complex)


def _balanced(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Return the system with states, inputs and outputs scaled so that rows and columns are alike in size."""
    n, m, o = a.shape[0], b.shape[1], c.shape[0]
    whole = np.block([[a, b], [c, d]])
    t, rows, columns = np.ones(n), np.ones(o), np.ones(m)
    for _ in range(8):
        for k in range(n):
            row = np.abs(np.delete(whole[k], k)).sum()
            column = np.abs(np.delete(whole[:, k], k)).sum()
            if row > 0 and column > 0:
                factor = 2.0 ** round(np.log2(np.sqrt(column / row)))
                whole[k] *= factor
                whole[:, k] /= factor
                t[k] /= factor
        for k in range(m):
            size = np.abs(whole[:, n + k]).max()
            if size > 0:
                factor = 2.0 ** round(np.log2(size))
                whole[:, n + k] /= factor
                columns[k] *= factor
        for k in range(o):
            size = np.abs(whole[n + k]).max()
            if size > 0:
                factor = 2.0 ** round(np.log2(size))
                whole[n + k] /= factor
                rows[k] *= factor
    return whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:]


def _rank(values: Array, scale: float) -> int:
    return int((values > RANK * scale).sum())


def _deflate(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Return the system with D of full row rank and the same zeros."""
    while True:
        n, o = a.shape[0], c.shape[0]
        scale = max(float(np.abs(np.block([[b], [d]])).max(initial=0.0)), 1e-300) if d.size else 1.0
        if o == 0 or n == 0:
            return a, b, c, d
        u, values, _ = np.linalg.svd(d) if d.shape[1] else (np.eye(o), np.zeros(0), None)
        r = _rank(values, scale)
        if r == o:
            return a, b, c, d
        c, d = u.T @ c, u.T @ d
        c_low = c[r:]
        v = np.linalg.svd(c_low)
        k = _rank(v[1], max(float(np.abs(c).max(initial=0.0)), float(np.abs(a).max(initial=0.0)) * 1e-3, 1e-300))
        if k == 0:
            return a, b, c[:r], d[:r]
        # The first n - k columns span the null space of the low part of C.
        basis = np.concatenate([v[2].T[:, k:], v[2].T[:, :k]], axis=1)
        at, bt, ct = basis.T @ a @ basis, basis.T @ b, c @ basis
        keep = n - k
        a = at[:keep, :keep]
        c = np.concatenate([ct[:r, :keep], at[keep:, :keep]])
        b, d = bt[:keep], np.concatenate([d[:r], bt[keep:]])


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """gain * prod(s - zeros) / prod(s - poles), s in rad/s; cancelled: (pole, zero) pairs that were left out.

    dc_gain: the value at s = 0, infinite with a pole there; modes that the input does not reach or the output does not
    see are no poles of it, though an integrator among them stays in `poles` and `zeros`.
    """

    input: str
    output: str
    zeros: Array
    poles: Array
    gain: float
    dc_gain: float
    cancelled: tuple[tuple[complex, complex], ...] = ()

    def __call__(self, s: complex | Array) -> Array:
        """Return the value at complex frequencies s."""
        s = np.asarray(s, dtype=complex)
        top = np.prod(s[..., None] - self.zeros, axis=-1)
        return np.asarray(self.gain * top / np.prod(s[..., None] - self.poles, axis=-1))

    def to_dict(self) -> dict[str, Any]:
        """Return the transfer function as plain numbers, complex ones as [re, im]."""

        def pairs(values: Array) -> list[list[float]]:
            return [[float(v.real), float(v.imag)] for v in values]

        return {
            "input": self.input,
            "output": self.output,
            "zeros": pairs(self.zeros),
            "poles": pairs(self.poles),
            "gain": self.gain,
            "cancelled": [[[p.real, p.imag], [z.real, z.imag]] for p, z in self.cancelled],
        }


def transfer_function(model: LinearModel, input: str, output: str) -> TransferFunction:
    """Return zeros, poles and gain of one channel; stable pole-zero pairs that cancel are left out and listed.

    An unstable pair is never cancelled. A channel without a path is 0: no zeros, no poles, gain 0.
    """
    from hvdc_ident.linearize.reduction import uncontrollable_unobservable

    part = model.channel(input, output)
    a, b, c, d = part.standard()
    if not _connected(a, b, c, d):
        none = np.zeros(0, dtype=complex)
        return TransferFunction(input, output, none, none, 0.0, 0.0)
    all_poles, all_zeros = np.linalg.eigvals(a).astype(complex), zeros(a, b, c, d)
    hidden = uncontrollable_unobservable(a, b, c)
    kept_poles, kept_zeros, cancelled = _cancel(all_poles, all_zeros, hidden)
    gain = _gain(a, b, c, d, kept_zeros, kept_poles)
    return TransferFunction(
        input, output, _paired(kept_zeros), _paired(kept_poles), gain, _dc_gain(part), tuple(cancelled)
    )


def _dc_gain(channel: LinearModel) -> float:
    """Return D - C A^-1 B; where A is singular that of what the input reaches and the output sees, infinite where it is too."""
    from hvdc_ident.linearize.reduction import visible, without_sliding_means

    for part in (without_sliding_means, visible):
        a, b, c, d = part(channel)
        at_rest = eliminate(np.block([[d, c], [b, a]]), 1, 1)
        if np.isfinite(at_rest.condition):
            return float(at_rest.result[0, 0])
    return float("inf")


def _connected(a: Array, b: Array, c: Array, d: Array) -> bool:
    if np.any(d):
        return True
    reached = np.any(b != 0, axis=1)
    for _ in range(a.shape[0]):
        reached = reached | (np.abs(a) @ reached > 0)
    return bool((np.abs(c) @ reached > 0).any())


def _cancel(poles: Array, zeros_: Array, hidden: Array) -> tuple[Array, Array, list[tuple[complex, complex]]]:
    """Poles and zeros without the pairs that stand for a hidden, stable mode."""
    left, pairs = list(zeros_), []
    kept = []
    candidates = list(hidden)
    for p in poles:
        match = min(candidates, key=lambda h: abs(h - p), default=None)
        near = min(range(len(left)), key=lambda k: abs(left[k] - p), default=None)
        close = 1e-6 * max(1.0, abs(p))
        if (
            match is not None
            and abs(match - p) < close
            and near is not None
            and abs(left[near] - p) < close
            and p.real < 0
        ):
            candidates.remove(match)
            pairs.append((complex(p), complex(left.pop(near))))
        else:
            kept.append(p)
    return np.array(kept, dtype=complex), np.array(left, dtype=complex), pairs


def _paired(values: Array) -> Array:
    """Return the values sorted by size, imaginary parts due to rounding removed."""
    values = np.where(np.abs(values.imag) < 1e-13 * np.abs(values), values.real, values)
    return np.asarray(values[np.lexsort((-values.imag, values.real, np.abs(values).round(12)))], dtype=complex)


def _gain(a: Array, b: Array, c: Array, d: Array, zeros_: Array, poles: Array) -> float:
    """Return the leading coefficient, from values of the transfer function at points away from every pole and zero."""
    sizes = np.abs(np.concatenate([poles, zeros_, [1.0 + 0j]]))
    typical = float(np.exp(np.log(np.maximum(sizes, 1e-3)).mean()))
    found, eye = [], np.eye(a.shape[0])
    for angle in (0.31, 0.77, 1.23):
        s = 1.7 * typical * np.exp(1j * angle)
        value = (c @ np.linalg.solve(s * eye - a, b) + d)[0, 0]
        log = np.log(value) + np.log(s - poles).sum() - np.log(s - zeros_).sum() if value != 0 else -np.inf
        found.append(float(np.exp(log).real))
    return float(np.median(found))
