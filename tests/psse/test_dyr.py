"""Records of .dyr files in every form that the free format takes, and values exchanged without another byte changed."""

from __future__ import annotations

import pytest

from hvdc_ident.errors import ModelError
from hvdc_ident.psse import read_dyr

TEXT = (
    "// a plant of two units, \xe9tat 2024\r\n"
    "@! exported\r\n"
    "  101 'GENROU' 1   6.50  0.06, 0.2\t0.05\r\n"
    "      3.2 0.0 1.8 1.75 0.3 0.5 0.25 0.2 0.1 0.4 / the machine, of 1.0D+2 MVA\r\n"
    "101,'SEXS','1',0.1,10.,1.0D+2,0.1,,5.0/\r\n"
    "102 \"TGOV1\" 'A ' 0.05 5.E-1 1 0 2 6 0/\r\n"
    "\r\n"
    "101 'USRMDL' 1 'XCTL' 4 0 2 3 2 7  0 1 'text / with slash' 0.5 /\r\n"
    "102 'GENCLS' A 3.0 0.0 / last"
)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "plant.dyr"
    path.write_bytes(TEXT.encode("latin-1"))
    return read_dyr(path)


def test_records_in_free_format(file) -> None:
    assert [(r.bus, r.model, r.machine) for r in file.records] == [
        (101, "GENROU", "1"),
        (101, "SEXS", "1"),
        (102, "TGOV1", "A"),
        (101, "XCTL", "1"),
        (102, "GENCLS", "A"),
    ]
    machine, exciter, governor, own, _ = file.records
    assert machine.values == (6.5, 0.06, 0.2, 0.05, 3.2, 0.0, 1.8, 1.75, 0.3, 0.5, 0.25, 0.2, 0.1, 0.4)
    assert exciter.values == (0.1, 10.0, 100.0, 0.1, None, 5.0)
    assert governor.values == (0.05, 0.5, 1.0, 0.0, 2.0, 6.0, 0.0)
    assert own.values == (4.0, 0.0, 2.0, 3.0, 2.0, 7.0, 0.0, 1.0, "text / with slash", 0.5)
    assert [r.line for r in file.records] == [3, 5, 6, 8, 9]


def test_what_is_not_changed_stays_to_the_byte(file, tmp_path) -> None:
    assert file.save(tmp_path / "same.dyr").read_bytes() == TEXT.encode("latin-1")
    changed = file.with_values(file.records[0], {4: 4.125, 13: 0.0}).with_values(file.records[1], {2: 1e-7})
    expected = TEXT.replace("      3.2 0.0 1.8", "      4.125 0.0 1.8").replace("0.1 0.4 / the", "0.1 0.0 / the")
    expected = expected.replace("1.0D+2,0.1", "1e-07,0.1")
    assert changed.save(tmp_path / "new.dyr").read_bytes() == expected.encode("latin-1")
    assert read_dyr(tmp_path / "new.dyr").records[0].values[4] == 4.125


def test_a_value_that_was_left_out_is_written_between_its_commas(file) -> None:
    changed = file.with_values(file.records[1], {4: -5.0})
    assert changed.records[1].values == (0.1, 10.0, 100.0, 0.1, -5.0, 5.0)
    assert changed.text.count("\n") == file.text.count("\n")


def test_records_of_a_machine(file) -> None:
    assert [r.model for r in file.at(101)] == ["GENROU", "SEXS", "XCTL"]
    assert [r.model for r in file.at(102, "A")] == ["TGOV1", "GENCLS"]
    with pytest.raises(ModelError, match=r"no record of bus 7.*101 and 102"):
        file.at(7)
    with pytest.raises(ModelError, match=r"no machine '2'.*expected one of 1"):
        file.at(101, "2")


def test_several_machines_have_to_be_told_apart(tmp_path) -> None:
    path = tmp_path / "two.dyr"
    path.write_text("1 'GENCLS' 1 3 0 /\n1 'GENCLS' 2 3 0 /\n", encoding="utf-8")
    with pytest.raises(ModelError, match=r"several machines.*1 and 2"):
        read_dyr(path).at(1)


def test_a_mark_of_the_byte_order_and_records_of_other_tools(tmp_path) -> None:
    path = tmp_path / "marked.dyr"
    path.write_bytes(b"\xef\xbb\xbf1 'GENCLS' 1 3 0 /\nLine 'Toggle' L1 1.0 /\n2 'GENCLS' 1 4 0 /")
    assert [r.values[0] for r in read_dyr(path).records] == [3.0, 4.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "no record"),
        (b"// only a comment\n", "no record"),
        (b"1 'GENCLS' 1 3.0 0.0\n", "line 1: the record does not end"),
        (b"\n1 'GENCLS' /\n", "line 2: this is no record of a model"),
        (b"0, 100.0, 33, 0, 1, 60.0 / a power flow\n", "line 1: this is no record of a model"),
        (b"1 'GENCLS' 1 \0 /", "no .dyr file"),
    ],
)
def test_what_cannot_be_read_is_told(tmp_path, text: bytes, words: str) -> None:
    path = tmp_path / "bad.dyr"
    path.write_bytes(text)
    with pytest.raises(ModelError, match=words):
        read_dyr(path)


def test_a_file_that_is_not_there(tmp_path) -> None:
    with pytest.raises(ModelError, match="cannot be read: no such file"):
        read_dyr(tmp_path / "none.dyr")
