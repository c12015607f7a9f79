"""Norms, nu-gap, minimal realisation and reduction."""

from dataclasses import replace

import control
import numpy as np
import pytest

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize import (
    balanced,
    compare,
    find_operating_point,
    h2_norm,
    hinf_norm,
    linearize,
    linf_norm,
    ncf_margin,
    nu_gap,
)
from hvdc_ident.linearize.realisation import difference
from hvdc_ident.linearize.reduction import minimal
from hvdc_ident.model import Model
from hvdc_ident.models import load_model
from tests.linearize.helpers import linear, stable


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


def winding_from_eigenvalues(first, second):
    """Return the count that must be 0 for the nu-gap, of minimal models: zeros less poles of det(1 + P2~ P1) from eigenvalues."""

    def right(a):
        return int((np.linalg.eigvals(a).real > 1e-9).sum())

    at, bt, ct, dt = -second.A.T, -second.C.T, second.B.T, second.D.T
    a = np.block([[first.A, np.zeros((len(first.A), len(at)))], [bt @ first.C, at]])
    b, c = np.concatenate([first.B, bt @ first.D]), np.concatenate([dt @ first.C, ct], axis=1)
    closed = a - b @ np.linalg.solve(np.eye(first.B.shape[1]) + dt @ first.D, c)
    axis = int((np.abs(np.linalg.eigvals(second.A).real) <= 1e-9).sum())
    return right(closed) - right(first.A) - right(at) + right(first.A) - right(second.A) - axis


@pytest.mark.parametrize("spread", [0.0, 4.0, 8.0])
def test_the_winding_is_that_of_eigenvalues(spread):
    """60 random pairs a spread, with unstable poles, in states of units up to 10^spread apart; half wind."""
    rng = np.random.default_rng(int(spread))
    winds = 0
    for _ in range(60):
        pair = []
        m = int(rng.integers(1, 4))
        for _ in range(2):
            n = int(rng.integers(1, 12))
            a = rng.normal(size=(n, n)) - rng.uniform(-0.5, 2.0) * np.sqrt(n) * np.eye(n)
            unit = 10 ** rng.uniform(-spread / 2, spread / 2, n)
            b, c, d = rng.normal(size=(n, m)), rng.normal(size=(m, n)), rng.normal(size=(m, m))
            pair.append(linear(a * unit[:, None] / unit, b * unit[:, None], c / unit, d))
        count = winding_from_eigenvalues(*pair)
        assert nu_gap(*pair).winding == count
        winds += count != 0
    assert 20 < winds < 55


@pytest.mark.parametrize("pole", [-1.0, 0.0, 0.5])
@pytest.mark.parametrize(("gain", "time"), [(1.0, 0.1), (1.0, 2.0), (5.0, 0.1), (5.0, 0.7), (5.0, 1.0)])
def test_the_winding_of_a_delay_is_that_of_a_good_approximant(pole, gain, time):
    """The approximant of order 10 is right up to w T = 10, where these gains are below 1; its winding comes from eigenvalues."""
    plain, late = late_lag(pole, gain, 0.0), late_lag(pole, gain, time)
    rational = replace(linearize(late.point.model, late.point, inputs="u", outputs="y", pade_order=10), exact=None)
    assert nu_gap(plain, late).winding == winding_from_eigenvalues(plain, rational)
    assert nu_gap(late, plain).winding == winding_from_eigenvalues(rational, plain)


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
    for first, second in (
        (plain, seen),
        (seen, plain),
        (seen, growing),
        (growing, seen),
        (damped, growing),
        (damped, seen),
    ):
        found = nu_gap(first, second)
        assert found.winding == 0 and found.value < 0.03


def test_a_resonance_too_narrow_for_any_step_winds():
    """-r s/(s^2 + 2 z s + 0.01) beside a late lag, 1e-5 of its frequency wide and 50 high: from eigenvalues it winds once each way."""
    plant = Model(
        name="narrow", parameters={"r": 1e-4, "z": 1e-6, "T": {"value": 0.1, "unit": "s"}}, inputs={"u": 0.0},
        states={"x": "u - x", "a": "b", "b": "u - 0.01*a - 2*z*b"}, delays={"late": {"of": "x", "time": "T"}},
        outputs={"y": "late - r*b"},
    )  # fmt: skip
    narrow, plain = linearize(plant), linearize(plant.with_values({"r": 0.0}))
    rational = [replace(m, exact=None) for m in (narrow, plain)]
    assert nu_gap(narrow, plain).winding == winding_from_eigenvalues(*rational) == -nu_gap(plain, narrow).winding != 0


def hidden_growth(time, mixed):
    """Return k e^(-s T)/(s + 1) in feedback round its delay, and beside it a growing state that no input drives and no output sees.

    mixed: in states 2 x + h and x + h, which the equations drive and see, so that their structure does not show it.
    """
    states = {"a": "2*f + 0.3*g", "b": "f + 0.3*g"} if mixed else {"x": "f"}
    signals = {"x_": "a - b", "g": "2*b - a"} if mixed else {"x_": "x"}
    return Model(
        name="late", parameters={"T": {"value": time, "unit": "s"}}, inputs={"u": 0.0}, states=states,
        signals={**signals, "f": "late - x_"}, delays={"late": {"of": "u - 0.4*x_", "time": "T"}}, outputs={"y": "x_"},
    )  # fmt: skip


def test_a_growing_mode_hidden_by_its_numbers_does_not_count_in_the_nu_gap():
    whole, plain = (linearize(hidden_growth(0.3, mixed)) for mixed in (True, False))
    assert whole.stability().verdict == "unstable" and plain.stability().verdict == "stable"
    other = linearize(hidden_growth(0.5, False))
    for first, second in ((whole, other), (other, whole)):
        found = nu_gap(first, second)
        expected = nu_gap(*(plain if m is whole else m for m in (first, second)))
        assert found.winding == expected.winding == 0
        assert found.value == pytest.approx(expected.value, rel=1e-6)
    assert hinf_norm(whole).value == pytest.approx(hinf_norm(plain).value, rel=1e-9)


def test_the_difference_of_models_with_delays_is_exact():
    """|e^(-jwT) - 1| |k/(jw - p)| on a fine grid: an approximant of order 5 leaves it beyond w T = 6."""
    plain, late = late_lag(-50.0, 50.0, 0.0), late_lag(-50.0, 50.0, 0.5)
    w = np.linspace(1e-3, 200.0, 400_001)
    largest = (np.abs(np.exp(-0.5j * w) - 1.0) * np.abs(50.0 / (1j * w + 50.0))).max()
    assert linf_norm(difference(plain, late)).value == pytest.approx(largest, rel=1e-6)
    assert compare(plain, late).difference.value == pytest.approx(largest, rel=1e-6)


def test_an_attainable_margin_that_cannot_be_computed_is_refused():
    """Two channels of the average-value model, 1e6 apart in size: no number is a margin there."""
    found = linearize(load_model("vsc-hvdc-avm"))
    part = found.channel(found.input_names[:2], found.output_names[:2])
    with pytest.raises(LinearizationError, match="coprime factors") as told:
        ncf_margin(part)
    assert "scale" in told.value.hint
    assert compare(part, part).attainable is None and "coprime factors" in compare(part, part).notes[0]


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


@pytest.mark.parametrize("through", [0.3, 2.0, -5.0])
def test_the_attainable_margin_of_a_plant_is_that_of_its_inverse(through):
    """The graphs of P and 1/P are one, inputs and outputs exchanged."""
    plant = linear([[-1.0]], [[1.0]], [[3.0]], [[through]])  # P = through + 3/(s + 1)
    inverse = linear([[-1.0 - 3.0 / through]], [[1.0 / through]], [[-3.0 / through]], [[1.0 / through]])
    np.testing.assert_allclose(plant.response([2.0]) * inverse.response([2.0]), 1.0)
    assert ncf_margin(plant).value == pytest.approx(ncf_margin(inverse).value, rel=1e-9)
    assert 0.0 < ncf_margin(plant).value < 1.0
