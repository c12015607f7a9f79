"""Colours and axes that the figures share; the colours are Okabe and Ito's, which colour-blind readers tell apart."""

from __future__ import annotations

from typing import Any

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINES = ("-", "--", "-.", ":")
MARK = "#777777"


def look(k: int) -> dict[str, Any]:
    """Colour and line of the k-th curve: they differ in both, so that a print in grey reads too."""
    return {"color": COLOURS[k % len(COLOURS)], "linestyle": LINES[(k // len(COLOURS) + k) % len(LINES)]}


def grid(axes: Any) -> None:
    """Nothing; light grid lines are put behind the curves."""
    axes.grid(True, which="both", color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)


def axes_through_zero(axes: Any) -> None:
    """Nothing; marks the real and the imaginary axis."""
    axes.axhline(0.0, color=MARK, linewidth=0.6)
    axes.axvline(0.0, color=MARK, linewidth=0.6)
