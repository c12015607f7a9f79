"""Power-flow data of PSS/E, in the sections and fields of each version."""

from __future__ import annotations

from pathlib import Path

import pytest

from hvdc_ident.errors import ModelError
from hvdc_ident.psse import RawFile, read_raw


def _case(version: int, *, named: bool = True) -> str:
    """A case of three buses whose sections and fields are those of the version."""
    new = version >= 34
    node = "0," if version >= 35 else ""
    rates = "'line A'," + 12 * "100.0," if new else "100.0,90.0,80.0,"
    sections = [
        ("SYSTEM-WIDE", ["GENERAL, THRSHZ=0.0001", 'RATING, 1, "RATE1 ", "SET 1"']) if new else None,
        (
            "BUS",
            [
                "@!   I,'NAME', BASKV",
                "1,'NORTH, A/B ', 20.0,3,1,1,1,1.05,-2.5",
                "2,'SOUTH       ',230.0,1,1,1,1, , 1.5D0",
                "3 'EAST' 230.0 2 1 1 1 0.98 0.0",
            ],
        ),
        ("LOAD", ["2,'1 ',1,1,1,150.0,30.0,1.0,2.0,3.0,4.0,1,1"]),
        ("FIXED SHUNT", ["2,'1 ',1,0.0,50.0"]),
        ("VOLTAGE DROOP CONTROL", []) if version >= 36 else None,
        (
            "GENERATOR",
            [
                f"1,'G1',120.0,15.0,80.0,-60.0,1.05,0,{node}250.0,0.003,0.25,0.001,0.1,1.02,1,100.0,220.0,10.0,1,1.0",
                "'EAST'",
            ],
        ),
        ("SWITCHING DEVICE RATING SET", []) if version >= 36 else None,
        ("BRANCH", [f"2,-3,'1 ',0.01,0.1,0.02,{rates}0.0,0.0,0.0,0.0,0,1,12.5 / out of service"]),
        ("SYSTEM SWITCHING DEVICE", ["2, 3,'@1',0.0001"]) if new else None,
        (
            "TRANSFORMER",
            [
                "1,2,0,'1 ',1,2,1,0.001,-0.002,2,'STEP/UP, 1',1,1,1.0",
                "0, 0.15, 300.0",
                "1.025, 20.0, 30.0, 300.0",
                "0.99, 230.0",
                "1,2,3,'1 ',1,1,1,0,0,2,'THREE',1,1,1.0",
                "0,0.1,100,0,0.1,100,0,0.1,100,1.0,0.0",
                "1.0,0.0,0.0",
                "1.0,0.0,0.0",
                "1.0,0.0,0.0",
            ],
        ),
        ("AREA", ["1,1,0.0,5.0,'AREA'"]),
    ]
    there = [s for s in sections if s]
    lines = ["@!IC,SBASE,REV,XFRRAT,NXFRAT,BASFRQ"] if new else []
    lines += [f"0, 100.0, {version}, 0, 1, 50.0 / a case", "'0 / a title'", "0 / another"]
    for (name, records), (after, _) in zip(there, [*there[1:], ("ZONE", [])], strict=True):
        lines += [*records, f" 0 /End of {name.title()} data, Begin {after.title()} data" if named else "0"]
    return "\n".join([*lines, "0" if named else "Q", "Q"])


def _read(tmp_path: Path, text: str) -> RawFile:
    path = tmp_path / "case.raw"
    path.write_bytes(text.encode("latin-1"))
    return read_raw(path)


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("version", [32, 33, 34, 35, 36])
def test_every_version(tmp_path: Path, version: int, named: bool) -> None:
    f = _read(tmp_path, _case(version, named=named))
    assert (f.version, f.sbase, f.frequency) == (version, 100.0, 50.0)
    assert f.titles == ("'0 / a title'", "0 / another")
    assert f.buses == (
        (1, "NORTH, A/B", 20.0, 3, 1.05, -2.5),
        (2, "SOUTH", 230.0, 1, 1.0, 1.5),
        (3, "EAST", 230.0, 2, 0.98, 0.0),
    )
    assert f.loads == ((2, "1", 1, 150.0, 30.0, 1.0, 2.0, 3.0, 4.0),)
    assert f.generators == (
        (1, "G1", 120.0, 15.0, 80.0, -60.0, 1.05, 250.0, 0.003, 0.25, 0.001, 0.1, 1.02, 1, 220.0, 10.0),
        (3, "1", 0.0, 0.0, 9999.0, -9999.0, 1.0, 100.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1, 9999.0, -9999.0),
    )
    assert f.branches == ((2, 3, "1", 0.01, 0.1, 0.02, 0),)
    assert f.transformers == (
        (1, 2, "1", 1, 2, 1, 0.001, -0.002, "STEP/UP, 1", 1, 0.0, 0.15, 300.0, 1.025, 20.0, 30.0, 0.99, 230.0),
    )
    assert f.three_winding == ((1, 2, 3, "1"),)


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
        (", 33,", ", 30,", "case.raw:1: power-flow data of version 30"),
        ("0, 100.0, 33, 0, 1, 50.0", "101 'GENROU' 1 5.0", "case.raw:1: this does not begin as power-flow data"),
        (
            "120.0,15.0",
            "120.0,high",
            "case.raw:13: not a number where QG of a generator is due; expected a number in field 4",
        ),
        ("'EAST'\n", "'WEST'\n", "case.raw:14: no buses with the name 'WEST'"),
        ("2,-3,'1 '", "2,-8,'1 '", "a branch at bus 8, which is not there; expected the bus 1 or 2 or 3"),
        ("1.0,0.0,0.0\n 0 /", " 0 /", "a transformer without its end; expected 5 lines for 3 windings, got 4"),
        ("'SOUTH       '", "'SOUTH", "case.raw:6: a quote without its end"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    case = _case(33)
    assert old in case
    with pytest.raises(ModelError) as caught:
        _read(tmp_path, case.replace(old, new, 1))
    assert message in str(caught.value)
