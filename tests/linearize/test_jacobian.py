"""The linear model's matrices and their derivatives, against independent ways to the same numbers."""

import numpy as np
import pytest
import sympy as sp

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import LinearizationError, UnknownNameError
from hvdc_ident.expression import parse, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import find_operating_point, jacobian_error, linearize, one_sided, point_at
from hvdc_ident.linearize.system import system
from hvdc_ident.model import Algebraic, Model, Output, Signal, State
from hvdc_ident.models import load_model, shipped_models
from hvdc_ident.parameters import Input, Parameter
from tests.effort import calls

DELAYED = [
    {"effect": "delay", "at": "Ir1", "parameters": {"T": 0.002}},
    {"effect": "sample-hold", "at": "P2_m", "parameters": {"Ts": 0.001, "compute": 0.0005}},
]


@pytest.mark.parametrize("name", shipped_models())
def test_exact_against_complex_step_on_every_shipped_model(name):
    model = load_model(name)
    point = find_operating_point(model)
    assert point.residual < 1e-12
    assert jacobian_error(model, point) < 1e-12
    found = linearize(model, point)
    assert found.A.shape == (len(found.state_names),) * 2 and np.isfinite(found.A).all()
    assert found.poles().real.max() < 1e-6


@pytest.mark.parametrize("name", shipped_models())
def test_exact_against_complex_step_away_from_rest(name):
    """At twenty random points near rest, switches as they fall."""
    model = load_model(name)
    point = find_operating_point(model)
    s = system(model)
    rng = np.random.default_rng(3)
    for _ in range(20):
        y = point.y * (1 + 0.02 * rng.normal(size=point.y.size)) + 1e-3 * rng.normal(size=point.y.size)
        w = point.w.copy()
        w[1:] *= 1 + 0.02 * rng.normal(size=w.size - 1)
        exact = s.jacobian(y, w, point.p, s.modes(y, w, point.p))[: s.layout.main]
        other = s.complex_step(y, w, point.p)
        scale = np.maximum(np.abs(exact).max(axis=1), 1e-9)
        assert (np.abs(exact - other) / scale[:, None]).max() < 1e-12


def test_complex_step_agrees_with_sympy_in_forty_digits():
    """The check itself is checked: sympy's own derivatives of the link's equations, evaluated by mpmath."""
    model = load_model("vsc-hvdc-link")
    point = find_operating_point(model, {"Pref2": 0.55, "Qref1": 0.1})
    s = system(model)
    jac = s.jacobian(point.y, point.w, point.p, s.modes(point.y, point.w, point.p))
    definitions = {symbol(n): x.value for n, x in model.signals.items()}
    definitions |= {symbol(n): model.algebraic[n].equation for n in model.algebraic if n not in s.unknowns}
    values = {symbol(n): sp.Float(v, 40) for n, v in (*point.states.items(), *point.unknowns.items())}
    values |= {symbol(n): sp.Float(v, 40) for n, v in (*point.inputs.items(), *point.parameters.items())}
    rows = [x.derivative for x in model.states.values()] + [model.algebraic[n].equation - symbol(n) for n in s.unknowns]
    for i, row in enumerate(rows):
        flat = row
        for _ in range(30):
            flat = flat.xreplace(definitions)
        flat = flat.replace(lambda e: e.func.__name__ == "clip", lambda e: _inside(e, values))
        flat = flat.replace(lambda e: isinstance(e, (sp.Min, sp.Max)), lambda e: _chosen(e, values))
        for j, n in enumerate((*s.states, *s.unknowns)):
            want = float(sp.diff(flat, symbol(n)).evalf(40, subs=values))
            assert jac[i, j] == pytest.approx(want, rel=1e-13, abs=1e-13 * np.abs(jac[i]).max())


def _inside(e, values):
    x, low, high = (float(a.evalf(30, subs=values)) for a in e.args)
    return e.args[0] if low <= x <= high else e.args[1] if x < low else e.args[2]


def _chosen(e, values):
    return (min if isinstance(e, sp.Min) else max)(e.args, key=lambda a: float(a.evalf(30, subs=values)))


@pytest.mark.parametrize("effects", [[], DELAYED], ids=["plain", "delayed"])
def test_total_derivatives_by_parameters(effects):
    """dA/dp ... with the shift of the operating point, against differences of whole linearisations."""
    model = apply_effects(load_model("vsc-hvdc-link"), effects).with_values({"Qref1": 0.1, "KPP": 0.5})
    names = [n for n in model.parameters if model.parameters[n].value > 0]
    found = linearize(model, sensitivities=names)

    def matrices(name, value):
        x = linearize(model.with_values({name: value}))
        return {k: getattr(x, k) for k in "ABCD"}

    for name in names:
        value = model.parameters[name].value
        h = 2e-4 * value
        # Richardson's combination of two central differences: the error falls with the fourth power of h.
        steps = {k: matrices(name, value + k * h) for k in (-2, -1, 1, 2)}
        for key in "ABCD":
            one, two = ((steps[k][key] - steps[-k][key]) / (2 * k * h) for k in (1, 2))
            want = (4 * one - two) / 3
            got = getattr(found.gradients[name], key)
            size = np.abs(getattr(found, key)).max() / value
            assert np.abs(got - want).max() < 1e-9 * size + 1e-7 * np.abs(want).max(), (name, key)


def test_linearising_again_is_arithmetic():
    """Nothing is derived or compiled again: what is left is numbers (under 2 ms for the link, `benchmarks/linearize.py`)."""
    model = load_model("vsc-hvdc-link")
    point = find_operating_point(model)
    linearize(model, point)
    assert calls(lambda: linearize(model, point)) < 2000


def circle(gain):
    return Model(
        name="circle",
        parameters=FrozenMap({"k": Parameter(gain)}),
        inputs=FrozenMap({"u": Input(1.0)}),
        states=FrozenMap({"x": State(parse("z - 2*x"))}),
        algebraic=FrozenMap({"z": Algebraic(parse("k*z + u - x"), unit="A")}),
        outputs=FrozenMap({"z": Output(parse("z"))}),
    )


def test_unknowns_are_eliminated_and_may_stay():
    model = circle(0.5)
    found = linearize(model)
    np.testing.assert_allclose(found.A, [[-4.0]])
    np.testing.assert_allclose(found.B, [[2.0]])
    kept = linearize(model, descriptor=True)
    assert kept.is_descriptor and kept.state_names == ("x", "z") and kept.state_units == ("", "A")
    np.testing.assert_allclose(kept.poles(), [-4.0])
    np.testing.assert_allclose(kept.standard()[0], found.A)
    np.testing.assert_allclose(kept.response([0.7]), found.response([0.7]), rtol=1e-13)
    assert found.provenance["algebraic part"] == "eliminated"


def test_an_ill_conditioned_algebraic_part_stays():
    """k = 1: g does not depend on z, the index is two: a descriptor without a standard form, and the error says so."""
    model = circle(1.0)
    found = linearize(model, point_at(circle(1.0), {"x": 1.0}))
    assert found.is_descriptor
    with pytest.raises(LinearizationError, match="cannot be eliminated"):
        found.standard()


def limiter():
    return Model(
        name="limited",
        inputs=FrozenMap({"u": Input(1.0)}),
        states=FrozenMap({"x": State(parse("y - x"), guess=0.0)}),
        signals=FrozenMap({"y": Signal(parse("clip(u, -1, 1)"))}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )


def test_a_kink_is_refused_with_the_limiter_named():
    model = limiter()
    with pytest.raises(LinearizationError, match=r"'y' is just at its limit.*one_sided"):
        linearize(model)
    below, above = one_sided(model, find_operating_point(model))
    np.testing.assert_array_equal(below.B, [[1.0]])
    np.testing.assert_array_equal(above.B, [[0.0]])
    low = find_operating_point(model, {"u": -1.0})
    below, above = one_sided(model, low)
    np.testing.assert_array_equal(below.B, [[0.0]])
    np.testing.assert_array_equal(above.B, [[1.0]])


@pytest.mark.parametrize("limit", ["1", "high"])
@pytest.mark.parametrize(("text", "slopes"), [("min", (1.0, 0.0)), ("max", (0.0, 1.0))])
def test_below_a_limit_is_where_the_signal_is_below_it(text, slopes, limit):
    for expression in (f"{text}(u, {limit})", f"{text}({limit}, u)"):
        model = Model(
            "m", parameters={"high": 1.0}, inputs={"u": 1.0}, states={"x": f"{expression} - x"}, outputs={"y": "x"}
        )
        below, above = one_sided(model, find_operating_point(model))
        assert (below.B[0, 0], above.B[0, 0]) == slopes


def test_a_condition_of_parameters_is_no_kink():
    """An option stands exactly on the number it is compared with; it does not move with the states."""
    option = Model(
        name="option",
        parameters=FrozenMap({"code": Parameter(1.0)}),
        inputs=FrozenMap({"u": Input(1.0)}),
        states=FrozenMap({"x": State(parse("where(code == 1, u, 2*u) - x"), guess=0.0)}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )
    np.testing.assert_array_equal(linearize(option).B, [[1.0]])
    np.testing.assert_array_equal(linearize(option.with_values({"code": 2.0})).B, [[2.0]])


def test_a_condition_on_parameters_alone_is_no_kink():
    model = Model(
        name="flag",
        parameters=FrozenMap({"band": Parameter(0.0)}),
        inputs=FrozenMap({"u": Input(0.0)}),
        states=FrozenMap({"x": State(parse("where(band > 0, deadband(u, band), 2*u) - x"), guess=0.0)}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )
    np.testing.assert_array_equal(linearize(model).B, [[2.0]])
    np.testing.assert_array_equal(linearize(model.with_values({"band": 0.1})).B, [[0.0]])
    with pytest.raises(LinearizationError, match="kink"):  # the edge of the band itself is one
        linearize(model.with_values({"band": 0.1, "u": 0.1}))


def test_unknown_names_are_refused():
    model = load_model("vsc-hvdc-link")
    with pytest.raises(UnknownNameError, match="Vdcref1"):
        linearize(model, inputs=["Vdcref"])
    with pytest.raises(UnknownNameError):
        linearize(model, outputs=["nothing"])
    with pytest.raises(UnknownNameError, match="KPVDC"):
        linearize(model, sensitivities=["KPVD"])


def test_outputs_may_be_signals():
    model = load_model("vsc-hvdc-link")
    found = linearize(model, inputs=["Vdcref1"], outputs=["ev", "yv"])
    assert found.output_names == ("ev", "yv") and found.output_units == ("pu", "pu")
    np.testing.assert_allclose(found.response([0.0])[0, 0, 0].real, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "why"), [("x**0.3 - x", "not finite"), ("sqrt(x**2 + u**2) - x", "slope is infinite")]
)
def test_a_root_without_slope_is_refused(text, why):
    model = Model(
        name="root",
        inputs=FrozenMap({"u": Input(0.0)}),
        states=FrozenMap({"x": State(parse(text))}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )
    with pytest.raises(LinearizationError, match=why):
        linearize(model, point_at(model, {"x": 0.0}))


def test_a_root_that_is_cut_at_zero_has_the_slope_zero():
    model = Model(
        name="cut",
        inputs=FrozenMap({"u": Input(2.0)}),
        states=FrozenMap({"x": State(parse("sqrt(max(0, 1 - u)) - x"), guess=0.0)}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )
    np.testing.assert_array_equal(linearize(model).B, [[0.0]])
