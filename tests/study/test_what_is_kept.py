"""Whatever the package hands to an executor comes back as something the store can hold, by the types of the functions."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import pkgutil
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

import hvdc_ident
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.fit.optimiser import Optimiser
from hvdc_ident.fit.partial_fits import _alone
from hvdc_ident.fit.profile import _descend
from hvdc_ident.immutable import FrozenMap

BOUND = {
    "partial(_alone, whiten=whiten)": _alone,
    "partial(method.run, problem)": Optimiser.run,
    "partial(_descend, objective)": _descend,
}
"""Calls whose function is no name of its module: what is bound in them."""
PLAIN = (bool, int, float, complex, str, bytes, type(None), np.integer, np.floating)


def calls() -> Iterator[tuple[str, ast.expr]]:
    """Of every call of `mapped` in the package the module and the function that is given."""
    for module in pkgutil.walk_packages(hvdc_ident.__path__, "hvdc_ident."):
        spec = importlib.util.find_spec(module.name)
        assert spec is not None and spec.origin is not None
        with open(spec.origin, encoding="utf-8") as stream:
            text = stream.read()
        for node in ast.walk(ast.parse(text)) if "mapped(" in text else ():
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "mapped":
                yield module.name, node.args[1]


CALLS = [pytest.param(module, given, id=f"{module}:{ast.unparse(given)}") for module, given in calls()]


def returned(module: str, given: ast.expr) -> Any:
    """The type that a function given to an executor returns."""
    text = ast.unparse(given)
    name = given.func.id if isinstance(given, ast.Call) and isinstance(given.func, ast.Name) else text
    found = BOUND.get(text) or getattr(importlib.import_module(module), name)
    return typing.get_type_hints(found.__call__ if isinstance(found, type) else found)["return"]


def unkept(hint: Any, above: tuple[Any, ...] = ()) -> list[str]:
    """The parts of a type that the store has no form for. above: the types that it is a part of; one may hold itself."""
    if hint in above:
        return []
    above = (*above, hint)
    kind, parts = typing.get_origin(hint), typing.get_args(hint)
    if kind is typing.Literal:
        return []
    if kind in (typing.Union, types.UnionType, list, tuple, dict, Mapping, Sequence, FrozenMap) or (
        isinstance(kind, type) and issubclass(kind, Mapping | Sequence)
    ):
        return [bad for part in parts if part is not Ellipsis for bad in unkept(part, above)]
    if hint in PLAIN or kind is np.ndarray or hint is Any:
        return []
    if dataclasses.is_dataclass(hint) and hint.__module__.startswith("hvdc_ident") and "." not in hint.__qualname__:
        own = typing.get_type_hints(hint)
        return [
            f"{hint.__name__}.{f.name}: {bad}" for f in dataclasses.fields(hint) for bad in unkept(own[f.name], above)
        ]
    return [str(hint)]


@pytest.mark.parametrize(("module", "given"), CALLS)
def test_a_function_given_to_an_executor_returns_what_can_be_kept(module: str, given: ast.expr) -> None:
    assert unkept(returned(module, given)) == []


def test_a_refit_with_its_model_cannot_be_kept() -> None:
    """The check itself: a model, with its equations, is found however deep it lies."""
    assert any("model" in bad for bad in unkept(tuple[Refit, ...]))
