"""MATLAB .mat version 5: A, B, C, D, E, names, units, x0, u0, y0 as variables of their own, provenance as a struct."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.errors import ModelError
from hvdc_ident.files import write_bytes
from hvdc_ident.linearize.linear_model import LinearModel

SUFFIX = ".mat"
SUMMARY = "MATLAB version 5: A, B, C, D, E, x0, u0, y0, names and units; sys = ss(A, B, C, D)"


def write(model: LinearModel, path: Path) -> Path:
    """Write the model, doubles as they are and names as cell arrays, and return the path."""
    import scipy.io

    def cells(names: tuple[str, ...]) -> Any:
        cell = np.empty((len(names), 1), dtype=object)
        for k, n in enumerate(names):
            cell[k, 0] = n
        return cell

    content: dict[str, Any] = {k: getattr(model, k) for k in "ABCDE"}
    for kind in ("state", "input", "output"):
        content[f"{kind}_names"] = cells(getattr(model, f"{kind}_names"))
        content[f"{kind}_units"] = cells(getattr(model, f"{kind}_units"))
    content |= {k: np.array(getattr(model, k), dtype=float).reshape(-1, 1) for k in ("x0", "u0", "y0")}
    content["name"] = model.name
    if model.provenance:
        content["provenance"] = {re.sub(r"\W", "_", k): v for k, v in model.provenance.items()}
    stream = io.BytesIO()
    scipy.io.savemat(stream, content, format="5", oned_as="column")
    return write_bytes(path, stream.getvalue())


def read(path: Path) -> LinearModel:
    """Return the linear model of a file. Raises ModelError."""
    import scipy.io

    try:
        data = scipy.io.loadmat(path)
    except Exception as e:  # the reader raises its own errors and many others on bytes that are no such file
        raise ModelError("the file cannot be read as MATLAB version 5", where=str(path), got=str(e)[:200]) from None
    missing = [k for k in ("A", "B", "C", "D", "state_names", "input_names", "output_names") if k not in data]
    if missing:
        raise ModelError(
            "the file holds no linear model", where=str(path), expected="A, B, C, D and names", got=f"no {missing[0]}"
        )

    def names(key: str) -> tuple[str, ...]:
        return tuple(str(np.ravel(c)[0]) if np.size(c) else "" for c in np.ravel(data.get(key, [])))

    def numbers(key: str) -> tuple[float, ...]:
        return tuple(float(v) for v in np.ravel(data.get(key, [])))

    fields: dict[str, Any] = {k: np.asarray(data[k], dtype=float) for k in "ABCD"}
    fields["E"] = np.asarray(data.get("E", np.eye(data["A"].shape[0])), dtype=float)
    fields |= {f"{k}_{w}": names(f"{k}_{w}") for k in ("state", "input", "output") for w in ("names", "units")}
    fields |= {k: numbers(k) for k in ("x0", "u0", "y0")}
    return LinearModel(**fields, name=str(np.ravel(data.get("name", ["model"]))[0]))
