"""Columns at the terminals of a plant that is played back: unit, base and sign of each, from its name, from what the files of the plant
state, and from the values.

A level decides only between ways to write one quantity that lie far apart: kV or pu, line or phase, MW or pu of the machine. What no
way explains, or two do, is left open.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hvdc_ident.data import FEWEST_QUIET, Array, Trajectory, before_event, conversion, same_unit
from hvdc_ident.data.signals import distinct
from hvdc_ident.data.three_phase import unwrapped
from hvdc_ident.data.turning import Agreement, agreement, finer_is_angle, scatter, unwrapped_words, whole_turns
from hvdc_ident.model import AnyModel
from hvdc_ident.plants import LEVELS, shelf_model
from hvdc_ident.study.column_matching import ColumnLine, Match
from hvdc_ident.study.conversions import scale_between
from hvdc_ident.text import quantity

NORMAL = (0.8, 1.2)
"""Voltage in pu, and frequency over the nominal one, at which a plant is ever at rest: limits of operation in an emergency are 0.9 to
1.1, protection trips outside 0.8 to 1.2; ways to count lie a factor of sqrt(3) apart."""
LOADS = (0.02, 1.5)
"""Apparent power over the machine's base at which a plant runs with something to be seen: from a house load to a short overload; ways to
count lie a factor of 100 apart, or that of two bases."""
NEAR = math.sqrt(2.0)
"""Largest factor between a recorded power and that of the power flow, which is another hour's, that tells which base is meant."""
FASTEST = 0.05
"""Share of the nominal frequency by which that of a network differs for a tenth of a second without the plant's being tripped."""
AT_REST = 0.01
"""Share of the nominal frequency within which a network's is before an event."""
SURE = 5.0
"""Standard errors from which a slope before the event is one."""
LASTS = 0.1
"""Time in s over which a voltage has a frequency: some cycles."""
DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class Terminals:
    """Statements about a plant's terminals. frequency: nominal, Hz; mva, system_mva: bases of machine and system; base_kv: of the bus;
    p, q: of the power flow, MW and Mvar; bus: its name. None and "" where no file says it."""

    frequency: float
    mva: float | None = None
    base_kv: float | None = None
    system_mva: float | None = None
    p: float | None = None
    q: float | None = None
    bus: str = ""


@dataclass(frozen=True)
class Way:
    """A way in which a column may be written: model = scale x recorded + offset. line: the same as keys of the study's `columns`;
    words: what it is then."""

    scale: float
    offset: float = 0.0
    line: ColumnLine = field(default_factory=ColumnLine)
    words: str = ""

    def size(self, recorded: float) -> float:
        """Return the size of a recorded value in the model's unit."""
        return abs(self.scale) * recorded


def terminals_of(model: AnyModel) -> Terminals | None:
    """Return what the card of a plant states of its terminals; None for a model that is not played back."""
    played = shelf_model("playback").inputs
    if not all(
        n in model.inputs and model.inputs[n].unit == i.unit and not model.inputs[n].settable for n, i in played.items()
    ):
        return None
    values = model.values
    nominal = next((v for n, v in values.items() if n.endswith(".f0")), model.inputs["f"].value)
    return Terminals(float(nominal), next((float(v) for n, v in values.items() if n.endswith(".Sn")), None))


def voltage_ways(unit: str, stated: bool, about: Terminals) -> Iterator[Way]:
    """Yield the ways to write a voltage whose model is in pu. unit: of the column, "" where it is not known; stated: by the file itself."""
    if unit and (by := conversion(unit, "pu")) is not None:
        yield Way(by[0], by[1], _unit_line(unit, stated), "")
        return
    if not unit:
        yield Way(1.0, words="taken as pu")
    for volts in [unit] if unit else ["kV", "V"]:
        size = conversion(volts, "kV")
        if size is None or about.base_kv is None:
            continue
        for root, words in ((1.0, ""), (math.sqrt(3.0), ", phase to ground")):
            base = rounded(about.base_kv / size[0] / root)
            line = ColumnLine(None if stated and unit else volts, base=base)
            yield Way(1.0 / base, 0.0, line, f"by the {about.base_kv:g} kV of the bus{words}")


def frequency_ways(unit: str, stated: bool, about: Terminals) -> Iterator[Way]:
    """Yield the ways to write a frequency whose model is in Hz: the frequency itself, its deviation, in pu or as an angular one."""
    f0 = about.frequency
    deviation = f"the deviation from {f0:g} Hz"
    if unit and not same_unit(unit, "pu"):
        by = conversion(unit, "Hz")
        if by is not None:
            yield Way(by[0], 0.0, _unit_line(unit, stated))
            yield Way(by[0], f0, replace(_unit_line(unit, stated), offset=f0), deviation)
        elif (angular := conversion(unit, "rad/s")) is not None:
            scale = angular[0] / (2.0 * math.pi)
            yield Way(scale, 0.0, ColumnLine(scale=scale), "the angular frequency")
        return
    if not unit:
        yield Way(1.0, words="taken as Hz")
        yield Way(1.0, f0, ColumnLine(offset=f0), f"{deviation}, taken as Hz")
        yield Way(0.5 / math.pi, 0.0, ColumnLine(scale=0.5 / math.pi), "the angular frequency in rad/s")
    yield Way(f0, 0.0, ColumnLine(scale=f0), f"in pu of {f0:g} Hz")
    yield Way(f0, f0, ColumnLine(scale=f0, offset=f0), f"{deviation}, in pu")


def power_ways(unit: str, stated: bool, wanted: str, about: Terminals) -> Iterator[Way]:
    """Yield the ways to write a power. wanted: the model's unit, MW or Mvar."""
    if unit and not same_unit(unit, "pu"):
        by = conversion(unit, wanted)
        if by is not None:
            yield Way(by[0], by[1], _unit_line(unit, stated))
        elif (scale := scale_between(unit, wanted)) is not None:
            yield Way(scale, 0.0, ColumnLine(scale=scale), f"{unit} for {wanted}")
        return
    if not unit:
        yield Way(1.0, words=f"taken as {wanted}")
        kind = "W" if wanted.endswith("W") else "var"
        for prefix, scale in (("k", 1e-3), ("", 1e-6)):
            yield Way(scale, 0.0, ColumnLine(unit=prefix + kind), f"in {prefix}{kind}")
    for base, whose in ((about.mva, "machine"), (about.system_mva, "system")):
        if base is not None:
            yield Way(base, 0.0, ColumnLine(scale=base), f"in pu of the {whose}'s {base:g} MVA")


def voltage_way(unit: str, stated: bool, level: float, about: Terminals) -> Way | None:
    """Return the way to write a voltage that puts its level where a plant rests; None where none does, or several."""
    return _only(w for w in voltage_ways(unit, stated, about) if NORMAL[0] <= w.scale * level + w.offset <= NORMAL[1])


def frequency_way(unit: str, stated: bool, level: float, largest: float, about: Terminals) -> Way | None:
    """Return the way to write a frequency that puts its level near the nominal one. largest: absolute value in the column.

    Between a deviation in Hz and one in pu decides that no network leaves its frequency by a tenth.
    """
    f0 = about.frequency
    near = [w for w in frequency_ways(unit, stated, about) if 0.9 * f0 <= w.scale * level + w.offset <= 1.1 * f0]
    possible = [w for w in near if not w.offset or (w.size(abs(level)) <= AT_REST * f0 and w.size(largest) <= 0.1 * f0)]
    return _only(possible)


def power_way(
    unit: str, stated: bool, wanted: str, level: float, apparent: float, about: Terminals, flow: float | None
) -> Way | None:
    """Return the way to write a power. apparent: of the levels of P and Q in the columns' unit, where they are alike; flow: apparent
    power of the power flow, MVA.

    A stated unit counts. Without one that counts which comes near the power flow's power, else which the machine can deliver.
    """
    ways = list(power_ways(unit, stated, wanted, about))
    if len(ways) <= 1:
        return _only(ways)
    size = apparent or abs(level)
    if flow and (near := [w for w in ways if size and abs(math.log(w.size(size) / flow)) < math.log(NEAR)]):
        return _only(near)
    if about.mva is None:
        return None
    return _only(w for w in ways if LOADS[0] <= w.size(size) / about.mva <= LOADS[1])


def angle_way(unit: str, stated: bool, time: Array, values: Array, frequency: Array | None, about: Terminals) -> Way:
    """Return the way to write an angle: in degrees or rad. frequency: (n,) Hz of the same voltage, where it is recorded.

    Without a unit the recorded frequency decides; else that no network turns so fast as degrees taken for rad say.
    """
    if unit and (by := conversion(unit, "rad")) is not None:
        return Way(by[0], 0.0, _unit_line(unit, stated))
    radians, degrees = Way(1.0, words="taken as rad"), Way(DEGREE, 0.0, ColumnLine(unit="deg"))
    if frequency is not None:
        for way, unit_words in ((radians, "rad"), (degrees, "degrees")):
            agreed = agreement(time, way.scale * values, frequency, about.frequency)
            if agreed.factor is not None and replace(agreed, factor=abs(agreed.factor)).turns_alike:
                return replace(way, words=f"{unit_words}, as its turn beside the frequency says")
    limit = FASTEST * about.frequency
    if fastest(time, values) > limit >= fastest(time, DEGREE * values):
        return replace(degrees, words=f"degrees: as rad it would turn by up to {fastest(time, values):.3g} Hz")
    return radians


def fastest(time: Array, angle: Array) -> float:
    """Return the largest frequency in Hz with which an angle in rad turns over a tenth of a second, or over four rows where those are
    longer; of each such stretch less its largest change from row to row, which alone is a step of a clock or of the polarity."""
    from scipy.ndimage import maximum_filter1d

    known = np.isfinite(angle)
    t, theta = distinct(time[known], unwrapped(angle[known]))
    if t.size < 2:
        return 0.0
    rows = max(4, round(LASTS / float(np.median(np.diff(t)))))
    if t.size <= rows:
        return 0.0
    largest = maximum_filter1d(np.abs(np.diff(theta)), rows)[rows // 2 :][: t.size - rows]
    moved = np.maximum(np.abs(theta[rows:] - theta[:-rows]) - largest, 0.0)
    return float((moved / (t[rows:] - t[:-rows])).max()) / (2.0 * math.pi)


@dataclass(frozen=True)
class Settled:
    """What a plant's terminals take of a record. matches: by signal, with their ways; open: those of which no way is known, with why.

    values: inputs that are constant at other than the card's value. compared: columns that say what another one says and are not used.
    notes: sentences on what was decided between columns.
    """

    matches: Mapping[str, Match]
    open: tuple[Match, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    compared: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def settled(record: Trajectory, named: Mapping[str, Match], event: float | None, about: Terminals) -> Settled:
    """Return the columns of a plant's terminals with unit, base and sign; of angle and frequency of one voltage that which tells the
    turn better. named: by names; event: s."""
    ways = {n: w for n, m in named.items() if (w := _way(n, record, named, about)) is not None}
    lost = tuple(_left_open(m, about) for n, m in named.items() if n in _OWN and n not in ways)
    matches = {n: m for n, m in named.items() if n not in _OWN}
    matches |= {n: replace(named[n], line=w.line, reason=_reason(named[n], w)) for n, w in ways.items()}
    notes: list[str] = []
    values: dict[str, float] = {}
    compared: tuple[str, ...] = ()
    if "theta" in ways:
        angle = ways["theta"].scale * record[named["theta"].column.name]
        if jumps := whole_turns(angle):
            notes.append(f"{named['theta'].column.name} is {unwrapped_words(jumps)}")
        if "f" in ways:
            frequency = _converted(record, named["f"], ways["f"])
            agreed = agreement(record.time, angle, frequency, about.frequency)
            kept, dropped = ("theta", "f") if finer_is_angle(record.time, angle, frequency) else ("f", "theta")
            columns = {n: named[n].column.name for n in (kept, dropped)}
            notes.append(
                f"{columns[dropped]} is not used beside {columns[kept]}: both tell how one voltage turns, {columns[kept]} more finely; "
                f"{agreement_words(agreed)}"
            )
            del matches[dropped]
            compared = (columns[dropped],)
        if "theta" in matches and (turn := _turn_before(record.time, angle, event)):
            matches["theta"] = replace(matches["theta"], line=replace(matches["theta"].line, turn=turn))
            values["f"] = rounded(about.frequency + turn)
            at = f"the frame turns with it, at f = {values['f']:g} Hz"
            notes.append(f"{named['theta'].column.name} turns by {turn:g} Hz before the event: {at}")
    return Settled(matches, lost, values, compared, tuple(notes))


_OWN = ("V", "theta", "f", *LEVELS.values())


def agreement_words(agreed: Agreement) -> str:
    """Return in words how far an angle and a frequency of one voltage agree."""
    degrees = agreed.rms / DEGREE
    if agreed.factor is None and agreed.holds:
        return f"neither turns enough to compare them ({degrees:.2g} deg rms between them)"
    if agreed.factor is None:
        apart = f"{degrees:.3g} deg rms between them, where {agreed.unseen / DEGREE:.2g} would be seen"
        return f"they disagree: one turns and the other does not, {apart}"
    if agreed.holds:
        return f"they agree within {degrees:.2g} deg rms, of {agreed.moves / DEGREE:.3g} deg"
    return f"they disagree: the angle turns {agreed.factor:.3g} times as far as the frequency says, {degrees:.3g} deg rms between them"


def unit_of_match(match: Match) -> tuple[str, bool]:
    """Return the unit of a column, by the file or its name, and whether the file itself states it."""
    column = match.column
    return (column.unit, True) if column.unit else (column.reading.unit, False)


def _way(name: str, record: Trajectory, named: Mapping[str, Match], about: Terminals) -> Way | None:
    """Return the way in which the column of a signal is written; None where that is open, or the signal is none of the terminals'."""
    match = named[name]
    unit, stated = unit_of_match(match)
    level, values = match.column.level, record[match.column.name]
    if name == "theta":
        f = named.get("f")
        f_way = _way("f", record, named, about) if f is not None else None
        frequency = None if f is None or f_way is None else _converted(record, f, f_way)
        return angle_way(unit, stated, record.time, values, frequency, about)
    if level is None or name not in _OWN:
        return None
    if name == "V":
        return voltage_way(unit, stated, level, about)
    if name == "f":
        return frequency_way(unit, stated, level, float(np.nanmax(np.abs(values))), about)
    pair = [named[n].column for n in LEVELS.values() if n in named]
    alike = len(pair) == 2 and pair[0].reading.unit == pair[1].reading.unit == ""
    apparent = math.hypot(*(c.level or 0.0 for c in pair)) if alike else 0.0
    flow = math.hypot(about.p, about.q or 0.0) if about.p is not None else None
    return power_way(unit, stated, match.target.unit, level, apparent, about, flow)


def _converted(record: Trajectory, match: Match, way: Way) -> Array:
    return np.asarray(way.scale * record[match.column.name] + way.offset)


def _reason(match: Match, way: Way) -> str:
    """Return the reason of a match with what its values are."""
    level = match.column.level
    if not way.words or level is None:
        return match.reason
    at = (
        ""
        if match.target.name == "theta"
        else f": {quantity(way.scale * level + way.offset, match.target.unit)} {match.column.place}"
    )
    return f"{match.reason}; {way.words}{at}"


def _left_open(match: Match, about: Terminals) -> Match:
    """Return a match whose unit or base is open, with why."""
    column = match.column
    unit, stated = unit_of_match(match)
    level = "nothing is recorded" if column.level is None else f"it reads {quantity(column.level, unit)} {column.place}"
    base = None
    why = f"no unit or base is known with which {match.target.name} is where a plant rests"
    if match.target.name == "V" and about.base_kv is None and unit and conversion(unit, "kV") is not None:
        why = "the base of the voltage is not known, which a power flow (a .raw file) states"
    elif match.target.name == "V" and unit and (by := conversion(unit, "kV")) is not None and about.base_kv is not None:
        base = rounded(about.base_kv / by[0])
        why = f"that is not where a bus of {about.base_kv:g} kV rests"
    line = _unit_line(unit, stated or not unit)
    return replace(match, reason=f"{match.reason}; {level}, and {why}", base=base, line=line, is_open=True)


def steadied(record: Trajectory, column: str, unit: str, others: float | None) -> Array:
    """Return an angle in its unit, unwrapped, without the course with which it turns at first: what is left moves with the event.

    unit: as the file states it, rad where it does not. others: event in s that the other columns show; without one the first tenth of
    the record tells the course.
    """
    by = (conversion(unit, "rad") if unit else None) or (1.0, 0.0)
    angle = unwrapped(by[0] * record[column])
    begin = others if others is not None else float(record.time[0] + 0.1 * (record.time[-1] - record.time[0]))
    turn = _turn_before(record.time, angle, begin)
    return np.asarray((angle - 2.0 * math.pi * turn * (record.time - record.time[0])) / by[0])


def _turn_before(time: Array, angle: Array, event: float | None) -> float:
    """Return the frequency in Hz with which an angle in rad turns before the event; 0 where that is no more than its noise."""
    rows = before_event(time, angle, event)
    n = int(rows.sum())
    if n < FEWEST_QUIET:
        return 0.0
    t, theta = time[rows], unwrapped(angle[rows])
    slope = float(np.polyfit(t, theta, 1)[0])
    error = scatter(t, theta) / (math.sqrt(n) * float(np.std(t)))
    return float(f"{slope / (2.0 * math.pi):.6g}") if abs(slope) > SURE * error else 0.0


def _only(ways: Iterable[Way]) -> Way | None:
    all_ways = list(ways)
    return all_ways[0] if len(all_ways) == 1 else None


def _unit_line(unit: str, stated: bool) -> ColumnLine:
    return ColumnLine() if stated else ColumnLine(unit)


def rounded(value: float) -> float:
    """Return a value with the digits that a study is written with."""
    return float(f"{value:.9g}")
