"""The signal flow of a model as an SVG drawing: inputs on the left, outputs on the right, states with an integral sign."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from hvdc_ident.model import Model

WIDE, HIGH = 84, 22
GAP_X, GAP_Y = 40, 12
PASSES = 4
"""Times that the boxes of a column are put into the order of those they are connected with."""


def diagram(model: Model) -> str:
    """Return the SVG element of a model's signal flow; arrows that lead back are dashed."""
    uses = _uses(model)
    forward = _without_loops(uses, model.states)
    columns = _columns(forward)
    at = {
        n: (x * (WIDE + GAP_X) + 2, y * (HIGH + GAP_Y) + 2 + _shift(columns, names))
        for x, names in enumerate(columns)
        for y, n in enumerate(names)
    }
    wide = len(columns) * (WIDE + GAP_X) - GAP_X + 4
    high = max(map(len, columns)) * (HIGH + GAP_Y) + 10
    parts = [
        f'<svg class="drawing flow" viewBox="0 0 {wide} {high}" role="img" '
        f'aria-label="signal flow of {escape(model.name)}: {escape(", ".join(model.inputs))} to {escape(", ".join(model.outputs))}">'
    ]
    for n, sources in uses.items():
        for s in sources:
            parts.append(_arrow(at[s], at[n], back=s not in forward[n]))
    for n, (x, y) in at.items():
        kind = "input" if n in model.inputs else "output" if n in model.outputs else "signal"
        kind += " state" if n in model.states else ""
        sign = "∫ " if n in model.states else ""
        parts.append(f'<rect class="box {kind}" x="{x}" y="{y}" width="{WIDE}" height="{HIGH}" rx="3"/>')
        parts.append(f'<text x="{x + WIDE / 2:.0f}" y="{y + 15}" text-anchor="middle">{sign}{escape(n)}</text>')
    return "".join([*parts, "</svg>"])


def _uses(model: Model) -> dict[str, list[str]]:
    """Return by variable the variables that its expression uses; what is made of parameters alone is left out."""
    expressions = {n: s.derivative for n, s in model.states.items()}
    expressions |= {n: s.value for n, s in model.signals.items()} | {n: a.equation for n, a in model.algebraic.items()}
    expressions |= {n: o.value for n, o in model.outputs.items() if n not in model.names}
    found: dict[str, list[str]] = {n: [] for n in model.inputs}
    for n, e in expressions.items():
        found[n] = sorted(s.name for s in e.free_symbols if s.name in expressions or s.name in model.inputs)
    while idle := [n for n, used in found.items() if not used and n not in model.inputs and n not in model.states]:
        found = {n: [s for s in used if s not in idle] for n, used in found.items() if n not in idle}
    return {n: [s for s in used if s != n] for n, used in found.items()}


def _without_loops(uses: Mapping[str, Sequence[str]], states: Iterable[str]) -> dict[str, set[str]]:
    """Return the uses without those that lead back; a state stands behind the first that moves it, and what else moves it leads back."""
    level = {n: 0 for n, used in uses.items() if not used}
    while reached := {n for n, used in uses.items() if n not in level and set(used) & set(level)}:
        level |= {n: 1 + min(level[s] for s in uses[n] if s in level) for n in reached}
    level = {n: level.get(n, 0) for n in uses}
    kept = {n: set(used) for n, used in uses.items()}
    for n in states:
        kept[n] = {s for s in kept[n] if level[s] < level[n]}
    return _acyclic(kept)


def _acyclic(kept: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the uses in an order in which each is placed after what it uses; what closes a circle is taken out."""
    left, placed = {n: set(used) for n, used in kept.items()}, set[str]()
    result: dict[str, set[str]] = {n: set() for n in kept}
    while left:
        free = [n for n, used in left.items() if used <= placed]
        chosen = free or [min(left, key=lambda n: len(left[n] - placed))]
        for n in chosen:
            result[n] = left.pop(n) & placed
        placed |= set(chosen)
    return result


def _columns(forward: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the names by column, each behind what it uses, and those of a column near what they are connected with."""
    rank: dict[str, int] = {}
    while len(rank) < len(forward):
        for n, used in forward.items():
            if n not in rank and used <= set(rank):
                rank[n] = 1 + max((rank[s] for s in used), default=-1)
    columns: list[list[str]] = [[] for _ in range(max(rank.values()) + 1)]
    for n in forward:
        columns[rank[n]].append(n)
    for _ in range(PASSES):
        place = {n: k / len(names) for names in columns for k, n in enumerate(names)}
        for names in columns[1:]:
            names.sort(key=lambda n: sum(place[s] for s in forward[n]) / max(len(forward[n]), 1))
    return columns


def _shift(columns: Sequence[Sequence[str]], names: Sequence[str]) -> int:
    """Return by how much a column is moved down so that it stands in the middle."""
    return (max(map(len, columns)) - len(names)) * (HIGH + GAP_Y) // 2


def _arrow(source: tuple[float, float], target: tuple[float, float], *, back: bool) -> str:
    (x1, y1), (x2, y2) = (source[0] + WIDE, source[1] + HIGH / 2), (target[0], target[1] + HIGH / 2)
    bend = GAP_X * 0.6 if x2 > x1 else GAP_X
    style = "edge back" if back else "edge"
    return f'<path class="{style}" d="M{x1:.0f} {y1:.0f} C{x1 + bend:.0f} {y1:.0f} {x2 - bend:.0f} {y2:.0f} {x2:.0f} {y2:.0f}"/>'
