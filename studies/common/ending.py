"""The end of a study: its numbers beside the expected ones, its tables in the README, its figure.

A study's run.py provides `main(...)`, its numbers; `tables(values)`, the README's tables by name; `draw(values)`, the
figure. Without --pin the folder does not change: the numbers are compared with expected.json.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hvdc_ident.files import json_text, write_text

DIGITS = 6


def arguments(text: str | None, *, quick: str = "", workers: bool = False) -> argparse.Namespace:
    """Return the parsed command line: --pin and, where they are useful, --quick and --workers."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pin", action="store_true", help="write expected.json, the README's tables and the figure")
    if quick:
        parser.add_argument("--quick", action="store_true", help=quick)
    if workers:
        parser.add_argument("--workers", type=int, default=1, help="processes (default 1)")
    return parser.parse_args()


def ended(
    here: Path,
    values: Mapping[str, Any],
    tables: Callable[[Mapping[str, Any]], dict[str, str]],
    draw: Callable[[Mapping[str, Any]], Any] | None,
    *,
    pin: bool = False,
    begun: float | None = None,
    whole: bool = True,
) -> int:
    """Print the tables, compare the numbers (or, with `pin`, write them) and return the exit code.

    whole: True if every number was computed; otherwise lists may be shorter than expected and nothing is pinned.
    """
    values = rounded(values)
    for name, text in tables(values).items() if whole else ():
        print(f"{name}\n{text}\n")
    if begun is not None:
        load = os.getloadavg()[0]
        print(f"{time.perf_counter() - begun:.1f} s, load of the machine {load:.1f} on {os.cpu_count()} cores")
    path = here / "expected.json"
    old = json.loads(path.read_text(encoding="utf-8"))
    if pin and whole:
        write_text(path, json_text({**old, "values": values}))
        write_tables(here / "README.md", tables(values))
        if draw is not None:
            save(draw(values), here / "figure.svg")
        print(f"pinned in {here.name}")
        return 0
    off = differences(old["values"], values, old["tolerance"], whole=whole)
    if draw is not None and whole:
        save(draw(values), here / "study-results" / "figure.svg")
    print("\n".join(off) if off else f"as expected.json, within {old['tolerance']}")
    return int(bool(off))


def rounded(value: Any, digits: int = DIGITS) -> Any:
    """Return the value as plain lists, dicts and numbers, each rounded to that many significant digits."""
    if isinstance(value, Mapping):
        return {str(k): rounded(v, digits) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v, digits) for v in value]
    if hasattr(value, "tolist"):
        return rounded(value.tolist(), digits)
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def differences(
    expected: Any, found: Any, tolerance: Mapping[str, float], where: str = "", *, whole: bool = True
) -> list[str]:
    """Return, as text, each number that differs by more than tolerance["relative"] and tolerance["absolute"] together."""
    if isinstance(expected, Mapping):
        if not isinstance(found, Mapping):
            return [f"{where}: expected a table, got {found!r}"]
        lines = [f"{where}: new '{k}'" for k in found if k not in expected]
        for key in expected if whole else [k for k in expected if k in found]:
            lines += differences(expected[key], found.get(key), tolerance, f"{where}.{key}", whole=whole)
        return lines
    if isinstance(expected, list):
        if not isinstance(found, list) or (len(found) != len(expected) if whole else len(found) > len(expected)):
            return [f"{where}: expected {len(expected)} values, got {found!r}"]
        return [
            line
            for i, (e, f) in enumerate(zip(expected, found, strict=False))
            for line in differences(e, f, tolerance, f"{where}[{i}]", whole=whole)
        ]
    if isinstance(expected, float | int) and not isinstance(expected, bool) and isinstance(found, float | int):
        room = tolerance["relative"] * abs(expected) + tolerance["absolute"]
        return [] if abs(found - expected) <= room else [f"{where}: expected {expected:g}, got {found:g}"]
    return [] if expected == found else [f"{where}: expected {expected!r}, got {found!r}"]


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *rows])


def write_tables(readme: Path, tables: Mapping[str, str]) -> None:
    """Write each table into the README between its marks. Raises ValueError where the marks are missing."""
    text = readme.read_text(encoding="utf-8")
    for name, table in tables.items():
        head, rest = text.split(f"<!-- {name} -->\n", 1)
        _, tail = rest.split("<!-- end -->", 1)
        text = f"{head}<!-- {name} -->\n{table}\n<!-- end -->{tail}"
    write_text(readme, text)


def save(figure: Any, path: Path) -> None:
    """Write the figure as an SVG file, with the same bytes each time."""
    import matplotlib

    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context({"svg.hashsalt": path.parent.name, "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None})


def number(value: float | None, digits: int = 4) -> str:
    """Return the number with that many significant digits, without an exponent from 1e-5 to 1e5; a dash for None."""
    if value is None:
        return "-"
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if not -5 <= size < 5:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - size)}f}"


def interval(ends: Sequence[float] | None, digits: int = 4) -> str:
    """Return both ends of an interval as text; a dash for None."""
    return "-" if ends is None else f"{number(ends[0], digits)} to {number(ends[1], digits)}"
