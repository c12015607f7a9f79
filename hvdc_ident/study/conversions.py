"""The mistakes of unit and sign that recordings come with: a recorded value is factor x model value + shift."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations
from math import log, pi, sqrt

from hvdc_ident.data import PREFIXED, PREFIXES, UNITS, conversion, same_unit
from hvdc_ident.parameters import Parameter

SIGN_SHARE, OTHER_SHARE, BOTH_SHARE = 0.5, 0.4, 0.1
"""Prior probabilities, given that a channel is wrong: its sign (the commonest mistake), one of the other known
conversions (all alike), or both."""
EXCHANGE_SHARE = 0.1
"""Prior probability, given that channels are wrong, that two columns are exchanged: as rare as two mistakes in one channel."""

GRID = (50.0, 60.0)  # Hz
LARGEST = 1e6
AMPLITUDES, POWERS = ("V", "A"), ("W", "var", "VA")
ELECTRICAL = (*AMPLITUDES, *POWERS)
OF_AMPLITUDES = {
    "sqrt(2): peak for rms": sqrt(2.0),
    "1/sqrt(2): rms for peak": 1.0 / sqrt(2.0),
    "sqrt(3): line to line for phase": sqrt(3.0),
    "1/sqrt(3): phase for line to line": 1.0 / sqrt(3.0),
}
OF_POWERS = {
    "3/2: power of dq peak values": 1.5,
    "2/3: power of dq peak values": 2.0 / 3.0,
    "3: all phases for one": 3.0,
    "1/3: one phase for all": 1.0 / 3.0,
}
OF_POLES = {"2: both poles for one": 2.0, "1/2: one pole for both": 0.5}
NAMES = {"%": "per cent", "deg": "degrees", "rad": "radians", "rpm": "1/min"}


@dataclass(frozen=True)
class Conversion:
    """One mistake. name: what the recording then holds, for a message. prior: its probability, given a mistake.

    gain: whether it is a factor like that of a wrong gain of the model, and no conversion of units.
    """

    name: str
    factor: float
    shift: float = 0.0
    prior: float = 0.0
    gain: bool = False

    def undone(self, recorded: float) -> float:
        """A recorded value in the model's unit."""
        return (recorded - self.shift) / self.factor


SIGN = Conversion("sign", -1.0, prior=SIGN_SHARE)


def conversions(unit: str, parameters: Mapping[str, Parameter]) -> tuple[Conversion, ...]:
    """The conversions that a signal of this unit may have suffered, the sign first, each with its prior probability.

    unit: the model's. parameters: the model's; those in V, A, W, var or VA are bases that a per-unit signal may have been
    multiplied by. A conversion and its opposite sign are two.
    """
    known = [*_of_unit(unit), *_of_bases(unit, parameters)]
    known = [(n, a, b) for n, a, b in known if not (abs(abs(a) - 1.0) < 1e-9 and b == 0.0)]
    distinct: dict[tuple[str, float], tuple[str, float, float]] = {}
    for line in known:
        distinct.setdefault((f"{line[1]:.6g}", line[2]), line)
    count = max(len(distinct), 1)
    plain = [Conversion(n, a, b, OTHER_SHARE / count) for n, a, b in distinct.values()]
    both = [
        Conversion(f"{c.name}, with the other sign", -c.factor, 0.0, BOTH_SHARE / count) for c in plain if not c.shift
    ]
    return (SIGN, *plain, *both)


def input_conversions(unit: str) -> tuple[Conversion, ...]:
    """The same for an input, whose level may well be another than the model's: only its sign and what changes it a lot."""
    large = [c for c in conversions(unit, {}) if c.factor > 0.0 and abs(log(abs(c.factor))) > log(30.0)]
    share = OTHER_SHARE / max(len(large) + 1, 1)
    return tuple(Conversion(c.name, c.factor, c.shift, share) for c in (SIGN, *large))


def _of_unit(unit: str) -> list[tuple[str, float, float]]:
    """(what is recorded, factor, shift): the other units of the kind, and what is confused with it beside them."""
    pu, found = same_unit(unit, "pu"), []
    for name in (*(u for u in UNITS if u != "‰"), *(prefix + base for base in PREFIXED for prefix in PREFIXES)):
        by = conversion(unit, name)
        if by is not None and 1.0 / LARGEST <= by[0] <= LARGEST:
            found.append((f"in {NAMES.get(name, name)}" if name != "pu" else "per unit", *by))
    if pu:
        found += [
            (f"a factor of {n}", a, 0.0) for n, a in (("100", 100.0), ("1/100", 0.01), ("1000", 1e3), ("1/1000", 1e-3))
        ]
        found += [("in degrees", 180.0 / pi, 0.0)]
        found += [
            line for f in GRID for line in ((f"in Hz of {f:g}", f, 0.0), (f"in rad/s of {f:g} Hz", 2 * pi * f, 0.0))
        ]
    if pu or any(conversion(unit, b) for b in AMPLITUDES):
        found += _factors({**OF_AMPLITUDES, **OF_POLES})
    if pu or any(conversion(unit, b) for b in POWERS):
        found += _factors({**OF_POWERS, **({} if pu else OF_POLES)})
    if same_unit(unit, "Hz"):
        found += [
            ("in rad/s", 2 * pi, 0.0),
            ("in 1/min", 60.0, 0.0),
            *((f"per unit of {f:g} Hz", 1 / f, 0.0) for f in GRID),
        ]
    if same_unit(unit, "rad/s"):
        found += [("in Hz", 0.5 / pi, 0.0), *((f"per unit of {f:g} Hz", 0.5 / pi / f, 0.0) for f in GRID)]
    return found


def _factors(sizes: Mapping[str, float]) -> list[tuple[str, float, float]]:
    return [(f"a factor of {name}", size, 0.0) for name, size in sizes.items()]


def _of_bases(unit: str, parameters: Mapping[str, Parameter]) -> list[tuple[str, float, float]]:
    """Bases among the parameters: their values for a per-unit signal, and the ratios of two of one kind; for a signal in
    V, A, W, var or VA those of its kind, that it may have been divided by."""
    bases = {n: p for n, p in parameters.items() if p.value > 0.0 and any(conversion(p.unit, b) for b in ELECTRICAL)}
    if not same_unit(unit, "pu"):
        of_kind = [(n, p, by[0] * p.value) for n, p in bases.items() if (by := conversion(p.unit, unit)) is not None]
        return [
            (f"{what} of {n} = {p.value:g} {p.unit}", size / base, 0.0)
            for n, p, base in of_kind
            for what, size in (("per unit", 1.0), ("in per cent", 100.0))
        ]
    found = [(f"in {p.unit} of the base {n} = {p.value:g}", p.value, 0.0) for n, p in bases.items()]
    for (a, one), (b, other) in permutations(bases.items(), 2):
        by = conversion(one.unit, other.unit)
        if by is not None:
            found.append((f"per unit of {b} and not of {a}", by[0] * one.value / other.value, 0.0))
    return found
