"""Parquet tables: the column called time (or the first one), and every other column of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Origin, Trajectory
from hvdc_ident.formats import pick
from hvdc_ident.formats._columns import check_size, damaged, instants, package, time_name

NAME = "parquet"
SUMMARY = "Parquet tables with a column `time`"
SUFFIXES = (".parquet", ".pq")

_MAGIC = b"PAR1"


def recognises(path: Path, top: bytes) -> bool:
    """True for a file that starts as Parquet does."""
    return top.startswith(_MAGIC)


def signals(path: Path) -> list[tuple[str, str]]:
    """Name and unit of every column but the time's; the unit where this package wrote it."""
    _, _, names, units = _opened(path)
    return list(zip(names, units, strict=True))


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The columns, all or those named in that order; a column of time stamps counts in s from its first row."""
    file, clock, names, units = _opened(path)
    wanted = pick(path, signals, names)
    check_size(file.metadata.num_rows, len(wanted) + 1, path)
    table = _guarded(path, lambda: file.read(columns=[clock, *(names[i] for i in wanted)]))
    time, origin = _seconds(table.column(clock).to_numpy(), clock, path)
    columns = [np.asarray(table.column(names[i]).to_numpy(), dtype=float) for i in wanted]
    values = np.column_stack(columns) if columns else np.empty((time.size, 0))
    labels = tuple(names[i] for i in wanted), tuple(units[i] for i in wanted)
    return Trajectory(time, values, *labels, origin)


def write(trajectory: Trajectory, path: Path) -> None:
    """Write the trajectory to the path in double precision, with units in the columns' metadata."""
    arrow, parquet = package("pyarrow", path), package("pyarrow.parquet", path)
    fields = [arrow.field("time", arrow.float64(), metadata={"unit": "s"})]
    for name, unit in zip(trajectory.names, trajectory.units, strict=True):
        fields.append(arrow.field(name, arrow.float64(), metadata={"unit": unit}))
    columns = [trajectory.time, *trajectory.values.T]
    parquet.write_table(arrow.table([arrow.array(c) for c in columns], schema=arrow.schema(fields)), path)


def _opened(path: Path) -> tuple[Any, str, list[str], list[str]]:
    """The file, its time column, and names and units of the other columns of numbers."""
    package("pyarrow", path)
    parquet = package("pyarrow.parquet", path)
    file = _guarded(path, lambda: parquet.ParquetFile(path))
    fields = list(file.schema_arrow)
    labels = [f.name for f in fields]
    if not labels or len(set(labels)) < len(labels):
        raise damaged(path, "no columns, or two of one name")
    clock = time_name(labels) or labels[0]
    numeric = [f for f in fields if f.name != clock and _is_number(str(f.type))]
    units = [(f.metadata or {}).get(b"unit", b"").decode("utf-8", "replace") for f in numeric]
    return file, clock, [f.name for f in numeric], units


def _is_number(kind: str) -> bool:
    return kind.startswith(("double", "float", "halffloat", "int", "uint", "bool"))


def _seconds(values: NDArray[Any], name: str, path: Path) -> tuple[Array, Origin]:
    """Times in s, time stamps from the first row, and their origin."""
    if values.dtype.kind == "M":
        return (values - values[:1]) / np.timedelta64(1, "ns") * 1e-9, Origin(time_unit="date")
    if values.dtype.kind not in "fiu":
        raise damaged(path, "the time column is no number and no time stamp", got=str(values.dtype))
    return instants(values, name, "", path)


def _guarded(path: Path, act: Any) -> Any:
    arrow = package("pyarrow", path)
    try:
        return act()
    except (arrow.ArrowException, OSError, ValueError) as error:
        raise damaged(path, f"the table cannot be read: {error}") from None
