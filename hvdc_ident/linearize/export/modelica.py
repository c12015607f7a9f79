"""Modelica text: a state space model with start values, in deviations or in the plant's own values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.errors import LinearizationError, ModelError
from hvdc_ident.files import write_text
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.system import Array

SUFFIX = ".mo"
SUMMARY = "Modelica text of the state space: inputs and outputs in the plant's own values"


def write(model: LinearModel, path: Path) -> Path:
    """Write the model and return the path."""
    return write_text(path, text(model, path.stem))


def text(model: LinearModel, name: str = "") -> str:
    """Return the Modelica model: y = y0 + C x + D (u - u0), der(x) = A x + B (u - u0). Needs no library.

    Raises LinearizationError for a descriptor whose algebraic part cannot be eliminated.
    """
    a, b, c, d = model.standard()
    n, m, o = a.shape[0], b.shape[1], c.shape[0]
    names = model.state_names[:n]
    if n == 0 or m == 0 or o == 0:
        raise LinearizationError(
            "a model without states, inputs or outputs has no Modelica state space", where=model.name
        )
    lines = [
        f"model {identifier(name or model.name)} {_text('Linear model of ' + model.name + ', deviations x from x0')}",
        *(f"  // {' '.join(f'{k}: {v}'.split())}" for k, v in model.provenance.items()),
        *(
            f"  parameter Real {k}[{v.shape[0]}, {v.shape[1]}] = {_matrix(v)};"
            for k, v in zip("ABCD", (a, b, c, d), strict=True)
        ),
        *(
            f"  parameter Real {k}[{len(v)}] = {{{', '.join(repr(float(x)) for x in v)}}};"
            for k, v in (("x0", model.x0[:n]), ("u0", model.u0), ("y0", model.y0))
        ),
        *(
            f"  constant String {kind}_names[{len(v)}] = {{{', '.join(map(_text, v))}}};"
            for kind, v in (("state", names), ("input", model.input_names), ("output", model.output_names))
        ),
        *(
            f"  constant String {kind}_units[{len(v)}] = {{{', '.join(map(_text, v))}}};"
            for kind, v in (
                ("state", model.state_units[:n]),
                ("input", model.input_units),
                ("output", model.output_units),
            )
        ),
        f"  input Real u[{m}] {_text(', '.join(model.input_names))};",
        f"  output Real y[{o}] {_text(', '.join(model.output_names))};",
        f"  Real x[{n}](each start = 0, each fixed = true) {_text('deviations of ' + ', '.join(names))};",
        "equation",
        "  der(x) = A * x + B * (u - u0);",
        "  y = y0 + C * x + D * (u - u0);",
        f"end {identifier(name or model.name)};",
    ]
    return "\n".join(lines) + "\n"


def identifier(name: str) -> str:
    """Return a Modelica identifier like the name."""
    cleaned = re.sub(r"\W", "_", name, flags=re.ASCII) or "model_"
    reserved = {"model", "end", "equation", "input", "output", "parameter", "constant", "block", "class", "der"}
    return f"m_{cleaned}" if cleaned[0].isdigit() or cleaned in reserved else cleaned


def _text(value: str) -> str:
    return '"' + " ".join(value.split()).replace("\\", "\\\\").replace('"', '\\"') + '"'


def _matrix(values: Array) -> str:
    return "{" + ", ".join("{" + ", ".join(repr(float(v)) for v in row) + "}" for row in values) + "}"


def read(path: Path) -> LinearModel:
    """Return the linear model of a file that `write` wrote. Raises ModelError."""
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as e:
        raise ModelError("the Modelica file cannot be read", where=str(path), got=str(e)) from None
    found = dict(
        re.findall(r"^  (?:parameter Real|constant String) (\w+)\[[^]]*\] = (\{.*\});$", content, flags=re.MULTILINE)
    )
    title = re.search(r'^model \w+ "Linear model of (.*), deviations', content)
    try:
        rows = {k: [[float(v) for v in r.split(",")] for r in re.findall(r"\{([^{}]+)\}", found[k])] for k in "ABCD"}
        tail = {k: tuple(float(v) for v in found[k].strip("{}").split(",")) for k in ("x0", "u0", "y0")}
        names = {
            f"{k}_{w}": tuple(re.sub(r"\\(.)", r"\1", n) for n in re.findall(r'"((?:[^"\\]|\\.)*)"', found[f"{k}_{w}"]))
            for k in ("state", "input", "output")
            for w in ("names", "units")
        }
    except (KeyError, ValueError) as e:
        raise ModelError(
            "the file is not one that was written here", where=str(path), got=f"{type(e).__name__}: {e}"
        ) from None
    matrices = [np.array(rows[k]) for k in "ABCD"]
    name = re.sub(r"\\(.)", r"\1", title.group(1)) if title else "model"
    fields: dict[str, Any] = {**dict(zip("ABCD", matrices, strict=True)), **names, **tail}
    return LinearModel(**fields, E=np.eye(matrices[0].shape[0]), name=name)
