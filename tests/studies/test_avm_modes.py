"""The average-value link's modes are where closed forms put them and bear the names of what they are made of."""

from __future__ import annotations

import math

import pytest

from hvdc_ident.models import load_model
from tests.studies.study_module import expected, load

STUDY, KNOWN = load("avm_modes"), expected("avm_modes")


@pytest.mark.parametrize("name", STUDY.CASES)
def test_the_modes_are_named_and_stable_and_where_they_should_be(name):
    found = STUDY.main(name)
    modes, v = found["modes"], load_model(name).values
    assert max(m["eigenvalue"][0] for m in modes) < -4.0
    (resonance,) = [m for m in modes if m["name"] == "dc link"]
    series = v["C1"] * v["C2"] / (v["C1"] + v["C2"])
    assert resonance["frequency_hz"] == pytest.approx(1 / math.sqrt(2 * v["Ls"] * series) / (2 * math.pi), rel=0.01)
    decay = (2 * v["Rs"] + v["Rdc"]) / (4 * v["Ls"])
    assert resonance["eigenvalue"][0] == pytest.approx(-decay, rel=0.05)
    (outer,) = [m for m in modes if "dc voltage control" in m["name"]]
    assert outer["frequency_hz"] == pytest.approx(KNOWN[name]["dc voltage control Hz"], rel=0.02)
    assert outer["damping"] == pytest.approx(0.7, abs=0.02)
    names = " ".join(m["name"] for m in modes)
    for part in ("PLL 1", "PLL 2", "current control 1", "current control 2", "reactive power control 1"):
        assert part in names
    for kind, delay in found["delay_ms"].items():
        if "measurement" in kind:
            assert delay == pytest.approx(KNOWN[name]["measurement_ms"], abs=2e-3)
        else:
            assert abs(delay) < 0.03  # the type-1 inner loop has no delay at low frequency
