"""What a recorded signal may have been multiplied by or shifted: a table of ratios, and the one that levels and movements suggest."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from math import pi, sqrt

from hvdc_ident.data import PREFIXED, PREFIXES, UNITS, conversion, same_unit
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.parameters import Parameter

LARGEST_FACTOR = 1e6
"""Largest factor between two units of one quantity that are confused."""
FINEST = 1e-3
"""No model's level or movement is expected nearer to the plant's than this share, so a nearer match proves no more."""
STRONG = 10.0
"""What a match has to come nearer by itself: odds from which evidence is strong (Jeffreys 1961)."""
POSITIVE = 3.0
"""Odds from which evidence is positive (Kass, Raftery 1995): enough for a question, which is all that is asked."""

POWERS = ("W", "var", "VA")
ELECTRICAL = ("V", "A", *POWERS)
COUNTED = (
    ("sqrt(2)", sqrt(2.0), "peak for rms"), ("1/sqrt(2)", sqrt(0.5), "rms for peak"),
    ("sqrt(3)", sqrt(3.0), "line to line for phase"), ("1/sqrt(3)", sqrt(1.0 / 3.0), "phase for line to line"),
    ("sqrt(2/3)", sqrt(2.0 / 3.0), "peak of phase for rms of line to line"),
    ("sqrt(3/2)", sqrt(1.5), "rms of line to line for peak of phase"),
)  # fmt: skip
"""Ratios of two ways to count a voltage or current of three phases."""
RATIOS: tuple[tuple[tuple[str, ...], str, float, float], ...] = (
    *(
        (("pu",), f"a factor of {n}", a, 0.0)
        for n, a in (("100", 100.0), ("1/100", 0.01), ("1000", 1e3), ("1/1000", 1e-3))
    ),
    (("pu",), "in degrees", 180.0 / pi, 0.0),
    *((("pu", "V", "A"), f"a factor of {n}: {why}", a, 0.0) for n, a, why in COUNTED),
    *(
        (("pu",), f"a factor of {k} {n}: {why}, and {with_k}", by * a, 0.0)
        for n, a, why in COUNTED
        for k, by, with_k in (("1000", 1e3, "a k too few"), ("1/1000", 1e-3, "a k too many"))
    ),
    (("pu", *POWERS), "a factor of 3/2: power of dq peak values", 1.5, 0.0),
    (("pu", *POWERS), "a factor of 2/3: power of dq peak values", 2.0 / 3.0, 0.0),
    (("pu", *POWERS), "a factor of 3: all phases for one", 3.0, 0.0),
    (("pu", *POWERS), "a factor of 1/3: one phase for all", 1.0 / 3.0, 0.0),
    (("pu", *ELECTRICAL), "a factor of 2: both poles for one", 2.0, 0.0),
    (("pu", *ELECTRICAL), "a factor of 1/2: one pole for both", 0.5, 0.0),
    (("pu",), "the quantity itself and not its deviation from 1", 1.0, 1.0),
    (("pu",), "the deviation from 1 and not the quantity itself", 1.0, -1.0),
    *((("Hz",), f"in {u}", a, 0.0) for u, a in (("rad/s", 2.0 * pi), ("1/min", 60.0))),
    (("rad/s",), "in Hz", 0.5 / pi, 0.0),
    *((("pu",), f"in Hz of {f:g}", f, 0.0) for f in (50.0, 60.0)),
    *((("pu",), f"in rad/s of {f:g} Hz", 2.0 * pi * f, 0.0) for f in (50.0, 60.0)),
    *((("pu",), f"in Hz, and not as a deviation from {f:g}", f, f) for f in (50.0, 60.0)),
    *((("Hz",), f"per unit of {f:g} Hz", 1.0 / f, 0.0) for f in (50.0, 60.0)),
    *((("Hz",), f"the frequency and not its deviation from {f:g}", 1.0, f) for f in (50.0, 60.0)),
    *((("Hz",), f"the deviation from {f:g} and not the frequency", 1.0, -f) for f in (50.0, 60.0)),
    *((("rad/s",), f"per unit of {f:g} Hz", 0.5 / pi / f, 0.0) for f in (50.0, 60.0)),
)
"""By units that a signal of the model may have: what the recording then holds, and recorded = factor x model's + shift. Other units of
the same quantity, and the bases of the model, join them."""
NAMES = {"%": "per cent", "deg": "degrees", "rad": "radians", "rpm": "1/min"}


@dataclass(frozen=True)
class Conversion:
    """recorded = factor x model's + shift. name: what the recording then holds, for a message.

    gain: whether it is a factor like that of a wrong gain of the model, and no conversion of units.
    """

    name: str
    factor: float
    shift: float = 0.0
    gain: bool = False

    def undone(self, recorded: float) -> float:
        """A recorded value in the model's unit."""
        return (recorded - self.shift) / self.factor


UNCHANGED = Conversion("", 1.0)
SIGN = Conversion("sign", -1.0)


def conversions(unit: str, parameters: Mapping[str, Parameter] = FrozenMap()) -> tuple[Conversion, ...]:
    """Return what a signal of this unit may have suffered beside its sign: each conversion, and each with the other sign.

    unit: the model's. parameters: the model's; those in V, A, W, var or VA are bases that a per-unit signal may have been
    multiplied by.
    """
    distinct: dict[tuple[str, float], Conversion] = {}
    for name, factor, shift in (*_of_unit(unit), *_of_bases(unit, parameters)):
        if abs(abs(factor) - 1.0) > 1e-9 or shift:
            distinct.setdefault((f"{factor:.6g}", shift), Conversion(name, factor, shift))
    same_sign = tuple(distinct.values())
    return (*same_sign, *(Conversion(f"{c.name}, with the other sign", -c.factor) for c in same_sign if not c.shift))


def _of_unit(unit: str) -> Iterator[tuple[str, float, float]]:
    """Yield what is recorded, factor and shift for the other units of the kind, and for what is confused with it beside them."""
    for name in (*(u for u in UNITS if u != "‰"), *(prefix + base for base in PREFIXED for prefix in PREFIXES)):
        by = conversion(unit, name)
        if by is not None and 1.0 / LARGEST_FACTOR <= by[0] <= LARGEST_FACTOR:
            yield f"in {NAMES.get(name, name)}" if name != "pu" else "per unit", *by
    for units, name, factor, shift in RATIOS:
        if any(same_unit(unit, u) or (u in ELECTRICAL and conversion(unit, u)) for u in units):
            yield name, factor, shift


def _of_bases(unit: str, parameters: Mapping[str, Parameter]) -> Iterator[tuple[str, float, float]]:
    """Yield the bases among the parameters: their values for a per-unit signal, and the ratios of two of one kind; for a signal in
    V, A, W, var or VA those of its kind, that it may have been divided by."""
    bases = {n: p for n, p in parameters.items() if p.value > 0.0 and any(conversion(p.unit, b) for b in ELECTRICAL)}
    if not same_unit(unit, "pu"):
        for n, p in bases.items():
            if (scale := scale_between(p.unit, unit)) is not None:
                yield f"per unit of {n} = {p.value:g} {p.unit}", 1.0 / (scale * p.value), 0.0
                yield f"in per cent of {n} = {p.value:g} {p.unit}", 100.0 / (scale * p.value), 0.0
        return
    for n, p in bases.items():
        yield f"in {p.unit} of the base {n} = {p.value:g}", p.value, 0.0
        if any(conversion(p.unit, counted) for counted in ("V", "A")):
            for name, factor, why in COUNTED:
                yield f"in {p.unit} of the base {n} = {p.value:g} by {name}: {why}", factor * p.value, 0.0
    for (a, one), (b, other) in permutations(bases.items(), 2):
        if (scale := scale_between(one.unit, other.unit)) is not None:
            yield f"per unit of {b} and not of {a}", scale * one.value / other.value, 0.0


def scale_between(unit: str, wanted: str) -> float | None:
    """Return the scale from one unit to another, of powers whether W, var or VA: a base in MVA is that of MW too."""
    ends = [next((by[0] for kind in POWERS if (by := conversion(u, kind))), None) for u in (unit, wanted)]
    if ends[0] is not None and ends[1] is not None:
        return ends[0] / ends[1]
    by = conversion(unit, wanted)
    return None if by is None else by[0]


@dataclass(frozen=True, eq=False)
class Evidence:
    """A recorded signal against the model: the level before an event, and the movement after it.

    recorded, error: level and standard error, in the recorded unit; None where there is no level. levels: those that the model
    can have. slopes: recorded over simulated movement and its error, one for each run in which both move. size: of the
    simulated movement: a difference that is small beside it is none.
    """

    recorded: float | None
    levels: Sequence[float]
    error: float = 0.0
    slopes: Sequence[tuple[float, float]] = field(default=())
    size: float = 0.0

    def level_mismatch(self, c: Conversion = UNCHANGED) -> float:
        """Return how far the level is from the model's on a logarithmic scale, once the conversion is undone.

        Not below what noise and the finest match leave; 1 where there is no level. What is shifted is shifted by a round number, so it
        has to match the first level, that at the given values.
        """
        if self.recorded is None or not self.levels:
            return 1.0
        undone, error = c.undone(self.recorded), self.error / abs(c.factor)
        near = min(max(undone, min(self.levels)), max(self.levels)) if not c.shift else self.levels[0]
        zero = math.hypot(error, self.size) or FINEST * max(abs(undone), abs(near)) or 1.0
        return max(math.hypot(log_distance(undone, near, zero), error / math.hypot(zero, near)), FINEST)

    def slope_mismatch(self, c: Conversion = UNCHANGED) -> float:
        """Return the same of the movement; 1 where nothing moves, whatever the conversion."""
        if not self.slopes:
            return 1.0
        slopes = [(slope / c.factor, max(error / abs(c.factor), FINEST)) for slope, error in self.slopes]
        low, high = min(s for s, _ in slopes), max(s for s, _ in slopes)
        if low <= 1.0 <= high:  # between two runs: as well known as the run that follows best
            return min(max(min(error / abs(s) for s, error in slopes if s), FINEST), 1.0)
        slope, error = min(slopes, key=lambda s: abs(s[0] - 1.0))
        return max(math.hypot(log_distance(slope, 1.0, error), error / math.hypot(1.0, error)), FINEST)

    def gain(self, level: float, slope: float) -> float | None:
        """Return the logarithm of how much nearer these mismatches are than its own; None where neither is by itself far nearer.

        A movement that is far nearer does not count where it leaves the level far off.
        """
        own = self.level_mismatch(), self.slope_mismatch()
        near = self.recorded is None or STRONG * level <= 1.0
        if not (STRONG * level <= own[0] or (STRONG * slope <= own[1] and near)):
            return None
        return math.log(own[0] / level) + math.log(own[1] / slope)

    def gain_of(self, c: Conversion) -> float | None:
        """Return the gain by undoing a conversion."""
        return self.gain(self.level_mismatch(c), self.slope_mismatch(c))


@dataclass(frozen=True)
class Suggestion:
    """A conversion that explains a signal. explained: the evidence that it explains; gain: logarithm of the odds by which it does."""

    conversion: Conversion
    explained: tuple[Evidence, ...]
    gain: float

    @property
    def distance(self) -> float:
        """The mean mismatch of level and movement at the given values, once the conversion is undone."""
        at_given = [replace(e, levels=e.levels[:1], slopes=e.slopes[:1]) for e in self.explained]
        c = self.conversion
        return sum(e.level_mismatch(c) + e.slope_mismatch(c) for e in at_given) / len(at_given)

    @property
    def reason(self) -> str:
        """What the recording holds, as a question."""
        return f"{self.conversion.name}?"


def suggest_conversion(
    evidence: Sequence[Evidence], unit: str, parameters: Mapping[str, Parameter] = FrozenMap()
) -> Suggestion | None:
    """Return the conversion that most of the recordings of one signal suggest most; None where nothing is more likely than chance.

    The sign, the table (`conversions`) and a free factor are tried. Each recording that one explains has to come far nearer by it
    (`STRONG`); together they have to come nearer by more than the best of so many tries does by chance, since a mismatch of
    unknown size is as likely in any decade. unit, parameters: of the model.
    """
    table = conversions(unit, parameters)
    tried = [(SIGN, 1), *((c, len(table)) for c in table)]
    tried += [(c, 2) for e in evidence if (c := _free_factor(e)) is not None]
    likely: list[tuple[float, Suggestion]] = []
    for c, tries in tried:
        gains = {e: gain for e in evidence if (gain := e.gain_of(c)) is not None and gain > math.log(2.0)}
        total = sum(gains.values()) - math.log(tries) - math.log(2.0) * len(gains)
        if gains and c.gain:  # a free number explains one level by itself
            total -= max(math.log(e.level_mismatch() / e.level_mismatch(c)) for e in gains)
        if gains and total > math.log(POSITIVE):
            # A unit is suspected only where that is clearly more likely than a gain of the model.
            likely.append((total + math.log(POSITIVE) if c.gain else total, Suggestion(c, tuple(gains), total)))
    # Of those that candidates let fit about as well, the one that is nearest at the given values.
    most = max((weighed for weighed, _ in likely), default=0.0) - math.log(POSITIVE)
    return min((s for weighed, s in likely if weighed >= most), key=lambda s: s.distance, default=None)


def _free_factor(e: Evidence) -> Conversion | None:
    """Return the factor between the levels, as a wrong gain of the model makes level and movement wrong alike; None without both."""
    model = float(e.levels[0]) if e.levels else 0.0
    if not e.recorded or not e.slopes or abs(model) <= 3.0 * e.error:
        return None
    factor = e.recorded / model
    cause = "a gain of the model, or another base or unit"
    cause = f"the sign, and {cause}" if factor < 0.0 else cause
    return Conversion(f"a factor of {factor:.3g} in level and movement: {cause}", factor, gain=True)


def log_distance(a: float, b: float, zero: float) -> float:
    """Return the distance of two values on a scale that is logarithmic above `zero` and passes through 0."""
    return abs(math.asinh(a / zero) - math.asinh(b / zero))
