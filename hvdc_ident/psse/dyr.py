"""Dynamic data of PSS/E (.dyr): records of models in free format, and values exchanged in them without another byte changed.

A record is `BUS 'MODEL' ID value value ... /`: items apart by blanks, commas, tabs or line ends, up to a slash; what follows the slash
on its line is a comment, and so is a line that begins with a slash or with @!. Two commas leave an item out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hvdc_ident.errors import ModelError
from hvdc_ident.files import write_bytes
from hvdc_ident.text import listed

MAX_BYTES = 200_000_000
_ITEM = re.compile(r"""'[^'\n]*'|"[^"\n]*"|[/,]|[^\s,/'"]+""")
_COMMENT = re.compile(r"[ \t]*(?:/|@!)")
_EXPONENT = str.maketrans("dD", "ee")


class Span(NamedTuple):
    """Place of an item in the text: from the first to behind the last character."""

    begin: int
    end: int


@dataclass(frozen=True)
class DyrRecord:
    """One record. bus: its number; model: its name in capitals; machine: the identifier of the machine, as text.

    values: what follows, numbers, texts (quoted ones without quotes), or None where an item is left out. spans: where each stands in the
    file's text. line: that of its first item, from 1. A model of the user's own (USRMDL) goes by its own name, its values begin behind it.
    """

    bus: int
    model: str
    machine: str
    values: tuple[float | str | None, ...]
    spans: tuple[Span, ...]
    line: int


@dataclass(frozen=True)
class DyrFile:
    """A file's text, each byte a character, with its records in their order. path: where it was read."""

    path: Path
    text: str
    records: tuple[DyrRecord, ...]

    def at(self, bus: int, machine: str | None = None) -> tuple[DyrRecord, ...]:
        """Return the records of a bus, of one machine where it has several. Raises ModelError where there are none, or several machines."""
        here = [r for r in self.records if r.bus == bus]
        if not here:
            buses = sorted({r.bus for r in self.records})
            raise ModelError(
                f"no record of bus {bus}", where=str(self.path), expected=f"one of {listed(list(map(str, buses[:20])))}"
            )
        machines = list(dict.fromkeys(r.machine for r in here))
        if machine is None and len(machines) > 1:
            raise ModelError(
                f"bus {bus} has several machines", where=str(self.path), expected=f"one of {listed(machines)}"
            )
        chosen = machines[0] if machine is None else machine.strip()
        if chosen not in machines:
            raise ModelError(
                f"bus {bus} has no machine '{chosen}'", where=str(self.path), expected=f"one of {listed(machines)}"
            )
        return tuple(r for r in here if r.machine == chosen)

    def with_values(self, record: DyrRecord, values: Mapping[int, float]) -> DyrFile:
        """Return the file with other numbers in a record, by their places among its values; every other byte stays.

        They are written in single precision, in which PSS/E holds them.
        The record is one of the file, or was before values in other records were exchanged.
        """
        place = next(k for k, r in enumerate(self.records) if r.line == record.line and r.model == record.model)
        own = self.records[place]
        text = self.text
        for k in sorted(values, key=lambda k: own.spans[k].begin, reverse=True):
            text = text[: own.spans[k].begin] + str(np.float32(values[k])) + text[own.spans[k].end :]
        return replace(self, text=text, records=tuple(_records(text, str(self.path))))

    def save(self, path: str | Path) -> Path:
        """Write the file; return its path."""
        return write_bytes(Path(path), self.text.encode("latin-1"))


def read_dyr(path: str | Path) -> DyrFile:
    """Return the records of a .dyr file.

    Raises ModelError for a file that cannot be read, holds no record, or a record that does not end or has no model's name and machine.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except OSError as e:
        raise ModelError(f"the .dyr file cannot be read: {(e.strerror or '').lower()}", where=str(path)) from None
    if len(content) > MAX_BYTES or b"\0" in content:
        raise ModelError("this is no .dyr file", where=str(path), expected=f"text of at most {MAX_BYTES} bytes")
    text = content.decode("latin-1")
    records = tuple(_records(text, str(path)))
    if not records:
        raise ModelError("the .dyr file has no record", where=str(path), expected="BUS 'MODEL' ID values /")
    return DyrFile(path, text, records)


def _records(text: str, where: str) -> Iterator[DyrRecord]:
    at = 3 if text.startswith("\xef\xbb\xbf") else 0  # a byte-order mark, byte by byte
    while True:
        at = _begin(text, at)
        if at >= len(text):
            return
        items: list[Span] = []
        begin, due = at, True
        while True:
            found = _ITEM.search(text, at)
            if found is None:
                raise ModelError(
                    "the record does not end",
                    where=_place(text, begin, where),
                    expected="a slash",
                    got=_shown(text, begin),
                )
            at = found.end()
            if found.group() == "/":
                break
            if found.group() == ",":
                items += [Span(found.start(), found.start())] * due  # left out, and nothing stands there
                due = True
            else:
                items.append(Span(*found.span()))
                due = False
        end = text.find("\n", at)
        at = len(text) if end < 0 else end + 1
        if items and text[items[0].begin : items[0].end].lstrip("-").isdigit():
            yield _record(text, items, begin, where)


def _begin(text: str, at: int) -> int:
    """Return where the next record begins: behind blanks, and lines of comments."""
    while at < len(text):
        if text[at].isspace():
            at += 1
        elif _COMMENT.match(text, at):
            end = text.find("\n", at)
            at = len(text) if end < 0 else end + 1
        else:
            break
    return at


def _record(text: str, items: list[Span], begin: int, where: str) -> DyrRecord:
    words, place = [text[s.begin : s.end] for s in items], _place(text, begin, where)
    if len(words) < 3 or not re.search("[A-Za-z]", words[1]):
        raise ModelError(
            "this is no record of a model", where=place, expected="BUS 'MODEL' ID values /", got=_shown(text, begin)
        )
    model, first = _plain(words[1]).upper(), 3
    if model == "USRMDL" and len(words) > 3:
        model, first = _plain(words[3]).upper(), 4
    values = tuple(_value(w) if w else None for w in words[first:])
    line = text.count("\n", 0, begin) + 1
    return DyrRecord(int(words[0]), model, _plain(words[2]), values, tuple(items[first:]), line)


def _plain(word: str) -> str:
    return word.strip("'\"").strip()


def _value(word: str) -> float | str:
    if word[0] in "'\"":
        return _plain(word)
    try:
        return float(word.translate(_EXPONENT))
    except ValueError:
        return word


def _place(text: str, at: int, where: str) -> str:
    return f"{where}, line {text.count(chr(10), 0, at) + 1}"


def _shown(text: str, at: int) -> str:
    return repr(text[at : at + 40].split("\n")[0])
