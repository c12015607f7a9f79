"""Controls of turbines by themselves, against simulations by scipy of their block diagrams and against transfer functions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.data import InputSignal
from hvdc_ident.model import shelf_model

TIMES = np.round(np.arange(0.0, 60.001, 0.1), 6)
OMEGA = np.logspace(-3, 1, 41)


def test_lcfb1_has_the_transfer_functions_of_its_diagram() -> None:
    """A lag of the power and a proportional and integral control; the frequency has no lag."""
    model = shelf_model("lcfb1").with_values({"Fb": 15.0, "Kp": 0.4, "scale": 0.05})
    linear = hi.linearize(model, outputs=["Pref"])
    responses = {n: linear.response(OMEGA)[:, 0, k] for k, n in enumerate(linear.input_names)}
    s, control = 1j * OMEGA, 0.4 + 0.02 / (1j * OMEGA)
    np.testing.assert_allclose(responses["Pref0"], 1.0, rtol=1e-9)
    np.testing.assert_allclose(responses["Pe"], -0.05 * control / (1 + s), rtol=1e-8)
    np.testing.assert_allclose(responses["dw"], -0.05 * control * 15.0, rtol=1e-8)


CASES = {
    "dead band": {"db": 0.01},
    "highest error": {"emax": 0.02},
    "limit": {"Irmax": 0.02, "Ki": 0.05},
    "frequency alone": {"Pbf": 0.0, "Fb": 20.0},
    "both": {"Fb": 20.0, "Tpelec": 0.0},
    "power alone": {"Fb": 20.0, "Fbf": 0.0},
}


@pytest.mark.parametrize("values", CASES.values(), ids=CASES)
def test_lcfb1_follows_its_block_diagram(values) -> None:
    """The power rises by 0.06 and falls by 0.04 below what it was, at another speed: integrated in steps of at most 10 ms."""
    model = shelf_model("lcfb1").with_values({"Kp": 0.3, **values})
    p, corners = model.values, [(0.0, 0.0), (5.0, 0.0), (6.0, 0.06), (35.0, 0.06), (36.0, -0.04), (60.0, -0.04)]

    def moved(t: float) -> float:
        return float(np.interp(t, *zip(*corners, strict=True)))

    def error(measured: float, t: float) -> float:
        raw = p["Pbf"] * (0.8 - measured) - p["Fbf"] * p["Fb"] * 0.02 * moved(t)
        return float(np.clip(np.sign(raw) * max(abs(raw) - p["db"], 0.0), -p["emax"], p["emax"]))

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        power = 0.8 + moved(t)
        slope = p["Ki"] * error(x[0] if p["Tpelec"] else power, t)
        held = abs(x[1]) >= p["Irmax"] and x[1] * slope > 0
        return np.array([(power - x[0]) / (p["Tpelec"] or 1.0), 0.0 if held else slope])

    exact = solve_ivp(rate, (0.0, 60.0), [0.8, 0.0], t_eval=TIMES, max_step=0.01, rtol=1e-9, atol=1e-11).y
    measured = exact[0] if p["Tpelec"] else [0.8 + moved(t) for t in TIMES]
    errors = np.array([error(m, t) for m, t in zip(measured, TIMES, strict=True)])
    expected = 0.7 + np.clip(p["Kp"] * errors + exact[1], -p["Irmax"], p["Irmax"])
    inputs = {
        "Pe": InputSignal.corners([(t, 0.8 + v) for t, v in corners]),
        "dw": InputSignal.corners([(t, 0.02 * v) for t, v in corners]),
    }
    run = hi.simulate(model.with_values({"Pref0": 0.7}), TIMES, inputs=inputs)
    np.testing.assert_allclose(run["Pref"], expected, atol=2e-5)
    assert np.ptp(expected) > 5e-3
