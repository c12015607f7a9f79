"""Inputs recorded with noise: steps end at their points, so that the run is that of the polygon."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

import hvdc_ident as hi
from hvdc_ident.data import InputSignal, input_signal, multisine
from hvdc_ident.model import parse_card

LAG = """
schema = 1
name = "lag"
[parameters]
T = {value = 0.7, unit = "s"}
[inputs]
u = {value = 1.0}
[states.x]
derivative = "(u - x)/T"
[outputs]
x = "x"
"""
DELAY = LAG.replace('"(u - x)/T"', '"(late - x)/T"') + '[delays]\nlate = {of = "u", time = "0.13"}\n'
TIME = np.linspace(0.0, 10.0, 501)


def noisy() -> InputSignal:
    rows = 1.0 + 0.2 * np.sin(TIME) + 0.01 * np.random.default_rng(0).standard_normal(TIME.size)
    return input_signal(TIME, rows, "linear")


def test_a_run_of_a_noisy_input_is_that_of_the_polygon_at_any_tolerance():
    """scipy has the answer of a linear system to a polygon without error. A step across corners leaves a thousandth of the noise."""
    signal = noisy()
    exact = lsim(([[-1 / 0.7]], [[1 / 0.7]], [[1.0]], [[0.0]]), signal(TIME), TIME, X0=signal(TIME[:1]))[1]
    model = parse_card(LAG)
    for rtol in (1e-5, 1e-8):
        run = hi.simulate(model, TIME, inputs={"u": signal}, rtol=rtol)
        assert run["x"] == pytest.approx(exact, abs=1e-8 if rtol < 1e-6 else 1e-6)
        assert run.statistics.segments >= TIME.size - 2


def test_corners_of_noise_do_not_come_back_through_delays():
    """Each would come back once, and the corner of that again."""
    model = parse_card(DELAY)
    signal = noisy()
    run = hi.simulate(model, TIME, inputs={"u": signal}, rtol=1e-8)
    assert run.statistics.segments <= TIME.size + 2
    fine = np.linspace(0.0, 10.0, 5001)
    late = signal(np.maximum(fine - 0.13, 0.0))
    exact = lsim(([[-1 / 0.7]], [[1 / 0.7]], [[1.0]], [[0.0]]), late, fine, X0=late[:1])[1][::10]
    assert run["x"] == pytest.approx(exact, abs=2e-5)


def test_smooth_signals_stop_no_step_but_at_their_breaks():
    sines = multisine(1.0, 0.1, [1.0, 3.0], start=1.0, end=9.0)
    assert np.array_equal(sines.stops, sines.breaks)
    for rows in (np.exp(-TIME), np.sin(2.0 * TIME), np.where(TIME > 3.0, 2.0, 1.0)):
        signal = input_signal(TIME, rows)
        assert np.array_equal(signal.stops, signal.breaks)
    assert noisy().breaks.size == 0 and noisy().stops.size == TIME.size - 2
