"""Every effect of the catalogue with its own example, in the link's P loop, for the tests that walk the catalogue."""

from __future__ import annotations

from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.immutable import FrozenMap

SIZES = {name: dict(effect.example) for name, effect in effects().items()}
SOURCE = "Vdc2"
TERM = "k*Vdc2**2"
NAMES = tuple(effects())
STATES = {"Q2_m": "xq2"}
"""State in whose loop a place lies; the others are in that of xp."""


def place(name: str, at: str) -> str:
    """The place, or a state in its loop for an effect that sits at states alone."""
    return at if effects()[name].insertion_kinds != ("state",) else STATES.get(at, "xp")


def use(name: str, at: str | tuple[str, ...], values: dict[str, float] | None = None) -> EffectUse:
    """The effect with the values of its example, and those given instead of them."""
    effect = effects()[name]
    return EffectUse(
        name,
        tuple(place(name, p) for p in ((at,) if isinstance(at, str) else at)),
        FrozenMap(SIZES[name] | (values or {})),
        source=SOURCE if effect.needs_source else "",
        expression=TERM if effect.needs_expression else "",
    )
