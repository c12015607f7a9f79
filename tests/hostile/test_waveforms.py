"""Mutilated waveform files end in a WaveformError, soon, and never in anything else."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import list_signals, read_waveforms
from tests.effort import calls
from tests.formats.samples import SAMPLES

CSV = "time,a,b\n" + "".join(f"{i / 1000!r},{i % 7},{i * 0.5!r}\n" for i in range(1000))
LINES = CSV.splitlines()
NOISE = np.random.default_rng(7).integers(0, 256, 20_000, dtype=np.uint8).tobytes()


def replaced(line: int, text: str) -> bytes:
    return "\n".join([*LINES[:line], text, *LINES[line + 1 :]]).encode()


BAD_CSV: dict[str, bytes] = {
    "random bytes": NOISE,
    "random bytes without NUL": NOISE.replace(b"\0", b"x"),
    "random bytes after the header": b"time,a,b\n" + NOISE,
    "random bytes at the end": CSV.encode() + NOISE,
    "NUL bytes only": b"\0" * 5000,
    "one NUL": replaced(500, "0.499,1\0,2"),
    "NUL in the header": replaced(0, "time,a\0,b"),
    "cut off in a row": CSV.encode()[: CSV.index("0.7,") + 5],
    "million columns": b"time," + b",".join(b"c%d" % i for i in range(1_000_000)) + b"\n",
    "million nameless columns": b"time" + b"," * 1_000_000 + b"\n0" + b"," * 1_000_000,
    "million blank columns": b"t " + b"x " * 1_000_000 + b"\n" + b"0 " * 1_000_001,
    "quote without end": replaced(0, '"time,a,b'),
    "quotes everywhere": b'"' * 10_000 + b"\n" + b'"' * 10_000,
    "long field": replaced(0, "time," + "a" * 200_000 + ',"' + "b" * 200_000 + '"') + b"\nx",
    "one long line": b"1" * 3_000_000,
    "digits without end": replaced(300, "0.3," + "9" * 500_000 + ",2"),
    "huge exponent": replaced(300, "0.3,1e" + "9" * 5000 + ",2"),
    "a time that is not a number": replaced(300, "NaN,1,2"),
    "infinite": replaced(300, "0.3,inf,2"),
    "text": replaced(999, "0.998,abc,2"),
    "formula": replaced(999, "0.998,=1+1,2"),
    "letters like digits": replaced(300, "0.3,\uff11,2"),
    "empty row of commas": replaced(300, ",,"),
    "extra cell": replaced(300, "0.3,1,2,3"),
    "missing cell": replaced(300, "0.3,1"),
    "balanced ragged rows": "\n".join([*LINES[:300], "0.299,1", "0.3,1,2,3", *LINES[302:]]).encode(),
    "time backwards": "\n".join([LINES[0], *LINES[:0:-1]]).encode(),
    "time without end": replaced(999, "inf,1,2"),
    "time stands still": b"time,a\n" + b"0,1\n" * 1000,
    "no header": "\n".join(LINES[1:]).encode(),
    "same names": replaced(0, "time,a,a"),
    "header only": b"time,a,b",
    "byte order mark only": b"\xef\xbb\xbf",
    "blank lines only": b"\n" * 100_000,
    "comments only": b"# x\n" * 100_000,
    "UTF-16 cut off in a letter": CSV.encode("utf-16")[:-5],
    "UTF-16 without mark": CSV.encode("utf-16-le"),
    "other separators": CSV.replace(",", "|").encode(),
    "web page": b"<!DOCTYPE html><html><body>404 not found, sorry</body></html>\n<p>, </p>\n",
    "zip": b"PK\x03\x04\x14\x00\x00\x00" + NOISE,
    "control characters": b"\x1b[2J\x07,\x08\n\x1b,\x07\n",
}


@pytest.mark.parametrize("content", BAD_CSV.values(), ids=BAD_CSV)
def test_bad_csv(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    refused(path)


def good_mat(folder: Path) -> bytes:
    SAMPLES["dymola-mat"](folder / "good.mat")
    return (folder / "good.mat").read_bytes()


def field(content: bytes, matrix: str, index: int, value: int) -> bytes:
    """The file with one field of a matrix header replaced: 0 type, 1 rows, 2 columns, 3 imaginary, 4 name length."""
    place = content.index(matrix.encode() + b"\0") - 20 + 4 * index
    return content[:place] + struct.pack("<i", value) + content[place + 4 :]


def swapped(content: bytes, old: bytes, new: bytes) -> bytes:
    assert old in content
    return content.replace(old, new, 1)


LARGE = 2**31 - 1
BAD_MAT: dict[str, Callable[[bytes], bytes]] = {
    "one byte": lambda c: c[:1],
    "header cut off": lambda c: c[:15],
    "after the first header": lambda c: c[:27],
    "half": lambda c: c[: len(c) // 2],
    "last byte gone": lambda c: c[:-1],
    "rubbish at the end": lambda c: c + b"\1\2\3",
    "random bytes at the end": lambda c: c + NOISE,
    "random bytes": lambda c: NOISE,
    "random bytes after the first matrix": lambda c: c[:71] + NOISE,
    "NUL bytes": lambda c: b"\0" * 4096,
    "twice the same": lambda c: c + c,
    "huge rows": lambda c: field(c, "data_2", 1, LARGE),
    "huge columns": lambda c: field(c, "data_2", 2, LARGE),
    "huge both": lambda c: field(field(c, "data_2", 1, LARGE), "data_2", 2, LARGE),
    "huge names": lambda c: field(c, "name", 2, LARGE),
    "huge names of no length": lambda c: field(field(c, "name", 2, LARGE), "name", 1, 0),
    "huge table of no width": lambda c: field(field(c, "data_2", 2, LARGE), "data_2", 1, 0),
    "negative rows": lambda c: field(c, "data_1", 1, -3),
    "negative both": lambda c: field(field(c, "data_1", 1, -2), "data_1", 2, -2),
    "no rows": lambda c: field(c, "dataInfo", 1, 0),
    "rows too many by one": lambda c: field(c, "data_2", 2, 6),
    "long name": lambda c: field(c, "data_1", 4, LARGE),
    "negative name": lambda c: field(c, "data_1", 4, -1),
    "imaginary": lambda c: field(c, "data_1", 3, 1),
    "sparse": lambda c: field(c, "data_1", 0, 2),
    "unknown numbers": lambda c: field(c, "data_1", 0, 70),
    "VAX": lambda c: field(c, "data_1", 0, 2000),
    "other class": lambda c: swapped(c, b"Aclass", b"Bclass"),
    "no such table": lambda c: swapped(c, b"data_2\0", b"data_9\0"),
    "no names": lambda c: swapped(c, b"name\0", b"nema\0"),
    "place outside": lambda c: swapped(c, struct.pack("<4i", 2, 2, 0, 0), struct.pack("<4i", 2, LARGE, 0, 0)),
    "lowest place": lambda c: swapped(c, struct.pack("<4i", 2, 2, 0, 0), struct.pack("<4i", 2, -(2**31), 0, 0)),
    "table outside": lambda c: swapped(c, struct.pack("<4i", 2, 2, 0, 0), struct.pack("<4i", LARGE, 2, 0, 0)),
    "infinite": lambda c: swapped(c, struct.pack("<d", 1.75), struct.pack("<d", np.inf)),
    "time not a number": lambda c: c[:-16] + struct.pack("<d", np.nan) + c[-8:],
    "time backwards": lambda c: c[:-16] + struct.pack("<d", -1.0) + c[-8:],
    "many small matrices": lambda c: (
        c + b"".join(struct.pack("<5i", 0, 0, 0, 0, 7) + b"m%05d\0" % i for i in range(9999))
    ),
}


@pytest.mark.parametrize("damage", BAD_MAT.values(), ids=BAD_MAT)
def test_bad_mat(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    path = tmp_path / "bad.mat"
    path.write_bytes(damage(good_mat(tmp_path)))
    tracemalloc.start()
    try:
        refused(path)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("seed", range(200))
def test_flipped_bytes_never_end_in_another_error(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    SAMPLES["csv"](tmp_path / "good.csv")
    for suffix, content in ((".mat", good_mat(tmp_path)), (".csv", (tmp_path / "good.csv").read_bytes())):
        damaged = bytearray(content)
        for place in rng.integers(0, len(damaged), 1 + seed % 4):
            damaged[place] = rng.integers(0, 256)
        path = tmp_path / f"bad{suffix}"
        path.write_bytes(bytes(damaged))
        for read in (read_waveforms, list_signals):
            try:
                read(path)
            except WaveformError as error:
                assert len(str(error)) < 2000


def test_every_cut_of_a_result_file_is_refused(tmp_path: Path) -> None:
    content = good_mat(tmp_path)
    path = tmp_path / "bad.mat"
    for size in range(1, len(content), 7):
        path.write_bytes(content[:size])
        with pytest.raises(WaveformError):
            read_waveforms(path)


def refused(path: Path) -> None:
    def said() -> str:
        with pytest.raises(WaveformError) as caught:
            read_waveforms(path)
        return str(caught.value)

    assert calls(said) < 1_000_000
    message = said()
    assert str(path) in message
    assert len(message) < 2000
    assert message.isprintable()
