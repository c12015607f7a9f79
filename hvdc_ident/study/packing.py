"""Values of this package as text that can be kept, and back, bit for bit; never a pickle.

Reading one back runs no code but the constructors of this package's own frozen dataclasses, so a store that somebody
else wrote can be wrong, not harmful.
"""

from __future__ import annotations

import base64
import dataclasses
import importlib
import json
import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from hvdc_ident.errors import ComputationError
from hvdc_ident.immutable import FrozenMap

PACKAGE = "hvdc_ident"
_KIND = "!"


def packed(value: Any) -> bytes:
    """The value as bytes. Raises TypeError for what is no number, text, array, collection or dataclass of here."""
    return json.dumps(_plain(value), ensure_ascii=False, separators=(",", ":")).encode()


def unpacked(content: bytes) -> Any:
    """The value again. Raises ComputationError where the bytes are none that `packed` made, or one of another release did."""
    try:
        return _value(json.loads(content))
    except (ValueError, KeyError, TypeError, IndexError, ImportError) as error:
        raise ComputationError(
            "a kept result cannot be read", got=f"{type(error).__name__}: {error}", hint="remove the folder .store"
        ) from None


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int) and not isinstance(value, np.generic):
        return value
    if isinstance(value, float) and not isinstance(value, np.generic):
        return value if math.isfinite(value) else {_KIND: "f", "v": repr(value)}
    if isinstance(value, bytes):
        return {_KIND: "b", "v": base64.b64encode(value).decode()}
    if isinstance(value, complex) and not isinstance(value, np.generic):
        return {_KIND: "c", "v": [_plain(value.real), _plain(value.imag)]}
    if isinstance(value, np.ndarray | np.generic):
        return _array(np.asarray(value), isinstance(value, np.generic))
    if isinstance(value, list):
        return [_plain(v) for v in value]
    if isinstance(value, tuple):
        return {_KIND: "t", "v": [_plain(v) for v in value]}
    if isinstance(value, Mapping):
        kind = "m" if isinstance(value, FrozenMap) else "d"
        return {_KIND: kind, "v": [[_plain(k), _plain(v)] for k, v in value.items()]}
    if dataclasses.is_dataclass(value) and type(value).__module__.split(".")[0] == PACKAGE:
        made = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
        return {_KIND: "o", "of": f"{type(value).__module__}:{type(value).__qualname__}", "v": made}
    raise TypeError(f"{type(value).__module__}.{type(value).__qualname__} cannot be kept")


def _array(value: np.ndarray[Any, Any], scalar: bool) -> dict[str, Any]:
    if value.dtype.kind not in "biufc":
        raise TypeError(f"an array of {value.dtype} cannot be kept")
    content = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
    return {_KIND: "s" if scalar else "a", "type": value.dtype.str, "shape": list(value.shape), "v": content}


def _value(plain: Any) -> Any:
    if isinstance(plain, list):
        return [_value(v) for v in plain]
    if not isinstance(plain, dict):
        return plain
    kind, content = plain[_KIND], plain["v"]
    if kind == "f":
        return float(content)
    if kind == "b":
        return base64.b64decode(content, validate=True)
    if kind == "c":
        return complex(*map(_value, content))
    if kind in "as":
        array = (
            np.frombuffer(base64.b64decode(content, validate=True), np.dtype(plain["type"]))
            .reshape(plain["shape"])
            .copy()
        )
        return array[()] if kind == "s" else array
    if kind == "t":
        return tuple(map(_value, content))
    if kind in "md":
        found = {_value(k): _value(v) for k, v in content}
        return FrozenMap(found) if kind == "m" else found
    if kind == "o":
        return _class(plain["of"])(**{name: _value(v) for name, v in content.items()})
    raise ValueError(f"no kind '{kind}'")


@cache
def _class(name: str) -> Any:
    """A dataclass of this package by module and name; ValueError for anything else."""
    module, _, qualified = name.partition(":")
    if module.split(".")[0] != PACKAGE or "." in qualified:
        raise ValueError(f"'{name}' is no class of {PACKAGE}")
    found = getattr(importlib.import_module(module), qualified, None)
    if not (isinstance(found, type) and dataclasses.is_dataclass(found) and found.__module__ == module):
        raise ValueError(f"'{name}' is no dataclass of {PACKAGE}")
    return found
