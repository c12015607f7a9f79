"""Text to sympy. The text is never evaluated, and no number in it can make the parser compute for long."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import sympy as sp

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression.functions import FUNCTIONS, function_of, symbol
from hvdc_ident.expression.grammar import (
    MAX_COMPARISONS,
    Call,
    Chain,
    Comparison,
    Name,
    Negative,
    Node,
    Number,
    Power,
    Source,
    TreeBuilder,
)
from hvdc_ident.expression.normal import EXACT, choose, is_double, normal, to_double

_FREE_BITS = 4096
_RELATIONS: dict[str, tuple[Any, Callable[[float, float], bool]]] = {
    "<": (sp.Lt, operator.lt),
    "<=": (sp.Le, operator.le),
    ">": (sp.Gt, operator.gt),
    ">=": (sp.Ge, operator.ge),
    "==": (sp.Eq, operator.eq),
    "!=": (sp.Ne, operator.ne),
}
_ARITHMETIC: dict[Any, Callable[..., float]] = {
    sp.Add: lambda *a: math.fsum(a),
    sp.Mul: lambda *a: math.prod(a),
    sp.Pow: math.pow,
    sp.cot: lambda x: 1 / math.tan(x),
}
_NOT_REAL = "the value is not a finite real number: a division by zero, or a function outside its range"


def parse(text: str, *, where: str = "") -> sp.Expr:
    """The sympy expression that the text of the card's grammar stands for.

    text: numbers, names, + - * / **, where(condition, a, b) with one comparison as its condition, clip, min, max, abs,
    sign, sqrt, exp, log, sin, cos, tan, tanh, asin, acos, atan, atan2, pi and `time`. where: its place, for messages.

    Integers up to 2**53 stay exact, every other number is the double that Python reads. Raises ExpressionError for
    text outside the grammar, too long or too deep, and for constants that are not finite or not real.
    """
    if not isinstance(text, str):
        raise ExpressionError("an expression must be text", where=where, got=type(text).__name__)
    source = Source(text, where)
    tree = TreeBuilder(source).tree()
    try:
        return _Builder(source).expression(tree)
    except RecursionError:
        raise ExpressionError(
            "the expression is nested too deeply", where=where, hint="name parts of it as signals"
        ) from None


class _Unfit(Exception):
    """A value that a model cannot hold; becomes an ExpressionError once the place is known."""


class _Builder:
    """A tree to sympy, with every constant checked before sympy may fold it."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.comparisons = 0

    def expression(self, root: Node) -> sp.Expr:
        """The expression of the whole tree."""
        if isinstance(root, Comparison):
            self.source.fail("a comparison is no value; use it as where(condition, a, b)", root.position)
        return self._guarded(lambda: finish(self.value(root)), root)

    def value(self, node: Node) -> sp.Expr:
        """The expression of one node."""
        match node:
            case Number():
                return self._guarded(lambda: literal(node.text), node)
            case Name("pi"):
                return sp.pi
            case Name():
                return symbol(node.name)
            case Comparison():
                self.source.fail("a comparison can only be the condition of where", node.position)
            case Call("where"):
                return self._where(node)
        arguments = [self.value(child) for child in _children(node)]
        if isinstance(node, Call) and node.function in ("min", "max"):
            self._count_comparisons(node, arguments)
        return self._guarded(lambda: checked(_combine(node, arguments)), node)

    def _count_comparisons(self, node: Call, arguments: list[sp.Expr]) -> None:
        """Nothing; raises where sympy would compare too many pairs of values, which it does slowly."""
        count = sum(len(a.args) if isinstance(a, (sp.Min, sp.Max)) else 1 for a in arguments)
        self.comparisons += count**2
        if self.comparisons > MAX_COMPARISONS:
            what = f"too many values in min and max (their numbers' squares sum to over {MAX_COMPARISONS})"
            self.source.fail(f"{what}; name parts of it as signals", node.position)

    def _where(self, node: Call) -> sp.Expr:
        condition, yes, no = node.arguments
        if not isinstance(condition, Comparison):
            self.source.fail(
                "the condition of where must be a comparison, as in where(x > 0, a, b)", condition.position
            )
        left, right = self.value(condition.left), self.value(condition.right)
        for side, node_of in ((left, condition.left), (right, condition.right)):
            if side.has(sp.Piecewise):
                self.source.fail("a condition cannot contain a where; name that part as a signal", node_of.position)
        test = self._guarded(lambda: compare(condition.relation, left, right), condition)
        first, second = self.value(yes), self.value(no)
        return self._guarded(lambda: checked(choose(test, first, second)), node)

    def _guarded(self, make: Callable[[], Any], node: Node) -> Any:
        try:
            return make()
        except _Unfit as e:
            self.source.fail(str(e), node.position)
        except (OverflowError, MemoryError):
            self.source.fail("the number is too large", node.position)
        except (TypeError, ValueError, ZeroDivisionError):
            self.source.fail(_NOT_REAL, node.position)


def _children(node: Node) -> tuple[Node, ...]:
    match node:
        case Negative():
            return (node.value,)
        case Chain():
            return tuple(child for _, child in node.items)
        case Power():
            return (node.base, node.exponent)
        case Call():
            return node.arguments
    return ()


def _combine(node: Node, arguments: list[sp.Expr]) -> sp.Expr:
    match node:
        case Negative():
            return product([sp.Integer(-1), *arguments])
        case Power():
            return power(*arguments)
        case Chain() if node.items[0][0] == "+":
            signed = zip(node.items, arguments, strict=True)
            return sp.Add(*(a if mark == "+" else product([sp.Integer(-1), a]) for (mark, _), a in signed))
        case Chain():
            return _quotient([mark for mark, _ in node.items], arguments)
        case Call():
            return call(node.function, arguments)
    raise AssertionError(node)


def _quotient(marks: list[str], arguments: list[sp.Expr]) -> sp.Expr:
    """The product of the arguments after *, divided by those after /; its numbers as Python would divide them."""
    numbers = [(m, a) for m, a in zip(marks, arguments, strict=True) if a.is_Rational or a.is_Float]
    exact = all(a.is_Rational for _, a in numbers)
    coefficient: Any = sp.Integer(1) if exact else 1.0
    for mark, number in numbers:
        value = number if exact else float(number)
        if mark == "/" and value == 0:
            raise _Unfit(_NOT_REAL)
        coefficient = coefficient * value if mark == "*" else coefficient / value
    if not exact and not math.isfinite(coefficient):
        raise _Unfit("the number is not finite: too large for a double")
    others = [(m, a) for m, a in zip(marks, arguments, strict=True) if not (a.is_Rational or a.is_Float)]
    factors = [a if mark == "*" else power(a, sp.Integer(-1)) for mark, a in others]
    return product([coefficient if exact else sp.Float(coefficient), *factors] if numbers else factors)


def literal(text: str) -> sp.Expr:
    """The number of a literal: an exact integer up to 2**53, else the double."""
    if text.isdigit() and len(text.lstrip("0")) <= 16 and int(text) <= EXACT:
        return sp.Integer(int(text))
    number = float(text)
    if not math.isfinite(number):
        raise _Unfit(f"the number {text[:30]} is not finite: too large for a double")
    return sp.Float(number)


def call(function: str, arguments: list[sp.Expr]) -> sp.Expr:
    """A function of the grammar applied to expressions."""
    match function:
        case "sqrt":
            return power(arguments[0], sp.Rational(1, 2))
        case "exp":
            return _exponential(arguments[0])
        case "tan" if arguments[0].is_number:
            constant(arguments[0])
    return _within(FUNCTIONS[function].head(*arguments))


def _within(expression: sp.Expr) -> sp.Expr:
    """The expression with the functions that sympy brings in on its own written in those of the grammar."""
    if not expression.has(sp.cot, sp.Heaviside):
        return expression
    expression = expression.replace(sp.cot, lambda x: 1 / sp.tan(x))
    return expression.replace(sp.Heaviside, lambda x, at=0.5: sp.Piecewise((0, x < 0), (1, x > 0), (at, True)))


def _exponential(argument: sp.Expr) -> sp.Expr:
    if argument.is_number and not abs(constant(argument)) < 700:
        return sp.Float(math.exp(constant(argument)))
    return sp.exp(_tame(argument))


def compare(relation: str, left: sp.Expr, right: sp.Expr) -> Any:
    """The condition `left relation right`; True or False where both are constants."""
    symbolic, numeric = _RELATIONS[relation]
    if left.is_number and right.is_number:
        return sp.true if numeric(constant(left), constant(right)) else sp.false
    return symbolic(left, right)


def product(factors: list[sp.Expr]) -> sp.Expr:
    """The product of the factors, made at once as sympy would otherwise expand a number times a sum halfway."""
    return sp.Mul(*(_tame_base(f) for f in factors))


def power(base: sp.Expr, exponent: sp.Expr) -> sp.Expr:
    """base**exponent, exact where that stays small, else in floats, so that no text can ask for a huge integer."""
    exponent = _tame(exponent)
    if not exponent.is_number:
        return sp.Pow(_tame_base(base, exponent), exponent)
    size = abs(constant(exponent))
    if base.is_number:
        value = math.pow(constant(base), constant(exponent))
        if constant(base) < 0 and not exponent.is_Integer:
            return sp.Float(value)
        return sp.Pow(base, exponent) if size * _bits(base) <= 53 or base.is_Float else sp.Float(value)
    coefficient, rest = base.as_coeff_Mul()
    if coefficient.is_Rational and size * _bits(coefficient) > 53:
        math.pow(abs(float(coefficient)), constant(exponent))
        base = sp.Mul(sp.Float(float(coefficient)), rest)
    return sp.Pow(_tame_base(base, exponent), exponent)


def _bits(expression: sp.Expr) -> int:
    """The bits of the largest integer that a power of the expression would raise."""
    if expression.is_Rational:
        return (max(abs(expression.p), expression.q) - 1).bit_length()
    if expression.is_Mul:
        return max(_bits(factor) for factor in expression.args)
    return _bits(expression.base) if expression.is_Pow else 0


def _tame(exponent: sp.Expr) -> sp.Expr:
    """The exponent with large numbers as floats where a logarithm could turn them into an integer power."""
    if not exponent.has(sp.log):
        return exponent
    large = {n: sp.Float(float(n)) for n in exponent.atoms(sp.Rational) if max(abs(n.p), n.q) > _FREE_BITS}
    return exponent.xreplace(large)


def _tame_base(factor: sp.Expr, outer: sp.Expr | None = None) -> sp.Expr:
    """The factor, its numeric base a float where the exponents could cancel down to a huge integer power."""
    if factor.is_Mul and any(f.is_Pow and f.base.is_Rational for f in factor.args):
        return sp.Mul(*(_tame_base(f, outer) for f in factor.args))
    base, exponent = factor.as_base_exp() if factor.is_Pow else (factor, sp.Integer(1))
    if not base.is_Rational or (factor.is_Rational and outer is None):
        return factor
    total = exponent if outer is None else exponent * outer
    if max((abs(n.p) / n.q for n in total.atoms(sp.Rational)), default=0) * _bits(base) <= _FREE_BITS:
        return factor
    return sp.Pow(sp.Float(float(base)), exponent)


def constant(expression: sp.Expr) -> float:
    """The value of an expression without variables, in doubles; OverflowError or ValueError where it has none."""
    if expression.is_Rational or expression.is_Float or expression in (sp.pi, sp.E):
        value = float(expression)
    elif number := _number_of(expression.func):
        value = number(*(constant(a) for a in expression.args))
    elif isinstance(expression, sp.Piecewise):
        value = constant(next(e for e, c in expression.args if c == True or sp.simplify(c) == True))  # noqa: E712
    else:
        raise _Unfit(_NOT_REAL)
    if not math.isfinite(value):
        raise _Unfit("the number is not finite: too large for a double")
    return value


def _number_of(head: Any) -> Callable[..., float] | None:
    """Function of doubles that a class of sympy stands for."""
    function = function_of(head)
    return _ARITHMETIC.get(head) if function is None else function.number


def checked(expression: sp.Expr) -> sp.Expr:
    """The same expression, refused where it is a constant that is no finite real number."""
    if expression.is_number:
        constant(expression)
    return expression


def finish(expression: sp.Expr) -> sp.Expr:
    """The normal form of the expression; refuses parts that are constant but no finite real number."""
    for number in expression.atoms(sp.Number):
        if not is_double(number) and not math.isfinite(to_double(number)):
            raise _Unfit("a number in the expression is not finite: too large for a double")
    result = normal(expression)
    if result is None or not isinstance(result, sp.Expr):
        raise _Unfit(_NOT_REAL)
    for part in sp.preorder_traversal(result):
        if part.args and isinstance(part, sp.Expr):
            checked(part)
    return checked(result)
