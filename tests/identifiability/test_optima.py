"""Parameters that are known about each of several optima and not which: exchanged lags, turned signs."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from hvdc_ident.data import InputSignal
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.identifiability import gated_fit, identifiability
from hvdc_ident.model import Model
from hvdc_ident.parameters import Parameter
from hvdc_ident.simulate import ModelSimulator
from tests.fit.simulators import recorded
from tests.identifiability.cases import closed

TIME = np.linspace(0.0, 4.0, 201)
FIRST, SECOND, NOISE = 0.3, 0.8, 1e-3
LAGS = Model(
    name="lags",
    parameters={"T1": Parameter(0.5, "s", 0.05, 5.0), "T2": Parameter(0.6, "s", 0.05, 5.0), "k": Parameter(1.0)},
    inputs={"u": 0.0},
    states={"x": "(k*u - x)/T1", "y": "(x - y)/T2"},
    outputs={"between": "x", "out": "y"},
)
FREE = (FitParameter("T1", 0.4, 0.05, 5.0), FitParameter("T2", 0.7, 0.05, 5.0), FitParameter("k", 1.0, 0.1, 10.0))


def step_record(*outputs):
    """Two lags in series after a step of 1 at 0.5 s, by the formula."""
    t = np.clip(TIME - 0.5, 0.0, None)
    a, b = np.exp(-t / FIRST), np.exp(-t / SECOND)
    curves = {"between": 1.5 * (1 - a), "out": 1.5 * (1 - (FIRST * a - SECOND * b) / (FIRST - SECOND))}
    rng = np.random.default_rng(2)
    seen = {o: curves[o] + NOISE * rng.normal(size=t.size) for o in outputs}
    data = recorded("step", TIME, dict.fromkeys(outputs, NOISE), **seen)
    return data.with_(inputs={"u": InputSignal.step(0.5, 0.0, 1.0)})


def test_two_lags_of_which_only_the_end_is_seen_are_known_but_not_which_is_which() -> None:
    """One start is enough: the exchange is looked for."""
    data = step_record("out")
    report = identifiability(LAGS, [data], FREE, starts=1)
    for name, here, there in (("T1", FIRST, SECOND), ("T2", SECOND, FIRST)):
        v = report.parameters[name]
        assert v.verdict == "locally-identifiable" and v.std is None
        assert v.optima == (pytest.approx(here, abs=0.01), pytest.approx(there, abs=0.01))
        assert v.ci95[0] < here < v.ci95[1] and f"{v.optima[1]:.4g}" in v.reason
    assert report.parameters["k"].verdict == "identifiable"
    (other,) = report.optima
    assert abs(other.rise) < 1e-3
    told = report.to_dict()
    assert told["optima"][0]["values"]["T1"] == pytest.approx(SECOND, abs=0.01)
    assert told["parameters"]["T1"]["optima"] == list(report.parameters["T1"].optima)
    found = gated_fit(Problem(ModelSimulator(LAGS), (data,), FREE), report, partial(fit, starts=2))
    assert set(found.fitted) == {"T1", "T2", "k"}
    estimate = found.estimates["T1"]
    assert estimate.ci95[0] <= estimate.value <= estimate.ci95[1] and "only other knowledge" in estimate.reason


def test_with_the_signal_between_them_recorded_too_each_is_known() -> None:
    report = identifiability(LAGS, [step_record("between", "out")], FREE, starts=2)
    assert {v.verdict for v in report.parameters.values()} == {"identifiable"} and report.optima == ()


def squared(t, p):
    """y = a^2 t + b."""
    return p["a"] ** 2 * t + p["b"], {"a": 2 * p["a"] * t, "b": np.ones_like(t)}


@pytest.mark.parametrize(("low", "verdict"), [(-10.0, "locally-identifiable"), (0.0, "identifiable")])
def test_a_sign_that_does_not_show_is_said_where_the_bounds_admit_it(low, verdict) -> None:
    y = 4.0 * TIME + 1.0 + 0.01 * np.random.default_rng(0).normal(size=TIME.size)
    data = recorded("e", TIME, {"y": 0.01}, y=y)
    report = identifiability(
        closed(squared, a=1.0, b=0.0), [data], [FitParameter("a", 1, low, 10), FitParameter("b", 0, -5, 5)], starts=1
    )
    a = report.parameters["a"]
    assert a.verdict == verdict and a.value == pytest.approx(2.0, abs=0.01)
    assert a.optima == ((a.value, pytest.approx(-a.value, rel=1e-6)) if low < 0 else ())
    assert report.parameters["b"].verdict == "identifiable"
