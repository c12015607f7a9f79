"""Records of one unit that are wrong in 40 ways, and 40 that are sound, through `new` and `check`: is what is wrong said, and is no
sound record nagged?

    python benchmarks/wrong_records.py [--only NAME ...] [--text]

The unit (GENROU, SEXS, TGOV1) runs behind a line; faults, steps, ramps and courses of the frequency there are simulated, and seen at its
terminals by a recorder with noise. Each record goes through `new --dyr --raw --bus` and `check`, as a user's does. A wrong record counts
as said where one line names its column, or its rows, and what is wrong, in words that a line on the sound record of the same kind does
not have; a refusal counts where its message does. A sound record counts as nagged where it is refused, or `check` does not end with "good".
"""

from __future__ import annotations

import argparse
import re
import shutil
import tempfile
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

import hvdc_ident as hi
from hvdc_ident.data import Array, InputSignal
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.model import parse_card
from hvdc_ident.plants import UnitPart, unit_card
from hvdc_ident.study.new_unit import UnitAsked, new_unit_study

KV, F0, MVA, P0 = 16.0, 50.0, 320.0, 240.0
EVENT = 2.0
DYR = """7 'GENROU' 1  6.5 0.035 0.7 0.06 3.4 0.0 1.9 1.8 0.24 0.45 0.2 0.16 0.06 0.35 /
7 'SEXS' 1  0.1 10.0 120.0 0.1 0.0 5.0 /
7 'TGOV1' 1 0.05 0.4 1.0 0.0 1.8 5.0 0.0 /
"""
RAW = f"""0, 100.0, 33, 0, 0, {F0} / case
one
two
7,'HOLMWOOD   7', {KV},2,1,1,1,1.01,8.0
0 / END OF BUS DATA
0 / END OF LOAD DATA
0 / END OF FIXED SHUNT DATA
7,'1 ',{P0},40.0,150.0,-100.0,1.01,0,{MVA},0.0,0.24
0 / END OF GENERATOR DATA
Q
"""
Corners = tuple[tuple[float, float], ...]
FAULT: Corners = ((EVENT, 1.0), (EVENT + 0.1, 0.75), (EVENT + 0.25, 0.97))
"""The course of the voltage behind the line, pu: from each instant on the value of the next."""


@dataclass(frozen=True)
class Seen:
    """What happens, and how it is recorded. voltage, frequency: behind the line, pu and Hz off the nominal one. noise: times that of a
    usual recorder. load: P in MW before the event, level: V in pu. bits: of the recorder, digits: significant ones of the file."""

    voltage: Corners = FAULT
    frequency: Callable[[Array], Array] = np.zeros_like
    rate: float = 50.0
    length: float = 8.0
    noise: float = 1.0
    load: float = P0
    level: float = 1.01
    bits: int | None = None
    digits: int = 7
    draw: Callable[[np.random.Generator, int], Array] = np.random.Generator.standard_normal
    seed: int = 1

    def columns(self) -> dict[str, Array]:
        """time in s, V in pu, theta in rad, f in Hz, P in MW, Q in Mvar, I in kA and its angle phi in rad."""
        time, clean = _clean(self.voltage, self.frequency, self.rate, self.length, self.load, self.level)
        rng = np.random.default_rng(self.seed)
        found = {"time": time}
        for n, v in clean.items():
            seen = v + self.noise * NOISE[n] * self.draw(rng, time.size)
            step = 0.0 if self.bits is None else RANGE[n] / 2**self.bits
            found[n] = np.asarray(step * np.round(seen / step) if step else seen)
        return found


NOISE = {"V": 2e-4, "theta": 3e-4, "f": 1e-3, "P": 0.15, "Q": 0.15, "I": 3e-3, "phi": 5e-4}
RANGE = {"V": 2.0, "theta": 2.0 * np.pi, "f": 20.0, "P": 800.0, "Q": 800.0, "I": 40.0, "phi": 2.0 * np.pi}


@cache
def _clean(
    voltage: Corners, frequency: Callable[[Array], Array], rate: float, length: float, load: float, level: float
) -> tuple[Array, dict[str, Array]]:
    """Return the course at the terminals, without noise."""
    parts = {
        "gen": UnitPart("genrou", {"Sn": MVA, "H": 3.4}),
        "avr": UnitPart("sexs", {"K": 160.0}),
        "gov": UnitPart("tgov1"),
    }
    card = unit_card(parts, R=0.004, X=0.1, f0=F0)
    seen = '[outputs]\nVr = {value = "line.Vr", unit = "pu"}\nVi = {value = "line.Vi", unit = "pu"}'
    card = card.replace("[inputs]", '[inputs]\nturn = {value = 0.0, unit = "rad", settable = false}')
    card = card.replace('"grid.theta" = "0"', '"grid.theta" = "turn"')
    model = parse_card(card.replace("[outputs]", seen))
    point = hi.find_operating_point(model, outputs={"P": load, "Vt": level}, free=["Pref", "Vref"])
    time = np.round(np.arange(0.0, length, 1.0 / rate), 6)
    fine = np.linspace(0.0, length, 4001)
    inputs: dict[str, InputSignal] = {}
    if voltage:
        inputs["E"] = InputSignal.corners(list(voltage))
    off = frequency(fine)
    if off.any():
        turn = np.concatenate([[0.0], np.cumsum(0.5 * (off[1:] + off[:-1]) * np.diff(fine))])
        inputs["turn"] = InputSignal(fine, 2.0 * np.pi * turn, np.array([]))
    run = hi.simulate(model.with_values(point.inputs), time, inputs=inputs)
    angle = np.unwrap(np.arctan2(run["Vi"], run["Vr"]))
    s = run["P"] + 1j * run["Q"]
    current = np.abs(s) / (np.sqrt(3.0) * KV * run["Vt"])
    f = F0 + np.gradient(angle, time) / (2.0 * np.pi)
    clean = {"V": run["Vt"], "theta": angle, "f": f, "P": run["P"], "Q": run["Q"], "I": current}
    return time, clean | {"phi": np.unwrap(angle - np.angle(s))}


Table = dict[str, Array]


def plain(c: Table) -> Table:
    """Columns as the model calls them: no units, pu and rad."""
    return {n: c[n] for n in ("time", "V", "theta", "P", "Q")}


def pmu(c: Table) -> Table:
    """Columns of a concentrator: kV, wrapped degrees, Hz."""
    return {
        "Time [s]": c["time"], "HOLMWOOD V1 Mag [kV]": KV * c["V"], "HOLMWOOD V1 Ang [deg]": wrapped(np.degrees(c["theta"]) + 100.0),
        "HOLMWOOD Freq [Hz]": c["f"], "HOLMWOOD P [MW]": c["P"], "HOLMWOOD Q [MVAR]": c["Q"],
    }  # fmt: skip


def full(c: Table) -> Table:
    """The same with the current."""
    return pmu(c) | {
        "HOLMWOOD I1 Mag [A]": 1e3 * c["I"],
        "HOLMWOOD I1 Ang [deg]": wrapped(np.degrees(c["phi"]) + 100.0),
    }


def meter(c: Table) -> Table:
    """Columns of a power meter, with the frequency in place of the angle."""
    return {"time": c["time"], "V [kV]": KV * c["V"], "f [Hz]": c["f"], "P [MW]": c["P"], "Q [Mvar]": c["Q"]}


def wrapped(degrees: Array) -> Array:
    """Return angles within half a turn."""
    return np.asarray((degrees + 180.0) % 360.0 - 180.0)


V, ANG, FREQ, P, Q, I = (
    "HOLMWOOD V1 Mag [kV]", "HOLMWOOD V1 Ang [deg]", "HOLMWOOD Freq [Hz]", "HOLMWOOD P [MW]", "HOLMWOOD Q [MVAR]", "HOLMWOOD I1 Mag [A]",
)  # fmt: skip


@dataclass(frozen=True)
class Record:
    """A record as a file. written: columns by their headers; edit: the rows of text, header first, as they are then spoilt or changed."""

    name: str
    seen: Seen = field(default_factory=Seen)
    written: Callable[[Table], Table] = plain
    edit: Callable[[list[list[str]]], list[list[str]]] = list
    said: tuple[str, ...] = ()
    """Expressions that one line has, each in upper or lower letters, where the record is wrong; for a sound record none."""

    def write(self, path: Path) -> None:
        """Write the file."""
        columns = self.written(self.seen.columns())
        digits = self.seen.digits
        rows = [
            [f"{v:.{max(digits, 9) if k == 0 else digits}g}" for k, v in enumerate(row)]
            for row in zip(*columns.values(), strict=True)
        ]
        path.write_text("\n".join(",".join(row) for row in self.edit([list(columns), *rows])) + "\n")


def changed(written: Callable[[Table], Table], **by: Callable[[Array], Array]) -> Callable[[Table], Table]:
    """Return how columns are written that were changed first."""
    return lambda c: written(c | {n: np.asarray(change(c[n])) for n, change in by.items()})


def put(
    column: str, rows: slice, change: Callable[[Array], Array], written: Callable[[Table], Table] = plain
) -> Callable[[Table], Table]:
    """Return how columns are written of which one is changed in some rows, in the file's unit."""

    def made(c: Table) -> Table:
        found = dict(written(c))
        values = found[column].copy()
        values[rows] = change(values[rows])
        return found | {column: values}

    return made


def exchanged(written: Callable[[Table], Table], one: str, other: str) -> Callable[[Table], Table]:
    """Return how columns are written of which two are exchanged."""

    def made(c: Table) -> Table:
        found = dict(written(c))
        return found | {one: found[other], other: found[one]}

    return made


def delayed(values: Array, rows: int) -> Array:
    """Return a column that comes some rows late; what was before it is as its first rows."""
    return np.asarray(np.concatenate([values[:rows], values[:-rows]]))


def cells(rows: slice, column: int, text: str) -> Callable[[list[list[str]]], list[list[str]]]:
    """Return an edit that writes a text into cells. rows: of data, from 0."""

    def edit(table: list[list[str]]) -> list[list[str]]:
        for row in table[1:][rows]:
            row[column] = text
        return table

    return edit


def lines(change: Callable[[list[list[str]]], list[list[str]]]) -> Callable[[list[list[str]]], list[list[str]]]:
    """Return an edit of the rows below the header."""
    return lambda table: [table[0], *change(table[1:])]


def times(change: Callable[[int, float], float]) -> Callable[[list[list[str]]], list[list[str]]]:
    """Return an edit of the instants. change: of the row's number and instant."""
    return lines(lambda rows: [[f"{change(k, float(r[0])):.9g}", *r[1:]] for k, r in enumerate(rows)])


def filled(rows: slice, *columns: str) -> Callable[[Table], Table]:
    """Return how columns are written whose rows are the line between their ends."""

    def made(c: Table) -> Table:
        found = dict(plain(c))
        for n in columns:
            v = found[n] = found[n].copy()
            v[rows] = np.linspace(v[rows.start], v[rows.stop - 1], rows.stop - rows.start)
        return found

    return made


def copied(to: slice, start: int) -> Callable[[Table], Table]:
    """Return how columns are written whose rows are earlier ones again."""

    def made(c: Table) -> Table:
        found = {n: v.copy() for n, v in pmu(c).items()}
        for n, v in list(found.items())[1:]:
            found[n][to] = v[start : start + to.stop - to.start]
        return found

    return made


def drifting(c: Table) -> Table:
    """Return columns whose angle loses its clock: it drifts from 1 s after the event on, which the frequency does not say."""
    return pmu(c | {"theta": c["theta"] + 1.5 * np.clip(c["time"] - EVENT - 1.0, 0.0, None)})


def wrong() -> list[Record]:
    """Return the records that are wrong."""
    rows = r"rows? \d"
    return [
        # units and bases
        Record(
            "powers in GW",
            written=changed(plain, P=lambda v: v / 1e3, Q=lambda v: v / 1e3),
            said=(r"\bP\b", "GW|unit|base|is not mapped"),
        ),
        Record("Q alone in kvar", written=changed(plain, Q=lambda v: v * 1e3), said=(r"\bQ\b", "in kvar")),
        Record(
            "powers of one phase",
            written=changed(plain, P=lambda v: v / 3, Q=lambda v: v / 3),
            said=(r"\bP\b", "phase"),
        ),
        Record(
            "powers of one phase, with the current",
            written=changed(full, P=lambda v: v / 3, Q=lambda v: v / 3),
            said=(r"\bP\b", r"\bI\b|current|phase"),
        ),
        Record(
            "peak of the voltage from line to line",
            written=changed(meter, V=lambda v: 2**0.5 * v),
            said=(r"\bV\b", "peak|base|amplitude|rests"),
        ),
        Record(
            "peak of the voltage of a phase",
            written=changed(meter, V=lambda v: (2 / 3) ** 0.5 * v),
            said=(r"\bV\b", "peak|base|amplitude|rests"),
        ),
        Record(
            "voltage of a phase in pu of the line's",
            written=changed(plain, V=lambda v: v / 3**0.5),
            said=(r"\bV\b", "phase|base|rests"),
        ),
        Record(
            "voltage in pu that says kV",
            written=changed(meter, V=lambda v: v / KV),
            said=(r"\bV\b", "pu|base|unit|rests"),
        ),
        Record(
            "voltage in percent",
            written=changed(plain, V=lambda v: 100 * v),
            said=(r"\bV\b", "percent|%|base|unit|rests"),
        ),
        Record(
            "frequency in rad/s that says Hz",
            written=changed(meter, f=lambda v: 2 * np.pi * v),
            said=(r"\bf\b", "rad/s|angular|unit|nominal"),
        ),
        Record("a network of 60 Hz", written=changed(meter, f=lambda v: 1.2 * v), said=("60", "Hz")),
        Record(
            "angle in degrees that says rad",
            written=lambda c: {
                ("theta [rad]" if n == "theta" else n): np.degrees(v) if n == "theta" else v
                for n, v in plain(c).items()
            },
            said=("theta", "degrees"),
        ),
        Record(
            "angle in rad that says degrees",
            written=lambda c: {("theta [deg]" if n == "theta" else n): v for n, v in plain(c).items()},
            said=("theta", "is in rad"),
        ),
        Record("angle in turns", written=changed(plain, theta=lambda v: v / (2 * np.pi)), said=("theta", "turns")),
        # signs and places
        Record("P alone with the other sign", written=changed(plain, P=lambda v: -v), said=(r"\bP\b", "sign")),
        Record("Q alone with the other sign", written=changed(plain, Q=lambda v: -v), said=(r"\bQ\b", "sign")),
        Record(
            "P and Q exchanged", written=exchanged(plain, "P", "Q"), said=(r"\bP\b.*\bQ\b", "exchanged|swapped|other")
        ),
        Record("V and I exchanged", written=exchanged(full, V, I), said=(r"\bV\b|V1 Mag", "base|unit|rests|current")),
        Record(
            "angle and frequency exchanged",
            written=exchanged(pmu, ANG, FREQ),
            said=("theta|Ang|Freq|f", "degrees|unit|disagree|nominal|is not mapped"),
        ),
        Record(
            "columns one place too far",
            edit=lines(lambda r: [[row[0], *row[2:], row[1]] for row in r]),
            said=(r"\bV\b", "base|unit|rests"),
        ),
        Record(
            "the angles of voltage and current exchanged",
            written=exchanged(full, ANG, "HOLMWOOD I1 Ang [deg]"),
            said=("theta|Ang|angles", "exchanged"),
        ),
        Record(
            "another unit's current",
            Seen(),
            lambda c: full(c | {"I": 0.3 * c["I"] ** 0 * 10.0 + 0.4 * c["I"]}),
            said=(r"\bP\b", "I1 Mag|current", "times what"),
        ),
        # time
        Record(
            "P and Q half a second late",
            written=changed(plain, P=lambda v: delayed(v, 25), Q=lambda v: delayed(v, 25)),
            said=(r"\bP\b", "later|late|shifted|apart"),
        ),
        Record(
            "the clock goes back by 0.4 s",
            edit=times(lambda k, t: t - 0.4 * (k >= 250)),
            said=(rows + r"|\bs\b", "time|clock|order"),
        ),
        Record("the clock jumps by 5 s", edit=times(lambda k, t: t + 5.0 * (k >= 250)), said=(rows, "clock jumped")),
        Record(
            "instants of whole seconds",
            edit=times(lambda _, t: float(int(t))),
            said=("time|instant", "same|twice|one|increase|apart|rows"),
        ),
        Record(
            "80 rows are there twice",
            edit=lines(lambda r: [*r[:200], *r[120:200], *r[200:]]),
            said=("row", "twice|again|order|repeat|drop|same|decrease|increase"),
        ),
        Record(
            "rows from the last to the first",
            edit=lines(lambda r: r[::-1]),
            said=("row|time", "order|sort|decreas|increas"),
        ),
        Record(
            "one second is missing after the event",
            edit=lines(lambda r: [*r[:130], *r[180:]]),
            said=(rows, "no rows|missing"),
        ),
        Record("the angle's clock drifts", written=drifting, said=("theta|Ang", "disagree|otherwise|steps|drift")),
        # rows
        Record(
            "the angle stands still",
            written=put("theta", slice(260, 400), lambda v: 0 * v + v[0]),
            said=(rows, "theta", "stands|stuck"),
        ),
        Record(
            "Q is zero in ten rows", written=put("Q", slice(300, 310), lambda v: 0 * v), said=(rows, r"\bQ\b", "zero")
        ),
        Record(
            "a mark of 32767 in the voltage",
            written=put("V", slice(250, 252), lambda v: 0 * v + 32767.0),
            said=(rows, r"\bV\b", "mark"),
        ),
        Record(
            "a spike of the voltage",
            written=put("V", slice(320, 321), lambda v: 1.3 * v),
            said=(rows, r"\bV\b", "spike"),
        ),
        Record(
            "P ten times in two rows",
            written=put(P, slice(60, 62), lambda v: 10 * v, pmu),
            said=(rows, r"\bP\b", "spike"),
        ),
        Record(
            "P meets the end of its range",
            written=changed(plain, P=lambda v: np.minimum(v, P0 + 4.0)),
            said=(rows, r"\bP\b", "range"),
        ),
        Record(
            "rows are a line in all columns",
            written=filled(slice(300, 340), "V", "theta", "P", "Q"),
            said=(rows, "line", "filled"),
        ),
        Record("a second is an earlier one again", written=copied(slice(330, 370), 260), said=(rows, "again")),
        Record(
            "the angle steps by 20 degrees",
            written=put(ANG, slice(300, None), lambda v: wrapped(v + 20.0), pmu),
            said=("row|theta|Ang", "step|disagree"),
        ),
        Record(
            "the angle's polarity turns",
            written=put("theta", slice(60, None), lambda v: v + np.pi),
            said=(rows, "theta", "steps"),
        ),
    ]


def t3(rng: np.random.Generator, n: int) -> Array:
    """Return noise with the tails of Student's t."""
    return np.asarray(rng.standard_t(3, n) / 3**0.5)


def red(rng: np.random.Generator, n: int) -> Array:
    """Return noise of first order."""
    white, out = rng.standard_normal(n), np.zeros(n)
    for k in range(1, n):
        out[k] = 0.8 * out[k - 1] + 0.6 * white[k]
    return out


def loss(t: Array) -> Array:
    """Return the frequency after a loss of generation."""
    since = np.clip(t - EVENT, 0.0, None)
    return np.asarray(-0.4 * (1.0 - np.exp(-since / 3.0) * np.cos(0.6 * since)))


def ramp(t: Array) -> Array:
    """Return a frequency that falls evenly for 5 s."""
    return np.asarray(-0.1 * np.clip(t - EVENT, 0.0, 5.0) / 5.0)


def swing(t: Array) -> Array:
    """Return a frequency that swings with another area."""
    since = np.clip(t - EVENT, 0.0, None)
    return np.asarray(0.05 * np.sin(2 * np.pi * 0.4 * since))


def held(c: Table) -> Table:
    """Return columns whose powers come at a fifth of the rate."""
    rows = 5 * (np.arange(c["time"].size) // 5)
    return plain(c | {"P": c["P"][rows], "Q": c["Q"][rows]})


def words(c: Table) -> Table:
    """Return columns with words for names."""
    return {"t": c["time"], "Voltage": c["V"], "Angle": c["theta"], "ActivePower": c["P"], "ReactivePower": c["Q"]}


def phasors(c: Table) -> Table:
    """Return columns with the names of a concentrator's phasors."""
    angles = {n: wrapped(np.degrees(c[of])) for n, of in (("VPA_deg", "theta"), ("IPA_deg", "phi"))}
    sizes = {"VPM_kV": KV * c["V"], "IPM_A": 1e3 * c["I"], "FREQ": c["f"], "MW": c["P"], "MVAR": c["Q"]}
    return {"time": c["time"], **angles, **sizes}


def volts(c: Table) -> Table:
    """Return columns in V, kW, kvar and ms."""
    powers = {"P [kW]": 1e3 * c["P"], "Q [kvar]": 1e3 * c["Q"]}
    return {"time [ms]": 1e3 * c["time"], "V [V]": 1e3 * KV * c["V"], "theta [rad]": c["theta"], **powers}


def stamped(rows: list[list[str]]) -> list[list[str]]:
    """Return rows with a date and a time of day for their instants."""
    for row in rows[1:]:
        s = float(row[0])
        row[0] = f"2026-03-04 09:{58 + int(s) // 60:02d}:{s % 60:09.6f}"
    return [["Timestamp", *rows[0][1:]], *rows[1:]]


def sound() -> list[Record]:
    """Return the sound records."""
    step: Corners = ((EVENT, 1.0), (EVENT, 0.97))
    deep: Corners = ((EVENT, 1.0), (EVENT + 0.12, 0.4), (EVENT + 0.15, 0.95))
    course = Seen(voltage=(), frequency=loss, length=30.0)
    return [
        Record("a fault, no units"),
        Record("a fault, a concentrator's", written=pmu),
        Record("a fault, with the current", written=full),
        Record("a fault, a meter's", written=meter),
        Record("without noise", Seen(noise=0.0, digits=12)),
        Record("little noise", Seen(noise=0.1)),
        Record("much noise", Seen(noise=10.0)),
        Record("noise of first order", Seen(draw=red)),
        Record("noise with tails", Seen(draw=t3)),
        Record("noise with tails, long", Seen(draw=t3, length=60.0, seed=5)),
        Record("8 bits", Seen(bits=8)),
        Record("12 bits", Seen(bits=12), pmu),
        Record("16 bits", Seen(bits=16), meter),
        Record("4 digits", Seen(digits=4)),
        Record("5 digits", Seen(digits=5), pmu),
        Record("6 digits", Seen(digits=6), full),
        Record("a step of the voltage", Seen(voltage=step)),
        Record("a deep fault", Seen(voltage=deep)),
        Record("a deep fault at 200 rows/s", Seen(voltage=deep, rate=200.0), pmu),
        Record("a small step", Seen(voltage=((EVENT, 1.0), (EVENT, 0.995)))),
        Record("a ramp of the voltage", Seen(voltage=((EVENT, 1.0), (EVENT + 2.0, 0.96)))),
        Record("a loss of generation", course, pmu),
        Record("a loss of generation, a meter's", course, meter),
        Record("a ramp of the frequency", Seen(voltage=(), frequency=ramp, length=15.0), pmu),
        Record("a swing of two areas", Seen(voltage=(), frequency=swing, length=15.0), full),
        Record("nothing happens", Seen(voltage=())),
        Record("10 rows/s", Seen(rate=10.0, length=20.0), pmu),
        Record("30 rows/s", Seen(rate=30.0), pmu),
        Record("60 rows/s", Seen(rate=60.0), phasors),
        Record("100 rows/s", Seen(rate=100.0), meter),
        Record("120 rows/s", Seen(rate=120.0), full),
        Record("200 rows/s", Seen(rate=200.0)),
        Record("names in words", written=words),
        Record("in volts, kW and ms", written=volts),
        Record("dates", Seen(seed=3), pmu, stamped),
        Record("powers at a fifth of the rate", written=held),
        Record("absorbing", Seen(level=0.96)),
        Record("a quarter of the load", Seen(load=80.0), full),
        Record("blank cells of an output", edit=cells(slice(150, 160), 3, "")),
        Record("one row is missing", edit=lines(lambda r: [*r[:170], *r[171:]])),
    ]


@dataclass(frozen=True)
class Answer:
    """The sentences that the user reads. good: nothing is refused and `check` says so."""

    text: str
    good: bool


def asked(record: Record, folder: Path) -> Answer:
    """Return what `new` and `check` say of a record."""
    folder.mkdir()
    (folder / "unit.dyr").write_text(DYR)
    (folder / "grid.raw").write_text(RAW)
    record.write(folder / "event.csv")
    try:
        new = new_unit_study(
            folder / "study", folder / "event.csv", UnitAsked(folder / "unit.dyr", 7, raw=folder / "grid.raw")
        )
        check = str(hi.check(new.path))
    except HvdcIdentError as e:
        return Answer(f"refused: {e}", good=False)
    return Answer(f"{new}\n{check}", "good" in check.splitlines()[0])


def found(record: Record, answer: Answer, beside: Answer) -> str:
    """Return the line that says what is wrong, "" where none does."""
    known = set(_sentences(beside))
    return next(
        (s for s in _sentences(answer) if s not in known and all(re.search(e, s, re.IGNORECASE) for e in record.said)),
        "",
    )


def _sentences(answer: Answer) -> list[str]:
    """Return what is said, each on one line: `new` breaks its lines, and a refusal has several."""
    if answer.text.startswith("refused"):
        return [" ".join(answer.text.split())]
    return re.sub(r"\n +", " ", answer.text).splitlines()


def main() -> None:
    """Print the table and the two counts."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", help="records with these words in their names")
    parser.add_argument("--text", action="store_true", help="print what was read too")
    options = parser.parse_args()
    begun, home = clock.process_time(), Path(tempfile.mkdtemp())
    of_wrong, of_sound = (
        [r for r in rs if not options.only or any(o in r.name for o in options.only)] for rs in (wrong(), sound())
    )
    said, nagged = 0, 0
    print("| wrong record | said | line |\n|---|---|---|")
    try:
        beside = {}
        for number, record in enumerate(of_wrong):
            key = "current" if "HOLMWOOD" in "".join(record.written(record.seen.columns())) else "plain"
            if key not in beside:
                beside[key] = asked(Record("", written=full if key == "current" else plain), home / key)
            answer = asked(record, home / f"wrong-{number}")
            line = found(record, answer, beside[key])
            said += bool(line)
            print(f"| {record.name} | {'yes' if line else 'NO'} | {line[:200]} |", flush=True)
            if options.text and (not line or options.only):
                print(answer.text)
        print("\n| sound record | nagged | line |\n|---|---|---|")
        for number, record in enumerate(of_sound):
            answer = asked(record, home / f"sound-{number}")
            nagged += not answer.good
            last = "" if answer.good else " ".join(answer.text.split("before a run:")[-1].split())[:300]
            print(f"| {record.name} | {'no' if answer.good else 'YES'} | {last} |", flush=True)
            if options.text and options.only:
                print(answer.text)
    finally:
        shutil.rmtree(home)
    spent = f"{clock.process_time() - begun:.0f} s of CPU"
    print(f"\nsaid: {said} of {len(of_wrong)} wrong records; nagged: {nagged} of {len(of_sound)} sound ones; {spent}")


if __name__ == "__main__":
    main()
