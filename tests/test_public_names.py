"""What `import hvdc_ident` offers: exactly the names of __all__, each with a docstring."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import hvdc_ident

PACKAGE = Path(hvdc_ident.__file__).parent


def test_all_names_resolve() -> None:
    for name in hvdc_ident.__all__:
        assert getattr(hvdc_ident, name) is not None
    assert sorted(hvdc_ident.__all__) == list(hvdc_ident.__all__) == dir(hvdc_ident)


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = hvdc_ident.no_such_thing  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", [n for n in hvdc_ident.__all__ if not n.startswith("_")])
def test_public_names_have_a_docstring(name: str) -> None:
    assert (getattr(hvdc_ident, name).__doc__ or "").strip()


@pytest.mark.parametrize("verb", ["fit", "linearize", "simulate"])
def test_a_verb_is_a_function_whatever_was_imported_first(verb: str) -> None:
    code = f"""
        import hvdc_ident.{verb}, inspect, types
        import hvdc_ident as hi
        from hvdc_ident.{verb} import {verb}
        assert type(hi) is types.ModuleType and inspect.isfunction(hi.{verb}) and inspect.isfunction({verb})
        assert "Return" in hi.{verb}.__doc__ and inspect.signature(hi.{verb})
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True)


def test_version_is_a_version() -> None:
    assert re.fullmatch(r"\d+\.\d+.*", hvdc_ident.__version__)


def test_the_package_and_the_command_line_import_nothing_heavy() -> None:
    heavy = {"numpy", "scipy", "sympy", "llvmlite", "matplotlib", "pydantic", "xarray", "control", "tomlkit"}
    assert not imported_with("hvdc_ident, hvdc_ident.cli") & heavy


def test_a_check_imports_no_diagnosis_no_identifiability_and_no_statistics() -> None:
    loaded = imported_with("hvdc_ident.study.study, hvdc_ident.study.summary")
    assert not loaded & {"hvdc_ident.discrepancy", "hvdc_ident.identifiability", "scipy.stats", "scipy.signal"}


def imported_with(modules: str) -> set[str]:
    code = f"import sys, {modules}; print(*sys.modules)"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


@pytest.mark.parametrize("stub", sorted(p.relative_to(PACKAGE) for p in PACKAGE.rglob("__init__.pyi")), ids=str)
def test_what_a_package_offers_lazily_is_there(stub: Path) -> None:
    """The stub is what is offered: mypy reads it, and so does the import."""
    package = importlib.import_module(".".join(["hvdc_ident", *stub.parts[:-1]]))
    assert package.__all__
    for name in package.__all__:
        assert getattr(package, name) is not None
