"""Quantity, unit and place of a column, as its name and its unit say them: by the habits of recorders, PMU concentrators and simulators.

A name such as `EASTFIELD12 V1 Mag` is read word by word: what it is of (voltage, current, frequency, power), which side of a phasor
(magnitude or angle), which phase or sequence, and what is left names the place. Some names mean two things by themselves (`VA` is a
phase, or the angle of a voltage): the unit, else the other columns of the file decide, and where neither does nothing is said.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from hvdc_ident.data.units import unit_of

Quantity = Literal[
    "",
    "voltage",
    "voltage angle",
    "current",
    "current angle",
    "angle",
    "frequency",
    "rate of frequency",
    "active power",
    "reactive power",
    "apparent power",
    "speed",
]
ANGLES = ("angle", "voltage angle", "current angle")
"""Quantities that turn: a whole turn more is the same. `angle` does not say of what."""


def _words_of(text: str) -> frozenset[str]:
    return frozenset(text.split())


_KINDS: dict[Quantity, str] = {
    "voltage": "v u volt volts voltage spannung spannungen tension tensione spanning vt ut etrm eterm kv vrms urms",
    "current": "i amp amps current strom courant corriente corrente stroom ka irms",
    "frequency": "f fq frq freq frequency frequenz frequence frecuencia frequenza frequentie netzfrequenz hz fehz",
    "rate of frequency": "df dfdt dfreq rocof roc rcf freqrate frequenzgradient",
    "active power": "p mw kw gw powr power pwr watt watts active activepower realpower wirk wirkleistung leistung activa attiva "
    "ptot psum p3ph pelec pe",
    "reactive power": "q mvar kvar gvar var vars reactive reactivepower blind blindleistung reactiva reattiva qtot qsum q3ph qe",
    "apparent power": "s mva kva apparent apparentpower scheinleistung",
}
_SUBJECTS = {word: quantity for quantity, words in _KINDS.items() for word in words.split()}
_FILLERS = _words_of(
    "power leistung puissance potencia potenza of der des de la the sequence seq system pmu phasor phasors synchrophasor dt meas measured "
    "value val total tot sum 3ph three terminal bus bb line ll ln lg lf to rms eff effektivwert net"
)
"""Words that say nothing about the quantity, and are no name of a place by themselves."""
_ANGLE = _words_of(
    "ang angle angles phi theta winkel phasenwinkel phasenlage spannungswinkel angulo angolo arg phang phaseangle"
)
_MAGNITUDE = _words_of("mag magn magnitude betrag amplitude ampl modul module abs")
_SEQUENCES = {
    **dict.fromkeys(("pos", "positive", "posseq", "ps", "mit", "mitsystem", "directe", "directa", "diretta"), "1"),
    **dict.fromkeys(("neg", "negative", "negseq", "gegensystem", "inverse"), "2"),
    **dict.fromkeys(("zero", "zeroseq", "nullsystem", "homopolaire"), "0"),
}
_PHASES = {
    **{letter: letter for letter in ("a", "b", "c", "ab", "bc", "ca")},
    **{f"{letter}n": letter for letter in "abc"},
    **{f"{letter}g": letter for letter in "abc"},
    **{f"ph{letter}": letter for letter in "abc"},
    **{f"l{k}": letter for k, letter in zip("123", "abc", strict=True)},
    **{f"l{a}l{b}": c for (a, b), c in {("1", "2"): "ab", ("2", "3"): "bc", ("3", "1"): "ca"}.items()},
    **{f"l{k}": c for k, c in {"12": "ab", "23": "bc", "31": "ca"}.items()},
}
_QUALIFIERS = _words_of(
    "ref reference order setpoint set sp soll sollwert consigne cmd command limit lim max min maximum minimum err error fehler std sigma "
    "vdc udc idc dc thd status stat flag flags quality valid field fd mech mechanical rotor neutral delta angl spread factor pf cosphi cos "
    "harmonic h3 h5 h7 target forecast demand rating rated nominal nom base bias integral sqrt count real imag im re internal efd ifd oel "
    "uel"
)
"""Words from which a column is not the measured quantity itself, or a part of it that is not its magnitude or angle."""
_DEVIATIONS = _words_of("dev deviation abweichung ecart desviacion")
_UNIT_WORDS = {
    "kv": "kV", "mw": "MW", "kw": "kW", "gw": "GW", "mvar": "Mvar", "kvar": "kvar", "mva": "MVA", "kva": "kVA", "ka": "kA", "hz": "Hz",
    "mhz": "mHz", "deg": "deg", "degree": "deg", "degrees": "deg", "grad": "deg", "rad": "rad", "radian": "rad", "radians": "rad",
    "pu": "pu", "volts": "V", "amps": "A", "watts": "W", "a": "A",
}  # fmt: skip
"""Units as the last word of a name."""
_BY_UNIT: dict[str, Quantity] = {
    "V": "voltage", "A": "current", "Hz": "frequency", "Hz/s": "rate of frequency", "W": "active power", "var": "reactive power",
    "VA": "apparent power", "rad": "angle", "rad/s": "speed",
}  # fmt: skip
_PHASOR = re.compile(
    r"(?P<phi>phi|ang)?(?P<of>[vui])(?P<which>pos|neg|ap|ab|bc|ca|an|bn|cn|l1|l2|l3|[012abcnz]|p1|p)?"
    r"(?P<channel>[lyzwxs]?pm|mp)?_?(?P<side>mag|ang|magnitude|angle|phase|ph|m|a)?"
)
_MICRO = re.compile(r"(?P<of>[lc])(?P<phase>[123])(?P<side>mag|ang)")
_NUMBERED = re.compile(r"(?P<word>[a-z]+?)(?P<number>\d+)")
_WHICH = {
    "pos": "1",
    "neg": "2",
    "n": "n",
    "z": "0",
    "p": "1",
    "p1": "1",
    "an": "a",
    "bn": "b",
    "cn": "c",
    "l1": "a",
    "l2": "b",
    "l3": "c",
}
_SPLIT = re.compile(r"[\W_]+")
_HUMPS = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


@dataclass(frozen=True)
class Reading:
    """A column as its name and unit say it.

    phase: "a", "b", "c", "ab", "bc", "ca", or of a sequence "1", "2", "0"; "" where it is not said. place: words that name where it was
    recorded, in their order. unit: as stated, else as the last word of the name says it. plain: it is the quantity itself, and no
    reference, limit or part of it. deviation: from the nominal value.
    """

    quantity: Quantity = ""
    phase: str = ""
    place: tuple[str, ...] = ()
    unit: str = ""
    plain: bool = True
    deviation: bool = False

    @property
    def whole(self) -> bool:
        """True for a quantity of all phases: a positive sequence, a total, or where no phase is said."""
        return self.phase in ("", "1")

    @property
    def measured(self) -> Quantity:
        """The quantity where it is measured of all phases, as a model of a plant has it; "" for a phase, a reference, a limit, or a
        deviation of anything but a frequency."""
        if not self.plain or not self.whole or (self.deviation and self.quantity != "frequency"):
            return ""
        return "angle" if self.quantity == "voltage angle" else self.quantity


def quantity_of_unit(unit: str) -> Quantity:
    """Return the quantity that is measured in a unit, "" where several are, or none is known."""
    known = unit_of(unit) if unit.strip() else None
    return "" if known is None else _BY_UNIT.get(known.kind, "")


def compatible(one: Quantity, other: Quantity) -> bool:
    """Return whether two columns may be the same quantity: the same, one not said, or an angle of which is not said of what."""
    if one in ANGLES and other in ANGLES:
        return one == other or "angle" in (one, other)
    return not one or not other or one == other


def read_columns(names: Sequence[str], units: Sequence[str]) -> tuple[Reading, ...]:
    """Return the columns of one file as their names and units say them. units: as the file states them, "" where it does not."""
    each = [_Words(name, unit) for name, unit in zip(names, units, strict=True)]
    return tuple(_settled([w.reading for w in each], [w.tie for w in each]))


@dataclass(frozen=True)
class _Tie:
    """The meanings of a word that has two: the phase a, or an angle; sequence 1, phase a, or the first of several."""

    kind: Literal["", "va", "number"] = ""
    of: str = ""
    number: str = ""


class _Words:
    """One name, read word by word."""

    def __init__(self, name: str, unit: str) -> None:
        self._unit = unit.strip()
        self._subjects: list[tuple[int, Quantity]] = []
        self._phase, self._side = "", ""
        self._place: list[tuple[int, str]] = []
        self._plain, self._deviation, self._rate = True, False, False
        self.tie = _Tie()
        words = _words(name)
        for number, word in enumerate(words):
            before, after = (words[k] if 0 <= k < len(words) else "" for k in (number - 1, number + 1))
            self._take(number, word, before, after, last=number == len(words) - 1)
        if self.tie.kind == "va" and self._side:  # `VA_ANG`: the phase, for the side is said
            self.tie = _Tie()
        self.reading = self._read()

    def _take(self, number: int, word: str, before: str, after: str, *, last: bool) -> None:
        plain = word.casefold()
        if last and not self._unit and plain in _UNIT_WORDS and (plain != "a" or (self._side and self._is_current())):
            self._unit = _UNIT_WORDS[plain]
            if plain in _SUBJECTS:
                self._subjects.append((number, _SUBJECTS[plain]))
        elif plain in _QUALIFIERS:
            self._plain = False
        elif plain in _DEVIATIONS:
            self._deviation = True
        elif plain == "rate":
            self._rate = True
        elif plain in ("phase", "ph", "phases"):
            if after.casefold() not in _PHASES and before.casefold() not in _PHASES:
                self._side = self._side or "angle"
        elif plain in _ANGLE:
            self._side = "angle"
        elif plain in _MAGNITUDE:
            self._side = "magnitude"
        elif plain in _SEQUENCES:
            self._phase = _SEQUENCES[plain]
        elif plain in ("power", "leistung") and self._subjects:
            pass
        elif plain in _SUBJECTS and not (plain == "s" and self._subjects):
            self._subjects.append((number, _SUBJECTS[plain]))
        elif self._subjects and self._subjects[-1][0] == number - 1 and plain in ("m", "a") and last and self._phase:
            self._side = {"m": "magnitude", "a": "angle"}[plain]  # `VA_A`, `VP_M`
        elif self._subjects and self._subjects[-1][0] == number - 1 and plain == "m" and last:
            self._side = "magnitude"
        elif plain in _PHASES and (
            self._subjects or before.casefold() in ("phase", "ph") or after.casefold() in ("phase", "ph")
        ):
            self._phase = _PHASES[plain]
        elif plain in _FILLERS:
            pass
        elif not self._fused(number, plain):
            self._place.append((number, word))

    def _is_current(self) -> bool:
        return bool(self._subjects) and self._subjects[-1][1] == "current"

    def _fused(self, number: int, word: str) -> bool:
        """Read a word of several parts, as `VPM` and `U1mag`; return whether it is one."""
        if (micro := _MICRO.fullmatch(word)) is not None:
            self._subjects.append((number, "voltage" if micro["of"] == "l" else "current"))
            self._phase, self._side = (
                "abc"[int(micro["phase"]) - 1],
                {"mag": "magnitude", "ang": "angle"}[micro["side"]],
            )
            return True
        if re.fullmatch(r"p[ma]\d*", word):  # magnitude or angle of a phasor, and of which is not said
            self._plain, self._side = False, "angle" if word[1] == "a" else "magnitude"
            self._place.append((number, word))
            return True
        phasor = _PHASOR.fullmatch(word)
        if phasor is not None:
            of: Quantity = "current" if phasor["of"] == "i" else "voltage"
            self._subjects.append((number, of))
            which, side = phasor["which"] or "", "ang" if phasor["phi"] else phasor["side"] or ""
            if side in ("ph", "phase"):  # the phase voltage, or its phase
                self._plain = False
            elif side:
                self._side = "magnitude" if side in ("mag", "magnitude", "m") else "angle"
            elif phasor["channel"] in ("pm", "mp") and not which:
                self._side = self._side or "magnitude"  # `VPM` beside `VPA`
            if word[1:] in ("pa", "ap"):
                self._side, which = "angle", ""
            elif which == "a" and not side and not phasor["channel"]:
                self.tie = _Tie("va", phasor["of"])
            elif which in ("0", "1", "2") and not phasor["channel"]:
                self.tie = _Tie("number", phasor["of"], which)
            self._phase = _WHICH.get(which, which) or self._phase
            return True
        numbered = _NUMBERED.fullmatch(word)
        if numbered is not None and numbered["word"] in ("v", "u", "i"):  # `V3`: a phase, or one of several
            self._subjects.append((number, _SUBJECTS[numbered["word"]]))
            self.tie = _Tie("number", numbered["word"], numbered["number"])
            self._place.append((number, numbered["number"]))
            return True
        if numbered is not None and numbered["word"] in _SUBJECTS:
            self._subjects.append((number, _SUBJECTS[numbered["word"]]))
            self._place.append((number, numbered["number"]))
            return True
        if word[:1] in "pq" and word[1:] in ("a", "b", "c"):
            self._subjects.append((number, _SUBJECTS[word[:1]]))
            self._phase = word[1:]
            return True
        return False

    def _read(self) -> Reading:
        by_unit = quantity_of_unit(self._unit)
        said = [s for s in self._subjects if _agrees(s[1], by_unit)]
        at, subject = (said or self._subjects or [(-1, "")])[-1]
        # Words before the last one that says a quantity name the place, as in `U1 P`.
        place = [*self._place, *((k, "") for k, q in self._subjects if k != at and q != subject)]
        plain = self._plain
        if self._rate and subject == "frequency":
            subject = "rate of frequency"
        if subject in ("voltage", "current") and (self._side == "angle" or by_unit == "angle"):
            plain = plain and by_unit in ("", "angle")
            subject = "voltage angle" if subject == "voltage" else "current angle"
        elif not subject and self._side == "angle":
            subject, plain = "angle", plain and by_unit in ("", "angle")
        elif self._side == "angle":
            subject, plain = "angle", False  # of a power or a frequency there is none
        contradicted = bool(subject) and not compatible(subject, by_unit) and (subject, by_unit) not in _SHARED
        if by_unit and (contradicted or not subject):  # the name says another quantity, or none: of what it is is open
            subject, plain = by_unit, False
        words = tuple(word for _, word in sorted(place) if word)
        return Reading(subject, self._phase, words, self._unit, plain, self._deviation)


_SHARED = {("active power", "apparent power"), ("reactive power", "apparent power"), ("rate of frequency", "frequency")}
"""Quantities whose unit is also written as that of another: MVA for a power, Hz for Hz/s."""


def _agrees(subject: Quantity, by_unit: Quantity) -> bool:
    """Return whether what a word says may have a unit of this quantity."""
    if by_unit == "angle":
        return subject in ("voltage", "current", "angle")
    return not by_unit or subject == by_unit or (subject, by_unit) in _SHARED


def _words(name: str) -> list[str]:
    """Return the words of a name: parts between signs, and of one that says nothing as a whole those that begin with a capital."""
    plain = "".join(c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c))
    for letter, word in (("θ", "theta"), ("φ", "phi"), ("δ", "delta")):
        plain = plain.replace(letter, word)
    plain = re.sub(r"\bd\s*\(?\s*f\s*\)?\s*/\s*d\s*t\b", "dfdt", plain, flags=re.IGNORECASE)
    split: list[str] = []
    for part in (p for p in _SPLIT.split(plain) if p):
        parts = [part] if _says(part.casefold()) else [p for p in _HUMPS.split(part) if p]
        split += [part] if len(parts) > 1 and not any(_says(p.casefold()) for p in parts) else parts
    return split


def _says(word: str) -> bool:
    """Return whether a word says something as a whole."""
    known: Iterable[Iterable[str]] = (
        _SUBJECTS, _FILLERS, _ANGLE, _MAGNITUDE, _SEQUENCES, _PHASES, _QUALIFIERS, _DEVIATIONS, _UNIT_WORDS,
    )  # fmt: skip
    return (
        any(word in words for words in known)
        or _PHASOR.fullmatch(word) is not None
        or _MICRO.fullmatch(word) is not None
    )


def _settled(readings: list[Reading], ties: Sequence[_Tie]) -> list[Reading]:
    """Return the readings with what several columns together decide."""
    settled = list(readings)
    for k, (reading, tie) in enumerate(zip(readings, ties, strict=True)):
        beside = [
            (r, t) for j, (r, t) in enumerate(zip(readings, ties, strict=True)) if j != k and _same_place(r, reading)
        ]
        if tie.kind == "va":
            settled[k] = _phase_or_angle(reading, beside)
        elif tie.kind == "number":
            settled[k] = _sequence_or_phase(reading, tie, beside)
    return settled


def _phase_or_angle(reading: Reading, beside: Sequence[tuple[Reading, _Tie]]) -> Reading:
    """Return what `VA`, `UA` or `IA` is: phase a beside phases b and c, the angle beside a magnitude without phase, else not said."""
    of = "current" if reading.quantity.startswith("current") else "voltage"
    if any(r.quantity.startswith(of) and r.phase in ("b", "c", "bc", "ca") for r, _ in beside):
        return reading
    unit = quantity_of_unit(reading.unit)
    magnitude = any(r.quantity == of and not r.phase for r, _ in beside)
    if unit == "angle" or (not unit and magnitude and not quantity_of_unit(reading.unit)):
        return replace(reading, quantity="voltage angle" if of == "voltage" else "current angle", phase="")
    return reading if unit else replace(reading, quantity="", plain=False)


def _sequence_or_phase(reading: Reading, tie: _Tie, beside: Sequence[tuple[Reading, _Tie]]) -> Reading:
    """Return what the number behind `V`, `U` or `I` means: with 3 beside 1 and 2 and no 0 a phase; with 1 alone, or with 0, a sequence;
    else one of several that are not told apart."""
    numbers = {t.number for r, t in beside if t.kind == "number" and t.of == tie.of} | {tie.number}
    place = tuple(w for w in reading.place if w != tie.number)
    if {"1", "2", "3"} <= numbers and "0" not in numbers and tie.number in "123" and not numbers - {"1", "2", "3"}:
        return replace(reading, phase="abc"[int(tie.number) - 1], place=place)
    if numbers <= {"0", "1", "2"} and (numbers == {"1"} or "0" in numbers):
        return replace(reading, phase=tie.number, place=place)
    return replace(reading, phase="", place=(*place, tie.number))


def _same_place(one: Reading, other: Reading) -> bool:
    """Return whether two names have the same words for the place, the number of one of several apart."""
    words = [tuple(w for w in r.place if not w.isdigit()) for r in (one, other)]
    return words[0] == words[1]
