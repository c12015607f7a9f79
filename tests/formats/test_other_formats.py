"""MATLAB, PSCAD, HDF5, netCDF and Parquet files written by other packages or as their tools lay them out."""

from __future__ import annotations

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import convert, list_signals, read_waveforms
from hvdc_ident.formats._columns import own_names
from tests.formats.samples import SAMPLES

TIME = np.array([0.0, 0.1, 0.2, 0.3])
Y = np.array([1.0, 1.0, 1.5, 1.25])


def test_simulink_structure_with_time(tmp_path: Path) -> None:
    from scipy.io import savemat

    signals = np.zeros(2, dtype=[("values", object), ("label", object), ("dimensions", object)])
    signals[0] = (Y[:, None], "P ref", 1.0)
    signals[1] = (np.column_stack([Y, -Y]), "", 2.0)
    savemat(tmp_path / "s.mat", {"out": {"time": TIME[:, None], "signals": signals, "blockName": "m/Scope"}})
    found = read_waveforms(tmp_path / "s.mat")
    assert found.names == ("P ref", "out.2(1)", "out.2(2)")
    np.testing.assert_array_equal(found.values, np.column_stack([Y, Y, -Y]))
    np.testing.assert_array_equal(found.time, TIME)


@pytest.mark.parametrize("rows", ["signals", "samples"])
def test_a_matrix_with_time_first_either_way_round(tmp_path: Path, rows: str) -> None:
    from scipy.io import savemat

    table = np.column_stack([TIME, Y, 2 * Y])
    savemat(tmp_path / "s.mat", {"ans": table.T if rows == "signals" else table})
    found = read_waveforms(tmp_path / "s.mat")
    assert found.names == ("ans(1)", "ans(2)")
    np.testing.assert_array_equal(found.values[:, 1], 2 * Y)


FAST = np.array([0.0, 0.05, 0.1, 0.15000000000000002, 0.2, 0.2, 0.25, 0.30000000000000004])
"""Two rows at 0.2 s, and instants that differ from those of TIME by their rounding."""


def test_structures_of_two_rates_stand_at_their_own_rows(tmp_path: Path) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "s.mat", {"a": {"time": FAST, "x": np.arange(8.0)}, "b": {"time": TIME, "y": Y, "z": -Y}})
    found = read_waveforms(tmp_path / "s.mat")
    assert found.names == ("a.x", "b.y", "b.z") and found.origin.records == (("a.x",), ("b.y", "b.z"))
    np.testing.assert_allclose(found.time, FAST, rtol=1e-15)
    np.testing.assert_array_equal(found["a.x"], np.arange(8.0))
    nan = np.nan
    np.testing.assert_array_equal(found["b.y"], [Y[0], nan, Y[1], nan, nan, Y[2], nan, Y[3]])  # after the jump at 0.2 s
    assert found.gaps("b.y") == 0 and found.own_rows("b.z").sum() == 4
    assert "each at its own instants: 8 rows of a.x, 4 rows of b.y" in found.origin.notes[0]


def test_the_signals_of_one_record_alone_have_its_rows(tmp_path: Path) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "s.mat", {"a": {"time": FAST, "x": np.arange(8.0)}, "b": {"time": TIME, "y": Y, "z": -Y}})
    found = read_waveforms(tmp_path / "s.mat", ["b.z"])
    np.testing.assert_array_equal(found.time, TIME)
    np.testing.assert_array_equal(found["b.z"], -Y)
    assert found.origin.records == () and found.origin.notes == ()
    convert(tmp_path / "s.mat", tmp_path / "s.csv")
    assert (tmp_path / "s.csv").read_text().splitlines()[2] == "0.05,1.0,,"


def test_records_that_share_no_time_and_gaps_of_their_own(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one/time"], file["one/P"], file["one/Q"] = [0.0, 1.0], [1.0, np.nan], [2.0, 2.5]
        file["two/time"], file["two/P"] = [5.0, 6.0], [3.0, 4.0]
    found = read_waveforms(tmp_path / "a.h5")
    assert found.time.tolist() == [0.0, 1.0, 5.0, 6.0]
    assert {name: found.gaps(name) for name in found.names} == {"one/P": 1, "one/Q": 0, "two/P": 0}


def test_records_since_1970_keep_the_time_between_their_starts(tmp_path: Path) -> None:
    start = 1_732_440_000_123_456_789
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, first, step in (("fast", start + 2_000, 1_000), ("slow", start, 3_000)):
            file[f"{name}/time"] = first + step * np.arange(3)
            file[f"{name}/time"].attrs["units"] = "ns"
            file[f"{name}/u"] = np.arange(3.0)
    found = read_waveforms(tmp_path / "a.h5")
    np.testing.assert_allclose(found.time, [0.0, 2e-6, 3e-6, 4e-6, 6e-6], rtol=1e-9)
    assert found["fast/u"][1:4].tolist() == [0.0, 1.0, 2.0]


def test_version_7_3(tmp_path: Path) -> None:
    path = tmp_path / "s.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", TIME[None, :]), ("y", Y[None, :]), ("u", np.vstack([Y, -Y]))):
            file[name] = values  # MATLAB's column vectors and matrices, axes the other way round
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))
    found = read_waveforms(path)
    assert found.names == ("u(1)", "u(2)", "y")
    np.testing.assert_array_equal(found["u(2)"], -Y)


def test_pscad_channels_beyond_ten_stand_in_the_second_file(tmp_path: Path) -> None:
    SAMPLES["pscad"](tmp_path / "run.inf")
    found = read_waveforms(tmp_path / "run.inf", ["S12", "S3"])
    np.testing.assert_allclose(found.values, np.column_stack([12 + found.time, 3 + found.time]))
    assert found.units == ("MW", "kV")
    (tmp_path / "run_02.out").unlink()
    assert read_waveforms(tmp_path / "run.inf", ["S3"]).names == ("S3",)
    with pytest.raises(WaveformError, match=r"run_02\.out"):
        read_waveforms(tmp_path / "run.inf")


def test_pscad_channels_up_to_ten_may_stand_in_one_file_without_a_number(tmp_path: Path) -> None:
    """Those beyond ten do not stand there."""
    SAMPLES["pscad"](tmp_path / "run.inf")
    (tmp_path / "run_01.out").rename(tmp_path / "run.out")
    assert read_waveforms(tmp_path / "run.inf", ["S3"])["S3"].tolist() == [3.0, 3.05, 3.1]
    (tmp_path / "run_02.out").unlink()
    with pytest.raises(WaveformError, match=r"channels 11 to 20 is missing.*run_02\.out"):
        read_waveforms(tmp_path / "run.inf", ["S12"])


def test_names_that_stand_twice_are_numbered_past_those_that_are_there() -> None:
    assert own_names(["a", "a", "b", "a (2)", "a"]) == ("a", "a (3)", "b", "a (2)", "a (4)")


ALL = ("a.parquet", "a.inf", "a.h5", "a.mat")


@pytest.mark.parametrize(
    ("times", "what", "name"),
    [
        *(([0.0], "too few rows; expected at least 2, got 1", n) for n in ("a.parquet", "a.h5")),
        *(([0.0, np.nan, 0.2], "the time in row 2 is not finite; expected a time in s, got nan", n) for n in ALL),
        *(
            ([0.0, 0.2, 0.1], "the time goes back in row 3, from 0.2 s to 0.1 s; expected increasing times", n)
            for n in ALL
        ),
    ],
)
def test_times_that_are_none_are_refused_alike(tmp_path: Path, times: list[float], what: str, name: str) -> None:
    y = np.zeros(len(times))
    if name == "a.parquet":
        pytest.importorskip("pyarrow.parquet").write_table(
            pytest.importorskip("pyarrow").table({"time": times, "y": y}), tmp_path / name
        )
    elif name == "a.inf":
        (tmp_path / name).write_text('PGB(1) Output Desc="y" Group="" Max=2.0 Min=-2.0 Units=""\n', "utf-8")
        (tmp_path / "a_01.out").write_text("\n" + "".join(f"{t} 0.0\n" for t in times), "utf-8")
    elif name == "a.h5":
        with h5py.File(tmp_path / name, "w") as file:
            file["time"], file["y"] = times, y
    else:
        from scipy.io import savemat

        savemat(tmp_path / name, {"time": times, "y": y})
    with pytest.raises(WaveformError, match=rf"{what}. Try: "):
        read_waveforms(tmp_path / name)


def test_netcdf_of_both_kinds(tmp_path: Path) -> None:
    from scipy.io import netcdf_file

    with netcdf_file(tmp_path / "a.nc", "w") as file:
        file.createDimension("time", 4)
        for name, values, unit in (("time", TIME, "s"), ("P", Y, "MW")):
            variable = file.createVariable(name, "d", ("time",))
            variable[:] = values
            variable.units = unit
    found = read_waveforms(tmp_path / "a.nc")
    assert (found.names, found.units) == (("P",), ("MW",))
    np.testing.assert_array_equal(found["P"], Y)


def test_hdf5_groups_without_a_time_use_the_one_above(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"] = TIME
        file["left/P"] = Y
        file["right/time"] = TIME[::2]
        file["right/Q"] = Y[::2]
        file["away"] = h5py.ExternalLink("/etc/passwd", "/")
    found = read_waveforms(tmp_path / "a.h5")
    assert set(found.names) == {"left/P", "right/Q"}
    np.testing.assert_array_equal(found["right/Q"], [Y[0], np.nan, Y[2], np.nan])
    np.testing.assert_array_equal(found.time, TIME)


def test_parquet_written_by_another_package_with_time_stamps(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    stamps = np.datetime64("2026-11-21T10:00:00") + (TIME * 1000).astype("timedelta64[ms]")
    pq.write_table(pa.table({"y": Y, "Time": stamps, "site": ["a"] * 4}), tmp_path / "a.parquet")
    found = read_waveforms(tmp_path / "a.parquet")
    assert found.names == ("y",)
    np.testing.assert_allclose(found.time, TIME, atol=1e-9)


def test_to_parquet_and_back_keeps_every_bit_and_the_unit(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "a.csv").write_text("time,P [MW],q\n0,0.1,3\n0.1,0.30000000000000004,4\n", "utf-8")
    convert(tmp_path / "a.csv", tmp_path / "a.parquet")
    assert list_signals(tmp_path / "a.parquet") == [("P", "MW"), ("q", "")]
    assert read_waveforms(tmp_path / "a.parquet")["P"][1] == 0.30000000000000004
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.parquet"]


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (["2026-11-21 10:15:00.000", "2026-11-21 10:15:00.020", "2026-11-21T10:15:00.040"], [0, 0.02, 0.04]),
        (["21/11/2026 23:59:59.98", "22/11/2026 00:00:00.00", "22/11/2026 00:00:00.02"], [0, 0.02, 0.04]),
        (["23:59:59.980", "00:00:00.000", "00:00:00.020"], [0, 0.02, 0.04]),
        (["2026-11-21T10:15:00+01:00", "2026-11-21T09:15:00.5Z", "2026-11-21T09:15:01Z"], [0, 0.5, 1.0]),
    ],
)
def test_dates_count_from_the_first_row(tmp_path: Path, times: list[str], expected: list[float]) -> None:
    rows = "\n".join(f"{t};{n},5" for n, t in enumerate(times))
    (tmp_path / "pmu.csv").write_text(f"Timestamp;V:MAG\n{rows}\n", "utf-8")
    found = read_waveforms(tmp_path / "pmu.csv")
    np.testing.assert_allclose(found.time, expected, atol=1e-9)
    np.testing.assert_array_equal(found["V:MAG"], [0.5, 1.5, 2.5])


def test_a_broken_date_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "pmu.csv").write_text("t,v\n2026-11-21 10:15:00,1\n2026-13-21 10:15:01,2\n", "utf-8")
    with pytest.raises(WaveformError, match=r"line 3.*2026-13-21"):
        read_waveforms(tmp_path / "pmu.csv")


def element(kind: int, content: bytes) -> bytes:
    """An element of a MATLAB 5 file: its kind, its length, and its bytes up to a multiple of 8."""
    return struct.pack("<II", kind, len(content)) + content.ljust(-(-len(content) // 8) * 8, b"\0")


def test_matlab_objects_are_refused_with_the_way_out(tmp_path: Path) -> None:
    """A file of one variable of class 17, as a timeseries is saved, laid out by hand."""
    inner = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 1, 2)) + element(1, b"")
    inner += element(6, struct.pack("<II", 1, 2))
    names = b"".join(element(1, name) for name in (b"ts", b"MCOS", b"timeseries"))
    body = element(6, struct.pack("<II", 17, 0)) + names + element(14, inner)
    (tmp_path / "s.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + element(14, body))
    with pytest.raises(WaveformError, match=r"'ts' is a MATLAB object.*Structure with time"):
        read_waveforms(tmp_path / "s.mat")


@pytest.mark.parametrize("version", ["4", "5"])
def test_complex_numbers_are_two_signals(tmp_path: Path, version: str) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "s.mat", {"t": TIME, "v": Y + 2j * TIME}, format=version)
    found = read_waveforms(tmp_path / "s.mat")
    np.testing.assert_array_equal(found["v.real"], Y)
    np.testing.assert_array_equal(found["v.imag"], 2 * TIME)


def test_a_file_that_unpacks_to_more_than_memory_may_take_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "s.mat", "w", userblock_size=512) as file:
        file.create_dataset("t", (10**10,), "f8", chunks=(10**6,), fillvalue=0.0)
    with open(tmp_path / "s.mat", "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))
    with pytest.raises(WaveformError, match="too much memory"):
        read_waveforms(tmp_path / "s.mat")


@pytest.mark.parametrize("name", ["parabola", "some_functions"])
def test_matlab_functions_beside_waveforms_do_not_refuse_a_file(tmp_path: Path, name: str) -> None:
    """Files of MATLAB's own that scipy is tested with; here a time and a signal stand before what they hold."""
    import scipy
    from scipy.io import savemat

    path = Path(scipy.__file__).parent / "io/matlab/tests/data" / f"{name}.mat"
    if not path.is_file():
        pytest.skip("scipy is installed without its tests")
    savemat(tmp_path / "s.mat", {"t": TIME, "y": Y})
    (tmp_path / "s.mat").write_bytes((tmp_path / "s.mat").read_bytes() + path.read_bytes()[128:])
    np.testing.assert_array_equal(read_waveforms(tmp_path / "s.mat", ["y"])["y"], Y)


@pytest.mark.parametrize("compressed", [False, True])
def test_what_another_package_writes_is_read_as_it_reads_it(tmp_path: Path, compressed: bool) -> None:
    from scipy.io import savemat

    rng = np.random.default_rng(0)
    wanted = {
        "t": np.arange(5.0),
        "single": rng.normal(size=5).astype("f4"),
        "whole": np.arange(5, dtype="i2"),
        "flags": np.array([True, False, True, True, False]),
        "wide": rng.normal(size=(5, 2)),
    }
    savemat(
        tmp_path / "s.mat",
        {**wanted, "text": "a label", "cells": np.array([1, "x"], object)},
        do_compression=compressed,
    )
    found = read_waveforms(tmp_path / "s.mat")
    np.testing.assert_array_equal(found["single"], wanted["single"])
    np.testing.assert_array_equal(found["whole"], wanted["whole"])
    np.testing.assert_array_equal(found["flags"], wanted["flags"])
    np.testing.assert_array_equal(found["wide(2)"], wanted["wide"][:, 1])
