"""Model cards: nothing lost on the way out and back, and a wrong card is told in one line."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from hvdc_ident.errors import ExpressionError, InputError, ModelError, UnknownNameError
from hvdc_ident.model import Model, Parameterisation, parse_card, read_card, save_card, write_card
from hvdc_ident.models import load_model, shipped_models
from hvdc_ident.parameters import Parameter

MOTOR = """
schema = 1
name = "dc-motor"
[parameters]
J = {value = 0.01, unit = "kg.m2", min = 0.001, max = 0.1}
b = {value = 0.1, unit = "N.m.s", description = "viscous friction"}
k = {value = 0.5}
R = {value = 1.0}
[inputs]
v = {value = 0.0, unit = "V"}
[states]
w = {derivative = "(torque - friction) / J", unit = "rad/s"}
[signals]
i = "(v - k*w) / R"
torque = "k*i"
friction = {value = "b*w", unit = "N.m"}
[outputs]
w = "w"
i = "i"
"""


def everything() -> Model:
    return Model(
        "all of it",
        parameters={
            "a": Parameter(0.1, "s", 0.0, math.inf, 2.0, 'a "quoted" text', (1e-300, 0.05)),
            "T": 0.01,
            "n": -0.0,
        },
        inputs={"u": {"value": 1e-300, "unit": "Ω", "description": "line\nbreak \\ \t tab \x7f é 😀"}},
        states={
            "x": {"derivative": "u - x/a", "start": "a**2", "guess": 3.5, "rest": "u*a", "description": "d"},
            "y": {"derivative": "where(x > 0, z, d)", "start": "free"},
            "r": "q - r",
        },
        signals={"s": "x + y", "t": {"value": "clip(s, -1, 1)", "unit": "pu"}},
        algebraic={"z": {"equation": "z/2 + t", "start": 0.1 + 0.2, "unit": "pu"}},
        outputs={"x": "x", "y": {"value": "y/3", "unit": "V", "description": "text"}},
        delays={"d": {"of": "s", "time": "T"}},
        sampled={"q": {"value": "s", "period": "2*T", "compute": "T/3"}, "p": {"value": "s", "period": 0.1}},
        parameterisations={
            "own": {"parameters": {}, "replaces": {}},
            "phys ical": Parameterisation({"tau": {"value": 0.1, "min": 0}}, {"a": "tau/3", "T": "tau*0.1"}, "a text"),
        },
        description='the "whole"\nthing',
    )  # type: ignore[arg-type]


@pytest.mark.parametrize(("usual", "why"), [("[0.2, 0.1]", "no range"), ("[0.1]", "usual"), ("0.1", "usual")])
def test_usual_values_that_are_no_range_are_refused(usual: str, why: str) -> None:
    with pytest.raises(ModelError, match=why):
        parse_card(MOTOR.replace("[parameters]", f"[parameters]\nT = {{value = 0.1, usual = {usual}}}"))


def test_the_card_of_the_documentation_is_the_model_it_says() -> None:
    model = parse_card(MOTOR)
    assert model.name == "dc-motor"
    assert model.parameters["J"] == Parameter(0.01, "kg.m2", 0.001, 0.1)
    assert model.states["w"].start is None
    assert model.signals["friction"].unit == "N.m"
    assert parse_card(write_card(model)) == model


def test_everything_a_model_can_hold_comes_back() -> None:
    model = everything()
    text = write_card(model)
    again = parse_card(text)
    assert again == model
    assert write_card(again) == text
    assert math.copysign(1, again.parameters["n"].value) == -1
    assert list(again.states) == list(model.states)
    assert tomllib.loads(text)["schema"] == 1


@pytest.mark.parametrize("name", list(shipped_models()))
def test_a_shipped_model_comes_back(name: str) -> None:
    model = load_model(name)
    assert parse_card(write_card(model)) == model


def test_a_card_is_saved_whole_and_read_from_its_file(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "model.toml"
    save_card(everything(), path)
    assert read_card(path) == everything()
    assert read_card(str(path)) == everything()
    assert [p.name for p in path.parent.iterdir()] == ["model.toml"]


def test_a_byte_order_mark_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_bytes(b"\xef\xbb\xbf" + MOTOR.encode())
    assert read_card(tmp_path / "m.toml") == parse_card(MOTOR)


@pytest.mark.parametrize(
    ("old", "new", "kind", "words"),
    [
        ("schema = 1", "", ModelError, "expected schema = 1, got nothing"),
        ("schema = 1", "schema = 2", ModelError, "expected schema = 1, got 2"),
        ("schema = 1", "schema = true", ModelError, "expected schema = 1, got true"),
        ('name = "dc-motor"', "", ModelError, "'name' is missing; expected name = "),
        (
            'name = "dc-motor"',
            "name = 3",
            ModelError,
            "name: a value of the wrong kind; expected text in quotes, got 3",
        ),
        ("[states]", "[stats]", UnknownNameError, "did you mean 'states'"),
        ("[inputs]\nv = {value = 0.0", "[inputs]\nv = {vlue = 0.0", UnknownNameError, "did you mean 'value'"),
        ("derivative", "derivatve", UnknownNameError, "did you mean 'derivative'"),
        ('derivative = "(torque - friction) / J", ', "", ModelError, "states.w: 'derivative' is missing"),
        (
            "k = {value = 0.5}",
            "k = 0.5",
            ModelError,
            "parameters.k: a value of the wrong kind; expected a table: {value = ...}, got 0.5",
        ),
        (
            "k = {value = 0.5}",
            'k = {value = "0.5"}',
            ModelError,
            'parameters.k.value: a value of the wrong kind; expected a number, got "',
        ),
        ("k = {value = 0.5}", "k = {value = [0.5]}", ModelError, "expected a number, got [0.5]"),
        ("k = {value = 0.5}", "k = {value = true}", ModelError, "expected a number, got true"),
        ("k = {value = 0.5}", "k = {value = 1979-05-27}", ModelError, "of the wrong kind"),
        ("k = {value = 0.5}", "k = {value = nan}", ModelError, "not a number"),
        ("k = {value = 0.5}", "k = {value = 0.5, min = 1}", ModelError, "outside its own bounds"),
        ("k = {value = 0.5}", "k = {value = 1" + "0" * 400 + "}", ModelError, "too large"),
        ("k = {value = 0.5}", "k = {value = 1" + "0" * 5000 + "}", ModelError, "not valid TOML"),
        ('torque = "k*i"', "torque = [1]", ModelError, "signals.torque: a value of the wrong kind"),
        ('torque = "k*i"', 'torque = "k*j"', UnknownNameError, "signal 'torque': no variable 'j'"),
        ('torque = "k*i"', 'torque = "k*"', ExpressionError, "signal 'torque': unexpected the end"),
        ('torque = "k*i"', 'torque = "__import__(a)"', ExpressionError, "no function '__import__'"),
        ('torque = "k*i"', "torque = k*i", ModelError, "not valid TOML"),
        ('torque = "k*i"', 'torque = "k*i"\ntorque = "1"', ModelError, "not valid TOML"),
        ('i = "(v - k*w) / R"', 'i = "torque"', ModelError, "circle"),
        ("[inputs]\nv =", "[inputs.v]\nx =", InputError, "inputs.v: unknown key 'x'"),
        ("schema = 1", "inputs = 3\nschema = 1", ModelError, "not valid TOML"),
        ("schema = 1", "schema = 1\nsampled = 3", ModelError, "sampled: a value of the wrong kind; expected a table"),
        ("schema = 1", "schema = 1\nsampled = " + "[" * 3000, ModelError, "not valid TOML"),
    ],
)
def test_a_wrong_card_is_told_with_its_place(old: str, new: str, kind: type[InputError], words: str) -> None:
    assert old in MOTOR
    with pytest.raises(kind) as caught:
        parse_card(MOTOR.replace(old, new, 1), "cards/motor.toml")
    assert words in str(caught.value)
    assert str(caught.value).startswith("cards/motor.toml: ")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\x00", "not UTF-8"),
        (b"\x00\x01\x02", "not valid TOML"),
        (b"", "schema"),
        (b"#" * 5_000_001, "too large"),
        (b"[[[", "not valid TOML"),
    ],
)
def test_a_file_that_is_no_card_is_told_in_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "m.toml"
    path.write_bytes(content)
    with pytest.raises(ModelError) as caught:
        read_card(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_are_told_in_one_line(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path, "with\0zero"):
        with pytest.raises(ModelError, match="cannot be read") as caught:
            read_card(path)
        assert "\n" not in str(caught.value)


def test_what_the_card_cannot_say_is_refused_with_its_place() -> None:
    model = Model("m", inputs={"u": 0}, outputs={"y": sp.floor(sp.Symbol("u"))})  # type: ignore[arg-type]
    with pytest.raises(ExpressionError, match="model 'm', output 'y': model cards have no word for 'floor'"):
        write_card(model)


NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,6}", fullmatch=True)
TEXTS = st.text(st.characters(exclude_categories=("Cs",)), max_size=12)
DOUBLES = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def models(draw: st.DrawFn) -> Model:
    prefixed = st.lists(NAMES, min_size=1, max_size=3, unique=True)
    p, u, x, s = ([f"{k}_{n}" for n in draw(prefixed)] for k in "puxs")
    known = [*p, *u, *x, "time"]
    forms = ("{a} + {n}*{b}", "{a}/({b} - {n})", "clip({a}, -1, {n})", "where({a} < {b}, {n}, {a})", "sqrt({a})*{n}")

    def text() -> str:
        a, b = draw(st.sampled_from(known)), draw(st.sampled_from(known))
        return draw(st.sampled_from(forms)).format(a=a, b=b, n=repr(draw(st.floats(0.001, 1e6))))

    return Model(
        draw(TEXTS.filter(lambda t: t.strip() != "")),
        parameters={n: Parameter(draw(DOUBLES), draw(TEXTS), description=draw(TEXTS)) for n in p},
        inputs={n: {"value": draw(DOUBLES), "unit": draw(TEXTS)} for n in u},
        states={n: {"derivative": text(), "start": draw(st.sampled_from([None, "free", p[0]]))} for n in x},
        signals={n: {"value": text(), "description": draw(TEXTS)} for n in s},
        algebraic={"z": {"equation": f"z/2 + {s[0]}", "start": draw(DOUBLES)}},
        outputs={f"o_{n}": draw(st.sampled_from([*x, *s, "z"])) for n in draw(prefixed)},
        delays={"d": {"of": x[0], "time": draw(st.floats(1e-6, 10))}},
        sampled={"q": {"value": s[0], "period": p[0], "compute": 0}},
        description=draw(TEXTS),
    )  # type: ignore[arg-type]


def bits(model: Model) -> list[Any]:
    """Everything in the model that equality might let pass: the order of names, and numbers by their digits."""
    return [model.name, repr(model.parameters), repr(model.inputs), list(model.states), list(model.signals)]


@settings(max_examples=60)
@given(models())
def test_any_model_comes_back_to_the_last_bit(model: Model) -> None:
    again = parse_card(write_card(model))
    assert again == model
    assert bits(again) == bits(model)
