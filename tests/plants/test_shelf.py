"""Every card of the shelf: it loads, says what it is, and its record names its parameters; every case stays at rest."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.model import read_card
from hvdc_ident.shelf import asked_of, card_of, components, outputs_of, power_flow_of, record_of
from tests.plants.test_against_andes import CASES, unit

NETWORK = ("bus-frequency", "infinite-bus", "line", "load", "playback", "transformer", "dc-line", "grid-impedance")
CONVERTER = ("vsc-phasor", "vsc-vdc-control", "vsc-p-control", "vsc-q-control")
NO_RECORD = (*NETWORK, *CONVERTER)


@pytest.mark.parametrize("name", components())
def test_a_card_loads_and_says_what_it_is(name: str) -> None:
    text = card_of(name).read_text(encoding="utf-8")
    card = tomllib.loads(text)  # refuses a name that is given twice
    model = read_card(card_of(name))
    assert model.name == name == card["name"]
    assert outputs_of(name) == set(model.outputs) != set()
    if name not in NO_RECORD:
        assert model.description.startswith(f"{name.upper()}: ")
    if name not in NETWORK:
        assert "Source: " in model.description or "Sources: " in model.description
    # A described state names modes by its description; the links' modes go by the states' names, which tell the station.
    for section in ("parameters", "inputs", "signals", *(() if name in CONVERTER else ("states",))):
        for n, item in getattr(model, section).items():
            assert item.description, f"{section} {n}"
    for n, q in (model.inputs | model.states).items():
        assert q.unit, n


@pytest.mark.parametrize("name", [n for n in components() if n not in NO_RECORD])
def test_a_record_names_parameters(name: str) -> None:
    """Each once; what the record lacks belongs to the base or is an option of the card."""
    model, record = read_card(card_of(name)), record_of(name)
    named = [n for n in record if n != "-"]
    assert named and len(set(named)) == len(named)
    assert set(named) <= set(model.parameters)
    for n in named:
        low, high = model.parameters[n].min, model.parameters[n].max
        assert low <= model.parameters[n].value <= high


@pytest.mark.parametrize("name", [n for n in components() if n not in NO_RECORD])
def test_what_a_power_flow_states_and_a_study_asks_about_are_parameters(name: str) -> None:
    model, record = read_card(card_of(name)), record_of(name)
    assert set(power_flow_of(name)) <= set(model.parameters)
    assert set(asked_of(name)) <= set(record)
    source_impedance = {n for n in model.parameters if n in ("Ra", "Qgen0") or (n == "Xpd" and n not in record)}
    assert source_impedance <= set(power_flow_of(name)), "a shelf default would stand in for what the .raw states"


@pytest.mark.parametrize("name", CASES)
def test_a_unit_stays_at_rest(name: str) -> None:
    times = np.linspace(0.0, 5.0, 51)
    model = unit(name)
    run = hi.simulate(model, times)
    for output in model.outputs:
        assert np.ptp(run[output]) <= 1e-6 * max(1.0, np.abs(run[output]).max()), output
