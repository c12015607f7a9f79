"""Files written whole or not at all, and JSON that keeps every digit."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hvdc_ident.codec import Rows, plain
from hvdc_ident.errors import InputError
from hvdc_ident.next_step import NextStep

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Beginnings of texts that a spreadsheet takes for a formula."""


def write_text(path: Path, text: str | Iterable[str]) -> Path:
    """The path, once the text, or its pieces, is on the disk: a reader sees the old file or the new one, no part."""
    pieces = [text] if isinstance(text, str) else text
    return _write(path, (piece.encode("utf-8") for piece in pieces))


def write_bytes(path: Path, content: bytes) -> Path:
    """The path, once the bytes are on the disk: temporary file, fsync, rename."""
    return _write(path, [content])


def _write(path: Path, pieces: Iterable[bytes]) -> Path:
    make_folder(path.parent)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    except OSError as e:
        raise _cannot_write(path, e) from None
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            for piece in pieces:
                stream.write(piece)
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except OSError as e:
        raise _cannot_write(path, e) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    return path


def make_folder(path: Path) -> Path:
    """The folder, made with its parents where it is missing; InputError where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise _cannot_write(path, e) from None
    return path


def csv_cell(text: str) -> str:
    """Text for a CSV cell, no line breaks in it, with an apostrophe before what a spreadsheet would calculate."""
    flat = " ".join(text.splitlines())
    return f"'{flat}" if text.startswith(FORMULA) else flat


def csv_columns(columns: Mapping[str, Any]) -> str:
    """Return CSV text of columns by name: arrays of one length."""
    return csv_text(list(columns), zip(*(c.tolist() for c in columns.values()), strict=True))


def csv_text(header: list[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return CSV text: every digit of every number, nothing for None and NaN, no text that a spreadsheet takes for a formula."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([csv_cell(h) for h in header])
    writer.writerows([[_csv_value(v) for v in row] for row in rows])
    return stream.getvalue()


def _csv_value(value: Any) -> Any:
    if isinstance(value, str):
        return csv_cell(value)
    if value is None or value != value:  # None, or NaN: not recorded
        return ""
    return repr(value) if isinstance(value, float) else value


def csv_name(cell: str) -> str:
    """The text of a cell that `csv_cell` wrote."""
    return cell[1:] if cell.startswith("'") and cell[1:].startswith(FORMULA) else cell


def digest(content: bytes) -> str:
    """The sha256 of some bytes, in hex."""
    return hashlib.sha256(content).hexdigest()


def json_text(value: Any) -> str:
    """JSON text with every digit of every number; what is not finite is written as null."""
    return "".join(json_pieces(value))


def json_pieces(value: Any) -> Iterator[str]:
    """Yield the JSON text in pieces, so that long `Rows` under a name of the outermost mapping are never held as a whole."""
    value = plain(value)
    if not (isinstance(value, dict) and any(isinstance(v, Rows) for v in value.values())):
        yield _dumped(value, 1) + "\n"
        return
    opening = "{\n"
    for name, item in value.items():
        yield f"{opening} {_dumped(name)}: "
        opening = ",\n"
        if isinstance(item, Rows):
            yield from _rows(item)
        else:
            yield _dumped(item, 1).replace("\n", "\n ")
    yield "\n}\n"


def _rows(rows: Rows) -> Iterator[str]:
    """A JSON list, one row a line."""
    opening = "[\n  "
    for row in rows:
        yield opening + _dumped(plain(row))
        opening = ",\n  "
    yield "[]" if opening.startswith("[") else "\n ]"


def _dumped(value: Any, indent: int | None = None) -> str:
    return json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False, default=_listed)


def _listed(value: Any) -> list[Any]:
    """Rows that stand deeper than the outermost mapping, as the list they are."""
    if isinstance(value, Rows):
        return [plain(row) for row in value]
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _cannot_write(path: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot write: {(error.strerror or str(error)).lower()}",
        where=str(path),
        next=(NextStep("folder"),),
    )
