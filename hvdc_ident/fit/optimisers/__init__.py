"""The optimisers, one file each; a file supplies NAME, SUMMARY (one line) and OPTIMISER (the options class)."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from hvdc_ident.errors import require_known
from hvdc_ident.fit.optimiser import Optimiser


def catalogue() -> dict[str, Any]:
    """Return the modules of this folder by the NAME each one gives itself."""
    names = sorted(m.name for m in pkgutil.iter_modules(__path__))
    modules = [importlib.import_module(f"{__name__}.{n}") for n in names]
    return {m.NAME: m for m in modules}


def optimiser(name: str) -> Optimiser:
    """Return the named optimiser with its default options. Raises UnknownNameError."""
    known = catalogue()
    require_known("optimiser", [name], known, "")
    named: Optimiser = known[name].OPTIMISER()
    return named
