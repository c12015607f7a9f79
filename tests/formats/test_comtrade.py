"""COMTRADE against records laid out here byte by byte, as the standard describes them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import list_signals, read_waveforms

RAW = np.array([[100, -20], [101, -21], [-32000, 60], [141, 32000]])
TRIP = np.array([0, 0, 1, 1])
EXPECTED = np.column_stack([0.5 * RAW[:, 0] + 1.0, 0.1 * RAW[:, 1] - 2.0, TRIP])


def header(kind: str, *, rates: str = "1\n1000,4", revision: str = "1999", multiplier: str = "1") -> str:
    return (
        f"STATION,REC,{revision}\n3,2A,1D\n1,Vdc,A,,kV,0.5,1,0,-32767,32767,1,1,P\n"
        f"2,P,,,MW,0.1,-2,0,-32767,32767,1,1,P\n1,TRIP,,,0\n50\n{rates}\n"
        f"01/01/2020,00:00:00.000000\n01/01/2020,00:00:00.002000\n{kind}\n{multiplier}\n"
    )


def binary(form: str, stamps: list[int] | None = None) -> bytes:
    stamps = stamps or [0, 1000, 2000, 3000]
    return b"".join(
        struct.pack(f"<II2{form}H", n + 1, stamps[n], *RAW[n].tolist(), int(TRIP[n])) for n in range(len(RAW))
    )


def ascii_rows(stamps: list[str] | None = None) -> str:
    stamps = stamps or ["0", "1000", "2000", "3000"]
    return "".join(f"{n + 1},{stamps[n]},{RAW[n, 0]},{RAW[n, 1]},{TRIP[n]}\r\n" for n in range(len(RAW)))


def put(folder: Path, head: str, data: str | bytes) -> Path:
    (folder / "r.cfg").write_text(head, "latin-1")
    (folder / "r.dat").write_bytes(data.encode() if isinstance(data, str) else data)
    return folder / "r.cfg"


@pytest.mark.parametrize(
    ("kind", "data"),
    [("ASCII", ascii_rows()), ("BINARY", binary("h")), ("BINARY32", binary("i")), ("FLOAT32", binary("f"))],
)
def test_every_kind_of_data(tmp_path: Path, kind: str, data: str | bytes) -> None:
    path = put(tmp_path, header(kind), data)
    found = read_waveforms(path)
    assert found.names == ("Vdc", "P", "TRIP")
    assert found.units == ("kV", "MW", "")
    np.testing.assert_allclose(found.values, EXPECTED, rtol=1e-15, atol=1e-12)
    np.testing.assert_array_equal(found.time, [0.0, 0.001, 0.002, 0.003])


@pytest.mark.parametrize("size", [True, False])
def test_one_file_with_binary_data(tmp_path: Path, size: bool) -> None:
    content = binary("h")
    mark = f"--- file type: DAT BINARY{f': {len(content)}' if size else ''} ---\r\n"
    text = "--- file type: CFG ---\r\n" + header("BINARY", revision="2013", multiplier="1\n0,0\n0,0")
    path = tmp_path / "r.cff"
    path.write_bytes(text.encode() + b"--- file type: HDR ---\r\nsaid the operator\r\n" + mark.encode() + content)
    np.testing.assert_allclose(read_waveforms(path).values, EXPECTED, rtol=1e-15, atol=1e-12)


def test_one_file_with_text_data(tmp_path: Path) -> None:
    path = tmp_path / "r.cff"
    path.write_text(f"--- file type: CFG ---\n{header('ASCII')}--- file type: DAT ASCII ---\n{ascii_rows()}", "ascii")
    np.testing.assert_allclose(read_waveforms(path).values, EXPECTED, rtol=1e-15, atol=1e-12)


def test_two_rates_count_on_from_the_last_sample(tmp_path: Path) -> None:
    path = put(tmp_path, header("ASCII", rates="2\n1000,2\n100,4"), ascii_rows())
    np.testing.assert_allclose(read_waveforms(path).time, [0.0, 0.001, 0.011, 0.021], rtol=1e-14)


def test_without_a_rate_the_time_stamps_count_with_their_multiplier(tmp_path: Path) -> None:
    head = header("ASCII", rates="0\n0,4", multiplier="2.5")
    path = put(tmp_path, head, ascii_rows(["10", "20", "40", "41"]))
    np.testing.assert_allclose(read_waveforms(path).time, np.array([0, 25, 75, 77.5]) * 1e-6, rtol=1e-9)


def test_a_skewed_channel_is_moved(tmp_path: Path) -> None:
    head = header("ASCII").replace("kV,0.5,1,0,", "kV,1,0,500,")
    path = put(tmp_path, head, "".join(f"{n + 1},{n * 1000},{2 * n},0,0\n" for n in range(4)))
    found = read_waveforms(path)["Vdc"]
    np.testing.assert_allclose(found[1:], [1.0, 3.0, 5.0], atol=1e-12)  # v = 2 n was taken half a sample late


def test_channels_of_one_name_keep_their_phase(tmp_path: Path) -> None:
    head = header("ASCII").replace("2,P,,,MW", "2,Vdc,B,,kV")
    assert [n for n, _ in list_signals(put(tmp_path, head, ascii_rows()))] == ["Vdc A", "Vdc B", "TRIP"]


@pytest.mark.parametrize(
    ("head", "data", "says"),
    [
        (header("ASCII", rates="1\n1000,400000000000"), ascii_rows(), "data end early"),
        (header("BINARY"), binary("h")[:-3], "data end early"),
        (header("ASCII").replace("3,2A,1D", "999999,999998A,1D"), ascii_rows(), "number of channels"),
        (header("ASCII").replace("3,2A,1D", "nonsense"), ascii_rows(), "line 2"),
        (header("MORSE"), ascii_rows(), "kind of data"),
        (header("ASCII", rates="1\n0,4"), ascii_rows(), "sampling rate of 0"),
        (header("ASCII", rates="2\n1000,4\n100,2"), ascii_rows(), "sampling rates"),
        (header("ASCII").replace("0.5,1,0", "nan,1,0"), ascii_rows(), "not finite"),
        (header("ASCII"), ascii_rows().replace("-21", "x"), "cannot be read"),
        ("STATION,REC\n" + "3,2A,1D\n", ascii_rows(), "number of channels"),
        (header("ASCII", rates="0\n0,4", multiplier="0"), ascii_rows(), "multiplier"),
    ],
)
def test_what_does_not_hold_together_is_refused(tmp_path: Path, head: str, data: str | bytes, says: str) -> None:
    with pytest.raises(WaveformError, match=says):
        read_waveforms(put(tmp_path, head, data))


def test_a_header_without_its_data_is_refused(tmp_path: Path) -> None:
    path = put(tmp_path, header("ASCII"), "")
    path.with_suffix(".dat").unlink()
    with pytest.raises(WaveformError, match=r"r\.dat beside it"):
        read_waveforms(path)
