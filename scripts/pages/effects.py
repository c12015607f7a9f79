"""The catalogue of effects as Markdown, with a picture of each: the package's own simulation of a step and a ramp through it."""

from __future__ import annotations

from typing import Any

import numpy as np

import hvdc_ident as hi
from hvdc_ident.effects import Effect, effects
from pages.svg import Curve, drawing

ROWS = 801
LARGE: dict[str, dict[str, float]] = {
    "backlash": {"width": 0.2},
    "conductance": {"g": 0.2},
    "curve": {"low": -0.5, "high": 0.5, "v3": 0.2, "v5": -0.1, "v8": 0.15},
    "deadband": {"width": 0.15},
    "deadband-step": {"width": 0.15},
    "droop": {"k": 0.3, "deadband": 0.1},
    "drift": {"c": 0.05, "g": -0.3},
    "dry-friction": {"F": 0.1, "v": 0.02},
    "gain": {"k": 0.8},
    "limit": {"level": 0.35},
    "lookup": {"low": -0.5, "high": 0.5, "s4": 0.2, "s5": 0.2, "s7": 2.0},
    "loss": {"a": 0.05, "b": 0.2, "c": 0.2},
    "non-windup-limit": {"low": -0.35, "high": 0.35},
    "offset": {"c": 0.1},
    "polynomial": {"b": 0.3, "c": -0.8},
    "product": {"g": -0.1, "k": 0.8},
    "quantisation": {"step": 0.15},
    "servo": {"T": 0.3, "up": 0.6, "down": 0.4},
    "term": {"k": 0.6},
}
"""Sizes of the pictures where those of the effect's example are too small to be seen in a drawing."""
LEVEL, OTHER = 0.5, 0.3
LAG = 0.04
"""Time constant of the lag whose state an effect on a state's equation is shown at, of the picture's duration."""


def page() -> str:
    """Return the page of all effects."""
    lines = [
        "# Effects",
        "",
        "An effect replaces the signal u of an insertion point by y, which all readers of the signal then see. Insertion points are",
        "inputs, named signals, algebraic unknowns, states and outputs; at an output only the recording changes. At its neutral value",
        "an effect is left out of the model. Effects on a derivative x' sit at a state and change its equation, whoever reads it;",
        "their pictures show the state of a lag. The pictures are simulated by this package with the values of the caption.",
        "",
        "| effect | y, or x' |",
        "|---|---|",
        *(f"| [`{name}`](#{name}) | {_cell(e.summary)} |" for name, e in effects().items()),
        "",
    ]
    for effect in effects().values():
        lines += [*_entry(effect), ""]
    return "\n".join(lines)


def _entry(e: Effect) -> list[str]:
    lines = [f"## `{e.name}` {{: #{e.name} }}", "", f"**{_changed(e)}**: {e.summary}", "", picture(e), ""]
    lines += [f"*How to excite it*: {e.excited_by}.", ""]
    if e.parameters:
        lines += ["| parameter | default | neutral | bounds | unit | meaning |", "|---|---|---|---|---|---|"]
        for name, p in e.parameters.items():
            neutral = "–" if p.neutral is None else f"{p.neutral}" if isinstance(p.neutral, str) else f"{p.neutral:g}"
            bounds = f"{p.min:g} to {p.max:g}"
            lines.append(
                f"| `{name}` | {p.value:g} | {neutral} | {bounds} | {p.unit or '–'} | {_cell(p.description)} |"
            )
        lines.append("")
    if e.needs_source:
        lines += ["It brings in another signal, named by `from`.", ""]
    if e.needs_expression:
        lines += [
            "Its `expression` is in signals of the model and coefficients of your own names, each neutral at 0.",
            "",
        ]
    if e.states != "none":
        lines += [f"States that it adds: {e.states}.", ""]
    if e.confusable:
        lines += [
            "May look like:",
            "",
            *(f"- `{other}`; what tells them apart: {how}" for other, how in e.confusable.items()),
            "",
        ]
    use = [f'effect = "{e.name}"', 'at = "STATE"' if e.of_derivative else 'at = "SIGNAL"']
    use += ['from = "OTHER"'] if e.needs_source else []
    use += ['expression = "k*OTHER**2"'] if e.needs_expression else []
    values = ", ".join(f"{n} = {v:g}" for n, v in e.example.items())
    lines += ["```toml", "[[model.effect]]", *use, f"parameters = {{{values}}}", "```"]
    return lines


def picture(e: Effect) -> str:
    """Return the drawing of u and y over time for the effect's example values, with its caption."""
    end = _duration(e)
    time, u, y, other = simulated(e, end)
    unit, factor = ("ms", 1e3) if end < 0.5 else ("s", 1.0)
    curves = [Curve("u", "given", factor * time, u), Curve("y", "fitted", factor * time, y)]
    if other is not None:
        curves.insert(1, Curve("other signal", "other", factor * time, other))
    values = ", ".join(
        f"{n} = {v:g} {e.parameters[n].unit if n in e.parameters else ''}".rstrip() for n, v in _shown(e).items()
    )
    if e.of_derivative:
        values += f", at the state of a lag of {LAG * end:.3g} s"
    made = drawing(curves, f"time, {unit}", "signal", f"u and y over time for the effect {e.name} with {values}")
    return f"<figure>{made}<figcaption>{e.name} with {values}</figcaption></figure>"


def simulated(e: Effect, end: float) -> tuple[Any, Any, Any, Any]:
    """Return time, u, y and the other signal (None where there is none) of a step and a ramp back through the effect."""
    state = {"x": f"(u - x)/{LAG * end}"} if e.of_derivative else {"clock": {"derivative": "-clock", "start": 0.0}}
    plain = hi.Model(
        name="wire",
        inputs={"u": 0.0, "other": 0.0},
        states=state,
        signals={"z": "other"} if e.of_derivative else {"x": "u", "z": "other"},
        outputs={"y": "x"},
    )
    use: dict[str, Any] = {"effect": e.name, "at": "x", "parameters": _shown(e)}
    if e.needs_source:
        use["from"] = "z"
    if e.needs_expression:
        use["expression"] = "k*z**2"
    brings_in = e.needs_source or e.needs_expression
    corners = [(0.1, 0.0), (0.1, LEVEL), (0.4, LEVEL), (0.8, -LEVEL)]
    moved = hi.InputSignal.corners([(end * t, v) for t, v in corners])
    still = 0.0 if e.self_exciting else moved
    time = np.linspace(0.0, end, ROWS)
    inputs = {"u": OTHER, "other": moved} if brings_in else {"u": still}
    run = hi.simulate(hi.apply_effects(plain, [use]), time, inputs=inputs)
    u = np.full(ROWS, OTHER) if brings_in else np.zeros(ROWS) if e.self_exciting else moved(time)
    return time, u, run["y"], moved(time) if brings_in else None


def _shown(e: Effect) -> dict[str, float]:
    return LARGE.get(e.name) or dict(e.example)


def _duration(e: Effect) -> float:
    """Return a duration in which the effect is seen, s, from the times in its example."""
    v = e.example
    if "L" in v:
        return 30 * v["L"] / v["R"]
    if "wn" in v:
        return 60 / v["wn"]
    if "frequency" in v:
        return 4 / v["frequency"]
    for rate in ("rate", "up"):
        if rate in v:
            return 6 * LEVEL / v[rate]
    times = [v[n] for n in ("T", "T1", "Ts") if n in v]
    return 25 * max(times) if times else 1.0


def _changed(e: Effect) -> str:
    return "x'" if e.of_derivative else "y"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
