"""A MATLAB or Octave script that builds the model: numbers with all digits, names, operating point."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.errors import ModelError
from hvdc_ident.files import write_text
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.system import Array

SUFFIX = ".m"
SUMMARY = "a MATLAB or Octave script that builds the state space, with names and operating point"


def write(model: LinearModel, path: Path) -> Path:
    """Write the model and return the path."""
    return write_text(path, text(model))


def text(model: LinearModel) -> str:
    """Return the script."""
    lines = [f"% Linear model of {_line(model.name)}: E*dx/dt = A*x + B*u, y = C*x + D*u, time in s."]
    lines += [f"% {_line(k)}: {_line(v)}" for k, v in model.provenance.items()]
    lines += [f"name = {_quoted(model.name)};"]
    lines += [f"{k} = {_matrix(getattr(model, k))};" for k in "ABCDE"]
    for kind in ("state", "input", "output"):
        lines += [
            f"{kind}_{w} = {{{', '.join(map(_quoted, getattr(model, f'{kind}_{w}')))}}};" for w in ("names", "units")
        ]
    lines += [f"{k} = {_matrix(np.array(getattr(model, k)).reshape(-1, 1))};" for k in ("x0", "u0", "y0")]
    build = "dss(A, B, C, D, E" if model.is_descriptor else "ss(A, B, C, D"
    names = "'StateName', state_names, 'InputName', input_names, 'OutputName', output_names"
    lines += ["if exist('ss')", f"  sys = {build}, {names});", "end"]
    return "\n".join(lines) + "\n"


def _line(text: str) -> str:
    return " ".join(text.split())


def _quoted(text: str) -> str:
    return "'" + _line(text).replace("'", "''") + "'"


def _matrix(values: Array) -> str:
    if values.size == 0:
        return f"zeros({values.shape[0]}, {values.shape[1]})"
    return "[" + "; ".join(" ".join(repr(float(v)) for v in row) for row in values) + "]"


def read(path: Path) -> LinearModel:
    """Return the linear model of a script that `write` wrote. Raises ModelError; nothing in the file is run."""
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as e:
        raise ModelError("the script cannot be read", where=str(path), got=str(e)) from None
    found = dict(re.findall(r"^(\w+) = (.*);$", content, flags=re.MULTILINE))
    try:
        numbers = {k: _parse_matrix(found[k]) for k in (*"ABCDE", "x0", "u0", "y0")}
        names = {
            f"{k}_{w}": tuple(n.replace("''", "'") for n in re.findall(r"'((?:[^']|'')*)'", found[f"{k}_{w}"]))
            for k in ("state", "input", "output")
            for w in ("names", "units")
        }
        name = found["name"][1:-1].replace("''", "'")
    except (KeyError, ValueError) as e:
        raise ModelError(
            "the script is not one that was written here", where=str(path), got=f"{type(e).__name__}: {e}"
        ) from None
    tail = {k: tuple(float(v) for v in numbers[k].ravel()) for k in ("x0", "u0", "y0")}
    fields: dict[str, Any] = {**{k: numbers[k] for k in "ABCDE"}, **names, **tail}
    return LinearModel(**fields, name=name)


def _parse_matrix(text: str) -> Array:
    if text.startswith("zeros("):
        rows, columns = text[6:-1].split(",")
        return np.zeros((int(rows), int(columns)))
    return np.array([[float(v) for v in row.split()] for row in text.strip("[]").split(";")])
