"""A small valid file of each format, written from its documentation."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Trajectory
from hvdc_ident.formats import parquet


def csv(path: Path) -> None:
    """Write a small file with a unit and a jump to the path."""
    path.write_text("# two signals\ntime,u [pu],y\n0.0,1.0,0.4\n0.1,1.0,0.4\n0.1,1.5,0.4\n0.25,1.5,-2e-3\n", "utf-8")


def comtrade(path: Path) -> None:
    """Write a small ASCII record with an analog channel of two kinds and a digital one."""
    header = (
        "STATION,REC,1999\r\n3,2A,1D\r\n1,Vdc,,,kV,0.5,1,0,-32767,32767,1,1,P\r\n2,P,,,MW,0.1,0,0,-32767,32767,1,1,P\r\n"
        "1,TRIP,,,0\r\n50\r\n1\r\n1000,4\r\n01/01/2020,00:00:00.000000\r\n01/01/2020,00:00:00.002000\r\nASCII\r\n1\r\n"
    )
    rows = "1,0,100,-20,0\r\n2,1000,101,-21,0\r\n3,2000,140,-60,1\r\n4,3000,141,-61,1\r\n"
    if path.suffix.lower() == ".cff":
        text = f"--- file type: CFG ---\r\n{header}--- file type: DAT ASCII ---\r\n{rows}"
        path.write_text(text, "ascii", newline="")
        return
    path.write_text(header, "ascii", newline="")
    path.with_suffix(".dat").write_text(rows, "ascii", newline="")


def dymola_mat(path: Path) -> None:
    """Write a small result (parameter, variable, negative alias, event) to the path."""
    rows = [(0.0, 1.0), (0.1, 1.0), (0.1, 1.5), (0.1, 2.0), (0.25, 1.75)]
    names, texts = ("time", "c.R", "c.v", "c.n"), ("Time [s]", "Resistance [Ohm]", "Voltage [V|kV]", "Its negative [V]")
    info = [(0, 1, 0, -1), (1, 2, 0, 0), (2, 2, 0, 0), (2, -2, 0, 0)]
    aclass = ("Atrajectory", "1.1", "", "binTrans")
    with open(path, "wb") as file:
        file.write(_matrix_bytes("Aclass", np.array([list(s.ljust(11).encode()) for s in aclass], np.uint8).T, 51))
        file.write(_matrix_bytes("name", np.array([list(s.ljust(4).encode()) for s in names], np.uint8), 51))
        file.write(_matrix_bytes("description", np.array([list(s.ljust(16).encode()) for s in texts], np.uint8), 51))
        file.write(_matrix_bytes("dataInfo", np.array(info, "<i4"), 20))
        file.write(_matrix_bytes("data_1", np.array([(0.0, 1e-3), (0.25, 1e-3)], "<f8"), 0))
        file.write(_matrix_bytes("data_2", np.array(rows, "<f8"), 0))


def _matrix_bytes(name: str, stored: NDArray[Any], kind: int) -> bytes:
    columns, rows = stored.shape
    text = name.encode() + b"\0"
    return struct.pack("<5i", kind, rows, columns, 0, len(text)) + text + stored.tobytes()


def hdf5(path: Path) -> None:
    """Write a small HDF5 file with two signals and a unit."""
    import h5py

    with h5py.File(path, "w") as file:
        file["time"] = np.array([0.0, 0.1, 0.1, 0.3])
        file["grid/P"] = np.array([1.0, 1.0, 1.5, 1.4])
        file["grid/P"].attrs["units"] = "MW"
        file["u"] = np.array([0.0, 0.0, 1.0, 1.0])


def matlab(path: Path) -> None:
    """Write a small version 5 file with a time vector, a vector and a matrix."""
    from scipy.io import savemat

    time = np.array([0.0, 0.1, 0.1, 0.3])
    savemat(path, {"t": time, "y": np.array([1.0, 1.0, 1.5, 1.4]), "u": np.column_stack([time, time + 1.0])})


def parquet_table(path: Path) -> None:
    """Write a small table with a unit and a jump."""
    values = np.array([[1.0, 0.5], [1.0, 0.5], [1.5, 0.5], [1.4, 0.25]])
    parquet.write(Trajectory(np.array([0.0, 0.1, 0.1, 0.3]), values, ("u", "y"), ("pu", "")), path)


def pscad(path: Path) -> None:
    """Write twelve channels in an .inf and two .out files."""
    lines = [
        f'PGB({n}) Output Desc="S{n}" Group="Main" Max=2.0 Min=-2.0 Units="{"kV" if n % 2 else "MW"}"'
        for n in range(1, 13)
    ]
    path.write_text("\n".join(lines) + "\n", "ascii")
    time = np.array([0.0, 0.05, 0.1])
    for number, columns in ((1, range(1, 11)), (2, range(11, 13))):
        rows = [[t, *(n + t for n in columns)] for t in time]
        text = "\n".join("  ".join(f"{x:.10E}" for x in row) for row in rows) + "\n"
        path.with_name(f"{path.stem}_{number:02d}.out").write_text(text, "ascii")


SAMPLES: dict[str, Callable[[Path], None]] = {
    "comtrade": comtrade,
    "csv": csv,
    "dymola-mat": dymola_mat,
    "hdf5": hdf5,
    "matlab": matlab,
    "parquet": parquet_table,
    "pscad": pscad,
}
"""Writers of the files by the name of the format; what stands beside a file is written beside it."""
