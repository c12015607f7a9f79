"""The optimisers, one file each; a file supplies NAME, SUMMARY (one line) and OPTIMISER (the options class).

GLOBAL = True in a file: its method searches the whole range by itself, so that one start is enough. PACKAGE: what it
needs beyond the package's own dependencies, of the extra `optimisers`.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from dataclasses import fields
from typing import Any

from hvdc_ident.errors import require_known
from hvdc_ident.fit.optimiser import Optimiser, missing


def catalogue() -> dict[str, Any]:
    """Return the modules of this folder by the NAME each one gives itself."""
    names = sorted(m.name for m in pkgutil.iter_modules(__path__))
    modules = [importlib.import_module(f"{__name__}.{n}") for n in names]
    return {m.NAME: m for m in modules}


def _module(name: str) -> Any:
    known = catalogue()
    require_known("optimiser", [name], known, "")
    return known[name]


def optimiser(name: str, seed: int = 0) -> Optimiser:
    """Return the named optimiser with its default options; seed: of its random numbers, if it has any.

    Raises UnknownNameError.
    """
    options = _module(name).OPTIMISER
    seeded = any(f.name == "seed" for f in fields(options))
    named: Optimiser = options(seed=seed) if seeded else options()
    return named


def need(name: str) -> None:
    """Raise UnknownNameError for an unknown optimiser, InputError where its package is not installed."""
    package = getattr(_module(name), "PACKAGE", None)
    if package is not None and importlib.util.find_spec(package) is None:
        raise missing(package, name)


def is_global(method: Optimiser) -> bool:
    """Return whether the optimiser searches the whole range by itself."""
    return any(isinstance(method, m.OPTIMISER) and getattr(m, "GLOBAL", False) for m in catalogue().values())
