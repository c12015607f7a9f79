"""Linear models as files: .mat, .json, .m, .csv of the frequency response, and Modelica, by the ending of the file's name."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.errors import LinearizationError, ModelError
from hvdc_ident.files import csv_columns, json_text, write_bytes, write_text
from hvdc_ident.linearize.frequency import FrequencyResponse, frequency_response
from hvdc_ident.linearize.linear_model import KINDS, LinearModel
from hvdc_ident.linearize.system import Array


def write(model: LinearModel, path: str | Path) -> Path:
    """Write the model in the format of the path's ending, and return the path. Raises ModelError for an ending that has none."""
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ModelError(
            "no format of a linear model has this ending", where=str(path), expected=f"one of {', '.join(FORMATS)}"
        )
    content = FORMATS[path.suffix.lower()](model, path.stem)
    return write_bytes(path, content) if isinstance(content, bytes) else write_text(path, content)


def _names(model: LinearModel) -> dict[str, tuple[str, ...]]:
    return {f"{k}_{w}": getattr(model, f"{k}_{w}") for k in KINDS for w in ("names", "units")}


def _levels(model: LinearModel) -> dict[str, Array]:
    return {k: np.array(getattr(model, k), dtype=float) for k in ("x0", "u0", "y0")}


def _provenance(model: LinearModel, mark: str) -> list[str]:
    """The provenance as lines of comment."""
    return [f"{mark} {_line(f'{k}: {v}')}" for k, v in model.provenance.items()]


def _line(text: str) -> str:
    return " ".join(text.split())


def mat(model: LinearModel, name: str = "") -> bytes:
    """MATLAB version 5: A, B, C, D, E, x0, u0, y0, names and units as cell arrays, provenance as a struct."""
    import scipy.io

    def cells(names: tuple[str, ...]) -> Array:
        cell = np.empty((len(names), 1), dtype=object)
        cell[:, 0] = names
        return cell

    content: dict[str, Any] = {k: getattr(model, k) for k in "ABCDE"} | {"name": model.name}
    content |= {k: cells(v) for k, v in _names(model).items()}
    content |= {k: v.reshape(-1, 1) for k, v in _levels(model).items()}
    if model.provenance:
        content["provenance"] = {re.sub(r"\W", "_", k): v for k, v in model.provenance.items()}
    stream = io.BytesIO()
    scipy.io.savemat(stream, content, format="5", oned_as="column")
    return stream.getvalue()


def json(model: LinearModel, name: str = "") -> str:
    """JSON: all that the model holds, every digit; `LinearModel.from_dict` reads it back without loss."""
    return json_text(model.to_dict())


def csv(model: LinearModel, name: str = "") -> str:
    """CSV of the frequency response, with the provenance below it so that names stay in the first line."""
    return csv_of_response(frequency_response(model)) + "".join(f"{x}\n" for x in _provenance(model, "#"))


def csv_of_response(response: FrequencyResponse) -> str:
    """CSV: omega in rad/s, then `re OUTPUT from INPUT` and `im OUTPUT from INPUT` of each channel, every digit."""
    columns = {"omega": response.omega}
    for i, o in enumerate(response.output_names):
        for j, u in enumerate(response.input_names):
            values = response.values[:, i, j]
            columns |= {f"re {o} from {u}": values.real, f"im {o} from {u}": values.imag}
    return csv_columns(columns)


def script(model: LinearModel, name: str = "") -> str:
    """A MATLAB or Octave script that builds the state space, with names and operating point, every digit."""

    def quoted(text: str) -> str:
        return "'" + _line(text).replace("'", "''") + "'"

    def matrix(values: Array) -> str:
        if values.size == 0:
            return f"zeros({values.shape[0]}, {values.shape[1]})"
        return "[" + "; ".join(" ".join(repr(float(v)) for v in row) for row in values) + "]"

    lines = [f"% Linear model of {_line(model.name)}: E*dx/dt = A*x + B*u, y = C*x + D*u, time in s."]
    lines += [*_provenance(model, "%"), f"name = {quoted(model.name)};"]
    lines += [f"{k} = {matrix(getattr(model, k))};" for k in "ABCDE"]
    lines += [f"{k} = {{{', '.join(map(quoted, v))}}};" for k, v in _names(model).items()]
    lines += [f"{k} = {matrix(v.reshape(-1, 1))};" for k, v in _levels(model).items()]
    build = "dss(A, B, C, D, E" if model.is_descriptor else "ss(A, B, C, D"
    names = "'StateName', state_names, 'InputName', input_names, 'OutputName', output_names"
    lines += ["if exist('ss')", f"  sys = {build}, {names});", "end"]
    return "\n".join(lines) + "\n"


def modelica(model: LinearModel, name: str = "") -> str:
    """Modelica: der(x) = A x + B (u - u0), y = y0 + C x + D (u - u0), inputs and outputs in the plant's own values. Needs no library.

    Raises LinearizationError for a model without states, inputs or outputs, and for a descriptor whose algebraic part cannot
    be eliminated.
    """
    matrices = a, b, c, _ = model.standard()
    n, m, o = a.shape[0], b.shape[1], c.shape[0]
    if n == 0 or m == 0 or o == 0:
        raise LinearizationError(
            "a model without states, inputs or outputs has no Modelica state space", where=model.name
        )
    called = identifier(name or model.name)

    def quoted(text: str) -> str:
        return '"' + _line(text).replace("\\", "\\\\").replace('"', '\\"') + '"'

    def row(values: Any) -> str:
        return "{" + ", ".join(repr(float(v)) for v in values) + "}"

    levels = {k: v[:n] if k == "x0" else v for k, v in _levels(model).items()}
    names = {k: v[:n] if k.startswith("state") else v for k, v in _names(model).items()}
    lines = [
        f"model {called} {quoted('Linear model of ' + model.name + ', deviations x from x0')}",
        *(f"  {x}" for x in _provenance(model, "//")),
        *(
            f"  parameter Real {k}[{v.shape[0]}, {v.shape[1]}] = {{{', '.join(map(row, v))}}};"
            for k, v in zip("ABCD", matrices, strict=True)
        ),
        *(f"  parameter Real {k}[{len(v)}] = {row(v)};" for k, v in levels.items()),
        *(f"  constant String {k}[{len(v)}] = {{{', '.join(map(quoted, v))}}};" for k, v in names.items()),
        f"  input Real u[{m}] {quoted(', '.join(model.input_names))};",
        f"  output Real y[{o}] {quoted(', '.join(model.output_names))};",
        f"  Real x[{n}](each start = 0, each fixed = true) {quoted('deviations of ' + ', '.join(names['state_names']))};",
        "equation",
        "  der(x) = A * x + B * (u - u0);",
        "  y = y0 + C * x + D * (u - u0);",
        f"end {called};",
    ]
    return "\n".join(lines) + "\n"


def identifier(name: str) -> str:
    """Return a Modelica identifier like the name."""
    cleaned = re.sub(r"\W", "_", name, flags=re.ASCII) or "model_"
    reserved = {"model", "end", "equation", "input", "output", "parameter", "constant", "block", "class", "der"}
    return f"m_{cleaned}" if cleaned[0].isdigit() or cleaned in reserved else cleaned


FORMATS: Mapping[str, Callable[[LinearModel, str], str | bytes]] = {
    ".csv": csv, ".json": json, ".m": script, ".mat": mat, ".mo": modelica,
}  # fmt: skip
"""What writes a linear model, by ending, from the model and the file's name."""
