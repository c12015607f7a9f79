"""Bases, buses and generators of .raw files of several versions."""

from __future__ import annotations

import pytest

from hvdc_ident.errors import ModelError
from hvdc_ident.psse import read_raw

BUSES = """101,'UNIT, 1/2   ', 20.0000,2,   1,   1,   1,1.02000,  10.5000
102,'GRID        ',230.0000,3,   1,   1,   1,1.00000,   0.0000
"""
GENERATORS = """101,'1 ',   200.000,    31.500,   120.000,   -80.000,1.02000,     0,   250.000, 3.0E-3, 2.5E-1
102,'1 ',  -200.000,     0.000,   999.000,  -999.000,1.00000,     0,   100.000, 0.0, 1.0
"""
V33 = (
    "0,   100.00, 33, 0, 0, 50.00 / PSS(R)E-33.4\nfirst line\nsecond, line / with a slash\n"
    + BUSES
    + "0 / END OF BUS DATA, BEGIN LOAD DATA\n101,'1 ',1,1,1,10.0,2.0\n0 / END OF LOAD DATA\n0 / END OF FIXED SHUNT DATA\n"
    + GENERATORS
    + "0 / END OF GENERATOR DATA, BEGIN BRANCH DATA\n101,102,'1',0.01,0.1\n0 / END OF BRANCH DATA\nQ\n"
)
V35 = (
    "@!IC,SBASE,REV,XFRRAT,NXFRAT,BASFRQ\n0, 100.0, 35, 0, 0, 60.0 / later\n\n\n"
    'GENERAL, THRSHZ=0.0001\nRATING, 1, "RATE1 "\n0 / END OF SYSTEM-WIDE DATA\n@! I, NAME\n'
    + BUSES
    + "0 / END OF BUS DATA\n0 / END OF LOAD DATA\n0 / END OF FIXED SHUNT DATA\n@! I, ID\n"
    + GENERATORS
    + "0 / END OF GENERATOR DATA\nQ\n"
)


@pytest.mark.parametrize(("text", "version", "frequency"), [(V33, 33, 50.0), (V35, 35, 60.0)])
def test_what_a_unit_needs(tmp_path, text: str, version: int, frequency: float) -> None:
    path = tmp_path / "grid.raw"
    path.write_text(text, encoding="latin-1")
    raw = read_raw(path)
    assert (raw.version, raw.base, raw.frequency) == (version, 100.0, frequency)
    assert [(b.number, b.name, b.base, b.voltage, b.angle) for b in raw.buses] == [
        (101, "UNIT, 1/2", 20.0, 1.02, 10.5),
        (102, "GRID", 230.0, 1.0, 0.0),
    ]
    unit = raw.generator(101)
    assert (unit.machine, unit.active, unit.reactive, unit.base) == ("1", 200.0, 31.5, 250.0)
    assert (unit.resistance, unit.reactance) == (3e-3, 0.25)
    with pytest.raises(ModelError, match=r"no generators at bus 7.*101 '1'"):
        raw.generator(7)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("one\n", "three lines of heading"),
        (V33.replace(" 33,", " 29,", 1), "this version of .raw is not read"),
        (V33.replace("0,   100.00,", "0,   much,", 1), "line 1: field 2 is no number"),
        (V33.split("0 / END OF LOAD")[0], "ends before its generators"),
    ],
)
def test_what_cannot_be_read_is_told(tmp_path, text: str, words: str) -> None:
    path = tmp_path / "bad.raw"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ModelError, match=words):
        read_raw(path)
