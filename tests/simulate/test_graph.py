"""The expression graph and its machine code against sympy's own derivatives and numbers."""

import numpy as np
import pytest
import sympy as sp

from hvdc_ident.expression import parse
from hvdc_ident.simulate import Code, Function, Graph, evaluate

NAMES = ("a", "b", "c")
TEXTS = (
    "a*b - c/a + 2.5",
    "(a + b)**3 / (1 + c**2)",
    "sqrt(a**2 + b**2) * exp(-c)",
    "sin(a)*cos(b) + tan(c/4) + tanh(a*b)",
    "log(a + 2) + atan(b/c) + atan2(a, b)",
    "asin(a/4) + acos(b/4)",
    "clip(a*b, -0.5, 0.5) * c",
    "min(a, b, c) + max(a*c, b)",
    "abs(a - b) + sign(c - a) * b",
    "where(a < b, a**2, c) + where(c >= a, b, -b)",
    "a**b + (a + 3)**-2 + a**0.5 + a**-0.5",
    "sqrt(max(0, a - b)) * c",
)


def graph_of(text):
    graph = Graph()
    nodes = {n: graph.leaf("y", k) for k, n in enumerate(NAMES)}
    return graph, nodes, graph.expression(parse(text), nodes, {})


@pytest.mark.parametrize("text", TEXTS)
def test_value_and_gradient_agree_with_sympy(text):
    graph, nodes, root = graph_of(text)
    expression = parse(text)
    gradient = graph.gradient(root)
    random = np.random.default_rng(3)
    for _ in range(5):
        point = dict(zip(NAMES, random.uniform(0.3, 1.7, 3), strict=True))
        leaves = {nodes[n]: v for n, v in point.items()}
        at = {s: point[s.name] for s in expression.free_symbols}
        assert graph.evaluate([root], leaves)[0] == pytest.approx(float(expression.subs(at)), rel=1e-13, abs=1e-13)
        for name, leaf in nodes.items():
            found = graph.evaluate([gradient[leaf]], leaves)[0] if leaf in gradient else 0.0
            slope = float(sp.diff(expression, sp.Symbol(name, real=True)).subs(at))
            if np.isnan(slope):  # sympy's 0 times infinity where a root is cut
                slope = 0.0
            assert found == pytest.approx(slope, rel=1e-11, abs=1e-12)


@pytest.mark.parametrize("text", TEXTS)
def test_machine_code_agrees_with_the_graph(text):
    graph, nodes, root = graph_of(text)
    derivatives = [d for _, d in sorted(graph.gradient(root).items())]
    both = list(enumerate([root, *derivatives]))
    code = Code(graph, [Function("cold", both, live=True), Function("hot", both, live=True, hot=True)], 1)
    point = np.array([0.7, 1.3, 0.9])
    expected = graph.evaluate([n for _, n in both], dict(zip(nodes.values(), point, strict=True)))
    for name in ("cold", "hot"):
        out = np.full(len(both), np.nan)
        evaluate(code.address[name], point, np.zeros(1), np.zeros(1), np.zeros(8), out)
        np.testing.assert_allclose(out, expected, rtol=1e-13, atol=1e-14)


def test_a_frozen_mode_decides_against_the_values():
    graph, _, root = graph_of("clip(a, -1, 1)")
    code = Code(graph, [Function("frozen", [(0, root)])], 1)
    out = np.zeros(1)
    evaluate(code.address["frozen"], np.array([5.0, 0, 0]), np.zeros(1), np.zeros(1), np.zeros(2), out)
    assert out[0] == 5.0  # no switch says that the limit is reached
    evaluate(code.address["frozen"], np.array([5.0, 0, 0]), np.zeros(1), np.zeros(1), np.array([0.0, 1.0]), out)
    assert out[0] == 1.0


def test_common_parts_stand_once():
    graph = Graph()
    nodes = {n: graph.leaf("y", k) for k, n in enumerate(NAMES)}
    first = graph.expression(parse("(a + b)*c"), nodes, {})
    count = len(graph.nodes)
    assert graph.expression(parse("(b + a)*c"), nodes, {}) == first
    assert len(graph.nodes) == count


def test_the_slope_of_a_cut_root_is_zero_where_it_is_cut():
    graph, nodes, root = graph_of("sqrt(max(0, a - b))")
    slope = graph.gradient(root)[nodes["a"]]
    leaves = dict(zip(nodes.values(), (1.0, 2.0, 0.0), strict=True))
    assert graph.evaluate([root, slope], leaves) == [0.0, 0.0]


@pytest.mark.parametrize("text", TEXTS)
def test_a_part_replaced_has_the_value_of_its_partner(text):
    """b^2 + c in place of a, and the first condition's outcome in place of the condition."""
    graph, nodes, root = graph_of(text)
    partner = graph.add(graph.mul(nodes["b"], nodes["b"]), nodes["c"])
    point = {"b": 0.7, "c": 0.4}
    a = point["b"] ** 2 + point["c"]
    leaves = {nodes[n]: v for n, v in point.items()}
    known = {nodes["a"]: partner}
    wanted = graph.evaluate([root], {**leaves, nodes["a"]: a})[0]
    for switch, value in enumerate(list(graph.switches)):
        negative = graph.evaluate([value], {**leaves, nodes["a"]: a})[0] < 0.0
        known[graph.condition(switch)] = graph.truth(negative)
    (replaced,) = graph.replaced([root], known)
    assert graph.evaluate([replaced], leaves)[0] == pytest.approx(wanted, rel=1e-13)
    assert nodes["a"] not in graph.reachable([replaced])
