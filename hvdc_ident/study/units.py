"""Whether two units are the same, and what lies between them where they differ by a prefix."""

from __future__ import annotations

PER_UNIT = {"", "1", "-", "pu", "p.u.", "p.u", "per unit"}
SPELT = {"ohms": "ohm", "Ω": "ohm", "Ohm": "ohm", "°": "deg", "degree": "deg", "sec": "s", "percent": "%"}
PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "n": 1e-9}
PREFIXED = {"V", "A", "W", "var", "VA", "VAr", "Hz", "ohm", "H", "F", "s"}


def same_unit(a: str, b: str) -> bool:
    """Whether two units mean the same."""
    return _normal(a) == _normal(b)


def factor(unit: str, wanted: str) -> float | None:
    """What a value in `unit` is multiplied by to be in `wanted`; None where they are of different kinds."""
    if same_unit(unit, wanted):
        return 1.0
    (size, base), (wanted_size, wanted_base) = _split(_normal(unit)), _split(_normal(wanted))
    return size / wanted_size if base == wanted_base else None


def _normal(unit: str) -> str:
    text = unit.strip()
    if text.lower() in PER_UNIT:
        return "pu"
    return SPELT.get(text, text)


def _split(unit: str) -> tuple[float, str]:
    for prefix, size in PREFIXES.items():
        if prefix and unit.startswith(prefix) and unit[len(prefix) :] in PREFIXED:
            return size, unit[len(prefix) :]
    return 1.0, unit
