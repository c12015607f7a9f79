"""Units as people write them: which are the same, and what turns a value in one into a value in another."""

from __future__ import annotations

import math
import re
import unicodedata
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PER_UNIT = ("", "1", "-", "pu", "p.u.", "p.u", "pu.", "perunit", "per-unit", "dimensionless")
PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "K": 1e3, "": 1.0, "m": 1e-3, "u": 1e-6, "μ": 1e-6, "n": 1e-9}
PREFIXED = ("V", "A", "W", "var", "VA", "Hz", "ohm", "H", "F", "s", "S", "Pa", "N", "N.m", "J", "Wh", "VAh", "m", "g",
            "Wb", "T", "bar", "rad")  # fmt: skip
SPELT = {
    "ohms": "ohm", "Ω": "ohm", "Ohm": "ohm", "Ohms": "ohm", "OHM": "ohm",
    "VAr": "var", "VAR": "var", "Var": "var", "vars": "var", "va": "VA", "volt": "V", "volts": "V", "Volt": "V",
    "Volts": "V", "v": "V", "amp": "A", "amps": "A", "Amps": "A", "ampere": "A", "Ampere": "A", "watt": "W", "watts": "W",
    "HZ": "Hz", "hz": "Hz", "hertz": "Hz", "Hertz": "Hz", "Nm": "N.m", "N*m": "N.m", "N·m": "N.m", "N⋅m": "N.m",
    "sec": "s", "secs": "s", "SEC": "s", "Sec": "s", "second": "s", "seconds": "s", "Seconds": "s", "Sekunden": "s",
    "secondes": "s", "minute": "min", "minutes": "min", "Minuten": "min", "hour": "h", "hours": "h", "hr": "h",
    "Stunden": "h", "day": "d", "days": "d", "msec": "ms", "millisecond": "ms", "milliseconds": "ms", "usec": "us",
    "microsecond": "us", "microseconds": "us", "nanosecond": "ns", "nanoseconds": "ns",
    "°": "deg", "degree": "deg", "degrees": "deg", "Degrees": "deg", "Deg": "deg", "DEG": "deg", "Grad": "deg",
    "grad": "deg", "el.deg": "deg", "°el": "deg", "radian": "rad", "radians": "rad", "Rad": "rad",
    "percent": "%", "Prozent": "%", "pct": "%", "°C": "degC", "Celsius": "degC", "celsius": "degC", "°F": "degF",
    "Kelvin": "K", "kelvin": "K",
    "1/min": "rpm", "U/min": "rpm", "tr/min": "rpm", "r/min": "rpm", "rev/min": "rpm", "min-1": "rpm", "min^-1": "rpm",
    "RPM": "rpm", "Upm": "rpm", "s-1": "1/s", "s^-1": "1/s", "rad.s-1": "rad/s", "rads/s": "rad/s", "rad/sec": "rad/s",
}  # fmt: skip
"""Other spellings of a unit, without a prefix."""


class Unit(NamedTuple):
    """A unit as a number of its kind's first unit: value = size x number + origin."""

    kind: str
    size: float
    origin: float = 0.0


UNITS = {
    "pu": Unit("pu", 1.0), "%": Unit("pu", 0.01), "‰": Unit("pu", 0.001),
    "rad": Unit("rad", 1.0), "deg": Unit("rad", math.pi / 180.0),
    "rad/s": Unit("rad/s", 1.0), "rpm": Unit("rad/s", math.pi / 30.0),
    "s": Unit("s", 1.0), "min": Unit("s", 60.0), "h": Unit("s", 3600.0), "d": Unit("s", 86400.0),
    "K": Unit("K", 1.0), "degC": Unit("K", 1.0, 273.15), "degF": Unit("K", 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0),
    "bar": Unit("Pa", 1e5), "Wh": Unit("J", 3600.0), "1/s": Unit("1/s", 1.0),
}  # fmt: skip
"""The units that are no prefix and no first unit of their kind."""


def same_unit(a: str, b: str) -> bool:
    """Return whether two units mean the same."""
    one, other = unit_of(a), unit_of(b)
    if one is None or other is None:
        return _plain(a) == _plain(b)
    return one.kind == other.kind and math.isclose(one.size, other.size, rel_tol=1e-12) and one.origin == other.origin


def conversion(unit: str, wanted: str) -> tuple[float, float] | None:
    """Scale and offset: value in `wanted` = scale x value in `unit` + offset; None where they are of different kinds."""
    if same_unit(unit, wanted):
        return 1.0, 0.0
    one, other = unit_of(unit), unit_of(wanted)
    if one is None or other is None or one.kind != other.kind:
        return None
    return one.size / other.size, (one.origin - other.origin) / other.size


def seconds_of(unit: str) -> float | None:
    """Return the length of a unit of time in s, "" counting as s; None where it is none. S, which is siemens, means seconds here."""
    if not _plain(unit) or _plain(unit) in ("-", "S"):
        return 1.0
    known = unit_of(unit)
    return known.size if known is not None and known.kind == "s" else None


def scaled(values: Array, scale: float) -> Array:
    """Return the values times the scale; by division where the scale is one over a whole number, so that 1400 ms are 1.4 s."""
    if scale == 1.0:
        return values
    whole = 1.0 / scale
    return values / whole if abs(whole) > 1.0 and whole.is_integer() else values * scale


def is_unit(text: str) -> bool:
    """Return whether a text is a unit that is known, and not merely a word or a letter that could be a name's end."""
    return bool(text.strip()) and text.strip() not in ("1", "-") and unit_of(text) is not None


@lru_cache(maxsize=4096)
def unit_of(text: str) -> Unit | None:
    """Return the unit of a text; None where it is not known."""
    plain = _plain(text)
    if plain.lower() in PER_UNIT:
        return UNITS["pu"]
    single = _single(plain)
    if single is not None:
        return single
    if plain.count("/") == 1:
        above, below = (_single(part) if part.lower() not in PER_UNIT else UNITS["pu"] for part in plain.split("/"))
        if above is not None and below is not None:
            return Unit(f"{above.kind}/{below.kind}", above.size / below.size)
    return None


def _single(text: str) -> Unit | None:
    """Return a unit without a stroke but in `rad/s` and its like: its own name, another spelling, or a prefix before either."""
    name = SPELT.get(text, text)
    if name in UNITS:
        return UNITS[name]
    if name in PREFIXED:
        return Unit(name, 1.0)
    for prefix, size in PREFIXES.items():
        if not prefix or not name.startswith(prefix):
            continue
        rest = SPELT.get(name[len(prefix) :], name[len(prefix) :])
        if rest in PREFIXED:
            of = UNITS.get(rest, Unit(rest, 1.0))
            return Unit(of.kind, size * of.size)
    return None


def _plain(text: str) -> str:
    """Return the text without the brackets people put around a unit, blanks, and letters of one look and two codes."""
    unit = unicodedata.normalize("NFKC", text).strip()
    if len(unit) > 1 and (unit[0], unit[-1]) in (("[", "]"), ("(", ")"), ("<", ">")):
        unit = unit[1:-1]
    if unit.lower().startswith("in "):
        unit = unit[3:]
    return re.sub(r"\s+", "", unit)
