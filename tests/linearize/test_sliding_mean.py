"""A sliding mean's Pade approximant has a hidden eigenvalue at 0 that the exact model lacks: no verdict may rest on it."""

import numpy as np
import pytest

from hvdc_ident.effects import apply_effects
from hvdc_ident.linearize import hinf_norm, linearize, loop, margins, nu_gap, root_locus
from hvdc_ident.linearize.realisation import difference, without_sliding_means
from hvdc_ident.models import load_model

W = np.logspace(-1, 2.5, 9)


@pytest.fixture(scope="module")
def link():
    mean = {"effect": "window-mean", "at": ["P2_m"], "parameters": {"T": 0.01}}
    return apply_effects(load_model("vsc-hvdc-link"), [mean])


@pytest.fixture(scope="module")
def model(link):
    return linearize(link, inputs=["Pref2", "Vdcref1"], outputs=["P2", "Vdc1"])


def test_one_eigenvalue_goes_and_the_response_stays(model):
    a, b, c, d = without_sliding_means(model)
    assert a.shape[0] == model.A.shape[0] - 1
    assert np.linalg.eigvals(a).real.max() < -1
    for w, want in zip(W, model.to_control()(1j * W).transpose(2, 0, 1), strict=True):
        np.testing.assert_allclose(c @ np.linalg.solve(1j * w * np.eye(a.shape[0]) - a, b) + d, want, atol=1e-8)


def test_the_response_at_zero_is_its_limit(model):
    np.testing.assert_allclose(model.response([0.0])[0], np.diag([1.0, 1.0]), atol=1e-8)


def test_verdicts(link, model):
    assert margins(loop(link, "P2_m")).stable
    plain = linearize(load_model("vsc-hvdc-link"), inputs=["Pref2", "Vdcref1"], outputs=["P2", "Vdc1"])
    assert nu_gap(plain, model).winding == 0
    assert nu_gap(model, plain).value == pytest.approx(nu_gap(plain, model).value, abs=1e-6)
    assert np.isfinite(hinf_norm(difference(plain, model)).value)
    assert np.isfinite(hinf_norm(model).value)
    found = root_locus(link, "KIVDC", np.linspace(250, 1500, 21))
    assert found.limits == () and found.stable.all()


def test_the_average_value_link_is_judged_too():
    plant = load_model("vsc-hvdc-avm")
    assert margins(loop(plant, "Irorder1")).stable
    found = root_locus(plant, "KIVDC", np.linspace(250, 1500, 11))
    assert found.limits == () and found.stable.all()
    link = linearize(load_model("vsc-hvdc-link"), inputs=["Vdcref1"], outputs=["Vdc1"])
    gap = nu_gap(link, linearize(plant, inputs=["Vdcref1"], outputs=["Vdc1"]))
    assert gap.winding == 0 and gap.value < 0.9
