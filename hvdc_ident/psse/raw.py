"""Power flow of PSS/E (.raw), versions 32 to 36: the base, the buses and the generators, which a unit needs.

Sections end with a line that begins with 0 (and Q ends the file); buses come first, then loads, fixed shunts and generators, from version
34 on behind system-wide data. Lines that begin with @! are comments; names stand in quotes, which may hold commas and slashes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hvdc_ident.errors import ModelError
from hvdc_ident.text import listed

_FIELD = re.compile(r"""\s*('[^']*'|"[^"]*"|[^,/'"]*)\s*(?:,|$|(?=/))""")
VERSIONS = range(30, 37)
BEFORE_GENERATORS = 3
"""Sections from the buses on that stand before the generators: buses, loads, fixed shunts."""


@dataclass(frozen=True)
class RawBus:
    """A bus. base: kV; voltage: pu; angle: degrees, as solved."""

    number: int
    name: str
    base: float
    voltage: float
    angle: float


@dataclass(frozen=True)
class RawGenerator:
    """A generator. bus; machine: its identifier; active, reactive: MW and Mvar; base: MVA (MBASE); resistance, reactance: pu of it."""

    bus: int
    machine: str
    active: float
    reactive: float
    base: float
    resistance: float
    reactance: float


@dataclass(frozen=True)
class RawFile:
    """What a unit needs of a power flow. base: MVA of the system; frequency: Hz; version: of the format."""

    path: Path
    base: float
    frequency: float
    version: int
    buses: tuple[RawBus, ...]
    generators: tuple[RawGenerator, ...]

    def generator(self, bus: int, machine: str | None = None) -> RawGenerator:
        """Return a generator. Raises ModelError where there is none, or several at the bus and no machine is named."""
        here = [g for g in self.generators if g.bus == bus and machine in (None, g.machine)]
        if len(here) != 1:
            known = [f"{g.bus} '{g.machine}'" for g in self.generators if not here or g.bus == bus]
            raise ModelError(
                f"{'no' if not here else 'several'} generators at bus {bus}{f' of machine {machine}' if machine else ''}",
                where=str(self.path),
                expected=f"one of {listed(known[:20])}",
            )
        return here[0]


def read_raw(path: str | Path) -> RawFile:
    """Return the base, buses and generators of a .raw file. Raises ModelError for a file or a line that cannot be read."""
    path = Path(path)
    try:
        text = path.read_bytes().decode("latin-1").removeprefix("\xef\xbb\xbf")
    except OSError as e:
        raise ModelError(f"the .raw file cannot be read: {(e.strerror or '').lower()}", where=str(path)) from None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if not line.lstrip().startswith("@!")]
    if len(lines) < 4:
        raise ModelError("this is no .raw file", where=str(path), expected="three lines of heading, then buses")
    head = _fields(lines[0][1])
    base, version = _number(head, 1, 100.0, path, 1), int(_number(head, 2, 0.0, path, 1))
    if version not in VERSIONS:
        raise ModelError(
            "this version of .raw is not read",
            where=f"{path}, line 1",
            expected=f"{VERSIONS[0]} to {VERSIONS[-1]}",
            got=str(version),
        )
    frequency = _number(head, 5, 60.0, path, 1)
    sections = list(_sections(lines[3:]))
    first = 1 if version >= 34 else 0
    if len(sections) <= first + BEFORE_GENERATORS:
        raise ModelError(
            "the .raw file ends before its generators", where=str(path), expected="sections that end with 0"
        )
    buses = tuple(_bus(f, path, n) for n, f in sections[first])
    generators = tuple(_generator(f, path, n) for n, f in sections[first + BEFORE_GENERATORS])
    return RawFile(path, base, frequency or 60.0, version, buses, generators)


def _sections(lines: Sequence[tuple[int, str]]) -> Iterator[list[tuple[int, list[str]]]]:
    """Yield the lines of each section as fields, with their numbers."""
    section: list[tuple[int, list[str]]] = []
    for n, line in lines:
        fields = _fields(line)
        if fields[0] in ("0", "Q"):
            yield section
            section = []
            if fields[0] == "Q":
                return
        elif any(fields):
            section.append((n, fields))
    if section:
        yield section


def _fields(line: str) -> list[str]:
    found, at = [], 0
    while at <= len(line):
        match = _FIELD.match(line, at)
        if match is None:
            break
        found.append(match[1].strip().strip("'\"").strip())
        if match.end() >= len(line) or line[match.end()] == "/" or match.end() == at:
            break
        at = match.end()
    if len(found) == 1 and " " in found[0]:  # a heading or an end of section in free format
        found = found[0].split()
    return found or [""]


def _number(fields: Sequence[str], k: int, default: float, path: Path, line: int) -> float:
    text = fields[k] if k < len(fields) else ""
    if not text:
        return default
    try:
        return float(text.replace("D", "E").replace("d", "e"))
    except ValueError:
        raise ModelError(
            f"field {k + 1} is no number", where=f"{path}, line {line}", expected="a number", got=repr(text[:40])
        ) from None


def _bus(f: Sequence[str], path: Path, line: int) -> RawBus:
    name = f[1] if len(f) > 1 else ""
    number = int(_number(f, 0, 0.0, path, line))
    return RawBus(
        number, name, _number(f, 2, 0.0, path, line), _number(f, 7, 1.0, path, line), _number(f, 8, 0.0, path, line)
    )


def _generator(f: Sequence[str], path: Path, line: int) -> RawGenerator:
    return RawGenerator(
        bus=int(_number(f, 0, 0.0, path, line)),
        machine=f[1] if len(f) > 1 and f[1] else "1",
        active=_number(f, 2, 0.0, path, line),
        reactive=_number(f, 3, 0.0, path, line),
        base=_number(f, 8, 100.0, path, line),
        resistance=_number(f, 9, 0.0, path, line),
        reactance=_number(f, 10, 1.0, path, line),
    )
