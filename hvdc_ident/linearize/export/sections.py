"""Zeros, poles and gain as JSON, and second-order sections as CSV."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from hvdc_ident.errors import ModelError
from hvdc_ident.files import json_text, write_text
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.system import Array
from hvdc_ident.linearize.transfer_function import TransferFunction

SUFFIX = ".zpk"
SUMMARY = "zeros, poles, gain and continuous second-order sections of every channel, as JSON"


def write(model: LinearModel, path: Path) -> Path:
    """Write the model and return the path."""
    functions = [model.transfer_function(i, o) for o in model.output_names for i in model.input_names]
    rows = [{**f.to_dict(), "sections": sections(f).tolist()} for f in functions]
    text = "[b2, b1, b0, a2, a1, a0] in falling powers of s; G is their product"
    head = {"schema": 1, "model": model.name, "provenance": dict(model.provenance), "sections": text}
    return write_text(path, json_text({**head, "transfer_functions": rows}))


def read(path: Path) -> tuple[TransferFunction, ...]:
    """Return the transfer functions of a file that `write` wrote. Raises ModelError."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return tuple(
            TransferFunction(
                f["input"],
                f["output"],
                np.array([complex(*v) for v in f["zeros"]], dtype=complex),
                np.array([complex(*v) for v in f["poles"]], dtype=complex),
                float(f["gain"]),
            )
            for f in data["transfer_functions"]
        )
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise ModelError("the file holds no zeros and poles", where=str(path), got=f"{type(e).__name__}: {e}") from None


def sections(f: TransferFunction) -> Array:
    """Return (k, 6) rows [b2, b1, b0, a2, a1, a0] of second-order factors, falling powers of s; the gain is in the first."""
    top, bottom = _quadratics(f.zeros), _quadratics(f.poles)
    count = max(len(top), len(bottom), 1)
    one = [0.0, 0.0, 1.0]
    rows = [[*(top[k] if k < len(top) else one), *(bottom[k] if k < len(bottom) else one)] for k in range(count)]
    found = np.array(rows, dtype=float)
    found[0, :3] *= f.gain
    return found


def _quadratics(roots: Array) -> list[list[float]]:
    """Factors of the second degree, a single one of the first where their number is odd."""
    pairs = [r for r in roots if r.imag > 0]
    real = sorted((float(r.real) for r in roots if r.imag == 0), key=abs)
    found = [[1.0, -2.0 * float(r.real), float(abs(r) ** 2)] for r in pairs]
    for k in range(0, len(real) - 1, 2):
        found.append([1.0, -(real[k] + real[k + 1]), real[k] * real[k + 1]])
    if len(real) % 2:
        found.append([0.0, 1.0, -real[-1]])
    return found
