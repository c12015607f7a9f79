"""CSV of the frequency response: omega, then real and imaginary part of each channel, every digit."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from hvdc_ident.errors import ModelError
from hvdc_ident.files import write_text
from hvdc_ident.linearize.frequency import FrequencyResponse
from hvdc_ident.linearize.linear_model import LinearModel

SUFFIX = ".csv"
SUMMARY = "the frequency response: omega in rad/s, real and imaginary part, delays exact"
_ARROW = " from "


def write(model: LinearModel, path: Path) -> Path:
    """Write the response at frequencies around the poles, and return the path."""
    return write_text(path, text(model.bode()) + _note(model))


def _note(model: LinearModel) -> str:
    """Return the provenance as comments, put below the response so that names stay in the first line."""
    return "".join(f"# {' '.join(f'{k}: {v}'.split())}\n" for k, v in model.provenance.items())


def text(response: FrequencyResponse) -> str:
    """CSV text: columns omega, `re OUTPUT from INPUT`, `im OUTPUT from INPUT`."""
    header, columns = ["omega"], [response.omega]
    for i, o in enumerate(response.output_names):
        for j, u in enumerate(response.input_names):
            header += [f"re {o}{_ARROW}{u}", f"im {o}{_ARROW}{u}"]
            columns += [response.values[:, i, j].real, response.values[:, i, j].imag]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([[repr(float(v)) for v in row] for row in np.column_stack(columns)])
    return stream.getvalue()


def read(path: Path) -> FrequencyResponse:
    """Return the response of a file that `write` wrote. Raises ModelError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = list(csv.reader(line for line in lines if not line.startswith("#")))
        data = np.array([[float(v) for v in row] for row in rows[1:]])
    except (OSError, ValueError) as e:
        raise ModelError("the frequency response cannot be read", where=str(path), got=str(e)) from None
    if not rows or rows[0][:1] != ["omega"] or len(rows[0]) % 2 == 0 or data.ndim != 2:
        raise ModelError("this is no frequency response", where=str(path), expected="columns omega, re ..., im ...")
    channels = [h.removeprefix("re ").split(_ARROW) for h in rows[0][1::2]]
    outputs, inputs = tuple(dict.fromkeys(c[0] for c in channels)), tuple(dict.fromkeys(c[1] for c in channels))
    values = (data[:, 1::2] + 1j * data[:, 2::2]).reshape(-1, len(outputs), len(inputs))
    return FrequencyResponse(data[:, 0], values, outputs, inputs, source=str(path.name))
