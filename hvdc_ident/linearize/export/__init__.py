"""Linear models as files, one format per file; which one is decided by the file name's ending."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from hvdc_ident.errors import ModelError
from hvdc_ident.linearize.linear_model import LinearModel

__all__ = ["formats", "read", "write"]


@cache
def formats() -> dict[str, ModuleType]:
    """Return the formats by ending."""
    found = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    return {m.SUFFIX: m for m in found}


def _format(path: Path) -> Any:
    if path.suffix.lower() not in formats():
        raise ModelError(
            "no format of a linear model has this ending", where=str(path), expected=f"one of {', '.join(formats())}"
        )
    return formats()[path.suffix.lower()]


def write(model: LinearModel, path: str | Path) -> Path:
    """Write the model in the format of the ending of the path, and return the path. Raises ModelError for an ending that has none."""
    return Path(_format(Path(path)).write(model, Path(path)))


def read(path: str | Path) -> Any:
    """Return the contents of a file: a LinearModel, of a .csv a FrequencyResponse, of a .zpk transfer functions. Raises ModelError."""
    chosen = _format(Path(path))
    if not hasattr(chosen, "read"):
        raise ModelError("this format is for people and cannot be read back", where=str(path), hint="use .json or .mat")
    return chosen.read(Path(path))
