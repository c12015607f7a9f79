"""COMTRADE as devices write it: pauses that only the time stamps tell, editions of other years, marks, odd fields.

Expected times are whole numbers of the stamps' unit, expected values the package `comtrade`'s of the plain record.
"""

from __future__ import annotations

import struct
from pathlib import Path

import comtrade
import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import list_signals, read_waveforms
from hvdc_ident.study import Summary, load_study
from tests.formats.samples import SAMPLES

DATES = "07/11/2024,06:30:00.250000\n07/11/2024,06:30:00.300000\n"


def header(rates: str, *, year: str = ",1999", kind: str = "ASCII", tail: str = "1\n", dates: str = DATES) -> str:
    return (
        f"MILL,FR{year}\n2,1A,1D\n1,Idc,,,A,0.25,-3,0,-8192,8191,1,1,P\n1,BRK,,,0\n60\n{rates}\n{dates}{kind}\n{tail}"
    )


def rows(stamps: list[int | None], samples: list[int] | None = None) -> str:
    samples = samples or [40 + 7 * k % 11 for k in range(len(stamps))]
    return "".join(
        f"{k + 1},{'' if t is None else t},{v},{k % 2}\r\n"
        for k, (t, v) in enumerate(zip(stamps, samples, strict=True))
    )


def binary(stamps: list[int]) -> bytes:
    return b"".join(struct.pack("<IIhH", k + 1, t, 40 + k, k % 2) for k, t in enumerate(stamps))


def put(folder: Path, head: str, data: str | bytes) -> Path:
    (folder / "r.cfg").write_text(head)
    (folder / "r.dat").write_bytes(data.encode() if isinstance(data, str) else data)
    return folder / "r.cfg"


def us(found: object) -> list[int]:
    """Times in whole microseconds."""
    return np.rint(1e6 * np.asarray(found)).astype(int).tolist()


# Pauses. At 1200 Hz a stamp is a third of a microsecond off, which adds up where a device adds rounded periods.

EXACT = [round(k * 1e6 / 1200) for k in range(30)]
ADDED = [833 * k for k in range(3000)]


def after(stamps: list[int], row: int, pause: int) -> list[int]:
    return [t + (pause if k >= row else 0) for k, t in enumerate(stamps)]


@pytest.mark.parametrize("segments", ["1\n1200,30", "2\n1200,12\n1200,30"])
def test_a_pause_of_the_stamps_is_kept_and_told(tmp_path: Path, segments: str) -> None:
    stamps = after(after(EXACT, 12, 2_500_000), 20, 700_000)
    found = read_waveforms(put(tmp_path, header(segments), rows(stamps)))
    np.testing.assert_allclose(1e6 * found.time, stamps, atol=1.0)
    (note,) = found.origin.notes
    assert "2 pauses" in note and "2.501 s after 0.00916667 s" in note and "0.7008 s" in note


def test_a_single_lost_sample_is_a_pause(tmp_path: Path) -> None:
    found = read_waveforms(put(tmp_path, header("1\n1200,30"), rows(after(EXACT, 7, 833))))
    assert found.time[7] - found.time[6] == pytest.approx(2 / 1200, abs=1e-6)
    assert "a pause" in found.origin.notes[0]


def test_binary_stamps_that_begin_again_at_the_end_of_their_four_bytes(tmp_path: Path) -> None:
    stamps = [2**32 - 2000 + t for t in after([1000 * k for k in range(8)], 5, 4000)]
    data = binary([t % 2**32 for t in stamps])
    found = read_waveforms(put(tmp_path, header("1\n1000,8", kind="BINARY"), data))
    assert us(found.time) == [t - stamps[0] for t in stamps]


def test_stamps_that_begin_again_at_the_end_of_two_bytes(tmp_path: Path) -> None:
    stamps = after([1000 * k for k in range(200)], 150, 4000)
    found = read_waveforms(put(tmp_path, header("1\n1000,200"), rows([t % 2**16 for t in stamps])))
    assert us(found.time) == stamps
    (note,) = found.origin.notes
    assert "a pause" in note and "0.005 s after 0.149 s" in note


def test_one_file_whose_marks_of_sections_have_no_colon(tmp_path: Path) -> None:
    SAMPLES["comtrade"](tmp_path / "r.cff")
    whole = read_waveforms(tmp_path / "r.cff")
    text = (tmp_path / "r.cff").read_text("ascii")
    for standard, other in (("--- file type: CFG", "--- file type  CFG"), ("--- file type: DAT", "-- file type  DAT")):
        text = text.replace(standard, other)
    (tmp_path / "r.cff").write_text(text)
    np.testing.assert_array_equal(read_waveforms(tmp_path / "r.cff").values, whole.values)


def test_a_step_between_two_rates_is_the_one_that_the_stamps_tell(tmp_path: Path) -> None:
    for stamps in ([0, 500, 1000, 3000, 5000, 7000], [0, 500, 1000, 1500, 3500, 5500]):
        found = read_waveforms(put(tmp_path, header("2\n2000,3\n500,6"), rows(stamps)))
        assert us(found.time) == stamps and not found.origin.notes


@pytest.mark.parametrize(
    ("rate", "stamps"),
    [
        (1200, ADDED),  # 1 ms behind at the end
        (1200, [1000 * int(k / 1.2) for k in range(40)]),  # whole milliseconds only
        (960, [1000 * int(k / 0.96) for k in range(60)]),
        (1000, [1000 * k + 30 * (k % 3) for k in range(20)]),  # a clock that jitters
        (1000, [0] * 20),
        (1000, [None] * 20),
        (1000, [-3000, None, -1000, 0, 1000, None, None, 4000]),
    ],
)
def test_stamps_that_tell_nothing_new_change_nothing(tmp_path: Path, rate: int, stamps: list[int | None]) -> None:
    n = len(stamps)
    found = read_waveforms(put(tmp_path, header(f"1\n{rate},{n}"), rows(stamps)))
    np.testing.assert_array_equal(found.time, np.arange(n) / rate)
    assert found.origin.notes == ()


@pytest.mark.parametrize(
    ("stamps", "apart"),
    [
        ([1200 * k for k in range(20)], "0.0038 s"),  # another rate
        (list(range(20)), "0.01898 s"),  # another unit
        ([1000 * (k % 10) for k in range(20)], "0.01 s"),  # they begin again with every segment
        ([5_000_000 * k for k in range(20)], "94.98 s"),  # pauses only
        ([1000 * k + 400 * (k > 4) + 400 * (k > 9) for k in range(20)], "0.0008 s"),
        ([0, 1000, None, 9_000_000, *(9_000_000 + 1000 * k for k in range(1, 17))], "8.997 s"),  # on which side?
    ],
)
def test_stamps_that_contradict_the_rates_are_told(tmp_path: Path, stamps: list[int | None], apart: str) -> None:
    found = read_waveforms(put(tmp_path, header("1\n1000,20"), rows(stamps)))
    np.testing.assert_array_equal(found.time, np.arange(20) / 1000)
    (note,) = found.origin.notes
    assert "contradict the sampling rates" in note and f"by up to {apart}" in note


# Editions and fields


@pytest.mark.parametrize("year", [",1997", ",2000", ",C37.111-1999", ","])
@pytest.mark.parametrize("unit", ["250", "0.5"])
def test_the_time_multiplier_counts_whatever_the_year(tmp_path: Path, year: str, unit: str) -> None:
    text = rows([10, 12, 16, 18, 26])
    found = read_waveforms(put(tmp_path, header("0\n0,5", year=year, tail=f"{unit}\n"), text))
    known = comtrade.Comtrade(ignore_warnings=True, use_double_precision=True)
    known.read(header("0\n0,5", tail=f"{unit}\n"), text)
    np.testing.assert_allclose(found.time, np.array(known.time) - known.time[0], rtol=1e-9)
    assert found.time[-1] == pytest.approx(16e-6 * float(unit), rel=1e-12)
    np.testing.assert_array_equal(found["Idc"], known.analog[0])


@pytest.mark.parametrize(
    "change",
    [
        ("07/11/2024,06:30:00.250000", "11/27/2024,06:30:00.250000"),
        ("07/11/2024,06:30:00.250000", "00/00/0000,06:30:00"),
        ("07/11/2024,06:30:00.250000", "27-NOV-2024,06:30"),
        ("07/11/2024,06:30:00.300000", ""),
        ("1\n500,5", "3\n500,2\n500,5\n250,5"),
        ("1\n500,5", "4\n500,5\n0,5\n0,5\n0,5"),
        ("\n60\n", "\nfifty\n"),
        ("\n1,Idc", "\nA1,Idc"),
        (",1,1,P", ",,,P"),
        ("MILL,FR", "MILL, NORTH,FR"),
        ("BRK,,,0", "BRK,,,open"),
        ("ASCII\n1\n", "ASCII\n\n"),
        ("ASCII\n1\n", "ASCII\n1\nlocal\n"),
    ],
)
def test_a_field_that_no_waveform_depends_on_refuses_no_record(tmp_path: Path, change: tuple[str, str]) -> None:
    plain, data = header("1\n500,5"), rows([2000 * k for k in range(5)])
    assert change[0] in plain
    found = read_waveforms(put(tmp_path, plain.replace(*change), data))
    known = comtrade.Comtrade(ignore_warnings=True, use_double_precision=True)
    known.read(plain, data)
    np.testing.assert_allclose(found.time, known.time, rtol=1e-15)
    np.testing.assert_array_equal(found.values, np.column_stack([known.analog[0], known.status[0]]))
    assert found.units == ("A", "") and found.origin.notes == ()


def test_a_multiplier_that_is_needed_has_to_be_a_number(tmp_path: Path) -> None:
    with pytest.raises(WaveformError, match="header cannot be read"):
        read_waveforms(put(tmp_path, header("0\n0,2", tail="one\n"), rows([0, 5])))


def test_nine_digits_of_a_second_make_the_stamps_nanoseconds(tmp_path: Path) -> None:
    head = header("0\n0,3", dates=DATES.replace("250000", "250000000").replace("07/11", "31/31"))
    assert us(read_waveforms(put(tmp_path, head, rows([0, 5000, 9000]))).time) == [0, 5, 9]


def test_digital_channels_of_1991_of_one_name_are_numbered(tmp_path: Path) -> None:
    head = header("1\n500,2", year="").replace("2,1A,1D", "3,1A,2D").replace("1,BRK,,,0", "1,BRK,0\n2,BRK,0")
    assert [n for n, _ in list_signals(put(tmp_path, head, ""))] == ["Idc", "BRK", "BRK (2)"]


# Samples outside the range of the header, -8192 to 8191


def test_a_number_outside_the_range_is_a_mark(tmp_path: Path) -> None:
    samples = [10, 99999, 12, 999999, 999999, -8192, 8191, -32768]
    found = read_waveforms(put(tmp_path, header("1\n500,8"), rows([2000 * k for k in range(8)], samples)))
    nan = np.nan
    np.testing.assert_array_equal(found["Idc"], [-0.5, nan, 0.0, nan, nan, -2051.0, 2044.75, nan])
    (note,) = found.origin.notes
    assert note.startswith("Idc: 1 sample outside the range of the header, -8192 to 8191: -32768 is taken as the mark")
    assert "2 samples" in note and "999999" in note
    assert found["BRK"].tolist() == [0, 1] * 4


def test_different_numbers_outside_the_range_are_a_signal_and_told(tmp_path: Path) -> None:
    samples = [8000, 8190, 8300, 8400, 8350, 8190, 8000, 9.5]
    found = read_waveforms(put(tmp_path, header("1\n500,8"), rows([2000 * k for k in range(8)], samples)))
    np.testing.assert_array_equal(found["Idc"], [0.25 * v - 3 for v in samples])
    assert "kept, for none is a mark of what was not recorded, 8300 to 8400" in found.origin.notes[0]


def test_a_level_outside_the_range_is_a_signal_and_told(tmp_path: Path) -> None:
    """A signal of two levels, the upper one beyond a range that the header gives too narrow."""
    samples = [8000, 8000, 8000, 40000, 40000, 40000, 8000, 8000]
    found = read_waveforms(put(tmp_path, header("1\n500,8"), rows([2000 * k for k in range(8)], samples)))
    np.testing.assert_array_equal(found["Idc"], [0.25 * v - 3 for v in samples])
    assert "3 samples outside the range of the header, -8192 to 8191: kept" in found.origin.notes[0]


@pytest.mark.parametrize("scale", ["0,-3", "1e-18,-3", "1e-310,-3"])
def test_samples_that_the_offset_swallows_have_no_marks(tmp_path: Path, scale: str) -> None:
    head = header("1\n500,3").replace("0.25,-3", scale)
    found = read_waveforms(put(tmp_path, head, rows([0, 2000, 4000], [1, 40000, 3])))
    np.testing.assert_allclose(found["Idc"], -3.0, rtol=1e-12)
    assert found.origin.notes == ()


@pytest.mark.parametrize(
    "change", [("1\n500,3", "1\n1e-310,3"), ("ASCII\n1\n", "ASCII\n1e300\n"), ("500,3", f"500,{10**400}")]
)
def test_times_beyond_all_numbers_are_refused(tmp_path: Path, change: tuple[str, str]) -> None:
    with pytest.raises(WaveformError, match="a number in the header"):
        read_waveforms(put(tmp_path, header("1\n500,3").replace(*change), rows([0, 2000, 4000])))


@pytest.mark.parametrize("limits", ["0,0", "8191,-8192", ",", "none,none", "nan,nan", "-inf,inf"])
def test_a_header_without_a_range_makes_no_marks(tmp_path: Path, limits: str) -> None:
    head = header("1\n500,3").replace("-8192,8191", limits)
    found = read_waveforms(put(tmp_path, head, rows([0, 2000, 4000], [50000, 4, 60000])))
    assert found["Idc"].tolist() == [12497.0, -2.0, 14997.0] and found.origin.notes == ()


def test_a_limit_that_is_the_rounded_extreme_makes_no_marks(tmp_path: Path) -> None:
    head = header("1\n500,3", kind="FLOAT32").replace("-8192,8191", "-1.23,4.57")
    values = np.array([-1.2349, 4.5749, 4.59], dtype=np.float32)
    data = b"".join(struct.pack("<IIfH", k + 1, 2000 * k, v, 0) for k, v in enumerate(values))
    found = read_waveforms(put(tmp_path, head, data))
    np.testing.assert_allclose(found["Idc"], 0.25 * values.astype(float) - 3.0, rtol=1e-6)
    assert "1 sample outside the range of the header, -1.23 to 4.57: kept" in found.origin.notes[0]


# Where a user reads it


def test_convert_and_check_tell(tmp_path: Path) -> None:
    stamps = [10_000 * k + 400_000 * (k >= 25) for k in range(60)]
    samples = [40 if k < 10 else 60 for k in range(60)]
    samples[3] = 999999
    record = put(tmp_path, header("1\n100,60"), rows(stamps, samples))
    said = CliRunner().invoke(app, ["convert", str(record), "--to", str(tmp_path / "out.csv")])
    assert said.exit_code == 0
    assert "kept: 0.41 s after 0.24 s" in said.stdout and "999999 is taken as the mark" in said.stdout
    (tmp_path / "m.toml").write_text(
        'schema = 1\nname = "m"\n[parameters]\nT = {value = 0.1, min = 0.01, max = 1}\n[inputs]\nu = {value = 0}\n'
        '[states]\nx = {derivative = "(u - x) / T"}\n[outputs]\ny = "x"\n'
    )
    (tmp_path / "s.toml").write_text(
        'schema = 1\nname = "s"\n[model]\nsource = "m.toml"\n[parameters]\nT = {start = 0.1, min = 0.01, max = 1}\n'
        '[[experiment]]\nname = "e"\ndata = "r.cfg"\ninputs = {u = "BRK"}\noutputs = {y = "Idc"}\n'
    )
    summary = Summary.of(load_study(tmp_path / "s.toml"))
    assert "a pause in the recording" in str(summary) and "999999" in str(summary)
    assert len(summary.to_dict()["experiments"]["e"]["recording"]["notes"]) == 2
