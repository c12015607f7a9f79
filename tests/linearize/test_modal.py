"""Modes, their derivatives, and loci."""

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import LinearizationError, SteadyStateError, UnknownNameError
from hvdc_ident.expression import parse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import find_operating_point, linearize, root_locus
from hvdc_ident.linearize.linear_model import gradient_of
from hvdc_ident.linearize.root_loci import match
from hvdc_ident.model import Model, Output, State
from hvdc_ident.models import load_model
from hvdc_ident.parameters import Input, Parameter
from tests.effort import calls
from tests.linearize.helpers import linear, stable


@pytest.fixture(scope="module")
def link():
    return load_model("vsc-hvdc-link")


def test_modes_of_an_oscillator():
    wn, zeta = 50.0, 0.1
    modes = linear([[0, 1], [-(wn**2), -2 * zeta * wn]], [[0], [1]], [[1, 0]]).modes()
    assert modes[0].eigenvalue == pytest.approx(-zeta * wn + 1j * wn * np.sqrt(1 - zeta**2))
    assert modes[0].damping == pytest.approx(zeta)
    assert modes[0].frequency_hz == pytest.approx(wn * np.sqrt(1 - zeta**2) / 2 / np.pi)
    assert modes[0].kind == "oscillation"
    assert sum(modes[0].participation.values()) == pytest.approx(1.0)
    assert modes[1].eigenvalue == modes[0].eigenvalue.conjugate()


@pytest.mark.parametrize("rate", [-2e-3, 2e-3])
def test_a_slow_pole_beside_a_fast_one_is_no_integrator(rate):
    """A boiler beside a snubber: nine decades apart, both are told as they are."""
    model = linear(np.diag([rate, -1e6]), np.ones((2, 1)), np.ones((1, 2)))
    slow = next(m for m in model.modes() if m.dominant == "x0")
    assert (slow.kind, slow.damping) == (("decay", 1.0) if rate < 0 else ("growth", -1.0))
    assert model.stability().verdict == ("stable" if rate < 0 else "unstable")
    assert model.bode().omega[0] < abs(rate)


@pytest.mark.parametrize("seed", range(20))
def test_machines_without_a_reference_rest_at_0(seed):
    """Undamped machines tied to one another alone: angle and speed of all, whose computed eigenvalues are 1e-7 off 0."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 12))
    ties = rng.uniform(0.2, 2.0, (n, n))
    ties = np.triu(ties, 1) + np.triu(ties, 1).T
    inertia = rng.uniform(2.0, 8.0, n)
    a = np.zeros((2 * n, 2 * n))
    a[0::2, 1::2] = 2 * np.pi * 50.0 * np.eye(n)
    a[1::2, 0::2] = -(np.diag(ties.sum(axis=1)) - ties) / (2.0 * inertia[:, None])
    model = linear(a, np.eye(2 * n)[:, [1]], np.eye(2 * n)[[0]])
    assert model.stability().verdict == "on the limit of stability"
    assert [m.eigenvalue for m in model.modes()].count(0) == 2
    assert all(m.kind == "oscillation" or m.eigenvalue == 0 or abs(m.damping) < 1e-9 for m in model.modes())
    # Derivatives by differences are off by more than rounding: the model knows by how much.
    noisy = linear(a * (1.0 + 1e-8 * rng.uniform(-1.0, 1.0, a.shape)), np.eye(2 * n)[:, [1]], np.eye(2 * n)[[0]])
    assert replace(noisy, error=1e-8).stability().verdict == "on the limit of stability"
    damped = a - 0.02 * np.kron(np.eye(n), np.diag([0.0, 1.0]))
    verdict = linear(damped, np.eye(2 * n)[:, [1]], np.eye(2 * n)[[0]])
    assert [m.eigenvalue for m in verdict.modes()].count(0) == 1 and verdict.stability().unstable == 0


@pytest.mark.parametrize("seed", range(5))
def test_shapes_are_eigenvectors_and_participations_sum_to_one(seed):
    model = stable(seed)
    for mode in model.modes():
        v = np.array([*mode.shape.values()])
        np.testing.assert_allclose(model.A @ v, mode.eigenvalue * v, atol=1e-12)
        assert max(abs(v)) == pytest.approx(1.0)
        assert sum(mode.participation.values()) == pytest.approx(1.0)


def test_eigenvalue_derivatives_against_differences(link):
    names = ["KPVDC", "KIVDC", "C1", "C2", "Rdc", "Zg"]
    found = linearize(link, sensitivities=names)
    want = {}
    for name in names:
        h = 1e-4 * link.parameters[name].value
        up, down = (linearize(link.with_values({name: link.parameters[name].value + s * h})).poles() for s in (1, -1))
        want[name] = (up, down, h)
    for mode in found.modes():
        if abs(mode.eigenvalue + 30) < 1e-6:
            continue  # three equal eigenvalues: no gain here moves them
        for name, (up, down, h) in want.items():
            a, b = (v[np.argmin(abs(v - mode.eigenvalue))] for v in (up, down))
            assert mode.sensitivity[name] == pytest.approx((a - b) / (2 * h), rel=2e-6, abs=1e-9 / h)


def test_equal_eigenvalues_have_the_block_s_derivatives(link):
    found = linearize(link, sensitivities=["KIP", "KIQ"])
    three = [m for m in found.modes() if abs(m.eigenvalue + 30) < 1e-6]
    assert len(three) == 3
    for name in ("KIP", "KIQ"):
        assert sorted(m.sensitivity[name].real for m in three) == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)


def test_zero_eigenvalues_are_classified():
    assert linear([[0.0]], [[1.0]], [[1.0]]).modes()[0].kind == "free integrator"
    hidden = linear([[-1, 0], [0, 0]], [[1], [0]], [[1, 0]]).modes()
    assert [m.kind for m in hidden] == ["hidden integrator", "decay"]
    angle = linear([[-1, 0], [1, 0]], [[1], [0]], [[1, 0]]).modes()
    assert angle[0].kind == "angle reference or unobserved integrator"
    assert angle[0].damping == 0.0
    link = apply_effects(
        load_model("vsc-hvdc-link"), [{"effect": "window-mean", "at": "P2_m", "parameters": {"T": 0.02}}]
    )
    zero = [m for m in linearize(link).modes() if abs(m.eigenvalue) < 1e-6]
    assert [m.kind for m in zero] == ["sliding mean (cancelled by its delay)"]


def test_growth_is_said():
    assert linear([[1.0]], [[1.0]], [[1.0]]).modes()[0].kind == "growth"
    assert linear([[0.1, 1], [-1, 0.1]], [[1], [0]], [[1, 0]]).modes()[0].kind == "growing oscillation"


def test_a_derivative_that_was_not_asked_for(link):
    with pytest.raises(LinearizationError, match=r"sensitivities=\['KIVDC'\]"):
        gradient_of(linearize(link), "KIVDC")
    with pytest.raises(UnknownNameError):
        gradient_of(linearize(link), "nothing")


# --- loci ---


def test_locus_of_the_link(link):
    values = np.linspace(250, 1500, 500)
    root_locus(link, "KIVDC", values[:2])
    assert calls(lambda: root_locus(link, "KIVDC", values)) < 2000 * len(values)  # 0.4 s, `benchmarks/linearize.py`
    found = root_locus(link, "KIVDC", values)
    assert found.eigenvalues.shape == (500, 6) and found.stable.all() and found.limits == ()
    for k in (0, 250, 499):
        own = linearize(link.with_values({"KIVDC": values[k]})).poles()
        np.testing.assert_allclose(np.sort_complex(found.eigenvalues[k]), np.sort_complex(own), rtol=1e-8, atol=1e-6)
    # Followed, not sorted: no column jumps.
    assert np.abs(np.diff(found.eigenvalues, axis=0)).max() < 3.0


def oscillator():
    """Damping 1 - k/10 at the rest x = 0: stability is lost at k = 10, with 7 rad/s."""
    return Model(
        name="oscillator", parameters=FrozenMap({"k": Parameter(1.0)}), inputs=FrozenMap({"u": Input(0.0)}),
        states=FrozenMap({"x": State(parse("v"), guess=0.0), "v": State(parse("u - 49*x - (1 - k/10)*v"), guess=0.0)}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )  # fmt: skip


def test_the_stability_limit_is_located():
    found = root_locus(oscillator(), "k", np.linspace(1, 15, 9))
    (limit,) = found.limits
    assert limit.value == pytest.approx(10.0, abs=1e-9)
    assert limit.eigenvalue == pytest.approx(7j, abs=1e-8)
    assert limit.direction == "lost"
    assert root_locus(oscillator(), "k", [15.0, 1.0]).limits[0].direction == "won"


def test_modes_that_pass_each_other_keep_their_columns():
    """Two decoupled decays cross; by size they would swap."""
    model = Model(
        name="crossing", parameters=FrozenMap({"k": Parameter(1.0)}), inputs=FrozenMap({"u": Input(0.0)}),
        states=FrozenMap({"a": State(parse("u - k*a")), "b": State(parse("u - 2*b"))}),
        outputs=FrozenMap({"a": Output(parse("a + b"))}),
    )  # fmt: skip
    found = root_locus(model, "k", np.linspace(1, 3, 21))
    columns = [c for c in range(2) if np.ptp(found.eigenvalues[:, c].real) > 1.9]
    assert len(columns) == 1
    np.testing.assert_allclose(found.eigenvalues[:, 1 - columns[0]], -2.0)


def test_match_is_a_permutation():
    order = match(np.array([1.0, 2.0]), np.eye(2), np.array([2.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]]))
    assert list(order) == [1, 0]


def test_locus_without_an_operating_point_names_the_value():
    model = Model(
        name="fold", parameters=FrozenMap({"k": Parameter(1.0)}),
        states=FrozenMap({"x": State(parse("k - x**2"), guess=1.0)}), outputs=FrozenMap({"x": Output(parse("x"))}),
    )  # fmt: skip
    with pytest.raises(SteadyStateError, match="k = -1"):
        root_locus(model, "k", [1.0, 0.5, -1.0])
    with pytest.raises(LinearizationError):
        root_locus(model, "k", [])
    with pytest.raises(UnknownNameError):
        root_locus(model, "nothing", [1.0])


def test_point_of_a_locus_is_the_search_s(link):
    point = find_operating_point(link, {"KIVDC": 900.0})
    assert point.parameters["KIVDC"] == 900.0


def test_a_state_behind_a_limit_is_saturated_and_without_it_an_integrator():
    held = Model(
        name="held", parameters={"top": Parameter(1.0)}, inputs={"u": Input(2.0)},
        states={"x": {"derivative": "lim - top", "start": 0.3}}, signals={"lim": "clip(u, 0, top)"}, outputs={"y": "x"},
    )  # fmt: skip
    (saturated,) = linearize(held, find_operating_point(held, at="start")).modes()
    (free,) = linearize(held, find_operating_point(held, {"u": 0.5}, at="start")).modes()
    assert (saturated.eigenvalue, saturated.kind) == (0, "saturated state")
    assert (free.eigenvalue, free.kind) == (0, "free integrator")
