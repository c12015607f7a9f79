"""No card of the shelf passes on the word of its own equations alone."""

from __future__ import annotations

import ast
import json
import tomllib
from pathlib import Path

import pytest

from hvdc_ident.shelf import components

HERE = Path(__file__).parent


def simulated_by_andes() -> set[str]:
    """Return the cards in a case whose response another simulator gave."""
    cases = tomllib.loads((HERE / "cases.toml").read_text(encoding="utf-8"))
    known = json.loads((HERE / "andes.json").read_text(encoding="utf-8"))["cases"]
    return {part.lower() for name, case in cases.items() if name in known for part in case}


def integrated_otherwise() -> set[str]:
    """Return what the tests `test_CARD_...` of the files `*against*.py` are named after."""
    found = set()
    for file in HERE.glob("test_*against*.py"):
        names = [n.name for n in ast.parse(file.read_text(encoding="utf-8")).body if isinstance(n, ast.FunctionDef)]
        found |= {c for c in components() for n in names if n.startswith(f"test_{c.replace('-', '_')}_")}
    return found


@pytest.mark.parametrize("card", components())
def test_a_card_agrees_with_something_that_the_package_did_not_make(card: str) -> None:
    assert card in simulated_by_andes() | integrated_otherwise(), (
        f"no independent check of card {card}: a case in cases.toml with numbers of another simulator, or a test test_"
        f"{card.replace('-', '_')}_... in a file test_*against*.py, of the published equations integrated in another form"
    )
