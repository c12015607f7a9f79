"""Norms, nu-gap, minimal realisation and reduction."""

import control
import numpy as np
import pytest
from helpers import linear, stable

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize import balanced, h2_norm, hinf_norm, linearize, nu_gap
from hvdc_ident.linearize.reduction import difference, minimal
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
