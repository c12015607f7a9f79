"""The one codec of results: frozen dataclasses as JSON holds them, and back.

A field stands under its own name. `stored_as` gives it another key, or leaves it out where it is empty; `NOT_STORED` keeps it out
of the JSON, `INLINE` puts the keys of a part among those of the whole. `stored_properties` of a class are written beside its fields,
for those who read the JSON with other tools. A number that is not finite is written as null; where only a number can stand, null is
read back as nan, or as the field's default where that is not finite. A complex number is [re, im].
"""

from __future__ import annotations

import math
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeVar, Union, get_args, get_origin

from hvdc_ident.errors import InputError
from hvdc_ident.immutable import FrozenMap

T = TypeVar("T")
NOT_STORED: dict[str, Any] = {"json": ""}
"""Metadata of a field that the JSON does not have: it can be made again, or no JSON can hold it."""
INLINE: dict[str, Any] = {"inline": True}
"""Metadata of a field that is a dataclass and whose keys stand among those of the whole."""


def stored_as(key: str, *, optional: bool = False) -> dict[str, Any]:
    """Return the metadata of a field that stands under another key. optional: it is left out where it is empty."""
    return {"json": key, "optional": optional}


class Coded:
    """A frozen dataclass that `to_dict` writes as JSON holds it and `from_dict` reads again."""

    stored_properties: ClassVar[tuple[str, ...]] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON holds it: full precision, None for a number that is not finite."""
        return plain_fields(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the result that `to_dict` wrote; keys that it does not have are passed over. Raises InputError for anything else."""
        return read_fields(cls, data)


@dataclass(frozen=True)
class Rows:
    """A long list of a result that is made row by row whenever it is written, never held as a whole."""

    make: Callable[[], Iterable[Any]]
    count: int

    def __iter__(self) -> Iterator[Any]:
        return iter(self.make())

    def __len__(self) -> int:
        return self.count


def plain(value: Any) -> Any:
    """Return the value as JSON can hold it: mappings, lists, text, numbers; a number that is not finite becomes None."""
    if value is None or isinstance(value, str | bool | Rows):
        return value
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return _plain_dataclass(value)
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _plain_dataclass(value: Any) -> Any:
    """Return a dataclass by its own `to_dict`, where it has one."""
    own = getattr(value, "to_dict", None)
    return plain_fields(value) if own is None else plain(own())


def plain_fields(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass, and its stored properties, under their keys."""
    by_key: dict[str, Any] = {}
    for f in fields(value):
        own, key = getattr(value, f.name), _key(f)
        if f.metadata.get("inline"):
            by_key |= plain(own)
        elif key and not (f.metadata.get("optional") and _empty(own)):
            by_key[key] = plain(own)
    return by_key | {name: plain(getattr(value, name)) for name in getattr(value, "stored_properties", ())}


def read_fields(kind: type[T], data: Any) -> T:
    """Return the value of a dataclass whose fields a mapping holds under their keys. Raises InputError where it does not."""
    try:
        return _fields(kind, data)
    except _Misread as error:
        where = ".".join(error.path)
        raise InputError(
            f"not the JSON of a {kind.__name__}", where=where, expected=error.expected, got=repr(error.got)[:80]
        ) from None


def _key(f: Field[Any]) -> str:
    return str(f.metadata.get("json", f.name))


def _empty(value: Any) -> bool:
    return value is None or (hasattr(value, "__len__") and len(value) == 0)


class _Misread(Exception):
    """A value that is not of the kind asked for. path: the keys that lead to it."""

    def __init__(self, expected: str, got: Any, path: tuple[str, ...] = ()) -> None:
        super().__init__(expected)
        self.expected, self.got, self.path = expected, got, path

    def below(self, key: object) -> _Misread:
        """Return the same of what stands under a key."""
        return _Misread(self.expected, self.got, (str(key), *self.path))


def _read(kind: Any, value: Any) -> Any:
    """Return the value as the annotation says. Raises _Misread."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any or isinstance(kind, TypeVar):
        return value
    if origin in (Union, types.UnionType):
        return _one_of(parts, value)
    if origin is Literal:
        return _expect(value in parts, value, f"one of {', '.join(map(str, parts))}")
    if isinstance(origin or kind, type):
        return _read_as(origin or kind, parts, value)
    raise TypeError(f"{kind} is no type of a result")


def _read_as(kind: type, parts: tuple[Any, ...], value: Any) -> Any:
    if is_dataclass(kind):
        own = getattr(kind, "from_dict", None)
        return _fields(kind, value) if own is None else own(value)
    if issubclass(kind, Mapping):
        _expect(isinstance(value, Mapping), value, "a mapping")
        of = parts[-1] if parts else Any
        items = {k: _under(k, of, v) for k, v in value.items()}
        return FrozenMap(items) if kind is FrozenMap else items
    if kind in (tuple, list) or kind.__name__ == "Sequence":
        return _sequence(kind, parts, value)
    if kind.__name__ == "ndarray":
        return _array(parts, value)
    if kind is Path:
        return Path(_expect(isinstance(value, str), value, "a path"))
    if kind is complex:
        _expect(isinstance(value, list) and len(value) == 2, value, "[re, im]")
        return complex(_read(float, value[0]), _read(float, value[1]))
    if kind is float:
        if value is None:
            return math.nan
        return float(_expect(isinstance(value, int | float) and not isinstance(value, bool), value, "a number"))
    if kind is int:
        return _expect(isinstance(value, int) and not isinstance(value, bool), value, "a whole number")
    return _expect(isinstance(value, kind), value, {str: "a text", bool: "true or false"}.get(kind, kind.__name__))


def _sequence(kind: type, parts: tuple[Any, ...], value: Any) -> Any:
    _expect(isinstance(value, list | tuple), value, "a list")
    if not parts:
        return kind(value)
    if kind is tuple and parts[-1] is not Ellipsis:
        _expect(len(value) == len(parts), value, f"a list of {len(parts)}")
        return tuple(_under(k, of, v) for k, (of, v) in enumerate(zip(parts, value, strict=True)))
    items = (_under(k, parts[0], v) for k, v in enumerate(value))
    return list(items) if kind is list else tuple(items)


def _array(parts: tuple[Any, ...], value: Any) -> Any:
    """Return a list of lists of numbers as an array; of complex ones from a last axis of [re, im]."""
    import numpy as np

    wanted = next((a for p in parts[1:] for a in get_args(p)), np.float64)
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise _Misread("rows of numbers", value) from None
    if not issubclass(wanted, np.complexfloating):
        return array if wanted is Any else array.astype(wanted, copy=False)
    _expect(array.size == 0 or array.shape[-1] == 2, value, "pairs [re, im]")
    return array[..., 0] + 1j * array[..., 1] if array.size else array.astype(complex)


def _one_of(parts: tuple[Any, ...], value: Any) -> Any:
    """Return the value as the first of several annotations that it fits; None where None is one of them."""
    if value is None and type(None) in parts:
        return None
    first: _Misread | None = None
    for part in parts:
        if part is type(None):
            continue
        try:
            return _read(part, value)
        except _Misread as error:
            first = first or error
    assert first is not None
    raise first


def _fields(kind: Any, data: Any) -> Any:
    _expect(isinstance(data, Mapping), data, "a mapping")
    made = {}
    for f in fields(kind):
        key = _key(f)
        if not (f.init and key):
            continue
        if f.metadata.get("inline"):
            made[f.name] = _read(_annotations(kind)[f.name], data)
        elif key in data and data[key] is None and isinstance(f.default, float) and not math.isfinite(f.default):
            made[f.name] = f.default
        elif key in data:
            made[f.name] = _under(key, _annotations(kind)[f.name], data[key])
        elif f.default is MISSING and f.default_factory is MISSING:
            raise _Misread(f"the key {key}", [*data])
    return kind(**made)


def _under(key: object, kind: Any, value: Any) -> Any:
    try:
        return _read(kind, value)
    except _Misread as error:
        raise error.below(key) from None


def _expect(right: bool, value: Any, expected: str) -> Any:
    if not right:
        raise _Misread(expected, value)
    return value


@cache
def _annotations(kind: type) -> dict[str, Any]:
    """Return the annotations of the fields of a dataclass that are read, each in the names of the module that states it."""
    by_field: dict[str, Any] = {}
    read = {f.name for f in fields(kind) if f.init and _key(f)}
    for owner in reversed(kind.__mro__):
        names = vars(sys.modules[owner.__module__])
        for name, told in vars(owner).get("__annotations__", {}).items():
            if name in read:
                by_field[name] = eval(told, dict(names)) if isinstance(told, str) else told
    return by_field
