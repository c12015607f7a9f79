"""Dynamic data of PSS/E (.dyr): `bus 'MODEL' id value value ... /`, read, and written back to the byte.

A record may take several lines. Anything after its `/` on the line is a comment, and so is a line that begins with `//` or `@!`, or,
between records, with `/`. A record of a user-written model, `bus 'USRMDL' id 'NAME' IC IT NI NC NS NV value ... /`, is a record of the
model NAME. The events that ANDES adds to such files stay in the text and are no records. Source: PSS/E, Program Operation Manual, DYRE.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hvdc_ident.errors import ModelError
from hvdc_ident.files import write_bytes
from hvdc_ident.psse.free_format import (
    BLANKS,
    ENCODING,
    SHOWN,
    Item,
    Word,
    content_of,
    items_of,
    number_text,
    start_of,
    tokens,
)
from hvdc_ident.text import one_of

Value = float | str | None

_NAME = re.compile(
    r"[A-Za-z][\w.$+-]{2,}"
)  # of a model; what circuits and machines are called has two characters at most
_COMMENT = re.compile(rf"[{BLANKS}]*(?://|@!)[^\r\n]*")
_COMMENT_BETWEEN = re.compile(rf"[{BLANKS}]*(?:/|@!)[^\r\n]*")
_REST = re.compile(r"[^\r\n]*")
_LINE_END = re.compile(r"\r\n|\n|\r")
_B = f"[{BLANKS}]*"
_RAW = re.compile(
    rf"(?i)^{_B}0{_B}/?{_B}END OF BUS DATA|\A{_B}(?:@!{_B}IC|0{_B},{_B}[\d.]+{_B},{_B}\d\d\b)",
    re.MULTILINE,
)
_EVENTS = {
    "TOGGLE",
    "FAULT",
    "ALTER",
}  # of ANDES, which writes them as `Line 'Toggle' Line_1 1.0 /`: of no bus, of no model
_FORM = "bus 'MODEL' id value value ... /"


@dataclass(frozen=True)
class UserModel:
    """The integers of a record of a user-written model, as PSS/E names them."""

    ic: int
    """What kind of model it is: 101 a generator, 104 an exciter, ..."""
    it: int
    icons: int
    """NI: how many of the values that follow are integers (ICONs)."""
    constants: int
    """NC: how many of the values after those are constants (CONs)."""
    states: int
    variables: int


@dataclass(frozen=True)
class DyrRecord:
    """One record of dynamic data."""

    number: int
    """The place among the records of the file, from 0."""
    bus: int
    model: str
    """In upper case, without quotes; of a user-written model that model's name."""
    machine: str
    """The machine's id, without quotes and blanks; empty where a user-written model has none."""
    values: tuple[Value, ...]
    """What follows; None where two commas leave a value at its default."""
    line: int
    """The line that the record begins at, from 1."""
    spans: tuple[tuple[int, int], ...] = field(repr=False)
    """The first byte of each value in the file, and the one after its last."""
    user: UserModel | None = None
    """Of a user-written model only."""


@dataclass(frozen=True)
class DyrFile:
    """A file of dynamic data: its bytes, and the records in them."""

    path: str
    content: bytes = field(repr=False)
    records: tuple[DyrRecord, ...]

    def at(self, bus: int, machine: str | None = None) -> tuple[DyrRecord, ...]:
        """Return the records of a bus, of all its machines or of one id; ModelError, with those there are, where there is none."""
        records = tuple(r for r in self.records if r.bus == bus and (machine is None or r.machine == machine.strip()))
        if records:
            return records
        ids = list(dict.fromkeys(r.machine for r in self.records if r.bus == bus))
        buses = list(dict.fromkeys(str(r.bus) for r in self.records))
        if ids:
            raise ModelError(
                f"no record of machine '{machine}' at bus {bus}",
                where=self.path,
                expected=f"the id {one_of(ids, SHOWN)}",
            )
        raise ModelError(f"no record of bus {bus}", where=self.path, expected=f"the bus {one_of(buses, SHOWN)}")

    def with_values(self, record: DyrRecord, values: Mapping[int, float | str]) -> DyrFile:
        """Return the file with some values of a record changed, by their index, and every other byte as it was.

        record: of this file, or of the one that this file is a changed copy of. A number has as few digits as give the same double,
        and a decimal point; a Python int that replaces an integer has none. A value that is the same already keeps its bytes.
        ModelError for an index that the record does not have, a number that is not finite, and a text that a record cannot hold.
        """
        mine = self.records[record.number] if record.number < len(self.records) else None
        if mine is None or (mine.bus, mine.model, mine.machine) != (record.bus, record.model, record.machine):
            raise ModelError(f"no {record.model} of bus {record.bus} in this place of the file", where=self.path)
        where = f"{self.path}:{mine.line}"
        for index in values:
            if not 0 <= index < len(mine.values):
                raise ModelError(
                    f"{mine.model} of bus {mine.bus} has no value {index}",
                    where=where,
                    expected=f"an index from 0 to {len(mine.values) - 1}",
                )
        places: dict[tuple[int, int], list[int]] = {}
        for index, place in enumerate(mine.spans):
            places.setdefault(place, []).append(index)
        content = self.content
        for place, indices in sorted(places.items(), reverse=True):
            if all(k not in values or _same(values[k], mine.values[k]) for k in indices):
                continue
            old = content[slice(*place)].decode(ENCODING)
            # A repeated value, 3*0.5, is written out.
            new = " ".join(_text(values.get(k, mine.values[k]), old, where) for k in indices)
            content = content[: place[0]] + new.encode(ENCODING) + content[place[1] :]
        return _parsed(self.path, content)

    def with_comment(self, record: DyrRecord, text: str) -> DyrFile:
        """Return the file with a comment behind a record, on its last line, and every other byte as it was. text: one line of Latin-1.

        record: of this file, or of the one that this file is a changed copy of.
        """
        last = self.records[record.number].spans[-1][1]
        slash = self.content.index(b"/", last)
        end = next((k for k in range(slash, len(self.content)) if self.content[k] in b"\r\n"), len(self.content))
        return _parsed(self.path, self.content[:end] + f"// {text}".encode(ENCODING, "replace") + self.content[end:])

    def write(self, path: str | Path) -> Path:
        """Write the bytes of the file, whole or not at all, and return its path."""
        return write_bytes(Path(path), self.content)


def read_dyr(path: str | Path) -> DyrFile:
    """Return the records of a .dyr file.

    ModelError, with file and line, for a record without `/`, a text where a number is due, a quote without its end, a file that is
    empty, no text, or power-flow data (.raw).
    """
    return _parsed(str(path), content_of(Path(path)))


def _parsed(path: str, content: bytes) -> DyrFile:
    text = content.decode(ENCODING)
    begin = start_of(text)
    if _RAW.search(text[begin:]):
        raise ModelError(
            "this is power-flow data", where=path, expected=f"dynamic data (.dyr): {_FORM}", hint="read_raw reads it"
        )
    lines = [begin] + [match.end() for match in _LINE_END.finditer(text)]
    records: list[DyrRecord] = []
    for pieces, closed in _records(text, begin):
        first = bisect_right(lines, pieces[0].start)
        _check_one(pieces, closed, f"{path}:{first}", lambda place: bisect_right(lines, place))
        if not _is_event(pieces):
            records.append(_record(len(records), first, pieces, path))
    return DyrFile(path, content, tuple(records))


def _records(text: str, begin: int) -> Iterator[tuple[list[Word], bool]]:
    """Yield the tokens of each record, and whether a `/` ends it."""
    pieces: list[Word] = []
    place, at_start = begin, True
    while place < len(text):
        if at_start:
            comment = (_COMMENT if pieces else _COMMENT_BETWEEN).match(text, place)
            place = comment.end() if comment else place
            at_start = False
        for piece in tokens(text, place):
            place = piece.end
            if piece.kind == "line":
                at_start = True
                if pieces:
                    pieces.append(piece)
                break
            if piece.kind == "slash":
                if pieces:
                    yield pieces, True
                    pieces = []
                rest = _REST.match(text, place)
                place = rest.end() if rest else place
                break
            pieces.append(piece)
        else:
            break
    if pieces:
        yield pieces, False


def _check_one(pieces: list[Word], closed: bool, where: str, line_of: Callable[[int], int]) -> None:
    """Raise ModelError where the tokens are those of two records, or their end is the file's."""
    hint = "end the record with /"
    values = [p for p in pieces if p.kind not in ("comma", "line")]
    user = len(values) > 1 and _bare(values[1]).upper().startswith("USR")
    for k, piece in enumerate(pieces):
        if piece.kind != "line" or k + 2 >= len(pieces):
            continue
        bus, model = pieces[k + 1], pieces[k + 2]
        named = bus.kind == "word" and bus.text.isdigit() and model.kind in ("quoted", "word")
        if not named or not _NAME.fullmatch(_bare(model)) or (user and model in values[2:4]):
            continue
        at = line_of(bus.start)
        raise ModelError(
            "a record without its end", where=where, expected="a /", got=f"the next record, at line {at}", hint=hint
        )
    if not closed:
        raise ModelError("a record without its end", where=where, expected="a /", got="the end of the file", hint=hint)


def _is_event(pieces: list[Word]) -> bool:
    words = [_bare(p) for p in pieces if p.kind in ("quoted", "word")][:2]
    return len(words) == 2 and words[1].upper() in _EVENTS and words[0].isalpha()


def _bare(piece: Word) -> str:
    return piece.text.strip("'\"").strip()


def _record(number: int, line: int, pieces: list[Word], path: str) -> DyrRecord:
    where = f"{path}:{line}"
    items = items_of(pieces, where)
    bus = _integer(items[0] if items else None, "a bus number", where)
    model = items[1].value if len(items) > 1 else None
    if not isinstance(model, str) or not model.strip():
        raise ModelError("a record without the name of a model", where=where, expected=_FORM, got=_shown(model))
    name = model.strip().upper()
    user, machine, rest = None, "", items[2:]
    own = next((k for k, item in enumerate(rest[:2]) if _is_name(item)), None) if name.startswith("USR") else None
    if own is not None:
        numbers: list[Item | None] = [*rest[own + 1 : own + 7], *(6 * [None])]
        name = str(rest[own].value).strip().upper()
        user = UserModel(*(_integer(n, f"an integer of {name} (IC IT NI NC NS NV)", where) for n in numbers[:6]))
        machine, rest = _id(rest[0], pieces) if own else "", rest[own + 7 :]
    elif rest:
        machine, rest = _id(rest[0], pieces), rest[1:]
    else:
        raise ModelError(f"a record of {name} without a machine id", where=where, expected=_FORM)
    quoted = {p.start for p in pieces if p.kind == "quoted"}
    for k, item in enumerate(rest):
        if isinstance(item.value, str) and item.start not in quoted:
            raise ModelError(
                f"a text without quotes where value {k} of {name} is due",
                where=where,
                expected="a number",
                got=_shown(item.value),
            )
    return DyrRecord(
        number, bus, name, machine, tuple(i.value for i in rest), line, tuple((i.start, i.end) for i in rest), user
    )


def _is_name(item: Item) -> bool:
    return isinstance(item.value, str) and _NAME.fullmatch(item.value.strip()) is not None


def _id(item: Item, pieces: list[Word]) -> str:
    """Return a machine's id as it is written: 1 stays 1, 01 stays 01."""
    if isinstance(item.value, str):
        return item.value.strip()
    return next((p.text for p in pieces if p.start == item.start and item.value is not None), "1")


def _integer(item: Item | None, what: str, where: str) -> int:
    value = item.value if item else None
    if isinstance(value, float) and value.is_integer():
        return int(value)
    raise ModelError("not a number where one is due", where=where, expected=what, got=_shown(value))


def _shown(value: Value) -> str:
    return "nothing" if value is None else f"'{value}'" if isinstance(value, str) else f"{value:g}"


def _same(new: float | str, old: Value) -> bool:
    if isinstance(new, str) or isinstance(old, str) or old is None:
        return new == old
    return new == old and math.copysign(1.0, new) == math.copysign(1.0, old)


def _text(value: Value, old: str, where: str) -> str:
    if value is None:
        return "1*"  # a default beside the others of one repeated token
    if isinstance(value, str):
        if "\n" in value or "\r" in value or any(ord(c) > 255 or c == "\0" for c in value):
            raise ModelError(
                "a text that a record cannot hold", where=where, expected="one line of Latin-1", got=repr(value)
            )
        return "'" + value.replace("'", "''") + "'"
    if not math.isfinite(value):
        raise ModelError("a number that a record cannot hold", where=where, expected="a finite number", got=str(value))
    if isinstance(value, int) and old.lstrip("+-").isdigit():
        return str(int(value))
    return number_text(value)
