"""Methods of a class that are imported when they are first used, so that importing stays quick."""

from __future__ import annotations

import importlib
from typing import Any


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
