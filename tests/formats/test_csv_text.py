"""CSV in all its dialects, what is wrong with it, and writing it."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvdc_ident import formats as catalogue
from hvdc_ident.data import Trajectory, trajectory
from hvdc_ident.errors import UnknownNameError, WaveformError
from hvdc_ident.formats import convert, csv_text, list_signals, read_waveforms, write_csv
from hvdc_ident.formats._clock import Clock

DIALECTS = {
    "comma": "time,a,b\n0,1.5,-2\n0.5,1e-3,+4\n",
    "semicolon": "time;a;b\n0;1.5;-2\n0.5;1e-3;4\n",
    "trailing semicolons": "TIME;a;b;\n0;1.5;-2;\n0.5;1e-3;4;\n",
    "trailing semicolons in the rows only": "time;a;b\n0;1.5;-2;\n0.5;1e-3;4;\n",
    "trailing semicolon in the header only": "time;a;b;\n0;1.5;-2\n0.5;1e-3;4\n",
    "trailing comma": "time,a,b,\n0,1.5,-2,\n0.5,1e-3,4,\n",
    "tab": "time\ta\tb\n0\t1.5\t-2\n0.5\t1e-3\t4\n",
    "blanks": "  time   a b\n 0 1.5   -2\n 0.5 1E-3 4 \n",
    "decimal comma": "time;a;b\n0;1,5;-2\n0,5;1e-3;4\n",
    "decimal comma and tab": "time\ta\tb\n0\t1,5\t-2\n0,5\t1e-3\t4\n",
    "decimal comma and trailing semicolon": "time;a;b;\n0;1,5;-2;\n0,5;1e-3;4;\n",
    "carriage returns": "time,a,b\r\n0,1.5,-2\r\n0.5,1e-3,4\r\n",
    "old carriage returns": "time,a,b\r0,1.5,-2\r0.5,1e-3,4\r",
    "no end of line": "time,a,b\n0,1.5,-2\n0.5,1e-3,4",
    "byte order mark": "\ufefftime,a,b\n0,1.5,-2\n0.5,1e-3,4\n",
    "comments and blank lines": "# made by hand\n\ntime,a,b\n# first\n0,1.5,-2\n\n  # second\n0.5,1e-3,4\n\n",
    "quotes": '"time","a","b"\n"0","1.5","-2"\n0.5,1e-3,4\n',
    "padded": "time , a , b\n0 , 1.5 , -2\n0.5 , 1e-3 , 4\n",
    "first column of any name": "clock,a,b\n0,1.5,-2\n0.5,1e-3,4\n",
}


@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS)
def test_dialects(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text)
    found = read_waveforms(path)
    assert found.names == ("a", "b")
    assert found.time.tolist() == [0.0, 0.5]
    assert found.values.tolist() == [[1.5, -2.0], [1e-3, 4.0]]
    layout = csv_text._layout(path)
    assert csv_text._fast(layout, [0, 1, 2]) is not None
    assert np.array_equal(csv_text._careful(layout, [0, 1, 2], Clock()), np.column_stack([found.time, found.values]))


def test_names_and_units(tmp_path: Path) -> None:
    path = write(tmp_path, 'time [s],"V,dc [kV]",P (MW),I[A],r[1],"m[2,3]",der(x),free\n' + "0,1,2,3,4,5,6,7\n" * 2)
    assert list_signals(path) == [
        ("V,dc", "kV"),
        ("P", "MW"),
        ("I", "A"),
        ("r[1]", ""),
        ("m[2,3]", ""),
        ("der(x)", ""),
        ("free", ""),
    ]
    assert read_waveforms(path, ["P (MW)", "I"]).names == ("P (MW)", "I")


def test_units_that_tell_columns_apart_stay_in_the_name(tmp_path: Path) -> None:
    assert list_signals(write(tmp_path, "t,I [A],I [pu],U [V]\n0,1,2,3\n1,1,2,3\n")) == [
        ("I [A]", "A"),
        ("I [pu]", "pu"),
        ("U", "V"),
    ]


def test_units_behind_an_underscore(tmp_path: Path) -> None:
    """Only of what the name begins with, for seconds and hours are seldom meant by V_s and I_h; I_A, I_B, I_C are phases."""
    units = {
        "P_W": "W", "f_Hz": "Hz", "Q_Mvar": "Mvar", "Vdc_kV": "kV", "id_A": "A", "n_rpm": "rpm", "theta_deg": "deg", "y_pu": "pu",
        "I_A": "", "I_B": "", "I_C": "", "V_s": "", "I_h": "", "P_m": "", "P_g": "", "T_m": "", "U_U": "", "U_V": "", "U_W": "", "P_N": "",
    }  # fmt: skip
    path = write(
        tmp_path, ",".join(["time_ms", *units]) + "\n" + "\n".join(["0" + ",1" * len(units), "5" + ",1" * len(units)])
    )
    assert dict(list_signals(path)) == units
    found = read_waveforms(path)
    assert dict(zip(found.names, found.units, strict=True)) == units
    assert found.time.tolist() == [0.0, 0.005] and found.origin.time_unit == "ms"


def test_units_between_blanks(tmp_path: Path) -> None:
    assert list_signals(write(tmp_path, 'time a [kV] "b c" d (A)\n0 1 2 3\n1 1 2 3\n')) == [
        ("a", "kV"),
        ("b c", ""),
        ("d", "A"),
    ]


def test_letters_outside_ascii(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes("time,Öl [°C]\n0,1\n1,2\n".encode("latin-1"))
    assert list_signals(path) == [("Öl", "°C")]
    path.write_bytes("time,Öl [°C]\n0,1\n1,2\n".encode())
    assert list_signals(path) == [("Öl", "°C")]


def test_search(tmp_path: Path) -> None:
    path = write(tmp_path, "time,Vdc1,Vdc2,Pref2,r[1]\n0,1,2,3,4\n1,1,2,3,4\n")
    assert [n for n, _ in list_signals(path, "vdc")] == ["Vdc1", "Vdc2"]
    assert [n for n, _ in list_signals(path, "*2")] == ["Vdc2", "Pref2"]
    assert [n for n, _ in list_signals(path, "VDC?")] == ["Vdc1", "Vdc2"]
    assert [n for n, _ in list_signals(path, "r[1")] == ["r[1]"]
    assert list_signals(path, "zzz") == []


MISTAKES = {
    "ragged": ("time,a\n0,1\n1\n", "line 3", "expected 2"),
    "too many cells": ("time,a\n0,1\n1,2,3\n", "line 3", "got 3"),
    "decimal commas between commas": ("time,a\n0,1,5\n1,2,5\n", "line 2", "semicolons"),
    "text": ("# c\ntime,a,b\n0,1,2\n\n1,2,abc\n", "line 5, column 3 ('b')", "got 'abc'"),
    "nan for a time": ("time,a,b\n0,1,2\nnan,1,2\n", "line 3, column 1 ('time')", "not finite"),
    "word for a gap where the time stands": ("time,a\n0,1\nNA,1\n", "line 3, column 1", "text"),
    "inf": ("time,a\n0,1\n1,-inf\n", "line 3, column 2 ('a')", "not finite"),
    "infinite time": ("time,a\n0,1\ninf,1\n", "line 3, column 1 ('time')", "not finite"),
    "number too large": ("time,a\n0,1\n1,1e400\n", "line 3, column 2", "too large"),
    "empty time": ("time,a,b\n0,1,2\n,1,2\n", "line 3, column 1 ('time')", "an empty cell"),
    "hexadecimal": ("time,a\n0,1\n1,0x10\n", "line 3", "text"),
    "underscore": ("time,a\n0,1\n1,1_0\n", "line 3", "text"),
    "complex": ("time,a\n0,1\n1,1+2j\n", "line 3", "text"),
    "unsorted": ("time,a\n0,1\n2,1\n# c\n1,1\n", "line 5, column 1 ('time')", "goes back"),
    "one time thrice": ("time,a\n0,1\n1,1\n1,2\n1,3\n2,4\n", "line 5, column 1", "more than twice"),
    "stuck clock": ("time,a\n" + "".join(f"{i // 3},{i}\n" for i in range(30)), "line 4", "more digits"),
    "no header": ("0,1\n1,1\n2,1\n", "line 1", "no header"),
    "commented header": ("# time,a\n0,1\n1,1\n", "line 2", "without #"),
    "duplicate names": ("time,a,b,a\n0,1,2,3\n1,1,2,3\n", "line 1, columns 2 and 4", "'a'"),
    "nameless column": ("time,a,,b\n0,1,2,3\n1,1,2,3\n", "line 1, column 3", "name it"),
    "binary": ("time,a\n0,1\n1,\x00\x01\n", "line 3", "binary"),
    "header only": ("time,a\n", "", "too few rows"),
    "one row": ("time,a\n0,1\n", "", "too few rows"),
    "one column": ("time\n0\n1\n", "line 1", "only one column"),
    "blanks below commas": ("time,u\n0 1\n1 2\n", "line 2", "another number of cells"),
    "comments only": ("# a\n# b\n", "", "nothing but"),
    "time in a unit that is none": ("time [kV],a\n0,1\n1,2\n", "line 1, column 1", "none of time"),
    "two decimal signs": ("time;a\n0;1,5\n1;2.5\n", "line 3", "decimal"),
    "thousands": ("time;a\n0;1.234,5\n1;2\n", "line 2, column 2", "text"),
}


@pytest.mark.parametrize(("text", "place", "what"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_name_their_place(tmp_path: Path, text: str, place: str, what: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(WaveformError) as caught:
        read_waveforms(path)
    assert str(path) in str(caught.value)
    assert place in str(caught.value)
    assert what in str(caught.value)


def test_columns_not_asked_for_may_hold_anything(tmp_path: Path) -> None:
    path = write(tmp_path, "time;a;state;b\n0;1;ok, so far;2\n1;2;;3.5\n")
    assert read_waveforms(path, ["b", "a"]).values.tolist() == [[2, 1], [3.5, 2]]
    with pytest.raises(WaveformError, match=r"line 2, column 3 \('state'\)"):
        read_waveforms(path)
    path = write(tmp_path, "time,a,b\n0,1,nan\n1,2,3\n")
    assert read_waveforms(path, ["a"])["a"].tolist() == [1, 2]


def test_steps_of_an_event_keep_first_and_last(tmp_path: Path) -> None:
    rows = [(t / 10, 0.0) for t in range(20)] + [(2.0, float(k)) for k in range(5)] + [(2.1, 9.0)]
    found = read_waveforms(write(tmp_path, "time,a\n" + "".join(f"{t!r},{v!r}\n" for t, v in rows)))
    assert found.time[-3:].tolist() == [2.0, 2.0, 2.1]
    assert found["a"][-3:].tolist() == [0.0, 4.0, 9.0]


def test_places_that_are_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(WaveformError, match="no such file"):
        read_waveforms(tmp_path / "none.csv")
    with pytest.raises(WaveformError, match="a folder"):
        read_waveforms(tmp_path)
    with pytest.raises(WaveformError, match="cannot open"):
        read_waveforms("a\0b.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(WaveformError, match="regular file"):
        read_waveforms(tmp_path / "pipe.csv")
    (tmp_path / "empty.csv").touch()
    with pytest.raises(WaveformError, match="empty"):
        read_waveforms(tmp_path / "empty.csv")
    with open(tmp_path / "large.csv", "wb") as file:
        file.truncate(catalogue.MAX_BYTES + 1)
    with pytest.raises(WaveformError, match="too large"):
        read_waveforms(tmp_path / "large.csv")
    (tmp_path / "x.xyz").write_text("time,a\n0,1\n1,2\n")
    with pytest.raises(WaveformError, match=r"csv \(.*dymola-mat"):
        read_waveforms(tmp_path / "x.xyz")


def test_unknown_column_with_a_near_one(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'Irorder1'"):
        read_waveforms(write(tmp_path, "time,Irorder1\n0,1\n1,2\n"), ["Irorder9"])


def test_writing_escapes_what_a_spreadsheet_would_run(tmp_path: Path) -> None:
    signals = {"=1+1": [1, 2], "@x": [1, 2], "-y": [1, 2], "+z": [1, 2], "'=w": [1, 2], "a,b": [1, 2], 'q"r': [1, 2]}
    write_csv(trajectory([0, 1], signals), tmp_path / "x.csv")
    header = (tmp_path / "x.csv").read_text().splitlines()[0]
    assert header == "time,'=1+1,'@x,'-y,'+z,''=w,\"a,b\",\"q\"\"r\""
    assert read_waveforms(tmp_path / "x.csv").names == tuple(signals)


def test_writing_units_only_if_asked(tmp_path: Path) -> None:
    data = trajectory([0, 1], {"a": [1, 2], "b": [3, 4]}, {"a": "kV"})
    write_csv(data, tmp_path / "x.csv")
    assert (tmp_path / "x.csv").read_text() == "time,a,b\n0.0,1.0,3.0\n1.0,2.0,4.0\n"
    write_csv(data, tmp_path / "x.csv", units=True)
    assert (tmp_path / "x.csv").read_text().startswith("time [s],a [kV],b\n")
    assert list_signals(tmp_path / "x.csv") == [("a", "kV"), ("b", "")]


def test_what_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(WaveformError, match="infinite"):
        write_csv(trajectory([0, 1], {"a": [1, np.inf]}), tmp_path / "x.csv")
    with pytest.raises(WaveformError, match="'time'"):
        write_csv(trajectory([0, 1], {"time": [1, 2]}), tmp_path / "x.csv")
    with pytest.raises(WaveformError, match="cannot write"):
        write_csv(trajectory([0, 1], {"a": [1, 2]}), tmp_path / "none" / "x.csv")
    path = write(tmp_path, "time,a\n0,1\n1,2\n")
    with pytest.raises(WaveformError, match="same file"):
        convert(path, path)
    with pytest.raises(WaveformError, match="ending in"):
        convert(path, tmp_path / "x.xlsx")
    assert list(tmp_path.iterdir()) == [path]


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(0, 10), st.floats(-1e300, 1e300), st.floats(-1, 1)), min_size=2, max_size=30))
def test_numbers_come_back_to_the_last_bit(rows: list[tuple[float, float, float]]) -> None:
    table = np.array(rows)
    data = Trajectory(np.cumsum(table[:, 0] + 1e-3), table[:, 1:], ("a", "b"))
    with TemporaryDirectory() as folder:
        write_csv(data, Path(folder, "x.csv"))
        back = read_waveforms(Path(folder, "x.csv"))
    assert np.array_equal(back.time, data.time)
    assert np.array_equal(back.values, data.values)


def test_both_readers_agree_on_many_rows(tmp_path: Path) -> None:
    n = 30_000
    data = Trajectory(np.arange(n) * 1e-4, np.random.default_rng(0).standard_normal((n, 2)), ("a", "b"))
    write_csv(data, tmp_path / "x.csv")
    layout = csv_text._layout(tmp_path / "x.csv")
    fast = csv_text._fast(layout, [0, 2])
    assert fast is not None
    assert np.array_equal(fast, csv_text._careful(layout, [0, 2], Clock()))


def write(folder: Path, text: str) -> Path:
    path = folder / "data.csv"
    path.write_bytes(text.encode())
    return path


def test_a_comma_in_a_name_between_blanks_separates_nothing(tmp_path: Path) -> None:
    path = tmp_path / "blanks.txt"
    path.write_text("time U(1,2) I\n0 1 2\n1 3 4\n")
    found = read_waveforms(path)
    assert found.names == ("U(1,2)", "I") and found["U(1,2)"].tolist() == [1.0, 3.0]
