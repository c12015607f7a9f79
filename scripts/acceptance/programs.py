"""Programs of the repository with numbers of their own: the studies of missing effects, and the benchmark of the engine."""

from __future__ import annotations

import importlib.util
from functools import partial

from runs import ROOT, Item, Setting, python, settled


def _study(name: str, setting: Setting) -> str:
    """Return what an executed study prints; it compares its numbers with its expected.json itself."""
    script = ROOT / "studies" / name / "run.py"
    said = python(script, "--workers", str(setting.workers), cwd=setting.folder, check=False)
    kept = [line for line in said.splitlines() if "load of the machine" not in line]
    return settled("\n".join([*kept, ""]), [setting.folder])


def _engine(setting: Setting) -> str:
    return python(ROOT / "benchmarks" / "engine.py", cwd=setting.folder)


def _needs_casadi() -> str:
    return "" if importlib.util.find_spec("casadi") else "it needs casadi: pip install '.[bench]'"


def _both(old: str, new: str) -> list[str]:
    return [f"before  {line}" for line in old.splitlines()] + [f"now     {line}" for line in new.splitlines()]


STUDIES = tuple(
    Item(name, partial(_study, name), full=True, suffix=".txt")
    for name in ("why_table_3_is_biased", "two_tools_one_link", "dymola_missing")
)
SPEED = (
    Item("engine", _engine, full=True, missing=_needs_casadi, compare=lambda a, b: [], beside=_both, suffix=".txt"),
)
