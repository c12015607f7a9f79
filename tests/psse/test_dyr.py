"""Dynamic data of PSS/E: what is read, and that every byte but the changed values stays."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvdc_ident.errors import ModelError
from hvdc_ident.psse import DyrFile, UserModel, read_dyr
from hvdc_ident.psse.free_format import number_of, number_text

HARD = (
    b"\xef\xbb\xbf// machines of the plant M\xfcnster\r\n"
    b"@! BUS MODEL ID\r\n"
    b"/ between records, one slash is enough\r\n"
    b"  101 'GENROU' 1   6.50  0.05,1.0D-3\t-.5\r\n"
    b"// within a record\r\n"
    b"     1.8, , 2*0.25   3.0-2  / d-axis / 'not a value'\r\n"
    b"\r\n"
    b"101,'esst1a',' 1 ',0,,0.01,\"A/B, C\",'it''s'/\r\n"
    b"102 'USRMDL' 'G1' 'WTG_A' 101 1 2 3 4 5\r\n"
    b"  7 8 0.1 0.2 0.3 /\r\n"
    b"0 'USRMSC' 'WATCH1' 512 0 0 1 0 0 2.5 /\r\n"
    b"Line 'Toggle' Line_8 2.0 /\r\n"
    b"103 GENCLS 2 3.5 0\r\n"
    b"/"
)


def _file(tmp_path: Path, content: bytes) -> DyrFile:
    path = tmp_path / "case.dyr"
    path.write_bytes(content)
    return read_dyr(path)


def _error(tmp_path: Path, content: bytes) -> str:
    with pytest.raises(ModelError) as caught:
        _file(tmp_path, content)
    return str(caught.value)


def test_records_in_free_format(tmp_path: Path) -> None:
    f = _file(tmp_path, HARD)
    assert [(r.bus, r.model, r.machine, r.line) for r in f.records] == [
        (101, "GENROU", "1", 4),
        (101, "ESST1A", "1", 8),
        (102, "WTG_A", "G1", 9),
        (0, "WATCH1", "", 11),
        (103, "GENCLS", "2", 13),
    ]
    assert f.records[0].values == (6.5, 0.05, 0.001, -0.5, 1.8, None, 0.25, 0.25, 0.03)
    assert f.records[1].values == (0.0, None, 0.01, "A/B, C", "it's")
    assert f.records[2].user == UserModel(101, 1, 2, 3, 4, 5)
    assert f.records[2].values == (7.0, 8.0, 0.1, 0.2, 0.3)
    assert f.records[3].values == (2.5,)
    assert f.records[4].values == (3.5, 0.0)


def test_only_the_bytes_of_the_changed_values_change(tmp_path: Path) -> None:
    f = _file(tmp_path, HARD)
    gen, avr, wtg = f.records[:3]
    changed = f.with_values(gen, {0: 7.0, 2: 1e-5, 5: 0.4, 7: 0.75}).with_values(avr, {1: 2.0, 4: "o'k"})
    changed = changed.with_values(wtg, {0: 9})
    expected = (
        HARD.replace(b"6.50", b"7.0")
        .replace(b"1.0D-3", b"1.0E-05")
        .replace(b"1.8, , 2*0.25", b"1.8, 0.4, 0.25 0.75")
        .replace(b"0,,0.01", b"0,2.0,0.01")
        .replace(b"it''s", b"o''k")
        .replace(b"  7 8", b"  9 8")
    )
    assert changed.content == expected
    assert changed.records[0].values == (7.0, 0.05, 1e-5, -0.5, 1.8, 0.4, 0.25, 0.75, 0.03)
    assert [r.values for r in changed.records[3:]] == [r.values for r in f.records[3:]]
    assert changed.write(tmp_path / "out.dyr").read_bytes() == expected


def test_values_that_are_the_same_keep_their_bytes(tmp_path: Path) -> None:
    f = _file(tmp_path, HARD)
    for r in f.records:
        assert f.with_values(r, {k: v for k, v in enumerate(r.values) if v is not None}).content == HARD


def test_a_repeated_default_is_written_out(tmp_path: Path) -> None:
    f = _file(tmp_path, b"1 'GENROU' 1 5.0 3* 2.0 /\n")
    assert f.records[0].values == (5.0, None, None, None, 2.0)
    changed = f.with_values(f.records[0], {2: 0.5})
    assert changed.content == b"1 'GENROU' 1 5.0 1* 0.5 1* 2.0 /\n"
    assert changed.records[0].values == (5.0, None, 0.5, None, 2.0)


def test_records_of_a_bus_and_machine(tmp_path: Path) -> None:
    f = _file(tmp_path, HARD)
    assert [r.model for r in f.at(101)] == ["GENROU", "ESST1A"]
    assert [r.model for r in f.at(102, "G1")] == ["WTG_A"]
    with pytest.raises(ModelError, match=r"no record of bus 7.*expected the bus 101 or 102 or 0 or 103"):
        f.at(7)
    with pytest.raises(ModelError, match=r"no record of machine '9' at bus 102.*expected the id G1"):
        f.at(102, "9")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "case.dyr: the file is empty"),
        (b"1 'GENROU' 1 5.0\n", "case.dyr:1: a record without its end; expected a /, got the end of the file"),
        (
            b"// a\n1 'GENROU' 1 5.0\n  0.1\n2 'GENROU' 1 5.0 /\n",
            "case.dyr:2: a record without its end; expected a /, got the next record, at line 4",
        ),
        (b"1 'GENROU' 1 5.0 abc /\n", "case.dyr:1: a text without quotes where value 1 of GENROU is due"),
        (b"1 'GENROU' 1 1.2.3 /\n", "expected a number, got '1.2.3'"),
        (b"north 'GENROU' 1 5.0 /\n", "expected a bus number, got 'north'"),
        (b"1 2.0 1 5.0 /\n", "a record without the name of a model"),
        (b"1 'GENROU /\n", "case.dyr:1: a quote without its end"),
        (b"1 'GENROU' /\n", "a record of GENROU without a machine id"),
        (b"1 'USRMDL' 1 'WTG_A' 101 1 0 /\n", "expected an integer of WTG_A (IC IT NI NC NS NV), got nothing"),
        (b"1 'GENROU' 1 \x00\x01/\n", "this is not a text file of PSS/E"),
        (b"0, 100.0, 33, 0, 1, 60.0 / PSS(R)E\n\n\n1,'A'\n", "this is power-flow data"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, content: bytes, message: str) -> None:
    assert message in _error(tmp_path, content)


def test_values_that_a_record_cannot_hold(tmp_path: Path) -> None:
    f = _file(tmp_path, HARD)
    with pytest.raises(ModelError, match="has no value 9; expected an index from 0 to 8"):
        f.with_values(f.records[0], {9: 1.0})
    with pytest.raises(ModelError, match="a finite number, got nan"):
        f.with_values(f.records[0], {0: float("nan")})
    with pytest.raises(ModelError, match="one line of Latin-1"):
        f.with_values(f.records[1], {3: "a\nb"})


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_is_written_as_the_same_double_with_a_point(value: float) -> None:
    text = number_text(value)
    assert number_of(text) == value
    assert "." in text


GAP = st.sampled_from([" ", "  ", ",", " , ", "\t", "\n  ", "\r\n", " ,\n", "\n// gap 1 'GENROU' /\n"])
NUMBERS = st.sampled_from(["1", "-2.50", ".5", "1.0D-3", "3.E+2", "'A 1'", "7.00", "0"])
COMMENT = st.sampled_from(["", " a / b 'c", "\xe4\xf6", " 1 'GENROU' 1 2 /"])
RECORD = st.tuples(st.integers(1, 99999), st.lists(st.tuples(GAP, NUMBERS), max_size=6), COMMENT)


@given(st.lists(RECORD, min_size=1, max_size=4), st.booleans(), st.booleans(), st.data())
def test_one_changed_value_leaves_all_others(
    tmp_path_factory: pytest.TempPathFactory, parts: list, mark: bool, last: bool, data: st.DataObject
) -> None:
    lines = [f"{bus} 'MODEL1' 1" + "".join(g + n for g, n in values) + "/" + c for bus, values, c in parts]
    content = (b"\xef\xbb\xbf" if mark else b"") + "\r\n".join(lines).encode("latin-1") + (b"\n" if last else b"")
    f = _file(tmp_path_factory.mktemp("dyr"), content)
    assert f.content == content
    assert [(r.bus, len(r.values)) for r in f.records] == [(bus, len(values)) for bus, values, _ in parts]
    places = [(r, k) for r in f.records for k in range(len(r.values))]
    if not places:
        return
    record, k = data.draw(st.sampled_from(places))
    changed = f.with_values(record, {k: 12.375})
    start, end = record.spans[k]
    assert changed.content == content[:start] + b"12.375" + content[end:]
    assert [r.values for r in changed.records] == [
        (*r.values[:k], 12.375, *r.values[k + 1 :]) if r.number == record.number else r.values for r in f.records
    ]
