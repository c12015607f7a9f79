"""Differences of two documents, one line for each kind.

A number is the same within 0.1 %, or, where it stands beside its own 95 % interval, within a twentieth of the interval's width:
another way to the same optimum ends there. The ends of an interval are the same within a tenth of its width.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

RELATIVE = 1e-3
IN_VALUE, IN_ENDS = 0.05, 0.1
"""Of an interval's width."""
WORST = 3
"""Differences of one kind that are shown."""


def lines(old: Any, new: Any) -> list[str]:
    """Return the differences; none if the documents say the same."""
    if isinstance(old, str) and isinstance(new, str):
        told = difflib.unified_diff(old.splitlines(), new.splitlines(), "frozen", "now", lineterm="", n=1)
        return [line for line in told if not line.startswith(("---", "+++"))]
    kinds: dict[str, list[str]] = {}
    for path, text in _differences(old, new, "", RELATIVE):
        kinds.setdefault(re.sub(r"\[\d+\]", "[*]", path), []).append(f"{path}: {text}")
    found: list[str] = []
    for group in kinds.values():
        found += group[:WORST]
        if len(group) > WORST:
            found.append(f"    and {len(group) - WORST} more of this kind")
    return found


def _differences(old: Any, new: Any, path: str, room: float, width: float = 0.0) -> Iterator[tuple[str, str]]:
    """Yield path and text of each difference. width: an absolute tolerance of numbers."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        own = _width(old)
        for key in dict.fromkeys([*old, *new]):
            where = f"{path}.{key}".lstrip(".")
            if key not in new:
                yield where, f"gone (was {_short(old[key])})"
            elif key not in old:
                yield where, f"new ({_short(new[key])})"
            else:
                share = {"value": IN_VALUE, "ci95": IN_ENDS, "std": IN_ENDS}.get(key, 0.0)
                yield from _differences(old[key], new[key], where, room, share * own if share else width)
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield path, f"{len(old)} entries before, {len(new)} now"
        for k, (a, b) in enumerate(zip(old, new, strict=False)):
            yield from _differences(a, b, f"{path}[{k}]", room, width)
    elif _number(old) and _number(new):
        if abs(old - new) > room * max(abs(old), abs(new)) + max(width, 1e-12):
            yield path, f"{old:.6g} before, {new:.6g} now"
    elif old != new:
        yield path, f"{_short(old)} before, {_short(new)} now"


def _width(table: Mapping[str, Any]) -> float:
    """Return the width of the table's own 95 % interval; 0 without a closed one."""
    ends = table.get("ci95")
    if isinstance(ends, list) and len(ends) == 2 and all(map(_number, ends)):
        return abs(ends[1] - ends[0])
    return 0.0


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 160 else f"{text[:157]}..."
