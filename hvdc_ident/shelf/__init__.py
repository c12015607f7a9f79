"""The shelf: standard components of plants, one model card each, named as in the standards and as in .dyr files."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

from hvdc_ident.errors import unknown_name
from hvdc_ident.immutable import FrozenMap


@cache
def components() -> tuple[str, ...]:
    """Return the names of the components."""
    return tuple(sorted(p.stem for p in Path(__file__).parent.glob("*.toml")))


def is_component(name: str) -> bool:
    """Return True where a component of that name is on the shelf."""
    return name in components()


def card_of(name: str) -> Path:
    """Return the path of a component's card. Raises UnknownNameError for a name that is not on the shelf."""
    if not is_component(name):
        raise unknown_name("component", name, components())
    return Path(__file__).parent / f"{name}.toml"


@cache
def _sources() -> dict[str, str]:
    """Return the component of each model of .dyr files, by the model's name."""
    by_model = {name.upper(): name for name in components()}
    for name in components():
        by_model |= dict.fromkeys(_about(name).get("also", ()), name)
    return by_model


def source_of(model: str) -> str | None:
    """Return the component that stands for a model of .dyr files (GENROU); None where none is on the shelf."""
    return _sources().get(model.upper())


@cache
def record_of(name: str) -> tuple[str, ...]:
    """Return a component's parameters in the order of the values of its .dyr record; "-" for a value that it does not use."""
    return tuple(_about(name).get("record", ()))


@cache
def power_flow_of(name: str) -> FrozenMap[str]:
    """Return the parameters of a component that a power flow states, with the names of their fields there."""
    return FrozenMap(_about(name).get("power_flow", {}))


@cache
def asked_of(name: str) -> tuple[str, ...]:
    """Return the parameters of a component that a study asks about, the first that counts."""
    return tuple(_about(name).get("asked", ()))


@cache
def exchange_of(name: str) -> FrozenMap[Any]:
    """Return the table of a component's card that says what its parameters mean, and for which others it stands in."""
    return FrozenMap(_about(name).get("exchange", {}))


@cache
def outputs_of(name: str) -> frozenset[str]:
    """Return the names of a component's outputs, without its equations being read."""
    return frozenset(_about(name)["outputs"])


@cache
def _about(name: str) -> dict[str, Any]:
    return tomllib.loads(card_of(name).read_text(encoding="utf-8"))
