"""Norms, nu-gap, minimal realisation and reduction."""

from dataclasses import replace

import control
import numpy as np
import pytest
from helpers import linear, stable

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize import balanced, find_operating_point, h2_norm, hinf_norm, linearize, nu_gap
from hvdc_ident.linearize.reduction import difference, minimal
from hvdc_ident.model import Model
from hvdc_ident.models import load_model


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("through", [False, True])
def test_h_infinity_is_the_peak_of_a_fine_grid(seed, through):
    model = stable(seed, n=6, through=through)
    found = hinf_norm(model)
    w = np.concatenate([[0.0], np.logspace(-4, 4, 40_001)])
    grid = np.linalg.svd(model.response(w), compute_uv=False)[:, 0].max()
    top = np.linalg.norm(model.D, 2)
    assert found.value >= max(grid, top) * (1 - 1e-12)
    assert found.value <= max(grid, top) * (1 + 1e-5)


def test_norms_against_python_control():
    model = stable(3)
    assert h2_norm(model) == pytest.approx(control.norm(model.to_control(), 2), rel=1e-9)


def test_norms_that_do_not_exist():
    unstable = linear([[1.0]], [[1.0]], [[1.0]])
    for norm in (hinf_norm, h2_norm):
        with pytest.raises(LinearizationError):
            norm(unstable)
    with pytest.raises(LinearizationError, match="D is not 0"):
        h2_norm(linear([[-1.0]], [[1.0]], [[1.0]], [[1.0]]))


def test_difference_of_a_model_with_itself():
    model = stable(1)
    assert hinf_norm(difference(model, model)).value < 1e-10
    with pytest.raises(LinearizationError, match="other inputs"):
        difference(model, stable(1, m=1))


@pytest.mark.parametrize("seed", range(4))
def test_nu_gap_is_a_metric_here(seed):
    a, b = stable(seed), stable(seed + 100)
    c = linear(a.A + 0.01, a.B, a.C)
    ab, ba = nu_gap(a, b), nu_gap(b, a)
    assert nu_gap(a, a).value < 1e-9
    assert ab.value == pytest.approx(ba.value, abs=1e-6)
    assert nu_gap(a, c).value <= ab.value + nu_gap(b, c).value + 1e-9
    assert 0 <= ab.value <= 1


def test_the_winding_condition_counts():
    """Two plants of opposite sign: no controller of high gain suits both, and the winding says so."""
    stable_one = linear([[-0.5]], [[1.0]], [[1.0]])
    flipped = linear([[-0.5]], [[1.0]], [[-1.0]])
    found = nu_gap(linear([[-0.5]], [[100.0]], [[1.0]]), linear([[-0.5]], [[100.0]], [[-1.0]]))
    assert found.winding != 0 and found.value == 1.0
    assert nu_gap(stable_one, flipped).distance <= 1.0


def late_lag(pole, gain, time):
    """Return gain e^(-s time)/(s - pole)."""
    lag = Model(
        name="lag", parameters={"p": pole, "k": gain}, inputs={"u": 0.0}, states={"x": "k*u + p*x"}, outputs={"y": "x"}
    )
    late = apply_effects(lag, [{"effect": "delay", "at": ["y"], "parameters": {"T": time}}]) if time else lag
    return linearize(late, find_operating_point(late), inputs="u", outputs="y")


@pytest.mark.parametrize(("gain", "time"), [(5.0, 0.1), (5.0, 1.0), (5.0, 3.0), (50.0, 0.1), (50.0, 3.0)])
@pytest.mark.parametrize("pole", [-1.0, 0.5])
def test_the_winding_of_a_delay_is_that_of_its_exact_response(pole, gain, time):
    """For gain/(s - p) without and with a delay f = 1 + |P|^2 e^(j w T): up to 48 turns, of which a Pade approximant has its order."""
    w = np.linspace(0.0, 1e4, 200_001)
    f = 1.0 + gain**2 / (w**2 + pole**2) * np.exp(1j * w * time)
    turns = np.unwrap(np.angle(f))
    plain, late = late_lag(pole, gain, 0.0), late_lag(pole, gain, time)
    found = nu_gap(late, plain)
    assert found.winding == round((turns[-1] - turns[0]) / np.pi) == -nu_gap(plain, late).winding
    assert found.value == (1.0 if found.winding else found.distance)


@pytest.mark.parametrize("pole", [-1.0, 0.0, 0.5])
@pytest.mark.parametrize(("gain", "time"), [(1.0, 0.1), (1.0, 2.0), (5.0, 0.1), (5.0, 0.7), (5.0, 1.0)])
def test_the_winding_of_a_delay_is_that_of_a_good_approximant(pole, gain, time):
    """The approximant of order 10 is right up to w T = 10, where these gains are below 1; its winding comes from eigenvalues."""
    plain, late = late_lag(pole, gain, 0.0), late_lag(pole, gain, time)
    rational = replace(linearize(late.point.model, late.point, inputs="u", outputs="y", pade_order=10), exact=None)
    assert nu_gap(plain, late).winding == nu_gap(plain, rational).winding
    assert nu_gap(late, plain).winding == nu_gap(rational, plain).winding


def test_poles_on_the_axis_of_a_model_with_a_delay_are_passed_on_their_right():
    """An undamped oscillator seen late is near itself without the delay, and one that grows a little is as near."""
    oscillator = Model(
        name="oscillator", parameters={"d": 0.0}, inputs={"u": 0.0},
        states={"x": "v", "v": {"derivative": "u - 4*x - d*v"}}, outputs={"y": "v"},
    )  # fmt: skip
    late = apply_effects(oscillator, [{"effect": "delay", "at": ["y"], "parameters": {"T": 0.01}}])
    shown = {"inputs": "u", "outputs": "y"}
    plain, seen = linearize(oscillator, **shown), linearize(late, **shown)
    growing = linearize(late.with_values({"d": -0.01}), **shown)
    damped = linearize(late.with_values({"d": 0.01}), **shown)
    for first, second in ((plain, seen), (seen, plain), (seen, growing), (growing, seen), (damped, growing), (damped, seen)):
        found = nu_gap(first, second)
        assert found.winding == 0 and found.value < 0.03


def test_a_winding_without_a_limit_is_refused():
    """u itself, late, beside u: the determinant turns for ever."""
    echo = Model(
        name="echo", parameters={"T": {"value": 0.1, "unit": "s"}}, inputs={"u": 0.0}, states={"x": "u - x"},
        delays={"late": {"of": "u", "time": "T"}}, outputs={"y": "2*u + late + x"},
    )  # fmt: skip
    found = linearize(echo)
    with pytest.raises(LinearizationError, match="no limit at high frequency"):
        nu_gap(found, linear([[-1.0]], [[1.0]], [[1.0]], [[1.0]]))


def test_minimal_realisation_lists_what_it_removed():
    a = np.diag([-1.0, -2.0, -3.0])
    found = minimal(linear(a, [[1], [0], [1]], [[1, 1, 0]]))
    assert len(found.model.state_names) == 1
    assert sorted(v.real for v in found.removed) == pytest.approx([-3.0, -2.0])
    np.testing.assert_allclose(found.model.poles(), [-1.0])
    with pytest.raises(LinearizationError, match="not stable"):
        minimal(linear(np.diag([-1.0, 2.0]), [[1], [0]], [[1, 1]]))


def test_minimal_link_channel_keeps_its_response():
    whole = linearize(load_model("vsc-hvdc-link"), inputs=["Vdcref1"], outputs=["Vdc1"])
    found = minimal(whole)
    assert len(found.model.state_names) == 3 and len(found.removed) == 3
    w = np.logspace(-1, 4, 20)
    np.testing.assert_allclose(found.model.response(w), whole.response(w), rtol=1e-9)


@pytest.mark.parametrize("order", range(1, 6))
def test_balanced_reduction_keeps_its_bound(order):
    model = stable(7, n=6)
    found = balanced(model, order)
    error = hinf_norm(difference(model, found.model)).value
    assert error <= found.bound * (1 + 1e-9)
    assert error >= found.hankel[order] * (1 - 1e-9)
    assert len(found.model.state_names) == order


def test_balanced_reduction_to_a_bound_and_its_refusals():
    model = stable(7, n=6)
    found = balanced(model, bound=0.2)
    assert found.bound <= 0.2
    assert balanced(linear([[1.0]], [[1.0]], [[1.0]]), 1).kept == 1
    with pytest.raises(LinearizationError, match="out of range"):
        balanced(model, 9)
    with pytest.raises(LinearizationError, match="neither"):
        balanced(model)
