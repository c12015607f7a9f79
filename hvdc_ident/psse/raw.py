"""Power-flow data of PSS/E (.raw), versions 24 to 36: the system's bases, its buses and its machines.

Signs and units are PSS/E's: MW and Mvar, positive out of a machine; impedances of machines in pu of their own base (MBASE).
The sections between and after those of buses and machines are passed over. Source: PSS/E, Program Operation Manual, Power Flow Raw
Data File.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from hvdc_ident.errors import ModelError
from hvdc_ident.psse.free_format import BLANKS, ENCODING, SHOWN, content_of, items_of, start_of, tokens
from hvdc_ident.text import one_of

OLDEST: Final = 24
"""The first version that has the name of a bus in its second field, and its loads in a section of their own."""
NEWEST: Final = 36

_END = re.compile(rf"[{BLANKS}]*0[{BLANKS}]*,?[{BLANKS}]*(?:/.*)?|[{BLANKS}]*0[{BLANKS}]+[A-Za-z].*")
_END_OF = re.compile(r"(?i)END OF (.+?) DATA")
_BEGIN = re.compile(r"(?i)BEGIN (.+?) DATA")
_LINE_END = re.compile(r"\r\n|\n|\r")
_WRITTEN_BY = re.compile(r"(?i)PSS.{0,4}?E-(\d\d)")
"""Up to version 30 the version stands in the comment of the first line: `0, 100.00 / PSS/E-30.3`, `/ PSS(tm)E-30 RAW`."""


class Bus(NamedTuple):
    """A bus. base_kv: 0 where the file states none; kind: IDE, 1 load, 2 generator, 3 swing, 4 disconnected."""

    number: int
    name: str
    base_kv: float
    kind: int


class Generator(NamedTuple):
    """A machine, with the names that PSS/E gives its fields: pg in MW, qg in Mvar, mbase in MVA, zr, zx, rt, xt in pu of mbase.

    line: of the file, from 1.
    """

    bus: int
    id: str
    pg: float
    qg: float
    mbase: float
    zr: float
    zx: float
    rt: float
    xt: float
    gtap: float
    stat: int
    line: int


@dataclass(frozen=True)
class RawFile:
    """The machines of a .raw file and their buses. version: REV. sbase: MVA. frequency: Hz, None where the file states none."""

    path: str
    version: int
    sbase: float
    frequency: float | None
    buses: tuple[Bus, ...] = field(repr=False)
    generators: tuple[Generator, ...] = field(repr=False)

    def bus(self, number: int) -> Bus:
        """Return a bus by its number; ModelError where there is none."""
        bus = next((b for b in self.buses if b.number == number), None)
        if bus is None:
            raise ModelError(
                f"no bus {number}",
                where=self.path,
                expected=f"the bus {one_of([str(b.number) for b in self.buses], SHOWN)}",
            )
        return bus

    def generator(self, bus: int, machine: str | None = None) -> Generator:
        """Return the generator of a bus, by its id where there are several; ModelError, with those there are, where it is not one."""
        there = [g for g in self.generators if g.bus == bus]
        generators = [g for g in there if machine is None or g.id == machine.strip()]
        if len(generators) == 1:
            return generators[0]
        which = f"'{machine}' at bus {bus}" if machine is not None else f"of bus {bus}"
        if there:
            what = f"{len(generators)} generators {which}" if generators else f"no generator {which}"
            raise ModelError(what, where=self.path, expected=f"the id {one_of([g.id for g in there], SHOWN)}")
        buses = dict.fromkeys(str(g.bus) for g in self.generators)
        raise ModelError(f"no generator {which}", where=self.path, expected=f"the bus {one_of(list(buses), SHOWN)}")


@dataclass(frozen=True)
class _Line:
    """The fields of one line, with what an error says of it. number: of the line, from 1."""

    what: str
    path: str
    number: int
    fields: tuple[float | str | None, ...]

    @property
    def where(self) -> str:
        return f"{self.path}:{self.number}"

    def get(self, place: int) -> float | str | None:
        return self.fields[place] if place < len(self.fields) else None

    def real(self, place: int, name: str, default: float | None) -> float:
        value = self.get(place)
        if value is None:
            value = default
        if isinstance(value, float):
            return value
        raise ModelError(
            f"not a number where {name} of {self.what} is due",
            where=self.where,
            expected=f"a number in field {place + 1}",
            got="nothing" if value is None else f"'{value}'",
        )

    def integer(self, place: int, name: str, default: int | None) -> int:
        value = self.real(place, name, None if default is None else float(default))
        if value.is_integer():
            return int(value)
        raise ModelError(
            f"{name} of {self.what} is no integer",
            where=self.where,
            expected=f"an integer in field {place + 1}",
            got=f"{value:g}",
        )

    def text(self, place: int, default: str) -> str:
        value = self.get(place)
        if isinstance(value, float):
            return f"{value:g}"
        return default if value is None else value.strip()


def read_raw(path: str | Path) -> RawFile:
    """Return the buses and machines of a .raw file of the versions 24 to 36.

    ModelError, with file and line, for another version, a missing title, a text where a number is due, a machine at a bus that is not
    there, a file that is empty, no text, or no power-flow data.
    """
    where = str(path)
    text = content_of(Path(path)).decode(ENCODING)
    numbered = list(enumerate(_LINE_END.split(text[start_of(text) :]), 1))
    while numbered and (numbered[0][1].lstrip(BLANKS).startswith("@!") or not numbered[0][1].strip(BLANKS)):
        del numbered[0]
    first = _record(where, "the case", *numbered[0])
    if not all(isinstance(first.get(k), float) for k in range(2)):
        raise ModelError(
            "this does not begin as power-flow data",
            where=first.where,
            expected="IC, SBASE, REV, XFRRAT, NXFRAT, BASFRQ",
            got=f"'{numbered[0][1].strip()[:60]}'",
            hint="a .raw file that PSS/E wrote; read_dyr reads dynamic data",
        )
    version = _version(first, numbered[0][1])
    _check_titles(where, numbered[1:3])
    sections: dict[str, list[tuple[int, str]]] = {}
    for name, lines in _sections(numbered[3:], version):
        sections.setdefault(name, []).extend(lines)
    buses = tuple(_bus(_record(where, "a bus", *line)) for line in sections.get("BUS", ()))
    if not buses:
        raise ModelError("no buses", where=where, expected="bus data after the three lines of the case's title")
    number, sbase = _numbers(buses), first.real(1, "SBASE", 100.0)
    machines = (_record(where, "a generator", *line) for line in sections.get("GENERATOR", ()))
    frequency = first.real(5, "BASFRQ", 0.0)
    return RawFile(
        where, version, sbase, frequency or None, buses, tuple(_generator(r, number, version, sbase) for r in machines)
    )


def _version(first: _Line, line: str) -> int:
    """Return the version that the first line states: in field 3 (REV), or in the comment of those up to 30."""
    written = _WRITTEN_BY.search(line)
    stated = first.get(2)
    version = int(written[1]) if stated is None and written else first.integer(2, "REV", None)
    if OLDEST <= version <= NEWEST:
        return version
    raise ModelError(
        f"power-flow data of version {version}",
        where=first.where,
        expected=f"a version from {OLDEST} to {NEWEST} in field 3 (REV)",
        hint="export the case from PSS/E as version 33",
    )


def _check_titles(path: str, lines: Sequence[tuple[int, str]]) -> None:
    """Raise ModelError where a line of the title is the record of a bus: that bus would be lost, and the next ones read as titles."""
    for number, line in lines:
        try:
            pieces = _record(path, "the title", number, line).fields
        except ModelError:
            continue  # a title is any text: also one with a quote that does not end
        kinds = [type(v) for v in pieces[:4]]
        if kinds == [float, str, float, float] and pieces[3] in (1.0, 2.0, 3.0, 4.0):
            raise ModelError(
                "the record of a bus where the title of the case is due",
                where=f"{path}:{number}",
                expected="two lines of title, which may be empty, after the first line",
                got=f"'{line.strip()[:60]}'",
                hint="put the two lines in; PSS/E takes the second and third line as the title, whatever they hold",
            )


def _order(version: int) -> list[str]:
    """Return the sections up to the last one that is read, in the order of the version."""
    wide = ["SYSTEM-WIDE"] if version >= 34 else []
    shunts = ["FIXED SHUNT"] if version >= 31 else []
    droop = ["VOLTAGE DROOP CONTROL"] if version >= 36 else []
    return [*wide, "BUS", "LOAD", *shunts, *droop, "GENERATOR"]


def _sections(lines: Sequence[tuple[int, str]], version: int) -> Iterator[tuple[str, list[tuple[int, str]]]]:
    """Yield the name of each section and its lines with their numbers, without comments and blank lines.

    A section is called what the line at its end says (`0 / END OF BUS DATA`), else what the line before it says (`BEGIN LOAD DATA`), else
    by the order of the version; the system-wide data of files since 34 are words, and some files lack them.
    """
    order = _order(version)
    expected, inside = order[0], list[tuple[int, str]]()
    for number, line in lines:
        bare = line.strip(BLANKS)
        if bare.upper() == "Q":
            break
        if not bare or bare.startswith(("@!", "//")):
            continue
        if not _END.fullmatch(line):
            if expected == "SYSTEM-WIDE" and not inside and not bare[0].isalpha():
                expected = "BUS"
            inside.append((number, line))
            continue
        end, begin = _END_OF.search(line), _BEGIN.search(line)
        name = _canonical(end[1]) if end else expected
        yield name, inside
        after = order.index(name) + 1 if name in order else len(order)
        expected = _canonical(begin[1]) if begin else order[after] if after < len(order) else ""
        inside = []
    yield expected, inside


def _canonical(name: str) -> str:
    return " ".join(name.upper().split()).replace("SYSTEM WIDE", "SYSTEM-WIDE")


def _record(path: str, what: str, number: int, line: str) -> _Line:
    pieces = []
    for piece in tokens(line, 0):
        if piece.kind == "slash":
            break
        pieces.append(piece)
    return _Line(what, path, number, tuple(item.value for item in items_of(pieces, f"{path}:{number}")))


def _bus(r: _Line) -> Bus:
    return Bus(r.integer(0, "I", None), r.text(1, ""), r.real(2, "BASKV", 0.0), r.integer(3, "IDE", 1))


Number = Callable[[_Line, int], int]


def _numbers(buses: Sequence[Bus]) -> Number:
    """Return what finds the number of the bus that a field names: by its number, its name, or its name and base voltage."""
    known = {b.number for b in buses}
    named: dict[str, list[int]] = {}
    for b in buses:
        for name in (b.name, f"{b.name:<12}{b.base_kv:g}"):
            named.setdefault(_squeezed(name), []).append(b.number)

    def number(r: _Line, place: int) -> int:
        value = r.get(place)
        if isinstance(value, str):
            squeezed = _squeezed(value)
            numbers = named.get(squeezed) or named.get(_without_zeros(squeezed), [])
            if len(numbers) == 1:
                return numbers[0]
            raise ModelError(
                f"{len(numbers) or 'no'} buses with the name '{value.strip()}'",
                where=r.where,
                expected="one bus with this name (and base voltage in kV)",
            )
        found_number = r.integer(place, "I", None)
        if found_number not in known:
            raise ModelError(
                f"{r.what} at bus {found_number}, which is not there",
                where=r.where,
                expected=f"the bus {one_of([str(n) for n in known], SHOWN)}",
            )
        return found_number

    return number


def _squeezed(name: str) -> str:
    return " ".join(name.split())


def _without_zeros(name: str) -> str:
    """Return a name whose base voltage has no zeros at its end: 345.000 is 345."""
    head, _, tail = name.rpartition(" ")
    return f"{head} {float(tail):g}" if re.fullmatch(r"\d+\.\d*", tail) else name


def _generator(r: _Line, number: Number, version: int, sbase: float) -> Generator:
    """Return a machine; what its line leaves out has PSS/E's default."""
    # The regulated bus (IREG) takes field 8, since version 35 with its node (NREG) in field 9.
    start = 9 if version >= 35 else 8
    return Generator(
        bus=number(r, 0),
        id=r.text(1, "1"),
        pg=r.real(2, "PG", 0.0),
        qg=r.real(3, "QG", 0.0),
        mbase=r.real(start, "MBASE", sbase),
        zr=r.real(start + 1, "ZR", 0.0),
        zx=r.real(start + 2, "ZX", 1.0),
        rt=r.real(start + 3, "RT", 0.0),
        xt=r.real(start + 4, "XT", 0.0),
        gtap=r.real(start + 5, "GTAP", 1.0),
        stat=r.integer(start + 6, "STAT", 1),
        line=r.number,
    )
