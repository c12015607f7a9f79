"""Units of standard components against andes 2.0: eigenvalues and responses to steps.

andes.json has the numbers, which benchmarks/plants_against_andes.py computes. Kw = 0: andes has Pm act as a torque. Tpfilt = 0.02: it
filters the power reference with 20 ms.
"""

from __future__ import annotations

import importlib.util
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
RECORDED = json.loads((HERE / "andes.json").read_text(encoding="utf-8"))
ANDES, STEPS, TIMES = RECORDED["cases"], RECORDED["steps"], np.array(RECORDED["times"])
UNUSED = {"reeca1-q": 4, "reeca1-pf": 3, "reeca1-v": 4, "reeca1-dip": 4, "reecb1-q": 4}
"""States of branches that a flag switches off, by case: andes keeps them, unseen by all others."""
UNSEEN = ("repca1-q", "type3-plant")
"""Cases without a comparison of eigenvalues: the Jacobian of andes lacks the power of the branch that a plant controller measures."""
ENDS_ALONE = (("reeca1-dip", "Pref"),)
"""Responses of which the end alone is compared: on the way to the limit of the active current, which is the same, P of andes is up to
2e-3 of its range apart, with a decay that is none of the equations'."""
OPTIONS = {"genrou": {"Kw": 0.0}, "reeca1": {"Tpfilt": 0.02}, "reecb1": {"Tpfilt": 0.02}}
CONSTANT_IN_ANDES = {"ESST3A": "avr.VE", "ESST4B": "avr.VE"}
"""What andes' Jacobian holds constant: the voltage of a source that follows from terminal voltage and current."""


def unit(name: str) -> Model:
    """Return the unit of a case at its power flow: 80 MW, 1.02 pu."""
    parts = {n: replace(p, values={**p.values, **OPTIONS.get(p.source, {})}) for n, p in parts_of(CASES[name]).items()}
    model = parse_card(unit_card(parts, f0=60.0, R=0.01, X=0.3))
    flags = {n.rpartition(".")[2]: p.value for n, p in model.parameters.items()}
    reactive = "Vref" if flags.get("RefFlag") else "Qref"
    free = ["Plant_pref", reactive] if "Plant_pref" in model.inputs else []
    if "PFaref" in model.inputs and not free:
        free = ["Pref", "PFaref" if flags["PFFLAG"] else "Qext"]
    free = free or [r for r in ("Vref", "Pref", "nref", "Efd", "Pm") if r in model.inputs]
    point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=free)
    return model.with_values(point.inputs)


def read(matrix: np.ndarray) -> np.ndarray:
    """Return the matrix of the states without those that no other one follows, as the eigenvalues of andes are without them."""
    kept = np.abs(matrix - np.diag(np.diag(matrix))).max(axis=0, initial=0.0) > 0
    return matrix if kept.all() else read(matrix[np.ix_(kept, kept)])


@pytest.fixture(scope="module", params=ANDES)
def case(request):
    return request.param, unit(request.param)


@pytest.mark.parametrize("case", [n for n in ANDES if n not in UNSEEN], indirect=True)
def test_eigenvalues(case) -> None:
    name, model = case
    held = [signal for record, signal in CONSTANT_IN_ANDES.items() if record in CASES[name]]
    point = hi.find_operating_point(model)
    if held:
        rest = hi.simulate(model, TIMES[:2], outputs=held)
        model = model.driven(held).with_values({n: rest[n][0] for n in held})
        point = hi.find_operating_point(model, guess=point.states)
    matrix = hi.linearize(model, point).A
    found = np.linalg.eigvals(read(matrix) if "REGCA1" in CASES[name] else matrix)
    expected = np.array([complex(*e) for e in ANDES[name]["eigenvalues"]])
    assert found.size == expected.size - UNUSED.get(name, 0)
    apart = np.abs(found[:, None] - expected[None, :]) / np.maximum(1.0, np.abs(expected))
    assert apart.min(axis=1).max() <= 1e-4, found[apart.min(axis=1).argmax()]
    if name not in UNUSED:
        assert apart.min(axis=0).max() <= 1e-4, expected[apart.min(axis=0).argmax()]


def test_responses(case) -> None:
    """Each within 1e-3 of the range of the signal, or of 1e-3 of its size where it hardly moves."""
    name, model = case
    for step, recorded in ANDES[name]["responses"].items():
        if step not in model.inputs:
            continue  # another component gives this reference
        before = model.inputs[step].value
        times = TIMES[: len(recorded["P"])]
        run = hi.simulate(model, times, inputs={step: hi.step(before, before + STEPS[step], at=0.5)})
        for output, values in recorded.items():
            expected = np.array(values)
            reach = max(np.ptp(expected), 1e-3 * np.abs(expected).max(), 1e-6)
            apart = np.abs(run[output] - expected) / reach
            compared = times == times[-1] if (name, step) in ENDS_ALONE else times != 0.5
            assert apart[compared].max() < 1e-3, (step, output, times[compared][apart[compared].argmax()], apart.max())


@pytest.mark.parametrize("name", ["sexs", "ieeeg1", "reeca1-q"])
def test_the_numbers_are_those_of_andes_where_it_is_installed(name: str, tmp_path: Path) -> None:
    pytest.importorskip("andes", reason="andes is not installed: pip install '.[bench]'")
    script = HERE.parents[1] / "benchmarks" / "plants_against_andes.py"
    spec = importlib.util.spec_from_file_location(script.stem, script)
    assert spec is not None and spec.loader is not None
    andes = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(andes)
    found, recorded = (
        np.array(e) @ [1.0, 1.0j] for e in (andes.eigenvalues(CASES[name], tmp_path), ANDES[name]["eigenvalues"])
    )
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(recorded), rel=1e-6, abs=1e-9)
