"""Free format, in which PSS/E writes its data: values between blanks and commas, texts in quotes, `/` at the end of a record.

As in Fortran's list-directed input: two commas with nothing between them leave a value at its default, 3*0.5 is the value 0.5
three times, and 1.0D-3 is 0.001.
"""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Literal, NamedTuple

from hvdc_ident.errors import ModelError

Kind = Literal["quoted", "comma", "slash", "line", "quote", "word"]

# Every byte of a file is one character of Latin-1, so that places in the text are places in the file.
ENCODING: Final = "latin-1"
SHOWN: Final = 12
"""How many buses or ids an error names, as `errors.unknown_name` does."""
BLANKS: Final = " \t\f\v\x1a\xa0"
_TOKEN = re.compile(
    rf"""[{BLANKS}]+
    |(?P<quoted>'(?:[^'\r\n]|'')*'|"(?:[^"\r\n]|"")*")
    |(?P<comma>,)
    |(?P<slash>/)
    |(?P<line>\r\n|\n|\r)
    |(?P<quote>['"])
    |(?P<word>[^{BLANKS}\r\n,/'"]+)""",
    re.VERBOSE,
)
_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[eEdD]([+-]?\d+)|([+-]\d+))?")
_REPEATED = re.compile(r"([1-9]\d{0,3})\*(.*)")


class Word(NamedTuple):
    """A piece of the text, with its place."""

    kind: Kind
    text: str
    start: int
    end: int


class Item(NamedTuple):
    """A value of a record: a number, a text, or None where it is left at its default; and its place in the text.

    Values of one repeated token, 3*0.5, have one place; a default between two commas has an empty one.
    """

    value: float | str | None
    start: int
    end: int


def content_of(path: Path) -> bytes:
    """Return the bytes of a text file; ModelError where it cannot be read, is empty or is no text."""
    try:
        content = path.read_bytes()
    except OSError as e:
        raise ModelError(f"cannot read: {(e.strerror or str(e)).lower()}", where=str(path)) from None
    if not content.removeprefix(codecs.BOM_UTF8).strip():
        raise ModelError("the file is empty", where=str(path), expected="PSS/E data as text")
    zero = content.find(b"\0")
    if zero >= 0:
        raise ModelError(
            "this is not a text file of PSS/E",
            where=str(path),
            expected="one byte for each character",
            got=f"a zero byte at byte {zero}",
            hint="export the case from PSS/E as text (.raw, .dyr), and save text as UTF-8 or Latin-1, not UTF-16",
        )
    return content


def start_of(text: str) -> int:
    """Return where the text begins, after the byte-order mark if there is one."""
    mark = codecs.BOM_UTF8.decode(ENCODING)
    return len(mark) if text.startswith(mark) else 0


def tokens(text: str, start: int, end: int | None = None) -> Iterator[Word]:
    """Yield the tokens of the text from a place on; blanks are none."""
    for match in _TOKEN.finditer(text, start, len(text) if end is None else end):
        kind = match.lastgroup
        if kind is not None:
            yield Word(kind, match[0], *match.span())  # type: ignore[arg-type]  # the names of the groups are the kinds


def items_of(pieces: list[Word], where: str) -> list[Item]:
    """Return the values of a record's tokens up to its `/`; ModelError for a quote without its end, or a word without quotes.

    where: the file and line that an error names.
    """
    items: list[Item] = []
    separated = False  # a comma since the last value
    for piece in pieces:
        if piece.kind == "comma":
            if separated:
                items.append(Item(None, piece.start, piece.start))
            separated = True
            continue
        if piece.kind == "line":
            continue
        if piece.kind == "quote":
            raise ModelError("a quote without its end on the same line", where=where, got=piece.text)
        if piece.kind == "quoted":
            quote = piece.text[0]
            value = piece.text[1:-1].replace(2 * quote, quote)
            items.append(Item(value, piece.start, piece.end))
        else:
            items += [Item(v, piece.start, piece.end) for v in _values(piece.text)]
        separated = False
    return items


def _values(word: str) -> list[float | str | None]:
    repeated = _REPEATED.fullmatch(word)
    if repeated is None:
        return [_value(word)]
    return int(repeated[1]) * [_value(repeated[2]) if repeated[2] else None]


def _value(word: str) -> float | str:
    number = number_of(word)
    return word if number is None else number


def number_of(word: str) -> float | None:
    """Return the number that a word is, also with Fortran's exponents (1.0D-3, 1.0-3); None for any other word."""
    match = _NUMBER.fullmatch(word)
    if match is None:
        return None
    number = float(f"{match[1]}e{match[2] or match[3] or 0}")
    return number if math.isfinite(number) else None


def number_text(value: float) -> str:
    """Return the number with as few digits as give the same double, and a decimal point: 0.5, 1.0E-05."""
    mantissa, _, exponent = repr(float(value)).partition("e")
    point = "" if "." in mantissa else ".0"
    return f"{mantissa}{point}" + (f"E{exponent}" if exponent else "")
