"""The examples in the docstrings of the public verbs do what they show."""

from __future__ import annotations

import doctest
import importlib

import pytest

WITH_EXAMPLES = (
    "hvdc_ident.api",
    "hvdc_ident.data.experiment",
    "hvdc_ident.formats",
    "hvdc_ident.data.signals",
    "hvdc_ident.linearize.distance",
    "hvdc_ident.linearize.linearisation",
    "hvdc_ident.linearize.loops",
    "hvdc_ident.linearize.operating_point",
    "hvdc_ident.models",
    "hvdc_ident.sensitivity.sweep_run",
)


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples(name: str) -> None:
    found = doctest.testmod(importlib.import_module(name), raise_on_error=False)
    assert found.attempted and not found.failed
