"""Units that are played back against andes 2.0, whose playback bus is PLBVFU1.

playback_andes.json has the numbers, which benchmarks/plants_against_andes.py computes: PLBVFU1 plays a table of voltage and frequency,
each value held until the next, behind a lag each. What stands at its terminals follows in closed form, and is played into our unit.
Kw = 0: andes has Pm act as a torque.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.data import InputSignal
from hvdc_ident.model import parse_card
from hvdc_ident.plants import parts_of, unit_card

HERE = Path(__file__).parent
CASES = tomllib.loads((HERE / "cases.toml").read_text(encoding="utf-8"))
RECORDED = json.loads((HERE / "playback_andes.json").read_text(encoding="utf-8"))
TABLE = {n: np.array(values) for n, values in RECORDED["table"].items()}
TIMES = np.array(RECORDED["times"])
FINE = np.round(np.arange(0.0, TIMES[-1] + 0.001, 0.002), 6)
"""Corners of the played signals, s: between them, lines are within 1e-6 of the lagged courses."""
F0 = 60.0


def lagged(column: str, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lagged departure from the first value of the table, and its integral. Both (n,)."""
    lag = RECORDED["lags"][column]
    since = np.maximum(times[:, None] - TABLE["t"][1:], 0.0)
    steps = np.diff(TABLE[column])
    reached = -np.expm1(-since / lag)
    return reached @ steps, (since - lag * reached) @ steps


def courses(name: str, times: np.ndarray) -> dict[str, np.ndarray]:
    """Return voltage (pu), angle (rad) and frequency (Hz) at the terminals."""
    departure, integral = lagged("f", times)
    voltage = RECORDED["cases"][name]["V"][0] + lagged("V", times)[0]
    return {"V": voltage, "theta": 2.0 * np.pi * F0 * integral, "f": F0 * (1.0 + departure)}


@pytest.mark.parametrize("name", RECORDED["cases"])
def test_playback_is_the_course_of_andes(name: str) -> None:
    course = courses(name, TIMES)
    assert course["V"] == pytest.approx(np.array(RECORDED["cases"][name]["V"]), abs=2e-6)
    assert course["theta"] == pytest.approx(np.array(RECORDED["cases"][name]["theta"]), abs=2e-5)


@pytest.mark.parametrize("given", ["theta", "f"])
@pytest.mark.parametrize("name", RECORDED["cases"])
def test_powers(name: str, given: str) -> None:
    """Each within 2e-4 of its range, with the angle given and with the frequency."""
    recorded = {n: np.array(values) for n, values in RECORDED["cases"][name].items()}
    parts = parts_of(CASES[name])
    parts["gen"] = replace(parts["gen"], values={**parts["gen"].values, "Kw": 0.0})
    model = parse_card(unit_card(parts, network="playback", f0=F0))
    model = model.with_values({"P0": recorded["P"][0], "Q0": recorded["Q"][0]})
    course = courses(name, FINE)
    inputs = {n: InputSignal.corners(zip(FINE, course[n], strict=True)) for n in ("V", given)}
    run = hi.simulate(model, TIMES, inputs=inputs)
    for n in ("P", "Q"):
        apart = np.abs(run[n] - recorded[n]) / np.ptp(recorded[n])
        assert apart.max() < 2e-4, (n, TIMES[apart.argmax()], apart.max())
