"""Power-flow data of PSS/E (.raw), versions 32 to 36: buses, loads, generators, branches, transformers with two windings.

Signs and units are PSS/E's: MW and Mvar, positive out of a generator and into a load; voltages in pu of the bus's base, angles in
degrees; impedances of branches in pu of the system base (SBASE), of machines in pu of their own (MBASE), of transformers as CZ says.
Source: PSS/E, Program Operation Manual, Power Flow Raw Data File.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from hvdc_ident.errors import ModelError
from hvdc_ident.psse.free_format import BLANKS, ENCODING, SHOWN, content_of, items_of, start_of, tokens
from hvdc_ident.text import one_of

VERSIONS: Final = (32, 33, 34, 35, 36)

_BEFORE_GENERATORS = {36: ["VOLTAGE DROOP CONTROL"]}
_BEFORE_BRANCHES = {36: ["SWITCHING DEVICE RATING SET"]}

# The places of the fields that are read, in each version.
_BUS = {"name": 1, "base_kv": 2, "kind": 3, "vm": 7, "va": 8}
_LOAD = {"id": 1, "status": 2, "p": 5, "q": 6, "ip": 7, "iq": 8, "yp": 9, "yq": 10}
_GENERATOR = {"id": 1, "pg": 2, "qg": 3, "qt": 4, "qb": 5, "vs": 6}
_AFTER_REGULATED = ("mbase", "zr", "zx", "rt", "xt", "gtap", "stat", "rmpct", "pt", "pb")
_BRANCH = {"circuit": 2, "r": 3, "x": 4, "b": 5}
_STATUS_OF_BRANCH = {32: 13, 33: 13, 34: 23, 35: 23, 36: 23}  # 12 ratings and a name since 34, 3 ratings before
_TRANSFORMER = {"circuit": 3, "cw": 4, "cz": 5, "cm": 6, "mag1": 7, "mag2": 8, "name": 10, "status": 11}

_END = re.compile(rf"[{BLANKS}]*0[{BLANKS}]*,?[{BLANKS}]*(?:/.*)?|[{BLANKS}]*0[{BLANKS}]+[A-Za-z].*")
_END_OF = re.compile(r"(?i)END OF (.+?) DATA")
_BEGIN = re.compile(r"(?i)BEGIN (.+?) DATA")
_LINE_END = re.compile(r"\r\n|\n|\r")


class Bus(NamedTuple):
    """A bus. kind: 1 load, 2 generator, 3 swing, 4 disconnected; vm in pu of base_kv, va in degrees."""

    number: int
    name: str
    base_kv: float
    kind: int
    vm: float
    va: float


class Load(NamedTuple):
    """A load, into which p + j q flows: MW and Mvar; of constant current (ip, iq) and admittance (yp, yq) at 1 pu of voltage."""

    bus: int
    id: str
    status: int
    p: float
    q: float
    ip: float
    iq: float
    yp: float
    yq: float


class Generator(NamedTuple):
    """A machine: pg, qg and their limits in MW and Mvar; vs in pu; zr, zx, rt, xt in pu of mbase (MVA)."""

    bus: int
    id: str
    pg: float
    qg: float
    qt: float
    qb: float
    vs: float
    mbase: float
    zr: float
    zx: float
    rt: float
    xt: float
    gtap: float
    stat: int
    pt: float
    pb: float


class Branch(NamedTuple):
    """A line between two buses: r, x, and the charging b of the whole line, in pu of the system base."""

    from_bus: int
    to_bus: int
    circuit: str
    r: float
    x: float
    b: float
    status: int


class Transformer(NamedTuple):
    """A transformer with two windings, with the names that PSS/E gives its fields.

    cz: 1 for r12, x12 in pu of the system base, 2 of sbase12 (MVA), 3 for r12 in W and x12 the absolute impedance in pu of sbase12.
    cw: 1 for windv in pu of the bus's base voltage, 2 in kV, 3 in pu of nomv; nomv in kV, 0 for the bus's base voltage.
    """

    from_bus: int
    to_bus: int
    circuit: str
    cw: int
    cz: int
    cm: int
    mag1: float
    mag2: float
    name: str
    status: int
    r12: float
    x12: float
    sbase12: float
    windv1: float
    nomv1: float
    ang1: float
    windv2: float
    nomv2: float


@dataclass(frozen=True)
class RawFile:
    """The network of a .raw file."""

    path: str
    version: int
    sbase: float
    """MVA."""
    frequency: float
    """Hz."""
    titles: tuple[str, ...]
    buses: tuple[Bus, ...] = field(repr=False)
    loads: tuple[Load, ...] = field(repr=False)
    generators: tuple[Generator, ...] = field(repr=False)
    branches: tuple[Branch, ...] = field(repr=False)
    transformers: tuple[Transformer, ...] = field(repr=False)
    three_winding: tuple[tuple[int, int, int, str], ...] = field(repr=False)
    """Transformers with three windings, which are not read further: their buses and circuit."""

    def bus(self, number: int) -> Bus:
        """Return a bus by its number; ModelError where there is none."""
        found = next((b for b in self.buses if b.number == number), None)
        if found is None:
            raise ModelError(
                f"no bus {number}",
                where=self.path,
                expected=f"the bus {one_of([str(b.number) for b in self.buses], SHOWN)}",
            )
        return found

    def generator(self, bus: int, machine: str | None = None) -> Generator:
        """Return the generator of a bus, by its id where there are several; ModelError, with those there are, where it is not one."""
        there = [g for g in self.generators if g.bus == bus]
        found = [g for g in there if machine is None or g.id == machine.strip()]
        if len(found) == 1:
            return found[0]
        which = f"'{machine}' at bus {bus}" if machine is not None else f"of bus {bus}"
        if there:
            what = f"{len(found)} generators {which}" if found else f"no generator {which}"
            raise ModelError(what, where=self.path, expected=f"the id {one_of([g.id for g in there], SHOWN)}")
        buses = dict.fromkeys(str(g.bus) for g in self.generators)
        raise ModelError(f"no generator {which}", where=self.path, expected=f"the bus {one_of(list(buses), SHOWN)}")


class _Section(NamedTuple):
    name: str
    lines: list[tuple[int, str]]
    """With the number of each line."""


@dataclass(frozen=True)
class _Line:
    """The fields of one line, with what an error says of it."""

    what: str
    where: str
    fields: tuple[float | str | None, ...]

    def get(self, place: int) -> float | str | None:
        return self.fields[place] if place < len(self.fields) else None

    def number(self, place: int, name: str, default: float | None) -> float:
        value = self.get(place)
        if value is None:
            value = default
        if isinstance(value, float):
            return value
        raise ModelError(
            f"not a number where {name.upper()} of {self.what} is due",
            where=self.where,
            expected=f"a number in field {place + 1}",
            got="nothing" if value is None else f"'{value}'",
        )

    def integer(self, place: int, name: str, default: int | None) -> int:
        value = self.number(place, name, None if default is None else float(default))
        if value.is_integer():
            return int(value)
        raise ModelError(f"{name.upper()} of {self.what} is no integer", where=self.where, got=f"{value:g}")

    def text(self, place: int, default: str) -> str:
        value = self.get(place)
        if isinstance(value, float):
            return f"{value:g}"
        return default if value is None else value.strip()


def read_raw(path: str | Path) -> RawFile:
    """Return the power-flow data of a .raw file of the versions 32 to 36.

    ModelError, with file and line, for another version, a text where a number is due, a bus that is not there, a transformer that
    lacks lines, a file that is empty, no text, or no power-flow data.
    """
    where = str(path)
    text = content_of(Path(path)).decode(ENCODING)
    numbered = list(enumerate(_LINE_END.split(text[start_of(text) :]), 1))
    while numbered and (numbered[0][1].lstrip(BLANKS).startswith("@!") or not numbered[0][1].strip(BLANKS)):
        del numbered[0]
    first = _record(where, "the case", *numbered[0])
    identification = [first.get(k) for k in range(3)]
    if not all(isinstance(v, float) for v in identification):
        raise ModelError(
            "this does not begin as power-flow data",
            where=first.where,
            expected="IC, SBASE, REV, XFRRAT, NXFRAT, BASFRQ",
            got=f"'{numbered[0][1].strip()[:60]}'",
            hint="a .raw file that PSS/E wrote; read_dyr reads dynamic data",
        )
    version = first.integer(2, "rev", None)
    if version not in VERSIONS:
        raise ModelError(
            f"power-flow data of version {version}",
            where=first.where,
            expected=f"a version from {VERSIONS[0]} to {VERSIONS[-1]} in field 3 (REV)",
            hint="export the case from PSS/E as version 33",
        )
    sbase = first.number(1, "sbase", 100.0)
    sections: dict[str, list[tuple[int, str]]] = {}
    for section in _sections(numbered[3:], version):
        sections.setdefault(section.name, []).extend(section.lines)

    def records(name: str, what: str) -> Iterator[_Line]:
        return (_record(where, what, *line) for line in sections.get(name, ()))

    buses = tuple(_bus(r) for r in records("BUS", "a bus"))
    if not buses:
        raise ModelError("no buses", where=where, expected="bus data after the three lines of the case's title")
    number = _numbers(buses)
    two, three = _transformers(sections.get("TRANSFORMER", []), where, number, sbase)
    return RawFile(
        path=where,
        version=version,
        sbase=sbase,
        frequency=first.number(5, "basfrq", 60.0),
        titles=tuple(line.strip() for _, line in numbered[1:3]),
        buses=buses,
        loads=tuple(_load(r, number) for r in records("LOAD", "a load")),
        generators=tuple(_generator(r, number, version, sbase) for r in records("GENERATOR", "a generator")),
        branches=tuple(_branch(r, number, version) for r in records("BRANCH", "a branch")),
        transformers=tuple(two),
        three_winding=tuple(three),
    )


def _order(version: int) -> list[str]:
    """Return the sections up to the last one that is read, in the order of the version."""
    wide = ["SYSTEM-WIDE"] if version >= 34 else []
    switching = ["SYSTEM SWITCHING DEVICE"] if version >= 34 else []
    generators = [*_BEFORE_GENERATORS.get(version, []), "GENERATOR", *_BEFORE_BRANCHES.get(version, [])]
    return [*wide, "BUS", "LOAD", "FIXED SHUNT", *generators, "BRANCH", *switching, "TRANSFORMER", "AREA"]


def _sections(lines: Sequence[tuple[int, str]], version: int) -> Iterator[_Section]:
    """Yield the sections, without comments and blank lines.

    A section is called what the line at its end says (`0 / END OF BUS DATA`), else what the line before it says (`BEGIN LOAD DATA`), else
    by the order of the version.
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
            inside.append((number, line))
            continue
        end, begin = _END_OF.search(line), _BEGIN.search(line)
        name = _canonical(end[1]) if end else expected
        yield _Section(name, inside)
        after = order.index(name) + 1 if name in order else len(order)
        expected = _canonical(begin[1]) if begin else order[after] if after < len(order) else ""
        inside = []
    yield _Section(expected, inside)


def _canonical(name: str) -> str:
    words = " ".join(name.upper().split())
    return {"NON-TRANSFORMER BRANCH": "BRANCH", "AC LINE": "BRANCH", "SYSTEM WIDE": "SYSTEM-WIDE"}.get(words, words)


def _record(path: str, what: str, number: int, line: str) -> _Line:
    where = f"{path}:{number}"
    pieces = []
    for piece in tokens(line, 0):
        if piece.kind == "slash":
            break
        pieces.append(piece)
    return _Line(what, where, tuple(item.value for item in items_of(pieces, where)))


def _bus(r: _Line) -> Bus:
    return Bus(
        r.integer(0, "i", None),
        r.text(_BUS["name"], ""),
        r.number(_BUS["base_kv"], "baskv", 0.0),
        r.integer(_BUS["kind"], "ide", 1),
        r.number(_BUS["vm"], "vm", 1.0),
        r.number(_BUS["va"], "va", 0.0),
    )


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
            found = named.get(squeezed) or named.get(_without_zeros(squeezed), [])
            if len(found) == 1:
                return found[0]
            raise ModelError(
                f"{len(found) or 'no'} buses with the name '{value.strip()}'",
                where=r.where,
                expected="one bus with this name (and base voltage in kV)",
            )
        found_number = abs(r.integer(place, "i", None))  # a minus sign says where the line is metered
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


def _load(r: _Line, number: Number) -> Load:
    powers = [r.number(_LOAD[name], name, 0.0) for name in ("p", "q", "ip", "iq", "yp", "yq")]
    return Load(number(r, 0), r.text(_LOAD["id"], "1"), r.integer(_LOAD["status"], "status", 1), *powers)


def _generator(r: _Line, number: Number, version: int, sbase: float) -> Generator:
    # The regulated bus (IREG) takes field 8, since version 35 with its node (NREG) in field 9.
    start = 9 if version >= 35 else 8
    places: Mapping[str, int] = _GENERATOR | {name: start + k for k, name in enumerate(_AFTER_REGULATED)}

    def get(name: str, default: float) -> float:
        return r.number(places[name], name, default)

    return Generator(
        bus=number(r, 0),
        id=r.text(places["id"], "1"),
        pg=get("pg", 0.0),
        qg=get("qg", 0.0),
        qt=get("qt", 9999.0),
        qb=get("qb", -9999.0),
        vs=get("vs", 1.0),
        mbase=get("mbase", sbase),
        zr=get("zr", 0.0),
        zx=get("zx", 1.0),
        rt=get("rt", 0.0),
        xt=get("xt", 0.0),
        gtap=get("gtap", 1.0),
        stat=r.integer(places["stat"], "stat", 1),
        pt=get("pt", 9999.0),
        pb=get("pb", -9999.0),
    )


def _branch(r: _Line, number: Number, version: int) -> Branch:
    return Branch(
        number(r, 0),
        number(r, 1),
        r.text(_BRANCH["circuit"], "1"),
        r.number(_BRANCH["r"], "r", 0.0),
        r.number(_BRANCH["x"], "x", None),
        r.number(_BRANCH["b"], "b", 0.0),
        r.integer(_STATUS_OF_BRANCH[version], "st", 1),
    )


def _transformers(
    lines: Sequence[tuple[int, str]], path: str, number: Number, sbase: float
) -> tuple[list[Transformer], list[tuple[int, int, int, str]]]:
    """Return the transformers with two windings, of four lines each, and the buses of those with three, of five."""
    two: list[Transformer] = []
    three: list[tuple[int, int, int, str]] = []
    place = 0
    while place < len(lines):
        first = _record(path, "a transformer", *lines[place])
        windings = 3 if first.get(2) not in (None, 0.0) else 2
        count = windings + 2
        if place + count > len(lines):
            raise ModelError(
                "a transformer without its end",
                where=first.where,
                expected=f"{count} lines for {windings} windings",
                got=f"{len(lines) - place}",
            )
        if windings == 3:
            three.append(
                (number(first, 0), number(first, 1), number(first, 2), first.text(_TRANSFORMER["circuit"], "1"))
            )
        else:
            rest = [_record(path, "a transformer", *line) for line in lines[place + 1 : place + count]]
            two.append(_two_windings(first, rest, number, sbase))
        place += count
    return two, three


def _two_windings(first: _Line, rest: Sequence[_Line], number: Number, sbase: float) -> Transformer:
    impedance, one, other = rest
    cw = first.integer(_TRANSFORMER["cw"], "cw", 1)
    nominal = None if cw == 2 else 1.0  # in kV there is no default but the bus's base voltage, which the file then says
    return Transformer(
        from_bus=number(first, 0),
        to_bus=number(first, 1),
        circuit=first.text(_TRANSFORMER["circuit"], "1"),
        cw=cw,
        cz=first.integer(_TRANSFORMER["cz"], "cz", 1),
        cm=first.integer(_TRANSFORMER["cm"], "cm", 1),
        mag1=first.number(_TRANSFORMER["mag1"], "mag1", 0.0),
        mag2=first.number(_TRANSFORMER["mag2"], "mag2", 0.0),
        name=first.text(_TRANSFORMER["name"], ""),
        status=first.integer(_TRANSFORMER["status"], "stat", 1),
        r12=impedance.number(0, "r1-2", 0.0),
        x12=impedance.number(1, "x1-2", None),
        sbase12=impedance.number(2, "sbase1-2", sbase),
        windv1=one.number(0, "windv1", nominal),
        nomv1=one.number(1, "nomv1", 0.0),
        ang1=one.number(2, "ang1", 0.0),
        windv2=other.number(0, "windv2", nominal),
        nomv2=other.number(1, "nomv2", 0.0),
    )
