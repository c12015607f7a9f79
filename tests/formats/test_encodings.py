"""Code pages that a file does not name, and numbers as the settings of a country write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import csv_text, list_signals, read_waveforms
from hvdc_ident.formats._clock import Clock
from hvdc_ident.formats._text import decoded, encoding_of
from tests.formats.samples import SAMPLES

TEXTS = {
    "cp1252": ("Größe;Öl [°C]", "Tension réseau créée;déjà", "MEDIÇÕES;TENSÕES", "µ", "Señal nº 1", "Årsdøgn"),
    "cp1251": ("Напряжение UA;кВ", "НАПРЯЖЕНИЕ;ТОК", "время, с;U, кВ", "Ua_1СШ-110_ТН_110кВ"),
    "gb18030": ("A相电压;B相电压", "时间;电压[kV];电流", "220kV母线_Ua", "频率", "A相,B相,C相"),
    "cp932": ("時間;電圧[kV];電流", "A相", "サンプル番号"),
    "utf-8-sig": ("Größe", "Напряжение", "电压", "plain"),
    "utf-16": ("Größe", "Напряжение", "电压"),
}


@pytest.mark.parametrize(("encoding", "text"), [(e, t) for e, texts in TEXTS.items() for t in texts])
def test_the_code_page_of_a_header_is_found(encoding: str, text: str) -> None:
    content = text.encode(encoding)
    assert encoding_of(content) == encoding and decoded(content).lstrip("\ufeff") == text


@pytest.mark.parametrize(
    ("encoding", "voltage", "current"),
    [
        ("cp1251", "Напряжение", "Ток"),
        ("gb18030", "电压", "电流"),
        ("cp932", "電圧", "電流"),
        ("cp1252", "Größe", "Öl"),
    ],
)
def test_names_in_every_code_page_can_be_asked_for(tmp_path: Path, encoding: str, voltage: str, current: str) -> None:
    (tmp_path / "x.csv").write_bytes(f"t [s];{voltage} [kV];{current}\n0;1,5;2\n1;2,5;3\n".encode(encoding))
    assert list_signals(tmp_path / "x.csv") == [(voltage, "kV"), (current, "")]
    assert read_waveforms(tmp_path / "x.csv", [current, voltage]).values.tolist() == [[2.0, 1.5], [3.0, 2.5]]
    SAMPLES["comtrade"](tmp_path / "r.cfg")
    header = (tmp_path / "r.cfg").read_text("ascii").replace("Vdc", voltage).replace(",P,", f",{current},")
    (tmp_path / "r.cfg").write_bytes(header.encode(encoding))
    assert read_waveforms(tmp_path / "r.cfg").names[:2] == (voltage, current)


NUMBERS = {
    "1'234.5": 1234.5,
    "-1’234’567,25": -1234567.25,
    "1\u00a0234": 1234.0,
    "12\u202f345,5": 12345.5,
    "1\u2009000e2": 1e5,
    "\u22123,5": -3.5,
    "\u00a07\u00a0": 7.0,
}


@pytest.mark.parametrize("cell", NUMBERS)
def test_thousands_set_apart_and_other_signs(tmp_path: Path, cell: str) -> None:
    path = tmp_path / "x.csv"
    path.write_text(f"t;y\n0;{cell}\n1;{cell}\n2;{cell}\n", "utf-8")
    assert read_waveforms(path)["y"].tolist() == [NUMBERS[cell]] * 3
    path.write_text(f"t;y\n{cell};0\n{cell};1\n", "utf-8")  # where the first row is to be told from the names
    assert read_waveforms(path).time.tolist() == [NUMBERS[cell]] * 2


@pytest.mark.parametrize("cell", ["1'23", "1''234", "12'3456", "1 234", "1'234'5"])
def test_what_only_looks_like_thousands_is_refused(tmp_path: Path, cell: str) -> None:
    (tmp_path / "x.csv").write_text(f"t;y\n0;1\n1;{cell}\n", "utf-8")
    with pytest.raises(WaveformError, match=r"line 3, column 2.*text where a number belongs"):
        read_waveforms(tmp_path / "x.csv")


def test_both_readers_see_the_same_numbers(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("t;y\n0;1'234.5\n1;2\n", "utf-8")
    (tmp_path / "y.csv").write_text("t;y\n0;1234.5\n1;2\n", "utf-8")
    quick = csv_text._fast(csv_text._layout(tmp_path / "y.csv"), [0, 1])
    assert quick is not None
    np.testing.assert_array_equal(csv_text._careful(csv_text._layout(tmp_path / "x.csv"), [0, 1], Clock()), quick)
