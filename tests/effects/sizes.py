"""A size of every effect of the catalogue that shows in the link's P loop, for the tests that walk the catalogue."""

from __future__ import annotations

from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.frozen import FrozenMap

SIZES: dict[str, dict[str, float]] = {
    "backlash": {"width": 0.02},
    "conductance": {"g": 0.02},
    "coupling": {"k": 0.2},
    "deadband": {"width": 0.02},
    "delay": {"T": 0.002},
    "disturbance": {"amplitude": 0.01, "frequency": 30.0, "phase": 0.3},
    "droop": {"k": 0.2, "deadband": 1e-4},
    "gain": {"k": 0.9},
    "inductance": {"L": 0.002, "R": 0.7},
    "lag": {"T": 0.002},
    "lead-lag": {"T1": 0.003, "T2": 0.001},
    "limit": {"level": 0.45},
    "loss": {"a": 0.002, "b": 0.03, "c": 0.02},
    "offset": {"c": 0.01},
    "quantisation": {"step": 0.03},
    "rate-limit": {"rate": 1.0},
    "sample-hold": {"Ts": 1.3e-3, "compute": 3e-4},
    "saturation": {"level": 0.8},
    "second-order": {"wn": 400.0, "zeta": 0.5},
    "term": {"k": 0.1},
    "window-mean": {"T": 0.01},
}
SOURCE = "Vdc2"
TERM = "k*Vdc2**2"
NAMES = tuple(effects())


def use(name: str, at: str | tuple[str, ...], values: dict[str, float] | None = None) -> EffectUse:
    """The effect with the values above, and those given instead of them."""
    effect = effects()[name]
    return EffectUse(
        name,
        (at,) if isinstance(at, str) else at,
        FrozenMap(SIZES[name] | (values or {})),
        source=SOURCE if effect.needs_source else "",
        expression=TERM if effect.needs_expression else "",
    )
