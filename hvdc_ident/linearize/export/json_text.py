"""JSON: everything a linear model holds, every digit; read back without loss."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hvdc_ident.errors import ModelError
from hvdc_ident.files import json_text, write_text
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.linear_model import LinearModel

SCHEMA = 1
SUFFIX = ".json"
SUMMARY = "all matrices, names, units, operating point and provenance, full precision"


def to_dict(model: LinearModel) -> dict[str, Any]:
    """Return the linear model as plain lists and text."""
    point = {} if model.point is None else {"operating_point": model.point.to_dict()}
    return {
        "schema": SCHEMA,
        "kind": "linear-model",
        "model": model.name,
        "equation": "E dx/dt = A x + B u, y = C x + D u, deviations from x0, u0, y0; time in s",
        **{k: getattr(model, k).tolist() for k in "ABCDE"},
        "state_names": list(model.state_names),
        "input_names": list(model.input_names),
        "output_names": list(model.output_names),
        "state_units": list(model.state_units),
        "input_units": list(model.input_units),
        "output_units": list(model.output_units),
        "x0": list(model.x0),
        "u0": list(model.u0),
        "y0": list(model.y0),
        "provenance": dict(model.provenance),
        **point,
    }


def from_dict(data: dict[str, Any], where: str = "linear model") -> LinearModel:
    """Return the linear model of `to_dict`'s result. Raises ModelError where it is not one."""
    if not isinstance(data, dict) or data.get("schema") != SCHEMA or "A" not in data:
        raise ModelError(
            "this is no linear model", where=where, expected=f"a JSON object with schema {SCHEMA} and A, B, C, D"
        )
    try:
        fields: dict[str, Any] = {k: data[k] for k in "ABCDE"}
        fields |= {
            f"{k}_{w}": tuple(data[f"{k}_{w}"]) for k in ("state", "input", "output") for w in ("names", "units")
        }
        fields |= {k: tuple(data[k]) for k in ("x0", "u0", "y0")}
        return LinearModel(**fields, name=data["model"], provenance=FrozenMap(data.get("provenance", {})))
    except (KeyError, TypeError, ValueError) as e:
        raise ModelError("the linear model is incomplete", where=where, got=f"{type(e).__name__}: {e}") from None


def write(model: LinearModel, path: Path) -> Path:
    """Write the model and return the path."""
    return write_text(path, json_text(to_dict(model)))


def read(path: Path) -> LinearModel:
    """Return the linear model of a file. Raises ModelError."""
    try:
        return from_dict(json.loads(path.read_text(encoding="utf-8")), str(path))
    except (OSError, ValueError) as e:
        raise ModelError("the file cannot be read as JSON", where=str(path), got=str(e)) from None
