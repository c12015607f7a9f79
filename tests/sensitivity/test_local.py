"""One verb for all that a model gives: derivatives of trajectories, steady state, eigenvalues and responses."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest

import hvdc_ident
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import UnknownNameError
from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.model import Model, Sampled, parse_card

mpl.use("Agg")
CARD = """
schema = 1
name = "oscillator"
[parameters]
w = {value = 3.0, unit = "rad/s", min = 0.1}
z = {value = 0.2, min = 0.0, max = 1.0}
c = {value = 0.0, min = 0.0, max = 5.0}
[inputs]
u = {value = 1.0}
[states]
x = {derivative = "v"}
v = {derivative = "w**2*(u + c - x) - 2*z*w*v"}
[outputs]
y = "x"
y2 = "x**2"
"""
MODEL = parse_card(CARD)
W, Z = 3.0, 0.2


def test_eigenvalues_have_their_derivatives() -> None:
    """lambda = w (-z + i sqrt(1 - z^2))."""
    found = hvdc_ident.sensitivities(MODEL).linear
    upper = found.eigenvalues[0]
    root = np.sqrt(1 - Z**2)
    assert upper == pytest.approx(W * (-Z + 1j * root))
    table = found.eigenvalue_array()
    assert complex(table.sel(mode=0, parameter="w")) == pytest.approx(-Z + 1j * root)
    assert complex(table.sel(mode=0, parameter="z")) == pytest.approx(W * (-1 - 1j * Z / root))
    assert abs(complex(table.sel(mode=0, parameter="c"))) < 1e-12
    assert complex(found.eigenvalue_array(normalised=True).sel(mode=0, parameter="w")) == pytest.approx(upper)
    assert complex(table.coords["eigenvalue"][1]) == pytest.approx(upper.conjugate())


def test_responses_have_their_derivatives_and_those_of_the_operating_point() -> None:
    """G = w^2/(s^2 + 2 z w s + w^2); of y2 = x^2 it is 2 x0 G, with x0 = u + c."""
    omega = np.array([0.3, 3.0, 12.0])
    found = hvdc_ident.sensitivities(MODEL, omega=omega, ranges={"z": (0.0, 0.5)}).linear
    s = 1j * omega
    below = s**2 + 2 * Z * W * s + W**2
    g = W**2 / below
    dz = -g * 2 * W * s / below
    dw = 2 * W / below - g * (2 * Z * s + 2 * W) / below
    assert np.allclose(found.channel("u", "y", "z"), dz) and np.allclose(found.channel("u", "y", "w"), dw)
    assert np.allclose(found.channel("u", "y2", "c"), 2 * g) and np.allclose(found.channel("u", "y2", "w"), 2 * dw)
    assert np.allclose(found.channel("u", "y", "z", normalised=True), 0.5 * dz)
    assert np.allclose(found.channel("u", "y2", "c", normalised=True), 5 * 2 * g)
    labelled = found.response_array().sel(output="y", input="u", parameter="w")
    assert np.allclose(labelled, dw)
    assert np.allclose(found.channel("u", "y", "z", normalised=True), 0.5 * dz)
    with pytest.raises(UnknownNameError):
        found.channel("u", "q", "w")


def test_they_are_those_of_the_linear_model() -> None:
    at = {"w": 2.0, "z": 0.5, "c": 1.0}
    found = hvdc_ident.sensitivities(MODEL, parameters=["z", "w"], values=at).linear
    linear = linearize(MODEL, find_operating_point(MODEL, at), sensitivities=["z", "w"])
    assert [m.sensitivity["w"] for m in linear.modes()] == pytest.approx(list(found.eigenvalue_gradients[:, 1]))
    step = 1e-5
    high, low = (
        linearize(MODEL, find_operating_point(MODEL, at | {"z": 0.5 + d})).response(found.omega) for d in (step, -step)
    )
    assert np.allclose(found.response_gradients[..., 0], (high - low) / (2 * step), atol=1e-7)


def test_trajectories_and_steady_state_come_with_them() -> None:
    time = np.linspace(0, 3, 61)
    step = experiment("step", time, {"u": InputSignal.step(0.5, 1.0, 2.0)})
    found = hvdc_ident.sensitivities(MODEL, [step], outputs=["y2"])
    assert found.trajectories.of("step", "y2", "c")[0] == pytest.approx(2.0)
    assert found.steady.gradients[0, 2] == pytest.approx(2.0) and found.steady.outputs == ("y2",)
    assert found.linear.outputs == ("y2",)
    alone = hvdc_ident.sensitivities(MODEL)
    assert alone.trajectories is None and alone.linear.plot().get_xlabel() == "frequency, Hz"


def test_results_draw_on_given_axes_and_tell_themselves() -> None:
    import matplotlib.pyplot as plt

    step = experiment("step", np.linspace(0, 3, 61), {"u": InputSignal.step(0.5, 1.0, 2.0)})
    found = hvdc_ident.sensitivities(MODEL, [step])
    for part in (found, found.trajectories, found.steady, found.linear):
        axes = plt.subplots()[1]
        assert part.plot(ax=axes) is axes and axes.get_legend() is not None
        assert str(part).splitlines()[0] in part._repr_html_()
    drawn = found.trajectories.plot("step", "y2").lines[2]
    assert np.allclose(drawn.get_ydata(), found.trajectories.of("step", "y2", "c", normalised=True))
    heights = [b.get_height() for b in found.steady.plot().patches]
    assert heights[-1] == pytest.approx(10.0) and "eigenvalue, rad/s" in str(found)  # d(x^2)/dc = 2, times its range 5
    with pytest.raises(UnknownNameError):
        found.trajectories.plot("other")
    plt.close("all")


def test_a_model_without_a_linear_one_says_so() -> None:
    model = Model(
        name="sampled",
        parameters={"k": 2.0},
        inputs={"u": 1.0},
        states={"x": "held - k*x"},
        sampled={"held": Sampled("u", "0.1")},
        outputs={"y": "x"},
    )
    found = hvdc_ident.sensitivities(model)
    assert found.steady.gradients[0, 0] == pytest.approx(-0.25)
    assert (found.linear is None) == bool(found.why)
