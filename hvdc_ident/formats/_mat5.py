"""The variables of a MATLAB version 5 to 7.2 file, every length checked before it is believed.

scipy reads these files too, but believes the lengths in them: a damaged file ends its process, so that each would have
to be read in a process of its own, which takes a second and a half more. Numbers, text, structures and cells
are understood, which is what waveforms come in; objects are named and left.
Source: MathWorks, "MAT-File Format", the level 5 format.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.formats import MAX_BYTES

HEADER = 128
MAX_DEPTH = 16
MAX_PARTS = 100_000
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _STRUCT, _CHAR, _SPARSE = 1, 2, 4, 5
_NUMERIC = range(6, 16)


@dataclass(frozen=True)
class Opaque:
    """A variable in a form that is not published: an object, a function, a timeseries."""

    kind: str


class Mat5Error(ValueError):
    """Bytes that are no version 5 file."""


def variables(content: bytes) -> dict[str, Any]:
    """The variables by name: arrays squeezed, text, a dict for a structure, a list for an array of them or cells.

    Raises Mat5Error where the bytes do not hold together or unpack to more than memory may take.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if len(content) < HEADER or order is None:
        raise Mat5Error("no header of a version 5 file")
    reader = _Reader(order)
    found: dict[str, Any] = {}
    for kind, data in reader.elements(memoryview(content)[HEADER:]):
        if kind == _COMPRESSED:
            inner = list(reader.elements(memoryview(reader.unpacked(data))))
            kind, data = inner[0] if inner else (0, memoryview(b""))
        if kind == _MATRIX:
            name, value = reader.matrix(data, 0)
            if name:
                found[name] = value
    return found


class _Reader:
    """Reader of the elements of a file, which counts what it has read against the limits."""

    def __init__(self, order: str) -> None:
        self.order, self.parts, self.bytes = order, 0, 0

    def elements(self, data: memoryview) -> Iterator[tuple[int, memoryview]]:
        """Kind and content of the elements, one after the other."""
        place = 0
        while place < len(data):
            if len(data) - place < 8:
                if any(data[place:]):
                    raise Mat5Error("an element is cut off")
                return
            kind, size = struct.unpack_from(f"{self.order}II", data, place)
            if kind >> 16:  # a small element: its size above its kind, its content in the tag
                kind, size = kind & 0xFFFF, kind >> 16
                if size > 4:
                    raise Mat5Error("a small element is too long")
                yield kind, data[place + 4 : place + 4 + size]
                place += 8
                continue
            if size > len(data) - place - 8:
                raise Mat5Error(f"an element of {size} bytes is cut off")
            yield kind, data[place + 8 : place + 8 + size]
            place += 8 + size + (-size % 8 if kind != _COMPRESSED else 0)

    def unpacked(self, data: memoryview) -> bytes:
        machine = zlib.decompressobj()
        try:
            found = machine.decompress(data, MAX_BYTES - self.bytes)
        except zlib.error as error:
            raise Mat5Error(f"compressed data cannot be read: {error}") from None
        self.bytes += len(found)
        if machine.unconsumed_tail or self.bytes >= MAX_BYTES:
            raise Mat5Error("the file unpacks to more than memory may take")
        return found

    def matrix(self, data: memoryview, depth: int) -> tuple[str, Any]:
        """Name and value of an array."""
        self.parts += 1
        if depth > MAX_DEPTH or self.parts > MAX_PARTS:
            raise Mat5Error("too many arrays within arrays")
        if not len(data):
            return "", np.empty(0)
        parts = self.elements(data)
        flags = self._numbers(*self._next(parts))
        if not flags.size:
            raise Mat5Error("an array without flags")
        kind = int(flags[0]) & 0xFF
        if kind in (16, 17):
            return self._text(*self._next(parts)), Opaque("function" if kind == 16 else "object")
        shape = tuple(int(n) for n in self._numbers(*self._next(parts)))
        if len(shape) < 2 or any(n < 0 for n in shape):
            raise Mat5Error("an array with an impossible shape")
        name = self._text(*self._next(parts))
        count = math.prod(shape)
        if kind in _NUMERIC:
            values = self._numbers(*self._next(parts))
            if values.size != count:
                raise Mat5Error(f"'{name[:40]}' has {values.size} values where its shape asks for {count}")
            return name, np.squeeze(values.astype(float).reshape(shape, order="F"))
        if kind == _CHAR:
            return name, self._text(*self._next(parts))
        if kind == _CELL:
            return name, [self._inner(parts, depth) for _ in range(self._bounded(count))]
        if kind == _STRUCT:
            return name, self._structure(parts, count, depth)
        return name, Opaque("sparse matrix" if kind == _SPARSE else "object")

    def _structure(self, parts: Iterator[tuple[int, memoryview]], count: int, depth: int) -> Any:
        width = self._numbers(*self._next(parts))
        if width.size != 1 or not 0 < int(width[0]) <= 4096:
            raise Mat5Error("field names of an impossible length")
        names = bytes(self._next(parts)[1])
        fields = [
            names[i : i + int(width[0])].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), int(width[0]))
        ]
        self._bounded(count * max(1, len(fields)))
        made = [{field: self._inner(parts, depth) for field in fields} for _ in range(count)]
        return made[0] if count == 1 else made

    def _inner(self, parts: Iterator[tuple[int, memoryview]], depth: int) -> Any:
        kind, data = self._next(parts)
        if kind != _MATRIX:
            raise Mat5Error("an array where none belongs")
        return self.matrix(data, depth + 1)[1]

    def _next(self, parts: Iterator[tuple[int, memoryview]]) -> tuple[int, memoryview]:
        found = next(parts, None)
        if found is None:
            raise Mat5Error("an array is cut off")
        return found

    def _bounded(self, count: int) -> int:
        if count > MAX_PARTS:
            raise Mat5Error("too many arrays within arrays")
        return count

    def _numbers(self, kind: int, data: memoryview) -> np.ndarray[Any, Any]:
        if kind not in _NUMBERS:
            raise Mat5Error(f"numbers of an unknown kind {kind}")
        dtype = np.dtype(self.order + _NUMBERS[kind])
        if len(data) % dtype.itemsize:
            raise Mat5Error("numbers that are cut off")
        return np.frombuffer(data, dtype)

    def _text(self, kind: int, data: memoryview) -> str:
        if kind not in _TEXT:
            raise Mat5Error(f"text of an unknown kind {kind}")
        coding = _TEXT[kind]
        if coding in ("utf-16", "utf-32"):
            coding += "-le" if self.order == "<" else "-be"
        return bytes(data).decode(coding, "replace")
