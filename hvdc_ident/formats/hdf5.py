"""HDF5 and netCDF files: every data set of numbers is a signal, over the time vector of its group.

A group's time is its data set called time, t or tout, in the unit it says; groups without one use that of the group above. Units come from
the attribute `units` (netCDF's own word) or `unit`. netCDF 4 is HDF5; netCDF 3 is another format, read by scipy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.data import Array, Origin, Trajectory
from hvdc_ident.formats._columns import checked, chosen, damaged, guarded, instants, joined, package, time_name

NAME = "hdf5"
SUMMARY = "HDF5 and netCDF: data sets over the `time` of their group"
SUFFIXES = (".h5", ".hdf5", ".nc", ".cdf")

_HDF5, _NETCDF3 = b"\x89HDF\r\n\x1a\n", (b"CDF\x01", b"CDF\x02", b"CDF\x05")
_MAX_DEPTH = 8
_MAX_SETS = 100_000


def recognises(path: Path, top: bytes) -> bool:
    """True for a file that starts as HDF5 or netCDF 3 does."""
    return top.startswith((_HDF5, *_NETCDF3))


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The signals under names with the groups they stand in, all or those named in that order; several rates at their own rows."""
    return chosen(guarded(waveforms_unguarded, path), signals, path)


def waveforms_unguarded(path: Path) -> Trajectory:
    """All waveforms of the file, read in this process, which a damaged file may hang or end."""
    with open(path, "rb") as file:
        newest = file.read(8) == _HDF5
    parts = _hdf5(path) if newest else _netcdf3(path)
    if not parts:
        raise damaged(path, "no waveforms", expected="a data set 'time' and others of as many rows")
    return joined([checked(part, path) for part in parts])


def _hdf5(path: Path) -> list[Trajectory]:
    with package("h5py", path).File(path, "r") as file:
        return list(_group(file, "", (None, Origin()), path, 0))


def _group(group: Any, prefix: str, above: tuple[Array | None, Origin], path: Path, depth: int) -> Iterator[Trajectory]:
    """The records of a group and of those inside it. above: time of the groups around it, and its origin."""
    if depth > _MAX_DEPTH or len(group) > _MAX_SETS:
        raise damaged(path, f"too many data sets in '{prefix or '/'}', or groups too deep")
    kinds = {name: group.get(name, getclass=True, getlink=True) for name in group}
    local = [name for name, kind in kinds.items() if kind is not None and kind.__name__ == "HardLink"]  # none outside
    sets = {n: group[n] for n in local if hasattr(group[n], "shape") and group[n].dtype.kind in "fiub"}
    name = time_name(list(sets))
    clock, origin = above
    if name is not None:
        clock, origin = instants(np.asarray(sets[name]).ravel(), name, _unit(sets[name]).split(" since ")[0], path)
    columns, units = {}, []
    for other, item in sets.items():
        if other == name or clock is None or item.ndim not in (1, 2) or clock.size not in item.shape:
            continue
        values = np.asarray(item, dtype=float)
        values = (values if item.shape[0] == clock.size else values.T).reshape(clock.size, -1)
        for i, column in enumerate(values.T):
            columns[prefix + other + (f"({i + 1})" if values.shape[1] > 1 else "")] = column
            units.append(_unit(item))
    if columns and clock is not None:
        yield Trajectory(clock, np.column_stack(list(columns.values())), tuple(columns), tuple(units), origin)
    for inner in local:
        if hasattr(group[inner], "keys"):
            yield from _group(group[inner], f"{prefix}{inner}/", (clock, origin), path, depth + 1)


def _unit(item: Any) -> str:
    return _text(item.attrs.get("units", item.attrs.get("unit", "")))


def _text(text: Any) -> str:
    return text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)


def _netcdf3(path: Path) -> list[Trajectory]:
    from scipy.io import netcdf_file

    with netcdf_file(path, "r", mmap=False) as file:
        sets = {k: v for k, v in file.variables.items() if v.data.dtype.kind in "fiu"}
        name = time_name(list(sets))
        if name is None:
            return []
        unit = _text(getattr(sets[name], "units", ""))
        clock, origin = instants(np.array(sets[name].data).ravel(), name, unit.split(" since ")[0], path)
        columns = {k: np.array(v.data, dtype=float) for k, v in sets.items() if k != name and v.shape == clock.shape}
        units = tuple(_text(getattr(sets[k], "units", "")) for k in columns)
    if not columns:
        return []
    return [Trajectory(clock, np.column_stack(list(columns.values())), tuple(columns), units, origin)]
