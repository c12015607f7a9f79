"""Names of a package and methods of a class that are imported when they are first used, so that importing stays quick."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def offered(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package that offers names of its modules (PEP 562).

    modules: names by module, as one text: {"fit.result": "Estimate FitResult"}.
    """
    home = {name: module for module, names in modules.items() for name in names.split()}

    def attribute(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(importlib.import_module(f"{package}.{home[name]}"), name)
        setattr(sys.modules[package], name, value)  # found without this function from now on
        return value

    return attribute


class method:
    """A method that is a function of another module, which is imported when the method is first asked for.

    So a class can offer what is made of it without importing its users. path: of the function, with its module.
    """

    def __init__(self, path: str) -> None:
        self._path = path

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object, owner: type) -> Any:
        module, _, name = self._path.rpartition(".")
        function = getattr(importlib.import_module(module), name)
        setattr(owner, self._name, function)  # found without this object from now on
        return getattr(owner if instance is None else instance, self._name)
