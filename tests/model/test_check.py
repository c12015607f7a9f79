"""What a model refuses, and the plain values it takes."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp

from hvdc_ident.errors import ExpressionError, InputError, ModelError, UnknownNameError
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Delay, Model, Output, Sampled, Signal, State, coerced, ordered_signals
from hvdc_ident.parameters import Input, Parameter


def motor(**changed: Any) -> Model:
    fields: dict[str, Any] = {
        "parameters": {"J": 0.01, "b": {"value": 0.1, "unit": "N.m.s"}, "k": Parameter(0.5), "R": 1},
        "inputs": {"v": 0.0},
        "states": {"w": "(torque - friction)/J"},
        "signals": {"i": "(v - k*w)/R", "torque": "k*i", "friction": "b*w"},
        "outputs": {"w": "w", "i": "i"},
    }
    return Model("dc-motor", **(fields | changed))


def test_plain_values_become_what_the_model_stores() -> None:
    model = motor()
    assert isinstance(model.parameters, FrozenMap)
    assert model.parameters["J"] == Parameter(0.01)
    assert model.parameters["b"] == Parameter(0.1, unit="N.m.s")
    assert model.inputs["v"] == Input(0.0)
    w, torque, friction, j = (symbol(n) for n in ("w", "torque", "friction", "J"))
    assert model.states["w"] == State((torque - friction) / j)
    assert model.outputs["w"] == Output(w)


def test_a_users_own_symbols_are_taken_as_the_models() -> None:
    k, i = sp.symbols("k i")
    positive = sp.Symbol("w", positive=True)
    model = motor(signals={"i": "(v - k*w)/R", "torque": k * i, "friction": Signal(sp.Symbol("b") * positive)})
    assert model == motor()
    assert hash(model) == hash(motor())


@pytest.mark.parametrize("number", [2, 2.5, np.float64(2.5), np.int32(2), sp.Rational(5, 2), sp.Integer(2)])
def test_numbers_of_every_kind_are_expressions(number: Any) -> None:
    assert float(motor(outputs={"y": number}).outputs["y"].value) == float(number)


def test_a_free_start_adds_its_parameter_once() -> None:
    model = motor(states={"w": {"derivative": "torque/J", "start": "free", "unit": "rad/s"}})
    assert model.parameters["w_start"] == Parameter(0.0, unit="rad/s")
    given = replace(model, parameters=model.parameters | {"w_start": Parameter(3.0)})
    assert given.parameters["w_start"].value == 3.0
    assert replace(given) == given
    assert list(given.parameters).count("w_start") == 1


def test_coercing_twice_changes_nothing_and_makes_nothing_anew() -> None:
    model = motor()
    for section, items in coerced(model).items():
        assert items == getattr(model, section)
        assert all(items[name] is value for name, value in getattr(model, section).items())


def test_a_model_travels_to_another_process() -> None:
    assert pickle.loads(pickle.dumps(motor())) == motor()


def test_a_model_that_is_sent_twice_is_there_once():
    first, second = (pickle.loads(pickle.dumps([motor()]))[0] for _ in range(2))
    assert first is second
    other = motor().with_values({next(iter(motor().parameters)): 0.123})
    there = pickle.loads(pickle.dumps(other))
    assert there == other and there != first and there.origin is not None and there.origin.root == motor()


def test_a_factored_expression_is_stored_as_it_reads_back() -> None:
    x = symbol("v")
    kept_apart = sp.Mul(2, x + 1, evaluate=False)
    assert motor(signals={"i": kept_apart, "torque": "i", "friction": "0"}).signals["i"].value == 2 * x + 2


@pytest.mark.parametrize(
    ("changed", "kind", "words"),
    [
        ({"parameters": {"J": math.nan}}, ModelError, "parameter 'J': a parameter's value is not a number"),
        ({"parameters": {"J": {"value": 1, "min": 2}}}, ModelError, "parameter 'J': a parameter's value lies outside"),
        ({"parameters": {"J": {"value": 1, "mn": 2}}}, UnknownNameError, "did you mean 'min'"),
        ({"parameters": {"J": "one"}}, ModelError, "its value is no number"),
        ({"parameters": {"J": True}}, ModelError, "its value is no number"),
        ({"parameters": ["J"]}, ModelError, "parameters is no mapping"),
        ({"parameters": {"J": {"unit": "s"}}}, ModelError, "parameter 'J': has no value"),
        ({"parameters": {"J": {"value": 1, "unit": 3}}}, ModelError, "its unit is no text"),
        ({"inputs": {"v": math.inf}}, ModelError, "input 'v': an input's value is not finite"),
        ({"states": {"w": {"start": 0.0}}}, ModelError, "state 'w': has no derivative"),
        ({"states": {"w": None}}, ModelError, "state 'w': has no derivative"),
        ({"states": {"w": "torqe/J"}}, UnknownNameError, "state 'w': no variable 'torqe'"),
        ({"states": {"w": "torqe/J"}}, UnknownNameError, "did you mean 'torque'"),
        ({"states": {"w": "torque/"}}, ExpressionError, "model 'dc-motor', state 'w': unexpected the end"),
        ({"states": {"w": {"derivative": "0", "start": "v"}}}, ModelError, "state 'w', start: 'v' is no parameter"),
        ({"states": {"w": {"derivative": "0", "start": "K"}}}, UnknownNameError, "start: no parameter 'K'"),
        ({"states": {"w": {"derivative": "0", "rest": "q"}}}, UnknownNameError, "rest: no variable 'q'"),
        ({"states": {"w": {"derivative": "0", "guess": math.inf}}}, ModelError, "the guess is not finite"),
        ({"states": {"w": math.inf}}, ModelError, "state 'w': the number is not finite"),
        ({"signals": {"sin": "1"}}, ModelError, "the name 'sin' is the function"),
        ({"signals": {"time": "1"}}, ModelError, "the name 'time' is the clock"),
        ({"signals": {"a b": "1"}}, ModelError, "'a b' cannot name a variable"),
        ({"signals": {"\u0430": "1"}}, ModelError, "cannot name a variable"),
        ({"signals": {1: "1"}}, ModelError, "cannot name a variable"),
        ({"signals": {"J": "1"}}, ModelError, "signal 'J': the name is taken: it is also a parameter"),
        ({"delays": {"v": {"of": "1", "time": "J"}}}, ModelError, "delay 'v': the name is taken"),
        ({"outputs": {"y": sp.Function("f")(sp.Symbol("w"))}}, ModelError, "the expression f\\(w\\) is not a real"),
        ({"outputs": {"y": sp.I * sp.Symbol("w")}}, ModelError, "is not a real, finite function"),
        ({"outputs": {"y": sp.oo}}, ModelError, "is not a real, finite function"),
        ({"outputs": {"y": sp.Symbol("w") > 1}}, ModelError, "this is no expression"),
        ({"outputs": {"y": sp.Matrix([1])}}, ModelError, "this is no expression"),
        ({"outputs": {"y": [1]}}, ModelError, "this is no expression"),
        ({"outputs": {"y": "z"}}, UnknownNameError, "output 'y': no variable 'z'"),
        ({"outputs": {"y": "w", "z": "y"}}, UnknownNameError, "an output cannot be read"),
        ({"delays": {"d": {"of": "w", "time": -1}}}, ModelError, "delay 'd', time: the time is wrong"),
        ({"delays": {"d": {"of": "w", "time": "w"}}}, ModelError, "delay 'd', time: 'w' is no parameter"),
        ({"delays": {"d": "w"}}, ModelError, "delay 'd': has no time"),
        ({"sampled": {"q": {"value": "w", "period": -1}}}, ModelError, "sampled 'q', period: the time is wrong"),
        ({"sampled": {"q": {"value": "w", "period": "time"}}}, ModelError, "period: 'time' is no parameter"),
        ({"algebraic": {"q": {"equation": "w", "start": math.nan}}}, ModelError, "the start is not finite"),
        ({"description": 3}, ModelError, "the description is no text"),
        ({"parameterisations": {"p": {"parameters": {"T": 1}, "replaces": {}}}}, ModelError, "replaces nothing"),
        (
            {"parameterisations": {"p": {"parameters": {"T": 1}, "replaces": {"JJ": "T"}}}},
            UnknownNameError,
            "did you mean 'J'",
        ),
        (
            {"parameterisations": {"p": {"parameters": {"T": 1}, "replaces": {"J": "U"}}}},
            UnknownNameError,
            "replaced 'J': no parameter 'U'",
        ),
        (
            {"parameterisations": {"p": {"parameters": {"b": 1}, "replaces": {"J": "b"}}}},
            ModelError,
            "the name 'b' is taken",
        ),
    ],
)
def test_a_model_that_does_not_hold_together_is_refused(changed: Any, kind: type[InputError], words: str) -> None:
    with pytest.raises(kind, match=words) as caught:
        motor(**changed)
    assert "model 'dc-motor'" in str(caught.value)


@pytest.mark.parametrize("name", ["", "  ", 3, None])
def test_a_model_needs_a_name(name: Any) -> None:
    with pytest.raises(ModelError, match="needs a name"):
        Model(name, outputs={"y": 1})  # type: ignore[arg-type]


def test_an_empty_model_is_refused() -> None:
    with pytest.raises(ModelError, match="the model is empty"):
        Model("m", parameters={"a": 1})  # type: ignore[arg-type]


def test_a_circle_of_signals_is_shown_with_the_way_out() -> None:
    circle = {"i": "torque", "torque": "friction + 1", "friction": "i", "beside": "i"}
    with pytest.raises(ModelError, match=r"i -> torque -> friction -> i.*algebraic"):
        motor(signals=circle)
    with pytest.raises(ModelError, match="i -> i"):
        motor(signals={"i": "i + 1", "torque": "1", "friction": "1"})


def test_circles_through_unknowns_delays_and_samples_are_allowed() -> None:
    signals = {"i": "torque + z", "torque": "d + q", "friction": "i"}
    model = motor(
        signals=signals,
        algebraic={"z": "i/2"},
        delays={"d": Delay(symbol("i"), sp.Float(0.1))},
        sampled={"q": Sampled(symbol("i"), sp.Float(0.1))},
    )
    assert ordered_signals(model) == ("torque", "i", "friction")


def test_signals_are_ordered_by_use_and_else_as_given() -> None:
    assert ordered_signals(motor()) == ("i", "torque", "friction")
    signals = {"c": "b + a", "b": "a", "a": "v", "friction": "0", "torque": "0", "i": "0"}
    assert ordered_signals(motor(parameters={"J": 1}, signals=signals)) == ("a", "b", "c", "friction", "torque", "i")


def test_a_chain_of_five_thousand_signals_needs_no_deep_stack() -> None:
    n = 5000
    chain = {f"s{k}": f"s{k + 1} + 1" if k < n - 1 else "u" for k in range(n)}
    model = Model("chain", inputs={"u": 0}, signals=chain, outputs={"y": "s0"})  # type: ignore[arg-type]
    assert ordered_signals(model)[:2] == (f"s{n - 1}", f"s{n - 2}")
    with pytest.raises(ModelError, match=r"s0 -> s1 -> .* more"):
        Model("ring", signals={**chain, f"s{n - 1}": "s0"}, outputs={"y": "s0"})  # type: ignore[arg-type]
