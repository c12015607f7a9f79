"""The docstrings of the public functions say each argument, result and error, and their examples do what they show."""

from __future__ import annotations

import ast
import builtins
import doctest
import importlib
import inspect
from collections.abc import Callable
from typing import Any

import pytest
from numpydoc.docscrape import FunctionDoc

import hvdc_ident
from hvdc_ident import errors, linear, sensitivity

OFFERED = {
    **{name: getattr(hvdc_ident, name) for name in hvdc_ident.__all__},
    **{f"linear.{name}": getattr(linear, name) for name in linear.__all__},
    **{f"sensitivity.{name}": getattr(sensitivity, name) for name in ("morris", "sobol")},
}
FUNCTIONS = {name: thing for name, thing in OFFERED.items() if inspect.isfunction(thing)}
OTHERS = ("hvdc_ident.data.experiment", "hvdc_ident.sensitivity.sweep_run")
"""Modules whose docstrings hold examples beside those of public functions."""
STARS = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}


def test_the_public_functions_are_those_that_are_meant() -> None:
    assert {"simulate", "fit", "load_model", "linear.margins", "sensitivity.sobol"} <= set(FUNCTIONS)
    assert len([n for n in FUNCTIONS if "." not in n]) == 20


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_docstring_has_its_sections(name: str) -> None:
    function = FUNCTIONS[name]
    doc = FunctionDoc(function)
    assert len(doc["Summary"]) == 1 and doc["Summary"][0].endswith(".")
    assert doc["Summary"][0].startswith("Return ") or ", and return " in doc["Summary"][0]
    assert [p.name for p in doc["Parameters"]] == _arguments(function)
    assert all(p.type or p.name.startswith("*") for p in doc["Parameters"])
    assert bool(doc["Returns"]) == (inspect.signature(function).return_annotation not in (None, "None"))
    assert doc["Raises"] and all(_is_error(line.type) for line in doc["Raises"])
    assert all(line.desc for section in ("Parameters", "Returns", "Raises") for line in doc[section])
    assert any(line.startswith(">>> ") for line in doc["Examples"])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_default_is_said_as_the_signature_has_it(name: str) -> None:
    said = {p.name: p.type.partition(", default ")[2] for p in FunctionDoc(FUNCTIONS[name])["Parameters"]}
    own = inspect.signature(FUNCTIONS[name]).parameters
    for argument, text in said.items():
        default = inspect.Parameter.empty if argument.startswith("*") else own[argument].default
        assert (ast.literal_eval(text) if text else inspect.Parameter.empty) == default, argument


def _arguments(function: Callable[..., Any]) -> list[str]:
    """Return the names of a signature, *args and **kwargs with their stars."""
    return [STARS.get(p.kind, "") + p.name for p in inspect.signature(function).parameters.values()]


def _is_error(name: str) -> bool:
    found = getattr(errors, name, getattr(builtins, name, None))
    return isinstance(found, type) and issubclass(found, Exception)


@pytest.mark.parametrize("name", sorted({inspect.unwrap(f).__module__ for f in FUNCTIONS.values()} | {*OTHERS}))
def test_the_examples_of_a_module_do_what_they_show(name: str) -> None:
    found = doctest.testmod(importlib.import_module(name), raise_on_error=False)
    assert found.attempted and not found.failed
