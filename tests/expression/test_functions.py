"""One table of functions: an entry reaches the parser, the printer, machine code with derivatives, and every export."""

from __future__ import annotations

import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import hvdc_ident as hi
from hvdc_ident.expression import (
    FUNCTIONS,
    GrammarFunction,
    Max,
    Min,
    at_values,
    functions,
    normal,
    parse,
    symbol,
    to_text,
)
from hvdc_ident.fmu.export.modelica_model import ModelicaPrinter
from hvdc_ident.linearize.system import evaluate
from hvdc_ident.simulate import Graph

ELEMENTARY = [f for f in FUNCTIONS.values() if f.slopes is not None]
AT = (0.37, 0.81)


@pytest.mark.parametrize("function", ELEMENTARY, ids=lambda f: f.name)
def test_slopes_are_the_derivatives_that_sympy_takes(function: GrammarFunction) -> None:
    graph, names = Graph(), [symbol("a"), symbol("b")][: function.arity[0]]
    leaves = [graph.leaf("y", k) for k in range(len(names))]
    expression = parse(f"{function.name}({', '.join(map(str, names))})")
    node = graph.expression(expression, dict(zip(map(str, names), leaves, strict=True)), {})
    gradient = graph.gradient(node)
    point = dict(zip(leaves, AT, strict=False))
    for name, leaf in zip(names, leaves, strict=True):
        expected = float(sp.diff(expression, name).evalf(30, subs=dict(zip(names, AT, strict=False))))
        assert graph.evaluate([gradient[leaf]], point)[0] == pytest.approx(expected, rel=1e-14)
        [slope] = evaluate(graph, [gradient[leaf]], {n: np.array([v]) for n, v in point.items()}, 1)
        assert slope[0] == pytest.approx(expected, rel=1e-14)


def test_a_new_function_is_one_entry(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sinh = GrammarFunction(
        "sinh",
        sp.sinh,
        math.sinh,
        array=np.sinh,
        slopes=lambda g, n, x: (g.call("sqrt", g.add(g.one, g.mul(n, n))),),
    )
    monkeypatch.setitem(functions.FUNCTIONS, "sinh", sinh)  # type: ignore[arg-type]
    assert to_text(parse("2*sinh(x)")) == "2*sinh(x)"
    assert ModelicaPrinter(lambda: "h")(parse("sinh(x)")) == "sinh(x)"
    model = hi.load_model(_card(tmp_path))
    result = hi.simulate(model, hi.Experiment(np.linspace(0.0, 1.0, 11)))
    # dx/dt = -sinh x has the solution tanh(x/2) = tanh(x0/2) exp(-t)
    expected = 2 * math.atanh(math.tanh(0.5) * math.exp(-1.0))
    assert result["x"][-1] == pytest.approx(expected, rel=1e-5)
    linear = hi.linearize(model)
    assert linear.A[0, 0] == pytest.approx(-1.0, rel=1e-9)


def _card(folder: Path) -> Path:
    path = folder / "sinh.toml"
    path.write_text(
        """schema = 1
name = "sinh"
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "u - sinh(x)", start = 1.0}
[outputs]
x = "x"
""",
        encoding="utf-8",
    )
    return path


PAIRS = [(Max, sp.Max, max), (Min, sp.Min, min)]


@pytest.mark.parametrize(("of_models", "of_sympy", "number"), PAIRS)
def test_an_extremum_stands_as_written_and_is_equal_to_that_of_sympy(of_models, of_sympy, number) -> None:
    x, y = symbol("x"), symbol("y")
    written = of_models(x, of_models(y, 3, x), 2)
    assert written.args == of_sympy(number(2, 3), x, y, evaluate=False).args
    assert written == of_sympy(x, y, number(2, 3)) == written and hash(written) == hash(of_sympy(x, y, number(2, 3)))
    assert written != next(of_other(*written.args) for of_other, _, _ in PAIRS if of_other is not of_models)
    for made in (pickle.loads(pickle.dumps(written)), written.xreplace({x: x}), normal(of_sympy(x, y, number(2, 3)))):
        assert made == written and type(made) is of_models
    assert to_text(written) == to_text(of_sympy(x, y, number(2, 3)))
    assert of_models(x, of_sympy.identity, x) == x and of_models(x, of_sympy.zero) == of_sympy.zero
    assert of_models() == of_sympy() and of_models(2, 3, sp.pi) == of_sympy(2, 3, sp.pi)
    assert not of_models(x, x + 1).is_Symbol and of_models(x, x + 1).subs(x, 2) == number(2, 3)


@pytest.mark.parametrize("of_models", [Max, Min])
@pytest.mark.parametrize("value", [sp.I, sp.nan, sp.zoo])
def test_what_cannot_be_compared_has_no_extremum(of_models, value: sp.Expr) -> None:
    with pytest.raises(ValueError, match="not comparable"):
        of_models(symbol("x"), value)


@pytest.mark.parametrize(("of_models", "of_sympy", "_number"), PAIRS)
def test_an_extremum_has_the_derivatives_of_that_of_sympy(of_models, of_sympy, _number) -> None:
    x, y = symbol("x"), symbol("y")
    for arguments in ((x**2, 3 * y), (x**2, 3 * y, 2)):
        assert of_models(*arguments).diff(x) == of_sympy(*arguments).diff(x)


def test_an_expression_at_values_has_the_branches_that_they_leave() -> None:
    x, y, a, b = (symbol(n) for n in "xyab")
    e = parse("where(a > 0, where(x > b/a, x, y), 2*y)")
    assert at_values(e, {a: sp.Float(0.0), b: sp.Float(0.0)}) == 2 * y
    assert at_values(e, {a: sp.Float(2.0), b: sp.Float(1.0)}) == parse("where(x > 0.5, x, y)")
    assert at_values(e, {}) == e
    assert at_values(parse("where(x > b/a, x, y)"), {a: sp.Float(0.0), b: sp.Float(0.0)}).free_symbols == {x, y, a, b}
