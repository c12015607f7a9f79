"""Colours of curves, each with one meaning on every figure, page and screen: recorded, given, fitted, with the effect.

On either ground each has a contrast of 3 and more, and any two are told apart by eyes that confuse red and green.
"""

from __future__ import annotations

LIGHT = {"measured": "#222222", "given": "#d08020", "fitted": "#1f5fa8", "effect": "#1d7f4e", "mark": "#8d8d8d"}
DARK = {"measured": "#f2f2f2", "given": "#f0a64a", "fitted": "#6fb0f5", "effect": "#5bd196", "mark": "#858c94"}
"""By the name that style sheets use: the colour on white, and on a dark page."""
RECORDED, GIVEN, FITTED, EFFECT, MARK = LIGHT.values()

SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours of curves that have none of these meanings, such as several outputs in one figure (Okabe and Ito)."""
ROLES = {"fit": "#5f7386", "holdout": "#9fb0c0"}
"""Colours of what is said of fitted and of held-out recordings."""


def style(names: dict[str, str]) -> str:
    """Return the colours as declarations of a style sheet: "--given: #d08020; ..."."""
    return " ".join(f"--{name}: {colour};" for name, colour in names.items())


def variable(name: str) -> str:
    """Return a colour as a style sheet names it."""
    return f"var(--{name})"
