"""Result files of Dymola: against a real one, read independently, and against ones made with another writer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from hvdc_ident.errors import UnknownNameError, WaveformError
from hvdc_ident.formats import convert, list_signals, read_waveforms

REAL = Path(__file__).parents[2] / "../shared/data/dymola/TwoNodePowerSystem.mat"
needs_real = pytest.mark.skipif(not REAL.is_file(), reason=f"no recorded result file at {REAL}")

P = "vSC_MMC_AVMP.upperLevel.p_Controller.P"
ID_REF = "vSC_MMC_AVMP.upperLevel.innerControl.Id_ref"
V_C = "vSC_MMC_AVMP.aVM.capacitor.v"
KP = "vSC_MMC_AVMP.upperLevel.KPVDC"


@pytest.fixture(scope="module")
def oracle() -> dict[str, Any]:
    """The file by scipy, its dataInfo still to be interpreted."""
    found = scipy.io.loadmat(REAL, chars_as_strings=False)
    return {
        "names": ["".join(c).rstrip("\0 ") for c in found["name"].T],
        "texts": ["".join(c).rstrip("\0 ") for c in found["description"].T],
        "info": found["dataInfo"].T,
        "data_1": found["data_1"].astype(float),
        "data_2": found["data_2"].astype(float),
    }


@needs_real
@pytest.mark.parametrize("name", [P, ID_REF, V_C, KP, "vSC_MMC_AVMP.upperLevel.q_Controller.QREF"])
def test_values_of_a_real_file(oracle: dict[str, Any], name: str) -> None:
    table, column = oracle["info"][oracle["names"].index(name)][:2]
    found = read_waveforms(REAL, [name])
    if table == 1:
        expected = np.full(len(found), oracle["data_1"][abs(column) - 1, 0])
    else:
        expected = oracle["data_2"][abs(column) - 1]
    assert np.array_equal(found[name], np.sign(column) * expected)
    assert np.array_equal(found.time, oracle["data_2"][0])


@needs_real
def test_every_signal_of_a_real_file(oracle: dict[str, Any]) -> None:
    found = read_waveforms(REAL)
    assert len(found.names) == len(oracle["names"]) - 1
    assert found.names == tuple(oracle["names"][1:])
    for j, (table, column) in enumerate(oracle["info"][1:, :2]):
        expected = oracle[f"data_{table}"][abs(column) - 1]
        expected = expected if table == 2 else expected[0]
        assert (found.values[:, j] == np.sign(column) * expected).all()


@needs_real
def test_negative_aliases_of_a_real_file(oracle: dict[str, Any]) -> None:
    places = [tuple(row[:2]) for row in oracle["info"]]
    name, opposite = next(
        (oracle["names"][i], oracle["names"][places.index((2, -c))])
        for i, (t, c) in enumerate(places)
        if t == 2 and c < 0 and (2, -c) in places
    )
    found = read_waveforms(REAL, [name, opposite])
    assert np.array_equal(found[name], -found[opposite])
    assert found[name].any()


@needs_real
def test_gains_of_a_real_file() -> None:
    gains = {"KPVDC": 9.6, "KIVDC": 293.877551, "KIP": 30.0, "KPP": 0.0, "KIQ": 30.0, "KPQ": 0.0, "Ictrl_KP": 0.4870141}
    for station in ("vSC_MMC_AVMP", "vSC_MMC_AVMVDC"):
        found = read_waveforms(REAL, [f"{station}.upperLevel.{g}" for g in gains])
        assert found.values[0] == pytest.approx(list(gains.values()), rel=1e-6)
        assert (found.values == found.values[0]).all()


@needs_real
def test_units_and_search_in_a_real_file() -> None:
    units = dict(list_signals(REAL))
    assert units[V_C] == "V"
    assert units["resistor.R"] == "Ohm"
    assert units["resistor.T_ref"] == "K"
    assert units["vSC_MMC_AVMP.upperLevel.Mode"] == ""
    assert [n for n, _ in list_signals(REAL, "*avmp*p_controller.p")] == [P]
    assert "Time" not in units


@needs_real
def test_a_real_file_becomes_csv(tmp_path: Path) -> None:
    found = convert(REAL, tmp_path / "x.csv", [P, V_C])
    back = read_waveforms(tmp_path / "x.csv")
    assert back.names == (P, V_C)
    assert np.array_equal(back.values, found.values)


@pytest.mark.parametrize("layout", ["binTrans", "binNormal"])
@pytest.mark.parametrize("time_table", [0, 2])
def test_layouts(tmp_path: Path, layout: str, time_table: int) -> None:
    path = result(tmp_path, layout=layout, info=[[time_table, 1, 0, -1], [1, 2, 0, 0], [2, 2, 0, 0], [2, -3, 0, 0]])
    found = read_waveforms(path, ["R", "v", "n"])
    assert found.time.tolist() == [0.0, 1.0, 2.0]
    assert found.values.tolist() == [[5.0, 10.0, -20.0], [5.0, 11.0, -21.0], [5.0, 12.0, -22.0]]
    assert found.units == ("Ohm", "V", "")


def test_an_event_keeps_its_first_and_last_row(tmp_path: Path) -> None:
    rows = [[0, 1, 1], [1, 2, 0], [1, 3, 0], [1, 4, 0], [1, 5, 0], [2, 6, 0], [2, 7, 0]]
    found = read_waveforms(result(tmp_path, data_2=rows), ["v"])
    assert found.time.tolist() == [0, 1, 1, 2, 2]
    assert found["v"].tolist() == [1, 2, 5, 6, 7]


def test_a_table_with_times_of_its_own(tmp_path: Path) -> None:
    path = result(tmp_path, data_1=[[0, 5], [2, 9]])
    assert read_waveforms(path, ["R"])["R"].tolist() == [5, 7, 9]


@pytest.mark.parametrize("data_1", [[[0, 5]], [[0, 5], [2, 5]]])
def test_constants_are_expanded(tmp_path: Path, data_1: list[list[float]]) -> None:
    assert read_waveforms(result(tmp_path, data_1=data_1), ["R"])["R"].tolist() == [5, 5, 5]


def test_big_endian(tmp_path: Path) -> None:
    path = tmp_path / "big.mat"
    texts = {"Aclass": ["Atrajectory", "1.1", "", "binTrans"], "name": ["time", "x"], "description": ["", "[m]"]}
    numbers = {"dataInfo": [[0, 1, 0, -1], [2, 2, 0, 0]], "data_2": [[0.0, 1.5], [1.0, 2.5]]}
    content = b""
    for name, lines in texts.items():
        codes = np.array([list(s.ljust(11).encode()) for s in lines], np.uint8)
        content += header(name, *(codes.T if name == "Aclass" else codes).shape[::-1], kind=1051)
        content += (codes.T if name == "Aclass" else codes).tobytes()
    for name, rows in numbers.items():
        values = np.array(rows, ">f8")
        content += header(name, *values.shape[::-1], kind=1000) + values.tobytes()
    path.write_bytes(content)
    found = read_waveforms(path)
    assert found["x"].tolist() == [1.5, 2.5]
    assert found.unit("x") == "m"


def test_descriptions_may_be_missing(tmp_path: Path) -> None:
    assert read_waveforms(result(tmp_path, drop=["description"])).units == ("", "", "")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drop": ["data_2"]}, "no matrix 'data_2'"),
        ({"drop": ["dataInfo"]}, "no matrix 'dataInfo'"),
        ({"info": [[0, 1, 0, 0], [1, 3, 0, 0], [2, 2, 0, 0], [2, 3, 0, 0]]}, "'R' has no column"),
        ({"info": [[0, 1, 0, 0], [3, 2, 0, 0], [2, 2, 0, 0], [2, 3, 0, 0]]}, "'R' has no column"),
        ({"info": [[0, 1, 0, 0], [-1, 2, 0, 0], [2, 0, 0, 0], [2, 3, 0, 0]]}, "'R' has no column"),
        ({"info": [[0, 1, 0, 0], [1, 2, 0, 0]]}, "'dataInfo' does not fit"),
        ({"info": [[0, 1, 0, 0], [1, 2.5, 0, 0], [2, 2, 0, 0], [2, 3, 0, 0]]}, "whole numbers"),
        ({"info": [[0, 1, 0, 0], [1, np.nan, 0, 0], [2, 2, 0, 0], [2, 3, 0, 0]]}, "whole numbers"),
        ({"names": ["time", "R", "v", "v"]}, "two signals have the name 'v'"),
        ({"data_2": [[0, 1, 1], [2, 1, 1], [1, 1, 1]]}, "goes back in row 3"),
        ({"data_2": [[0, 1, 1], [np.nan, 1, 1]]}, "time in row 2"),
        ({"data_2": [[0, 1, 1], [1, 1, np.inf]]}, "'n' is infinite at 1 s"),
        ({"data_2": [[0, 1, 1]]}, "too few rows.*at least 2, got 1"),
        ({"layout": "binOther"}, "unknown layout"),
        ({"kind": "Alinear"}, "not a trajectory"),
    ],
)
def test_damage_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = result(tmp_path, **changes)
    with pytest.raises(WaveformError, match=message) as caught:
        read_waveforms(path)
    assert str(path) in str(caught.value)


def test_too_much_for_memory_asks_for_a_selection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hvdc_ident.formats._columns.MAX_BYTES", 50)
    path = result(tmp_path)
    with pytest.raises(WaveformError, match="name the signals you need"):
        read_waveforms(path)
    assert read_waveforms(path, ["v"])["v"].tolist() == [10, 11, 12]


def test_near_names(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="no signal 'vv'"):
        read_waveforms(result(tmp_path), ["vv"])


def test_matlab_files_without_a_time_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.mat"
    scipy.io.savemat(path, {"A": np.eye(3)})
    with pytest.raises(WaveformError):
        read_waveforms(path)
    scipy.io.savemat(path, {"A": np.eye(3)}, format="4")
    with pytest.raises(WaveformError, match="nothing in the file is known to be the time"):
        read_waveforms(path)


def header(name: str, rows: int, columns: int, kind: int = 0) -> bytes:
    """The header of a MATLAB v4 matrix, big-endian."""
    return np.array([kind, rows, columns, 0, len(name) + 1], ">i4").tobytes() + name.encode() + b"\0"


def result(
    folder: Path,
    *,
    layout: str = "binTrans",
    kind: str = "Atrajectory",
    names: list[str] | None = None,
    info: Any = ((0, 1, 0, -1), (1, 2, 0, 0), (2, 2, 0, 0), (2, 3, 0, 0)),
    data_1: Any = ((0, 5), (2, 5)),
    data_2: Any = ((0, 10, 20), (1, 11, 21), (2, 12, 22)),
    drop: list[str] | None = None,
) -> Path:
    """A result file written by scipy. Signals: R (constant), v, n; tables given row by row."""

    def turn(table: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(table.T if layout == "binTrans" else table)

    content = {
        "Aclass": characters([kind, "1.1", "", layout]),
        "name": turn(characters(names or ["time", "R", "v", "n"])),
        "description": turn(characters(["Time [s]", "Resistance [Ohm]", "[V|kV]", "[:#(type=Integer)]"])),
        "dataInfo": turn(np.array(info, float)),
        "data_1": turn(np.array(data_1, float)),
        "data_2": turn(np.array(data_2, float)),
    }
    path = folder / "result.mat"
    scipy.io.savemat(path, {k: v for k, v in content.items() if k not in (drop or [])}, format="4")
    return path


def characters(texts: list[str]) -> np.ndarray:
    width = max(map(len, texts))
    return np.array([list(text.ljust(width)) for text in texts])
