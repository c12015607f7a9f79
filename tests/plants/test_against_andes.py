"""Units of standard components against andes 2.0: eigenvalues and responses to steps.

andes.json has the numbers, which benchmarks/plants_against_andes.py computes. Kw = 0: andes has Pm act as a torque.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.model import Model, parse_card
from hvdc_ident.plants import parts_of, unit_card

HERE = Path(__file__).parent
CASES = tomllib.loads((HERE / "cases.toml").read_text(encoding="utf-8"))
ANDES = json.loads((HERE / "andes.json").read_text(encoding="utf-8"))["cases"]
STEPS = {"Vref": 0.02, "Pref": 0.05, "E": -0.05}
TIMES = np.round(np.arange(0.0, 5.01, 0.1), 6)
OPTIONS = {"gen": {"Kw": 0.0}}
CONSTANT_IN_ANDES = {"ESST3A": "avr.VE", "ESST4B": "avr.VE"}
"""What andes' Jacobian holds constant: the voltage of a source that follows from terminal voltage and current."""


def unit(name: str) -> Model:
    """Return the unit of a case at its power flow: 80 MW, 1.02 pu."""
    parts = parts_of(CASES[name])
    for part, values in OPTIONS.items():
        if part in parts:
            parts[part] = replace(parts[part], values={**parts[part].values, **values})
    model = parse_card(unit_card(parts, f0=60.0, R=0.01, X=0.3))
    free = [r for r in ("Vref", "Pref", "Efd", "Pm") if r in model.inputs]
    point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=free)
    return model.with_values(point.inputs)


@pytest.fixture(scope="module", params=ANDES)
def case(request):
    return request.param, unit(request.param)


def test_eigenvalues(case) -> None:
    name, model = case
    held = [signal for record, signal in CONSTANT_IN_ANDES.items() if record in CASES[name]]
    point = hi.find_operating_point(model)
    if held:
        rest = hi.simulate(model, TIMES[:2], outputs=held)
        model = model.driven(held).with_values({n: rest[n][0] for n in held})
        point = hi.find_operating_point(model, guess=point.states)
    found = np.linalg.eigvals(hi.linearize(model, point).A)
    expected = np.array([complex(*e) for e in ANDES[name]["eigenvalues"]])
    assert found.size == expected.size
    apart = np.abs(found[:, None] - expected[None, :]) / np.maximum(1.0, np.abs(expected))
    assert apart.min(axis=0).max() <= 1e-4, expected[apart.min(axis=0).argmax()]
    assert apart.min(axis=1).max() <= 1e-4, found[apart.min(axis=1).argmax()]


def test_responses(case) -> None:
    """Each within 1e-3 of the range of the signal, or of 1e-3 of its size where it hardly moves."""
    name, model = case
    for step, recorded in ANDES[name]["responses"].items():
        before = model.inputs[step].value
        run = hi.simulate(model, TIMES, inputs={step: hi.step(before, before + STEPS[step], at=0.5)})
        for output, values in recorded.items():
            expected = np.array(values)
            reach = max(np.ptp(expected), 1e-3 * np.abs(expected).max(), 1e-6)
            apart = np.abs(run[output] - expected)[TIMES != 0.5] / reach
            assert apart.max() < 1e-3, (step, output, TIMES[TIMES != 0.5][apart.argmax()], apart.max())
