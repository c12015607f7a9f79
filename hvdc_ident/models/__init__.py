"""The shipped models, one file each, and the one way to load any model.

A file gives `model()` and one line, SUMMARY, under its own name with hyphens; where it has structure options it may
ship more of them: VARIANTS, {name: (one line, function that gives the model)}, or a family of any size: `family(name)`,
which gives the model a name asks for, or None. Files that begin with _ are no models.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hvdc_ident.errors import ModelError, in_python, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, Model, is_white_box
from hvdc_ident.next_step import NextStep

if TYPE_CHECKING:
    from hvdc_ident.fmu import Limits

__all__ = ["is_shipped", "load_model", "shipped_models", "summaries"]


@cache
def _shipped_by_name() -> FrozenMap[tuple[str, Callable[[], Model]]]:
    shipped: dict[str, tuple[str, Callable[[], Model]]] = {}
    for name in sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_")):
        module: Any = importlib.import_module(f"{__name__}.{name}")
        shipped |= {name.replace("_", "-"): (str(module.SUMMARY), module.model)} | getattr(module, "VARIANTS", {})
    return FrozenMap(shipped)


def shipped_models() -> tuple[str, ...]:
    """Names of the shipped models."""
    return tuple(_shipped_by_name())


def is_shipped(name: str) -> bool:
    """Return True where a model of that name is shipped, alone or as one of a family."""
    return name in _shipped_by_name() or _of_a_family(name) is not None


def summaries() -> dict[str, str]:
    """Return one line on each shipped model, by name."""
    return {name: summary for name, (summary, _) in _shipped_by_name().items()}


@cache
def _shipped(name: str) -> Model:
    known = _shipped_by_name()
    model = known[name][1]() if name in known else _of_a_family(name)
    assert model is not None  # is_shipped said so
    return model


@cache
def _of_a_family(name: str) -> Model | None:
    """Return the member of a family of models that goes by the name; None where none does."""
    for module_name in (m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_")):
        module: Any = importlib.import_module(f"{__name__}.{module_name}")
        member = module.family(name) if hasattr(module, "family") else None
        if is_white_box(member):
            return member
    return None


@in_python
def load_model(
    source: str | Path,
    *,
    trust: bool = False,
    interface: Literal["model-exchange", "co-simulation"] | None = None,
    limits: Limits | Mapping[str, float] | None = None,
) -> AnyModel:
    """Return a shipped model by name, or the model of a file.

    A Python file runs its code here; an FMU runs its own in a process of its own, which contains crashes, not malice: load only FMUs
    you trust.

    Parameters
    ----------
    source : str or Path
        The name of a shipped model, or the path of a model card (.toml), an FMU (.fmu) or a Python file (.py, needs `trust`).
    trust : bool, default False
        Whether a Python file may be run.
    interface : "model-exchange" or "co-simulation", default None
        Of an FMU that offers both. None: model exchange.
    limits : Limits or dict of float, default None
        Of an FMU's process, as {"deadline": 300.0, "load": 60.0, "memory": 4096}: s for one run, s to begin, and MiB. None: 60 s,
        60 s and 2048 MiB.

    Returns
    -------
    Model
        The model; of an FMU an object that is used like one.

    Raises
    ------
    UnknownNameError
        A name that is not shipped.
    ModelError
        A file that cannot be used, or limits of a model that is no FMU.

    Examples
    --------
    >>> from hvdc_ident import load_model
    >>> link = load_model("vsc-hvdc-link")
    >>> list(link.states)
    ['Vdc1', 'Vdc2', 'xv', 'xp', 'xq1', 'xq2']
    >>> link.parameters["KIVDC"].value, link.parameters["KIVDC"].unit
    (734.7, 'pu/s')
    """
    text = str(source)
    if is_shipped(text):
        if limits is not None:
            raise _unlimited(text)
        return _shipped(text)
    path = Path(text)
    suffix = path.suffix.lower()
    if limits is not None and suffix != ".fmu":
        raise _unlimited(text)
    if suffix == ".toml":
        from hvdc_ident.model import read_card

        return read_card(path)
    if suffix == ".fmu":
        from hvdc_ident.fmu import read_fmu

        return read_fmu(path, interface=interface, limits=limits)
    if suffix == ".py":
        return _from_python(path, trust)
    if suffix or path.exists():
        raise ModelError(
            "this kind of model file cannot be read",
            where=text,
            expected="a model card (.toml), an FMU (.fmu) or a Python file (.py)",
        )
    raise unknown_name("shipped model", text, shipped_models())


def _unlimited(source: str) -> ModelError:
    return ModelError(
        "deadline, load and memory are limits of an FMU's process, and this model has none",
        where=source,
        expected="a path that ends in .fmu",
    )


def _from_python(path: Path, trust: bool) -> Model:
    if not trust:
        raise ModelError(
            "a Python model runs its code",
            where=str(path),
            hint="read the file first; a model card needs no trust",
            next=(NextStep("option", "trust = True", "then runs it"),),
        )
    if not path.is_file():
        raise ModelError("the model file is not there", where=str(path))
    namespace: dict[str, object] = {"__name__": "hvdc_ident_user_model", "__file__": str(path)}
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), namespace)
    defined = namespace.get("model")
    result = defined() if callable(defined) else defined
    if not is_white_box(result):
        raise ModelError(
            "the file defines no model",
            where=str(path),
            expected="a variable or function `model` that gives a Model",
            got=type(result).__name__,
        )
    return result
