"""Makes `tests` importable by its own name, wherever pytest is started and whichever copy of the package is tested."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

tests = ModuleType("tests")
tests.__path__ = [str(Path(__file__).parent)]
sys.modules["tests"] = tests
