"""Transfer functions as formulas in a few parameters, the rest being numbers at the operating point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sympy as sp

from hvdc_ident.errors import LinearizationError, require_known, unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.linearize.operating_point import find_operating_point, signal_values
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.model import Model

S = sp.Symbol("s")
FORMULA_STATES = 6


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

    Only the states that lie between input and output count. The operating point is held: it does not move with the symbols.

    Parameters
    ----------
    model : Model
        A model with equations.
    input : str
        Name of the input.
    output : str
        Name of an output or signal.
    parameters : list of str
        The parameters that stay symbols.
    point : OperatingPoint, default None
        Where. None: the steady state.
    together : dict of str, default None
        Parameters shown as one symbol, such as {"C1": "C", "C2": "C"}.

    Returns
    -------
    SymbolicTransfer
        `numerator` and `denominator`, sympy expressions in s (rad/s) and the symbols; other numbers are right to 15 digits.

    Raises
    ------
    UnknownNameError
        An input, output or parameter that the model lacks.
    SteadyStateError
        There is no steady state, where no point is given.
    LinearizationError
        More than six states lie between input and output, or the model has delays.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 0.5, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> transfer = hi.linear.symbolic_transfer(lag, "u", "y", ["T"])
    >>> transfer.rounded(3)
    ('2.00', 'T*s + 1.0')
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
    if a.shape[0] > FORMULA_STATES:
        raise LinearizationError(
            f"{a.shape[0]} states lie between '{input}' and '{output}': no formula anyone would read",
            expected=f"at most {FORMULA_STATES}",
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
