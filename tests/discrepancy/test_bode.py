"""The record's frequency response against a first-order lag's own, whose step and ramp responses are known."""

import numpy as np
import pytest

from hvdc_ident import Experiment, InputSignal, Trajectory
from hvdc_ident.discrepancy.location import derivative_spectrum, recorded
from hvdc_ident.immutable import FrozenMap

STEP, LAG = 2e-3, 0.02
TIME = np.arange(500) * STEP


def lagged(event: float) -> np.ndarray:
    """1/(1 + s LAG) of a unit step."""
    return np.where(event <= TIME, 1.0 - np.exp(-np.maximum(TIME - event, 0.0) / LAG), 0.0)


@pytest.mark.parametrize("event", [0.1, 0.1 + 0.4 * STEP, 0.1 + 0.9 * STEP])
def test_a_record_shows_no_delay_of_its_own(event: float) -> None:
    e = Experiment(
        TIME,
        "e",
        inputs=FrozenMap({"u": InputSignal.step(event, 0.0, 1.0)}),
        measured=Trajectory(TIME, lagged(event)[:, None], ("y",), ("",)),
    )
    omega, h = recorded(e, "u", "y", 0.0)
    low = omega < 2 * np.pi * 100.0
    error = np.degrees(np.angle(h[low] * (1 + 1j * omega[low] * LAG)))
    assert low.sum() > 10
    # What is folded back from beyond half the rate stays: some degrees; a row's delay at 100 Hz would be 72.
    assert np.abs(error).max() < 15.0
    assert np.abs(error[omega[low] < 2 * np.pi * 30.0]).max() < 2.0


def test_the_input_s_spectrum_is_exact() -> None:
    signal = InputSignal.corners([(0.1, 0.0), (0.1, 0.4), (0.3, 1.0)])
    omega = np.array([0.0, 3.0, 40.0])
    fine = np.linspace(0.1, 0.3, 200_001)
    line = np.trapezoid(3.0 * np.exp(-1j * np.outer(omega, fine)), fine, axis=1)
    assert derivative_spectrum(signal, 0.0, 1.0, omega) == pytest.approx(0.4 * np.exp(-0.1j * omega) + line, abs=1e-8)
