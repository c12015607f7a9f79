"""Imports run down the list of rooms and never up."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "hvdc_ident"

ROOMS = """
next_step errors aliases text immutable codec toml_tables executor budget files parallel psse colours display data
parameters axes expression shelf model plants effects
models formats simulate
fmu linearize sensitivity linear fit identifiability discrepancy summary report study api app command run_commands cli
""".split()  # noqa: SIM905 - one list of words, read as such

# Rooms with rooms inside, and the order of those.
INSIDE = {
    "discrepancy": """
options result candidates movable nominal prediction hypothesis screen location residual_checks misfit score pushes expansion
stated search moves remainder sentences rivals description conclusion unknown_noise diagnosis
""",
    "linearize": """
limits system delays sampling characteristic stability descriptor equilibrium plot derivatives point branches linear_model zeros
delayed_zeros frequency realisation gramians norms kinds fmu_linear jacobian operating_point linearisation mode delayed_modes
modal root_loci gain_limits loops reduction
distance transfer_function formula impedance response_file export
""",
    "fmu": """
archive description request piecewise_linear differences last_runs fmi instance runner derivatives model_exchange co_simulation
worker_run worker
worker_pool gradients evaluate terminal_effects capabilities model compile export
""",
}

ALLOWED = {
    # (from, to): why
    ("models", "fmu"): "load_model reads the model of any file; an FMU is looked up when one is named",
}


METHODS = {
    # file of a class: why its methods may import what stands above it in its room
    "linearize/linear_model.py": "a linear model's analysis is a function of another module, imported when its method is called",
}


def _imports(path: Path, *, of_methods: bool = True) -> Iterator[str]:
    """Every module of the package that a file imports, anywhere in it; what only type checkers see is left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if not of_methods:
        for kind in (n for n in tree.body if isinstance(n, ast.ClassDef)):
            kind.body = [n for n in kind.body if not isinstance(n, ast.FunctionDef)]
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            module = node.module or ""
            yield from [f"{module}.{alias.name}" for alias in node.names] if module == "hvdc_ident" else [module]
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def _room(path: Path) -> str:
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def test_every_room_has_a_place_in_the_list() -> None:
    rooms = {_room(p) for p in PACKAGE.rglob("*.py")} - {"__init__"}
    assert rooms <= set(ROOMS), f"not in the list: {sorted(rooms - set(ROOMS))}"


def test_imports_run_down() -> None:
    upward = []
    for path in sorted(PACKAGE.rglob("*.py")):
        room = _room(path)
        if room == "__init__":
            continue  # the package's face: it may name everything
        for module in _imports(path):
            parts = module.split(".")
            if parts[0] != "hvdc_ident" or len(parts) < 2:
                continue
            other = parts[1]
            if other not in ROOMS or ROOMS.index(other) <= ROOMS.index(room) or (room, other) in ALLOWED:
                continue
            upward.append(f"{path.relative_to(PACKAGE)} imports {module}")
    assert not upward, "\n".join(upward)


def test_only_what_is_needed_is_allowed() -> None:
    used = {(_room(p), m.split(".")[1]) for p in PACKAGE.rglob("*.py") for m in _imports(p) if m.count(".")}
    assert set(ALLOWED) <= used


@pytest.mark.parametrize("room", INSIDE)
def test_imports_run_down_within_a_room(room: str) -> None:
    order = INSIDE[room].split()
    files = sorted((PACKAGE / room).rglob("*.py"))
    inner = {path: path.relative_to(PACKAGE / room).parts[0].removesuffix(".py") for path in files}
    there = set(inner.values()) - {"__init__"}
    assert there == set(order), f"in the list or in the room alone: {sorted(there ^ set(order))}"
    upward = [
        f"{path.relative_to(PACKAGE)} imports {module}"
        for path in files
        for module in _imports(path, of_methods=path.relative_to(PACKAGE).as_posix() not in METHODS)
        if inner[path] != "__init__" and module.startswith(f"hvdc_ident.{room}.")
        if order.index(module.split(".")[2]) > order.index(inner[path])
    ]
    assert not upward, "\n".join(upward)
