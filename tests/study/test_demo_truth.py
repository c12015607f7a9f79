"""The truth behind recordings made here, against loops whose delay is known on paper."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from hvdc_ident import Model, apply_effects, load_model
from hvdc_ident.study.demo_truth import equivalent_delay, truth_of
from hvdc_ident.summary import summarise
from hvdc_ident.summary.truth import found_effect, truth_lines

LOOP = Model(
    "loop",
    parameters={"K": 30.0},
    inputs={"r": 1.0},
    states={"x": "K*order"},
    signals={"order": "r - seen", "seen": "x"},
    outputs={"x": "x"},
)


def late(effect: str, size: float) -> dict[str, Any]:
    plant = apply_effects(LOOP, [{"effect": effect, "at": "seen", "parameters": {"T": size}}])
    found = equivalent_delay(plant, LOOP, "order")
    assert found is not None
    return found


def test_a_delay_is_as_long_as_it_is() -> None:
    """K/s crosses the gain 1 at K rad/s."""
    found = late("delay", 1.5e-3)
    assert found["seconds"] == pytest.approx(1.5e-3, rel=1e-9)
    assert found["at_hz"] == pytest.approx(30.0 / math.tau, rel=1e-6)


def test_a_lag_is_a_delay_of_its_phase() -> None:
    assert late("lag", 4e-3)["seconds"] == pytest.approx(math.atan(30.0 * 4e-3) / 30.0, rel=1e-6)


def test_the_average_value_link_lacks_nothing_against_itself_and_its_filters_against_the_phasor_link() -> None:
    """Two lags in a row of the 140 Hz filters: w = 2 pi 140/sqrt(sqrt(2) - 1), a delay of 2/w at low frequencies."""
    plant, link = load_model("vsc-hvdc-avm"), load_model("vsc-hvdc-link")
    same = truth_of(plant, plant, ["KIP"], ["Irorder2"])
    assert same["lacking"] == [] and same["delays"][0]["seconds"] == pytest.approx(0.0, abs=1e-12)
    truth = truth_of(plant, link, ["KIP", "KIVDC"], ["Irorder2"])
    assert truth["parameters"]["KIP"]["value"] == plant.parameters["KIP"].value
    filters = 2.0 * math.sqrt(math.sqrt(2.0) - 1.0) / (math.tau * plant.parameters["FM"].value)
    assert truth["delays"][0]["seconds"] == pytest.approx(filters, rel=0.05)
    assert {"current control", "PLL"} <= set(truth["lacking"])


def test_the_screen_and_the_page_have_the_truth_beside_what_was_found(tmp_path: Path) -> None:
    truth = truth_of(load_model("vsc-hvdc-avm"), load_model("vsc-hvdc-link"), ["KIP"], ["Irorder2"])
    fit = {
        "candidates": {"KIP": {"given": 28.0, "unit": "pu/s"}},
        "estimates": {"KIP": {"value": 31.25, "ci95": [31.0, 31.5]}},
        "held": {},
        "status": "converged",
        "fitted": ["KIP"],
        "values": {"KIP": 31.25},
    }
    finding = {"effect": "lag", "probability": 0.98, "equivalent_delay": {"value": 1.4e-3, "ci95": [1.3e-3, 1.5e-3]}}
    lag = {"effect": "lag", "at": ["P2_m"], "text": "P2_m lags"}
    diagnosis = {"verdict": "named", "effects": [lag], "parameters_after": {"KIP": 29.875}, "augmented_model": "a.toml"}
    diagnosis["findings"] = [finding]
    summary = summarise({"fit": fit, "discrepancy": diagnosis})
    lines = truth_lines(truth, summary)
    assert lines[2].split()[-1] == "true"
    assert lines[3].split() == ["KIP", "pu/s", "28", "31.25", "29.88", "30"]
    assert found_effect(summary) == "lag that acts as a delay of 1.4 ms (98 %)"
    assert found_effect(summarise({"fit": fit})) == "nothing"
    assert lines[-1].startswith("missing, true: vsc-hvdc-avm has further states in its dc link, current control, PLL, ")
    assert f"delay the loop of Irorder2 by {1e3 * truth['delays'][0]['seconds']:.4g} ms (at 4.77 Hz)" in lines[-1]
    heading = {"schema": 1, "study": "demo", "model": "vsc-hvdc-link", "software": "hvdc_ident"}
    for name, data in (("truth", truth), ("fit", fit), ("discrepancy", diagnosis)):
        (tmp_path / f"{name}.json").write_text(json.dumps({**heading, **data}))
    from hvdc_ident.report.sections.truth import SECTION
    from hvdc_ident.summary import Results

    body = SECTION.render(Results(tmp_path))
    assert '<td class="n">28</td><td class="n">31.25</td><td class="n">29.88</td><td class="n">30</td>' in body
    assert "found: lag that acts as a delay of 1.4 ms" in body and "delay the loop of Irorder2" in body
