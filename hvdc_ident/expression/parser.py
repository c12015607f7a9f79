"""Text to sympy. The text is never evaluated, and no number in it can make the parser compute for long."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any, NoReturn

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.logic.boolalg import And

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression.blocks import BLOCKS
from hvdc_ident.expression.functions import FUNCTIONS, function_of, own, symbol
from hvdc_ident.expression.grammar import MAX_POINTS, Source, SyntaxTree

EXACT = 2**53
"""Integers up to here are exact, as in a double; beyond it numbers are floats."""
_FREE_BITS = 4096
_SUMS: Mapping[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-"}
_PRODUCTS: Mapping[type[ast.operator], str] = {ast.Mult: "*", ast.Div: "/"}
Relation = tuple[Any, Callable[[float, float], bool]]
_RELATIONS: Mapping[type[ast.cmpop], Relation] = {
    ast.Lt: (sp.Lt, operator.lt),
    ast.LtE: (sp.Le, operator.le),
    ast.Gt: (sp.Gt, operator.gt),
    ast.GtE: (sp.Ge, operator.ge),
    ast.Eq: (sp.Eq, operator.eq),
    ast.NotEq: (sp.Ne, operator.ne),
}
_ARITHMETIC: dict[Any, Callable[..., float]] = {
    sp.Add: lambda *a: math.fsum(a),
    sp.Mul: lambda *a: math.prod(a),
    sp.Pow: math.pow,
    sp.cot: lambda x: 1 / math.tan(x),
}
_NOT_REAL = "the value is not a finite real number: a division by zero, or a function outside its range"


def parse(text: str, *, where: str = "") -> sp.Expr:
    """Return the sympy expression that the text of the card's grammar stands for.

    text: numbers, names, + - * / **, where(condition, a, b) with one comparison as its condition, clip, min, max, abs,
    sign, sqrt, exp, log, sin, cos, tan, tanh, asin, acos, atan, atan2, pi and `time`; blocks as deadband(u, width) and
    table(x, [0, 1], [0, 2]), which are written with these. where: its place, for messages.

    Integers up to 2**53 stay exact, every other number is the double that Python reads. Raises ExpressionError for
    text outside the grammar, too long or too deep, and for constants that are not finite or not real.
    """
    if not isinstance(text, str):
        raise ExpressionError("an expression must be text", where=where, got=type(text).__name__)
    source = Source(text, where)
    try:
        return _Builder(source, SyntaxTree(source)).expression()
    except RecursionError:
        raise ExpressionError(
            "the expression is nested too deeply or too long", where=where, hint="name parts of it as signals"
        ) from None


class _Unfit(Exception):
    """A value that a model cannot hold; becomes an ExpressionError once the place is known."""


class _Builder:
    """A syntax tree to sympy, with every constant checked before sympy may fold it."""

    def __init__(self, source: Source, tree: SyntaxTree) -> None:
        self.source, self.tree = source, tree

    def expression(self) -> sp.Expr:
        """Expression of the whole tree."""
        root = self.tree.root
        if isinstance(root, ast.Compare):
            self._fail("a comparison is no value; use it as where(condition, a, b)", root)
        return self._guarded(lambda: finish(self.value(root)), root)

    def value(self, node: ast.expr) -> sp.Expr:
        """Expression of one node."""
        match node:
            case ast.Name():
                return self._leaf(node)
            case ast.UnaryOp(op=ast.UAdd()):
                return self.value(node.operand)
            case ast.UnaryOp(op=ast.USub()):
                return self._negative(self.value(node.operand), node)
            case ast.BinOp(op=ast.Pow()):
                base, exponent = self.value(node.left), self.value(node.right)
                return self._guarded(lambda: checked(power(base, exponent)), node)
            case ast.BinOp(op=ast.Add() | ast.Sub()):
                return self._sum(node)
            case ast.BinOp(op=ast.Mult() | ast.Div()):
                return self._product(node)
            case ast.Call():
                return self._call(node)
            case ast.Compare():
                self._fail("a comparison can only be the condition of where", node)
        raise AssertionError(ast.dump(node))

    def _leaf(self, node: ast.Name) -> sp.Expr:
        token = self.tree.token(node)
        if token.kind == "number":
            return self._guarded(lambda: literal(token.text), node)
        return sp.pi if token.text == "pi" else symbol(token.text)

    def _negative(self, value: sp.Expr, node: ast.expr) -> sp.Expr:
        return self._guarded(lambda: checked(product([sp.Integer(-1), value])), node)

    def _sum(self, node: ast.BinOp) -> sp.Expr:
        terms = [(mark, self.value(term)) for mark, term in _chain(node, _SUMS)]
        return self._guarded(
            lambda: checked(sp.Add(*(a if mark == "+" else product([sp.Integer(-1), a]) for mark, a in terms))), node
        )

    def _product(self, node: ast.BinOp) -> sp.Expr:
        """Product of all factors that stand side by side, with one sign before it for the signs of them all."""
        marks, factors, negative = [], [], False
        for mark, factor in _chain(node, _PRODUCTS):
            while isinstance(factor, ast.UnaryOp) and isinstance(factor.op, ast.UAdd):
                factor = factor.operand
            if isinstance(factor, ast.UnaryOp):
                negative, factor = not negative, factor.operand
            marks.append(mark)
            factors.append(self.value(factor))
        result = self._guarded(lambda: checked(_quotient(marks, factors)), node)
        return self._negative(result, node) if negative else result

    def _call(self, node: ast.Call) -> sp.Expr:
        name, count = self.tree.token(node).text, len(node.args)
        if name in BLOCKS:
            return self._block(node)
        low, high = FUNCTIONS[name].arity
        if not low <= count <= high:
            counts = f"{low}" if low == high else f"{low} to {high}"
            self._fail(f"'{name}' takes {counts} arguments, got {count}", node)
        if name == "where":
            return self._where(node)
        arguments = [self.value(child) for child in node.args]
        return self._guarded(lambda: checked(call(name, arguments)), node)

    def _block(self, node: ast.Call) -> sp.Expr:
        name = self.tree.token(node).text
        block = BLOCKS[name]
        lists = [isinstance(a, ast.List) for a in node.args]
        if lists != [a.startswith("[") for a in block.arguments]:
            self._fail(f"'{name}' takes {name}({', '.join(block.arguments)})", node)
        arguments: list[Any] = [
            [self.value(item) for item in a.elts] if isinstance(a, ast.List) else self.value(a) for a in node.args
        ]
        if name == "table":
            self._check_table(arguments[1], arguments[2], node)
        return self._guarded(lambda: finish(block.write(*arguments)), node)

    def _check_table(self, at: list[sp.Expr], values: list[sp.Expr], node: ast.expr) -> None:
        if len(at) != len(values) or not 2 <= len(at) <= MAX_POINTS:
            self._fail(f"a table has 2 to {MAX_POINTS} points, got {len(at)} arguments and {len(values)} values", node)
        for low, high in pairwise(at):
            if low.is_number and high.is_number and not constant(low) < constant(high):
                self._fail(f"the arguments of a table rise; {high} follows {low}", node)

    def _where(self, node: ast.Call) -> sp.Expr:
        condition, yes, no = node.args
        if not isinstance(condition, ast.Compare):
            self._fail("the condition of where must be a comparison, as in where(x > 0, a, b)", condition)
        relation, sides = _RELATIONS[type(condition.ops[0])], (condition.left, condition.comparators[0])
        left, right = (self.value(side) for side in sides)
        for side, value in zip(sides, (left, right), strict=True):
            if value.has(sp.Piecewise):
                self._fail("a condition cannot contain a where; name that part as a signal", side)
        test = self._guarded(lambda: compare(relation, left, right), condition)
        first, second = self.value(yes), self.value(no)
        return self._guarded(lambda: checked(choose(test, first, second)), node)

    def _guarded(self, make: Callable[[], Any], node: ast.expr) -> Any:
        try:
            return make()
        except _Unfit as e:
            self._fail(str(e), node)
        except (OverflowError, MemoryError):
            self._fail("the number is too large", node)
        except (TypeError, ValueError, ZeroDivisionError):
            self._fail(_NOT_REAL, node)

    def _fail(self, what: str, node: ast.expr) -> NoReturn:
        self.source.fail(what, self.tree.token(node).position)


def _chain(node: ast.BinOp, marks: Mapping[type[ast.operator], str]) -> list[tuple[str, ast.expr]]:
    """Operands of the operators in `marks` that stand side by side without parentheses, each with the mark before it."""
    first, operands = node, [(marks[type(node.op)], node.right)]
    while (
        isinstance(first.left, ast.BinOp)
        and type(first.left.op) in marks
        and first.left.col_offset == first.col_offset  # an operand in parentheses begins after the whole
    ):
        first = first.left
        operands.append((marks[type(first.op)], first.right))
    return [(next(iter(marks.values())), first.left), *reversed(operands)]


def _quotient(marks: list[str], arguments: list[sp.Expr]) -> sp.Expr:
    """Return the product of the arguments after *, divided by those after /; its numbers as Python would divide them."""
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
    """Return the number of a literal: an exact integer up to 2**53, else the double."""
    if text.isdigit() and len(text.lstrip("0")) <= 16 and int(text) <= EXACT:
        return sp.Integer(int(text))
    number = float(text)
    if not math.isfinite(number):
        raise _Unfit(f"the number {text[:30]} is not finite: too large for a double")
    return sp.Float(number)


def call(function: str, arguments: list[sp.Expr]) -> sp.Expr:
    """Return a function of the grammar applied to expressions."""
    match function:
        case "sqrt":
            return power(arguments[0], sp.Rational(1, 2))
        case "exp":
            return _exponential(arguments[0])
        case "tan" if arguments[0].is_number:
            constant(arguments[0])
    return _within(FUNCTIONS[function].head(*arguments))


def _within(expression: sp.Expr) -> sp.Expr:
    """Return the expression with the functions that sympy brings in on its own written in those of the grammar."""
    if not expression.has(sp.cot, sp.Heaviside):
        return expression
    expression = expression.replace(sp.cot, lambda x: 1 / sp.tan(x))
    return expression.replace(sp.Heaviside, lambda x, at=0.5: sp.Piecewise((0, x < 0), (1, x > 0), (at, True)))


def _exponential(argument: sp.Expr) -> sp.Expr:
    if argument.is_number and not abs(constant(argument)) < 700:
        return sp.Float(math.exp(constant(argument)))
    return sp.exp(_tame(argument))


def compare(relation: Relation, left: sp.Expr, right: sp.Expr) -> Any:
    """Condition `left relation right`; True or False where both are constants."""
    symbolic, numeric = relation
    if left.is_number and right.is_number:
        return sp.true if numeric(constant(left), constant(right)) else sp.false
    return symbolic(left, right)


def product(factors: list[sp.Expr]) -> sp.Expr:
    """Return the product of the factors, made at once as sympy would otherwise expand a number times a sum halfway."""
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
    """Return the bits of the largest integer that a power of the expression would raise."""
    if expression.is_Rational:
        return (max(abs(expression.p), expression.q) - 1).bit_length()
    if expression.is_Mul:
        return max(_bits(factor) for factor in expression.args)
    return _bits(expression.base) if expression.is_Pow else 0


def _tame(exponent: sp.Expr) -> sp.Expr:
    """Return the exponent with large numbers as floats where a logarithm could turn them into an integer power."""
    if not exponent.has(sp.log):
        return exponent
    large = {n: sp.Float(float(n)) for n in exponent.atoms(sp.Rational) if max(abs(n.p), n.q) > _FREE_BITS}
    return exponent.xreplace(large)


def _tame_base(factor: sp.Expr, outer: sp.Expr | None = None) -> sp.Expr:
    """Return the factor, its numeric base a float where the exponents could cancel down to a huge integer power."""
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
    """Return the value of an expression without variables, in doubles; OverflowError or ValueError where it has none."""
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
    """Return the expression; refuse a constant that is no finite real number."""
    if expression.is_number:
        constant(expression)
    return expression


def finish(expression: sp.Expr) -> sp.Expr:
    """Return the normal form of the expression; refuses parts that are constant but no finite real number."""
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


# --- the normal form ---

_UNREAL = (sp.zoo, sp.nan, sp.oo, -sp.oo, sp.I)
_OUTSIDE = (AppliedUndef, sp.Derivative, sp.Integral)


@lru_cache(maxsize=50_000)
def normal(value: sp.Expr) -> sp.Expr | None:
    """Return the expression in the form that models hold, None where no model can hold it; doing it twice changes nothing.

    Symbols are the models' real ones, numbers are doubles or integers that a double holds exactly, factors that were
    kept apart are multiplied out as sympy does, and a choice in the last branch of a choice is part of it.
    """
    parts: list[Any] = []
    if not value.args:
        result: Any = _atom(value)
    else:
        parts = [normal(a) if isinstance(a, sp.Expr) else _condition(a) for a in value.args]
        if isinstance(value, _OUTSIDE) or any(p is None for p in parts):
            return None
        result = _rebuilt(value, parts)
    if result == value and type(result) is type(value) and all(p is a for p, a in zip(parts, value.args, strict=True)):
        result = value
    return result if isinstance(result, sp.Expr) and not result.has(*_UNREAL) else None


def _atom(value: sp.Expr) -> sp.Expr:
    if isinstance(value, sp.Symbol):
        return symbol(value.name)
    return value if is_double(value) else sp.Float(to_double(value))


def is_double(value: sp.Expr) -> bool:
    """True but for a number that a double cannot hold."""
    if value.is_Rational:
        return bool(max(abs(value.p), value.q) <= EXACT)
    return bool(not value.is_Float or (value._prec == 53 and sp.Float(to_double(value)) == value))


def to_double(value: sp.Expr) -> float:
    """Return the nearest double of a number, infinite where it is too large."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _condition(part: Any) -> Any:
    if not part.args:
        return part
    parts = [normal(a) if isinstance(a, sp.Expr) else _condition(a) for a in part.args]
    if any(p is None for p in parts):
        return None
    return part if all(p is a for p, a in zip(parts, part.args, strict=True)) else part.func(*parts)


def _rebuilt(value: sp.Expr, parts: list[Any]) -> Any:
    if not isinstance(value, sp.Piecewise):
        return own(value.func)(*parts)
    last = parts[-1].args[0]
    if isinstance(last, sp.Piecewise) and parts[-1].args[1] == True:  # noqa: E712 - a sympy condition
        parts = [*parts[:-1], *last.args]
    return _without_and(sp.Piecewise(*parts))


def _without_and(value: sp.Expr) -> sp.Expr:
    """Return the choice with conditions joined by `&` as choices inside choices, which the grammar has words for."""
    if not isinstance(value, sp.Piecewise) or not any(c.has(And) for _, c in value.args):
        return value
    (yes, condition), rest = value.args[0], value.args[1:]
    no = _without_and(sp.Piecewise(*rest)) if rest else sp.nan
    return _chosen(condition, yes, no)


def _chosen(condition: Any, yes: Any, no: Any) -> Any:
    if not condition.has(And):
        return choose(condition, yes, no)
    for part in reversed(condition.args):
        if isinstance(condition, And):
            yes = _chosen(part, yes, no)
        else:
            no = _chosen(part, yes, no)
    return yes if isinstance(condition, And) else no


def choose(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` where the condition holds, else `no`; a choice in the else branch becomes further pieces of this one."""
    rest = no.args if isinstance(no, sp.Piecewise) else ((no, True),)
    return sp.Piecewise((yes, condition), *rest)
