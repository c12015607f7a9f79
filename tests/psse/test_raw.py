"""Power-flow data of PSS/E, in the sections and fields of each version."""

from __future__ import annotations

from pathlib import Path

import pytest

from hvdc_ident.errors import ModelError
from hvdc_ident.psse import RawFile, read_raw

VERSIONS = (24, 29, 30, 31, 32, 33, 34, 35, 36)


def _first(version: int) -> str:
    """The first line: up to 29 the version stands in its comment, up to 30 the frequency nowhere."""
    old = f"0, 100.0 / PSS/E-{version}.0 MON" if version < 30 else f"0, 100.0, {version} / PSS(tm)E-{version} RAW"
    return old if version <= 30 else f"0, 100.0, {version}, 0, 1, 50.0 / a case"


def _case(version: int, *, named: bool = True) -> str:
    """A case of three buses whose sections and fields are those of the version."""
    new = version >= 34
    node = "0," if version >= 35 else ""
    shunts = "0.0,50.0," if version <= 30 else ""  # GL, BL of the bus
    limits = ",1.1,0.9,1.1,0.9" if version >= 33 else ",1" if version <= 30 else ""
    sections = [
        ("SYSTEM-WIDE", ["GENERAL, THRSHZ=0.0001", 'RATING, 1, "RATE1 ", "SET 1"']) if new else None,
        (
            "BUS",
            [
                "@!   I,'NAME', BASKV",
                f"1,'NORTH, A/B ', 20.0,3,{shunts}1,1,1,1.05,-2.5{limits}",
                f"2,'SOUTH       ',230.0,1,{shunts}1,1,1, , 1.5D0{limits}",
                "3 'EAST' 230.0",
            ],
        ),
        ("LOAD", ["2,'1 ',1,1,1,150.0,30.0,1.0,2.0,3.0,4.0,1,1"]),
        ("FIXED SHUNT", ["2,'1 ',1,0.0,50.0"]) if version >= 31 else None,
        ("VOLTAGE DROOP CONTROL", []) if version >= 36 else None,
        (
            "GENERATOR",
            [
                f"1,'G1',120.0,15.0,80.0,-60.0,1.05,0,{node}250.0,0.003,0.25,0.001,0.1,1.02,0,100.0,220.0,10.0,1,1.0",
                "'EAST'",
            ],
        ),
        ("SWITCHING DEVICE RATING SET", []) if version >= 36 else None,
        ("BRANCH", ["2,-3,'1 ',0.01,0.1,0.02,100.0,90.0,80.0,0.0,0.0,0.0,0.0,0,1,12.5 / out of service"]),
        ("TRANSFORMER", ["1,2,0,'1 ',1,2,1,0.001,-0.002,2,'STEP/UP, 1',1,1,1.0", "0, 0.15, 300.0"]),
        ("AREA", ["1,1,0.0,5.0,'AREA'"]),
    ]
    there = [s for s in sections if s]
    lines = ["@!IC,SBASE,REV,XFRRAT,NXFRAT,BASFRQ"] if new else []
    lines += [_first(version), "'0 / a title'", "0 / another"]
    for (name, records), (after, _) in zip(there, [*there[1:], ("ZONE", [])], strict=True):
        lines += [*records, f" 0 /End of {name.title()} data, Begin {after.title()} data" if named else "0"]
    return "\n".join([*lines, "0" if named else "Q", "Q"])


def _read(tmp_path: Path, text: str) -> RawFile:
    path = tmp_path / "case.raw"
    path.write_bytes(text.encode("latin-1"))
    return read_raw(path)


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("version", VERSIONS)
def test_every_version(tmp_path: Path, version: int, named: bool) -> None:
    text = _case(version, named=named)
    f = _read(tmp_path, text)
    assert (f.version, f.sbase, f.frequency) == (version, 100.0, 50.0 if version > 30 else None)
    assert f.buses == ((1, "NORTH, A/B", 20.0, 3), (2, "SOUTH", 230.0, 1), (3, "EAST", 230.0, 1))
    line = next(n for n, t in enumerate(text.split("\n"), 1) if t.startswith("1,'G1'"))
    assert f.generators == (
        (1, "G1", 120.0, 15.0, 250.0, 0.003, 0.25, 0.001, 0.1, 1.02, 0, line),
        (3, "1", 0.0, 0.0, 100.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1, line + 1),
    )


@pytest.mark.parametrize("named", [True, False])
def test_a_file_of_version_34_without_system_wide_data(tmp_path: Path, named: bool) -> None:
    text = _case(33, named=named).replace(", 33,", ", 34,")
    assert _read(tmp_path, text).generator(1).mbase == 250.0


def test_one_bus_and_one_generator(tmp_path: Path) -> None:
    f = _read(tmp_path, "\ufeff".encode().decode("latin-1") + _case(33).replace("\n", "\r\n"))
    assert f.bus(2).name == "SOUTH"
    assert f.generator(1).mbase == f.generator(1, "G1 ").mbase == 250.0
    with pytest.raises(ModelError, match="no bus 9; expected the bus 1 or 2 or 3"):
        f.bus(9)
    with pytest.raises(ModelError, match="no generator 'G2' at bus 1; expected the id G1"):
        f.generator(1, "G2")
    with pytest.raises(ModelError, match="no generator of bus 2; expected the bus 1 or 3"):
        f.generator(2)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (", 33,", ", 23,", "case.raw:1: power-flow data of version 23; expected a version from 24 to 36"),
        (", 33, 0, 1, 50.0", "", "case.raw:1: not a number where REV of the case is due; expected a number in field 3"),
        ("0, 100.0, 33, 0, 1, 50.0", "101 'GENROU' 1 5.0", "case.raw:1: this does not begin as power-flow data"),
        (
            "120.0,15.0",
            "120.0,high",
            "case.raw:13: not a number where QG of a generator is due; expected a number in field 4, got 'high'",
        ),
        (
            ",1.02,0,100.0",
            ",1.02,0.5,100.0",
            "case.raw:13: STAT of a generator is no integer; expected an integer in field 15, got 0.5",
        ),
        ("'EAST'\n", "'WEST'\n", "case.raw:14: no buses with the name 'WEST'"),
        ("1,'G1'", "8,'G1'", "case.raw:13: a generator at bus 8, which is not there; expected the bus 1 or 2 or 3"),
        ("'SOUTH       '", "'SOUTH", "case.raw:6: a quote without its end"),
        (
            "'0 / a title'\n0 / another\n@!   I,'NAME', BASKV\n",
            "",
            "case.raw:2: the record of a bus where the title of the case is due; expected two lines of title",
        ),
        (
            "0 / another\n@!   I,'NAME', BASKV\n",
            "",
            "case.raw:3: the record of a bus where the title of the case is due; expected two lines of title",
        ),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    case = _case(33)
    assert old in case
    with pytest.raises(ModelError) as caught:
        _read(tmp_path, case.replace(old, new, 1))
    assert message in str(caught.value)


def test_a_title_may_be_any_text(tmp_path: Path) -> None:
    """Also one with an apostrophe, and one that begins as the record of a bus does."""
    text = _case(33).replace("'0 / a title'\n0 / another", "the grid's case\n1,'NORTH' of 2026")
    assert len(_read(tmp_path, text).buses) == 3
