"""Inputs of a unit's parts that no other part gives."""

from __future__ import annotations

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.model import parse_card
from hvdc_ident.plants import parts_of, unit_card

TIMES = np.round(np.arange(0.0, 4.001, 0.02), 6)
MACHINE = {"GENROU": [7.0, 0.03, 0.75, 0.05, 3.0, 0.0, 2.1, 2.0, 0.2, 0.5, 0.18, 0.15, 0.05, 0.3]}


def test_a_stabiliser_by_the_frequency_follows_the_recorded_one() -> None:
    records = MACHINE | {"SEXS": [0.1, 10.0, 100.0, 0.1, 0.0, 5.0]}
    records["IEEEST"] = [2.0, 0.0, *[0.0] * 10, 10.0, 10.0, 5.0, 0.1, -0.1, 0.0, 0.0]
    model = parse_card(unit_card(parts_of(records), network="playback", f0=60.0))
    model = model.with_values({"V": 1.02, "f": 60.0, "P0": 80.0, "Q0": 10.0})
    run = hi.simulate(model, TIMES, inputs={"f": hi.step(60.0, 60.3, at=0.5)}, outputs=["pss.Vs"])
    expected = np.where(TIMES < 0.5, 0.0, 5 * 0.005 * np.exp(-(TIMES - 0.5) / 10))
    np.testing.assert_allclose(run["pss.Vs"], expected, atol=1e-6)


def test_gates_that_nothing_drives_stay_open() -> None:
    """The field voltage is what the machine needs, between the gates of both limiters."""
    exciter = [3.0, 1.0, 0.0, 99.0, -99.0, 0.0, 0.0, 0.0, 0.0, 150.0, 0.01, 8.0, -6.0, 7.0, -6.0, 0.05, *[0.0] * 4]
    model = parse_card(unit_card(parts_of(MACHINE | {"ESST1A": exciter}), f0=60.0, R=0.01, X=0.3))
    assert not {"Voel_gate", "Vuel_gate"} & set(model.inputs)
    point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=["Vref", "Pm"])
    by_field = parse_card(unit_card(parts_of(MACHINE), f0=60.0, R=0.01, X=0.3))
    field = hi.find_operating_point(by_field, outputs={"P": 80.0, "Vt": 1.02}, free=["Efd", "Pm"])
    assert point.outputs["Efd"] == pytest.approx(field.inputs["Efd"], rel=1e-8)
