"""Files as tools and people write them: titles, two header lines, other languages, dates, gaps, rows left out."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from hvdc_ident.data import trajectory
from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import convert, csv_text, files_of, list_signals, read_waveforms, write_csv
from hvdc_ident.formats._clock import Clock
from tests.formats.samples import SAMPLES

ROWS = ((0.0, 1.5, -2.0), (0.5, 1e-3, 4.0))
"""What every file of STYLES holds: time in s, U in kV, P in MW."""

STYLES = {
    "German Excel": ("Zeit [s];U [kV];P [MW]\n0;1,5;-2\n0,5;0,001;4\n", "cp1252"),
    "sep line and units below": ("sep=;\nZeit;U;P\n[ms];[kV];[MW]\n0;1,5;-2\n500;0,001;4\n;;\n", "cp1252"),
    "title above": ("Messung Müller;;\nGerät 7\n\nt/ms;U/kV;P/MW\n0;1,5;-2\n500;0,001;4\n", "cp1252"),
    "French": ("Temps (ms);U (kV);P (MW)\n0;1,5;-2\n500;1,0E-3;4\n", "utf-8"),
    "brackets without a blank": ('"Time(s)","U(kV)","P(MW)"\n0,1.5,-2\n0.5,1e-3,4\n', "utf-8"),
    "PowerFactory": ('"All calculations","U","P"\n"Time in s","in kV","in MW"\n0,1.5,-2\n0.5,1e-3,4\n', "utf-8"),
    "stroke": ("t / s\tU / kV\tP / MW\n0\t1.5\t-2\n0.5\t1e-3\t4\n", "utf-8"),
    "Excel's Unicode text": ("Time [s]\tU [kV]\tP [MW]\r\n0\t1,5\t-2\r\n0,5\t0,001\t4\r\n", "utf-16"),
    "index first": (",time [s],U [kV],P [MW]\n0,0,1.5,-2\n1,0.5,1e-3,4\n", "utf-8"),
    "sample number first": ("Sample;Zeit [ms];U [kV];P [MW]\n17;0;1,5;-2\n18;500;0,001;4\n", "utf-8"),
    "dates, the month first": (
        "Timestamp,U (kV),P (MW)\n11/30/2026 11:59:59.750 PM,1.5,-2\n12/01/2026 12:00:00.250 AM,1e-3,4\n", "utf-8",
    ),
    "dates in a column of their own": (
        "Datum;Uhrzeit;U [kV];P [MW]\n30.11.2026;23:59:59,75;1,5;-2\n01.12.2026;00:00:00,25;0,001;4\n", "utf-8",
    ),
    "decimal commas in quotes": ('"Zeit [s]","U [kV]","P [MW]"\n"0","1,5","-2"\n"0,5","0,001","4"\n', "cp1252"),
    "oscilloscope": (
        "Model,DPO4054\nSample Interval,0.5\n\nTIME [s],U [kV],P [MW]\n0.0,1.5,-2\n5.0e-01,1e-3,4\n", "utf-8",
    ),
    "seconds since 1970": ("timestamp,U [kV],P [MW]\n1732440000.25,1.5,-2\n1732440000.75,1e-3,4\n", "utf-8"),
    "milliseconds since 1970": ("timestamp,U [kV],P [MW]\n1732440000250,1.5,-2\n1732440000750,1e-3,4\n", "utf-8"),
    "microseconds since 1970": (
        "timestamp [us],U [kV],P [MW]\n1732440000250000,1.5,-2\n1732440000750000,1e-3,4\n", "utf-8",
    ),
    "blanks at the end": ("time[s], U[kV], P[MW],\n0, 1.5, -2,\n0.5, 1e-3, 4,\n\n", "utf-8"),
}  # fmt: skip


def put(folder: Path, text: str, encoding: str = "utf-8", name: str = "x.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(("text", "encoding"), STYLES.values(), ids=STYLES)
def test_one_record_in_many_styles(tmp_path: Path, text: str, encoding: str) -> None:
    path = put(tmp_path, text, encoding)
    found = read_waveforms(path, ["U", "P"])
    np.testing.assert_allclose(np.column_stack([found.time - found.time[0], found.values]), ROWS, rtol=1e-12)
    assert found.units == ("kV", "MW") and list_signals(path)[-2:] == [("U", "kV"), ("P", "MW")]


def test_names_with_strokes_and_brackets_that_are_no_units(tmp_path: Path) -> None:
    path = put(
        tmp_path, "t,P/Q,U (L1),dP/dt,V(bus1),Uf / p.u.,ROCOF / Hz/s,n / 1/min\n" + "0,1,2,3,4,5,6,7\n1,1,2,3,4,5,6,7\n"
    )
    assert list_signals(path) == [
        ("P/Q", ""), ("U (L1)", ""), ("dP/dt", ""), ("V(bus1)", ""), ("Uf", "p.u."), ("ROCOF", "Hz/s"), ("n", "1/min"),
    ]  # fmt: skip
    assert read_waveforms(path, ["Uf / p.u."]).unit("Uf / p.u.") == "p.u."


GAPS = "time;a;b\n0;1;2\n1;;2,5\n2;NaN;\n3;#NV;3\n4;5;n/a\n"


def test_cells_of_what_was_not_recorded(tmp_path: Path) -> None:
    path = put(tmp_path, GAPS)
    found = read_waveforms(path)
    np.testing.assert_array_equal(found["a"], [1.0, np.nan, np.nan, np.nan, 5.0])
    np.testing.assert_array_equal(found["b"], [2.0, 2.5, np.nan, 3.0, np.nan])
    assert (found.gaps("a"), found.gaps("b")) == (3, 2)


def test_both_readers_see_the_same_gaps(tmp_path: Path) -> None:
    path = put(tmp_path, "time,a,b,c\n0,1,,\n1,,,3\n2,nan,2,4\n")
    layout = csv_text._layout(path)
    quick = csv_text._fast(
        csv_text._layout(put(tmp_path, "time,a,b,c\n0,1,,9\n1,,,3\n2,nan,2,4\n", name="y.csv")), [0, 1, 2]
    )
    assert quick is not None
    np.testing.assert_array_equal(quick, [[0, 1, np.nan], [1, np.nan, np.nan], [2, np.nan, 2]])
    np.testing.assert_array_equal(
        csv_text._careful(layout, [0, 2, 3], Clock()), [[0, np.nan, np.nan], [1, np.nan, 3], [2, 2, 4]]
    )


def test_gaps_stay_gaps_in_what_is_written(tmp_path: Path) -> None:
    record = trajectory([0.0, 1.0, 2.0], {"a": [1.0, np.nan, 3.0], "nano": [np.nan, 2.0, np.nan]})
    write_csv(record, tmp_path / "x.csv")
    assert (tmp_path / "x.csv").read_text() == "time,a,nano\n0.0,1.0,\n1.0,,2.0\n2.0,3.0,\n"
    np.testing.assert_array_equal(read_waveforms(tmp_path / "x.csv").values, record.values)
    convert(tmp_path / "x.csv", tmp_path / "x.parquet")
    np.testing.assert_array_equal(read_waveforms(tmp_path / "x.parquet").values, record.values)


def test_a_comtrade_mark_for_a_missing_sample_is_a_gap(tmp_path: Path) -> None:
    SAMPLES["comtrade"](tmp_path / "r.cfg")
    data = tmp_path / "r.dat"
    data.write_text(data.read_text().replace("2,1000,101,-21,0", "2,1000,99999,-21,0"))
    assert np.isnan(read_waveforms(tmp_path / "r.cfg")["Vdc"]).tolist() == [False, True, False, False]


def test_rows_left_out_are_counted(tmp_path: Path) -> None:
    rows = [(t / 10, 0.0) for t in range(20)] + [(2.0, float(k)) for k in range(5)] + [(2.1, 9.0)]
    found = read_waveforms(put(tmp_path, "time,a\n" + "".join(f"{t!r},{v!r}\n" for t, v in rows)))
    assert (found.origin.rows, found.origin.dropped, len(found)) == (26, 3, 23)
    assert found.select(["a"]).origin.dropped == 3


def test_the_unit_of_the_time_is_known(tmp_path: Path) -> None:
    for label, unit in (("t", ""), ("t [s]", "s"), ("t/ms", "ms")):
        assert read_waveforms(put(tmp_path, f"{label},a\n0,1\n1,1\n")).origin.time_unit == unit
    assert read_waveforms(put(tmp_path, "n,time [ms],a\n0,0,1\n1,5,1\n")).origin.time_column == "time [ms]"


def test_every_file_behind_a_recording_is_listed(tmp_path: Path) -> None:
    for name, first, others in (
        ("comtrade", "r.cfg", ["r.dat"]), ("pscad", "run.inf", ["run_01.out", "run_02.out"]), ("csv", "x.csv", []),
    ):  # fmt: skip
        SAMPLES[name](tmp_path / first)
        assert [f.name for f in files_of(tmp_path / first)] == [first, *others]


def test_dates_of_one_record_that_no_order_explains_are_refused(tmp_path: Path) -> None:
    path = put(tmp_path, "Timestamp,a\n13/02/2026 00:00:00,1\n02/14/2026 00:00:01,1\n")
    with pytest.raises(WaveformError, match="line 3"):
        read_waveforms(path)


def test_a_table_on_its_side_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WaveformError, match="the signals stand in rows"):
        read_waveforms(put(tmp_path, "time;0;0,1;0,2\nu;1;1;2\ny;0,4;0,5;0,6\n"))


TIME = np.arange(280) * 0.01
SIGNALS = np.column_stack([np.cos(TIME), np.sin(3.0 * TIME)])
"""Neither increases all along."""

LAYOUTS = {
    "time across, signals down": {"t": TIME[None, :], "y": SIGNALS},
    "time down, signals across": {"t": TIME[:, None], "y": SIGNALS.T},
    "both across": {"time": TIME[None, :], "y": SIGNALS.T},
    "German time": {"Zeit": TIME[None, :], "y": SIGNALS.T},
    "one matrix down": {"y": np.column_stack([TIME, SIGNALS])},
    "one matrix across": {"y": np.column_stack([TIME, SIGNALS]).T},
}


@pytest.mark.parametrize("version", ["4", "5", "7.3"])
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_matlab_matrices_either_way_round(tmp_path: Path, layout: dict[str, np.ndarray], version: str) -> None:
    found = read_waveforms(saved(tmp_path, layout, version))
    np.testing.assert_array_equal(found.time, TIME)
    np.testing.assert_array_equal(found.values, SIGNALS)
    assert found.names == ("y(1)", "y(2)")


@pytest.mark.parametrize("version", ["4", "5", "7.3"])
def test_signals_beside_a_time_of_another_name_are_no_table(tmp_path: Path, version: str) -> None:
    """Two rows that happen to begin with an increase were once 279 signals of two rows."""
    path = saved(tmp_path, {"x_axis": TIME[None, :], "y": np.vstack([SIGNALS[:, 1], SIGNALS[:, 0]])}, version)
    with pytest.raises(WaveformError, match="'x_axis' increases all along: if it is the time, save it as 't'"):
        read_waveforms(path)


def saved(folder: Path, content: dict[str, np.ndarray], version: str) -> Path:
    """A MATLAB file; version 7.3 as MATLAB lays it out, with its axes the other way round."""
    path = folder / "x.mat"
    if version != "7.3":
        scipy.io.savemat(path, content, format=version)
        return path
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in content.items():
            file[name] = np.asarray(values, dtype=float).T
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")
    return path


def test_hdf5_sets_either_way_round_and_times_in_other_units(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["time"] = 1e3 * TIME
        file["time"].attrs["units"] = "milliseconds since 2026-11-24"
        file["y"] = SIGNALS.T
    found = read_waveforms(tmp_path / "x.h5")
    np.testing.assert_allclose(found.time, TIME, rtol=1e-15)
    np.testing.assert_array_equal(found.values, SIGNALS)


COMTRADE = (
    "UW,REC,{}\n2,2A,0D\n1,U,,,kV,0.1,0,0,-32767,32767{}\n2,P,,,MW,1,0,0,-32767,32767{}\n50\n1\n1000,3\n{}\n{}\n{}"
)


@pytest.mark.parametrize("revision", ["1991", "1999", "2013"])
def test_comtrade_of_three_editions(tmp_path: Path, revision: str) -> None:
    ratios = "" if revision == "1991" else ",1,1,P"
    day = (
        "03/24/20" if revision == "1991" else "24/03/2020"
    )  # the first edition has the month first and two digits of the year
    stamps = f"{day},10:00:00.000000", f"{day},10:00:00.001000"
    tail = {"1991": "ASCII\n", "1999": "ASCII\n1\n", "2013": "ASCII\n1\n0h00,0h00\nB,3\n"}[revision]
    text = COMTRADE.format(revision, ratios, ratios, *stamps, tail)
    if revision == "1991":
        text = text.replace(",1991\n", "\n", 1)
    (tmp_path / "r.cfg").write_text(text)
    (tmp_path / "r.dat").write_text("1,0,1100,5\n2,1000,,6\n3,2000,1098,7\n")
    found = read_waveforms(tmp_path / "r.cfg")
    np.testing.assert_allclose(found["U"], [110.0, np.nan, 109.8])
    np.testing.assert_array_equal(found["P"], [5.0, 6.0, 7.0])
    np.testing.assert_array_equal(found.time, [0.0, 0.001, 0.002])


def test_times_since_1970_count_from_the_first_row(tmp_path: Path) -> None:
    found = read_waveforms(put(tmp_path, "timestamp,a\n1732440000.00,1\n1732440000.02,1\n"))
    assert found.time[0] == 0.0 and found.time[1] == pytest.approx(
        0.02, abs=2.0**-22
    )  # half the spacing of doubles there
    assert found.origin.time_unit == "date"
    plain = read_waveforms(put(tmp_path, "time,a\n50000,1\n50001,1\n"))  # half a day: a clock of its own
    assert plain.time.tolist() == [50000.0, 50001.0] and plain.origin.time_unit == ""


def test_an_out_file_finds_its_run(tmp_path: Path) -> None:
    SAMPLES["pscad"](tmp_path / "run.inf")
    whole, part = read_waveforms(tmp_path / "run.inf"), read_waveforms(tmp_path / "run_01.out")
    assert part.names == whole.names and np.array_equal(part.values, whole.values)
    assert {f.name for f in files_of(tmp_path / "run_02.out")} == {"run.inf", "run_01.out", "run_02.out"}
    (tmp_path / "run.inf").unlink()
    with pytest.raises(WaveformError, match="the list of channels is missing"):
        read_waveforms(tmp_path / "run_01.out")


def test_structures_inside_a_structure(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "x.mat", {"log": {"t": TIME, "grid": {"U": SIGNALS[:, 0], "P": SIGNALS[:, 1]}}})
    found = read_waveforms(tmp_path / "x.mat")
    assert found.names == ("log.grid.U", "log.grid.P") and np.array_equal(found.values, SIGNALS)
