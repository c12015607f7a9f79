"""Units as people write them, against the SI's definitions."""

from __future__ import annotations

import math

import pytest

from hvdc_ident.data import conversion, is_unit, same_unit, seconds_of


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("p.u.", "pu"), ("p. u.", "1"), ("P.U.", ""), ("per unit", "-"), ("[kV]", "kV"), ("KV", "kV"), ("(MW)", "MW"),
        ("Mvar", "MVAr"), ("MVAR", "Mvar"), ("1/min", "rpm"), ("U/min", "r/min"), ("min-1", "rpm"), ("°", "deg"),
        ("°C", "degC"), ("\u2103", "degC"), ("\u2126", "ohm"), ("\u03a9", "Ohm"), ("\u00b5s", "\u03bcs"), ("us", "µs"),
        ("kOhm", "kΩ"), ("Nm", "N.m"), ("msec", "ms"), ("HZ", "Hz"), ("rad/sec", "rad/s"), ("p.u./s", "pu/s"),
    ],
)  # fmt: skip
def test_spellings_of_one_unit(a: str, b: str) -> None:
    assert same_unit(a, b) and conversion(a, b) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("a", "b"),
    [("mW", "MW"), ("kV", "V"), ("W", "var"), ("VA", "W"), ("Hz", "rad/s"), ("%", "pu"), ("deg", "rad"), ("S", "s")],
)
def test_units_that_differ(a: str, b: str) -> None:
    assert not same_unit(a, b)


@pytest.mark.parametrize(
    ("unit", "wanted", "value", "expected"),
    [
        ("kV", "V", 1.5, 1500.0), ("Mvar", "kvar", 2.0, 2000.0), ("%", "pu", 95.0, 0.95), ("rpm", "rad/s", 60.0, 2 * math.pi),
        ("deg", "rad", 180.0, math.pi), ("degC", "K", 20.0, 293.15), ("K", "°C", 293.15, 20.0), ("°F", "°C", 212.0, 100.0),
        ("kV/ms", "V/s", 1.0, 1e6), ("min", "s", 2.0, 120.0), ("bar", "kPa", 1.0, 100.0), ("%/s", "pu/s", 5.0, 0.05),
    ],
)  # fmt: skip
def test_conversions(unit: str, wanted: str, value: float, expected: float) -> None:
    found = conversion(unit, wanted)
    assert found is not None
    assert found[0] * value + found[1] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("a", "b"), [("kV", "pu"), ("W", "var"), ("Hz", "rad/s"), ("m", "s"), ("furlong", "m")])
def test_kinds_that_have_nothing_in_common(a: str, b: str) -> None:
    assert conversion(a, b) is None


def test_units_of_time() -> None:
    assert [seconds_of(u) for u in ("", "s", "ms", "µs", "min", "h", "S")] == [1.0, 1.0, 1e-3, 1e-6, 60.0, 3600.0, 1.0]
    assert seconds_of("kV") is None


def test_words_that_are_no_unit() -> None:
    assert not any(map(is_unit, ("", "1", "L1", "Q", "x", "bus 3", "P0", "M")))
