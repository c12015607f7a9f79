"""Figures of linear models, one kind per file; each is a function of a result and computes nothing of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hvdc_ident.errors import unknown_name

if TYPE_CHECKING:
    from hvdc_ident.linearize.linear_model import LinearModel

KINDS = ("bode", "nyquist", "poles", "participation")


def draw(model: LinearModel, kind: str, ax: Any = None) -> Any:
    """The axes of a drawing of a linear model: "bode", "nyquist", "poles" or "participation". Raises UnknownNameError."""
    if kind == "bode":
        from hvdc_ident.linearize.plots.bode import bode

        return bode([model.bode()], ax=ax)
    if kind == "nyquist":
        from hvdc_ident.linearize.plots.nyquist import nyquist

        return nyquist([model.bode()], ax=ax)
    if kind == "poles":
        from hvdc_ident.linearize.plots.poles import poles

        return poles(model, ax)
    if kind == "participation":
        from hvdc_ident.linearize.plots.participation import participation

        return participation(model.modes(), ax)
    raise unknown_name("figure", kind, KINDS)
