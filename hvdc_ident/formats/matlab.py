"""MATLAB files of version 4, 5 to 7.2, and 7.3 (HDF5), as Simulink and scripts save waveforms.

Three layouts are understood, each either way round: a vector called time, t, tout, Zeit or temps with vectors or
matrices of as many rows beside it; a matrix whose first column or row is the time, which increases; Simulink's
"structure with time" (fields `time` and `signals`, each with `values` and `label`). Several structures are
records of their own rates. Complex numbers are two signals, `y.real` and `y.imag`. Objects (timeseries, Dataset) are
stored in a form MathWorks does not publish: they are refused with the way out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Origin, Trajectory
from hvdc_ident.errors import WaveformError
from hvdc_ident.formats._columns import (
    check_size,
    checked,
    chosen,
    damaged,
    guarded,
    instants,
    joined,
    package,
    time_name,
)
from hvdc_ident.formats.dymola_mat import recognises as is_result_file
from hvdc_ident.formats.dymola_mat import starts_as_version_4

NAME = "matlab"
SUMMARY = "MATLAB and Simulink, versions 4 to 7.3: time vector, time in the first column, or structure with time"
SUFFIXES = (".mat",)

_V5, _V73 = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
_ADVICE = "save it as 'Structure with time' or as vectors: t = ts.Time; y = ts.Data; save('x.mat', 't', 'y')"
_MAX_DEPTH = 4
_FEWEST = 8
"""Numbers that increase by chance once in 8! = 40 320 times: with fewer, an increasing row proves no time axis."""


@dataclass(frozen=True)
class _Object:
    """A variable in a form that is not published: an object, a function, a timeseries."""


def recognises(path: Path, top: bytes) -> bool:
    """Return whether the file starts as MATLAB's versions 4 to 7.3 do, and is no result file of Dymola's."""
    if top.startswith((_V5, _V73)):
        return True
    return path.suffix.lower() in SUFFIXES and starts_as_version_4(top) and not is_result_file(path, top)


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The signals, all or those named in that order, without units: MATLAB keeps none.

    An instant with more than two rows keeps its first and last.
    """
    return chosen(guarded(waveforms_unguarded, path), signals, path)


def waveforms_unguarded(path: Path) -> Trajectory:
    """All waveforms of the file, read in this process, which a damaged file may hang or end."""
    with open(path, "rb") as file:
        newest = file.read(len(_V73)) == _V73
    variables = _split_complex(_version_73(path) if newest else _until_version_7(path))
    parts = list(_parts(variables, path))
    if not parts:
        raise _no_time(variables, path)
    return joined([checked(part, path) for part in parts])


def _until_version_7(path: Path) -> dict[str, Any]:
    """The variables of a file of version 4 to 7.2 by name."""
    from scipy.io import loadmat

    variables = {}
    for name, value in loadmat(path, simplify_cells=True).items():
        if isinstance(value, np.ndarray) and value.dtype.names == ("s0", "s1", "s2", "arr"):
            variables[value["s0"][0].decode("latin-1")] = _Object()  # scipy calls it 'None'
        elif not name.startswith("__"):
            variables[name] = value
    if "dataInfo" in variables:
        raise damaged(path, "a result file of Dymola without its class", expected="a matrix 'Aclass' at its start")
    return variables


def _version_73(path: Path) -> dict[str, Any]:
    with package("h5py", path).File(path, "r") as file:
        return {name: _from_hdf5(file[name], file, path, 0) for name in file if not name.startswith("#")}


def _split_complex(variables: Mapping[str, Any]) -> dict[str, Any]:
    """The variables with two in place of each complex one, in the structures among them too."""
    parts: dict[str, Any] = {}
    for name, value in variables.items():
        if isinstance(value, dict):
            parts[name] = _split_complex(value)
        elif isinstance(value, list):
            parts[name] = [_split_complex(item) if isinstance(item, dict) else item for item in value]
        elif np.iscomplexobj(value):
            parts |= {f"{name}.real": np.real(value), f"{name}.imag": np.imag(value)}
        else:
            parts[name] = value
    return parts


def _from_hdf5(item: Any, file: Any, path: Path, depth: int) -> Any:
    """A dataset or group as scipy would give it: MATLAB's axes are the other way round."""
    if depth > _MAX_DEPTH:
        return None
    if hasattr(item, "keys"):
        return {k: _from_hdf5(item[k], file, path, depth + 1) for k in item}
    if "MATLAB_object_decode" in item.attrs:
        return _Object()
    kind = item.attrs.get("MATLAB_class", b"").decode("ascii", "replace")
    if kind == "char":
        check_size(1, item.size, path)
        return "" if _empty(item) else "".join(map(chr, np.asarray(item).ravel().astype(int)))
    if item.dtype.kind == "O":  # references: the elements of a structure array
        return [_from_hdf5(file[r], file, path, depth + 1) for r in np.asarray(item).ravel()]
    values = np.asarray(item) if item.dtype.kind in "fiub" or item.dtype.names == ("real", "imag") else None
    if values is None:
        return None
    values = values["real"] + 1j * values["imag"] if values.dtype.names else values
    return np.squeeze(values.T) if not _empty(item) else np.empty(0)


def _empty(item: Any) -> bool:
    return bool(item.attrs.get("MATLAB_empty", 0))


def _parts(variables: Mapping[str, Any], path: Path) -> Iterator[Trajectory]:
    """The records among the variables, each with a time of its own."""
    structures = {k: v for k, v in variables.items() if isinstance(v, dict)}
    arrays = {k: np.asarray(v) for k, v in variables.items() if _numeric(v)}
    for name, structure in structures.items():
        yield from _structure(name, structure, path)
    time = time_name(list(arrays))
    if time is not None:
        yield _beside(time, arrays, path)
        return
    for name, table in arrays.items():
        if table.ndim == 2 and min(table.shape) >= 2:
            upright = _upright(table)
            if upright is not None:
                labels = _labels(name, upright.shape[1] - 1)
                yield Trajectory(upright[:, 0], upright[:, 1:], labels)


def _upright(table: NDArray[Any]) -> NDArray[Any] | None:
    """The matrix with the time in its first column; None where neither its first column nor its first row is one.

    To File blocks save one row a signal, logged arrays one column a signal: the time is what increases. Where both
    increase, or so few numbers that chance may have it so, the longer one is the time.
    """
    down, across = _increases(table[:, 0]), _increases(table[0])
    if down and across:
        return table if table.shape[0] >= table.shape[1] else table.T
    for increases, upright in ((down, table), (across, table.T)):
        if increases and (upright.shape[0] >= _FEWEST or upright.shape[0] >= upright.shape[1]):
            return upright
    return None


def _no_time(variables: Mapping[str, Any], path: Path) -> WaveformError:
    """The error for a file without a time, which names the variable that may be it."""
    arrays = {k: np.asarray(v) for k, v in variables.items() if _numeric(v)}
    opaque = next((name for name, value in variables.items() if isinstance(value, _Object)), None)
    if opaque is not None and not arrays:
        return WaveformError(
            f"'{opaque}' is a MATLAB object, whose form is not published",
            where=str(path),
            expected="vectors, matrices or structures with time",
            hint=_ADVICE,
        )
    shapes = ", ".join(f"{k} {'x'.join(map(str, v.shape)) or '1'}" for k, v in list(arrays.items())[:8])
    likely = [k for k, v in arrays.items() if v.ndim == 1 and v.size > 1 and _increases(v)]
    return WaveformError(
        "no waveforms: nothing in the file is known to be the time",
        where=str(path),
        expected="a vector called time or t with signals of as many rows, a matrix whose first column is the time, or a "
        "structure with time",
        got=shapes or "no numbers",
        hint=f"'{likely[0]}' increases all along: if it is the time, save it as 't'" if likely else _ADVICE,
    )


def _structure(name: str, structure: Mapping[str, Any], path: Path) -> Iterator[Trajectory]:
    """A structure with time, or a structure of vectors that has one called time."""
    time = structure.get("time")
    listed = structure.get("signals")
    if not _numeric(time):
        numeric = _flat(structure)
        other = time_name([k for k in numeric if "." not in k])
        if other is not None:
            yield _beside(other, numeric, path, prefix=f"{name}.")
        return
    clock, origin = instants(np.atleast_1d(np.asarray(time)).ravel(), "time", "", path)
    if listed is None:
        yield _beside("time", _flat(structure), path, prefix=f"{name}.")
        return
    columns: dict[str, NDArray[Any]] = {}
    for i, signal in enumerate(_list(listed)):
        if not isinstance(signal, dict) or not _numeric(signal.get("values")):
            continue
        label = signal.get("label")
        shown = label if isinstance(label, str) and label else f"{name}.{i + 1}"
        _add(columns, shown, np.asarray(signal["values"]), clock.size)
    if columns:
        yield _record(clock, columns, origin)


def _record(clock: Array, columns: Mapping[str, NDArray[Any]], origin: Origin) -> Trajectory:
    return Trajectory(clock, np.column_stack(list(columns.values())), tuple(columns), origin=origin)


def _flat(structure: Mapping[str, Any], prefix: str = "") -> dict[str, NDArray[Any]]:
    """The arrays of numbers in a structure and the structures inside it, those under `inner.name`."""
    arrays: dict[str, NDArray[Any]] = {}
    for key, value in structure.items():
        if _numeric(value):
            arrays[prefix + key] = np.asarray(value)
        elif isinstance(value, dict):
            arrays |= _flat(value, f"{prefix}{key}.")
    return arrays


def _beside(time: str, arrays: Mapping[str, NDArray[Any]], path: Path, prefix: str = "") -> Trajectory:
    """A time vector and every array of as many rows."""
    clock, origin = instants(np.atleast_1d(arrays[time]).ravel(), time, "", path)
    columns: dict[str, NDArray[Any]] = {}
    for name, values in arrays.items():
        if name != time:
            _add(columns, prefix + name, values, clock.size)
    if not columns:
        shapes = ", ".join(
            f"{k} {'x'.join(map(str, v.shape)) or '1'}" for k, v in list(arrays.items())[:8] if k != time
        )
        raise WaveformError(
            f"no signal has as many rows as '{prefix}{time}'",
            where=str(path),
            expected=f"{clock.size} rows",
            got=shapes or "nothing else",
            hint="save signals and their time at the same instants",
        )
    return _record(clock, columns, origin)


def _add(columns: dict[str, NDArray[Any]], name: str, values: NDArray[Any], rows: int) -> None:
    """Put a vector, or each column of a matrix, of so many rows among the columns; anything else is no signal."""
    if values.ndim == 1 and values.size == rows:
        columns[name] = values
    elif values.ndim == 2 and rows in values.shape:
        upright = values if values.shape[0] == rows else values.T
        for label, column in zip(_labels(name, upright.shape[1]), upright.T, strict=True):
            columns[label] = column


def _labels(name: str, n: int) -> tuple[str, ...]:
    return (name,) if n == 1 else tuple(f"{name}({i + 1})" for i in range(n))


def _list(value: Any) -> list[Any]:
    """The elements of a structure array, however it was stored."""
    if isinstance(value, dict):  # one structure; or version 7.3's array of them: one list a field
        lists = {k: v for k, v in value.items() if isinstance(v, list)}
        n = max(map(len, lists.values()), default=0)
        return [{k: v[i] for k, v in lists.items() if i < len(v)} for i in range(n)] if n else [value]
    return value if isinstance(value, list) else []


def _numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray | float | int) and np.asarray(value).dtype.kind in "fiub"


def _increases(values: NDArray[Any]) -> bool:
    values = values.astype(float)  # differences of whole numbers without a sign never fall
    return bool(values.size > 1 and np.isfinite(values).all() and (np.diff(values) >= 0).all() and np.ptp(values) > 0)
