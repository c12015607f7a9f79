"""Sensitivities against closed solutions."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import StudyError, UnknownNameError
from hvdc_ident.model import parse_card
from hvdc_ident.sensitivity import steady_sensitivities, trajectory_sensitivities

CARD = """
schema = 1
name = "lag"
[parameters]
k = {value = 2.0, unit = "1/s", min = 0.1, max = 10.0}
b = {value = 0.0, min = 0.0, max = 4.0}
[inputs]
u = {value = 1.0}
[states]
x = {derivative = "u + b - k*x"}
[outputs]
y = "x"
"""
MODEL = parse_card(CARD)
TIME = np.arange(201) * 0.01
STEP = experiment("step", TIME, {"u": InputSignal.step(0.0, 1.0, 2.0)}, window=(0.5, 2.0))


def test_over_time_in_units_and_normalised():
    found = trajectory_sensitivities(MODEL, [STEP])
    k, e = 2.0, np.exp(-2.0 * TIME)
    want = -(2 - e) / k**2 + TIME * e / k  # d/dk of (2 - exp(-k t))/k: the start is at rest, so it moves too
    assert np.allclose(found.of("step", "y", "k"), want, atol=1e-7)
    assert np.allclose(found.of("step", "y", "k", normalised=True), 2 * want, atol=1e-7)
    assert found.factors["b"] == 4.0  # its value is 0: its range
    assert np.allclose(found.array("step").sel(output="y", parameter="b"), 1 / k, atol=1e-7)
    rows = STEP.compared
    assert float(found.norms["rms"].sel(parameter="k").squeeze()) == pytest.approx(
        np.sqrt(np.mean((2 * want[rows]) ** 2)), abs=1e-6
    )
    assert found.table["step"]["y"]["k"][1] == pytest.approx(np.abs(2 * want[rows]).max(), abs=1e-6)
    assert not found.notes


def test_at_rest():
    found = steady_sensitivities(MODEL, values={"k": 4.0}, ranges={"k": (1, 9)})
    assert found.steady["y"] == pytest.approx(0.25)
    assert np.allclose(found.gradients, [[-1 / 16, 1 / 4]])
    assert float(found.array(normalised=True).sel(parameter="k").squeeze()) == pytest.approx(-0.5)


def test_nothing_silent():
    still = experiment("still", TIME, {"u": 1.0})
    assert "no input moves" in trajectory_sensitivities(MODEL, [still]).notes["still"]
    with pytest.raises(StudyError, match="need an experiment"):
        trajectory_sensitivities(MODEL, [])
    with pytest.raises(UnknownNameError):
        trajectory_sensitivities(MODEL, [STEP], ["q"])
    with pytest.raises(UnknownNameError):
        trajectory_sensitivities(MODEL, [STEP]).of("step", "q", "k")
    with pytest.raises(StudyError, match="range"):
        trajectory_sensitivities(MODEL, [STEP], ranges={"k": (1, 1)})
