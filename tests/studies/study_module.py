"""A study's run.py as a module."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

STUDIES = Path(__file__).resolve().parents[2] / "studies"


def load(name: str, script: str = "run") -> ModuleType:
    """The module of studies/NAME/SCRIPT.py."""
    spec = importlib.util.spec_from_file_location(f"study_{name}_{script}", STUDIES / name / f"{script}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where a dataclass looks its annotations up
    spec.loader.exec_module(module)
    return module


def expected(name: str) -> Any:
    """What studies/NAME/expected.json holds."""
    return json.loads((STUDIES / name / "expected.json").read_text(encoding="utf-8"))
