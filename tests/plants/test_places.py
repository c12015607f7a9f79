"""Places that a study of a unit offers: the signals of the block diagram that carry something to P or Q."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hvdc_ident.model import parse_card
from hvdc_ident.plants import UnitPart, block_signals, parts_of, unit_card
from tests.plants.test_against_andes import CASES

CONTROLS = ("avr.*", "gov.*", "elec.*", "plant.*", "gen.Pm", "gen.Efd", "gen.Ipcmd", "gen.Iqcmd", "P", "Q")


def places(**parts: UnitPart) -> tuple[str, ...]:
    model = parse_card(unit_card(parts, network="playback"))
    return block_signals(model, CONTROLS, ("V", "theta", "f"), ("P", "Q"))


def test_the_places_of_a_steam_unit_are_those_of_its_block_diagrams():
    """IEEET1 without transducer: error, regulator, exciter and rate feedback; TGOV1: speed, demand, valve, reheater, power.
    What the machine takes for its power is the last of these, by another name."""
    found = places(gen=UnitPart("genrou"), avr=UnitPart("ieeet1", {"TR": 0.0}), gov=UnitPart("tgov1"))
    avr = {"avr.Vt", "avr.err", "avr.VR", "avr.Efd", "avr.VF", "avr.xf"}
    gov = {"gov.dw", "gov.demand", "gov.valve", "gov.x", "gov.Pm"}
    assert set(found) == avr | gov | {"gen.Efd", "P", "Q"}
    assert len(set(found)) == len(found)


def test_a_transducer_and_feedback_that_are_off_are_no_places():
    on = places(gen=UnitPart("genrou"), avr=UnitPart("ieeet1"), gov=UnitPart("tgov1"))
    off = places(gen=UnitPart("genrou"), avr=UnitPart("ieeet1", {"TR": 0.0, "KF": 0.0}), gov=UnitPart("tgov1"))
    assert set(on) - set(off) == {"avr.Vc", "avr.VF", "avr.xf"} and set(off) <= set(on)


@pytest.mark.parametrize("flag", [0.0, 1.0])
def test_flags_choose_the_branches_that_count(flag):
    found = places(
        gen=UnitPart("regca1"), elec=UnitPart("reecb1", {"QFLAG": 0.0}), plant=UnitPart("repca1", {"Fflag": flag})
    )
    frequency = {"plant.ferr_in", "plant.ferr", "plant.Perr", "plant.Ppi", "plant.dwn", "plant.Pmeas"}
    assert frequency <= set(found) if flag else not frequency & set(found)
    voltage_loop = {"elec.Verr", "elec.xv", "elec.Vsel", "elec.xq", "elec.Qerr"}
    assert not voltage_loop & set(found)
    assert not {"elec.dip", "plant.Vref", "plant.Plant_pref", "elec.PFaref"} & set(found)
    assert {"elec.Qsel", "elec.Iqcmd", "plant.err", "plant.Vmeas", "P", "Q"} <= set(found)


SATURATION = ("S10", "S12", "E1", "SE1", "E2", "SE2")


@pytest.mark.parametrize("name", [n for n, records in CASES.items() if {"GENROU", "GENSAL"} & set(records)])
def test_zeros_for_no_saturation_leave_a_unit_its_references_and_places(name):
    """The branch of the saturation, which does not count then, has 0/0 in it; the saturation itself is no place."""
    parts = parts_of(CASES[name])
    plain = {
        n: replace(p, values={**p.values, **{k: 0.0 for k in SATURATION if k in p.values}}) for n, p in parts.items()
    }
    assert places(**plain) == places(**parts)
    assert (
        parse_card(unit_card(plain, network="playback")).inputs
        == parse_card(unit_card(parts, network="playback")).inputs
    )
